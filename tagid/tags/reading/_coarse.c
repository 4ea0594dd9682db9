/* Many points: the coarse search for layouts, and points that are asked for again and again.
 *
 * coarse:    b and the constant part of the templates of many points, for several patterns and range offsets
 * energies:  of every rotation and shift of a layout, on images of these
 * correlate: b of points with any data, from a table
 * left:      |b|^2 of points with what others leave of the data
 * beyond:    energies of their templates beyond a few others
 */
#include "_many.h"

typedef struct {
    const float *table;     /* (views, entries, 2) */
    const double *points;   /* (N, 3) */
    const double *facing;   /* (N, 2) */
    const double *patterns; /* (A, 3) */
    const double *offsets;  /* (O,) */
    const int32_t *pixel;   /* (N,) of the images, where a point lies */
    int64_t count, kinds, shifts, pixels, room;
    float *fixed;  /* (A, pixels, 2, width) */
    float *images; /* (A, pixels, 2, room) */
} Coarse;

#define VIEWS 16 /* at a time: their phases stay near */

/* out (2, w) += sum over the views of (x + j y) profile; the sums stay in registers where w is a constant. */
INLINE void add_turned(const Field *g, const int64_t w, int64_t views, const int32_t *index,
                       const float *lit_up, int64_t stride, float *restrict out)
{
    Four re[WIDEST / LANES], im[WIDEST / LANES];
    for (int64_t j = 0; j < w / LANES; j++) {
        re[j] = load(out + LANES * j);
        im[j] = load(out + w + LANES * j);
    }
    for (int64_t v = 0; v < views; v++) {
        const float x = lit_up[stride * v], y = lit_up[stride * v + BLOCK];
        const float *p = g->profiles + 2 * w * (int64_t)index[BLOCK * v];
        for (int64_t j = 0; j < w / LANES; j++) {
            const Four a = load(p + LANES * j), b = load(p + w + LANES * j);
            re[j] += x * a - y * b;
            im[j] += x * b + y * a;
        }
    }
    for (int64_t j = 0; j < w / LANES; j++) {
        store(out + LANES * j, re[j]);
        store(out + w + LANES * j, im[j]);
    }
}

