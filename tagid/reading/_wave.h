/* Waves without a call to the library of C, so that loops over them become vectors. Planes (.., 2, V) hold real
 * and imaginary parts apart. */
#ifndef TAGID_WAVE_H
#define TAGID_WAVE_H
#include "_buffers.h"
#include <math.h>

/* exp(-j x) by polynomials over half a turn: to 3e-16. */
INLINE void wave_of(double x, double *re, double *im)
{
    const double half = rint(x * 0.31830988618379067154);
    const double r = (x - half * 3.141592653589793116) - half * 1.2246467991473532e-16, q = r * r;
    const double odd = half - 2.0 * rint(0.5 * half), sign = 1.0 - 2.0 * odd * odd;
    double s = 1.9572941063391263e-20, c = -8.896791392450574e-22;
    s = s * q - 8.220635246624329e-18, c = c * q + 4.110317623312165e-19;
    s = s * q + 2.8114572543455206e-15, c = c * q - 1.5619206968586225e-16;
    s = s * q - 7.647163731819816e-13, c = c * q + 4.779477332387385e-14;
    s = s * q + 1.6059043836821613e-10, c = c * q - 1.1470745597729725e-11;
    s = s * q - 2.505210838544172e-08, c = c * q + 2.08767569878681e-09;
    s = s * q + 2.7557319223985893e-06, c = c * q - 2.755731922398589e-07;
    s = s * q - 1.984126984126984e-04, c = c * q + 2.48015873015873e-05;
    s = s * q + 8.333333333333333e-03, c = c * q - 1.3888888888888889e-03;
    s = s * q - 1.6666666666666666e-01, c = c * q + 4.1666666666666664e-02;
    *im = -sign * (r + r * q * s);
    *re = sign * (1.0 + q * (c * q - 0.5));
}

/* So many waves (count, 2, V) at the next frequency: each times its step. */
INLINE void advance(double *waves, const double *steps, int64_t count, int64_t V)
{
    for (int64_t i = 0; i < count; i++) {
        double *restrict wave = waves + 2 * i * V;
        const double *restrict step = steps + 2 * i * V;
#pragma omp simd
        for (int64_t v = 0; v < V; v++) {
            const double re = wave[v], im = wave[V + v];
            wave[v] = re * step[v] - im * step[V + v];
            wave[V + v] = re * step[V + v] + im * step[v];
        }
    }
}

/* sum += factor a b, all planes. */
INLINE void add_product(const double *restrict a, const double *restrict b, double factor, int64_t V,
                        double *restrict sum)
{
#pragma omp simd
    for (int64_t v = 0; v < V; v++) {
        sum[v] += factor * (a[v] * b[v] - a[V + v] * b[V + v]);
        sum[V + v] += factor * (a[v] * b[V + v] + a[V + v] * b[v]);
    }
}

#endif
