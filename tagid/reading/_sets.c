/* Log Bayes factors of sets of reflectors from tables of inner products.
 *
 * `tagid.reading.search` holds the formula, and does the same with numpy where no compiler was present.
 * Only the stable ABI and the buffer protocol are used.
 */
#include "../tags/_buffers.h"
#include <math.h>
#include <stdlib.h>

#define MOST 8 /* columns of a reflector, at most */
#define UNIT 4 /* frequencies of a vector */
#define BELOW(p, q) ((p) * ((p) + 1) / 2 + (q)) /* of a lower triangle */

typedef double Four __attribute__((vector_size(8 * UNIT), aligned(16)));

/* Real and imaginary parts lie apart, frequencies last: (.., 2, F), F a multiple of UNIT. */
typedef struct {
    const double *own;   /* (B, T, 2, F) a block with itself, T = P (P + 1) / 2 */
    const double *pair;  /* (B, B, V, T, 2, F) block a at 0 with block b at a shift, and b with a */
    const double *held;  /* (B V, P, J, 2, F) with what is projected out */
    const double *right; /* (B V, P, 2, F) with the data */
    const double *power; /* (P, F) prior variances */
    const int32_t *sets; /* (H, K) block * V + shift */
    int64_t f, b, v, p, j, h, k;
    double *out; /* (H,) */
} Sets;

#define FOUR(from) (*(const Four *)(from))

/* log of N(b; 0, M) over N(b; 0, 1 / power) of a set, P known to the compiler. */
INLINE double score_of(const Sets *g, const int32_t *set, const int64_t P)
{
    const int64_t F = g->f, T = P * (P + 1) / 2, J = g->j, K = g->k;
    const int32_t V = (int32_t)g->v;
    const Four zero = {0};
    Four gain = zero, volume = zero + 1.0;
    for (int64_t f = 0; f < F; f += UNIT) {
        Four mr[MOST * (MOST + 1) / 2], mi[MOST * (MOST + 1) / 2], sr[MOST], si[MOST], inverse[MOST];
        for (int64_t t = 0; t < T; t++)
            mr[t] = mi[t] = zero;
        for (int64_t p = 0; p < P; p++)
            sr[p] = si[p] = zero;
        for (int64_t a = 0; a < K; a++) {
            const int32_t ba = set[a] / V, va = set[a] - ba * V;
            const double *right = g->right + set[a] * P * 2 * F + f, *own = g->own + ba * T * 2 * F + f;
            for (int64_t p = 0; p < P; p++)
                sr[p] += FOUR(right + 2 * p * F), si[p] += FOUR(right + (2 * p + 1) * F);
            for (int64_t t = 0; t < T; t++)
                mr[t] += FOUR(own + 2 * t * F), mi[t] += FOUR(own + (2 * t + 1) * F);
            for (int64_t c = 0; c < a; c++) {
                const int32_t bc = set[c] / V, vc = set[c] - bc * V, shift = va >= vc ? va - vc : va - vc + V;
                const double *pair = g->pair + ((bc * g->b + ba) * V + shift) * T * 2 * F + f;
                for (int64_t t = 0; t < T; t++)
                    mr[t] += FOUR(pair + 2 * t * F), mi[t] += FOUR(pair + (2 * t + 1) * F);
            }
        }
        for (int64_t j = 0; j < J; j++) {
            Four ur[MOST], ui[MOST];
            for (int64_t p = 0; p < P; p++) {
                ur[p] = ui[p] = zero;
                for (int64_t a = 0; a < K; a++) {
                    const double *held = g->held + ((set[a] * P + p) * J + j) * 2 * F + f;
                    ur[p] += FOUR(held), ui[p] += FOUR(held + F);
                }
                for (int64_t q = 0; q <= p; q++) {
                    mr[BELOW(p, q)] -= ur[p] * ur[q] + ui[p] * ui[q];
                    mi[BELOW(p, q)] -= ur[p] * ui[q] - ui[p] * ur[q];
                }
            }
        }
        for (int64_t p = 0; p < P; p++) {
            const Four power = FOUR(g->power + p * F + f);
            Four d = mr[BELOW(p, p)] + 1.0 / power;
            for (int64_t q = 0; q < p; q++) {
                Four re = mr[BELOW(p, q)], im = mi[BELOW(p, q)];
                for (int64_t m = 0; m < q; m++) { /* what is left of row p, and rows over their pivots */
                    const Four ar = mr[BELOW(p, m)], ai = mi[BELOW(p, m)];
                    const Four br = mr[BELOW(q, m)] * inverse[m], bi = mi[BELOW(q, m)] * inverse[m];
                    re -= ar * br + ai * bi;
                    im -= ai * br - ar * bi;
                }
                mr[BELOW(p, q)] = re, mi[BELOW(p, q)] = im;
                const Four lr = re * inverse[q], li = im * inverse[q];
                d -= re * lr + im * li;
                sr[p] -= lr * sr[q] - li * si[q];
                si[p] -= lr * si[q] + li * sr[q];
            }
            for (int l = 0; l < UNIT; l++)
                d[l] = d[l] > 1e-300 ? d[l] : 1e-300;
            inverse[p] = 1.0 / d;
            gain += (sr[p] * sr[p] + si[p] * si[p]) * inverse[p];
            volume *= d * power;
        }
    }
    double sum = 0.0;
    for (int l = 0; l < UNIT; l++)
        sum += gain[l] - log(volume[l]);
    return sum;
}

