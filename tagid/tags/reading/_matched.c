/* Points in the plane moved to where they explain most of the scans.
 *
 * move_points: free places near a start
 *
 * `tagid.tags.reading` holds the formulas, and does the same with numpy where no compiler was present. Only
 * the stable ABI and the buffer protocol are used. Complex numbers are pairs of real ones.
 */
#include "../_buffers.h"
#include <math.h>
#include <stdlib.h>
#include <string.h>

#define MOST 24 /* points, at most */

typedef struct {
    const double *antennas; /* (ways, 3, views) */
    const int32_t *circle;  /* (views,) antenna height of each view */
    const float *profiles;  /* (entries, 2, width) */
    int64_t ways, views, entries, width, circles;
    double start, step, wavenumber;
} Field;

typedef struct {
    const Field *field;
    const float *data; /* (2, views, width) */
    float *templates;  /* (room, 2, views, width) */
    double *b;         /* (room, 2) */
    double *far;       /* (views,) */
    float *re, *im, *sums;
    int32_t *index;
} Scene;

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

/* Distance (views,) of a point (2,) in the plane from the antennas. */
INLINE void distances(const Field *g, const double *point, double *restrict out)
{
    const int64_t n = g->views;
    for (int64_t way = 0; way < g->ways; way++) {
        const double *restrict x = g->antennas + 3 * n * way, *restrict y = x + n, *restrict z = y + n;
        for (int64_t v = 0; v < n; v++) {
            const double a = point[0] - x[v], b = point[1] - y[v];
            const double d = sqrt(a * a + b * b + z[v] * z[v]);
            out[v] = way ? 0.5 * (out[v] + d) : d;
        }
    }
}

INLINE int32_t entry(const Field *g, double distance)
{
    double at = (distance - (g->start - 0.5 * g->step)) * (1.0 / g->step);
    const double last = (double)(g->entries - 1);
    at = at > 0.0 ? at : 0.0;
    return (int32_t)(at < last ? at : last);
}

