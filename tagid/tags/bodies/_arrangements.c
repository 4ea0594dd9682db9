/* Arrangements of alike reflectors on a body: what each leaves and which way is down, and what sets of
 * angles on a ring explain.
 *
 * `tagid.tags.bodies.reflectors_fit` and `.ring` hold the formulas, and do the same with numpy where no
 * compiler was present. Only the stable ABI and the buffer protocol are used.
 */
#include "_spectra.h"
#include <math.h>
#include <stdlib.h>
#include <string.h>

#define COMMON 6 /* coordinates before the reflectors' angles */
#define TERMS 7  /* of a pattern, at most */
#define COLUMNS (TERMS + 1)
#define MOVES 32 /* directions, at most */
#define LOAD 1e-6
#define LARGEST 8 /* terms of a ring's pattern, at most */
#define SIDE COLUMNS
#include "_hermitian.h"

typedef struct {
    const double *at;      /* (H, 6 + K) */
    const double *radii;   /* (H, K) */
    const double *heights; /* (H, K) */
    const double *present; /* (H, K) */
    const double *tilt;    /* (H,) */
    const double *terms;   /* (H,) */
    const double *moves;   /* (H, P, 6 + K) */
    const double *echoes;  /* (B, H, F, views, 2): at its place, and moved a little; none where B is 0 */
    const double *steps;   /* (3,) by how much */
    int64_t rows, width, directions, bodies;
    double *left;     /* (H,) */
    double *normal;   /* (H, P, P); NULL for the energies alone */
    double *gradient; /* (H, P) */
} Rows;

/* One reflector of a row; every array has a value per view. */
typedef struct {
    double *wave, *turn;                  /* (2, views) at one frequency, and to the next */
    double *shape, *rise;                 /* (TERMS, views) cos(p psi), and its derivative with cos(psi) */
    double *steep;                        /* d log(facing) / d cos(psi) */
    double *out_far, *out_turn;           /* of a step outward: change of the distance, of cos(psi) */
    double *side_far, *side_turn;         /* of a step to the side */
    double *reach_x, *reach_y;            /* from the ring's centre to the antenna, turned */
    double *along_x, *along_y, *along_at; /* (2, views) change of the echo with either, and with the angle */
    double cosine, sine;                  /* of the reflector's angle */
    int number;
} Reflector;
#define PER_REFLECTOR (2 * 2 + 2 * TERMS + 7 + 3 * 2)

/* Its real part. */
INLINE double real_inner(const double *restrict a, const double *restrict b, int64_t n)
{
    double re = 0.0;
#pragma omp simd reduction(+ : re)
    for (int64_t v = 0; v < 2 * n; v++)
        re += a[v] * b[v];
    return re;
}

/* y += c x with a complex c. */
INLINE void add(double *restrict y, const double *restrict x, const double *c, int64_t n)
{
    for (int64_t v = 0; v < n; v++) {
        y[v] += c[0] * x[v] - c[1] * x[n + v];
        y[n + v] += c[0] * x[n + v] + c[1] * x[v];
    }
}

