/* Gyro array: the plain methods, and what all methods share. */
#include "arrays.h"

static const int LOST_RUNS[3] = {4, 8, 7}; /* scenarios of vectors.h: bursts, all but one lost, all lost */

static void plain_methods_equal_the_equations(void) {
    il_real rate[V_SAMPLES];
    const il_real limit = ROUNDING_LIMIT * REAL(0.5);
    for (int r = 0; r < 3; r++) {
        il_array a = settings_of(IL_MEAN);
        CHECK(run(&a, LOST_RUNS[r], rate, NULL) & IL_NOT_FINITE);
        compare(rate, v_mean_rate[r], limit, __LINE__);
        a = settings_of(IL_COVARIANCE);
        a.weight = v_array_reliability;
        CHECK(run(&a, LOST_RUNS[r], rate, NULL) & IL_NOT_FINITE);
        compare(rate, v_covariance_rate[r], limit, __LINE__);
        for (int kernel = 0; kernel < 2; kernel++) {
            a = settings_of(IL_SUPPORT);
            a.kernel = kernel;
            CHECK(run(&a, LOST_RUNS[r], rate, NULL) & IL_NOT_FINITE);
            compare(rate, v_support_rate[kernel][r], limit, __LINE__);
        }
        a = settings_of(IL_KALMAN);
        a.gain = &v_kalman_gain[0][0];
        a.initial = r;
        a.bias = v_array_bias;
        CHECK(run(&a, LOST_RUNS[r], rate, NULL) & IL_NOT_FINITE);
        compare(rate, v_kalman_rate[r], limit, __LINE__);
    }
    for (int m = 0; m < 2; m++) {
        il_array a = settings_of(IL_LEAST_SQUARES);
        a.memory = m ? REAL(0.125) : REAL(0);
        CHECK(run(&a, 0, rate, NULL) == 0);
        compare(rate, v_least_squares_rate[m], limit, __LINE__);
    }
}

/* Readings whose squares are beyond all numbers leave no weight. */
static void no_weight_is_no_rate(void) {
    il_array a = settings_of(IL_LEAST_SQUARES);
    il_array_state state;
    il_real out = REAL(0);
    CHECK(il_array_start(&a, &state) == IL_OK);
    for (int k = 0; k < 4; k++) {
        il_real reading[V_ELEMENTS], far = REAL(1);
        for (int times = k < 3 ? 0 : IS_FLOAT ? 1 : 7; times > 0; times--) far *= REAL(1e30);
        for (int i = 0; i < V_ELEMENTS; i++) reading[i] = i % 2 ? far : -far;
        (void)il_array_step(&a, &state, reading, &out);
        CHECK((isnan(out) != 0) == (k == 3));
    }
}

static void kalman_starts_with_what_is_there(void) {
    il_array a = settings_of(IL_KALMAN);
    il_real rate[V_SAMPLES];
    uint8_t flags[V_SAMPLES * V_ELEMENTS];
    a.gain = &v_kalman_gain[0][0];
    CHECK(run(&a, 14, rate, flags) == (IL_NOT_FINITE | IL_EXCLUDED)); /* gyro 2 comes late */
    CHECK_CLOSE(rate[0], v_array_turn[0], REAL(0.01));
    CHECK(flags[2] == (IL_NOT_FINITE | IL_EXCLUDED) && flags[0] == 0 && flags[160 * V_ELEMENTS + 2] == 0);
}

static void feedback_equals_the_source(void) {
    static const int initial[] = {IL_FIRST, IL_ZERO, IL_GIVEN, IL_FIRST, IL_ZERO};
    static const il_real memory[] = {REAL(0), REAL(0), REAL(0), REAL(0.125), REAL(0)};
    static const uint32_t start[] = {1, 1, 1, 1, 40};
    il_real rate[V_SAMPLES];
    for (size_t i = 0; i < LENGTH(initial); i++) {
        il_array a = settings_of(IL_FEEDBACK);
        a.initial = initial[i];
        a.memory = memory[i];
        a.start = start[i];
        a.bias = v_array_bias;
        CHECK(run(&a, 0, rate, NULL) == 0);
        compare(rate, v_feedback_rate[i], ROUNDING_LIMIT * REAL(0.5), __LINE__);
    }
    /* To the letter: a dead channel takes the weight, and one NaN stays for good. */
    il_array a = settings_of(IL_FEEDBACK);
    CHECK(run(&a, 4, rate, NULL) == IL_NOT_FINITE);
    CHECK(isnan(rate[V_SAMPLES - 1]) && isfinite(rate[99]));
    a.elements = 1;
    a.memory = REAL(0.5);
    il_array_state state;
    CHECK(il_array_start(&a, &state) == IL_OK);
    for (int k = 0; k < 5; k++) { /* a constant: its variance is the floor */
        const il_real one = REAL(0.25);
        CHECK(il_array_step(&a, &state, &one, rate) == 0 && rate[0] == REAL(0.25));
        CHECK(state.axis[0].weight[0] == REAL(1));
    }
}

