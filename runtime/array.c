/* Gyro array: the plain methods, and what all methods share; the robust one is in robust.c and what goes with it. */
#include "array.h"

/* A reading may come with an alignment of its element over the axes; then one lost axis loses all. */
static void aligned(const il_array *a, const il_real *reading, il_real *z) {
    int32_t n = a->elements;
    for (int32_t i = 0; i < n * a->axes; i++) z[i] = a->offset != NULL ? reading[i] - a->offset[i] : reading[i];
    if (a->matrix == NULL) return;
    for (int32_t i = 0; i < n; i++) {
        const il_real *m = a->matrix + i * a->axes * a->axes;
        il_real out[3] = {IL_C(0.0), IL_C(0.0), IL_C(0.0)};
        for (int32_t r = 0; r < a->axes; r++) {
            for (int32_t c = 0; c < a->axes; c++) out[r] += m[r * a->axes + c] * z[c * n + i];
        }
        for (int32_t r = 0; r < a->axes; r++) z[r * n + i] = out[r];
    }
}

/* Gain of the running estimates at sample k, k >= 1. */
static il_real array_gain(const il_array *a, uint32_t k) {
    return a->memory > IL_C(0.0) ? a->memory : IL_C(1.0) / (il_real)k;
}

/* Mean of the finite readings, some of which are not; flags those, and counts the others. */
static il_real mean_of_some(const il_array *a, il_array_axis *s, const il_real *z, int32_t *count) {
    il_real sum = IL_C(0.0);
    int32_t found = 0;
    for (int32_t i = 0; i < a->elements; i++) {
        int fine = il_finite(z[i]);
        s->flags[i] = fine ? 0 : (uint8_t)(IL_NOT_FINITE | IL_EXCLUDED);
        if (fine) {
            sum += z[i];
            found++;
        }
    }
    *count = found;
    return found > 0 ? sum / (il_real)found : il_nan();
}

/* Mean of the finite readings. Counts them, and flags the others; without a wish for health only where there are some. */
static inline il_real finite_mean(const il_array *a, il_array_axis *s, const il_real *z, int32_t *count, int want_health) {
    const int32_t n = a->elements;
    il_real sum[2] = {IL_C(0.0), IL_C(0.0)};
    int32_t i;
    for (i = 0; i + 1 < n; i += 2) {
        for (int32_t j = 0; j < 2; j++) sum[j] += z[i + j];
    }
    if (i < n) sum[0] += z[i];
    if (!il_finite(sum[0] + sum[1])) return mean_of_some(a, s, z, count);
    for (i = 0; want_health && i < n; i++) s->flags[i] = 0;
    *count = n;
    return (sum[0] + sum[1]) / (il_real)n;
}

/* Weighted mean of the finite readings; makes the weights sum to one. */
static il_real weighted(const il_array *a, il_array_axis *s, const il_real *z, int want_health) {
    il_real total = IL_C(0.0), sum = IL_C(0.0);
    for (int32_t i = 0; i < a->elements; i++) {
        if (s->flags[i]) s->weight[i] = IL_C(0.0);
        total += s->weight[i];
        if (!s->flags[i]) sum += s->weight[i] * z[i];
    }
    if (total == IL_C(0.0)) return il_nan();
    for (int32_t i = 0; want_health && i < a->elements; i++) s->weight[i] /= total;
    return sum / total;
}

/* Equal weights of `count` gyros. */
static void weigh_alike(const il_array *a, il_array_axis *s, int32_t count) {
    for (int32_t i = 0; i < a->elements; i++) s->weight[i] = s->flags[i] ? IL_C(0.0) : IL_C(1.0) / (il_real)count;
}

static il_real mean_step(const il_array *a, il_array_axis *s, const il_real *z, int want_health) {
    int32_t count;
    il_real mean = finite_mean(a, s, z, &count, want_health);
    if (want_health) weigh_alike(a, s, count);
    return mean;
}

/* Support degree: a reading weighs as much as the others support it, by a kernel of the distance of each pair, in
 * units of the root mean square distance so far. */
