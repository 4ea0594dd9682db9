/* Points that are asked for again and again: their profile and phase in every view are kept. */
#ifndef TAGID_MANY_H
#define TAGID_MANY_H
#include "_block.h"

#define WIDEST 16 /* coordinates of which sums are kept in registers */

typedef struct {
    const int32_t *index; /* (views, N) */
    const float *turn;    /* (views, 2, N) */
    int64_t count;
    float *rows;    /* (2, views, width) data, and scratch */
    float *sums;    /* (circles, 2, width) */
    float *columns; /* (width, 2, entries) the profiles */
    float *table;   /* (2, entries) */
    float *total;   /* (2, N) */
    double *out;  /* (N, 2) or (N,) */
    int squared;  /* |b|^2 is asked for */
} Correlation;

/* Rows (2, views, width) less their mean over the views of each circle. */
INLINE void without_constant(const Field *g, float *rows, float *sums)
{
    const int64_t n = g->views, w = g->width;
    memset(sums, 0, (size_t)(2 * w * g->circles) * sizeof(float));
    for (int64_t v = 0; v < n; v++) {
        float *s = sums + 2 * w * g->circle[v];
        for (int64_t j = 0; j < w; j++) {
            s[j] += rows[w * v + j];
            s[w + j] += rows[w * (n + v) + j];
        }
    }
    for (int64_t c = 0; c < g->circles; c++) {
        const float share = 1.0f / (float)on_circle(g, c);
        for (int64_t j = 0; j < 2 * w; j++)
            sums[2 * w * c + j] *= share;
    }
    for (int64_t v = 0; v < n; v++) {
        const float *s = sums + 2 * w * g->circle[v];
        for (int64_t j = 0; j < w; j++) {
            rows[w * v + j] -= s[j];
            rows[w * (n + v) + j] -= s[w + j];
        }
    }
}

/* b of the points, or its square: the data's products with all profiles of a view are read at the points. */
INLINE void correlate_points(const Field *g, const Correlation *c)
{
    const int64_t n = g->views, w = g->width, m = g->entries, count = c->count;
    float *restrict re = c->table, *restrict im = re + m;
    float *restrict real = c->total, *restrict imaginary = real + count;
    without_constant(g, c->rows, c->sums);
    for (int64_t e = 0; e < m; e++)
        for (int64_t j = 0; j < w; j++) {
            c->columns[m * (2 * j) + e] = g->profiles[w * (2 * e) + j];
            c->columns[m * (2 * j + 1) + e] = g->profiles[w * (2 * e + 1) + j];
        }
    memset(c->total, 0, (size_t)(2 * count) * sizeof(float));
    for (int64_t v = 0; v < n; v++) {
        memset(c->table, 0, (size_t)(2 * m) * sizeof(float));
        for (int64_t j = 0; j < w; j++) {
            const float x = c->rows[w * v + j], y = c->rows[w * (n + v) + j];
            const float *restrict p = c->columns + m * (2 * j), *restrict q = p + m;
#pragma omp simd
            for (int64_t e = 0; e < m; e++) {
                re[e] += p[e] * x + q[e] * y;
                im[e] += p[e] * y - q[e] * x;
            }
        }
        const int32_t *at = c->index + count * v;
        const float *a = c->turn + count * (2 * v), *b = a + count;
        for (int64_t i = 0; i < count; i++) {
            const float x = re[at[i]], y = im[at[i]];
            real[i] += a[i] * x + b[i] * y;
            imaginary[i] += a[i] * y - b[i] * x;
        }
    }
    for (int64_t i = 0; i < count; i++)
        if (c->squared)
            c->out[i] = (double)real[i] * real[i] + (double)imaginary[i] * imaginary[i];
        else {
            c->out[2 * i] = real[i];
            c->out[2 * i + 1] = imaginary[i];
        }
}

WIDE static void correlate_with(const Field *shared, const Correlation *c)
{
    /* A copy that no store can change. */
    const Field own_field = *shared;
    correlate_points(&own_field, c);
}

