/* Alike reflectors beside round walls: what each arrangement leaves of the spectra.
 *
 * `tagid.tags.bodies.cylinder_fit` holds the formula, and does the same with numpy where no compiler was
 * present. Only the stable ABI and the buffer protocol are used.
 */
#include "_spectra.h"
#include <math.h>
#include <stdlib.h>
#include <string.h>

#define DIPOLES 2
#define COLUMNS (1 + DIPOLES)
#define COMMON 3 /* coordinates before the reflectors' angles */
#define MOST 8   /* reflectors, at most */
#define SIDE COLUMNS
#include "_leave.h"
#define TURN 6.283185307179586

typedef struct {
    const double *patterns; /* (DIPOLES, S, F, angles, 2) */
    const int64_t *shells;  /* (H,) */
    const double *at;       /* (H, 3 + K) centre x and y, radius offset, angles */
    const double *radii;    /* (H, K) */
    const double *heights;  /* (H, K) */
    const double *present;  /* (H, K) */
    const double *body;     /* (F, 2, views) of a body in its pose; NULL for one of revolution */
    int64_t rows, width, angles, walls;
    double *rest; /* (H, F, views, 2) */
    double *left; /* (H,) */
} Ringed;

/* A wave (2, views) at one frequency, the step to the next, and where a reflector is seen from. */
typedef struct {
    double *wave, *turn, *part;
    int64_t *low;
} Way;
#define PER_WAY 6

INLINE void way_at(Way *w, double *scratch, int64_t n)
{
    w->wave = scratch;
    w->turn = w->wave + 2 * n;
    w->part = w->turn + 2 * n;
    w->low = (int64_t *)(w->part + n);
}

/* Wave over a path, of so much weight, at the first frequency. */
INLINE void begin(const Spectra *g, Way *w, int64_t v, double path, double weight)
{
    const int64_t n = g->views;
    w->wave[v] = weight * cos(g->first * path);
    w->wave[n + v] = -weight * sin(g->first * path);
    w->turn[v] = cos(g->step * path);
    w->turn[n + v] = -sin(g->step * path);
}

/* To the next frequency. */
INLINE void proceed(Way *w, int64_t n)
{
    double *restrict re = w->wave, *restrict im = re + n;
    const double *restrict tr = w->turn, *restrict ti = tr + n;
    for (int64_t v = 0; v < n; v++) {
        const double next = re[v] * tr[v] - im[v] * ti[v];
        im[v] = re[v] * ti[v] + im[v] * tr[v];
        re[v] = next;
    }
}

/* The body's way, and that of every reflector present; returns their number. */
INLINE int see(const Spectra *g, const Ringed *r, int64_t row, Way *body, Way *each)
{
    const int64_t n = g->views;
    const double *place = r->at + (COMMON + r->width) * row;
    int count = 0;
    for (int64_t v = 0; v < n; v++) {
        const double a = g->antenna[v] - place[0], b = g->antenna[n + v] - place[1];
        const double rho = sqrt(a * a + b * b);
        begin(g, body, v, rho - g->distance, (g->distance / rho) * (g->distance / rho));
    }
    for (int64_t k = 0; k < r->width; k++) {
        const int64_t own = r->width * row + k;
        if (r->present[own] == 0.0)
            continue;
        Way *w = each + count++;
        const double angle = place[COMMON + k], radius = r->radii[own] + place[2];
        const double c = cos(angle), s = sin(angle);
        for (int64_t v = 0; v < n; v++) {
            const double a = g->antenna[v] - place[0], b = g->antenna[n + v] - place[1];
            const double x = a * c + b * s, y = b * c - a * s, up = g->height[v] - r->heights[own];
            const double far = sqrt((x - radius) * (x - radius) + y * y + up * up), near = g->distance / far;
            const double at = atan2(y, x) * ((double)r->angles / TURN), low = floor(at);
            begin(g, w, v, far - g->distance, r->present[own] * near * near);
            w->part[v] = at - low;
            w->low[v] = ((int64_t)low % r->angles + r->angles) % r->angles;
        }
    }
    return count;
}

/* Echo (2, views) of a reflector as one dipole, added; pattern (angles, 2). */
INLINE void shine(const Way *w, const double *restrict pattern, int64_t angles, int64_t n,
                  double *restrict out)
{
    for (int64_t v = 0; v < n; v++) {
        const int64_t low = w->low[v], next = low + 1 == angles ? 0 : low + 1;
        const double *here = pattern + 2 * low, *ahead = pattern + 2 * next, part = w->part[v];
        const double re = here[0] + (ahead[0] - here[0]) * part, im = here[1] + (ahead[1] - here[1]) * part;
        out[v] += re * w->wave[v] - im * w->wave[n + v];
        out[n + v] += re * w->wave[n + v] + im * w->wave[v];
    }
}