static void alignment_comes_first(void) {
    il_array a = settings_of(IL_MEAN);
    il_array_state state;
    il_real rate[3];
    a.elements = 2;
    a.axes = 3;
    a.offset = &v_aligned_offset[0][0];
    a.matrix = &v_aligned_matrix[0][0][0];
    CHECK(il_array_start(&a, &state) == IL_OK);
    for (size_t k = 0; k < LENGTH(v_aligned_rate); k++) {
        CHECK(il_array_step(&a, &state, &v_aligned_reading[k][0][0], rate) == 0);
        for (int axis = 0; axis < 3; axis++) CHECK_CLOSE(rate[axis], v_aligned_rate[k][axis], ROUNDING_LIMIT * REAL(2));
    }
    il_real reading[6];
    memcpy(reading, v_aligned_reading[0], sizeof reading);
    reading[2] = NAN_REAL; /* axis y of element 0: with an alignment all of that element is lost */
    CHECK(il_array_step(&a, &state, reading, rate) == (IL_NOT_FINITE | IL_EXCLUDED));
    for (int axis = 0; axis < 3; axis++) {
        CHECK(state.axis[axis].flags[0] == (IL_NOT_FINITE | IL_EXCLUDED) && state.axis[axis].flags[1] == 0);
        CHECK(state.axis[axis].weight[0] == REAL(0) && state.axis[axis].weight[1] == REAL(1));
    }
    a.offset = NULL; /* a matrix alone, and an offset alone */
    CHECK(il_array_step(&a, &state, &v_aligned_reading[0][0][0], rate) == 0 && isfinite(rate[0]));
    a.offset = &v_aligned_offset[0][0];
    a.matrix = NULL;
    CHECK(il_array_step(&a, &state, &v_aligned_reading[0][0][0], rate) == 0);
    const il_real z = (v_aligned_reading[0][1][0] - v_aligned_offset[1][0] + v_aligned_reading[0][1][1] - v_aligned_offset[1][1]) / REAL(2);
    CHECK_CLOSE(rate[1], z, ROUNDING_LIMIT);
}

static void support_corners(void) {
    il_array a = settings_of(IL_SUPPORT);
    il_array_state state;
    il_real rate, same[V_ELEMENTS], none[V_ELEMENTS];
    for (int i = 0; i < V_ELEMENTS; i++) {
        same[i] = REAL(0.5);
        none[i] = NAN_REAL;
    }
    CHECK(il_array_start(&a, &state) == IL_OK);
    CHECK(il_array_step(&a, &state, none, &rate) == (IL_NOT_FINITE | IL_EXCLUDED) && isnan(rate));
    CHECK(il_array_step(&a, &state, same, &rate) == 0); /* no distance at all: equal weights */
    CHECK_CLOSE(rate, REAL(0.5), ROUNDING_LIMIT);
    none[3] = REAL(0.25);
    CHECK(il_array_step(&a, &state, none, &rate) == (IL_NOT_FINITE | IL_EXCLUDED) && rate == REAL(0.25));
    CHECK(state.axis[0].weight[3] == REAL(1));
}

