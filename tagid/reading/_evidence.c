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

#define NEARLY 0.1 /* standard deviations before a limit from which on its slopes may set in */

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

/* Adds share (2,) times the slopes of a point, reflector or odd scatterer, to (T,). */
static void add_place(const Problem *g, int64_t i, double along_x, double along_y, double *slope)
{
    if (i < g->k) {
        const int64_t turn = g->head + g->group[i], stretch = g->head + g->turns + g->group[g->k + i];
        const double facing = g->tag[g->k + i] + g->x[turn], radius = g->tag[i] + g->x[stretch];
        slope[0] += along_x, slope[1] += along_y;
        slope[turn] += radius * (along_y * cos(facing) - along_x * sin(facing));
        slope[stretch] += along_x * cos(facing) + along_y * sin(facing);
    } else {
        double *own = slope + g->t - g->spot * (g->odd - (i - g->k));
        own[0] += along_x, own[1] += along_y;
    }
}

/* Half the square of what a limit is passed by; lowers the gradient and raises the Hessian by its slopes, which
 * set in over a step: central differences of `tagid.reading.columns` do the same. */
static double limited(const Problem *g, double by, double *slope, double *gradient, double *hessian)
{
    const double over = by > 0.0 ? by : 0.0;
    for (int64_t t = 0; gradient && t < g->t; t++) {
        const double rise = 1e-5 * slope[t], there = by + rise, back = by - rise;
        slope[t] = ((there > 0.0 ? there : 0.0) - (back > 0.0 ? back : 0.0)) / 2e-5;
    }
    for (int64_t t = 0; gradient && t < g->t; t++) {
        gradient[t] -= slope[t] * over;
        for (int64_t u = 0; u < g->t; u++)
            hessian[t * g->t + u] += slope[t] * slope[u];
    }
    return 0.5 * over * over;
}

/* The log density of the parameters, with what crowds; adds its slopes where there is a gradient.
 *
 * The limits: largest log density, scale of shapes or 0, the bound of three times their size, both of the radii
 * of free rings, the standard deviation of all, and how far out an odd scatterer may stand. */
static double prior(const Problem *g, double *gradient, double *hessian)
{
    const int64_t T = g->t;
    const double *x = g->x, *limit = g->least, unit = 1.0 / limit[5];
    double log_density = limit[0], slope[MOST], place[3 * MOST];
    for (int64_t t = 0; t < T; t++) {
        double pulled = 0.0;
        for (int64_t u = 0; u < T; u++)
            pulled += g->pull[t * T + u] * x[u];
        log_density -= 0.5 * pulled * x[t];
        if (gradient)
            gradient[t] -= pulled;
        for (int64_t u = 0; gradient && u < T; u++)
            hessian[t * T + u] += g->pull[t * T + u];
    }
    if (limit[1] > 0.0) {
        const double square = x[2] * x[2] + x[3] * x[3], size = limit[1] * limit[1] + square, far = sqrt(square);
        const double by = unit * (3.0 * far - limit[2]);
        log_density += log(limit[1] / 6.283185307179586) - 1.5 * log(size);
        for (int64_t t = 2; gradient && t < 4; t++)
            gradient[t] -= 3.0 * x[t] / size, hessian[t * T + t] += 3.0 / size;
        if (by > -NEARLY) {
            memset(slope, 0, sizeof slope);
            slope[2] = 3.0 * unit * x[2] / far, slope[3] = 3.0 * unit * x[3] / far;
            log_density -= limited(g, by, slope, gradient, hessian);
        }
    }
    for (int64_t k = 0; k < g->k; k++) {
        const int64_t stretch = g->head + g->turns + g->group[g->k + k];
        const double radius = g->tag[k] + x[stretch], way = radius < limit[3] ? -1.0 : 1.0;
        const double by = unit * (radius < limit[3] ? limit[3] - radius : radius - limit[4]);
        if (!g->near[k] || by <= -NEARLY)
            continue;
        memset(slope, 0, sizeof slope);
        slope[stretch] = way * unit;
        log_density -= limited(g, by, slope, gradient, hessian);
    }
    place_all(g, place);
    for (int64_t i = g->k; i < g->k + g->odd; i++) {
        const double *p = place + 3 * (i + (g->body > 0)), far = hypot(p[0], p[1]), by = unit * (far - limit[6]);
        if (by <= -NEARLY)
            continue;
        memset(slope, 0, sizeof slope);
        add_place(g, i, unit * p[0] / far, unit * p[1] / far, slope);
        log_density -= limited(g, by, slope, gradient, hessian);
    }
    for (int64_t i = 0; i < g->pairs; i++) {
        const int64_t one = g->near[g->k + i], other = g->near[g->k + g->pairs + i], body = g->body > 0;
        const double *p = place + 3 * (one + body), *q = place + 3 * (other + body), dx = p[0] - q[0], dy = p[1] - q[1];
        const double apart = sqrt(dx * dx + dy * dy + limit[LIMITS + i]);
        const double by = unit * (limit[LIMITS + g->pairs + i] - apart), along = unit / (apart > 1e-9 ? apart : 1e-9);
        if (by <= -NEARLY)
            continue;
        memset(slope, 0, sizeof slope);
        add_place(g, one, -dx * along, -dy * along, slope);
        add_place(g, other, dx * along, dy * along, slope);
        log_density -= limited(g, by, slope, gradient, hessian);
    }
    return log_density;
}

