/* What points explain, and the search for the places where they explain most.
 *
 * evaluate:     least squares of the scans on sets of templates, without forming the templates in numpy
 * move_points:  free places near a start
 * move_layouts: turn, shift and range offset of a layout near a start
 * place_layout: what a layout explains at given places
 * look:         range profile and phase of points in every view
 */
#include "_block.h"

typedef struct {
    const Field *field;
    const Pattern *pattern;
    const float *data; /* (2, views, width) */
    int whole;         /* keep what is constant over the views */
    float *templates;  /* (room, 2, views, width) */
    double *b;         /* (room, 2) */
    double *far;       /* (views,) */
    float *re, *im, *sums;
    int32_t *index;
} Scene;

/* Bytes that a scene of so many templates needs. */
static size_t room_of(const Field *g, int64_t count)
{
    const int64_t floats = 2 * g->views * g->width * count + 3 * g->views + 2 * g->width * g->circles;
    return (size_t)floats * sizeof(float) + (size_t)(g->views + 2 * count) * sizeof(double);
}

static void lay_out(Scene *s, const Field *g, int64_t count, void *room)
{
    s->field = g;
    s->far = room;
    s->b = s->far + g->views;
    s->templates = (float *)(s->b + 2 * count);
    s->re = s->templates + 2 * g->views * g->width * count;
    s->im = s->re + g->views;
    s->index = (int32_t *)(s->im + g->views);
    s->sums = (float *)(s->index + g->views);
}

/* Template number i and its b. */
INLINE void place(const Scene *s, int64_t i, const double *point, const double *facing, double offset)
{
    const Field *g = s->field;
    const int64_t n = g->views * g->width;
    distances(g, point, offset, s->far);
    for (int64_t v = 0; v < g->views; v++)
        s->index[v] = entry(g, s->far[v]);
    phases(g, s->far, s->re, s->im);
    lit(g, s->pattern, point, facing, s->re, s->im);
    template(g, s->index, s->re, s->im, 1, s->whole, s->templates + 2 * n * i, s->sums);
    inner(s->templates + 2 * n * i, s->data, n, s->b + 2 * i, s->b + 2 * i + 1);
}

/* Row i and column i of the Gram matrix (k, k) of a set. */
INLINE void relate(const Scene *s, const int32_t *set, int64_t k, int64_t i, int64_t from, double (*gram)[2])
{
    const int64_t n = s->field->views * s->field->width;
    for (int64_t j = from; j < k; j++) {
        double *low = gram[i * k + j], *high = gram[j * k + i];
        inner(s->templates + 2 * n * set[i], s->templates + 2 * n * set[j], n, low, low + 1);
        high[0] = low[0];
        high[1] = -low[1];
    }
    gram[i * k + i][1] = 0.0;
}

/* Energy that a set explains, with the matrix loaded by 1e-2 of itself, and the amplitudes. */
INLINE double explain(const Scene *s, const int32_t *set, int64_t k, const double (*gram)[2], double (*x)[2])
{
    double factor[MOST * MOST][2], load = 0.0, sum = 0.0;
    memcpy(factor, gram, (size_t)(k * k) * sizeof(*factor));
    for (int64_t i = 0; i < k; i++)
        load += gram[i * k + i][0] / (double)k;
    load = 1e-2 * (load > 1e-30 ? load : 1e-30);
    for (int64_t i = 0; i < k; i++) {
        factor[i * k + i][0] += load;
        x[i][0] = s->b[2 * set[i]];
        x[i][1] = s->b[2 * set[i] + 1];
    }
    factorise((int)k, factor);
    substitute((int)k, factor, x);
    for (int64_t i = 0; i < k; i++)
        sum += s->b[2 * set[i]] * x[i][0] + s->b[2 * set[i] + 1] * x[i][1];
    return sum > 0.0 ? sum : 0.0;
}

typedef struct {
    const double *points; /* (N, 3) */
    const double *facing; /* (N, 2) */
    const double *offset; /* (N,) */
    const int32_t *sets;  /* (H, K) */
    int64_t count, groups, size;
    double *amplitudes; /* (H, K, 2) */
    double *explained;  /* (H,) */
    double *gram;       /* (H, K, K, 2) */
} Evaluation;

