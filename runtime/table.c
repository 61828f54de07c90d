/* Tables: the numbers of one unit as bytes ("blob"), checked to the last bit before any of them is believed.
 *
 *   offset 0   8 bytes  89 49 4D 55 4C 41 42 0A
 *          8   u16      version (1 to 3)      10  u16  bytes per number: 4 (float) or 8 (double)
 *         12   u32      size of the whole table, CRC included
 *         16   sections: u32 kind, u32 size of what follows, then u32 counts and IEEE 754 numbers
 *   size - 4   u32      CRC-32 of everything before
 *
 * All integers little-endian. Section 0 is text for people and programs on the desk; it is skipped here.
 */
#include "real.h"

enum { HEAD = 16, TAIL = 4, SECTION_HEAD = 8, MANY = 65536 };
enum { CROSSED = 256 }; /* on top of a tumble's order: cross terms follow the polynomial */
enum { TEXT = 0, TUMBLE = 1, GYRO = 2, CENTRIFUGE = 3, WARMUP = 4, ARRAY = 5, MAG = 6, THERMAL = 7, THERMAL_GYRO = 8,
       IMUS = 9 };

static const uint8_t MAGIC[8] = {0x89, 0x49, 0x4D, 0x55, 0x4C, 0x41, 0x42, 0x0A};

uint32_t il_crc32(const uint8_t *bytes, size_t n) {
    uint32_t crc = 0xFFFFFFFFu;
    for (size_t i = 0; i < n; i++) {
        crc ^= bytes[i];
        for (int bit = 0; bit < 8; bit++) crc = (crc >> 1) ^ (0xEDB88320u & (0u - (crc & 1u)));
    }
    return ~crc;
}

const char *il_status_text(il_status status) {
    switch (status) {
        case IL_OK: return "ok";
        case IL_ARGUMENT: return "an argument or a setting that cannot be";
        case IL_TABLE_SHORT: return "the table is cut off";
        case IL_TABLE_LONG: return "bytes follow the table";
        case IL_TABLE_NOT_TABLE: return "not a table of imulab";
        case IL_TABLE_NEWER: return "the table is of a newer version";
        case IL_TABLE_CORRUPT: return "the table is corrupt (CRC-32)";
        case IL_TABLE_WIDTH: return "the table has numbers of another width";
        case IL_TABLE_NOT_FINITE: return "the table has a number that is not finite";
        case IL_TABLE_CONTENT: return "the table has contents that cannot be";
        case IL_TABLE_MEMORY: return "too little memory for the table";
    }
    return "unknown status";
}

/* Bytes being read, and where numbers that need an address go. The first fault stays. */
typedef struct {
    const uint8_t *at, *end;
    uint32_t width, version;
    il_real *memory;
    size_t capacity;
    il_status status;
} cursor;

static void fail(cursor *c, il_status status) {
    if (c->status == IL_OK) c->status = status;
}

static uint32_t u32(const uint8_t *p) {
    return (uint32_t)p[0] | (uint32_t)p[1] << 8 | (uint32_t)p[2] << 16 | (uint32_t)p[3] << 24;
}

static uint32_t whole(cursor *c) {
    if (c->end - c->at < 4) {
        fail(c, IL_TABLE_CONTENT);
        return 0;
    }
    uint32_t value = u32(c->at);
    c->at += 4;
    return value;
}

/* A count between two limits. */
static int32_t count(cursor *c, uint32_t least, uint32_t most) {
    uint32_t value = whole(c);
    if (value >= least && value <= most) return (int32_t)value;
    fail(c, IL_TABLE_CONTENT);
    return (int32_t)least;
}

/* Whether n numbers are still to come in this section. */
static int there(cursor *c, size_t n) {
    if ((size_t)(c->end - c->at) / c->width >= n) return 1;
    fail(c, IL_TABLE_CONTENT);
    return 0;
}