/* What does not depend on the frequency: where a reflector is seen from, and its wave at the first one. */
INLINE void begin(const Spectra *g, const Rows *r, int64_t row, int k, int terms, Reflector *o, double *at)
{
    const int64_t n = g->views;
    double **arrays[] = {&o->steep,    &o->out_far, &o->out_turn, &o->side_far,
                         &o->side_turn, &o->reach_x, &o->reach_y};
    o->wave = at;
    o->turn = o->wave + 2 * n;
    o->shape = o->turn + 2 * n;
    o->rise = o->shape + TERMS * n;
    o->along_x = o->rise + TERMS * n;
    o->along_y = o->along_x + 2 * n;
    o->along_at = o->along_y + 2 * n;
    at = o->along_at + 2 * n;
    for (int i = 0; i < 7; i++, at += n)
        *arrays[i] = at;
    o->number = k;
    const double *place = r->at + (COMMON + r->width) * row;
    const double angle = place[COMMON + k], radius = r->radii[r->width * row + k] + place[2];
    const double height = r->heights[r->width * row + k], present = r->present[r->width * row + k];
    const double tilted = r->tilt[row] > 0.0;
    o->cosine = cos(angle);
    o->sine = sin(angle);
    for (int64_t v = 0; v < n; v++) {
        const double x = g->antenna[v] - place[0], y = g->antenna[n + v] - place[1];
        const double rx = x * o->cosine + y * o->sine, ry = y * o->cosine - x * o->sine;
        const double tx = rx - radius, up = g->height[v] - height;
        const double plane = sqrt(tx * tx + ry * ry), far = sqrt(plane * plane + up * up);
        const double c = tx / plane, s = ry / plane, longer = plane / far, near = g->distance / far;
        const double half = 0.5 * (1.0 + c), facing = tilted ? half * half : 1.0;
        const double weight = facing * near * near * present, path = far - g->distance;
        const double first = g->first * path, step = g->step * path;
        o->wave[v] = weight * cos(first);
        o->wave[n + v] = -weight * sin(first);
        o->turn[v] = cos(step);
        o->turn[n + v] = -sin(step);
        o->steep[v] = tilted ? 2.0 / (1.02 + c) : 0.0;
        o->out_far[v] = c * longer;
        o->out_turn[v] = (1.0 - c * c) / plane;
        o->side_far[v] = s * longer;
        o->side_turn[v] = c * s / plane;
        o->reach_x[v] = rx;
        o->reach_y[v] = ry;
        o->shape[v] = 1.0;
        o->rise[v] = 0.0;
        o->shape[n + v] = c;
        o->rise[n + v] = 1.0;
    }
    for (int p = 2; p < terms; p++)
        for (int64_t v = 0; v < n; v++) {
            const double c = 2.0 * o->shape[n + v];
            const double *last = o->shape + n * (p - 1) + v, *rise = o->rise + n * (p - 1) + v;
            o->shape[n * p + v] = c * last[0] - last[-n];
            o->rise[n * p + v] = 2.0 * last[0] + c * rise[0] - rise[-n];
        }
}

/* Changes of a reflector's echo at one frequency. */
INLINE void derive(const Spectra *g, double kappa, int terms, const double (*amplitude)[2],
                   const Reflector *o, double *restrict work)
{
    const int64_t n = g->views;
    double *restrict pr = work, *restrict pi = pr + n, *restrict sr = pi + n, *restrict si = sr + n;
    memset(work, 0, (size_t)(4 * n) * sizeof(double));
    for (int p = 0; p < terms; p++) {
        const double a = amplitude[p][0], b = amplitude[p][1];
        const double *restrict shape = o->shape + n * p, *restrict rise = o->rise + n * p;
        for (int64_t v = 0; v < n; v++) {
            pr[v] += a * shape[v];
            pi[v] += b * shape[v];
            sr[v] += a * rise[v];
            si[v] += b * rise[v];
        }
    }
    const double *restrict wr = o->wave, *restrict wi = wr + n, *restrict steep = o->steep;
    const double *restrict xf = o->out_far, *restrict xt = o->out_turn;
    const double *restrict yf = o->side_far, *restrict yt = o->side_turn;
    const double *restrict rx = o->reach_x, *restrict ry = o->reach_y;
    double *restrict xr = o->along_x, *restrict xi = xr + n, *restrict yr = o->along_y, *restrict yi = yr + n;
    double *restrict ar = o->along_at, *restrict ai = ar + n;
    for (int64_t v = 0; v < n; v++) {
        const double er = pr[v] * wr[v] - pi[v] * wi[v], ei = pr[v] * wi[v] + pi[v] * wr[v];
        const double qr = sr[v] + pr[v] * steep[v], qi = si[v] + pi[v] * steep[v];
        const double tr = qr * wr[v] - qi * wi[v], ti = qr * wi[v] + qi * wr[v];
        /* -j kappa (a + j b) = kappa b - j kappa a */
        const double fr = kappa * ei, fi = -kappa * er;
        xr[v] = fr * xf[v] + tr * xt[v];
        xi[v] = fi * xf[v] + ti * xt[v];
        yr[v] = fr * yf[v] - tr * yt[v];
        yi[v] = fi * yf[v] - ti * yt[v];
        ar[v] = xr[v] * ry[v] - yr[v] * rx[v];
        ai[v] = xi[v] * ry[v] - yi[v] * rx[v];
    }
}