/* One template (2, views, width) from its profile and phase in every view, less its mean over each circle. */
INLINE void template(const Scene *s, float *restrict out)
{
    const Field *g = s->field;
    const int64_t n = g->views, w = g->width;
    float *restrict real = out, *restrict imaginary = out + n * w, *restrict sums = s->sums;
    memset(sums, 0, (size_t)(2 * w * g->circles) * sizeof(float));
    for (int64_t v = 0; v < n; v++) {
        const float a = s->re[v], b = s->im[v];
        const float *restrict p = g->profiles + 2 * w * (int64_t)s->index[v];
        float *restrict sum = sums + 2 * w * g->circle[v];
        float *restrict r = real + v * w, *restrict i = imaginary + v * w;
#pragma omp simd
        for (int64_t j = 0; j < w; j++) {
            const float tr = a * p[j] - b * p[w + j], ti = a * p[w + j] + b * p[j];
            r[j] = tr;
            i[j] = ti;
            sum[j] += tr;
            sum[w + j] += ti;
        }
    }
    for (int64_t c = 0; c < g->circles; c++) {
        const float share = 1.0f / (float)on_circle(g, c);
        for (int64_t j = 0; j < 2 * w; j++)
            sums[2 * w * c + j] *= share;
    }
    for (int64_t v = 0; v < n; v++) {
        const float *restrict sum = sums + 2 * w * g->circle[v];
#pragma omp simd
        for (int64_t j = 0; j < w; j++) {
            real[v * w + j] -= sum[j];
            imaginary[v * w + j] -= sum[w + j];
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

/* Template number i, of a point, and its b. */
INLINE void place(const Scene *s, int64_t i, const double *point)
{
    const Field *g = s->field;
    const int64_t n = g->views * g->width;
    const double per_metre = -g->wavenumber / 3.141592653589793;
    distances(g, point, s->far);
    for (int64_t v = 0; v < g->views; v++)
        s->index[v] = entry(g, s->far[v]);
    for (int64_t v = 0; v < g->views; v++)
        turned(s->far[v] * per_metre, s->re + v, s->im + v);
    template(s, s->templates + 2 * n * i);
    inner(s->templates + 2 * n * i, s->data, n, s->b + 2 * i, s->b + 2 * i + 1);
}

/* Row i and column i of the Gram matrix (k, k) of a set. */
INLINE void relate(const Scene *s, const int32_t *set, int64_t k, int64_t i, int64_t from, double (*gram)[2])
{
    const int64_t n = s->field->views * s->field->width;
    for (int64_t j = from; j < k; j++) {
        double *low = gram[i * k + j], *high = gram[j * k + i];
        inner(s->templates + 2 * n * set[i], s->templates + 2 * n * set[j], n, low, low + 1);
        high[0] = low[0];
        high[1] = -low[1];
    }
    gram[i * k + i][1] = 0.0;
}

/* Energy that a set explains, with the matrix loaded by 1e-2 of itself, and the amplitudes. */
INLINE double explain(const Scene *s, const int32_t *set, int64_t k, const double (*gram)[2], double (*x)[2])
{
    double factor[MOST * MOST][2], load = 0.0, sum = 0.0;
    memcpy(factor, gram, (size_t)(k * k) * sizeof(*factor));
    for (int64_t i = 0; i < k; i++)
        load += gram[i * k + i][0] / (double)k;
    load = 1e-2 * (load > 1e-30 ? load : 1e-30);
    for (int64_t i = 0; i < k; i++) {
        factor[i * k + i][0] += load;
        x[i][0] = s->b[2 * set[i]];
        x[i][1] = s->b[2 * set[i] + 1];
    }
    factorise((int)k, factor);
    substitute((int)k, factor, x);
    for (int64_t i = 0; i < k; i++)
        sum += s->b[2 * set[i]] * x[i][0] + s->b[2 * set[i] + 1] * x[i][1];
    return sum > 0.0 ? sum : 0.0;
}

INLINE double held(double x, double low, double high)
{
    x = x > low ? x : low;
    return x < high ? x : high;
}

/* The vertex of a parabola through three values at -1, 0 and 1; the better side where it opens upwards. */
INLINE double vertex(double middle, double plus, double minus, double reach)
{
    const double bend = 2 * middle - plus - minus, slope = (plus - minus) / 2;
    const double jump = bend > 0 ? slope / bend : slope > 0 ? 1.0 : slope < 0 ? -1.0 : 0.0;
    return jump == jump ? held(jump, -reach, reach) : 0.0;
}

typedef struct {
    double step, reach;
    int64_t size, rounds;
    double *places;     /* (K, 2) */
    double *amplitudes; /* (K, 2) */
} Points;

/* Every point free near its start: joint parabolic steps, or the best single one. */
WIDE static void search_points(const Scene *s, const Points *p)
{
    const int64_t k = p->size, moves = 2 * k;
    double start[2 * MOST], trial[4 * MOST], joint[2 * MOST], value[4 * MOST + 1];
    double gram[MOST * MOST][2], changed[MOST * MOST][2], x[MOST][2], step = p->step;
    int32_t set[MOST];
    memcpy(start, p->places, (size_t)moves * sizeof(double));
    for (int64_t turn = 0; turn <= p->rounds; turn++) {
        for (int64_t i = 0; i < k; i++) {
            set[i] = (int32_t)i;
            place(s, i, p->places + 2 * i);
        }
        for (int64_t i = 0; i < k; i++)
            relate(s, set, k, i, i, gram);
        value[0] = explain(s, set, k, gram, x);
        if (turn == p->rounds)
            break;
        int64_t best = 0;
        for (int64_t m = 0; m < 2 * moves; m++) {
            const int64_t c = m % moves, i = c / 2;
            double at[2] = {p->places[2 * i], p->places[2 * i + 1]};
            at[c % 2] = held(at[c % 2] + (m < moves ? step : -step), start[c] - p->reach, start[c] + p->reach);
            trial[m] = at[c % 2];
            place(s, k + i, at);
            memcpy(changed, gram, (size_t)(k * k) * sizeof(*changed));
            set[i] = (int32_t)(k + i);
            relate(s, set, k, i, 0, changed);
            value[1 + m] = explain(s, set, k, changed, x);
            set[i] = (int32_t)i;
            best = value[1 + m] > value[best] ? 1 + m : best;
        }
        for (int64_t c = 0; c < moves; c++) {
            const double jump = vertex(value[0], value[1 + c], value[1 + moves + c], 2.0);
            joint[c] = held(p->places[c] + jump * step, start[c] - p->reach, start[c] + p->reach);
        }
        for (int64_t i = 0; i < k; i++)
            place(s, i, joint + 2 * i);
        for (int64_t i = 0; i < k; i++)
            relate(s, set, k, i, i, gram);
        if (explain(s, set, k, gram, x) >= value[best])
            memcpy(p->places, joint, (size_t)moves * sizeof(double));
        else if (best)
            p->places[(best - 1) % moves] = trial[best - 1];
        step *= 0.7;
    }
    memcpy(p->amplitudes, x, (size_t)k * sizeof(*x));
}

/* The field of a tuple (antennas, circle, profiles, circles, width, start, step, wavenumber). */
static int field_of(Held *h, PyObject *tables, Field *g)
{
    PyObject *antennas, *circle, *profiles;
    Py_ssize_t circles, width;
    if (!PyArg_ParseTuple(tables, "OOOnnddd", &antennas, &circle, &profiles, &circles, &width, &g->start,
                          &g->step, &g->wavenumber))
        return 0;
    if (!(g->circle = take(h, circle, -1, 0)))
        return 0;
    g->views = taken(h) / 4;
    if (!(g->antennas = take(h, antennas, -1, 0)))
        return 0;
    g->ways = g->views ? taken(h) / 24 / g->views : 0;
    if (g->views < 1 || g->ways < 1 || taken(h) != 24 * g->views * g->ways)
        return refused("antennas do not fit together");
    if (!(g->profiles = take(h, profiles, -1, 0)))
        return 0;
    g->circles = circles;
    g->width = width;
    if (circles < 1 || circles > g->views || width < 1 || width > 4096)
        return refused("numbers of circles and coordinates are out of range");
    g->entries = taken(h) / 8 / width;
    if (g->entries < 1 || g->entries > (1 << 24) || taken(h) != 8 * width * g->entries)
        return refused("profiles do not fit together");
    for (int64_t v = 0; v < g->views; v++)
        if (g->circle[v] < 0 || g->circle[v] >= circles)
            return refused("a view's circle is out of range");
    return 1;
}

static PyObject *move_points(PyObject *self, PyObject *args)
{
    (void)self;
    PyObject *tables, *o[3];
    Py_ssize_t rounds;
    Held h = {.count = 0};
    Field g;
    Points m;
    Scene s = {.field = &g};
    if (!PyArg_ParseTuple(args, "OO(dd)nOO", &tables, o, &m.step, &m.reach, &rounds, o + 1, o + 2))
        return NULL;
    m.rounds = rounds;
    if (!field_of(&h, tables, &g) || !(s.data = take(&h, o[0], 8 * g.views * g.width, 0)) ||
        !(m.places = take(&h, o[1], -1, 1)))
        return finished(&h);
    m.size = taken(&h) / 16;
    if (m.size < 1 || m.size > MOST || taken(&h) != 16 * m.size || rounds < 0) {
        refused("points do not fit together");
        return finished(&h);
    }
    if (!(m.amplitudes = take(&h, o[2], 16 * m.size, 1)))
        return finished(&h);
    const int64_t room = 2 * m.size, values = g.views * g.width;
    const int64_t floats = 2 * values * room + 3 * g.views + 2 * g.width * g.circles;
    void *scratch = malloc((size_t)floats * sizeof(float) + (size_t)(g.views + 2 * room) * sizeof(double));
    if (!scratch) {
        PyErr_NoMemory();
        return finished(&h);
    }
    s.far = scratch;
    s.b = s.far + g.views;
    s.templates = (float *)(s.b + 2 * room);
    s.re = s.templates + 2 * values * room;
    s.im = s.re + g.views;
    s.index = (int32_t *)(s.im + g.views);
    s.sums = (float *)(s.index + g.views);
    Py_BEGIN_ALLOW_THREADS search_points(&s, &m);
    Py_END_ALLOW_THREADS free(scratch);
    return finished(&h);
}

static PyMethodDef methods[] = {
    {"move_points", move_points, METH_VARARGS,
     "move_points(tables, data, (step, reach), rounds, places, amplitudes)"},
    {NULL, NULL, 0, NULL},
};

MODULE(_matched, "Compiled search for places of points (see tagid.tags.reading.compiled).", methods, 4)
