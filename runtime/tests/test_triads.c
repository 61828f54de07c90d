/* Accelerometer, gyroscope and magnetometer triads, and the flexible gyroscope's drift. */
#include "check.h"
#include "vectors.h"

enum { ORDERS = 5, FORCES = 12, RATES = 10 };

static il_tumble golden_tumble(int order) {
    il_tumble t;
    const int i = order - 1;
    memset(&t, 0, sizeof t);
    t.order = order;
    memcpy(t.gain, v_tumble_gain[i], sizeof t.gain);
    memcpy(t.bias, v_tumble_bias[i], sizeof t.bias);
    memcpy(t.misalignment, v_tumble_misalignment[i], sizeof t.misalignment);
    memcpy(t.low, v_tumble_low[i], sizeof t.low);
    memcpy(t.high, v_tumble_high[i], sizeof t.high);
    memcpy(t.nonlinearity, v_tumble_nonlinearity[i], sizeof t.nonlinearity);
    return t;
}

/* A triad without errors but for one coefficient of the polynomial, the same on every axis. */
static il_tumble polynomial(int order, il_real k, il_real low, il_real high) {
    il_tumble t;
    memset(&t, 0, sizeof t);
    t.order = order;
    for (int i = 0; i < 3; i++) {
        t.gain[i] = REAL(1);
        t.low[i] = low;
        t.high[i] = high;
        t.nonlinearity[order - 2][i] = k;
    }
    return t;
}

static void tumble_equals_the_equations(void) {
    for (int order = 1; order <= ORDERS; order++) {
        const il_tumble t = golden_tumble(order);
        for (int k = 0; k < FORCES; k++) {
            il_real force[3];
            CHECK(il_tumble_apply(&t, v_tumble_output[order - 1][k], force) == 0);
            for (int i = 0; i < 3; i++) {
                CHECK_CLOSE(force[i], v_tumble_force[order - 1][k][i], ROUNDING_LIMIT * REAL(20));
            }
        }
    }
}

/* Cross terms of a few percent within 2 g: the equations forward, and back; what they cannot bear has no force. */
static void cross_terms_are_solved(void) {
    for (int order = 1; order <= ORDERS; order++) {
        il_tumble t = golden_tumble(order);
        t.has_cross = 1;
        for (int i = 0; i < 3; i++) t.cross[i] = REAL(1e-3) * REAL(i + 1);
        for (int k = 0; k < FORCES; k++) {
            const il_real *f = v_tumble_force[order - 1][k];
            const il_real s[3] = {f[0], f[1] + t.misalignment[0] * f[0],
                                  f[2] + t.misalignment[1] * f[0] + t.misalignment[2] * f[1]};
            il_real output[3], force[3];
            for (int i = 0; i < 3; i++) {
                const il_real product = t.cross[i] * s[i] * s[(i + 1) % 3];
                output[i] = v_tumble_output[order - 1][k][i] + product / t.gain[i];
            }
            CHECK(il_tumble_apply(&t, output, force) == 0);
            for (int i = 0; i < 3; i++) CHECK_CLOSE(force[i], f[i], ROUNDING_LIMIT * REAL(40));
        }
        const il_real far[3] = {REAL(1e9), REAL(1e9), REAL(-1e9)}, none[3] = {NAN_REAL, REAL(1), REAL(1)};
        il_real force[3];
        CHECK(il_tumble_apply(&t, far, force) == (unsigned)IL_BEYOND);
        CHECK(force[0] != force[0] && force[1] != force[1] && force[2] != force[2]);
        CHECK(il_tumble_apply(&t, none, force) == (unsigned)IL_NOT_FINITE);
    }
}

