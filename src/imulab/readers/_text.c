/* Numbers out of delimited text, correctly rounded, at memory speed.
 *
 * One pass over a block of whole lines writes each wanted field into its own column. A decimal with up to 19
 * significant digits is rounded exactly by one IEEE operation where both operands are exact (W. D. Clinger, "How to read
 * floating point numbers accurately", PLDI 1990), or else by one or two multiplications with a power of five of 128 bits
 * (D. Lemire, "Number parsing at a gigabyte per second", Software: Practice and Experience 51, 2021; that it never needs
 * help: N. Mushtak and D. Lemire, "Fast number parsing without fallback", 2023). Everything else goes through Python's
 * own correctly rounded conversion. No processor foresees the sign or the decimals of a sensor's readings: no branch depends
 * on the sign, and on x86-64 none on the number of decimals from eight on. The interpreter is let go while a block is read,
 * so that threads can share a file.
 */
#include "buffers.h"

#include <float.h>
#include <math.h>
#include <string.h>
#ifdef __x86_64__
#include <emmintrin.h>
#endif

enum { OK = 0, NOT_A_NUMBER = 1, WRONG_COUNT = 2, LONGEST_TOKEN = 1100 }; /* 3, 4: of dates;
    the exact digits of any double have no more characters */
/* Flag of a slot: the field is a date, the column takes nanoseconds since 1970 as int64; the order is in two bits. */
enum { DATE = 1 << 30, ORDER = 28, FLAGS = DATE | 3 << ORDER };

#include "_dates.h"
#include "_fields.h"

static const double TENS[] = {1e0,  1e1,  1e2,  1e3,  1e4,  1e5,  1e6,  1e7,  1e8,  1e9,  1e10, 1e11,
                              1e12, 1e13, 1e14, 1e15, 1e16, 1e17, 1e18, 1e19, 1e20, 1e21, 1e22};

static const double SIGNS[] = {1.0, -1.0};

enum { LOWEST_POWER = -342, HIGHEST_POWER = 308, POWERS = HIGHEST_POWER - LOWEST_POWER + 1, MODERATE = 270 };
/* A double holds integers up to 2^53 exactly; numbers of 16 digits, which lie on both sides of it, all go the other way. */
#ifdef __SIZEOF_INT128__
#define LARGEST_EXACT UINT64_C(1000000000000000)
#else
#define LARGEST_EXACT (UINT64_C(1) << 53)
#endif

/* 5^q, scaled to 128 bits with the highest one set: high and low half of each; filled by prepare(). */
static uint64_t fives[2 * POWERS];
static int prepared = 0;

#ifdef __SIZEOF_INT128__
/* The bits of w 10^q, rounded to nearest even; w > 0; `moderate`: neither q nor the result is near an end of its range. */
static inline double scaled(uint64_t w, int64_t q, int moderate) {
    if (!moderate && q < LOWEST_POWER) return 0.0;
    if (!moderate && q > HIGHEST_POWER) return (double)INFINITY;
    const int lz = __builtin_clzll(w);
    w <<= lz;
    const uint64_t *five = fives + 2 * (q - LOWEST_POWER);
    unsigned __int128 product = (unsigned __int128)w * five[0];
    uint64_t high = (uint64_t)(product >> 64), low = (uint64_t)product;
    if ((high & 0x1FF) == 0x1FF) { /* the bits behind the mantissa could still be carried into */
        const uint64_t more = (uint64_t)(((unsigned __int128)w * five[1]) >> 64);
        low += more;
        if (low < more) high++;
    }
    const int upper = (int)(high >> 63);
    uint64_t mantissa = high >> (upper + 9);
    int64_t exponent = (((152170 + 65536) * q) >> 16) + 63 + upper - lz + 1023;
    if (!moderate && exponent <= 0) { /* subnormal */
        if (-exponent + 1 >= 64) return 0.0;
        mantissa >>= -exponent + 1;
        mantissa += mantissa & 1u;
        mantissa >>= 1;
        exponent = mantissa < (UINT64_C(1) << 52) ? 0 : 1;
    } else {
        if (low <= 1 && q >= -4 && q <= 23 && (mantissa & 3u) == 1 && mantissa << (upper + 9) == high) {
            mantissa &= ~UINT64_C(1); /* exactly half way: to even */
        }
        mantissa += mantissa & 1u;
        mantissa >>= 1;
        if (mantissa >= UINT64_C(1) << 53) {
            mantissa = UINT64_C(1) << 52;
            exponent++;
        }
        if (!moderate && exponent >= 0x7FF) return (double)INFINITY;
    }
    const uint64_t bits = (mantissa & ~(UINT64_C(1) << 52)) | (uint64_t)exponent << 52;
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}
#endif

