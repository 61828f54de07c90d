/* The inverse error model of an accelerometer triad and its derivatives, for many problems; the equations of model.py. */
#include "_model.h"
#include <float.h>
#include <math.h>

#include "imulab.h"

static const double ALIGNED[3] = {0.0, 0.0, 0.0}; /* order 0 has no misalignment */

double model_length(const double *theta, const double *reading, int order, double *derivative, double *f) {
    const double *scale = theta + 3, *m = order > 0 ? theta + 6 : ALIGNED;
    double a[3], s[3], slope[3];
    for (int i = 0; i < 3; i++) a[i] = (reading[i] - theta[i]) / scale[i];
    il_tumble_solve(order, (const double(*)[3])(theta + 9), a, s, slope);
    f[0] = s[0];
    f[1] = s[1] - m[0] * f[0];
    f[2] = s[2] - m[1] * f[0] - m[2] * f[1];
    double norm = sqrt(f[0] * f[0] + f[1] * f[1] + f[2] * f[2]);
    if (norm < DBL_MIN) norm = DBL_MIN;
    if (derivative == NULL) return norm;
    const double per_norm = 1.0 / norm;
    double v[3]; /* T' v = f / |f|, so that d|f| = v . (ds - dT f) */
    v[2] = f[2] * per_norm;
    v[1] = f[1] * per_norm - m[2] * v[2];
    v[0] = f[0] * per_norm - m[0] * v[1] - m[1] * v[2];
    for (int i = 0; i < 3; i++) {
        const double per_reading = v[i] / slope[i], q = per_reading / scale[i];
        derivative[i] = -q;
        derivative[3 + i] = -q * a[i];
        double power = s[i];
        for (int j = 0; j < order - 1; j++) {
            power *= s[i];
            derivative[9 + 3 * j + i] = -per_reading * power;
        }
    }
    if (order == 0) return norm;
    derivative[6] = -v[1] * f[0];
    derivative[7] = -v[2] * f[0];
    derivative[8] = -v[2] * f[1];
    return norm;
}

PyDoc_STRVAR(lengths_doc,
             "lengths(theta, reading, order, norm, jacobian, force) -> None\n\n"
             "theta (b, p) and reading (b, n, 3), or (1, n, 3) for all alike, to |f| (b, n), its derivatives (b, n, p) and\n"
             "f (b, n, 3); float64 buffers without gaps.");

static PyObject *lengths(PyObject *module, PyObject *args) {
    enum { THETA, READING, NORM, JACOBIAN, FORCE, BUFFERS };
    Py_buffer v[BUFFERS];
    int order;
    (void)module;
    if (!PyArg_ParseTuple(args, "y*y*iw*w*w*", &v[THETA], &v[READING], &order, &v[NORM], &v[JACOBIAN], &v[FORCE])) return NULL;
    const Py_ssize_t p = 3 * ((Py_ssize_t)order + 2), problems = order >= 0 ? v[THETA].len / DOUBLE_BYTES / p : 0;
    const Py_ssize_t n = problems > 0 ? v[NORM].len / DOUBLE_BYTES / problems : 0;
    const int fits = order >= 0 && v[THETA].len == problems * p * DOUBLE_BYTES && v[NORM].len == problems * n * DOUBLE_BYTES &&
                     v[JACOBIAN].len == v[NORM].len * p && v[FORCE].len == v[NORM].len * 3 &&
                     (v[READING].len == n * 3 * DOUBLE_BYTES || v[READING].len == v[FORCE].len);
    if (fits) {
        const Py_ssize_t next = v[READING].len == v[FORCE].len ? 3 * n : 0;
        const double *theta = v[THETA].buf, *reading = v[READING].buf;
        double *norm = v[NORM].buf, *derivative = v[JACOBIAN].buf, *force = v[FORCE].buf;
        Py_BEGIN_ALLOW_THREADS
        for (Py_ssize_t b = 0; b < problems; b++, theta += p, reading += next) {
            for (Py_ssize_t i = 0; i < n; i++, derivative += p, force += 3) {
                *norm++ = model_length(theta, reading + 3 * i, order, derivative, force);
            }
        }
        Py_END_ALLOW_THREADS
    }
    return done(v, BUFFERS, fits);
}

PyDoc_STRVAR(noise_doc,
             "noise(theta, jacobian, covariance, lengthening, variance) -> None\n\n"
             "theta (b, p), jacobian (b, n, p) and the covariance of the outputs (b, n, 3, 3), or (1, n, 3, 3) for all alike,\n"
             "to the lengthening of |f| by noise and its variance (b, n); or, from the covariance of x, y, z, xx, yy, zz, xy, xz\n"
             "and yz, (b or 1, n, 9, 9), the variance of |f|^2 / 2 alone. Float64 buffers without gaps.");

