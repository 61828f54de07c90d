/* Gyro array, the robust method: every fault of the methods document, its flags, and a bound on what it does to the rate. */
#include "arrays.h"

static il_real rate[V_SAMPLES], clean[V_SAMPLES];
static uint8_t flags[V_SAMPLES][V_ELEMENTS];

/* The methods document determines what healthy gyros give, growing memory or not. */
static void healthy_gyros_give_what_the_document_says(void) {
    for (int fixed = 0; fixed < 2; fixed++) {
        il_array a = settings_of(IL_ROBUST);
        a.memory = fixed ? REAL(0.015625) : REAL(0);
        CHECK(run(&a, 0, rate, NULL) == 0);
        compare(rate, v_robust_rate[fixed], ROUNDING_LIMIT * REAL(0.5), __LINE__);
    }
    il_array a = settings_of(IL_ROBUST);
    a.weight = v_array_reliability;
    CHECK(run(&a, 0, rate, NULL) == 0);
    compare(rate, v_robust_calibrated, ROUNDING_LIMIT * REAL(0.5), __LINE__);
}

/* A sample in which all is well is fused without the questions of the long way: with them it gives the same. */
static void the_short_way_gives_what_the_long_way_gives(void) {
    for (int scenario = 0; scenario < V_SCENARIOS; scenario++) {
        il_array a = settings_of(IL_ROBUST);
        il_array_state quick, thorough;
        a.memory = scenario == 15 ? REAL(0.015625) : REAL(0);
        CHECK(il_array_start(&a, &quick) == IL_OK && il_array_start(&a, &thorough) == IL_OK);
        for (int k = 0; k < V_SAMPLES; k++) {
            il_real reading[V_ELEMENTS], out, expected;
            for (int i = 0; i < V_ELEMENTS; i++) reading[i] = faulty(scenario, k, i);
            thorough.axis[0].well = 0;
            const unsigned met = il_array_step(&a, &quick, reading, &out);
            CHECK(il_array_step(&a, &thorough, reading, &expected) == met);
            CHECK(memcmp(quick.axis[0].flags, thorough.axis[0].flags, V_ELEMENTS) == 0);
            CHECK((isnan(out) != 0) == (isnan(expected) != 0));
            if (!isnan(expected)) CHECK_CLOSE(out, expected, ROUNDING_LIMIT * REAL(scenario == 3 || scenario == 13 ? 5 : 0.5));
        }
    }
}

/* Flags that gyro i carried in samples [from, to), or-ed. */
static unsigned carried(int i, int from, int to) {
    unsigned met = 0;
    for (int k = from; k < to; k++) met |= flags[k][i];
    return met;
}

/* Largest difference from the rate of healthy gyros in samples [from, to). */
static il_real departure(int from, int to) {
    il_real most = REAL(0);
    for (int k = from; k < to; k++) {
        const il_real error = rate[k] < clean[k] ? clean[k] - rate[k] : rate[k] - clean[k];
        if (!(error <= most)) most = error;
    }
    return most;
}

