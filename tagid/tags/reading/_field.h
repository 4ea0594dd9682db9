/* Templates of points in the basis of the range profiles, and least squares on them.
 *
 * `tagid.tags.reading` holds the formulas, and does the same with numpy where no compiler was present. Only
 * the stable ABI and the buffer protocol are used. Complex numbers are pairs of real ones.
 */
#ifndef TAGID_FIELD_H
#define TAGID_FIELD_H
#include "../_buffers.h"
#include <math.h>
#include <stdlib.h>
#include <string.h>

#define LANES 4 /* numbers of coordinates are padded to a multiple */
#define MOST 24 /* points of a set, at most */

typedef struct {
    const double *antennas; /* (ways, 3, views) */
    const double *middle;   /* (3, views), where patterns are seen from */
    const int32_t *circle;  /* (views,) antenna height of each view */
    const float *profiles;  /* (entries, 2, width) */
    int64_t ways, views, entries, width, circles;
    double start, step, wavenumber;
} Field;

typedef struct {
    double edge, softness, floor;
} Pattern; /* of `Aspect`; a floor of 1 is the same from all sides */

/* Coordinates that one register holds, in any place. */
typedef float Four __attribute__((vector_size(4 * LANES)));

INLINE Four load(const float *from)
{
    Four found;
    memcpy(&found, from, sizeof found);
    return found;
}

INLINE void store(float *to, Four values) { memcpy(to, &values, sizeof values); }

/* Views of a circle, at least 1. */
INLINE int64_t on_circle(const Field *g, int64_t c)
{
    int64_t count = 0;
    for (int64_t v = 0; v < g->views; v++)
        count += g->circle[v] == c;
    return count ? count : 1;
}

/* cos and sin of `cycles` turns; single precision, the whole turns removed in double. */
INLINE void turned(double cycles, float *c, float *s)
{
    const double whole = (cycles + 6755399441055744.0) - 6755399441055744.0;
    const float r = (float)(cycles - whole);
    const int32_t q = (int32_t)(4.0f * r + (r < 0.0f ? -0.5f : 0.5f));
    const float t = 6.283185307179586f * (r - 0.25f * (float)q), z = t * t;
    /* Minimax polynomials up to pi / 4 (S. Moshier, Cephes). */
    const float sine = ((-1.9515295891e-4f * z + 8.3321608736e-3f) * z - 1.6666654611e-1f) * z * t + t;
    const float cosine =
        ((2.443315711809948e-5f * z - 1.388731625493765e-3f) * z + 4.166664568298827e-2f) * z * z - 0.5f * z +
        1.0f;
    const float a = q & 1 ? sine : cosine, b = q & 1 ? cosine : sine;
    *c = (q + 1) & 2 ? -a : a;
    *s = q & 2 ? -b : b;
}

/* Distance (views,) of a point from the antennas, plus an offset. */
INLINE void distances(const Field *g, const double *point, double offset, double *restrict out)
{
    const int64_t n = g->views;
    for (int64_t way = 0; way < g->ways; way++) {
        const double *restrict x = g->antennas + 3 * n * way, *restrict y = x + n, *restrict z = y + n;
        for (int64_t v = 0; v < n; v++) {
            const double a = point[0] - x[v], b = point[1] - y[v], c = point[2] - z[v];
            const double d = sqrt(a * a + b * b + c * c);
            out[v] = way ? 0.5 * (out[v] + d) : d;
        }
    }
    for (int64_t v = 0; v < n; v++)
        out[v] += offset;
}

INLINE int32_t entry(const Field *g, double distance)
{
    double at = (distance - (g->start - 0.5 * g->step)) * (1.0 / g->step);
    const double last = (double)(g->entries - 1);
    at = at > 0.0 ? at : 0.0;
    return (int32_t)(at < last ? at : last);
}