WIDE static void score(const Sets *g)
{
    for (int64_t h = 0; h < g->h; h++) {
        const int32_t *set = g->sets + h * g->k;
        switch (g->p) {
        case 1: g->out[h] = score_of(g, set, 1); break;
        case 2: g->out[h] = score_of(g, set, 2); break;
        case 3: g->out[h] = score_of(g, set, 3); break;
        case 4: g->out[h] = score_of(g, set, 4); break;
        case 5: g->out[h] = score_of(g, set, 5); break;
        default: g->out[h] = score_of(g, set, g->p);
        }
    }
}

static PyObject *scores(PyObject *self, PyObject *args)
{
    (void)self;
    PyObject *own, *pair, *held, *right, *power, *sets, *out;
    Sets g;
    long long f, b, v, p, j, h, k;
    if (!PyArg_ParseTuple(args, "OOOOOOOLLLLLLL", &own, &pair, &held, &right, &power, &sets, &out, &f, &b, &v,
                          &p, &j, &h, &k))
        return NULL;
    if (p < 1 || p > MOST || f < 1 || f % UNIT || b < 1 || v < 1 || j < 0 || k < 1) {
        refused("sizes of the tables");
        return NULL;
    }
    g.f = f, g.b = b, g.v = v, g.p = p, g.j = j, g.h = h, g.k = k;
    Held buffers = {0};
    const int64_t triangle = p * (p + 1) / 2;
    g.own = take(&buffers, own, 16 * b * triangle * f, 0);
    g.pair = g.own ? take(&buffers, pair, k > 1 ? 16 * b * b * v * triangle * f : 0, 0) : NULL;
    g.held = g.pair ? take(&buffers, held, 16 * b * v * p * j * f, 0) : NULL;
    g.right = g.held ? take(&buffers, right, 16 * b * v * p * f, 0) : NULL;
    g.power = g.right ? take(&buffers, power, 8 * p * f, 0) : NULL;
    g.sets = g.power ? take(&buffers, sets, 4 * h * k, 0) : NULL;
    g.out = g.sets ? take(&buffers, out, 8 * h, 1) : NULL;
    if (!g.out)
        return finished(&buffers);
    for (int64_t i = 0; i < h * k; i++)
        if (g.sets[i] < 0 || g.sets[i] >= b * v) {
            refused("a set names a place beyond the table");
            return finished(&buffers);
        }
    Py_BEGIN_ALLOW_THREADS score(&g);
    Py_END_ALLOW_THREADS return finished(&buffers);
}

