/* Three axes at once, in the lanes of one vector, for processors with instructions of four numbers. */
#ifndef IL_LANES_H
#define IL_LANES_H

#include "robust.h"

/* Whether it is compiled: by default for x86-64 by gcc or clang, and then used where there is AVX2; -DIL_LANES=0 leaves it
 * out, -DIL_LANES=1 has gcc or clang make it of what instructions there are. The results are the same, bit for bit. */
#ifndef IL_LANES /* (gcc does not align vectors on the stack of Windows) */
#if defined(__x86_64__) && !defined(_WIN32) && (defined(__clang__) || (defined(__GNUC__) && __GNUC__ >= 9))
#define IL_LANES 1
#else
#define IL_LANES 0
#endif
#endif

typedef struct il_lanes il_lanes;

#if IL_LANES
enum { LANES = 4 }; /* three axes; the fourth lane does what the third does */
#define EACH_AXIS for (int32_t j = 0; j < 3; j++)
#define EACH_LANE for (int32_t j = 0; j < LANES; j++)

typedef il_real il_four __attribute__((vector_size(4 * sizeof(il_real))));
typedef uint32_t il_counts __attribute__((vector_size(16)));
#if IL_FLOAT
typedef int32_t il_verdict __attribute__((vector_size(16))); /* what a comparison of il_four gives: -1 or 0 */
#else
typedef int64_t il_verdict __attribute__((vector_size(32)));
#endif

/* State of the robust method while all is well, of least squares while no reading is missing, of feedback: the axes beside
 * each other; and one sample at work (as in robust.h). */
struct il_lanes {
    int together;          /* not 0: the state is here, and what il_array_axis has of it is out of date */
    int settled;           /* gains and pulls do not change any more */
    uint32_t wait, pause;  /* samples until another try, and how many these were the last time */
    uint32_t stay;         /* samples since it succeeded */
    uint32_t done, most;   /* samples since the counts of the axes were brought up to date, and how many there may be */
    const il_real *before; /* last sample's readings, or NULL: the state has them */
    il_four resolution;
    il_four middle, usual, change, squares, total, rate, top, outside, bent;
    il_four jumped;        /* by how much a mean of a second is beyond what shows that none has jumped */
    il_verdict well;
    il_four bias[IL_ARRAY_ROOM], variance[IL_ARRAY_ROOM], fast[IL_ARRAY_ROOM], ratio[IL_ARRAY_ROOM];
    il_four last[IL_ARRAY_ROOM], pull[IL_ARRAY_ROOM], gain[IL_ARRAY_ROOM];
    il_four r[IL_ARRAY_ROOM], trust[IL_ARRAY_ROOM], weight[IL_ARRAY_ROOM];
    il_counts seen[IL_ARRAY_ROOM];
};

/* Whether blocks of n samples are worth it; makes the lanes ready. */
int il_lanes_start(il_lanes *l, const il_array *a, size_t n);

/* Try to have the axes together, when l->wait has passed. Returns whether they are. */
int il_lanes_ready(il_lanes *l, const il_array *a, const il_array_state *state);

/* One sample of three axes that are together. Returns whether it is done; if not, they are not together any more. */
int il_lanes_step(il_lanes *l, const il_array *a, const il_robust_terms *t, il_array_state *state, const il_real *z,
                  const il_real *reading, il_real *rate, int want_health, unsigned *met);

/* Bring the state up to date. */
void il_lanes_end(il_lanes *l, const il_array *a, il_array_state *state);

/* Each axis by itself for a while, the longer the less it was worth to have them together. */
void il_lanes_part(il_lanes *l);

/* robust_lanes.c: whether all is well in three axes; have them together; one sample, flags met; bring the state up to
 * date. */
int il_robust_lanes_ready(const il_array_state *state);
void il_robust_lanes_enter(il_lanes *l, const il_array *a, const il_array_state *state);
unsigned il_robust_lanes_step(il_lanes *l, const il_array *a, const il_robust_terms *t, il_array_state *state,
                              const il_real *z, const il_real *reading, il_real *rate, int want_health);
void il_robust_lanes_leave(il_lanes *l, const il_array *a, il_array_state *state);

/* ---- four numbers at a time ------------------------------------------------------------------------------------------ */

/* What is between these two is for processors with AVX2: of all that x86-64 is, only they have instructions of four
 * doubles. Fused multiply-add, which rounds once instead of twice, is no part of it. */
#if defined(__x86_64__) && defined(__clang__)
#define LANES_BEGIN _Pragma("clang attribute push(__attribute__((target(\"avx2\"))), apply_to = function)")
#define LANES_END _Pragma("clang attribute pop")
#elif defined(__x86_64__)
#define LANES_BEGIN _Pragma("GCC push_options") _Pragma("GCC target(\"avx2\")")
#define LANES_END _Pragma("GCC pop_options")
#else
#define LANES_BEGIN
#define LANES_END
#endif
#if defined(__x86_64__)
#define LANES_SUPPORTED (__builtin_cpu_supports("avx2") != 0)
#else
#define LANES_SUPPORTED 1
#endif
#define LANES_INLINE static inline __attribute__((always_inline))

LANES_BEGIN
LANES_INLINE il_four all_lanes(il_real x) {
    const il_four out = {x, x, x, x};
    return out;
}

LANES_INLINE il_four larger_lanes(il_four a, il_four b) {
    il_four out;
    EACH_LANE out[j] = larger(a[j], b[j]);
    return out;
}

LANES_INLINE il_four smaller_lanes(il_four a, il_four b) {
    il_four out;
    EACH_LANE out[j] = smaller(a[j], b[j]);
    return out;
}

LANES_INLINE il_four size_lanes(il_four a) {
    il_four out;
    EACH_LANE out[j] = il_fabs(a[j]);
    return out;
}

/* What is chosen stays, the rest is zero. */
LANES_INLINE il_four chosen_lanes(il_verdict chosen, il_four a) {
    return (il_four)(chosen & (il_verdict)a);
}

/* il_counted */
LANES_INLINE il_counts counted_lanes(il_counts a, uint32_t b) {
    const il_counts sum = a + b;
    return sum | (il_counts)(sum < a);
}

LANES_INLINE il_four capped_lanes(il_counts a, uint32_t cap) {
    EACH_LANE a[j] = a[j] < cap ? a[j] : cap;
    return __builtin_convertvector(a, il_four);
}

/* The same gyro of three axes of n gyros. */
LANES_INLINE il_four lanes_of(const il_real *x, int32_t n) {
    const il_four out = {x[0], x[n], x[2 * n], x[2 * n]};
    return out;
}

LANES_INLINE int all_axes(il_verdict v) {
    return (v[0] & v[1] & v[2]) != 0;
}
LANES_END
#endif
#endif