static il_real support_step(const il_array *a, il_array_axis *s, const il_real *z, int want_health) {
    int32_t n = a->elements, count;
    il_real sum = IL_C(0.0);
    finite_mean(a, s, z, &count, 1);
    for (int32_t i = 0; i < n; i++) {
        s->weight[i] = IL_C(0.0);
        for (int32_t j = 0; j < i; j++) sum += s->flags[i] | s->flags[j] ? IL_C(0.0) : (z[i] - z[j]) * (z[i] - z[j]);
    }
    if (count > 1) {
        il_real gain = s->seen[0] == 0 ? IL_C(1.0) : array_gain(a, il_counted(s->seen[0], a->start));
        s->spread += gain * (sum / ((il_real)count * (il_real)(count - 1) / IL_C(2.0)) - s->spread);
        il_count(&s->seen[0]);
    }
    il_real scale = s->spread > IL_C(0.0) ? IL_C(1.0) / s->spread : IL_C(0.0);
    for (int32_t i = 0; i < n; i++) {
        for (int32_t j = 0; j < i; j++) {
            if (s->flags[i] | s->flags[j]) continue;
            il_real square = (z[i] - z[j]) * (z[i] - z[j]) * scale;
            il_real kernel = a->kernel == IL_GAUSSIAN ? il_exp(-square / IL_C(2.0)) : il_exp(-il_sqrt(square));
            s->weight[i] += kernel;
            s->weight[j] += kernel;
        }
    }
    if (count == 1) return mean_step(a, s, z, want_health);
    return weighted(a, s, z, want_health);
}

/* Residuals about the mean to biases, variances and inverse-variance weights. Two gyros at a time, as in feedback. */
static il_real least_squares_loop(int32_t n, il_real mean, const il_real *restrict z, const il_real *restrict gain,
                                  const il_real *restrict least, il_real *restrict bias, il_real *restrict variance,
                                  il_real *restrict weight, il_real *total) {
    il_real all[2] = {IL_C(0.0), IL_C(0.0)}, sum[2] = {IL_C(0.0), IL_C(0.0)};
    for (int32_t i = 0; i < n; i += 2) {
        for (int32_t j = 0; j < 2; j++) {
            const il_real g = gain[i + j], residual = z[i + j] - mean - bias[i + j];
            /* Written as a step, which a float takes more exactly than (1-g) times the sum. */
            const il_real v = variance[i + j] + g * ((IL_C(1.0) - g) * residual * residual - variance[i + j]);
            const il_real w = IL_C(1.0) / (v + least[i + j]);
            bias[i + j] += g * residual;
            variance[i + j] = v;
            weight[i + j] = w;
            all[j] += w;
            sum[j] += w * z[i + j];
        }
    }
    *total = all[0] + all[1];
    return (sum[0] + sum[1]) / *total;
}

/* Gain of a bias and of a variance after `seen` residuals. */
static il_real least_squares_gain(const il_array *a, uint32_t seen) {
    return seen == 0 ? IL_C(1.0) : array_gain(a, il_counted(seen, a->start));
}

/* Gains and floors of the variances, and one more residual seen. A gyro without a reading has no gain and no weight. */
static void least_squares_prepare(const il_array *a, il_array_axis *s, int32_t count, il_real *gain, il_real *least) {
    const int32_t n = a->elements;
    uint32_t differ = 0;
    for (int32_t i = 0; i < n; i++) differ |= s->seen[i] ^ s->seen[0];
    if (count == n && differ == 0) { /* nearly always: one division serves */
        const il_real shared = least_squares_gain(a, s->seen[0]);
        const uint32_t seen = il_counted(s->seen[0], 1);
        for (int32_t i = 0; i < n; i += 2) {
            gain[i] = gain[i + 1] = shared;
            least[i] = least[i + 1] = IL_TINY;
        }
        for (int32_t i = 0; i < n; i++) s->seen[i] = seen;
    } else {
        for (int32_t i = 0; i < n; i++) {
            const int lost = count < n && s->flags[i];
            gain[i] = lost ? IL_C(0.0) : least_squares_gain(a, s->seen[i]);
            least[i] = lost ? (il_real)INFINITY : IL_TINY;
            s->seen[i] = il_counted(s->seen[i], !lost);
        }
    }
    gain[n] = IL_C(0.0); /* of the last one's partner, where n is odd */
    least[n] = (il_real)INFINITY;
}

/* Inverse-variance weights, the variance of each gyro about the mean of the array. Apart, because its stack would add to
 * that of the robust method. */
