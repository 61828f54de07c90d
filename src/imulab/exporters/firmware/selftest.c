/* Runs the unit's own numbers through the core on this machine and compares with what the desk computed.
 * Prints one line; exits 0 when all agree. */
#include <stdio.h>

#include "golden.h"
#include "unit.h"

static const int is_float = sizeof(il_real) < sizeof(double);
static il_real worst; /* difference from the desk, as a fraction of full scale */
static unsigned long compared;

static int is_nan(il_real x) {
    return !(x == x);
}

static void compare(il_real found, il_real expected, il_real scale) {
    il_real error = found < expected ? expected - found : found - expected;
    compared++;
    if (is_nan(found) && is_nan(expected)) return;
    if (is_nan(error)) error = scale;
    if (error / scale > worst) worst = error / scale;
}

#if UNIT_HAS_TUMBLE
static void run_tumble(void) {
    for (int k = 0; k < GOLDEN_TUMBLE; k++) {
        il_real force[3];
        (void)il_tumble_apply(&unit_tumble, golden_tumble_output[k], force);
        for (int i = 0; i < 3; i++) compare(force[i], golden_tumble_force[k][i], golden_tumble_scale);
    }
}
#endif

#if UNIT_HAS_GYRO
static void run_gyro(void) {
    for (int k = 0; k < GOLDEN_GYRO; k++) {
        il_real rate[3];
        (void)il_gyro_apply(&unit_gyro, golden_gyro_output[k], golden_gyro_force[k], rate);
        for (int i = 0; i < 3; i++) compare(rate[i], golden_gyro_rate[k][i], golden_gyro_scale);
    }
}
#endif

#if UNIT_HAS_MAG
static void run_mag(void) {
    for (int k = 0; k < GOLDEN_MAG; k++) {
        il_real field[3];
        (void)il_mag_apply(&unit_mag, golden_mag_output[k], field);
        for (int i = 0; i < 3; i++) compare(field[i], golden_mag_field[k][i], golden_mag_scale);
    }
}
#endif

#if UNIT_HAS_THERMAL
static void run_thermal(void) {
    il_thermal_state state;
    il_thermal_start(&state);
    for (int k = 0; k < GOLDEN_THERMAL; k++) {
        il_real force[3];
        (void)il_thermal_apply(&unit_thermal, &state, golden_thermal_temperature[k], golden_thermal_output[k], force);
        for (int i = 0; i < 3; i++) compare(force[i], golden_thermal_force[k][i], golden_thermal_scale);
    }
}
#endif

#if UNIT_HAS_THERMAL_GYRO
static void run_thermal_gyro(void) {
    il_thermal_gyro_state state;
    il_thermal_gyro_start(&state);
    for (int k = 0; k < GOLDEN_THERMAL_GYRO; k++) {
        il_real rate[3];
        (void)il_thermal_gyro_apply(&unit_thermal_gyro, &state, golden_thermal_gyro_temperature[k],
                                    golden_thermal_gyro_output[k], golden_thermal_gyro_force[k], rate);
        for (int i = 0; i < 3; i++) compare(rate[i], golden_thermal_gyro_rate[k][i], golden_thermal_gyro_scale);
    }
}
#endif

#if UNIT_HAS_CENTRIFUGE
static void run_centrifuge(void) {
    for (int k = 0; k < GOLDEN_CENTRIFUGE; k++) {
        il_real rate[2] = {golden_centrifuge_rate[k][0], golden_centrifuge_rate[k][1]};
        (void)il_centrifuge_apply(&unit_centrifuge, golden_centrifuge_force[k], rate);
        for (int i = 0; i < 2; i++) compare(rate[i], golden_centrifuge_expected[k][i], golden_centrifuge_scale);
    }
}
#endif

