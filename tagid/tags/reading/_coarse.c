/* Many points: the coarse search for layouts, and points that are asked for again and again.
 *
 * coarse:    b and the constant part of the templates of many points, for several patterns and range offsets
 * energies:  of every rotation and shift of a layout, on images of these
 * correlate: b of points with any data, from a table
 * overlaps:  their templates' inner products with a few others
 */
#include "_field.h"

typedef struct {
    const float *table;     /* (views, entries, 2) */
    const double *points;   /* (N, 3) */
    const double *facing;   /* (N, 2) */
    const double *patterns; /* (A, 3) */
    const double *offsets;  /* (O,) */
    int64_t count, kinds, shifts;
    float *fixed;  /* (A, N, 2, width) */
    float *images; /* (A, O, N, 2) */
} Coarse;

#define BLOCK 64 /* points at a time: each loop runs over points, whose number is known */

typedef struct {
    double x[BLOCK], y[BLOCK], z[BLOCK], face_x[BLOCK], face_y[BLOCK]; /* m; unit vectors */
    double far[BLOCK];                                                 /* from the antenna of a view, m */
    int32_t index[BLOCK];
    float re[BLOCK], im[BLOCK]; /* phase */
} Block;

/* Points from `first` on; the last one stands for those that are missing. */
INLINE void begin_block(const Coarse *c, int64_t first, Block *b)
{
    for (int64_t i = 0; i < BLOCK; i++) {
        const int64_t at = first + i < c->count ? first + i : c->count - 1;
        b->x[i] = c->points[3 * at];
        b->y[i] = c->points[3 * at + 1];
        b->z[i] = c->points[3 * at + 2];
        b->face_x[i] = c->facing[2 * at];
        b->face_y[i] = c->facing[2 * at + 1];
    }
}

/* Distance, profile and phase of every point in one view. */
INLINE void look_from(const Field *g, int64_t v, Block *b)
{
    for (int64_t way = 0; way < g->ways; way++) {
        const double *at = g->antennas + 3 * g->views * way + v;
        const double ax = at[0], ay = at[g->views], az = at[2 * g->views];
        for (int i = 0; i < BLOCK; i++) {
            const double x = b->x[i] - ax, y = b->y[i] - ay, z = b->z[i] - az;
            const double d = sqrt(x * x + y * y + z * z);
            b->far[i] = way ? 0.5 * (b->far[i] + d) : d;
        }
    }
    const double per_metre = -g->wavenumber / 3.141592653589793;
    for (int i = 0; i < BLOCK; i++)
        b->index[i] = entry(g, b->far[i]);
    for (int i = 0; i < BLOCK; i++)
        turned(b->far[i] * per_metre, b->re + i, b->im + i);
}

/* The phases (2, BLOCK) with a pattern's amplitude. */
INLINE void light(const Field *g, const double *pattern, int64_t v, const Block *b, float *restrict out)
{
    const double edge = pattern[0], slope = 1.0 / (2.0 * pattern[1]), floor = pattern[2];
    const double mx = g->middle[v], my = g->middle[g->views + v];
    for (int i = 0; i < BLOCK; i++) {
        const double x = mx - b->x[i], y = my - b->y[i];
        const double cosine = (b->face_x[i] * x + b->face_y[i] * y) / sqrt(x * x + y * y);
        double ramp = (cosine - edge) * slope + 0.5;
        ramp = ramp > 0.0 ? ramp : 0.0;
        ramp = ramp < 1.0 ? ramp : 1.0;
        const double sided = fabs(b->face_x[i]) + fabs(b->face_y[i]);
        const float w = sided > 0.0 && floor < 1.0 ? (float)(floor + (1.0 - floor) * ramp) : 1.0f;
        out[i] = b->re[i] * w;
        out[BLOCK + i] = b->im[i] * w;
    }
}

