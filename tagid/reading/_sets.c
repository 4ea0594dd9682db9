/* Log Bayes factors of sets of reflectors from tables of inner products, and the sets that have the largest.
 *
 * `tagid.reading.search` holds the formula, and does the same with numpy where no compiler was present.
 * Only the stable ABI and the buffer protocol are used.
 */
#include "_buffers.h"
#include <math.h>
#include <stdlib.h>
#include <string.h>

#define MOST 8    /* columns of a reflector, at most */
#define MEMBERS 5 /* reflectors of a set that is grown, at most */
#define GROWN 64  /* sets to which one more is added, at most */
#define UNIT 8    /* frequencies of a vector */
#define BELOW(p, q) ((p) * ((p) + 1) / 2 + (q)) /* of a lower triangle */

typedef float Eight __attribute__((vector_size(4 * UNIT), aligned(4)));

/* Real and imaginary parts lie apart, frequencies last: (.., 2, F), F a multiple of UNIT. */
typedef struct {
    const float *own;   /* (B, T, 2, F) a block with itself, T = P (P + 1) / 2 */
    const float *pair;  /* (B, B, V, T, 2, F) block a at 0 with block b at a shift, and b with a */
    const float *held;  /* (B V, P, J, 2, F) with what is projected out */
    const float *right; /* (B V, P, 2, F) with the data */
    const float *power; /* (P, F) prior variances */
    int64_t f, b, v, p, j, k; /* k: reflectors of a set, each of them block * V + shift */
} Sets;

#define EIGHT(from) (*(const Eight *)(from))

/* log of N(b; 0, M) over N(b; 0, 1 / power) of a set, P known to the compiler. */
INLINE double score_of(const Sets *g, const int32_t *set, const int64_t P)
{
    const int64_t F = g->f, T = P * (P + 1) / 2, J = g->j, K = g->k;
    const int32_t V = (int32_t)g->v;
    const Eight zero = {0};
    Eight gain = zero, some = zero;
    double log_volume = 0.0;
    for (int64_t f = 0; f < F; f += UNIT) {
        Eight mr[MOST * (MOST + 1) / 2], mi[MOST * (MOST + 1) / 2], sr[MOST], si[MOST], inverse[MOST];
        for (int64_t t = 0; t < T; t++)
            mr[t] = mi[t] = zero;
        for (int64_t p = 0; p < P; p++)
            sr[p] = si[p] = zero;
        for (int64_t a = 0; a < K; a++) {
            const int32_t ba = set[a] / V, va = set[a] - ba * V;
            const float *right = g->right + set[a] * P * 2 * F + f, *own = g->own + ba * T * 2 * F + f;
            for (int64_t p = 0; p < P; p++)
                sr[p] += EIGHT(right + 2 * p * F), si[p] += EIGHT(right + (2 * p + 1) * F);
            for (int64_t t = 0; t < T; t++)
                mr[t] += EIGHT(own + 2 * t * F), mi[t] += EIGHT(own + (2 * t + 1) * F);
            for (int64_t c = 0; c < a; c++) {
                const int32_t bc = set[c] / V, vc = set[c] - bc * V, shift = va >= vc ? va - vc : va - vc + V;
                const float *pair = g->pair + ((bc * g->b + ba) * V + shift) * T * 2 * F + f;
                for (int64_t t = 0; t < T; t++)
                    mr[t] += EIGHT(pair + 2 * t * F), mi[t] += EIGHT(pair + (2 * t + 1) * F);
            }
        }
        for (int64_t j = 0; j < J; j++) {
            Eight ur[MOST], ui[MOST];
            for (int64_t p = 0; p < P; p++) {
                ur[p] = ui[p] = zero;
                for (int64_t a = 0; a < K; a++) {
                    const float *held = g->held + ((set[a] * P + p) * J + j) * 2 * F + f;
                    ur[p] += EIGHT(held), ui[p] += EIGHT(held + F);
                }
                for (int64_t q = 0; q <= p; q++) {
                    mr[BELOW(p, q)] -= ur[p] * ur[q] + ui[p] * ui[q];
                    mi[BELOW(p, q)] -= ur[p] * ui[q] - ui[p] * ur[q];
                }
            }
        }
        for (int64_t p = 0; p < P; p++) {
            const Eight power = EIGHT(g->power + p * F + f);
            Eight d = mr[BELOW(p, p)] + 1.0f / power;
            for (int64_t q = 0; q < p; q++) {
                Eight re = mr[BELOW(p, q)], im = mi[BELOW(p, q)];
                for (int64_t m = 0; m < q; m++) { /* what is left of row p, and rows over their pivots */
                    const Eight ar = mr[BELOW(p, m)], ai = mi[BELOW(p, m)];
                    const Eight br = mr[BELOW(q, m)] * inverse[m], bi = mi[BELOW(q, m)] * inverse[m];
                    re -= ar * br + ai * bi;
                    im -= ai * br - ar * bi;
                }
                mr[BELOW(p, q)] = re, mi[BELOW(p, q)] = im;
                const Eight lr = re * inverse[q], li = im * inverse[q];
                d -= re * lr + im * li;
                sr[p] -= lr * sr[q] - li * si[q];
                si[p] -= lr * si[q] + li * sr[q];
            }
            for (int l = 0; l < UNIT; l++)
                d[l] = d[l] > 1e-30f ? d[l] : 1e-30f;
            inverse[p] = 1.0f / d;
            gain += (sr[p] * sr[p] + si[p] * si[p]) * inverse[p];
            d *= power;
            some = p % 4 ? some * d : d;
            if (p % 4 == 3 || p == P - 1) { /* before the product is more than a number holds */
                double volume = 1.0;
                for (int l = 0; l < UNIT; l++)
                    volume *= some[l];
                log_volume += log(volume);
            }
        }
    }
    double sum = 0.0;
    for (int l = 0; l < UNIT; l++)
        sum += gain[l];
    return sum - log_volume;
}

