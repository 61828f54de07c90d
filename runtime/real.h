/* What depends on the width of il_real; included by the sources of the runtime only. */
#ifndef IL_REAL_H
#define IL_REAL_H

#include <math.h>
#include <string.h>

#include "imulab.h"

#if (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__) || defined(_M_FP_FAST)
#error "imulab must recognise what is not a number: compile it without -ffast-math (-Ofast, /fp:fast)"
#endif

#define IL_IS_float 1
#define IL_IS_double 0
#define IL_PASTE(a, b) a##b
#define IL_IS(type) IL_PASTE(IL_IS_, type)

#if IL_IS(IMULAB_REAL)
#define IL_FLOAT 1
#define IL_C(x) x##f
#define il_sqrt sqrtf
#define il_exp expf
#define il_log1p log1pf
#define il_fabs fabsf
#define IL_TINY 1e-30f        /* floor of a variance */
#define IL_EPSILON 1.2e-7f    /* spacing of numbers near 1 */
#else
#define IL_FLOAT 0
#define IL_C(x) x
#define il_sqrt sqrt
#define il_exp exp
#define il_log1p log1p
#define il_fabs fabs
#define IL_TINY 1e-300
#define IL_EPSILON 2.2e-16
#endif

/* False for infinities and for what is not a number; without library calls, so that loops stay branch-free. */
static inline int il_finite(il_real x) {
    return x - x == IL_C(0.0);
}

/* A hint, where there are caches: these addresses will be read, and written. */
static inline void il_prefetch(const il_real *read, const il_real *written) {
#if defined(__GNUC__) && (defined(__x86_64__) || defined(__aarch64__))
    __builtin_prefetch(read, 0);
    __builtin_prefetch(written, 1);
#else
    (void)read;
    (void)written;
#endif
}

static inline il_real il_nan(void) {
    return (il_real)NAN;
}

#endif
