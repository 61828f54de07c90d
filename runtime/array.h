/* What array.c and the robust method share. */
#ifndef IL_ARRAY_H
#define IL_ARRAY_H

#include "real.h"

#if defined(__GNUC__)
#define IL_APART __attribute__((noinline)) /* a function that is not to become part of another */
#else
#define IL_APART
#endif

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
