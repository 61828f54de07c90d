/* Warm-up: the table's row is picked once at power-on, then evaluated per sample. Time is counted in integer ticks,
 * because a sum of float seconds drifts.
 *
 * exp and log1p are asked of the library once for a span of ticks, whose first tick is a multiple of its length; within
 * it a short series leads on. So a sample's value depends on its tick alone, whatever came before it, and a block of
 * samples is a loop over a polynomial. */
#include "real.h"

/* Shares of the lower and upper value, and of the lower and upper slope, in the cubic through both (Hermite). */
static void hermite(il_warmup_state *state, il_real x, il_real width) {
    il_real y = IL_C(1.0) - x;
    state->share[0] = (IL_C(1.0) + IL_C(2.0) * x) * y * y;
    state->share[1] = x * x * (IL_C(3.0) - IL_C(2.0) * x);
    state->share[2] = width * x * y * y;
    state->share[3] = -width * x * x * y;
}

/* Ticks in a time, rounded up and limited to what a counter holds; 0 for a time that is negative or no number. */
static uint32_t ticks_in(il_real time, il_real tick) {
    il_real ticks = time / tick;
    if (!(ticks > IL_C(0.0))) return 0;
    if (ticks >= IL_C(4294967040.0)) return UINT32_MAX; /* largest float below 2^32 */
    uint32_t whole = (uint32_t)ticks;
    return (il_real)whole < ticks ? whole + 1u : whole;
}

enum { LONGEST_SPAN = 1 << 24 }; /* ticks; a float counts as far */

/* Ticks in a span: a power of two in which the fastest rate goes no further than 1/256, where the series below end. */
static uint32_t span_of(il_real fastest) {
    uint32_t span = 1;
    while (span < LONGEST_SPAN && (il_real)span * fastest <= IL_C(0.001953125)) span *= 2;
    return span;
}

il_status il_warmup_start(const il_warmup *settings, il_warmup_state *state, il_real temperature, il_real tick) {
    const il_warmup *w = settings;
    memset(state, 0, sizeof *state);
    if (!(tick > IL_C(0.0)) || !il_finite(tick) || w->temperatures < 2) return IL_ARGUMENT;
    state->settled = ticks_in(w->settling_time, tick);
    state->ended = ticks_in(w->settling_time + w->taper_time, tick);
    state->rate[0] = tick / w->settling_time;
    if (w->model == IL_KNOT_LOG_CUBIC) {
        state->rate[0] = tick / w->time_scale;
        state->log_scale = IL_C(1.0) / il_log1p(w->settling_time / w->time_scale);
    }
    il_real fastest = state->rate[0];
    for (int32_t j = 0; w->model == IL_EXPONENTIAL && j < w->terms; j++) {
        state->rate[j] = -tick / w->time_constant[j];
        if (j == 0 || !(il_fabs(state->rate[j]) <= fastest)) fastest = il_fabs(state->rate[j]);
    }
    state->span = span_of(fastest);
    int32_t last = w->temperatures - 1;
    if (!(temperature >= w->temperature[0] && temperature <= w->temperature[last])) return IL_OK; /* also for NaN */
    state->active = 1;
    int32_t row = 0; /* intervals are half-open, the last one is closed */
    while (row < last - 1 && temperature >= w->temperature[row + 1]) row++;
    state->row = row;
    state->share[0] = IL_C(1.0);
    if (w->model == IL_INTERVAL_CUBIC) return IL_OK;
    il_real width = w->temperature[row + 1] - w->temperature[row];
    il_real x = (temperature - w->temperature[row]) / width;
    if (w->model == IL_EXPONENTIAL) {
        hermite(state, x, width);
    } else {
        state->share[0] = IL_C(1.0) - x;
        state->share[1] = x;
    }
    return IL_OK;
}

/* exp and log1p of |q| <= 1/256: what the series leave out is below 3e-18. */
static inline il_real exp_near(il_real q) {
    il_real tail = IL_C(1.0) / IL_C(24.0) + q * (IL_C(1.0) / IL_C(120.0));
    return IL_C(1.0) + q * (IL_C(1.0) + q * (IL_C(0.5) + q * (IL_C(1.0) / IL_C(6.0) + q * tail)));
}

static inline il_real log1p_near(il_real q) {
    il_real tail = IL_C(0.25) - q * (IL_C(1.0) / IL_C(5.0) - q * (IL_C(1.0) / IL_C(6.0)));
    return q * (IL_C(1.0) - q * (IL_C(0.5) - q * (IL_C(1.0) / IL_C(3.0) - q * tail)));
}

