/* Numbers out of delimited text, correctly rounded, at memory speed.
 *
 * One pass over a block of whole lines writes each wanted field into its own column. A decimal with up to 19
 * significant digits and a power of ten of at least -19 is rounded exactly by integer division (or by one IEEE operation
 * where both operands are exact: W. D. Clinger, "How to read floating point numbers accurately", PLDI 1990);
 * everything else goes through Python's own correctly rounded conversion.
 */
#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030B0000
#include <Python.h>
#include <float.h>
#include <math.h>
#include <stdint.h>
#include <string.h>

enum { OK = 0, NOT_A_NUMBER = 1, WRONG_COUNT = 2, LONGEST_TOKEN = 400 };

static const double TENS[] = {1e0,  1e1,  1e2,  1e3,  1e4,  1e5,  1e6,  1e7,  1e8,  1e9,  1e10, 1e11,
                              1e12, 1e13, 1e14, 1e15, 1e16, 1e17, 1e18, 1e19, 1e20, 1e21, 1e22};

#ifdef __SIZEOF_INT128__
/* w / 10^k, rounded to nearest even; w > 0, 0 <= k <= 19. */
static double divided(uint64_t w, int k) {
    uint64_t d = 1;
    for (int i = 0; i < k; i++) d *= 10u;
    int w_shift = __builtin_clzll(w), d_shift = __builtin_clzll(d);
    uint64_t wn = w << w_shift, dn = d << d_shift;
    int extra = wn >= dn ? 63 : 64; /* the quotient then has exactly 64 bits */
    unsigned __int128 numerator = (unsigned __int128)wn << extra;
    uint64_t quotient = (uint64_t)(numerator / dn);
    int sticky = (numerator % dn) != 0;
    uint64_t mantissa = quotient >> 11, rest = quotient & 0x7FFu;
    if (rest > 0x400u || (rest == 0x400u && (sticky || (mantissa & 1u)))) mantissa++;
    return ldexp((double)mantissa, 11 - extra - w_shift + d_shift);
}
#endif

/* The token [p, end) without surrounding blanks -> value. */
static int slow_number(const char *p, const char *end, double *value) {
    char text[LONGEST_TOKEN + 1];
    size_t length = (size_t)(end - p);
    if (length == 0 || length > LONGEST_TOKEN) return NOT_A_NUMBER;
    memcpy(text, p, length);
    text[length] = '\0';
    char *stop = NULL;
    *value = PyOS_string_to_double(text, &stop, NULL);
    if (PyErr_Occurred()) {
        PyErr_Clear();
        return NOT_A_NUMBER;
    }
    return stop == text + length ? OK : NOT_A_NUMBER;
}

static int number(const char *p, const char *end, double *value) {
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
    int negative = *p == '-';
    if (*p == '-' || *p == '+') p++;
    uint64_t w = 0;
    int significant = 0, digits = 0, exponent = 0;
    for (; p < end && *p >= '0' && *p <= '9'; p++, digits++) {
        w = 10u * w + (uint64_t)(*p - '0');
        significant += significant > 0 || *p != '0';
        if (significant > 19) return slow_number(start, end, value);
    }
    if (p < end && *p == '.') {
        for (p++; p < end && *p >= '0' && *p <= '9'; p++, digits++, exponent--) {
            w = 10u * w + (uint64_t)(*p - '0');
            significant += significant > 0 || *p != '0';
            if (significant > 19) return slow_number(start, end, value);
        }
    }
    if (digits == 0) return slow_number(start, end, value); /* nan, inf, or nothing that is a number */
    if (p < end && (*p == 'e' || *p == 'E')) {
        p++;
        int down = p < end && *p == '-', power = 0, power_digits = 0;
        if (p < end && (*p == '-' || *p == '+')) p++;
        for (; p < end && *p >= '0' && *p <= '9'; p++, power_digits++) {
            power = 10 * power + (*p - '0');
            if (power > 9999) return slow_number(start, end, value);
        }
        if (power_digits == 0) return NOT_A_NUMBER;
        exponent += down ? -power : power;
    }
    if (p != end) return NOT_A_NUMBER;
    double magnitude;
    if (w == 0) {
        magnitude = 0.0;
    } else if (FLT_EVAL_METHOD == 0 && w <= (UINT64_C(1) << 53) && exponent >= -22 && exponent <= 22) {
        magnitude = exponent < 0 ? (double)w / TENS[-exponent] : (double)w * TENS[exponent];
#ifdef __SIZEOF_INT128__
    } else if (exponent <= 0 && exponent >= -19) {
        magnitude = divided(w, -exponent);
#endif
    } else {
        return slow_number(start, end, value);
    }
    *value = negative ? -magnitude : magnitude;
    return OK;
}

