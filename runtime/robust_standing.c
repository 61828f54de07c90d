/* Gyro array, the robust method: who is trusted. Gyros that are stuck, have jumped or come back. */
#include "robust.h"

#define CHANCE IL_C(1e-6) /* that a reading repeats so often by chance: less is held, as at the end of a range */
enum { ENOUGH = 20 };     /* repeats that nobody takes for chance */

/* Most of what this gyro taught was wrong: the others settle among themselves, and it starts anew. */
static void forget(const il_array *a, il_array_axis *s, int32_t i) {
    il_real sum = IL_C(0.0);
    int32_t others = 0;
    for (int32_t j = 0; j < a->elements; j++) {
        if (j == i || s->seen[j] == 0) continue;
        sum += s->bias[j];
        others++;
    }
    for (int32_t j = 0; j < a->elements; j++) {
        if (j != i && s->seen[j] != 0) s->bias[j] -= sum / (il_real)others;
    }
    s->bias[i] = s->variance[i] = s->late[i] = s->scale[i] = IL_C(0.0);
    s->seen[i] = 0;
}

void il_robust_jump(il_array_axis *s, int32_t i) {
    s->standing[i] |= IL_STANDS_OUT | IL_STANDS_FRESH | IL_STANDS_JUMPED;
    s->calm[i] = s->away[i] = 0;
    s->fast[i] = IL_C(0.0);
}

/* Halve how often readings were compared and had changed, so that the ratio goes on. */
static void halve(il_array_axis *s, int32_t i) {
    s->changed[i] >>= 1;
    s->compared[i] >>= 1;
}

/* Whether a reading repeats oftener than by chance, which is told by so many pairs that changed, and repeated before. */
static int is_held(uint32_t run, uint64_t changed, uint64_t repeated) {
    if (changed <= repeated) return 0; /* a coarse gyro at rest: it may be stuck, but that takes longer to tell */
    il_real usual = (il_real)(repeated + 1) / (il_real)(changed + repeated + 2), chance = IL_C(1.0);
    for (uint32_t k = 0; k < run && chance > CHANCE; k++) chance *= usual;
    return chance <= CHANCE;
}

/* Pairs of a gyro's readings that were equal, before the present run of them. */
static uint32_t repeated_before(const il_array_axis *s, int32_t i) {
    uint32_t equal = s->compared[i] - 1 - s->changed[i];
    return equal > s->repeats[i] ? equal - s->repeats[i] : 0;
}

static il_real share_changed(const il_array_axis *s, int32_t i) {
    return (il_real)s->changed[i] / (il_real)(s->compared[i] > 1 ? s->compared[i] - 1 : 1);
}

/* A gyro is stuck when its readings repeat longer than they usually do while somebody else is alive. Before that it is
 * held: what it tells is not the rate. */
static void find_stuck(const il_array *a, il_array_axis *s, il_sample *p) {
    il_real shares[IL_ARRAY_ELEMENTS], usual = IL_C(0.0);
    uint64_t repeated = 0, changed = 0;
    int32_t alive = 0, free = 0;
    for (int32_t i = 0; i < a->elements; i++) {
        if (!p->usable[i] || s->changed[i] == 0) continue;
        repeated += repeated_before(s, i);
        changed += s->changed[i];
    }
    for (int32_t i = 0; i < a->elements; i++) { /* one that has never changed is judged by the others */
        if (p->usable[i] && s->changed[i] == 0) p->held[i] = (uint8_t)is_held(s->repeats[i], changed, repeated);
        free += p->usable[i] && !p->held[i];
        if (p->usable[i] && s->repeats[i] < a->stuck) shares[alive++] = share_changed(s, i);
    }
    if (alive > 0) usual = il_median(shares, alive);
    for (int32_t i = 0; i < a->elements; i++) {
        if (!p->usable[i]) continue;
        il_real share = s->changed[i] ? share_changed(s, i) : usual;
        int stuck = alive > 0 && s->repeats[i] >= a->stuck && (il_real)s->repeats[i] * share >= (il_real)ENOUGH;
        if (stuck || (p->held[i] && free > 0)) {
            s->flags[i] |= stuck ? IL_STUCK : IL_BEYOND;
            p->usable[i] = 0;
            s->compared[i] -= s->compared[i] > 1; /* such pairs are not what is usual */
            int taught = s->seen[i] > 0 && (uint64_t)s->repeats[i] * 2 >= s->seen[i];
            if (!(s->standing[i] & IL_STANDS_STUCK) && taught) forget(a, s, i);
        }
        s->standing[i] = (uint8_t)((s->standing[i] & ~IL_STANDS_STUCK) | (stuck ? IL_STANDS_STUCK : 0));
    }
}