/* w 10^q if that is known exactly rounded; returns 0 where it is not. */
static inline int decimal(uint64_t w, int64_t q, double *value) {
    if (w == 0) {
        *value = 0.0;
    } else if (FLT_EVAL_METHOD == 0 && w <= LARGEST_EXACT && q >= -22 && q <= 22) {
        *value = q < 0 ? (double)w / TENS[-q] : (double)w * TENS[q];
    } else {
#ifdef __SIZEOF_INT128__
        *value = q >= -MODERATE && q <= MODERATE ? scaled(w, q, 1) : scaled(w, q, 0);
#else
        return 0;
#endif
    }
    return 1;
}

/* The token [p, end) without surrounding blanks -> value; takes the interpreter back while it converts. */
static int slow_number(const char *p, const char *end, double *value, PyThreadState **thread) {
    char text[LONGEST_TOKEN + 1];
    size_t length = (size_t)(end - p);
    if (length == 0 || length > LONGEST_TOKEN) return NOT_A_NUMBER;
    memcpy(text, p, length);
    text[length] = '\0';
    char *stop = NULL;
    PyEval_RestoreThread(*thread);
    *value = PyOS_string_to_double(text, &stop, NULL);
    const int failed = PyErr_Occurred() != NULL;
    PyErr_Clear();
    *thread = PyEval_SaveThread();
    return !failed && stop == text + length ? OK : NOT_A_NUMBER;
}

static int number(const char *p, const char *end, double *value, PyThreadState **thread) {
    while (p < end && (*p == ' ' || *p == '\t')) p++;
    while (end > p && (end[-1] == ' ' || end[-1] == '\t' || end[-1] == '\r')) end--;
    if (end - p >= 2 && *p == '"' && end[-1] == '"') { /* spreadsheets quote numbers */
        p++;
        end--;
    }
    if (p == end) {
        *value = (double)NAN; /* an empty field is a missing reading */
        return OK;
    }
    const char *start = p;
    if (end - p == 3 && (p[0] | 32) == 'n' && (p[1] | 32) == 'a' && (p[2] | 32) == 'n') {
        *value = (double)NAN;
        return OK;
    }
    int negative = *p == '-';
    if (*p == '-' || *p == '+') p++;
    uint64_t w = 0;
    int significant = 0, digits = 0, exponent = 0;
    for (; p < end && *p >= '0' && *p <= '9'; p++, digits++) {
        w = 10u * w + (uint64_t)(*p - '0');
        significant += significant > 0 || *p != '0';
        if (significant > 19) return slow_number(start, end, value, thread);
    }
    if (p < end && *p == '.') {
        for (p++; p < end && *p >= '0' && *p <= '9'; p++, digits++, exponent--) {
            w = 10u * w + (uint64_t)(*p - '0');
            significant += significant > 0 || *p != '0';
            if (significant > 19) return slow_number(start, end, value, thread);
        }
    }
    if (digits == 0) return slow_number(start, end, value, thread); /* nan, inf, or nothing that is a number */
    if (p < end && (*p == 'e' || *p == 'E')) {
        p++;
        int down = p < end && *p == '-', power = 0, power_digits = 0;
        if (p < end && (*p == '-' || *p == '+')) p++;
        for (; p < end && *p >= '0' && *p <= '9'; p++, power_digits++) {
            power = 10 * power + (*p - '0');
            if (power > 9999) return slow_number(start, end, value, thread);
        }
        if (power_digits == 0) return NOT_A_NUMBER;
        exponent += down ? -power : power;
    }
    if (p != end) return NOT_A_NUMBER;
    double magnitude;
    if (!decimal(w, exponent, &magnitude)) return slow_number(start, end, value, thread);
    *value = negative ? -magnitude : magnitude;
    return OK;
}