/* Change of the whole echo along one move. */
INLINE void move(const Spectra *g, const double *along, const Reflector *o, int count, double *restrict out)
{
    const int64_t n = g->views;
    for (int k = 0; k < count; k++) {
        const double x = -(along[0] * o[k].cosine + along[1] * o[k].sine) - along[2];
        const double y = -(along[1] * o[k].cosine - along[0] * o[k].sine), t = along[COMMON + o[k].number];
        const double *restrict ax = o[k].along_x, *restrict ay = o[k].along_y, *restrict at = o[k].along_at;
        for (int64_t v = 0; v < 2 * n; v++)
            out[v] += x * ax[v] + y * ay[v] + t * at[v];
    }
}

/* A body's echo (views, 2) as a column (2, views). */
INLINE void unpack(const double *restrict from, double *restrict out, int64_t n)
{
    for (int64_t v = 0; v < n; v++) {
        out[v] = from[2 * v];
        out[n + v] = from[2 * v + 1];
    }
}

/* One arrangement, frequency after frequency (Kaufman 1975). */
INLINE void one_row(const Spectra *g, const Rows *r, int64_t row, Reflector *o, double *scratch)
{
    const int64_t n = g->views, whole = COMMON + r->width, p_count = r->directions;
    const int terms = (int)r->terms[row], first = r->bodies ? 0 : 1, cols = 1 + terms;
    double *column = scratch, *rest = column + 2 * n * COLUMNS, *slope = rest + 2 * n;
    double *body = slope + 2 * n * MOVES, *work = body + 6 * n, *at = work + 4 * n;
    const double *moves = r->moves + p_count * whole * row;
    double *normal = r->normal ? r->normal + p_count * p_count * row : NULL;
    int count = 0, used[MOVES], uses = 0;
    for (int k = 0; k < r->width; k++)
        if (r->present[r->width * row + k] != 0.0) {
            begin(g, r, row, k, terms, o + count++, at);
            at += PER_REFLECTOR * n;
        }
    r->left[row] = 0.0;
    if (normal) {
        memset(normal, 0, (size_t)(p_count * p_count) * sizeof(double));
        memset(r->gradient + p_count * row, 0, (size_t)p_count * sizeof(double));
        for (int p = 0; p < p_count; p++) {
            int any = 0;
            for (int i = 0; i < whole; i++)
                any |= moves[whole * p + i] != 0.0;
            if (any)
                used[uses++] = p;
        }
    }
    for (int64_t f = 0; f < g->frequencies; f++) {
        const int64_t echo = 2 * n * (g->frequencies * row + f), next = 2 * n * g->frequencies * r->rows;
        memset(column, 0, (size_t)(2 * n * cols) * sizeof(double));
        if (r->bodies)
            unpack(r->echoes + echo, column, n);
        for (int p = 0; p < terms; p++) {
            double *restrict re = column + 2 * n * (1 + p), *restrict im = re + n;
            for (int k = 0; k < count; k++) {
                const double *restrict wr = o[k].wave, *restrict wi = wr + n,
                                       *restrict shape = o[k].shape + n * p;
                for (int64_t v = 0; v < n; v++) {
                    re[v] += wr[v] * shape[v];
                    im[v] += wi[v] * shape[v];
                }
            }
        }
        if (normal && r->bodies)
            for (int i = 0; i + 1 < r->bodies; i++)
                for (int64_t v = 0; v < n; v++) {
                    const double *there = r->echoes + next * (i + 1) + echo + 2 * v;
                    body[2 * n * i + v] = (there[0] - column[v]) / r->steps[i];
                    body[2 * n * i + n + v] = (there[1] - column[n + v]) / r->steps[i];
                }
        double gram[COLUMNS][COLUMNS][2], load[COLUMNS], amplitude[COLUMNS][2] = {{0.0, 0.0}}, most = 0.0;
        for (int c = first; c < cols; c++)
            centre(column + 2 * n * c, n);
        const double *data = g->data + 2 * n * f;
        memcpy(rest, data, (size_t)(2 * n) * sizeof(double));
        for (int c = first; c < cols; c++) {
            for (int d = first; d < c; d++)
                inner(column + 2 * n * c, column + 2 * n * d, n, gram[c][d]);
            gram[c][c][0] = real_inner(column + 2 * n * c, column + 2 * n * c, n);
            gram[c][c][1] = 0.0;
            most = gram[c][c][0] > most ? gram[c][c][0] : most;
            inner(column + 2 * n * c, data, n, amplitude[c]);
        }
        if (!r->bodies) { /* an empty column keeps its place */
            memset(gram[0], 0, sizeof gram[0]);
            for (int c = 1; c < cols; c++)
                gram[c][0][0] = gram[c][0][1] = 0.0;
        }
        for (int c = 0; c < cols; c++) {
            const double size = gram[c][c][0];
            load[c] = LOAD * size + (size > 1e-9 * most ? 0.0 : 1.0);
            gram[c][c][0] += load[c];
        }
        factorise(cols, gram);
        substitute(cols, gram, amplitude);
        for (int c = first; c < cols; c++) {
            const double minus[2] = {-amplitude[c][0], -amplitude[c][1]};
            add(rest, column + 2 * n * c, minus, n);
        }
        r->left[row] += real_inner(rest, rest, n);
        if (normal) {
            double along[MOVES][COLUMNS][2], before[MOVES][COLUMNS][2], remains[COLUMNS][2];
            for (int k = 0; k < count; k++)
                derive(g, g->first + (double)f * g->step, terms,
                       (const double (*)[2])(amplitude + 1), o + k, work);
            for (int c = 0; c < cols; c++)
                inner(column + 2 * n * c, rest, n, remains[c]);
            for (int u = 0; u < uses; u++) {
                double *own = slope + 2 * n * u;
                const double *there = moves + whole * used[u];
                memset(own, 0, (size_t)(2 * n) * sizeof(double));
                move(g, there, o, count, own);
                for (int i = 0; i + 1 < r->bodies; i++)
                    if (there[3 + i] != 0.0) {
                        const double c[2] = {there[3 + i] * amplitude[0][0], there[3 + i] * amplitude[0][1]};
                        add(own, body + 2 * n * i, c, n);
                    }
                centre(own, n);
                for (int c = 0; c < cols; c++)
                    inner(column + 2 * n * c, own, n, before[u][c]);
                memcpy(along[u], before[u], sizeof along[u]);
                substitute(cols, gram, along[u]);
                /* The slope is C a - s with a = G^-1 C^H s; its products follow from those of C, s and rest. */
                double down = -real_inner(own, rest, n);
                for (int c = 0; c < cols; c++)
                    down += along[u][c][0] * remains[c][0] + along[u][c][1] * remains[c][1];
                r->gradient[p_count * row + used[u]] += down;
                for (int w = 0; w <= u; w++) {
                    double value = real_inner(own, slope + 2 * n * w, n);
                    for (int c = 0; c < cols; c++) {
                        const double *a = along[u][c], *b = along[w][c], *s = before[w][c];
                        value -= a[0] * s[0] + a[1] * s[1] + load[c] * (a[0] * b[0] + a[1] * b[1]);
                    }
                    normal[p_count * used[u] + used[w]] += value;
                }
            }
        }
        for (int k = 0; k < count; k++) {
            double *restrict re = o[k].wave, *restrict im = re + n;
            const double *restrict tr = o[k].turn, *restrict ti = tr + n;
            for (int64_t v = 0; v < n; v++) {
                const double a = re[v] * tr[v] - im[v] * ti[v], b = re[v] * ti[v] + im[v] * tr[v];
                re[v] = a;
                im[v] = b;
            }
        }
    }
    if (normal)
        for (int p = 0; p < p_count; p++)
            for (int q = 0; q < p; q++)
                normal[p_count * q + p] = normal[p_count * p + q];
}