/* The span last used. */
typedef struct {
    int known;
    uint32_t first;   /* tick */
    il_real value[3]; /* there: the decays, or log(1 + t / tau0) in [0] */
    il_real rate[3];  /* per tick: of the exponents, or of 1 + t / tau0 relative to itself in [0] */
} anchor;

static void move(const il_warmup *w, const il_warmup_state *state, uint32_t ticks, anchor *a) {
    uint32_t first = ticks - ticks % state->span;
    if (a->known && first == a->first) return;
    a->known = 1;
    a->first = first;
    il_real t = (il_real)first * state->rate[0];
    if (w->model == IL_KNOT_LOG_CUBIC) {
        a->value[0] = il_log1p(t);
        a->rate[0] = state->rate[0] / (IL_C(1.0) + t);
    }
    for (int32_t j = 0; w->model == IL_EXPONENTIAL && j < w->terms; j++) {
        a->value[j] = il_exp((il_real)first * state->rate[j]);
        a->rate[j] = state->rate[j];
    }
}

/* How many ticks, from the first one on, lie in its span. */
static size_t run_of(uint32_t span, size_t n, const uint32_t *ticks) {
    uint32_t differ = 0;
    size_t k = 1;
    for (size_t i = 0; i < n; i++) differ |= ticks[i] ^ ticks[0];
    if (differ < span) return n;
    while ((ticks[k] ^ ticks[0]) < span) k++;
    return k;
}

/* The basis of n ticks, which all axes share: u of the cubics, t / T_M or the same in log(1 + t / tau0); or a row of
 * decays for each time constant, `stride` apart. */
static void basis_of(const il_warmup *w, const il_warmup_state *state, anchor *a, size_t n, const uint32_t *ticks,
                     size_t stride, il_real *basis) {
    if (w->model == IL_INTERVAL_CUBIC || w->model == IL_KNOT_CUBIC) {
        for (size_t k = 0; k < n; k++) basis[k] = (il_real)ticks[k] * state->rate[0];
        return;
    }
    for (size_t at = 0, end; at < n; at = end) {
        move(w, state, ticks[at], a);
        end = at + run_of(state->span, n - at, ticks + at);
        if (w->model == IL_KNOT_LOG_CUBIC) {
            for (size_t k = at; k < end; k++) {
                il_real q = (il_real)(int32_t)(ticks[k] - a->first) * a->rate[0];
                basis[k] = (a->value[0] + log1p_near(q)) * state->log_scale;
            }
        }
        for (int32_t j = 0; w->model == IL_EXPONENTIAL && j < w->terms; j++) {
            il_real value = a->value[j], rate = a->rate[j];
            for (size_t k = at; k < end; k++) {
                basis[(size_t)j * stride + k] = value * exp_near((il_real)(int32_t)(ticks[k] - a->first) * rate);
            }
        }
    }
}

/* Coefficient of a term, interpolated to the power-on temperature. */
static il_real coefficient(const il_warmup *w, const il_warmup_state *state, int32_t axis, int32_t term) {
    size_t low = ((size_t)state->row * (size_t)w->axes + (size_t)axis) * (size_t)w->terms + (size_t)term;
    size_t high = low + (size_t)w->axes * (size_t)w->terms;
    if (w->model == IL_INTERVAL_CUBIC) return w->coefficient[low];
    il_real c = state->share[0] * w->coefficient[low] + state->share[1] * w->coefficient[high];
    if (w->model == IL_EXPONENTIAL) c += state->share[2] * w->slope[low] + state->share[3] * w->slope[high];
    return c;
}

static void coefficients(const il_warmup *w, const il_warmup_state *state, int32_t axis, il_real factor, il_real c[4]) {
    for (int32_t j = 0; j < 4; j++) c[j] = j < w->terms ? factor * coefficient(w, state, axis, j) : IL_C(0.0);
}

static inline il_real cubic(const il_real c[4], il_real u) {
    return c[0] + u * (c[1] + u * (c[2] + u * c[3]));
}

/* Terms that the model lacks have coefficients of zero. */
static inline il_real decays(const il_real c[4], il_real first, il_real second, il_real third) {
    return c[0] * first + c[1] * second + c[2] * third;
}

/* Share of Z in force after `ticks`, and the ticks to evaluate Z at. */
static il_real exit_share(const il_warmup *w, const il_warmup_state *state, uint32_t *ticks) {
    if (!state->active) return IL_C(0.0);
    if (*ticks < state->settled) return IL_C(1.0);
    uint32_t now = *ticks;
    *ticks = state->settled;
    if (w->exit == IL_EXIT_HOLD) return IL_C(1.0);
    if (w->exit == IL_EXIT_ZERO || now >= state->ended) return IL_C(0.0);
    return (il_real)(state->ended - now) / (il_real)(state->ended - state->settled);
}