static void faults_are_named_and_bounded(void) {
    const il_array a = settings_of(IL_ROBUST);
    const il_real noise = REAL(2e-3); /* about four standard deviations of the fused rate */
    CHECK(run(&a, 0, clean, &flags[0][0]) == 0);
    for (int i = 0; i < V_ELEMENTS; i++) CHECK(carried(i, 0, V_SAMPLES) == 0);

    (void)run(&a, 1, rate, &flags[0][0]); /* dead from the start: stuck within 2 s at 50 Hz */
    CHECK(carried(2, 0, 100) & IL_STUCK && carried(2, 100, V_SAMPLES) & IL_EXCLUDED);
    CHECK(departure(100, V_SAMPLES) < noise);
    CHECK(carried(0, 100, V_SAMPLES) == 0);

    (void)run(&a, 2, rate, &flags[0][0]); /* stuck in motion */
    CHECK(carried(1, 150, 250) & IL_STUCK && !(carried(1, 0, 150) & IL_STUCK));
    CHECK(departure(0, V_SAMPLES) < REAL(4) * noise);

    (void)run(&a, 3, rate, &flags[0][0]); /* spikes of 300 deg/s */
    for (int k = 5; k < V_SAMPLES; k += 37) CHECK(flags[k][3] & IL_GATED && flags[k][3] & IL_EXCLUDED);
    CHECK(departure(0, V_SAMPLES) < noise);

    (void)run(&a, 4, rate, &flags[0][0]); /* bursts of what is not a number */
    CHECK(flags[100][0] & IL_NOT_FINITE && flags[202][4] & IL_NOT_FINITE && flags[135][0] & IL_QUIET);
    CHECK(carried(0, 190, V_SAMPLES) == 0);
    CHECK(departure(0, V_SAMPLES) < noise);

    (void)run(&a, 5, rate, &flags[0][0]); /* a jump: found, learnt, taken back */
    CHECK(carried(5, 200, 240) & IL_JUMPED && carried(5, 390, V_SAMPLES) == 0);
    CHECK(departure(0, V_SAMPLES) < noise);

    (void)run(&a, 6, rate, &flags[0][0]); /* a jump below the gate: at most beta times the weight, then found */
    CHECK(carried(5, 270, 370) & IL_JUMPED);
    CHECK(departure(0, V_SAMPLES) < noise);

    CHECK(run(&a, 7, rate, &flags[0][0]) & IL_NOT_FINITE); /* all lost: no rate, in exactly these samples */
    for (int k = 0; k < V_SAMPLES; k++) CHECK((isnan(rate[k]) != 0) == (k >= 200 && k < 210));
    CHECK(flags[205][3] == (IL_NOT_FINITE | IL_EXCLUDED | IL_ALONE));

    CHECK(run(&a, 8, rate, &flags[0][0]) & IL_ALONE); /* all but one: it passes through, and says so */
    CHECK(flags[230][4] & IL_ALONE && !(flags[230][4] & IL_EXCLUDED) && flags[230][0] & IL_EXCLUDED);
    CHECK(departure(0, V_SAMPLES) < REAL(0.01));

    CHECK(run(&a, 9, rate, &flags[0][0]) & IL_ALONE); /* all but two: they count alike */
    CHECK(departure(0, V_SAMPLES) < REAL(0.01));

    (void)run(&a, 11, rate, &flags[0][0]); /* back after being stuck */
    CHECK(carried(1, 100, 250) & IL_STUCK && carried(1, V_SAMPLES - 1, V_SAMPLES) == 0);

    (void)run(&a, 13, rate, &flags[0][0]); /* the very first reading is a spike: forgotten within 1 s */
    CHECK(departure(50, V_SAMPLES) < noise);

    (void)run(&a, 14, rate, &flags[0][0]); /* one that comes late is watched, then used */
    CHECK(flags[155][2] & IL_QUIET && carried(2, 300, V_SAMPLES) == 0);
}

/* Weights: one to three gyros, the cap, and its use against a gyro that looks perfect. */
static void weights_are_capped(void) {
    il_array a = settings_of(IL_ROBUST);
    il_array_state state;
    il_real out, reading[V_ELEMENTS];
    a.weight_floor = REAL(1e-6);
    CHECK(il_array_start(&a, &state) == IL_OK);
    for (int k = 0; k < V_SAMPLES; k++) {
        for (int i = 0; i < V_ELEMENTS; i++) reading[i] = random_real() * REAL(i == 2 ? 1e-5 : 1e-2);
        (void)il_array_step(&a, &state, reading, &out);
        il_real sum = REAL(0), most = REAL(0);
        for (int i = 0; i < V_ELEMENTS; i++) {
            sum += state.axis[0].weight[i];
            if (state.axis[0].weight[i] > most) most = state.axis[0].weight[i];
        }
        CHECK_CLOSE(sum, REAL(1), REAL(4) * ROUNDING_LIMIT);
        CHECK(most <= REAL(0.5));
    }
    CHECK(state.axis[0].weight[2] == REAL(0.5));
    for (int lost = 0; lost < V_ELEMENTS; lost++) { /* gyros go one by one */
        reading[lost] = NAN_REAL;
        const unsigned met = il_array_step(&a, &state, reading, &out);
        CHECK(met & IL_NOT_FINITE && (isnan(out) != 0) == (lost == V_ELEMENTS - 1));
        CHECK(((met & IL_ALONE) != 0) == (lost >= 3));
    }
}