static void numbers(cursor *c, il_real *out, size_t n) {
    for (size_t i = 0; i < n; i++) out[i] = IL_C(0.0);
    if (!there(c, n)) return;
    for (size_t i = 0; i < n; i++, c->at += c->width) {
#if !IL_FLOAT
        if (c->width == 8) {
            uint64_t bits = (uint64_t)u32(c->at) | (uint64_t)u32(c->at + 4) << 32;
            memcpy(&out[i], &bits, sizeof bits);
        } else
#endif
        {
            uint32_t bits = u32(c->at);
            float narrow;
            memcpy(&narrow, &bits, sizeof narrow);
            out[i] = (il_real)narrow;
        }
        if (!il_finite(out[i])) fail(c, IL_TABLE_NOT_FINITE);
    }
}

static il_real number(cursor *c) {
    il_real value;
    numbers(c, &value, 1);
    return value;
}

static il_real positive(cursor *c) {
    il_real value = number(c);
    if (!(value > IL_C(0.0))) fail(c, IL_TABLE_CONTENT);
    return value;
}

/* Numbers into the caller's memory; NULL for none. */
static const il_real *kept(cursor *c, size_t n) {
    if (n == 0 || c->status != IL_OK || !there(c, n)) return NULL;
    if (n > c->capacity) {
        fail(c, IL_TABLE_MEMORY);
        return NULL;
    }
    il_real *place = c->memory;
    numbers(c, place, n);
    c->memory += n;
    c->capacity -= n;
    return place;
}

static void read_tumble(cursor *c, il_tumble *t) {
    t->order = count(c, 1, CROSSED + IL_TUMBLE_ORDER);
    t->has_cross = t->order > CROSSED;
    if (t->has_cross) t->order -= CROSSED;
    if (t->order > IL_TUMBLE_ORDER) {
        fail(c, IL_TABLE_CONTENT);
        return;
    }
    numbers(c, t->gain, 3);
    numbers(c, t->bias, 3);
    numbers(c, t->misalignment, 3);
    numbers(c, t->low, 3);
    numbers(c, t->high, 3);
    for (int p = 0; p < IL_TUMBLE_ORDER - 1; p++) {
        if (p < t->order - 1) numbers(c, t->nonlinearity[p], 3);
    }
    if (t->has_cross) numbers(c, t->cross, 3);
}

static void read_gyro(cursor *c, il_gyro *g) {
    g->has_sensitivity = count(c, 0, 1);
    g->order = c->version > 1 ? count(c, 1, IL_TUMBLE_ORDER) : 1;
    numbers(c, g->gain, 3);
    numbers(c, g->bias, 3);
    for (int i = 0; i < 3; i++) numbers(c, g->turn[i], 3);
    for (int i = 0; i < 3 && g->has_sensitivity; i++) numbers(c, g->sensitivity[i], 3);
    if (g->order < 2) return;
    numbers(c, g->low, 3);
    numbers(c, g->high, 3);
    for (int p = 0; p < g->order - 1; p++) numbers(c, g->nonlinearity[p], 3);
}

static void read_mag(cursor *c, il_mag *m) {
    m->order = count(c, 1, 2);
    numbers(c, m->gain, 3);
    numbers(c, m->bias, 3);
    for (int i = 0; i < 3; i++) numbers(c, m->turn[i], 3);
    if (m->order > 1) numbers(c, m->quadratic, 3);
}

/* Temperatures in rising order. */
static const il_real *knots(cursor *c, int32_t pieces) {
    const il_real *knot = kept(c, (size_t)pieces + 1);
    for (int32_t i = 0; knot != NULL && i < pieces; i++) {
        if (!(knot[i + 1] > knot[i])) fail(c, IL_TABLE_CONTENT);
    }
    return knot;
}

static void read_thermal(cursor *c, il_thermal *t) {
    t->pieces = count(c, 1, MANY);
    t->terms = count(c, 1, IL_THERMAL_TERMS);
    t->knot = knots(c, t->pieces);
    t->coefficient = kept(c, (size_t)t->pieces * IL_THERMAL_LAWS * (size_t)t->terms);
}