/* The score of one set, P one of a few numbers that the compiler knows. */
INLINE double scored(const Sets *g, const int32_t *set)
{
    switch (g->p) {
    case 1: return score_of(g, set, 1);
    case 2: return score_of(g, set, 2);
    case 3: return score_of(g, set, 3);
    case 4: return score_of(g, set, 4);
    case 5: return score_of(g, set, 5);
    default: return score_of(g, set, g->p);
    }
}

WIDE static void score(const Sets *g, const int32_t *sets, int64_t count, double *out)
{
    for (int64_t h = 0; h < count; h++)
        out[h] = scored(g, sets + h * g->k);
}

/* Tables as every call hands them over; 0 with an error set. */
static int tables(Sets *g, Held *held, PyObject *const from[5])
{
    const int64_t triangle = g->p * (g->p + 1) / 2;
    if (g->p < 1 || g->p > MOST || g->f < 1 || g->f % UNIT || g->b < 1 || g->v < 1 || g->j < 0 || g->k < 1)
        return refused("sizes of the tables");
    g->own = take(held, from[0], 8 * g->b * triangle * g->f, 0);
    g->pair = g->own ? take(held, from[1], g->k > 1 ? 8 * g->b * g->b * g->v * triangle * g->f : 0, 0) : NULL;
    g->held = g->pair ? take(held, from[2], 8 * g->b * g->v * g->p * g->j * g->f, 0) : NULL;
    g->right = g->held ? take(held, from[3], 8 * g->b * g->v * g->p * g->f, 0) : NULL;
    g->power = g->right ? take(held, from[4], 4 * g->p * g->f, 0) : NULL;
    return g->power != NULL;
}

static int within(const int32_t *places, int64_t count, int64_t end)
{
    for (int64_t i = 0; i < count; i++)
        if (places[i] < 0 || places[i] >= end)
            return refused("a set names a place beyond the table");
    return 1;
}

static PyObject *scores(PyObject *self, PyObject *args)
{
    (void)self;
    PyObject *from[5], *sets, *out;
    Sets g;
    Held buffers = {0};
    long long f, b, v, p, j, h, k;
    if (!PyArg_ParseTuple(args, "OOOOOOOLLLLLLL", from, from + 1, from + 2, from + 3, from + 4, &sets, &out, &f,
                          &b, &v, &p, &j, &h, &k))
        return NULL;
    g.f = f, g.b = b, g.v = v, g.p = p, g.j = j, g.k = k;
    if (!tables(&g, &buffers, from))
        return finished(&buffers);
    const int32_t *all = take(&buffers, sets, 4 * h * k, 0);
    double *to = all ? take(&buffers, out, 8 * h, 1) : NULL;
    if (!to || !within(all, h * k, b * v))
        return finished(&buffers);
    Py_BEGIN_ALLOW_THREADS score(&g, all, h, to);
    Py_END_ALLOW_THREADS return finished(&buffers);
}