/* d' C d, of `size` rows */
static double quadratic(const double *c, const double *d, int size) {
    double sum = 0.0;
    for (int i = 0; i < size; i++) {
        double row = 0.0;
        for (int j = 0; j < size; j++) row += c[size * i + j] * d[j];
        sum += d[i] * row;
    }
    return sum;
}

static PyObject *noise(PyObject *module, PyObject *args) {
    enum { THETA, JACOBIAN, COVARIANCE, LENGTHENING, VARIANCE, BUFFERS };
    enum { AXES = 3, MOMENTS = 9 };
    Py_buffer v[BUFFERS];
    (void)module;
    if (!PyArg_ParseTuple(args, "y*y*y*w*w*", &v[THETA], &v[JACOBIAN], &v[COVARIANCE], &v[LENGTHENING], &v[VARIANCE])) {
        return NULL;
    }
    const Py_ssize_t all = v[VARIANCE].len / DOUBLE_BYTES;
    const Py_ssize_t p = all > 0 ? v[JACOBIAN].len / DOUBLE_BYTES / all : 0, problems = p > 0 ? v[THETA].len / DOUBLE_BYTES / p : 0;
    const Py_ssize_t n = problems > 0 ? all / problems : 0;
    const int size = v[LENGTHENING].len == 0 ? MOMENTS : AXES;
    const Py_ssize_t square = size * size;
    const int fits = p >= 6 && n > 0 && v[THETA].len == problems * p * DOUBLE_BYTES && all == problems * n &&
                     v[JACOBIAN].len == all * p * DOUBLE_BYTES && (size == MOMENTS || v[LENGTHENING].len == v[VARIANCE].len) &&
                     (v[COVARIANCE].len == square * n * DOUBLE_BYTES || v[COVARIANCE].len == square * all * DOUBLE_BYTES);
    if (fits) {
        const Py_ssize_t next = v[COVARIANCE].len == square * all * DOUBLE_BYTES ? square * n : 0;
        const double *theta = v[THETA].buf, *derivative = v[JACOBIAN].buf, *covariance = v[COVARIANCE].buf;
        double *lengthening = v[LENGTHENING].buf, *variance = v[VARIANCE].buf;
        for (Py_ssize_t b = 0; b < problems; b++, theta += p, covariance += next) {
            /* df/dM = T^-1 diag(1 / (slope S)); the nonlinearity's slope is 1 to the order that matters here. */
            const double *scale = theta + 3, *m = p > 6 ? theta + 6 : ALIGNED;
            const double carried[3][3] = {{1.0 / scale[0], 0.0, 0.0},
                                          {-m[0] / scale[0], 1.0 / scale[1], 0.0},
                                          {(m[2] * m[0] - m[1]) / scale[0], -m[2] / scale[1], 1.0 / scale[2]}};
            double gram[3][3]; /* of its columns: |f|^2 / 2 is half of it, to second order in the outputs */
            for (int i = 0; i < 3; i++) {
                for (int j = 0; j < 3; j++) {
                    gram[i][j] = carried[0][i] * carried[0][j] + carried[1][i] * carried[1][j] + carried[2][i] * carried[2][j];
                }
            }
            for (Py_ssize_t i = 0; i < n; i++, derivative += p) {
                const double *c = covariance + square * i; /* the first three derivatives are -q */
                if (size == MOMENTS) {
                    const double d[MOMENTS] = {-derivative[0],     -derivative[1],     -derivative[2],
                                               gram[0][0] / 2.0, gram[1][1] / 2.0, gram[2][2] / 2.0,
                                               gram[0][1],       gram[0][2],       gram[1][2]};
                    *variance++ = quadratic(c, d, MOMENTS);
                    continue;
                }
                const double along = quadratic(c, derivative, AXES);
                double trace = 0.0;
                for (int j = 0; j < 9; j++) trace += gram[j / 3][j % 3] * c[j];
                *lengthening++ = (trace - along) / 2.0;
                *variance++ = along;
            }
        }
    }
    return done(v, BUFFERS, fits);
}

MODULE(_model, "The inverse error model of a triad.", METHOD(lengths), METHOD(noise),
       {"fit", model_fit, METH_VARARGS, model_fit_doc}, {"left_out", model_left_out, METH_VARARGS, model_left_out_doc},
       {"best_subset", model_best_subset, METH_VARARGS, model_best_subset_doc})