typedef struct {
    const Pattern *pattern;
    const double *points;     /* (K, 3) */
    const double *facing;     /* (K, 2) */
    const double *amplitudes; /* (K, 2) */
    double offset;
    int64_t count;
    float *template;   /* (2, views, width) */
    double *far;       /* (views,) */
    float *re, *im;    /* (views,) */
    int32_t *index;    /* (views,) */
} Removed;

/* The same of what points with amplitudes leave of the data. */
WIDE static void correlate_left(const Field *shared, const Removed *r, const Correlation *c)
{
    /* A copy that no store can change. */
    const Field own_field = *shared, *g = &own_field;
    const int64_t n = g->views * g->width;
    for (int64_t k = 0; k < r->count; k++) {
        const float x = (float)r->amplitudes[2 * k], y = (float)r->amplitudes[2 * k + 1];
        distances(g, r->points + 3 * k, r->offset, r->far);
        for (int64_t v = 0; v < g->views; v++)
            r->index[v] = entry(g, r->far[v]);
        phases(g, r->far, r->re, r->im);
        lit(g, r->pattern, r->points + 3 * k, r->facing + 2 * k, r->re, r->im);
        template(g, r->index, r->re, r->im, 1, 0, r->template, c->sums);
        for (int64_t j = 0; j < n; j++) {
            c->rows[j] -= x * r->template[j] - y * r->template[n + j];
            c->rows[n + j] -= x * r->template[n + j] + y * r->template[j];
        }
    }
    correlate_points(g, c);
}

typedef struct {
    const int32_t *index;  /* (views, N) */
    const float *turn;     /* (views, 2, N) */
    const float *others;   /* (views, width, 2, room), less what is constant over the views */
    const double *inverse; /* (size, 2, room) of the others' products, 0 where there are none */
    int64_t count, size, room;
    double *left; /* (N,) energy of a template beyond the others */
} Overlaps;

#define PART 8 /* others at a time */

/* sum (2, PART) += conj(re + j im) x, the imaginary parts of x `apart` behind its real ones. */
INLINE void add_conjugate(float re, float im, const float *restrict x, int64_t apart, float *restrict sum)
{
#pragma omp simd
    for (int k = 0; k < PART; k++) {
        sum[k] += re * x[k] + im * x[apart + k];
        sum[PART + k] += re * x[apart + k] - im * x[k];
    }
}

/* Energy of a template: that of all views less that of what is constant over the views of each height. The
 * point's profiles and phases in the views lie `apart`. */
INLINE double energy_of(const Field *g, const int32_t *index, const float *turn, int64_t apart,
                        const float *size, float *restrict sums)
{
    const int64_t w = g->width;
    double total = 0.0;
    memset(sums, 0, (size_t)(2 * w * g->circles) * sizeof(float));
    for (int64_t v = 0; v < g->views; v++) {
        const float a = turn[apart * 2 * v], b = turn[apart * (2 * v + 1)];
        const float *p = g->profiles + 2 * w * (int64_t)index[apart * v];
        float *restrict s = sums + 2 * w * g->circle[v];
        total += (a * a + b * b) * size[index[apart * v]];
#pragma omp simd
        for (int64_t j = 0; j < w; j++) {
            s[j] += a * p[j] - b * p[w + j];
            s[w + j] += a * p[w + j] + b * p[j];
        }
    }
    for (int64_t c = 0; c < g->circles; c++) {
        double constant, none;
        product(sums + 2 * w * c, sums + 2 * w * c, w, &constant, &none);
        total -= constant / (double)on_circle(g, c);
    }
    return total > 0.0 ? total : 0.0;
}