/* Sets of one to `most` of N places, grown one by one from the best of one fewer. */
typedef struct {
    const int32_t *ids;            /* (N,) in the tables */
    const uint8_t *clear, *unlike; /* (N, N) both may be taken; sets that differ in them are two */
    int64_t n, most, kept, grown;
    double *pairs;   /* (N, N) scores of pairs, of the first place below the second */
    int known;       /* they are filled in */
    double *best;    /* (most, kept) scores, -inf where there is none */
    int32_t *chosen; /* (most, kept, most) places of those sets */
    double *log;     /* room for scores, and for sets (.., MEMBERS), of what is tried */
    int32_t *sets;
} Growth;

INLINE uint64_t packed(const int32_t *set, int64_t k, int64_t without)
{
    uint64_t code = 0;
    for (int64_t i = 0; i < k; i++)
        code = i == without ? code : code << 16 | (uint64_t)set[i];
    return code;
}

/* Sets of k parents (.., MEMBERS) with one more place, every one once; their number. */
INLINE int64_t longer(const Growth *g, const int32_t *parents, int64_t count, int64_t k, int32_t *out)
{
    uint64_t codes[GROWN];
    int64_t made = 0;
    for (int64_t s = 0; s < count; s++) {
        const int32_t *set = parents + s * MEMBERS;
        codes[s] = packed(set, k, -1);
        for (int32_t n = 0; n < g->n; n++) {
            int64_t free = 1, at = 0, again = 0;
            for (int64_t i = 0; i < k; i++)
                free &= g->clear[set[i] * g->n + n], at += set[i] < n;
            if (!free)
                continue;
            int32_t *to = out + made * MEMBERS;
            for (int64_t i = 0; i <= k; i++)
                to[i] = i < at ? set[i] : i == at ? n : set[i - 1];
            for (int64_t i = 0; i <= k && !again; i++) {
                const uint64_t code = packed(to, k + 1, i);
                for (int64_t r = 0; r < s; r++)
                    again |= codes[r] == code;
            }
            made += !again;
        }
    }
    return made;
}

/* All sets of one or two places; their number. */
INLINE int64_t begun(const Growth *g, int64_t k, int32_t *out)
{
    int64_t made = 0;
    for (int32_t a = 0; a < g->n; a++)
        for (int32_t b = k > 1 ? a + 1 : 0; b < (k > 1 ? g->n : 1); b++)
            if (k < 2 || g->clear[a * g->n + b]) {
                out[made * MEMBERS] = a, out[made * MEMBERS + 1] = b;
                made++;
            }
    return made;
}

/* Whether a set has a member that is unlike all of another set. */
INLINE int differs(const Growth *g, const int32_t *set, const int32_t *other, int64_t k)
{
    for (int64_t i = 0; i < k; i++) {
        int64_t all = 1;
        for (int64_t j = 0; j < k; j++)
            all &= g->unlike[set[i] * g->n + other[j]];
        if (all)
            return 1;
    }
    return 0;
}

/* The best sets of k, none like a better one. */
INLINE void keep(const Growth *g, int64_t count, int64_t k)
{
    int32_t *chosen = g->chosen + (k - 1) * g->kept * g->most;
    for (int64_t i = 0; i < g->kept; i++) {
        int64_t top = -1;
        for (int64_t s = 0; s < count; s++) {
            if (top >= 0 && !(g->log[s] > g->log[top]))
                continue;
            int64_t other = 1;
            for (int64_t b = 0; b < i && other; b++)
                other = differs(g, g->sets + s * MEMBERS, chosen + b * g->most, k);
            top = other ? s : top;
        }
        if (top < 0)
            return;
        g->best[(k - 1) * g->kept + i] = g->log[top];
        memcpy(chosen + i * g->most, g->sets + top * MEMBERS, (size_t)k * sizeof *chosen);
    }
}

/* The sets to which one more is added, the best first; their number. */
INLINE int64_t likeliest(const Growth *g, int64_t count, int32_t *parents)
{
    const size_t size = MEMBERS * sizeof *parents;
    double logs[GROWN];
    int64_t full = 0;
    for (int64_t s = 0; s < count; s++) {
        if (full == g->grown && !(g->log[s] > logs[full - 1]))
            continue;
        int64_t at = full < g->grown ? full++ : full - 1;
        for (; at > 0 && logs[at - 1] < g->log[s]; at--) {
            logs[at] = logs[at - 1];
            memcpy(parents + at * MEMBERS, parents + (at - 1) * MEMBERS, size);
        }
        logs[at] = g->log[s];
        memcpy(parents + at * MEMBERS, g->sets + s * MEMBERS, size);
    }
    return full;
}

