/* Whole IMUs: which triads are used in a sample.
 *
 * A triad is left out while it is no number, at the end of its range (an accelerometer), stuck, or further from the others
 * than chi-square with three degrees of freedom allows. The others show how noisy the sample is: c > gate max(1, rest), with
 * rest the chi-square per degree of freedom without the triad, c its own. Accelerometers are judged with the rate of the
 * gyroscopes, so not while these are beyond their range. Each bad sample is made good by several good ones.
 */
#include "imus.h"

enum { ACCELEROMETER = 0, GYROSCOPE = 1 };
enum { OWES = 4 };           /* good samples for a bad one */
enum { CHANGES = 20 };       /* changes that a stuck triad would have shown */
enum { HALVED = 1 << 20 };   /* samples after which counts are halved */
#define OLD IL_C(1.5e-3)     /* s: chips with clocks of their own are read up to so far apart, which is no fault */
enum { FEWEST = 3 };         /* triads of which one can be found wrong */

/* Whether a triad's readings repeat for longer than they usually do. */
static void count_repeats(il_imus_state *s, int sensor, int32_t k, const il_real y[3], il_real last[3]) {
    const int same = s->compared[sensor][k] > 0 && y[0] == last[0] && y[1] == last[1] && y[2] == last[2];
    if (same) {
        if (s->repeats[sensor][k] < UINT32_MAX) s->repeats[sensor][k]++;
    } else {
        s->repeats[sensor][k] = 0;
        s->changed[sensor][k] += s->compared[sensor][k] > 0;
    }
    if (++s->compared[sensor][k] >= HALVED) {
        s->compared[sensor][k] /= 2;
        s->changed[sensor][k] /= 2;
    }
    memcpy(last, y, 3 * sizeof *y);
}

/* Share of a triad's readings that differed from the one before, until the present run of equal ones. */
static il_real changing_share(const il_imus_state *s, int sensor, int32_t k) {
    const uint32_t compared = s->compared[sensor][k], run = s->repeats[sensor][k] + 1;
    return (il_real)s->changed[sensor][k] / (il_real)(compared > run ? compared - run : 1);
}

/* A triad is stuck when its readings repeat longer than they usually do while another of its kind is alive. One that has
 * never changed is judged by the others. */
static void find_stuck_triads(const il_imus *a, il_imus_state *s, int sensor, il_imus_sample *p) {
    il_real usual = IL_C(0.0);
    int32_t alive = 0, suspects = 0;
    for (int32_t k = 0; k < a->count; k++) {
        const int suspect = s->repeats[sensor][k] >= a->stuck;
        suspects += p->usable[sensor][k] && suspect;
        alive += p->usable[sensor][k] && !suspect;
    }
    if (suspects == 0 || alive == 0) return;
    for (int32_t k = 0; k < a->count; k++) {
        if (p->usable[sensor][k] && s->repeats[sensor][k] < a->stuck) usual += changing_share(s, sensor, k);
    }
    for (int32_t k = 0; k < a->count; k++) {
        if (!p->usable[sensor][k] || s->repeats[sensor][k] < a->stuck) continue;
        const il_real share = s->changed[sensor][k] > 0 ? changing_share(s, sensor, k) : usual / (il_real)alive;
        if (!((il_real)s->repeats[sensor][k] * share >= (il_real)CHANGES)) continue;
        s->flags[sensor][k] |= IL_STUCK;
        p->usable[sensor][k] = 0;
        s->owed[sensor][k] = a->quiet;
    }
}

void il_imus_examine(const il_imus *a, il_imus_state *s, const il_real *reading, il_imus_sample *p) {
    for (int sensor = 0; sensor < 2; sensor++) {
        const il_real *matrix = sensor == ACCELEROMETER ? a->accel : a->gyro;
        const il_real *bias = sensor == ACCELEROMETER ? a->accel_bias : a->gyro_bias;
        const il_real *limit = sensor == ACCELEROMETER ? a->accel_limit : a->gyro_limit;
        for (int32_t k = 0; k < a->count; k++) {
            const il_real *y = reading + 3 * (sensor * a->count + k), *m = matrix + 9 * k;
            il_real *out = sensor == ACCELEROMETER ? p->u[k] : p->g[k], z[3];
            int at_limit = 0;
            s->flags[sensor][k] = 0;
            p->usable[sensor][k] = (uint8_t)(il_finite(y[0]) && il_finite(y[1]) && il_finite(y[2]));
            if (!p->usable[sensor][k]) {
                s->flags[sensor][k] = IL_NOT_FINITE;
                continue;
            }
            count_repeats(s, sensor, k, y, s->last + 3 * (sensor * a->count + k));
            for (int i = 0; i < 3; i++) {
                const int beyond = il_fabs(y[i]) >= limit[k];
                if (sensor == GYROSCOPE) p->clipped[k][i] = (uint8_t)beyond;
                at_limit |= beyond;
                z[i] = y[i] - bias[3 * k + i];
            }
            if (at_limit) s->flags[sensor][k] |= IL_BEYOND;
            if (at_limit && sensor == ACCELEROMETER) p->usable[sensor][k] = 0;
            for (int i = 0; i < 3; i++) out[i] = m[3 * i] * z[0] + m[3 * i + 1] * z[1] + m[3 * i + 2] * z[2];
        }
        find_stuck_triads(a, s, sensor, p);
    }
}

