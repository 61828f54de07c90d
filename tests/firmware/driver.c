/* Runs one function of the exported core on rows of doubles from standard input; rows of doubles to standard output.
 *
 *   driver unit|BLOB tumble | gyro | gyro-force | mag | centrifuge | warmup TEMPERATURE TICK | array
 *
 * `unit` takes the numbers compiled into unit.c, anything else is the file of a blob. One sample at a time, as a unit does.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "unit.h"

enum { MOST = 300, BLOB = 1 << 16 };

static uint8_t bytes[BLOB];
static il_real memory[BLOB / 4];
static il_unit loaded;
static il_array_state array_state;

static int fail(const char *what) {
    fprintf(stderr, "%s\n", what);
    return EXIT_FAILURE;
}

static size_t row(size_t columns, il_real *out) {
    static double in[MOST];
    const size_t got = fread(in, sizeof *in, columns, stdin);
    for (size_t i = 0; i < got; i++) out[i] = (il_real)in[i];
    return got == columns;
}

static void put(size_t columns, const il_real *values) {
    double out[MOST];
    for (size_t i = 0; i < columns; i++) out[i] = (double)values[i];
    (void)fwrite(out, sizeof *out, columns, stdout);
}

int main(int count, char **words) {
    il_real in[MOST], out[MOST];
    if (count < 3) return fail("driver unit|BLOB FUNCTION ...");
    if (strcmp(words[1], "unit") == 0) {
        loaded.has = UNIT_HAS;
        loaded.tumble = unit_tumble;
        loaded.gyro = unit_gyro;
        loaded.centrifuge = unit_centrifuge;
        loaded.warmup = unit_warmup;
    } else {
        FILE *file = fopen(words[1], "rb");
        if (file == NULL) return fail("no such blob");
        const size_t size = fread(bytes, 1, sizeof bytes, file);
        (void)fclose(file);
        const il_status status = il_table_load(&loaded, bytes, size, memory, size / 4);
        if (status != IL_OK) return fail(il_status_text(status));
    }
    if (strcmp(words[2], "tumble") == 0) {
        while (row(3, in)) {
            (void)il_tumble_apply(&loaded.tumble, in, out);
            put(3, out);
        }
    } else if (strcmp(words[2], "gyro") == 0) {
        while (row(3, in)) {
            (void)il_gyro_apply(&loaded.gyro, in, NULL, out);
            put(3, out);
        }
    } else if (strcmp(words[2], "gyro-force") == 0) {
        while (row(6, in)) {
            (void)il_gyro_apply(&loaded.gyro, in, in + 3, out);
            put(3, out);
        }
    } else if (strcmp(words[2], "mag") == 0) {
        while (row(3, in)) {
            (void)il_mag_apply(&loaded.mag, in, out);
            put(3, out);
        }
    } else if (strcmp(words[2], "centrifuge") == 0) {
        while (row(4, in)) {
            (void)il_centrifuge_apply(&loaded.centrifuge, in, in + 2);
            put(2, in + 2);
        }
    } else if (strcmp(words[2], "warmup") == 0 && count == 5) {
        il_warmup_state state;
        double ticks;
        if (il_warmup_start(&loaded.warmup, &state, (il_real)atof(words[3]), (il_real)atof(words[4])) != IL_OK) {
            return fail("il_warmup_start");
        }
        while (fread(&ticks, sizeof ticks, 1, stdin) == 1) {
            il_warmup_bias(&loaded.warmup, &state, (uint32_t)ticks, out);
            put((size_t)loaded.warmup.axes, out);
        }
    } else if (strcmp(words[2], "array") == 0) {
        if (il_array_start(&loaded.array, &array_state) != IL_OK) return fail("il_array_start");
        while (row((size_t)(loaded.array.axes * loaded.array.elements), in)) {
            (void)il_array_step(&loaded.array, &array_state, in, out);
            put((size_t)loaded.array.axes, out);
        }
    } else {
        return fail("unknown function");
    }
    return EXIT_SUCCESS;
}