/* Settings of every method, in turn with one or three axes, growing or fixed memory, with or without tables. */
static il_array any_settings(int which, const il_real *numbers) {
    il_array a = settings_of(which % IL_METHODS);
    a.axes = which & 8 ? 3 : 1;
    a.memory = which & 16 ? REAL(0.0625) : REAL(0);
    a.initial = which / 5 % 3;
    a.kernel = which & 1;
    a.start = which & 32 ? 30 : 1;
    a.quiet = 20;
    a.bias = numbers;
    a.weight = a.method == IL_COVARIANCE || which & 64 ? numbers + 20 : NULL;
    a.gain = numbers + 40;
    a.offset = which & 4 ? numbers + 60 : NULL;
    a.matrix = which & 2 ? numbers + 80 : NULL;
    return a;
}

enum { WIDE = 3 * V_ELEMENTS, KINDS = 7 * 32 };

/* A block of any size gives bit for bit what single steps give, also after the state was copied away and back. */
static void blocks_equal_single_samples(void) {
    static il_real reading[V_SAMPLES * WIDE], numbers[300], rate[2][V_SAMPLES * 3], weight[2][V_SAMPLES * WIDE];
    static uint8_t flags[2][V_SAMPLES * WIDE], still[V_SAMPLES];
    for (size_t i = 0; i < LENGTH(numbers); i++) numbers[i] = REAL(0.01) * (random_real() + REAL(1.5));
    for (int k = 0; k < V_SAMPLES; k++) {
        still[k] = k % 90 > 70;
        for (int i = 0; i < WIDE; i++) {
            const int axis = i / V_ELEMENTS;
            reading[k * WIDE + i] = faulty(axis == 0 ? 2 + k / 100 : axis == 1 ? 11 : 8, k, i % V_ELEMENTS) * REAL(1 + axis);
        }
    }
    for (int kind = 0; kind < KINDS; kind++) {
        const il_array a = any_settings(kind, numbers);
        const size_t axes = (size_t)a.axes, width = axes * V_ELEMENTS;
        const int samples = V_SAMPLES;
        il_array_state state, saved;
        CHECK(il_array_start(&a, &state) == IL_OK);
        for (int k = 0; k < samples; k++) {
            (void)il_array_step(&a, &state, reading + (size_t)k * width, rate[0] + (size_t)k * axes);
            if (still[k]) il_array_still(&a, &state);
            for (size_t axis = 0; axis < axes; axis++) {
                memcpy(flags[0] + (size_t)k * width + axis * V_ELEMENTS, state.axis[axis].flags, V_ELEMENTS);
                memcpy(weight[0] + (size_t)k * width + axis * V_ELEMENTS, state.axis[axis].weight, V_ELEMENTS * sizeof(il_real));
            }
        }
        const il_array_state last = state;
        CHECK(il_array_start(&a, &state) == IL_OK);
        unsigned met = il_array_block(&a, &state, (size_t)samples, reading, still, rate[1], flags[1], weight[1]), seen = 0;
        CHECK_SAME(rate[1], rate[0], (size_t)samples * axes);
        CHECK_SAME(flags[1], flags[0], (size_t)samples * width);
        CHECK_SAME(weight[1], weight[0], (size_t)samples * width);
        CHECK(memcmp(&state, &last, sizeof state) == 0);
        for (size_t i = 0; i < (size_t)samples * width; i++) seen |= flags[0][i];
        CHECK((met | IL_NOT_FINITE) == (seen | IL_NOT_FINITE));
        /* without flags and weights, in pieces, the state moved between them */
        memset(rate[1], 0, sizeof rate[1]);
        CHECK(il_array_start(&a, &state) == IL_OK);
        size_t size = 1;
        for (size_t at = 0; at < (size_t)samples; at += size) {
            size = at * 2 + 1 < (size_t)samples - at ? at * 2 + 1 : (size_t)samples - at;
            memcpy(&saved, &state, sizeof saved);
            memset(&state, 0xA5, sizeof state);
            memcpy(&state, &saved, sizeof saved);
            (void)il_array_block(&a, &state, size, reading + at * width, still + at, rate[1] + at * axes, NULL, NULL);
        }
        CHECK_SAME(rate[1], rate[0], (size_t)samples * axes);
        CHECK(memcmp(&state, &last, sizeof state) == 0);
        CHECK(il_array_block(&a, &state, 0, reading, NULL, rate[1], NULL, NULL) == 0);
        CHECK(memcmp(&state, &last, sizeof state) == 0);
        /* one of the two outputs alone, and nobody says when the unit is still */
        CHECK(il_array_start(&a, &state) == IL_OK);
        (void)il_array_block(&a, &state, (size_t)samples, reading, NULL, rate[1], flags[1], NULL);
        CHECK_SAME(flags[1], flags[0], (size_t)samples * width);
        CHECK(il_array_start(&a, &state) == IL_OK);
        (void)il_array_block(&a, &state, (size_t)samples, reading, NULL, rate[1], NULL, weight[1]);
        CHECK_SAME(weight[1], weight[0], (size_t)samples * width);
    }
}

