/* Turns: rotations composed step by step, and what they make of errors of the rate (rotation.py has the equations); and the
 * rate between samples (windows.py). */
#include "buffers.h"

#include <math.h>

typedef struct {
    double w, x, y, z;
} Quaternion;

/* The rotation by half a rotation vector, backwards; small ones by their series, to rounding. */
static Quaternion half_back(const double *vector) {
    const double x = -0.5 * vector[0], y = -0.5 * vector[1], z = -0.5 * vector[2];
    const double q = 0.25 * (x * x + y * y + z * z); /* the square of half its angle */
    if (q < 0.01) {
        const double s = 1.0 - q * (1.0 / 6.0 - q * (1.0 / 120.0 - q * (1.0 / 5040.0 - q * (1.0 / 362880.0))));
        const double w = 1.0 - q * (0.5 - q * (1.0 / 24.0 - q * (1.0 / 720.0 - q * (1.0 / 40320.0 - q * (1.0 / 3628800.0)))));
        return (Quaternion){w, 0.5 * s * x, 0.5 * s * y, 0.5 * s * z};
    }
    const double half = sqrt(q), s = 0.5 * sin(half) / half;
    return (Quaternion){cos(half), s * x, s * y, s * z};
}

/* The rotation `first`, then `second`. */
static Quaternion composed(Quaternion second, Quaternion first) {
    const Quaternion a = second, b = first;
    return (Quaternion){a.w * b.w - (a.x * b.x + a.y * b.y + a.z * b.z), a.w * b.x + b.w * a.x + (a.y * b.z - a.z * b.y),
                        a.w * b.y + b.w * a.y + (a.z * b.x - a.x * b.z), a.w * b.z + b.w * a.z + (a.x * b.y - a.y * b.x)};
}

/* Its matrix, row by row; thousands of unit quaternions composed are one but for rounding. */
static void matrix_of(Quaternion q, double *m) {
    const double w = q.w, x = q.x, y = q.y, z = q.z;
    m[0] = 1.0 - 2.0 * (y * y + z * z), m[1] = 2.0 * (x * y - w * z), m[2] = 2.0 * (x * z + w * y);
    m[3] = 2.0 * (x * y + w * z), m[4] = 1.0 - 2.0 * (x * x + z * z), m[5] = 2.0 * (y * z - w * x);
    m[6] = 2.0 * (x * z - w * y), m[7] = 2.0 * (y * z + w * x), m[8] = 1.0 - 2.0 * (x * x + y * y);
}

/* One segment: its matrix; the sum of C' x dt over its steps for each of the k weights x, with C to a step's middle; and
   where `squares` is not NULL, the sum of (C' a)(C' a)' of the steps' own rotation vectors a. */
static void turn(const double *rate, const double *step, const double *weights, Py_ssize_t k, Py_ssize_t steps, double *matrix,
                 double *sums, double *squares) {
    Quaternion whole = {1.0, 0.0, 0.0, 0.0};
    double middle[9]; /* C' */
    for (Py_ssize_t j = 0; j < 9 * k; j++) sums[j] = 0.0;
    for (int j = 0; squares && j < 9; j++) squares[j] = 0.0;
    for (Py_ssize_t i = 0; i < steps; i++, rate += 3, weights += k) {
        const double dt = step[i], angle[3] = {rate[0] * dt, rate[1] * dt, rate[2] * dt};
        if (dt == 0.0) continue; /* beyond a turn's end */
        const Quaternion half = half_back(angle), full = composed(half, half);
        if (k > 0 || squares) {
            const Quaternion halfway = composed(half, whole);
            matrix_of((Quaternion){halfway.w, -halfway.x, -halfway.y, -halfway.z}, middle);
        }
        whole = composed(full, whole); /* not by halves: each step waits for the one before */
        if (squares) {
            double moved[3];
            for (int a = 0; a < 3; a++) moved[a] = middle[3 * a] * angle[0] + middle[3 * a + 1] * angle[1] + middle[3 * a + 2] * angle[2];
            for (int j = 0; j < 9; j++) squares[j] += moved[j / 3] * moved[j % 3];
        }
        for (Py_ssize_t j = 0; j < k; j++) {
            const double x = weights[j] * dt;
            for (int a = 0; a < 9; a++) sums[9 * j + a] += x * middle[a];
        }
    }
    const double norm = sqrt(whole.w * whole.w + whole.x * whole.x + whole.y * whole.y + whole.z * whole.z);
    matrix_of((Quaternion){whole.w / norm, whole.x / norm, whole.y / norm, whole.z / norm}, matrix);
}

PyDoc_STRVAR(turns_doc,
             "turns(rate, step, weights, start, stop, matrix, sums, squares) -> None\n\n"
             "rate (n, 3) and duration (n,) of each step, and weights (n, k), to the matrix (m, 3, 3) that carries fixed\n"
             "directions through steps start[i] to stop[i] - 1 (int64, shape (m,)), and to the sum (m, k, 3, 3) of C' x dt\n"
             "over them, C from the start to the middle of each step, and to the sum (m, 3, 3) of (C' w dt)(C' w dt)', which\n"
             "is left out where `squares` is empty. Steps of no duration count for nothing. float64 buffers without gaps.");

