/* Three axes in a block are what they are sample by sample, to the last bit: the lanes must not show. */
#include "check.h"

enum { MOST_GYROS = 9, MOST_SAMPLES = 1500, WIDTH = 3 * MOST_GYROS };

static il_real reading[MOST_SAMPLES * WIDTH];
static uint8_t still[MOST_SAMPLES];
static il_real bias[WIDTH], weight[WIDTH], offset[WIDTH], matrix[MOST_GYROS * 9];

static int one_of(int n) {
    return (int)((random_real() + REAL(1)) * REAL(0.5) * REAL(n));
}

/* Nearly normal, of unit variance. */
static il_real noise(void) {
    return (random_real() + random_real() + random_real()) * REAL(1);
}

/* Any settings of a method. */
static il_array any_settings(int method) {
    il_array a;
    memset(&a, 0, sizeof a);
    a.method = method;
    a.axes = 3;
    a.elements = 3 + one_of(MOST_GYROS - 2);
    a.initial = one_of(3);
    a.start = one_of(4) ? 1 : 40;
    a.cap = one_of(2) ? 200 : 100000;
    a.stuck = a.jump = 25;
    a.quiet = 50;
    a.memory = one_of(4) ? REAL(0) : REAL(0.0078125);
    a.gate = REAL(6);
    a.spread_gate = REAL(4);
    a.scale_tolerance = REAL(0.01);
    a.weight_cap = REAL(0.5);
    a.weight_floor = REAL(0.05);
    a.bias = bias;
    for (int i = 0; i < WIDTH; i++) {
        bias[i] = REAL(0.01) * noise();
        offset[i] = REAL(0.02) * noise();
        weight[i] = REAL(1.5) + random_real();
    }
    for (int i = 0; i < MOST_GYROS * 9; i++) matrix[i] = REAL(i % 9 % 4 == 0) + REAL(0.01) * noise();
    if (one_of(3) == 0) a.weight = weight;
    if (one_of(3) == 0) a.offset = offset;
    if (one_of(5) == 0) a.matrix = matrix;
    return a;
}

/* Noise of gyros of unlike quality, coarse in some recordings, with motion that all share. */
static void any_readings(const il_array *a, int samples) {
    const int n = a->elements;
    const il_real step = one_of(3) ? REAL(0) : REAL(0.0078125) * REAL(1 << one_of(3));
    il_real deviation[WIDTH];
    for (int i = 0; i < 3 * n; i++) deviation[i] = (REAL(0.08) + REAL(0.04) * random_real()) * (one_of(9) ? REAL(1) : REAL(0.1));
    for (int k = 0; k < samples; k++) {
        still[k] = k % 400 < 40;
        for (int i = 0; i < 3 * n; i++) {
            const il_real x = deviation[i] * noise() + REAL(0.001) * REAL(k % 300);
            reading[k * 3 * n + i] = step > REAL(0) ? step * REAL(floor((double)(x / step))) : x;
        }
    }
}

/* Something goes wrong with one gyro of one axis, or with all of it. */
static void any_fault(const il_array *a, int samples) {
    const int n = a->elements, kind = one_of(9), axis = one_of(3), gyro = one_of(n), begin = one_of(samples);
    const int length = 1 + one_of(one_of(2) ? 10 : samples), first = axis * n + gyro;
    for (int k = begin; k < samples && (k < begin + length || kind == 5); k++) {
        il_real *x = reading + k * 3 * n + first;
        if (kind == 0) *x = NAN_REAL;
        if (kind == 1) *x = REAL(0);
        if (kind == 2) *x = reading[begin * 3 * n + first];
        if (kind == 3 && k % 7 == 0) *x += REAL(5);
        if (kind == 4) *x += REAL(0.5);
        if (kind == 5) *x += REAL(0.05);
        if (kind == 6) *x = INF_REAL;
        for (int i = 0; kind == 7 && i < n; i++) x[i - gyro] = NAN_REAL;
        if (kind == 8 && k % 90 == 0) *x += REAL(5);
    }
}

typedef struct {
    il_array_state state;
    unsigned met;
    il_real rate[MOST_SAMPLES * 3], weight[MOST_SAMPLES * WIDTH];
    uint8_t flags[MOST_SAMPLES * WIDTH];
} fused;

/* Sample by sample. */
static void run_single(const il_array *a, int samples, const uint8_t *stands, fused *f) {
    const size_t n = (size_t)a->elements;
    CHECK(il_array_start(a, &f->state) == IL_OK);
    f->met = 0;
    for (size_t k = 0; k < (size_t)samples; k++) {
        f->met |= il_array_step(a, &f->state, reading + k * 3 * n, f->rate + k * 3);
        if (stands != NULL && stands[k]) il_array_still(a, &f->state);
        for (size_t axis = 0; axis < 3; axis++) {
            memcpy(f->flags + (k * 3 + axis) * n, f->state.axis[axis].flags, n);
            memcpy(f->weight + (k * 3 + axis) * n, f->state.axis[axis].weight, n * sizeof(il_real));
        }
    }
}

/* In blocks of any size; health: 0 none, 1 flags, 2 weights as well. */
static void run_blocks(const il_array *a, int samples, const uint8_t *stands, int health, fused *f) {
    const size_t n = (size_t)a->elements;
    CHECK(il_array_start(a, &f->state) == IL_OK);
    f->met = 0;
    for (int k = 0, size; k < samples; k += size) {
        const size_t place = (size_t)k * 3 * n;
        size = 1 + one_of(one_of(3) ? samples : 20);
        size = size < samples - k ? size : samples - k;
        f->met |= il_array_block(a, &f->state, (size_t)size, reading + place, stands == NULL ? NULL : stands + k,
                                 f->rate + k * 3, health > 0 ? f->flags + place : NULL,
                                 health > 1 ? f->weight + place : NULL);
    }
}

