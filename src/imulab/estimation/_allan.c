/* The sums that an Allan curve is made of. */
#include "buffers.h"

enum { TOGETHER = 4, PIECE = 16384 }; /* sums that a processor adds at once; samples that stay near it for all short lags */

/* Two builds of a loop, for processors with AVX2 and for all others; the sums are the same, in the same order. */
#if defined(__x86_64__) && defined(__gnu_linux__) && defined(__GNUC__) && !defined(__clang__)
#define WIDE __attribute__((target_clones("avx2", "default")))
#else
#define WIDE
#endif

/* Sum over k in [start, stop) of (x[k + 2 m] - 2 x[k + m] + x[k])^2. */
WIDE static double second_differences(const double *x, Py_ssize_t start, Py_ssize_t stop, Py_ssize_t m) {
    double sums[TOGETHER] = {0.0, 0.0, 0.0, 0.0};
    Py_ssize_t k = start;
    for (; k + TOGETHER <= stop; k += TOGETHER) {
        for (int i = 0; i < TOGETHER; i++) {
            const double difference = x[k + i + 2 * m] - 2.0 * x[k + i + m] + x[k + i];
            sums[i] += difference * difference;
        }
    }
    for (; k < stop; k++) {
        const double difference = x[k + 2 * m] - 2.0 * x[k + m] + x[k];
        sums[0] += difference * difference;
    }
    return (sums[0] + sums[1]) + (sums[2] + sums[3]);
}

PyDoc_STRVAR(integrate_doc, "integrate(values, mean) -> None\n\n"
                            "The running sums of a float64 buffer less a mean, in its place.");
static PyObject *integrate(PyObject *module, PyObject *args) {
    Py_buffer values;
    double mean, sum = 0.0;
    (void)module;
    if (!PyArg_ParseTuple(args, "w*d", &values, &mean)) return NULL;
    double *x = values.buf;
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t k = 0; k < values.len / DOUBLE_BYTES; k++) x[k] = sum += x[k] - mean;
    Py_END_ALLOW_THREADS
    return done(&values, 1, 1);
}

PyDoc_STRVAR(fill_squares_doc, "fill_squares(sums, integral, lags) -> None\n\n"
                               "Sums of squared second differences of a float64 buffer at lags, int64.");
static PyObject *fill_squares(PyObject *module, PyObject *args) {
    Py_buffer v[3];
    (void)module;
    if (!PyArg_ParseTuple(args, "w*y*y*", &v[0], &v[1], &v[2])) return NULL;
    double *sums = v[0].buf;
    const double *x = v[1].buf;
    const int64_t *lags = v[2].buf;
    const Py_ssize_t count = v[2].len / INDEX_BYTES, length = v[1].len / DOUBLE_BYTES;
    int fits = v[0].len == count * DOUBLE_BYTES;
    for (Py_ssize_t i = 0; i < count; i++) fits = fits && lags[i] > 0 && lags[i] <= length / 2;
    if (fits) {
        Py_BEGIN_ALLOW_THREADS
        for (Py_ssize_t i = 0; i < count; i++) sums[i] = 0.0;
        for (Py_ssize_t start = 0; start < length; start += PIECE) {
            for (Py_ssize_t i = 0; i < count; i++) {
                const Py_ssize_t m = (Py_ssize_t)lags[i], end = length - 2 * m;
                sums[i] += second_differences(x, start, end < start + PIECE ? end : start + PIECE, m);
            }
        }
        Py_END_ALLOW_THREADS
    }
    return done(v, 3, fits);
}

MODULE(_allan, "The sums of an Allan curve.", METHOD(integrate), METHOD(fill_squares))