static IL_APART il_real least_squares_step(const il_array *a, il_array_axis *s, const il_real *z, int want_health) {
    const int32_t n = a->elements;
    il_real y[IL_ARRAY_ROOM], gain[IL_ARRAY_ROOM], least[IL_ARRAY_ROOM], total;
    int32_t count;
    const il_real mean = finite_mean(a, s, z, &count, want_health);
    if (count > 1) {
        least_squares_prepare(a, s, count, gain, least);
        if (n % 2 || count < n) {
            for (int32_t i = 0; i < n; i++) y[i] = count < n && s->flags[i] ? mean + s->bias[i] : z[i];
            y[n] = mean;
            z = y;
        }
        const il_real rate = least_squares_loop(n, mean, z, gain, least, s->bias, s->variance, s->weight, &total);
        /* equal weights until every variance rests on two residuals */
        if (s->count - a->start >= 2) {
            if (total == IL_C(0.0)) return il_nan();
            for (int32_t i = 0; want_health && i < n; i++) s->weight[i] /= total;
            return rate;
        }
    }
    if (want_health) weigh_alike(a, s, count);
    return mean;
}

static il_real fixed_step(const il_array *a, il_array_axis *s, const il_real *z, int32_t axis, int want_health) {
    int32_t count;
    finite_mean(a, s, z, &count, 1);
    for (int32_t i = 0; i < a->elements; i++) s->weight[i] = a->weight[axis * a->elements + i];
    return weighted(a, s, z, want_health);
}

/* Bias at the first sample, for the methods that estimate one. */
static il_real start_bias(const il_array *a, il_array_axis *s, const il_real *z, int32_t axis) {
    int32_t n = a->elements;
    il_real sum = IL_C(0.0), fused = IL_C(0.0);
    for (int32_t i = 0; i < n; i++) sum += z[i];
    for (int32_t i = 0; i < n; i++) {
        s->bias[i] = IL_C(0.0);
        if (a->initial == IL_FIRST) s->bias[i] = z[i] - sum / (il_real)n;
        if (a->initial == IL_GIVEN) s->bias[i] = a->bias[axis * n + i];
        s->weight[i] = IL_C(1.0) / (il_real)n;
        fused += z[i] - s->bias[i];
    }
    return fused / (il_real)n;
}

/* The recursion of CN109443333B, to the letter: it has no defence against readings that are no numbers.
 *   b = (1-g) b + g (Z - Zr'),  Y = Z - b,  D = (1-g) D + g (Y - Zr')^2,  Zr = sum Y/D / sum 1/D,  Zr' one sample old
 * Two gyros at a time, each with sums of its own: compilers make one instruction of both. Of an odd number the last
 * one's partner has an infinite variance. */
static il_real feedback_loop(int32_t n, il_real gain, il_real before, il_real least, const il_real *restrict z,
                             il_real *restrict bias, il_real *restrict variance, il_real *restrict weight) {
    const il_real keep = IL_C(1.0) - gain;
    il_real total[2] = {IL_C(0.0), IL_C(0.0)}, sum[2] = {IL_C(0.0), IL_C(0.0)};
    for (int32_t i = 0; i < n; i += 2) {
        for (int32_t j = 0; j < 2; j++) {
            /* Written as a step: (1-g) and g as rounded do not add up to one, which would let the common bias leak. */
            const il_real b = bias[i + j] + gain * (z[i + j] - bias[i + j] - before), y = z[i + j] - b;
            const il_real error = y - before, d = keep * variance[i + j] + gain * (error * error);
            const il_real share = IL_C(1.0) / (least > d ? least : d);
            bias[i + j] = b;
            variance[i + j] = d;
            weight[i + j] = share;
            total[j] += share;
            sum[j] += share * y;
        }
    }
    return (sum[0] + sum[1]) / (total[0] + total[1]);
}

static il_real feedback_step(const il_array *a, il_array_axis *s, const il_real *z, int32_t axis) {
    const int32_t n = a->elements;
    il_real even[IL_ARRAY_ROOM];
    if (s->count == a->start) return start_bias(a, s, z, axis);
    if (n % 2) {
        memcpy(even, z, (size_t)n * sizeof *z);
        even[n] = s->rate;
        z = even;
    }
    return feedback_loop(n, array_gain(a, s->count), s->rate, IL_TINY, z, s->bias, s->variance, s->weight);
}