/* The same for one height, the sums in registers where w is a constant. */
INLINE double energy_near(const Field *g, const int64_t w, const int32_t *index, const float *turn,
                          int64_t apart, const float *size)
{
    Four re[WIDEST / LANES], im[WIDEST / LANES], square = {0.0f};
    double total = 0.0;
    for (int64_t j = 0; j < w / LANES; j++)
        re[j] = im[j] = square;
    for (int64_t v = 0; v < g->views; v++) {
        const float x = turn[apart * 2 * v], y = turn[apart * (2 * v + 1)];
        const float *p = g->profiles + 2 * w * (int64_t)index[apart * v];
        total += (x * x + y * y) * size[index[apart * v]];
        for (int64_t j = 0; j < w / LANES; j++) {
            const Four a = load(p + LANES * j), b = load(p + w + LANES * j);
            re[j] += x * a - y * b;
            im[j] += x * b + y * a;
        }
    }
    for (int64_t j = 0; j < w / LANES; j++)
        square += re[j] * re[j] + im[j] * im[j];
    total -= ((square[0] + square[1]) + (square[2] + square[3])) / (double)g->views;
    return total > 0.0 ? total : 0.0;
}

/* Scratch of `overlap_points`. */
typedef struct {
    float *size, *sums; /* (entries,) energies of the profiles; (circles, 2, width) */
    float *table;       /* (entries, 2, PART) products of the profiles in one view with some others */
    float *total;       /* (room / PART, N, 2, PART) <template, other> */
} Desk;

/* Each clone of the caller vectorises the loops over PART for its own processor; vector types of 32 bytes
 * would be split through memory where registers have 16, which takes four times as long. */
INLINE void products(const Field *g, const float *others, int64_t room, int32_t first, int32_t last,
                     float *restrict table)
{
    for (int64_t e = first; e <= last; e++) {
        const float *profile = g->profiles + 2 * g->width * e;
        float re[PART] = {0.0f}, im[PART] = {0.0f};
        for (int64_t j = 0; j < g->width; j++) {
            const float a = profile[j], b = profile[g->width + j];
            const float *x = others + 2 * room * j, *y = x + room;
#pragma omp simd
            for (int k = 0; k < PART; k++) {
                re[k] += a * x[k] + b * y[k];
                im[k] += a * y[k] - b * x[k];
            }
        }
        memcpy(table + 2 * PART * e, re, sizeof re);
        memcpy(table + 2 * PART * e + PART, im, sizeof im);
    }
}

#define SOME 4 /* products at a time, in double precision */
typedef double Two __attribute__((vector_size(16)));

/* What the others explain of a template: s^T inverse s*, of its products s with them. */
INLINE double explained_of(const Overlaps *o, const float *products, int64_t apart)
{
    const int64_t room = o->room;
    double sum = 0.0;
    for (int64_t to = 0; to < o->size; to += SOME) {
        Two re[SOME / 2], im[SOME / 2], a[SOME / 2], b[SOME / 2];
        for (int k = 0; k < SOME / 2; k++)
            re[k] = im[k] = (Two){0.0};
        for (int64_t from = 0; from < o->size; from++) {
            const float *s = products + apart * (from / PART) + from % PART;
            const double x = s[0], y = s[PART], *row = o->inverse + 2 * room * from + to;
            memcpy(a, row, sizeof a);
            memcpy(b, row + room, sizeof b);
            for (int k = 0; k < SOME / 2; k++) {
                re[k] += x * a[k] - y * b[k];
                im[k] += x * b[k] + y * a[k];
            }
        }
        const float *s = products + apart * (to / PART) + to % PART;
        for (int k = 0; k < SOME; k++)
            sum += re[k / 2][k % 2] * (double)s[k] + im[k / 2][k % 2] * (double)s[PART + k];
    }
    return sum;
}