WIDE static void evaluate_sets(const Scene *s, const Evaluation *e)
{
    const int64_t k = e->size;
    for (int64_t i = 0; i < e->count; i++)
        place(s, i, e->points + 3 * i, e->facing + 2 * i, e->offset[i]);
    for (int64_t h = 0; h < e->groups; h++) {
        double (*gram)[2] = (double (*)[2])(e->gram + 2 * k * k * h);
        for (int64_t i = 0; i < k; i++)
            relate(s, e->sets + h * k, k, i, i, gram);
        e->explained[h] = explain(s, e->sets + h * k, k, gram, (double (*)[2])(e->amplitudes + 2 * k * h));
    }
}

INLINE double held(double x, double low, double high)
{
    x = x > low ? x : low;
    return x < high ? x : high;
}

/* The vertex of a parabola through three values at -1, 0 and 1; the better side where it opens upwards. */
INLINE double vertex(double middle, double plus, double minus, double reach)
{
    const double bend = 2 * middle - plus - minus, slope = (plus - minus) / 2;
    const double jump = bend > 0 ? slope / bend : slope > 0 ? 1.0 : slope < 0 ? -1.0 : 0.0;
    return jump == jump ? held(jump, -reach, reach) : 0.0;
}

typedef struct {
    const double *centre; /* (2,) that points face away from */
    double no_side, offset, step, reach, rise;
    int64_t size, axes, rounds;
    double *places;     /* (K, axes) */
    double *amplitudes; /* (K, 2) */
    double *explained;  /* (1,) */
} Points;

INLINE void place_free(const Scene *s, const Points *p, int64_t i, const double *at)
{
    const double point[3] = {at[0], at[1], p->axes > 2 ? at[2] : 0.0};
    const double x = at[0] - p->centre[0], y = at[1] - p->centre[1], gap = sqrt(x * x + y * y);
    const double some = gap > 1e-12 ? gap : 1e-12;
    const double facing[2] = {gap < p->no_side ? 0.0 : x / some, gap < p->no_side ? 0.0 : y / some};
    place(s, i, point, facing, p->offset);
}

/* Every point free near its start: joint parabolic steps, or the best single one. */
WIDE static void search_points(const Scene *s, const Points *p)
{
    const int64_t k = p->size, axes = p->axes, moves = axes * k;
    double start[3 * MOST], trial[6 * MOST], joint[3 * MOST], value[6 * MOST + 1], gram[MOST * MOST][2],
        x[MOST][2];
    double changed[MOST * MOST][2], step = p->step;
    int32_t set[MOST];
    value[0] = 0.0;
    memcpy(start, p->places, (size_t)moves * sizeof(double));
    for (int64_t turn = 0; turn <= p->rounds; turn++) {
        for (int64_t i = 0; i < k; i++) {
            set[i] = (int32_t)i;
            place_free(s, p, i, p->places + axes * i);
        }
        for (int64_t i = 0; i < k; i++)
            relate(s, set, k, i, i, gram);
        value[0] = explain(s, set, k, gram, x);
        if (turn == p->rounds)
            break;
        int64_t best = 0;
        for (int64_t m = 0; m < 2 * moves; m++) {
            const int64_t c = m % moves, i = c / axes, axis = c % axes;
            const double unit = axis == 2 ? p->rise : 1.0, reach = p->reach * unit;
            double at[3];
            memcpy(at, p->places + axes * i, (size_t)axes * sizeof(double));
            at[axis] = held(at[axis] + (m < moves ? unit : -unit) * step, start[c] - reach, start[c] + reach);
            trial[m] = at[axis];
            place_free(s, p, k + i, at);
            memcpy(changed, gram, (size_t)(k * k) * sizeof(*changed));
            set[i] = (int32_t)(k + i);
            relate(s, set, k, i, 0, changed);
            value[1 + m] = explain(s, set, k, changed, x);
            set[i] = (int32_t)i;
            best = value[1 + m] > value[best] ? 1 + m : best;
        }
        for (int64_t c = 0; c < moves; c++) {
            const double unit = c % axes == 2 ? p->rise : 1.0, reach = p->reach * unit;
            const double jump = vertex(value[0], value[1 + c], value[1 + moves + c], 2.0);
            joint[c] = held(p->places[c] + jump * unit * step, start[c] - reach, start[c] + reach);
        }
        for (int64_t i = 0; i < k; i++)
            place_free(s, p, i, joint + axes * i);
        for (int64_t i = 0; i < k; i++)
            relate(s, set, k, i, i, gram);
        if (explain(s, set, k, gram, x) >= value[best])
            memcpy(p->places, joint, (size_t)moves * sizeof(double));
        else if (best)
            p->places[(best - 1) % moves] = trial[best - 1];
        step *= 0.7;
    }
    memcpy(p->amplitudes, x, (size_t)k * sizeof(*x));
    *p->explained = value[0];
}