static void tumble_blocks_equal_single_samples(void) {
    for (int order = 1; order <= ORDERS; order++) {
        const il_tumble t = golden_tumble(order);
        il_real single[FORCES][3], columns[3][FORCES], rows[FORCES][3], out[3][FORCES];
        for (int k = 0; k < FORCES; k++) {
            (void)il_tumble_apply(&t, v_tumble_output[order - 1][k], single[k]);
            for (int i = 0; i < 3; i++) columns[i][k] = v_tumble_output[order - 1][k][i];
        }
        const il_real *const from[3] = {columns[0], columns[1], columns[2]};
        il_real *const to[3] = {out[0], out[1], out[2]};
        CHECK(il_tumble_block(&t, FORCES, from, 1, to, 1) == 0);
        for (int k = 0; k < FORCES; k++) {
            for (int i = 0; i < 3; i++) CHECK_SAME(&out[i][k], &single[k][i], 1);
        }
        /* interleaved, and in place */
        memcpy(rows, v_tumble_output[order - 1], sizeof rows);
        const il_real *const row_from[3] = {&rows[0][0], &rows[0][1], &rows[0][2]};
        il_real *const row_to[3] = {&rows[0][0], &rows[0][1], &rows[0][2]};
        CHECK(il_tumble_block(&t, FORCES, row_from, 3, row_to, 3) == 0);
        CHECK_SAME(&rows[0][0], &single[0][0], FORCES * 3);
        /* columns in, rows out */
        memset(rows, 0, sizeof rows);
        CHECK(il_tumble_block(&t, FORCES, from, 1, row_to, 3) == 0);
        CHECK_SAME(&rows[0][0], &single[0][0], FORCES * 3);
        il_real *const place[3] = {columns[0], columns[1], columns[2]};
        CHECK(il_tumble_block(&t, FORCES, from, 1, place, 1) == 0);
        CHECK_SAME(&columns[0][0], &out[0][0], 3 * FORCES);
        CHECK(il_tumble_block(&t, 0, from, 1, place, 1) == 0);
    }
}

static void what_is_not_a_number_stays_where_it_reaches(void) {
    static const il_real bad[] = {NAN_REAL, INF_REAL, -INF_REAL};
    for (int order = 1; order <= ORDERS; order++) {
        const il_tumble t = golden_tumble(order);
        for (size_t b = 0; b < LENGTH(bad); b++) {
            for (int axis = 0; axis < 3; axis++) {
                il_real output[3] = {REAL(100), REAL(200), REAL(-300)}, clean[3], force[3];
                CHECK(il_tumble_apply(&t, output, clean) == 0);
                output[axis] = bad[b];
                CHECK(il_tumble_apply(&t, output, force) == IL_NOT_FINITE);
                for (int i = 0; i < 3; i++) { /* x reaches y and z, y reaches z */
                    if (i < axis) CHECK_SAME(&force[i], &clean[i], 1);
                    if (i >= axis) CHECK(!isfinite(force[i]));
                }
                const il_real *const from[3] = {&output[0], &output[1], &output[2]};
                il_real *const to[3] = {&force[0], &force[1], &force[2]};
                CHECK(il_tumble_block(&t, 1, from, 1, to, 1) == IL_NOT_FINITE);
                CHECK(il_tumble_block(&t, 1, from, 3, to, 3) == IL_NOT_FINITE);
            }
        }
    }
}

static void outputs_beyond_a_turning_point_have_no_force(void) {
    /* s - s^3 / 300 turns at s = 10, where it is 20/3 */
    const il_real top = REAL(20.0) / REAL(3.0);
    const il_tumble t = polynomial(3, REAL(-1.0) / REAL(300.0), -top, top);
    static const il_real share[] = {REAL(0.5), REAL(0.9), REAL(0.99), REAL(0.999), REAL(1.001), REAL(2), REAL(1e6)};
    for (size_t i = 0; i < LENGTH(share); i++) {
        for (int sign = -1; sign <= 1; sign += 2) {
            const il_real output[3] = {REAL(sign) * share[i] * top, REAL(0), REAL(0)};
            il_real force[3];
            const unsigned flags = il_tumble_apply(&t, output, force);
            CHECK(flags == (share[i] > REAL(1) ? (unsigned)IL_BEYOND : 0u));
            if (share[i] > REAL(1)) CHECK(isnan(force[0]) && force[1] != force[1]);
            else CHECK_CLOSE(force[0] - force[0] * force[0] * force[0] / REAL(300), output[0], ROUNDING_LIMIT * REAL(10));
        }
    }
    /* Settings whose limits promise more than the polynomial has: said, never looped for. */
    const il_tumble wrong[] = {polynomial(2, REAL(1), REAL(-1e30), REAL(1e30)), polynomial(3, REAL(-1), REAL(-1e30), REAL(1e30)),
                               polynomial(5, REAL(-1), REAL(-1e30), REAL(1e30))};
    for (size_t i = 0; i < LENGTH(wrong); i++) {
        for (int k = -400; k <= 400; k++) {
            const il_real a = REAL(k) / REAL(16), output[3] = {a, REAL(0), REAL(0)};
            il_real force[3];
            const unsigned flags = il_tumble_apply(&wrong[i], output, force);
            CHECK(flags == 0u || flags == (unsigned)IL_BEYOND);
            CHECK((flags == 0u) == (isfinite(force[0]) != 0));
        }
    }
    const il_real below[3] = {REAL(-1000) /* s + s^2 is never below -1/4 */, REAL(0), REAL(0)};
    il_real force[3];
    CHECK(il_tumble_apply(&wrong[0], below, force) == (unsigned)IL_BEYOND);
    CHECK(isnan(force[0]));
}

