/* The coarse search: images of b for several patterns and range offsets, and what every place of a layout
 * explains.
 *
 * coarse:   b and the constant part of the templates of many points
 * energies: of every rotation and shift of a layout, on these images
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
    const float *images;  /* (O, side, side, 2) */
    const float *fixed;   /* (side, side, width, 2) */
    const double *placed; /* (A, K, 2) m */
    const double *shifts; /* (S, 2) m */
    const double *gram;   /* (A, K, K, 2) */
    int64_t offsets, half, width, rotations, size, places;
    double step, template_energy, balance, visible, views;
    float *out; /* (O, A, S) */
} Grid;

WIDE static void grid_energies(const Grid *given)
{
    /* A copy that no store can change. */
    const Grid own_grid = *given, *g = &own_grid;
    const int64_t side = 2 * g->half + 1, k = g->size, w = g->width;
    for (int64_t a = 0; a < g->rotations; a++)
        for (int64_t s = 0; s < g->places; s++) {
            double factor[MOST * MOST][2], x[MOST][2];
            const float *rows[MOST];
            float trust[MOST], fx[MOST], fy[MOST], seen[MOST], all = 0.0f;
            int64_t base[MOST];
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
                base[i] = side * ly + lx;
                fx[i] = (float)(px - (double)lx);
                fy[i] = (float)(py - (double)ly);
            }
            for (int64_t i = 0; i < k; i++)
                for (int64_t j = 0; j <= i; j++) {
                    const float *restrict one = rows[i], *restrict other = rows[j];
                    float re = 0.0f, im = 0.0f;
#pragma omp simd reduction(+ : re, im)
                    for (int64_t q = 0; q < w; q++) {
                        re += one[2 * q] * other[2 * q] + one[2 * q + 1] * other[2 * q + 1];
                        im += one[2 * q] * other[2 * q + 1] - one[2 * q + 1] * other[2 * q];
                    }
                    const double *full = g->gram + 2 * (k * (k * a + i) + j);
                    factor[i * k + j][0] = full[0] - g->views * re;
                    factor[i * k + j][1] = full[1] - g->views * im;
                    if (i == j) {
                        const float share = (float)(factor[i * k + i][0] / g->template_energy / g->visible);
                        trust[i] = share < 1.0f ? share : 1.0f;
                        all += trust[i];
                        factor[i * k + i][0] += 1e-2 * g->template_energy;
                    }
                }
            factorise((int)k, factor);
            for (int64_t o = 0; o < g->offsets; o++) {
                const float *image = g->images + 2 * side * side * o;
                double b[MOST][2], sum = 0.0;
                for (int64_t i = 0; i < k; i++)
                    for (int part = 0; part < 2; part++) {
                        const float *p = image + 2 * base[i] + part, *up = p + 2 * side;
                        const float low = p[0] * (1.0f - fx[i]) + p[2] * fx[i];
                        const float high = up[0] * (1.0f - fx[i]) + up[2] * fx[i];
                        b[i][part] = x[i][part] = low * (1.0f - fy[i]) + high * fy[i];
                    }
                substitute((int)k, factor, x);
                for (int64_t i = 0; i < k; i++) {
                    sum += b[i][0] * x[i][0] + b[i][1] * x[i][1];
                    seen[i] = (float)sqrt(x[i][0] * x[i][0] + x[i][1] * x[i][1]);
                }
                float typical = 0.0f, least = INFINITY, most = 0.0f;
                for (int64_t i = 0; i < k; i++)
                    typical += trust[i] * seen[i];
                typical /= all > 1e-9f ? all : 1e-9f;
                for (int64_t i = 0; i < k; i++) {
                    const float own = trust[i] * seen[i] + (1.0f - trust[i]) * typical;
                    least = own < least ? own : least;
                    most = own > most ? own : most;
                }
                const double alike = least / (most > 1e-30f ? most : 1e-30f) / g->balance;
                g->out[g->places * (g->rotations * o + a) + s] =
                    (float)((sum > 0.0 ? sum : 0.0) * (alike < 1.0 ? alike : 1.0));
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
    Py_ssize_t half, size;
    Held h = {.count = 0};
    Grid g;
    if (!PyArg_ParseTuple(args, "OOOOOnndddddO", o, o + 1, o + 2, o + 3, o + 4, &half, &size, &g.step,
                          &g.template_energy, &g.balance, &g.visible, &g.views, o + 5))
        return NULL;
    g.half = half;
    g.size = size;
    if (half < 1 || half > (1 << 14) || size < 1 || size > MOST) {
        refused("the image or the layout is too large");
        goto done;
    }
    const int64_t pixels = (2 * g.half + 1) * (2 * g.half + 1);
    if (!(g.images = take(&h, o[0], -1, 0)))
        goto done;
    g.offsets = taken(&h) / 8 / pixels;
    if (taken(&h) != 8 * pixels * g.offsets || !(g.fixed = take(&h, o[1], -1, 0))) {
        refused("images do not fit together");
        goto done;
    }
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

static PyMethodDef methods[] = {
    {"coarse", coarse, METH_VARARGS,
     "coarse(tables, table, points, facing, patterns, offsets, fixed, images)"},
    {"energies", energies, METH_VARARGS,
     "energies(images, fixed, placed, shifts, gram, half, size, step, template_energy, balance, visible, "
     "views, out)"},
    {NULL, NULL, 0, NULL},
};

MODULE(_coarse, "Compiled loops of the coarse search (see tagid.tags.reading.compiled).", methods, 1)
