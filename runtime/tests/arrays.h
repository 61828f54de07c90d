/* Settings and faulty readings that the tests of the array share. */
#ifndef ARRAYS_H
#define ARRAYS_H

#include "check.h"
#include "vectors.h"

enum { POINTS = (V_SAMPLES + V_EVERY - 1) / V_EVERY }; /* samples that vectors.h has a rate for */

/* Six gyros, one axis, 50 Hz, growing memory. */
static inline il_array settings_of(int method) {
    il_array a;
    memset(&a, 0, sizeof a);
    a.method = method;
    a.elements = V_ELEMENTS;
    a.axes = 1;
    a.start = 1;
    a.cap = 5000;
    a.stuck = 25;
    a.jump = 25;
    a.quiet = 50;
    a.gate = REAL(6);
    a.spread_gate = REAL(4);
    a.scale_tolerance = REAL(0.01);
    a.weight_cap = REAL(0.5);
    a.weight_floor = REAL(0.05);
    return a;
}

static inline il_real coarse(il_real x, il_real steps) {
    return REAL(floor((double)(x * steps) + 0.5)) / steps;
}

/* Reading k of gyro i in a scenario; make_vectors.py has three of these. */
static inline il_real faulty(int scenario, int k, int i) {
    const il_real x = v_array_base[k][i];
    switch (scenario) {
        case 1: return i == 2 ? REAL(0) : x;
        case 2: return i == 1 && k >= 150 ? v_array_base[150][i] : x;
        case 3: return i == 3 && k % 37 == 5 ? x + REAL(5.25) : x;
        case 4:
            if (i == 0 && k >= 100 && k < 130) return NAN_REAL;
            return i == 4 && k >= 200 && k < 205 ? INF_REAL : x;
        case 5: return i == 5 && k >= 200 ? x + REAL(0.0625) : x;
        case 6: return i == 5 && k >= 270 ? x + REAL(0.00390625) : x;
        case 7: return k >= 200 && k < 210 ? NAN_REAL : x;
        case 8: return i != 4 && k >= 200 && k < 260 ? -INF_REAL : x;
        case 9: return i > 1 && k >= 200 && k < 260 ? NAN_REAL : x;
        case 10: return coarse(x, REAL(256));
        case 11: return i == 1 && k >= 100 && k < 250 ? v_array_base[100][i] : x;
        case 12: return i < 3 ? coarse(x - v_array_turn[k], REAL(512)) : coarse(x / REAL(64), REAL(4096));
        case 13: return i == 0 && k == 0 ? x + REAL(5.25) : x;
        case 14: return i == 2 && k < 150 ? NAN_REAL : x;
        default: return x;
    }
}

/* All samples of a scenario through single steps; flags may be NULL. Returns the flags met. */
static inline unsigned run(const il_array *a, int scenario, il_real rate[V_SAMPLES], uint8_t *flags) {
    il_array_state state;
    unsigned met = 0;
    CHECK(il_array_start(a, &state) == IL_OK);
    for (int k = 0; k < V_SAMPLES; k++) {
        il_real reading[V_ELEMENTS];
        for (int i = 0; i < V_ELEMENTS; i++) reading[i] = faulty(scenario, k, i);
        met |= il_array_step(a, &state, reading, &rate[k]);
        if (flags != NULL) memcpy(flags + k * V_ELEMENTS, state.axis[0].flags, V_ELEMENTS);
    }
    return met;
}

/* The rates that vectors.h has, against a run; the full scale of the golden readings is about 0.2 rad/s, 5 with spikes. */
static inline void compare(const il_real rate[V_SAMPLES], const il_real golden[POINTS], il_real limit, int line) {
    for (int p = 0; p < POINTS; p++) {
        const il_real error = rate[p * V_EVERY] - golden[p];
        const int lost = golden[p] != golden[p];
        const int holds = lost ? rate[p * V_EVERY] != rate[p * V_EVERY] : error <= limit && error >= -limit;
        check_that(holds, __FILE__, line, "rate of the golden vectors");
        if (!holds) printf("    sample %d: %.17g, expected %.17g\n", p * V_EVERY, (double)rate[p * V_EVERY], (double)golden[p]);
    }
}

#endif
