/* Many points in one view: the loops run over the points, as there may be few views. */
#ifndef TAGID_BLOCK_H
#define TAGID_BLOCK_H
#include "_field.h"

#define BLOCK 64 /* points at a time: each loop runs over points, whose number is known */

typedef struct {
    double x[BLOCK], y[BLOCK], z[BLOCK], face_x[BLOCK], face_y[BLOCK]; /* m; unit vectors */
    double far[BLOCK];                                                 /* from the antenna of a view, m */
    int32_t index[BLOCK];
    float re[BLOCK], im[BLOCK]; /* phase */
} Block;

/* Points from `first` on; the last one stands for those that are missing. */
INLINE void begin_block(const double *points, const double *facing, int64_t count, int64_t first, Block *b)
{
    for (int64_t i = 0; i < BLOCK; i++) {
        const int64_t at = first + i < count ? first + i : count - 1;
        b->x[i] = points[3 * at];
        b->y[i] = points[3 * at + 1];
        b->z[i] = points[3 * at + 2];
        b->face_x[i] = facing[2 * at];
        b->face_y[i] = facing[2 * at + 1];
    }
}

/* Distance, an offset longer, with profile and phase of every point in one view. */
INLINE void look_from(const Field *g, int64_t v, double offset, Block *b)
{
    for (int64_t way = 0; way < g->ways; way++) {
        const double *at = g->antennas + 3 * g->views * way + v;
        const double ax = at[0], ay = at[g->views], az = at[2 * g->views];
        for (int i = 0; i < BLOCK; i++) {
            const double x = b->x[i] - ax, y = b->y[i] - ay, z = b->z[i] - az;
            const double d = sqrt(x * x + y * y + z * z);
            b->far[i] = way ? 0.5 * (b->far[i] + d) : d;
        }
    }
    const double per_metre = -g->wavenumber / 3.141592653589793;
    for (int i = 0; i < BLOCK; i++)
        b->far[i] += offset;
    for (int i = 0; i < BLOCK; i++)
        b->index[i] = entry(g, b->far[i]);
    for (int i = 0; i < BLOCK; i++)
        turned(b->far[i] * per_metre, b->re + i, b->im + i);
}

/* The phases (2, BLOCK) with a pattern's amplitude. */
INLINE void light(const Field *g, const double *pattern, int64_t v, const Block *b, float *restrict out)
{
    const double edge = pattern[0], slope = 1.0 / (2.0 * pattern[1]), floor = pattern[2];
    const double mx = g->middle[v], my = g->middle[g->views + v];
    if (floor >= 1.0) {
        memcpy(out, b->re, sizeof b->re);
        memcpy(out + BLOCK, b->im, sizeof b->im);
        return;
    }
    for (int i = 0; i < BLOCK; i++) {
        const double x = mx - b->x[i], y = my - b->y[i];
        const double cosine = (b->face_x[i] * x + b->face_y[i] * y) / sqrt(x * x + y * y);
        double ramp = (cosine - edge) * slope + 0.5;
        ramp = ramp > 0.0 ? ramp : 0.0;
        ramp = ramp < 1.0 ? ramp : 1.0;
        const double sided = fabs(b->face_x[i]) + fabs(b->face_y[i]);
        const float w = sided > 0.0 ? (float)(floor + (1.0 - floor) * ramp) : 1.0f;
        out[i] = b->re[i] * w;
        out[BLOCK + i] = b->im[i] * w;
    }
}

#endif