/* out += (x + j y) profile, both (2, width). */
INLINE void add_turned(const float *restrict profile, float x, float y, int64_t w, float *restrict out)
{
#pragma omp simd
    for (int64_t j = 0; j < w; j++) {
        out[j] += x * profile[j] - y * profile[w + j];
        out[w + j] += x * profile[w + j] + y * profile[j];
    }
}

/* A row of the table (entries, 2) at the points' distances and an offset: (2, BLOCK). */
INLINE void read_row(const Field *g, const float *row, const Block *b, double offset, float *restrict out)
{
    int32_t at[BLOCK];
    for (int i = 0; i < BLOCK; i++)
        at[i] = entry(g, b->far[i] + offset);
    for (int i = 0; i < BLOCK; i++) {
        out[i] = row[2 * at[i]];
        out[BLOCK + i] = row[2 * at[i] + 1];
    }
}

/* sum += conj(own) seen, all (2, BLOCK). */
INLINE void add_products(const float *restrict own, const float *restrict seen, float *restrict sum)
{
    for (int i = 0; i < BLOCK; i++) {
        sum[i] += own[i] * seen[i] + own[BLOCK + i] * seen[BLOCK + i];
        sum[BLOCK + i] += own[i] * seen[BLOCK + i] - own[BLOCK + i] * seen[i];
    }
}

WIDE static void coarse_points(const Field *shared, const Coarse *c, float *sums)
{
    /* A copy that no store can change. */
    const Field own_field = *shared, *g = &own_field;
    const int64_t w = g->width;
    float *lit_up = sums + 2 * BLOCK * c->kinds * c->shifts, seen[2 * BLOCK];
    Block b;
    for (int64_t first = 0; first < c->count; first += BLOCK) {
        const int64_t count = c->count - first < BLOCK ? c->count - first : BLOCK;
        begin_block(c, first, &b);
        memset(sums, 0, (size_t)(2 * BLOCK * c->kinds * c->shifts) * sizeof(float));
        for (int64_t a = 0; a < c->kinds; a++)
            memset(c->fixed + 2 * w * (c->count * a + first), 0, (size_t)(2 * w * count) * sizeof(float));
        for (int64_t v = 0; v < g->views; v++) {
            look_from(g, v, &b);
            for (int64_t a = 0; a < c->kinds; a++) {
                float *own = lit_up + 2 * BLOCK * a, *fixed = c->fixed + 2 * w * (c->count * a + first);
                light(g, c->patterns + 3 * a, v, &b, own);
                for (int64_t i = 0; i < count; i++)
                    add_turned(g->profiles + 2 * w * (int64_t)b.index[i], own[i], own[BLOCK + i], w,
                               fixed + 2 * w * i);
            }
            for (int64_t o = 0; o < c->shifts; o++) {
                read_row(g, c->table + 2 * g->entries * v, &b, c->offsets[o], seen);
                for (int64_t a = 0; a < c->kinds; a++)
                    add_products(lit_up + 2 * BLOCK * a, seen, sums + 2 * BLOCK * (c->shifts * a + o));
            }
        }
        const float share = 1.0f / (float)g->views;
        for (int64_t a = 0; a < c->kinds; a++) {
            float *fixed = c->fixed + 2 * w * (c->count * a + first);
            for (int64_t j = 0; j < 2 * w * count; j++)
                fixed[j] *= share;
            for (int64_t o = 0; o < c->shifts; o++) {
                const float *re = sums + 2 * BLOCK * (c->shifts * a + o), *im = re + BLOCK;
                float *out = c->images + 2 * (c->count * (c->shifts * a + o) + first), tr, ti;
                turned(g->wavenumber * c->offsets[o] / 3.141592653589793, &tr, &ti);
                for (int64_t i = 0; i < count; i++) {
                    out[2 * i] = re[i] * tr - im[i] * ti;
                    out[2 * i + 1] = re[i] * ti + im[i] * tr;
                }
            }
        }
    }
}