/* The same for any w, a view at a time. */
INLINE void add_turned_wide(const Field *g, int64_t views, const int32_t *index, const float *lit_up,
                            int64_t stride, float *restrict out)
{
    const int64_t w = g->width;
    for (int64_t v = 0; v < views; v++) {
        const float x = lit_up[stride * v], y = lit_up[stride * v + BLOCK];
        const float *p = g->profiles + 2 * w * (int64_t)index[BLOCK * v];
#pragma omp simd
        for (int64_t j = 0; j < w; j++) {
            out[j] += x * p[j] - y * p[w + j];
            out[w + j] += x * p[w + j] + y * p[j];
        }
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

/* `sums` has room for (A, O, 2, BLOCK), then (A, VIEWS, 2, BLOCK). */
WIDE static void coarse_points(const Field *shared, const Coarse *c, float *sums)
{
    /* A copy that no store can change. */
    const Field own_field = *shared, *g = &own_field;
    const int64_t w = g->width, lit_size = 2 * BLOCK * VIEWS;
    float *lit_up = sums + 2 * BLOCK * c->kinds * c->shifts, seen[2 * BLOCK];
    int32_t index[VIEWS * BLOCK];
    Block b;
    for (int64_t first = 0; first < c->count; first += BLOCK) {
        const int64_t count = c->count - first < BLOCK ? c->count - first : BLOCK;
        const int32_t *pixel = c->pixel + first;
        begin_block(c->points, c->facing, c->count, first, &b);
        memset(sums, 0, (size_t)(2 * BLOCK * c->kinds * c->shifts) * sizeof(float));
        for (int64_t from = 0; from < g->views; from += VIEWS) {
            const int64_t views = g->views - from < VIEWS ? g->views - from : VIEWS;
            for (int64_t v = 0; v < views; v++) {
                look_from(g, from + v, 0.0, &b);
                memcpy(index + BLOCK * v, b.index, sizeof b.index);
                for (int64_t a = 0; a < c->kinds; a++)
                    light(g, c->patterns + 3 * a, from + v, &b, lit_up + lit_size * a + 2 * BLOCK * v);
                for (int64_t o = 0; o < c->shifts; o++) {
                    read_row(g, c->table + 2 * g->entries * (from + v), &b, c->offsets[o], seen);
                    for (int64_t a = 0; a < c->kinds; a++)
                        add_products(lit_up + lit_size * a + 2 * BLOCK * v, seen,
                                     sums + 2 * BLOCK * (c->shifts * a + o));
                }
            }
            for (int64_t a = 0; a < c->kinds; a++)
                for (int64_t i = 0; i < count; i++) {
                    float *fixed = c->fixed + 2 * w * (c->pixels * a + pixel[i]);
                    const float *own = lit_up + lit_size * a + i;
                    if (w == 8)
                        add_turned(g, 8, views, index + i, own, 2 * BLOCK, fixed);
                    else if (w == 12)
                        add_turned(g, 12, views, index + i, own, 2 * BLOCK, fixed);
                    else if (w == 16)
                        add_turned(g, 16, views, index + i, own, 2 * BLOCK, fixed);
                    else
                        add_turned_wide(g, views, index + i, own, 2 * BLOCK, fixed);
                }
        }
        const float share = 1.0f / (float)g->views;
        for (int64_t a = 0; a < c->kinds; a++) {
            for (int64_t i = 0; i < count; i++) {
                float *fixed = c->fixed + 2 * w * (c->pixels * a + pixel[i]);
                for (int64_t j = 0; j < 2 * w; j++)
                    fixed[j] *= share;
            }
            for (int64_t o = 0; o < c->shifts; o++) {
                const float *re = sums + 2 * BLOCK * (c->shifts * a + o), *im = re + BLOCK;
                float *out = c->images + 2 * c->room * c->pixels * a + o, tr, ti;
                turned(g->wavenumber * c->offsets[o] / 3.141592653589793, &tr, &ti);
                for (int64_t i = 0; i < count; i++) {
                    out[2 * c->room * pixel[i]] = re[i] * tr - im[i] * ti;
                    out[2 * c->room * pixel[i] + c->room] = re[i] * ti + im[i] * tr;
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
    float *own;  /* (side, side) energies of `fixed` */
    float *out;  /* (O, A, S) */
    float *best; /* (O, A) the largest of all S */
} Grid;

#define ROOM 8 /* range offsets at a time: each loop runs over them */

typedef float Offsets __attribute__((vector_size(4 * ROOM)));

/* G = L D L^H of a Hermitian positive matrix (k, k): L below the diagonal, and 1 / D. */
INLINE void split(const int64_t k, double (*g)[2], double *inverse)
{
    double part[MOST][2]; /* of a row, L times D */
    for (int64_t i = 0; i < k; i++) {
        double d = g[i * k + i][0];
        for (int64_t j = 0; j < i; j++) {
            double re = g[i * k + j][0], im = g[i * k + j][1];
            for (int64_t s = 0; s < j; s++) {
                const double *b = g[j * k + s];
                re -= part[s][0] * b[0] + part[s][1] * b[1];
                im -= part[s][1] * b[0] - part[s][0] * b[1];
            }
            part[j][0] = re;
            part[j][1] = im;
            g[i * k + j][0] = re * inverse[j];
            g[i * k + j][1] = im * inverse[j];
            d -= re * g[i * k + j][0] + im * g[i * k + j][1];
        }
        inverse[i] = 1.0 / (d > 1e-300 ? d : 1e-300);
    }
}

/* One rotation and shift of k reflectors at every offset: energies (ROOM,), in single precision, as the
 * images are. */
INLINE void energies_at(const Grid *g, const int64_t k, int64_t a, int64_t s, int64_t room, int64_t from,
                        float *restrict out)
{
    const int64_t side = 2 * g->half + 1, w = g->width;
    double factor[MOST * MOST][2], inverse[MOST];
    int64_t row[MOST];
    Offsets re[MOST], im[MOST], b_re[MOST], b_im[MOST], seen[MOST], sum = {0.0f}, typical = {0.0f};
    float trust[MOST], all = 0.0f;
    for (int64_t i = 0; i < k; i++) {
        const double *place = g->placed + 2 * (k * a + i), half = (double)g->half;
        const double atx = (place[0] + g->shifts[2 * s]) / g->step, px = atx + half;
        const double aty = (place[1] + g->shifts[2 * s + 1]) / g->step, py = aty + half;
        const double last = (double)(side - 1), before = (double)(side - 2);
        const double nx = rint(atx) + half, ny = rint(aty) + half;
        const int64_t ix = (int64_t)(nx > 0 ? (nx < last ? nx : last) : 0);
        const int64_t iy = (int64_t)(ny > 0 ? (ny < last ? ny : last) : 0);
        row[i] = side * iy + ix;
        const int64_t lx = (int64_t)(px > 0 ? (px < before ? px : before) : 0);
        const int64_t ly = (int64_t)(py > 0 ? (py < before ? py : before) : 0);
        const float *corner = g->images + 2 * room * (side * ly + lx) + from;
        const float fx = (float)(px - (double)lx), fy = (float)(py - (double)ly);
        for (int part = 0; part < 2; part++) {
            const float *p = corner + part * room, *up = p + 2 * room * side;
            Offsets here, right, above, beyond;
            memcpy(&here, p, sizeof here);
            memcpy(&right, p + 2 * room, sizeof right);
            memcpy(&above, up, sizeof above);
            memcpy(&beyond, up + 2 * room, sizeof beyond);
            const Offsets low = here * (1.0f - fx) + right * fx, high = above * (1.0f - fx) + beyond * fx;
            if (part)
                b_im[i] = low * (1.0f - fy) + high * fy;
            else
                b_re[i] = low * (1.0f - fy) + high * fy;
        }
    }
    for (int64_t i = 0; i < k; i++) {
        const double *full = g->gram + 2 * k * (k * a + i);
        for (int64_t j = 0; j < i; j++) {
            double own[2];
            product(g->fixed + 2 * w * row[i], g->fixed + 2 * w * row[j], w, own, own + 1);
            factor[i * k + j][0] = full[2 * j] - g->views * own[0];
            factor[i * k + j][1] = full[2 * j + 1] - g->views * own[1];
        }
        const double energy = full[2 * i] - g->views * g->own[row[i]];
        const float share = (float)(energy / g->template_energy / g->visible);
        trust[i] = share < 1.0f ? share : 1.0f;
        all += trust[i];
        factor[i * k + i][0] = energy + 1e-2 * g->template_energy;
    }
    split(k, factor, inverse);
    for (int64_t i = 0; i < k; i++) {
        re[i] = b_re[i];
        im[i] = b_im[i];
        for (int64_t j = 0; j < i; j++) {
            const float x = (float)factor[i * k + j][0], y = (float)factor[i * k + j][1];
            re[i] -= x * re[j] - y * im[j];
            im[i] -= x * im[j] + y * re[j];
        }
    }
    for (int64_t i = 0; i < k; i++) {
        re[i] *= (float)inverse[i];
        im[i] *= (float)inverse[i];
    }
    for (int64_t i = k - 1; i >= 0; i--)
        for (int64_t j = i + 1; j < k; j++) {
            const float x = (float)factor[j * k + i][0], y = (float)factor[j * k + i][1];
            re[i] -= x * re[j] + y * im[j];
            im[i] -= x * im[j] - y * re[j];
        }
    const float share = 1.0f / (all > 1e-9f ? all : 1e-9f);
    for (int64_t i = 0; i < k; i++) {
        sum += b_re[i] * re[i] + b_im[i] * im[i];
        seen[i] = re[i] * re[i] + im[i] * im[i];
        for (int o = 0; o < ROOM; o++)
            seen[i][o] = sqrtf(seen[i][o]);
        typical += trust[i] * seen[i];
    }
    typical *= share;
    float least[ROOM], most[ROOM];
    for (int o = 0; o < ROOM; o++) {
        least[o] = INFINITY;
        most[o] = 0.0f;
    }
    for (int64_t i = 0; i < k; i++) {
        const Offsets own = trust[i] * seen[i] + (1.0f - trust[i]) * typical;
        for (int o = 0; o < ROOM; o++) {
            least[o] = own[o] < least[o] ? own[o] : least[o];
            most[o] = own[o] > most[o] ? own[o] : most[o];
        }
    }
    const float balance = (float)(1.0 / g->balance);
    for (int o = 0; o < ROOM; o++) {
        const float alike = least[o] / (most[o] > 1e-30f ? most[o] : 1e-30f) * balance;
        out[o] = (sum[o] > 0.0f ? sum[o] : 0.0f) * (alike < 1.0f ? alike : 1.0f);
    }
}

WIDE static void grid_energies(const Grid *given)
{
    /* A copy that no store can change. */
    const Grid own_grid = *given, *g = &own_grid;
    const int64_t room = (g->offsets + ROOM - 1) / ROOM * ROOM, side = 2 * g->half + 1;
    float found[ROOM];
    for (int64_t i = 0; i < side * side; i++) {
        double energy, none;
        product(g->fixed + 2 * g->width * i, g->fixed + 2 * g->width * i, g->width, &energy, &none);
        g->own[i] = (float)energy;
    }
    for (int64_t a = 0; a < g->rotations; a++)
        for (int64_t from = 0; from < room; from += ROOM) {
            float best[ROOM] = {0.0f};
            const int64_t count = g->offsets - from < ROOM ? g->offsets - from : ROOM;
            for (int64_t s = 0; s < g->places; s++) {
                /* The usual numbers of reflectors as constants. */
                if (g->size == 2)
                    energies_at(g, 2, a, s, room, from, found);
                else if (g->size == 3)
                    energies_at(g, 3, a, s, room, from, found);
                else
                    energies_at(g, g->size, a, s, room, from, found);
                for (int64_t o = 0; o < count; o++)
                    g->out[g->places * (g->rotations * (from + o) + a) + s] = found[o];
                for (int o = 0; o < ROOM; o++)
                    best[o] = found[o] > best[o] ? found[o] : best[o];
            }
            for (int64_t o = 0; o < count; o++)
                g->best[g->rotations * (from + o) + a] = best[o];
        }
}

static PyObject *coarse(PyObject *self, PyObject *args)
{
    (void)self;
    PyObject *tables, *o[8];
    Py_ssize_t room;
    Held h = {.count = 0};
    Field g;
    Coarse c;
    if (!PyArg_ParseTuple(args, "OOOOOOOnOO", &tables, o, o + 1, o + 2, o + 3, o + 4, o + 5, &room, o + 6,
                          o + 7))
        return NULL;
    if (!field_of(&h, tables, &g) || !(c.table = take(&h, o[0], 8 * g.views * g.entries, 0)) ||
        !(c.points = take(&h, o[1], -1, 0)))
        goto done;
    c.count = taken(&h) / 24;
    if (!(c.facing = take(&h, o[2], 16 * c.count, 0)) || !(c.pixel = take(&h, o[3], 4 * c.count, 0)) ||
        !(c.patterns = take(&h, o[4], -1, 0)))
        goto done;
    c.kinds = taken(&h) / 24;
    if (!(c.offsets = take(&h, o[5], -1, 0)))
        goto done;
    c.shifts = taken(&h) / 8;
    c.room = room;
    if (c.kinds < 1 || room < c.shifts || room > (1 << 10)) {
        refused("patterns and offsets do not fit together");
        goto done;
    }
    if (!(c.fixed = take(&h, o[6], -1, 1)))
        goto done;
    c.pixels = taken(&h) / 8 / c.kinds / g.width;
    if (taken(&h) != 8 * c.kinds * c.pixels * g.width) {
        refused("images do not fit together");
        goto done;
    }
    if (!(c.images = take(&h, o[7], 8 * c.kinds * c.pixels * room, 1)) || !below(c.pixel, c.count, c.pixels))
        goto done;
    float *sums = malloc((size_t)(2 * BLOCK * c.kinds * (c.shifts + VIEWS)) * sizeof(float));
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
    PyObject *o[7];
    Py_ssize_t half, size, offsets;
    Held h = {.count = 0};
    Grid g;
    if (!PyArg_ParseTuple(args, "OOOOOnnndddddOO", o, o + 1, o + 2, o + 3, o + 4, &offsets, &half, &size,
                          &g.step, &g.template_energy, &g.balance, &g.visible, &g.views, o + 5, o + 6))
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
    if (taken(&h) != 8 * pixels * g.width || g.width % LANES || !(g.placed = take(&h, o[2], -1, 0))) {
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
        !(g.out = take(&h, o[5], 4 * g.offsets * g.rotations * g.places, 1)) ||
        !(g.best = take(&h, o[6], 4 * g.offsets * g.rotations, 1)))
        goto done;
    if (!(g.own = malloc((size_t)pixels * sizeof(float)))) {
        PyErr_NoMemory();
        goto done;
    }
    Py_BEGIN_ALLOW_THREADS grid_energies(&g);
    Py_END_ALLOW_THREADS free(g.own);
done:
    return finished(&h);
}

static PyMethodDef methods[] = {
    {"coarse", coarse, METH_VARARGS,
     "coarse(tables, table, points, facing, pixel, patterns, offsets, room, fixed, images)"},
    {"energies", energies, METH_VARARGS,
     "energies(images, fixed, placed, shifts, gram, offsets, half, size, step, template_energy, balance, "
     "visible, views, out, best)"},
    {"correlate", correlate, METH_VARARGS, "correlate(tables, data, index, turn, out)"},
    {"left", left, METH_VARARGS,
     "left(tables, pattern, data, points, facing, offset, amplitudes, index, turn, out)"},
    {"beyond", beyond, METH_VARARGS, "beyond(tables, index, turn, others, inverse, left)"},
    {NULL, NULL, 0, NULL},
};

MODULE(_coarse, "Compiled loops over many points (see tagid.tags.reading.compiled).", methods, 3)