/* s + k2 s^2 = a: with small whole numbers and a power of two a is exact, and the closed form must give s back. */
static void second_order_is_solved_in_closed_form(void) {
    const il_real k2 = REAL(-0.0078125), top = REAL(32); /* turns at s = 64, where it is 32 */
    for (int i = -2000; i < 64; i++) {
        const il_real s = REAL(i), a[3] = {s + k2 * s * s, -(s + k2 * s * s), REAL(0)}, k[1][3] = {{k2, -k2, k2}};
        const il_real slope = REAL(1) + REAL(2) * k2 * s;
        il_real found[3], slopes[3];
        il_tumble_solve(2, k, a, found, slopes);
        CHECK_CLOSE(found[0], s, ROUNDING_LIMIT * REAL(1 + abs(i)));
        CHECK(found[1] == -found[0] && found[2] == REAL(0) && slopes[2] == REAL(1));
        CHECK_CLOSE(slopes[0], slope, ROUNDING_LIMIT * REAL(100));
        /* Newton's method, which orders above the second take, finds the same where it has steps enough. */
        const il_real more[2][3] = {{k2, -k2, k2}, {REAL(0), REAL(0), REAL(0)}};
        il_real newton[3];
        il_tumble_solve(3, more, a, newton, slopes);
        if (i > -1000 && i < 60) CHECK_CLOSE(newton[0], found[0], ROUNDING_LIMIT * REAL(1000));
    }
    /* Without a second order the output is the solution, to the last bit. */
    const il_real straight[1][3] = {{REAL(0), REAL(0), REAL(0)}}, any[3] = {REAL(0.1), REAL(-3e30), REAL(1e-30)};
    il_real found[3], slopes[3];
    il_tumble_solve(2, straight, any, found, slopes);
    CHECK_SAME(found, any, 3);
    /* At the turning point, beyond it, where the square is beyond all numbers, and for what is not a number. */
    const il_real huge[1][3] = {{REAL(1e30), REAL(0), REAL(0)}};
    const il_real far[3] = {IS_FLOAT ? REAL(1e30) : REAL(1e300), NAN_REAL, INF_REAL};
    const il_real bends[1][3] = {{k2, k2, k2}}, beyond[3] = {top, REAL(33), INF_REAL};
    il_tumble_solve(2, huge, far, found, slopes);
    for (int i = 0; i < 3; i++) CHECK(isnan(found[i]) && isnan(slopes[i]));
    il_tumble_solve(2, bends, beyond, found, slopes);
    for (int i = 0; i < 3; i++) CHECK(isnan(found[i]) && isnan(slopes[i]));
    const il_tumble t = polynomial(2, k2, REAL(-1e30), top);
    il_real force[3];
    const il_real at_top[3] = {top, REAL(0), REAL(0)}, none[3] = {NAN_REAL, REAL(0), REAL(0)}, below[3] = {REAL(31.99), REAL(0), REAL(0)};
    CHECK(il_tumble_apply(&t, at_top, force) == (unsigned)IL_BEYOND && isnan(force[0]));
    CHECK(il_tumble_apply(&t, none, force) == (unsigned)IL_NOT_FINITE && isnan(force[0]));
    CHECK(il_tumble_apply(&t, below, force) == 0 && force[0] < REAL(64) && force[0] > REAL(62));
}