int il_robust_examine(const il_array *a, il_array_axis *s, const il_real *z, const il_real *reading, il_sample *p) {
    int closer = 0;
    for (int32_t i = 0; i < a->elements; i++) {
        int fine = il_finite(z[i]);
        p->usable[i] = (uint8_t)fine;
        p->held[i] = 0;
        s->flags[i] = fine ? 0 : (uint8_t)IL_NOT_FINITE;
        closer |= !fine;
        if (!fine) continue;
        il_real change = il_fabs(reading[i] - s->last[i]);
        int same = change == IL_C(0.0) && s->compared[i] > 0;
        s->repeats[i] = same ? il_counted(s->repeats[i], 1) : 0;
        if (s->compared[i] == UINT32_MAX) halve(s, i);
        if (s->compared[i] > 0 && !same) {
            s->changed[i]++;
            if (change < s->resolution || s->resolution == IL_C(0.0)) s->resolution = change;
        }
        s->compared[i]++; /* pairs seen, plus one: 0 means that there is no reading to compare with */
        s->last[i] = reading[i];
        p->held[i] = (uint8_t)(same && is_held(s->repeats[i], s->changed[i], repeated_before(s, i)));
        closer |= p->held[i] | (same && s->changed[i] == 0) | (s->repeats[i] >= a->stuck) | (s->standing[i] & IL_STANDS_STUCK);
    }
    if (closer) find_stuck(a, s, p);
    return closer;
}

/* Trusted is who is usable and not waiting. Newcomers wait. */
int32_t il_robust_choose_trusted(const il_array *a, il_array_axis *s, il_sample *p) {
    int32_t core = 0, usable = 0;
    for (int32_t i = 0; i < a->elements; i++) {
        if (p->usable[i] && s->seen[i] == 0 && p->learnt > 2 && !(s->standing[i] & IL_STANDS_FRESH)) {
            s->standing[i] |= IL_STANDS_OUT | IL_STANDS_FRESH;
            s->calm[i] = 0;
        }
        p->core[i] = p->usable[i] && !(s->standing[i] & IL_STANDS_OUT);
        core += p->core[i];
        usable += p->usable[i];
    }
    p->waived = core == 0;
    if (p->waived) memcpy(p->core, p->usable, sizeof p->core);
    return p->waived ? usable : core;
}

/* A gyro that left the gate and stays off by the same amount has jumped, also if its noise takes it in at times. */
static void follow(const il_array *a, il_array_axis *s, const il_sample *p, int32_t i) {
    il_real distance = p->r_still[i] - p->middle;
    if (++s->away[i] == 1) s->away_mean[i] = s->away_square[i] = IL_C(0.0);
    il_real step = distance - s->away_mean[i];
    s->away_mean[i] += step / (il_real)s->away[i];
    s->away_square[i] += step * (distance - s->away_mean[i]);
    if (s->away[i] < a->jump) return;
    il_real scatter = il_sqrt(s->away_square[i] / (il_real)(s->away[i] - 1));
    il_real least = il_larger(il_sqrt(p->trust[i]), a->scale_tolerance * il_fabs(p->middle));
    if (scatter <= p->half[i] / IL_C(2.0) && il_fabs(s->away_mean[i]) > least) {
        if (s->away[i] >= s->seen[i]) forget(a, s, i);
        il_robust_jump(s, i);
    }
    s->away[i] = 0;
}

