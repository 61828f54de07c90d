/* Gyro array, the robust method: what a gyro's residual has of the motion, which is no bias.
 *
 * A gyro that is late by d, or whose scale factor differs by c from the array's, leaves it by -d w' + c w. From rest that
 * averages away; an array that starts in motion takes the first of it for a bias. So once a lateness of 10 ms or a
 * scale error of 1 % would show beyond MOST sigma, residuals are explained by u = (w - w smoothed over 10 ms, w/100) as
 * well: e_i = b_i + late_i u_1 + scale_i u_2, least squares recursively with the memory of the biases,
 *   (b, late, scale)_i += g_i A^-1 (1, u) [e_i - late_i u_1 - scale_i u_2],
 * A the mean of (1, u)(1, u)' so far, with a ridge against motion that tells nothing. Fused is what it was, reading less
 * bias: which of the gyros are late, and which early, the array cannot know.
 */
#include "robust.h"

#define LEAST IL_C(10.0) /* standard deviations by which a lateness of 10 ms or a scale error of 1 % must show */
#define SHARE IL_C(0.01)
#define MOST_LATE IL_C(2.0)  /* 20 ms, and */
#define MOST_SCALE IL_C(5.0) /* 5 %: beyond, it is a fault */

enum { KNOWN = IL_SETTLING, MOVED }; /* rates so far, until the noise is known; motion was found */

int il_robust_move(const il_array *a, const il_array_axis *s, il_real rate, il_sample *p) {
    il_real turn = s->motion ? rate - s->slow : IL_C(0.0), share = SHARE * rate;
    const il_real least = s->motion == MOVED ? IL_MOST : LEAST;
    if (s->motion >= KNOWN && turn * turn + share * share > least * least * p->noise) {
        p->motion[0] = turn;
        p->motion[1] = share;
    } else {
        p->motion[0] = p->motion[1] = IL_C(0.0);
        if (s->motion != MOVED) return 0;
    }
    for (int32_t i = 0; i < a->elements + a->elements % 2; i++) {
        p->r_still[i] = p->r[i] - (s->late[i] * p->motion[0] + s->scale[i] * p->motion[1]);
    }
    return 1;
}

static il_real within(il_real x, il_real limit) {
    return il_smaller(il_larger(x, -limit), limit);
}

/* What is known of the motion tells nothing more. */
static void rest(il_array_axis *s) {
    memset(s->motion_mean, 0, sizeof s->motion_mean);
    memset(s->motion_square, 0, sizeof s->motion_square);
    s->motion = KNOWN;
}

void il_robust_learn_motion(const il_array *a, il_array_axis *s, const il_sample *p, const il_real *f) {
    il_real gain = IL_C(1.0), *mean = s->motion_mean, *square = s->motion_square, away[2];
    for (int32_t i = 0; i < a->elements; i++) {
        if (p->gain[i] > IL_C(0.0)) gain = il_smaller(gain, p->gain[i]);
    }
    for (int32_t j = 0; j < 2; j++) {
        away[j] = p->motion[j] - mean[j];
        mean[j] += gain * away[j];
    }
    square[0] = (IL_C(1.0) - gain) * (square[0] + gain * away[0] * away[0]);
    square[1] = (IL_C(1.0) - gain) * (square[1] + gain * away[1] * away[1]);
    square[2] = (IL_C(1.0) - gain) * (square[2] + gain * away[0] * away[1]);
    const il_real ridge = il_larger(p->noise, IL_ROUNDING * (square[0] + square[1]));
    const il_real first = square[0] + ridge, second = square[1] + ridge;
    /* the determinant, which rounding may make less than it can be */
    const il_real det = il_larger(first * second - square[2] * square[2], ridge * (square[0] + second));
    const il_real scale = (IL_C(1.0) - gain) / det;
    const il_real late = scale * (second * away[0] - square[2] * away[1]);
    const il_real share = scale * (first * away[1] - square[2] * away[0]);
    const il_real own = late * mean[0] + share * mean[1];
    if (!il_finite(own)) { /* rates whose squares are beyond all numbers */
        rest(s);
        return;
    }
    for (int32_t i = 0; i < a->elements; i++) {
        const il_real step = p->gain[i] * f[i];
        s->bias[i] -= own * step;
        s->late[i] = within(s->late[i] + late * step, MOST_LATE);
        s->scale[i] = within(s->scale[i] + share * step, MOST_SCALE);
    }
    s->motion = MOVED;
    if (square[0] + square[1] <= p->noise && p->motion[1] == IL_C(0.0)) rest(s); /* it has been still for long */
}

void il_robust_pass(const il_robust_terms *t, il_array_axis *s, il_real rate) {
    s->slow = s->motion ? s->slow + t->quick * (rate - s->slow) : rate;
    if (s->motion < KNOWN) s->motion++;
}
