/* Triads over temperature, against the model computed forward. */
#include "check.h"

enum { PIECES = 2, TERMS = 3, SAMPLES = 40 };

static const il_real KNOTS[PIECES + 1] = {REAL(-20), REAL(10), REAL(60)};
static il_real coefficients[PIECES * IL_THERMAL_LAWS * TERMS];

/* Laws of MEMS size that differ from axis to axis and from piece to piece. */
static il_thermal triad(int pieces, int terms) {
    const il_thermal t = {.pieces = pieces, .terms = terms, .knot = KNOTS, .coefficient = coefficients};
    for (int p = 0; p < pieces; p++) {
        for (int i = 0; i < IL_THERMAL_LAWS; i++) {
            for (int k = 0; k < terms; k++) {
                const il_real size = i < 3 ? REAL(0.3) : REAL(0.02);
                const il_real own = size * random_real() / REAL(1 + 9 * k);
                coefficients[(p * IL_THERMAL_LAWS + i) * terms + k] = own + REAL(i / 3 == 1 && k == 0);
            }
        }
    }
    return t;
}

/* A parameter by sums of powers, in its piece. */
static il_real law(const il_thermal *t, int piece, int i, il_real temperature) {
    const il_real low = KNOTS[piece], high = KNOTS[piece + 1];
    const il_real theta = (REAL(2) * temperature - low - high) / (high - low);
    il_real sum = REAL(0), power = REAL(1);
    for (int k = 0; k < t->terms; k++, power *= theta) sum += power * t->coefficient[(piece * IL_THERMAL_LAWS + i) * t->terms + k];
    return sum;
}

/* M = S (T_m f + b). */
static void outputs(const il_thermal *t, int piece, il_real temperature, const il_real f[3], il_real m[3]) {
    il_real p[IL_THERMAL_LAWS];
    for (int i = 0; i < IL_THERMAL_LAWS; i++) p[i] = law(t, piece, i, temperature);
    m[0] = p[3] * (f[0] + p[0]);
    m[1] = p[4] * (p[6] * f[0] + f[1] + p[1]);
    m[2] = p[5] * (p[7] * f[0] + p[8] * f[1] + f[2] + p[2]);
}

static void equals_the_model(void) {
    for (int terms = 1; terms <= TERMS; terms++) {
        const il_thermal t = triad(PIECES, terms);
        il_real temperature[SAMPLES], m[3][SAMPLES], block[3][SAMPLES], single[3][SAMPLES];
        il_thermal_state state;
        il_thermal_start(&state);
        for (int k = 0; k < SAMPLES; k++) {
            il_real f[3], output[3], force[3];
            for (int i = 0; i < 3; i++) f[i] = REAL(19) * random_real();
            temperature[k] = REAL(20) + REAL(40) * (k % 3 ? temperature[k - 1] / REAL(40) - REAL(0.5) : random_real());
            outputs(&t, temperature[k] >= KNOTS[1], temperature[k], f, output);
            CHECK(il_thermal_apply(&t, &state, temperature[k], output, force) == 0);
            for (int i = 0; i < 3; i++) {
                CHECK_CLOSE(force[i], f[i], ROUNDING_LIMIT * REAL(40));
                m[i][k] = output[i];
                single[i][k] = force[i];
            }
        }
        const il_real *from[3] = {m[0], m[1], m[2]};
        il_real *to[3] = {block[0], block[1], block[2]};
        CHECK(il_thermal_block(&t, SAMPLES, temperature, from, 1, to, 1) == 0);
        CHECK_SAME(&block[0][0], &single[0][0], 3 * SAMPLES);
    }
}

static void ends_of_the_range_are_held(void) {
    const il_thermal t = triad(PIECES, TERMS);
    const il_real f[3] = {REAL(3), REAL(-4), REAL(8)}, outside[2] = {REAL(-80), REAL(61)};
    for (int end = 0; end < 2; end++) {
        il_real output[3], force[3];
        il_thermal_state state;
        il_thermal_start(&state);
        outputs(&t, end, KNOTS[end * PIECES], f, output);
        CHECK(il_thermal_apply(&t, &state, outside[end], output, force) == IL_BEYOND);
        CHECK(il_thermal_apply(&t, &state, outside[end], output, force) == IL_BEYOND); /* the same bits again */
        for (int i = 0; i < 3; i++) CHECK_CLOSE(force[i], f[i], ROUNDING_LIMIT * REAL(40));
        CHECK(il_thermal_apply(&t, &state, KNOTS[end * PIECES], output, force) == 0);
    }
}

