/* Turns: rotations composed step by step, and what they make of errors of the rate (rotation.py has the equations). */
#include "buffers.h"

#include <math.h>

typedef struct {
    double w, x, y, z;
} Quaternion;

/* The rotation by a fraction of a rotation vector. */
static Quaternion rotation_by(const double *vector, double fraction) {
    const double x = fraction * vector[0], y = fraction * vector[1], z = fraction * vector[2];
    const double half = 0.5 * sqrt(x * x + y * y + z * z), s = half == 0.0 ? 0.5 : 0.5 * sin(half) / half;
    return (Quaternion){cos(half), s * x, s * y, s * z};
}

/* The rotation `first`, then `second`. */
static Quaternion composed(Quaternion second, Quaternion first) {
    const Quaternion a = second, b = first;
    return (Quaternion){a.w * b.w - (a.x * b.x + a.y * b.y + a.z * b.z), a.w * b.x + b.w * a.x + (a.y * b.z - a.z * b.y),
                        a.w * b.y + b.w * a.y + (a.z * b.x - a.x * b.z), a.w * b.z + b.w * a.z + (a.x * b.y - a.y * b.x)};
}

/* Its matrix, row by row. */
static void matrix_of(Quaternion q, double *m) {
    const double norm = sqrt(q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z);
    const double w = q.w / norm, x = q.x / norm, y = q.y / norm, z = q.z / norm;
    m[0] = 1.0 - 2.0 * (y * y + z * z), m[1] = 2.0 * (x * y - w * z), m[2] = 2.0 * (x * z + w * y);
    m[3] = 2.0 * (x * y + w * z), m[4] = 1.0 - 2.0 * (x * x + z * z), m[5] = 2.0 * (y * z - w * x);
    m[6] = 2.0 * (x * z - w * y), m[7] = 2.0 * (y * z + w * x), m[8] = 1.0 - 2.0 * (x * x + y * y);
}

/* One segment: its matrix; the sum of C' x over its steps for each of the k weights x, with C to a step's middle; and
   where `squares` is not NULL, the sum of (C' a)(C' a)' of the steps' own rotation vectors a. */
static void turn(const double *angle, const double *weights, Py_ssize_t k, Py_ssize_t steps, double *matrix, double *sums, double *squares) {
    Quaternion whole = {1.0, 0.0, 0.0, 0.0};
    double middle[9];
    for (Py_ssize_t j = 0; j < 9 * k; j++) sums[j] = 0.0;
    for (int j = 0; squares && j < 9; j++) squares[j] = 0.0;
    for (Py_ssize_t i = 0; i < steps; i++, angle += 3, weights += k) {
        if (k > 0 || squares) matrix_of(composed(rotation_by(angle, -0.5), whole), middle);
        if (squares) {
            double moved[3];
            for (int a = 0; a < 3; a++) moved[a] = middle[a] * angle[0] + middle[3 + a] * angle[1] + middle[6 + a] * angle[2];
            for (int j = 0; j < 9; j++) squares[j] += moved[j / 3] * moved[j % 3];
        }
        for (Py_ssize_t j = 0; j < k; j++) {
            for (int a = 0; a < 3; a++) {
                for (int b = 0; b < 3; b++) sums[9 * j + 3 * a + b] += weights[j] * middle[3 * b + a];
            }
        }
        whole = composed(rotation_by(angle, -1.0), whole);
    }
    matrix_of(whole, matrix);
}

PyDoc_STRVAR(turns_doc,
             "turns(angle, weights, start, stop, matrix, sums, squares) -> None\n\n"
             "angle (n, 3), the body's rotation vector in each step, and weights (n, k) to the matrix (m, 3, 3) that carries\n"
             "fixed directions through steps start[i] to stop[i] - 1 (int64, shape (m,)), and to the sum (m, k, 3, 3) of C' x\n"
             "over them, C from the start to the middle of each step, and to the sum (m, 3, 3) of (C' angle)(C' angle)', which\n"
             "is left out where `squares` is empty. float64 buffers without gaps.");

static PyObject *turns(PyObject *module, PyObject *args) {
    enum { ANGLE, WEIGHTS, START, STOP, MATRIX, SUMS, SQUARES, BUFFERS };
    Py_buffer v[BUFFERS];
    (void)module;
    if (!PyArg_ParseTuple(args, "y*y*y*y*w*w*w*", &v[ANGLE], &v[WEIGHTS], &v[START], &v[STOP], &v[MATRIX], &v[SUMS],
                          &v[SQUARES])) {
        return NULL;
    }
    const Py_ssize_t n = v[ANGLE].len / DOUBLE_BYTES / 3, m = v[START].len / INDEX_BYTES, k = n > 0 ? v[WEIGHTS].len / DOUBLE_BYTES / n : 0;
    const int64_t *start = v[START].buf, *stop = v[STOP].buf;
    int fits = v[ANGLE].len == 3 * n * DOUBLE_BYTES && v[WEIGHTS].len == n * k * DOUBLE_BYTES && v[STOP].len == v[START].len &&
               v[MATRIX].len == 9 * m * DOUBLE_BYTES && v[SUMS].len == 9 * m * k * DOUBLE_BYTES &&
               (v[SQUARES].len == 0 || v[SQUARES].len == v[MATRIX].len);
    for (Py_ssize_t i = 0; fits && i < m; i++) fits = 0 <= start[i] && start[i] <= stop[i] && stop[i] <= n;
    if (fits) {
        const double *angle = v[ANGLE].buf, *weights = v[WEIGHTS].buf;
        double *matrix = v[MATRIX].buf, *sums = v[SUMS].buf, *squares = v[SQUARES].len ? v[SQUARES].buf : NULL;
        Py_BEGIN_ALLOW_THREADS
        for (Py_ssize_t i = 0; i < m; i++) {
            const Py_ssize_t from = (Py_ssize_t)start[i];
            turn(angle + 3 * from, weights + k * from, k, (Py_ssize_t)stop[i] - from, matrix + 9 * i, sums + 9 * k * i,
                 squares ? squares + 9 * i : NULL);
        }
        Py_END_ALLOW_THREADS
    }
    static const char wrong[] = "buffers that do not go together, or a segment beyond the steps";
    return released(v, BUFFERS, fits, wrong) ? Py_NewRef(Py_None) : NULL;
}

MODULE(_rotation, "Rotations composed step by step.", METHOD(turns))
