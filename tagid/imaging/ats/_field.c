/* The inner loops of the neural field: features of pixels from those of vertices, the transpose, and Adam.
 *
 * interpolate: out[r] = sum_t weight[r][t] table[index[r][t]], t = 0 .. 3
 * accumulate:  out[index[r][t]] += weight[r][t] slope[r], its transpose
 * adam:        one update of all parameters (Kingma and Ba, ICLR 2015), epsilon relative to each tensor's largest gradient
 *
 * `tagid.imaging.ats.taps` does the same with scipy where no compiler was present. Only the stable ABI and the
 * buffer protocol are used.
 */
#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030b0000
#include <Python.h>
#include "../../_wide.h" /* after a header of the C library, which names it */
#include <math.h>
#include <stdint.h>
#include <string.h>

#define TAPS 4

/* 1 if an index is not below `vertices`. */
WIDE static int beyond(const uint32_t *index, int64_t count, uint32_t vertices)
{
    uint32_t most = 0;
    for (int64_t k = 0; k < count; k++)
        most = index[k] > most ? index[k] : most;
    return count > 0 && most >= vertices;
}

WIDE static void interpolate_rows(const uint32_t *restrict index, const float *restrict weight, const float *restrict table,
                                  float *restrict out, int64_t rows, int features)
{
    if (features == 2) { /* the default, with the pair in registers */
        for (int64_t r = 0; r < rows; r++) {
            float a = 0.0f, b = 0.0f;
            for (int t = 0; t < TAPS; t++) {
                const float *v = table + 2 * (int64_t)index[TAPS * r + t], w = weight[TAPS * r + t];
                a += w * v[0];
                b += w * v[1];
            }
            out[2 * r] = a;
            out[2 * r + 1] = b;
        }
        return;
    }
    memset(out, 0, (size_t)rows * (size_t)features * sizeof(float));
    for (int64_t r = 0; r < rows; r++)
        for (int t = 0; t < TAPS; t++) {
            const float *v = table + (int64_t)features * index[TAPS * r + t], w = weight[TAPS * r + t];
            for (int f = 0; f < features; f++)
                out[features * r + f] += w * v[f];
        }
}

WIDE static void accumulate_rows(const uint32_t *restrict index, const float *restrict weight, const float *restrict slope,
                                 float *restrict out, int64_t rows, int features)
{
    if (features == 2) {
        for (int64_t r = 0; r < rows; r++) {
            const float a = slope[2 * r], b = slope[2 * r + 1];
            for (int t = 0; t < TAPS; t++) {
                float *v = out + 2 * (int64_t)index[TAPS * r + t];
                const float w = weight[TAPS * r + t];
                v[0] += w * a;
                v[1] += w * b;
            }
        }
        return;
    }
    for (int64_t r = 0; r < rows; r++)
        for (int t = 0; t < TAPS; t++) {
            float *v = out + (int64_t)features * index[TAPS * r + t];
            const float w = weight[TAPS * r + t];
            for (int f = 0; f < features; f++)
                v[f] += w * slope[features * r + f];
        }
}

static PyObject *taps(PyObject *args, int back)
{
    Py_buffer index, weight, in, out;
    int features;
    if (!PyArg_ParseTuple(args, "y*y*y*w*i", &index, &weight, &in, &out, &features))
        return NULL;
    PyObject *result = NULL;
    const int64_t rows = index.len / (4 * TAPS);
    const Py_buffer *by_row = back ? &in : &out, *by_vertex = back ? &out : &in;
    if (features < 1 || index.len != rows * 4 * TAPS || weight.len != index.len ||
        by_row->len != rows * features * 4 || by_vertex->len % (4 * features) ||
        beyond(index.buf, rows * TAPS, (uint32_t)(by_vertex->len / (4 * features)))) {
        PyErr_SetString(PyExc_ValueError, "buffers of taps, vertices and rows do not fit together");
        goto done;
    }
    Py_BEGIN_ALLOW_THREADS
    if (back) {
        memset(out.buf, 0, (size_t)out.len);
        accumulate_rows(index.buf, weight.buf, in.buf, out.buf, rows, features);
    } else {
        interpolate_rows(index.buf, weight.buf, in.buf, out.buf, rows, features);
    }
    Py_END_ALLOW_THREADS
    Py_INCREF(Py_None);
    result = Py_None;
done:
    PyBuffer_Release(&index);
    PyBuffer_Release(&weight);
    PyBuffer_Release(&in);
    PyBuffer_Release(&out);
    return result;
}

