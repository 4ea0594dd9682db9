/* The two inner loops of imaging: read range profiles at every pixel's distance, and write them back.
 *
 * They are exact transposes of each other: both walk the same distances and use the same two weights. Numpy
 * would need the distances in memory, which is what makes it slow; here they live in registers.
 *
 * gather:  out[p]    += sum_v (1 - f) row_v[i] + f row_v[i + 1],        i + f = d_vp - start
 * scatter: row_v[i]  += (1 - f) x_p,  row_v[i + 1] += f x_p             (row index clipped to the row)
 *
 * d_vp = |antenna_v - point_p|, or with a second antenna (|antenna_v - point_p| + |second_v - point_p|) / 2.
 * Points lie in the plane z = 0 unless heights are given. All lengths are in units of the row's range step. Only the stable ABI and the buffer protocol are used.
 */
#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030b0000
#include <Python.h>
#include "../_wide.h" /* after a header of the C library, which names it */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#if !defined(_WIN32)
#include <pthread.h>
#define HAVE_THREADS 1
#endif

#define BLOCK 512
#define GROUP 32 /* views whose rows stay in the cache while all points are served */
#define MAX_THREADS 64

typedef struct {
    const float *antenna; /* (views, 3) */
    const float *second;  /* (views, 3), or NULL */
    const float *x, *y;   /* (points,) */
    const float *z;       /* (points,), or NULL */
    int64_t views, points, bins;
    float start;
} Geometry;

/* Bin and weight of a range in steps. */
INLINE void split(float t, float last, float before, int32_t *bin, float *f)
{
    /* As the processor's minimum and maximum do, so that the loops over points use them. */
    t = t > 0.0f ? t : 0.0f;
    t = t < last ? t : last;
    const int32_t left = (int32_t)t, most = (int32_t)before;
    const int32_t here = left < most ? left : most;
    *bin = here;
    *f = t - (float)here;
}

/* Bin and weight of n points of the plane seen from one antenna. */
INLINE void locate_plane(const Geometry *g, int64_t view, int64_t at, int n, int32_t *bin, float *f)
{
    const float *restrict x = g->x + at, *restrict y = g->y + at, *antenna = g->antenna + 3 * view;
    const float ax = antenna[0], ay = antenna[1], az2 = antenna[2] * antenna[2];
    const float last = (float)(g->bins - 1), before = (float)(g->bins - 2), start = g->start;
    for (int k = 0; k < n; k++) {
        const float dx = x[k] - ax, dy = y[k] - ay;
        split(sqrtf(dx * dx + dy * dy + az2) - start, last, before, bin + k, f + k);
    }
}

/* The same for points at heights of their own. */
INLINE void locate_space(const Geometry *g, int64_t view, int64_t at, int n, int32_t *bin, float *f)
{
    const float *restrict x = g->x + at, *restrict y = g->y + at, *restrict z = g->z + at;
    const float *antenna = g->antenna + 3 * view;
    const float ax = antenna[0], ay = antenna[1], az = antenna[2];
    const float last = (float)(g->bins - 1), before = (float)(g->bins - 2), start = g->start;
    for (int k = 0; k < n; k++) {
        const float dx = x[k] - ax, dy = y[k] - ay, dz = z[k] - az;
        split(sqrtf(dx * dx + dy * dy + dz * dz) - start, last, before, bin + k, f + k);
    }
}

/* The same with two antennas. */
INLINE void locate_two(const Geometry *g, int64_t view, int64_t at, int n, int32_t *bin, float *f)
{
    const float *restrict x = g->x + at, *restrict y = g->y + at, *a = g->antenna + 3 * view;
    const float *b = g->second + 3 * view, *restrict z = g->z ? g->z + at : NULL;
    const float last = (float)(g->bins - 1), before = (float)(g->bins - 2), start = g->start;
    if (!z) {
        const float az2 = a[2] * a[2], bz2 = b[2] * b[2];
        for (int k = 0; k < n; k++) {
            const float ax = x[k] - a[0], ay = y[k] - a[1], bx = x[k] - b[0], by = y[k] - b[1];
            const float both = sqrtf(ax * ax + ay * ay + az2) + sqrtf(bx * bx + by * by + bz2);
            split(0.5f * both - start, last, before, bin + k, f + k);
        }
        return;
    }
    for (int k = 0; k < n; k++) {
        const float ax = x[k] - a[0], ay = y[k] - a[1], az = z[k] - a[2];
        const float bx = x[k] - b[0], by = y[k] - b[1], bz = z[k] - b[2];
        const float both = sqrtf(ax * ax + ay * ay + az * az) + sqrtf(bx * bx + by * by + bz * bz);
        split(0.5f * both - start, last, before, bin + k, f + k);
    }
}

