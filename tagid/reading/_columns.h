/* Columns of a model of points and their slopes, planes (column, 2, V): real and imaginary parts apart. */
#ifndef TAGID_COLUMNS_H
#define TAGID_COLUMNS_H
#include "_wave.h"
#include <string.h>

#define ANGLES 256 /* of a table of patterns */
#define LANES 8
#define MOST 32 /* columns or parameters, at most */
#define UNIT 4  /* doubles of a vector */
#define LIMITS 7 /* doubles before those of the pairs */

typedef double Four __attribute__((vector_size(8 * UNIT), aligned(16)));
typedef struct {
    Four re[2], im[2];
} Lanes;

typedef struct {
    const double *views;   /* (5 + odd, V) antenna x, y, height, direction, 0 where reflectors are hidden, and how
                              much is seen of every odd scatterer */
    const double *kappa;   /* (2, F) kappa and moving energy */
    const double *clutter; /* (F, M) variance of unit clutter */
    const double *white;   /* (F, M) complex: whitened data */
    const double *basis;   /* (F, M, V); on a full even turn exp(-2 pi j m / V), (V,) complex */
    const double *tag;     /* (3, K) radius, angle, height */
    const int64_t *group;  /* (4, K) turn, stretch, table, lift or -1 */
    const double *tables;  /* (tables, P, F, ANGLES) complex */
    const double *x;       /* (T,) parameters */
    const double *power;   /* (H, N) prior powers of the columns, over the moving energy */
    const double *sigma;   /* (G,) powers of the clutter */
    const double *pull;    /* (T + 1, T) precision of the prior that pulls, and of all parameters apart */
    const int64_t *near;   /* (K,) whether a radius is free, then (2, pairs) points that may be too close */
    const double *least;   /* (LIMITS,) see `prior`, then (2, pairs) squared difference in height and distance */
    const double *given, *rates; /* instead of points: columns (F, N, V) and slopes (T, F, N, V), complex */
    double *out;
    double distance, bounce_m, touch_m; /* of the antenna; see `bounce` */
    int64_t pairs, v, f, m, k, t, n, h, g, body, p, bounces, odd, spot, turns, stretches, lifts, head;
    int64_t even, rows, split, sources, blocks, more;
} Problem;

typedef struct {
    double *range, *toward, *wave, *step; /* (S, V), (S, 3, V), (S, 2, V) */
    double *lower, *part;                 /* (K, V) where a table is read */
    double *pattern, *turned;             /* (K, P, 2, V) */
    double *half, *half_step, *back;      /* (K, 2, V) what passes between reflectors, half way; to each */
    double *apart, *pair, *drawn;         /* (K, K, 4) x, y, z and length, (K, K, 2) and its slope */
    double *oval;                         /* (2, V) */
    double *columns;                      /* (N, 2, V) columns, then weights */
    double *slopes;                       /* (T, 2, V) */
    double *scale;                        /* (rows,) 1 / sqrt(lambda) */
    Lanes *in, *mid;                      /* (blocks, V or rows), (V,) */
    Lanes *raw, *white;                   /* (blocks, rows), (blocks + more, rows) */
    Lanes *gram, *inverse;                /* (columns, blocks) */
    Lanes *lower_inverse;                 /* (blocks, columns) of the Cholesky factor */
} Work;

/* Lays the work out from a base; the doubles that it takes. */
static int64_t lay_out(const Problem *g, Work *w, double *base)
{
    double *at = base;
    const int64_t V = g->v, S = g->sources, most = g->blocks > g->more ? g->blocks : g->more, L = 2 * LANES;
    const int64_t tall = V > g->rows ? V : g->rows, wide = g->blocks + g->more;
    w->range = room(&at, S * V), w->toward = room(&at, 3 * S * V);
    w->wave = room(&at, 2 * S * V), w->step = room(&at, 2 * S * V);
    w->lower = room(&at, g->k * V), w->part = room(&at, g->k * V);
    w->pattern = room(&at, 2 * g->k * g->p * V), w->turned = room(&at, 2 * g->k * g->p * V);
    const int64_t bouncing = g->bounces ? g->k : 0;
    w->half = room(&at, 2 * bouncing * V), w->half_step = room(&at, 2 * bouncing * V);
    w->back = room(&at, 2 * bouncing * V), w->apart = room(&at, 4 * bouncing * bouncing);
    w->pair = room(&at, 2 * bouncing * bouncing), w->drawn = room(&at, 2 * bouncing * bouncing);
    w->oval = room(&at, 2 * V), w->columns = room(&at, 2 * (g->n + 1) * V);
    w->slopes = room(&at, 2 * g->t * V);
    w->scale = room(&at, g->rows);
    w->in = (Lanes *)room(&at, L * most * tall), w->mid = (Lanes *)room(&at, L * V);
    w->raw = (Lanes *)room(&at, L * most * tall), w->white = (Lanes *)room(&at, L * wide * g->rows);
    w->gram = (Lanes *)room(&at, L * LANES * most * wide);
    w->inverse = (Lanes *)room(&at, L * LANES * g->blocks * g->blocks);
    w->lower_inverse = (Lanes *)room(&at, L * LANES * g->blocks * g->blocks);
    return at - base;
}