WIDE static void every_row(const Spectra *g, const Rows *r, Reflector *reflectors, double *scratch)
{
    for (int64_t row = 0; row < r->rows; row++)
        one_row(g, r, row, reflectors, scratch);
}

static int rows_of(Held *h, PyObject **o, const Spectra *g, Rows *r)
{
    if (!(r->tilt = take(h, o[4], -1, 0)))
        return 0;
    r->rows = taken(h) / 8;
    if (!(r->radii = take(h, o[1], -1, 0)))
        return 0;
    r->width = r->rows ? taken(h) / 8 / r->rows : 0;
    if (r->rows < 1 || r->width < 1 || r->width > 1024 || taken(h) != 8 * r->rows * r->width)
        return refused("arrangements do not fit together");
    const int64_t cells = 8 * r->rows * r->width, whole = COMMON + r->width;
    if (!(r->at = take(h, o[0], 8 * r->rows * whole, 0)) || !(r->heights = take(h, o[2], cells, 0)) ||
        !(r->present = take(h, o[3], cells, 0)) || !(r->terms = take(h, o[5], 8 * r->rows, 0)) ||
        !(r->moves = take(h, o[6], -1, 0)))
        return 0;
    r->directions = taken(h) / 8 / r->rows / whole;
    if (r->directions < 1 || r->directions > MOVES || taken(h) != 8 * r->rows * whole * r->directions)
        return refused("too few moves, or too many");
    for (int64_t i = 0; i < r->rows; i++)
        if (!(r->terms[i] >= 1.0 && r->terms[i] <= TERMS))
            return refused("too few terms, or too many");
    if (!(r->steps = take(h, o[8], 24, 0)) || !(r->echoes = take(h, o[7], -1, 0)))
        return 0;
    const int64_t one = 16 * r->rows * g->frequencies * g->views;
    r->bodies = taken(h) / one;
    if (r->bodies > 4 || taken(h) != one * r->bodies)
        return refused("echoes of the body do not fit");
    if (!(r->left = take(h, o[9], 8 * r->rows, 1)) || !(r->normal = take(h, o[10], -1, 1)))
        return 0;
    if (!taken(h)) {
        r->normal = NULL;
        return 1;
    }
    if (taken(h) != 8 * r->rows * r->directions * r->directions)
        return refused("moves do not fit together");
    return (r->gradient = take(h, o[11], 8 * r->rows * r->directions, 1)) != NULL;
}