typedef struct {
    const double *positions;         /* (K, 2) */
    const double *heights;           /* (K,) */
    const double *facing;            /* (K, 2) */
    const double *low, *high, *step; /* (D,) */
    int64_t size, axes, first, last;
    double balance, template_energy, visible;
} Layout;

/* Energy explained at one place, with the matrix and the amplitudes. */
INLINE double explained_at(const Scene *s, const Layout *l, const double *at, double (*gram)[2],
                           double (*x)[2])
{
    const int64_t k = l->size;
    const double c = cos(at[0]), n = sin(at[0]);
    int32_t set[MOST];
    for (int64_t i = 0; i < k; i++) {
        const double *p = l->positions + 2 * i, *f = l->facing + 2 * i;
        const double point[3] = {c * p[0] - n * p[1] + at[1], n * p[0] + c * p[1] + at[2],
                                 l->heights[i] + (l->axes > 4 ? at[4] : 0.0)};
        const double facing[2] = {c * f[0] - n * f[1], n * f[0] + c * f[1]};
        place(s, i, point, facing, at[3]);
        set[i] = (int32_t)i;
    }
    for (int64_t i = 0; i < k; i++)
        relate(s, set, k, i, i, gram);
    return explain(s, set, k, gram, x);
}

/* The same, charged for unlike amplitudes. */
INLINE double charged(const Scene *s, const Layout *l, const double *at)
{
    const int64_t k = l->size;
    double gram[MOST * MOST][2], x[MOST][2], size[MOST], trust[MOST], all = 0.0, typical = 0.0;
    const double explained = explained_at(s, l, at, gram, x);
    for (int64_t i = 0; i < k; i++) {
        const double share = gram[i * k + i][0] / l->template_energy / l->visible;
        trust[i] = share < 1.0 ? share : 1.0;
        size[i] = sqrt(x[i][0] * x[i][0] + x[i][1] * x[i][1]);
        all += trust[i];
        typical += trust[i] * size[i];
    }
    typical /= all > 1e-9 ? all : 1e-9;
    double least = INFINITY, most = 0.0;
    for (int64_t i = 0; i < k; i++) {
        const double own = trust[i] * size[i] + (1 - trust[i]) * typical;
        least = own < least ? own : least;
        most = own > most ? own : most;
    }
    const double alike = least / (most > 1e-30 ? most : 1e-30) / l->balance;
    return explained * (alike < 1.0 ? alike : 1.0);
}

#define AXES 5

/* One place (D,) moved: parabolic steps along all coordinates jointly, or the best single one. */
WIDE static void search_layout(const Scene *s, const Layout *l, double *at)
{
    const int64_t d = l->axes;
    for (int64_t turn = l->first; turn < l->last; turn++) {
        double value[2 * AXES + 1], trial[2 * AXES], joint[AXES], there[AXES];
        int64_t best = 0;
        for (int64_t i = 0; i < d; i++)
            there[i] = at[i] = held(at[i], l->low[i], l->high[i]);
        value[0] = charged(s, l, at);
        for (int64_t m = 0; m < 2 * d; m++) {
            const int64_t i = m % d;
            const double now = l->step[i] * 0.5 * pow(0.6, (double)turn);
            there[i] = trial[m] = held(at[i] + (m < d ? now : -now), l->low[i], l->high[i]);
            value[1 + m] = charged(s, l, there);
            there[i] = at[i];
            best = value[1 + m] > value[best] ? 1 + m : best;
        }
        for (int64_t i = 0; i < d; i++) {
            const double now = l->step[i] * 0.5 * pow(0.6, (double)turn);
            const double jump = vertex(value[0], value[1 + i], value[1 + d + i], 1.0);
            joint[i] = held(at[i] + jump * now, l->low[i], l->high[i]);
        }
        if (charged(s, l, joint) >= value[best])
            memcpy(at, joint, (size_t)d * sizeof(double));
        else if (best)
            at[(best - 1) % d] = trial[best - 1];
    }
}

