/* The inner loops of segment.py: blocks, windows, the stretches of a threshold, its attitudes, how well they agree
 * (and, in _scatter.h, how they scatter).
 *
 * What each is for stands there. A sweep of the threshold passes a few times over a few thousand blocks: as calls on
 * arrays of that size it took longer than as loops. The plain form is tests/reference/segment.py.
 */
#include "buffers.h"

#include <math.h>
#include <string.h>

enum { AXES = 3, MOMENTS = 9, COEFFICIENTS = 9, FEWEST_ATTITUDES = 11 };
static const double DEFINED = 1e-6, LEAST_LEFT = 1e-9;

#include "_scatter.h"

/* Mean and mean squared scatter of each block, from its first sample on: equal samples have a scatter of exactly 0.
 * Even and odd samples have sums of their own, since a sum cannot go on before the last is there. */
static void form_axis(const double *samples, Py_ssize_t count, Py_ssize_t length, double *mean, double *scatter) {
    for (Py_ssize_t block = 0; block < count; block++, samples += length, mean += AXES, scatter += AXES) {
        double sum[2] = {0.0}, squares[2] = {0.0};
        for (Py_ssize_t i = 0; i + 1 < length; i += 2) {
            sum[0] += samples[i] - samples[0];
            sum[1] += samples[i + 1] - samples[0];
        }
        if (length % 2 != 0) sum[0] += samples[length - 1] - samples[0];
        const double centre = samples[0] + (sum[0] + sum[1]) / (double)length;
        for (Py_ssize_t i = 0; i + 1 < length; i += 2) {
            squares[0] += (samples[i] - centre) * (samples[i] - centre);
            squares[1] += (samples[i + 1] - centre) * (samples[i + 1] - centre);
        }
        if (length % 2 != 0) squares[0] += (samples[length - 1] - centre) * (samples[length - 1] - centre);
        *mean = centre;
        *scatter = (squares[0] + squares[1]) / (double)length;
    }
}

PyDoc_STRVAR(blocks_doc,
             "blocks(x, y, z, time, length, mean, scatter, longest) -> None\n\n"
             "Samples (n) to blocks of `length`: mean and mean squared scatter (b, 3), and the longest step in time from a\n"
             "sample of each block to the next sample (b).");

static PyObject *blocks(PyObject *module, PyObject *args) {
    enum { X, Y, Z, TIME, MEAN, SCATTER, LONGEST, BUFFERS };
    Py_buffer v[BUFFERS];
    Py_ssize_t length;
    (void)module;
    if (!PyArg_ParseTuple(args, "y*y*y*y*nw*w*w*", &v[X], &v[Y], &v[Z], &v[TIME], &length, &v[MEAN], &v[SCATTER],
                          &v[LONGEST])) {
        return NULL;
    }
    const Py_ssize_t n = v[TIME].len / DOUBLE_BYTES, count = v[LONGEST].len / DOUBLE_BYTES;
    const int fits = length > 0 && count <= n / length && v[X].len == v[TIME].len && v[Y].len == v[TIME].len &&
                     v[Z].len == v[TIME].len && v[MEAN].len == AXES * v[LONGEST].len && v[SCATTER].len == v[MEAN].len;
    if (fits) {
        const double *time = v[TIME].buf;
        double *mean = v[MEAN].buf, *scatter = v[SCATTER].buf, *longest = v[LONGEST].buf;
        Py_BEGIN_ALLOW_THREADS
        for (int axis = 0; axis < AXES; axis++) {
            form_axis(v[X + axis].buf, count, length, mean + axis, scatter + axis);
        }
        for (Py_ssize_t block = 0; block < count; block++) {
            double most = 0.0;
            for (Py_ssize_t i = block * length; i < (block + 1) * length && i + 1 < n; i++) {
                if (time[i + 1] - time[i] > most) most = time[i + 1] - time[i];
            }
            longest[block] = most;
        }
        Py_END_ALLOW_THREADS
    }
    return done(v, BUFFERS, fits);
}