static PyObject *linear(PyObject *self, PyObject *args)
{
    (void)self;
    PyObject *s[3], *o[12];
    Held h = {.count = 0};
    Spectra g;
    Rows r = {.rows = 0};
    if (!PyArg_ParseTuple(args, "OOO(ddd)OOOOOOOOOOOO", s, s + 1, s + 2, &g.first, &g.step, &g.distance, o,
                          o + 1, o + 2, o + 3, o + 4, o + 5, o + 6, o + 7, o + 8, o + 9, o + 10, o + 11))
        return NULL;
    if (!take_spectra(&h, s, &g) || !rows_of(&h, o, &g, &r))
        return finished(&h);
    const int64_t columns = 2 * COLUMNS + 2 + 2 * MOVES + 6 + 4 + PER_REFLECTOR * r.width;
    double *scratch = malloc((size_t)(g.views * columns) * sizeof(double));
    Reflector *reflectors = malloc((size_t)r.width * sizeof(Reflector));
    if (scratch && reflectors) {
        Py_BEGIN_ALLOW_THREADS every_row(&g, &r, reflectors, scratch);
        Py_END_ALLOW_THREADS
    } else
        PyErr_NoMemory();
    free(scratch);
    free(reflectors);
    return finished(&h);
}

typedef struct {
    const float *gram;   /* (B, F, N M, N M, 2) */
    const float *right;  /* (B, F, N M, 2) */
    const float *ridge;  /* (B, F) */
    const int32_t *sets; /* (H, n) */
    int64_t rings, frequencies, angles, terms, rows, size;
    double *out; /* (B, H) */
} Sets;