/* Fourier transforms of V rows of lanes, in two steps of A and V / A, by exp(-2 pi j i / V). */
typedef struct {
    int64_t v, a;
    const double *turn; /* (V, 2) */
    Four *in, *mid, *out; /* (V, 2) */
} Fourier;

INLINE void sum_of(const Fourier *w, const Four *in, int64_t count, int64_t stride, int64_t at, int64_t step,
                   Four *out)
{
    Four re = {0}, im = {0};
    for (int64_t i = 0; i < count; i++, in += 2 * stride) {
        const double c = w->turn[2 * at], s = w->turn[2 * at + 1];
        re += in[0] * c - in[1] * s, im += in[0] * s + in[1] * c;
        at += step;
        at -= at >= w->v ? w->v : 0;
    }
    out[0] = re, out[1] = im;
}

INLINE void transform(const Fourier *w)
{
    const int64_t V = w->v, A = w->a, B = V / A;
    for (int64_t j = 0; j < B; j++)
        for (int64_t m = 0; m < A; m++)
            sum_of(w, w->in + 2 * j, A, B, m * j, m * B, w->mid + 2 * (j * A + m));
    for (int64_t m = 0; m < A; m++)
        for (int64_t n = 0; n < B; n++)
            sum_of(w, w->mid + 2 * m, B, A, 0, n * A, w->out + 2 * (m + A * n));
}

/* Columns and vectors are planes (.., V, 2, F). */
typedef struct {
    const double *columns, *vectors; /* (B, P, ..), (C, J, ..) */
    double *out; /* (C, B V, P, J, 2, F), or (B, B, V, T, 2, F) */
    int64_t f, b, p, c, j;
    Fourier w;
} Turns;

/* <vector, column shifted by n views> = sum over m of conj(vector) column exp(-2 pi j m n / V). */
WIDE static void all_against(const Turns *g)
{
    const int64_t F = g->f, V = g->w.v, P = g->p, J = g->j, row = 2 * V * F;
    for (int64_t c = 0; c < g->c; c++)
        for (int64_t b = 0; b < g->b; b++)
            for (int64_t i = 0; i < P * J; i++) {
                const double *x = g->columns + (b * P + i / J) * row, *y = g->vectors + (c * J + i % J) * row;
                for (int64_t f = 0; f < F; f += UNIT) {
                    for (int64_t m = 0; m < V; m++) {
                        const Four xr = FOUR(x + 2 * m * F + f), xi = FOUR(x + 2 * m * F + F + f);
                        const Four yr = FOUR(y + 2 * m * F + f), yi = FOUR(y + 2 * m * F + F + f);
                        g->w.in[2 * m] = xr * yr + xi * yi, g->w.in[2 * m + 1] = xi * yr - xr * yi;
                    }
                    transform(&g->w);
                    double *to = g->out + ((c * g->b + b) * V * P * J + i) * 2 * F + f;
                    for (int64_t n = 0; n < V; n++, to += P * J * 2 * F)
                        *(Four *)to = g->w.out[2 * n], *(Four *)(to + F) = g->w.out[2 * n + 1];
                }
            }
}