static il_gyro golden_gyro(int sensitive) {
    il_gyro g;
    memset(&g, 0, sizeof g);
    g.has_sensitivity = sensitive;
    memcpy(g.gain, v_gyro_gain, sizeof g.gain);
    memcpy(g.bias, v_gyro_bias, sizeof g.bias);
    memcpy(g.turn, v_gyro_turn, sizeof g.turn);
    memcpy(g.sensitivity, v_gyro_sensitivity, sizeof g.sensitivity);
    return g;
}

static void gyro_equals_the_equations(void) {
    const il_gyro plain = golden_gyro(0), sensitive = golden_gyro(1);
    il_real columns[3][RATES], under[3][RATES], out[3][RATES], single[RATES][3], rows[RATES][3], forces[RATES][3];
    const il_real *const from[3] = {columns[0], columns[1], columns[2]}, *const with[3] = {under[0], under[1], under[2]};
    il_real *const to[3] = {out[0], out[1], out[2]};
    for (int k = 0; k < RATES; k++) {
        il_real rate[3];
        const il_real lost[3] = {NAN_REAL, INF_REAL, NAN_REAL};
        CHECK(il_gyro_apply(&plain, v_gyro_output[k], NULL, rate) == 0);
        for (int i = 0; i < 3; i++) CHECK_CLOSE(rate[i], v_gyro_plain[k][i], ROUNDING_LIMIT * REAL(6));
        CHECK(il_gyro_apply(&plain, v_gyro_output[k], lost, rate) == 0); /* a force that it does not need */
        for (int i = 0; i < 3; i++) CHECK_CLOSE(rate[i], v_gyro_plain[k][i], ROUNDING_LIMIT * REAL(6));
        CHECK(il_gyro_apply(&sensitive, v_gyro_output[k], v_gyro_force[k], single[k]) == 0);
        for (int i = 0; i < 3; i++) {
            CHECK_CLOSE(single[k][i], v_gyro_rate[k][i], ROUNDING_LIMIT * REAL(6));
            columns[i][k] = v_gyro_output[k][i];
            under[i][k] = v_gyro_force[k][i];
        }
    }
    CHECK(il_gyro_block(&sensitive, RATES, from, with, 1, to, 1) == 0);
    for (int k = 0; k < RATES; k++) {
        for (int i = 0; i < 3; i++) CHECK_SAME(&out[i][k], &single[k][i], 1);
    }
    memcpy(rows, v_gyro_output, sizeof rows);
    memcpy(forces, v_gyro_force, sizeof forces);
    const il_real *const row_from[3] = {&rows[0][0], &rows[0][1], &rows[0][2]};
    const il_real *const row_with[3] = {&forces[0][0], &forces[0][1], &forces[0][2]};
    il_real *const row_to[3] = {&rows[0][0], &rows[0][1], &rows[0][2]};
    CHECK(il_gyro_block(&sensitive, RATES, row_from, row_with, 3, row_to, 3) == 0);
    CHECK_SAME(&rows[0][0], &single[0][0], RATES * 3);
    CHECK(il_gyro_block(&plain, RATES, from, NULL, 1, to, 1) == 0);
    CHECK_CLOSE(out[1][4], v_gyro_plain[4][1], ROUNDING_LIMIT * REAL(6));
    CHECK(il_gyro_block(&plain, RATES, from, with, 1, to, 1) == 0);
    CHECK_CLOSE(out[1][4], v_gyro_plain[4][1], ROUNDING_LIMIT * REAL(6));
}

static void gyro_powers_equal_the_equations(void) {
    for (int order = 2; order <= ORDERS; order++) {
        il_gyro g = golden_gyro(1);
        il_real rate[3];
        const il_real far[3] = {REAL(1e30), REAL(1), REAL(1)}, under[3] = {REAL(0), REAL(0), REAL(0)};
        g.order = order;
        memcpy(g.low, v_gyro_low[order - 2], sizeof g.low);
        memcpy(g.high, v_gyro_high[order - 2], sizeof g.high);
        memcpy(g.nonlinearity, v_gyro_nonlinearity[order - 2], sizeof g.nonlinearity);
        for (int k = 0; k < RATES; k++) {
            CHECK(il_gyro_apply(&g, v_gyro_output[k], v_gyro_force[k], rate) == 0);
            for (int i = 0; i < 3; i++) CHECK_CLOSE(rate[i], v_gyro_bent[order - 2][k][i], ROUNDING_LIMIT * REAL(20));
        }
        g.high[0] = REAL(3);
        CHECK(il_gyro_apply(&g, far, under, rate) == (unsigned)IL_BEYOND && isnan(rate[0]));
        CHECK(il_gyro_apply(&g, v_gyro_output[0], NULL, rate) == IL_NOT_FINITE);
    }
}

