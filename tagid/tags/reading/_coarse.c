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

WIDE static void coarse_points(const Field *g, const Coarse *c, double *far, float *scratch)
{
    const int64_t n = g->views, w = g->width;
    float *base = scratch, *re = base + 2 * n;
    float *restrict seen = re + 2 * n * c->kinds;
    int32_t *index = (int32_t *)(seen + 2 * n), *moved = index + n;
    for (int64_t i = 0; i < c->count; i++) {
        const double *point = c->points + 3 * i;
        distances(g, point, 0.0, far);
        for (int64_t v = 0; v < n; v++)
            index[v] = entry(g, far[v]);
        phases(g, far, base, base + n);
        for (int64_t a = 0; a < c->kinds; a++) {
            const double *p = c->patterns + 3 * a;
            const Pattern pattern = {p[0], p[1], p[2]};
            float *own = re + 2 * n * a, *restrict out = c->fixed + 2 * w * (c->count * a + i);
            memcpy(own, base, (size_t)(2 * n) * sizeof(float));
            lit(g, &pattern, point, c->facing + 2 * i, own, own + n);
            memset(out, 0, (size_t)(2 * w) * sizeof(float));
            for (int64_t v = 0; v < n; v++) {
                const float x = own[v],
                            y = own[n + v], *restrict profile = g->profiles + 2 * w * (int64_t)index[v];
                for (int64_t j = 0; j < w; j += LANES)
                    for (int l = 0; l < LANES; l++) {
                        out[j + l] += x * profile[j + l] - y * profile[w + j + l];
                        out[w + j + l] += x * profile[w + j + l] + y * profile[j + l];
                    }
            }
            for (int64_t j = 0; j < 2 * w; j++)
                out[j] /= (float)n;
        }
        for (int64_t o = 0; o < c->shifts; o++) {
            double phase = g->wavenumber * c->offsets[o] / 3.141592653589793;
            float tr, ti;
            turned(phase, &tr, &ti);
            for (int64_t v = 0; v < n; v++)
                moved[v] = entry(g, far[v] + c->offsets[o]);
            for (int64_t v = 0; v < n; v++) {
                const float *t = c->table + 2 * (g->entries * v + moved[v]);
                seen[v] = t[0];
                seen[n + v] = t[1];
            }
            for (int64_t a = 0; a < c->kinds; a++) {
                const float *restrict x = re + 2 * n * a, *restrict y = x + n;
                float sr = 0.0f, si = 0.0f;
#pragma omp simd reduction(+ : sr, si)
                for (int64_t v = 0; v < n; v++) {
                    sr += x[v] * seen[v] + y[v] * seen[n + v];
                    si += x[v] * seen[n + v] - y[v] * seen[v];
                }
                float *out = c->images + 2 * (c->count * (c->shifts * a + o) + i);
                out[0] = sr * tr - si * ti;
                out[1] = sr * ti + si * tr;
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

WIDE static void grid_energies(const Grid *g)
{
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
                    float re = 0.0f, im = 0.0f;
                    for (int64_t q = 0; q < 2 * w; q += 2) {
                        re += rows[i][q] * rows[j][q] + rows[i][q + 1] * rows[j][q + 1];
                        im += rows[i][q] * rows[j][q + 1] - rows[i][q + 1] * rows[j][q];
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
    double *far = malloc((size_t)g.views * 8 + (size_t)(6 + 2 * c.kinds) * (size_t)g.views * 4);
    if (!far) {
        PyErr_NoMemory();
        goto done;
    }
    Py_BEGIN_ALLOW_THREADS coarse_points(&g, &c, far, (float *)(far + g.views));
    Py_END_ALLOW_THREADS free(far);
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
