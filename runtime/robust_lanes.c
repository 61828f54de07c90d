/* Gyro array, the robust method: three axes at once while all is well in them.
 *
 * What robust_well.c does for one axis, with the axes in the lanes of one vector: the same operations on the same numbers
 * in the same order (two sums each, of even and of odd gyros), hence the same results to the last bit. A sample costs not
 * much more than one axis alone, where an instruction takes four numbers. An axis in which something is wrong goes its own
 * way for this sample, by robust.c, and comes back if that is all; if not, all three go theirs for a while.
 */
#include "lanes.h"

#if IL_LANES
LANES_BEGIN

/* ---- from the state into lanes, and back ----------------------------------------------------------------------------- */

/* Counts of an axis; how many samples may pass without it. */
static void lanes_recount(il_lanes *l, const il_array *a, const il_array_axis *s, int32_t axis) {
    for (int32_t j = axis; j < (axis < 2 ? axis + 1 : LANES); j++) {
        for (int32_t i = 0; i < a->elements; i++) l->seen[i][j] = il_counted(s->seen[i], s->clean);
        l->resolution[j] = s->resolution;
    }
    if (l->most > MOST_CLEAN - s->clean) l->most = MOST_CLEAN - s->clean;
}

static void lanes_gather(il_lanes *l, const il_array *a, const il_array_axis *s, int32_t axis) {
    for (int32_t j = axis; j < (axis < 2 ? axis + 1 : LANES); j++) {
        for (int32_t i = 0; i < a->elements; i++) l->last[i][j] = s->last[i];
        for (int32_t i = 0; i < a->elements + a->elements % 2; i++) {
            l->bias[i][j] = s->bias[i];
            l->variance[i][j] = s->variance[i];
            l->fast[i][j] = s->fast[i];
            l->ratio[i][j] = s->ratio[i];
        }
    }
}

static void lanes_scatter(const il_lanes *l, const il_array *a, il_array_axis *s, int32_t axis) {
    for (int32_t i = 0; i < a->elements + a->elements % 2; i++) {
        s->bias[i] = l->bias[i][axis];
        s->variance[i] = l->variance[i][axis];
        s->fast[i] = l->fast[i][axis];
    }
}

/* The readings of the sample before. */
static void lanes_remember(const il_lanes *l, const il_array *a, il_array_axis *s, int32_t axis) {
    if (l->before != NULL) memcpy(s->last, l->before + axis * a->elements, (size_t)a->elements * sizeof(il_real));
}

/* Bring the counts of all axes up to date. */
static void lanes_count(il_lanes *l, il_array_state *state) {
    EACH_AXIS {
        il_array_axis *s = &state->axis[j];
        s->count = il_counted(s->count, l->done);
        s->clean += l->done;
        s->resolution = l->resolution[j];
    }
    l->done = 0;
}

int il_robust_lanes_ready(const il_array_state *state) {
    return state->axis[0].well && state->axis[1].well && state->axis[2].well;
}

void il_robust_lanes_enter(il_lanes *l, const il_array *a, const il_array_state *state) {
    l->settled = 0;
    l->most = MOST_CLEAN;
    l->before = NULL;
    EACH_AXIS {
        lanes_gather(l, a, &state->axis[j], j);
        lanes_recount(l, a, &state->axis[j], j);
    }
}

/* ---- one sample ------------------------------------------------------------------------------------------------------ */

/* Gains, and how far variances are drawn to the mean, of gyro i. Returns whether they will stay. */
LANES_INLINE int lanes_learnt(il_lanes *l, const il_array *a, int32_t i) {
    const il_counts seen = counted_lanes(l->seen[i], l->done), more = counted_lanes(seen, 1);
    const il_real prior = a->weight != NULL ? CALIBRATED : OWN;
    il_four count = capped_lanes(seen, a->cap);
    const il_four growing = IL_C(1.0) / capped_lanes(more, a->memory > IL_C(0.0) ? UINT32_MAX : a->cap);
    int stays = (seen[0] >= a->cap) & (seen[1] >= a->cap) & (seen[2] >= a->cap);
    if (a->memory > IL_C(0.0)) {
        EACH_LANE count[j] = count[j] * a->memory > IL_C(1.0) ? IL_C(1.0) / a->memory : count[j];
        stays &= all_axes(growing <= a->memory);
    }
    l->pull[i] = prior / (prior + count);
    l->gain[i] = larger_lanes(all_lanes(a->memory), growing);
    return stays;
}