static void what_is_no_number_stays_so(void) {
    const il_thermal t = triad(1, TERMS);
    const il_real lost[3] = {NAN_REAL, INF_REAL, -INF_REAL}, whole[3] = {REAL(1), REAL(2), REAL(3)};
    il_thermal_state state;
    il_thermal_start(&state);
    for (int k = 0; k < 3; k++) {
        il_real force[3];
        CHECK(il_thermal_apply(&t, &state, lost[k], whole, force) == IL_NOT_FINITE);
        for (int i = 0; i < 3; i++) CHECK(isnan(force[i]));
        CHECK(il_thermal_apply(&t, &state, REAL(5), whole, force) == 0); /* and goes on */
        const il_real output[3] = {REAL(1), lost[k], REAL(3)};
        CHECK(il_thermal_apply(&t, &state, REAL(5), output, force) == IL_NOT_FINITE);
        CHECK(isfinite(force[0]) && !isfinite(force[1]));
    }
}

/* M = S (T w + b + G f), with T and its inverse both written out. */
static void gyroscopes_equal_the_model(void) {
    for (int with = 0; with < 2; with++) {
        il_real own[IL_THERMAL_GYRO_LAWS * TERMS];
        il_thermal_gyro t = {.has_sensitivity = with, .pieces = 1, .terms = TERMS, .knot = KNOTS, .coefficient = own};
        const il_real a = REAL(0.01), b = REAL(-0.02), c = REAL(0.015);
        const il_real inverse[3][3] = {{1, -a, a * c - b}, {0, 1, -c}, {0, 0, 1}}; /* of {{1, a, b}, {0, 1, c}, {0, 0, 1}} */
        memcpy(t.turn, inverse, sizeof inverse);
        for (int i = 0; i < IL_THERMAL_GYRO_LAWS; i++) {
            for (int k = 0; k < TERMS; k++) {
                own[i * TERMS + k] = REAL(0.02) * random_real() / REAL(1 + 9 * k) + REAL(i / 3 == 1 && k == 0);
            }
        }
        for (int i = 0; i < 9 && with; i++) t.sensitivity[i / 3][i % 3] = REAL(1e-3) * random_real();
        il_real m[3][SAMPLES], f[3][SAMPLES], temperature[SAMPLES], block[3][SAMPLES], single[3][SAMPLES];
        il_thermal_gyro_state state;
        il_thermal_gyro_start(&state);
        for (int k = 0; k < SAMPLES; k++) {
            il_real w[3], rate[3], law[IL_THERMAL_GYRO_LAWS], output[3], force[3];
            temperature[k] = k % 3 ? temperature[k - 1] : REAL(-5) + REAL(14) * random_real();
            const il_real theta = (REAL(2) * temperature[k] - KNOTS[0] - KNOTS[1]) / (KNOTS[1] - KNOTS[0]);
            for (int i = 0; i < IL_THERMAL_GYRO_LAWS; i++) {
                law[i] = own[i * TERMS] + theta * own[i * TERMS + 1] + theta * theta * own[i * TERMS + 2];
            }
            for (int i = 0; i < 3; i++) {
                w[i] = REAL(5) * random_real();
                f[i][k] = force[i] = REAL(19) * random_real();
            }
            const il_real sensed[3] = {w[0] + a * w[1] + b * w[2], w[1] + c * w[2], w[2]};
            for (int i = 0; i < 3; i++) {
                il_real felt = REAL(0);
                for (int j = 0; j < 3; j++) felt += t.sensitivity[i][j] * force[j];
                m[i][k] = output[i] = law[3 + i] * (sensed[i] + law[i] + felt);
            }
            CHECK(il_thermal_gyro_apply(&t, &state, temperature[k], output, with ? force : NULL, rate) == 0);
            for (int i = 0; i < 3; i++) {
                CHECK_CLOSE(rate[i], w[i], ROUNDING_LIMIT * REAL(40));
                single[i][k] = rate[i];
            }
        }
        const il_real *from[3] = {m[0], m[1], m[2]}, *under[3] = {f[0], f[1], f[2]};
        il_real *to[3] = {block[0], block[1], block[2]}, rate[3];
        CHECK(il_thermal_gyro_block(&t, SAMPLES, temperature, from, with ? under : NULL, 1, to, 1) == 0);
        CHECK_SAME(&block[0][0], &single[0][0], 3 * SAMPLES);
        const il_real output[3] = {REAL(1), REAL(2), REAL(3)};
        CHECK(il_thermal_gyro_apply(&t, &state, REAL(11), output, output, rate) == IL_BEYOND);
        CHECK(il_thermal_gyro_apply(&t, &state, NAN_REAL, output, output, rate) == IL_NOT_FINITE);
        CHECK(isnan(rate[0]) && isnan(rate[1]) && isnan(rate[2]));
        CHECK((il_thermal_gyro_apply(&t, &state, REAL(0), output, NULL, rate) == IL_NOT_FINITE) == with);
    }
}

void test_thermal(void) {
    equals_the_model();
    ends_of_the_range_are_held();
    what_is_no_number_stays_so();
    gyroscopes_equal_the_model();
}
