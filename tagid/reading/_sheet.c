/* The columns of a thin sheet and of reflectors about it, and their slopes.
 *
 * `tagid.fields.thin_shell` and `tagid.reading.sheet` hold the formulas, and do the same with numpy where no
 * compiler was present. Only the stable ABI and the buffer protocol are used.
 *
 * The system of the contour is made symmetric, S = 1 - k^2 s w^1/2 G w^1/2, so that one inverse P serves its
 * answers and their slopes: d (x^T P y) = dx^T P y + (P x)^T dy - (P x)^T dS (P y). What is even or odd about
 * each axis couples with itself only ("parts"). The sheet's own echo is the same in all four quadrants of
 * aspects: it is found at Q aspects of one, at a fixed distance, and interpolated by its harmonics. By
 * reciprocity every reflector costs one answer, for all antennas.
 *
 * The columns of planes are filled up to a multiple of UNIT.
 */
#include "_wave.h"
#include <stdlib.h>
#include <string.h>

#define UNIT 4     /* doubles of a vector */
#define SHAPES 3   /* columns of the sheet: powers of the cosine of incidence */
#define HEAD 6     /* parameters of the sheet */
#define MOST_CELLS 512 /* of a quadrant */
#define SUMS 8     /* of a reflector over the contour: the field, and its slopes over place, antenna and shape */
#define PADDED(count) (((count) + UNIT - 1) / UNIT * UNIT)

typedef double Four __attribute__((vector_size(8 * UNIT), aligned(8)));

typedef struct {
    const double *views;      /* (3 + odd, V) antenna x, y, height, and how much is seen of odd scatterers */
    const double *wavenumber; /* (F,) equally spaced */
    const double *unit;       /* (2, N) the first quadrant of the contour, over the half sizes */
    const double *table;      /* (entries, 2) G at equally spaced arguments */
    const double *tag;        /* (3, K) radius, angle, height */
    const int64_t *group;     /* (2, K) turn, stretch */
    const int64_t *past;      /* (odd,) whether an odd scatterer is seen past the sheet */
    const double *x;          /* (T,) parameters */
    const double *shape;      /* (6,) half sizes, strength, and their slopes over their parameters */
    double *values, *rates;   /* (F, C, V) and (T, F, C, V) complex */
    double distance, aspect_m, from, step; /* aspect_m: distance of the aspects from the sheet */
    int64_t v, f, n, entries, k, odd, t, round, q, turns, stretches, columns, sources, with_slopes;
} Sheet;

typedef struct {
    double *weight, *weight_a, *weight_b; /* (N,) length of a cell, and slopes of its logarithm */
    double *apart;                        /* (N, N, 4) of a cell and the images of another */
    double *range, *cosine;               /* (4, N, Q) from cells to aspects */
    double *range_a, *range_b, *cosine_a, *cosine_b;
    double *wave, *turn;                  /* (4, N, 2, Q) */
    double *echo;                         /* (SHAPES, 4, N, 2, Q) the field on the contour, weighted */
    double *answer;                       /* (SHAPES, 4, N, 2, Q) */
    double *pulled;                       /* (2, 4, N, 2, Q) slopes of S times the answer */
    double *system, *slope_a, *slope_b;   /* (4, N, N, 2) */
    double *from_q, *slope_q;             /* (Q, V) from aspects to views, and the slope over the angle */
    double *at_q;                         /* (4, SHAPES, 2, Q) echo, and slopes over both sizes and strength */
    double *at_v;                         /* (7, SHAPES, 2, V) and over x, y and turn */
    double *away;                         /* (5, V) distance from the sheet, direction x, y, antenna x, y */
    double *cell;                         /* (4, N, 7, V) of cells: 1 / range, direction x, y, wave, turn */
    double *place;                        /* (S, 5) x, y, height, and x, y in the sheet's frame */
    double *source;                       /* (S, 9, V) range, direction x, y, whole range, wave, turn, loss */
    double *near_wave;                    /* (S, 4, V) wave from antenna to place, and its turn */
    double *right, *solved, *moved;       /* (4, N, 2, L) of the reflectors; three columns each */
    double *by_size;                      /* (2, 4, N, 2, L) */
    double *sum;                          /* (SUMS, 2, V) */
    double *seen;                         /* (1 + SUMS, 2, V) a reflector's column, and its slopes */
} Work;

static int64_t lay_out(const Sheet *g, Work *w, double *base)
{
    double *at = base;
    const int64_t N = g->n, Q = g->q, V = PADDED(g->v), S = g->sources, L = PADDED(3 * S), each = 4 * N * Q;
    w->weight = room(&at, N), w->weight_a = room(&at, N), w->weight_b = room(&at, N);
    w->apart = room(&at, 4 * N * N);
    w->range = room(&at, each), w->cosine = room(&at, each);
    w->range_a = room(&at, each), w->range_b = room(&at, each);
    w->cosine_a = room(&at, each), w->cosine_b = room(&at, each);
    w->wave = room(&at, 2 * each), w->turn = room(&at, 2 * each);
    w->echo = room(&at, 2 * SHAPES * each), w->answer = room(&at, 2 * SHAPES * each);
    w->pulled = room(&at, 4 * each);
    w->system = room(&at, 8 * N * N), w->slope_a = room(&at, 8 * N * N), w->slope_b = room(&at, 8 * N * N);
    w->from_q = room(&at, Q * V), w->slope_q = room(&at, Q * V);
    w->at_q = room(&at, 8 * SHAPES * Q), w->at_v = room(&at, 14 * SHAPES * V);
    w->away = room(&at, 5 * V), w->cell = room(&at, S ? 28 * N * V : 0);
    w->place = room(&at, 5 * S), w->source = room(&at, 9 * S * V), w->near_wave = room(&at, 4 * S * V);
    w->right = room(&at, 8 * N * L), w->solved = room(&at, 8 * N * L), w->moved = room(&at, 8 * N * L);
    w->by_size = room(&at, 16 * N * L);
    w->sum = room(&at, 2 * SUMS * V), w->seen = room(&at, 2 * (1 + SUMS) * V);
    return at - base;
}

