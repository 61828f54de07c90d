/* Whole IMUs: what a set of accelerometers tells, prepared once for as long as the set stays.
 *
 * Weights p = 1/sa^2, centroid rb = sum p r / sum p, rho = r - rb, R = sum p rho rho' = V diag(l) V'. In the principal axes
 * V three virtual accelerometers at sqrt(l_i) e_i stand for all of them, and tr R I - R is diagonal: l_j + l_k.
 */
#include "imus.h"

#define NEGLIGIBLE IL_C(1e-5) /* of tr R: the board has no extent this way */

/* Eigenvectors, as columns of v, and eigenvalues of a symmetric matrix, by Jacobi's rotations. */
static void eigen(il_real m[3][3], il_real v[3][3]) {
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) v[i][j] = i == j ? IL_C(1.0) : IL_C(0.0);
    }
    for (int sweep = 0; sweep < 8; sweep++) {
        for (int a = 0; a < 2; a++) {
            for (int b = a + 1; b < 3; b++) {
                if (m[a][b] == IL_C(0.0)) continue;
                const il_real half = (m[b][b] - m[a][a]) / (IL_C(2.0) * m[a][b]);
                const il_real size = il_fabs(half) + il_sqrt(half * half + IL_C(1.0));
                const il_real t = (half < IL_C(0.0) ? IL_C(-1.0) : IL_C(1.0)) / size;
                const il_real c = IL_C(1.0) / il_sqrt(t * t + IL_C(1.0)), s = t * c;
                for (int k = 0; k < 3; k++) {
                    const il_real x = m[k][a], y = m[k][b];
                    m[k][a] = c * x - s * y;
                    m[k][b] = s * x + c * y;
                }
                for (int k = 0; k < 3; k++) {
                    const il_real x = m[a][k], y = m[b][k], vx = v[k][a], vy = v[k][b];
                    m[a][k] = c * x - s * y;
                    m[b][k] = s * x + c * y;
                    v[k][a] = c * vx - s * vy;
                    v[k][b] = s * vx + c * vy;
                }
            }
        }
    }
}

int il_imus_invert(const il_real m[3][3], il_real out[3][3]) {
    il_real l[3][3] = {{IL_C(0.0)}}, k[3][3] = {{IL_C(0.0)}};
    for (int j = 0; j < 3; j++) {
        il_real square = m[j][j];
        for (int i = 0; i < j; i++) square -= l[j][i] * l[j][i];
        if (!(square > m[j][j] * IL_EPSILON)) return 0;
        l[j][j] = il_sqrt(square);
        for (int i = j + 1; i < 3; i++) {
            il_real sum = m[i][j];
            for (int n = 0; n < j; n++) sum -= l[i][n] * l[j][n];
            l[i][j] = sum / l[j][j];
        }
    }
    for (int j = 0; j < 3; j++) {
        k[j][j] = IL_C(1.0) / l[j][j];
        for (int i = j + 1; i < 3; i++) {
            il_real sum = IL_C(0.0);
            for (int n = j; n < i; n++) sum -= l[i][n] * k[n][j];
            k[i][j] = sum / l[i][i];
        }
    }
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) out[i][j] = k[0][i] * k[0][j] + k[1][i] * k[1][j] + k[2][i] * k[2][j];
    }
    return 1;
}

/* Inverse covariance of how far each triad lies from what the set says: of one in the set its own noise less what the set
 * owes to it, of another the sum of both. `free` says whether the angular acceleration is fitted, or known. */
static void leverages(const il_imus *a, il_imus_state *s, const uint8_t *used, int is_fitted) {
    for (int32_t k = 0; k < a->count; k++) {
        const il_real sign = used[k] ? IL_C(-1.0) : IL_C(1.0), own = a->accel_noise[k] * a->accel_noise[k];
        il_real rho[3], at[3], c[3][3];
        for (int i = 0; i < 3; i++) rho[i] = a->position[3 * k + i] - s->centroid[i];
        il_transposed_times((const il_real(*)[3])s->axes, rho, at);
        /* [at]x diag(inertia) [at]x', turned back */
        const il_real cross[3][3] = {{IL_C(0.0), -at[2], at[1]}, {at[2], IL_C(0.0), -at[0]}, {-at[1], at[0], IL_C(0.0)}};
        il_real turned[3][3];
        for (int i = 0; i < 3; i++) {
            for (int j = 0; j < 3; j++) {
                turned[i][j] = IL_C(0.0);
                for (int n = 0; n < 3; n++) turned[i][j] += s->axes[i][n] * cross[n][j];
            }
        }
        for (int i = 0; i < 3; i++) {
            for (int j = 0; j < 3; j++) {
                il_real owed = i == j ? IL_C(1.0) / s->weight : IL_C(0.0);
                for (int n = 0; is_fitted && n < 3; n++) owed += turned[i][n] * s->inertia[n] * turned[j][n];
                c[i][j] = (i == j ? own : IL_C(0.0)) + sign * owed;
            }
        }
        if (!il_imus_invert((const il_real(*)[3])c, s->leverage[k])) memset(s->leverage[k], 0, sizeof s->leverage[k]);
    }
}

void il_imus_prepare(const il_imus *a, il_imus_state *s, const uint8_t *used) {
    il_real m[3][3] = {{IL_C(0.0)}}, trace;
    memset(s->centroid, 0, sizeof s->centroid);
    memcpy(s->used, used, sizeof s->used);
    s->weight = IL_C(0.0);
    s->members = 0;
    for (int32_t k = 0; k < a->count; k++) {
        if (!used[k]) continue;
        const il_real p = s->share[0][k];
        s->members++;
        s->weight += p;
        for (int i = 0; i < 3; i++) s->centroid[i] += p * a->position[3 * k + i];
    }
    for (int i = 0; s->members > 0 && i < 3; i++) s->centroid[i] /= s->weight;
    for (int32_t k = 0; k < a->count; k++) {
        if (!used[k]) continue;
        const il_real p = s->share[0][k];
        il_real rho[3];
        for (int i = 0; i < 3; i++) rho[i] = a->position[3 * k + i] - s->centroid[i];
        for (int i = 0; i < 3; i++) {
            for (int j = 0; j < 3; j++) m[i][j] += p * rho[i] * rho[j];
        }
    }
    eigen(m, s->axes);
    trace = m[0][0] + m[1][1] + m[2][2];
    s->unknown = 0;
    for (int i = 0; i < 3; i++) s->root[i] = m[i][i] > NEGLIGIBLE * trace ? il_sqrt(m[i][i]) : IL_C(0.0);
    for (int i = 0; i < 3; i++) {
        const il_real j = s->root[(i + 1) % 3], k = s->root[(i + 2) % 3], sum = j * j + k * k;
        s->inertia[i] = sum > IL_C(0.0) ? IL_C(1.0) / sum : IL_C(0.0);
        if (!(sum > IL_C(0.0))) s->unknown |= (uint32_t)1 << i;
    }
    /* Of fewer than four, who is right shows only with an angular acceleration from elsewhere: the gyroscopes. */
    s->by_gyroscopes = s->unknown != 0 || s->members < 4;
    if (s->members > 0) leverages(a, s, used, !s->by_gyroscopes);
}

void il_imus_to_axes(const il_imus_state *s, const il_imus_sample *p, il_real b[3][3]) {
    il_real half[3][3];
    for (int i = 0; i < 3; i++) il_transposed_times((const il_real(*)[3])s->axes, p->slope[i], half[i]);
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++) {
            b[i][j] = s->axes[0][i] * half[0][j] + s->axes[1][i] * half[1][j] + s->axes[2][i] * half[2][j];
        }
    }
}
