/* The log likelihood of a model of points, its gradient and its Gauss-Newton Hessian.
 *
 * `tagid.reading.columns` and `tagid.reading.evidence` hold the formulas, and do the same with numpy where no
 * compiler was present. Only the stable ABI and the buffer protocol are used.
 *
 * Two layouts: planes, see `_columns.h`, where columns are made view by view; and lanes (block of columns,
 * row) of LANES columns side by side, where views and columns are summed over.
 */
#include "_columns.h"
#include <stdlib.h>

/* Planes of so many columns to lanes (blocks, V), and back. */
INLINE void to_lanes(const double *planes, int64_t count, int64_t V, Lanes *lanes)
{
    for (int64_t c = 0; c < (count + LANES - 1) / LANES * LANES; c++) {
        double *to = (double *)(lanes + c / LANES * V) + c % LANES;
        for (int64_t v = 0; v < V; v++) {
            to[2 * LANES * v] = c < count ? planes[2 * c * V + v] : 0.0;
            to[2 * LANES * v + LANES] = c < count ? planes[2 * c * V + V + v] : 0.0;
        }
    }
}

INLINE void to_planes(const Lanes *lanes, int64_t count, int64_t V, double *planes)
{
    for (int64_t c = 0; c < count; c++) {
        const double *from = (const double *)(lanes + c / LANES * V) + c % LANES;
        for (int64_t v = 0; v < V; v++) {
            planes[2 * c * V + v] = from[2 * LANES * v];
            planes[2 * c * V + V + v] = from[2 * LANES * v + LANES];
        }
    }
}

/* Sum of `count` lanes a stride apart times exp(-2 pi j i step / V), from the phase `at`. */
INLINE Lanes turned_sum(const Lanes *in, int64_t count, int64_t stride, const double *turn, int64_t at,
                        int64_t step, int64_t V)
{
    Lanes sum = {0};
    for (int64_t i = 0; i < count; i++) {
        const Lanes *x = in + i * stride;
        const double c = turn[2 * at], s = turn[2 * at + 1];
        for (int q = 0; q < 2; q++) {
            sum.re[q] += x->re[q] * c - x->im[q] * s;
            sum.im[q] += x->re[q] * s + x->im[q] * c;
        }
        at += step;
        at -= at >= V ? V : 0;
    }
    return sum;
}

/* Lanes (blocks, V) to the whitener's basis (blocks, rows); `back`: by the transposed basis.
 *
 * On a full even turn in two steps, of `split` and V / split views (J. W. Cooley and J. W. Tukey,
 * *Mathematics of Computation* 19, 1965). */
INLINE void transform(const Problem *g, const Work *w, int64_t f, const Lanes *in, int64_t blocks, Lanes *out,
                      int back)
{
    const int64_t V = g->v, A = g->split, B = V / A, from = back ? g->rows : V, to = back ? V : g->rows;
    const double unit = 1.0 / sqrt((double)V), *basis = g->basis + f * g->m * V;
    for (int64_t b = 0; b < blocks; b++, in += from, out += to) {
        for (int64_t j = 0; g->even && j < B; j++)
            for (int64_t m = 0; m < A; m++)
                w->mid[j * A + m] = turned_sum(in + j, A, B, g->basis, m * j, m * B, V);
        for (int64_t m = 0; g->even && m < A; m++)
            for (int64_t n = 0; n < B; n++) {
                Lanes sum = turned_sum(w->mid + m, B, A, g->basis, 0, n * A, V);
                for (int q = 0; q < 2; q++)
                    sum.re[q] *= unit, sum.im[q] *= unit;
                out[m + A * n] = sum;
            }
        for (int64_t r = 0; !g->even && r < to; r++) {
            Lanes sum = {0};
            for (int64_t v = 0; v < from; v++) {
                const double weight = back ? basis[v * V + r] : basis[r * V + v];
                for (int q = 0; q < 2; q++)
                    sum.re[q] += in[v].re[q] * weight, sum.im[q] += in[v].im[q] * weight;
            }
            out[r] = sum;
        }
    }
}