/* Values of a quadrant and its images left, down and both, `stride` apart, to parts, even or odd about each
 * axis; but for a factor of 4 its own inverse. */
INLINE void parts_of(double *at, int64_t stride, int64_t count)
{
    double *restrict a = at, *restrict b = at + stride, *restrict c = b + stride, *restrict d = c + stride;
#pragma omp simd
    for (int64_t i = 0; i < count; i++) {
        const double left = a[i] + b[i], right = c[i] + d[i], odd = a[i] - b[i], other = c[i] - d[i];
        a[i] = left + right, b[i] = odd + other, c[i] = left - right, d[i] = odd - other;
    }
}

/* a (N, N, 2) times x (N, 2, Q). */
INLINE void times(const double *a, const double *x, int64_t N, int64_t Q, double *out)
{
    for (int64_t q = 0; q < Q; q += UNIT)
        for (int64_t i = 0; i < N; i += 2) {
            const int64_t other = i + 1 < N ? i + 1 : i;
            Four re = {0}, im = {0}, re2 = {0}, im2 = {0};
            for (int64_t j = 0; j < N; j++) {
                const Four xr = *(const Four *)(x + 2 * j * Q + q), xi = *(const Four *)(x + (2 * j + 1) * Q + q);
                const double *b = a + 2 * (i * N + j), *c = a + 2 * (other * N + j);
                re += b[0] * xr - b[1] * xi, im += b[0] * xi + b[1] * xr;
                re2 += c[0] * xr - c[1] * xi, im2 += c[0] * xi + c[1] * xr;
            }
            *(Four *)(out + 2 * i * Q + q) = re, *(Four *)(out + (2 * i + 1) * Q + q) = im;
            *(Four *)(out + 2 * other * Q + q) = re2, *(Four *)(out + (2 * other + 1) * Q + q) = im2;
        }
}

/* The inverse of a (N, N, 2) in place, by pivots of the largest size in their column. */
INLINE void invert(double *a, int64_t N)
{
    int64_t order[MOST_CELLS];
    for (int64_t c = 0; c < N; c++) {
        int64_t best = c;
        double size = -1.0;
        for (int64_t i = c; i < N; i++) {
            const double *e = a + 2 * (i * N + c), here = e[0] * e[0] + e[1] * e[1];
            if (here > size)
                size = here, best = i;
        }
        order[c] = best;
        double *restrict own = a + 2 * c * N, *restrict swap = a + 2 * best * N;
        for (int64_t j = 0; best != c && j < 2 * N; j++) {
            const double held = own[j];
            own[j] = swap[j], swap[j] = held;
        }
        const double re = own[2 * c] / size, im = -own[2 * c + 1] / size;
        own[2 * c] = 1.0, own[2 * c + 1] = 0.0;
#pragma omp simd
        for (int64_t j = 0; j < N; j++) {
            const double b = own[2 * j], d = own[2 * j + 1];
            own[2 * j] = b * re - d * im, own[2 * j + 1] = b * im + d * re;
        }
        for (int64_t i = 0; i < N; i++) {
            if (i == c)
                continue;
            double *restrict row = a + 2 * i * N;
            const double fr = row[2 * c], fi = row[2 * c + 1];
            row[2 * c] = row[2 * c + 1] = 0.0;
#pragma omp simd
            for (int64_t j = 0; j < N; j++) {
                row[2 * j] -= own[2 * j] * fr - own[2 * j + 1] * fi;
                row[2 * j + 1] -= own[2 * j] * fi + own[2 * j + 1] * fr;
            }
        }
    }
    for (int64_t c = N - 1; c >= 0; c--)
        for (int64_t i = 0; order[c] != c && i < N; i++)
            for (int64_t r = 0; r < 2; r++) {
                double *one = a + 2 * (i * N + c) + r, *two = a + 2 * (i * N + order[c]) + r, held = *one;
                *one = *two, *two = held;
            }
}

/* G and its slope at an argument. */
INLINE void line_source(const Sheet *g, double x, double *value, double *slope)
{
    double at = (x - g->from) / g->step;
    at = at < 0.0 ? 0.0 : at > (double)(g->entries - 2) ? (double)(g->entries - 2) : at;
    const int64_t low = (int64_t)at;
    const double part = at - (double)low, *here = g->table + 2 * low;
    for (int r = 0; r < 2; r++) {
        const double rise = here[2 + r] - here[r];
        value[r] = here[r] + part * rise;
        slope[r] = rise / g->step;
    }
}

INLINE double sign_x(int64_t image) { return image & 1 ? -1.0 : 1.0; }
INLINE double sign_y(int64_t image) { return image & 2 ? -1.0 : 1.0; }

