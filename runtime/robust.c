/* Gyro array, the robust method: one sample of one axis.
 *
 * Residuals are taken against the mean of the same sample, so that motion, which all gyros share, cancels in them. Biases
 * follow them, b_i += g_i e_i with sum e_i = 0: the sum of the biases, which the array cannot see, stays while all have
 * learnt alike; otherwise sum b_i / g_i does, so that who has seen little moves to the others, and not they to it.
 * Variances come from the residuals by the N-cornered hat (Grubbs 1948): of e_i = r_i - mean(r),
 * E e_i^2 = (1 - 2/m) v_i + sum_j v_j / m^2, hence
 *   v_i = m/(m-2) [e_i^2 - sum_j e_j^2 / (m(m-1))],
 * averaged sample by sample, which stays right when the set of gyros changes. A gyro's reading counts in the output while it
 * is inside the gate about the median, and teaches while it is inside the narrower gate of its own noise; no more than
 * MOST sigma of it teach, or a gyro that leaves the others slowly would open its gate ahead of itself (Huber 1964).
 */
#include "robust.h"

/* Most of what this gyro taught was wrong: the others settle among themselves, and it starts anew. */
static void forget(const il_array *a, il_array_axis *s, int32_t i) {
    il_real sum = IL_C(0.0);
    int32_t others = 0;
    for (int32_t j = 0; j < a->elements; j++) {
        if (j == i || s->seen[j] == 0) continue;
        sum += s->bias[j];
        others++;
    }
    for (int32_t j = 0; j < a->elements; j++) {
        if (j != i && s->seen[j] != 0) s->bias[j] -= sum / (il_real)others;
    }
    s->bias[i] = s->variance[i] = s->late[i] = s->scale[i] = IL_C(0.0);
    s->seen[i] = 0;
}

static void jump(il_array_axis *s, int32_t i) {
    s->standing[i] |= OUT | FRESH | JUMPED;
    s->calm[i] = s->away[i] = 0;
    s->fast[i] = IL_C(0.0);
}

/* Halve how often readings were compared and had changed, so that the ratio goes on. */
static void halve(il_array_axis *s, int32_t i) {
    s->changed[i] >>= 1;
    s->compared[i] >>= 1;
}

/* Whether a reading repeats oftener than by chance, which is told by so many pairs that changed, and repeated before. */
static int is_held(uint32_t run, uint64_t changed, uint64_t repeated) {
    if (changed <= repeated) return 0; /* a coarse gyro at rest: it may be stuck, but that takes longer to tell */
    il_real usual = (il_real)(repeated + 1) / (il_real)(changed + repeated + 2), chance = IL_C(1.0);
    for (uint32_t k = 0; k < run && chance > CHANCE; k++) chance *= usual;
    return chance <= CHANCE;
}

/* Pairs of a gyro's readings that were equal, before the present run of them. */
static uint32_t repeated_before(const il_array_axis *s, int32_t i) {
    uint32_t equal = s->compared[i] - 1 - s->changed[i];
    return equal > s->repeats[i] ? equal - s->repeats[i] : 0;
}

/* Repeated and missing readings. Returns whether there is anything that needs a closer look. */
static int examine(const il_array *a, il_array_axis *s, const il_real *z, const il_real *reading, sample *p) {
    int closer = 0;
    for (int32_t i = 0; i < a->elements; i++) {
        int fine = il_finite(z[i]);
        p->usable[i] = (uint8_t)fine;
        p->held[i] = 0;
        s->flags[i] = fine ? 0 : (uint8_t)IL_NOT_FINITE;
        closer |= !fine;
        if (!fine) continue;
        il_real change = il_fabs(reading[i] - s->last[i]);
        int same = change == IL_C(0.0) && s->compared[i] > 0;
        s->repeats[i] = same ? s->repeats[i] + (s->repeats[i] < UINT32_MAX) : 0;
        if (s->compared[i] == UINT32_MAX) halve(s, i);
        if (s->compared[i] > 0 && !same) {
            s->changed[i]++;
            if (change < s->resolution || s->resolution == IL_C(0.0)) s->resolution = change;
        }
        s->compared[i]++; /* pairs seen, plus one: 0 means that there is no reading to compare with */
        s->last[i] = reading[i];
        p->held[i] = (uint8_t)(same && is_held(s->repeats[i], s->changed[i], repeated_before(s, i)));
        closer |= p->held[i] | (same && s->changed[i] == 0) | (s->repeats[i] >= a->stuck) | (s->standing[i] & STUCK);
    }
    return closer;
}