/* out (count, blocks) = conj(x)^T y over rows: x (blocks of x, rows), y (blocks, rows). */
INLINE void products(const Lanes *x, int64_t count, const Lanes *y, int64_t blocks, int64_t rows, Lanes *out)
{
    for (int64_t b = 0; b < blocks; b++)
        for (int64_t p = 0; p < count; p += 2) {
            const double *a = (const double *)(x + p / LANES * rows) + p % LANES;
            const Lanes *c = y + b * rows;
            Lanes first = {0}, second = {0};
            for (int64_t r = 0; r < rows; r++, a += 2 * LANES)
                for (int q = 0; q < 2; q++) {
                    const Four re = c[r].re[q], im = c[r].im[q];
                    first.re[q] += re * a[0] + im * a[LANES];
                    first.im[q] += im * a[0] - re * a[LANES];
                    second.re[q] += re * a[1] + im * a[LANES + 1];
                    second.im[q] += im * a[1] - re * a[LANES + 1];
                }
            out[p * blocks + b] = first;
            out[(p + 1) * blocks + b] = second;
        }
}

INLINE double real_of(const Lanes *row, int64_t c) { return ((const double *)(row + c / LANES))[c % LANES]; }

INLINE double imag_of(const Lanes *row, int64_t c)
{
    return ((const double *)(row + c / LANES))[LANES + c % LANES];
}

/* Variances of the rows under a power of the clutter; the sum of their logarithms. */
INLINE double scales(const Problem *g, const Work *w, int64_t f, double sigma)
{
    const int64_t skip = g->rows - g->m; /* the constant vector of a full even turn is the room's */
    const double *variance = g->clutter + f * g->m;
    double sum = 0.0;
    if (skip)
        w->scale[0] = 0.0;
    for (int64_t m = 0; m < g->m; m++) {
        const double lambda = 1.0 + sigma * g->kappa[g->f + f] * variance[m];
        w->scale[skip + m] = 1.0 / sqrt(lambda);
        sum += log(lambda);
    }
    return sum;
}

/* Lanes (blocks, rows) times the scale of their rows; the data as column n where they are wanted. */
INLINE void scaled(const Problem *g, const Work *w, int64_t f, const Lanes *from, int64_t blocks, Lanes *out,
                   int with_data)
{
    for (int64_t b = 0; b < blocks; b++)
        for (int64_t r = 0; r < g->rows; r++)
            for (int q = 0; q < 2; q++) {
                out[b * g->rows + r].re[q] = from[b * g->rows + r].re[q] * w->scale[r];
                out[b * g->rows + r].im[q] = from[b * g->rows + r].im[q] * w->scale[r];
            }
    double *to = (double *)(out + g->n / LANES * g->rows) + g->n % LANES;
    const int64_t skip = g->rows - g->m;
    const double *y = g->white + 2 * f * g->m;
    for (int64_t r = 0; with_data && r < g->rows; r++) {
        to[2 * LANES * r] = r < skip ? 0.0 : w->scale[r] * y[2 * (r - skip)];
        to[2 * LANES * r + LANES] = r < skip ? 0.0 : w->scale[r] * y[2 * (r - skip) + 1];
    }
}

/* Columns that are given, as planes. */
INLINE void given_columns(const Problem *g, const Work *w, int64_t f)
{
    const int64_t V = g->v;
    for (int64_t c = 0; c < g->n; c++) {
        const double *from = g->given + 2 * (f * g->n + c) * V;
        double *to = w->columns + 2 * c * V;
        for (int64_t v = 0; v < V; v++)
            to[v] = from[2 * v], to[V + v] = from[2 * v + 1];
    }
}

/* What `slopes_of` is for points. */
INLINE void given_slopes(const Problem *g, const Work *w, int64_t f, const double *weight)
{
    const int64_t V = g->v;
    memset(w->slopes, 0, (size_t)(2 * g->t * V) * sizeof(double));
    for (int64_t t = 0; t < g->t; t++) {
        double *restrict to = w->slopes + 2 * t * V;
        for (int64_t c = 0; c < g->n; c++) {
            const double *restrict from = g->rates + 2 * ((t * g->f + f) * g->n + c) * V;
            const double *restrict by = weight + 2 * c * V;
            for (int64_t v = 0; v < V; v++) {
                to[v] += from[2 * v] * by[v] - from[2 * v + 1] * by[V + v];
                to[V + v] += from[2 * v] * by[V + v] + from[2 * v + 1] * by[v];
            }
        }
    }
}

