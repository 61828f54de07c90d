/* Whole IMUs on one rigid board: readings of K accelerometer and gyroscope triads to one specific force, rate and angular
 * acceleration, maximum likelihood for white noise.
 *
 *   u_k = Ta_k^-1 (y - ba) = s + (W^2 + [al]x) (r_k - rb) + noise,   g_k = Tg_k^-1 (z - bg) = w + noise
 *
 * The mean s = sum p u / sum p and the 3x3 sum of p u rho' hold all that the accelerometers tell. In the principal axes of
 * R = sum p rho rho' its columns are three virtual accelerometers; Gauss-Newton on w with al eliminated:
 *   E_i = Y_i - W^2 L_i - al x L_i,  H_i = d(W^2 L_i)/dw = (w.L_i) I + w L_i' - 2 L_i w',  C = sum [L_i]x H_i
 *   N = sum H'H - C' (tr R I - R)^-1 C + Q,   w += N^-1 (sum H'E + Q (gb - w)),   al -= (tr R I - R)^-1 C dw
 * Source: Skog, Nilsson, Haendel, Nehorai, IEEE Trans. Signal Process. 64(16) 4218 (2016).
 */
#include "imus.h"

#define OFF_AXIS IL_C(1e-3)  /* cosine: less of an axis about which nothing is known is nothing */
#define OFF_LINE IL_C(1e-6)  /* m: the same for the lever arm of such an angular acceleration */
enum { IN_RANGE = 1, BRIDGING = 4 }; /* iterations */

/* The estimate in the principal axes. */
typedef struct {
    il_real w[3], al[3];
    il_real covariance[3][3]; /* of w */
    il_real follow[3][3];     /* al changes by -follow dw */
    int fine;
} solution;

il_status il_imus_check(const il_imus *a) {
    const il_real *needed[] = {a->position, a->accel, a->accel_bias, a->accel_noise, a->accel_limit,
                               a->gyro, a->gyro_bias, a->gyro_noise, a->gyro_limit, a->gyro_rows};
    if (a->count < 2 || a->count > IL_IMUS || a->stuck < 2 || a->quiet < 1 || !(a->gate > IL_C(0.0))) return IL_ARGUMENT;
    for (size_t i = 0; i < sizeof needed / sizeof *needed; i++) {
        if (needed[i] == NULL) return IL_ARGUMENT;
    }
    for (int32_t k = 0; k < a->count; k++) {
        if (!(a->accel_noise[k] > IL_C(0.0) && a->gyro_noise[k] > IL_C(0.0))) return IL_ARGUMENT;
        if (!(a->accel_limit[k] > IL_C(0.0) && a->gyro_limit[k] > IL_C(0.0))) return IL_ARGUMENT;
    }
    return IL_OK;
}

il_status il_imus_start(const il_imus *settings, il_imus_state *state) {
    uint8_t used[IL_IMUS] = {0};
    memset(state, 0, sizeof *state);
    if (il_imus_check(settings) != IL_OK) return IL_ARGUMENT;
    for (int32_t k = 0; k < settings->count; k++) {
        used[k] = 1;
        state->share[0][k] = IL_C(1.0) / (settings->accel_noise[k] * settings->accel_noise[k]);
        state->share[1][k] = IL_C(1.0) / (settings->gyro_noise[k] * settings->gyro_noise[k]);
    }
    il_imus_prepare(settings, state, used);
    return IL_OK;
}

/* Information of the gyroscopes about the rate, and its product with what they read; of rows within their range only. */
static void rows_within(const il_imus *a, const il_imus_state *s, const il_imus_sample *p, il_real q[3][3], il_real h[3]) {
    memset(q, 0, 9 * sizeof(il_real));
    for (int i = 0; i < 3; i++) h[i] = IL_C(0.0);
    for (int32_t k = 0; k < a->count; k++) {
        if (!p->usable[1][k]) continue;
        const il_real share = s->share[1][k];
        for (int row = 0; row < 3; row++) {
            if (p->clipped[k][row]) continue;
            il_real t[3];
            const il_real *of_body = a->gyro_rows + 9 * k + 3 * row, z = il_dot(of_body, p->g[k]);
            il_transposed_times((const il_real(*)[3])s->axes, of_body, t);
            for (int i = 0; i < 3; i++) {
                h[i] += share * t[i] * z;
                for (int j = 0; j < 3; j++) q[i][j] += share * t[i] * t[j];
            }
        }
    }
}