typedef struct {
    const float *images;  /* (side, side, 2, room) */
    const float *fixed;   /* (side, side, 2, width) */
    const double *placed; /* (A, K, 2) m */
    const double *shifts; /* (S, 2) m */
    const double *gram;   /* (A, K, K, 2) */
    int64_t offsets, half, width, rotations, size, places;
    double step, template_energy, balance, visible, views;
    float *out; /* (O, A, S) */
} Grid;

#define ROOM 8 /* range offsets at a time: each loop runs over them */

/* G^-1 applied to values (k, ROOM) of every offset, by the factor. */
INLINE void substitute_each(const int64_t k, const double (*g)[2], double (*re)[ROOM], double (*im)[ROOM])
{
    for (int64_t i = 0; i < k; i++) {
        for (int64_t s = 0; s < i; s++) {
            const double a = g[i * k + s][0], b = g[i * k + s][1];
            for (int o = 0; o < ROOM; o++) {
                re[i][o] -= a * re[s][o] - b * im[s][o];
                im[i][o] -= a * im[s][o] + b * re[s][o];
            }
        }
        const double part = 1.0 / g[i * k + i][0];
        for (int o = 0; o < ROOM; o++) {
            re[i][o] *= part;
            im[i][o] *= part;
        }
    }
    for (int64_t i = k - 1; i >= 0; i--) {
        for (int64_t s = i + 1; s < k; s++) {
            const double a = g[s * k + i][0], b = g[s * k + i][1];
            for (int o = 0; o < ROOM; o++) {
                re[i][o] -= a * re[s][o] + b * im[s][o];
                im[i][o] -= a * im[s][o] - b * re[s][o];
            }
        }
        const double part = 1.0 / g[i * k + i][0];
        for (int o = 0; o < ROOM; o++) {
            re[i][o] *= part;
            im[i][o] *= part;
        }
    }
}

