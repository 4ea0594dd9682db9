/* Spectra of a turn as the compiled loops of the reading on bodies take them, and sums over their columns. */
#ifndef TAGID_SPECTRA_H
#define TAGID_SPECTRA_H
#include "../_buffers.h"

typedef struct {
    const double *antenna; /* (2, views) */
    const double *height;  /* (views,) */
    const double *data;    /* (F, 2, views) */
    int64_t views, frequencies;
    double first, step, distance; /* kappa of the first frequency and between two; d */
} Spectra;

/* Antenna, height and data from Python; 0 with an error set. */
static inline int take_spectra(Held *h, PyObject *const *from, Spectra *g)
{
    if (!(g->height = take(h, from[1], -1, 0)))
        return 0;
    g->views = taken(h) / 8;
    if (!(g->antenna = take(h, from[0], 16 * g->views, 0)) || !(g->data = take(h, from[2], -1, 0)))
        return 0;
    g->frequencies = g->views ? taken(h) / 16 / g->views : 0;
    if (g->frequencies < 1 || taken(h) != 16 * g->views * g->frequencies)
        return refused("spectra and antennas do not fit together");
    return 1;
}

/* Takes out what is constant over the views of a column (2, views). */
INLINE void centre(double *restrict x, int64_t n)
{
    for (int part = 0; part < 2; part++, x += n) {
        double mean = 0.0;
#pragma omp simd reduction(+ : mean)
        for (int64_t v = 0; v < n; v++)
            mean += x[v];
        mean /= (double)n;
        for (int64_t v = 0; v < n; v++)
            x[v] -= mean;
    }
}

/* <a, b> of columns (2, views). */
INLINE void inner(const double *restrict a, const double *restrict b, int64_t n, double *out)
{
    double re = 0.0, im = 0.0;
#pragma omp simd reduction(+ : re, im)
    for (int64_t v = 0; v < n; v++) {
        re += a[v] * b[v] + a[n + v] * b[n + v];
        im += a[v] * b[n + v] - a[n + v] * b[v];
    }
    out[0] = re;
    out[1] = im;
}

#endif
