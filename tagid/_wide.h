/* Loops that are compiled twice: for the processors of today, and for any. */
#ifndef TAGID_WIDE_H
#define TAGID_WIDE_H

/* Wider vectors where the processor has them, decided when the module is loaded. Not by the name of a
 * processor: GCC compares `arch=haswell` with the one present, and runs the narrow clone on all later ones. */
#if defined(__GNUC__) && !defined(__clang__) && defined(__x86_64__) && defined(__linux__) &&                 \
    defined(__GLIBC__)
#if __GNUC__ >= 12
#define WIDE __attribute__((target_clones("arch=x86-64-v3", "default")))
#else
#define WIDE __attribute__((target_clones("avx2", "default")))
#endif
#else
#define WIDE
#endif

/* What is not inlined before the clones are made stays narrow. */
#if defined(__GNUC__)
#define INLINE static inline __attribute__((always_inline))
#else
#define INLINE static inline
#endif

#endif