/* Three gyros are the fewest: what one of them does reaches the rate by a third at most. */
static void three_gyros_are_enough(void) {
    il_array a = settings_of(IL_ROBUST);
    a.elements = 3;
    for (int scenario = 0; scenario < 4; scenario++) {
        il_array_state state;
        il_real out = REAL(0);
        unsigned met = 0;
        CHECK(il_array_start(&a, &state) == IL_OK);
        for (int k = 0; k < V_SAMPLES; k++) {
            il_real reading[3] = {v_array_base[k][0], v_array_base[k][1], v_array_base[k][2]};
            if (scenario == 1 && k > 200) reading[1] += REAL(1);                                 /* a jump */
            if (scenario == 2 && k == 0) reading[1] += REAL(100);                                /* a spike at the start */
            if (scenario == 3 && k > 200) reading[0] = reading[1] = v_array_base[200][1];        /* two are stuck */
            met |= il_array_step(&a, &state, reading, &out);
            if (k < 60 || (scenario == 3 && k < 260)) continue;
            CHECK_CLOSE(out, v_array_turn[k], scenario == 1 ? REAL(1) / REAL(3) + REAL(0.02) : REAL(0.02));
        }
        CHECK(((met & IL_STUCK) != 0) == (scenario == 3));
        CHECK(((met & IL_GATED) != 0) == (scenario == 1 || scenario == 2));
        CHECK(((met & IL_BEYOND) != 0) == (scenario == 3)); /* held, before they are known to be stuck */
        CHECK((met == 0) == (scenario == 0));
    }
}

/* While two of three are alone they learn how noisy they are, so that the third, whose first readings are lost, is let in. */
static void two_let_the_third_in(void) {
    il_array a = settings_of(IL_ROBUST);
    a.elements = 3;
    il_array_state state;
    il_real out = REAL(0);
    CHECK(il_array_start(&a, &state) == IL_OK);
    for (int k = 0; k < V_SAMPLES; k++) {
        const il_real reading[3] = {v_array_base[k][0], v_array_base[k][1], k < 150 ? NAN_REAL : v_array_base[k][2]};
        (void)il_array_step(&a, &state, reading, &out);
        CHECK(k > 205 ? state.axis[0].flags[2] == 0 : k > 195 || (state.axis[0].flags[2] & IL_EXCLUDED) != 0);
    }
}

/* Run n healthy samples, so that biases and variances are known. */
static void warm(const il_array *a, il_array_state *state, int n) {
    il_real out;
    CHECK(il_array_start(a, state) == IL_OK);
    for (int k = 0; k < n; k++) (void)il_array_step(a, state, v_array_base[k], &out);
}

static void a_scale_factor_is_no_jump(void) {
    const il_array a = settings_of(IL_ROBUST);
    for (int jumps = 0; jumps < 2; jumps++) {
        il_array_state state;
        unsigned met = 0;
        warm(&a, &state, 200);
        for (int k = 0; k < 100; k++) { /* 10 rad/s, and one gyro 0.5 % or 5 % off: within the tolerance, or not */
            il_real reading[V_ELEMENTS], out;
            for (int i = 0; i < V_ELEMENTS; i++) reading[i] = REAL(10) + v_array_base[k][i] - v_array_turn[k];
            reading[3] += jumps ? REAL(0.5) : REAL(0.05);
            met |= il_array_step(&a, &state, reading, &out);
            CHECK_CLOSE(out, REAL(10), REAL(0.01));
        }
        CHECK(met & IL_GATED && ((met & IL_JUMPED) != 0) == jumps);
    }
}

static void the_most_central_gyro_serves_where_all_are_gated(void) {
    il_array a = settings_of(IL_ROBUST);
    il_array_state state;
    il_real reading[4], out;
    a.elements = 4;
    a.spread_gate = REAL(0); /* else half of them are always inside */
    CHECK(il_array_start(&a, &state) == IL_OK);
    for (int k = 0; k < 200; k++) {
        for (int i = 0; i < 4; i++) reading[i] = REAL(1e-3) * random_real();
        (void)il_array_step(&a, &state, reading, &out);
    }
    reading[0] = REAL(1);
    reading[1] = REAL(2);
    reading[2] = REAL(-1);
    reading[3] = REAL(-2);
    CHECK(il_array_step(&a, &state, reading, &out) & IL_ALONE);
    CHECK_CLOSE(out < REAL(0) ? -out : out, REAL(1), REAL(0.01));
    CHECK(state.axis[0].weight[0] + state.axis[0].weight[2] == REAL(1));
}

static il_real sine(il_real x) {
    return (il_real)sin((double)x);
}

/* Three sines of 60 deg/s together, in rad/s at time t. */
static il_real turning(il_real t) {
    return REAL(0.5) * sine(REAL(3) * t + REAL(1)) + REAL(0.4) * sine(REAL(7) * t + REAL(2)) + REAL(0.2) * sine(REAL(11) * t);
}