/* The contour, and ranges from its cells to the aspects. */
INLINE void prepare_contour(const Sheet *g, const Work *w)
{
    const int64_t N = g->n, Q = g->q;
    const double a = g->shape[0], b = g->shape[1], between = g->f > 1 ? g->wavenumber[1] - g->wavenumber[0] : 0.0;
    for (int64_t i = 0; i < N; i++) {
        const double u = g->unit[i], v = g->unit[N + i], h2 = a * v * a * v + b * u * b * u, h = sqrt(h2);
        double normal[2], normal_a[2] = {0}, normal_b[2] = {0};
        if (g->round) {
            w->weight[i] = h * 6.283185307179586 / (double)(4 * N);
            w->weight_a[i] = a * v * v / h2, w->weight_b[i] = b * u * u / h2;
            normal[0] = b * u / h, normal[1] = a * v / h;
            normal_a[0] = -normal[0] * w->weight_a[i], normal_a[1] = v / h - normal[1] * w->weight_a[i];
            normal_b[0] = u / h - normal[0] * w->weight_b[i], normal_b[1] = -normal[1] * w->weight_b[i];
        } else {
            const int upright = fabs(u) == 1.0;
            w->weight[i] = (upright ? b : a) * 2.0 / (double)N;
            w->weight_a[i] = upright ? 0.0 : 1.0 / a, w->weight_b[i] = upright ? 1.0 / b : 0.0;
            normal[0] = upright ? u : 0.0, normal[1] = upright ? 0.0 : v;
        }
        for (int64_t j = 0; j < N; j++)
            for (int64_t m = 0; m < 4; m++) {
                const double dx = a * (u - sign_x(m) * g->unit[j]), dy = b * (v - sign_y(m) * g->unit[N + j]);
                w->apart[4 * (i * N + j) + m] = sqrt(dx * dx + dy * dy);
            }
        for (int64_t m = 0; m < 4; m++) {
            const double ux = sign_x(m) * u, uy = sign_y(m) * v;
            const int64_t at = (m * N + i) * Q;
            double *wave = w->wave + 2 * at, *turn = w->turn + 2 * at;
            for (int64_t q = 0; q < Q; q++) {
                const double angle = 1.5707963267948966 * ((double)q + 0.5) / (double)Q;
                const double dx = g->aspect_m * cos(angle) - a * ux, dy = g->aspect_m * sin(angle) - b * uy;
                const double r = sqrt(dx * dx + dy * dy), nx = sign_x(m) * normal[0], ny = sign_y(m) * normal[1];
                const double c = (dx * nx + dy * ny) / r, ra = -ux * dx / r, rb = -uy * dy / r;
                w->range[at + q] = r, w->cosine[at + q] = c, w->range_a[at + q] = ra, w->range_b[at + q] = rb;
                w->cosine_a[at + q] =
                    (-ux * nx + dx * sign_x(m) * normal_a[0] + dy * sign_y(m) * normal_a[1] - c * ra) / r;
                w->cosine_b[at + q] =
                    (-uy * ny + dx * sign_x(m) * normal_b[0] + dy * sign_y(m) * normal_b[1] - c * rb) / r;
                double re, im;
                wave_of(g->wavenumber[0] * r, &re, &im);
                wave[q] = re / r, wave[Q + q] = im / r;
                wave_of(between * r, &re, &im);
                turn[q] = re, turn[Q + q] = im;
            }
        }
    }
}

/* From aspects to views: by harmonics that are even about both axes. */
INLINE void prepare_views(const Sheet *g, const Work *w)
{
    const int64_t Q = g->q, V = PADDED(g->v);
    const double c = cos(g->x[2]), s = sin(g->x[2]);
    for (int64_t v = 0; v < V; v++) {
        const int64_t of = v < g->v ? v : 0;
        const double dx = g->views[of] - g->x[0], dy = g->views[g->v + of] - g->x[1], d = sqrt(dx * dx + dy * dy);
        w->away[v] = d, w->away[V + v] = dx / d, w->away[2 * V + v] = dy / d;
        w->away[3 * V + v] = c * dx + s * dy, w->away[4 * V + v] = c * dy - s * dx;
    }
    /* The harmonic m and the next one, from the two before. */
    double *cosine = w->sum, *sine = cosine + V, *first = sine + V, *second = first + V;
    for (int64_t v = 0; v < V; v++) {
        const double x = w->away[3 * V + v], y = w->away[4 * V + v], r2 = x * x + y * y;
        cosine[v] = 1.0, sine[v] = 0.0, first[v] = (x * x - y * y) / r2, second[v] = 2.0 * x * y / r2;
    }
    memset(w->from_q, 0, (size_t)(Q * V) * sizeof(double));
    memset(w->slope_q, 0, (size_t)(Q * V) * sizeof(double));
    for (int64_t m = 0; m < Q; m++) {
        for (int64_t q = 0; q < Q; q++) {
            const double angle = 3.141592653589793 * (double)m * ((double)q + 0.5) / (double)Q;
            const double share = (m ? 2.0 : 1.0) / (double)Q * cos(angle), steep = -2.0 * (double)m * share;
            double *restrict to = w->from_q + q * V, *restrict slope = w->slope_q + q * V;
#pragma omp simd
            for (int64_t v = 0; v < V; v++)
                to[v] += share * cosine[v], slope[v] += steep * sine[v];
        }
#pragma omp simd
        for (int64_t v = 0; v < V; v++) {
            const double held = cosine[v];
            cosine[v] = held * first[v] - sine[v] * second[v];
            sine[v] = held * second[v] + sine[v] * first[v];
        }
    }
}

/* Places of the reflectors and odd scatterers, their ranges, and those of the cells, from all antennas. */
INLINE void prepare_reflectors(const Sheet *g, const Work *w)
{
    const int64_t V = PADDED(g->v), S = g->sources, N = g->n;
    const double between = g->f > 1 ? g->wavenumber[1] - g->wavenumber[0] : 0.0;
    const double c = cos(g->x[2]), s = sin(g->x[2]), middle_x = g->x[0] + g->x[HEAD], middle_y = g->x[1] + g->x[HEAD + 1];
    const double *turn = g->x + HEAD + 2, *stretch = turn + g->turns, *odd = stretch + g->stretches;
    for (int64_t k = 0; k < S; k++) {
        double *to = w->place + 5 * k;
        if (k < g->k) {
            const double facing = g->tag[g->k + k] + turn[g->group[k]];
            const double radius = g->tag[k] + stretch[g->group[g->k + k]];
            to[0] = middle_x + radius * cos(facing), to[1] = middle_y + radius * sin(facing);
            to[2] = g->tag[2 * g->k + k];
        } else
            to[0] = odd[2 * (k - g->k)], to[1] = odd[2 * (k - g->k) + 1], to[2] = 0.0;
        const double x = to[0] - g->x[0], y = to[1] - g->x[1];
        to[3] = c * x + s * y, to[4] = c * y - s * x;
        double *source = w->source + 9 * k * V, *near_wave = w->near_wave + 4 * k * V;
        for (int64_t v = 0; v < V; v++) {
            const int64_t of = v < g->v ? v : 0;
            const double dx = g->views[of] - to[0], dy = g->views[g->v + of] - to[1];
            const double dz = g->views[2 * g->v + of] - to[2], flat = sqrt(dx * dx + dy * dy);
            const double seen = k < g->k ? 1.0 : g->views[(3 + k - g->k) * g->v + of];
            const double whole = sqrt(flat * flat + dz * dz);
            const double loss = g->distance / whole * (g->distance / whole) * seen;
            double re, im;
            source[v] = flat, source[V + v] = dx / flat, source[2 * V + v] = dy / flat, source[3 * V + v] = whole;
            wave_of(2.0 * g->wavenumber[0] * (whole - g->distance), &re, &im);
            source[4 * V + v] = loss * re, source[5 * V + v] = loss * im;
            wave_of(2.0 * between * (whole - g->distance), &re, &im);
            source[6 * V + v] = re, source[7 * V + v] = im;
            wave_of(g->wavenumber[0] * flat, &re, &im);
            near_wave[v] = re, near_wave[V + v] = im;
            wave_of(between * flat, &re, &im);
            near_wave[2 * V + v] = re, near_wave[3 * V + v] = im;
        }
    }
    for (int64_t i = 0; S && i < 4 * N; i++) {
        const int64_t m = i / N, of = i % N;
        const double px = sign_x(m) * g->shape[0] * g->unit[of], py = sign_y(m) * g->shape[1] * g->unit[N + of];
        double *restrict cell = w->cell + 7 * i * V;
#pragma omp simd
        for (int64_t v = 0; v < V; v++) {
            const double dx = w->away[3 * V + v] - px, dy = w->away[4 * V + v] - py, r = sqrt(dx * dx + dy * dy);
            double re, im;
            cell[v] = 1.0 / r, cell[V + v] = dx / r, cell[2 * V + v] = dy / r;
            wave_of(g->wavenumber[0] * r, &re, &im);
            cell[3 * V + v] = re / r, cell[4 * V + v] = im / r;
            wave_of(between * r, &re, &im);
            cell[5 * V + v] = re, cell[6 * V + v] = im;
        }
    }
}

