/* Warm-up: the table's row is picked once at power-on, then evaluated per sample. Time is counted in integer ticks,
 * because a sum of float seconds drifts. */
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
    for (int32_t j = 0; w->model == IL_EXPONENTIAL && j < w->terms; j++) state->rate[j] = -tick / w->time_constant[j];
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

enum { FINE = 32 }; /* ticks; a power of two */

/* Decay after `ticks` ticks as a product, whose second factor has few values: a block computes each of them once. */
static il_real decay(il_real rate, uint32_t ticks) {
    return il_exp((il_real)(ticks - ticks % FINE) * rate) * il_exp((il_real)(ticks % FINE) * rate);
}

/* u of the cubics: t / T_M, or the same in log(1 + t / tau0). */
static il_real cubic_time(const il_warmup *w, const il_warmup_state *state, uint32_t ticks) {
    il_real t = (il_real)ticks * state->rate[0];
    return w->model == IL_KNOT_LOG_CUBIC ? il_log1p(t) * state->log_scale : t;
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

static void coefficients(const il_warmup *w, const il_warmup_state *state, int32_t axis, il_real c[4]) {
    for (int32_t j = 0; j < w->terms; j++) c[j] = coefficient(w, state, axis, j);
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
    if (active && !exponential) b[0] = cubic_time(settings, state, ticks);
    for (int32_t j = 0; active && exponential && j < settings->terms; j++) b[j] = decay(state->rate[j], ticks);
    for (int32_t axis = 0; axis < settings->axes; axis++) {
        il_real c[4] = {IL_C(0.0), IL_C(0.0), IL_C(0.0), IL_C(0.0)};
        bias[axis] = IL_C(0.0);
        if (!active) continue;
        coefficients(settings, state, axis, c);
        bias[axis] = share * (exponential ? decays(c, b[0], b[1], b[2]) : cubic(c, b[0]));
    }
}

enum { CHUNK = 64 }; /* samples whose basis is kept on the stack */

/* The basis of some samples, computed once for all axes: u (in [0]), or a decay per time constant. */
typedef struct {
    il_real basis[3][CHUNK];
    il_real share[CHUNK];
    int some, all; /* whether Z is in force in some samples, and wholly in all */
} chunk;

/* The factors of the decays: all of the fine ones, and the coarse ones last used. */
typedef struct {
    il_real fine[3][FINE], coarse[3];
    uint32_t at; /* ticks of the coarse ones */
    uint32_t count; /* fine ones per term: none where the block is too short to gain from them */
} factors;

static void prepare(const il_warmup *w, const il_warmup_state *state, size_t n, factors *f) {
    f->at = 0;
    f->count = w->model == IL_EXPONENTIAL && n > 2 * FINE ? FINE : 0;
    for (int32_t j = 0; j < w->terms && f->count > 0; j++) {
        f->coarse[j] = il_exp(IL_C(0.0) * state->rate[j]);
        for (uint32_t k = 0; k < FINE; k++) f->fine[j][k] = il_exp((il_real)k * state->rate[j]);
    }
}

static il_real decay_from(factors *f, const il_warmup_state *state, int32_t j, uint32_t ticks) {
    if (f->count == 0) return decay(state->rate[j], ticks);
    return f->coarse[j] * f->fine[j][ticks % FINE];
}

static void look_ahead(const il_warmup *w, const il_warmup_state *state, factors *f, size_t n, const uint32_t *ticks,
                       chunk *p) {
    p->some = 0;
    p->all = 1;
    for (size_t k = 0; k < n; k++) {
        uint32_t t = ticks[k];
        p->share[k] = exit_share(w, state, &t);
        p->all &= p->share[k] == IL_C(1.0);
        for (int j = 0; j < 3; j++) p->basis[j][k] = IL_C(0.0);
        if (p->share[k] == IL_C(0.0)) continue;
        p->some = 1;
        if (w->model != IL_EXPONENTIAL) {
            p->basis[0][k] = cubic_time(w, state, t);
            continue;
        }
        if (f->count > 0 && t - t % FINE != f->at) {
            f->at = t - t % FINE;
            for (int32_t j = 0; j < w->terms; j++) f->coarse[j] = il_exp((il_real)f->at * state->rate[j]);
        }
        for (int32_t j = 0; j < w->terms; j++) p->basis[j][k] = decay_from(f, state, j, t);
    }
}

static void subtract(const il_warmup *w, const chunk *p, const il_real c[4], size_t n, il_real *z) {
    const il_real *u = p->basis[0], *v = p->basis[1], *x = p->basis[2];
    if (p->all && w->model != IL_EXPONENTIAL) { /* the usual cases, without a question in the loop */
        for (size_t k = 0; k < n; k++) z[k] -= cubic(c, u[k]);
    } else if (p->all) {
        for (size_t k = 0; k < n; k++) z[k] -= decays(c, u[k], v[k], x[k]);
    } else {
        for (size_t k = 0; k < n; k++) {
            il_real bias = w->model == IL_EXPONENTIAL ? decays(c, u[k], v[k], x[k]) : cubic(c, u[k]);
            if (p->share[k] > IL_C(0.0)) z[k] -= p->share[k] * bias;
        }
    }
}

void il_warmup_block(const il_warmup *settings, const il_warmup_state *state, size_t n, const uint32_t *ticks,
                     il_real *const *output) {
    factors f;
    if (!state->active) return;
    prepare(settings, state, n, &f);
    for (size_t first = 0; first < n; first += CHUNK) {
        size_t count = n - first < CHUNK ? n - first : CHUNK;
        chunk p;
        look_ahead(settings, state, &f, count, ticks + first, &p);
        for (int32_t axis = 0; p.some && axis < settings->axes; axis++) {
            il_real c[4] = {IL_C(0.0), IL_C(0.0), IL_C(0.0), IL_C(0.0)};
            if (output[axis] == NULL) continue;
            coefficients(settings, state, axis, c);
            subtract(settings, &p, c, count, output[axis] + first);
        }
    }
}