WIDE static void all_grown(const Growth *g, Sets *tables, int32_t *parents)
{
    for (int64_t k = 1, count = 0; k <= g->most; k++) {
        tables->k = k;
        count = k > 2 ? longer(g, parents, count, k - 1, g->sets) : begun(g, k, g->sets);
        for (int64_t s = 0; s < count; s++) {
            int32_t ids[MEMBERS];
            const int32_t *set = g->sets + s * MEMBERS;
            for (int64_t i = 0; i < k; i++)
                ids[i] = g->ids[set[i]];
            double *pair = g->pairs + set[0] * g->n + set[1];
            g->log[s] = k == 2 && g->known ? *pair : scored(tables, ids);
            if (k == 2)
                *pair = g->log[s];
        }
        keep(g, count, k);
        count = likeliest(g, count, parents);
    }
}

static PyObject *grow(PyObject *self, PyObject *args)
{
    (void)self;
    PyObject *from[5], *ids, *clear, *unlike, *pairs, *best, *chosen;
    Sets t;
    Growth g;
    Held buffers = {0};
    long long f, b, v, p, j, most, kept, grown;
    if (!PyArg_ParseTuple(args, "OOOOOOOOOOOLLLLLLLLi", from, from + 1, from + 2, from + 3, from + 4, &ids,
                          &clear, &unlike, &pairs, &best, &chosen, &f, &b, &v, &p, &j, &most, &kept, &grown,
                          &g.known))
        return NULL;
    t.f = f, t.b = b, t.v = v, t.p = p, t.j = j, t.k = most;
    g.most = most, g.kept = kept, g.grown = grown;
    if (!tables(&t, &buffers, from) || !(g.ids = take(&buffers, ids, -1, 0)))
        return finished(&buffers);
    g.n = taken(&buffers) / 4;
    if (g.n < 1 || g.n > 0xffff || most > MEMBERS || kept < 1 || grown < 1 || grown > GROWN) {
        refused("how many sets are grown");
        return finished(&buffers);
    }
    if (!within(g.ids, g.n, b * v) || !(g.clear = take(&buffers, clear, g.n * g.n, 0)) ||
        !(g.unlike = take(&buffers, unlike, g.n * g.n, 0)) ||
        !(g.pairs = take(&buffers, pairs, 8 * g.n * g.n, 1)) ||
        !(g.best = take(&buffers, best, 8 * most * kept, 1)) ||
        !(g.chosen = take(&buffers, chosen, 4 * most * kept * most, 1)))
        return finished(&buffers);
    const int64_t tried = g.n * (g.n > 2 * grown ? g.n / 2 + 1 : grown);
    int32_t parents[GROWN * MEMBERS];
    g.log = malloc((size_t)tried * (sizeof(double) + MEMBERS * sizeof(int32_t)));
    if (!g.log)
        return no_memory(&buffers);
    g.sets = (int32_t *)(g.log + tried);
    Py_BEGIN_ALLOW_THREADS all_grown(&g, &t, parents);
    free(g.log);
    Py_END_ALLOW_THREADS return finished(&buffers);
}

/* Fourier transforms of V rows of lanes, in two steps of A and V / A, by exp(-2 pi j i / V). */
typedef struct {
    int64_t v, a;
    const float *turn; /* (V, 2) */
    Eight *in, *mid, *out; /* (V, 2) */
} Fourier;

