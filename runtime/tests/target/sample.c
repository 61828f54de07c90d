/* One sample of everything that an exported unit corrects, on a Cortex-M4F; each at a temperature of its own, or with
 * HELD all at one; of whole IMUs each turned anew, with BRIDGED beyond the range of the gyroscopes.
 *
 * With EMPTY or CALLS only what is linked matters: the difference of the two images is what the unit costs in flash.
 * Otherwise the emulator counts: with `qemu -icount shift=0` each instruction takes 1 ns of the clock that SysTick counts,
 * so that a loop over samples, less the same loop without the calls, gives instructions a sample. */
#include "unit.h"

#if UNIT_HAS_WARMUP
static il_warmup_state warm;
static il_real warming[UNIT_WARMUP_AXES];
#endif
#if UNIT_HAS_ARRAY
static il_array_state array;
static il_real reading[UNIT_ARRAY_AXES * UNIT_ARRAY_ELEMENTS], rates[UNIT_ARRAY_AXES];
#endif
#if UNIT_HAS_IMUS
static il_imus_state board;
static il_imus_fused fused;
static il_real readings[6 * UNIT_IMUS];
#endif
#if UNIT_HAS_THERMAL
static il_thermal_state warmth;
#endif
#if UNIT_HAS_THERMAL_GYRO
static il_thermal_gyro_state gyro_warmth;
#endif
static uint32_t tick;
static il_real temperature, accel[3], gyro[3], mag[3], level[2], drifting[2];
volatile il_real seen; /* what a result is kept in, so that none is left out */

__attribute__((noinline)) static void sample(void) {
#ifndef EMPTY
#if UNIT_HAS_TUMBLE
    (void)il_tumble_apply(&unit_tumble, accel, accel);
#endif
#if UNIT_HAS_GYRO
    (void)il_gyro_apply(&unit_gyro, gyro, accel, gyro);
#endif
#if UNIT_HAS_THERMAL
    (void)il_thermal_apply(&unit_thermal, &warmth, temperature, accel, accel);
#endif
#if UNIT_HAS_THERMAL_GYRO
    (void)il_thermal_gyro_apply(&unit_thermal_gyro, &gyro_warmth, temperature, gyro, accel, gyro);
#endif
#if UNIT_HAS_MAG
    (void)il_mag_apply(&unit_mag, mag, mag);
#endif
#if UNIT_HAS_CENTRIFUGE
    (void)il_centrifuge_apply(&unit_centrifuge, level, drifting);
#endif
#if UNIT_HAS_WARMUP
    il_real bias[UNIT_WARMUP_AXES];
    il_warmup_bias(&unit_warmup, &warm, tick, bias);
    for (int i = 0; i < UNIT_WARMUP_AXES; i++) warming[i] -= bias[i];
#endif
#if UNIT_HAS_ARRAY
    (void)il_array_step(&unit_array, &array, reading, rates);
#endif
#if UNIT_HAS_IMUS
    (void)il_imus_step(&unit_imus, &board, (il_real)0.01, readings, &fused);
#endif
#endif
    __asm volatile("" ::: "memory");
}

static int start(void) {
    tick = 0;
#ifndef EMPTY
#if UNIT_HAS_THERMAL
    il_thermal_start(&warmth);
#endif
#if UNIT_HAS_THERMAL_GYRO
    il_thermal_gyro_start(&gyro_warmth);
#endif
#if UNIT_HAS_WARMUP
    if (il_warmup_start(&unit_warmup, &warm, (il_real)21.5, (il_real)0.005) != IL_OK) return 0;
#endif
#if UNIT_HAS_ARRAY
    if (il_array_start(&unit_array, &array) != IL_OK) return 0;
#endif
#if UNIT_HAS_IMUS
    if (il_imus_start(&unit_imus, &board) != IL_OK) return 0;
#endif
#endif
    return 1;
}

#if defined(EMPTY) || defined(CALLS)
extern uint32_t data_start;
void reset(void);

