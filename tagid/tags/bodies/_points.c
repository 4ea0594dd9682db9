/* Points and their double bounce: where an arrangement of them leaves least, beginning near there.
 *
 * `tagid.tags.bodies.points` holds the formula, and does the same with numpy where no compiler was present.
 * Only the stable ABI and the buffer protocol are used.
 */
#include "_spectra.h"
#include <math.h>
#include <stdlib.h>
#include <string.h>

#define MOST 16 /* points, at most */
#define PAIRS (MOST * (MOST - 1) / 2)
#define LOAD 1e-9
#define SPACING 0.06 /* of two reflectors whose bounce has the amplitude 1, m */

typedef struct {
    double *phase; /* (2, views) now, at one frequency, with its spreading loss */
    double *turn;  /* (2, views) from one frequency to the next */
} Wave;

/* exp(-j kappa path) times an amplitude, and its change from one frequency to the next. */
INLINE void begin(const Spectra *g, Wave *w, int64_t v, double path, double amplitude)
{
    const double first = g->first * path, step = g->step * path;
    w->phase[v] = amplitude * cos(first);
    w->phase[g->views + v] = -amplitude * sin(first);
    w->turn[v] = cos(step);
    w->turn[g->views + v] = -sin(step);
}

INLINE void advance(const Spectra *g, const Wave *w)
{
    double *restrict re = w->phase, *restrict im = re + g->views;
    const double *restrict tr = w->turn, *restrict ti = tr + g->views;
    for (int64_t v = 0; v < g->views; v++) {
        const double a = re[v] * tr[v] - im[v] * ti[v], b = re[v] * ti[v] + im[v] * tr[v];
        re[v] = a;
        im[v] = b;
    }
}

/* y -= c x. */
INLINE void subtract(double *restrict y, const double *restrict x, const double *c, int64_t n)
{
    for (int64_t v = 0; v < n; v++) {
        y[v] -= c[0] * x[v] - c[1] * x[n + v];
        y[n + v] -= c[0] * x[n + v] + c[1] * x[v];
    }
}

/* x scaled to length 1; its length. */
INLINE double scale(double *restrict x, int64_t n)
{
    double size[2];
    inner(x, x, n, size);
    size[0] = sqrt(size[0]);
    const double part = size[0] > 0.0 ? 1.0 / size[0] : 0.0;
    for (int64_t v = 0; v < 2 * n; v++)
        x[v] *= part;
    return size[0];
}

/* dR / dx and dR / dy (2, views) of every point, dD / dx and dD / dy (2,) of every pair. */
typedef struct {
    double *toward[MOST];
    double along[PAIRS][2];
    int one[PAIRS], other[PAIRS], pairs;
} Slopes;

/* Waves of points and pairs at the first frequency. */
INLINE void prepare(const Spectra *g, const double *places, const double *heights, int count, double *away,
                    Wave *single, Wave *bounce, Slopes *s)
{
    const int64_t n = g->views;
    for (int k = 0; k < count; k++)
        for (int64_t v = 0; v < n; v++) {
            const double x = g->antenna[v] - places[2 * k], y = g->antenna[n + v] - places[2 * k + 1];
            const double up = g->height[v] - heights[k], d = sqrt(x * x + y * y + up * up),
                         near = g->distance / d;
            away[n * k + v] = d;
            s->toward[k][v] = -x / d;
            s->toward[k][n + v] = -y / d;
            begin(g, single + k, v, d - g->distance, near * near);
        }
    s->pairs = 0;
    for (int i = 0; i < count; i++)
        for (int k = i + 1; k < count; k++) {
            const int p = s->pairs++;
            const double x = places[2 * i] - places[2 * k], y = places[2 * i + 1] - places[2 * k + 1];
            const double up = heights[i] - heights[k], gap = sqrt(x * x + y * y + up * up);
            const double apart = gap > 1e-3 ? gap : 1e-3;
            s->one[p] = i;
            s->other[p] = k;
            s->along[p][0] = x / apart;
            s->along[p][1] = y / apart;
            for (int64_t v = 0; v < n; v++) {
                const double a = away[n * i + v], b = away[n * k + v];
                begin(g, bounce + p, v, (a + b + apart) / 2 - g->distance,
                      g->distance * g->distance / (a * b) * SPACING / apart);
            }
        }
}