/* The inverse of the contour's system, and its slopes over both half sizes, in parts. */
INLINE void solve(const Sheet *g, const Work *w, double k)
{
    const int64_t N = g->n, part = 2 * N * N;
    const double a = g->shape[0], b = g->shape[1], strength = k * k * g->shape[2];
    for (int64_t i = 0; i < N; i++)
        for (int64_t j = 0; j <= i; j++) {
            double value[4][2], over_a[4][2], over_b[4][2];
            for (int64_t m = 0; m < 4; m++) {
                const double r = w->apart[4 * (i * N + j) + m];
                if (i == j && m == 0) {
                    /* The mean of Hankel's function over a cell about its singularity, by its leading terms. */
                    const double size = w->weight[i];
                    value[0][0] = -(log(k * size / 4.0) + 0.5772156649015329 - 1.0) / 6.283185307179586;
                    value[0][1] = -0.25;
                    over_a[0][0] = -w->weight_a[i] / 6.283185307179586, over_a[0][1] = 0.0;
                    over_b[0][0] = -w->weight_b[i] / 6.283185307179586, over_b[0][1] = 0.0;
                    continue;
                }
                double slope[2];
                line_source(g, k * r, value[m], slope);
                if (!g->with_slopes)
                    continue;
                const double dx = a * (g->unit[i] - sign_x(m) * g->unit[j]);
                const double dy = b * (g->unit[N + i] - sign_y(m) * g->unit[N + j]);
                for (int64_t c = 0; c < 2; c++) {
                    over_a[m][c] = k * slope[c] * dx * dx / (a * r);
                    over_b[m][c] = k * slope[c] * dy * dy / (b * r);
                }
            }
            parts_of(value[0], 2, 2);
            const double scale = strength * sqrt(w->weight[i] * w->weight[j]);
            const int64_t at = 2 * (i * N + j), back = 2 * (j * N + i);
            for (int64_t p = 0; p < 4; p++)
                for (int64_t c = 0; c < 2; c++)
                    w->system[p * part + at + c] = w->system[p * part + back + c] =
                        (i == j && c == 0 ? 1.0 : 0.0) - scale * value[p][c];
            if (!g->with_slopes)
                continue;
            const double length_a = 0.5 * (w->weight_a[i] + w->weight_a[j]);
            const double length_b = 0.5 * (w->weight_b[i] + w->weight_b[j]);
            parts_of(over_a[0], 2, 2);
            parts_of(over_b[0], 2, 2);
            for (int64_t p = 0; p < 4; p++)
                for (int64_t c = 0; c < 2; c++) {
                    w->slope_a[p * part + at + c] = w->slope_a[p * part + back + c] =
                        -scale * (over_a[p][c] + length_a * value[p][c]);
                    w->slope_b[p * part + at + c] = w->slope_b[p * part + back + c] =
                        -scale * (over_b[p][c] + length_b * value[p][c]);
                }
        }
    for (int64_t p = 0; p < 4; p++)
        invert(w->system + p * part, N);
}

