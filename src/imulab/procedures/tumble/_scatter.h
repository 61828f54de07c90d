/* How the blocks of an attitude scatter, and how it moves: the last of the inner loops of _segment.c. */
#ifndef IMULAB_SCATTER_H
#define IMULAB_SCATTER_H

PyDoc_STRVAR(batches_doc,
             "batches(block_mean, start, stop, attitude, centre, size, first, mean, number, scatter) -> None\n\n"
             "Cut stretches (s), int64, into batches of `size` blocks: the first block of each (b), int64, and the means (b, 9)\n"
             "of its blocks' deviations x, y, z from the attitude's `centre` (a, 3) and of their products xx, yy, zz, xy, xz,\n"
             "yz; for each attitude the number of its batches (a), int64, and the sum of the products of those means'\n"
             "deviations from the mean of all of them (a, 9, 9). Stretches of one attitude follow each other.");

/* Mean over blocks of their deviations from a centre and of the products of these. */
static void moments_of(const double *block, int64_t start, int64_t stop, const double *centre, double *mean) {
    for (int k = 0; k < MOMENTS; k++) mean[k] = 0.0;
    for (const double *at = block + AXES * start; at < block + AXES * stop; at += AXES) {
        const double x = at[0] - centre[0], y = at[1] - centre[1], z = at[2] - centre[2];
        const double own[MOMENTS] = {x, y, z, x * x, y * y, z * z, x * y, x * z, y * z};
        for (int k = 0; k < MOMENTS; k++) mean[k] += own[k];
    }
    for (int k = 0; k < MOMENTS; k++) mean[k] /= (double)(stop - start);
}

/* Whether stretches [start, stop) lie within `blocks` and belong to one of `count` attitudes. */
static int within(const int64_t *start, const int64_t *stop, const int64_t *attitude, Py_ssize_t n, Py_ssize_t blocks,
                  Py_ssize_t count) {
    for (Py_ssize_t i = 0; i < n; i++) {
        if (start[i] < 0 || start[i] >= stop[i] || stop[i] > blocks || attitude[i] < 0 || attitude[i] >= count) return 0;
    }
    return 1;
}

static PyObject *batches(PyObject *module, PyObject *args) {
    enum { BLOCK, START, STOP, ATTITUDE, CENTRE, FIRST, MEAN, NUMBER, SCATTER, BUFFERS };
    Py_buffer v[BUFFERS];
    Py_ssize_t size;
    (void)module;
    if (!PyArg_ParseTuple(args, "y*y*y*y*y*nw*w*w*w*", &v[BLOCK], &v[START], &v[STOP], &v[ATTITUDE], &v[CENTRE], &size,
                          &v[FIRST], &v[MEAN], &v[NUMBER], &v[SCATTER])) {
        return NULL;
    }
    const Py_ssize_t n = v[START].len / INDEX_BYTES, count = v[NUMBER].len / INDEX_BYTES;
    const int64_t *start = v[START].buf, *stop = v[STOP].buf, *attitude = v[ATTITUDE].buf;
    int fits = size > 0 && v[STOP].len == v[START].len && v[ATTITUDE].len == v[START].len &&
               v[CENTRE].len == AXES * DOUBLE_BYTES * count && v[MEAN].len == MOMENTS * DOUBLE_BYTES * (v[FIRST].len / INDEX_BYTES) &&
               v[SCATTER].len == MOMENTS * MOMENTS * DOUBLE_BYTES * count &&
               within(start, stop, attitude, n, v[BLOCK].len / (AXES * DOUBLE_BYTES), count);
    int64_t needed = 0;
    for (Py_ssize_t i = 0; i < n && fits; i++) needed += (stop[i] - start[i]) / size;
    fits = fits && needed == v[FIRST].len / INDEX_BYTES;
    if (fits) {
        const double *block = v[BLOCK].buf;
        int64_t *first = v[FIRST].buf, *number = v[NUMBER].buf;
        double *mean = v[MEAN].buf;
        memset(number, 0, (size_t)v[NUMBER].len);
        memset(v[SCATTER].buf, 0, (size_t)v[SCATTER].len);
        for (Py_ssize_t i = 0; i < n;) {
            const int64_t own = attitude[i];
            double *scatter = (double *)v[SCATTER].buf + MOMENTS * MOMENTS * own, centre[MOMENTS] = {0.0};
            Py_ssize_t found = 0;
            for (; i < n && attitude[i] == own; i++) {
                for (int64_t at = start[i]; at + size <= stop[i]; at += size, found++) {
                    first[found] = at;
                    moments_of(block, at, at + size, (double *)v[CENTRE].buf + AXES * own, mean + MOMENTS * found);
                    for (int k = 0; k < MOMENTS; k++) centre[k] += mean[MOMENTS * found + k];
                }
            }
            for (int k = 0; k < MOMENTS; k++) centre[k] /= (double)found;
            for (Py_ssize_t k = 0; k < found; k++, mean += MOMENTS) {
                for (int a = 0; a < MOMENTS; a++) {
                    for (int b = 0; b < MOMENTS; b++) {
                        scatter[MOMENTS * a + b] += (mean[a] - centre[a]) * (mean[b] - centre[b]);
                    }
                }
            }
            number[own] = found;
            first += found;
        }
    }
    return done(v, BUFFERS, fits);
}