/* Places (S, 3) of the sources: body, reflectors, odd scatterers. */
INLINE void place_all(const Problem *g, double *place)
{
    const double *x = g->x, *lift = x + g->head + g->turns + g->stretches, *odd = lift + g->lifts;
    int64_t s = 0;
    if (g->body)
        place[0] = x[0], place[1] = x[1], place[2] = 0.0, s = 1;
    for (int64_t k = 0; k < g->k; k++, s++) {
        const double facing = g->tag[g->k + k] + x[g->head + g->group[k]];
        const double radius = g->tag[k] + x[g->head + g->turns + g->group[g->k + k]];
        place[3 * s] = x[0] + radius * cos(facing);
        place[3 * s + 1] = x[1] + radius * sin(facing);
        place[3 * s + 2] = g->tag[2 * g->k + k];
        if (g->lifts)
            place[3 * s + 2] += lift[g->group[3 * g->k + k]];
    }
    for (int64_t i = 0; i < g->odd; i++, s++, odd += g->spot)
        place[3 * s] = odd[0], place[3 * s + 1] = odd[1], place[3 * s + 2] = g->spot > 2 ? odd[2] : 0.0;
}

/* Half the waves of the reflectors, and what lies between them, from places (K, 3). */
INLINE void prepare_bounces(const Problem *g, const Work *w, const double *place)
{
    const int64_t V = g->v, body = g->body > 0;
    const double first = g->kappa[0] / 2, between = g->f > 1 ? (g->kappa[1] - g->kappa[0]) / 2 : 0.0;
    const double *seen = g->views + 4 * V;
    for (int64_t k = 0; k < g->k; k++) {
        const double *restrict range = w->range + (body + k) * V;
        double *restrict half = w->half + 2 * k * V, *restrict step = w->half_step + 2 * k * V;
        for (int64_t v = 0; v < V; v++) {
            const double path = range[v] - g->distance, loss = seen[v] * g->distance / range[v];
            double re, im;
            wave_of(first * path, &re, &im);
            half[v] = loss * re, half[V + v] = loss * im;
            wave_of(between * path, &re, &im);
            step[v] = re, step[V + v] = im;
        }
        for (int64_t j = 0; j < g->k; j++) {
            double *apart = w->apart + 4 * (k * g->k + j);
            for (int64_t i = 0; i < 3; i++)
                apart[i] = place[3 * k + i] - place[3 * j + i];
            apart[3] = sqrt(apart[0] * apart[0] + apart[1] * apart[1] + apart[2] * apart[2] + g->touch_m * g->touch_m);
        }
    }
}

/* What reaches every reflector from the others at frequency f, after f - 1. */
INLINE void bounces_at(const Problem *g, const Work *w, int64_t f)
{
    const int64_t V = g->v, K = g->k;
    const double half_kappa = g->kappa[f] / 2;
    if (f > 0)
        advance(w->half, w->half_step, K, V);
    memset(w->back, 0, (size_t)(2 * K * V) * sizeof(double));
    for (int64_t k = 0; k < K; k++)
        for (int64_t j = 0; j < K; j++) {
            const double far = w->apart[4 * (k * K + j) + 3], *restrict other = w->half + 2 * j * V;
            double *pair = w->pair + 2 * (k * K + j), *drawn = w->drawn + 2 * (k * K + j);
            double *restrict back = w->back + 2 * k * V, re, im;
            pair[0] = pair[1] = drawn[0] = drawn[1] = 0.0;
            if (j == k)
                continue;
            wave_of(half_kappa * far, &re, &im);
            pair[0] = g->bounce_m / far * re, pair[1] = g->bounce_m / far * im;
            drawn[0] = (pair[1] * half_kappa - pair[0] / far) / far;
            drawn[1] = (-pair[0] * half_kappa - pair[1] / far) / far;
#pragma omp simd
            for (int64_t v = 0; v < V; v++) {
                back[v] += pair[0] * other[v] - pair[1] * other[V + v];
                back[V + v] += pair[0] * other[V + v] + pair[1] * other[v];
            }
        }
}