INLINE void slopes(const Problem *g, const Work *w, int64_t f, const double *weight, double *scratch)
{
    if (g->given)
        given_slopes(g, w, f, weight);
    else
        slopes_of(g, w, f, weight, scratch);
}

/* The whitened columns of frequency f in w->raw. */
INLINE void whitened(const Problem *g, const Work *w, int64_t f, int with_slopes)
{
    if (g->given)
        given_columns(g, w, f);
    else {
        at_frequency(g, w, f, with_slopes);
        columns_of(g, w);
    }
    memset(w->in, 0, (size_t)(g->blocks * g->v) * sizeof(Lanes));
    to_lanes(w->columns, g->n, g->v, w->in);
    transform(g, w, f, w->in, g->blocks, w->raw, 0);
}

/* Adds to `sum` (LANES,) log det and data term of powers h to h + LANES: one power a lane. */
INLINE void add_powers(const Problem *g, const Lanes *gram, int64_t f, int64_t h, double *sum)
{
    const int64_t N = g->n;
    const double moving = g->kappa[g->f + f];
    Lanes factor[MOST * (MOST + 1) / 2], row[MOST], half[MOST];
    Four inverse[MOST][2], gain[2] = {{0}}, volume[2];
    volume[0] = volume[1] = gain[0] + 1.0;
    for (int64_t p = 0; p < N; p++) {
        const Lanes *from = gram + p * g->blocks;
        Lanes *own = factor + p * (p + 1) / 2;
        Four power[2], d[2];
        for (int64_t l = 0; l < LANES; l++)
            ((double *)power)[l] = moving * g->power[(h + l < g->h ? h + l : g->h - 1) * N + p];
        for (int q = 0; q < 2; q++) {
            d[q] = real_of(from, p) + 1.0 / power[q];
            half[p].re[q] = real_of(from, N) + 0.0 * power[q];
            half[p].im[q] = imag_of(from, N) + 0.0 * power[q];
        }
        for (int64_t c = 0; c < p; c++) {
            const Lanes *other = factor + c * (c + 1) / 2;
            const double re = real_of(from, c), im = imag_of(from, c);
            for (int q = 0; q < 2; q++) {
                Four a = re + 0.0 * power[q], b = im + 0.0 * power[q];
                for (int64_t m = 0; m < c; m++) {
                    a -= row[m].re[q] * other[m].re[q] + row[m].im[q] * other[m].im[q];
                    b -= row[m].im[q] * other[m].re[q] - row[m].re[q] * other[m].im[q];
                }
                row[c].re[q] = a, row[c].im[q] = b;
                own[c].re[q] = a * inverse[c][q], own[c].im[q] = b * inverse[c][q];
                d[q] -= a * own[c].re[q] + b * own[c].im[q];
                half[p].re[q] -= own[c].re[q] * half[c].re[q] - own[c].im[q] * half[c].im[q];
                half[p].im[q] -= own[c].re[q] * half[c].im[q] + own[c].im[q] * half[c].re[q];
            }
        }
        for (int q = 0; q < 2; q++) {
            inverse[p][q] = 1.0 / d[q];
            gain[q] += (half[p].re[q] * half[p].re[q] + half[p].im[q] * half[p].im[q]) * inverse[p][q];
            volume[q] *= d[q] * power[q];
        }
    }
    for (int64_t l = 0; l < LANES; l++)
        sum[l] += ((double *)gain)[l] - log(((double *)volume)[l]);
}

