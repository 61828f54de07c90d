/* Gyro array: the recursion of CN109443333B, to the letter: it has no defence against readings that are no numbers.
 *   b = (1-g) b + g (Z - Zr'),  Y = Z - b,  D = (1-g) D + g (Y - Zr')^2,  Zr = sum Y/D / sum 1/D,  Zr' one sample old
 */
#include "array.h"

/* Two gyros at a time, each with sums of its own: compilers make one instruction of both. Of an odd number the last one's
 * partner has an infinite variance. */
static il_real recursion(int32_t n, il_real gain, il_real before, const il_real *restrict z, il_real *restrict bias,
                         il_real *restrict variance, il_real *restrict weight) {
    const il_real keep = IL_C(1.0) - gain, least = IL_TINY;
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

static il_real first(const il_array *a, il_array_axis *s, const il_real *z, int32_t axis) {
    const il_real n = (il_real)a->elements;
    il_real sum = IL_C(0.0), fused = IL_C(0.0);
    for (int32_t i = 0; i < a->elements; i++) sum += z[i];
    for (int32_t i = 0; i < a->elements; i++) {
        s->bias[i] = il_first_bias(a, axis, i, z[i] - sum / n);
        s->weight[i] = IL_C(1.0) / n;
        fused += z[i] - s->bias[i];
    }
    return fused / n;
}

il_real il_feedback_step(const il_array *a, il_array_axis *s, const il_real *z, int32_t axis, int want_health) {
    const int32_t n = a->elements;
    il_real even[IL_ARRAY_ROOM], total = IL_C(0.0), rate;
    if (s->count == a->start) {
        rate = first(a, s, z, axis);
    } else {
        if (n % 2) {
            memcpy(even, z, (size_t)n * sizeof *z);
            even[n] = s->rate;
        }
        rate = recursion(n, il_array_gain(a, s->count), s->rate, n % 2 ? even : z, s->bias, s->variance, s->weight);
    }
    if (!want_health) return rate;
    for (int32_t i = 0; i < n; i++) {
        s->flags[i] = il_finite(z[i]) ? 0 : (uint8_t)IL_NOT_FINITE;
        total += s->weight[i];
    }
    for (int32_t i = 0; i < n; i++) s->weight[i] /= total;
    return rate;
}
