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
    state->per_tick = w->model == IL_EXPONENTIAL ? tick : tick / w->settling_time;
    if (w->model == IL_KNOT_LOG_CUBIC) {
        state->per_tick = tick / w->time_scale;
        state->log_scale = IL_C(1.0) / il_log1p(w->settling_time / w->time_scale);
    }
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

/* What the coefficients of an axis are multiplied with: u for the cubics, one decay per time constant. */
typedef struct {
    il_real u;
    il_real decay[3];
} basis;

static basis basis_at(const il_warmup *w, const il_warmup_state *state, uint32_t ticks) {
    basis b = {IL_C(0.0), {IL_C(0.0), IL_C(0.0), IL_C(0.0)}};
    il_real t = (il_real)ticks * state->per_tick;
    if (w->model == IL_EXPONENTIAL) {
        for (int32_t j = 0; j < w->terms; j++) b.decay[j] = il_exp(-t / w->time_constant[j]);
    } else {
        b.u = w->model == IL_KNOT_LOG_CUBIC ? il_log1p(t) * state->log_scale : t;
    }
    return b;
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

static il_real combined(const il_warmup *w, const basis *b, const il_real c[4]) {
    if (w->model != IL_EXPONENTIAL) return c[0] + b->u * (c[1] + b->u * (c[2] + b->u * c[3]));
    il_real sum = IL_C(0.0);
    for (int32_t j = 0; j < w->terms; j++) sum += c[j] * b->decay[j];
    return sum;
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

static void coefficients(const il_warmup *w, const il_warmup_state *state, int32_t axis, il_real c[4]) {
    for (int32_t j = 0; j < w->terms; j++) c[j] = coefficient(w, state, axis, j);
}

void il_warmup_bias(const il_warmup *settings, const il_warmup_state *state, uint32_t ticks, il_real *bias) {
    il_real share = exit_share(settings, state, &ticks);
    basis b = basis_at(settings, state, ticks);
    for (int32_t axis = 0; axis < settings->axes; axis++) {
        il_real c[4] = {IL_C(0.0), IL_C(0.0), IL_C(0.0), IL_C(0.0)};
        bias[axis] = IL_C(0.0);
        if (share > IL_C(0.0)) {
            coefficients(settings, state, axis, c);
            bias[axis] = share * combined(settings, &b, c);
        }
    }
}

enum { CHUNK = 256 }; /* samples whose basis fits in the first cache */

void il_warmup_block(const il_warmup *settings, const il_warmup_state *state, size_t n, const uint32_t *ticks,
                     il_real *const *output) {
    const il_warmup *w = settings;
    basis b[CHUNK];
    il_real share[CHUNK];
    if (!state->active) return;
    for (size_t first = 0; first < n; first += CHUNK) {
        size_t count = n - first < CHUNK ? n - first : CHUNK;
        for (size_t k = 0; k < count; k++) {
            uint32_t t = ticks[first + k];
            share[k] = exit_share(w, state, &t);
            b[k] = basis_at(w, state, t);
        }
        for (int32_t axis = 0; axis < w->axes; axis++) {
            il_real c[4] = {IL_C(0.0), IL_C(0.0), IL_C(0.0), IL_C(0.0)};
            if (output[axis] == NULL) continue;
            coefficients(w, state, axis, c);
            il_real *z = output[axis] + first;
            for (size_t k = 0; k < count; k++) {
                if (share[k] > IL_C(0.0)) z[k] -= share[k] * combined(w, &b[k], c);
            }
        }
    }
}
