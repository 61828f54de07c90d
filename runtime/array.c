/* Gyro array: settings, alignment, and each sample to its method. */
#include "array.h"

/* A reading may come with an alignment of its element over the axes; then one lost axis loses all. */
static void aligned(const il_array *a, const il_real *reading, il_real *z) {
    int32_t n = a->elements;
    for (int32_t i = 0; i < n * a->axes; i++) z[i] = a->offset != NULL ? reading[i] - a->offset[i] : reading[i];
    if (a->matrix == NULL) return;
    for (int32_t i = 0; i < n; i++) {
        const il_real *m = a->matrix + i * a->axes * a->axes;
        il_real out[3] = {IL_C(0.0), IL_C(0.0), IL_C(0.0)};
        for (int32_t r = 0; r < a->axes; r++) {
            for (int32_t c = 0; c < a->axes; c++) out[r] += m[r * a->axes + c] * z[c * n + i];
        }
        for (int32_t r = 0; r < a->axes; r++) z[r * n + i] = out[r];
    }
}

static inline unsigned step(const il_array *a, const il_robust_terms *t, il_array_state *state,
                            const il_real *reading, il_real *rate, int want_health) {
    il_real moved[3 * IL_ARRAY_ELEMENTS];
    const il_real *z = reading;
    unsigned flags = 0;
    if (a->offset != NULL || a->matrix != NULL) {
        aligned(a, reading, moved);
        z = moved;
    }
    for (int32_t axis = 0; axis < a->axes; axis++) {
        il_array_axis *s = &state->axis[axis];
        const il_real *mine = z + axis * a->elements;
        il_count(&s->count);
        if (a->method == IL_ROBUST) {
            s->rate = il_robust_step(a, t, s, mine, reading + axis * a->elements, want_health);
        } else if (a->method == IL_FEEDBACK) {
            s->rate = il_feedback_step(a, s, mine, axis, want_health);
        } else {
            s->rate = il_plain_step(a, s, mine, axis, want_health);
        }
        rate[axis] = s->rate - s->common;
        if (!il_finite(s->rate)) flags |= IL_NOT_FINITE;
        if (want_health) {
            for (int32_t i = 0; i < a->elements; i++) flags |= s->flags[i];
        }
    }
    return flags;
}

il_status il_array_check(const il_array *a) {
    int32_t least = a->method == IL_ROBUST ? 3 : 1;
    if (a->method < 0 || a->method >= IL_METHODS || (a->axes != 1 && a->axes != 3)) return IL_ARGUMENT;
    if (a->elements < least || a->elements > IL_ARRAY_ELEMENTS || a->start < 1) return IL_ARGUMENT;
    if (!(a->memory >= IL_C(0.0) && a->memory < IL_C(1.0))) return IL_ARGUMENT;
    if (a->initial == IL_GIVEN && a->bias == NULL) return IL_ARGUMENT;
    if (a->method == IL_COVARIANCE && a->weight == NULL) return IL_ARGUMENT;
    if (a->method == IL_KALMAN && a->gain == NULL) return IL_ARGUMENT;
    for (int32_t i = 0; a->method == IL_ROBUST && a->weight != NULL && i < a->axes * a->elements; i++) {
        if (!(a->weight[i] > IL_C(0.0))) return IL_ARGUMENT;
    }
    if (a->method == IL_ROBUST && (a->jump < 2 || a->cap < 2 || a->stuck < 2 || a->quiet < 1)) return IL_ARGUMENT;
    return IL_OK;
}

il_status il_array_start(const il_array *settings, il_array_state *state) {
    memset(state, 0, sizeof *state);
    if (il_array_check(settings) != IL_OK) return IL_ARGUMENT;
    for (int32_t axis = 0; axis < settings->axes; axis++) {
        il_array_axis *s = &state->axis[axis];
        int32_t n = settings->elements;
        il_real sum = IL_C(0.0);
        s->count = settings->start - 1;
        for (int32_t i = 0; i < n; i++) {
            s->ratio[i] = settings->weight != NULL ? IL_C(1.0) / settings->weight[axis * n + i] : IL_C(1.0);
            s->bias[i] = settings->initial == IL_GIVEN ? settings->bias[axis * n + i] : IL_C(0.0);
            sum += s->ratio[i] / (il_real)n;
        }
        for (int32_t i = 0; i < n; i++) s->ratio[i] /= sum;
        /* of the last one's partner, where n is odd */
        if (settings->method == IL_ROBUST) s->ratio[n] = (il_real)INFINITY;
        if (settings->method == IL_FEEDBACK) s->variance[n] = (il_real)INFINITY;
    }
    return IL_OK;
}

unsigned il_array_step(const il_array *settings, il_array_state *state, const il_real *reading, il_real *rate) {
    il_robust_terms t;
    if (settings->method == IL_ROBUST) t = il_robust_prepare(settings);
    return step(settings, &t, state, reading, rate, 1);
}

void il_array_still(const il_array *settings, il_array_state *state) {
    for (int32_t axis = 0; axis < settings->axes; axis++) {
        il_array_axis *s = &state->axis[axis];
        if (!il_finite(s->rate)) continue;
        il_count(&s->still);
        il_real k = (il_real)(s->still < settings->cap || settings->cap == 0 ? s->still : settings->cap);
        s->common += (s->rate - s->common) / k;
    }
}

unsigned il_array_block(const il_array *settings, il_array_state *state, size_t n, const il_real *reading,
                        const uint8_t *still, il_real *rate, uint8_t *flags, il_real *weight) {
    const il_array a = *settings; /* a copy cannot alias the samples */
    size_t width = (size_t)a.axes * (size_t)a.elements, elements = (size_t)a.elements;
    unsigned all = 0;
    int want_health = flags != NULL || weight != NULL;
    il_robust_terms t;
    if (a.method == IL_ROBUST) t = il_robust_prepare(&a);
    for (size_t k = 0; k < n; k++) {
        /* the last sample leaves flags and weights in the state, as single steps do */
        const int health = want_health || k + 1 == n;
        all |= step(&a, &t, state, reading + k * width, rate + k * (size_t)a.axes, health);
        if (still != NULL && still[k]) il_array_still(&a, state);
        for (size_t axis = 0; want_health && axis < (size_t)a.axes; axis++) {
            const il_array_axis *s = &state->axis[axis];
            size_t place = k * width + axis * elements;
            if (flags != NULL) memcpy(flags + place, s->flags, elements);
            if (weight != NULL) memcpy(weight + place, s->weight, elements * sizeof(il_real));
        }
    }
    return all;
}
