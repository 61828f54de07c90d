/* Ratios of the core's block functions to a plain copy of the same arrays and to a bare loop of the same recursion.
 * Everything takes turns; each figure is a median. Prints `name ratio asked` lines and, as comments, the times. */
#if defined(__unix__) || defined(__APPLE__)
#define _POSIX_C_SOURCE 199309L
#endif
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "imulab.h"

enum { ROUNDS = 15, N = 1000000, GYROS = 6, AXES = 6, SAMPLES = 200000 };
#define REAL(x) ((il_real)(x))
#define LENGTH(array) (sizeof(array) / sizeof *(array))

static double now(void) {
#if defined(CLOCK_MONOTONIC)
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
#else
    return (double)clock() / CLOCKS_PER_SEC;
#endif
}

static int by_size(const void *a, const void *b) {
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

/* Median time of each job, all taking turns; the first round warms up. */
static void race(int jobs, void (*const job[])(void), double median[]) {
    static double times[16][ROUNDS];
    for (int round = -1; round < ROUNDS; round++) {
        for (int j = 0; j < jobs; j++) {
            const double begin = now();
            job[j]();
            if (round >= 0) times[j][round] = now() - begin;
        }
    }
    for (int j = 0; j < jobs; j++) {
        qsort(times[j], ROUNDS, sizeof(double), by_size);
        median[j] = times[j][ROUNDS / 2];
    }
}

static il_real random_real(void) {
    static uint32_t state = 1u;
    state = state * 1664525u + 1013904223u;
    return REAL((int32_t)(state >> 11)) / REAL(1 << 20) - REAL(1);
}

static il_real *column(size_t n) {
    il_real *made = malloc(n * sizeof *made);
    if (made == NULL) exit(EXIT_FAILURE);
    for (size_t i = 0; i < n; i++) made[i] = random_real();
    return made;
}

/* ---- triads ------------------------------------------------------------------------------------------------------- */

static il_real *in[AXES], *out[AXES];
static il_tumble triad;
static unsigned met;

static void copy_three(void) {
    for (int i = 0; i < 3; i++) memcpy(out[i], in[i], N * sizeof *out[i]);
}

static void tumble(void) {
    const il_real *const from[3] = {in[0], in[1], in[2]};
    met |= il_tumble_block(&triad, N, from, 1, out, 1);
}

static void triads(void) {
    static void (*const jobs[])(void) = {copy_three, tumble};
    double t[2];
    triad.order = 1;
    for (int i = 0; i < 3; i++) {
        triad.gain[i] = REAL(1.01);
        triad.bias[i] = REAL(0.1);
        triad.misalignment[i] = REAL(0.01);
    }
    race(2, jobs, t);
    printf("tumble %.2f 3 # order 1, 3 x 1e6: %.2f ms, copy %.2f ms\n", t[1] / t[0], 1e3 * t[1], 1e3 * t[0]);
}

/* ---- warm-up ------------------------------------------------------------------------------------------------------ */

static il_real edges[8] = {REAL(-40), REAL(-30), REAL(-20), REAL(-10), REAL(0), REAL(40), REAL(50), REAL(60)};
static il_warmup table;
static il_warmup_state warm;
static uint32_t *ticks;

static void copy_six(void) {
    for (int i = 0; i < AXES; i++) memcpy(out[i], in[i], N * sizeof *out[i]);
}

static void warmup(void) {
    const il_real *const from[AXES] = {in[0], in[1], in[2], in[3], in[4], in[5]};
    il_warmup_block(&table, &warm, N, ticks, from, NULL, out);
}

static void warmups(void) {
    static const char *const names[4] = {"interval-cubic", "knot-cubic", "knot-log-cubic", "exponential"};
    static void (*const jobs[])(void) = {copy_six, warmup};
    ticks = malloc(N * sizeof *ticks);
    if (ticks == NULL) exit(EXIT_FAILURE);
    for (uint32_t k = 0; k < N; k++) ticks[k] = k;
    table.coefficient = column(8 * AXES * 4);
    table.slope = column(8 * AXES * 4);
    table.temperature = edges;
    table.temperatures = 8;
    table.axes = AXES;
    table.time_scale = REAL(20);
    for (int model = 0; model < 4; model++) {
        table.model = model;
        table.terms = model == IL_EXPONENTIAL ? 3 : 4;
        for (int rule = 0; rule < 3; rule++) {
            double t[2];
            table.exit = rule;
            /* hold: all of the recording is compensated; zero and taper: it ends halfway */
            table.settling_time = REAL(N) / REAL(rule == IL_EXIT_HOLD ? 200 : 400);
            table.taper_time = REAL(60);
            for (int j = 0; j < 3; j++) table.time_constant[j] = table.settling_time / REAL(10 * (j + 1));
            if (il_warmup_start(&table, &warm, REAL(20), REAL(0.005)) != IL_OK) exit(EXIT_FAILURE);
            race(2, jobs, t);
            printf("warmup-%s-%s %.2f 4 # 6 x 1e6: %.2f ms, copy %.2f ms\n", names[model],
                   rule == IL_EXIT_ZERO ? "zero" : rule == IL_EXIT_HOLD ? "hold" : "taper", t[1] / t[0], 1e3 * t[1], 1e3 * t[0]);
        }
    }
}

/* ---- gyro array --------------------------------------------------------------------------------------------------- */

static il_real *readings, *rates;
static il_array_state state;

/* The source's recursion as one would write it, without anything around it. */
static void bare_loop(void) {
    il_real b[GYROS], d[GYROS] = {REAL(0)}, rate = REAL(0), mean = REAL(0);
    for (int i = 0; i < GYROS; i++) mean += readings[i] / REAL(GYROS);
    for (int i = 0; i < GYROS; i++) {
        b[i] = readings[i] - mean;
        rate += (readings[i] - b[i]) / REAL(GYROS);
    }
    rates[0] = rate;
    for (int k = 1; k < SAMPLES; k++) {
        const il_real g = REAL(1) / REAL(k + 1), *z = readings + k * GYROS;
        il_real sum = REAL(0), total = REAL(0);
        for (int i = 0; i < GYROS; i++) {
            b[i] = (REAL(1) - g) * b[i] + g * (z[i] - rate);
            const il_real y = z[i] - b[i];
            d[i] = (REAL(1) - g) * d[i] + g * (y - rate) * (y - rate);
            sum += y / d[i];
            total += REAL(1) / d[i];
        }
        rate = sum / total;
        rates[k] = rate;
    }
}

static void fuse(int method, int axes) {
    il_array a;
    memset(&a, 0, sizeof a);
    a.method = method;
    a.elements = GYROS;
    a.axes = axes;
    a.start = 1;
    a.cap = 10000;
    a.stuck = a.jump = 50;
    a.quiet = 100;
    a.gate = REAL(6);
    a.spread_gate = REAL(4);
    a.scale_tolerance = REAL(0.01);
    a.weight_cap = REAL(0.5);
    a.weight_floor = REAL(0.05);
    if (il_array_start(&a, &state) != IL_OK) exit(EXIT_FAILURE);
    met |= il_array_block(&a, &state, SAMPLES, readings, NULL, rates, NULL, NULL);
}

static void feedback(void) {
    fuse(IL_FEEDBACK, 1);
}

static void feedback_three(void) {
    fuse(IL_FEEDBACK, 3);
}

static void robust(void) {
    fuse(IL_ROBUST, 1);
}

static void robust_three(void) {
    fuse(IL_ROBUST, 3);
}

static void mean(void) {
    fuse(IL_MEAN, 1);
}

static void mean_three(void) {
    fuse(IL_MEAN, 3);
}

static void least_squares(void) {
    fuse(IL_LEAST_SQUARES, 1);
}

static void least_squares_three(void) {
    fuse(IL_LEAST_SQUARES, 3);
}

static void arrays(void) {
    static void (*const jobs[])(void) = {bare_loop,    feedback, feedback_three, robust,
                                         robust_three, mean,     mean_three,     least_squares, least_squares_three};
    enum { JOBS = LENGTH(jobs) };
    double t[JOBS];
    readings = column(3 * GYROS * SAMPLES);
    rates = column(3 * SAMPLES);
    for (size_t k = 0; k < 3 * SAMPLES; k++) {
        for (size_t i = 0; i < GYROS; i++) readings[k * GYROS + i] *= REAL(0.01) * REAL(1 + i);
    }
    race(JOBS, jobs, t);
    for (int j = 0; j < JOBS; j++) t[j] *= 1e9 / SAMPLES;
    printf("feedback %.2f 1.3 # of a bare loop: %.1f ns a sample, loop %.1f ns\n", t[1] / t[0], t[1], t[0]);
    printf("robust %.2f 5 # of feedback: %.1f ns a sample\n", t[3] / t[1], t[3]);
    printf("robust-three %.0f 250 # ns a sample of three axes; feedback %.1f, mean %.1f (one %.1f), least squares %.1f (one %.1f)\n",
           t[4], t[2], t[6], t[5], t[8], t[7]);
}

int main(void) {
    for (int i = 0; i < AXES; i++) {
        in[i] = column(N);
        out[i] = column(N);
    }
    triads();
    warmups();
    arrays();
    return met & IL_BEYOND ? EXIT_FAILURE : EXIT_SUCCESS;
}