WIDE static void all_values(const Problem *g, const Work *w)
{
    memset(g->out, 0, (size_t)(g->g * g->h) * sizeof(double));
    if (!g->given)
        prepare(g, w);
    for (int64_t f = 0; f < g->f; f++) {
        whitened(g, w, f, 0);
        for (int64_t i = 0; i < g->g; i++) {
            const double logs = scales(g, w, f, g->sigma[i]);
            scaled(g, w, f, w->raw, g->blocks, w->white, 1);
            products(w->white, g->n + 1, w->white, g->blocks, g->rows, w->gram);
            const double energy = logs + real_of(w->gram + g->n * g->blocks, g->n);
            for (int64_t h = 0; h < g->h; h += LANES) {
                double sum[LANES] = {0};
                add_powers(g, w->gram, f, h, sum);
                for (int64_t l = 0; l < LANES && h + l < g->h; l++)
                    g->out[i * g->h + h + l] += sum[l] - energy;
            }
        }
    }
}

/* The inverse (N, blocks) of gram + 1 / power, and amplitudes (N, 2); log det and data term. */
INLINE double solved(const Problem *g, const Work *w, int64_t f, double *amplitude)
{
    const int64_t N = g->n, blocks = g->blocks;
    const double moving = g->kappa[g->f + f];
    double factor[2 * MOST * (MOST + 1) / 2], sum = 0.0, volume = 1.0;
    for (int64_t p = 0; p < N; p++) {
        const Lanes *from = w->gram + p * blocks;
        double *own = factor + p * (p + 1), d = real_of(from, p) + 1.0 / (moving * g->power[p]);
        for (int64_t c = 0; c < p; c++) {
            const double *other = factor + c * (c + 1);
            double re = real_of(from, c), im = imag_of(from, c);
            for (int64_t m = 0; m < c; m++) {
                re -= own[2 * m] * other[2 * m] + own[2 * m + 1] * other[2 * m + 1];
                im -= own[2 * m + 1] * other[2 * m] - own[2 * m] * other[2 * m + 1];
            }
            own[2 * c] = re * other[2 * c], own[2 * c + 1] = im * other[2 * c];
            d -= own[2 * c] * own[2 * c] + own[2 * c + 1] * own[2 * c + 1];
        }
        volume *= d * moving * g->power[p];
        own[2 * p] = 1.0 / sqrt(d);
        for (int64_t b = 0; b < blocks; b++) {
            Lanes solution = {0};
            if (p / LANES == b)
                ((double *)&solution)[p % LANES] = 1.0;
            for (int64_t m = 0; m < p; m++) {
                const Lanes *x = w->lower_inverse + b * N + m;
                for (int q = 0; q < 2; q++) {
                    solution.re[q] -= x->re[q] * own[2 * m] - x->im[q] * own[2 * m + 1];
                    solution.im[q] -= x->re[q] * own[2 * m + 1] + x->im[q] * own[2 * m];
                }
            }
            for (int q = 0; q < 2; q++)
                solution.re[q] *= own[2 * p], solution.im[q] *= own[2 * p];
            w->lower_inverse[b * N + p] = solution;
        }
    }
    products(w->lower_inverse, N, w->lower_inverse, blocks, N, w->inverse);
    for (int64_t p = 0; p < N; p++) {
        double re = 0.0, im = 0.0;
        for (int64_t c = 0; c < N; c++) {
            const double ar = real_of(w->inverse + p * blocks, c), ai = imag_of(w->inverse + p * blocks, c);
            const double br = real_of(w->gram + c * blocks, N), bi = imag_of(w->gram + c * blocks, N);
            re += ar * br - ai * bi, im += ar * bi + ai * br;
        }
        amplitude[2 * p] = re, amplitude[2 * p + 1] = im;
        sum += re * real_of(w->gram + p * blocks, N) + im * imag_of(w->gram + p * blocks, N);
    }
    return sum - log(volume);
}

/* -conj(A^T W) / sqrt(lambda), (blocks, rows): what log det pulls the columns with. */
INLINE void pull(const Problem *g, const Work *w, Lanes *out)
{
    for (int64_t b = 0; b < g->blocks; b++)
        for (int64_t r = 0; r < g->rows; r++) {
            Lanes sum = {0};
            for (int64_t c = 0; c < g->n; c++) {
                const double *x = (const double *)(w->white + c / LANES * g->rows + r) + c % LANES;
                const Lanes *a = w->inverse + c * g->blocks + b;
                for (int q = 0; q < 2; q++) {
                    sum.re[q] -= a->re[q] * x[0] - a->im[q] * x[LANES];
                    sum.im[q] += a->re[q] * x[LANES] + a->im[q] * x[0];
                }
            }
            for (int q = 0; q < 2; q++)
                sum.re[q] *= w->scale[r], sum.im[q] *= w->scale[r];
            out[b * g->rows + r] = sum;
        }
}

