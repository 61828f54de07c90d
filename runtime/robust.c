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

#define DEVIATION IL_C(1.4826)    /* median absolute deviation to standard deviation */
enum { MOST_CLEAN = 1 << 16 };    /* samples between two counts of each gyro */

/* Median of the chosen values, and their typical distance from it as a standard deviation. */
static il_real median_of(int32_t n, const uint8_t *chosen, const il_real *values, il_real *typical) {
    il_real sorted[IL_ARRAY_ELEMENTS] = {IL_C(0.0)};
    int32_t count = 0;
    for (int32_t i = 0; i < n; i++) {
        if (chosen[i]) sorted[count++] = values[i];
    }
    const il_real middle = il_median(sorted, count);
    for (int32_t i = 0; i < count; i++) sorted[i] = il_fabs(sorted[i] - middle);
    *typical = DEVIATION * il_median(sorted, count);
    return middle;
}

static il_real mean_variance(const il_array *a, const il_array_axis *s) {
    il_real sum = IL_C(0.0);
    int32_t known = 0;
    for (int32_t i = 0; i < a->elements; i++) {
        if (s->seen[i] < 2) continue;
        sum += s->variance[i];
        known++;
    }
    return known > 0 ? il_larger(sum / (il_real)known, IL_C(0.0)) : IL_C(0.0);
}

/* Variances as far as they can be trusted. */
static void trust(const il_array *a, const il_array_axis *s, il_sample *p) {
    il_real least = il_larger(a->weight_floor * p->mean_variance, IL_TINY);
    for (int32_t i = 0; i < a->elements; i++) {
        p->trust[i] = il_larger(il_shrunk(s->variance[i], il_pull(a, s->seen[i]), p->mean_variance * s->ratio[i]), least);
    }
}

/* Take off what moves with this rate. Returns whether there is anything. */
static int explain(const il_array *a, const il_array_axis *s, il_real rate, il_sample *p) {
    const int moves = il_robust_move(a, s, rate, p);
    if (!moves) memcpy(p->r_still, p->r, sizeof p->r);
    return moves;
}

/* Both gates about the median: inside[] counts in the output, learns[] teaches as well. */
static void gates(const il_array *a, il_array_axis *s, const il_real *z, il_sample *p, int32_t core) {
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
            il_real young = IL_C(1.0) + IL_OWN / (il_real)(known > 0 ? known : 1);
            il_real noise = p->trust[i] + IL_C(2.0) * p->mean_variance / (il_real)core;
            narrow = a->gate * young * il_sqrt(noise);
        }
        /* a coarse gyro, whose variance may still be zero, must be able to toggle; and rounding is no fault */
        narrow = il_larger(narrow, IL_C(1.5) * s->resolution);
        narrow = il_larger(narrow, IL_ROUNDING * il_larger(il_fabs(z[i]), il_fabs(p->middle)));
        p->half[i] = il_larger(narrow, a->spread_gate * spread);
        p->raw[i] = il_fabs(p->r[i] - p->middle);
        il_real distance = moves ? il_smaller(p->raw[i], il_fabs(p->r_still[i] - p->middle)) : p->raw[i];
        p->learns[i] = distance <= narrow;
        /* a bias that is learnt anew has half of the watch to settle */
        p->inside[i] = distance <= p->half[i] || ((s->standing[i] & IL_STANDS_FRESH) && s->calm[i] < a->quiet / 2);
    }
}