typedef struct {
    const double *places; /* (H, D) */
    int64_t count;
    double *amplitudes; /* (H, K, 2) */
    double *explained;  /* (H,) */
    double *gram;       /* (H, K, K, 2) */
} Placed;

WIDE static void evaluate_places(const Scene *s, const Layout *l, const Placed *p)
{
    const int64_t k = l->size;
    for (int64_t h = 0; h < p->count; h++)
        p->explained[h] =
            explained_at(s, l, p->places + l->axes * h, (double (*)[2])(p->gram + 2 * k * k * h),
                         (double (*)[2])(p->amplitudes + 2 * k * h));
}

/* Profile (views, N) and phase (views, 2, N) of every point: what is read together lies together. */
WIDE static void look_points(const Field *g, const double *pattern, const double *points,
                             const double *facing, double offset, int64_t count, int32_t *index, float *turn)
{
    float lit_up[2 * BLOCK];
    Block b;
    for (int64_t first = 0; first < count; first += BLOCK) {
        const size_t some = (size_t)(count - first < BLOCK ? count - first : BLOCK);
        begin_block(points, facing, count, first, &b);
        for (int64_t v = 0; v < g->views; v++) {
            look_from(g, v, offset, &b);
            light(g, pattern, v, &b, lit_up);
            memcpy(index + count * v + first, b.index, some * sizeof(int32_t));
            memcpy(turn + count * (2 * v) + first, lit_up, some * sizeof(float));
            memcpy(turn + count * (2 * v + 1) + first, lit_up + BLOCK, some * sizeof(float));
        }
    }
}

static PyObject *evaluate(PyObject *self, PyObject *args)
{
    (void)self;
    PyObject *tables, *o[8];
    Py_ssize_t size;
    Held h = {.count = 0};
    Field g;
    Pattern p;
    Evaluation e;
    Scene s = {.pattern = &p};
    if (!PyArg_ParseTuple(args, "O(ddd)OOOOOniOOO", &tables, &p.edge, &p.softness, &p.floor, o, o + 1, o + 2,
                          o + 3, o + 4, &size, &s.whole, o + 5, o + 6, o + 7))
        return NULL;
    if (!field_of(&h, tables, &g) || !(s.data = take(&h, o[0], 8 * g.views * g.width, 0)) ||
        !(e.offset = take(&h, o[3], -1, 0)))
        return finished(&h);
    e.count = taken(&h) / 8;
    if (!(e.points = take(&h, o[1], 24 * e.count, 0)) || !(e.facing = take(&h, o[2], 16 * e.count, 0)) ||
        !(e.sets = take(&h, o[4], -1, 0)))
        return finished(&h);
    e.size = size;
    if (size < 1 || size > MOST || taken(&h) % (4 * size)) {
        refused("sets do not fit together");
        return finished(&h);
    }
    e.groups = taken(&h) / 4 / size;
    if (!below(e.sets, e.groups * size, e.count) ||
        !(e.amplitudes = take(&h, o[5], 16 * e.groups * size, 1)) ||
        !(e.explained = take(&h, o[6], 8 * e.groups, 1)) ||
        !(e.gram = take(&h, o[7], 16 * e.groups * size * size, 1)))
        return finished(&h);
    void *room = malloc(room_of(&g, e.count));
    if (!room) {
        PyErr_NoMemory();
        return finished(&h);
    }
    lay_out(&s, &g, e.count, room);
    Py_BEGIN_ALLOW_THREADS evaluate_sets(&s, &e);
    Py_END_ALLOW_THREADS free(room);
    return finished(&h);
}

