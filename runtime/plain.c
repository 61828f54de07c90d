/* Gyro array: the methods that keep readings that are no numbers apart and do without more: mean, support degree, least
 * squares, given weights, Kalman. */
#include "array.h"

/* Mean of the finite readings. Counts them, and flags the others; without a wish for health only where there are some. */
static inline il_real finite_mean(const il_array *a, il_array_axis *s, const il_real *z, int32_t *count, int want_health) {
    const int32_t n = a->elements;
    il_real even = IL_C(0.0), odd = IL_C(0.0), sum = IL_C(0.0);
    int32_t i;
    for (i = 0; i + 1 < n; i += 2) {
        even += z[i];
        odd += z[i + 1];
    }
    if (i < n) even += z[i];
    *count = n;
    if (il_finite(even + odd)) {
        for (i = 0; want_health && i < n; i++) s->flags[i] = 0;
        return (even + odd) / (il_real)n;
    }
    *count = 0;
    for (i = 0; i < n; i++) {
        const int fine = il_finite(z[i]);
        s->flags[i] = fine ? 0 : (uint8_t)(IL_NOT_FINITE | IL_EXCLUDED);
        sum += fine ? z[i] : IL_C(0.0);
        *count += fine;
    }
    return *count > 0 ? sum / (il_real)*count : il_nan();
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

/* The mean, of `count` gyros that weigh alike. */
static il_real alike(const il_array *a, il_array_axis *s, il_real mean, int32_t count, int want_health) {
    for (int32_t i = 0; want_health && i < a->elements; i++) {
        s->weight[i] = s->flags[i] ? IL_C(0.0) : IL_C(1.0) / (il_real)count;
    }
    return mean;
}

/* Support degree: a reading weighs as much as the others support it, by a kernel of the distance of each pair, in
 * units of the root mean square distance so far. */
static il_real support(const il_array *a, il_array_axis *s, const il_real *z, int want_health) {
    int32_t n = a->elements, count;
    il_real sum = IL_C(0.0);
    const il_real mean = finite_mean(a, s, z, &count, 1);
    if (count == 1) return alike(a, s, mean, count, want_health);
    for (int32_t i = 0; i < n; i++) {
        s->weight[i] = IL_C(0.0);
        for (int32_t j = 0; j < i; j++) sum += s->flags[i] | s->flags[j] ? IL_C(0.0) : (z[i] - z[j]) * (z[i] - z[j]);
    }
    if (count > 1) {
        il_real gain = s->seen[0] == 0 ? IL_C(1.0) : il_array_gain(a, il_counted(s->seen[0], a->start));
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
    return weighted(a, s, z, want_health);
}

/* Residuals about the mean to biases, variances and inverse-variance weights. Two gyros at a time, as in feedback.c. */
static il_real squares_loop(int32_t n, il_real mean, const il_real *restrict z, const il_real *restrict gain,
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

/* Gains and floors of the variances, and one more residual seen. A gyro without a reading has no gain and no weight. */
static void gains_of(const il_array *a, il_array_axis *s, int32_t count, il_real *gain, il_real *least) {
    const int32_t n = a->elements;
    il_real shared = IL_C(1.0);
    uint32_t known = 0; /* nearly always all have seen the same: one division serves */
    for (int32_t i = 0; i < n; i++) {
        const int lost = count < n && s->flags[i];
        const uint32_t seen = s->seen[i];
        if (seen != known) {
            known = seen;
            shared = seen == 0 ? IL_C(1.0) : il_array_gain(a, il_counted(seen, a->start));
        }
        gain[i] = lost ? IL_C(0.0) : shared;
        least[i] = lost ? (il_real)INFINITY : IL_TINY;
        s->seen[i] = il_counted(seen, !lost);
    }
    gain[n] = IL_C(0.0); /* of the last one's partner, where n is odd */
    least[n] = (il_real)INFINITY;
}

/* Inverse-variance weights, the variance of each gyro about the mean of the array. */
static il_real least_squares(const il_array *a, il_array_axis *s, const il_real *z, int want_health) {
    const int32_t n = a->elements;
    il_real y[IL_ARRAY_ROOM], gain[IL_ARRAY_ROOM], least[IL_ARRAY_ROOM], total;
    int32_t count;
    const il_real mean = finite_mean(a, s, z, &count, want_health);
    if (count > 1) {
        gains_of(a, s, count, gain, least);
        if (n % 2 || count < n) {
            for (int32_t i = 0; i < n; i++) y[i] = count < n && s->flags[i] ? mean + s->bias[i] : z[i];
            y[n] = mean;
            z = y;
        }
        const il_real rate = squares_loop(n, mean, z, gain, least, s->bias, s->variance, s->weight, &total);
        /* equal weights until every variance rests on two residuals */
        if (s->count - a->start >= 2) {
            if (total == IL_C(0.0)) return il_nan();
            for (int32_t i = 0; want_health && i < n; i++) s->weight[i] /= total;
            return rate;
        }
    }
    return alike(a, s, mean, count, want_health);
}

static il_real given_weights(const il_array *a, il_array_axis *s, const il_real *z, int32_t axis, int want_health) {
    int32_t count;
    finite_mean(a, s, z, &count, 1);
    memcpy(s->weight, a->weight + axis * a->elements, (size_t)a->elements * sizeof *s->weight);
    return weighted(a, s, z, want_health);
}

/* Virtual gyro: state (rate, bias_1 .. bias_n), a random walk each, with the steady-state gain. */
static il_real kalman(const il_array *a, il_array_axis *s, const il_real *z, int32_t axis) {
    int32_t n = a->elements, count;
    const il_real *gain = a->gain + axis * (n + 1) * n;
    il_real innovation[IL_ARRAY_ELEMENTS], correction = IL_C(0.0), usual = IL_C(0.0);
    il_real mean = finite_mean(a, s, z, &count, 1);
    if (count == 0) return il_nan();
    if (s->seen[0] == 0) { /* the first sample with a reading starts the filter at the array's mean */
        s->seen[0] = 1;
        s->filtered = IL_C(0.0); /* apart from s->rate, which is no number while all gyros are lost */
        for (int32_t i = 0; i < n; i++) {
            s->bias[i] = il_first_bias(a, axis, i, s->flags[i] ? IL_C(0.0) : z[i] - mean);
            s->filtered += s->flags[i] ? IL_C(0.0) : (z[i] - s->bias[i]) / (il_real)count;
        }
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

il_real il_plain_step(const il_array *a, il_array_axis *s, const il_real *z, int32_t axis, int want_health) {
    int32_t count;
    switch (a->method) {
        case IL_SUPPORT: return support(a, s, z, want_health);
        case IL_LEAST_SQUARES: return least_squares(a, s, z, want_health);
        case IL_COVARIANCE: return given_weights(a, s, z, axis, want_health);
        case IL_KALMAN: return kalman(a, s, z, axis);
        default: break;
    }
    const il_real mean = finite_mean(a, s, z, &count, want_health);
    return alike(a, s, mean, count, want_health);
}
