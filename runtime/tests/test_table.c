/* The table loader: what is whole is unpacked, everything else is refused with its status, nothing is read out of bounds.
 * Bytes and memory are allocated to the exact size, so that a sanitizer sees one step too far. */
#include "check.h"
#include "exercise.h"
#include "vectors.h"

enum { HEAD = 16, TAIL = 4 };

static void put_u32(uint8_t *p, uint32_t value) {
    for (int i = 0; i < 4; i++) p[i] = (uint8_t)(value >> 8 * i);
}

static uint32_t get_u32(const uint8_t *p) {
    return (uint32_t)p[0] | (uint32_t)p[1] << 8 | (uint32_t)p[2] << 16 | (uint32_t)p[3] << 24;
}

/* State size and CRC anew, as somebody would who makes a table by hand. */
static void repair(uint8_t *bytes, size_t size) {
    put_u32(bytes + 12, (uint32_t)size);
    put_u32(bytes + size - TAIL, il_crc32(bytes, size - TAIL));
}

/* Load from memory of just these bytes into memory of just the size / 4 numbers that the header promises; then run it. */
static il_status load_exactly(const uint8_t *bytes, size_t size, uint32_t *has) {
    uint8_t *copy = malloc(size > 0 ? size : 1);
    il_real *memory = malloc(size / 4 > 0 ? size / 4 * sizeof *memory : 1);
    il_unit unit;
    il_status status = IL_ARGUMENT;
    if (copy != NULL && memory != NULL) {
        memcpy(copy, bytes, size);
        memset(&unit, 0xFF, sizeof unit);
        status = il_table_load(&unit, copy, size, memory, size / 4);
        if (has != NULL) *has = unit.has;
        CHECK(status == IL_OK || unit.has == 0);
        if (status == IL_OK) exercise(&unit);
    }
    free(copy);
    free(memory);
    return status;
}

static void crc_is_that_of_ieee_802_3(void) {
    CHECK(il_crc32((const uint8_t *)"123456789", 9) == 0xCBF43926u);
    CHECK(il_crc32(v_crc_bytes, sizeof v_crc_bytes) == v_crc);
    CHECK(il_crc32(v_crc_bytes, 0) == 0);
}

static void whole_tables_load(void) {
    static const uint32_t has[V_BLOBS] = {0, 0, 31, 1, 1, 1, 1, 1, 2, 2, 4, 1, 8, 8, 8, 8, 16, 16, 16, 16, 16, 16, 16, 32, 32, 64, 64, 2,
                                           128, 128, 256};
    for (int b = 0; b < V_BLOBS; b++) {
        uint32_t found = 99;
        CHECK(load_exactly(v_blob4[b], v_blob4_size[b], &found) == IL_OK && found == has[b]);
        CHECK(load_exactly(v_blob8[b], v_blob8_size[b], &found) == (IS_FLOAT ? IL_TABLE_WIDTH : IL_OK));
        if (!IS_FLOAT) CHECK(found == has[b]);
    }
}

/* Numbers of make_vectors.py: start + i / 8 each. */
static void counted(const il_real *found, int n, il_real start, int from) {
    for (int i = 0; i < n; i++) CHECK(found[i] == start + REAL(from + i) / REAL(8));
}