static void blame(const il_imus *a, il_imus_state *s, int sensor, int32_t k) {
    const uint32_t more = s->owed[sensor][k] + OWES;
    s->owed[sensor][k] = more < a->quiet ? more : a->quiet;
    s->flags[sensor][k] |= IL_GATED;
}

/* Who is usable and owes nothing; if that is nobody, who is usable. Returns how many. */
static int32_t candidates(const il_imus *a, const il_imus_state *s, int sensor, const il_imus_sample *p, uint8_t *used) {
    int32_t count = 0;
    memset(used, 0, IL_IMUS);
    for (int waived = 0; waived < 2 && count == 0; waived++) {
        for (int32_t k = 0; k < a->count; k++) {
            used[k] = (uint8_t)(p->usable[sensor][k] && (waived || s->owed[sensor][k] == 0));
            count += used[k];
        }
    }
    return count;
}

static void report(const il_imus *a, il_imus_state *s, int sensor, const il_imus_sample *p, const uint8_t *used) {
    for (int32_t k = 0; k < a->count; k++) {
        if (!used[k]) s->flags[sensor][k] |= IL_EXCLUDED;
        if (p->usable[sensor][k] && s->owed[sensor][k] > 0) s->flags[sensor][k] |= IL_QUIET;
    }
}

/* Weighted mean of the chosen gyroscopes' rates; returns the sum of their weights. */
static il_real mean_rate(const il_imus *a, const il_imus_state *s, const uint8_t *chosen, const il_imus_sample *p,
                         il_real mean[3]) {
    il_real total = IL_C(0.0);
    for (int i = 0; i < 3; i++) mean[i] = IL_C(0.0);
    for (int32_t k = 0; k < a->count; k++) {
        if (!chosen[k]) continue;
        const il_real q = s->share[GYROSCOPE][k];
        total += q;
        for (int i = 0; i < 3; i++) mean[i] += q * p->g[k][i];
    }
    for (int i = 0; i < 3; i++) mean[i] /= total;
    return total;
}

static il_real squared_distance(const il_real a[3], const il_real b[3]) {
    const il_real d[3] = {a[0] - b[0], a[1] - b[1], a[2] - b[2]};
    return il_dot(d, d);
}

/* Leave out gyroscopes that contradict the others, all within their range; who is left out is judged by them too. */
static void judge_gyroscopes(const il_imus *a, il_imus_state *s, il_imus_sample *p, uint8_t *used) {
    uint8_t whole[IL_IMUS] = {0}, blamed[IL_IMUS] = {0};
    int32_t count = 0;
    il_real mean[3], total, squares;
    const il_real apart = s->known > 1 ? OLD * OLD * il_dot(s->turning, s->turning) : IL_C(0.0);
    for (int32_t k = 0; k < a->count; k++) {
        whole[k] = used[k] && !(p->clipped[k][0] | p->clipped[k][1] | p->clipped[k][2]);
        count += whole[k];
    }
    for (;;) {
        int32_t worst = -1;
        il_real most = IL_C(0.0), left = IL_C(1.0); /* square and remaining weight of the worst: most / left is largest */
        if (count == 0) return;
        total = mean_rate(a, s, whole, p, mean);
        squares = IL_C(0.0);
        for (int32_t k = 0; k < a->count; k++) {
            if (!whole[k]) continue;
            const il_real q = s->share[GYROSCOPE][k], square = q * squared_distance(p->g[k], mean);
            squares += square;
            if (square * left > most * (total - q)) {
                most = square;
                left = total - q;
                worst = k;
            }
        }
        if (count < FEWEST || worst < 0) break;
        most *= total / left;
        const il_real rest = (squares - most) / (il_real)(3 * count - 6);
        if (!(most > a->gate * (rest > IL_C(1.0) ? rest : IL_C(1.0)))) break;
        if (squared_distance(p->g[worst], mean) <= apart) break;
        whole[worst] = used[worst] = 0;
        blamed[worst] = 1;
        count--;
        blame(a, s, GYROSCOPE, worst);
    }
    const il_real usual = count > 1 ? squares / (il_real)(3 * count - 3) : IL_C(1.0);
    for (int32_t k = 0; k < a->count; k++) {
        if (s->owed[GYROSCOPE][k] == 0 || blamed[k] || !p->usable[GYROSCOPE][k]) continue;
        if (p->clipped[k][0] | p->clipped[k][1] | p->clipped[k][2]) continue;
        const il_real square = squared_distance(p->g[k], mean);
        const il_real c = square / (IL_C(1.0) / s->share[GYROSCOPE][k] + IL_C(1.0) / total);
        if (square <= apart || c <= a->gate * (usual > IL_C(1.0) ? usual : IL_C(1.0))) {
            s->owed[GYROSCOPE][k]--;
        } else if (!used[k]) {
            blame(a, s, GYROSCOPE, k);
        }
    }
}

