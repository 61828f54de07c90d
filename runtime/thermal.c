/* Triads over temperature: the laws of their parameters at the temperature of a sample, and then what tumble.c does at
 * one temperature. The laws are evaluated again only where the bits of the temperature differ from those
 * before, so a sample's value depends on that sample alone, and blocks of any length give the same. */
#include "real.h"

enum { BIAS = 0, SCALE_FACTOR = 3, MISALIGNMENT = 6 };

/* The laws at a temperature, held beyond the ends; all not a number at a temperature that is none. */
static unsigned laws_at(int32_t pieces, int32_t terms, const il_real *knot, const il_real *coefficient, int32_t laws,
                        il_real temperature, il_real *law) {
    const il_real lowest = knot[0], highest = knot[pieces];
    il_real t = temperature;
    unsigned flags = 0;
    int32_t piece = 0;
    if (!il_finite(t)) {
        flags = IL_NOT_FINITE;
        t = lowest;
    } else if (t < lowest || t > highest) {
        flags = IL_BEYOND;
        t = t < lowest ? lowest : highest;
    }
    while (piece < pieces - 1 && t >= knot[piece + 1]) piece++;
    const il_real start = knot[piece], half = IL_C(0.5) * (knot[piece + 1] - start);
    const il_real theta = (t - start) / half - IL_C(1.0);
    for (int32_t i = 0; i < laws; i++) {
        const il_real *c = coefficient + (piece * laws + i) * terms;
        law[i] = c[terms - 1];
        for (int32_t k = terms - 2; k >= 0; k--) law[i] = law[i] * theta + c[k];
        if (flags == IL_NOT_FINITE) law[i] = il_nan();
    }
    return flags;
}

unsigned il_thermal_at(const il_thermal *settings, il_real temperature, il_tumble *at) {
    const il_thermal *s = settings;
    il_real law[IL_THERMAL_LAWS];
    const unsigned flags = laws_at(s->pieces, s->terms, s->knot, s->coefficient, IL_THERMAL_LAWS, temperature, law);
    memset(at, 0, sizeof *at);
    at->order = 1;
    for (int i = 0; i < 3; i++) {
        at->gain[i] = IL_C(1.0) / law[SCALE_FACTOR + i];
        at->bias[i] = law[BIAS + i];
        at->misalignment[i] = law[MISALIGNMENT + i];
    }
    return flags;
}

void il_thermal_start(il_thermal_state *state) {
    memset(state, 0, sizeof *state);
}

unsigned il_thermal_apply(const il_thermal *settings, il_thermal_state *state, il_real temperature, const il_real output[3],
                          il_real force[3]) {
    if (!state->known || memcmp(&temperature, &state->temperature, sizeof temperature) != 0) {
        state->flags = il_thermal_at(settings, temperature, &state->at);
        state->temperature = temperature;
        state->known = 1;
    }
    return state->flags | il_tumble_apply(&state->at, output, force);
}

unsigned il_thermal_block(const il_thermal *settings, size_t n, const il_real *temperature, const il_real *const output[3],
                          size_t stride, il_real *const force[3], size_t force_stride) {
    il_thermal_state state;
    unsigned flags = 0;
    il_thermal_start(&state);
    for (size_t k = 0; k < n; k++) {
        const il_real m[3] = {output[0][k * stride], output[1][k * stride], output[2][k * stride]};
        il_real f[3];
        flags |= il_thermal_apply(settings, &state, temperature[k * stride], m, f);
        for (int a = 0; a < 3; a++) force[a][k * force_stride] = f[a];
    }
    return flags;
}

unsigned il_thermal_gyro_at(const il_thermal_gyro *settings, il_real temperature, il_gyro *at) {
    const il_thermal_gyro *s = settings;
    il_real law[IL_THERMAL_GYRO_LAWS];
    const unsigned flags = laws_at(s->pieces, s->terms, s->knot, s->coefficient, IL_THERMAL_GYRO_LAWS, temperature, law);
    memset(at, 0, sizeof *at);
    at->has_sensitivity = s->has_sensitivity;
    at->order = 1;
    memcpy(at->turn, s->turn, sizeof at->turn);
    memcpy(at->sensitivity, s->sensitivity, sizeof at->sensitivity);
    for (int i = 0; i < 3; i++) {
        at->gain[i] = IL_C(1.0) / law[SCALE_FACTOR + i];
        at->bias[i] = law[BIAS + i];
    }
    return flags;
}

void il_thermal_gyro_start(il_thermal_gyro_state *state) {
    memset(state, 0, sizeof *state);
}

unsigned il_thermal_gyro_apply(const il_thermal_gyro *settings, il_thermal_gyro_state *state, il_real temperature,
                               const il_real output[3], const il_real force[3], il_real rate[3]) {
    if (!state->known || memcmp(&temperature, &state->temperature, sizeof temperature) != 0) {
        state->flags = il_thermal_gyro_at(settings, temperature, &state->at);
        state->temperature = temperature;
        state->known = 1;
    }
    return state->flags | il_gyro_apply(&state->at, output, force, rate);
}

unsigned il_thermal_gyro_block(const il_thermal_gyro *settings, size_t n, const il_real *temperature,
                               const il_real *const output[3], const il_real *const force[3], size_t stride,
                               il_real *const rate[3], size_t rate_stride) {
    il_thermal_gyro_state state;
    unsigned flags = 0;
    il_thermal_gyro_start(&state);
    for (size_t k = 0; k < n; k++) {
        const size_t i = k * stride;
        const il_real m[3] = {output[0][i], output[1][i], output[2][i]};
        il_real f[3] = {IL_C(0.0), IL_C(0.0), IL_C(0.0)}, w[3];
        for (int a = 0; a < 3 && force != NULL; a++) f[a] = force[a][i];
        flags |= il_thermal_gyro_apply(settings, &state, temperature[i], m, force != NULL ? f : NULL, w);
        for (int a = 0; a < 3; a++) rate[a][k * rate_stride] = w[a];
    }
    return flags;
}