static void contents_arrive(void) {
    for (int width = 4; width <= 8; width += 4) {
        const uint8_t *const *blobs = width == 4 ? v_blob4 : v_blob8;
        const size_t *sizes = width == 4 ? v_blob4_size : v_blob8_size;
        il_real memory[400];
        il_unit unit;
        if (IS_FLOAT && width == 8) continue;
        for (int order = 1; order <= IL_TUMBLE_ORDER; order++) {
            const int b = V_BLOB_TUMBLE + order - 1;
            CHECK(il_table_load(&unit, blobs[b], sizes[b], NULL, 0) == IL_OK);
            CHECK(unit.tumble.order == order);
            counted(unit.tumble.gain, 3, REAL(order), 0);
            counted(unit.tumble.bias, 3, REAL(order), 3);
            counted(unit.tumble.misalignment, 3, REAL(order), 6);
            counted(unit.tumble.low, 3, REAL(order), 9);
            counted(unit.tumble.high, 3, REAL(order), 12);
            counted(&unit.tumble.nonlinearity[0][0], 3 * (order - 1), REAL(50), 0);
            for (int p = order - 1; p < IL_TUMBLE_ORDER - 1; p++) CHECK(unit.tumble.nonlinearity[p][0] == REAL(0));
        }
        CHECK(unit.tumble.has_cross == 0);
        CHECK(il_table_load(&unit, blobs[V_BLOB_CROSS], sizes[V_BLOB_CROSS], NULL, 0) == IL_OK);
        CHECK(unit.tumble.order == 2 && unit.tumble.has_cross == 1);
        counted(&unit.tumble.nonlinearity[0][0], 3, REAL(50), 0);
        counted(unit.tumble.cross, 3, REAL(50), 3);
        for (int sensitive = 0; sensitive < 2; sensitive++) {
            const int b = V_BLOB_GYRO + sensitive;
            CHECK(il_table_load(&unit, blobs[b], sizes[b], NULL, 0) == IL_OK);
            CHECK(unit.gyro.has_sensitivity == sensitive);
            counted(unit.gyro.gain, 3, REAL(1), 0);
            counted(unit.gyro.bias, 3, REAL(1), 3);
            counted(&unit.gyro.turn[0][0], 9, REAL(1), 6);
            if (sensitive) counted(&unit.gyro.sensitivity[0][0], 9, REAL(1), 15);
            else CHECK(unit.gyro.sensitivity[2][2] == REAL(0));
        }
        CHECK(il_table_load(&unit, blobs[V_BLOB_BENT], sizes[V_BLOB_BENT], NULL, 0) == IL_OK);
        CHECK(unit.gyro.order == 3 && unit.gyro.has_sensitivity == 1);
        counted(&unit.gyro.sensitivity[0][0], 9, REAL(1), 15);
        counted(unit.gyro.low, 3, REAL(60), 0);
        counted(unit.gyro.high, 3, REAL(60), 3);
        counted(&unit.gyro.nonlinearity[0][0], 6, REAL(60), 6);
        for (int order = 1; order <= 2; order++) {
            const int b = V_BLOB_MAG + order - 1;
            CHECK(il_table_load(&unit, blobs[b], sizes[b], NULL, 0) == IL_OK);
            CHECK(unit.mag.order == order);
            counted(unit.mag.gain, 3, REAL(3), 0);
            counted(unit.mag.bias, 3, REAL(3), 3);
            counted(&unit.mag.turn[0][0], 9, REAL(3), 6);
            if (order > 1) counted(unit.mag.quadratic, 3, REAL(3), 15);
            else CHECK(unit.mag.quadratic[2] == REAL(0));
        }
        for (int k = 0; k < 2; k++) {
            const int b = V_BLOB_THERMAL + k;
            CHECK(il_table_load(&unit, blobs[b], sizes[b], memory, LENGTH(memory)) == IL_OK);
            CHECK(unit.thermal.pieces == (k ? 3 : 1) && unit.thermal.terms == (k ? 2 : 4));
            counted(unit.thermal.knot, unit.thermal.pieces + 1, REAL(-20), 0);
            counted(unit.thermal.coefficient, 9 * unit.thermal.pieces * unit.thermal.terms, REAL(30), 0);
        }
        for (int g = 0; g < 2; g++) {
            const int b = V_BLOB_THERMAL_GYRO + g;
            CHECK(il_table_load(&unit, blobs[b], sizes[b], memory, LENGTH(memory)) == IL_OK);
            const il_thermal_gyro *t = &unit.thermal_gyro;
            CHECK(t->has_sensitivity == g && t->pieces == (g ? 3 : 1) && t->terms == (g ? 2 : 4));
            counted(&t->turn[0][0], 9, REAL(1), 0);
            if (g) counted(&t->sensitivity[0][0], 9, REAL(1), 9);
            else CHECK(t->sensitivity[2][2] == REAL(0));
            counted(t->knot, t->pieces + 1, REAL(-20), 0);
            counted(t->coefficient, 6 * t->pieces * t->terms, REAL(30), 0);
        }
        CHECK(il_table_load(&unit, blobs[V_BLOB_IMUS], sizes[V_BLOB_IMUS], memory, LENGTH(memory)) == IL_OK);
        CHECK(unit.imus.count == 3 && unit.imus.stuck == 20 && unit.imus.quiet == 16 && unit.imus.gate == REAL(30));
        counted(unit.imus.at, 3, REAL(30), 1);
        const il_real *const tables[] = {unit.imus.position, unit.imus.accel, unit.imus.accel_bias, unit.imus.accel_noise,
                                         unit.imus.accel_limit, unit.imus.gyro, unit.imus.gyro_bias, unit.imus.gyro_noise,
                                         unit.imus.gyro_limit, unit.imus.gyro_rows};
        static const int lengths[] = {9, 27, 9, 3, 3, 27, 9, 3, 3, 27};
        for (int i = 0; i < 10; i++) counted(tables[i], lengths[i], REAL(1 + i), 0);
        CHECK(il_table_load(&unit, blobs[V_BLOB_DRIFT], sizes[V_BLOB_DRIFT], NULL, 0) == IL_OK);
        CHECK(unit.centrifuge.has[0] == 1 && unit.centrifuge.has[1] == 0 && unit.centrifuge.highest == REAL(2));
        counted(unit.centrifuge.k0, 2, REAL(2), 1);
        counted(unit.centrifuge.c1, 2, REAL(2), 3);
        counted(unit.centrifuge.c2, 2, REAL(2), 5);
        counted(unit.centrifuge.cosine, 2, REAL(2), 7);
        counted(unit.centrifuge.sine, 2, REAL(2), 9);
        for (int model = 0; model < 4; model++) {
            const int b = V_BLOB_WARMUP + model, terms = model == IL_EXPONENTIAL ? 2 : 4, rows = model == 0 ? 2 : 3;
            const il_warmup *w = &unit.warmup;
            CHECK(il_table_load(&unit, blobs[b], sizes[b], memory, LENGTH(memory)) == IL_OK);
            CHECK(w->model == model && w->exit == model % 3 && w->temperatures == 3 && w->axes == 2 && w->terms == terms);
            CHECK(w->settling_time == REAL(300) && w->taper_time == REAL(60) && w->time_scale == REAL(20));
            CHECK(w->time_constant[0] == REAL(15) && w->time_constant[2] == REAL(200));
            CHECK(w->temperature[0] == REAL(-40) && w->temperature[2] == REAL(60));
            counted(w->coefficient, rows * 2 * terms, REAL(1), 0);
            CHECK((w->slope != NULL) == (model == IL_EXPONENTIAL));
            if (w->slope != NULL) counted(w->slope, rows * 2 * terms, REAL(100), 0);
        }
        for (int method = 0; method < IL_METHODS; method++) {
            static const int masks[IL_METHODS] = {1, 2, 4, 8, 7, 8, 16};
            const int b = V_BLOB_ARRAY + method, axes = method == IL_ROBUST ? 3 : 1;
            const il_array *a = &unit.array;
            CHECK(il_table_load(&unit, blobs[b], sizes[b], memory, LENGTH(memory)) == IL_OK);
            CHECK(a->method == method && a->elements == 3 && a->axes == axes && a->kernel == 1 && a->start == 1);
            CHECK(a->initial == (masks[method] & 4 ? IL_GIVEN : IL_FIRST));
            CHECK(a->cap == 100 && a->stuck == 20 && a->jump == 10 && a->quiet == 5 && a->memory == REAL(0.25));
            CHECK(a->gate == REAL(6) && a->spread_gate == REAL(4) && a->scale_tolerance == REAL(0.0078125));
            CHECK(a->weight_cap == REAL(0.5) && a->weight_floor == REAL(0.0625));
            const il_real *const tables[5] = {a->offset, a->matrix, a->bias, a->weight, a->gain};
            const int sizes_of[5] = {axes * 3, 3 * axes * axes, axes * 3, axes * 3, axes * 12};
            int from = 0;
            for (int t = 0; t < 5; t++) {
                CHECK((tables[t] != NULL) == (masks[method] >> t & 1));
                if (tables[t] == NULL) continue;
                counted(tables[t], sizes_of[t], REAL(1), from);
                from += sizes_of[t];
            }
        }
    }
}

