/* What the files of whole IMUs share. imus.c calls the others, which do not call back: imus_standing.c (who is used) and,
 * below both, imus_geometry.c (what a set of accelerometers tells). */
#ifndef IL_IMUS_H
#define IL_IMUS_H

#include "real.h"

/* One sample at work. */
typedef struct {
    il_real u[IL_IMUS][3], g[IL_IMUS][3]; /* readings in the body frame, m/s^2 and rad/s */
    uint8_t usable[2][IL_IMUS];           /* accelerometers, gyroscopes: numbers within their range, not stuck */
    uint8_t clipped[IL_IMUS][3];          /* rows of gyroscopes at the end of their range, or without a number */
    il_real force[3];                     /* weighted mean of u: the specific force at the centroid */
    il_real slope[3][3];                  /* sum p u rho' */
    il_real rate[3];                      /* weighted mean of g */
    il_real information;                  /* sum q of the gyroscopes used */
    il_real turning[3];                   /* angular acceleration by the gyroscopes, rad/s^2, */
    il_real turning_variance;             /* by their noise, and half a sample late; (rad/s^2)^2 */
    int turning_known, turning_trusted;   /* from two samples, and from three, which show how late it is */
    unsigned flags;
} il_imus_sample;

/* imus_geometry.c: prepare the centroid, the principal axes and the leverages of the accelerometers `used`. */
void il_imus_prepare(const il_imus *settings, il_imus_state *state, const uint8_t *used);

/* The sum of p u rho' in the principal axes. */
void il_imus_to_axes(const il_imus_state *state, const il_imus_sample *p, il_real b[3][3]);

/* The inverse of a symmetric matrix, 0 where it is not positive definite. */
int il_imus_invert(const il_real m[3][3], il_real out[3][3]);

/* imus_standing.c: find what is stuck or no number; then leave out what contradicts the others, gyroscopes before
 * accelerometers. */
void il_imus_examine(const il_imus *settings, il_imus_state *state, const il_real *reading, il_imus_sample *p);
void il_imus_choose_gyroscopes(const il_imus *settings, il_imus_state *state, il_imus_sample *p);
void il_imus_choose_accelerometers(const il_imus *settings, il_imus_state *state, il_imus_sample *p);

/* out = a x b; out = M x; out = M' x */
static inline void il_cross(const il_real a[3], const il_real b[3], il_real out[3]) {
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

static inline void il_times(const il_real m[3][3], const il_real x[3], il_real out[3]) {
    for (int i = 0; i < 3; i++) out[i] = m[i][0] * x[0] + m[i][1] * x[1] + m[i][2] * x[2];
}

static inline void il_transposed_times(const il_real m[3][3], const il_real x[3], il_real out[3]) {
    for (int i = 0; i < 3; i++) out[i] = m[0][i] * x[0] + m[1][i] * x[1] + m[2][i] * x[2];
}

static inline il_real il_dot(const il_real a[3], const il_real b[3]) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/* (W^2 + [al]x) r */
static inline void il_lever(const il_real w[3], const il_real al[3], const il_real r[3], il_real out[3]) {
    const il_real along = il_dot(w, r), square = il_dot(w, w);
    il_cross(al, r, out);
    for (int i = 0; i < 3; i++) out[i] += w[i] * along - square * r[i];
}

#endif