void reset(void) {
    for (;;) {
        temperature = accel[0] = gyro[0] = mag[0] = level[0] = drifting[0] = seen;
        if (start()) sample();
        seen = accel[0] + gyro[0] + mag[0] + level[0] + drifting[0];
    }
}

__attribute__((section(".vectors"), used)) static void (*const vectors[])(void) = {(void (*)(void))0x20400000u, reset};
#else
#include <stdio.h>
#include <stdlib.h>

enum { SAMPLES = 2000, BEFORE = 500, PAINTED = 16384, KNOWN = 100000 };
#define SYSTICK ((volatile uint32_t *)0xE000E010u) /* control, reload, current */
#define ONCE(i) for (int i = 0; i < 3; i++)

static uint32_t state;

static il_real uniform(void) {
    state = state * 1664525u + 1013904223u;
    return (il_real)((int32_t)(state >> 8) - (1 << 23)) / (il_real)(1 << 23);
}

#if UNIT_HAS_IMUS
static void cross(const il_real a[3], const il_real b[3], il_real out[3]) {
    ONCE(i) out[i] = a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3];
}

/* What a triad reads of x: the solution of m (y - bias) = x, with noise, within its range. */
static void read_triad(const il_real *m, const il_real *bias, il_real noise, il_real limit, const il_real x[3], il_real *y) {
    il_real column[3][3];
    ONCE(i) cross(m + 3 * ((i + 1) % 3), m + 3 * ((i + 2) % 3), column[i]);
    const il_real volume = m[0] * column[0][0] + m[1] * column[0][1] + m[2] * column[0][2];
    ONCE(i) {
        const il_real z = bias[i] + (x[0] * column[0][i] + x[1] * column[1][i] + x[2] * column[2][i]) / volume + noise * uniform();
        y[i] = z > limit ? limit : z < -limit ? -limit : z;
    }
}

/* The board turned at up to 6 rad/s about each axis, or with BRIDGED at 40, which is beyond the range of gyroscopes. */
static void load_board(void) {
#ifdef BRIDGED
    const il_real size = (il_real)40;
#else
    const il_real size = (il_real)6;
#endif
    const il_imus *u = &unit_imus;
    il_real w[3], force[3];
    ONCE(i) w[i] = size * (uniform() < (il_real)0 ? (il_real)-1 : (il_real)1) * ((il_real)0.95 + (il_real)0.05 * uniform());
    ONCE(i) force[i] = (il_real)9.8 * uniform();
    for (int k = 0; k < UNIT_IMUS; k++) {
        il_real turned[3], twice[3], felt[3];
        cross(w, u->position + 3 * k, turned);
        cross(w, turned, twice);
        ONCE(i) felt[i] = force[i] + twice[i];
        read_triad(u->accel + 9 * k, u->accel_bias + 3 * k, u->accel_noise[k], u->accel_limit[k], felt, readings + 3 * k);
        read_triad(u->gyro + 9 * k, u->gyro_bias + 3 * k, u->gyro_noise[k], u->gyro_limit[k], w,
                   readings + 3 * (UNIT_IMUS + k));
    }
}
#endif

