/* Least squares of |f| = 1, for many small problems one after the other.
 *
 * Levenberg-Marquardt. A Gauss-Newton step is tried first; damping enters only where a step does not lower the cost, so that
 * convergence stays quadratic where residuals are small (Moré, LNM 630 (1978) 105). A choice of the order makes hundreds
 * of them on arrays of a few hundred numbers: in Python that time went into calls.
 */
#include "_model.h"
#include <math.h>
#include <string.h>

static const double SENSED = 1e-9; /* columns shorter than this, relative to the longest, are of parameters that nothing senses */
static const double LEAST_DAMPING = 1e-12, MAX_DAMPING = 1e12; /* the least keeps what nothing determines in place */
static const double NEAR = 100.0; /* steps of so many tolerances are taken where the cost changes by no more than rounding */

/* What the fit of one problem works on: n observations, p parameters, two evaluations that take turns. */
typedef struct {
    Py_ssize_t n, p;
    int order;
    const double *reading, *weights, *lengthening;
    double *residuals, *jacobian, *new_residuals, *new_jacobian; /* n, n p */
    double *normal, *factor;                                     /* p p */
    double *downhill, *step, *trial, *scale;                     /* p */
} Work;

/* Numbers of room that a Work needs, and its arrays laid out in it. */
static size_t needed(size_t n, size_t p) { return 2 * n * (p + 1) + 2 * p * p + 4 * p; }

static void lay_out(Work *w, double *room) {
    double **arrays[] = {&w->residuals, &w->new_residuals, &w->jacobian, &w->new_jacobian, &w->normal,
                         &w->factor,    &w->downhill,      &w->step,     &w->trial,        &w->scale};
    const Py_ssize_t n = w->n, p = w->p, sizes[] = {n, n, n * p, n * p, p * p, p * p, p, p, p, p};
    for (size_t i = 0; i < sizeof sizes / sizeof *sizes; i++) {
        *arrays[i] = room;
        room += sizes[i];
    }
}

/* Residuals |f| - 1 - lengthening and, where `jacobian` is not NULL, their derivatives; returns the weighted sum of squares. */
static double evaluate(const Work *w, const double *theta, double *residuals, double *jacobian) {
    double cost = 0.0, force[3];
    for (Py_ssize_t i = 0; i < w->n; i++) {
        residuals[i] = model_length(theta, w->reading + 3 * i, w->order, jacobian == NULL ? NULL : jacobian + i * w->p, force) - 1.0 - w->lengthening[i];
        cost += w->weights[i] * residuals[i] * residuals[i];
    }
    return cost;
}