/* Phase (views,) at distances (views,). */
INLINE void phases(const Field *g, const double *restrict d, float *restrict re, float *restrict im)
{
    const double per_metre = -g->wavenumber / 3.141592653589793;
    for (int64_t v = 0; v < g->views; v++)
        turned(d[v] * per_metre, re + v, im + v);
}

/* Phase times the pattern's amplitude, of a point that faces `facing`; (0, 0) is no side. */
INLINE void lit(const Field *g, const Pattern *p, const double *point, const double *facing,
                float *restrict re, float *restrict im)
{
    if (p->floor >= 1.0 || (facing[0] == 0.0 && facing[1] == 0.0))
        return;
    const double *restrict x = g->middle, *restrict y = x + g->views, slope = 1.0 / (2.0 * p->softness);
    for (int64_t v = 0; v < g->views; v++) {
        const double a = x[v] - point[0], b = y[v] - point[1];
        const double cosine = (facing[0] * a + facing[1] * b) / sqrt(a * a + b * b);
        double ramp = (cosine - p->edge) * slope + 0.5;
        ramp = ramp > 0.0 ? ramp : 0.0;
        ramp = ramp < 1.0 ? ramp : 1.0;
        const float w = (float)(p->floor + (1.0 - p->floor) * ramp);
        re[v] *= w;
        im[v] *= w;
    }
}

/* One template (2, views, width) from its profile and phase in every view, less its mean over each circle. */
INLINE void template(const Field *g, const int32_t *index, const float *re, const float *im, int64_t stride,
                     int whole, float *restrict out, float *restrict sums)
{
    const int64_t n = g->views, w = g->width;
    float *restrict real = out, *restrict imaginary = out + n * w;
    memset(sums, 0, (size_t)(2 * w * g->circles) * sizeof(float));
    for (int64_t v = 0; v < n; v++) {
        const float a = re[v * stride], b = im[v * stride];
        const float *restrict p = g->profiles + 2 * w * (int64_t)index[v];
        float *restrict s = sums + 2 * w * g->circle[v];
        float *restrict r = real + v * w, *restrict i = imaginary + v * w;
#pragma omp simd
        for (int64_t j = 0; j < w; j++) {
            const float tr = a * p[j] - b * p[w + j], ti = a * p[w + j] + b * p[j];
            r[j] = tr;
            i[j] = ti;
            s[j] += tr;
            s[w + j] += ti;
        }
    }
    if (whole)
        return;
    for (int64_t c = 0; c < g->circles; c++) {
        const float share = 1.0f / (float)on_circle(g, c);
        float *s = sums + 2 * w * c;
        for (int64_t j = 0; j < 2 * w; j++)
            s[j] *= share;
    }
    for (int64_t v = 0; v < n; v++) {
        const float *restrict s = sums + 2 * w * g->circle[v];
#pragma omp simd
        for (int64_t j = 0; j < w; j++) {
            real[v * w + j] -= s[j];
            imaginary[v * w + j] -= s[w + j];
        }
    }
}

/* <a, b> of two arrays (2, n). */
INLINE void inner(const float *restrict a, const float *restrict b, int64_t n, double *re, double *im)
{
    float rr = 0.0f, ri = 0.0f;
#pragma omp simd reduction(+ : rr, ri)
    for (int64_t j = 0; j < n; j++) {
        rr += a[j] * b[j] + a[n + j] * b[n + j];
        ri += a[j] * b[n + j] - a[n + j] * b[j];
    }
    *re = rr;
    *im = ri;
}

/* <a, b> of two arrays (2, w), w a multiple of LANES. */
INLINE void product(const float *a, const float *b, int64_t w, double *re, double *im)
{
    Four rr = {0.0f}, ri = {0.0f};
    for (int64_t j = 0; j < w; j += LANES) {
        const Four ar = load(a + j), ai = load(a + w + j), br = load(b + j), bi = load(b + w + j);
        rr += ar * br + ai * bi;
        ri += ar * bi - ai * br;
    }
    *re = (rr[0] + rr[1]) + (rr[2] + rr[3]);
    *im = (ri[0] + ri[1]) + (ri[2] + ri[3]);
}

