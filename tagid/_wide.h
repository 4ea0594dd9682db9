/* Wider vectors where the processor has them, decided when the module is loaded; the loops stay plain C.
 *
 * A clone for `arch=haswell` runs on that processor alone: GCC compares its name, not what it can do.
 */
#ifndef TAGID_WIDE_H
#define TAGID_WIDE_H

#if defined(__GNUC__) && !defined(__clang__) && defined(__x86_64__) && defined(__linux__) && defined(__GLIBC__)
#if __GNUC__ >= 12
#define WIDE __attribute__((target_clones("arch=x86-64-v3", "default")))
#else
#define WIDE __attribute__((target_clones("avx2", "default")))
#endif
#else
#define WIDE
#endif

#endif