/* Outputs of 1.5 g, 3 rad/s, one field; of gyros at rest with noise; as the unit's own numbers make them. */
static void load(void) {
    ONCE(i) accel[i] = gyro[i] = mag[i] = uniform();
#if UNIT_HAS_TUMBLE
    ONCE(i) accel[i] = ((il_real)14.7 * accel[i] + unit_tumble.bias[i]) / unit_tumble.gain[i];
#endif
#if UNIT_HAS_GYRO
    ONCE(i) gyro[i] = ((il_real)3 * gyro[i] + unit_gyro.bias[i]) / unit_gyro.gain[i];
#endif
#if UNIT_HAS_THERMAL
    const il_real low = unit_thermal.knot[0], high = unit_thermal.knot[unit_thermal.pieces];
    il_tumble triad;
#ifdef HELD
    temperature = low + (il_real)0.6 * (high - low);
#else
    temperature = low + (il_real)0.5 * (high - low) * ((il_real)1 + uniform());
#endif
    (void)il_thermal_at(&unit_thermal, temperature, &triad);
    ONCE(i) accel[i] = ((il_real)14.7 * accel[i] + triad.bias[i]) / triad.gain[i];
#endif
#if UNIT_HAS_THERMAL_GYRO
    il_gyro turned;
    (void)il_thermal_gyro_at(&unit_thermal_gyro, temperature, &turned);
    ONCE(i) gyro[i] = ((il_real)3 * gyro[i] + turned.bias[i]) / turned.gain[i];
#endif
#if UNIT_HAS_MAG
    ONCE(i) mag[i] = (mag[i] + unit_mag.bias[i]) / unit_mag.gain[i];
#endif
    for (int i = 0; i < 2; i++) {
        level[i] = (il_real)50 * uniform();
        drifting[i] = uniform();
    }
#if UNIT_HAS_WARMUP
    for (int i = 0; i < UNIT_WARMUP_AXES; i++) warming[i] = uniform();
#endif
#if UNIT_HAS_ARRAY
    for (int i = 0; i < UNIT_ARRAY_AXES * UNIT_ARRAY_ELEMENTS; i++) {
        reading[i] = (il_real)1e-3 * (uniform() + uniform() + uniform());
    }
#endif
#if UNIT_HAS_IMUS
    load_board();
#endif
    tick++;
}

__attribute__((noinline)) static void nothing(void) {
    __asm volatile("" ::: "memory");
}

static uint32_t now(void) {
    return 0xFFFFFFu - SYSTICK[2];
}

static double ticks_of(void (*const job)(void)) {
    double total = 0;
    state = 1;
    if (!start()) exit(1);
    for (int k = 0; k < BEFORE + SAMPLES; k++) {
        static uint32_t begin;
        if (k == BEFORE) begin = now();
        load();
        job();
        if (k == BEFORE + SAMPLES - 1) total = (double)((now() - begin) & 0xFFFFFFu);
    }
    return total;
}

/* Instructions in a tick of SysTick, from a loop of two instructions. */
static double in_a_tick(void) {
    uint32_t left = KNOWN;
    const uint32_t begin = now();
    __asm volatile("1: subs %0, #1\n bne 1b" : "+r"(left)::"cc");
    return 2.0 * KNOWN / (double)((now() - begin) & 0xFFFFFFu);
}

/* Bytes that a call changes below the stack pointer. */
__attribute__((noinline)) static unsigned stack_of(void (*const job)(void)) {
    volatile uint8_t *top;
    __asm volatile("mov %0, sp" : "=r"(top));
    for (int i = 1; i <= PAINTED; i++) top[-i] = 0xA5;
    job();
    int deepest = PAINTED;
    while (deepest > 0 && top[-deepest] == 0xA5) deepest--;
    return (unsigned)deepest;
}

int main(void) {
    SYSTICK[1] = 0xFFFFFFu;
    SYSTICK[2] = 0;
    SYSTICK[0] = 5; /* on, at the processor's clock */
    const double each = in_a_tick();
    const double instructions = (ticks_of(sample) - ticks_of(nothing)) * each / SAMPLES;
    unsigned stack = 0;
    state = 1;
    if (!start()) return 1;
    for (int k = 0; k < 200; k++) {
        load();
        const unsigned used = stack_of(sample);
        if (used > stack) stack = used;
    }
    unsigned ram = 0;
#if UNIT_HAS_THERMAL
    ram += (unsigned)sizeof warmth;
#endif
#if UNIT_HAS_THERMAL_GYRO
    ram += (unsigned)sizeof gyro_warmth;
#endif
#if UNIT_HAS_WARMUP
    ram += (unsigned)sizeof warm;
#endif
#if UNIT_HAS_ARRAY
    ram += (unsigned)sizeof array;
#endif
#if UNIT_HAS_IMUS
    ram += (unsigned)sizeof board;
#endif
    printf("instructions %.1f stack %u state %u\n", instructions, stack, ram);
    return 0;
}
#endif