static void gyro_corners(void) {
    const il_gyro plain = golden_gyro(0), sensitive = golden_gyro(1);
    const il_real *const none[3] = {v_gyro_output[0], v_gyro_output[0], v_gyro_output[0]};
    il_real rate[3];
    il_real *const to[3] = {&rate[0], &rate[1], &rate[2]};
    CHECK(il_gyro_apply(&sensitive, v_gyro_output[0], NULL, rate) == IL_NOT_FINITE); /* its force is missing */
    CHECK(isnan(rate[0]) && isnan(rate[1]) && isnan(rate[2]));
    CHECK(il_gyro_block(&sensitive, 1, none, NULL, 1, to, 1) == IL_NOT_FINITE);
    for (int i = 0; i < 3; i++) {
        il_real output[3] = {REAL(1), REAL(2), REAL(3)}, force[3] = {REAL(1), REAL(2), REAL(3)};
        output[i] = i == 1 ? INF_REAL : NAN_REAL;
        CHECK(il_gyro_apply(&plain, output, NULL, rate) == IL_NOT_FINITE);
        CHECK(!isfinite(rate[0]) && !isfinite(rate[1]) && !isfinite(rate[2]));
        output[i] = REAL(0);
        force[i] = i == 1 ? INF_REAL : NAN_REAL;
        CHECK(il_gyro_apply(&sensitive, output, force, rate) == IL_NOT_FINITE);
        CHECK(!isfinite(rate[0]) && !isfinite(rate[1]) && !isfinite(rate[2]));
    }
}

static il_centrifuge golden_centrifuge(void) {
    il_centrifuge c;
    c.has[0] = c.has[1] = 1;
    c.highest = REAL(150);
    memcpy(c.k0, v_centrifuge_k0, sizeof c.k0);
    memcpy(c.c1, v_centrifuge_c1, sizeof c.c1);
    memcpy(c.c2, v_centrifuge_c2, sizeof c.c2);
    memcpy(c.cosine, v_centrifuge_cosine, sizeof c.cosine);
    memcpy(c.sine, v_centrifuge_sine, sizeof c.sine);
    return c;
}

static void centrifuge_equals_the_equations(void) {
    il_centrifuge c = golden_centrifuge();
    il_real force[2][RATES], rate[2][RATES], single[2][RATES];
    for (int k = 0; k < RATES; k++) {
        il_real out[2] = {v_centrifuge_rate[k][0], v_centrifuge_rate[k][1]};
        CHECK(il_centrifuge_apply(&c, v_centrifuge_force[k], out) == 0);
        for (int i = 0; i < 2; i++) {
            CHECK_CLOSE(out[i], v_centrifuge_expected[k][i], ROUNDING_LIMIT * REAL(1e-3));
            force[i][k] = v_centrifuge_force[k][i];
            rate[i][k] = v_centrifuge_rate[k][i];
            single[i][k] = out[i];
        }
    }
    const il_real *const under[2] = {force[0], force[1]};
    il_real *const both[2] = {rate[0], rate[1]};
    CHECK(il_centrifuge_block(&c, RATES, under, both) == 0);
    CHECK_SAME(&rate[0][0], &single[0][0], 2 * RATES);
    /* one axis that is not there, and one that was not tested */
    for (int k = 0; k < RATES; k++) rate[0][k] = rate[1][k] = v_centrifuge_rate[k][1];
    il_real *const second[2] = {NULL, rate[1]};
    CHECK(il_centrifuge_block(&c, RATES, under, second) == 0);
    CHECK_SAME(rate[1], single[1], RATES);
    c.has[0] = 0;
    const il_real kept = rate[0][3];
    il_real *const first[2] = {rate[0], NULL};
    CHECK(il_centrifuge_block(&c, RATES, under, first) == 0);
    CHECK_SAME(&rate[0][3], &kept, 1);
}

