/* Gyro array: three axes at once, for the methods that have it: what they share, mean, least squares and feedback;
 * robust_lanes.c has the robust method. */
#include "lanes.h"

#if IL_LANES
enum { BLOCK = 8 };                /* samples in a block that are worth it, */
enum { SHORT = 64 };               /* and in a row without a pause */
enum { PAUSE = 8, LONGEST = 512 }; /* samples between two tries, at first and when they fail again and again */

void il_lanes_part(il_lanes *l) {
    l->pause = l->together && l->stay >= SHORT ? PAUSE : l->pause < LONGEST ? 2 * l->pause : LONGEST;
    l->wait = l->pause;
    l->together = 0;
}

/* ---- mean and least squares: what array.c does, to the last bit ------------------------------------------------------ */

LANES_BEGIN

/* Whether every gyro has a residual, and every axis two samples. */
static int squares_ready(const il_array *a, const il_array_state *state) {
    int ready = 1;
    EACH_AXIS {
        const il_array_axis *s = &state->axis[j];
        ready &= (s->count > a->start) & (s->count < UINT32_MAX);
        for (int32_t i = 0; i < a->elements; i++) ready &= s->seen[i] > 0;
    }
    return ready;
}

static void squares_enter(il_lanes *l, const il_array *a, const il_array_state *state) {
    l->settled = 1; /* all gyros of an axis have seen the same */
    EACH_LANE {
        const il_array_axis *s = &state->axis[j < 2 ? j : 2];
        for (int32_t i = 0; i < a->elements; i++) {
            l->bias[i][j] = s->bias[i];
            l->variance[i][j] = s->variance[i];
            l->seen[i][j] = s->seen[i];
            l->settled &= s->seen[i] == s->seen[0];
        }
    }
}

static void squares_leave(const il_lanes *l, const il_array *a, il_array_state *state) {
    EACH_AXIS {
        il_array_axis *s = &state->axis[j];
        for (int32_t i = 0; i < a->elements; i++) {
            s->bias[i] = l->bias[i][j];
            s->variance[i] = l->variance[i][j];
            s->seen[i] = il_counted(s->seen[i], l->done);
        }
    }
}

LANES_INLINE il_four squares_gain(const il_lanes *l, const il_array *a, int32_t i) {
    if (a->memory > IL_C(0.0)) return all_lanes(a->memory);
    return IL_C(1.0) / capped_lanes(counted_lanes(counted_lanes(l->seen[i], l->done), a->start), UINT32_MAX);
}

/* What a gyro teaches, its weight, and what is summed up of it. */
LANES_INLINE void squares_take(il_lanes *l, int32_t i, il_four mean, il_four gain, il_four *total, il_four *sum) {
    const il_four z = l->r[i], residual = z - mean - l->bias[i];
    const il_four variance = l->variance[i] + gain * ((IL_C(1.0) - gain) * residual * residual - l->variance[i]);
    const il_four weight = IL_C(1.0) / (variance + IL_TINY);
    l->bias[i] += gain * residual;
    l->variance[i] = variance;
    l->weight[i] = weight;
    *total += weight;
    *sum += weight * z;
}

static void squares_fuse(il_lanes *l, const il_array *a, il_four mean) {
    const int32_t n = a->elements;
    const il_four none = all_lanes(IL_C(0.0)), shared = squares_gain(l, a, 0);
    il_four total[2] = {none, none}, sum[2] = {none, none};
    int32_t i;
    for (i = 0; i + 1 < n; i += 2) {
        squares_take(l, i, mean, l->settled ? shared : squares_gain(l, a, i), &total[0], &sum[0]);
        squares_take(l, i + 1, mean, l->settled ? shared : squares_gain(l, a, i + 1), &total[1], &sum[1]);
    }
    if (i < n) squares_take(l, i, mean, l->settled ? shared : squares_gain(l, a, i), &total[0], &sum[0]);
    l->total = total[0] + total[1];
    l->rate = (sum[0] + sum[1]) / l->total;
    EACH_LANE {
        if (l->total[j] != IL_C(0.0)) continue; /* variances beyond all numbers */
        l->rate[j] = il_nan();
        l->total[j] = IL_C(1.0);
    }
}