/* Derivatives (2 K, 2, 2, views) of both columns at one frequency. */
INLINE void derive(const Spectra *g, double kappa, int count, const Wave *single, const Wave *bounce,
                   const Slopes *s, double *slopes)
{
    const int64_t n = g->views;
    memset(slopes, 0, (size_t)(8 * count * n) * sizeof(double));
    /* -j kappa (a + j b) = kappa b - j kappa a */
    for (int k = 0; k < count; k++)
        for (int axis = 0; axis < 2; axis++) {
            double *restrict re = slopes + 4 * n * (2 * k + axis), *restrict im = re + n;
            const double *restrict a = single[k].phase, *restrict b = a + n,
                                   *restrict t = s->toward[k] + n * axis;
            for (int64_t v = 0; v < n; v++) {
                re[v] = kappa * b[v] * t[v];
                im[v] = -kappa * a[v] * t[v];
            }
        }
    for (int p = 0; p < s->pairs; p++)
        for (int end = 0; end < 2; end++)
            for (int axis = 0; axis < 2; axis++) {
                const int k = end ? s->other[p] : s->one[p];
                const double along = end ? -s->along[p][axis] : s->along[p][axis];
                double *restrict re = slopes + 4 * n * (2 * k + axis) + 2 * n, *restrict im = re + n;
                const double *restrict a = bounce[p].phase, *restrict b = a + n,
                                       *restrict t = s->toward[k] + n * axis;
                for (int64_t v = 0; v < n; v++) {
                    const double w = 0.5 * kappa * (t[v] + along);
                    re[v] += b[v] * w;
                    im[v] -= a[v] * w;
                }
            }
}

typedef struct {
    double *left;     /* (1,) */
    double *normal;   /* (2 K, 2 K) */
    double *gradient; /* (2 K,) */
} Result;

/* Least squares with the amplitudes eliminated (Kaufman 1975), frequency after frequency. */
WIDE static void linear_model(const Spectra *g, const double *places, const double *heights, int count,
                              double *scratch, const Result *out)
{
    const int64_t n = g->views;
    const int cols = count > 1 ? 2 : 1, moves = 2 * count, pairs = count * (count - 1) / 2;
    Wave single[MOST], bounce[PAIRS];
    Slopes s;
    double *at = scratch, *away = at, *q = away + n * count, *rest, *slopes;
    at = q + 4 * n;
    rest = at;
    slopes = rest + 2 * n;
    at = slopes + 8 * n * count;
    for (int k = 0; k < count; k++, at += 6 * n) {
        single[k] = (Wave){at, at + 2 * n};
        s.toward[k] = at + 4 * n;
    }
    for (int p = 0; p < pairs; p++, at += 4 * n)
        bounce[p] = (Wave){at, at + 2 * n};
    prepare(g, places, heights, count, away, single, bounce, &s);
    memset(out->normal, 0, (size_t)(moves * moves) * sizeof(double));
    memset(out->gradient, 0, (size_t)moves * sizeof(double));
    *out->left = 0.0;
    for (int64_t f = 0; f < g->frequencies; f++) {
        memset(q, 0, (size_t)(4 * n) * sizeof(double));
        for (int k = 0; k < count; k++)
            for (int64_t v = 0; v < 2 * n; v++)
                q[v] += single[k].phase[v];
        for (int p = 0; p < pairs; p++)
            for (int64_t v = 0; v < 2 * n; v++)
                q[2 * n + v] += bounce[p].phase[v];
        /* Orthonormal columns by Gram and Schmidt, the second in two steps, which is as exact as reflections.
         */
        double size[2] = {0.0, 0.0}, overlap[2] = {0.0, 0.0}, found[2][2] = {{0.0, 0.0}, {0.0, 0.0}};
        memcpy(rest, g->data + 2 * n * f, (size_t)(2 * n) * sizeof(double));
        for (int c = 0; c < cols; c++) {
            double *own = q + 2 * n * c;
            centre(own, n);
            for (int again = 0; c && again < 2; again++) {
                double part[2];
                inner(q, own, n, part);
                subtract(own, q, part, n);
                overlap[0] += part[0];
                overlap[1] += part[1];
            }
            size[c] = scale(own, n);
            inner(own, rest, n, found[c]);
            subtract(rest, own, found[c], n);
        }
        double energy[2], amplitude[2][2] = {{0.0, 0.0}, {0.0, 0.0}};
        inner(rest, rest, n, energy);
        *out->left += energy[0];
        const double cross = sqrt(overlap[0] * overlap[0] + overlap[1] * overlap[1]);
        double most = size[0] > size[1] ? size[0] : size[1];
        most = most > cross ? most : cross;
        const double load = LOAD * most + 1e-300;
        if (cols > 1) {
            amplitude[1][0] = found[1][0] / (size[1] + load);
            amplitude[1][1] = found[1][1] / (size[1] + load);
        }
        const double *a1 = amplitude[1];
        amplitude[0][0] = (found[0][0] - overlap[0] * a1[0] + overlap[1] * a1[1]) / (size[0] + load);
        amplitude[0][1] = (found[0][1] - overlap[0] * a1[1] - overlap[1] * a1[0]) / (size[0] + load);
        const double *a0 = amplitude[0];
        derive(g, g->first + (double)f * g->step, count, single, bounce, &s, slopes);
        for (int p = 0; p < moves; p++) {
            double *restrict re = slopes + 4 * n * p, *restrict im = re + n;
            const double *restrict br = re + 2 * n, *restrict bi = re + 3 * n;
            for (int64_t v = 0; v < n; v++) {
                const double x = re[v], y = im[v];
                re[v] = a0[0] * x - a0[1] * y + a1[0] * br[v] - a1[1] * bi[v];
                im[v] = a0[0] * y + a0[1] * x + a1[0] * bi[v] + a1[1] * br[v];
            }
            centre(re, n);
            for (int c = 0; c < cols; c++) {
                double part[2];
                inner(q + 2 * n * c, re, n, part);
                subtract(re, q + 2 * n * c, part, n);
            }
            double value[2];
            inner(re, rest, n, value);
            out->gradient[p] += value[0];
            for (int o = 0; o <= p; o++) {
                inner(re, slopes + 4 * n * o, n, value);
                out->normal[moves * p + o] += value[0];
            }
        }
        for (int k = 0; k < count; k++)
            advance(g, single + k);
        for (int p = 0; p < pairs; p++)
            advance(g, bounce + p);
    }
    for (int p = 0; p < moves; p++)
        for (int o = 0; o < p; o++)
            out->normal[moves * o + p] = out->normal[moves * p + o];
}