/* b^H G^-1 b of one set at one frequency, G the sum of its blocks. */
INLINE float set_energy(const float *gram, const float *right, float ridge, const int32_t *set, int n, int m,
                        int64_t across)
{
    float g[LARGEST][LARGEST][2], x[LARGEST][2], total = 0.0f;
    for (int p = 0; p < m; p++)
        for (int q = 0; q <= p; q++)
            g[p][q][0] = g[p][q][1] = 0.0f;
    for (int p = 0; p < m; p++)
        x[p][0] = x[p][1] = 0.0f;
    for (int i = 0; i < n; i++) {
        const int64_t a = (int64_t)m * set[i];
        for (int p = 0; p < m; p++) {
            x[p][0] += right[2 * (a + p)];
            x[p][1] += right[2 * (a + p) + 1];
        }
        for (int j = 0; j < n; j++) {
            const float *block = gram + 2 * (across * a + (int64_t)m * set[j]);
            for (int p = 0; p < m; p++, block += 2 * across)
                for (int q = 0; q <= p; q++) {
                    g[p][q][0] += block[2 * q];
                    g[p][q][1] += block[2 * q + 1];
                }
        }
    }
    for (int p = 0; p < m; p++) {
        float pivot = g[p][p][0] + ridge, re = x[p][0], im = x[p][1];
        for (int q = 0; q < p; q++) {
            float vr = g[p][q][0], vi = g[p][q][1];
            for (int s = 0; s < q; s++) {
                vr -= g[p][s][0] * g[q][s][0] + g[p][s][1] * g[q][s][1];
                vi -= g[p][s][1] * g[q][s][0] - g[p][s][0] * g[q][s][1];
            }
            vr *= g[q][q][0];
            vi *= g[q][q][0];
            g[p][q][0] = vr;
            g[p][q][1] = vi;
            pivot -= vr * vr + vi * vi;
            re -= vr * x[q][0] - vi * x[q][1];
            im -= vr * x[q][1] + vi * x[q][0];
        }
        pivot = pivot > 0.5f * ridge ? pivot : 0.5f * ridge;
        g[p][p][0] = 1.0f / sqrtf(pivot);
        x[p][0] = re * g[p][p][0];
        x[p][1] = im * g[p][p][0];
        total += x[p][0] * x[p][0] + x[p][1] * x[p][1];
    }
    return total;
}

WIDE static void set_energies(const Sets *s)
{
    const int64_t across = s->angles * s->terms;
    memset(s->out, 0, (size_t)(s->rings * s->rows) * sizeof(double));
    for (int64_t ring = 0; ring < s->rings; ring++)
        for (int64_t f = 0; f < s->frequencies; f++) {
            const int64_t here = s->frequencies * ring + f;
            const float *gram = s->gram + 2 * across * across * here, *right = s->right + 2 * across * here;
            double *out = s->out + s->rows * ring;
            for (int64_t i = 0; i < s->rows; i++) {
                const int32_t *set = s->sets + s->size * i;
                const int n = (int)s->size;
                /* The usual numbers of terms as constants. */
                out[i] += s->terms == 3   ? set_energy(gram, right, s->ridge[here], set, n, 3, across)
                          : s->terms == 2 ? set_energy(gram, right, s->ridge[here], set, n, 2, across)
                                          : set_energy(gram, right, s->ridge[here], set, n, (int)s->terms,
                                                       across);
            }
        }
}