/* One rotation and shift of k reflectors at every offset: energies (ROOM,). */
INLINE void energies_at(const Grid *g, const int64_t k, int64_t a, int64_t s, int64_t room, int64_t from,
                        float *restrict out)
{
    const int64_t side = 2 * g->half + 1, w = g->width;
    double factor[MOST * MOST][2], re[MOST][ROOM], im[MOST][ROOM], sum[ROOM] = {0.0};
    const float *rows[MOST], *corner[MOST];
    float trust[MOST], fx[MOST], fy[MOST], seen[MOST][ROOM], b[MOST][2][ROOM], all = 0.0f;
    for (int64_t i = 0; i < k; i++) {
        const double *place = g->placed + 2 * (k * a + i), half = (double)g->half;
        const double atx = (place[0] + g->shifts[2 * s]) / g->step, px = atx + half;
        const double aty = (place[1] + g->shifts[2 * s + 1]) / g->step, py = aty + half;
        const double last = (double)(side - 1), before = (double)(side - 2);
        const double nx = rint(atx) + half, ny = rint(aty) + half;
        const int64_t ix = (int64_t)(nx > 0 ? (nx < last ? nx : last) : 0);
        const int64_t iy = (int64_t)(ny > 0 ? (ny < last ? ny : last) : 0);
        rows[i] = g->fixed + 2 * w * (side * iy + ix);
        const int64_t lx = (int64_t)(px > 0 ? (px < before ? px : before) : 0);
        const int64_t ly = (int64_t)(py > 0 ? (py < before ? py : before) : 0);
        corner[i] = g->images + 2 * room * (side * ly + lx) + from;
        fx[i] = (float)(px - (double)lx);
        fy[i] = (float)(py - (double)ly);
    }
    for (int64_t i = 0; i < k; i++)
        for (int64_t j = 0; j <= i; j++) {
            double product[2];
            const double *full = g->gram + 2 * (k * (k * a + i) + j);
            inner(rows[i], rows[j], w, product, product + 1);
            factor[i * k + j][0] = full[0] - g->views * product[0];
            factor[i * k + j][1] = full[1] - g->views * product[1];
            if (i == j) {
                const float share = (float)(factor[i * k + i][0] / g->template_energy / g->visible);
                trust[i] = share < 1.0f ? share : 1.0f;
                all += trust[i];
                factor[i * k + i][0] += 1e-2 * g->template_energy;
            }
        }
    factorise((int)k, factor);
    for (int64_t i = 0; i < k; i++)
        for (int part = 0; part < 2; part++) {
            const float *p = corner[i] + part * room, *up = p + 2 * room * side;
            for (int o = 0; o < ROOM; o++) {
                const float low = p[o] * (1.0f - fx[i]) + p[2 * room + o] * fx[i];
                const float high = up[o] * (1.0f - fx[i]) + up[2 * room + o] * fx[i];
                b[i][part][o] = low * (1.0f - fy[i]) + high * fy[i];
            }
        }
    for (int64_t i = 0; i < k; i++)
        for (int o = 0; o < ROOM; o++) {
            re[i][o] = b[i][0][o];
            im[i][o] = b[i][1][o];
        }
    substitute_each(k, (const double (*)[2])factor, re, im);
    float typical[ROOM] = {0.0f}, least[ROOM], most[ROOM];
    const float share = 1.0f / (all > 1e-9f ? all : 1e-9f);
    for (int64_t i = 0; i < k; i++)
        for (int o = 0; o < ROOM; o++) {
            sum[o] += b[i][0][o] * re[i][o] + b[i][1][o] * im[i][o];
            seen[i][o] = (float)sqrt(re[i][o] * re[i][o] + im[i][o] * im[i][o]);
            typical[o] += trust[i] * seen[i][o];
        }
    for (int o = 0; o < ROOM; o++) {
        typical[o] *= share;
        least[o] = INFINITY;
        most[o] = 0.0f;
    }
    for (int64_t i = 0; i < k; i++)
        for (int o = 0; o < ROOM; o++) {
            const float own = trust[i] * seen[i][o] + (1.0f - trust[i]) * typical[o];
            least[o] = own < least[o] ? own : least[o];
            most[o] = own > most[o] ? own : most[o];
        }
    for (int o = 0; o < ROOM; o++) {
        const double alike = least[o] / (most[o] > 1e-30f ? most[o] : 1e-30f) / g->balance;
        out[o] = (float)((sum[o] > 0.0 ? sum[o] : 0.0) * (alike < 1.0 ? alike : 1.0));
    }
}

WIDE static void grid_energies(const Grid *given)
{
    /* A copy that no store can change. */
    const Grid own_grid = *given, *g = &own_grid;
    const int64_t room = (g->offsets + ROOM - 1) / ROOM * ROOM;
    float found[ROOM];
    for (int64_t a = 0; a < g->rotations; a++)
        for (int64_t s = 0; s < g->places; s++)
            for (int64_t from = 0; from < room; from += ROOM) {
                /* The usual numbers of reflectors as constants. */
                if (g->size == 2)
                    energies_at(g, 2, a, s, room, from, found);
                else if (g->size == 3)
                    energies_at(g, 3, a, s, room, from, found);
                else
                    energies_at(g, g->size, a, s, room, from, found);
                for (int64_t o = from; o < g->offsets && o < from + ROOM; o++)
                    g->out[g->places * (g->rotations * o + a) + s] = found[o - from];
            }
}

/* (N, 2) sum over the views of conj(turn) table[v][index]. */
WIDE static void read_table(const float *table, int64_t entries, const int32_t *index, const float *turn,
                            int64_t count, int64_t views, double *out)
{
    for (int64_t i = 0; i < count; i++) {
        float re = 0.0f, im = 0.0f;
        for (int64_t v = 0; v < views; v++) {
            const float *t = table + 2 * (entries * v + index[views * i + v]),
                        *a = turn + 2 * (views * i + v);
            re += a[0] * t[0] + a[1] * t[1];
            im += a[0] * t[1] - a[1] * t[0];
        }
        out[2 * i] = re;
        out[2 * i + 1] = im;
    }
}