WIDE static void every_row(const Spectra *shared, const Ringed *r, double *scratch)
{
    /* A copy that no store can change. */
    const Spectra own_spectra = *shared, *g = &own_spectra;
    const int64_t n = g->views, band = 2 * r->angles;
    Way body, each[MOST];
    double *column = scratch, *rest = column + 2 * COLUMNS * n, *ways = rest + 2 * n;
    way_at(&body, ways, n);
    for (int k = 0; k < MOST; k++)
        way_at(each + k, ways + PER_WAY * n * (k + 1), n);
    for (int64_t row = 0; row < r->rows; row++) {
        const int count = see(g, r, row, &body, each);
        double total = 0.0;
        for (int64_t f = 0; f < g->frequencies; f++) {
            memcpy(column, r->body ? r->body + 2 * n * f : body.wave, (size_t)(2 * n) * sizeof(double));
            memset(column + 2 * n, 0, (size_t)(2 * n * DIPOLES) * sizeof(double));
            for (int d = 0; d < DIPOLES; d++) {
                const double *pattern =
                    r->patterns + band * ((r->walls * d + r->shells[row]) * g->frequencies + f);
                for (int k = 0; k < count; k++)
                    shine(each + k, pattern, r->angles, n, column + 2 * n * (1 + d));
            }
            for (int c = 0; c < COLUMNS; c++)
                centre(column + 2 * n * c, n);
            total += leave(COLUMNS, column, g->data + 2 * n * f, n, rest);
            double *restrict out = r->rest + 2 * n * (g->frequencies * row + f);
            for (int64_t v = 0; v < n; v++) {
                out[2 * v] = rest[v];
                out[2 * v + 1] = rest[n + v];
            }
            proceed(&body, n);
            for (int k = 0; k < count; k++)
                proceed(each + k, n);
        }
        r->left[row] = total;
    }
}

static int rows_of(Held *h, PyObject **o, const Spectra *g, Ringed *r)
{
    if (!(r->shells = take(h, o[1], -1, 0)))
        return 0;
    r->rows = taken(h) / 8;
    if (!(r->at = take(h, o[2], -1, 0)))
        return 0;
    r->width = r->rows ? taken(h) / 8 / r->rows - COMMON : 0;
    if (r->rows < 1 || r->width < 1 || r->width > MOST || taken(h) != 8 * r->rows * (COMMON + r->width))
        return refused("arrangements have 1 to 8 reflectors");
    const int64_t whole = 8 * r->rows * r->width, pattern = 16 * DIPOLES * g->frequencies * r->angles;
    if (!(r->radii = take(h, o[3], whole, 0)) || !(r->heights = take(h, o[4], whole, 0)) ||
        !(r->present = take(h, o[5], whole, 0)) || !(r->patterns = take(h, o[0], -1, 0)))
        return 0;
    r->walls = taken(h) / pattern;
    if (taken(h) != r->walls * pattern)
        return refused("patterns and spectra do not fit together");
    for (int64_t i = 0; i < r->rows; i++)
        if (r->shells[i] < 0 || r->shells[i] >= r->walls)
            return refused("there is no such wall");
    r->body = NULL;
    if (o[6] != Py_None && !(r->body = take(h, o[6], 16 * g->frequencies * g->views, 0)))
        return 0;
    return (r->rest = take(h, o[7], 16 * r->rows * g->frequencies * g->views, 1)) &&
           (r->left = take(h, o[8], 8 * r->rows, 1));
}

static PyObject *left(PyObject *self, PyObject *args)
{
    (void)self;
    PyObject *s[3], *o[9];
    Py_ssize_t angles;
    Held h = {.count = 0};
    Spectra g;
    Ringed r;
    if (!PyArg_ParseTuple(args, "OOO(ddd)OnOOOOOOOO", s, s + 1, s + 2, &g.first, &g.step, &g.distance, o,
                          &angles, o + 1, o + 2, o + 3, o + 4, o + 5, o + 6, o + 7, o + 8))
        return NULL;
    if (angles < 1 || angles > 1 << 16) {
        refused("too few angles of a pattern, or too many");
        return NULL;
    }
    r.angles = angles;
    if (!take_spectra(&h, s, &g) || !rows_of(&h, o, &g, &r))
        return finished(&h);
    const int64_t per_view = 2 * COLUMNS + 2 + PER_WAY * (MOST + 1);
    double *scratch = malloc((size_t)(per_view * g.views) * sizeof(double));
    if (scratch) {
        Py_BEGIN_ALLOW_THREADS every_row(&g, &r, scratch);
        Py_END_ALLOW_THREADS
    } else
        PyErr_NoMemory();
    free(scratch);
    return finished(&h);
}

static PyMethodDef methods[] = {
    {"left", left, METH_VARARGS,
     "left(antenna, height, data, (first, step, distance), patterns, angles, shells, at, radii, heights, "
     "present, body, rest, left)"},
    {NULL, NULL, 0, NULL},
};

MODULE(_cylinders, "Compiled loop of reflectors beside round walls (see tagid.tags.bodies.compiled).", methods,
       2)
