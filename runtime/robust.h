/* What the files of the robust method share: constants, one sample at work, gains. robust.c calls the others, which do not
 * call back: robust_standing.c (who is trusted), robust_well.c (a sample in which all is well) and, below both ways,
 * robust_motion.c (what moves with the rate). */
#ifndef IL_ROBUST_H
#define IL_ROBUST_H

#include "array.h"

#if IL_FLOAT
#define IL_ROUNDING 1e-5f /* of a reading: closer than this, two readings agree */
#else
#define IL_ROUNDING 1e-12
#endif
#define IL_OWN IL_C(16.0)         /* residuals that the mean variance of the array counts for in each gyro's own */
#define IL_CALIBRATED IL_C(200.0) /* the same where a calibration says how the variances compare */
#define IL_MOST IL_C(3.0)         /* standard deviations of a reading that teach */

/* standing of a gyro, from sample to sample */
enum { IL_STANDS_STUCK = 1, IL_STANDS_OUT = 2, IL_STANDS_FRESH = 4, IL_STANDS_JUMPED = 8 };
enum { IL_UNEQUAL = 1, IL_ALIKE = 2 }; /* all is well: gyros have learnt differently, or alike */
enum { IL_SETTLING = 16 };             /* residuals before a variance is fit to bound others */
enum { IL_ESTABLISHED = 10 };          /* quiet periods after which a gyro may weigh more */
enum { IL_FORMING = 5 };               /* quiet periods in which the array finds its own biases */

/* One sample at work. */
typedef struct {
    uint8_t usable[IL_ARRAY_ELEMENTS], core[IL_ARRAY_ELEMENTS], held[IL_ARRAY_ELEMENTS], inside[IL_ARRAY_ELEMENTS];
    uint8_t excused[IL_ARRAY_ELEMENTS], learns[IL_ARRAY_ELEMENTS], used[IL_ARRAY_ELEMENTS];
    il_real r[IL_ARRAY_ROOM];        /* reading less bias */
    il_real trust[IL_ARRAY_ROOM];    /* variance as far as it can be trusted */
    il_real gain[IL_ARRAY_ROOM];     /* of bias and variance in this sample */
    il_real pull[IL_ARRAY_ROOM];     /* of the mean variance on this one */
    il_real raw[IL_ARRAY_ELEMENTS];  /* distance from the median, with what moves with the rate */
    il_real half[IL_ARRAY_ELEMENTS]; /* width of the gate */
    il_real middle;                  /* median of those trusted; their mean where all is well */
    il_real mean_variance;
    il_real noise;         /* harmonic mean of the variances of those trusted */
    il_real motion[2];     /* change of the rate within 10 ms, and a hundredth of it; 0 while the noise hides these */
    il_real rate;          /* fused; where all is well: */
    il_real change;        /* smallest change of a reading, */
    il_real squares, total; /* sums of squared residuals and of weights, */
    il_real top;           /* largest weight, */
    il_real outside, strained; /* by how much a squared residual is beyond the gate, and beyond full teaching */
    il_real r_still[IL_ARRAY_ROOM]; /* r less what moves with the rate */
    uint32_t learnt;       /* residuals of the most experienced gyro */
    int moves;             /* r_still is not r */
    int waived;            /* nobody is trusted: the quiet period does not count */
} il_sample;

static inline il_real il_larger(il_real a, il_real b) {
    return a > b ? a : b;
}

static inline il_real il_smaller(il_real a, il_real b) {
    return a < b ? a : b;
}

static inline il_real il_median(il_real *values, int32_t n) {
    for (int32_t i = 1; i < n; i++) { /* insertion sort: n is small */
        il_real v = values[i];
        int32_t j = i;
        for (; j > 0 && values[j - 1] > v; j--) values[j] = values[j - 1];
        values[j] = v;
    }
    return n % 2 ? values[n / 2] : IL_C(0.5) * (values[n / 2 - 1] + values[n / 2]);
}