void il_robust_judge(const il_array *a, il_array_axis *s, const il_sample *p) {
    uint32_t patience = a->quiet / 5 > 0 ? a->quiet / 5 : 1;
    for (int32_t i = 0; i < a->elements; i++) {
        if (!p->usable[i] || !p->inside[i]) {
            il_count(&s->bad[i]);
            s->calm[i] = 0;
            if (s->bad[i] >= patience || (s->standing[i] & IL_STANDS_STUCK)) s->standing[i] |= IL_STANDS_OUT;
            if (p->usable[i]) {
                s->flags[i] |= IL_GATED;
                follow(a, s, p, i);
                continue;
            }
            s->away[i] = 0;
            s->fast[i] = IL_C(0.0);
            if (s->standing[i] & IL_STANDS_STUCK) s->standing[i] &= (uint8_t)~IL_STANDS_JUMPED;
            continue;
        }
        s->bad[i] = 0;
        if ((s->standing[i] & (IL_STANDS_OUT | IL_STANDS_FRESH)) == IL_STANDS_OUT && p->half[i] > IL_C(0.0)) {
            follow(a, s, p, i);
        } else {
            s->away[i] = 0;
        }
        if (!(s->standing[i] & IL_STANDS_OUT) || ++s->calm[i] <= a->quiet) continue;
        if (s->standing[i] & IL_STANDS_FRESH) {
            if (s->seen[i] == 0) s->variance[i] = p->mean_variance;
            if (s->seen[i] < a->quiet) s->seen[i] = a->quiet;
        }
        s->standing[i] &= (uint8_t) ~(IL_STANDS_OUT | IL_STANDS_FRESH | IL_STANDS_JUMPED);
        memset(s->fast, 0, sizeof s->fast); /* those of the others hold what it did when it left */
    }
}

void il_robust_report(const il_array *a, il_array_axis *s, const il_sample *p, int32_t used) {
    for (int32_t i = 0; i < a->elements; i++) {
        unsigned told = p->used[i] ? 0u : (unsigned)IL_EXCLUDED;
        if (p->usable[i] && (s->standing[i] & IL_STANDS_OUT)) told |= IL_QUIET;
        if (s->standing[i] & IL_STANDS_JUMPED) told |= IL_JUMPED;
        if (used < 3) told |= IL_ALONE;
        s->flags[i] = (uint8_t)(s->flags[i] | told);
    }
}

/* It is well while all gyros are in use and none is under suspicion. */
void il_robust_assess(const il_array *a, il_array_axis *s) {
    uint32_t trouble = s->resolution == IL_C(0.0), differ = 0, full = a->memory > IL_C(0.0) ? UINT32_MAX : a->cap;
    /* a start other than 1 has gains of its own until the memory is full */
    uint32_t least = a->start > 1 && full == a->cap ? full : 2;
    for (int32_t i = 0; i < a->elements; i++) {
        trouble |= s->standing[i] | s->bad[i] | s->away[i] | (uint32_t)(s->seen[i] < least);
        differ |= (s->seen[i] < full ? s->seen[i] : full) ^ (s->seen[0] < full ? s->seen[0] : full);
    }
    s->well = trouble ? 0 : differ ? IL_UNEQUAL : IL_ALIKE;
}

void il_robust_settle(const il_array *a, il_array_axis *s) {
    if (s->clean == 0) return;
    for (int32_t i = 0; i < a->elements; i++) {
        if (s->compared[i] > UINT32_MAX - s->clean) halve(s, i);
        s->compared[i] += s->clean;
        s->changed[i] += s->clean;
        s->seen[i] = il_counted(s->seen[i], s->clean);
        s->repeats[i] = 0;
    }
    s->clean = 0;
}
