/* Walls with planes of symmetry: what each leaves of the spectra.
 *
 * `tagid.tags.bodies.symmetric` holds the formula, and does the same with numpy where no compiler was present.
 * Only the stable ABI and the buffer protocol are used.
 */
#include "_spectra.h"
#include <math.h>
#include <stdlib.h>
#include <string.h>

#define MOST 8 /* amplitudes per frequency, at most */
#define SIDE MOST
#include "_leave.h"

typedef struct {
    const double *places; /* (H, 3) centre x and y, m, and gamma, rad */
    int64_t rows, order;
    int columns;
    double *left; /* (H,) */
} Walls;

/* (F, 2, views) waves of a wall about a centre, and (2, views) the direction to the antenna from there. */
INLINE void see(const Spectra *g, double x, double y, double *restrict waves, double *restrict toward)
{
    const int64_t n = g->views;
    for (int64_t v = 0; v < n; v++) {
        const double a = g->antenna[v] - x, b = g->antenna[n + v] - y;
        const double rho = sqrt(a * a + b * b), path = rho - g->distance;
        const double loss = (g->distance / rho) * (g->distance / rho);
        double re = loss * cos(g->first * path), im = -loss * sin(g->first * path);
        const double tr = cos(g->step * path), ti = -sin(g->step * path);
        toward[v] = a / rho;
        toward[n + v] = b / rho;
        for (int64_t f = 0; f < g->frequencies; f++) {
            waves[2 * n * f + v] = re;
            waves[2 * n * f + n + v] = im;
            const double next = re * tr - im * ti;
            im = re * ti + im * tr;
            re = next;
        }
    }
}

/* (columns, views) cos(order p (phi - gamma)), by recurrence over p. */
INLINE void shapes(int64_t n, int64_t order, int columns, double gamma, const double *toward,
                   double *restrict shape)
{
    const double c = cos(gamma), s = sin(gamma);
    for (int64_t v = 0; v < n; v++) {
        const double re = toward[v] * c + toward[n + v] * s, im = toward[n + v] * c - toward[v] * s;
        double x = 1.0, y = 0.0;
        for (int64_t i = 0; i < order; i++) {
            const double next = x * re - y * im;
            y = x * im + y * re;
            x = next;
        }
        double now = 1.0, before = x;
        for (int p = 0; p < columns; p++) {
            shape[n * p + v] = now;
            const double next = 2.0 * x * now - before;
            before = now;
            now = next;
        }
    }
}

/* Energy that so many columns leave at one frequency. */
INLINE double left_at(int64_t n, int columns, const double *wave, const double *shape, const double *data,
                      double *restrict column, double *restrict rest)
{
    for (int p = 0; p < columns; p++) {
        double *restrict own = column + 2 * n * p;
        const double *restrict by = shape + n * p;
        for (int64_t v = 0; v < n; v++) {
            own[v] = wave[v] * by[v];
            own[n + v] = wave[n + v] * by[v];
        }
        centre(own, n);
    }
    return leave(columns, column, data, n, rest);
}

WIDE static void every_wall(const Spectra *shared, const Walls *w, double *scratch)
{
    /* A copy that no store can change. */
    const Spectra own_spectra = *shared, *g = &own_spectra;
    const int64_t n = g->views;
    double *waves = scratch, *toward = waves + 2 * n * g->frequencies, *shape = toward + 2 * n,
           *column = shape + MOST * n, *rest = column + 2 * MOST * n;
    for (int64_t row = 0; row < w->rows; row++) {
        const double *place = w->places + 3 * row;
        if (!row || place[0] != place[-3] || place[1] != place[-2])
            see(g, place[0], place[1], waves, toward);
        shapes(n, w->order, w->columns, place[2], toward, shape);
        double total = 0.0;
        for (int64_t f = 0; f < g->frequencies; f++) {
            const double *wave = waves + 2 * n * f, *data = g->data + 2 * n * f;
            /* The usual number as a constant. */
            total += w->columns == 2 ? left_at(n, 2, wave, shape, data, column, rest)
                                     : left_at(n, w->columns, wave, shape, data, column, rest);
        }
        w->left[row] = total;
    }
}

static PyObject *left(PyObject *self, PyObject *args)
{
    (void)self;
    PyObject *s[3], *o[2];
    Py_ssize_t order, columns;
    Held h = {.count = 0};
    Spectra g;
    Walls w;
    if (!PyArg_ParseTuple(args, "OOO(ddd)OnnO", s, s + 1, s + 2, &g.first, &g.step, &g.distance, o, &order,
                          &columns, o + 1))
        return NULL;
    if (order < 0 || order > 1024 || columns < 1 || columns > MOST) {
        refused("too few amplitudes or planes, or too many");
        return NULL;
    }
    w.order = order;
    w.columns = (int)columns;
    if (!take_spectra(&h, s, &g) || !(w.left = take(&h, o[1], -1, 1)))
        return finished(&h);
    w.rows = taken(&h) / 8;
    if (!(w.places = take(&h, o[0], 24 * w.rows, 0)))
        return finished(&h);
    double *scratch = malloc((size_t)(g.views * (2 * g.frequencies + 4 + 3 * MOST)) * sizeof(double));
    if (scratch) {
        Py_BEGIN_ALLOW_THREADS every_wall(&g, &w, scratch);
        Py_END_ALLOW_THREADS
    } else
        PyErr_NoMemory();
    free(scratch);
    return finished(&h);
}

static PyMethodDef methods[] = {
    {"left", left, METH_VARARGS,
     "left(antenna, height, data, (first, step, distance), places, order, columns, left)"},
    {NULL, NULL, 0, NULL},
};

MODULE(_walls, "Compiled loop of walls with planes of symmetry (see tagid.tags.bodies.compiled).", methods, 1)
