/* Accelerometer triad over temperature: the laws of the nine parameters at the temperature of a sample, and then what
 * tumble.c does at one temperature. The laws are evaluated again only where the bits of the temperature differ from those
 * before, so a sample's value depends on that sample alone, and blocks of any length give the same. */
#include "real.h"

enum { BIAS = 0, SCALE_FACTOR = 3, MISALIGNMENT = 6 };

unsigned il_thermal_at(const il_thermal *settings, il_real temperature, il_tumble *at) {
    const il_thermal *s = settings;
    const il_real lowest = s->knot[0], highest = s->knot[s->pieces];
    il_real t = temperature, law[IL_THERMAL_LAWS];
    unsigned flags = 0;
    int32_t piece = 0;
    if (!il_finite(t)) {
        flags = IL_NOT_FINITE;
        t = lowest;
    } else if (t < lowest || t > highest) {
        flags = IL_BEYOND;
        t = t < lowest ? lowest : highest;
    }
    while (piece < s->pieces - 1 && t >= s->knot[piece + 1]) piece++;
    const il_real start = s->knot[piece], half = IL_C(0.5) * (s->knot[piece + 1] - start);
    const il_real theta = (t - start) / half - IL_C(1.0);
    for (int32_t i = 0; i < IL_THERMAL_LAWS; i++) {
        const il_real *c = s->coefficient + (piece * IL_THERMAL_LAWS + i) * s->terms;
        law[i] = c[s->terms - 1];
        for (int32_t k = s->terms - 2; k >= 0; k--) law[i] = law[i] * theta + c[k];
        if (flags == IL_NOT_FINITE) law[i] = il_nan();
    }
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