/* x of a x = b for a (n, n), by elimination with the largest pivots; what is given is spent. */
static void solve(int n, double *a, double *b)
{
    for (int c = 0; c < n; c++) {
        int best = c;
        for (int r = c + 1; r < n; r++)
            best = fabs(a[n * r + c]) > fabs(a[n * best + c]) ? r : best;
        for (int k = c; best != c && k < n; k++) {
            const double swap = a[n * c + k];
            a[n * c + k] = a[n * best + k];
            a[n * best + k] = swap;
        }
        const double swap = b[c];
        b[c] = b[best];
        b[best] = swap;
        const double part = a[n * c + c] != 0.0 ? 1.0 / a[n * c + c] : 0.0;
        for (int r = c + 1; r < n; r++) {
            const double share = a[n * r + c] * part;
            for (int k = c; k < n; k++)
                a[n * r + k] -= share * a[n * c + k];
            b[r] -= share * b[c];
        }
    }
    for (int c = n - 1; c >= 0; c--) {
        for (int k = c + 1; k < n; k++)
            b[c] -= a[n * c + k] * b[k];
        b[c] = a[n * c + c] != 0.0 ? b[c] / a[n * c + c] : 0.0;
    }
}

/* How points may move. */
typedef struct {
    int rigid, rounds;
    double reach, step; /* largest distance from the axis, and in one step, m */
} Freedom;

/* Middle (2,) of the points. */
static void middle_of(const double *places, int count, double *middle)
{
    middle[0] = middle[1] = 0.0;
    for (int i = 0; i < 2 * count; i++)
        middle[i % 2] += places[i] / count;
}

/* Directions (P, 2 K): the points as a whole, shifted and turned about their middle, or each on its own. */
static int directions(const double *places, int count, int rigid, double *out)
{
    const int size = 2 * count, rows = rigid ? 3 : size;
    memset(out, 0, (size_t)(rows * size) * sizeof(double));
    if (!rigid) {
        for (int i = 0; i < size; i++)
            out[size * i + i] = 1.0;
        return rows;
    }
    double middle[2];
    middle_of(places, count, middle);
    for (int k = 0; k < count; k++) {
        out[2 * k] = out[size + 2 * k + 1] = 1.0;
        out[2 * size + 2 * k] = middle[1] - places[2 * k + 1];
        out[2 * size + 2 * k + 1] = places[2 * k] - middle[0];
    }
    return rows;
}

/* Places after a step (P,) along the directions. A turn is a whole one, not along its tangent, which would
   stretch what is rigid. */
static void moved(const double *places, int count, int rigid, const double *step, double *out)
{
    if (!rigid) {
        for (int i = 0; i < 2 * count; i++)
            out[i] = places[i] + step[i];
        return;
    }
    double middle[2];
    middle_of(places, count, middle);
    const double c = cos(step[2]), s = sin(step[2]);
    for (int k = 0; k < count; k++) {
        const double x = places[2 * k] - middle[0], y = places[2 * k + 1] - middle[1];
        out[2 * k] = middle[0] + step[0] + c * x - s * y;
        out[2 * k + 1] = middle[1] + step[1] + s * x + c * y;
    }
}