/* The echo at the aspects, and its slopes over both sizes and the strength. */
INLINE void echo(const Sheet *g, const Work *w, double k)
{
    const int64_t N = g->n, Q = g->q, part = 2 * N * Q, whole = 4 * part, square = 2 * N * N;
    for (int64_t i = 0; i < 4 * N; i++) {
        const double root = sqrt(w->weight[i % N]);
        const double *restrict wave = w->wave + 2 * i * Q, *restrict cosine = w->cosine + i * Q;
        for (int64_t c = 0; c < 2; c++) {
            double *restrict to = w->echo + (2 * i + c) * Q;
#pragma omp simd
            for (int64_t q = 0; q < Q; q++) {
                const double e = root * wave[c * Q + q];
                to[q] = e, to[whole + q] = e * cosine[q], to[2 * whole + q] = e * cosine[q] * cosine[q];
            }
        }
    }
    memset(w->at_q, 0, (size_t)(8 * SHAPES * Q) * sizeof(double));
    for (int64_t j = 0; j < SHAPES; j++) {
        double *in = w->echo + j * whole, *out = w->answer + j * whole;
        parts_of(in, part, part);
        for (int64_t p = 0; p < 4 && (j == 0 || g->with_slopes); p++)
            times(w->system + p * square, in + p * part, N, Q, out + p * part);
        double *sum = w->at_q + 2 * j * Q;
        for (int64_t i = 0; i < 4 * N; i++)
            add_product(in + 2 * i * Q, w->answer + 2 * i * Q, 0.25, Q, sum);
    }
    if (!g->with_slopes)
        return;
    for (int64_t p = 0; p < 4; p++) {
        times(w->slope_a + p * square, w->answer + p * part, N, Q, w->pulled + p * part);
        times(w->slope_b + p * square, w->answer + p * part, N, Q, w->pulled + whole + p * part);
    }
    const int64_t rows = 2 * SHAPES * Q;
    for (int64_t j = 0; j < SHAPES; j++) {
        double *over_a = w->at_q + rows + 2 * j * Q, *over_b = over_a + rows, *over_s = over_b + rows;
        for (int64_t q = 0; q < 2 * Q; q++)
            over_s[q] = -w->at_q[2 * j * Q + q];
        for (int64_t i = 0; i < 4 * N; i++) {
            const double *own = w->answer + j * whole + 2 * i * Q;
            add_product(own, w->pulled + 2 * i * Q, -0.25, Q, over_a);
            add_product(own, w->pulled + whole + 2 * i * Q, -0.25, Q, over_b);
            add_product(own, w->answer + 2 * i * Q, 0.25, Q, over_s);
        }
    }
    for (int64_t j = 0; j < SHAPES; j++)
        parts_of(w->answer + j * whole, part, part);
    for (int64_t i = 0; i < 4 * N; i++) {
        const double root = 0.25 * sqrt(w->weight[i % N]);
        const double half_a = 0.5 * w->weight_a[i % N], half_b = 0.5 * w->weight_b[i % N];
        const double *wave = w->wave + 2 * i * Q, *first = w->answer + 2 * i * Q;
        for (int64_t q = 0; q < Q; q++) {
            const int64_t at = i * Q + q;
            const double c = w->cosine[at], loss = 1.0 / w->range[at];
            /* the wave's relative slope is half + (-j k - loss) dr */
            const double over_a[2] = {half_a - loss * w->range_a[at], -k * w->range_a[at]};
            const double over_b[2] = {half_b - loss * w->range_b[at], -k * w->range_b[at]};
            const double er = root * wave[q], ei = root * wave[Q + q], ur = first[q], ui = first[Q + q];
            const double zr = er * ur - ei * ui, zi = er * ui + ei * ur;
            double power = 1.0, below = 0.0;
            for (int64_t j = 0; j < SHAPES; j++) {
                const double *own = w->answer + j * whole + 2 * i * Q;
                const double xr = power * ur + own[q], xi = power * ui + own[Q + q];
                const double yr = er * xr - ei * xi, yi = er * xi + ei * xr;
                double *to_a = w->at_q + rows + 2 * j * Q + q, *to_b = to_a + rows;
                to_a[0] += over_a[0] * yr - over_a[1] * yi + below * w->cosine_a[at] * zr;
                to_a[Q] += over_a[0] * yi + over_a[1] * yr + below * w->cosine_a[at] * zi;
                to_b[0] += over_b[0] * yr - over_b[1] * yi + below * w->cosine_b[at] * zr;
                to_b[Q] += over_b[0] * yi + over_b[1] * yr + below * w->cosine_b[at] * zi;
                below = (double)(j + 1) * power, power *= c;
            }
        }
    }
}

/* Adds planes times a factor to one column of frequency f of values (F, C, V). */
INLINE void put(const Sheet *g, double *to, int64_t f, int64_t column, const double *planes, double factor)
{
    const int64_t V = PADDED(g->v);
    double *out = to + 2 * (f * g->columns + column) * g->v;
    for (int64_t v = 0; v < g->v; v++)
        out[2 * v] += factor * planes[v], out[2 * v + 1] += factor * planes[V + v];
}

/* The same of rates over a parameter. */
INLINE void put_rate(const Sheet *g, int64_t row, int64_t f, int64_t column, const double *planes, double factor)
{
    put(g, g->rates + 2 * row * g->f * g->columns * g->v, f, column, planes, factor);
}

/* The columns of the sheet from the antennas, of unit energy for the first. */
INLINE void sheet_seen(const Sheet *g, const Work *w, int64_t f)
{
    const int64_t V = PADDED(g->v), Q = g->q, count = g->with_slopes ? 7 : 1;
    const double kappa = 2.0 * g->wavenumber[f];
    memset(w->at_v, 0, (size_t)(14 * SHAPES * V) * sizeof(double));
    for (int64_t l = 0; l < (g->with_slopes ? 8 : 2) * SHAPES; l++) {
        double *restrict to = w->at_v + l * V, *restrict turned = w->at_v + (12 * SHAPES + l) * V;
        const int steep = g->with_slopes && l < 2 * SHAPES;
        for (int64_t q = 0; q < Q; q++) {
            const double e = w->at_q[l * Q + q];
            const double *restrict from = w->from_q + q * V, *restrict slope = w->slope_q + q * V;
#pragma omp simd
            for (int64_t v = 0; v < V; v++)
                to[v] += e * from[v];
            if (steep) {
#pragma omp simd
                for (int64_t v = 0; v < V; v++)
                    turned[v] += e * slope[v];
            }
        }
    }
    /* Rows are now value, over a, b and s, two empty ones, and over the angle. */
    double change[7] = {0};
    for (int64_t j = 0; j < SHAPES; j++)
        for (int64_t v = 0; v < V; v++) {
            const double d = w->away[v], ux = w->away[V + v], uy = w->away[2 * V + v];
            const double loss = g->aspect_m / d * (g->aspect_m / d);
            double *at = w->at_v + 2 * j * V + v, re, im;
            wave_of(kappa * (d - g->aspect_m), &re, &im);
            re *= loss, im *= loss;
            for (int64_t i = 0; i < count; i++) {
                double *here = at + 2 * i * SHAPES * V;
                const double held = here[0];
                here[0] = held * re - here[V] * im, here[V] = held * im + here[V] * re;
            }
            if (g->with_slopes) {
                /* distance and angle of the antenna change with the centre */
                double *x = at + 8 * SHAPES * V, *y = x + 2 * SHAPES * V, *angle = y + 2 * SHAPES * V;
                const double fall = 2.0 / d, over_r = -fall * at[0] + kappa * at[V], over_i = -fall * at[V] - kappa * at[0];
                x[0] = -ux * over_r + uy / d * angle[0], x[V] = -ux * over_i + uy / d * angle[V];
                y[0] = -uy * over_r - ux / d * angle[0], y[V] = -uy * over_i - ux / d * angle[V];
                angle[0] = -angle[0], angle[V] = -angle[V];
            }
            for (int64_t i = 0; j == 0 && v < g->v && i < count; i++) {
                const double *here = at + 2 * i * SHAPES * V;
                change[i] += here[0] * at[0] + here[V] * at[V];
            }
        }
    const double energy = change[0], unit = sqrt((double)g->v / energy);
    static const int64_t row_of[7] = {0, 3, 4, 5, 0, 1, 2};
    for (int64_t i = count - 1; i >= 0; i--)
        for (int64_t j = 0; j < SHAPES; j++) {
            double *here = w->at_v + 2 * (i * SHAPES + j) * V;
            const double *value = w->at_v + 2 * j * V, share = i ? change[i] / energy : 0.0;
            const double steep = unit * (i == 1 ? g->shape[3] : i == 2 ? g->shape[4] : i == 3 ? g->shape[5] : 1.0);
            for (int64_t v = 0; v < 2 * V; v++)
                here[v] = steep * (here[v] - share * value[v]);
            if (i)
                put_rate(g, row_of[i], f, j, here, 1.0);
            else
                put(g, g->values, f, j, here, 1.0);
        }
}