/* Inverse-variance weights of the gyros used, none above the cap; two count alike, one passes through. */
static void weigh(const il_array *a, il_array_axis *s, const il_sample *p, int32_t used) {
    int32_t top = 0;
    for (int32_t i = 0; i < a->elements; i++) {
        s->weight[i] = !p->used[i] ? IL_C(0.0) : used < 3 ? IL_C(1.0) : IL_C(1.0) / p->trust[i];
        if (s->weight[i] > s->weight[top]) top = i;
    }
    il_real scale = IL_C(1.0) / il_sum(a->elements, s->weight), cap = used < 3 ? IL_C(1.0) : il_most_weight(a, s->seen[top]);
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
static void find_small_jumps(const il_array *a, const il_robust_terms *t, il_array_axis *s, il_sample *p) {
    il_real scatter;
    const il_real usual = median_of(a->elements, p->learns, s->fast, &scatter);
    trust(a, s, p); /* the sample has changed the variances */
    uint64_t young = (uint64_t)a->quiet * (il_forming(a, p->learnt) ? IL_FORMING : 1);
    /* of the median that all are held against: a quiet gyro among noisy ones is no surer than they are */
    const il_real middle = IL_C(2.0) * t->share * p->mean_variance;
    for (int32_t i = 0; i < a->elements; i++) {
        if (!p->learns[i] || s->seen[i] < young) continue;
        /* variances: (8 sqrt(f / 2))^2 */
        il_real limit = il_larger(il_sqrt(IL_C(4.0) * t->jump * il_larger(p->trust[i], middle)), IL_C(8.0) * scatter);
        limit = il_larger(limit, a->scale_tolerance * il_fabs(p->middle));
        if (il_fabs(s->fast[i] - usual) > limit) il_robust_jump(s, i);
    }
}

/* Residuals against the mean of those who learn, of readings held to what may teach about the fused rate. */
static void residuals(const il_array *a, const il_array_axis *s, const il_sample *p, const il_real *r, il_real m,
                      il_real rate, il_real *e) {
    il_real mean = IL_C(0.0), most = IL_MOST * IL_MOST * p->mean_variance;
    for (int32_t i = 0; i < a->elements; i++) {
        e[i] = p->learns[i] ? r[i] - rate : IL_C(0.0);
        if (e[i] * e[i] > most && e[i] * e[i] > IL_MOST * IL_MOST * p->trust[i] && s->seen[i] >= IL_SETTLING) {
            il_real bound = IL_MOST * il_sqrt(il_larger(p->trust[i], p->mean_variance));
            e[i] = e[i] > IL_C(0.0) ? bound : -bound;
        }
        mean += e[i];
    }
    mean /= m;
    for (int32_t i = 0; i < a->elements; i++) e[i] -= p->learns[i] ? mean : IL_C(0.0);
}

/* Whether somebody has never taught. */
static int has_newcomer(const il_array *a, const il_array_axis *s) {
    int any = 0;
    for (int32_t i = 0; i < a->elements; i++) any |= s->seen[i] == 0;
    return any;
}

/* Two residuals, e and -e, tell the mean of two variances, 2 e^2: without it a third gyro would find a gate of no width. */
static void learn_as_pair(const il_array *a, il_array_axis *s, const il_sample *p, const il_real *e) {
    for (int32_t i = 0; i < a->elements; i++) {
        if (!p->learns[i]) continue;
        s->variance[i] = (IL_C(1.0) - p->gain[i]) * (s->variance[i] + p->gain[i] * IL_C(2.0) * e[i] * e[i]);
    }
}

/* Biases, variances and means of a second take in the sample; learns[] says whose. */
static void learn(const il_array *a, const il_robust_terms *t, il_array_axis *s, il_sample *p, int32_t learners) {
    il_real m = (il_real)learners, squares = IL_C(0.0), gain = IL_C(0.0);
    il_real e[IL_ARRAY_ELEMENTS], f[IL_ARRAY_ELEMENTS];
    residuals(a, s, p, p->r, m, p->rate, e);
    const int moves = explain(a, s, p->rate, p);
    residuals(a, s, p, p->r_still, m, p->rate, f);
    const il_real before = il_sum(a->elements, s->bias);
    uint32_t known = 0; /* nearly always all gyros have seen the same: one division serves */
    for (int32_t i = 0; i < a->elements; i++) {
        p->gain[i] = IL_C(0.0);
        if (!p->learns[i]) continue;
        il_count(&s->seen[i]);
        if (s->seen[i] != known) {
            known = s->seen[i];
            gain = il_learning_gain(a, known);
        }
        p->gain[i] = gain;
        squares += e[i] * e[i];
        /* a start other than 1 is experience in the bias, from the second residual on */
        il_real bias_gain = gain;
        if (a->start > 1 && a->memory == IL_C(0.0) && !(known == 1 && a->initial == IL_FIRST)) {
            bias_gain = il_learning_gain(a, il_counted(known, a->start - 1));
        }
        s->bias[i] += bias_gain * f[i];
    }
    if (moves) il_robust_learn_motion(a, s, p, f);
    if (il_forming(a, p->learnt)) {
        const il_real drift = (il_sum(a->elements, s->bias) - before) / m;
        for (int32_t i = 0; i < a->elements; i++) s->bias[i] -= p->learns[i] ? drift : IL_C(0.0);
    }
    if (learners < 3) {
        if (has_newcomer(a, s)) learn_as_pair(a, s, p, e);
        return;
    }
    squares /= m * (m - IL_C(1.0));
    il_real hat = m / (m - IL_C(2.0));
    for (int32_t i = 0; i < a->elements; i++) {
        if (!p->learns[i]) continue;
        il_real grubbs = hat * (e[i] * e[i] - squares);
        s->variance[i] = (IL_C(1.0) - p->gain[i]) * (s->variance[i] + p->gain[i] * grubbs);
        s->fast[i] = t->keep * s->fast[i] + t->recent * (p->r_still[i] - p->rate); /* as it came */
    }
    find_small_jumps(a, t, s, p);
}

/* Who is trusted, who is inside, who is used, who teaches. Returns the number used. */
static int32_t choose(const il_array *a, il_array_axis *s, const il_real *z, il_sample *p) {
    int32_t used = 0, nearest = -1;
    gates(a, s, z, p, il_robust_choose_trusted(a, s, p));
    il_robust_judge(a, s, p);
    trust(a, s, p);
    for (int32_t i = 0; i < a->elements; i++) {
        int here = p->waived ? p->core[i] : p->usable[i] && !(s->standing[i] & IL_STANDS_OUT);
        p->used[i] = (uint8_t)(here && p->inside[i] && (p->raw[i] <= p->half[i] || (s->standing[i] & IL_STANDS_FRESH)));
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

/* A gyro that waits after a jump or a stuck spell learns its bias anew, against the output. */
static void teach_fresh(const il_array *a, il_array_axis *s, const il_sample *p) {
    for (int32_t i = 0; i < a->elements; i++) {
        int fresh = p->usable[i] && (s->standing[i] & IL_STANDS_OUT) && (s->standing[i] & IL_STANDS_FRESH);
        if (fresh && !p->used[i] && s->calm[i] > 0) s->bias[i] += (p->r_still[i] - p->rate) / (il_real)s->calm[i];
    }
}

/* The long way, for samples in which something is wrong or new. */
static il_real look_closely(const il_array *a, const il_robust_terms *t, il_array_axis *s, const il_real *z, il_sample *p) {
    int32_t learners = 0;
    p->learnt = il_most_seen(a, s);
    p->mean_variance = mean_variance(a, s);
    trust(a, s, p);
    for (int32_t i = 0; i < a->elements; i++) p->r[i] = z[i] - s->bias[i];
    int32_t used = choose(a, s, z, p);
    il_robust_report(a, s, p, used);
    if (used == 0) {
        memset(s->weight, 0, sizeof s->weight);
        return il_nan();
    }
    weigh(a, s, p, used);
    p->rate = IL_C(0.0);
    for (int32_t i = 0; i < a->elements; i++) {
        p->rate += p->used[i] ? s->weight[i] * p->r[i] : IL_C(0.0);
        learners += p->learns[i];
    }
    if (used < a->elements) teach_fresh(a, s, p);
    if (learners >= 2) learn(a, t, s, p, learners);
    il_robust_pass(t, s, p->rate);
    return p->rate;
}

il_robust_terms il_robust_prepare(const il_array *a) {
    il_real n = (il_real)a->elements;
    il_robust_terms t;
    t.share = IL_C(1.0) / n;
    t.hat = n / (n - IL_C(2.0));
    t.cross = IL_C(1.0) / ((n - IL_C(1.0)) * (n - IL_C(2.0)));
    t.recent = IL_C(1.0) / (il_real)a->quiet;
    t.quick = il_smaller(IL_C(100.0) * t.recent, IL_C(1.0));
    t.keep = IL_C(1.0) - t.recent;
    t.gate = a->gate * a->gate * IL_C(0.5);
    t.jump = il_larger(IL_C(32.0) * t.recent, IL_C(1.0)) * IL_C(0.25);
    return t;
}

il_real il_robust_step(const il_array *a, const il_robust_terms *t, il_array_axis *s, const il_real *z,
                       const il_real *reading, int want_health) {
    il_sample p;
    int well = s->well && il_robust_all_well(a, t, s, z, reading, &p);
    if (well && p.change > IL_C(0.0) && s->clean < MOST_CLEAN) {
        s->clean++;
        s->resolution = il_smaller(p.change, s->resolution);
        memcpy(s->last, reading, (size_t)a->elements * sizeof(il_real));
    } else {
        il_robust_settle(a, s);
        if (il_robust_examine(a, s, z, reading, &p) || !well) {
            const il_real rate = look_closely(a, t, s, z, &p);
            il_robust_assess(a, s);
            return rate;
        }
        for (int32_t i = 0; i < a->elements; i++) il_count(&s->seen[i]);
    }
    if (want_health) {
        for (int32_t i = 0; i < a->elements; i++) s->weight[i] /= p.total;
        memset(s->flags, 0, (size_t)a->elements);
    }
    if (il_robust_learn_well(a, t, s, &p)) {
        il_robust_settle(a, s);
        p.learnt = il_most_seen(a, s) - 1;
        memset(p.learns, 1, sizeof p.learns);
        find_small_jumps(a, t, s, &p);
        il_robust_assess(a, s);
    }
    il_robust_pass(t, s, p.rate);
    return p.rate;
}