/* Not-a-number has many bit patterns: one for all. */
static void settle_nan(il_real *x, size_t n) {
    for (size_t i = 0; i < n; i++) x[i] = x[i] == x[i] ? x[i] : NAN_REAL;
}

static void settle_state(il_array_state *state) {
    for (int j = 0; j < 3; j++) {
        il_array_axis *s = &state->axis[j];
        settle_nan(&s->rate, 1);
        settle_nan(s->bias, LENGTH(s->bias));
        settle_nan(s->variance, LENGTH(s->variance));
        settle_nan(s->weight, LENGTH(s->weight));
    }
}

static void check_same(const il_array *a, int samples, int health, fused *blocks, fused *single) {
    const size_t n = (size_t)a->elements, all = (size_t)samples * 3;
    settle_nan(blocks->rate, all);
    settle_nan(single->rate, all);
    settle_state(&blocks->state);
    settle_state(&single->state);
    settle_nan(blocks->weight, all * n);
    settle_nan(single->weight, all * n);
    CHECK_SAME(blocks->rate, single->rate, all);
    CHECK_SAME(&blocks->state, &single->state, 1);
    if (health > 0) CHECK_SAME(blocks->flags, single->flags, all * n);
    if (health > 0) CHECK(blocks->met == single->met);
    if (health > 1) CHECK_SAME(blocks->weight, single->weight, all * n);
}

static void any_faults_in_any_axis(int method, int seeds) {
    static fused blocks, single;
    for (int seed = 0; seed < seeds; seed++) {
        const il_array a = any_settings(method);
        const int samples = MOST_SAMPLES - one_of(900), health = one_of(3), faults = one_of(4);
        const uint8_t *stands = one_of(3) ? NULL : still;
        any_readings(&a, samples);
        for (int i = 0; i < faults; i++) any_fault(&a, samples);
        run_single(&a, samples, stands, &single);
        run_blocks(&a, samples, stands, health, &blocks);
        check_same(&a, samples, health, &blocks, &single);
    }
}

/* Readings whose squares are beyond all numbers leave no weight. */
static void variances_beyond_all_numbers(void) {
    enum { SAMPLES = 100 };
    static fused blocks, single;
    il_array a = any_settings(IL_LEAST_SQUARES);
    a.matrix = NULL; /* which mixes the axes */
    const size_t n = (size_t)a.elements;
    any_readings(&a, SAMPLES);
    for (size_t i = 0; i < n; i++) {
        il_real x = i % 2 ? REAL(1e30) : REAL(-1e30);
        for (int times = IS_FLOAT ? 1 : 6; times > 1; times--) x *= REAL(1e30);
        reading[(50 * 3 + 1) * n + i] = x;
    }
    run_single(&a, SAMPLES, NULL, &single);
    CHECK(single.rate[SAMPLES * 3 - 2] != single.rate[SAMPLES * 3 - 2]);
    CHECK(single.rate[SAMPLES * 3 - 1] == single.rate[SAMPLES * 3 - 1]);
    run_blocks(&a, SAMPLES, NULL, 2, &blocks);
    CHECK(blocks.met & IL_NOT_FINITE);
    check_same(&a, SAMPLES, 2, &blocks, &single);
}

/* Counts that are kept together for a while are brought up to date in time, and stop at the largest number. */
static void counts_reach_their_limits(void) {
    enum { WARM = 200, SAMPLES = 400 };
    static fused blocks, single;
    for (int odd = 0; odd < 2; odd++) {
        il_array a = any_settings(IL_ROBUST);
        a.elements = 6 + odd;
        a.start = 1;
        a.cap = odd ? UINT32_MAX : 5000;
        a.memory = odd ? REAL(0) : REAL(0.0078125);
        for (int i = 0; i < SAMPLES * 3 * a.elements; i++) reading[i] = REAL(0.05) * noise();
        CHECK(il_array_start(&a, &single.state) == IL_OK);
        const size_t width = 3 * (size_t)a.elements;
        (void)il_array_block(&a, &single.state, WARM, reading, NULL, single.rate, NULL, NULL);
        for (uint32_t j = 0; j < 3; j++) {
            il_array_axis *s = &single.state.axis[j];
            s->clean = 65536 - 10 * j;
            for (int i = 0; i < a.elements; i++) s->seen[i] = UINT32_MAX - 65536 - 30 * j;
        }
        blocks.state = single.state;
        const size_t place = WARM * width, rest = SAMPLES - WARM;
        for (size_t k = 0; k < rest; k++) (void)il_array_step(&a, &single.state, reading + place + k * width, single.rate + k * 3);
        (void)il_array_block(&a, &blocks.state, rest, reading + place, NULL, blocks.rate, NULL, NULL);
        check_same(&a, (int)rest, 0, &blocks, &single);
    }
}

void test_lanes(void) {
    any_faults_in_any_axis(IL_ROBUST, 120);
    any_faults_in_any_axis(IL_LEAST_SQUARES, 40);
    any_faults_in_any_axis(IL_FEEDBACK, 40);
    any_faults_in_any_axis(IL_MEAN, 20);
    variances_beyond_all_numbers();
    counts_reach_their_limits();
}