/* What every reflector needs of the contour: answers to a source at its place, and their slopes. */
INLINE void answer_sources(const Sheet *g, const Work *w, double k)
{
    const int64_t N = g->n, S = g->sources, L = PADDED(3 * S), part = 2 * N * L, square = 2 * N * N;
    const double strength = k * k * g->shape[2];
    memset(w->right, 0, (size_t)(4 * part) * sizeof(double));
    memset(w->by_size, 0, (size_t)(8 * part) * sizeof(double));
    for (int64_t i = 0; i < 4 * N; i++) {
        const int64_t m = i / N, of = i % N;
        const double ux = sign_x(m) * g->unit[of], uy = sign_y(m) * g->unit[N + of];
        const double scale = strength * sqrt(w->weight[of]);
        double *right = w->right + 2 * i * L, *over_a = w->by_size + 2 * i * L, *over_b = over_a + 4 * part;
        for (int64_t s = 0; s < S; s++) {
            const double dx = w->place[5 * s + 3] - g->shape[0] * ux, dy = w->place[5 * s + 4] - g->shape[1] * uy;
            const double r = sqrt(dx * dx + dy * dy), safe = r > 1e-9 ? r : 1e-9;
            double value[2], slope[2];
            line_source(g, k * r, value, slope);
            for (int64_t c = 0; c < 2; c++) {
                const double rise = scale * k * slope[c] / safe;
                right[c * L + 3 * s] = scale * value[c];
                right[c * L + 3 * s + 1] = rise * dx, right[c * L + 3 * s + 2] = rise * dy;
                over_a[c * L + 3 * s] = 0.5 * w->weight_a[of] * scale * value[c] - rise * dx * ux;
                over_b[c * L + 3 * s] = 0.5 * w->weight_b[of] * scale * value[c] - rise * dy * uy;
            }
        }
    }
    parts_of(w->right, part, part);
    for (int64_t p = 0; p < 4; p++)
        times(w->system + p * square, w->right + p * part, N, L, w->solved + p * part);
    if (g->with_slopes) {
        parts_of(w->by_size, part, part);
        parts_of(w->by_size + 4 * part, part, part);
        for (int64_t c = 0; c < 2; c++)
            for (int64_t p = 0; p < 4; p++) {
                times((c ? w->slope_b : w->slope_a) + p * square, w->solved + p * part, N, L, w->moved + p * part);
                double *right = w->by_size + (4 * c + p) * part;
                for (int64_t i = 0; i < part; i++)
                    right[i] -= w->moved[p * part + i];
            }
        /* Columns over a, b and the strength, in w->right. */
        for (int64_t i = 0; i < 8 * N; i++)
            for (int64_t s = 0; s < S; s++) {
                double *to = w->right + i * L + 3 * s;
                to[0] = w->by_size[i * L + 3 * s], to[1] = w->by_size[4 * part + i * L + 3 * s];
                to[2] = w->solved[i * L + 3 * s];
            }
        for (int64_t p = 0; p < 4; p++)
            times(w->system + p * square, w->right + p * part, N, L, w->moved + p * part);
        parts_of(w->moved, part, part);
    }
    parts_of(w->solved, part, part);
}

/* What the sheet adds to the field at a reflector, and its slopes, from all antennas. */
INLINE void field_at(const Sheet *g, const Work *w, double k, int64_t s)
{
    const int64_t N = g->n, V = PADDED(g->v), L = PADDED(3 * g->sources);
    memset(w->sum, 0, (size_t)(2 * SUMS * V) * sizeof(double));
    for (int64_t i = 0; i < 4 * N; i++) {
        const int64_t m = i / N, of = i % N;
        const double root = 0.25 * sqrt(w->weight[of]);
        const double half_a = 0.5 * w->weight_a[of], half_b = 0.5 * w->weight_b[of];
        const double ux = sign_x(m) * g->unit[of], uy = sign_y(m) * g->unit[N + of];
        const double *restrict cell = w->cell + 7 * i * V;
        const double *q = w->solved + 2 * i * L + 3 * s, *d = w->moved + 2 * i * L + 3 * s;
        double *restrict sum = w->sum;
        double re[6], im[6];
        for (int64_t c = 0; c < 3; c++) {
            re[c] = root * q[c], im[c] = root * q[L + c];
            re[3 + c] = root * d[c], im[3 + c] = root * d[L + c];
        }
        re[3] += half_a * re[0], im[3] += half_a * im[0], re[4] += half_b * re[0], im[4] += half_b * im[0];
        if (!g->with_slopes) {
#pragma omp simd
            for (int64_t v = 0; v < V; v++) {
                const double er = cell[3 * V + v], ei = cell[4 * V + v];
                sum[v] += re[0] * er - im[0] * ei, sum[V + v] += re[0] * ei + im[0] * er;
            }
            continue;
        }
#pragma omp simd
        for (int64_t v = 0; v < V; v++) {
            const double er = cell[3 * V + v], ei = cell[4 * V + v], dx = cell[V + v], dy = cell[2 * V + v];
            const double zr = re[0] * er - im[0] * ei, zi = re[0] * ei + im[0] * er;
            const double tr = k * zi - cell[v] * zr, ti = -k * zr - cell[v] * zi;
            sum[v] += zr, sum[V + v] += zi;
            sum[2 * V + v] += re[1] * er - im[1] * ei, sum[3 * V + v] += re[1] * ei + im[1] * er;
            sum[4 * V + v] += re[2] * er - im[2] * ei, sum[5 * V + v] += re[2] * ei + im[2] * er;
            sum[6 * V + v] += tr * dx, sum[7 * V + v] += ti * dx;
            sum[8 * V + v] += tr * dy, sum[9 * V + v] += ti * dy;
            sum[10 * V + v] += re[3] * er - im[3] * ei - ux * dx * tr;
            sum[11 * V + v] += re[3] * ei + im[3] * er - ux * dx * ti;
            sum[12 * V + v] += re[4] * er - im[4] * ei - uy * dy * tr;
            sum[13 * V + v] += re[4] * ei + im[4] * er - uy * dy * ti;
            sum[14 * V + v] += re[5] * er - im[5] * ei, sum[15 * V + v] += re[5] * ei + im[5] * er;
        }
    }
}