INLINE void locate(const Geometry *g, int64_t view, int64_t at, int n, int32_t *bin, float *f)
{
    if (g->second)
        locate_two(g, view, at, n, bin, f);
    else if (g->z)
        locate_space(g, view, at, n, bin, f);
    else
        locate_plane(g, view, at, n, bin, f);
}

/* Points [from, to): out (points, 2) of rows (views, bins, 2). */
WIDE static void gather_points(const Geometry *g, const float *rows, float *out, int64_t from, int64_t to)
{
    int32_t bin[BLOCK];
    float f[BLOCK];
    float sum[4 * BLOCK];
    memset(out + 2 * from, 0, (size_t)(to - from) * 2 * sizeof(float));
    for (int64_t first = 0; first < g->views; first += GROUP) {
        const int64_t end = first + GROUP < g->views ? first + GROUP : g->views;
        for (int64_t at = from; at < to; at += BLOCK) {
            const int n = (int)(to - at < BLOCK ? to - at : BLOCK);
            memset(sum, 0, sizeof sum);
            for (int64_t v = first; v < end; v++) {
                const float *restrict row = rows + 2 * v * g->bins;
                locate(g, v, at, n, bin, f);
                for (int k = 0; k < n; k++) {
                    const float *a = row + 2 * (int64_t)bin[k];
                    float *restrict s = sum + 4 * k;
                    const float w = f[k], u = 1.0f - w;
                    s[0] += u * a[0];
                    s[1] += u * a[1];
                    s[2] += w * a[2];
                    s[3] += w * a[3];
                }
            }
            for (int k = 0; k < n; k++) {
                out[2 * (at + k)] += sum[4 * k] + sum[4 * k + 2];
                out[2 * (at + k) + 1] += sum[4 * k + 1] + sum[4 * k + 3];
            }
        }
    }
}

/* Views [from, to): rows (views, bins, 2) of x (points, 2). `pair` is scratch of 4 * bins floats: every bin
 * keeps what went to it and to its right neighbour apart, so that successive writes never half overlap. */
WIDE static void scatter_views(const Geometry *g, const float *x, float *rows, float *pair, int64_t from, int64_t to)
{
    int32_t bin[BLOCK];
    float f[BLOCK];
    for (int64_t v = from; v < to; v++) {
        float *restrict row = rows + 2 * v * g->bins;
        memset(pair, 0, (size_t)g->bins * 4 * sizeof(float));
        for (int64_t at = 0; at < g->points; at += BLOCK) {
            const int n = (int)(g->points - at < BLOCK ? g->points - at : BLOCK);
            const float *restrict from_x = x + 2 * at;
            locate(g, v, at, n, bin, f);
            for (int k = 0; k < n; k++) {
                float *restrict s = pair + 4 * (int64_t)bin[k];
                const float *a = from_x + 2 * k;
                const float w = f[k], u = 1.0f - w;
                s[0] += u * a[0];
                s[1] += u * a[1];
                s[2] += w * a[0];
                s[3] += w * a[1];
            }
        }
        row[0] = pair[0];
        row[1] = pair[1];
        for (int64_t b = 1; b < g->bins; b++) {
            row[2 * b] = pair[4 * b] + pair[4 * b - 2];
            row[2 * b + 1] = pair[4 * b + 1] + pair[4 * b - 1];
        }
    }
}

typedef struct {
    const Geometry *g;
    const float *in;
    float *out, *scratch;
    int64_t room; /* floats of scratch for a thread */
    int64_t from, to;
    int scatter;
} Job;

static void *work(void *argument)
{
    Job *job = argument;
    if (job->scatter)
        scatter_views(job->g, job->in, job->out, job->scratch, job->from, job->to);
    else
        gather_points(job->g, job->in, job->out, job->from, job->to);
    return NULL;
}