/* Virtual gyro: state (rate, bias_1 .. bias_n), a random walk each, with the steady-state gain. */
static il_real kalman_step(const il_array *a, il_array_axis *s, const il_real *z, int32_t axis) {
    int32_t n = a->elements, count;
    const il_real *gain = a->gain + axis * (n + 1) * n;
    il_real innovation[IL_ARRAY_ELEMENTS], correction = IL_C(0.0), usual = IL_C(0.0);
    il_real mean = finite_mean(a, s, z, &count, 1);
    if (count == 0) return il_nan();
    if (s->seen[0] == 0) { /* the first sample with a reading starts the filter at the array's mean */
        s->seen[0] = 1;
        for (int32_t i = 0; i < n; i++) {
            s->bias[i] = IL_C(0.0);
            if (a->initial == IL_FIRST && !s->flags[i]) s->bias[i] = z[i] - mean;
            if (a->initial == IL_GIVEN) s->bias[i] = a->bias[axis * n + i];
        }
        s->filtered = IL_C(0.0); /* apart from s->rate, which is no number while all gyros are lost */
        for (int32_t i = 0; i < n; i++) s->filtered += s->flags[i] ? IL_C(0.0) : (z[i] - s->bias[i]) / (il_real)count;
    }
    for (int32_t i = 0; i < n; i++) {
        innovation[i] = s->flags[i] ? IL_C(0.0) : z[i] - s->filtered - s->bias[i];
        usual += innovation[i] / (il_real)count;
    }
    for (int32_t i = 0; i < n; i++) {
        if (s->flags[i]) innovation[i] = usual; /* a missing gyro says what the others say */
        correction += gain[i] * innovation[i];
        s->weight[i] = gain[i];
    }
    s->filtered += correction;
    for (int32_t i = 0; i < n; i++) {
        for (int32_t j = 0; j < n; j++) s->bias[i] += gain[(i + 1) * n + j] * innovation[j];
    }
    return s->filtered;
}

static il_real axis_step(const il_array *a, const il_robust_terms *t, il_array_axis *s, const il_real *z,
                         const il_real *reading, int32_t axis, int want_health) {
    switch (a->method) {
        case IL_SUPPORT: return support_step(a, s, z, want_health);
        case IL_LEAST_SQUARES: return least_squares_step(a, s, z, want_health);
        case IL_ROBUST: return il_robust_step(a, t, s, z, reading, want_health);
        case IL_COVARIANCE: return fixed_step(a, s, z, axis, want_health);
        case IL_KALMAN: return kalman_step(a, s, z, axis);
        default: return mean_step(a, s, z, want_health);
    }
}

/* Flags of such a sample, and its weights in the sum of one; apart, because its speed is the recursion's. */
static void feedback_health(const il_array *a, il_array_axis *s, const il_real *z) {
    il_real total = IL_C(0.0);
    for (int32_t i = 0; i < a->elements; i++) {
        s->flags[i] = il_finite(z[i]) ? 0 : (uint8_t)IL_NOT_FINITE;
        total += s->weight[i];
    }
    for (int32_t i = 0; i < a->elements; i++) s->weight[i] /= total;
}

static inline unsigned step(const il_array *a, const il_robust_terms *t, il_array_state *state,
                            const il_real *reading, il_real *rate, int want_health) {
    il_real moved[3 * IL_ARRAY_ELEMENTS];
    const il_real *z = reading;
    unsigned flags = 0;
    if (a->offset != NULL || a->matrix != NULL) {
        aligned(a, reading, moved);
        z = moved;
    }
    for (int32_t axis = 0; axis < a->axes; axis++) {
        il_array_axis *s = &state->axis[axis];
        const il_real *mine = z + axis * a->elements;
        il_count(&s->count);
        if (a->method == IL_FEEDBACK) {
            s->rate = feedback_step(a, s, mine, axis);
            if (want_health) feedback_health(a, s, mine);
        } else {
            s->rate = axis_step(a, t, s, mine, reading + axis * a->elements, axis, want_health);
        }
        rate[axis] = s->rate - s->common;
        if (!il_finite(s->rate)) flags |= IL_NOT_FINITE;
        if (want_health) {
            for (int32_t i = 0; i < a->elements; i++) flags |= s->flags[i];
        }
    }
    return flags;
}

