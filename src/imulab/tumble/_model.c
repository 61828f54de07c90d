/* The inverse error model of an accelerometer triad, its derivatives, and its fit, for many problems.
 *
 * The equations are those of model.py, the steps those of estimate.levenberg_marquardt, which says why each is taken. A
 * choice of the order makes hundreds of steps on arrays of a few hundred numbers: in Python that time went into calls.
 */
#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030B0000
#include <Python.h>
#include <float.h>
#include <math.h>
#include <stdint.h>
#include <string.h>

enum { NEWTON_STEPS = 12 };
static const double CLOSE = 1e-15, SENSED = 1e-9, LEAST_DAMPING = 1e-12, MAX_DAMPING = 1e12; /* as in estimate.py */

/* Value and slope of s + k2 s^2 + ... by Horner's scheme; k[3 j] is the coefficient of s^(j + 2). */
static void polynomial(double s, const double *k, int count, double *value, double *slope) {
    double v = k[3 * (count - 1)], d = 0.0;
    for (int j = count - 2; j >= 0; j--) {
        d = d * s + v;
        v = v * s + k[3 * j];
    }
    *value = s * (1.0 + s * v);
    *slope = 1.0 + s * (2.0 * v + s * d);
}

/* The s at which each axis's polynomial is a, and the slopes there, by Newton's method; NaN where it turns back before.
 *
 * The three axes step together: each step waits for a division, and the processor has three to wait for at once. */
static void inverted(const double *a, const double *k, int count, double *s, double *slope) {
    double value, size[3];
    int on_its_way[3] = {count > 0, count > 0, count > 0};
    for (int i = 0; i < 3; i++) {
        s[i] = a[i];
        slope[i] = 1.0;
        size[i] = CLOSE * fmax(fabs(a[i]), 1.0);
    }
    for (int number = 0; number < NEWTON_STEPS && (on_its_way[0] | on_its_way[1] | on_its_way[2]); number++) {
        for (int i = 0; i < 3; i++) {
            polynomial(s[i], k + i, count, &value, &slope[i]);
            const double step = (value - a[i]) / slope[i];
            on_its_way[i] = fabs(step) > size[i];
            s[i] -= on_its_way[i] || isnan(step) ? step : 0.0;
        }
    }
    for (int i = 0; i < 3; i++) {
        if (on_its_way[i] || isnan(s[i]) || !(slope[i] > 0.0)) s[i] = slope[i] = (double)NAN;
    }
}

/* |f| in one attitude, its derivatives (3 (order + 2) of them), and f. */
static double length(const double *theta, const double *reading, int order, double *derivative, double *f) {
    const double *scale = theta + 3, *m = theta + 6, *k = theta + 9;
    double a[3], s[3], slope[3];
    for (int i = 0; i < 3; i++) a[i] = (reading[i] - theta[i]) / scale[i];
    inverted(a, k, order - 1, s, slope);
    f[0] = s[0];
    f[1] = s[1] - m[0] * f[0];
    f[2] = s[2] - m[1] * f[0] - m[2] * f[1];
    double norm = sqrt(f[0] * f[0] + f[1] * f[1] + f[2] * f[2]);
    if (norm < DBL_MIN) norm = DBL_MIN;
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
    Py_buffer theta, reading, norm, jacobian, force;
    int order;
    (void)module;
    if (!PyArg_ParseTuple(args, "y*y*iw*w*w*", &theta, &reading, &order, &norm, &jacobian, &force)) return NULL;
    const Py_ssize_t one = (Py_ssize_t)sizeof(double), p = 3 * ((Py_ssize_t)order + 2);
    const Py_ssize_t problems = order > 0 ? theta.len / one / p : 0;
    const Py_ssize_t n = problems > 0 ? norm.len / one / problems : 0;
    const int fits = order > 0 && theta.len == problems * p * one && norm.len == problems * n * one &&
                     jacobian.len == norm.len * p && force.len == norm.len * 3 &&
                     (reading.len == n * 3 * one || reading.len == force.len);
    if (fits) {
        const Py_ssize_t next = reading.len == force.len ? 3 * n : 0;
        const double *t = theta.buf, *r = reading.buf;
        double *length_of = norm.buf, *derivative = jacobian.buf, *f = force.buf;
        Py_BEGIN_ALLOW_THREADS
        for (Py_ssize_t b = 0; b < problems; b++, t += p, r += next) {
            for (Py_ssize_t i = 0; i < n; i++, derivative += p, f += 3) {
                *length_of++ = length(t, r + 3 * i, order, derivative, f);
            }
        }
        Py_END_ALLOW_THREADS
    }
    PyBuffer_Release(&theta);
    PyBuffer_Release(&reading);
    PyBuffer_Release(&norm);
    PyBuffer_Release(&jacobian);
    PyBuffer_Release(&force);
    if (!fits) {
        PyErr_SetString(PyExc_ValueError, "buffers that do not go together");
        return NULL;
    }
    Py_RETURN_NONE;
}