static il_real share_changed(const il_array_axis *s, int32_t i) {
    uint32_t pairs = s->compared[i] > 1 ? s->compared[i] - 1 : 1;
    return (il_real)s->changed[i] / (il_real)pairs;
}

/* A gyro is stuck when its readings repeat longer than they usually do while somebody else is alive. Before that it is
 * held: what it tells is not the rate. */
static void find_stuck(const il_array *a, il_array_axis *s, sample *p) {
    il_real shares[IL_ARRAY_ELEMENTS], usual = IL_C(0.0);
    uint64_t repeated = 0, changed = 0;
    int32_t alive = 0, free = 0;
    for (int32_t i = 0; i < a->elements; i++) {
        if (!p->usable[i] || s->changed[i] == 0) continue;
        repeated += repeated_before(s, i);
        changed += s->changed[i];
    }
    for (int32_t i = 0; i < a->elements; i++) { /* one that has never changed is judged by the others */
        if (p->usable[i] && s->changed[i] == 0) p->held[i] = (uint8_t)is_held(s->repeats[i], changed, repeated);
        free += p->usable[i] && !p->held[i];
        if (p->usable[i] && s->repeats[i] < a->stuck) shares[alive++] = share_changed(s, i);
    }
    if (alive > 0) usual = median(shares, alive);
    for (int32_t i = 0; i < a->elements; i++) {
        if (!p->usable[i]) continue;
        il_real share = s->changed[i] ? share_changed(s, i) : usual;
        int stuck = alive > 0 && s->repeats[i] >= a->stuck && (il_real)s->repeats[i] * share >= (il_real)ENOUGH;
        int held = p->held[i] && free > 0;
        if (stuck || held) {
            s->flags[i] |= stuck ? IL_STUCK : IL_BEYOND;
            p->usable[i] = 0;
            s->compared[i] -= s->compared[i] > 1; /* such pairs are not what is usual */
            int taught = s->seen[i] > 0 && (uint64_t)s->repeats[i] * 2 >= s->seen[i];
            if (!(s->standing[i] & STUCK) && taught) forget(a, s, i);
        }
        s->standing[i] = (uint8_t)((s->standing[i] & ~STUCK) | (stuck ? STUCK : 0));
    }
}

/* Who is trusted in this sample: usable, and not waiting. Newcomers wait. */
static int32_t roll_call(const il_array *a, il_array_axis *s, sample *p) {
    int32_t core = 0, usable = 0;
    for (int32_t i = 0; i < a->elements; i++) {
        if (p->usable[i] && s->seen[i] == 0 && p->learnt > 2 && !(s->standing[i] & FRESH)) {
            s->standing[i] |= OUT | FRESH;
            s->calm[i] = 0;
        }
        p->core[i] = p->usable[i] && !(s->standing[i] & OUT);
        core += p->core[i];
        usable += p->usable[i];
    }
    p->waived = core == 0;
    if (!p->waived) return core;
    for (int32_t i = 0; i < a->elements; i++) p->core[i] = p->usable[i];
    return usable;
}

static il_real mean_variance(const il_array *a, const il_array_axis *s) {
    il_real sum = IL_C(0.0);
    int32_t known = 0;
    for (int32_t i = 0; i < a->elements; i++) {
        if (s->seen[i] < 2) continue;
        sum += s->variance[i];
        known++;
    }
    return known > 0 ? larger(sum / (il_real)known, IL_C(0.0)) : IL_C(0.0);
}

/* Variances as far as they can be trusted. */
static void trust(const il_array *a, const il_array_axis *s, sample *p) {
    il_real least = larger(a->weight_floor * p->mean_variance, IL_TINY);
    for (int32_t i = 0; i < a->elements; i++) {
        il_real pull = pull_of(a, s->seen[i]);
        p->trust[i] = larger(drawn(s->variance[i], pull, p->mean_variance * s->ratio[i]), least);
    }
}

/* Take off what moves with this rate. Returns whether there is anything. */
static int explain(const il_array *a, const il_array_axis *s, il_real rate, sample *p) {
    const int moves = il_robust_move(a, s, rate, p);
    if (!moves) memcpy(p->r_still, p->r, sizeof p->r);
    return moves;
}