static void every_corruption_is_refused(void) {
    static uint8_t bytes[2000];
    for (int width = 4; width <= 8; width += 4) {
        for (int b = 0; b < V_BLOBS; b++) {
            const size_t size = width == 4 ? v_blob4_size[b] : v_blob8_size[b];
            memcpy(bytes, width == 4 ? v_blob4[b] : v_blob8[b], size);
            for (size_t at = 0; at < size; at++) {
                const uint8_t was = bytes[at];
                const int all = size < 160; /* all 255 wrong values in the short ones, all 8 bits in the others */
                for (unsigned k = 1; k < (all ? 256u : 9u); k++) {
                    il_unit unit;
                    bytes[at] = (uint8_t)(was ^ (all ? k : 1u << (k - 1)));
                    const il_status status = il_table_load(&unit, bytes, size, NULL, 0);
                    CHECK(status != IL_OK && unit.has == 0);
                    if (at < 8) CHECK(status == IL_TABLE_NOT_TABLE);
                    if (at == 8 || at == 9) CHECK(status == (at == 8 && bytes[8] <= IL_VERSION ? IL_TABLE_CORRUPT : IL_TABLE_NEWER));
                    if (at >= 12 && at < HEAD) CHECK(status == (get_u32(bytes + 12) > size ? IL_TABLE_SHORT : IL_TABLE_LONG));
                    if (at == 10 || at == 11 || at >= HEAD) CHECK(status == IL_TABLE_CORRUPT);
                }
                bytes[at] = was;
            }
        }
    }
}