#if UNIT_HAS_WARMUP
static void run_warmup(void) {
    for (int k = 0; k < GOLDEN_WARMUP_STARTS; k++) {
        il_warmup_state state;
        (void)il_warmup_start(&unit_warmup, &state, golden_warmup_temperature[k], golden_warmup_tick);
        for (int j = 0; j < GOLDEN_WARMUP_TICKS; j++) {
            il_real bias[UNIT_WARMUP_AXES];
            il_warmup_bias(&unit_warmup, &state, golden_warmup_ticks[j], bias);
            for (int i = 0; i < UNIT_WARMUP_AXES; i++) {
                compare(bias[i], golden_warmup_bias[k][j][i], golden_warmup_scale[i]);
            }
        }
    }
}
#endif

#if UNIT_HAS_ARRAY
static void run_array(void) {
    static il_array_state state;
    (void)il_array_start(&unit_array, &state);
    for (int k = 0; k < GOLDEN_ARRAY; k++) {
        il_real rate[3];
        (void)il_array_step(&unit_array, &state, golden_array_reading[k], rate);
        for (int i = 0; i < UNIT_ARRAY_AXES; i++) compare(rate[i], golden_array_rate[k][i], golden_array_scale);
    }
}
#endif

#if UNIT_HAS_IMUS
static void run_imus(void) {
    static il_imus_state state;
    (void)il_imus_start(&unit_imus, &state);
    for (int k = 0; k < GOLDEN_IMUS; k++) {
        il_imus_fused out;
        const unsigned met = il_imus_step(&unit_imus, &state, golden_imus_step[k], golden_imus_reading[k], &out);
        const il_real *const found[] = {out.force, out.rate, out.acceleration, out.force_std, out.rate_std, out.acceleration_std};
        const int bridged = (golden_imus_flags[k] & IL_BEYOND) != 0;
        for (int i = 0; i < 18; i++) {
            il_real scale = golden_imus_scale[i];
            /* Beyond the gyroscopes' range the rate is known less well: in float to a fifth of its standard uncertainty. */
            if (bridged) scale += i < 9 ? (il_real)1e5 * golden_imus_fused[k][i + 9] : (il_real)200 * golden_imus_fused[k][i];
            compare(found[i / 3][i % 3], golden_imus_fused[k][i], scale);
        }
        compare((il_real)met, (il_real)golden_imus_flags[k], (il_real)1);
    }
}
#endif

/* The blob of the same unit loads, and one wrong bit or a missing byte in it is noticed. */
static int run_loader(void) {
    static il_unit unit;
    static il_real memory[sizeof golden_blob / 4];
    static uint8_t copy[sizeof golden_blob];
    const size_t size = sizeof golden_blob, capacity = sizeof golden_blob / 4;
    for (size_t i = 0; i < size; i++) copy[i] = golden_blob[i];
    if (il_table_load(&unit, copy, size, memory, capacity) != IL_OK || unit.has != UNIT_HAS) return 0;
    if (il_table_load(&unit, copy, size - 1, memory, capacity) == IL_OK) return 0;
    copy[size / 2] ^= 1u;
    return il_table_load(&unit, copy, size, memory, capacity) != IL_OK;
}

int main(void) {
    /* The same source in double is the same to the last bit, unless exp and log come from another library. */
    const il_real limit = is_float ? (il_real)2e-6 : (il_real)1e-12;
    int fine = run_loader();
#if UNIT_HAS_TUMBLE
    run_tumble();
#endif
#if UNIT_HAS_GYRO
    run_gyro();
#endif
#if UNIT_HAS_MAG
    run_mag();
#endif
#if UNIT_HAS_THERMAL
    run_thermal();
#endif
#if UNIT_HAS_THERMAL_GYRO
    run_thermal_gyro();
#endif
#if UNIT_HAS_CENTRIFUGE
    run_centrifuge();
#endif
#if UNIT_HAS_WARMUP
    run_warmup();
#endif
#if UNIT_HAS_ARRAY
    run_array();
#endif
#if UNIT_HAS_IMUS
    run_imus();
#endif
    fine = fine && worst <= limit;
    printf("imulab self-test: %s, worst %.3g of full scale (%s, %lu numbers compared)\n", fine ? "pass" : "FAIL",
           (double)worst, is_float ? "float" : "double", compared);
    return fine ? 0 : 1;
}