/* Both gates about the median: inside[] counts in the output, learns[] teaches as well. */
static void gates(const il_array *a, il_array_axis *s, const il_real *z, sample *p, int32_t core) {
    il_real spread = IL_C(0.0);
    p->middle = il_nan();
    if (core > 0) p->middle = median_of(a->elements, p->core, p->r, &spread);
    il_real total = IL_C(0.0);
    for (int32_t i = 0; i < a->elements; i++) total += p->core[i] ? IL_C(1.0) / p->trust[i] : IL_C(0.0);
    p->noise = (il_real)core / total;
    const int moves = explain(a, s, p->middle, p);
    for (int32_t i = 0; i < a->elements; i++) {
        /* of two that are trusted none can judge the other, but both can judge who wants to come back */
        int judged = core > 2 || (core == 2 && !p->core[i]);
        p->inside[i] = p->learns[i] = (uint8_t)(p->usable[i] && !judged);
        p->half[i] = p->raw[i] = IL_C(0.0);
        if (!p->usable[i] || !judged) continue;
        il_real narrow = (core > 3 ? IL_C(30.0) : IL_C(100.0)) * spread; /* three gyros tell little about their noise */
        if (p->learnt >= 2) {
            uint32_t known = s->seen[i] > s->calm[i] ? s->seen[i] : s->calm[i];
            il_real young = IL_C(1.0) + OWN / (il_real)(known > 0 ? known : 1);
            il_real noise = p->trust[i] + IL_C(2.0) * p->mean_variance / (il_real)core;
            narrow = a->gate * young * il_sqrt(noise);
        }
        /* a coarse gyro, whose variance may still be zero, must be able to toggle; and rounding is no fault */
        narrow = larger(narrow, IL_C(1.5) * s->resolution);
        narrow = larger(narrow, ROUNDING * larger(il_fabs(z[i]), il_fabs(p->middle)));
        p->half[i] = larger(narrow, a->spread_gate * spread);
        p->raw[i] = il_fabs(p->r[i] - p->middle);
        il_real distance = moves ? smaller(p->raw[i], il_fabs(p->r_still[i] - p->middle)) : p->raw[i];
        p->learns[i] = distance <= narrow;
        /* a bias that is learnt anew has half of the watch to settle */
        p->inside[i] = distance <= p->half[i] || ((s->standing[i] & FRESH) && s->calm[i] < a->quiet / 2);
    }
}

/* A gyro that left the gate and stays off by the same amount has jumped, also if its noise takes it in at times. */
static void follow(const il_array *a, il_array_axis *s, const sample *p, int32_t i) {
    il_real distance = p->r_still[i] - p->middle;
    if (++s->away[i] == 1) {
        s->away_mean[i] = distance;
        s->away_square[i] = IL_C(0.0);
    } else {
        il_real step = distance - s->away_mean[i];
        s->away_mean[i] += step / (il_real)s->away[i];
        s->away_square[i] += step * (distance - s->away_mean[i]);
    }
    if (s->away[i] < a->jump) return;
    il_real scatter = il_sqrt(s->away_square[i] / (il_real)(s->away[i] - 1));
    il_real least = larger(il_sqrt(p->trust[i]), a->scale_tolerance * il_fabs(p->middle));
    if (scatter <= p->half[i] / IL_C(2.0) && il_fabs(s->away_mean[i]) > least) {
        if (s->away[i] >= s->seen[i]) forget(a, s, i);
        jump(s, i);
    }
    s->away[i] = 0;
}

/* What the sample does to the standing of each gyro. */
static void judge(const il_array *a, il_array_axis *s, const sample *p) {
    uint32_t patience = a->quiet / 5 > 0 ? a->quiet / 5 : 1;
    for (int32_t i = 0; i < a->elements; i++) {
        if (!p->usable[i] || !p->inside[i]) {
            il_count(&s->bad[i]);
            s->calm[i] = 0;
            if (s->bad[i] >= patience || (s->standing[i] & STUCK)) s->standing[i] |= OUT;
            if (p->usable[i]) {
                s->flags[i] |= IL_GATED;
                follow(a, s, p, i);
                continue;
            }
            s->away[i] = 0;
            s->fast[i] = IL_C(0.0);
            if (s->standing[i] & STUCK) s->standing[i] &= (uint8_t)~JUMPED;
            continue;
        }
        s->bad[i] = 0;
        if ((s->standing[i] & (OUT | FRESH)) == OUT && p->half[i] > IL_C(0.0)) {
            follow(a, s, p, i);
        } else {
            s->away[i] = 0;
        }
        if (!(s->standing[i] & OUT) || ++s->calm[i] <= a->quiet) continue;
        if (s->standing[i] & FRESH) {
            if (s->seen[i] == 0) s->variance[i] = p->mean_variance;
            if (s->seen[i] < a->quiet) s->seen[i] = a->quiet;
        }
        s->standing[i] &= (uint8_t) ~(OUT | FRESH | JUMPED);
        memset(s->fast, 0, sizeof s->fast); /* those of the others hold what it did when it left */
    }
}