static void a_still_unit_shows_the_common_bias(void) {
    il_array a = settings_of(IL_MEAN);
    il_array_state state;
    il_real rate, reading[V_ELEMENTS];
    CHECK(il_array_start(&a, &state) == IL_OK);
    for (int k = 1; k <= 8; k++) {
        for (int i = 0; i < V_ELEMENTS; i++) reading[i] = REAL(k % 2 ? 0.75 : 0.25);
        (void)il_array_step(&a, &state, reading, &rate);
        il_array_still(&a, &state);
    }
    CHECK_CLOSE(state.axis[0].common, REAL(0.5), ROUNDING_LIMIT);
    (void)il_array_step(&a, &state, reading, &rate);
    CHECK_CLOSE(rate, REAL(-0.25), ROUNDING_LIMIT); /* fused 0.25, less what stillness has shown */
    for (int i = 0; i < V_ELEMENTS; i++) reading[i] = NAN_REAL;
    (void)il_array_step(&a, &state, reading, &rate);
    il_array_still(&a, &state); /* nothing to learn from */
    CHECK_CLOSE(state.axis[0].common, REAL(0.5), ROUNDING_LIMIT);
    a.cap = 4; /* memory of the mean no longer than the cap, and without a cap growing */
    for (int k = 0; k < 200; k++) {
        for (int i = 0; i < V_ELEMENTS; i++) reading[i] = REAL(1);
        (void)il_array_step(&a, &state, reading, &rate);
        il_array_still(&a, &state);
    }
    CHECK_CLOSE(state.axis[0].common, REAL(1), ROUNDING_LIMIT);
    a.cap = 0;
    state.axis[0].still = UINT32_MAX;
    for (int i = 0; i < V_ELEMENTS; i++) reading[i] = REAL(3);
    (void)il_array_step(&a, &state, reading, &rate);
    il_array_still(&a, &state);
    CHECK(state.axis[0].still == UINT32_MAX);
    CHECK_CLOSE(state.axis[0].common, REAL(1), REAL(1e-6));
}

static void counters_stop_at_their_end(void) {
    for (int kind = 0; kind < 2 * IL_METHODS; kind++) {
        const int method = kind % IL_METHODS, repeating = kind / IL_METHODS;
        il_array a = settings_of(method);
        il_array_state state;
        il_real rate;
        a.gain = &v_kalman_gain[0][0];
        a.weight = v_array_reliability;
        CHECK(il_array_start(&a, &state) == IL_OK);
        for (int k = 0; k < 120; k++) {
            il_array_axis *s = &state.axis[0];
            if (k == 60) { /* as after years */
                s->count = UINT32_MAX - 1;
                if (method == IL_ROBUST && !repeating) s->clean = 1u << 16;
                for (int i = 0; i < V_ELEMENTS; i++) {
                    if (method == IL_ROBUST || method == IL_LEAST_SQUARES || method == IL_SUPPORT) s->seen[i] = UINT32_MAX - 2;
                    s->compared[i] = UINT32_MAX - 2;
                    s->changed[i] = UINT32_MAX - 4;
                }
            }
            il_real reading[V_ELEMENTS];
            memcpy(reading, v_array_base[k], sizeof reading);
            if (k == 110 || (repeating && k > 50)) reading[1] = s->last[1]; /* robust counts such samples at once */
            (void)il_array_step(&a, &state, method == IL_ROBUST ? reading : v_array_base[k], &rate);
            CHECK(isfinite(rate));
            /* feedback and kalman lag behind the motion by their nature */
            if (method != IL_FEEDBACK && method != IL_KALMAN) CHECK_CLOSE(rate, v_array_turn[k], REAL(0.02));
            for (int i = 0; i < V_ELEMENTS; i++) CHECK(s->changed[i] <= s->compared[i]);
        }
        CHECK(state.axis[0].count == UINT32_MAX);
    }
}