/* Adds what is seen of a reflector, and its slopes, to a column. */
INLINE void put_seen(const Sheet *g, const Work *w, int64_t f, int64_t s, int64_t column)
{
    const int64_t V = PADDED(g->v);
    const double *seen = w->seen, *along_x = seen + 2 * V, *along_y = along_x + 2 * V;
    put(g, g->values, f, column, seen, 1.0);
    if (!g->with_slopes)
        return;
    for (int64_t l = 2; l < SUMS; l++)
        put_rate(g, l - 2, f, column, seen + 2 * (l + 1) * V, 1.0);
    int64_t row = g->t - 2 * (g->sources - s);
    double out_x = 1.0, out_y = 0.0;
    if (s < g->k) {
        const int64_t turn = HEAD + 2 + g->group[s], stretch = HEAD + 2 + g->turns + g->group[g->k + s];
        const double facing = g->tag[g->k + s] + g->x[turn], radius = g->tag[s] + g->x[stretch];
        out_x = cos(facing), out_y = sin(facing);
        put_rate(g, 0, f, column, along_x, 1.0), put_rate(g, 1, f, column, along_y, 1.0);
        put_rate(g, turn, f, column, along_x, -radius * out_y), put_rate(g, turn, f, column, along_y, radius * out_x);
        put_rate(g, stretch, f, column, along_x, out_x), put_rate(g, stretch, f, column, along_y, out_y);
        row = HEAD;
    }
    put_rate(g, row, f, column, along_x, 1.0), put_rate(g, row + 1, f, column, along_y, 1.0);
}

/* The columns of a reflector: the square of the field at its place. */
INLINE void reflector_seen(const Sheet *g, const Work *w, int64_t f, int64_t s)
{
    const int64_t V = PADDED(g->v);
    const double k = g->wavenumber[f], c = cos(g->x[2]), n = sin(g->x[2]);
    const double *place = w->place + 5 * s, *source = w->source + 9 * s * V, *wave = w->near_wave + 4 * s * V;
    const double *sum = w->sum;
    double *seen = w->seen;
    for (int64_t v = 0; v < V; v++) {
        const double r = source[v], ux = source[V + v], uy = source[2 * V + v], whole = source[3 * V + v];
        const double dr = source[4 * V + v], di = source[5 * V + v];
        const double er = r * wave[v], ei = -r * wave[V + v]; /* 1 / the incident field */
        double at[2 * SUMS];
        for (int64_t l = 0; l < (g->with_slopes ? SUMS : 1); l++) {
            const double re = sum[2 * l * V + v], im = sum[(2 * l + 1) * V + v];
            at[2 * l] = re * er - im * ei, at[2 * l + 1] = re * ei + im * er;
        }
        const double hr = 1.0 + at[0], hi = at[1];
        const double or = dr * hr - di * hi, oi = dr * hi + di * hr; /* direct times h */
        const double vr = or * hr - oi * hi, vi = or * hi + oi * hr;
        seen[v] = vr, seen[V + v] = vi;
        if (!g->with_slopes)
            continue;
        double slope[SUMS][2]; /* of the column over place x, y, centre x, y, turn, half sizes, strength */
        const double pr = c * at[2] - n * at[4], pi = c * at[3] - n * at[5];
        const double qr = n * at[2] + c * at[4], qi = n * at[3] + c * at[5];
        const double ar = c * at[6] - n * at[8], ai = c * at[7] - n * at[9];
        const double br = n * at[6] + c * at[8], bi = n * at[7] + c * at[9];
        /* The incident field at the place falls, too: its range shrinks along u. */
        const double lr = at[0] / r - k * at[1], li = at[1] / r + k * at[0];
        const double x = place[3], y = place[4], ax = w->away[3 * V + v], ay = w->away[4 * V + v];
        const double over[SUMS][2] = {
            {pr - ux * lr, pi - ux * li},
            {qr - uy * lr, qi - uy * li},
            {-pr - ar, -pi - ai},
            {-qr - br, -qi - bi},
            {y * at[2] - x * at[4] + ay * at[6] - ax * at[8], y * at[3] - x * at[5] + ay * at[7] - ax * at[9]},
            {g->shape[3] * at[10], g->shape[3] * at[11]},
            {g->shape[4] * at[12], g->shape[4] * at[13]},
            {g->shape[5] * at[14], g->shape[5] * at[15]},
        };
        for (int64_t l = 0; l < SUMS; l++) {
            slope[l][0] = 2.0 * (or * over[l][0] - oi * over[l][1]);
            slope[l][1] = 2.0 * (or * over[l][1] + oi * over[l][0]);
        }
        const double fall = 2.0 / whole, near_x = -ux * r / whole, near_y = -uy * r / whole;
        const double wr = -fall * vr + 2.0 * k * vi, wi = -fall * vi - 2.0 * k * vr;
        slope[0][0] += near_x * wr, slope[0][1] += near_x * wi, slope[1][0] += near_y * wr, slope[1][1] += near_y * wi;
        for (int64_t l = 0; l < SUMS; l++)
            seen[2 * (l + 1) * V + v] = slope[l][0], seen[(2 * l + 3) * V + v] = slope[l][1];
    }
    const int64_t unlike = g->k > 1 ? g->k : 0;
    if (s >= g->k)
        put_seen(g, w, f, s, SHAPES + (g->k > 0) + unlike + s - g->k);
    else {
        put_seen(g, w, f, s, SHAPES);
        if (unlike)
            put_seen(g, w, f, s, SHAPES + 1 + s);
    }
}

