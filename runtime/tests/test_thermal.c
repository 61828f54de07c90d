/* Accelerometers over temperature, against the model computed forward. */
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

void test_thermal(void) {
    equals_the_model();
    ends_of_the_range_are_held();
    what_is_no_number_stays_so();
}
