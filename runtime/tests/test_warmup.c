/* Warm-up tables: every model and exit rule, edges of temperature and time. */
#include "check.h"
#include "vectors.h"

enum { EDGES = 8, AXES = 2, LONG = 1000 };

static il_warmup table_of(int model, int rule) {
    il_warmup w;
    memset(&w, 0, sizeof w);
    w.model = model;
    w.exit = rule;
    w.temperatures = EDGES;
    w.axes = AXES;
    w.terms = model == IL_EXPONENTIAL ? 3 : 4;
    w.settling_time = v_warmup_settling;
    w.taper_time = v_warmup_taper;
    w.time_scale = v_warmup_scale;
    memcpy(w.time_constant, v_warmup_constant, sizeof w.time_constant);
    w.temperature = v_warmup_edges;
    w.coefficient = model == IL_EXPONENTIAL ? &v_warmup_amplitude[0][0][0] : &v_warmup_coefficient[0][0][0];
    w.slope = model == IL_EXPONENTIAL ? &v_warmup_slope[0][0][0] : NULL;
    return w;
}

static void tables_equal_the_equations(void) {
    for (int model = 0; model < 4; model++) {
        for (int rule = 0; rule < 3; rule++) {
            const il_warmup w = table_of(model, rule);
            for (int start = 0; start < V_STARTS; start++) {
                il_warmup_state state;
                CHECK(il_warmup_start(&w, &state, v_warmup_starts[start], v_warmup_tick) == IL_OK);
                for (int k = 0; k < V_TICKS; k++) {
                    il_real bias[AXES];
                    il_warmup_bias(&w, &state, v_warmup_ticks[k], bias);
                    for (int axis = 0; axis < AXES; axis++) {
                        /* full scale: the coefficients add up to about 1e-3 rad/s; 0.01 deg/h are 4.8e-8 rad/s */
                        CHECK_CLOSE(bias[axis], v_warmup_bias[model][rule][start][k][axis], ROUNDING_LIMIT * REAL(1e-3));
                    }
                }
            }
        }
    }
}

static void edges_belong_where_they_belong(void) {
    static const struct {
        il_real temperature;
        int active, row;
    } places[] = {
        {REAL(-40), 1, 0},      {REAL(-40.01), 0, 0}, {REAL(-30.001), 1, 0}, {REAL(-30), 1, 1}, {REAL(-20), 1, 2},
        {REAL(0), 1, 4},        {REAL(39.99), 1, 4},  {REAL(40), 1, 5},      {REAL(50), 1, 6},  {REAL(60), 1, 6},
        {REAL(60.01), 0, 0},    {NAN_REAL, 0, 0},     {INF_REAL, 0, 0},      {-INF_REAL, 0, 0}, {REAL(1e30), 0, 0},
    };
    for (int model = 0; model < 4; model++) {
        const il_warmup w = table_of(model, IL_EXIT_HOLD);
        for (size_t i = 0; i < LENGTH(places); i++) {
            il_warmup_state state;
            il_real bias[AXES] = {REAL(7), REAL(7)}, column[3] = {REAL(1), NAN_REAL, REAL(-0.0)}, before[3];
            const uint32_t ticks[3] = {0, 1, 2};
            il_real *const output[AXES] = {column, NULL};
            const il_real *const input[AXES] = {column, NULL};
            CHECK(il_warmup_start(&w, &state, places[i].temperature, v_warmup_tick) == IL_OK);
            CHECK(state.active == places[i].active && state.row == places[i].row);
            il_warmup_bias(&w, &state, 10, bias);
            CHECK((bias[0] != REAL(0)) == places[i].active && (bias[1] != REAL(0)) == places[i].active);
            memcpy(before, column, sizeof before);
            il_warmup_block(&w, &state, 3, ticks, input, NULL, output);
            if (!places[i].active) CHECK_SAME(column, before, 3); /* outside the table: unchanged to the bit */
            if (places[i].active) CHECK(isnan(column[1]) && column[0] != REAL(1));
        }
    }
}

/* In place, as a unit does it. */
static void subtract(const il_warmup *w, const il_warmup_state *state, size_t n, const uint32_t *ticks, il_real *first,
                     il_real *second) {
    il_real *const columns[AXES] = {first, second};
    const il_real *const same[AXES] = {first, second};
    il_warmup_block(w, state, n, ticks, same, NULL, columns);
}

