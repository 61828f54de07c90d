/* Accelerometer, gyroscope and magnetometer triads: outputs to specific force, angular rate and field. */
#include "real.h"

/* Newton's method doubles the correct digits: at MEMS size three or four steps reach the last bit of a double; twelve get
 * within a thousandth of a turning point. No more are ever made. */
enum { NEWTON_STEPS = 12, CROSS_STEPS = 30 };
static const il_real SOLVED = IL_C(64.0) * IL_EPSILON; /* last step, relative, below which a solution stands */

/* The axes step together: each step waits for a division, and a processor may have three to wait for at once. */
void il_tumble_solve(int32_t order, const il_real (*k)[3], const il_real a[3], il_real s[3], il_real slope[3]) {
    il_real step[3] = {IL_C(0.0), IL_C(0.0), IL_C(0.0)};
    int moves[3] = {order > 2, order > 2, order > 2};
    for (int i = 0; i < 3; i++) {
        s[i] = a[i];
        slope[i] = IL_C(1.0);
        if (order != 2) continue;
        const il_real square = IL_C(1.0) + IL_C(4.0) * k[0][i] * a[i];
        slope[i] = il_finite(square) && square > SOLVED ? il_sqrt(square) : il_nan(); /* less is nothing but rounding */
        s[i] = a[i] / (IL_C(0.5) + IL_C(0.5) * slope[i]); /* in which nothing cancels where k2 is small */
    }
    for (int number = 0; number < NEWTON_STEPS && (moves[0] | moves[1] | moves[2]); number++) {
        for (int i = 0; i < 3; i++) {
            if (!moves[i]) continue;
            il_real value = k[order - 2][i], tilt = IL_C(0.0);
            for (int32_t p = order - 3; p >= 0; p--) {
                tilt = tilt * s[i] + value;
                value = value * s[i] + k[p][i];
            }
            slope[i] = IL_C(1.0) + s[i] * (IL_C(2.0) * value + s[i] * tilt);
            step[i] = (s[i] * (IL_C(1.0) + s[i] * value) - a[i]) / slope[i];
            s[i] -= step[i];
            moves[i] = il_fabs(step[i]) > IL_C(4.0) * IL_EPSILON * il_fabs(s[i]); /* else the next one would move nothing */
        }
    }
    for (int i = 0; i < 3; i++) {
        const int solved = slope[i] > IL_C(0.0) && il_fabs(step[i]) <= SOLVED * (il_fabs(s[i]) + IL_C(1.0));
        if (!solved) s[i] = slope[i] = il_nan();
    }
}

/* The same for a unit, whose polynomials have limits. */
static unsigned within_range(int32_t order, const il_real (*k)[3], const il_real low[3], const il_real high[3],
                             const il_real a[3], il_real s[3]) {
    il_real slope[3];
    unsigned flags = 0;
    il_tumble_solve(order, k, a, s, slope);
    for (int i = 0; i < 3; i++) {
        if (!(a[i] >= low[i] && a[i] <= high[i])) s[i] = il_nan();
        if (s[i] != s[i]) flags |= il_finite(a[i]) ? (unsigned)IL_BEYOND : (unsigned)IL_NOT_FINITE;
    }
    return flags;
}

/* Solve the axes together where products of two enter: each by itself, with the products at the last solution taken off,
 * again and again. An error shrinks by twice the product of cross term and specific force at a step: three or four reach the
 * last bit at 1000 ug/g^2 and 1 g. What does not come to rest lies beyond what these terms are for. */
static unsigned crossed(const il_tumble *t, const il_real a[3], il_real s[3]) {
    unsigned flags = 0;
    il_real step = IL_C(0.0), size = IL_C(0.0), rest[3];
    memcpy(s, a, sizeof rest);
    for (int k = 0; k < CROSS_STEPS && flags == 0; k++) {
        const il_real last[3] = {s[0], s[1], s[2]};
        for (int i = 0; i < 3; i++) rest[i] = a[i] - t->cross[i] * last[i] * last[(i + 1) % 3];
        flags = within_range(t->order, t->nonlinearity, t->low, t->high, rest, s);
        step = size = IL_C(0.0);
        for (int i = 0; i < 3; i++) {
            step += il_fabs(s[i] - last[i]);
            size += il_fabs(s[i]);
        }
        if (step <= IL_EPSILON * size) break;
    }
    if (flags == 0 && step <= SOLVED * (size + IL_C(1.0))) return 0;
    s[0] = s[1] = s[2] = il_nan();
    return il_finite(a[0] + a[1] + a[2]) ? (unsigned)IL_BEYOND : (unsigned)IL_NOT_FINITE;
}

/* One sample; inlined, so that the block function compiles to straight code for each stride. */
static inline unsigned tumble_sample(const il_tumble *t, il_real mx, il_real my, il_real mz, il_real *fx, il_real *fy,
                                     il_real *fz) {
    il_real x = mx * t->gain[0] - t->bias[0], y = my * t->gain[1] - t->bias[1], z = mz * t->gain[2] - t->bias[2];
    unsigned flags = il_finite(x + y + z) ? 0u : (unsigned)IL_NOT_FINITE;
    if (t->has_cross || t->order > 1) {
        const il_real a[3] = {x, y, z};
        il_real s[3];
        flags |= t->has_cross ? crossed(t, a, s) : within_range(t->order, t->nonlinearity, t->low, t->high, a, s);
        x = s[0];
        y = s[1];
        z = s[2];
    }
    y = y - t->misalignment[0] * x;
    z = z - t->misalignment[1] * x - t->misalignment[2] * y;
    *fx = x;
    *fy = y;
    *fz = z;
    return flags;
}