PyDoc_STRVAR(motion_doc,
             "motion(x, y, z, length, block_mean, start, stop, attitude, centre, noise, spread, slope) -> None\n\n"
             "Samples (n), in blocks of `length`, to sums of products over each attitude, (a, 3, 3): of the differences of\n"
             "successive samples; of the blocks about `centre` (a, 3); and of half the difference of each block's neighbours.");

/* Add the products of a vector with itself to a matrix. */
static void add_products(const double *d, double *sum) {
    for (int a = 0; a < AXES; a++) {
        for (int b = 0; b < AXES; b++) sum[AXES * a + b] += d[a] * d[b];
    }
}

static PyObject *motion(PyObject *module, PyObject *args) {
    enum { X, Y, Z, BLOCK, START, STOP, ATTITUDE, CENTRE, NOISE, SPREAD, SLOPE, BUFFERS };
    Py_buffer v[BUFFERS];
    Py_ssize_t length;
    (void)module;
    if (!PyArg_ParseTuple(args, "y*y*y*ny*y*y*y*y*w*w*w*", &v[X], &v[Y], &v[Z], &length, &v[BLOCK], &v[START], &v[STOP],
                          &v[ATTITUDE], &v[CENTRE], &v[NOISE], &v[SPREAD], &v[SLOPE])) {
        return NULL;
    }
    const Py_ssize_t n = v[START].len / INDEX_BYTES, count = v[CENTRE].len / (AXES * DOUBLE_BYTES), there = v[BLOCK].len / (AXES * DOUBLE_BYTES);
    const Py_ssize_t square = AXES * AXES * DOUBLE_BYTES * count;
    const int64_t *start = v[START].buf, *stop = v[STOP].buf, *attitude = v[ATTITUDE].buf;
    const int fits = length > 0 && there <= v[X].len / DOUBLE_BYTES / length && v[Y].len == v[X].len && v[Z].len == v[X].len &&
                     v[STOP].len == v[START].len && v[ATTITUDE].len == v[START].len && v[NOISE].len == square &&
                     v[SPREAD].len == square && v[SLOPE].len == square && within(start, stop, attitude, n, there, count);
    if (fits) {
        const double *x = v[X].buf, *y = v[Y].buf, *z = v[Z].buf;
        for (int i = NOISE; i <= SLOPE; i++) memset(v[i].buf, 0, (size_t)square);
        Py_BEGIN_ALLOW_THREADS
        for (Py_ssize_t i = 0; i < n; i++) {
            const double *centre = (const double *)v[CENTRE].buf + AXES * attitude[i];
            double *noise = (double *)v[NOISE].buf + AXES * AXES * attitude[i];
            double *spread = (double *)v[SPREAD].buf + AXES * AXES * attitude[i];
            double *slope = (double *)v[SLOPE].buf + AXES * AXES * attitude[i];
            for (int64_t k = start[i] * length + 1; k < stop[i] * length; k++) {
                const double d[AXES] = {x[k] - x[k - 1], y[k] - y[k - 1], z[k] - z[k - 1]};
                add_products(d, noise);
            }
            for (int64_t k = start[i]; k < stop[i]; k++) {
                const double *at = (const double *)v[BLOCK].buf + AXES * k;
                double d[AXES];
                for (int a = 0; a < AXES; a++) d[a] = at[a] - centre[a];
                add_products(d, spread);
                if (k == start[i] || k + 1 == stop[i]) continue;
                for (int a = 0; a < AXES; a++) d[a] = (at[a + AXES] - at[a - AXES]) / 2.0;
                add_products(d, slope);
            }
        }
        Py_END_ALLOW_THREADS
    }
    return done(v, BUFFERS, fits);
}

#endif
