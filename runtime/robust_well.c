/* Gyro array, the robust method: a sample in which all is well, which is nearly every one.
 *
 * The same as robust.c computes, without its questions: a quarter of the instructions, without which three axes of six gyros
 * could not be fused in 250 ns. The loops take two gyros at a time, each with sums of its own:
 * compilers make one instruction of both. Of an odd number, the last one's partner has an infinite variance.
 */
#include "robust.h"

/* Gains, and how far variances are shrunk towards the mean, with one residual more than so far. */
static void experience(const il_array *a, const il_array_axis *s, il_sample *p) {
    const int32_t n = a->elements;
    uint32_t seen = il_counted(s->seen[0], s->clean);
    const il_real pull = il_pull(a, seen), gain = il_learning_gain(a, il_counted(seen, 1));
    for (int32_t i = 0; i < n; i += 2) {
        p->pull[i] = p->pull[i + 1] = pull;
        p->gain[i] = p->gain[i + 1] = gain;
    }
    for (int32_t i = 1; s->well == IL_UNEQUAL && i < n; i++) {
        seen = il_counted(s->seen[i], s->clean);
        p->pull[i] = il_pull(a, seen);
        p->gain[i] = il_learning_gain(a, il_counted(seen, 1));
    }
    p->pull[n] = IL_C(1.0); /* of the last one's partner, where n is odd */
    p->gain[n] = IL_C(0.0);
}

/* Readings less biases; sums of these and of the variances, and the smallest change of a reading. */
static void compensate(int32_t n, const il_real *restrict z, const il_real *restrict bias,
                       const il_real *restrict variance, const il_real *restrict reading,
                       const il_real *restrict last, il_real *restrict r, il_sample *restrict p) {
    il_real sum[2] = {IL_C(0.0), IL_C(0.0)}, variances[2] = {IL_C(0.0), IL_C(0.0)};
    il_real least[2] = {(il_real)INFINITY, (il_real)INFINITY};
    int32_t i;
    for (i = 0; i + 1 < n; i += 2) {
        for (int32_t j = 0; j < 2; j++) {
            r[i + j] = z[i + j] - bias[i + j];
            sum[j] += r[i + j];
            variances[j] += variance[i + j];
            least[j] = il_smaller(il_fabs(reading[i + j] - last[i + j]), least[j]);
        }
    }
    if (i < n) {
        r[i] = z[i] - bias[i];
        sum[0] += r[i];
        variances[0] += variance[i];
        least[0] = il_smaller(il_fabs(reading[i] - last[i]), least[0]);
    }
    p->middle = sum[0] + sum[1];
    p->mean_variance = variances[0] + variances[1];
    p->change = il_smaller(least[0], least[1]);
}

/* Weights, their sums, and the two margins of `il_robust_all_well`. */
static void compare(int32_t n, il_real gate, il_real floor, const il_real *restrict r, const il_real *restrict variance,
                    const il_real *restrict ratio, const il_real *restrict pull, il_real *restrict trusted,
                    il_real *restrict weight, il_sample *restrict p) {
    const il_real middle = p->middle, usual = p->mean_variance;
    il_real squares[2] = {IL_C(0.0), IL_C(0.0)}, total[2] = {IL_C(0.0), IL_C(0.0)}, rate[2] = {IL_C(0.0), IL_C(0.0)};
    il_real top[2] = {IL_C(0.0), IL_C(0.0)}, outside[2] = {-(il_real)INFINITY, -(il_real)INFINITY};
    il_real strained[2] = {-(il_real)INFINITY, -(il_real)INFINITY};
    for (int32_t i = 0; i < n; i += 2) {
        for (int32_t j = 0; j < 2; j++) {
            il_real e = r[i + j] - middle, square = e * e;
            il_real v = il_larger(il_shrunk(variance[i + j], pull[i + j], usual * ratio[i + j]), floor), w = IL_C(1.0) / v;
            trusted[i + j] = v;
            weight[i + j] = w;
            squares[j] += square;
            total[j] += w;
            rate[j] += w * r[i + j];
            top[j] = il_larger(w, top[j]);
            outside[j] = il_larger(square - gate * v, outside[j]);
            strained[j] = il_larger(IL_C(1.25) * square - IL_MOST * IL_MOST * il_larger(v, usual), strained[j]);
        }
    }
    p->squares = squares[0] + squares[1];
    p->total = total[0] + total[1];
    p->rate = (rate[0] + rate[1]) / p->total;
    p->top = il_larger(top[0], top[1]);
    p->outside = il_larger(outside[0], outside[1]);
    p->strained = il_larger(strained[0], strained[1]);
}

/* Hold the largest weight to the cap. */
static void hold(const il_array *a, const il_array_axis *s, il_real *weight, il_sample *p) {
    il_real others = IL_C(0.0), rate = IL_C(0.0);
    int32_t top = 0;
    while (weight[top] < p->top) top++;
    for (int32_t i = 0; i < a->elements; i++) {
        if (i == top) continue;
        others += weight[i];
        rate += weight[i] * p->r[i];
    }
    const il_real cap = il_most_weight(a, il_counted(s->seen[top], s->clean));
    if (weight[top] <= cap * p->total) return;
    weight[top] = cap / (IL_C(1.0) - cap) * others;
    p->total = others + weight[top];
    p->rate = (rate + weight[top] * p->r[top]) / p->total;
}