static void lanes_experience(il_lanes *l, const il_array *a, const il_array_state *state) {
    const int32_t n = a->elements;
    const il_array_axis *s = state->axis;
    l->settled = lanes_learnt(l, a, 0);
    if (s[0].well == ALIKE && s[1].well == ALIKE && s[2].well == ALIKE) {
        for (int32_t i = 1; i < n + n % 2; i++) {
            l->pull[i] = l->pull[0];
            l->gain[i] = l->gain[0];
        }
        return;
    }
    for (int32_t i = 1; i < n; i++) l->settled &= lanes_learnt(l, a, i);
    l->pull[n] = all_lanes(IL_C(1.0)); /* of the last one's partner, where n is odd */
    EACH_LANE l->gain[n][j] = s[j < 2 ? j : 2].well == ALIKE ? l->gain[0][j] : IL_C(0.0);
}

/* A gyro's reading less its bias, and what is summed up of it. */
LANES_INLINE void lanes_take(il_lanes *l, int32_t i, il_four z, il_four reading, il_four *sum, il_four *variances) {
    const il_four r = z - l->bias[i];
    l->r[i] = r;
    *sum += r;
    *variances += l->variance[i];
    l->change = smaller_lanes(size_lanes(reading - l->last[i]), l->change);
    l->last[i] = reading;
}

LANES_INLINE void lanes_compensate(il_lanes *l, int32_t n, const il_real *z, const il_real *reading) {
    il_four sum[2] = {all_lanes(IL_C(0.0)), all_lanes(IL_C(0.0))}, variances[2] = {sum[0], sum[0]};
    int32_t i;
    l->change = all_lanes((il_real)INFINITY);
    for (i = 0; i + 1 < n; i += 2) {
        lanes_take(l, i, lanes_of(z + i, n), lanes_of(reading + i, n), &sum[0], &variances[0]);
        lanes_take(l, i + 1, lanes_of(z + i + 1, n), lanes_of(reading + i + 1, n), &sum[1], &variances[1]);
    }
    if (i < n) lanes_take(l, i, lanes_of(z + i, n), lanes_of(reading + i, n), &sum[0], &variances[0]);
    l->middle = sum[0] + sum[1];
    l->usual = variances[0] + variances[1];
}

typedef struct {
    il_four squares, total, rate;
} lanes_sums;

typedef struct {
    il_four top, outside, bent;
} lanes_margins;

/* A gyro's weight, and what is summed up of it. */
LANES_INLINE void lanes_weigh(il_lanes *l, int32_t i, il_real gate, il_four floor, lanes_sums *s, lanes_margins *m) {
    const il_four r = l->r[i], e = r - l->middle, square = e * e, variance = l->variance[i];
    const il_four v = larger_lanes(variance + l->pull[i] * (l->usual * l->ratio[i] - variance), floor);
    const il_four w = IL_C(1.0) / v;
    l->trust[i] = v;
    l->weight[i] = w;
    s->squares += square;
    s->total += w;
    s->rate += w * r;
    m->top = larger_lanes(w, m->top);
    m->outside = larger_lanes(square - gate * v, m->outside);
    m->bent = larger_lanes(IL_C(1.25) * square - MOST * MOST * larger_lanes(v, l->usual), m->bent);
}

LANES_INLINE void lanes_compare(il_lanes *l, int32_t n, il_real gate, il_four floor) {
    const il_four none = all_lanes(IL_C(0.0)), least = all_lanes(-(il_real)INFINITY);
    lanes_sums even = {none, none, none}, odd = even;
    lanes_margins m = {none, least, least};
    for (int32_t i = 0; i < n; i += 2) {
        lanes_weigh(l, i, gate, floor, &even, &m);
        lanes_weigh(l, i + 1, gate, floor, &odd, &m);
    }
    l->squares = even.squares + odd.squares;
    l->total = even.total + odd.total;
    l->rate = (even.rate + odd.rate) / l->total;
    l->top = m.top;
    l->outside = m.outside;
    l->bent = m.bent;
}

/* Hold the largest weight to the cap, in the lanes chosen. */
static void lanes_hold(il_lanes *l, const il_array *a, il_verdict chosen) {
    il_four others = all_lanes(IL_C(0.0)), rate = others, most = others;
    il_verdict before = {0}, held[IL_ARRAY_ROOM];
    for (int32_t i = 0; i < a->elements; i++) {
        const il_verdict is_top = (l->weight[i] >= l->top) & ~before; /* the first one, if there are several */
        before |= is_top;
        held[i] = is_top & chosen;
        others += chosen_lanes(~is_top, l->weight[i]);
        rate += chosen_lanes(~is_top, l->weight[i] * l->r[i]);
        most += chosen_lanes(is_top, l->r[i]);
    }
    const il_four weight = a->weight_cap / (IL_C(1.0) - a->weight_cap) * others, total = others + weight;
    for (int32_t i = 0; i < a->elements; i++) {
        l->weight[i] = chosen_lanes(held[i], weight) + chosen_lanes(~held[i], l->weight[i]);
    }
    l->rate = chosen_lanes(chosen, (rate + weight * most) / total) + chosen_lanes(~chosen, l->rate);
    l->total = chosen_lanes(chosen, total) + chosen_lanes(~chosen, l->total);
}