/* Adds the share of frequency f to gradient and Hessian: gram (T, blocks + more) is of slopes with columns,
 * data and slopes. */
INLINE void add_curvature(const Problem *g, const Work *w, const double *amplitude, double *gradient,
                          double *hessian)
{
    const int64_t N = g->n, T = g->t, wide = g->blocks + g->more, other = LANES * g->blocks;
    double held[2 * MOST];
    for (int64_t t = 0; t < T; t++) {
        const Lanes *own = w->gram + t * wide;
        double slope = real_of(own, N);
        for (int64_t c = 0; c < N; c++)
            slope -= real_of(own, c) * amplitude[2 * c] - imag_of(own, c) * amplitude[2 * c + 1];
        gradient[t] += 2.0 * slope;
        for (int64_t c = 0; c < N; c++) {
            double re = 0.0, im = 0.0; /* of own^T inverse */
            for (int64_t d = 0; d < N; d++) {
                const Lanes *row = w->inverse + d * g->blocks;
                const double ar = real_of(row, c), ai = imag_of(row, c);
                re += real_of(own, d) * ar - imag_of(own, d) * ai;
                im += real_of(own, d) * ai + imag_of(own, d) * ar;
            }
            held[2 * c] = re, held[2 * c + 1] = im;
        }
        for (int64_t u = 0; u <= t; u++) {
            const Lanes *row = w->gram + u * wide;
            double left = real_of(own, other + u);
            for (int64_t c = 0; c < N; c++)
                left -= held[2 * c] * real_of(row, c) + held[2 * c + 1] * imag_of(row, c);
            hessian[t * T + u] += 2.0 * left;
        }
    }
}

WIDE static void expanded(const Problem *g, const Work *w)
{
    const int64_t V = g->v, T = g->t, N = g->n;
    double *gradient = g->out + 1, *hessian = gradient + T, amplitude[2 * MOST];
    double *scratch = (double *)w->mid; /* (2, 2, V) */
    memset(g->out, 0, (size_t)(1 + T + T * T) * sizeof(double));
    if (!g->given)
        prepare(g, w);
    for (int64_t f = 0; f < g->f; f++) {
        whitened(g, w, f, 1);
        const double logs = scales(g, w, f, g->sigma[0]);
        scaled(g, w, f, w->raw, g->blocks, w->white, 1);
        products(w->white, N + 1, w->white, g->blocks, g->rows, w->gram);
        g->out[0] -= logs + real_of(w->gram + N * g->blocks, N);
        g->out[0] += solved(g, w, f, amplitude);
        for (int64_t c = 0; c < N; c++)
            for (int64_t v = 0; v < V; v++) {
                w->columns[2 * c * V + v] = amplitude[2 * c];
                w->columns[2 * c * V + V + v] = amplitude[2 * c + 1];
            }
        slopes(g, w, f, w->columns, scratch);
        to_lanes(w->slopes, T, V, w->in);
        transform(g, w, f, w->in, g->more, w->raw, 0);
        scaled(g, w, f, w->raw, g->more, w->white + g->blocks * g->rows, 0);
        products(w->white + g->blocks * g->rows, T, w->white, g->blocks + g->more, g->rows, w->gram);
        add_curvature(g, w, amplitude, gradient, hessian);
        pull(g, w, w->in);
        transform(g, w, f, w->in, g->blocks, w->raw, 1);
        to_planes(w->raw, N, V, w->columns);
        slopes(g, w, f, w->columns, scratch);
        for (int64_t t = 0; t < T; t++) {
            double sum = 0.0;
            for (int64_t v = 0; v < V; v++)
                sum += w->slopes[2 * t * V + v];
            gradient[t] += 2.0 * sum;
        }
    }
    for (int64_t t = 0; t < T; t++)
        for (int64_t u = 0; u < t; u++)
            hessian[u * T + t] = hessian[t * T + u];
}

