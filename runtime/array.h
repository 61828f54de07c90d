/* What array.c and robust.c share. */
#ifndef IL_ARRAY_H
#define IL_ARRAY_H

#include "real.h"

/* Gain of the running estimates at sample k, k >= 1. */
il_real il_array_gain(const il_array *a, uint32_t k);

/* One sample of one axis by the robust method; reading as it came (stuck gyros), z aligned. Returns the rate. */
il_real il_robust_step(const il_array *a, il_array_axis *s, const il_real *z, const il_real *reading);

/* Count up to the largest number and stay there. */
static inline void il_count(uint32_t *n) {
    if (*n < UINT32_MAX) ++*n;
}

/* Sum of two counts, which stops at the largest number too. */
static inline uint32_t il_counted(uint32_t a, uint32_t b) {
    return b <= UINT32_MAX - a ? a + b : UINT32_MAX;
}

#endif