static void settings_that_cannot_be_are_refused(void) {
    static il_real weight[V_ELEMENTS];
    il_array_state state;
    for (int i = 0; i < V_ELEMENTS; i++) weight[i] = REAL(1);
#define REFUSED(method, change)                              \
    do {                                                     \
        il_array a = settings_of(method);                    \
        CHECK(il_array_check(&a) == IL_OK);                  \
        change;                                              \
        CHECK(il_array_check(&a) == IL_ARGUMENT);            \
        memset(&state, 0xFF, sizeof state);                  \
        CHECK(il_array_start(&a, &state) == IL_ARGUMENT);    \
        CHECK(state.axis[0].count == 0);                     \
    } while (0)
    REFUSED(IL_MEAN, a.method = -1);
    REFUSED(IL_MEAN, a.method = IL_METHODS);
    REFUSED(IL_MEAN, a.axes = 2);
    REFUSED(IL_MEAN, a.axes = 0);
    REFUSED(IL_MEAN, a.elements = 0);
    REFUSED(IL_MEAN, a.elements = IL_ARRAY_ELEMENTS + 1);
    REFUSED(IL_MEAN, a.start = 0);
    REFUSED(IL_MEAN, a.memory = REAL(-0.1));
    REFUSED(IL_MEAN, a.memory = REAL(1));
    REFUSED(IL_MEAN, a.memory = NAN_REAL);
    REFUSED(IL_FEEDBACK, a.initial = IL_GIVEN);
    REFUSED(IL_FEEDBACK, a.method = IL_COVARIANCE);
    REFUSED(IL_FEEDBACK, a.method = IL_KALMAN);
    REFUSED(IL_ROBUST, a.elements = 2);
    REFUSED(IL_ROBUST, a.jump = 1);
    REFUSED(IL_ROBUST, a.cap = 1);
    REFUSED(IL_ROBUST, a.stuck = 1);
    REFUSED(IL_ROBUST, a.quiet = 0);
    static const il_real wrong[] = {REAL(0), REAL(-1), NAN_REAL};
    for (size_t i = 0; i < LENGTH(wrong); i++) {
        weight[5] = wrong[i];
        REFUSED(IL_ROBUST, a.weight = weight);
    }
    il_array a = settings_of(IL_MEAN);
    a.elements = 1;
    CHECK(il_array_check(&a) == IL_OK);
    a.elements = IL_ARRAY_ELEMENTS;
    a.axes = 3;
    CHECK(il_array_check(&a) == IL_OK);
}

static void the_largest_array_fits(void) {
    static il_real reading[3 * IL_ARRAY_ELEMENTS], numbers[20 * IL_ARRAY_ELEMENTS * IL_ARRAY_ELEMENTS];
    static il_array_state state;
    for (size_t i = 0; i < LENGTH(numbers); i++) numbers[i] = REAL(0.001) * (random_real() + REAL(2));
    for (int kind = 0; kind < KINDS; kind++) {
        il_array a = any_settings(kind, numbers);
        il_real rate[3];
        a.elements = IL_ARRAY_ELEMENTS;
        a.axes = 3;
        a.bias = a.weight = a.gain = numbers;
        if (a.offset != NULL) a.offset = numbers;
        if (a.matrix != NULL) a.matrix = numbers;
        CHECK(il_array_start(&a, &state) == IL_OK);
        for (int k = 0; k < 30; k++) {
            for (size_t i = 0; i < LENGTH(reading); i++) reading[i] = random_real();
            (void)il_array_step(&a, &state, reading, rate);
            CHECK(isfinite(rate[0]) && isfinite(rate[1]) && isfinite(rate[2]));
        }
    }
}

void test_array(void) {
    plain_methods_equal_the_equations();
    no_weight_is_no_rate();
    kalman_starts_with_what_is_there();
    feedback_equals_the_source();
    alignment_comes_first();
    support_corners();
    blocks_equal_single_samples();
    a_still_unit_shows_the_common_bias();
    counters_stop_at_their_end();
    settings_that_cannot_be_are_refused();
    the_largest_array_fits();
}