static inline il_real il_sum(int32_t n, const il_real *x) {
    il_real sum = IL_C(0.0);
    for (int32_t i = 0; i < n; i++) sum += x[i];
    return sum;
}

static inline uint32_t il_most_seen(const il_array *a, const il_array_axis *s) {
    uint32_t most = 0;
    for (int32_t i = 0; i < a->elements; i++) most = s->seen[i] > most ? s->seen[i] : most;
    return most;
}

/* Gain of a bias and of a variance after `seen` residuals. */
static inline il_real il_learning_gain(const il_array *a, uint32_t seen) {
    il_real growing = IL_C(1.0) / (il_real)(seen < a->cap ? seen : a->cap);
    return a->memory > IL_C(0.0) ? il_larger(a->memory, IL_C(1.0) / (il_real)seen) : growing;
}

/* Residuals that a variance rests on, after `seen`. */
static inline il_real il_remembered(const il_array *a, uint32_t seen) {
    const il_real count = (il_real)(seen < a->cap ? seen : a->cap);
    return count * a->memory > IL_C(1.0) ? IL_C(1.0) / a->memory : count;
}

/* How far a variance is shrunk towards the mean of all. */
static inline il_real il_pull(const il_array *a, uint32_t seen) {
    const il_real prior = a->weight != NULL ? IL_CALIBRATED : IL_OWN;
    return prior / (prior + il_remembered(a, seen));
}

static inline il_real il_shrunk(il_real variance, il_real pull, il_real usual) {
    return variance + pull * (usual - variance);
}

/* Largest weight of a gyro: what it leaves to the others becomes less, the longer its noise is known. */
static inline il_real il_most_weight(const il_array *a, uint32_t seen) {
    const il_real enough = (il_real)IL_ESTABLISHED * (il_real)a->quiet;
    return IL_C(1.0) - (IL_C(1.0) - a->weight_cap) * il_smaller(enough / il_remembered(a, seen), IL_C(1.0));
}

/* While the array finds its biases, the sum of these is kept whatever the gains are: with the sum of b_i / g_i a bias that
 * is taken back, by gains that have become alike, would leave half of itself with the others. */
static inline int il_forming(const il_array *a, uint32_t learnt) {
    return learnt < (uint64_t)IL_FORMING * a->quiet;
}

/* robust_motion.c: what a rate means to gyros that are late or have scale factors of their own. Returns whether there is
 * anything to tell apart; then p->r_still is filled. */
int il_robust_move(const il_array *a, const il_array_axis *s, il_real rate, il_sample *p);

/* Learn both from residuals f, which sum to zero over the gyros with a gain; take the rate in. */
void il_robust_learn_motion(const il_array *a, il_array_axis *s, const il_sample *p, const il_real *f);
void il_robust_pass(const il_robust_terms *t, il_array_axis *s, il_real rate);

/* robust_well.c: whether all is well in a sample, which is then fused; and what it teaches, which returns whether a gyro may
 * have jumped by less than the gate. */
int il_robust_all_well(const il_array *a, const il_robust_terms *t, il_array_axis *s, const il_real *z,
                       const il_real *reading, il_sample *p);
int il_robust_learn_well(const il_array *a, const il_robust_terms *t, il_array_axis *s, il_sample *p);

/* robust_standing.c: who is usable (returns whether anything needs a closer look), who is trusted (returns how many),
 * what the sample does to the standing of each, and what is told of it. */
int il_robust_examine(const il_array *a, il_array_axis *s, const il_real *z, const il_real *reading, il_sample *p);
int32_t il_robust_choose_trusted(const il_array *a, il_array_axis *s, il_sample *p);
void il_robust_judge(const il_array *a, il_array_axis *s, const il_sample *p);
void il_robust_report(const il_array *a, il_array_axis *s, const il_sample *p, int32_t used);

/* A gyro has jumped; count the samples since the last time in which all was well; whether it is well from now on. */
void il_robust_jump(il_array_axis *s, int32_t i);
void il_robust_settle(const il_array *a, il_array_axis *s);
void il_robust_assess(const il_array *a, il_array_axis *s);

#endif