/* One step of Gauss-Newton. Returns 0 where nothing tells the rate about some axis. */
static int iterate(const il_imus_state *s, const il_real b[3][3], const il_real q[3][3], const il_real h[3], solution *x) {
    il_real e[3][3], big_h[3][3][3], c[3][3] = {{IL_C(0.0)}}, n[3][3], g[3], dw[3];
    const il_real *w = x->w, square = il_dot(w, w);
    for (int i = 0; i < 3; i++) x->al[i] = IL_C(0.0);
    for (int i = 0; i < 3; i++) {
        const int j = (i + 1) % 3, k = (i + 2) % 3;
        const il_real root = s->root[i], inverse = root > IL_C(0.0) ? IL_C(1.0) / root : IL_C(0.0);
        for (int m = 0; m < 3; m++) {
            e[i][m] = b[m][i] * inverse - root * w[m] * w[i];
            for (int t = 0; t < 3; t++) {
                big_h[i][m][t] = root * ((m == t ? w[i] : IL_C(0.0)) + (t == i ? w[m] : IL_C(0.0))
                                         - (m == i ? IL_C(2.0) * w[t] : IL_C(0.0)));
            }
        }
        e[i][i] += root * square;
        x->al[j] -= root * e[i][k];
        x->al[k] += root * e[i][j];
        for (int t = 0; t < 3; t++) {
            c[j][t] -= root * big_h[i][k][t];
            c[k][t] += root * big_h[i][j][t];
        }
    }
    for (int i = 0; i < 3; i++) x->al[i] *= s->inertia[i];
    for (int i = 0; i < 3; i++) { /* E_i -= al x e_i root_i */
        const int j = (i + 1) % 3, k = (i + 2) % 3;
        e[i][j] -= s->root[i] * x->al[k];
        e[i][k] += s->root[i] * x->al[j];
    }
    for (int t = 0; t < 3; t++) {
        g[t] = h[t] - il_dot(q[t], w);
        for (int i = 0; i < 3; i++) {
            for (int m = 0; m < 3; m++) g[t] += big_h[i][m][t] * e[i][m];
            x->follow[i][t] = s->inertia[i] * c[i][t];
        }
        for (int v = 0; v < 3; v++) {
            n[t][v] = q[t][v];
            for (int i = 0; i < 3; i++) {
                n[t][v] -= c[i][t] * s->inertia[i] * c[i][v];
                for (int m = 0; m < 3; m++) n[t][v] += big_h[i][m][t] * big_h[i][m][v];
            }
        }
    }
    if (!il_imus_invert((const il_real(*)[3])n, x->covariance)) return 0;
    il_times((const il_real(*)[3])x->covariance, g, dw);
    for (int i = 0; i < 3; i++) x->w[i] += dw[i];
    for (int i = 0; i < 3; i++) x->al[i] -= il_dot(x->follow[i], dw);
    return 1;
}

static void solve(const il_imus *a, const il_imus_state *s, const il_imus_sample *p, solution *x) {
    il_real b[3][3], q[3][3] = {{IL_C(0.0)}}, h[3];
    const int bridged = (p->flags & IL_BEYOND) != 0;
    il_imus_to_axes(s, p, b);
    il_transposed_times((const il_real(*)[3])s->axes, p->rate, x->w);
    if (bridged) {
        rows_within(a, s, p, q, h);
    } else {
        for (int i = 0; i < 3; i++) {
            q[i][i] = p->information;
            h[i] = p->information * x->w[i];
        }
    }
    x->fine = 1;
    for (int k = 0; x->fine && k < (bridged ? BRIDGING : IN_RANGE); k++) {
        x->fine = iterate(s, (const il_real(*)[3])b, (const il_real(*)[3])q, h, x);
    }
}

/* Square roots of the diagonal of V (J N^-1 J' + D) V'. */
static void deviations(const il_imus_state *s, const solution *x, const il_real j[3][3], const il_real d[3][3],
                       il_real out[3]) {
    il_real half[3][3], whole[3][3];
    for (int r = 0; r < 3; r++) il_times((const il_real(*)[3])x->covariance, j[r], half[r]);
    for (int r = 0; r < 3; r++) {
        for (int c = 0; c < 3; c++) whole[r][c] = d[r][c] + il_dot(half[r], j[c]);
    }
    for (int i = 0; i < 3; i++) {
        il_real sum = IL_C(0.0);
        for (int r = 0; r < 3; r++) sum += s->axes[i][r] * il_dot(whole[r], s->axes[i]);
        out[i] = il_sqrt(sum);
    }
}

