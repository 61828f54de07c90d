/* What the robust method works with: its constants, one sample at work, and the median. */
#ifndef IL_ROBUST_H
#define IL_ROBUST_H

#include "array.h"

#if IL_FLOAT
#define ROUNDING 1e-5f /* of a reading: closer than this, two readings agree */
#else
#define ROUNDING 1e-12
#endif
#define OWN IL_C(16.0)        /* residuals that the mean variance of the array counts for in each gyro's own */
#define CALIBRATED IL_C(200.0) /* the same where a calibration says how the variances compare */
#define MOST IL_C(3.0) /* standard deviations of a reading that teach */
#define DEVIATION IL_C(1.4826) /* median absolute deviation to standard deviation */

enum { STUCK = 1, OUT = 2, FRESH = 4, JUMPED = 8 }; /* standing of a gyro, from sample to sample */
enum { ENOUGH = 20 };                               /* repeats that nobody takes for chance */
enum { SETTLING = 16 };                             /* residuals before a variance is fit to bound others */
enum { FORMING = 5 };                               /* quiet periods in which the array finds its own biases */

/* One sample at work. */
typedef struct {
    uint8_t usable[IL_ARRAY_ELEMENTS], core[IL_ARRAY_ELEMENTS], inside[IL_ARRAY_ELEMENTS];
    uint8_t learns[IL_ARRAY_ELEMENTS], used[IL_ARRAY_ELEMENTS];
    il_real r[IL_ARRAY_ELEMENTS];    /* reading less bias */
    il_real trust[IL_ARRAY_ELEMENTS]; /* variance as far as it can be trusted */
    il_real half[IL_ARRAY_ELEMENTS];  /* width of the gate */
    il_real middle;                  /* median of those trusted */
    il_real mean_variance;
    uint32_t learnt; /* residuals of the most experienced gyro */
    int waived;      /* nobody is trusted: the quiet period does not count */
} sample;

static inline il_real larger(il_real a, il_real b) {
    return a > b ? a : b;
}

static inline il_real median(il_real *values, int32_t n) {
    for (int32_t i = 1; i < n; i++) { /* insertion sort: n is small */
        il_real v = values[i];
        int32_t j = i;
        for (; j > 0 && values[j - 1] > v; j--) values[j] = values[j - 1];
        values[j] = v;
    }
    return n % 2 ? values[n / 2] : IL_C(0.5) * (values[n / 2 - 1] + values[n / 2]);
}

/* Median of the chosen values, and their typical distance from it as a standard deviation. */
static inline il_real median_of(int32_t n, const uint8_t *chosen, const il_real *values, il_real *typical) {
    il_real sorted[IL_ARRAY_ELEMENTS] = {IL_C(0.0)};
    int32_t count = 0;
    for (int32_t i = 0; i < n; i++) {
        if (chosen[i]) sorted[count++] = values[i];
    }
    il_real middle = median(sorted, count);
    for (int32_t i = 0; i < count; i++) sorted[i] = il_fabs(sorted[i] - middle);
    *typical = DEVIATION * median(sorted, count);
    return middle;
}

#endif