/* Frequencies, variance, data and basis of a recording. On a full even turn the basis says the views V. */
static int taken_recording(Held *held, PyObject **o, Problem *g)
{
    if (!(g->kappa = take(held, o[0], -1, 0)) || (g->f = taken(held) / 16) < 1)
        return refused("frequencies");
    if (!(g->clutter = take(held, o[1], -1, 0)) || (g->m = taken(held) / 8 / g->f) < 1)
        return refused("variance");
    if (!(g->white = take(held, o[2], 16 * g->f * g->m, 0)) || !(g->basis = take(held, o[3], -1, 0)))
        return 0;
    g->even = taken(held) == 16 * (g->m + 1);
    const int64_t views = g->even ? g->m + 1 : taken(held) / 8 / g->f / g->m;
    if (g->v && g->v != views)
        return refused("basis");
    g->v = views, g->rows = g->even ? views : g->m;
    if (!g->even && taken(held) != 8 * g->f * g->m * g->v)
        return refused("basis");
    return 1;
}

/* Powers of columns and clutter, and the results. */
static int taken_powers(Held *held, PyObject **o, Problem *g, int one)
{
    if (!(g->power = take(held, o[0], -1, 0)))
        return 0;
    const int64_t powers = taken(held) / 8;
    if (!(g->sigma = take(held, o[1], -1, 0)) || (g->g = taken(held) / 8) < 1 ||
        !(g->out = take(held, o[2], -1, 1)))
        return refused("powers");
    g->h = one ? 1 : taken(held) / 8 / g->g; /* without columns their powers do not say */
    if (taken(held) != 8 * (one ? 1 + g->t + g->t * g->t : g->g * g->h) || powers != g->h * g->n ||
        (one && g->g > 1))
        return refused("sizes of powers and results");
    for (g->split = 1; (g->split + 1) * (g->split + 1) <= g->v;) {
        int64_t next = g->split + 1;
        while (g->v % next)
            next++;
        if (next * next > g->v)
            break;
        g->split = next;
    }
    g->blocks = (g->n + LANES) / LANES, g->more = (g->t + LANES - 1) / LANES;
    return 1;
}

/* Problem and buffers from Python; 0 with an error set. */
static int taken_problem(PyObject *args, Held *held, Problem *g, int one)
{
    PyObject *o[12];
    long long body, patterns, bounces, odd, spot;
    if (!PyArg_ParseTuple(args, "OOOOOOOOOOOOdddLLLLL", o, o + 1, o + 2, o + 3, o + 4, o + 5, o + 6, o + 7, o + 8,
                          o + 9, o + 10, o + 11, &g->distance, &g->bounce_m, &g->touch_m, &body, &patterns, &bounces, &odd, &spot))
        return 0;
    g->body = body, g->p = patterns, g->bounces = bounces, g->odd = odd, g->spot = spot;
    if (!(g->views = take(held, o[0], -1, 0)) || (g->v = taken(held) / 40) < 1)
        return refused("views");
    if (!taken_recording(held, o + 1, g))
        return 0;
    if (!(g->tag = take(held, o[5], -1, 0)))
        return 0;
    g->k = taken(held) / 24;
    if (g->k && g->p < 1)
        return refused("patterns");
    if (g->bounces < 0 || g->bounces > (g->k > 1))
        return refused("bounces");
    if (!(g->group = take(held, o[6], 32 * g->k, 0)) || !(g->tables = take(held, o[7], -1, 0)))
        return 0;
    const int64_t of_table = 16 * g->p * g->f * ANGLES, tables = g->k ? taken(held) / of_table : 0;
    for (int64_t k = 0; k < g->k; k++) {
        const int64_t turn = g->group[k], stretch = g->group[g->k + k], table = g->group[2 * g->k + k];
        const int64_t lift = g->group[3 * g->k + k];
        g->lifts = lift >= g->lifts ? lift + 1 : g->lifts;
        g->turns = turn >= g->turns ? turn + 1 : g->turns;
        g->stretches = stretch >= g->stretches ? stretch + 1 : g->stretches;
        if (turn < 0 || stretch < 0 || table < 0 || table >= tables ||
            lift < -1 || (lift < 0) != (g->group[3 * g->k] < 0))
            return refused("groups");
    }
    if (spot != 2 && spot != 3)
        return refused("odd scatterers");
    g->head = g->body > 1 ? 4 : 2;
    g->t = g->head + g->turns + g->stretches + g->lifts + g->spot * g->odd;
    g->n = g->body + (g->k ? g->p : 0) + g->bounces + (g->k > 1 ? g->k : 0) + g->odd;
    g->sources = (g->body > 0) + g->k + g->odd;
    if (g->body < 0 || g->body == 2 || g->body > 3 || g->odd < 0 || g->n >= MOST ||
        g->t > MOST || g->sources > MOST)
        return refused("the model has too many columns or parameters");
    return (g->x = take(held, o[8], 8 * g->t, 0)) && taken_powers(held, o + 9, g, one);
}