/* Slope of the bounces times weights, as reflector k moves by (x, y, z), onto planes. */
INLINE void add_bounce(const Problem *g, const Work *w, int64_t k, const double *restrict weight, double kappa,
                       const double by[3], double *restrict out)
{
    const int64_t V = g->v, K = g->k, s = (g->body > 0) + k;
    const double *restrict range = w->range + s * V, *restrict toward = w->toward + 3 * s * V;
    const double *restrict half = w->half + 2 * k * V, *restrict back = w->back + 2 * k * V;
    for (int64_t j = 0; j < K; j++) {
        const double *apart = w->apart + 4 * (k * K + j), *drawn = w->drawn + 2 * (k * K + j);
        const double *restrict other = w->half + 2 * j * V;
        const double along = by[0] * apart[0] + by[1] * apart[1] + by[2] * apart[2];
        const double c = along * drawn[0], d = along * drawn[1];
        for (int64_t v = 0; j != k && v < V; v++) {
            const double re = half[v] * other[v] - half[V + v] * other[V + v];
            const double im = half[v] * other[V + v] + half[V + v] * other[v];
            const double moved = c * re - d * im, spun = c * im + d * re;
            out[v] += weight[v] * moved - weight[V + v] * spun;
            out[V + v] += weight[v] * spun + weight[V + v] * moved;
        }
    }
    for (int64_t v = 0; v < V; v++) {
        const double share = by[0] * toward[v] + by[1] * toward[V + v] + by[2] * toward[2 * V + v];
        const double re = half[v] * back[v] - half[V + v] * back[V + v];
        const double im = half[v] * back[V + v] + half[V + v] * back[v];
        const double moved = share * (0.5 * kappa * im - re / range[v]);
        const double spun = share * (-0.5 * kappa * re - im / range[v]);
        out[v] += weight[v] * moved - weight[V + v] * spun;
        out[V + v] += weight[v] * spun + weight[V + v] * moved;
    }
}

/* What holds at all frequencies. */
INLINE void prepare(const Problem *g, const Work *w)
{
    const int64_t V = g->v;
    const double *ax = g->views, *ay = ax + V, *az = ay + V, *direction = az + V;
    const double first = g->kappa[0], between = g->f > 1 ? g->kappa[1] - g->kappa[0] : 0.0;
    double place[3 * MOST];
    place_all(g, place);
    const int64_t first_odd = g->sources - g->odd;
    for (int64_t s = 0; s < g->sources; s++) {
        const double *seen = g->views + (s < first_odd ? 0 : 5 + s - first_odd) * V;
        const double px = place[3 * s], py = place[3 * s + 1], pz = place[3 * s + 2];
        double *restrict range = w->range + s * V, *restrict toward = w->toward + 3 * s * V;
        double *restrict wave = w->wave + 2 * s * V, *restrict step = w->step + 2 * s * V;
#pragma omp simd
        for (int64_t v = 0; v < V; v++) {
            const double dx = px - ax[v], dy = py - ay[v], dz = az[v] - pz;
            const double r = sqrt(dx * dx + dy * dy + dz * dz), path = r - g->distance;
            const double loss = g->distance / r * (g->distance / r) * (s < first_odd ? 1.0 : seen[v]);
            double re, im;
            range[v] = r, toward[v] = dx / r, toward[V + v] = dy / r, toward[2 * V + v] = -dz / r;
            wave_of(first * path, &re, &im);
            wave[v] = loss * re, wave[V + v] = loss * im;
            wave_of(between * path, &re, &im);
            step[v] = re, step[V + v] = im;
        }
    }
    if (g->bounces)
        prepare_bounces(g, w, place + 3 * (g->body > 0));
    for (int64_t k = 0; k < g->k; k++) {
        const double facing = g->tag[g->k + k] + g->x[g->head + g->group[k]];
        for (int64_t v = 0; v < V; v++) {
            const double at = (direction[v] - facing) * (ANGLES / 6.283185307179586), low = floor(at);
            w->part[k * V + v] = at - low;
            w->lower[k * V + v] = low - ANGLES * floor(low / ANGLES);
        }
    }
    for (int64_t v = 0; g->body > 1 && v < V; v++) {
        const double c = cos(2.0 * direction[v]), s = sin(2.0 * direction[v]);
        const double path = w->range[v] - g->distance - g->x[2] * c - g->x[3] * s;
        const double loss = g->distance / w->range[v] * (g->distance / w->range[v]);
        double re, im;
        wave_of(first * path, &re, &im);
        w->wave[v] = loss * re, w->wave[V + v] = loss * im;
        wave_of(between * path, &re, &im);
        w->step[v] = re, w->step[V + v] = im;
        w->oval[v] = c, w->oval[V + v] = s;
    }
}