static PyObject *move_points(PyObject *self, PyObject *args)
{
    (void)self;
    PyObject *tables, *o[5];
    Py_ssize_t rounds;
    Held h = {.count = 0};
    Field g;
    Pattern p;
    Points m;
    Scene s = {.pattern = &p, .whole = 0};
    if (!PyArg_ParseTuple(args, "O(ddd)OO(ddddd)nOOO", &tables, &p.edge, &p.softness, &p.floor, o, o + 1,
                          &m.no_side, &m.offset, &m.step, &m.reach, &m.rise, &rounds, o + 2, o + 3, o + 4))
        return NULL;
    m.rounds = rounds;
    if (!field_of(&h, tables, &g) || !(s.data = take(&h, o[0], 8 * g.views * g.width, 0)) ||
        !(m.centre = take(&h, o[1], 16, 0)) || !(m.amplitudes = take(&h, o[3], -1, 1)))
        return finished(&h);
    m.size = taken(&h) / 16;
    if (!(m.places = take(&h, o[2], -1, 1)) || !(m.explained = take(&h, o[4], 8, 1)))
        return finished(&h);
    m.axes = m.size ? h.held[h.count - 2].len / 8 / m.size : 0;
    if (m.size < 1 || m.size > MOST || m.axes < 2 || m.axes > 3 || rounds < 0 ||
        h.held[h.count - 2].len != 8 * m.size * m.axes) {
        refused("points do not fit together");
        return finished(&h);
    }
    void *room = malloc(room_of(&g, 2 * m.size));
    if (!room) {
        PyErr_NoMemory();
        return finished(&h);
    }
    lay_out(&s, &g, 2 * m.size, room);
    Py_BEGIN_ALLOW_THREADS search_points(&s, &m);
    Py_END_ALLOW_THREADS free(room);
    return finished(&h);
}

static PyObject *move_layouts(PyObject *self, PyObject *args)
{
    (void)self;
    PyObject *tables, *o[8];
    Py_ssize_t first, last;
    Held h = {.count = 0};
    Field g;
    Pattern p;
    Layout l;
    Scene s = {.pattern = &p, .whole = 0};
    double *places;
    if (!PyArg_ParseTuple(args, "O(ddd)OOOOOOO(ddd)nnO", &tables, &p.edge, &p.softness, &p.floor, o, o + 1,
                          o + 2, o + 3, o + 4, o + 5, o + 6, &l.balance, &l.template_energy, &l.visible,
                          &first, &last, o + 7))
        return NULL;
    l.first = first;
    l.last = last;
    if (!field_of(&h, tables, &g) || !(s.data = take(&h, o[0], 8 * g.views * g.width, 0)) ||
        !(l.heights = take(&h, o[2], -1, 0)))
        return finished(&h);
    l.size = taken(&h) / 8;
    if (!(l.positions = take(&h, o[1], 16 * l.size, 0)) || !(l.facing = take(&h, o[3], 16 * l.size, 0)) ||
        !(l.step = take(&h, o[4], -1, 0)))
        return finished(&h);
    l.axes = taken(&h) / 8;
    if (l.size < 1 || l.size > MOST || l.axes < 4 || l.axes > AXES) {
        refused("a layout does not fit together");
        return finished(&h);
    }
    if (!(l.low = take(&h, o[5], 8 * l.axes, 0)) || !(l.high = take(&h, o[6], 8 * l.axes, 0)) ||
        !(places = take(&h, o[7], -1, 1)))
        return finished(&h);
    const int64_t starts = taken(&h) / 8 / l.axes;
    if (taken(&h) != 8 * l.axes * starts) {
        refused("places do not fit together");
        return finished(&h);
    }
    void *room = malloc(room_of(&g, l.size));
    if (!room) {
        PyErr_NoMemory();
        return finished(&h);
    }
    lay_out(&s, &g, l.size, room);
    Py_BEGIN_ALLOW_THREADS for (int64_t i = 0; i < starts; i++) search_layout(&s, &l, places + l.axes * i);
    Py_END_ALLOW_THREADS free(room);
    return finished(&h);
}

