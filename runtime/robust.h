/* What robust.c and robust_well.c share: constants, one sample at work, the median, gains. */
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
#define CHANCE IL_C(1e-6) /* that a reading repeats so often by chance: less is held, as at the end of a range */
#define DEVIATION IL_C(1.4826) /* median absolute deviation to standard deviation */

enum { STUCK = 1, OUT = 2, FRESH = 4, JUMPED = 8 }; /* standing of a gyro, from sample to sample */
enum { ENOUGH = 20 };                               /* repeats that nobody takes for chance */
enum { SETTLING = 16 };                             /* residuals before a variance is fit to bound others */
enum { UNEQUAL = 1, ALIKE = 2 };                    /* all is well: gyros have learnt differently, or alike */
enum { MOST_CLEAN = 1 << 16 };                      /* samples between two counts of each gyro */
enum { ESTABLISHED = 10 };                          /* quiet periods after which a gyro may weigh more */
enum { FORMING = 5 };                               /* quiet periods in which the array finds its own biases */

/* One sample at work. */
typedef struct {
    uint8_t usable[IL_ARRAY_ELEMENTS], core[IL_ARRAY_ELEMENTS], held[IL_ARRAY_ELEMENTS], inside[IL_ARRAY_ELEMENTS], excused[IL_ARRAY_ELEMENTS];
    uint8_t learns[IL_ARRAY_ELEMENTS], used[IL_ARRAY_ELEMENTS];
    il_real r[IL_ARRAY_ROOM];        /* reading less bias */
    il_real trust[IL_ARRAY_ROOM];    /* variance as far as it can be trusted */
    il_real gain[IL_ARRAY_ROOM];     /* of bias and variance in this sample */
    il_real pull[IL_ARRAY_ROOM];     /* of the mean variance on this one */
    il_real raw[IL_ARRAY_ELEMENTS];  /* distance from the median, with what moves with the rate */
    il_real half[IL_ARRAY_ELEMENTS]; /* width of the gate */
    il_real middle;                  /* median of those trusted; their mean where all is well */
    il_real mean_variance;
    il_real noise;                   /* harmonic mean of the variances of those trusted */
    il_real rate;                    /* fused; where all is well: */
    il_real change;                  /* smallest change of a reading, */
    il_real squares, total;          /* sums of squared residuals and of weights, */
    il_real top;                     /* largest weight, */
    il_real outside, bent;           /* by how much a squared residual is beyond the gate, and beyond full teaching */
    il_real motion[2];       /* change of the rate within 10 ms, and a hundredth of it; 0 while the noise hides these */
    il_real r_still[IL_ARRAY_ROOM]; /* reading less bias and less what moves with the rate */
    uint32_t learnt; /* residuals of the most experienced gyro */
    int moves;       /* r_still is not r */
    int waived;      /* nobody is trusted: the quiet period does not count */
} sample;

static inline il_real larger(il_real a, il_real b) {
    return a > b ? a : b;
}

static inline il_real smaller(il_real a, il_real b) {
    return a < b ? a : b;
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

static inline uint32_t most_seen(const il_array *a, const il_array_axis *s) {
    uint32_t most = 0;
    for (int32_t i = 0; i < a->elements; i++) most = s->seen[i] > most ? s->seen[i] : most;
    return most;
}

/* Gain of a bias and of a variance after `seen` residuals. */
static inline il_real learning_gain(const il_array *a, uint32_t seen) {
    il_real growing = IL_C(1.0) / (il_real)(seen < a->cap ? seen : a->cap);
    return a->memory > IL_C(0.0) ? larger(a->memory, IL_C(1.0) / (il_real)seen) : growing;
}

/* Residuals that a variance rests on, after `seen`. */
static inline il_real remembered(const il_array *a, uint32_t seen) {
    const il_real count = (il_real)(seen < a->cap ? seen : a->cap);
    return count * a->memory > IL_C(1.0) ? IL_C(1.0) / a->memory : count;
}

/* How far a variance is drawn to the mean of all. */
static inline il_real pull_of(const il_array *a, uint32_t seen) {
    const il_real prior = a->weight != NULL ? CALIBRATED : OWN;
    return prior / (prior + remembered(a, seen));
}

/* Largest weight of a gyro: what it leaves to the others becomes less, the longer its noise is known. */
static inline il_real most_weight(const il_array *a, uint32_t seen) {
    const il_real enough = (il_real)ESTABLISHED * (il_real)a->quiet;
    return IL_C(1.0) - (IL_C(1.0) - a->weight_cap) * smaller(enough / remembered(a, seen), IL_C(1.0));
}

static inline il_real drawn(il_real variance, il_real pull, il_real usual) {
    return variance + pull * (usual - variance);
}

/* robust_motion.c: what a rate means to gyros that are late or have scale factors of their own. Returns whether there is
 * anything to tell apart; then p->r_still is filled. */
int il_robust_move(const il_array *a, const il_array_axis *s, il_real rate, sample *p);

/* robust_motion.c: learn both from residuals f, which sum to zero over the gyros with a gain; take the rate in. */
void il_robust_learn_motion(const il_array *a, il_array_axis *s, const sample *p, const il_real *f);
void il_robust_pass(const il_robust_terms *t, il_array_axis *s, il_real rate);

/* While the array finds its biases, the sum of these is kept whatever the gains are: with the sum of b_i / g_i a bias that
 * is taken back, by gains that have become alike, would leave half of itself with the others. */
static inline int forming(const il_array *a, uint32_t learnt) {
    return learnt < (uint64_t)FORMING * a->quiet;
}

static inline il_real sum_of(int32_t n, const il_real *x) {
    il_real sum = IL_C(0.0);
    for (int32_t i = 0; i < n; i++) sum += x[i];
    return sum;
}

/* robust.c: jumps that are too small for the gate. */
void il_robust_find_small_jumps(const il_array *a, il_array_axis *s, sample *p);

/* robust.c: decide whether the next sample may go the short way; bring the counts of each gyro up to date. */
void il_robust_muster(const il_array *a, il_array_axis *s);
void il_robust_settle(const il_array *a, il_array_axis *s);

/* robust_well.c: whether all is well in a sample, which is then fused, and what it teaches. */
int il_robust_all_well(const il_array *a, const il_robust_terms *t, il_array_axis *s, const il_real *z,
                       const il_real *reading, sample *p);
void il_robust_learn(const il_array *a, const il_robust_terms *t, il_array_axis *s, sample *p);

#endif