/* A block with another turned by n views, and the other with the first: the transform of what is reversed. */
WIDE static void all_pairs(const Turns *g)
{
    const int64_t F = g->f, V = g->w.v, P = g->p, T = P * (P + 1) / 2, row = 2 * V * F;
    for (int64_t a = 0; a < g->b; a++)
        for (int64_t b = a; b < g->b; b++)
            for (int64_t p = 0; p < P; p++)
                for (int64_t q = 0; q <= p; q++)
                    for (int64_t f = 0; f < F; f += UNIT) {
                        const double *ap = g->columns + (a * P + p) * row + f, *aq = ap + (q - p) * row;
                        const double *bp = g->columns + (b * P + p) * row + f, *bq = bp + (q - p) * row;
                        for (int64_t m = 0; m < V; m++) {
                            const int64_t i = 2 * m * F, k = 2 * (m ? V - m : 0) * F;
                            g->w.in[2 * m] = FOUR(ap + i) * FOUR(bq + i) + FOUR(ap + i + F) * FOUR(bq + i + F) +
                                             FOUR(bp + k) * FOUR(aq + k) + FOUR(bp + k + F) * FOUR(aq + k + F);
                            g->w.in[2 * m + 1] =
                                FOUR(ap + i) * FOUR(bq + i + F) - FOUR(ap + i + F) * FOUR(bq + i) +
                                FOUR(bp + k) * FOUR(aq + k + F) - FOUR(bp + k + F) * FOUR(aq + k);
                        }
                        transform(&g->w);
                        for (int64_t n = 0; n < V; n++) {
                            const int64_t t = (BELOW(p, q)) * 2 * F + f, back = n ? V - n : 0;
                            double *to = g->out + ((a * g->b + b) * V + n) * T * 2 * F + t;
                            double *other = g->out + ((b * g->b + a) * V + back) * T * 2 * F + t;
                            *(Four *)to = *(Four *)other = g->w.out[2 * n];
                            *(Four *)(to + F) = *(Four *)(other + F) = g->w.out[2 * n + 1];
                        }
                    }
}

static PyObject *turned(PyObject *args, int pairs)
{
    PyObject *columns, *vectors = NULL, *turn, *out;
    Turns g = {0};
    Held buffers = {0};
    long long f, b, p, c = 0, j = 0;
    if (!(pairs ? PyArg_ParseTuple(args, "OOOLLL", &columns, &turn, &out, &f, &b, &p)
                : PyArg_ParseTuple(args, "OOOOLLLLL", &columns, &vectors, &turn, &out, &f, &b, &p, &c, &j)))
        return NULL;
    g.f = f, g.b = b, g.p = p, g.c = c, g.j = j;
    if (f < 1 || f % UNIT || b < 1 || p < 1 || c < 0 || j < 0 || !(g.w.turn = take(&buffers, turn, -1, 0)) ||
        (g.w.v = taken(&buffers) / 16) < 1) {
        refused("sizes of the tables");
        return finished(&buffers);
    }
    const int64_t v = g.w.v, results = pairs ? b * b * v * p * (p + 1) / 2 : c * b * v * p * j;
    for (int64_t a = 1; a * a <= v; a++)
        g.w.a = v % a ? g.w.a : a;
    g.columns = take(&buffers, columns, 16 * b * p * v * f, 0);
    g.vectors = g.columns && !pairs ? take(&buffers, vectors, 16 * c * j * v * f, 0) : g.columns;
    g.out = g.vectors ? take(&buffers, out, 16 * results * f, 1) : NULL;
    if (!g.out)
        return finished(&buffers);
    g.w.in = malloc((size_t)(6 * v) * sizeof(Four));
    if (!g.w.in) {
        release(&buffers);
        return PyErr_NoMemory();
    }
    g.w.mid = g.w.in + 2 * v, g.w.out = g.w.mid + 2 * v;
    Py_BEGIN_ALLOW_THREADS if (pairs) all_pairs(&g);
    else all_against(&g);
    Py_END_ALLOW_THREADS free(g.w.in);
    return finished(&buffers);
}

static PyObject *pairs(PyObject *self, PyObject *args)
{
    (void)self;
    return turned(args, 1);
}

static PyObject *against(PyObject *self, PyObject *args)
{
    (void)self;
    return turned(args, 0);
}

static PyMethodDef methods[] = {
    {"pairs", pairs, METH_VARARGS, "pairs(columns, turn, out, f, b, p): the table of `scores`, on an even turn"},
    {"against", against, METH_VARARGS,
     "against(columns, vectors, turn, out, f, b, p, c, j): products of vectors with all turns"},
    {"scores", scores, METH_VARARGS, "scores(own, pair, held, right, power, sets, out, f, b, v, p, j, h, k)"},
    {NULL, NULL, 0, NULL},
};

MODULE(_sets, "Log Bayes factors of sets of reflectors.", methods, 3)