static PyObject *energies(PyObject *self, PyObject *args)
{
    (void)self;
    PyObject *o[5];
    Py_ssize_t rings, frequencies, terms, size;
    Held h = {.count = 0};
    Sets s;
    if (!PyArg_ParseTuple(args, "OOOOnnnnO", o, o + 1, o + 2, o + 3, &rings, &frequencies, &terms, &size, o + 4))
        return NULL;
    s.rings = rings;
    s.frequencies = frequencies;
    s.terms = terms;
    s.size = size;
    if (rings < 1 || frequencies < 1 || terms < 1 || terms > LARGEST || size < 1) {
        refused("too few rings, frequencies or terms, or too many");
        return finished(&h);
    }
    if (!(s.right = take(&h, o[1], -1, 0)))
        return finished(&h);
    s.angles = taken(&h) / 8 / rings / frequencies / terms;
    const int64_t across = s.angles * terms;
    if (s.angles < 1 || taken(&h) != 8 * across * rings * frequencies) {
        refused("rings do not fit together");
        return finished(&h);
    }
    if (!(s.gram = take(&h, o[0], 8 * across * across * rings * frequencies, 0)) ||
        !(s.ridge = take(&h, o[2], 4 * rings * frequencies, 0)) || !(s.sets = take(&h, o[3], -1, 0)))
        return finished(&h);
    s.rows = taken(&h) / 4 / size;
    if (taken(&h) != 4 * size * s.rows) {
        refused("sets do not fit together");
        return finished(&h);
    }
    for (int64_t i = 0; i < s.rows * size; i++)
        if (s.sets[i] < 0 || s.sets[i] >= s.angles) {
            refused("an angle is out of range");
            return finished(&h);
        }
    if (!(s.out = take(&h, o[4], 8 * rings * s.rows, 1)))
        return finished(&h);
    Py_BEGIN_ALLOW_THREADS set_energies(&s);
    Py_END_ALLOW_THREADS return finished(&h);
}

/* exp(-j kappa path) of every frequency, by recurrence. */
WIDE static void all_waves(const double *path, int64_t count, int64_t frequencies, double first, double step,
                           double *out)
{
    for (int64_t i = 0; i < count; i++) {
        double re = cos(first * path[i]), im = -sin(first * path[i]);
        const double tr = cos(step * path[i]), ti = -sin(step * path[i]);
        for (int64_t f = 0; f < frequencies; f++) {
            out[2 * (count * f + i)] = re;
            out[2 * (count * f + i) + 1] = im;
            const double next = re * tr - im * ti;
            im = re * ti + im * tr;
            re = next;
        }
    }
}

static PyObject *waves(PyObject *self, PyObject *args)
{
    (void)self;
    PyObject *o[2];
    Held h = {.count = 0};
    Py_ssize_t frequencies;
    double first, step, *out;
    const double *path;
    if (!PyArg_ParseTuple(args, "OnddO", o, &frequencies, &first, &step, o + 1))
        return NULL;
    if (!(path = take(&h, o[0], -1, 0)))
        return finished(&h);
    const int64_t count = taken(&h) / 8;
    if (frequencies < 1 || !(out = take(&h, o[1], 16 * count * frequencies, 1))) {
        if (!PyErr_Occurred())
            refused("too few frequencies");
        return finished(&h);
    }
    Py_BEGIN_ALLOW_THREADS all_waves(path, count, frequencies, first, step, out);
    Py_END_ALLOW_THREADS return finished(&h);
}

static PyMethodDef methods[] = {
    {"linear", linear, METH_VARARGS,
     "linear(antenna, height, data, (first, step, distance), at, radii, heights, present, tilt, terms, moves, "
     "echoes, steps, left, normal, gradient)"},
    {"energies", energies, METH_VARARGS,
     "energies(gram, right, ridge, sets, rings, frequencies, terms, size, out)"},
    {"waves", waves, METH_VARARGS, "waves(path, frequencies, first, step, out)"},
    {NULL, NULL, 0, NULL},
};

MODULE(_arrangements, "Compiled loops of reflectors on a body (see tagid.tags.bodies).", methods, 1)