/* The angular acceleration that the gyroscopes tell: half a sample late, which shows in how it changes. */
static void find_turning(il_imus_state *s, il_imus_sample *p, int known) {
    p->turning_known = known && s->known > 0 && s->step > IL_C(0.0);
    p->turning_trusted = p->turning_known && s->known > 1;
    if (p->turning_known) {
        for (int i = 0; i < 3; i++) p->turning[i] = (p->rate[i] - s->before[i]) / s->step;
        const il_real late = p->turning_trusted ? squared_distance(p->turning, s->turning) : il_dot(p->turning, p->turning);
        p->turning_variance = IL_C(2.0) / (p->information * s->step * s->step) + late / IL_C(4.0);
        memcpy(s->turning, p->turning, sizeof s->turning);
    }
    s->known = !known ? 0 : p->turning_trusted ? 3 : p->turning_known ? 2 : 1;
    if (known) memcpy(s->before, p->rate, sizeof s->before);
}

void il_imus_choose_gyroscopes(const il_imus *a, il_imus_state *s, il_imus_sample *p) {
    uint8_t used[IL_IMUS];
    int bridged = 0;
    p->information = IL_C(0.0);
    for (int i = 0; i < 3; i++) p->rate[i] = p->turning[i] = IL_C(0.0);
    if (candidates(a, s, GYROSCOPE, p, used) > 0) {
        judge_gyroscopes(a, s, p, used);
        p->information = mean_rate(a, s, used, p, p->rate);
    }
    report(a, s, GYROSCOPE, p, used);
    for (int32_t k = 0; k < a->count; k++) {
        p->usable[GYROSCOPE][k] = used[k];
        if (used[k]) bridged |= p->clipped[k][0] | p->clipped[k][1] | p->clipped[k][2];
    }
    if (bridged) p->flags |= IL_BEYOND;
    find_turning(s, p, p->information > IL_C(0.0) && !bridged);
}

/* The sums that hold all that the accelerometers of the prepared set tell. */
static void sum_accelerometers(const il_imus *a, const il_imus_state *s, il_imus_sample *p) {
    memset(p->slope, 0, sizeof p->slope);
    memset(p->force, 0, sizeof p->force);
    for (int32_t k = 0; k < a->count; k++) {
        if (!s->used[k]) continue;
        const il_real weight = s->share[ACCELEROMETER][k], *r = a->position + 3 * k;
        const il_real rho[3] = {r[0] - s->centroid[0], r[1] - s->centroid[1], r[2] - s->centroid[2]};
        for (int i = 0; i < 3; i++) {
            const il_real pu = weight * p->u[k][i];
            p->force[i] += pu;
            for (int j = 0; j < 3; j++) p->slope[i][j] += pu * rho[j];
        }
    }
    for (int i = 0; i < 3; i++) p->force[i] /= s->weight;
}