static PyObject *turns(PyObject *module, PyObject *args) {
    enum { RATE, STEP, WEIGHTS, START, STOP, MATRIX, SUMS, SQUARES, BUFFERS };
    Py_buffer v[BUFFERS];
    (void)module;
    if (!PyArg_ParseTuple(args, "y*y*y*y*y*w*w*w*", &v[RATE], &v[STEP], &v[WEIGHTS], &v[START], &v[STOP], &v[MATRIX], &v[SUMS],
                          &v[SQUARES])) {
        return NULL;
    }
    const Py_ssize_t n = v[STEP].len / DOUBLE_BYTES, m = v[START].len / INDEX_BYTES, k = n > 0 ? v[WEIGHTS].len / DOUBLE_BYTES / n : 0;
    const int64_t *start = v[START].buf, *stop = v[STOP].buf;
    int fits = v[RATE].len == 3 * n * DOUBLE_BYTES && v[WEIGHTS].len == n * k * DOUBLE_BYTES && v[STOP].len == v[START].len &&
               v[MATRIX].len == 9 * m * DOUBLE_BYTES && v[SUMS].len == 9 * m * k * DOUBLE_BYTES &&
               (v[SQUARES].len == 0 || v[SQUARES].len == v[MATRIX].len);
    for (Py_ssize_t i = 0; fits && i < m; i++) fits = 0 <= start[i] && start[i] <= stop[i] && stop[i] <= n;
    if (fits) {
        const double *rate = v[RATE].buf, *step = v[STEP].buf, *weights = v[WEIGHTS].buf;
        double *matrix = v[MATRIX].buf, *sums = v[SUMS].buf, *squares = v[SQUARES].len ? v[SQUARES].buf : NULL;
        Py_BEGIN_ALLOW_THREADS
        for (Py_ssize_t i = 0; i < m; i++) {
            const Py_ssize_t from = (Py_ssize_t)start[i];
            turn(rate + 3 * from, step + from, weights + k * from, k, (Py_ssize_t)stop[i] - from, matrix + 9 * i,
                 sums + 9 * k * i, squares ? squares + 9 * i : NULL);
        }
        Py_END_ALLOW_THREADS
    }
    static const char wrong[] = "buffers that do not go together, or a segment beyond the steps";
    return released(v, BUFFERS, fits, wrong) ? Py_NewRef(Py_None) : NULL;
}

PyDoc_STRVAR(between_doc,
             "between(values, c, kernels, start, stop, pieces, middle, half) -> None\n\n"
             "values (n, c) at the samples, and kernels (taps, 2 pieces) of both kinds, to the pieces (m, steps * pieces, c) of\n"
             "the steps from sample start[i] to stop[i] (int64, (m,)); those after are left as they are. The taps are centred on a step; beyond the ends of the values\n"
             "the last ones count. float64 buffers without gaps.");

static PyObject *between(PyObject *module, PyObject *args) {
    enum { VALUES, KERNELS, START, STOP, MIDDLE, HALF, BUFFERS, MOST = 8, TAPS = 32 }; /* kinds; taps */
    Py_buffer v[BUFFERS];
    int pieces, columns;
    (void)module;
    if (!PyArg_ParseTuple(args, "y*iy*y*y*iw*w*", &v[VALUES], &columns, &v[KERNELS], &v[START], &v[STOP], &pieces, &v[MIDDLE],
                          &v[HALF])) {
        return NULL;
    }
    const Py_ssize_t kinds = 2 * (Py_ssize_t)pieces, m = v[START].len / INDEX_BYTES;
    const int likely = columns > 0 && pieces > 0 && kinds <= MOST && m > 0;
    const Py_ssize_t n = likely ? v[VALUES].len / DOUBLE_BYTES / columns : 0, taps = likely ? v[KERNELS].len / DOUBLE_BYTES / kinds : 0;
    const Py_ssize_t steps = likely ? v[MIDDLE].len / DOUBLE_BYTES / (m * pieces * columns) : 0;
    const int fits = n > 0 && v[VALUES].len == n * columns * DOUBLE_BYTES && v[KERNELS].len == taps * kinds * DOUBLE_BYTES && taps <= TAPS &&
                     v[STOP].len == v[START].len && v[MIDDLE].len == m * steps * pieces * columns * DOUBLE_BYTES && v[HALF].len == v[MIDDLE].len;
    if (fits) {
        const double *values = v[VALUES].buf, *given = v[KERNELS].buf;
        const int64_t *start = v[START].buf, *stop = v[STOP].buf;
        double *middle = v[MIDDLE].buf, *half = v[HALF].buf, kernels[TAPS][MOST] = {{0.0}}; /* as many sums for any pieces */
        for (Py_ssize_t i = 0; i < taps * kinds; i++) kernels[i / kinds][i % kinds] = given[i];
        Py_BEGIN_ALLOW_THREADS
        for (Py_ssize_t i = 0; i < m * steps; i++, middle += pieces * columns, half += pieces * columns) {
            const Py_ssize_t step = (Py_ssize_t)start[i / steps] + i % steps, first = step + 1 - taps / 2;
            if (step >= (Py_ssize_t)stop[i / steps]) continue;
            for (int c = 0; c < columns; c++) {
                double sums[MOST] = {0.0};
                for (Py_ssize_t t = 0; t < taps; t++) {
                    const Py_ssize_t at = first + t < 0 ? 0 : first + t < n ? first + t : n - 1;
                    const double value = values[at * columns + c];
                    for (int k = 0; k < MOST; k++) sums[k] += kernels[t][k] * value;
                }
                for (int k = 0; k < pieces; k++) middle[k * columns + c] = sums[k], half[k * columns + c] = sums[pieces + k];
            }
        }
        Py_END_ALLOW_THREADS
    }
    return done(v, BUFFERS, fits);
}

MODULE(_rotation, "Rotations composed step by step, and the rate between samples.", METHOD(turns), METHOD(between))