/* The others' products with every profile, view by view, are read at the points; no template is formed. */
WIDE static void overlap_points(const Field *shared, const Overlaps *o, const Desk *d)
{
    /* A copy that no store can change. */
    const Field own_field = *shared, *g = &own_field;
    const int64_t n = g->views, w = g->width, part = 2 * PART * o->count;
    for (int64_t e = 0; e < g->entries; e++) {
        double energy, none;
        product(g->profiles + 2 * w * e, g->profiles + 2 * w * e, w, &energy, &none);
        d->size[e] = (float)energy;
    }
    for (int64_t i = 0; i < o->count; i++) {
        const int32_t *at = o->index + i;
        const float *turn = o->turn + i;
        if (w == 8 && g->circles == 1)
            o->left[i] = energy_near(g, 8, at, turn, o->count, d->size);
        else if (w == 12 && g->circles == 1)
            o->left[i] = energy_near(g, 12, at, turn, o->count, d->size);
        else if (w == 16 && g->circles == 1)
            o->left[i] = energy_near(g, 16, at, turn, o->count, d->size);
        else
            o->left[i] = energy_of(g, at, turn, o->count, d->size, d->sums);
    }
    memset(d->total, 0, (size_t)(2 * o->room * o->count) * sizeof(float));
    for (int64_t v = 0; v < n; v++) {
        const int32_t *at = o->index + o->count * v;
        const float *re = o->turn + o->count * (2 * v), *im = re + o->count;
        int32_t first = (int32_t)g->entries, last = 0;
        for (int64_t i = 0; i < o->count; i++) {
            first = at[i] < first ? at[i] : first;
            last = at[i] > last ? at[i] : last;
        }
        for (int64_t k = 0; k < o->room; k += PART) {
            float *total = d->total + part * (k / PART);
            products(g, o->others + 2 * w * o->room * v + k, o->room, first, last, d->table);
            for (int64_t i = 0; i < o->count; i++)
                add_conjugate(re[i], im[i], d->table + 2 * PART * (int64_t)at[i], PART, total + 2 * PART * i);
        }
    }
    for (int64_t i = 0; i < o->count; i++)
        o->left[i] -= explained_of(o, d->total + 2 * PART * i, part);
}

/* Points as of `look`, and data whose rows are copied to be changed. The scratch is the caller's to free. */
static float *correlation(Held *h, const Field *g, PyObject *data, PyObject *index, PyObject *turn,
                          PyObject *out, int squared, int64_t more, Correlation *c)
{
    const int64_t rows = 2 * g->views * g->width, sums = 2 * g->width * g->circles;
    const float *given = take(h, data, 4 * rows, 0);
    if (!given || !(c->index = take(h, index, -1, 0)))
        return NULL;
    c->count = taken(h) / 4 / g->views;
    if (taken(h) != 4 * c->count * g->views) {
        refused("points and views do not fit together");
        return NULL;
    }
    c->squared = squared;
    if (!below(c->index, c->count * g->views, g->entries) ||
        !(c->turn = take(h, turn, 8 * c->count * g->views, 0)) ||
        !(c->out = take(h, out, (squared ? 8 : 16) * c->count, 1)))
        return NULL;
    const int64_t columns = 2 * g->width * g->entries, table = 2 * g->entries;
    float *scratch = malloc((size_t)(rows + sums + columns + table + 2 * c->count + more) * sizeof(float));
    if (!scratch) {
        PyErr_NoMemory();
        return NULL;
    }
    c->rows = memcpy(scratch, given, (size_t)rows * sizeof(float));
    c->sums = c->rows + rows;
    c->columns = c->sums + sums;
    c->table = c->columns + columns;
    c->total = c->table + table;
    return scratch;
}

static PyObject *correlate(PyObject *self, PyObject *args)
{
    (void)self;
    PyObject *tables, *o[4];
    Held h = {.count = 0};
    Field g;
    Correlation c;
    if (!PyArg_ParseTuple(args, "OOOOO", &tables, o, o + 1, o + 2, o + 3))
        return NULL;
    float *scratch;
    if (!field_of(&h, tables, &g) || !(scratch = correlation(&h, &g, o[0], o[1], o[2], o[3], 0, 0, &c)))
        return finished(&h);
    Py_BEGIN_ALLOW_THREADS correlate_with(&g, &c);
    Py_END_ALLOW_THREADS free(scratch);
    return finished(&h);
}