typedef struct {
    float beta1, beta2, correction, epsilon, smallest;
} Constants;

/* One tensor of n parameters; `gradient` is scratch afterwards. */
WIDE static void update(float *restrict p, float *restrict gradient, float *restrict m, float *restrict v, int64_t n,
                        float rate, const Constants *c)
{
    const float b1 = c->beta1, b2 = c->beta2, rest1 = 1.0f - b1, rest2 = 1.0f - b2, correction = c->correction;
    for (int64_t k = 0; k < n; k++) {
        const float g = gradient[k];
        m[k] = b1 * m[k] + rest1 * g;
        v[k] = b2 * v[k] + rest2 * g * g;
        gradient[k] = sqrtf(v[k] * correction);
    }
    /* Floats that are not negative are ordered as their bits, and a largest integer is found in wide registers. */
    int32_t most = 0;
    for (int64_t k = 0; k < n; k++) {
        int32_t bits;
        memcpy(&bits, &gradient[k], sizeof bits);
        most = bits > most ? bits : most;
    }
    float largest;
    memcpy(&largest, &most, sizeof largest);
    const float added = c->epsilon * largest + c->smallest;
    for (int64_t k = 0; k < n; k++)
        p[k] -= rate * m[k] / (gradient[k] + added);
}

static PyObject *adam(PyObject *self, PyObject *args)
{
    (void)self;
    Py_buffer p, g, m, v, sizes, rates;
    Constants c;
    if (!PyArg_ParseTuple(args, "w*w*w*w*y*y*fffff", &p, &g, &m, &v, &sizes, &rates, &c.beta1, &c.beta2, &c.correction,
                          &c.epsilon, &c.smallest))
        return NULL;
    PyObject *result = NULL;
    const int64_t tensors = sizes.len / 8, *size = sizes.buf;
    int64_t total = 0;
    int fits = g.len == p.len && m.len == p.len && v.len == p.len && sizes.len == tensors * 8 && rates.len == tensors * 4;
    for (int64_t t = 0; fits && t < tensors; t++) {
        fits = size[t] >= 0 && size[t] <= p.len / 4 - total;
        total += fits ? size[t] : 0;
    }
    if (!fits || total * 4 != p.len) {
        PyErr_SetString(PyExc_ValueError, "buffers of parameters, moments and sizes do not fit together");
        goto done;
    }
    Py_BEGIN_ALLOW_THREADS
    int64_t at = 0;
    for (int64_t t = 0; t < tensors; at += size[t++])
        update((float *)p.buf + at, (float *)g.buf + at, (float *)m.buf + at, (float *)v.buf + at, size[t],
               ((const float *)rates.buf)[t], &c);
    Py_END_ALLOW_THREADS
    Py_INCREF(Py_None);
    result = Py_None;
done:
    PyBuffer_Release(&p);
    PyBuffer_Release(&g);
    PyBuffer_Release(&m);
    PyBuffer_Release(&v);
    PyBuffer_Release(&sizes);
    PyBuffer_Release(&rates);
    return result;
}

static PyObject *interpolate(PyObject *self, PyObject *args) { (void)self; return taps(args, 0); }
static PyObject *accumulate(PyObject *self, PyObject *args) { (void)self; return taps(args, 1); }

static PyMethodDef methods[] = {
    {"interpolate", interpolate, METH_VARARGS, "interpolate(index, weight, table, out, features)"},
    {"accumulate", accumulate, METH_VARARGS, "accumulate(index, weight, slope, out, features)"},
    {"adam", adam, METH_VARARGS,
     "adam(parameters, gradient, first, second, sizes, rates, beta1, beta2, correction, epsilon, smallest)"},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef module = {
    PyModuleDef_HEAD_INIT, "_field", "Compiled inner loops of the neural field (see tagid.imaging.ats.taps).", -1,
    methods, NULL, NULL, NULL, NULL,
};

PyMODINIT_FUNC PyInit__field(void)
{
    PyObject *made = PyModule_Create(&module);
    /* `tagid.loops` uses no build of other arguments. */
    if (made && PyModule_AddIntConstant(made, "ARGUMENTS", 1) < 0) {
        Py_DECREF(made);
        return NULL;
    }
    return made;
}
