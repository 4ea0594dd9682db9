/* Energies of every rotation and shift of a layout on a coarse image (see tagid.tags.reading.coarse_grid). */
#include "../_buffers.h"
#include <math.h>
#include <stdlib.h>
#include <string.h>

#define LANES 4 /* numbers of coordinates are padded to a multiple */
#define MOST 24 /* reflectors of a layout, at most */

/* Coordinates that one register holds, in any place. */
typedef float Four __attribute__((vector_size(4 * LANES)));

INLINE Four load(const float *from)
{
    Four found;
    memcpy(&found, from, sizeof found);
    return found;
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

typedef struct {
    const float *images;  /* (side, side, 2, room) */
    const float *fixed;   /* (side, side, 2, width) */
    const double *placed; /* (A, K, 2) m */
    const double *shifts; /* (S, 2) m */
    const double *gram;   /* (A, K, K, 2) */
    int64_t offsets, half, width, rotations, size, places;
    double step, template_energy, balance, visible, views;
    float *own;  /* (side, side) energies of `fixed` */
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
                for (int o = 0; o < ROOM; o++)
                    best[o] = found[o] > best[o] ? found[o] : best[o];
            }
            for (int64_t o = 0; o < count; o++)
                g->best[g->rotations * (from + o) + a] = best[o];
        }
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
        !(g.best = take(&h, o[5], 4 * g.offsets * g.rotations, 1)))
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
    {"energies", energies, METH_VARARGS,
     "energies(images, fixed, placed, shifts, gram, offsets, half, size, step, template_energy, balance, "
     "visible, views, best)"},
    {NULL, NULL, 0, NULL},
};

MODULE(_coarse, "Compiled coarse search for layouts (see tagid.tags.reading.compiled).", methods, 4)