/* Waves and patterns of frequency f, after those of f - 1. */
INLINE void at_frequency(const Problem *g, const Work *w, int64_t f, int with_slopes)
{
    const int64_t V = g->v;
    const double *seen = g->views + 4 * V, per_angle = ANGLES / 6.283185307179586;
    if (f > 0)
        advance(w->wave, w->step, g->sources, V);
    if (g->bounces)
        bounces_at(g, w, f);
    for (int64_t k = 0; k < g->k; k++)
        for (int64_t p = 0; p < g->p; p++) {
            const double *table = g->tables + 2 * (((g->group[2 * g->k + k] * g->p + p) * g->f + f) * ANGLES);
            double *restrict to = w->pattern + 2 * (k * g->p + p) * V;
            double *restrict turned = w->turned + 2 * (k * g->p + p) * V;
            for (int64_t v = 0; v < V; v++) {
                const int64_t low = (int64_t)w->lower[k * V + v], next = (low + 1) % ANGLES;
                const double re = table[2 * low], im = table[2 * low + 1], part = w->part[k * V + v];
                const double rise_re = table[2 * next] - re, rise_im = table[2 * next + 1] - im;
                to[v] = seen[v] * (re + rise_re * part);
                to[V + v] = seen[v] * (im + rise_im * part);
                if (with_slopes) {
                    turned[v] = seen[v] * rise_re * per_angle;
                    turned[V + v] = seen[v] * rise_im * per_angle;
                }
            }
        }
}

/* The planes of all columns. */
INLINE void columns_of(const Problem *g, const Work *w)
{
    const int64_t V = g->v;
    const double *wave = w->wave;
    double *to = w->columns;
    memset(to, 0, (size_t)(2 * g->n * V) * sizeof(double));
    for (int64_t b = 0; b < g->body; b++, to += 2 * V)
        for (int64_t v = 0; v < V; v++) {
            const double shape = b ? w->oval[(b - 1) * V + v] : 1.0;
            to[v] = wave[v] * shape, to[V + v] = wave[V + v] * shape;
        }
    wave += g->body ? 2 * V : 0;
    for (int64_t k = 0; k < g->k; k++) {
        for (int64_t p = 0; p < g->p; p++)
            add_product(w->pattern + 2 * (k * g->p + p) * V, wave + 2 * k * V, 1.0, V, to + 2 * p * V);
        if (g->k > 1)
            add_product(w->pattern + 2 * k * g->p * V, wave + 2 * k * V, 1.0, V, to + 2 * (g->p + g->bounces + k) * V);
        if (g->bounces)
            add_product(w->half + 2 * k * V, w->back + 2 * k * V, 1.0, V, to + 2 * g->p * V);
    }
    for (int64_t v = 0; g->bounces && v < 2 * V; v++)
        to[2 * g->p * V + v] *= 0.5; /* there and back are one path */
    to += g->k ? 2 * (g->p + g->bounces + (g->k > 1 ? g->k : 0)) * V : 0;
    memcpy(to, wave + 2 * g->k * V, (size_t)(2 * g->odd * V) * sizeof(double));
}

/* Slopes of a source whose patterns sum to `sum`, along two axes times the given shares, onto planes. */
INLINE void add_along(const Work *w, int64_t s, const double *restrict sum, double kappa, double along_x,
                      double along_y, const double *restrict toward, double *restrict out, int64_t V)
{
    const double *restrict wave = w->wave + 2 * s * V, *restrict range = w->range + s * V;
#pragma omp simd
    for (int64_t v = 0; v < V; v++) {
        const double re = sum[v] * wave[v] - sum[V + v] * wave[V + v];
        const double im = sum[v] * wave[V + v] + sum[V + v] * wave[v];
        const double share = along_x * toward[v] + along_y * toward[V + v], loss = -2.0 / range[v];
        out[v] += share * (loss * re + kappa * im);
        out[V + v] += share * (loss * im - kappa * re);
    }
}

/* The same along x and y. */
INLINE void add_slope(const Work *w, int64_t s, const double *sum, double kappa, double along_x,
                      double along_y, double *out, int64_t V)
{
    add_along(w, s, sum, kappa, along_x, along_y, w->toward + 3 * s * V, out, V);
}

/* The same upward: along y and z. */
INLINE void add_rise(const Work *w, int64_t s, const double *sum, double kappa, double *out, int64_t V)
{
    add_along(w, s, sum, kappa, 0.0, 1.0, w->toward + (3 * s + 1) * V, out, V);
}