static PyObject *place_layout(PyObject *self, PyObject *args)
{
    (void)self;
    PyObject *tables, *o[8];
    Held h = {.count = 0};
    Field g;
    Pattern p;
    Layout l;
    Placed m;
    Scene s = {.pattern = &p, .whole = 0};
    if (!PyArg_ParseTuple(args, "O(ddd)OOOOOOOO", &tables, &p.edge, &p.softness, &p.floor, o, o + 1, o + 2,
                          o + 3, o + 4, o + 5, o + 6, o + 7))
        return NULL;
    if (!field_of(&h, tables, &g) || !(s.data = take(&h, o[0], 8 * g.views * g.width, 0)) ||
        !(l.heights = take(&h, o[2], -1, 0)))
        return finished(&h);
    l.size = taken(&h) / 8;
    if (!(l.positions = take(&h, o[1], 16 * l.size, 0)) || !(l.facing = take(&h, o[3], 16 * l.size, 0)) ||
        !(m.explained = take(&h, o[6], -1, 1)))
        return finished(&h);
    m.count = taken(&h) / 8;
    if (!(m.places = take(&h, o[4], -1, 0)))
        return finished(&h);
    l.axes = m.count ? taken(&h) / 8 / m.count : 0;
    if (l.size < 1 || l.size > MOST || l.axes < 4 || l.axes > AXES || taken(&h) != 8 * m.count * l.axes) {
        refused("a layout and its places do not fit together");
        return finished(&h);
    }
    if (!(m.amplitudes = take(&h, o[5], 16 * m.count * l.size, 1)) ||
        !(m.gram = take(&h, o[7], 16 * m.count * l.size * l.size, 1)))
        return finished(&h);
    void *room = malloc(room_of(&g, l.size));
    if (!room) {
        PyErr_NoMemory();
        return finished(&h);
    }
    lay_out(&s, &g, l.size, room);
    Py_BEGIN_ALLOW_THREADS evaluate_places(&s, &l, &m);
    Py_END_ALLOW_THREADS free(room);
    return finished(&h);
}

static PyObject *look(PyObject *self, PyObject *args)
{
    (void)self;
    PyObject *tables, *o[4];
    Held h = {.count = 0};
    Field g;
    Pattern p;
    double offset;
    const double *points, *facing;
    int32_t *index;
    float *turn;
    if (!PyArg_ParseTuple(args, "O(ddd)OOdOO", &tables, &p.edge, &p.softness, &p.floor, o, o + 1, &offset,
                          o + 2, o + 3))
        return NULL;
    if (!field_of(&h, tables, &g) || !(points = take(&h, o[0], -1, 0)))
        goto done;
    const int64_t count = taken(&h) / 24;
    if (!(facing = take(&h, o[1], 16 * count, 0)) || !(index = take(&h, o[2], 4 * count * g.views, 1)) ||
        !(turn = take(&h, o[3], 8 * count * g.views, 1)))
        goto done;
    const double pattern[3] = {p.edge, p.softness, p.floor};
    Py_BEGIN_ALLOW_THREADS look_points(&g, pattern, points, facing, offset, count, index, turn);
    Py_END_ALLOW_THREADS
done:
    return finished(&h);
}

static PyMethodDef methods[] = {
    {"evaluate", evaluate, METH_VARARGS,
     "evaluate(tables, pattern, data, points, facing, offsets, sets, size, whole, amplitudes, explained, "
     "gram)"},
    {"move_points", move_points, METH_VARARGS,
     "move_points(tables, pattern, data, centre, (no_side, offset, step, reach, rise), rounds, places, "
     "amplitudes, explained)"},
    {"move_layouts", move_layouts, METH_VARARGS,
     "move_layouts(tables, pattern, data, positions, heights, facing, step, low, high, (balance, "
     "template_energy, visible), "
     "first, last, places)"},
    {"place_layout", place_layout, METH_VARARGS,
     "place_layout(tables, pattern, data, positions, heights, facing, places, amplitudes, explained, gram)"},
    {"look", look, METH_VARARGS, "look(tables, pattern, points, facing, offset, index, turn)"},
    {NULL, NULL, 0, NULL},
};

MODULE(_matched, "Compiled inner loops of the tag reader (see tagid.tags.reading.compiled).", methods, 3)