static void centrifuge_corners(void) {
    const il_centrifuge c = golden_centrifuge();
    const il_real strong[2] = {REAL(-120), REAL(120)}, bad[][2] = {{NAN_REAL, REAL(0)}, {REAL(0), NAN_REAL}, {INF_REAL, REAL(1)}};
    il_real rate[2] = {REAL(0), REAL(0)};
    CHECK(il_centrifuge_apply(&c, strong, rate) == IL_BEYOND);
    CHECK(isfinite(rate[0]) && isfinite(rate[1]) && rate[0] != REAL(0));
    for (size_t i = 0; i < LENGTH(bad); i++) {
        rate[0] = rate[1] = REAL(0);
        CHECK((il_centrifuge_apply(&c, bad[i], rate) & ~(unsigned)IL_BEYOND) == IL_NOT_FINITE);
        CHECK(isnan(rate[0]) && isnan(rate[1]));
    }
    rate[0] = INF_REAL;
    rate[1] = REAL(1);
    CHECK(il_centrifuge_apply(&c, v_centrifuge_force[0], rate) == IL_NOT_FINITE);
    CHECK(isnan(rate[0]) && isfinite(rate[1]));
    const il_real *const under[2] = {bad[0], bad[1]};
    il_real lost[2] = {REAL(0), REAL(0)};
    il_real *const both[2] = {&lost[0], &lost[1]};
    CHECK(il_centrifuge_block(&c, 1, under, both) == IL_NOT_FINITE);
}

static il_mag golden_mag(int order) {
    il_mag m;
    m.order = order;
    memcpy(m.gain, v_mag_gain, sizeof m.gain);
    memcpy(m.bias, v_mag_bias, sizeof m.bias);
    memcpy(m.turn, v_mag_turn, sizeof m.turn);
    memcpy(m.quadratic, v_mag_quadratic, sizeof m.quadratic);
    return m;
}

static void mag_equals_the_equations(void) {
    const il_mag plain = golden_mag(1), bent = golden_mag(2);
    il_real single[RATES][3], rows[RATES][3];
    for (int k = 0; k < RATES; k++) {
        il_real field[3];
        CHECK(il_mag_apply(&plain, v_mag_output[k], field) == 0);
        for (int i = 0; i < 3; i++) CHECK_CLOSE(field[i], v_mag_plain[k][i], ROUNDING_LIMIT * REAL(4));
        CHECK(il_mag_apply(&bent, v_mag_output[k], single[k]) == 0);
        for (int i = 0; i < 3; i++) CHECK_CLOSE(single[k][i], v_mag_field[k][i], ROUNDING_LIMIT * REAL(4));
    }
    memcpy(rows, v_mag_output, sizeof rows);
    const il_real *const from[3] = {&rows[0][0], &rows[0][1], &rows[0][2]};
    il_real *const to[3] = {&rows[0][0], &rows[0][1], &rows[0][2]};
    CHECK(il_mag_block(&bent, RATES, from, 3, to, 3) == 0);
    CHECK_SAME(&rows[0][0], &single[0][0], RATES * 3);
}

static void mag_corners(void) {
    il_mag m = golden_mag(2);
    il_real field[3];
    for (int i = 0; i < 3; i++) {
        il_real output[3] = {REAL(1), REAL(2), REAL(3)};
        output[i] = i == 1 ? INF_REAL : NAN_REAL;
        CHECK(il_mag_apply(&m, output, field) == IL_NOT_FINITE);
        CHECK(!isfinite(field[0]) && !isfinite(field[1]) && !isfinite(field[2]));
    }
    const il_real far[3] = {REAL(0), REAL(1e5), REAL(0)}; /* beyond the turning point of 1 - 0.06 s */
    CHECK(il_mag_apply(&m, far, field) == IL_BEYOND && isnan(field[0]));
}

void test_triads(void) {
    tumble_equals_the_equations();
    cross_terms_are_solved();
    tumble_blocks_equal_single_samples();
    what_is_not_a_number_stays_where_it_reaches();
    outputs_beyond_a_turning_point_have_no_force();
    second_order_is_solved_in_closed_form();
    gyro_equals_the_equations();
    gyro_powers_equal_the_equations();
    gyro_corners();
    mag_equals_the_equations();
    mag_corners();
    centrifuge_equals_the_equations();
    centrifuge_corners();
}
