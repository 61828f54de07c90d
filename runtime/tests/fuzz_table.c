/* libFuzzer target: any bytes into the loader, and what it accepts into every function.
 *
 * The first byte chooses: even, the bytes as they are; odd, with version, size and CRC made to fit, so that the inside of
 * the loader is reached. Bytes and memory have just the size that the loader may use. */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "exercise.h"

static void put_u32(uint8_t *p, uint32_t value) {
    for (int i = 0; i < 4; i++) p[i] = (uint8_t)(value >> 8 * i);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size) {
    static const uint8_t magic[8] = {0x89, 0x49, 0x4D, 0x55, 0x4C, 0x41, 0x42, 0x0A};
    if (size == 0) return 0;
    const uint8_t choice = *data++;
    const size_t capacity = --size / (choice & 2 ? 4 : 16);
    uint8_t *bytes = malloc(size > 0 ? size : 1);
    il_real *memory = malloc(capacity > 0 ? capacity * sizeof *memory : 1);
    if (bytes != NULL && memory != NULL) {
        il_unit unit;
        memcpy(bytes, data, size);
        if ((choice & 1) && size >= 20) {
            memcpy(bytes, magic, sizeof magic);
            put_u32(bytes + 8, 1u | (choice & 4 ? 8u : 4u) << 16);
            put_u32(bytes + 12, (uint32_t)size);
            put_u32(bytes + size - 4, il_crc32(bytes, size - 4));
        }
        const il_status status = il_table_load(&unit, bytes, size, memory, capacity);
        if (status == IL_OK) exercise(&unit);
        else if (unit.has != 0) abort();
        if (strlen(il_status_text(status)) < 2) abort();
    }
    free(bytes);
    free(memory);
    return 0;
}