PyDoc_STRVAR(windows_doc,
             "windows(mean, scatter, broken, width, variance) -> None\n\n"
             "Blocks, with bool (b) where time breaks off after one, to the variance of each window of `width` blocks, summed\n"
             "over the axes (b - width + 1); infinite across a break.");

static PyObject *windows(PyObject *module, PyObject *args) {
    enum { MEAN, SCATTER, BROKEN, VARIANCE, BUFFERS };
    Py_buffer v[BUFFERS];
    Py_ssize_t width;
    (void)module;
    if (!PyArg_ParseTuple(args, "y*y*y*nw*", &v[MEAN], &v[SCATTER], &v[BROKEN], &width, &v[VARIANCE])) return NULL;
    const Py_ssize_t count = v[VARIANCE].len / DOUBLE_BYTES;
    const int fits = width > 0 && v[BROKEN].len - count == width - 1 && v[MEAN].len == AXES * DOUBLE_BYTES * v[BROKEN].len &&
                     v[SCATTER].len == v[MEAN].len;
    if (fits) {
        const double *mean = v[MEAN].buf, *scatter = v[SCATTER].buf;
        const char *broken = v[BROKEN].buf;
        double *variance = v[VARIANCE].buf;
        Py_ssize_t breaks = 0;
        Py_BEGIN_ALLOW_THREADS
        for (Py_ssize_t i = 0; i + 1 < width; i++) breaks += broken[i] != 0;
        for (Py_ssize_t i = 0; i < count; i++, mean += AXES, scatter += AXES) {
            double sum[AXES] = {0.0}, spread = 0.0;
            for (Py_ssize_t k = 0; k < AXES * width; k += AXES) {
                for (int axis = 0; axis < AXES; axis++) sum[axis] += mean[k + axis];
            }
            for (int axis = 0; axis < AXES; axis++) sum[axis] /= (double)width;
            for (Py_ssize_t k = 0; k < AXES * width; k += AXES) {
                for (int axis = 0; axis < AXES; axis++) {
                    const double deviation = mean[k + axis] - sum[axis];
                    spread += scatter[k + axis] + deviation * deviation;
                }
            }
            breaks += broken[i + width - 1] != 0;
            variance[i] = breaks > 0 ? (double)INFINITY : spread / (double)width;
            breaks -= broken[i] != 0;
        }
        Py_END_ALLOW_THREADS
    }
    return done(v, BUFFERS, fits);
}

PyDoc_STRVAR(stretches_doc,
             "stretches(variance, limit, width, trim, fewest, start, stop) -> int\n\n"
             "Blocks that a window of no more than `limit` covers, as stretches without `trim` blocks at each end where\n"
             "`fewest` are left, half-open, int64; returns how many.");

static PyObject *stretches(PyObject *module, PyObject *args) {
    enum { VARIANCE, START, STOP, BUFFERS };
    Py_buffer v[BUFFERS];
    double limit;
    Py_ssize_t width, trim, fewest, found = 0;
    (void)module;
    if (!PyArg_ParseTuple(args, "y*dnnnw*w*", &v[VARIANCE], &limit, &width, &trim, &fewest, &v[START], &v[STOP])) {
        return NULL;
    }
    const Py_ssize_t count = v[VARIANCE].len / DOUBLE_BYTES, room = v[START].len / INDEX_BYTES;
    const Py_ssize_t most = PY_SSIZE_T_MAX / 4; /* what can be added and doubled */
    int fits = 0 < width && width < most && 0 <= trim && trim < most && -most < fewest && v[START].len == v[STOP].len;
    const double *variance = v[VARIANCE].buf;
    int64_t *start = v[START].buf, *stop = v[STOP].buf;
    for (Py_ssize_t i = 0; i < count && fits;) {
        if (!(variance[i] <= limit)) {
            i++;
            continue;
        }
        const Py_ssize_t first = i;
        Py_ssize_t end = i + width; /* a quiet window that begins before the end, or there, goes on with the stretch */
        while (++i < count && i <= end) {
            if (variance[i] <= limit) end = i + width;
        }
        if (end - first - 2 * trim < fewest) continue;
        fits = found < room;
        if (fits) {
            start[found] = first + trim;
            stop[found++] = end - trim;
        }
    }
    return released(v, BUFFERS, fits, WRONG_BUFFERS) ? PyLong_FromSsize_t(found) : NULL;
}