PyDoc_STRVAR(noise_doc,
             "noise(theta, jacobian, covariance, lengthening, variance) -> None\n\n"
             "theta (b, p), jacobian (b, n, p) and the covariance of the outputs (b, n, 3, 3), or (1, n, 3, 3) for all alike,\n"
             "to the lengthening of |f| by noise and its variance (b, n); float64 buffers without gaps.");

/* d' C d */
static double quadratic(const double *c, const double *d) {
    double sum = 0.0;
    for (int i = 0; i < 3; i++) sum += d[i] * (c[3 * i] * d[0] + c[3 * i + 1] * d[1] + c[3 * i + 2] * d[2]);
    return sum;
}

static PyObject *noise(PyObject *module, PyObject *args) {
    enum { THETA, JACOBIAN, COVARIANCE, LENGTHENING, VARIANCE, BUFFERS };
    Py_buffer v[BUFFERS];
    (void)module;
    if (!PyArg_ParseTuple(args, "y*y*y*w*w*", &v[THETA], &v[JACOBIAN], &v[COVARIANCE], &v[LENGTHENING], &v[VARIANCE])) {
        return NULL;
    }
    const Py_ssize_t one = (Py_ssize_t)sizeof(double), all = v[VARIANCE].len / one;
    const Py_ssize_t p = all > 0 ? v[JACOBIAN].len / one / all : 0, problems = p > 0 ? v[THETA].len / one / p : 0;
    const Py_ssize_t n = problems > 0 ? all / problems : 0;
    const int fits = p >= 9 && n > 0 && v[THETA].len == problems * p * one && all == problems * n &&
                     v[JACOBIAN].len == all * p * one && v[LENGTHENING].len == v[VARIANCE].len &&
                     (v[COVARIANCE].len == 9 * n * one || v[COVARIANCE].len == 9 * all * one);
    if (fits) {
        const Py_ssize_t next = v[COVARIANCE].len == 9 * all * one ? 9 * n : 0;
        const double *theta = v[THETA].buf, *derivative = v[JACOBIAN].buf, *covariance = v[COVARIANCE].buf;
        double *lengthening = v[LENGTHENING].buf, *variance = v[VARIANCE].buf;
        for (Py_ssize_t b = 0; b < problems; b++, theta += p, covariance += next) {
            /* df/dM = T^-1 diag(1 / (slope S)); the nonlinearity's slope is 1 to the order that matters here. */
            const double *scale = theta + 3, *m = theta + 6;
            const double carried[3][3] = {{1.0 / scale[0], 0.0, 0.0},
                                          {-m[0] / scale[0], 1.0 / scale[1], 0.0},
                                          {(m[2] * m[0] - m[1]) / scale[0], -m[2] / scale[1], 1.0 / scale[2]}};
            for (Py_ssize_t i = 0; i < n; i++, derivative += p) {
                const double *c = covariance + 9 * i, along = quadratic(c, derivative); /* its first three are -q */
                const double trace = quadratic(c, carried[0]) + quadratic(c, carried[1]) + quadratic(c, carried[2]);
                *lengthening++ = (trace - along) / 2.0;
                *variance++ = along;
            }
        }
    }
    for (int i = 0; i < BUFFERS; i++) PyBuffer_Release(&v[i]);
    if (!fits) {
        PyErr_SetString(PyExc_ValueError, "buffers that do not go together");
        return NULL;
    }
    Py_RETURN_NONE;
}

/* What the fit of one problem works on: n observations, p parameters, two evaluations that take turns. */
typedef struct {
    Py_ssize_t n, p;
    const double *reading, *weights, *lengthening;
    int order;
    double *residuals, *jacobian, *new_residuals, *new_jacobian, *trial, *normal, *factor, *scale, *step, *force;
} Work;

/* Residuals |f| - 1 - lengthening and their derivatives; returns the weighted sum of squares. */
static double evaluate(const Work *w, const double *theta, double *residuals, double *jacobian) {
    double cost = 0.0;
    for (Py_ssize_t i = 0; i < w->n; i++) {
        residuals[i] = length(theta, w->reading + 3 * i, w->order, jacobian + i * w->p, w->force) - 1.0 - w->lengthening[i];
        cost += w->weights[i] * residuals[i] * residuals[i];
    }
    return cost;
}