/* Mean of each axis; readings into lanes. */
LANES_INLINE il_four plain_mean(il_lanes *l, int32_t n, const il_real *z) {
    il_four even = all_lanes(IL_C(0.0)), odd = even;
    int32_t i;
    for (i = 0; i + 1 < n; i += 2) {
        even += l->r[i] = lanes_of(z + i, n);
        odd += l->r[i + 1] = lanes_of(z + i + 1, n);
    }
    if (i < n) even += l->r[i] = lanes_of(z + i, n);
    return (even + odd) / (il_real)n;
}

static int plain_step(il_lanes *l, const il_array *a, il_array_state *state, const il_real *z, il_real *rate,
                      int want_health, unsigned *met) {
    const int32_t n = a->elements;
    const il_four mean = plain_mean(l, n, z);
    const int squares = a->method == IL_LEAST_SQUARES;
    if (!all_axes(mean - mean == IL_C(0.0))) { /* a reading is missing */
        if (squares) squares_leave(l, a, state);
        il_lanes_part(l);
        return 0;
    }
    if (squares) {
        squares_fuse(l, a, mean);
    } else {
        l->rate = mean;
    }
    l->done++;
    l->stay++;
    for (int32_t i = 0; want_health && i < n; i++) {
        const il_four weight = squares ? l->weight[i] / l->total : all_lanes(IL_C(1.0) / (il_real)n);
        EACH_AXIS {
            state->axis[j].weight[i] = weight[j];
            state->axis[j].flags[i] = 0;
        }
    }
    EACH_AXIS {
        il_array_axis *s = &state->axis[j];
        il_count(&s->count);
        s->rate = l->rate[j];
        rate[j] = s->rate - s->common;
        if (!il_finite(s->rate)) *met |= IL_NOT_FINITE;
    }
    return 1;
}

/* ---- feedback: its recursion in array.c, which has no defence against readings that are no numbers ------------------- */

/* Whether every axis had its first sample, which is unlike the others. */
static int feedback_ready(const il_array *a, const il_array_state *state) {
    int ready = a->start < UINT32_MAX;
    EACH_AXIS ready &= state->axis[j].count >= a->start;
    return ready;
}

static void feedback_enter(il_lanes *l, const il_array *a, const il_array_state *state) {
    EACH_LANE {
        const il_array_axis *s = &state->axis[j < 2 ? j : 2];
        l->rate[j] = s->rate;
        l->seen[0][j] = s->count;
        for (int32_t i = 0; i < a->elements + a->elements % 2; i++) {
            l->bias[i][j] = s->bias[i];
            l->variance[i][j] = s->variance[i];
        }
    }
}

static void feedback_leave(const il_lanes *l, const il_array *a, il_array_state *state) {
    EACH_AXIS {
        for (int32_t i = 0; i < a->elements + a->elements % 2; i++) {
            state->axis[j].bias[i] = l->bias[i][j];
            state->axis[j].variance[i] = l->variance[i][j];
        }
    }
}

LANES_INLINE void feedback_take(il_lanes *l, int32_t i, il_four z, il_four gain, il_four before, il_four *total,
                                il_four *sum) {
    const il_four b = l->bias[i] + gain * (z - l->bias[i] - before), y = z - b, error = y - before;
    const il_four d = (IL_C(1.0) - gain) * l->variance[i] + gain * (error * error);
    const il_four share = IL_C(1.0) / larger_lanes(all_lanes(IL_TINY), d);
    l->bias[i] = b;
    l->variance[i] = d;
    l->weight[i] = share;
    *total += share;
    *sum += share * y;
}