/* Where no residual is beyond full teaching. */
static il_verdict lanes_straight(const il_lanes *l, int32_t n) {
    il_verdict all = ~(il_verdict){0};
    for (int32_t i = 0; i < n; i++) {
        const il_four e = l->r[i] - l->rate;
        all &= e * e <= MOST * MOST * larger_lanes(l->trust[i], l->usual);
    }
    return all;
}

/* il_robust_all_well */
LANES_INLINE void lanes_fuse(il_lanes *l, const il_array *a, const il_robust_terms *t, const il_real *z,
                             const il_real *reading) {
    const int32_t n = a->elements;
    if (z == reading) {
        lanes_compensate(l, n, z, z); /* turned into lanes once */
    } else {
        lanes_compensate(l, n, z, reading);
    }
    l->middle *= t->share;
    l->usual *= t->share;
    l->r[n] = l->middle;
    lanes_compare(l, n, t->gate, larger_lanes(a->weight_floor * l->usual, all_lanes(IL_TINY)));
    const il_verdict held = l->top > a->weight_cap * l->total;
    if (held[0] | held[1] | held[2]) lanes_hold(l, a, held);
    const il_four apart = l->middle - l->rate, room = IL_C(2.0) * t->gate * l->usual - l->squares;
    il_verdict straight = l->bent + IL_C(5.0) * apart * apart <= IL_C(0.0);
    if (!all_axes(straight)) straight |= lanes_straight(l, n);
    l->well = (l->outside <= room * t->share) & straight & (l->usual > IL_C(0.0));
}

/* What a gyro teaches. */
LANES_INLINE void lanes_teach(il_lanes *l, int32_t i, const il_robust_terms *t, il_four level, il_four *sum, il_four *far) {
    const il_four r = l->r[i], e = r - l->middle, gain = l->gain[i];
    const il_four mean = t->keep * l->fast[i] + t->recent * (r - l->rate), square = mean * mean;
    l->bias[i] += gain * e;
    l->variance[i] = (IL_C(1.0) - gain) * (l->variance[i] + gain * (t->hat * (e * e) - level));
    l->fast[i] = mean;
    *sum += square;
    *far = larger_lanes(square - t->jump * l->trust[i], *far);
}

LANES_INLINE void lanes_learn(il_lanes *l, int32_t n, const il_robust_terms *t) {
    const il_four level = t->cross * l->squares;
    il_four even = all_lanes(IL_C(0.0)), odd = even, far = all_lanes(-(il_real)INFINITY);
    for (int32_t i = 0; i < n; i += 2) {
        lanes_teach(l, i, t, level, &even, &far);
        lanes_teach(l, i + 1, t, level, &odd, &far);
    }
    l->jumped = far + IL_C(2.0) * t->share * (even + odd);
}

/* ---- samples that are not plainly well ------------------------------------------------------------------------------- */

/* Each axis by itself. Returns those that were looked at closely, a bit each; their state is not in lanes any more. */
static unsigned lanes_doubt(il_lanes *l, const il_array *a, il_array_state *state, const il_real *z,
                            const il_real *reading) {
    const int32_t n = a->elements;
    unsigned closely = 0;
    lanes_count(l, state);
    EACH_AXIS {
        il_array_axis *s = &state->axis[j];
        il_count(&s->count);
        if (l->well[j] && l->change[j] > IL_C(0.0) && s->clean < MOST_CLEAN) {
            s->clean++;
            s->resolution = smaller(l->change[j], s->resolution);
            continue;
        }
        sample p;
        lanes_remember(l, a, s, j);
        int closer = il_robust_examine(a, s, z + j * n, reading + j * n, &p);
        if (closer || !l->well[j]) {
            lanes_scatter(l, a, s, j);
            s->rate = il_robust_look_closely(a, s, z + j * n, &p, closer);
            closely |= 1u << j;
        } else {
            for (int32_t i = 0; i < n; i++) il_count(&s->seen[i]);
        }
    }
    return closely;
}