/* Upper triangle of J' W J, and -J' W r where the step will be; four attitudes at a time, as its rows are short. */
static void normal_equations(const Work *w) {
    const Py_ssize_t p = w->p;
    for (Py_ssize_t a = 0; a < p * p; a++) w->normal[a] = 0.0;
    for (Py_ssize_t a = 0; a < p; a++) w->step[a] = 0.0;
    for (Py_ssize_t i = 0; i < w->n; i += 4) {
        const double *row[4];
        double weight[4], residual[4];
        for (Py_ssize_t k = 0; k < 4; k++) {
            const int there = i + k < w->n;
            const Py_ssize_t j = there ? i + k : i;
            row[k] = w->jacobian + j * p, residual[k] = w->residuals[j], weight[k] = there ? w->weights[j] : 0.0;
        }
        for (Py_ssize_t a = 0; a < p; a++) {
            const double first = row[0][a] * weight[0], second = row[1][a] * weight[1];
            const double third = row[2][a] * weight[2], fourth = row[3][a] * weight[3];
            double *into = w->normal + a * p;
            for (Py_ssize_t b = a; b < p; b++) {
                into[b] += (first * row[0][b] + second * row[1][b]) + (third * row[2][b] + fourth * row[3][b]);
            }
            w->step[a] -= (first * residual[0] + second * residual[1]) + (third * residual[2] + fourth * residual[3]);
        }
    }
}

/* Solve (H + damping diag H) step = -g in scaled parameters by Cholesky's method; what nothing senses stays. */
static void damped_step(const Work *w, double damping) {
    const Py_ssize_t p = w->p;
    double *u = w->factor, *scale = w->scale, *x = w->step, longest = 0.0;
    for (Py_ssize_t a = 0; a < p; a++) {
        scale[a] = sqrt(w->normal[a * p + a]);
        if (scale[a] > longest) longest = scale[a];
    }
    const double added = damping > LEAST_DAMPING ? damping : LEAST_DAMPING;
    for (Py_ssize_t a = 0; a < p; a++) {
        /* From here on 1 / scale, and 0 for what is not sensed. */
        scale[a] = scale[a] > SENSED * longest || isnan(scale[a]) ? 1.0 / scale[a] : 0.0;
    }
    for (Py_ssize_t a = 0; a < p; a++) {
        const double *from = w->normal + a * p;
        for (Py_ssize_t b = a; b < p; b++) u[a * p + b] = from[b] * scale[a] * scale[b];
        u[a * p + a] += scale[a] == 0.0 ? 1.0 : added;
        x[a] *= scale[a];
    }
    for (Py_ssize_t a = 0; a < p; a++) { /* U' U = H, row by row; U' y = -g beside it */
        double *row = u + a * p;
        const double per_pivot = 1.0 / sqrt(row[a]);
        for (Py_ssize_t b = a; b < p; b++) row[b] *= per_pivot;
        x[a] *= per_pivot;
        for (Py_ssize_t c = a + 1; c < p; c++) {
            double *below = u + c * p;
            const double factor = row[c];
            for (Py_ssize_t b = c; b < p; b++) below[b] -= factor * row[b];
            x[c] -= factor * x[a];
        }
    }
    for (Py_ssize_t a = p - 1; a >= 0; a--) {
        double sum = x[a];
        for (Py_ssize_t b = a + 1; b < p; b++) sum -= u[a * p + b] * x[b];
        x[a] = sum / u[a * p + a];
    }
    for (Py_ssize_t a = 0; a < p; a++) x[a] *= scale[a];
}

/* Levenberg-Marquardt on one problem; returns the number of steps tried. */
static int minimise(Work *w, double *theta, double tolerance, int most, char *converged) {
    double cost = evaluate(w, theta, w->residuals, w->jacobian), damping = 0.0;
    *converged = 0;
    for (int number = 1; number <= most; number++) {
        normal_equations(w);
        damped_step(w, damping);
        double largest = 0.0;
        for (Py_ssize_t a = 0; a < w->p; a++) {
            w->trial[a] = theta[a] + w->step[a];
            if (!(fabs(w->step[a]) <= largest)) largest = fabs(w->step[a]);
        }
        const int small = largest <= tolerance;
        const double found = evaluate(w, w->trial, w->new_residuals, w->new_jacobian);
        if (found <= cost * (small ? 1.0 + 1e-12 : 1.0)) {
            double *swapped = w->residuals;
            w->residuals = w->new_residuals;
            w->new_residuals = swapped;
            swapped = w->jacobian;
            w->jacobian = w->new_jacobian;
            w->new_jacobian = swapped;
            for (Py_ssize_t a = 0; a < w->p; a++) theta[a] = w->trial[a];
            cost = found;
            damping = damping / 10.0 < 1e-9 ? 0.0 : damping / 10.0;
            *converged = (char)small;
        } else {
            damping = 10.0 * damping > 1e-6 ? 10.0 * damping : 1e-6;
            *converged = (char)(small && damping <= 1e-6);
        }
        if (*converged || damping >= MAX_DAMPING) return number;
    }
    return most;
}