/* Inverse-variance weights of the gyros used, none above the cap; two count alike, one passes through. */
static void weigh(const il_array *a, il_array_axis *s, const sample *p, int32_t used) {
    il_real total = IL_C(0.0), most = IL_C(0.0);
    int32_t top = 0;
    for (int32_t i = 0; i < a->elements; i++) {
        s->weight[i] = !p->used[i] ? IL_C(0.0) : used < 3 ? IL_C(1.0) : IL_C(1.0) / p->trust[i];
        total += s->weight[i];
        if (s->weight[i] > most) {
            most = s->weight[i];
            top = i;
        }
    }
    il_real scale = IL_C(1.0) / total, cap = used < 3 ? IL_C(1.0) : most_weight(a, s->seen[top]);
    for (int32_t i = 0; i < a->elements; i++) s->weight[i] *= scale;
    if (s->weight[top] <= cap) return;
    /* The others' sum, not what the top one leaves of 1: that may be nothing but rounding. */
    il_real rest = IL_C(0.0);
    for (int32_t i = 0; i < a->elements; i++) rest += i == top ? IL_C(0.0) : s->weight[i];
    if (!(rest > IL_C(0.0))) return;
    for (int32_t i = 0; i < a->elements; i++) s->weight[i] = i == top ? cap : s->weight[i] / rest * (IL_C(1.0) - cap);
}

/* A jump too small for the gate shows in the mean of a second, where the others' means agree. Not while the array as a
 * whole is finding its biases; but a gyro that came back is watched at once. */
void il_robust_find_small_jumps(const il_array *a, il_array_axis *s, sample *p) {
    il_real share = IL_C(1.0) / (IL_C(2.0) * (il_real)a->quiet), largest = IL_C(0.0), smallest = IL_C(-1.0), scatter;
    il_real least = larger(IL_C(64.0) * share, IL_C(1.0)); /* variances: (8 sqrt(f / 2))^2 */
    for (int32_t i = 0; i < a->elements; i++) {
        if (!p->learns[i]) continue;
        largest = larger(largest, s->fast[i] * s->fast[i]);
        if (smallest < IL_C(0.0) || p->trust[i] < smallest) smallest = p->trust[i];
    }
    /* No two means are further apart than twice the largest; half, because one sample moves a variance a little. */
    if (IL_C(4.0) * largest <= IL_C(0.5) * least * smallest) return;
    il_real usual = median_of(a->elements, p->learns, s->fast, &scatter);
    trust(a, s, p); /* the sample has changed the variances */
    uint64_t young = (uint64_t)a->quiet * (p->learnt < (uint64_t)FORMING * a->quiet ? FORMING : 1);
    for (int32_t i = 0; i < a->elements; i++) {
        if (!p->learns[i] || s->seen[i] < young) continue;
        il_real limit = larger(il_sqrt(least * p->trust[i]), IL_C(8.0) * scatter);
        limit = larger(limit, a->scale_tolerance * il_fabs(p->middle));
        if (il_fabs(s->fast[i] - usual) > limit) jump(s, i);
    }
}

/* Residuals against the mean of those who learn, of readings held to what may teach about the fused rate. */
static void residuals(const il_array *a, const il_array_axis *s, const sample *p, const il_real *r, il_real m,
                      il_real rate, il_real *e) {
    il_real mean = IL_C(0.0), most = MOST * MOST * p->mean_variance;
    for (int32_t i = 0; i < a->elements; i++) {
        e[i] = p->learns[i] ? r[i] - rate : IL_C(0.0);
        if (e[i] * e[i] > most && e[i] * e[i] > MOST * MOST * p->trust[i] && s->seen[i] >= SETTLING) {
            il_real bound = MOST * il_sqrt(larger(p->trust[i], p->mean_variance));
            e[i] = e[i] > IL_C(0.0) ? bound : -bound;
        }
        mean += e[i];
    }
    mean /= m;
    for (int32_t i = 0; i < a->elements; i++) e[i] -= p->learns[i] ? mean : IL_C(0.0);
}

