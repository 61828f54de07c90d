/* What the files of the gyro array share. array.c calls the methods: plain.c, feedback.c and robust.c, none of which calls back. */
#ifndef IL_ARRAY_H
#define IL_ARRAY_H

#include "real.h"

/* What the robust method makes of its settings, once for many samples. */
typedef struct {
    il_real share;      /* 1/n */
    il_real hat, cross; /* n/(n-2) and 1/((n-1)(n-2)), of the N-cornered hat */
    il_real recent;     /* gain of the mean of a second, */
    il_real keep;       /* and 1 less that gain */
    il_real gate;       /* half of the squared gate */
    il_real quick;      /* share of the rate that its smoothing over 10 ms takes in */
    il_real jump;       /* share of a variance that the squared mean of a second may have without any doubt */
} il_robust_terms;

il_robust_terms il_robust_prepare(const il_array *a);

/* One sample z of one axis, aligned, by each method; the robust one needs the reading as it came too (stuck gyros). Returns
 * the rate. Flags and normalised weights are left in the state only where health is wanted. */
il_real il_plain_step(const il_array *a, il_array_axis *s, const il_real *z, int32_t axis, int want_health);
il_real il_feedback_step(const il_array *a, il_array_axis *s, const il_real *z, int32_t axis, int want_health);
il_real il_robust_step(const il_array *a, const il_robust_terms *t, il_array_axis *s, const il_real *z,
                       const il_real *reading, int want_health);

/* Gain of the running estimates at sample k, k >= 1. */
static inline il_real il_array_gain(const il_array *a, uint32_t k) {
    return a->memory > IL_C(0.0) ? a->memory : IL_C(1.0) / (il_real)k;
}

/* Bias of a gyro at the first sample, in which it differs by `residual` from the mean. */
static inline il_real il_first_bias(const il_array *a, int32_t axis, int32_t i, il_real residual) {
    if (a->initial == IL_GIVEN) return a->bias[axis * a->elements + i];
    return a->initial == IL_FIRST ? residual : IL_C(0.0);
}

/* Sum of two counts, which stops at the largest number. */
static inline uint32_t il_counted(uint32_t a, uint32_t b) {
    return b <= UINT32_MAX - a ? a + b : UINT32_MAX;
}

static inline void il_count(uint32_t *n) {
    *n = il_counted(*n, 1);
}

#endif