PyDoc_STRVAR(fit_doc,
             "fit(theta, reading, weights, lengthening, order, tolerance, most, residuals, jacobian, iterations, converged)\n\n"
             "Minimise sum w (|f| - 1 - lengthening)^2 for each problem. theta (b, p), the start, becomes the solution;\n"
             "weights, lengthening, residuals (b, n), jacobian (b, n, p), iterations int64 (b), converged bool (b); reading\n"
             "(b, n, 3), or (1, n, 3) for all alike.");

static PyObject *fit(PyObject *module, PyObject *args) {
    enum { THETA, READING, WEIGHTS, LENGTHENING, RESIDUALS, JACOBIAN, ITERATIONS, CONVERGED, BUFFERS };
    Py_buffer v[BUFFERS];
    int order, most;
    double tolerance;
    (void)module;
    if (!PyArg_ParseTuple(args, "w*y*y*y*idiw*w*w*w*", &v[THETA], &v[READING], &v[WEIGHTS], &v[LENGTHENING], &order,
                          &tolerance, &most, &v[RESIDUALS], &v[JACOBIAN], &v[ITERATIONS], &v[CONVERGED])) {
        return NULL;
    }
    const Py_ssize_t one = (Py_ssize_t)sizeof(double), problems = v[CONVERGED].len, p = 3 * ((Py_ssize_t)order + 2);
    const Py_ssize_t n = problems > 0 ? v[WEIGHTS].len / one / problems : 0;
    const int fits = order > 0 && v[THETA].len == problems * p * one && v[WEIGHTS].len == problems * n * one &&
                     v[LENGTHENING].len == v[WEIGHTS].len && v[RESIDUALS].len == v[WEIGHTS].len &&
                     v[JACOBIAN].len == v[WEIGHTS].len * p && v[ITERATIONS].len == problems * (Py_ssize_t)sizeof(int64_t) &&
                     (v[READING].len == 3 * n * one || v[READING].len == 3 * v[WEIGHTS].len);
    double *room = fits ? PyMem_Malloc(sizeof(double) * (size_t)(2 * n * (p + 1) + 2 * p * p + 3 * p + 3)) : NULL;
    if (room != NULL) {
        const Py_ssize_t next = v[READING].len == 3 * v[WEIGHTS].len ? 3 * n : 0;
        Work w = {n, p, v[READING].buf, v[WEIGHTS].buf, v[LENGTHENING].buf, order, room, room + 2 * n, room + n,
                  room + 2 * n + n * p, NULL, NULL, NULL, NULL, NULL, NULL};
        w.trial = room + 2 * n * (p + 1);
        w.scale = w.trial + p;
        w.step = w.scale + p;
        w.force = w.step + p;
        w.normal = w.force + 3;
        w.factor = w.normal + p * p;
        double *theta = v[THETA].buf, *residuals = v[RESIDUALS].buf, *jacobian = v[JACOBIAN].buf;
        int64_t *iterations = v[ITERATIONS].buf;
        char *converged = v[CONVERGED].buf;
        Py_BEGIN_ALLOW_THREADS
        for (Py_ssize_t b = 0; b < problems; b++) {
            iterations[b] = minimise(&w, theta, tolerance, most, converged + b);
            memcpy(residuals, w.residuals, sizeof(double) * (size_t)n);
            memcpy(jacobian, w.jacobian, sizeof(double) * (size_t)(n * p));
            theta += p, residuals += n, jacobian += n * p;
            w.reading += next, w.weights += n, w.lengthening += n;
        }
        Py_END_ALLOW_THREADS
        PyMem_Free(room);
    }
    for (int i = 0; i < BUFFERS; i++) PyBuffer_Release(&v[i]);
    if (!fits) {
        PyErr_SetString(PyExc_ValueError, "buffers that do not go together");
        return NULL;
    }
    if (room == NULL) return PyErr_NoMemory();
    Py_RETURN_NONE;
}

static PyMethodDef methods[] = {{"lengths", lengths, METH_VARARGS, lengths_doc},
                                {"noise", noise, METH_VARARGS, noise_doc},
                                {"fit", fit, METH_VARARGS, fit_doc},
                                {NULL, NULL, 0, NULL}};

static struct PyModuleDef definition = {
    PyModuleDef_HEAD_INIT, "_model", "The inverse error model of a triad.", 0, methods, NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__model(void) { return PyModule_Create(&definition); }