/* Solves a (T, T) step = b, both overwritten, by pivots of the largest size in their column. */
static void solve_step(double *a, double *b, int64_t T)
{
    for (int64_t c = 0; c < T; c++) {
        int64_t best = c;
        for (int64_t i = c + 1; i < T; i++)
            best = fabs(a[i * T + c]) > fabs(a[best * T + c]) ? i : best;
        for (int64_t j = 0; j <= T; j++) {
            double *one = j < T ? a + c * T + j : b + c, *two = j < T ? a + best * T + j : b + best, held = *one;
            *one = *two, *two = held;
        }
        for (int64_t i = c + 1; i < T; i++) {
            const double share = a[i * T + c] / a[c * T + c];
            for (int64_t j = c; j < T; j++)
                a[i * T + j] -= share * a[c * T + j];
            b[i] -= share * b[c];
        }
    }
    for (int64_t c = T - 1; c >= 0; c--) {
        for (int64_t j = c + 1; j < T; j++)
            b[c] -= a[c * T + j] * b[j];
        b[c] /= a[c * T + c];
    }
}

static void expand_at(Problem *g, const Work *w, const double *x, double *out)
{
    g->x = x, g->out = out;
    expanded(g, w);
    out[0] += prior(g, out + 1, out + 1 + g->t);
}

