/* Doubles as the shortest decimals that read back exactly, in rows of delimited text.
 *
 * The decimal is found without trial by three multiplications with a power of ten of 128 bits (R. Giulietti, "The
 * Schubfach way to render doubles", 2020; its names are kept) and written as Python writes it: 0.1, 1e-05, 1e+16, nan.
 */
#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030B0000
#include <Python.h>
#include <stdint.h>
#include <string.h>

enum { LOWEST = -292, HIGHEST = 324, POWERS = HIGHEST - LOWEST + 1 };
enum { LONGEST = 25 }; /* bytes of a number and what separates it from the next */

static int prepared = 0;

#ifdef __SIZEOF_INT128__
/* 10^k, scaled to 128 bits and rounded up: high and low half of each; filled by prepare(). */
static uint64_t tens[2 * POWERS];

typedef struct {
    uint64_t digits;
    int exponent;
} Decimal;

/* The product's upper bits, the lowest of them set if anything below is. */
static uint64_t round_to_odd(const uint64_t *g, uint64_t cp) {
    const uint64_t x = (uint64_t)(((unsigned __int128)g[1] * cp) >> 64);
    const unsigned __int128 y = (unsigned __int128)g[0] * cp + x;
    return (uint64_t)(y >> 64) | ((uint64_t)y > 1);
}

/* The shortest decimal in the rounding interval of a double, and the closest of those; `bits` positive, finite, not 0. */
static Decimal shortest(uint64_t bits) {
    const uint64_t fraction = bits & ((UINT64_C(1) << 52) - 1);
    const int biased = (int)(bits >> 52);
    uint64_t c = fraction;
    int q = 1 - 1075;
    if (biased != 0) {
        c |= UINT64_C(1) << 52;
        q = biased - 1075;
        if (q <= 0 && q > -53 && (c & ((UINT64_C(1) << -q) - 1)) == 0) return (Decimal){c >> -q, 0};
    }
    const int odd = (int)(c & 1);
    const int closer = fraction == 0 && biased > 1;
    const int k = (q * 1262611 - (closer ? 524031 : 0)) >> 22;
    const int h = q + ((-k * 1741647) >> 19) + 1;
    const uint64_t *g = tens + 2 * (-k - LOWEST);
    const uint64_t vbl = round_to_odd(g, (4 * c - 2 + (uint64_t)closer) << h);
    const uint64_t vb = round_to_odd(g, (4 * c) << h);
    const uint64_t vbr = round_to_odd(g, (4 * c + 2) << h);
    const uint64_t lower = vbl + (uint64_t)odd, upper = vbr - (uint64_t)odd;
    const uint64_t s = vb / 4;
    if (s >= 10) {
        const uint64_t sp = s / 10;
        const int below = lower <= 40 * sp, above = 40 * sp + 40 <= upper;
        if (below != above) return (Decimal){sp + (uint64_t)above, k + 1};
    }
    const int below = lower <= 4 * s, above = 4 * s + 4 <= upper;
    if (below != above) return (Decimal){s + (uint64_t)above, k};
    const uint64_t middle = 4 * s + 2;
    return (Decimal){s + (uint64_t)(vb > middle || (vb == middle && (s & 1) != 0)), k};
}

/* 00 to 99 */
static const char pairs[] = "00010203040506070809101112131415161718192021222324252627282930313233343536373839404142434445464748"
                            "49505152535455565758596061626364656667686970717273747576777879808182838485868788899091929394959697"
                            "9899";

static char *repeated(char *out, char c, int count) {
    for (int i = 0; i < count; i++) *out++ = c;
    return out;
}