/* Ticks that rise, and ticks in any order, some at the very ends of a counter. */
static void blocks_equal_single_samples(uint32_t fine) {
    const uint32_t settled = 2400 * fine, ended = 2880 * fine;
    const uint32_t ends[] = {0,         1,     settled - 1, settled,     settled + 1,
                             ended - 1, ended, ended + 1,   4294967294u, 4294967295u};
    static uint32_t ticks[3][LONG];
    static il_real output[AXES][LONG], expected[AXES][LONG], whole[AXES][LONG];
    for (uint32_t k = 0; k < LONG; k++) {
        ticks[0][k] = 3 * k * fine;
        ticks[1][k] = k % 7 == 3 ? ends[k % LENGTH(ends)] : (k * 2654435761u) % (3000u * fine);
        if (k < 300) ticks[1][k] = ended + 20 + k; /* a first chunk in which nothing is left to do */
        ticks[2][k] = settled - LONG + k; /* several samples within a span */
    }
    for (int model = 0; model < 4; model++) {
        for (int rule = 0; rule < 3; rule++) {
            const il_warmup w = table_of(model, rule);
            il_warmup_state state;
            CHECK(il_warmup_start(&w, &state, REAL(21.5), v_warmup_tick / REAL(fine)) == IL_OK);
            CHECK(state.settled == settled && state.ended == ended);
            for (int order = 0; order < 3; order++) {
                for (int k = 0; k < LONG; k++) {
                    il_real bias[AXES];
                    il_warmup_bias(&w, &state, ticks[order][k], bias);
                    for (int axis = 0; axis < AXES; axis++) {
                        output[axis][k] = whole[axis][k] = random_real() * REAL(1e-3);
                        const int over = ticks[order][k] >= state.settled && bias[axis] == REAL(0);
                        expected[axis][k] = over ? output[axis][k] : output[axis][k] - bias[axis];
                    }
                }
                subtract(&w, &state, LONG, ticks[order], whole[0], whole[1]);
                CHECK_SAME(&whole[0][0], &expected[0][0], AXES * LONG);
                for (size_t at = 0, size = 1; at < LONG; at += size, size = size * 3 + 1) { /* blocks of any size */
                    if (size > LONG - at) size = LONG - at;
                    subtract(&w, &state, size, ticks[order] + at, output[0] + at, output[1] + at);
                }
                CHECK_SAME(&output[0][0], &expected[0][0], AXES * LONG);
                const il_real kept = output[0][5];
                subtract(&w, &state, 10, ticks[order], NULL, output[1]);
                CHECK_SAME(&output[0][5], &kept, 1);
            }
        }
    }
}

/* More axes than fit into one pass, each in a unit of its own, from columns that stay as they are. */
static void columns_in_other_units_are_corrected_as_well(void) {
    enum { MANY = 19, FEW = 200 };
    static il_real coefficient[EDGES * MANY * 4], input[MANY][FEW], output[MANY][FEW], kept[MANY][FEW];
    static uint32_t ticks[FEW];
    il_real factor[MANY], *to[MANY];
    const il_real *from[MANY];
    for (size_t i = 0; i < LENGTH(coefficient); i++) coefficient[i] = random_real() * REAL(1e-3);
    for (uint32_t k = 0; k < FEW; k++) ticks[k] = k * 13;
    for (int i = 0; i < MANY; i++) {
        for (int k = 0; k < FEW; k++) kept[i][k] = input[i][k] = random_real();
        factor[i] = (il_real)(1 << (i % 8)) / REAL(16); /* scales without rounding */
        from[i] = input[i];
        to[i] = i == 3 ? NULL : i == 7 ? input[i] : output[i];
    }
    for (int model = 0; model < 4; model++) {
        il_warmup w = table_of(model, IL_EXIT_TAPER);
        il_warmup_state state;
        w.axes = MANY;
        w.coefficient = coefficient;
        w.slope = coefficient + 100;
        w.temperatures = EDGES - 2;
        memcpy(input, kept, sizeof input);
        memset(output, 0, sizeof output);
        CHECK(il_warmup_start(&w, &state, REAL(-12.5), v_warmup_tick) == IL_OK && state.active);
        il_warmup_block(&w, &state, FEW, ticks, from, factor, to);
        for (int k = 0; k < FEW; k++) {
            il_real bias[MANY];
            il_warmup_bias(&w, &state, ticks[k], bias);
            for (int i = 0; i < MANY; i++) {
                const il_real left = kept[i][k] - factor[i] * bias[i];
                CHECK(i == 7 ? input[i][k] == left : i == 3 ? output[i][k] == REAL(0) : output[i][k] == left);
                CHECK(i == 7 || input[i][k] == kept[i][k]);
            }
        }
        CHECK(il_warmup_start(&w, &state, REAL(-50), v_warmup_tick) == IL_OK && !state.active);
        il_warmup_block(&w, &state, FEW, ticks, from, factor, to);
        CHECK_SAME(&output[8][0], &kept[8][0], (MANY - 8) * FEW); /* outside the table: what was given, to the bit */
    }
}

/* Within a span the series stand in for the library: to the last bits of a double, from a tick of a microsecond to one
 * as long as a time constant. */