/* An array that starts in motion takes nothing of a gyro's lateness or scale factor for a bias; at rest it forgets. */
static void what_moves_with_the_rate_is_no_bias(void) {
    for (int fault = 0; fault < 3; fault++) {
        il_array a = settings_of(IL_ROBUST);
        il_array_state state;
        il_array_axis *s = &state.axis[0];
        il_real out, away = REAL(0);
        unsigned met = 0;
        a.elements = 6 - fault % 2;
        a.memory = fault == 2 ? REAL(0.0078125) : REAL(0);
        CHECK(il_array_start(&a, &state) == IL_OK);
        for (int k = 0; k < 6000; k++) {
            const il_real t = REAL(k) / REAL(50), rate_now = k < 3000 ? turning(t) : REAL(0);
            il_real reading[6];
            for (int i = 0; i < a.elements; i++) reading[i] = rate_now + REAL(1e-3) * random_real() + REAL(0.002) * REAL(i - 2);
            if (k < 3000 && fault != 1) reading[3] += turning(t - REAL(0.006)) - rate_now;
            if (k < 3000 && fault == 1) reading[3] += REAL(0.03) * rate_now;
            met |= il_array_step(&a, &state, reading, &out);
            if (k == 2999) {
                for (int i = 0; i < a.elements; i++) { /* differences of the biases, which are 0.002 from one to the next */
                    const il_real off = s->bias[i] - s->bias[0] - REAL(0.002) * REAL(i);
                    CHECK((off < REAL(0) ? -off : off) < (fault == 2 ? REAL(4e-3) : REAL(1e-3)));
                }
                CHECK(s->motion == 17);
            }
            if (k >= 250 && k < 3000) away += (out - rate_now - (a.elements == 6 ? REAL(0.001) : REAL(0))) / REAL(2750);
        }
        CHECK((away < REAL(0) ? -away : away) < REAL(5e-4));
        CHECK(!(met & (IL_JUMPED | IL_STUCK | IL_BEYOND)));
        CHECK((s->motion == 16) == (fault == 2)); /* growing memory would take longer */
    }
}

/* Rates whose squares are beyond all numbers tell nothing of the motion, and leave nothing behind. */
static void motion_beyond_all_numbers(void) {
    const il_array a = settings_of(IL_ROBUST);
    const il_real far = IS_FLOAT ? REAL(1e25) : REAL(1e80) * REAL(1e80);
    il_array_state state;
    il_real out = REAL(0);
    CHECK(il_array_start(&a, &state) == IL_OK);
    for (int k = 0; k < 60; k++) {
        il_real reading[V_ELEMENTS];
        for (int i = 0; i < V_ELEMENTS; i++) reading[i] = k == 40 ? far : v_array_base[k][i];
        (void)il_array_step(&a, &state, reading, &out);
        CHECK(isfinite(out) && isfinite(state.axis[0].motion_square[0]));
        if (k <= 40) CHECK(state.axis[0].motion == (k < 15 ? (uint32_t)k + 1 : 16));
    }
}

/* Two of six at the end of their range, on both sides, from the first sample on. */
static void held_readings_do_not_count(void) {
    il_array a = settings_of(IL_ROBUST);
    il_array_state state;
    CHECK(il_array_start(&a, &state) == IL_OK);
    for (int k = 0; k < 1000; k++) {
        const il_real now = -REAL(0.22) * sine(REAL(0.02) * REAL(k) + REAL(1)), range = REAL(0.17);
        il_real reading[V_ELEMENTS], out;
        for (int i = 0; i < V_ELEMENTS; i++) {
            reading[i] = now + REAL(1e-3) * random_real();
            if (i < 2 && reading[i] > range) reading[i] = range;
            if (i < 2 && reading[i] < -range) reading[i] = -range;
        }
        const unsigned met = il_array_step(&a, &state, reading, &out);
        CHECK(((met & (IL_BEYOND | IL_STUCK)) != 0) <= (now < -range + REAL(0.01) || now > range - REAL(0.01)));
        if (k > 50) CHECK_CLOSE(out, now, REAL(4e-3));
    }
}