/* Biases, variances and means of a second take in the sample; learns[] says whose. */
static void learn(const il_array *a, il_array_axis *s, sample *p, int32_t pupils, il_real rate) {
    il_real m = (il_real)pupils, squares = IL_C(0.0), gain = IL_C(0.0), recent = IL_C(1.0) / (il_real)a->quiet;
    il_real e[IL_ARRAY_ELEMENTS], f[IL_ARRAY_ELEMENTS];
    residuals(a, s, p, p->r, m, rate, e);
    const int moves = explain(a, s, rate, p);
    if (moves) {
        residuals(a, s, p, p->r_still, m, rate, f);
    } else {
        memcpy(f, e, sizeof e);
    }
    const il_real before = sum_of(a->elements, s->bias);
    uint32_t known = 0; /* nearly always all gyros have seen the same: one division serves */
    for (int32_t i = 0; i < a->elements; i++) {
        p->gain[i] = IL_C(0.0);
        if (!p->learns[i]) continue;
        il_count(&s->seen[i]);
        if (s->seen[i] != known) {
            known = s->seen[i];
            gain = learning_gain(a, known);
        }
        p->gain[i] = gain;
        squares += e[i] * e[i];
        /* a start other than 1 is experience in the bias, from the second residual on */
        il_real bias_gain = gain;
        if (a->start > 1 && a->memory == IL_C(0.0) && !(known == 1 && a->initial == IL_FIRST)) {
            bias_gain = learning_gain(a, il_counted(known, a->start - 1));
        }
        s->bias[i] += bias_gain * f[i];
    }
    if (moves) il_robust_learn_motion(a, s, p, f);
    if (forming(a, p->learnt)) {
        const il_real drift = (sum_of(a->elements, s->bias) - before) / m;
        for (int32_t i = 0; i < a->elements; i++) s->bias[i] -= p->learns[i] ? drift : IL_C(0.0);
    }
    if (pupils < 3) return;
    squares /= m * (m - IL_C(1.0));
    il_real hat = m / (m - IL_C(2.0));
    for (int32_t i = 0; i < a->elements; i++) {
        if (!p->learns[i]) continue;
        il_real grubbs = hat * (e[i] * e[i] - squares);
        s->variance[i] = (IL_C(1.0) - p->gain[i]) * (s->variance[i] + p->gain[i] * grubbs);
        s->fast[i] = (IL_C(1.0) - recent) * s->fast[i] + recent * (p->r_still[i] - rate); /* as it came */
    }
    il_robust_find_small_jumps(a, s, p);
}

/* The long way: who is trusted, who is inside, who is used, who teaches. Returns the number used. */
static int32_t choose(const il_array *a, il_array_axis *s, const il_real *z, sample *p) {
    int32_t used = 0, nearest = -1;
    gates(a, s, z, p, roll_call(a, s, p));
    judge(a, s, p);
    trust(a, s, p);
    for (int32_t i = 0; i < a->elements; i++) {
        int here = p->waived ? p->core[i] : p->usable[i] && !(s->standing[i] & OUT);
        p->used[i] = (uint8_t)(here && p->inside[i] && (p->raw[i] <= p->half[i] || (s->standing[i] & FRESH)));
        p->excused[i] = here && p->inside[i] && !p->used[i];
        if (p->excused[i]) s->flags[i] |= IL_GATED;
        used += p->used[i];
        if (!p->core[i]) continue;
        if (nearest < 0 || il_fabs(p->r[i] - p->middle) < il_fabs(p->r[nearest] - p->middle)) nearest = i;
    }
    if (used == 0 && nearest >= 0) { /* rather the most central one than none */
        p->used[nearest] = 1;
        used = 1;
    }
    for (int32_t i = 0; i < a->elements; i++) p->learns[i] = p->learns[i] && (p->used[i] || p->excused[i]);
    return used;
}

static void report(const il_array *a, il_array_axis *s, const sample *p, int32_t used) {
    for (int32_t i = 0; i < a->elements; i++) {
        unsigned told = p->used[i] ? 0u : (unsigned)IL_EXCLUDED;
        if (p->usable[i] && (s->standing[i] & OUT)) told |= IL_QUIET;
        if (s->standing[i] & JUMPED) told |= IL_JUMPED;
        if (used < 3) told |= IL_ALONE;
        s->flags[i] = (uint8_t)(s->flags[i] | told);
    }
}