/* Mean of the blocks from start to stop. */
static void mean_of(const double *block, int64_t start, int64_t stop, double *mean) {
    double sum[AXES] = {0.0};
    for (const double *at = block + AXES * start; at < block + AXES * stop; at += AXES) {
        for (int axis = 0; axis < AXES; axis++) sum[axis] += at[axis];
    }
    for (int axis = 0; axis < AXES; axis++) mean[axis] = sum[axis] / (double)(stop - start);
}

/* Half of the widest axis of points (n, 3), and the middle of each axis. */
static double half_width(const double *points, Py_ssize_t n, double *middle) {
    double widest = 0.0;
    for (int axis = 0; axis < AXES; axis++) {
        double least = points[axis], most = points[axis];
        for (Py_ssize_t i = 1; i < n; i++) {
            least = fmin(least, points[AXES * i + axis]);
            most = fmax(most, points[AXES * i + axis]);
        }
        middle[axis] = (most + least) / 2.0;
        widest = fmax(widest, most - least);
    }
    return widest / 2.0;
}

PyDoc_STRVAR(attitudes_doc,
             "attitudes(block_mean, start, stop, same, attitude, mean) -> int\n\n"
             "Number stretches (s), int64: neighbours whose means are no farther apart than `same` radii are one attitude.\n"
             "Its mean goes to `mean`, of (s, 3) the first rows; returns how many.");

static PyObject *attitudes(PyObject *module, PyObject *args) {
    enum { BLOCK, START, STOP, ATTITUDE, MEAN, BUFFERS };
    Py_buffer v[BUFFERS];
    double same;
    (void)module;
    if (!PyArg_ParseTuple(args, "y*y*y*dw*w*", &v[BLOCK], &v[START], &v[STOP], &same, &v[ATTITUDE], &v[MEAN])) {
        return NULL;
    }
    const Py_ssize_t n = v[START].len / INDEX_BYTES, count = v[BLOCK].len / (AXES * DOUBLE_BYTES);
    const int64_t *start = v[START].buf, *stop = v[STOP].buf;
    int fits = v[STOP].len == v[START].len && v[ATTITUDE].len == v[START].len && v[MEAN].len == AXES * DOUBLE_BYTES * n;
    for (Py_ssize_t i = 0; i < n && fits; i++) fits = 0 <= start[i] && start[i] < stop[i] && stop[i] <= count;
    Py_ssize_t found = 0;
    if (fits && n > 0) {
        const double *block = v[BLOCK].buf;
        double *mean = v[MEAN].buf, middle[AXES];
        int64_t *attitude = v[ATTITUDE].buf;
        for (Py_ssize_t i = 0; i < n; i++) mean_of(block, start[i], stop[i], mean + AXES * i);
        const double apart = same * half_width(mean, n, middle);
        attitude[0] = 0;
        for (Py_ssize_t i = 1; i < n; i++) {
            double squares = 0.0;
            for (int axis = 0; axis < AXES; axis++) {
                const double step = mean[AXES * i + axis] - mean[AXES * (i - 1) + axis];
                squares += step * step;
            }
            attitude[i] = attitude[i - 1] + (sqrt(squares) > apart);
        }
        for (Py_ssize_t i = 0; i < n; found++) { /* never beyond i: the means that it takes the place of are done with */
            double total[AXES] = {0.0}, size = 0.0;
            do {
                const double own = (double)(stop[i] - start[i]);
                for (int axis = 0; axis < AXES; axis++) total[axis] += own * mean[AXES * i + axis];
                size += own;
            } while (++i < n && attitude[i] == found);
            for (int axis = 0; axis < AXES; axis++) mean[AXES * found + axis] = total[axis] / size;
        }
    }
    return released(v, BUFFERS, fits, WRONG_BUFFERS) ? PyLong_FromSsize_t(found) : NULL;
}