/* The angular acceleration that the accelerometers tell with the rate of the gyroscopes, or that of the gyroscopes. */
static void turning_of(const il_imus_state *s, const il_imus_sample *p, il_real al[3]) {
    il_real w[3], b[3][3], at[3] = {IL_C(0.0), IL_C(0.0), IL_C(0.0)};
    if (s->by_gyroscopes) {
        memcpy(al, p->turning, 3 * sizeof *al);
        return;
    }
    il_imus_to_axes(s, p, b);
    il_transposed_times((const il_real(*)[3])s->axes, p->rate, w);
    for (int i = 0; i < 3; i++) {
        /* root_i e_i x (column - root_i W^2 e_i), of which the part along e_i falls out */
        const int j = (i + 1) % 3, k = (i + 2) % 3;
        const il_real l = s->root[i] * s->root[i];
        at[j] -= b[k][i] - l * w[k] * w[i];
        at[k] += b[j][i] - l * w[j] * w[i];
    }
    for (int i = 0; i < 3; i++) at[i] *= s->inertia[i];
    il_times((const il_real(*)[3])s->axes, at, al);
}

/* Residual of an accelerometer against the set; returns its chi-square, and its weighted square. */
static il_real contradiction(const il_imus *a, const il_imus_state *s, const il_imus_sample *p, const il_real al[3],
                             int32_t k, il_real *square) {
    const il_real *r = a->position + 3 * k, weight = s->share[ACCELEROMETER][k];
    const il_real rho[3] = {r[0] - s->centroid[0], r[1] - s->centroid[1], r[2] - s->centroid[2]};
    il_real e[3], lever[3], shared[3], widened = IL_C(1.0);
    il_lever(p->rate, al, rho, lever);
    for (int i = 0; i < 3; i++) e[i] = p->u[k][i] - p->force[i] - lever[i];
    if (s->by_gyroscopes) { /* whose noise is in the angular acceleration */
        widened += weight * il_dot(rho, rho) * p->turning_variance;
    }
    il_times((const il_real(*)[3])s->leverage[k], e, shared);
    *square = weight * il_dot(e, e);
    return il_dot(e, shared) / widened;
}

/* Leave out the accelerometers of the set that contradict the others. Returns chi-square per degree of freedom. */
static il_real judge_accelerometers(const il_imus *a, il_imus_state *s, il_imus_sample *p, il_real al[3]) {
    for (;;) {
        il_real squares = IL_C(0.0), most = IL_C(0.0), square;
        int32_t worst = -1;
        uint8_t used[IL_IMUS];
        const int32_t freedom = 3 * s->members - (s->by_gyroscopes ? 3 : 6);
        if (s->by_gyroscopes && !p->turning_trusted) return IL_C(-1.0);
        turning_of(s, p, al);
        for (int32_t k = 0; k < a->count; k++) {
            if (!s->used[k]) continue;
            const il_real c = contradiction(a, s, p, al, k, &square);
            squares += square;
            if (c > most) {
                most = c;
                worst = k;
            }
        }
        const il_real rest = (squares - most) / (il_real)(freedom > 3 ? freedom - 3 : 1);
        if (s->members < FEWEST || worst < 0 || !(most > a->gate * (rest > IL_C(1.0) ? rest : IL_C(1.0)))) {
            return freedom > 0 ? squares / (il_real)freedom : IL_C(1.0);
        }
        memcpy(used, s->used, sizeof used);
        used[worst] = 0;
        blame(a, s, ACCELEROMETER, worst);
        il_imus_prepare(a, s, used);
        sum_accelerometers(a, s, p);
    }
}

void il_imus_choose_accelerometers(const il_imus *a, il_imus_state *s, il_imus_sample *p) {
    uint8_t used[IL_IMUS];
    il_real al[3], square;
    const int32_t count = candidates(a, s, ACCELEROMETER, p, used);
    if (memcmp(used, s->used, sizeof used) != 0) il_imus_prepare(a, s, used);
    if (count > 0) {
        sum_accelerometers(a, s, p);
        const int judged = p->information > IL_C(0.0) && !(p->flags & IL_BEYOND);
        const il_real usual = judged ? judge_accelerometers(a, s, p, al) : IL_C(-1.0);
        for (int32_t k = 0; usual >= IL_C(0.0) && k < a->count; k++) {
            if (s->owed[ACCELEROMETER][k] == 0 || !p->usable[ACCELEROMETER][k]) continue;
            if (s->flags[ACCELEROMETER][k] & IL_GATED) continue;
            if (s->used[k]) { /* nobody else was there */
                s->owed[ACCELEROMETER][k]--;
                continue;
            }
            const il_real c = contradiction(a, s, p, al, k, &square);
            if (c <= a->gate * (usual > IL_C(1.0) ? usual : IL_C(1.0))) {
                s->owed[ACCELEROMETER][k]--;
            } else {
                blame(a, s, ACCELEROMETER, k);
            }
        }
    }
    report(a, s, ACCELEROMETER, p, s->used);
}