static void read_thermal_gyro(cursor *c, il_thermal_gyro *t) {
    t->has_sensitivity = count(c, 0, 1);
    t->pieces = count(c, 1, MANY);
    t->terms = count(c, 1, IL_THERMAL_TERMS);
    for (int i = 0; i < 3; i++) numbers(c, t->turn[i], 3);
    for (int i = 0; i < 3 && t->has_sensitivity; i++) numbers(c, t->sensitivity[i], 3);
    t->knot = knots(c, t->pieces);
    t->coefficient = kept(c, (size_t)t->pieces * IL_THERMAL_GYRO_LAWS * (size_t)t->terms);
}

static void read_centrifuge(cursor *c, il_centrifuge *k) {
    k->has[0] = count(c, 0, 1);
    k->has[1] = count(c, 0, 1);
    k->highest = positive(c);
    numbers(c, k->k0, 2);
    numbers(c, k->c1, 2);
    numbers(c, k->c2, 2);
    numbers(c, k->cosine, 2);
    numbers(c, k->sine, 2);
}

static void read_warmup(cursor *c, il_warmup *w) {
    w->model = count(c, IL_INTERVAL_CUBIC, IL_EXPONENTIAL);
    w->exit = count(c, IL_EXIT_ZERO, IL_EXIT_TAPER);
    w->temperatures = count(c, 2, MANY);
    w->axes = count(c, 1, MANY);
    int exponential = w->model == IL_EXPONENTIAL;
    w->terms = count(c, exponential ? 1 : 4, exponential ? 3 : 4);
    w->settling_time = positive(c);
    w->taper_time = number(c);
    w->time_scale = number(c);
    numbers(c, w->time_constant, 3);
    if (w->taper_time < IL_C(0.0)) fail(c, IL_TABLE_CONTENT);
    if (w->model == IL_KNOT_LOG_CUBIC && !(w->time_scale > IL_C(0.0))) fail(c, IL_TABLE_CONTENT);
    for (int32_t j = 0; exponential && j < w->terms; j++) {
        if (!(w->time_constant[j] > IL_C(0.0))) fail(c, IL_TABLE_CONTENT);
    }
    /* No more numbers than the section has bytes for: asked by division, because a product need not fit in size_t. */
    uint32_t left = (uint32_t)(c->end - c->at) / c->width, per_row = (uint32_t)w->axes * (uint32_t)w->terms;
    uint32_t rows = (uint32_t)w->temperatures - (w->model == IL_INTERVAL_CUBIC ? 1u : 0u);
    if ((uint32_t)w->temperatures > left || rows > left / per_row) {
        fail(c, IL_TABLE_CONTENT);
        return;
    }
    size_t size = (size_t)rows * per_row;
    w->temperature = kept(c, (size_t)w->temperatures);
    w->coefficient = kept(c, size);
    w->slope = kept(c, exponential ? size : 0);
    for (int32_t i = 1; w->temperature != NULL && i < w->temperatures; i++) {
        if (!(w->temperature[i] > w->temperature[i - 1])) fail(c, IL_TABLE_CONTENT);
    }
}

static void read_array(cursor *c, il_array *a) {
    a->method = count(c, IL_MEAN, IL_METHODS - 1);
    a->elements = count(c, 1, IL_ARRAY_ELEMENTS);
    a->axes = count(c, 1, 3);
    a->initial = count(c, IL_FIRST, IL_GIVEN);
    a->kernel = count(c, IL_GAUSSIAN, IL_EXPONENTIAL_KERNEL);
    a->start = whole(c);
    a->cap = whole(c);
    a->stuck = whole(c);
    a->jump = whole(c);
    a->quiet = whole(c);
    uint32_t tables = (uint32_t)count(c, 0, 31);
    a->memory = number(c);
    a->gate = number(c);
    a->spread_gate = number(c);
    a->scale_tolerance = number(c);
    a->weight_cap = number(c);
    a->weight_floor = number(c);
    size_t n = (size_t)a->elements, axes = (size_t)a->axes;
    a->offset = kept(c, tables & 1u ? axes * n : 0);
    a->matrix = kept(c, tables & 2u ? n * axes * axes : 0);
    a->bias = kept(c, tables & 4u ? axes * n : 0);
    a->weight = kept(c, tables & 8u ? axes * n : 0);
    a->gain = kept(c, tables & 16u ? axes * (n + 1) * n : 0);
    if (il_array_check(a) != IL_OK) fail(c, IL_TABLE_CONTENT);
}

