/* What array.c and the robust method share. */
#ifndef IL_ARRAY_H
#define IL_ARRAY_H

#include "real.h"

#if defined(__GNUC__)
#define IL_APART __attribute__((noinline)) /* a function that is not to become part of another */
#else
#define IL_APART
#endif

/* Gain of the running estimates at sample k, k >= 1. */
il_real il_array_gain(const il_array *a, uint32_t k);

/* One sample of one axis by the source's recursion; least: floor of a variance. Apart, for restrict to hold. */
il_real il_feedback_loop(int32_t n, il_real gain, il_real before, il_real least, const il_real *restrict z,
                         il_real *restrict bias, il_real *restrict variance, il_real *restrict weight);

/* Flags of such a sample, and its weights in the sum of one; apart, because its speed is the recursion's. */
void il_feedback_health(const il_array *a, il_array_axis *s, const il_real *z);

/* What the robust method makes of its settings, once for many samples. */
typedef struct {
    il_real share;      /* 1/n */
    il_real hat, cross; /* n/(n-2) and 1/((n-1)(n-2)), of the N-cornered hat */
    il_real recent;     /* gain of the mean of a second, */
    il_real keep;       /* and 1 less that gain */
    il_real gate;       /* half of the squared gate */
    il_real jump;       /* share of a variance that the squared mean of a second may have without any doubt */
} il_robust_terms;

il_robust_terms il_robust_prepare(const il_array *a);

/* One sample of one axis by the robust method; reading as it came (stuck gyros), z aligned. Returns the rate. */
il_real il_robust_step(const il_array *a, const il_robust_terms *t, il_array_axis *s, const il_real *z,
                       const il_real *reading, int want_health);

/* Count up to the largest number and stay there. */
static inline void il_count(uint32_t *n) {
    if (*n < UINT32_MAX) ++*n;
}

/* Sum of two counts, which stops at the largest number too. */
static inline uint32_t il_counted(uint32_t a, uint32_t b) {
    return b <= UINT32_MAX - a ? a + b : UINT32_MAX;
}

#endif