INLINE void sum_of(const Fourier *w, const Eight *in, int64_t count, int64_t stride, int64_t at, int64_t step,
                   Eight *out)
{
    Eight re = {0}, im = {0};
    for (int64_t i = 0; i < count; i++, in += 2 * stride) {
        const float c = w->turn[2 * at], s = w->turn[2 * at + 1];
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
    const float *columns, *vectors; /* (B, P, ..), (C, J, ..) */
    float *out; /* (C, B V, P, J, 2, F), or (B, B, V, T, 2, F) */
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
                const float *x = g->columns + (b * P + i / J) * row, *y = g->vectors + (c * J + i % J) * row;
                for (int64_t f = 0; f < F; f += UNIT) {
                    for (int64_t m = 0; m < V; m++) {
                        const Eight xr = EIGHT(x + 2 * m * F + f), xi = EIGHT(x + 2 * m * F + F + f);
                        const Eight yr = EIGHT(y + 2 * m * F + f), yi = EIGHT(y + 2 * m * F + F + f);
                        g->w.in[2 * m] = xr * yr + xi * yi, g->w.in[2 * m + 1] = xi * yr - xr * yi;
                    }
                    transform(&g->w);
                    float *to = g->out + ((c * g->b + b) * V * P * J + i) * 2 * F + f;
                    for (int64_t n = 0; n < V; n++, to += P * J * 2 * F)
                        *(Eight *)to = g->w.out[2 * n], *(Eight *)(to + F) = g->w.out[2 * n + 1];
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
                        const float *ap = g->columns + (a * P + p) * row + f, *aq = ap + (q - p) * row;
                        const float *bp = g->columns + (b * P + p) * row + f, *bq = bp + (q - p) * row;
                        for (int64_t m = 0; m < V; m++) {
                            const int64_t i = 2 * m * F, k = 2 * (m ? V - m : 0) * F;
                            g->w.in[2 * m] =
                                EIGHT(ap + i) * EIGHT(bq + i) + EIGHT(ap + i + F) * EIGHT(bq + i + F) +
                                EIGHT(bp + k) * EIGHT(aq + k) + EIGHT(bp + k + F) * EIGHT(aq + k + F);
                            g->w.in[2 * m + 1] =
                                EIGHT(ap + i) * EIGHT(bq + i + F) - EIGHT(ap + i + F) * EIGHT(bq + i) +
                                EIGHT(bp + k) * EIGHT(aq + k + F) - EIGHT(bp + k + F) * EIGHT(aq + k);
                        }
                        transform(&g->w);
                        for (int64_t n = 0; n < V; n++) {
                            const int64_t t = (BELOW(p, q)) * 2 * F + f, back = n ? V - n : 0;
                            float *to = g->out + ((a * g->b + b) * V + n) * T * 2 * F + t;
                            float *other = g->out + ((b * g->b + a) * V + back) * T * 2 * F + t;
                            *(Eight *)to = *(Eight *)other = g->w.out[2 * n];
                            *(Eight *)(to + F) = *(Eight *)(other + F) = g->w.out[2 * n + 1];
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
        (g.w.v = taken(&buffers) / 8) < 1) {
        refused("sizes of the tables");
        return finished(&buffers);
    }
    const int64_t v = g.w.v, results = pairs ? b * b * v * p * (p + 1) / 2 : c * b * v * p * j;
    for (int64_t a = 1; a * a <= v; a++)
        g.w.a = v % a ? g.w.a : a;
    g.columns = take(&buffers, columns, 8 * b * p * v * f, 0);
    g.vectors = g.columns && !pairs ? take(&buffers, vectors, 8 * c * j * v * f, 0) : g.columns;
    g.out = g.vectors ? take(&buffers, out, 8 * results * f, 1) : NULL;
    if (!g.out)
        return finished(&buffers);
    g.w.in = malloc((size_t)(6 * v) * sizeof(Eight));
    if (!g.w.in)
        return no_memory(&buffers);
    g.w.mid = g.w.in + 2 * v, g.w.out = g.w.mid + 2 * v;
    Py_BEGIN_ALLOW_THREADS if (pairs) all_pairs(&g);
    else all_against(&g);
    Py_END_ALLOW_THREADS free(g.w.in);
    return finished(&buffers);
}

METHOD(pairs, turned(args, 1))
METHOD(against, turned(args, 0))

static PyMethodDef methods[] = {
    {"pairs", pairs, METH_VARARGS, "pairs(columns, turn, out, f, b, p): the table of `scores`, on an even turn"},
    {"against", against, METH_VARARGS,
     "against(columns, vectors, turn, out, f, b, p, c, j): products of vectors with all turns"},
    {"scores", scores, METH_VARARGS, "scores(own, pair, held, right, power, sets, out, f, b, v, p, j, h, k)"},
    {"grow", grow, METH_VARARGS,
     "grow(own, pair, held, right, power, ids, clear, unlike, pairs, best, chosen, f, b, v, p, j, most, kept, "
     "grown, known)"},
    {NULL, NULL, 0, NULL},
};

MODULE(_sets, "Log Bayes factors of sets of reflectors.", methods, 4)