/* Eight digits at p -> *w, or 0 if they are not eight digits. */
static inline int eight_digits(const char *p, uint64_t *w) {
#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__
    uint64_t v;
    memcpy(&v, p, sizeof v);
    if (((v + UINT64_C(0x4646464646464646)) | (v - UINT64_C(0x3030303030303030))) & UINT64_C(0x8080808080808080)) return 0;
    v -= UINT64_C(0x3030303030303030);
    v = v * 10 + (v >> 8);
    const uint64_t mask = UINT64_C(0x000000FF000000FF);
    v = ((v & mask) * UINT64_C(0x000F424000000064) + ((v >> 16) & mask) * UINT64_C(0x0000271000000001)) >> 32;
    *w = *w * 100000000u + (v & UINT64_C(0xFFFFFFFF));
    return 1;
#else
    (void)p;
    (void)w;
    return 0;
#endif
}

#ifdef __x86_64__
/* The digits at p, or the first 16 of them -> behind those of *w; where they end. 16 bytes on both sides of p are read. */
static inline const char *last_digits(const char *p, uint64_t *w) {
    static const uint64_t tens[] = {
        1u, 10u, 100u, 1000u, 10000u, 100000u, 1000000u, 10000000u, 100000000u, 1000000000u, UINT64_C(10000000000),
        UINT64_C(100000000000), UINT64_C(1000000000000), UINT64_C(10000000000000), UINT64_C(100000000000000),
        UINT64_C(1000000000000000), UINT64_C(10000000000000000)};
    static const int8_t kept[32] = {0,  0,  0,  0,  0,  0,  0,  0,  0,  0,  0,  0,  0,  0,  0,  0,
                                    -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1, -1};
    const __m128i zeros = _mm_set1_epi8('0'), nine = _mm_set1_epi8(9);
    __m128i v = _mm_sub_epi8(_mm_loadu_si128((const __m128i *)p), zeros);
    const int count = __builtin_ctz(~(unsigned)_mm_movemask_epi8(_mm_cmpeq_epi8(_mm_min_epu8(v, nine), v)));
    p += count;
    /* The 16 bytes before the end, with zeros for those before p. */
    v = _mm_sub_epi8(_mm_loadu_si128((const __m128i *)(p - 16)), zeros);
    v = _mm_and_si128(v, _mm_loadu_si128((const __m128i *)(kept + count)));
    v = _mm_add_epi16(_mm_mullo_epi16(v, _mm_set1_epi16(10)), _mm_srli_epi16(v, 8)); /* pairs, in the lower bytes */
    v = _mm_madd_epi16(_mm_and_si128(v, _mm_set1_epi16(255)), _mm_set1_epi32(1 << 16 | 100));
    v = _mm_madd_epi16(_mm_packs_epi32(v, v), _mm_set1_epi32(1 << 16 | 10000));
    const uint64_t halves = (uint64_t)_mm_cvtsi128_si64(v);
    *w = *w * tens[count] + (halves & UINT64_C(0xFFFFFFFF)) * 100000000u + (halves >> 32);
    return p;
}
#endif

/* Digits at p -> behind those of *w; where they end, which is before `end`. */
static inline const char *digits(const char *p, const char *end, uint64_t *w) {
    while (end - p >= 8 && eight_digits(p, w)) {
        p += 8;
#ifdef __x86_64__
        if (end - p >= 16) return last_digits(p, w);
#endif
    }
    for (; *p >= '0' && *p <= '9'; p++) *w = 10u * *w + (uint64_t)(*p - '0');
    return p;
}

/* A plain decimal that begins at p: where it ends, or NULL if it needs the careful way. */
static inline const char *plain_number(const char *p, const char *end, double *value) {
    const int negative = *p == '-';
    p += negative;
    uint64_t w = 0;
    const char *first = p;
    for (; *p >= '0' && *p <= '9'; p++) w = 10u * w + (uint64_t)(*p - '0');
    int64_t count = p - first, exponent = 0;
    if (*p == '.') {
        const char *point = ++p;
        p = digits(p, end, &w);
        exponent = point - p;
        count -= exponent;
    }
    for (; count > 19 && (*first == '0' || *first == '.'); first++) count -= *first == '0'; /* leading zeros */
    if (count == 0 || count > 19) return NULL;
    if ((*p | 32) == 'e') {
        p++;
        const int down = *p == '-';
        if (*p == '-' || *p == '+') p++;
        int64_t power = 0;
        const char *start = p;
        for (; *p >= '0' && *p <= '9' && p - start < 5; p++) power = 10 * power + (*p - '0');
        if (p == start || p - start > 4) return NULL;
        exponent += down ? -power : power;
    }
    double magnitude;
    if (!decimal(w, exponent, &magnitude)) return NULL;
    *value = SIGNS[negative] * magnitude;
    return p;
}