/* Slopes (T, 2, V) of the sum of weights (N, 2, V) times columns; `scratch` (2, 2, V). */
INLINE void slopes_of(const Problem *g, const Work *w, int64_t f, const double *weight, double *scratch)
{
    const int64_t V = g->v, two = 2 * V;
    const double kappa = g->kappa[f];
    double *sum = scratch, *turned = scratch + two, *out = w->slopes;
    int64_t s = 0;
    memset(out, 0, (size_t)(g->t * two) * sizeof(double));
    if (g->body) {
        memcpy(sum, weight, (size_t)two * sizeof(double));
        for (int64_t b = 1; b < g->body; b++)
            for (int64_t v = 0; v < V; v++) {
                sum[v] += weight[b * two + v] * w->oval[(b - 1) * V + v];
                sum[V + v] += weight[b * two + V + v] * w->oval[(b - 1) * V + v];
            }
        add_slope(w, s, sum, kappa, 1.0, 0.0, out, V);
        add_slope(w, s, sum, kappa, 0.0, 1.0, out + two, V);
        for (int64_t b = 1; b < g->body; b++) /* the support function brings the echo nearer: j kappa */
            for (int64_t v = 0; v < V; v++) {
                const double nearer = kappa * w->oval[(b - 1) * V + v], *wave = w->wave;
                out[(b + 1) * two + v] -= nearer * (sum[v] * wave[V + v] + sum[V + v] * wave[v]);
                out[(b + 1) * two + V + v] += nearer * (sum[v] * wave[v] - sum[V + v] * wave[V + v]);
            }
        weight += g->body * two, s = 1;
    }
    for (int64_t k = 0; k < g->k; k++, s++) {
        const int64_t turn = g->group[k], stretch = g->group[g->k + k];
        const double facing = g->tag[g->k + k] + g->x[g->head + turn], c = cos(facing), d = sin(facing);
        const double radius = g->tag[k] + g->x[g->head + g->turns + stretch];
        memset(scratch, 0, (size_t)(2 * two) * sizeof(double));
        for (int64_t p = 0; p < g->p + (g->k > 1); p++) {
            const int64_t of = (k * g->p + (p < g->p ? p : 0)) * two, from = (p < g->p ? p : p + g->bounces + k) * two;
            add_product(w->pattern + of, weight + from, 1.0, V, sum);
            add_product(w->turned + of, weight + from, 1.0, V, turned);
        }
        for (int64_t v = 0; v < two; v++)
            turned[v] = -turned[v];
        double *spun = out + (g->head + turn) * two, *drawn = out + (g->head + g->turns + stretch) * two;
        add_slope(w, s, sum, kappa, 1.0, 0.0, out, V);
        add_slope(w, s, sum, kappa, 0.0, 1.0, out + two, V);
        add_slope(w, s, sum, kappa, -radius * d, radius * c, spun, V);
        add_slope(w, s, sum, kappa, c, d, drawn, V);
        add_product(turned, w->wave + s * two, 1.0, V, spun);
        double *risen = out + (g->head + g->turns + g->stretches + g->group[3 * g->k + k]) * two;
        if (g->lifts)
            add_rise(w, s, sum, kappa, risen, V);
        if (g->bounces) {
            const double *bounce = weight + g->p * two;
            add_bounce(g, w, k, bounce, kappa, (const double[3]){1.0, 0.0, 0.0}, out);
            add_bounce(g, w, k, bounce, kappa, (const double[3]){0.0, 1.0, 0.0}, out + two);
            add_bounce(g, w, k, bounce, kappa, (const double[3]){-radius * d, radius * c, 0.0}, spun);
            add_bounce(g, w, k, bounce, kappa, (const double[3]){c, d, 0.0}, drawn);
            if (g->lifts)
                add_bounce(g, w, k, bounce, kappa, (const double[3]){0.0, 0.0, 1.0}, risen);
        }
    }
    weight += g->k ? (g->p + g->bounces + (g->k > 1 ? g->k : 0)) * two : 0;
    out += (g->head + g->turns + g->stretches + g->lifts) * two;
    for (int64_t i = 0; i < g->odd; i++, s++, weight += two, out += g->spot * two) {
        add_slope(w, s, weight, kappa, 1.0, 0.0, out, V);
        add_slope(w, s, weight, kappa, 0.0, 1.0, out + two, V);
        if (g->spot > 2)
            add_rise(w, s, weight, kappa, out + 2 * two, V);
    }
}

#endif