/* Cholesky factor of a Hermitian positive matrix (k, k), in place below the diagonal. */
INLINE void factorise(int k, double (*g)[2])
{
    for (int j = 0; j < k; j++) {
        double d = g[j * k + j][0];
        for (int s = 0; s < j; s++)
            d -= g[j * k + s][0] * g[j * k + s][0] + g[j * k + s][1] * g[j * k + s][1];
        d = sqrt(d > 1e-300 ? d : 1e-300);
        g[j * k + j][0] = d;
        for (int i = j + 1; i < k; i++) {
            double re = g[i * k + j][0], im = g[i * k + j][1];
            for (int s = 0; s < j; s++) {
                const double *a = g[i * k + s], *b = g[j * k + s];
                re -= a[0] * b[0] + a[1] * b[1];
                im -= a[1] * b[0] - a[0] * b[1];
            }
            g[i * k + j][0] = re / d;
            g[i * k + j][1] = im / d;
        }
    }
}

/* x = G^-1 x by the factor. */
INLINE void substitute(int k, double (*g)[2], double (*x)[2])
{
    for (int i = 0; i < k; i++) {
        for (int s = 0; s < i; s++) {
            const double *a = g[i * k + s];
            x[i][0] -= a[0] * x[s][0] - a[1] * x[s][1];
            x[i][1] -= a[0] * x[s][1] + a[1] * x[s][0];
        }
        const double part = 1.0 / g[i * k + i][0];
        x[i][0] *= part;
        x[i][1] *= part;
    }
    for (int i = k - 1; i >= 0; i--) {
        for (int s = i + 1; s < k; s++) {
            const double *a = g[s * k + i];
            x[i][0] -= a[0] * x[s][0] + a[1] * x[s][1];
            x[i][1] -= a[0] * x[s][1] - a[1] * x[s][0];
        }
        const double part = 1.0 / g[i * k + i][0];
        x[i][0] *= part;
        x[i][1] *= part;
    }
}

/* The field of a tuple (antennas, middle, circle, profiles, circles, width, start, step, wavenumber). */
static inline int field_of(Held *h, PyObject *tables, Field *g)
{
    PyObject *antennas, *middle, *circle, *profiles;
    Py_ssize_t circles, width;
    if (!PyArg_ParseTuple(tables, "OOOOnnddd", &antennas, &middle, &circle, &profiles, &circles, &width,
                          &g->start, &g->step, &g->wavenumber))
        return 0;
    if (!(g->middle = take(h, middle, -1, 0)))
        return 0;
    g->views = taken(h) / 24;
    if (!(g->antennas = take(h, antennas, -1, 0)))
        return 0;
    g->ways = g->views ? taken(h) / 24 / g->views : 0;
    if (g->views < 1 || g->ways < 1 || taken(h) != 24 * g->views * g->ways)
        return refused("antennas do not fit together");
    if (!(g->circle = take(h, circle, 4 * g->views, 0)) || !(g->profiles = take(h, profiles, -1, 0)))
        return 0;
    g->circles = circles;
    g->width = width;
    if (circles < 1 || circles > g->views || width < LANES || width > 4096 || width % LANES)
        return refused("numbers of circles and coordinates are out of range");
    g->entries = taken(h) / 8 / width;
    if (g->entries < 1 || g->entries > (1 << 24) || taken(h) != 8 * width * g->entries)
        return refused("profiles do not fit together");
    for (int64_t v = 0; v < g->views; v++)
        if (g->circle[v] < 0 || g->circle[v] >= circles)
            return refused("a view's circle is out of range");
    return 1;
}

static inline int below(const int32_t *index, int64_t count, int64_t limit)
{
    for (int64_t i = 0; i < count; i++)
        if (index[i] < 0 || index[i] >= limit)
            return refused("an index is out of range");
    return 1;
}

#endif