typedef struct {
    const int32_t *index; /* (N, views) */
    const float *turn;    /* (N, views, 2) */
    const float *others;  /* (views, width, 2, room), less what is constant over the views */
    int64_t count, size, room;
    double *shared; /* (N, size, 2) <template, other> */
    double *own;    /* (N,) energy of a template */
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

/* Energy of a template: that of all views less that of what is constant over the views of each height. */
INLINE double energy_of(const Field *g, const int32_t *index, const float *turn, const float *size,
                        float *restrict sums)
{
    const int64_t w = g->width;
    double total = 0.0;
    memset(sums, 0, (size_t)(2 * w * g->circles) * sizeof(float));
    for (int64_t v = 0; v < g->views; v++) {
        const float a = turn[2 * v], b = turn[2 * v + 1], *p = g->profiles + 2 * w * (int64_t)index[v];
        float *restrict s = sums + 2 * w * g->circle[v];
        total += (a * a + b * b) * size[index[v]];
#pragma omp simd
        for (int64_t j = 0; j < w; j++) {
            s[j] += a * p[j] - b * p[w + j];
            s[w + j] += a * p[w + j] + b * p[j];
        }
    }
    for (int64_t c = 0; c < g->circles; c++) {
        double constant, none;
        int64_t count = 0;
        for (int64_t v = 0; v < g->views; v++)
            count += g->circle[v] == c;
        inner(sums + 2 * w * c, sums + 2 * w * c, w, &constant, &none);
        total -= constant / (double)(count ? count : 1);
    }
    return total > 0.0 ? total : 0.0;
}

/* Scratch of `overlap_points`. */
typedef struct {
    float *size, *sums; /* (entries,) energies of the profiles; (circles, 2, width) */
    float *table;       /* (entries, 2, PART) products of the profiles in one view with a part of the others */
    float *total;       /* (N, 2, PART) */
    float *re, *im;     /* (views, N): what is read together lies together */
    int32_t *at;        /* (views, N) */
} Desk;

INLINE void products(const Field *g, const float *others, int64_t room, int32_t first, int32_t last,
                     float *table)
{
    for (int64_t e = first; e <= last; e++) {
        const float *profile = g->profiles + 2 * g->width * e;
        float sum[2 * PART] = {0.0f};
        for (int64_t j = 0; j < g->width; j++)
            add_conjugate(profile[j], profile[g->width + j], others + 2 * room * j, room, sum);
        memcpy(table + 2 * PART * e, sum, sizeof sum);
    }
}

/* The others' products with every profile, a view at a time, are read at the points: a template is not formed. */
WIDE static void overlap_points(const Field *shared, const Overlaps *o, const Desk *d)
{
    /* A copy that no store can change. */
    const Field own_field = *shared, *g = &own_field;
    const int64_t n = g->views, w = g->width;
    for (int64_t e = 0; e < g->entries; e++) {
        double energy, none;
        inner(g->profiles + 2 * w * e, g->profiles + 2 * w * e, w, &energy, &none);
        d->size[e] = (float)energy;
    }
    for (int64_t i = 0; i < o->count; i++) {
        o->own[i] = energy_of(g, o->index + n * i, o->turn + 2 * n * i, d->size, d->sums);
        for (int64_t v = 0; v < n; v++) {
            d->at[o->count * v + i] = o->index[n * i + v];
            d->re[o->count * v + i] = o->turn[2 * (n * i + v)];
            d->im[o->count * v + i] = o->turn[2 * (n * i + v) + 1];
        }
    }
    for (int64_t k = 0; k < o->room; k += PART) {
        memset(d->total, 0, (size_t)(2 * PART * o->count) * sizeof(float));
        for (int64_t v = 0; v < n; v++) {
            const int32_t *at = d->at + o->count * v;
            const float *re = d->re + o->count * v, *im = d->im + o->count * v;
            int32_t first = (int32_t)g->entries, last = 0;
            for (int64_t i = 0; i < o->count; i++) {
                first = at[i] < first ? at[i] : first;
                last = at[i] > last ? at[i] : last;
            }
            products(g, o->others + 2 * w * o->room * v + k, o->room, first, last, d->table);
            for (int64_t i = 0; i < o->count; i++)
                add_conjugate(re[i], im[i], d->table + 2 * PART * (int64_t)at[i], PART,
                              d->total + 2 * PART * i);
        }
        const int64_t last = o->size - k < PART ? o->size - k : PART;
        for (int64_t i = 0; i < o->count; i++)
            for (int64_t p = 0; p < last; p++) {
                o->shared[2 * (o->size * i + k + p)] = d->total[2 * PART * i + p];
                o->shared[2 * (o->size * i + k + p) + 1] = d->total[2 * PART * i + PART + p];
            }
    }
}

static PyObject *coarse(PyObject *self, PyObject *args)
{
    (void)self;
    PyObject *tables, *o[7];
    Held h = {.count = 0};
    Field g;
    Coarse c;
    if (!PyArg_ParseTuple(args, "OOOOOOOO", &tables, o, o + 1, o + 2, o + 3, o + 4, o + 5, o + 6))
        return NULL;
    if (!field_of(&h, tables, &g) || !(c.table = take(&h, o[0], 8 * g.views * g.entries, 0)) ||
        !(c.points = take(&h, o[1], -1, 0)))
        goto done;
    c.count = taken(&h) / 24;
    if (!(c.facing = take(&h, o[2], 16 * c.count, 0)) || !(c.patterns = take(&h, o[3], -1, 0)))
        goto done;
    c.kinds = taken(&h) / 24;
    if (!(c.offsets = take(&h, o[4], -1, 0)))
        goto done;
    c.shifts = taken(&h) / 8;
    if (!(c.fixed = take(&h, o[5], 8 * c.kinds * c.count * g.width, 1)) ||
        !(c.images = take(&h, o[6], 8 * c.kinds * c.shifts * c.count, 1)))
        goto done;
    float *sums = malloc((size_t)(2 * BLOCK * c.kinds * (c.shifts + 1)) * sizeof(float));
    if (!sums) {
        PyErr_NoMemory();
        goto done;
    }
    Py_BEGIN_ALLOW_THREADS coarse_points(&g, &c, sums);
    Py_END_ALLOW_THREADS free(sums);
done:
    return finished(&h);
}

static PyObject *energies(PyObject *self, PyObject *args)
{
    (void)self;
    PyObject *o[6];
    Py_ssize_t half, size, offsets;
    Held h = {.count = 0};
    Grid g;
    if (!PyArg_ParseTuple(args, "OOOOOnnndddddO", o, o + 1, o + 2, o + 3, o + 4, &offsets, &half, &size,
                          &g.step, &g.template_energy, &g.balance, &g.visible, &g.views, o + 5))
        return NULL;
    g.offsets = offsets;
    g.half = half;
    g.size = size;
    if (half < 1 || half > (1 << 14) || size < 1 || size > MOST || offsets < 1 || offsets > (1 << 10)) {
        refused("the image or the layout is too large");
        goto done;
    }
    const int64_t pixels = (2 * g.half + 1) * (2 * g.half + 1);
    if (!(g.images = take(&h, o[0], 8 * pixels * ((g.offsets + ROOM - 1) / ROOM * ROOM), 0)) ||
        !(g.fixed = take(&h, o[1], -1, 0)))
        goto done;
    g.width = taken(&h) / 8 / pixels;
    if (taken(&h) != 8 * pixels * g.width || !(g.placed = take(&h, o[2], -1, 0))) {
        refused("images do not fit together");
        goto done;
    }
    g.rotations = taken(&h) / 16 / size;
    if (taken(&h) != 16 * size * g.rotations || !(g.shifts = take(&h, o[3], -1, 0))) {
        refused("places do not fit together");
        goto done;
    }
    g.places = taken(&h) / 16;
    if (!(g.gram = take(&h, o[4], 16 * g.rotations * size * size, 0)) ||
        !(g.out = take(&h, o[5], 4 * g.offsets * g.rotations * g.places, 1)))
        goto done;
    Py_BEGIN_ALLOW_THREADS grid_energies(&g);
    Py_END_ALLOW_THREADS done : return finished(&h);
}

static PyObject *correlate(PyObject *self, PyObject *args)
{
    (void)self;
    PyObject *o[4];
    Py_ssize_t views;
    Held h = {.count = 0};
    const float *table, *turn;
    const int32_t *index;
    double *out;
    if (!PyArg_ParseTuple(args, "OOOnO", o, o + 1, o + 2, &views, o + 3))
        return NULL;
    if (!(index = take(&h, o[1], -1, 0)))
        goto done;
    const int64_t pairs = h.held[0].len / 4, count = views > 0 ? pairs / views : 0;
    if (views < 1 || count * views * 4 != h.held[0].len) {
        refused("points and views do not fit together");
        goto done;
    }
    if (!(turn = take(&h, o[2], 8 * pairs, 0)) || !(out = take(&h, o[3], 16 * count, 1)) ||
        !(table = take(&h, o[0], -1, 0)))
        goto done;
    const int64_t entries = taken(&h) / 8 / views;
    if (!below(index, pairs, entries))
        goto done;
    Py_BEGIN_ALLOW_THREADS read_table(table, entries, index, turn, count, views, out);
    Py_END_ALLOW_THREADS done : return finished(&h);
}

static PyObject *overlaps(PyObject *self, PyObject *args)
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
    if (taken(&h) != 8 * g.views * g.width * o.room || o.room % PART || !(o.own = take(&h, p[4], 8 * o.count, 1)) ||
        !(o.shared = take(&h, p[3], -1, 1))) {
        if (!PyErr_Occurred())
            refused("templates do not fit together");
        goto done;
    }
    o.size = o.count ? taken(&h) / 16 / o.count : 0;
    if (taken(&h) != 16 * o.count * o.size || o.size > o.room) {
        refused("templates do not fit together");
        goto done;
    }
    const int64_t pairs = o.count * g.views;
    const int64_t floats =
        g.entries * (1 + 2 * PART) + 2 * g.width * g.circles + 2 * PART * o.count + 2 * pairs;
    float *scratch = malloc((size_t)floats * sizeof(float) + (size_t)pairs * sizeof(int32_t));
    if (!scratch) {
        PyErr_NoMemory();
        goto done;
    }
    Desk d = {.size = scratch};
    d.sums = d.size + g.entries;
    d.table = d.sums + 2 * g.width * g.circles;
    d.total = d.table + 2 * PART * g.entries;
    d.re = d.total + 2 * PART * o.count;
    d.im = d.re + pairs;
    d.at = (int32_t *)(d.im + pairs);
    Py_BEGIN_ALLOW_THREADS overlap_points(&g, &o, &d);
    Py_END_ALLOW_THREADS free(scratch);
done:
    return finished(&h);
}

static PyMethodDef methods[] = {
    {"coarse", coarse, METH_VARARGS,
     "coarse(tables, table, points, facing, patterns, offsets, fixed, images)"},
    {"energies", energies, METH_VARARGS,
     "energies(images, fixed, placed, shifts, gram, offsets, half, size, step, template_energy, balance, "
     "visible, views, out)"},
    {"correlate", correlate, METH_VARARGS, "correlate(table, index, turn, views, out)"},
    {"overlaps", overlaps, METH_VARARGS, "overlaps(tables, index, turn, others, shared, own)"},
    {NULL, NULL, 0, NULL},
};

MODULE(_coarse, "Compiled loops over many points (see tagid.tags.reading.compiled).", methods, 2)