/* Levenberg and Marquardt's method, as of `tagid.reading.descent.descend`: results are x, and the expansion. */
static void descend_all(Problem *g, const Work *w, int64_t rounds, double far, double enough, double *room)
{
    const int64_t T = g->t, size = 1 + T + T * T;
    const double *precision = g->pull + T * T;
    double *x = g->out, *here = x + T, *there = room, *a = there + size, *trial = a + T * T, *step = trial + T;
    double damping = 1e-2;
    memcpy(x, g->x, (size_t)T * sizeof(double));
    expand_at(g, w, x, here);
    for (int64_t round = 0; round < rounds; round++) {
        const double *gradient = here + 1, *hessian = gradient + T;
        double promised = 0.0;
        memcpy(a, hessian, (size_t)(T * T) * sizeof(double));
        memcpy(step, gradient, (size_t)T * sizeof(double));
        for (int64_t t = 0; t < T; t++)
            a[t * T + t] += damping * (hessian[t * T + t] + precision[t]);
        solve_step(a, step, T);
        for (int64_t t = 0; t < T; t++)
            trial[t] = x[t] + step[t], promised += step[t] * gradient[t];
        if (!(promised >= enough))
            break;
        const int inside = hypot(trial[0], trial[1]) < far;
        if (inside)
            expand_at(g, w, trial, there);
        if (inside && there[0] > here[0]) {
            const double gained = there[0] - here[0];
            memcpy(x, trial, (size_t)T * sizeof(double));
            memcpy(here, there, (size_t)size * sizeof(double));
            damping /= 5.0;
            if (gained < enough)
                break;
        } else if ((damping *= 10.0) > 1e6)
            break;
    }
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
    const int64_t results = one ? 1 + (one > 1 ? 2 : 1) * g->t + g->t * g->t : g->g * g->h;
    if (taken(held) != 8 * results || powers != g->h * g->n ||
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

typedef struct {
    long long rounds;
    double far, enough;
} Descent;

/* Problem and buffers from Python; 0 with an error set. */
static int taken_problem(PyObject *args, Held *held, Problem *g, int one, Descent *way)
{
    PyObject *o[15];
    long long body, patterns, bounces, odd, spot;
    if (!PyArg_ParseTuple(args, "OOOOOOOOOOOOOOOdddLLLLL|Ldd", o, o + 1, o + 2, o + 3, o + 4, o + 5, o + 6, o + 7,
                          o + 8, o + 9, o + 10, o + 11, o + 12, o + 13, o + 14, &g->distance, &g->bounce_m,
                          &g->touch_m, &body, &patterns, &bounces, &odd, &spot, &way->rounds, &way->far,
                          &way->enough))
        return 0;
    g->body = body, g->p = patterns, g->bounces = bounces, g->odd = odd, g->spot = spot;
    if (!(g->views = take(held, o[0], -1, 0)) || (g->v = odd < 0 ? 0 : taken(held) / (40 + 8 * odd)) < 1 ||
        taken(held) != (40 + 8 * odd) * g->v)
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
    if (!(g->pull = take(held, o[8], 8 * (g->t + 1) * g->t, 0)) || !(g->near = take(held, o[9], -1, 0)))
        return 0;
    g->pairs = (taken(held) / 8 - g->k) / 2;
    if (taken(held) != 8 * (g->k + 2 * g->pairs) ||
        !(g->least = take(held, o[10], 8 * (LIMITS + 2 * g->pairs), 0)))
        return refused("pairs");
    for (int64_t i = g->k; i < g->k + 2 * g->pairs; i++)
        if (g->near[i] < 0 || g->near[i] >= g->k + g->odd)
            return refused("pairs");
    return (g->x = take(held, o[11], 8 * g->t, 0)) && taken_powers(held, o + 12, g, one);
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
    Descent way = {0};
    if (!(given ? taken_given(args, &held, &g, one) : taken_problem(args, &held, &g, one, &way)))
        return finished(&held);
    const int64_t size = lay_out(&g, &w, NULL);
    double *base = malloc((size_t)(size + 1 + 3 * g.t + 2 * g.t * g.t) * sizeof(double));
    if (!base)
        return no_memory(&held);
    lay_out(&g, &w, base);
    Py_BEGIN_ALLOW_THREADS if (one > 1) descend_all(&g, &w, way.rounds, way.far, way.enough, base + size);
    else if (given) (one ? expanded : all_values)(&g, &w);
    else if (one) expand_at(&g, &w, g.x, g.out);
    else {
        all_values(&g, &w);
        const double own = prior(&g, NULL, NULL);
        for (int64_t i = 0; i < g.g * g.h; i++)
            g.out[i] += own;
    }
    Py_END_ALLOW_THREADS free(base);
    return finished(&held);
}

METHOD(values, computed(args, 0, 0))
METHOD(expand, computed(args, 1, 0))
METHOD(descend, computed(args, 2, 0))
METHOD(given_values, computed(args, 0, 1))
METHOD(given_expand, computed(args, 1, 1))

#define ARGUMENTS_OF                                                                                         \
    "views, kappa, clutter, white, basis, tag, group, tables, pull, near, least, x, power, sigma, out, "           \
    "distance, bounce_m, touch_m, body, p, bounces, odd, spot"

static PyMethodDef methods[] = {
    {"values", values, METH_VARARGS, "values(" ARGUMENTS_OF "): out (G, H) log densities"},
    {"expand", expand, METH_VARARGS, "expand(" ARGUMENTS_OF "): out (1 + T + T T,) value, gradient, Hessian"},
    {"descend", descend, METH_VARARGS,
     "descend(" ARGUMENTS_OF ", rounds, far, enough): out (T + 1 + T + T T,) parameters and expansion"},
    {"given_values", given_values, METH_VARARGS,
     "given_values(kappa, clutter, white, basis, columns, rates, power, sigma, out): as `values`"},
    {"given_expand", given_expand, METH_VARARGS,
     "given_expand(kappa, clutter, white, basis, columns, rates, power, sigma, out): as `expand`"},
    {NULL, NULL, 0, NULL},
};

MODULE(_evidence, "Log likelihoods of models of points, or of any columns, with slopes.", methods, 4)