/* What a thread reads, and where to. */
typedef struct {
    const char *end;
    const int32_t *slots;
    double *out;
    Py_ssize_t fields, capacity;
    char delimiter;
    int dated; /* whether a field is a date */
    Py_ssize_t first; /* row of the first line */
    PyThreadState *thread;
} Task;

/* A line of plain decimals at p, 16 bytes or more into the block, whose end stops every loop: where the next begins, or NULL if
 * it needs the careful way. */
static const char *plain_line(const Task *t, const char *p, Py_ssize_t row) {
    const int blanks = t->delimiter == ' ';
    for (Py_ssize_t field = 0; field < t->fields; field++) {
        if (blanks) {
            while (*p == ' ' || *p == '\t') p++;
        }
        if (t->slots[field] >= 0) {
            p = plain_number(p, t->end, &t->out[t->slots[field] * t->capacity + row]);
            if (p == NULL) return NULL;
        } else {
            const char *start = p;
            while (*p != t->delimiter && *p != '\n' && *p != '\r' && !(blanks && *p == '\t')) p++;
            if (blanks && p == start) return NULL;
        }
        if (field + 1 < t->fields) {
            if (!(*p == t->delimiter || (blanks && *p == '\t'))) return NULL;
            p++;
        }
    }
    if (blanks) {
        while (*p == ' ' || *p == '\t') p++;
    }
    if (*p == '\r') p++;
    return *p == '\n' ? p + 1 : NULL;
}

/* Any line [p, end) into row `row` of the columns; `*found`: the number of fields, or the index of the bad one. */
static int line_fields(Task *t, const char *p, const char *end, Py_ssize_t row, Py_ssize_t *found) {
    Py_ssize_t field = 0;
    const int blanks = t->delimiter == ' ';
    if (end > p && end[-1] == '\r') end--;
    for (;;) {
        if (blanks) {
            while (p < end && (*p == ' ' || *p == '\t')) p++;
            if (p == end) break;
        }
        const char *stop = p;
        if (blanks) {
            while (stop < end && *stop != ' ' && *stop != '\t') stop++;
        } else {
            stop = memchr(p, t->delimiter, (size_t)(end - p));
            if (stop == NULL) stop = end;
        }
        if (field < t->fields && t->slots[field] >= 0) {
            double *value = &t->out[(t->slots[field] & ~FLAGS) * t->capacity + row];
            const int order = t->slots[field] >> ORDER & 3;
            const int problem = t->slots[field] & DATE ? date(p, stop, order, value) : number(p, stop, value, &t->thread);
            /* A time of day below a date is damaged. */
            const int other = problem == OK && t->slots[field] & DATE && row > t->first && !is_time_of_day(value - 1);
            if (problem != OK || (other && is_time_of_day(value))) {
                *found = field;
                return problem != OK ? problem : NOT_A_DATE;
            }
        }
        field++;
        if (stop == end) break;
        p = stop + 1;
    }
    *found = field;
    return field == t->fields ? OK : WRONG_COUNT;
}

PyDoc_STRVAR(parse_doc,
             "parse(block, delimiter, slots, out, capacity, start=0, stop=-1, row=0) -> (rows, problem, field)\n\n"
             "Read whole lines of `block` from byte `start` to `stop`; field i goes to column slots[i] (int32, -1: skip) of\n"
             "`out`, a writable float64 buffer of columns with `capacity` rows each, from row `row` on. Delimiter ' ' means\n"
             "any run of blanks. A slot with bit 30 set takes dates, as nanoseconds since 1970 (int64); bit 28: the day comes\n"
             "first, bit 29: the month. On a problem (1: field `field` is no number, 2: the line has `field` fields, 3: field\n"
             "`field` is no date, 4: day and month may be either way round) `rows` is the index of that\n"
             "line from `start`. The interpreter is released: threads may fill different rows.");