/* Levenberg and Marquardt's descent from `places`, which end where the least is left. */
static void descend(const Spectra *g, const Freedom *free_to, double *places, const double *heights, int count,
                    double *scratch, const Result *at)
{
    enum { SIZE = 2 * MOST };
    const int size = 2 * count;
    double steps[SIZE * SIZE], along[SIZE * SIZE], normal[SIZE * SIZE], load[SIZE * SIZE], trial[SIZE];
    double gradient[SIZE], move[SIZE], new_normal[SIZE * SIZE], new_gradient[SIZE], left, damping = 1e-3;
    const Result after = {&left, new_normal, new_gradient};
    linear_model(g, places, heights, count, scratch, at);
    for (int round = 0; round < free_to->rounds; round++) {
        const int rows = directions(places, count, free_to->rigid, steps);
        double trace = 0.0, gain = 0.0;
        for (int p = 0; p < rows; p++) {
            gradient[p] = 0.0;
            for (int i = 0; i < size; i++) {
                gradient[p] += steps[size * p + i] * at->gradient[i];
                along[size * p + i] = 0.0;
                for (int k = 0; k < size; k++)
                    along[size * p + i] += steps[size * p + k] * at->normal[size * k + i];
            }
        }
        for (int p = 0; p < rows; p++)
            for (int q = 0; q < rows; q++) {
                double value = 0.0;
                for (int i = 0; i < size; i++)
                    value += along[size * p + i] * steps[size * q + i];
                normal[rows * p + q] = value;
                trace += p == q ? value : 0.0;
            }
        for (int again = 0; again < 4; again++) {
            double farthest = 0.0, longest = 0.0;
            memcpy(load, normal, (size_t)(rows * rows) * sizeof(double));
            memcpy(move, gradient, (size_t)rows * sizeof(double));
            for (int p = 0; p < rows; p++)
                load[rows * p + p] += damping * normal[rows * p + p] + 1e-12 * trace + 1e-300;
            solve(rows, load, move);
            moved(places, count, free_to->rigid, move, trial);
            for (int i = 0; i < size; i++)
                longest = fmax(longest, fabs(trial[i] - places[i]));
            for (int k = 0; k < count; k++) {
                const double far = hypot(trial[2 * k], trial[2 * k + 1]);
                farthest = far > farthest ? far : farthest;
            }
            if (farthest < free_to->reach && longest < free_to->step) {
                linear_model(g, trial, heights, count, scratch, &after);
                if (left < *at->left) {
                    gain = *at->left - left;
                    memcpy(places, trial, (size_t)size * sizeof(double));
                    memcpy(at->normal, new_normal, (size_t)(size * size) * sizeof(double));
                    memcpy(at->gradient, new_gradient, (size_t)size * sizeof(double));
                    *at->left = left;
                    damping /= 5;
                    break;
                }
            }
            damping *= 8;
        }
        if (gain < 1e-4 * *at->left)
            break;
    }
}

static PyObject *fit(PyObject *self, PyObject *args)
{
    (void)self;
    PyObject *o[8];
    Held h = {.count = 0};
    Spectra g;
    Result out;
    Freedom free_to;
    double *places;
    const double *heights;
    if (!PyArg_ParseTuple(args, "OOO(ddd)(iidd)OOOOO", o, o + 1, o + 2, &g.first, &g.step, &g.distance,
                          &free_to.rigid, &free_to.rounds, &free_to.reach, &free_to.step, o + 3, o + 4, o + 5,
                          o + 6, o + 7))
        return NULL;
    if (!take_spectra(&h, o, &g))
        return finished(&h);
    if (!(heights = take(&h, o[4], -1, 0)))
        return finished(&h);
    const int64_t count = taken(&h) / 8;
    if (count < 1 || count > MOST) {
        refused("too few points, or too many");
        return finished(&h);
    }
    if (!(places = take(&h, o[3], 16 * count, 1)) || !(out.left = take(&h, o[5], 8, 1)) ||
        !(out.normal = take(&h, o[6], 32 * count * count, 1)) ||
        !(out.gradient = take(&h, o[7], 16 * count, 1)))
        return finished(&h);
    const int64_t pairs = count * (count - 1) / 2;
    double *scratch = malloc((size_t)(g.views * (6 + 15 * count + 4 * pairs)) * sizeof(double));
    if (!scratch) {
        PyErr_NoMemory();
        return finished(&h);
    }
    Py_BEGIN_ALLOW_THREADS descend(&g, &free_to, places, heights, (int)count, scratch, &out);
    Py_END_ALLOW_THREADS free(scratch);
    return finished(&h);
}

static PyMethodDef methods[] = {
    {"fit", fit, METH_VARARGS,
     "fit(antenna, height, data, (first, step, distance), (rigid, rounds, reach, step), places, heights, left, "
     "normal, gradient)"},
    {NULL, NULL, 0, NULL},
};

MODULE(_points, "Compiled model of points (see tagid.tags.bodies.points).", methods, 2)
