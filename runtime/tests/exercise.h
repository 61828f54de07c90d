/* Runs whatever a table has brought on a few samples, odd ones among them; for the loader's test and its fuzzer. */
#ifndef EXERCISE_H
#define EXERCISE_H

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "imulab.h"

enum { EXERCISE_SAMPLES = 24, EXERCISE_AXES = 64 };

static inline void exercise(const il_unit *unit) {
    static const il_real odd[8] = {(il_real)0.5,  (il_real)-3,        (il_real)NAN, (il_real)1e30,
                                   (il_real)-9.8, (il_real)-INFINITY, (il_real)0,   (il_real)1e-30};
    static const uint32_t ticks[8] = {0, 1, 2999, 3000, 3001, 100000, UINT32_MAX - 1u, UINT32_MAX};
    for (unsigned k = 0; k < 8; k++) {
        const il_real in[3] = {odd[k], odd[(k + 1) % 8], odd[(k + 3) % 8]};
        il_real out[3], rate[2] = {in[0], in[1]};
        if (unit->has & IL_HAS_TUMBLE) (void)il_tumble_apply(&unit->tumble, in, out);
        if (unit->has & IL_HAS_GYRO) (void)il_gyro_apply(&unit->gyro, in, odd, out);
        if (unit->has & IL_HAS_MAG) (void)il_mag_apply(&unit->mag, in, out);
        if (unit->has & IL_HAS_THERMAL) {
            il_thermal_state state;
            il_thermal_start(&state);
            (void)il_thermal_apply(&unit->thermal, &state, odd[k], in, out);
        }
        if (unit->has & IL_HAS_THERMAL_GYRO) {
            il_thermal_gyro_state state;
            il_thermal_gyro_start(&state);
            (void)il_thermal_gyro_apply(&unit->thermal_gyro, &state, odd[k], in, k % 2 ? odd : NULL, out);
        }
        if (unit->has & IL_HAS_CENTRIFUGE) (void)il_centrifuge_apply(&unit->centrifuge, in, rate);
        if ((unit->has & IL_HAS_WARMUP) && unit->warmup.axes <= EXERCISE_AXES) {
            static il_real columns[EXERCISE_AXES][8];
            il_real bias[EXERCISE_AXES], *place[EXERCISE_AXES];
            il_warmup_state state;
            const il_real *from[EXERCISE_AXES];
            for (unsigned i = 0; i < EXERCISE_AXES; i++) from[i] = place[i] = i % 3 == 1 ? NULL : columns[i];
            (void)il_warmup_start(&unit->warmup, &state, k < 4 ? (il_real)(20.0 * k) - (il_real)10 : odd[k], (il_real)0.1);
            il_warmup_bias(&unit->warmup, &state, ticks[k], bias);
            il_warmup_block(&unit->warmup, &state, 8, ticks, from, NULL, place);
        }
    }
    if (unit->has & IL_HAS_ARRAY) {
        const size_t width = (size_t)unit->array.axes * (size_t)unit->array.elements;
        il_array_state *state = malloc(sizeof *state);
        il_real *reading = malloc(width * EXERCISE_SAMPLES * sizeof *reading), rate[3 * EXERCISE_SAMPLES];
        uint8_t *flags = malloc(width * EXERCISE_SAMPLES);
        /* at first with odd readings everywhere, then with a few in one sample, so that all may be well before */
        for (size_t few = 0; few < 2 && state != NULL && reading != NULL && flags != NULL; few++) {
            if (il_array_start(&unit->array, state) != IL_OK) break;
            for (size_t i = 0; i < width * EXERCISE_SAMPLES; i++) {
                reading[i] = (il_real)0.1 * (il_real)(i % 11) + (il_real)0.01 * (il_real)(i % 7);
                if (i % 37 == 5 && (few == 0 || i / width == EXERCISE_SAMPLES - 3)) reading[i] = odd[i % 8];
            }
            (void)il_array_block(&unit->array, state, EXERCISE_SAMPLES, reading, NULL, rate, flags, NULL);
            il_array_still(&unit->array, state);
            (void)il_array_step(&unit->array, state, reading, rate);
        }
        free(state);
        free(reading);
        free(flags);
    }
    if (unit->has & IL_HAS_IMUS) {
        const size_t width = 6 * (size_t)unit->imus.count;
        il_imus_state *state = malloc(sizeof *state);
        il_real *reading = malloc(width * sizeof *reading);
        il_imus_fused fused;
        if (state != NULL && reading != NULL && il_imus_start(&unit->imus, state) == IL_OK) {
            for (size_t k = 0; k < EXERCISE_SAMPLES; k++) {
                for (size_t i = 0; i < width; i++) {
                    reading[i] = (il_real)0.1 * (il_real)((i + k) % 11) + (il_real)0.01 * (il_real)(i * k % 7);
                    if ((i + 3 * k) % 37 == 5 && k % 3) reading[i] = odd[(i + k) % 8];
                }
                (void)il_imus_step(&unit->imus, state, odd[k % 8], reading, &fused);
            }
        }
        free(state);
        free(reading);
    }
}

#endif