/* Biases, variances, means of a second. Returns by how much one of these is beyond what shows that none has jumped. */
static il_real update(int32_t n, const il_robust_terms *restrict t, const il_sample *restrict p, const il_real *restrict r,
                     const il_real *restrict still, il_real centre, const il_real *restrict gain,
                     const il_real *restrict trusted, il_real *restrict bias, il_real *restrict variance,
                     il_real *restrict fast) {
    const il_real middle = p->middle, rate = p->rate, level = t->cross * p->squares, hat = t->hat, keep = t->keep;
    const il_real recent = t->recent, jump = t->jump;
    il_real sum[2] = {IL_C(0.0), IL_C(0.0)}, far[2] = {-(il_real)INFINITY, -(il_real)INFINITY};
    for (int32_t i = 0; i < n; i += 2) {
        for (int32_t j = 0; j < 2; j++) {
            il_real e = r[i + j] - middle, f = still[i + j];
            il_real mean = keep * fast[i + j] + recent * (f - rate), square = mean * mean;
            bias[i + j] += gain[i + j] * (f - centre);
            variance[i + j] = (IL_C(1.0) - gain[i + j]) * (variance[i + j] + gain[i + j] * (hat * (e * e) - level));
            fast[i + j] = mean;
            sum[j] += square;
            far[j] = il_larger(square - jump * trusted[i + j], far[j]);
        }
    }
    return il_larger(far[0], far[1]) + IL_C(2.0) * t->share * (sum[0] + sum[1]);
}

/* Whether no residual is beyond full teaching; exactly, where the margin of `compare` leaves it open. */
static int all_teach_in_full(int32_t n, const il_sample *p, const il_real *r) {
    int all = 1;
    for (int32_t i = 0; i < n; i++) {
        const il_real e = r[i] - p->rate;
        all &= e * e <= IL_MOST * IL_MOST * il_larger(p->trust[i], p->mean_variance);
    }
    return all;
}

/* Whether all readings lie well inside the gate, with residuals that teach in full. Fuses them, and changes no state
 * but the weights. Of any numbers, the median is no further from the mean than the root mean square deviation, so that
 * |r - median|^2 <= 2 (e^2 + mean e^2); and with the fused rate d away from the mean,
 * |r - rate|^2 <= 5/4 e^2 + 5 d^2. */
int il_robust_all_well(const il_array *a, const il_robust_terms *t, il_array_axis *s, const il_real *z,
                       const il_real *reading, il_sample *p) {
    const int32_t n = a->elements;
    compensate(n, z, s->bias, s->variance, reading, s->last, p->r, p);
    p->middle *= t->share; /* stands for the median where only its size matters */
    p->mean_variance *= t->share;
    p->r[n] = p->middle;
    if (!(p->mean_variance > IL_C(0.0))) return 0;
    experience(a, s, p);
    const il_real floor = il_larger(a->weight_floor * p->mean_variance, IL_TINY);
    compare(n, t->gate, floor, p->r, s->variance, s->ratio, p->pull, p->trust, s->weight, p);
    p->noise = (il_real)n / p->total;
    if (p->top > a->weight_cap * p->total) hold(a, s, s->weight, p);
    const il_real apart = p->middle - p->rate, room = IL_C(2.0) * t->gate * p->mean_variance - p->squares;
    if (!(p->outside <= room * t->share)) return 0;
    if (p->strained + IL_C(5.0) * apart * apart > IL_C(0.0) && !all_teach_in_full(n, p, p->r)) return 0;
    p->moves = il_robust_move(a, s, p->rate, p);
    return !p->moves || all_teach_in_full(n, p, p->r_still);
}

/* Whether the means of a second are so near to each other that none can have jumped: half of the limit of a jump, because
 * one sample moves a variance a little. */
static int agree(int32_t n, const il_robust_terms *t, const il_real *fast, const il_real *trusted) {
    il_real sorted[IL_ARRAY_ELEMENTS];
    int all = 1;
    memcpy(sorted, fast, (size_t)n * sizeof *fast);
    const il_real usual = il_median(sorted, n);
    for (int32_t i = 0; i < n; i++) {
        const il_real far = fast[i] - usual;
        all &= far * far <= IL_C(2.0) * t->jump * trusted[i];
    }
    return all;
}

int il_robust_learn_well(const il_array *a, const il_robust_terms *t, il_array_axis *s, il_sample *p) {
    const int32_t n = a->elements;
    const int unlike = s->well == IL_UNEQUAL && il_forming(a, il_counted(il_most_seen(a, s), s->clean) - 1);
    const il_real before = unlike ? il_sum(n, s->bias) : IL_C(0.0);
    const il_real *still = p->moves ? p->r_still : p->r;
    il_real centre = p->middle;
    if (p->moves) {
        il_real f[IL_ARRAY_ROOM];
        centre = il_sum(n, still) * t->share;
        for (int32_t i = 0; i < n; i++) f[i] = still[i] - centre;
        p->r_still[n] = centre;
        il_robust_learn_motion(a, s, p, f);
    }
    /* The median of the means of a second is no further from 0 than sqrt(2) times their root mean square. */
    const il_real doubt = update(n, t, p, p->r, still, centre, p->gain, p->trust, s->bias, s->variance, s->fast);
    if (unlike) {
        const il_real drift = (il_sum(n, s->bias) - before) * t->share;
        for (int32_t i = 0; i < n; i++) s->bias[i] -= drift;
    }
    return !(doubt <= IL_C(0.0)) && !agree(n, t, s->fast, p->trust);
}