static void feedback_fuse(il_lanes *l, const il_array *a, const il_real *z) {
    const int32_t n = a->elements;
    const il_four before = l->rate, none = all_lanes(IL_C(0.0));
    il_four gain = all_lanes(a->memory), total[2] = {none, none}, sum[2] = {none, none};
    int32_t i;
    if (!(a->memory > IL_C(0.0))) gain = IL_C(1.0) / capped_lanes(counted_lanes(l->seen[0], l->done), UINT32_MAX);
    for (i = 0; i + 1 < n; i += 2) {
        feedback_take(l, i, lanes_of(z + i, n), gain, before, &total[0], &sum[0]);
        feedback_take(l, i + 1, lanes_of(z + i + 1, n), gain, before, &total[1], &sum[1]);
    }
    if (i < n) { /* and its partner of infinite variance */
        feedback_take(l, i, lanes_of(z + i, n), gain, before, &total[0], &sum[0]);
        feedback_take(l, i + 1, before, gain, before, &total[1], &sum[1]);
    }
    l->rate = (sum[0] + sum[1]) / (total[0] + total[1]);
}

static void feedback_of_three(il_lanes *l, const il_array *a, il_array_state *state, const il_real *z, il_real *rate,
                              int want_health, unsigned *met) {
    const int32_t n = a->elements;
    l->done++;
    feedback_fuse(l, a, z);
    EACH_AXIS {
        il_array_axis *s = &state->axis[j];
        il_count(&s->count);
        s->rate = l->rate[j];
        rate[j] = s->rate - s->common;
        if (!il_finite(s->rate)) *met |= IL_NOT_FINITE;
        if (!want_health) continue;
        for (int32_t i = 0; i < n + n % 2; i++) s->weight[i] = l->weight[i][j];
        il_feedback_health(a, s, z + j * n);
        for (int32_t i = 0; i < n; i++) *met |= s->flags[i];
    }
}

LANES_END

/* ---- each method ----------------------------------------------------------------------------------------------------- */

int il_lanes_start(il_lanes *l, const il_array *a, size_t n) {
    const unsigned with_lanes = 1u << IL_MEAN | 1u << IL_LEAST_SQUARES | 1u << IL_FEEDBACK | 1u << IL_ROBUST;
    if (!(with_lanes >> a->method & 1u) || a->axes != 3 || n < BLOCK) return 0;
    l->together = 0;
    l->wait = 0;
    l->pause = PAUSE;
    return LANES_SUPPORTED;
}

int il_lanes_ready(il_lanes *l, const il_array *a, const il_array_state *state) {
    int ready = 1;
    if (a->method == IL_ROBUST) ready = il_robust_lanes_ready(state);
    if (a->method == IL_FEEDBACK) ready = feedback_ready(a, state);
    if (a->method == IL_LEAST_SQUARES) ready = squares_ready(a, state);
    if (!ready) {
        il_lanes_part(l);
        return 0;
    }
    l->together = 1;
    l->stay = 0;
    l->done = 0;
    if (a->method == IL_ROBUST) il_robust_lanes_enter(l, a, state);
    if (a->method == IL_FEEDBACK) feedback_enter(l, a, state);
    if (a->method == IL_LEAST_SQUARES) squares_enter(l, a, state);
    return 1;
}

int il_lanes_step(il_lanes *l, const il_array *a, const il_robust_terms *t, il_array_state *state, const il_real *z,
                  const il_real *reading, il_real *rate, int want_health, unsigned *met) {
    if (a->method == IL_ROBUST) {
        *met |= il_robust_lanes_step(l, a, t, state, z, reading, rate, want_health);
        return 1;
    }
    if (a->method == IL_FEEDBACK) {
        feedback_of_three(l, a, state, z, rate, want_health, met);
        return 1;
    }
    return plain_step(l, a, state, z, rate, want_health, met);
}

void il_lanes_end(il_lanes *l, const il_array *a, il_array_state *state) {
    if (!l->together) return;
    if (a->method == IL_ROBUST) il_robust_lanes_leave(l, a, state);
    if (a->method == IL_FEEDBACK) feedback_leave(l, a, state);
    if (a->method == IL_LEAST_SQUARES) squares_leave(l, a, state);
}
#endif