/* Upper triangle of J' W J, and -J' W r; four attitudes at a time, as its rows are short. */
static void normal_equations(const Work *w) {
    const Py_ssize_t p = w->p;
    for (Py_ssize_t a = 0; a < p * p; a++) w->normal[a] = 0.0;
    for (Py_ssize_t a = 0; a < p; a++) w->downhill[a] = 0.0;
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
            w->downhill[a] -= (first * residual[0] + second * residual[1]) + (third * residual[2] + fourth * residual[3]);
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
        x[a] = w->downhill[a] * scale[a];
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

static void swap(double **a, double **b) {
    double *kept = *a;
    *a = *b;
    *b = kept;
}

/* Levenberg-Marquardt on one problem, from a start with this cost where residuals, Jacobian and normal equations are known;
 * returns the number of steps tried. The Jacobian at a solution is left out where it is not `wanted`. */
static int minimise(Work *w, double *theta, double cost, double tolerance, int most, int wanted, char *converged) {
    double damping = 0.0;
    *converged = 0;
    for (int number = 1; number <= most; number++) {
        damped_step(w, damping);
        double largest = 0.0;
        for (Py_ssize_t a = 0; a < w->p; a++) {
            w->trial[a] = theta[a] + w->step[a];
            if (!(fabs(w->step[a]) <= largest)) largest = fabs(w->step[a]);
        }
        const int small = largest <= tolerance;
        const double found = evaluate(w, w->trial, w->new_residuals, small && !wanted ? NULL : w->new_jacobian);
        const int better = found <= cost * (largest <= NEAR * tolerance ? 1.0 + 1e-12 : 1.0);
        if (better) {
            swap(&w->residuals, &w->new_residuals);
            swap(&w->jacobian, &w->new_jacobian);
            for (Py_ssize_t a = 0; a < w->p; a++) theta[a] = w->trial[a];
            cost = found;
            damping = damping / 10.0 < 1e-9 ? 0.0 : damping / 10.0;
            *converged = (char)small;
        } else {
            damping = 10.0 * damping > 1e-6 ? 10.0 * damping : 1e-6;
            *converged = (char)(small && damping <= 1e-6);
        }
        if (*converged || damping >= MAX_DAMPING) return number;
        if (better) normal_equations(w);
    }
    return most;
}

const char model_fit_doc[] =
    "fit(theta, reading, weights, lengthening, order, tolerance, most, residuals, jacobian, iterations, converged)\n\n"
    "Minimise sum w (|f| - 1 - lengthening)^2 for each problem. theta (b, p), the start, becomes the solution;\n"
    "weights, lengthening, residuals (b, n), jacobian (b, n, p), iterations int64 (b), converged bool (b); reading\n"
    "(b, n, 3), or (1, n, 3) for all alike.";

PyObject *model_fit(PyObject *module, PyObject *args) {
    enum { THETA, READING, WEIGHTS, LENGTHENING, RESIDUALS, JACOBIAN, ITERATIONS, CONVERGED, BUFFERS };
    Py_buffer v[BUFFERS];
    int order, most;
    double tolerance;
    (void)module;
    if (!PyArg_ParseTuple(args, "w*y*y*y*idiw*w*w*w*", &v[THETA], &v[READING], &v[WEIGHTS], &v[LENGTHENING], &order,
                          &tolerance, &most, &v[RESIDUALS], &v[JACOBIAN], &v[ITERATIONS], &v[CONVERGED])) {
        return NULL;
    }
    const Py_ssize_t problems = v[CONVERGED].len, p = 3 * ((Py_ssize_t)order + 2);
    const Py_ssize_t n = problems > 0 ? v[WEIGHTS].len / DOUBLE_BYTES / problems : 0;
    const int fits = order >= 0 && v[THETA].len == problems * p * DOUBLE_BYTES && v[WEIGHTS].len == problems * n * DOUBLE_BYTES &&
                     v[LENGTHENING].len == v[WEIGHTS].len && v[RESIDUALS].len == v[WEIGHTS].len &&
                     v[JACOBIAN].len == v[WEIGHTS].len * p && v[ITERATIONS].len == problems * INDEX_BYTES &&
                     (v[READING].len == 3 * n * DOUBLE_BYTES || v[READING].len == 3 * v[WEIGHTS].len);
    double *room = fits ? PyMem_Malloc(sizeof(double) * needed((size_t)n, (size_t)p)) : NULL;
    if (room != NULL) {
        const Py_ssize_t next = v[READING].len == 3 * v[WEIGHTS].len ? 3 * n : 0;
        Work w = {.n = n, .p = p, .order = order, .reading = v[READING].buf, .weights = v[WEIGHTS].buf,
                  .lengthening = v[LENGTHENING].buf};
        lay_out(&w, room);
        double *theta = v[THETA].buf, *residuals = v[RESIDUALS].buf, *jacobian = v[JACOBIAN].buf;
        int64_t *iterations = v[ITERATIONS].buf;
        char *converged = v[CONVERGED].buf;
        Py_BEGIN_ALLOW_THREADS
        for (Py_ssize_t b = 0; b < problems; b++) {
            const double cost = evaluate(&w, theta, w.residuals, w.jacobian);
            normal_equations(&w);
            iterations[b] = minimise(&w, theta, cost, tolerance, most, 1, converged + b);
            memcpy(residuals, w.residuals, sizeof(double) * (size_t)n);
            memcpy(jacobian, w.jacobian, sizeof(double) * (size_t)(n * p));
            theta += p, residuals += n, jacobian += n * p;
            w.reading += next, w.weights += n, w.lengthening += n;
        }
        Py_END_ALLOW_THREADS
        PyMem_Free(room);
    }
    if (!released(v, BUFFERS, fits, WRONG_BUFFERS)) return NULL;
    return room == NULL ? PyErr_NoMemory() : Py_NewRef(Py_None);
}

/* Fit all attitudes but one, for each of them, from the common start `all`, and take the residual of the one.
 *
 * At the start the n problems differ by one attitude's share of the cost and of the normal equations. */
static void leave_out_each(Work *w, Work *all, const double *theta, double tolerance, int most, double *weights, double *errors) {
    const Py_ssize_t n = w->n, p = w->p;
    const double cost = evaluate(all, theta, all->residuals, all->jacobian);
    double *solution = all->trial;
    char converged;
    normal_equations(all);
    for (Py_ssize_t i = 0; i < n; i++) {
        const double *row = all->jacobian + i * p, residual = all->residuals[i], weight = weights[i];
        memcpy(w->residuals, all->residuals, sizeof(double) * (size_t)n);
        for (Py_ssize_t a = 0; a < p; a++) {
            for (Py_ssize_t b = a; b < p; b++) {
                w->normal[a * p + b] = all->normal[a * p + b] - weight * row[a] * row[b];
            }
            w->downhill[a] = all->downhill[a] + weight * row[a] * residual;
            solution[a] = theta[a];
        }
        weights[i] = 0.0;
        minimise(w, solution, cost - weight * residual * residual, tolerance, most, 0, &converged);
        weights[i] = weight;
        errors[i] = w->residuals[i];
    }
}

const char model_left_out_doc[] =
    "left_out(theta, reading, weights, lengthening, order, tolerance, most, errors) -> None\n\n"
    "Residual |f| - 1 - lengthening of each attitude (n,) under the fit to all others, as by `fit` with its weight set to\n"
    "zero; theta (p,), where each of these fits starts, reading (n, 3), weights and lengthening (n,).";

PyObject *model_left_out(PyObject *module, PyObject *args) {
    enum { THETA, READING, WEIGHTS, LENGTHENING, ERRORS, BUFFERS };
    Py_buffer v[BUFFERS];
    int order, most;
    double tolerance;
    (void)module;
    if (!PyArg_ParseTuple(args, "y*y*y*y*idiw*", &v[THETA], &v[READING], &v[WEIGHTS], &v[LENGTHENING], &order, &tolerance,
                          &most, &v[ERRORS])) {
        return NULL;
    }
    const Py_ssize_t p = 3 * ((Py_ssize_t)order + 2), n = v[ERRORS].len / DOUBLE_BYTES;
    const int fits = order >= 0 && v[THETA].len == p * DOUBLE_BYTES && v[READING].len == 3 * n * DOUBLE_BYTES && v[ERRORS].len == n * DOUBLE_BYTES &&
                     v[WEIGHTS].len == v[ERRORS].len && v[LENGTHENING].len == v[ERRORS].len;
    double *room = fits ? PyMem_Malloc(sizeof(double) * (2 * needed((size_t)n, (size_t)p) + (size_t)n)) : NULL;
    if (room != NULL) {
        double *weights = room + 2 * needed((size_t)n, (size_t)p);
        memcpy(weights, v[WEIGHTS].buf, sizeof(double) * (size_t)n);
        Work w = {.n = n, .p = p, .order = order, .reading = v[READING].buf, .weights = weights,
                  .lengthening = v[LENGTHENING].buf};
        Work all = w;
        lay_out(&w, room);
        lay_out(&all, room + needed((size_t)n, (size_t)p));
        Py_BEGIN_ALLOW_THREADS
        leave_out_each(&w, &all, v[THETA].buf, tolerance, most, weights, v[ERRORS].buf);
        Py_END_ALLOW_THREADS
        PyMem_Free(room);
    }
    if (!released(v, BUFFERS, fits, WRONG_BUFFERS)) return NULL;
    return room == NULL ? PyErr_NoMemory() : Py_NewRef(Py_None);
}