static void every_truncation_is_refused(void) {
    for (int width = 4; width <= 8; width += 4) {
        for (int b = 0; b < V_BLOBS; b++) {
            const uint8_t *blob = width == 4 ? v_blob4[b] : v_blob8[b];
            const size_t size = width == 4 ? v_blob4_size[b] : v_blob8_size[b];
            uint8_t longer[2000] = {0};
            for (size_t cut = 0; cut < size; cut++) CHECK(load_exactly(blob, cut, NULL) == IL_TABLE_SHORT);
            memcpy(longer, blob, size);
            for (size_t more = 1; more < 9; more++) CHECK(load_exactly(longer, size + more, NULL) == IL_TABLE_LONG);
        }
    }
}

/* Cut inside, with size and CRC made to fit again. */
static void every_truncation_inside_is_refused(void) {
    static uint8_t bytes[2000];
    for (int b = V_BLOB_TUMBLE; b < V_BLOBS; b++) {
        const size_t size = v_blob4_size[b];
        for (size_t cut = 1; cut < size - HEAD - TAIL; cut++) {
            memcpy(bytes, v_blob4[b], size);
            repair(bytes, size - cut);
            CHECK(load_exactly(bytes, size - cut, NULL) == IL_TABLE_CONTENT); /* the section states more than there is */
            if (size - cut < HEAD + 8 + TAIL) continue;
            put_u32(bytes + HEAD + 4, (uint32_t)(size - cut - HEAD - 8 - TAIL));
            repair(bytes, size - cut);
            CHECK(load_exactly(bytes, size - cut, NULL) == IL_TABLE_CONTENT); /* the section is too short for its kind */
        }
        /* bytes inside the section that nobody reads */
        memcpy(bytes, v_blob4[b], size);
        put_u32(bytes + HEAD + 4, get_u32(bytes + HEAD + 4) + 4);
        put_u32(bytes + size - TAIL, 0);
        repair(bytes, size + 4);
        CHECK(load_exactly(bytes, size + 4, NULL) == IL_TABLE_CONTENT);
    }
}