/* Splits `count` points or views over the threads; the caller's own thread takes the first part. */
static void run(Job *first, int64_t count, int threads)
{
    Job jobs[MAX_THREADS];
    for (int t = 0; t < threads; t++) {
        jobs[t] = *first;
        jobs[t].from = count * t / threads;
        jobs[t].to = count * (t + 1) / threads;
        if (first->scratch)
            jobs[t].scratch = first->scratch + (int64_t)t * first->room;
    }
#ifdef HAVE_THREADS
    pthread_t ids[MAX_THREADS];
    int started[MAX_THREADS] = {0};
    for (int t = 1; t < threads; t++)
        started[t] = pthread_create(&ids[t], NULL, work, &jobs[t]) == 0;
    work(&jobs[0]);
    for (int t = 1; t < threads; t++) {
        if (started[t])
            pthread_join(ids[t], NULL);
        else
            work(&jobs[t]);
    }
#else
    for (int t = 0; t < threads; t++)
        work(&jobs[t]);
#endif
}

static PyObject *apply(PyObject *args, int scatter)
{
    Py_buffer antenna, second, x, y, z, in, out;
    Py_ssize_t bins;
    float start;
    int threads;
    if (!PyArg_ParseTuple(args, "y*y*y*y*y*y*w*nfi", &antenna, &second, &x, &y, &z, &in, &out, &bins, &start, &threads))
        return NULL;
    /* An empty buffer of second antennas or of heights stands for none. */
    Geometry g = {antenna.buf, second.len ? second.buf : NULL, x.buf, y.buf, z.len ? z.buf : NULL,
                  antenna.len / 12, x.len / 4, bins, start};
    const Py_buffer *rows = scatter ? &out : &in, *image = scatter ? &in : &out;
    PyObject *result = NULL;
    float *scratch = NULL;
    if (bins < 2 || bins > (1 << 24) || antenna.len != g.views * 12 || x.len != g.points * 4 || y.len != x.len ||
        (second.len && second.len != antenna.len) || (z.len && z.len != x.len) ||
        image->len / 8 != g.points || image->len != g.points * 8 || rows->len / 8 / bins != g.views || rows->len != g.views * bins * 8) {
        PyErr_SetString(PyExc_ValueError, "buffers of antennas, points, rows and image do not fit together");
        goto done;
    }
    const int64_t count = scatter ? g.views : g.points;
    if (threads > MAX_THREADS)
        threads = MAX_THREADS;
    if (threads > count)
        threads = (int)count;
    if (threads < 1)
        threads = 1;
    const int64_t room = scatter ? 4 * bins : 0;
    if (room && !(scratch = malloc((size_t)threads * (size_t)room * sizeof(float)))) {
        PyErr_NoMemory();
        goto done;
    }
    Job job = {&g, in.buf, out.buf, scratch, room, 0, 0, scatter};
    Py_BEGIN_ALLOW_THREADS
    run(&job, count, threads);
    Py_END_ALLOW_THREADS
    free(scratch);
    Py_INCREF(Py_None);
    result = Py_None;
done:
    PyBuffer_Release(&antenna);
    PyBuffer_Release(&second);
    PyBuffer_Release(&x);
    PyBuffer_Release(&y);
    PyBuffer_Release(&z);
    PyBuffer_Release(&in);
    PyBuffer_Release(&out);
    return result;
}

static PyObject *gather(PyObject *self, PyObject *args) { (void)self; return apply(args, 0); }
static PyObject *scatter(PyObject *self, PyObject *args) { (void)self; return apply(args, 1); }

static PyMethodDef methods[] = {
    {"gather", gather, METH_VARARGS, "gather(antenna, second, x, y, z, rows, out, bins, start, threads)"},
    {"scatter", scatter, METH_VARARGS, "scatter(antenna, second, x, y, z, image, out, bins, start, threads)"},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef module = {
    PyModuleDef_HEAD_INIT, "_kernel", "Compiled inner loops of imaging (see tagid.imaging.kernel).", -1, methods,
    NULL, NULL, NULL, NULL,
};

PyMODINIT_FUNC PyInit__kernel(void)
{
    PyObject *made = PyModule_Create(&module);
    /* `tagid.loops` uses no build of other arguments. */
    if (made && PyModule_AddIntConstant(made, "ARGUMENTS", 4) < 0) {
        Py_DECREF(made);
        return NULL;
    }
    return made;
}