/* One line [p, end) into row `row` of the columns; `*found` is the number of fields, or the index of the bad one. */
static int line_fields(const char *p, const char *end, char delimiter, const int32_t *slots, Py_ssize_t fields,
                       double *out, Py_ssize_t capacity, Py_ssize_t row, Py_ssize_t *found) {
    Py_ssize_t field = 0;
    const int blanks = delimiter == ' ';
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
            stop = memchr(p, delimiter, (size_t)(end - p));
            if (stop == NULL) stop = end;
        }
        if (field < fields && slots[field] >= 0) {
            if (number(p, stop, &out[slots[field] * capacity + row]) != OK) {
                *found = field;
                return NOT_A_NUMBER;
            }
        }
        field++;
        if (stop == end) break;
        p = stop + 1;
    }
    *found = field;
    return field == fields ? OK : WRONG_COUNT;
}

PyDoc_STRVAR(parse_doc,
             "parse(block, delimiter, slots, out, capacity) -> (rows, problem, field)\n\n"
             "Read whole lines of `block`; field i goes to column slots[i] (int32, -1: skip) of `out`, a writable\n"
             "float64 buffer of columns with `capacity` rows each. Delimiter ' ' means any run of blanks. On a problem\n"
             "(1: field `field` is no number, 2: the line has `field` fields) `rows` is the index of that line.");

static PyObject *parse(PyObject *module, PyObject *args) {
    Py_buffer block, slots, out;
    int delimiter;
    Py_ssize_t capacity;
    (void)module;
    if (!PyArg_ParseTuple(args, "y*Cy*w*n", &block, &delimiter, &slots, &out, &capacity)) return NULL;
    const Py_ssize_t fields = slots.len / (Py_ssize_t)sizeof(int32_t);
    const int32_t *slot = slots.buf;
    Py_ssize_t rows = 0, found = 0;
    int problem = OK, fits = capacity >= 0 && delimiter > 0 && delimiter < 128;
    for (Py_ssize_t i = 0; fits && i < fields; i++) {
        fits = slot[i] < 0 || slot[i] < out.len / (Py_ssize_t)sizeof(double) / (capacity > 0 ? capacity : 1);
    }
    const char *p = block.buf, *end = p + block.len;
    while (fits && p < end) {
        const char *stop = memchr(p, '\n', (size_t)(end - p));
        if (stop == NULL) stop = end;
        if (rows >= capacity) {
            fits = 0;
            break;
        }
        problem = line_fields(p, stop, (char)delimiter, slot, fields, out.buf, capacity, rows, &found);
        if (problem != OK) break;
        rows++;
        p = stop + 1;
    }
    PyBuffer_Release(&block);
    PyBuffer_Release(&slots);
    PyBuffer_Release(&out);
    if (!fits) {
        PyErr_SetString(PyExc_ValueError, "the output buffer is too small for the block, or the delimiter is not ASCII");
        return NULL;
    }
    return Py_BuildValue("nin", rows, problem, found);
}

static PyMethodDef methods[] = {{"parse", parse, METH_VARARGS, parse_doc}, {NULL, NULL, 0, NULL}};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "_text", "Numbers out of delimited text.", 0, methods, NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__text(void) { return PyModule_Create(&definition); }