static PyObject *parse(PyObject *module, PyObject *args) {
    enum { BLOCK, SLOTS, OUT, BUFFERS };
    Py_buffer v[BUFFERS];
    int delimiter;
    Py_ssize_t capacity, start = 0, last = -1, row = 0;
    (void)module;
    if (!PyArg_ParseTuple(args, "y*Cy*w*n|nnn", &v[BLOCK], &delimiter, &v[SLOTS], &v[OUT], &capacity, &start, &last, &row)) {
        return NULL;
    }
    if (last < 0) last = v[BLOCK].len;
    Task t = {NULL, v[SLOTS].buf, v[OUT].buf, v[SLOTS].len / (Py_ssize_t)sizeof(int32_t), capacity, (char)delimiter, 0, row, NULL};
    Py_ssize_t rows = 0, found = 0;
    int problem = OK, fits = prepared && capacity >= 0 && delimiter > 0 && delimiter < 128 && start >= 0 &&
                             start <= last && last <= v[BLOCK].len && row >= 0;
    for (Py_ssize_t i = 0; fits && i < t.fields; i++) {
        const Py_ssize_t columns = v[OUT].len / DOUBLE_BYTES / (capacity > 0 ? capacity : 1);
        fits = t.slots[i] < 0 || (t.slots[i] & ~FLAGS) < columns;
        t.dated |= t.slots[i] >= 0 && (t.slots[i] & DATE);
    }
    if (fits) {
        const char *p = (const char *)v[BLOCK].buf + start;
        t.end = (const char *)v[BLOCK].buf + last;
        const char *first = (const char *)v[BLOCK].buf + 16, *ended = t.end; /* behind the last line that has an end */
        while (ended > p && ended[-1] != '\n') ended--;
        t.thread = PyEval_SaveThread();
        while (p < t.end) {
            if (row + rows >= capacity) {
                fits = 0;
                break;
            }
            const char *next = t.dated || p < first || p >= ended ? NULL : plain_line(&t, p, row + rows);
            if (next == NULL) {
                const char *stop = memchr(p, '\n', (size_t)(t.end - p));
                if (stop == NULL) stop = t.end;
                problem = line_fields(&t, p, stop, row + rows, &found);
                if (problem != OK) break;
                next = stop + 1;
            }
            rows++;
            p = next;
        }
        PyEval_RestoreThread(t.thread);
        if (problem == OK && rows > 0) found = t.fields;
    }
    static const char wrong[] = "the output buffer is too small for the block, or the delimiter is not ASCII";
    return released(v, BUFFERS, fits, wrong) ? Py_BuildValue("nin", rows, problem, found) : NULL;
}

PyDoc_STRVAR(line_ends_doc, "line_ends(block) -> int\n\nThe number of line ends: twenty times as fast as bytes.count.");

static PyObject *line_ends(PyObject *module, PyObject *args) {
    enum { AT_ONCE = 255 }; /* whose number fits in a byte, so that the compiler compares 16 at a time */
    Py_buffer block;
    Py_ssize_t count = 0;
    (void)module;
    if (!PyArg_ParseTuple(args, "y*", &block)) return NULL;
    const char *p = block.buf, *end = p + block.len;
    for (; end - p >= AT_ONCE; p += AT_ONCE) {
        uint8_t ends = 0;
        for (int i = 0; i < AT_ONCE; i++) ends = (uint8_t)(ends + (p[i] == '\n'));
        count += ends;
    }
    for (; p < end; p++) count += *p == '\n';
    PyBuffer_Release(&block);
    return PyLong_FromSsize_t(count);
}

PyDoc_STRVAR(prepare_doc, "prepare(fives)\n\n5^q for q = -342 .. 308, scaled to 128 bits: high and low half of each (uint64).");

static PyObject *prepare(PyObject *module, PyObject *args) {
    Py_buffer table;
    (void)module;
    if (!PyArg_ParseTuple(args, "y*", &table)) return NULL;
    const int fits = table.len == (Py_ssize_t)sizeof fives;
    if (fits) {
        memcpy(fives, table.buf, sizeof fives);
        prepared = 1;
    }
    return released(&table, 1, fits, "expected 651 numbers of 128 bits") ? Py_NewRef(Py_None) : NULL;
}

MODULE(_text, "Numbers out of delimited text.", METHOD(parse), METHOD(choose), METHOD(line_ends), METHOD(prepare))
