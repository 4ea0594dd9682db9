/* Least squares of the compiled loops: what columns leave at one frequency. After `_spectra.h`; SIDE is the
 * most columns. */
#ifndef TAGID_LEAVE_H
#define TAGID_LEAVE_H
#include "_hermitian.h"
#include <string.h>

#define LOAD 1e-6 /* of each column's energy */

/* What columns (count, 2, views) leave of data (2, views), in place of `rest`; returns its energy. */
INLINE double leave(int count, const double *column, const double *data, int64_t n, double *restrict rest)
{
    double gram[SIDE][SIDE][2], amplitude[SIDE][2], size[SIDE], most = 0.0, left = 0.0;
    for (int c = 0; c < count; c++) {
        for (int d = 0; d <= c; d++)
            inner(column + 2 * n * c, column + 2 * n * d, n, gram[c][d]);
        inner(column + 2 * n * c, data, n, amplitude[c]);
        size[c] = gram[c][c][0];
        most = size[c] > most ? size[c] : most;
    }
    for (int c = 0; c < count; c++)
        gram[c][c][0] += LOAD * size[c] + (size[c] > 1e-9 * most ? 0.0 : 1.0);
    factorise(count, gram);
    substitute(count, gram, amplitude);
    memcpy(rest, data, (size_t)(2 * n) * sizeof(double));
    for (int c = 0; c < count; c++) {
        const double *restrict own = column + 2 * n * c;
        const double re = amplitude[c][0], im = amplitude[c][1];
        for (int64_t v = 0; v < n; v++) {
            rest[v] -= re * own[v] - im * own[n + v];
            rest[n + v] -= re * own[n + v] + im * own[v];
        }
    }
#pragma omp simd reduction(+ : left)
    for (int64_t v = 0; v < 2 * n; v++)
        left += rest[v] * rest[v];
    return left;
}

#endif