il_status il_array_check(const il_array *a) {
    int32_t least = a->method == IL_ROBUST ? 3 : 1;
    if (a->method < 0 || a->method >= IL_METHODS || (a->axes != 1 && a->axes != 3)) return IL_ARGUMENT;
    if (a->elements < least || a->elements > IL_ARRAY_ELEMENTS || a->start < 1) return IL_ARGUMENT;
    if (!(a->memory >= IL_C(0.0) && a->memory < IL_C(1.0))) return IL_ARGUMENT;
    if (a->initial == IL_GIVEN && a->bias == NULL) return IL_ARGUMENT;
    if (a->method == IL_COVARIANCE && a->weight == NULL) return IL_ARGUMENT;
    if (a->method == IL_KALMAN && a->gain == NULL) return IL_ARGUMENT;
    for (int32_t i = 0; a->method == IL_ROBUST && a->weight != NULL && i < a->axes * a->elements; i++) {
        if (!(a->weight[i] > IL_C(0.0))) return IL_ARGUMENT;
    }
    if (a->method == IL_ROBUST && (a->jump < 2 || a->cap < 2 || a->stuck < 2 || a->quiet < 1)) return IL_ARGUMENT;
    return IL_OK;
}

il_status il_array_start(const il_array *settings, il_array_state *state) {
    memset(state, 0, sizeof *state);
    if (il_array_check(settings) != IL_OK) return IL_ARGUMENT;
    for (int32_t axis = 0; axis < settings->axes; axis++) {
        il_array_axis *s = &state->axis[axis];
        int32_t n = settings->elements;
        il_real sum = IL_C(0.0);
        s->count = settings->start - 1;
        for (int32_t i = 0; i < n; i++) {
            s->ratio[i] = settings->weight != NULL ? IL_C(1.0) / settings->weight[axis * n + i] : IL_C(1.0);
            s->bias[i] = settings->initial == IL_GIVEN ? settings->bias[axis * n + i] : IL_C(0.0);
            sum += s->ratio[i] / (il_real)n;
        }
        for (int32_t i = 0; i < n; i++) s->ratio[i] /= sum;
        /* of the last one's partner, where n is odd */
        if (settings->method == IL_ROBUST) s->ratio[n] = (il_real)INFINITY;
        if (settings->method == IL_FEEDBACK) s->variance[n] = (il_real)INFINITY;
    }
    return IL_OK;
}

unsigned il_array_step(const il_array *settings, il_array_state *state, const il_real *reading, il_real *rate) {
    il_robust_terms t;
    if (settings->method == IL_ROBUST) t = il_robust_prepare(settings);
    return step(settings, &t, state, reading, rate, 1);
}

void il_array_still(const il_array *settings, il_array_state *state) {
    for (int32_t axis = 0; axis < settings->axes; axis++) {
        il_array_axis *s = &state->axis[axis];
        if (!il_finite(s->rate)) continue;
        il_count(&s->still);
        il_real k = (il_real)(s->still < settings->cap || settings->cap == 0 ? s->still : settings->cap);
        s->common += (s->rate - s->common) / k;
    }
}

unsigned il_array_block(const il_array *settings, il_array_state *state, size_t n, const il_real *reading,
                        const uint8_t *still, il_real *rate, uint8_t *flags, il_real *weight) {
    const il_array a = *settings; /* a copy cannot alias the samples */
    size_t width = (size_t)a.axes * (size_t)a.elements, elements = (size_t)a.elements;
    unsigned all = 0;
    int want_health = flags != NULL || weight != NULL;
    il_robust_terms t;
    if (a.method == IL_ROBUST) t = il_robust_prepare(&a);
    for (size_t k = 0; k < n; k++) {
        /* the last sample leaves flags and weights in the state, as single steps do */
        const int health = want_health || k + 1 == n;
        all |= step(&a, &t, state, reading + k * width, rate + k * (size_t)a.axes, health);
        if (still != NULL && still[k]) il_array_still(&a, state);
        for (size_t axis = 0; want_health && axis < (size_t)a.axes; axis++) {
            const il_array_axis *s = &state->axis[axis];
            size_t place = k * width + axis * elements;
            if (flags != NULL) memcpy(flags + place, s->flags, elements);
            if (weight != NULL) memcpy(weight + place, s->weight, elements * sizeof(il_real));
        }
    }
    return all;
}