static void read_imus(cursor *c, il_imus *m) {
    m->count = count(c, 2, IL_IMUS);
    m->stuck = whole(c);
    m->quiet = whole(c);
    m->gate = positive(c);
    numbers(c, m->at, 3);
    const size_t n = (size_t)m->count;
    m->position = kept(c, 3 * n);
    m->accel = kept(c, 9 * n);
    m->accel_bias = kept(c, 3 * n);
    m->accel_noise = kept(c, n);
    m->accel_limit = kept(c, n);
    m->gyro = kept(c, 9 * n);
    m->gyro_bias = kept(c, 3 * n);
    m->gyro_noise = kept(c, n);
    m->gyro_limit = kept(c, n);
    m->gyro_rows = kept(c, 9 * n);
    if (c->status == IL_OK && il_imus_check(m) != IL_OK) fail(c, IL_TABLE_CONTENT);
}

static void read_section(cursor *c, il_unit *unit, uint32_t kind) {
    uint32_t bit = kind == TEXT ? 0u : 1u << (kind - 1u);
    if (unit->has & bit) fail(c, IL_TABLE_CONTENT); /* one of each */
    unit->has |= bit;
    switch (kind) {
        case TUMBLE: read_tumble(c, &unit->tumble); break;
        case GYRO: read_gyro(c, &unit->gyro); break;
        case CENTRIFUGE: read_centrifuge(c, &unit->centrifuge); break;
        case WARMUP: read_warmup(c, &unit->warmup); break;
        case ARRAY: read_array(c, &unit->array); break;
        case MAG: read_mag(c, &unit->mag); break;
        case THERMAL: read_thermal(c, &unit->thermal); break;
        case THERMAL_GYRO: read_thermal_gyro(c, &unit->thermal_gyro); break;
        case IMUS: read_imus(c, &unit->imus); break;
        default: c->at = c->end; break;
    }
    if (c->at != c->end) fail(c, IL_TABLE_CONTENT);
}

static il_status load(il_unit *unit, const uint8_t *bytes, size_t size, il_real *memory, size_t capacity) {
    if (size < HEAD + TAIL) return IL_TABLE_SHORT;
    if (memcmp(bytes, MAGIC, sizeof MAGIC) != 0) return IL_TABLE_NOT_TABLE;
    uint32_t version = u32(bytes + 8) & 0xFFFFu, width = u32(bytes + 8) >> 16, stated = u32(bytes + 12);
    if (version > IL_VERSION) return IL_TABLE_NEWER;
    if (size < stated) return IL_TABLE_SHORT;
    if (size > stated) return IL_TABLE_LONG;
    if (il_crc32(bytes, size - TAIL) != u32(bytes + size - TAIL)) return IL_TABLE_CORRUPT;
    if (version < 1) return IL_TABLE_CONTENT;
    if (width != 4 && !(width == 8 && !IL_FLOAT)) return IL_TABLE_WIDTH;
    cursor c = {bytes + HEAD, NULL, width, version, memory, capacity, IL_OK};
    const uint8_t *end = bytes + size - TAIL;
    while (c.at < end && c.status == IL_OK) {
        if (end - c.at < SECTION_HEAD) return IL_TABLE_CONTENT;
        uint32_t kind = u32(c.at), length = u32(c.at + 4);
        c.at += SECTION_HEAD;
        if (kind > (version > 2 ? IMUS : THERMAL_GYRO) || length > (size_t)(end - c.at)) return IL_TABLE_CONTENT;
        c.end = c.at + length;
        read_section(&c, unit, kind);
    }
    return c.status;
}

il_status il_table_load(il_unit *unit, const uint8_t *bytes, size_t size, il_real *memory, size_t capacity) {
    if (unit == NULL || bytes == NULL || (memory == NULL && capacity > 0)) return IL_ARGUMENT;
    memset(unit, 0, sizeof *unit);
    il_status status = load(unit, bytes, size, memory, capacity);
    if (status != IL_OK) memset(unit, 0, sizeof *unit);
    return status;
}