/* A gyro that waits after a jump or a stuck spell learns its bias anew, against the output. */
static void teach_fresh(const il_array *a, il_array_axis *s, const sample *p, il_real rate) {
    for (int32_t i = 0; i < a->elements; i++) {
        int fresh = p->usable[i] && (s->standing[i] & OUT) && (s->standing[i] & FRESH);
        if (fresh && !p->used[i] && s->calm[i] > 0) s->bias[i] += (p->r_still[i] - rate) / (il_real)s->calm[i];
    }
}

/* The long way, for samples in which something is wrong or new. */
static il_real look_closely(const il_array *a, const il_robust_terms *t, il_array_axis *s, const il_real *z, sample *p,
                            int closer) {
    il_real rate = IL_C(0.0);
    int32_t pupils = 0;
    if (closer) find_stuck(a, s, p);
    p->learnt = most_seen(a, s);
    p->mean_variance = mean_variance(a, s);
    trust(a, s, p);
    for (int32_t i = 0; i < a->elements; i++) p->r[i] = z[i] - s->bias[i];
    int32_t used = choose(a, s, z, p);
    report(a, s, p, used);
    if (used == 0) {
        for (int32_t i = 0; i < a->elements; i++) s->weight[i] = IL_C(0.0);
        return il_nan();
    }
    weigh(a, s, p, used);
    for (int32_t i = 0; i < a->elements; i++) {
        rate += p->used[i] ? s->weight[i] * p->r[i] : IL_C(0.0);
        pupils += p->learns[i];
    }
    if (used < a->elements) teach_fresh(a, s, p, rate);
    if (pupils >= 2) learn(a, s, p, pupils, rate);
    il_robust_pass(t, s, rate);
    return rate;
}

/* Whether all gyros are in use and none is under suspicion: then the next sample may go the short way. */
void il_robust_muster(const il_array *a, il_array_axis *s) {
    uint32_t trouble = s->resolution == IL_C(0.0), differ = 0, full = a->memory > IL_C(0.0) ? UINT32_MAX : a->cap;
    /* a start other than 1 has gains of its own until the memory is full */
    uint32_t least = a->start > 1 && full == a->cap ? full : 2;
    for (int32_t i = 0; i < a->elements; i++) {
        trouble |= s->standing[i] | s->bad[i] | s->away[i] | (uint32_t)(s->seen[i] < least);
        differ |= (s->seen[i] < full ? s->seen[i] : full) ^ (s->seen[0] < full ? s->seen[0] : full);
    }
    s->well = trouble ? 0 : differ ? UNEQUAL : ALIKE;
}

/* Count the samples since the last time in which all was well. */
void il_robust_settle(const il_array *a, il_array_axis *s) {
    if (s->clean == 0) return;
    for (int32_t i = 0; i < a->elements; i++) {
        if (s->compared[i] > UINT32_MAX - s->clean) halve(s, i);
        s->compared[i] += s->clean;
        s->changed[i] += s->clean;
        s->seen[i] = il_counted(s->seen[i], s->clean);
        s->repeats[i] = 0;
    }
    s->clean = 0;
}

il_real il_robust_step(const il_array *a, const il_robust_terms *t, il_array_axis *s, const il_real *z,
                       const il_real *reading, int want_health) {
    sample p;
    int well = s->well && il_robust_all_well(a, t, s, z, reading, &p);
    if (well && p.change > IL_C(0.0) && s->clean < MOST_CLEAN) {
        s->clean++;
        s->resolution = smaller(p.change, s->resolution);
        memcpy(s->last, reading, (size_t)a->elements * sizeof(il_real));
    } else {
        il_robust_settle(a, s);
        int closer = examine(a, s, z, reading, &p);
        if (closer || !well) {
            const il_real rate = look_closely(a, t, s, z, &p, closer);
            il_robust_muster(a, s);
            return rate;
        }
        for (int32_t i = 0; i < a->elements; i++) il_count(&s->seen[i]);
    }
    if (want_health) {
        for (int32_t i = 0; i < a->elements; i++) s->weight[i] /= p.total;
        memset(s->flags, 0, (size_t)a->elements);
    }
    il_robust_learn(a, t, s, &p);
    il_robust_pass(t, s, p.rate);
    return p.rate;
}