/* Q of a QR decomposition of (n, 9) in place, by Gram and Schmidt's method twice over; false if the columns depend. */
static int orthogonal(double *q, Py_ssize_t n) {
    double least = INFINITY, most = 0.0;
    for (int column = 0; column < COEFFICIENTS; column++) {
        for (int pass = 0; pass < 2; pass++) {
            for (int earlier = 0; earlier < column; earlier++) {
                double product = 0.0;
                for (Py_ssize_t i = 0; i < n; i++) product += q[COEFFICIENTS * i + earlier] * q[COEFFICIENTS * i + column];
                for (Py_ssize_t i = 0; i < n; i++) q[COEFFICIENTS * i + column] -= product * q[COEFFICIENTS * i + earlier];
            }
        }
        double squares = 0.0;
        for (Py_ssize_t i = 0; i < n; i++) squares += q[COEFFICIENTS * i + column] * q[COEFFICIENTS * i + column];
        const double length = sqrt(squares);
        least = fmin(least, length);
        most = fmax(most, length);
        if (!(least > 0.0)) return 0;
        for (Py_ssize_t i = 0; i < n; i++) q[COEFFICIENTS * i + column] /= length;
    }
    return least >= DEFINED * most;
}

/* Leave-one-out error of x' Q x + 2 q' x = 1 through the points, as a fraction of the radius; q has room for (n, 9). */
static double predicted(const double *points, Py_ssize_t n, double *q) {
    double middle[AXES], sum[COEFFICIENTS] = {0.0}, squares = 0.0;
    const double radius = half_width(points, n, middle);
    if (!(radius > 0.0)) return (double)INFINITY;
    for (Py_ssize_t i = 0; i < n; i++) {
        const double x = (points[AXES * i] - middle[0]) / radius, y = (points[AXES * i + 1] - middle[1]) / radius,
                     z = (points[AXES * i + 2] - middle[2]) / radius;
        const double row[COEFFICIENTS] = {x * x, y * y, z * z, x * y, y * z, z * x, x, y, z};
        memcpy(q + COEFFICIENTS * i, row, sizeof(row));
    }
    if (!orthogonal(q, n)) return (double)INFINITY;
    for (Py_ssize_t i = 0; i < n; i++) {
        for (int k = 0; k < COEFFICIENTS; k++) sum[k] += q[COEFFICIENTS * i + k];
    }
    for (Py_ssize_t i = 0; i < n; i++) {
        double leverage = 0.0, residual = 1.0;
        for (int k = 0; k < COEFFICIENTS; k++) {
            leverage += q[COEFFICIENTS * i + k] * q[COEFFICIENTS * i + k];
            residual -= q[COEFFICIENTS * i + k] * sum[k];
        }
        const double error = residual / fmax(1.0 - leverage, LEAST_LEFT);
        squares += error * error;
    }
    return sqrt(squares / (double)n) / 2.0;
}

PyDoc_STRVAR(ellipsoid_error_doc,
             "ellipsoid_error(mean) -> float\n\n"
             "Leave-one-out error of an ellipsoid through points (n, 3), as a fraction of its radius; infinite where they\n"
             "do not determine one.");

static PyObject *ellipsoid_error(PyObject *module, PyObject *args) {
    Py_buffer mean;
    (void)module;
    if (!PyArg_ParseTuple(args, "y*", &mean)) return NULL;
    const Py_ssize_t n = mean.len / (AXES * DOUBLE_BYTES);
    double error = INFINITY, *room = NULL;
    if (n >= FEWEST_ATTITUDES) {
        room = PyMem_Malloc(sizeof(double) * (size_t)(COEFFICIENTS * n));
        if (room != NULL) error = predicted(mean.buf, n, room);
    }
    PyBuffer_Release(&mean);
    if (n >= FEWEST_ATTITUDES && room == NULL) return PyErr_NoMemory();
    PyMem_Free(room);
    return PyFloat_FromDouble(error);
}

MODULE(_segment, "The inner loops of segmentation.", METHOD(blocks), METHOD(windows), METHOD(stretches), METHOD(attitudes),
       METHOD(ellipsoid_error), METHOD(batches), METHOD(motion))