/* One word of a table changed, size and CRC right: the status that this has to give. */
static void expect(int b, size_t word, uint32_t value, il_status status, int line) {
    static uint8_t bytes[2000];
    memcpy(bytes, v_blob4[b], v_blob4_size[b]);
    put_u32(bytes + 4 * word, value);
    repair(bytes, v_blob4_size[b]);
    check_that(load_exactly(bytes, v_blob4_size[b], NULL) == status, __FILE__, line, "status of a table with a word changed");
}

#define EXPECT(b, word, value, status) expect(b, word, value, status, __LINE__)

static void contents_that_cannot_be_are_refused(void) {
    enum { KIND = 4, LENGTH_WORD = 5, BODY = 6 }; /* words from the start of the blob */
    const uint32_t nan_bits = 0x7FC00000u, inf_bits = 0x7F800000u, minus = 0xBF800000u /* -1 */, zero = 0;
    EXPECT(0, 2, 0x00040000u, IL_TABLE_CONTENT); /* version 0 */
    EXPECT(0, 2, 0x00040004u, IL_TABLE_NEWER);
    EXPECT(0, 2, 0x00020001u, IL_TABLE_WIDTH);
    EXPECT(0, 2, 0x00000001u, IL_TABLE_WIDTH);
    EXPECT(0, 2, 0x00080001u, IS_FLOAT ? IL_TABLE_WIDTH : IL_OK); /* no numbers in it */
    EXPECT(V_BLOB_TUMBLE, KIND, 8, IL_TABLE_CONTENT);
    EXPECT(V_BLOB_IMUS, 2, 0x00040002u, IL_TABLE_CONTENT); /* a kind that version 2 does not have */
    EXPECT(V_BLOB_IMUS, KIND, 10, IL_TABLE_CONTENT);
    EXPECT(V_BLOB_IMUS, BODY, 1, IL_TABLE_CONTENT); /* IMUs */
    EXPECT(V_BLOB_IMUS, BODY, IL_IMUS + 1, IL_TABLE_CONTENT);
    EXPECT(V_BLOB_IMUS, BODY + 1, 1, IL_TABLE_CONTENT); /* stuck */
    EXPECT(V_BLOB_IMUS, BODY + 3, minus, IL_TABLE_CONTENT); /* gate */
    EXPECT(V_BLOB_IMUS, BODY + 55, zero, IL_TABLE_CONTENT); /* noise of an accelerometer */
    EXPECT(V_BLOB_TUMBLE, KIND, 0xFFFFFFFFu, IL_TABLE_CONTENT);
    EXPECT(V_BLOB_TUMBLE, LENGTH_WORD, 0xFFFFFFFFu, IL_TABLE_CONTENT);
    EXPECT(V_BLOB_TUMBLE, LENGTH_WORD, 3, IL_TABLE_CONTENT);
    EXPECT(V_BLOB_TUMBLE, BODY, 0, IL_TABLE_CONTENT); /* order */
    EXPECT(V_BLOB_TUMBLE, BODY, 2, IL_TABLE_CONTENT);
    EXPECT(V_BLOB_TUMBLE, BODY, 6, IL_TABLE_CONTENT);
    EXPECT(V_BLOB_TUMBLE, BODY, 0xFFFFFFFFu, IL_TABLE_CONTENT);
    for (size_t word = BODY + 1; word < v_blob4_size[V_BLOB_TUMBLE] / 4 - 1; word++) {
        EXPECT(V_BLOB_TUMBLE, word, nan_bits, IL_TABLE_NOT_FINITE);
        EXPECT(V_BLOB_TUMBLE, word, inf_bits, IL_TABLE_NOT_FINITE);
        EXPECT(V_BLOB_TUMBLE, word, 0xFF800000u, IL_TABLE_NOT_FINITE);
        EXPECT(V_BLOB_TUMBLE, word, 0x00000001u, IL_OK); /* subnormal */
    }
    EXPECT(V_BLOB_GYRO, BODY, 2, IL_TABLE_CONTENT);
    EXPECT(V_BLOB_GYRO, BODY, 1, IL_TABLE_CONTENT);
    EXPECT(V_BLOB_GYRO + 1, BODY + 24, nan_bits, IL_TABLE_NOT_FINITE);
    EXPECT(V_BLOB_MAG, BODY, 3, IL_TABLE_CONTENT); /* order */
    EXPECT(V_BLOB_MAG, BODY, 0, IL_TABLE_CONTENT);
    EXPECT(V_BLOB_MAG + 1, BODY + 18, nan_bits, IL_TABLE_NOT_FINITE);
    EXPECT(V_BLOB_BENT, BODY + 1, 0, IL_TABLE_CONTENT); /* order */
    EXPECT(V_BLOB_BENT, BODY + 1, 2, IL_TABLE_CONTENT);
    EXPECT(V_BLOB_BENT, BODY + 1, 6, IL_TABLE_CONTENT);
    EXPECT(V_BLOB_BENT, BODY + 30, nan_bits, IL_TABLE_NOT_FINITE);
    for (int b = V_BLOB_THERMAL; b < V_BLOB_BENT; b++) {
        EXPECT(b, BODY, 0, IL_TABLE_CONTENT); /* pieces */
        EXPECT(b, BODY, 2, IL_TABLE_CONTENT);
        EXPECT(b, BODY, 65536, IL_TABLE_CONTENT);
        EXPECT(b, BODY, 65537, IL_TABLE_CONTENT);
        EXPECT(b, BODY + 1, 0, IL_TABLE_CONTENT); /* terms */
        EXPECT(b, BODY + 1, IL_THERMAL_TERMS + 1, IL_TABLE_CONTENT);
        EXPECT(b, BODY + 2, 0x42480000u, IL_TABLE_CONTENT); /* 50 before -19.875 */
        EXPECT(b, BODY + 3, nan_bits, IL_TABLE_NOT_FINITE);
        EXPECT(b, BODY + 12, inf_bits, IL_TABLE_NOT_FINITE);
    }
    for (int g = 0; g < 2; g++) {
        const int b = V_BLOB_THERMAL_GYRO + g;
        EXPECT(b, BODY, g ? 0u : 1u, IL_TABLE_CONTENT); /* has_sensitivity */
        EXPECT(b, BODY, 2, IL_TABLE_CONTENT);
        EXPECT(b, BODY + 1, 0, IL_TABLE_CONTENT); /* pieces */
        EXPECT(b, BODY + 1, 65537, IL_TABLE_CONTENT);
        EXPECT(b, BODY + 2, 0, IL_TABLE_CONTENT); /* terms */
        EXPECT(b, BODY + 2, IL_THERMAL_TERMS + 1, IL_TABLE_CONTENT);
        EXPECT(b, (size_t)(BODY + 12 + 9 * g), 0x42480000u, IL_TABLE_CONTENT); /* 50 before -19.875 */
        EXPECT(b, BODY + 14, nan_bits, IL_TABLE_NOT_FINITE);
    }
    EXPECT(V_BLOB_DRIFT, BODY, 2, IL_TABLE_CONTENT);
    EXPECT(V_BLOB_DRIFT, BODY + 1, 2, IL_TABLE_CONTENT);
    EXPECT(V_BLOB_DRIFT, BODY + 2, zero, IL_TABLE_CONTENT); /* highest level */
    EXPECT(V_BLOB_DRIFT, BODY + 2, nan_bits, IL_TABLE_NOT_FINITE);
    EXPECT(V_BLOB_DRIFT, BODY + 12, nan_bits, IL_TABLE_NOT_FINITE);
    for (int model = 0; model < 4; model++) {
        const int b = V_BLOB_WARMUP + model;
        EXPECT(b, BODY, 4, IL_TABLE_CONTENT);
        EXPECT(b, BODY + 1, 3, IL_TABLE_CONTENT);
        EXPECT(b, BODY + 2, 1, IL_TABLE_CONTENT);
        EXPECT(b, BODY + 2, 2, IL_TABLE_CONTENT);
        EXPECT(b, BODY + 2, 65536, IL_TABLE_CONTENT);
        EXPECT(b, BODY + 2, 65537, IL_TABLE_CONTENT);
        EXPECT(b, BODY + 3, 0, IL_TABLE_CONTENT);
        EXPECT(b, BODY + 3, 65536, IL_TABLE_CONTENT);
        EXPECT(b, BODY + 4, model == IL_EXPONENTIAL ? 0u : 3u, IL_TABLE_CONTENT);
        EXPECT(b, BODY + 4, model == IL_EXPONENTIAL ? 4u : 5u, IL_TABLE_CONTENT);
        EXPECT(b, BODY + 5, zero, IL_TABLE_CONTENT);
        EXPECT(b, BODY + 5, minus, IL_TABLE_CONTENT);
        EXPECT(b, BODY + 5, nan_bits, IL_TABLE_NOT_FINITE);
        EXPECT(b, BODY + 6, minus, IL_TABLE_CONTENT); /* taper */
        EXPECT(b, BODY + 7, zero, model == IL_KNOT_LOG_CUBIC ? IL_TABLE_CONTENT : IL_OK); /* time scale */
        EXPECT(b, BODY + 8, zero, model == IL_EXPONENTIAL ? IL_TABLE_CONTENT : IL_OK);    /* time constants */
        EXPECT(b, BODY + 9, minus, model == IL_EXPONENTIAL ? IL_TABLE_CONTENT : IL_OK);
        EXPECT(b, BODY + 10, zero, IL_OK); /* two terms only */
        EXPECT(b, BODY + 12, 0xC2200000u, IL_TABLE_CONTENT); /* -40 twice: temperatures must rise */
        EXPECT(b, BODY + 13, zero, IL_TABLE_CONTENT);
        EXPECT(b, BODY + 13, inf_bits, IL_TABLE_NOT_FINITE);
        EXPECT(b, BODY + 14, nan_bits, IL_TABLE_NOT_FINITE);
    }
    for (int method = 0; method < IL_METHODS; method++) {
        const int b = V_BLOB_ARRAY + method;
        EXPECT(b, BODY, IL_METHODS, IL_TABLE_CONTENT);
        EXPECT(b, BODY + 1, 0, IL_TABLE_CONTENT);
        EXPECT(b, BODY + 1, IL_ARRAY_ELEMENTS + 1, IL_TABLE_CONTENT);
        EXPECT(b, BODY + 2, 0, IL_TABLE_CONTENT);
        EXPECT(b, BODY + 2, 2, IL_TABLE_CONTENT);
        EXPECT(b, BODY + 2, 4, IL_TABLE_CONTENT);
        EXPECT(b, BODY + 3, 3, IL_TABLE_CONTENT);
        EXPECT(b, BODY + 4, 2, IL_TABLE_CONTENT);
        EXPECT(b, BODY + 5, 0, IL_TABLE_CONTENT); /* start */
        EXPECT(b, BODY + 10, 32, IL_TABLE_CONTENT); /* which tables */
        EXPECT(b, BODY + 10, 31, IL_TABLE_CONTENT);
        EXPECT(b, BODY + 11, minus, IL_TABLE_CONTENT); /* memory */
        EXPECT(b, BODY + 11, nan_bits, IL_TABLE_NOT_FINITE);
        EXPECT(b, BODY + 17, inf_bits, IL_TABLE_NOT_FINITE);
        EXPECT(b, BODY + 9, 0, method == IL_ROBUST ? IL_TABLE_CONTENT : IL_OK); /* quiet */
    }
}

