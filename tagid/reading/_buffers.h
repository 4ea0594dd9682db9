/* Buffers that a call from Python hands over, with the sizes that they must have. */
#ifndef TAGID_BUFFERS_H
#define TAGID_BUFFERS_H
#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030b0000
#include <Python.h>
#include "../_wide.h" /* after a header of the C library, which names it */
#include <stdint.h>

typedef struct {
    Py_buffer held[16];
    int count;
} Held;

static inline void release(Held *h)
{
    while (h->count > 0)
        PyBuffer_Release(&h->held[--h->count]);
}

/* A contiguous buffer of so many bytes (any, where negative); NULL with an error set. */
static inline void *take(Held *h, PyObject *from, int64_t bytes, int writable)
{
    Py_buffer *b = &h->held[h->count];
    if (PyObject_GetBuffer(from, b, writable ? PyBUF_CONTIG : PyBUF_CONTIG_RO) < 0)
        return NULL;
    h->count++;
    if (bytes >= 0 && b->len != bytes) {
        PyErr_Format(PyExc_ValueError, "a buffer of %zd bytes where %lld are expected", b->len,
                     (long long)bytes);
        return NULL;
    }
    return b->buf;
}

/* Bytes of the buffer taken last. */
static inline int64_t taken(const Held *h) { return h->held[h->count - 1].len; }

static inline int refused(const char *why)
{
    PyErr_SetString(PyExc_ValueError, why);
    return 0;
}

/* Room for so many doubles, from where a layout has come to. */
static inline double *room(double **at, int64_t count)
{
    double *here = *at;
    *at += (count + 3) / 4 * 4;
    return here;
}

/* The end of a call for which there is no room. */
static inline PyObject *no_memory(Held *h)
{
    release(h);
    return PyErr_NoMemory();
}

/* The end of every other call: None, or the error that is set. */
static inline PyObject *finished(Held *h)
{
    release(h);
    return PyErr_Occurred() ? NULL : Py_BuildValue("");
}

/* Defines a method by what it returns for `args`. */
#define METHOD(name, result)                                                                                 \
    static PyObject *name(PyObject *self, PyObject *args)                                                    \
    {                                                                                                        \
        (void)self;                                                                                          \
        return result;                                                                                       \
    }

/* Defines a module of these methods. `ARGUMENTS` counts the changes of their arguments: Python uses no build
 * of others. */
#define MODULE(name, about, methods, arguments)                                                              \
    static struct PyModuleDef module = {                                                                     \
        PyModuleDef_HEAD_INIT, #name, about, -1, methods, NULL, NULL, NULL, NULL,                            \
    };                                                                                                       \
    PyMODINIT_FUNC PyInit_##name(void)                                                                       \
    {                                                                                                        \
        PyObject *made = PyModule_Create(&module);                                                           \
        if (made && PyModule_AddIntConstant(made, "ARGUMENTS", arguments) < 0) {                             \
            Py_DECREF(made);                                                                                 \
            return NULL;                                                                                     \
        }                                                                                                    \
        return made;                                                                                         \
    }
#endif