unsigned il_tumble_apply(const il_tumble *settings, const il_real output[3], il_real force[3]) {
    return tumble_sample(settings, output[0], output[1], output[2], &force[0], &force[1], &force[2]);
}

unsigned il_tumble_block(const il_tumble *settings, size_t n, const il_real *const output[3], size_t stride,
                         il_real *const force[3], size_t force_stride) {
    const il_tumble t = *settings; /* a copy cannot alias the samples */
    const il_real *mx = output[0], *my = output[1], *mz = output[2];
    il_real *fx = force[0], *fy = force[1], *fz = force[2];
    unsigned flags = 0;
    if (stride == 1 && force_stride == 1) {
        for (size_t k = 0; k < n; k++) flags |= tumble_sample(&t, mx[k], my[k], mz[k], &fx[k], &fy[k], &fz[k]);
        return flags;
    }
    for (size_t k = 0; k < n; k++) {
        size_t i = k * stride, o = k * force_stride;
        flags |= tumble_sample(&t, mx[i], my[i], mz[i], &fx[o], &fy[o], &fz[o]);
    }
    return flags;
}

static inline unsigned gyro_sample(const il_gyro *g, il_real mx, il_real my, il_real mz, il_real ax, il_real ay,
                                   il_real az, il_real *rx, il_real *ry, il_real *rz) {
    il_real x = mx * g->gain[0] - g->bias[0], y = my * g->gain[1] - g->bias[1], z = mz * g->gain[2] - g->bias[2];
    if (g->has_sensitivity) {
        x -= g->sensitivity[0][0] * ax + g->sensitivity[0][1] * ay + g->sensitivity[0][2] * az;
        y -= g->sensitivity[1][0] * ax + g->sensitivity[1][1] * ay + g->sensitivity[1][2] * az;
        z -= g->sensitivity[2][0] * ax + g->sensitivity[2][1] * ay + g->sensitivity[2][2] * az;
    }
    unsigned flags = il_finite(x + y + z) ? 0u : (unsigned)IL_NOT_FINITE;
    if (g->order > 1) {
        const il_real a[3] = {x, y, z};
        il_real s[3];
        flags |= within_range(g->order, g->nonlinearity, g->low, g->high, a, s);
        x = s[0];
        y = s[1];
        z = s[2];
    }
    *rx = g->turn[0][0] * x + g->turn[0][1] * y + g->turn[0][2] * z;
    *ry = g->turn[1][0] * x + g->turn[1][1] * y + g->turn[1][2] * z;
    *rz = g->turn[2][0] * x + g->turn[2][1] * y + g->turn[2][2] * z;
    return flags;
}

unsigned il_gyro_apply(const il_gyro *settings, const il_real output[3], const il_real force[3], il_real rate[3]) {
    static const il_real none[3] = {IL_C(0.0), IL_C(0.0), IL_C(0.0)};
    const il_real *f = settings->has_sensitivity ? force : none;
    if (f == NULL) {
        rate[0] = rate[1] = rate[2] = il_nan();
        return IL_NOT_FINITE;
    }
    return gyro_sample(settings, output[0], output[1], output[2], f[0], f[1], f[2], &rate[0], &rate[1], &rate[2]);
}

unsigned il_gyro_block(const il_gyro *settings, size_t n, const il_real *const output[3], const il_real *const force[3],
                       size_t stride, il_real *const rate[3], size_t rate_stride) {
    unsigned flags = 0;
    for (size_t k = 0; k < n; k++) {
        size_t i = k * stride;
        const il_real m[3] = {output[0][i], output[1][i], output[2][i]};
        il_real f[3] = {IL_C(0.0), IL_C(0.0), IL_C(0.0)}, w[3];
        if (force != NULL) {
            for (int a = 0; a < 3; a++) f[a] = force[a][i];
        }
        flags |= il_gyro_apply(settings, m, force != NULL ? f : NULL, w);
        for (int a = 0; a < 3; a++) rate[a][k * rate_stride] = w[a];
    }
    return flags;
}

unsigned il_mag_apply(const il_mag *settings, const il_real output[3], il_real field[3]) {
    il_real s[3], slope[3];
    unsigned flags = 0;
    for (int i = 0; i < 3; i++) s[i] = output[i] * settings->gain[i] - settings->bias[i];
    const int finite = il_finite(s[0] + s[1] + s[2]);
    if (settings->order > 1) {
        const il_real a[3] = {s[0], s[1], s[2]};
        il_tumble_solve(2, &settings->quadratic, a, s, slope);
    }
    if (!finite) flags = IL_NOT_FINITE;
    else if (!il_finite(s[0] + s[1] + s[2])) flags = IL_BEYOND;
    for (int i = 0; i < 3; i++) {
        field[i] = settings->turn[i][0] * s[0] + settings->turn[i][1] * s[1] + settings->turn[i][2] * s[2];
    }
    return flags;
}

unsigned il_mag_block(const il_mag *settings, size_t n, const il_real *const output[3], size_t stride,
                      il_real *const field[3], size_t field_stride) {
    unsigned flags = 0;
    for (size_t k = 0; k < n; k++) {
        const il_real m[3] = {output[0][k * stride], output[1][k * stride], output[2][k * stride]};
        il_real b[3];
        flags |= il_mag_apply(settings, m, b);
        for (int a = 0; a < 3; a++) field[a][k * field_stride] = b[a];
    }
    return flags;
}