static void a_section_may_come_once(void) {
    static uint8_t bytes[4000];
    for (int b = V_BLOB_TUMBLE; b < V_BLOBS; b++) {
        const size_t size = v_blob4_size[b], section = size - HEAD - TAIL;
        memcpy(bytes, v_blob4[b], size - TAIL);
        memcpy(bytes + size - TAIL, v_blob4[b] + HEAD, section);
        repair(bytes, size + section);
        CHECK(load_exactly(bytes, size + section, NULL) == IL_TABLE_CONTENT);
    }
    /* text may come as often as it likes, also after the numbers */
    const size_t size = v_blob4_size[1], section = size - HEAD - TAIL;
    memcpy(bytes, v_blob4[1], size - TAIL);
    memcpy(bytes + size - TAIL, v_blob4[1] + HEAD, section);
    repair(bytes, size + section);
    CHECK(load_exactly(bytes, size + section, NULL) == IL_OK);
    /* fewer bytes than a section's head has, at the end */
    for (size_t more = 1; more < 8; more++) {
        memset(bytes + size - TAIL, 0, 20);
        repair(bytes, size + more);
        CHECK(load_exactly(bytes, size + more, NULL) == IL_TABLE_CONTENT);
    }
}

static void memory_is_checked(void) {
    for (int b = V_BLOB_WARMUP; b < V_BLOB_MAG; b++) {
        il_real memory[200];
        il_unit unit;
        size_t needed = 0;
        while (needed < LENGTH(memory) && il_table_load(&unit, v_blob4[b], v_blob4_size[b], memory, needed) == IL_TABLE_MEMORY) {
            CHECK(unit.has == 0);
            needed++;
        }
        CHECK(il_table_load(&unit, v_blob4[b], v_blob4_size[b], memory, needed) == IL_OK);
        CHECK(needed > 0 && needed <= v_blob4_size[b] / 4);
        CHECK(il_table_load(&unit, v_blob4[b], v_blob4_size[b], NULL, 0) == IL_TABLE_MEMORY);
    }
}