static PyObject *left(PyObject *self, PyObject *args)
{
    (void)self;
    PyObject *tables, *o[7];
    Held h = {.count = 0};
    Field g;
    Pattern p;
    Correlation c;
    Removed r = {.pattern = &p};
    if (!PyArg_ParseTuple(args, "O(ddd)OOOdOOOO", &tables, &p.edge, &p.softness, &p.floor, o, o + 1, o + 2,
                          &r.offset, o + 3, o + 4, o + 5, o + 6))
        return NULL;
    float *scratch;
    if (!field_of(&h, tables, &g) || !(r.points = take(&h, o[1], -1, 0)))
        return finished(&h);
    r.count = taken(&h) / 24;
    const int64_t more = 2 * g.views * g.width + 5 * g.views + 1;
    if (!(r.facing = take(&h, o[2], 16 * r.count, 0)) || !(r.amplitudes = take(&h, o[3], 16 * r.count, 0)) ||
        !(scratch = correlation(&h, &g, o[0], o[4], o[5], o[6], 1, more, &c)))
        return finished(&h);
    double *far = malloc((size_t)g.views * sizeof(double));
    r.template = c.total + 2 * c.count;
    r.re = r.template + 2 * g.views * g.width;
    r.im = r.re + g.views;
    r.index = (int32_t *)(r.im + g.views);
    r.far = far;
    if (far) {
        Py_BEGIN_ALLOW_THREADS correlate_left(&g, &r, &c);
        Py_END_ALLOW_THREADS
    } else
        PyErr_NoMemory();
    free(far);
    free(scratch);
    return finished(&h);
}

static PyObject *beyond(PyObject *self, PyObject *args)
{
    (void)self;
    PyObject *tables, *p[5];
    Held h = {.count = 0};
    Field g;
    Overlaps o;
    if (!PyArg_ParseTuple(args, "OOOOOO", &tables, p, p + 1, p + 2, p + 3, p + 4))
        return NULL;
    if (!field_of(&h, tables, &g) || !(o.index = take(&h, p[0], -1, 0)))
        goto done;
    o.count = taken(&h) / 4 / g.views;
    if (taken(&h) != 4 * o.count * g.views) {
        refused("points and views do not fit together");
        goto done;
    }
    if (!below(o.index, o.count * g.views, g.entries) ||
        !(o.turn = take(&h, p[1], 8 * o.count * g.views, 0)) || !(o.others = take(&h, p[2], -1, 0)))
        goto done;
    o.room = taken(&h) / 8 / g.views / g.width;
    if (taken(&h) != 8 * g.views * g.width * o.room || o.room % PART) {
        refused("templates do not fit together");
        goto done;
    }
    if (!(o.inverse = take(&h, p[3], -1, 0)))
        goto done;
    o.size = o.room ? taken(&h) / 16 / o.room : 0;
    if (taken(&h) != 16 * o.room * o.size || o.size > o.room) {
        refused("templates do not fit together");
        goto done;
    }
    if (!(o.left = take(&h, p[4], 8 * o.count, 1)))
        goto done;
    const int64_t floats = g.entries * (1 + 2 * PART) + 2 * g.width * g.circles + 2 * o.room * o.count;
    float *scratch = malloc((size_t)floats * sizeof(float));
    if (!scratch) {
        PyErr_NoMemory();
        goto done;
    }
    Desk d = {.size = scratch};
    d.sums = d.size + g.entries;
    d.table = d.sums + 2 * g.width * g.circles;
    d.total = d.table + 2 * PART * g.entries;
    Py_BEGIN_ALLOW_THREADS overlap_points(&g, &o, &d);
    Py_END_ALLOW_THREADS free(scratch);
done:
    return finished(&h);
}

#endif