void il_warmup_bias(const il_warmup *settings, const il_warmup_state *state, uint32_t ticks, il_real *bias) {
    il_real share = exit_share(settings, state, &ticks), b[3] = {IL_C(0.0), IL_C(0.0), IL_C(0.0)};
    int exponential = settings->model == IL_EXPONENTIAL, active = share > IL_C(0.0);
    anchor a = {0};
    if (active) basis_of(settings, state, &a, 1, &ticks, 1, b);
    for (int32_t axis = 0; axis < settings->axes; axis++) {
        il_real c[4];
        bias[axis] = IL_C(0.0);
        if (!active) continue;
        coefficients(settings, state, axis, IL_C(1.0), c);
        bias[axis] = share * (exponential ? decays(c, b[0], b[1], b[2]) : cubic(c, b[0]));
    }
}

enum { CHUNK = 64 }; /* samples whose basis is kept on the stack */
enum { GROUP = 8 };  /* axes whose coefficients are kept there */

typedef struct {
    il_real basis[3 * CHUNK];
    il_real share[CHUNK]; /* of Z in force, where that is not all of it throughout */
    int some, all;        /* whether Z is in force in some samples, and wholly in all */
} chunk;

static void look_ahead(const il_warmup *w, const il_warmup_state *state, anchor *a, size_t n, const uint32_t *ticks,
                       chunk *p) {
    uint32_t when[CHUNK];
    size_t late = 0;
    for (size_t k = 0; k < n; k++) late += ticks[k] >= state->settled;
    p->all = late == 0;
    p->some = late < n || w->exit != IL_EXIT_ZERO;
    if (p->all) basis_of(w, state, a, n, ticks, CHUNK, p->basis);
    if (p->all || !p->some) return;
    p->all = 1;
    p->some = 0;
    for (size_t k = 0; k < n; k++) {
        when[k] = ticks[k];
        p->share[k] = exit_share(w, state, &when[k]);
        p->all &= p->share[k] == IL_C(1.0);
        p->some |= p->share[k] > IL_C(0.0);
    }
    if (p->some) basis_of(w, state, a, n, when, CHUNK, p->basis);
}

static void subtract(const il_warmup *w, const chunk *p, const il_real of[4], size_t n, il_real *z) {
    const il_real c[4] = {of[0], of[1], of[2], of[3]}; /* which z cannot change */
    const il_real *u = p->basis, *v = u + CHUNK, *x = v + CHUNK;
    int exponential = w->model == IL_EXPONENTIAL;
    if (p->all && !exponential) { /* the usual cases, without a question in the loop */
        for (size_t k = 0; k < n; k++) z[k] -= cubic(c, u[k]);
    } else if (p->all && w->terms < 3) {
        for (size_t k = 0; k < n; k++) z[k] -= decays(c, u[k], v[k], IL_C(0.0));
    } else if (p->all) {
        for (size_t k = 0; k < n; k++) z[k] -= decays(c, u[k], v[k], x[k]);
    } else {
        for (size_t k = 0; k < n; k++) {
            il_real bias = exponential ? decays(c, u[k], v[k], x[k]) : cubic(c, u[k]);
            if (p->share[k] > IL_C(0.0)) z[k] -= p->share[k] * bias;
        }
    }
}

void il_warmup_block(const il_warmup *settings, const il_warmup_state *state, size_t n, const uint32_t *ticks,
                     const il_real *const *input, const il_real *factor, il_real *const *output) {
    anchor a = {0};
    chunk p = {.some = 0};
    for (int32_t from = 0; from < settings->axes; from += GROUP) {
        int32_t axes = settings->axes - from < GROUP ? settings->axes - from : GROUP;
        il_real c[GROUP][4];
        for (int32_t i = 0; i < axes && state->active; i++) {
            coefficients(settings, state, from + i, factor == NULL ? IL_C(1.0) : factor[from + i], c[i]);
        }
        for (size_t first = 0; first < n; first += CHUNK) {
            size_t count = n - first < CHUNK ? n - first : CHUNK;
            if (state->active) look_ahead(settings, state, &a, count, ticks + first, &p);
            for (int32_t i = 0; i < axes; i++) {
                il_real *z = output[from + i];
                if (z == NULL) continue;
                const il_real *x = input[from + i] + first;
                z += first;
                if (x != z) memcpy(z, x, count * sizeof *z);
                /* A dozen columns are more than the processor looks ahead in by itself. */
                for (size_t k = CHUNK; n - first >= 2 * CHUNK && k < 2 * CHUNK; k += 8) il_prefetch(x + k, z + k);
                if (p.some) subtract(settings, &p, c[i], count, z);
            }
        }
    }
}