/* Take the doubt away where the means of a second agree. */
static void lanes_agree(il_lanes *l, const il_array *a, const il_robust_terms *t) {
    EACH_AXIS {
        il_real fast[IL_ARRAY_ELEMENTS], trust[IL_ARRAY_ELEMENTS];
        if (l->jumped[j] <= IL_C(0.0)) continue;
        for (int32_t i = 0; i < a->elements; i++) {
            fast[i] = l->fast[i][j];
            trust[i] = l->trust[i][j];
        }
        if (il_robust_agree(a->elements, t, fast, trust)) l->jumped[j] = IL_C(0.0);
    }
}

/* Look for jumps of an axis whose means of a second leave doubt. */
static void lanes_suspect(il_lanes *l, const il_array *a, il_array_axis *s, int32_t j) {
    sample p;
    lanes_scatter(l, a, s, j);
    lanes_remember(l, a, s, j);
    for (int32_t i = 0; i < a->elements; i++) p.trust[i] = l->trust[i][j];
    p.middle = l->middle[j];
    p.mean_variance = l->usual[j];
    il_robust_suspect(a, s, &p);
}

/* After such a sample: take in again who is well, or go apart. */
static void lanes_mend(il_lanes *l, const il_array *a, il_array_state *state, unsigned closely) {
    unsigned out = closely; /* of the lanes: the state has them */
    EACH_AXIS {
        if ((closely >> j & 1u) || l->jumped[j] <= IL_C(0.0)) continue;
        lanes_suspect(l, a, &state->axis[j], j);
        out |= 1u << j;
    }
    if (il_robust_lanes_ready(state)) {
        l->settled = 0;
        l->most = MOST_CLEAN;
        EACH_AXIS {
            if (out >> j & 1u) lanes_gather(l, a, &state->axis[j], j);
            lanes_recount(l, a, &state->axis[j], j);
        }
        return;
    }
    EACH_AXIS {
        if (out >> j & 1u) continue;
        lanes_scatter(l, a, &state->axis[j], j);
        lanes_remember(l, a, &state->axis[j], j);
    }
    il_lanes_part(l);
}

/* Weights and flags of the axes where all is well. */
static void lanes_health(const il_lanes *l, const il_array *a, il_array_state *state, unsigned closely) {
    for (int32_t i = 0; i < a->elements; i++) {
        const il_four weight = l->weight[i] / l->total;
        EACH_AXIS if (!(closely >> j & 1u)) state->axis[j].weight[i] = weight[j];
    }
    EACH_AXIS if (!(closely >> j & 1u)) memset(state->axis[j].flags, 0, (size_t)a->elements);
}

/* Flags of the axes where it is not. */
static unsigned lanes_met(const il_array *a, const il_array_state *state, unsigned closely, int want_health) {
    unsigned met = 0;
    EACH_AXIS {
        const il_array_axis *s = &state->axis[j];
        if (!(closely >> j & 1u)) continue;
        if (!il_finite(s->rate)) met |= IL_NOT_FINITE;
        for (int32_t i = 0; want_health && i < a->elements; i++) met |= s->flags[i];
    }
    return met;
}

unsigned il_robust_lanes_step(il_lanes *l, const il_array *a, const il_robust_terms *t, il_array_state *state,
                              const il_real *z, const il_real *reading, il_real *rate, int want_health) {
    unsigned closely = 0;
    if (!l->settled) lanes_experience(l, a, state);
    lanes_fuse(l, a, t, z, reading);
    const int plain = all_axes(l->well & (l->change > IL_C(0.0))) && l->done < l->most;
    if (plain) {
        l->done++;
        l->resolution = smaller_lanes(l->change, l->resolution);
    } else {
        closely = lanes_doubt(l, a, state, z, reading);
    }
    lanes_learn(l, a->elements, t);
    l->before = reading;
    if (want_health) lanes_health(l, a, state, closely);
    EACH_AXIS {
        il_array_axis *s = &state->axis[j];
        if (!(closely >> j & 1u)) s->rate = l->rate[j];
        rate[j] = s->rate - s->common;
    }
    l->stay++;
    if (!all_axes(l->jumped <= IL_C(0.0))) lanes_agree(l, a, t);
    if (plain && all_axes(l->jumped <= IL_C(0.0))) return 0;
    if (plain) lanes_count(l, state);
    lanes_mend(l, a, state, closely);
    return lanes_met(a, state, closely, want_health);
}

void il_robust_lanes_leave(il_lanes *l, const il_array *a, il_array_state *state) {
    lanes_count(l, state);
    EACH_AXIS {
        lanes_scatter(l, a, &state->axis[j], j);
        lanes_remember(l, a, &state->axis[j], j);
    }
}

LANES_END
#endif
