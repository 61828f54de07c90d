/* Where the messages are in a block of a log: one walk from record to record, nothing copied, nothing trusted.
 *
 * A log is a chain of records, each known only from the one before. The chain is followed here; NumPy then takes
 * the fixed-size payloads out at the offsets found. Every length is checked against the end of the block first.
 */
#include "buffers.h"

#include <string.h>

enum { ULOG = 0, DATAFLASH = 1, MCAP = 2, ROSBAG = 3 };
enum { MORE = 0, FULL = 1, DAMAGED = 2 };

typedef struct {
    const uint8_t *bytes;
    uint64_t size;
} Block;

/* One record: where its payload is, what it is, and where the next record starts. */
typedef struct {
    uint64_t payload, length, next;
    int64_t key;
} Record;

static uint64_t little(const uint8_t *p, int bytes) {
    uint64_t value = 0;
    for (int i = bytes - 1; i >= 0; i--) value = value << 8 | p[i];
    return value;
}

/* u16 size, u8 type, payload; data ('D') begins with the u16 id of its subscription. key = type | id << 8. */
static int ulog(Block b, uint64_t at, Record *r) {
    if (b.size - at < 3) return MORE;
    const uint64_t size = little(b.bytes + at, 2);
    const uint8_t type = b.bytes[at + 2];
    if (type == 0 || strchr("ABCDFILMOPQRS", type) == NULL) return DAMAGED;
    if (b.size - at - 3 < size) return MORE;
    const uint64_t id = type == 'D' ? 2 : 0;
    if (size < id) return DAMAGED;
    r->payload = at + 3 + id;
    r->length = size - id;
    r->next = at + 3 + size;
    r->key = (int64_t)(type | (id ? little(b.bytes + at + 3, 2) << 8 : 0));
    return FULL;
}

/* A3 95, u8 type, payload; the length of each type is told by a message of type 128 before its first use. */
static int dataflash(Block b, uint64_t at, uint8_t *lengths, Record *r) {
    if (b.size - at < 3) return MORE;
    if (b.bytes[at] != 0xA3 || b.bytes[at + 1] != 0x95) return DAMAGED;
    const uint8_t type = b.bytes[at + 2];
    const uint64_t length = type == 128 ? 89 : lengths[type];
    if (length < 3) return DAMAGED;
    if (b.size - at < length) return MORE;
    if (type == 128) lengths[b.bytes[at + 3]] = b.bytes[at + 4];
    r->payload = at + 3;
    r->length = length - 3;
    r->next = at + length;
    r->key = type;
    return FULL;
}

/* u8 opcode, u64 length, payload; a message (5) begins with u16 channel, u32 sequence, two u64 times. */
static int mcap(Block b, uint64_t at, Record *r) {
    if (b.size - at < 9) return MORE;
    const uint8_t opcode = b.bytes[at];
    const uint64_t length = little(b.bytes + at + 1, 8);
    if (opcode == 0) return DAMAGED;
    if (b.size - at - 9 < length) return MORE;
    const uint64_t head = opcode == 5 ? 22 : 0;
    if (length < head) return DAMAGED;
    r->payload = at + 9 + head;
    r->length = length - head;
    r->next = at + 9 + length;
    r->key = (int64_t)(opcode | (head ? little(b.bytes + at + 9, 2) << 8 : 0));
    return FULL;
}

/* u32 length, fields "name=value" each with its u32 length, u32 length, payload. key = op | conn << 8. */
static int rosbag(Block b, uint64_t at, Record *r) {
    if (b.size - at < 4) return MORE;
    const uint64_t head = little(b.bytes + at, 4);
    if (b.size - at - 4 < head || b.size - at - 4 - head < 4) return MORE;
    uint64_t p = at + 4;
    const uint64_t end = p + head;
    uint64_t op = 0, conn = 0;
    while (p < end) {
        if (end - p < 4) return DAMAGED;
        const uint64_t length = little(b.bytes + p, 4);
        p += 4;
        if (end - p < length) return DAMAGED;
        if (length == 4 && memcmp(b.bytes + p, "op=", 3) == 0) op = b.bytes[p + 3];
        if (length == 9 && memcmp(b.bytes + p, "conn=", 5) == 0) conn = little(b.bytes + p + 5, 4);
        p += length;
    }
    const uint64_t data = little(b.bytes + end, 4);
    if (op == 0) return DAMAGED;
    if (b.size - end - 4 < data) return MORE;
    r->payload = end + 4;
    r->length = data;
    r->next = end + 4 + data;
    r->key = (int64_t)(op | conn << 8);
    return FULL;
}

PyDoc_STRVAR(walk_doc,
             "walk(kind, block, start, lengths, offsets, sizes, keys) -> (count, position, status)\n\n"
             "Follow the records of `block` from `start`. Payload offset, payload size and key of each go to the int64\n"
             "arrays; `lengths` is the DataFlash table of 256 message lengths (uint8, updated). Stops at `position`:\n"
             "status 0: the rest is no whole record, 1: the arrays are full, 2: what is there is no record.");

static PyObject *walk(PyObject *module, PyObject *args) {
    enum { BLOCK, LENGTHS, OFFSETS, SIZES, KEYS, BUFFERS };
    Py_buffer v[BUFFERS];
    int kind;
    Py_ssize_t start;
    (void)module;
    if (!PyArg_ParseTuple(args, "iy*nw*w*w*w*", &kind, &v[BLOCK], &start, &v[LENGTHS], &v[OFFSETS], &v[SIZES], &v[KEYS])) {
        return NULL;
    }
    Py_ssize_t capacity = v[OFFSETS].len < v[SIZES].len ? v[OFFSETS].len : v[SIZES].len;
    if (v[KEYS].len < capacity) capacity = v[KEYS].len;
    capacity /= INDEX_BYTES;
    int64_t *offset = v[OFFSETS].buf, *size = v[SIZES].buf, *key = v[KEYS].buf;
    const int fits = start >= 0 && start <= v[BLOCK].len && v[LENGTHS].len >= 256 && kind >= ULOG && kind <= ROSBAG;
    Py_ssize_t count = 0;
    int status = MORE;
    if (fits) {
        const Block b = {v[BLOCK].buf, (uint64_t)v[BLOCK].len};
        uint64_t at = (uint64_t)start;
        Record r = {0, 0, 0, 0};
        for (;;) {
            if (count == capacity) {
                status = FULL;
                break;
            }
            status = kind == ULOG        ? ulog(b, at, &r)
                     : kind == DATAFLASH ? dataflash(b, at, v[LENGTHS].buf, &r)
                     : kind == MCAP      ? mcap(b, at, &r)
                                         : rosbag(b, at, &r);
            if (status != FULL) break;
            offset[count] = (int64_t)r.payload;
            size[count] = (int64_t)r.length;
            key[count] = r.key;
            count++;
            at = r.next;
        }
        start = (Py_ssize_t)at;
    }
    static const char wrong[] = "no such kind of log, a start outside the block, or a short table of lengths";
    return released(v, BUFFERS, fits, wrong) ? Py_BuildValue("nni", count, start, status) : NULL;
}

MODULE(_logs, "Where the messages are in a log.", METHOD(walk))