/* Newcomers are used at once where nobody else is left. */
static void nobody_waits_for_nobody(void) {
    const il_array a = settings_of(IL_ROBUST);
    il_array_state state;
    CHECK(il_array_start(&a, &state) == IL_OK);
    for (int k = 0; k < V_SAMPLES; k++) {
        il_real reading[V_ELEMENTS], out;
        for (int i = 0; i < V_ELEMENTS; i++) reading[i] = (i < 3) == (k < 100) ? v_array_base[k][i] : NAN_REAL;
        CHECK(il_array_step(&a, &state, reading, &out) & IL_NOT_FINITE && isfinite(out));
        CHECK_CLOSE(out, v_array_turn[k], REAL(0.02));
        CHECK(state.axis[0].weight[k < 100 ? 0 : 3] > REAL(0));
    }
}

/* Variances as only garbage can leave them: the weights still sum to one. */
static void weights_survive_any_variances(void) {
    const il_array a = settings_of(IL_ROBUST);
    const il_real huge = IS_FLOAT ? REAL(1e28) : REAL(1e290);
    il_array_state state;
    il_real out, sum = REAL(0);
    warm(&a, &state, 100);
    for (int i = 0; i < V_ELEMENTS; i++) state.axis[0].variance[i] = i == 1 ? -REAL(6) * huge : huge;
    (void)il_array_step(&a, &state, v_array_base[100], &out);
    for (int i = 0; i < V_ELEMENTS; i++) sum += state.axis[0].weight[i];
    CHECK_CLOSE(sum, REAL(1), ROUNDING_LIMIT);
    CHECK_CLOSE(out, v_array_turn[100], REAL(0.02));
}

/* Everything that random faults can do to an array: finite in, finite out, whatever came before; weights sum to one. */
static void random_faults_never_break_it(void) {
    for (int trial = 0; trial < 240; trial++) {
        il_array a = settings_of(IL_ROBUST);
        il_array_state state;
        int fault[V_ELEMENTS] = {0};
        il_real held[V_ELEMENTS] = {REAL(0)};
        a.elements = 3 + trial % 4;
        a.quiet = 1u + (uint32_t)(trial % 40);
        a.jump = 2u + (uint32_t)(trial % 20);
        a.stuck = 2u + (uint32_t)(trial % 15);
        a.cap = trial % 3 ? 5000 : 40;
        a.memory = trial % 5 ? REAL(0) : REAL(0.02);
        a.start = trial % 7 ? 1 : 60;
        a.initial = trial % 3;
        a.bias = v_array_bias;
        a.weight = trial % 4 ? NULL : v_array_reliability;
        CHECK(il_array_start(&a, &state) == IL_OK);
        for (int k = 0; k < V_SAMPLES; k++) {
            il_real reading[V_ELEMENTS], out, sum = REAL(0);
            int finite = 0;
            for (int i = 0; i < a.elements; i++) {
                if (random_real() > REAL(0.97)) fault[i] = fault[i] ? 0 : 1 + (int)(REAL(3.99) * (REAL(1) + random_real()));
                il_real x = v_array_base[k][i];
                switch (fault[i]) {
                    case 1: x = held[i]; break;
                    case 2: x = NAN_REAL; break;
                    case 3: x += REAL(0.5); break;
                    case 4: x *= REAL(100); break;
                    case 5: x = random_real() * REAL(1e12); break;
                    case 6: x = coarse(x, REAL(64)); break;
                    case 7: x = -INF_REAL; break;
                    default: break;
                }
                held[i] = isfinite(x) ? x : held[i];
                reading[i] = x;
                finite += isfinite(x) != 0;
            }
            const unsigned met = il_array_step(&a, &state, reading, &out);
            for (int i = 0; i < a.elements; i++) sum += state.axis[0].weight[i];
            CHECK(finite > 0 || isnan(out));
            CHECK((isfinite(out) != 0) == (sum > REAL(0)));
            if (isfinite(out)) CHECK_CLOSE(sum, REAL(1), REAL(4) * ROUNDING_LIMIT);
            if (!isfinite(out)) CHECK(met & IL_NOT_FINITE || met & IL_STUCK);
        }
    }
}

void test_robust(void) {
    healthy_gyros_give_what_the_document_says();
    the_short_way_gives_what_the_long_way_gives();
    faults_are_named_and_bounded();
    weights_are_capped();
    three_gyros_are_enough();
    two_let_the_third_in();
    a_scale_factor_is_no_jump();
    the_most_central_gyro_serves_where_all_are_gated();
    what_moves_with_the_rate_is_no_bias();
    motion_beyond_all_numbers();
    held_readings_do_not_count();
    nobody_waits_for_nobody();
    weights_survive_any_variances();
    random_faults_never_break_it();
}