static void series_equal_the_library(void) {
    static const double lengths[] = {1e-7, 1e-6, 3.7e-5, 1e-3, 0.005, 0.125, 2.0, 15.0};
    il_real unit[2 * 4] = {REAL(0), REAL(1), REAL(0), REAL(0), REAL(0), REAL(1), REAL(0), REAL(0)}, none[2 * 3] = {REAL(0)};
    il_real edge[2] = {REAL(0), REAL(1)};
    const il_real limit = IS_FLOAT ? REAL(1e-6) : REAL(1e-15);
    for (int kind = 0; kind < 4; kind++) { /* log1p, and the decay of each term */
        il_warmup w = table_of(kind == 0 ? IL_KNOT_LOG_CUBIC : IL_EXPONENTIAL, IL_EXIT_ZERO);
        il_real amplitude[2 * 3] = {REAL(0)};
        w.temperatures = 2;
        w.axes = 1;
        w.temperature = edge;
        for (int i = 0; i < 2 && kind > 0; i++) amplitude[3 * i + kind - 1] = REAL(1);
        w.coefficient = kind > 0 ? amplitude : unit;
        w.slope = none;
        for (size_t i = 0; i < LENGTH(lengths); i++) {
            il_warmup_state state;
            const il_real tick = (il_real)lengths[i];
            CHECK(il_warmup_start(&w, &state, REAL(0), tick) == IL_OK);
            CHECK(i > 0 || state.span > 1000);
            for (uint32_t k = 0; k < 5000; k++) {
                const uint32_t ticks = k < 2500 ? k % state.settled : (k * 2654435761u) % state.settled;
                const double t = (double)ticks * (double)tick;
                const double exact = kind > 0 ? exp(-t / (double)w.time_constant[kind - 1])
                                              : log1p(t / (double)w.time_scale) /
                                                    log1p((double)w.settling_time / (double)w.time_scale);
                il_real bias;
                il_warmup_bias(&w, &state, ticks, &bias);
                CHECK_CLOSE(bias, (il_real)exact, limit);
            }
        }
    }
}

static void time_is_limited_to_what_a_counter_holds(void) {
    il_warmup w = table_of(IL_INTERVAL_CUBIC, IL_EXIT_TAPER);
    il_warmup_state state;
    il_real bias[AXES];
    CHECK(il_warmup_start(&w, &state, REAL(20), REAL(1e-9)) == IL_OK); /* 300 s are 3e11 ticks */
    CHECK(state.settled == UINT32_MAX && state.ended == UINT32_MAX);
    il_warmup_bias(&w, &state, UINT32_MAX - 1u, bias);
    CHECK(bias[0] != REAL(0));
    il_warmup_bias(&w, &state, UINT32_MAX, bias);
    CHECK(bias[0] == REAL(0));
    CHECK(il_warmup_start(&w, &state, REAL(20), REAL(1000)) == IL_OK); /* 300 s end within the first tick */
    CHECK(state.settled == 1 && state.ended == 1);
    CHECK(il_warmup_start(&w, &state, REAL(20), REAL(7)) == IL_OK); /* 42.86 and 51.4 ticks: rounded up */
    CHECK(state.settled == 43 && state.ended == 52);
    CHECK(il_warmup_start(&w, &state, REAL(20), REAL(100)) == IL_OK);
    CHECK(state.settled == 3);
    w.settling_time = REAL(-5); /* no table has these, but nothing breaks */
    CHECK(il_warmup_start(&w, &state, REAL(20), REAL(1)) == IL_OK && state.settled == 0 && state.ended == 55);
    w.settling_time = NAN_REAL;
    CHECK(il_warmup_start(&w, &state, REAL(20), REAL(1)) == IL_OK && state.settled == 0 && state.ended == 0);
    il_warmup_bias(&w, &state, 0, bias);
    CHECK(bias[0] == REAL(0) && bias[1] == REAL(0));
    w.settling_time = INF_REAL;
    CHECK(il_warmup_start(&w, &state, REAL(20), REAL(1)) == IL_OK && state.settled == UINT32_MAX);
}

static void settings_that_cannot_be_are_refused(void) {
    static const il_real wrong[] = {REAL(0), REAL(-1), NAN_REAL, INF_REAL, -INF_REAL};
    il_warmup w = table_of(IL_KNOT_CUBIC, IL_EXIT_ZERO);
    for (size_t i = 0; i < LENGTH(wrong); i++) {
        il_warmup_state state;
        il_real bias[AXES];
        CHECK(il_warmup_start(&w, &state, REAL(20), wrong[i]) == IL_ARGUMENT);
        CHECK(!state.active);
        il_warmup_bias(&w, &state, 1, bias);
        CHECK(bias[0] == REAL(0) && bias[1] == REAL(0));
    }
    for (int32_t few = -1; few < 2; few++) {
        il_warmup_state state;
        w.temperatures = few;
        CHECK(il_warmup_start(&w, &state, REAL(20), v_warmup_tick) == IL_ARGUMENT && !state.active);
    }
}

void test_warmup(void) {
    tables_equal_the_equations();
    edges_belong_where_they_belong();
    blocks_equal_single_samples(1);
    blocks_equal_single_samples(64);
    columns_in_other_units_are_corrected_as_well();
    series_equal_the_library();
    time_is_limited_to_what_a_counter_holds();
    settings_that_cannot_be_are_refused();
}
