/* Whole IMUs, against the dense least squares of tests/reference: healthy, with faults, beyond the gyroscopes' range. */
#include "check.h"
#include "vectors.h"

/* What rounding may cost, in standard uncertainties. */
#define ROUNDING_SHARE (IS_FLOAT ? REAL(0.05) : REAL(1e-8))

enum { NUMBERS = 18 };

#define BOARD(a, name)                                                                                                \
    do {                                                                                                              \
        memset(a, 0, sizeof *(a));                                                                                    \
        (a)->count = (int32_t)LENGTH(v_imus_##name##_accel_noise);                                                    \
        (a)->stuck = 20;                                                                                              \
        (a)->quiet = 16;                                                                                              \
        (a)->gate = REAL(30.664851);                                                                                  \
        memcpy((a)->at, v_imus_##name##_at, sizeof (a)->at);                                                          \
        (a)->position = &v_imus_##name##_position[0][0];                                                              \
        (a)->accel = &v_imus_##name##_accel[0][0][0];                                                                 \
        (a)->accel_bias = &v_imus_##name##_accel_bias[0][0];                                                          \
        (a)->accel_noise = v_imus_##name##_accel_noise;                                                               \
        (a)->accel_limit = v_imus_##name##_accel_limit;                                                               \
        (a)->gyro = &v_imus_##name##_gyro[0][0][0];                                                                   \
        (a)->gyro_bias = &v_imus_##name##_gyro_bias[0][0];                                                            \
        (a)->gyro_noise = v_imus_##name##_gyro_noise;                                                                 \
        (a)->gyro_limit = v_imus_##name##_gyro_limit;                                                                 \
        (a)->gyro_rows = &v_imus_##name##_gyro_rows[0][0][0];                                                         \
    } while (0)

static int same_number(il_real found, il_real expected, il_real limit) {
    if (expected != expected) return found != found;
    return found - expected <= limit && expected - found <= limit;
}

static void compare(const il_imus *a, const il_real *reading, const il_real (*golden)[NUMBERS],
                    const il_real (*standing)[3], size_t n, int line) {
    static il_imus_state state;
    CHECK(il_imus_start(a, &state) == IL_OK);
    for (size_t k = 0; k < n; k++) {
        il_imus_fused out;
        const unsigned flags = il_imus_step(a, &state, k ? v_imus_step : REAL(0), reading + k * 6 * (size_t)a->count, &out);
        il_real found[NUMBERS];
        int holds = sizeof out == sizeof found;
        memcpy(found, &out, sizeof found);
        for (int i = 0; k % V_IMUS_EVERY == 0 && i < NUMBERS; i++) {
            const il_real *expected = golden[k / V_IMUS_EVERY], deviation = expected[i < 9 ? i + 9 : i];
            holds &= same_number(found[i], expected[i], ROUNDING_SHARE * (deviation == deviation ? deviation : REAL(0)));
        }
        check_that(holds, __FILE__, line, "fused numbers of the golden vectors");
        if (!holds) printf("    sample %lu\n", (unsigned long)k);
        CHECK(((flags & IL_BEYOND) != 0) == (standing[k][0] > REAL(0)));
        for (int sensor = 0; sensor < 2; sensor++) {
            uint32_t used = 0;
            for (int32_t i = 0; i < a->count; i++) used |= state.flags[sensor][i] & IL_EXCLUDED ? 0u : 1u << i;
            check_that(used == (uint32_t)standing[k][1 + sensor], __FILE__, line, "triads used in the golden vectors");
        }
    }
}

static void fusion_equals_dense_least_squares(void) {
    il_imus a;
    BOARD(&a, five);
    compare(&a, &v_imus_five_reading[0][0], v_imus_five_fused, v_imus_five_standing, V_IMUS_SAMPLES, __LINE__);
    BOARD(&a, two);
    compare(&a, &v_imus_two_reading[0][0], v_imus_two_fused, v_imus_two_standing, V_IMUS_FEW, __LINE__);
    BOARD(&a, line);
    compare(&a, &v_imus_line_reading[0][0], v_imus_line_fused, v_imus_line_standing, V_IMUS_FEW, __LINE__);
}

static void faults_are_told(void) {
    static il_imus_state state;
    il_imus a;
    il_imus_fused out;
    unsigned met[V_IMUS_SAMPLES];
    uint8_t health[V_IMUS_SAMPLES][2][5];
    BOARD(&a, five);
    CHECK(il_imus_start(&a, &state) == IL_OK);
    for (int k = 0; k < V_IMUS_SAMPLES; k++) {
        met[k] = il_imus_step(&a, &state, v_imus_step, v_imus_five_reading[k], &out);
        for (int sensor = 0; sensor < 2; sensor++) memcpy(health[k][sensor], state.flags[sensor], 5);
    }
    CHECK(health[0][0][4] == (IL_GATED | IL_EXCLUDED | IL_QUIET)); /* dead: found at once, */
    CHECK(health[40][0][4] & IL_STUCK);                            /* and called stuck in the end */
    CHECK(health[31][0][1] & IL_EXCLUDED);                         /* stuck in motion: within two samples */
    CHECK((health[59][0][1] & IL_STUCK) && !(health[99][0][1] & IL_EXCLUDED));
    CHECK(health[71][0][0] == (IL_NOT_FINITE | IL_EXCLUDED));
    CHECK(health[80][1][3] == (IL_GATED | IL_EXCLUDED | IL_QUIET) && health[81][1][3] == (IL_EXCLUDED | IL_QUIET));
    CHECK(health[90][0][0] == (IL_BEYOND | IL_EXCLUDED));
    CHECK((met[101] & IL_NOT_FINITE) && (met[101] & IL_ALONE) && !(met[110] & IL_NOT_FINITE));
}

static void blocks_equal_steps(void) {
    static il_imus_state one, other;
    static il_imus_fused out[V_IMUS_SAMPLES];
    static uint8_t flags[V_IMUS_SAMPLES], health[V_IMUS_SAMPLES][2][5];
    il_real step[V_IMUS_SAMPLES];
    il_imus a;
    BOARD(&a, five);
    for (int k = 0; k < V_IMUS_SAMPLES; k++) step[k] = v_imus_step;
    CHECK(il_imus_start(&a, &one) == IL_OK && il_imus_start(&a, &other) == IL_OK);
    unsigned all = il_imus_block(&a, &one, 70, step, v_imus_five_reading[0], out, flags, &health[0][0][0]);
    all |= il_imus_block(&a, &one, V_IMUS_SAMPLES - 70, step, v_imus_five_reading[70], out + 70, NULL, NULL);
    unsigned each = 0;
    for (int k = 0; k < V_IMUS_SAMPLES; k++) {
        il_imus_fused single;
        const unsigned met = il_imus_step(&a, &other, v_imus_step, v_imus_five_reading[k], &single);
        each |= met;
        CHECK_SAME(&single, &out[k], 1);
        if (k >= 70) continue;
        CHECK(flags[k] == (uint8_t)met);
        CHECK_SAME(other.flags[0], health[k][0], 5);
        CHECK_SAME(other.flags[1], health[k][1], 5);
    }
    CHECK(all == each);
    CHECK_SAME(&one, &other, 1);
}

/* With nothing but what is no number, or with one triad of each left, nothing traps and what is known is given. */
static void last_ones_pass_through(void) {
    static il_imus_state state;
    il_imus a;
    il_imus_fused out;
    BOARD(&a, five);
    CHECK(il_imus_start(&a, &state) == IL_OK);
    il_real reading[30];
    for (int i = 0; i < 30; i++) reading[i] = i % 2 ? NAN_REAL : INF_REAL;
    CHECK(il_imus_step(&a, &state, v_imus_step, reading, &out) & IL_NOT_FINITE);
    CHECK(isnan(out.force[0]) && isnan(out.rate[1]) && isnan(out.acceleration_std[2]));
    memcpy(reading + 3, v_imus_five_reading[3] + 3, 3 * sizeof *reading);
    memcpy(reading + 18, v_imus_five_reading[3] + 18, 3 * sizeof *reading);
    memcpy(a.at, a.position + 3, sizeof a.at);
    const unsigned met = il_imus_step(&a, &state, REAL(0), reading, &out);
    CHECK((met & IL_ALONE) && isfinite(out.force[0]) && isfinite(out.rate[0]) && isnan(out.acceleration[0]));
    CHECK_CLOSE(out.force_std[0], a.accel_noise[1], REAL(1e-5));
    CHECK_CLOSE(out.rate_std[0], a.gyro_noise[1], REAL(1e-5));
    memcpy(reading, v_imus_five_reading[3], 15 * sizeof *reading); /* accelerometers, and no gyroscope */
    for (int i = 15; i < 30; i++) reading[i] = NAN_REAL;
    CHECK((il_imus_step(&a, &state, v_imus_step, reading, &out) & IL_NOT_FINITE) && isnan(out.rate[0]));
}

static void settings_that_cannot_be(void) {
    static il_imus_state state;
    il_imus a;
    il_real zero[5] = {REAL(0)};
    BOARD(&a, five);
    CHECK(il_imus_check(&a) == IL_OK);
#define REFUSED(change)                                 \
    do {                                                \
        BOARD(&a, five);                                \
        change;                                         \
        CHECK(il_imus_start(&a, &state) == IL_ARGUMENT); \
    } while (0)
    REFUSED(a.count = 1);
    REFUSED(a.count = IL_IMUS + 1);
    REFUSED(a.stuck = 1);
    REFUSED(a.quiet = 0);
    REFUSED(a.gate = NAN_REAL);
    REFUSED(a.gyro_rows = NULL);
    REFUSED(a.accel_noise = zero);
    REFUSED(a.gyro_noise = zero);
    REFUSED(a.accel_limit = zero);
    REFUSED(a.gyro_limit = zero);
}

void test_imus(void) {
    fusion_equals_dense_least_squares();
    faults_are_told();
    blocks_equal_steps();
    last_ones_pass_through();
    settings_that_cannot_be();
}