/* The shortest decimal that reads back as `value`, at `out`, as Python writes it; returns where it ends. */
static char *print_number(double value, char *out) {
    uint64_t bits;
    memcpy(&bits, &value, sizeof bits);
    const uint64_t magnitude = bits & ~(UINT64_C(1) << 63);
    if (magnitude > UINT64_C(0x7FF0000000000000)) {
        memcpy(out, "nan", 3);
        return out + 3;
    }
    if (bits >> 63) *out++ = '-';
    if (magnitude == UINT64_C(0x7FF0000000000000)) {
        memcpy(out, "inf", 3);
        return out + 3;
    }
    if (magnitude == 0) {
        memcpy(out, "0.0", 3);
        return out + 3;
    }
    Decimal d = shortest(magnitude);
    if (d.digits % 100000000 == 0) { /* as what was typed ends: many zeros, taken off at once */
        d.digits /= 100000000;
        d.exponent += 8;
    }
    while (d.digits % 10 == 0) {
        d.digits /= 10;
        d.exponent++;
    }
    char text[20], *digits = text + sizeof text;
    uint64_t rest = d.digits;
    while (rest >= 10) {
        digits -= 2;
        memcpy(digits, pairs + 2 * (rest % 100), 2);
        rest /= 100;
    }
    if (rest > 0) *--digits = (char)('0' + rest);
    const int count = (int)(text + sizeof text - digits);
    const int point = count + d.exponent; /* digits before the decimal point */
    if (point > -4 && point <= 16) {
        if (point <= 0) {
            *out++ = '0';
            *out++ = '.';
            out = repeated(out, '0', -point);
            memcpy(out, digits, (size_t)count);
            return out + count;
        }
        if (count <= point) {
            memcpy(out, digits, (size_t)count);
            out = repeated(out + count, '0', point - count);
            *out++ = '.';
            *out++ = '0';
            return out;
        }
        memcpy(out, digits, (size_t)point);
        out += point;
        *out++ = '.';
        memcpy(out, digits + point, (size_t)(count - point));
        return out + count - point;
    }
    *out++ = digits[0];
    if (count > 1) {
        *out++ = '.';
        memcpy(out, digits + 1, (size_t)count - 1);
        out += count - 1;
    }
    *out++ = 'e';
    int power = point - 1;
    *out++ = power < 0 ? '-' : '+';
    if (power < 0) power = -power;
    if (power >= 100) *out++ = (char)('0' + power / 100);
    *out++ = (char)('0' + power / 10 % 10);
    *out++ = (char)('0' + power % 10);
    return out;
}
#endif

PyDoc_STRVAR(rows_doc,
             "rows(values, columns, out) -> bytes written\n\n"
             "Write a row-major float64 buffer as lines of `columns` numbers with commas between; `out` needs 25 bytes for\n"
             "each number. The interpreter is released.");

static PyObject *rows(PyObject *module, PyObject *args) {
#ifdef __SIZEOF_INT128__
    Py_buffer values, out;
    Py_ssize_t columns;
    (void)module;
    if (!PyArg_ParseTuple(args, "y*nw*", &values, &columns, &out)) return NULL;
    const Py_ssize_t count = values.len / (Py_ssize_t)sizeof(double);
    const int fits = prepared && columns > 0 && count % columns == 0 && out.len / LONGEST >= count;
    Py_ssize_t written = 0;
    if (fits) {
        const double *value = values.buf;
        char *p = out.buf;
        Py_BEGIN_ALLOW_THREADS
        for (Py_ssize_t i = 0, column = 1; i < count; i++, column++) {
            p = print_number(value[i], p);
            *p++ = column == columns ? '\n' : ',';
            if (column == columns) column = 0;
        }
        Py_END_ALLOW_THREADS
        written = p - (char *)out.buf;
    }
    PyBuffer_Release(&values);
    PyBuffer_Release(&out);
    if (!fits) {
        PyErr_SetString(PyExc_ValueError, "not whole rows, or an output buffer of less than 25 bytes a number");
        return NULL;
    }
    return PyLong_FromSsize_t(written);
#else
    (void)module;
    (void)args;
    PyErr_SetString(PyExc_NotImplementedError, "needs a compiler with integers of 128 bits");
    return NULL;
#endif
}

PyDoc_STRVAR(prepare_doc, "prepare(tens) -> bool\n\n10^k for k = -292 .. 324 to 128 bits, rounded up; False: not available here.");

static PyObject *prepare(PyObject *module, PyObject *args) {
    Py_buffer table;
    (void)module;
    if (!PyArg_ParseTuple(args, "y*", &table)) return NULL;
    int fits = 0;
#ifdef __SIZEOF_INT128__
    fits = table.len == (Py_ssize_t)sizeof tens;
    if (fits) {
        memcpy(tens, table.buf, sizeof tens);
        prepared = 1;
    }
#endif
    PyBuffer_Release(&table);
    return PyBool_FromLong(fits);
}

static PyMethodDef methods[] = {{"rows", rows, METH_VARARGS, rows_doc},
                                {"prepare", prepare, METH_VARARGS, prepare_doc},
                                {NULL, NULL, 0, NULL}};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "_digits", "Doubles as the shortest decimals.", 0, methods, NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__digits(void) { return PyModule_Create(&definition); }