WIDE static void compute(const Sheet *g, const Work *w)
{
    const int64_t N = g->n, Q = g->q, V = PADDED(g->v), size = g->f * g->columns * g->v;
    memset(g->values, 0, (size_t)(2 * size) * sizeof(double));
    if (g->with_slopes)
        memset(g->rates, 0, (size_t)(2 * g->t * size) * sizeof(double));
    prepare_contour(g, w);
    prepare_views(g, w);
    prepare_reflectors(g, w);
    for (int64_t f = 0; f < g->f; f++) {
        const double k = g->wavenumber[f];
        if (f)
            advance(w->wave, w->turn, 4 * N, Q);
        solve(g, w, k);
        echo(g, w, k);
        sheet_seen(g, w, f);
        if (!g->sources)
            continue;
        for (int64_t i = 0; f && i < 4 * N; i++)
            advance(w->cell + (7 * i + 3) * V, w->cell + (7 * i + 5) * V, 1, V);
        answer_sources(g, w, k);
        for (int64_t s = 0; s < g->sources; s++) {
            if (f) {
                advance(w->source + (9 * s + 4) * V, w->source + (9 * s + 6) * V, 1, V);
                advance(w->near_wave + 4 * s * V, w->near_wave + (4 * s + 2) * V, 1, V);
            }
            if (s < g->k || !g->past[s - g->k])
                field_at(g, w, k, s);
            else
                memset(w->sum, 0, (size_t)(2 * SUMS * V) * sizeof(double));
            reflector_seen(g, w, f, s);
        }
    }
}

/* Problem and buffers from Python; 0 with an error set. */
static int taken_sheet(PyObject *args, Held *held, Sheet *g)
{
    PyObject *o[11];
    long long round, odd, aspects;
    if (!PyArg_ParseTuple(args, "OOOOOOOOOOOddddLLL", o, o + 1, o + 2, o + 3, o + 4, o + 5, o + 6, o + 7, o + 8,
                          o + 9, o + 10, &g->distance, &g->aspect_m, &g->from, &g->step, &round, &odd, &aspects))
        return 0;
    g->round = round, g->odd = odd, g->q = PADDED(aspects);
    if (!(g->views = take(held, o[0], -1, 0)) || (g->v = odd < 0 ? 0 : taken(held) / (24 + 8 * odd)) < 1 ||
        taken(held) != (24 + 8 * odd) * g->v ||
        !(g->wavenumber = take(held, o[1], -1, 0)) || (g->f = taken(held) / 8) < 1 ||
        !(g->unit = take(held, o[2], -1, 0)) || (g->n = taken(held) / 16) < 1 || g->n > MOST_CELLS ||
        !(g->table = take(held, o[3], -1, 0)) || (g->entries = taken(held) / 16) < 2 ||
        !(g->tag = take(held, o[4], -1, 0)))
        return refused("views, frequencies, contour or table");
    g->k = taken(held) / 24;
    if (!(g->group = take(held, o[5], 16 * g->k, 0)))
        return 0;
    for (int64_t i = 0; i < g->k; i++) {
        if (g->group[i] < 0 || g->group[g->k + i] < 0)
            return refused("groups");
        g->turns = g->group[i] >= g->turns ? g->group[i] + 1 : g->turns;
        g->stretches = g->group[g->k + i] >= g->stretches ? g->group[g->k + i] + 1 : g->stretches;
    }
    g->sources = g->k + g->odd, g->t = HEAD + 2 + g->turns + g->stretches + 2 * g->odd;
    g->columns = SHAPES + (g->k > 0) + (g->k > 1 ? g->k : 0) + g->odd;
    if (g->q < UNIT)
        return refused("aspects or odd scatterers");
    if (!(g->x = take(held, o[6], 8 * g->t, 0)) || !(g->shape = take(held, o[7], 48, 0)) ||
        !(g->values = take(held, o[8], 16 * g->f * g->columns * g->v, 1)) ||
        !(g->past = take(held, o[9], 8 * g->odd, 0)) || !(g->rates = take(held, o[10], -1, 1)))
        return 0;
    g->with_slopes = taken(held) > 0;
    if (g->with_slopes && taken(held) != 16 * g->t * g->f * g->columns * g->v)
        return refused("sizes of the results");
    return 1;
}

static PyObject *computed(PyObject *args)
{
    Sheet g = {0};
    Work w;
    Held held = {0};
    if (!taken_sheet(args, &held, &g))
        return finished(&held);
    double *base = malloc((size_t)lay_out(&g, &w, NULL) * sizeof(double));
    if (!base)
        return no_memory(&held);
    lay_out(&g, &w, base);
    Py_BEGIN_ALLOW_THREADS compute(&g, &w);
    Py_END_ALLOW_THREADS free(base);
    return finished(&held);
}

METHOD(columns, computed(args))

static PyMethodDef methods[] = {
    {"columns", columns, METH_VARARGS,
     "columns(views, wavenumber, unit, table, tag, group, x, shape, values, past, rates, distance, aspect_m, from, step, "
     "round, odd, aspects): values (F, C, V) and rates (T, F, C, V), or none"},
    {NULL, NULL, 0, NULL},
};

MODULE(_sheet, "Columns of a thin sheet and of reflectors about it, with slopes.", methods, 2)