/* The same of columns that are given. */
static int taken_given(PyObject *args, Held *held, Problem *g, int one)
{
    PyObject *o[9];
    if (!PyArg_ParseTuple(args, "OOOOOOOOO", o, o + 1, o + 2, o + 3, o + 4, o + 5, o + 6, o + 7, o + 8) ||
        !taken_recording(held, o, g) || !(g->given = take(held, o[4], -1, 0)))
        return 0;
    const int64_t column = 16 * g->f * g->v;
    g->n = taken(held) / column;
    if (taken(held) != g->n * column || !(g->rates = take(held, o[5], -1, 0)))
        return refused("columns");
    g->t = g->n ? taken(held) / column / g->n : 0;
    if (taken(held) != g->t * g->n * column || (one && g->t < 1))
        return refused("slopes");
    if (g->n < 1 || g->n >= MOST || g->t > MOST)
        return refused("the model has too many columns or parameters");
    return taken_powers(held, o + 6, g, one);
}

static PyObject *computed(PyObject *args, int one, int given)
{
    Problem g = {0};
    Work w;
    Held held = {0};
    if (!(given ? taken_given : taken_problem)(args, &held, &g, one))
        return finished(&held);
    double *base = malloc((size_t)lay_out(&g, &w, NULL) * sizeof(double));
    if (!base) {
        release(&held);
        return PyErr_NoMemory();
    }
    lay_out(&g, &w, base);
    Py_BEGIN_ALLOW_THREADS if (one) expanded(&g, &w);
    else all_values(&g, &w);
    Py_END_ALLOW_THREADS free(base);
    return finished(&held);
}

static PyObject *values(PyObject *self, PyObject *args)
{
    (void)self;
    return computed(args, 0, 0);
}

static PyObject *expand(PyObject *self, PyObject *args)
{
    (void)self;
    return computed(args, 1, 0);
}

static PyObject *given_values(PyObject *self, PyObject *args)
{
    (void)self;
    return computed(args, 0, 1);
}

static PyObject *given_expand(PyObject *self, PyObject *args)
{
    (void)self;
    return computed(args, 1, 1);
}

#define ARGUMENTS_OF                                                                                         \
    "views, kappa, clutter, white, basis, tag, group, tables, x, power, sigma, out, distance, bounce_m, touch_m, body, p, bounces, odd, spot"

static PyMethodDef methods[] = {
    {"values", values, METH_VARARGS, "values(" ARGUMENTS_OF "): out (G, H) log likelihoods"},
    {"expand", expand, METH_VARARGS, "expand(" ARGUMENTS_OF "): out (1 + T + T T,) value, gradient, Hessian"},
    {"given_values", given_values, METH_VARARGS,
     "given_values(kappa, clutter, white, basis, columns, rates, power, sigma, out): as `values`"},
    {"given_expand", given_expand, METH_VARARGS,
     "given_expand(kappa, clutter, white, basis, columns, rates, power, sigma, out): as `expand`"},
    {NULL, NULL, 0, NULL},
};

MODULE(_evidence, "Log likelihoods of models of points, or of any columns, with slopes.", methods, 2)