static void arguments_are_checked(void) {
    il_real memory[1];
    il_unit unit;
    CHECK(il_table_load(NULL, v_blob4[0], v_blob4_size[0], memory, 1) == IL_ARGUMENT);
    CHECK(il_table_load(&unit, NULL, 20, memory, 1) == IL_ARGUMENT);
    CHECK(il_table_load(&unit, v_blob4[0], v_blob4_size[0], NULL, 1) == IL_ARGUMENT);
    CHECK(il_table_load(&unit, v_blob4[0], v_blob4_size[0], NULL, 0) == IL_OK);
    CHECK(il_table_load(&unit, v_blob4[0], 0, NULL, 0) == IL_TABLE_SHORT);
    for (int status = IL_OK; status <= IL_TABLE_MEMORY; status++) {
        const char *text = il_status_text((il_status)status);
        CHECK(text != NULL && strlen(text) > 1 && strcmp(text, "unknown status") != 0);
        for (int other = 0; other < status; other++) CHECK(strcmp(text, il_status_text((il_status)other)) != 0);
    }
    CHECK(strcmp(il_status_text((il_status)(IL_TABLE_MEMORY + 1)), "unknown status") == 0);
}

/* Every byte set to values that tend to break things, CRC repaired: refused or loaded and run, never more than that. */
static void nothing_inside_breaks_it(void) {
    static const uint8_t values[] = {0x00, 0x01, 0x02, 0x1F, 0x20, 0x40, 0x7F, 0x80, 0xFE, 0xFF};
    static uint8_t bytes[2000];
    const size_t size = v_blob4_size[V_BLOB_WHOLE];
    for (size_t at = HEAD; at < size - TAIL; at++) {
        for (size_t v = 0; v < LENGTH(values); v++) {
            memcpy(bytes, v_blob4[V_BLOB_WHOLE], size);
            bytes[at] = values[v];
            repair(bytes, size);
            (void)load_exactly(bytes, size, NULL);
        }
    }
}

void test_table(void) {
    crc_is_that_of_ieee_802_3();
    whole_tables_load();
    contents_arrive();
    every_corruption_is_refused();
    every_truncation_is_refused();
    every_truncation_inside_is_refused();
    contents_that_cannot_be_are_refused();
    a_section_may_come_once();
    memory_is_checked();
    arguments_are_checked();
    nothing_inside_breaks_it();
}