/* The force at the output point, and how sure all are. */
static void express(const il_imus *a, const il_imus_state *s, const il_imus_sample *p, const solution *x,
                    const il_real inertia[3], il_imus_fused *out) {
    il_real away[3], d[3], lever[3], j[3][3], noise[3][3] = {{IL_C(0.0)}}, one[3][3] = {{IL_C(0.0)}};
    const il_real *w = x->w;
    for (int i = 0; i < 3; i++) away[i] = a->at[i] - s->centroid[i];
    il_transposed_times((const il_real(*)[3])s->axes, away, d);
    il_times((const il_real(*)[3])s->axes, x->w, out->rate);
    il_times((const il_real(*)[3])s->axes, x->al, out->acceleration);
    il_lever(out->rate, out->acceleration, away, lever);
    for (int i = 0; i < 3; i++) out->force[i] = p->force[i] + lever[i];

    for (int i = 0; i < 3; i++) one[i][i] = IL_C(1.0);
    deviations(s, x, (const il_real(*)[3])one, (const il_real(*)[3])noise, out->rate_std);
    for (int i = 0; i < 3; i++) noise[i][i] = inertia[i];
    deviations(s, x, (const il_real(*)[3])x->follow, (const il_real(*)[3])noise, out->acceleration_std);
    const il_real cross[3][3] = {{IL_C(0.0), -d[2], d[1]}, {d[2], IL_C(0.0), -d[0]}, {-d[1], d[0], IL_C(0.0)}};
    for (int r = 0; r < 3; r++) {
        for (int c = 0; c < 3; c++) {
            noise[r][c] = r == c ? IL_C(1.0) / s->weight : IL_C(0.0);
            j[r][c] = w[r] * d[c] - IL_C(2.0) * d[r] * w[c] + (r == c ? il_dot(w, d) : IL_C(0.0));
            for (int k = 0; k < 3; k++) {
                noise[r][c] += cross[r][k] * inertia[k] * cross[c][k];
                j[r][c] += cross[r][k] * x->follow[k][c];
            }
        }
    }
    deviations(s, x, (const il_real(*)[3])j, (const il_real(*)[3])noise, out->force_std);
    for (int i = 0; i < 3; i++) {
        if (!(s->unknown & (uint32_t)1 << i) || inertia[i] > IL_C(0.0)) continue;
        const il_real axis[3] = {s->axes[0][i], s->axes[1][i], s->axes[2][i]};
        il_cross(axis, away, lever);
        for (int k = 0; k < 3; k++) {
            if (il_fabs(axis[k]) > OFF_AXIS) out->acceleration[k] = out->acceleration_std[k] = il_nan();
            if (il_fabs(lever[k]) > OFF_LINE) out->force[k] = out->force_std[k] = il_nan();
        }
    }
}

static void nothing(il_real *numbers) {
    for (int i = 0; i < 3; i++) numbers[i] = il_nan();
}

unsigned il_imus_step(const il_imus *a, il_imus_state *s, il_real step, const il_real *reading, il_imus_fused *out) {
    il_imus_sample p;
    solution x;
    p.flags = 0;
    s->step = il_finite(step) ? step : IL_C(0.0);
    il_imus_examine(a, s, reading, &p);
    il_imus_choose_gyroscopes(a, s, &p);
    il_imus_choose_accelerometers(a, s, &p);
    x.fine = 0;
    if (s->members > 0 && p.information > IL_C(0.0)) solve(a, s, &p, &x);
    if (x.fine) {
        il_real inertia[3], turning[3];
        il_transposed_times((const il_real(*)[3])s->axes, p.turning, turning);
        for (int i = 0; i < 3; i++) {
            inertia[i] = s->inertia[i];
            /* About the line of those that are left, where the board had more: by the gyroscopes. */
            if (!(s->unknown & (uint32_t)1 << i) || s->members == a->count || !p.turning_known) continue;
            x.al[i] = turning[i];
            inertia[i] = p.turning_variance;
        }
        express(a, s, &p, &x, inertia, out);
    } else {
        nothing(out->force);
        nothing(out->rate);
        nothing(out->acceleration);
        nothing(out->force_std);
        nothing(out->rate_std);
        nothing(out->acceleration_std);
        p.flags |= IL_NOT_FINITE;
    }
    if (s->members < 3) p.flags |= IL_ALONE;
    for (int sensor = 0; sensor < 2; sensor++) {
        for (int32_t k = 0; k < a->count; k++) p.flags |= s->flags[sensor][k] & (unsigned)~IL_BEYOND;
    }
    return p.flags;
}

unsigned il_imus_block(const il_imus *settings, il_imus_state *state, size_t n, const il_real *step, const il_real *reading,
                       il_imus_fused *fused, uint8_t *flags, uint8_t *health) {
    const size_t width = 6 * (size_t)settings->count, triads = 2 * (size_t)settings->count;
    unsigned all = 0;
    for (size_t k = 0; k < n; k++) {
        const unsigned met = il_imus_step(settings, state, step[k], reading + k * width, fused + k);
        all |= met;
        if (flags != NULL) flags[k] = (uint8_t)met;
        for (size_t sensor = 0; health != NULL && sensor < 2; sensor++) {
            memcpy(health + k * triads + sensor * triads / 2, state->flags[sensor], triads / 2);
        }
    }
    return all;
}
