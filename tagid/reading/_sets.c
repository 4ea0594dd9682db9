/* Log Bayes factors of sets of reflectors from tables of inner products.
 *
 * `tagid.reading.search` holds the formula, and does the same with numpy where no compiler was present.
 * Only the stable ABI and the buffer protocol are used.
 */
#include "../tags/_buffers.h"
#include <math.h>
#include <stdlib.h>

#define MOST 8 /* columns of a reflector, at most */

typedef struct {
    const double *gram;  /* (F, B, B, V, P, P) complex: block a at 0 with block b at a shift */
    const double *held;  /* (F, B, V, P, J) complex: with what is projected out */
    const double *right; /* (F, B, V, P) complex: with the data */
    const double *power; /* (F, P) prior variances */
    const int32_t *sets; /* (H, K) block * V + shift */
    int64_t f, b, v, p, j, h, k;
    double *out; /* (H,) */
} Sets;

/* log of N(b; 0, M) over N(b; 0, I) of one frequency: the lower triangle of M is overwritten. */
INLINE double gain(int64_t n, double *restrict mr, double *restrict mi, double *restrict sr, double *restrict si)
{
    double sum = 0.0;
    for (int64_t p = 0; p < n; p++) {
        for (int64_t q = 0; q < p; q++) {
            double re = mr[p * MOST + q], im = mi[p * MOST + q];
            for (int64_t m = 0; m < q; m++) {
                const double ar = mr[p * MOST + m], ai = mi[p * MOST + m];
                const double br = mr[q * MOST + m], bi = mi[q * MOST + m];
                re -= ar * br + ai * bi;
                im -= ai * br - ar * bi;
            }
            mr[p * MOST + q] = re / mr[q * MOST + q];
            mi[p * MOST + q] = im / mr[q * MOST + q];
        }
        double d = mr[p * MOST + p], re = sr[p], im = si[p];
        for (int64_t m = 0; m < p; m++) {
            const double ar = mr[p * MOST + m], ai = mi[p * MOST + m];
            d -= ar * ar + ai * ai;
            re -= ar * sr[m] - ai * si[m];
            im -= ar * si[m] + ai * sr[m];
        }
        d = d > 1e-300 ? d : 1e-300;
        mr[p * MOST + p] = sqrt(d);
        sr[p] = re / mr[p * MOST + p];
        si[p] = im / mr[p * MOST + p];
        sum += sr[p] * sr[p] + si[p] * si[p] - log(d);
    }
    return sum;
}

WIDE static void score(const Sets *g)
{
    const int64_t P = g->p, V = g->v, B = g->b, J = g->j;
    for (int64_t h = 0; h < g->h; h++) {
        const int32_t *set = g->sets + h * g->k;
        double sum = 0.0;
        for (int64_t f = 0; f < g->f; f++) {
            double mr[MOST * MOST] = {0}, mi[MOST * MOST] = {0}, sr[MOST] = {0}, si[MOST] = {0};
            for (int64_t a = 0; a < g->k; a++) {
                const int64_t ba = set[a] / V, va = set[a] % V;
                const double *right = g->right + 2 * (((f * B + ba) * V + va) * P);
                for (int64_t p = 0; p < P; p++) {
                    sr[p] += right[2 * p];
                    si[p] += right[2 * p + 1];
                }
                for (int64_t c = 0; c < g->k; c++) {
                    const int64_t bc = set[c] / V, vc = set[c] % V, shift = vc >= va ? vc - va : vc - va + V;
                    const double *gram = g->gram + 2 * ((((f * B + ba) * B + bc) * V + shift) * P * P);
                    for (int64_t p = 0; p < P; p++)
                        for (int64_t q = 0; q <= p; q++) {
                            mr[p * MOST + q] += gram[2 * (p * P + q)];
                            mi[p * MOST + q] += gram[2 * (p * P + q) + 1];
                        }
                }
            }
            for (int64_t j = 0; j < J; j++) {
                double ur[MOST] = {0}, ui[MOST] = {0};
                for (int64_t a = 0; a < g->k; a++) {
                    const double *held = g->held + 2 * (((f * B * V) + set[a]) * P * J);
                    for (int64_t p = 0; p < P; p++) {
                        ur[p] += held[2 * (p * J + j)];
                        ui[p] += held[2 * (p * J + j) + 1];
                    }
                }
                for (int64_t p = 0; p < P; p++)
                    for (int64_t q = 0; q <= p; q++) {
                        mr[p * MOST + q] -= ur[p] * ur[q] + ui[p] * ui[q];
                        mi[p * MOST + q] -= ur[p] * ui[q] - ui[p] * ur[q];
                    }
            }
            const double *power = g->power + f * P;
            for (int64_t p = 0; p < P; p++) {
                mr[p * MOST + p] += 1.0 / power[p];
                sum -= log(power[p]);
            }
            sum += gain(P, mr, mi, sr, si);
        }
        g->out[h] = sum;
    }
}

static PyObject *scores(PyObject *self, PyObject *args)
{
    (void)self;
    PyObject *gram, *held, *right, *power, *sets, *out;
    Sets g;
    long long f, b, v, p, j, h, k;
    if (!PyArg_ParseTuple(args, "OOOOOOLLLLLLL", &gram, &held, &right, &power, &sets, &out, &f, &b, &v, &p, &j, &h,
                          &k))
        return NULL;
    if (p < 1 || p > MOST || f < 1 || b < 1 || v < 1 || j < 0 || k < 1) {
        refused("sizes of the tables");
        return NULL;
    }
    g.f = f, g.b = b, g.v = v, g.p = p, g.j = j, g.h = h, g.k = k;
    Held held_buffers = {0};
    g.gram = take(&held_buffers, gram, 16 * f * b * b * v * p * p, 0);
    g.held = g.gram ? take(&held_buffers, held, 16 * f * b * v * p * j, 0) : NULL;
    g.right = g.held ? take(&held_buffers, right, 16 * f * b * v * p, 0) : NULL;
    g.power = g.right ? take(&held_buffers, power, 8 * f * p, 0) : NULL;
    g.sets = g.power ? take(&held_buffers, sets, 4 * h * k, 0) : NULL;
    g.out = g.sets ? take(&held_buffers, out, 8 * h, 1) : NULL;
    if (!g.out)
        return finished(&held_buffers);
    for (int64_t i = 0; i < h * k; i++)
        if (g.sets[i] < 0 || g.sets[i] >= b * v) {
            refused("a set names a place beyond the table");
            return finished(&held_buffers);
        }
    Py_BEGIN_ALLOW_THREADS score(&g);
    Py_END_ALLOW_THREADS return finished(&held_buffers);
}

static PyMethodDef methods[] = {
    {"scores", scores, METH_VARARGS, "scores(gram, held, right, power, sets, out, f, b, v, p, j, h, k)"},
    {NULL, NULL, 0, NULL},
};

MODULE(_sets, "Log Bayes factors of sets of reflectors.", methods, 1)
