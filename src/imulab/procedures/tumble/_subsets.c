/* Which one, two or three of some tens of attitudes explain most of a sum of squares: every set is tried.
 *
 * Members are eliminated one after the other, by Cholesky's method: given i, and given i and j, the residuals and the
 * matrix of all later attitudes are updated once, so that a set of three costs a few operations.
 */
#include "_model.h"
#include <math.h>

enum { MOST = 3 };

/* n attitudes, their residuals r and the matrix R = I - H, and the best set of `size` so far. */
typedef struct {
    Py_ssize_t n, size;
    const double *residual, *matrix;
    double least; /* eigenvalue of R_SS */
    Py_ssize_t chosen[MOST], best[MOST];
    double gain; /* of the best, r_S' R_SS^-1 r_S */
} Search;

/* Whether the least eigenvalue of R_SS is above the limit: R_SS less the limit is positive definite. */
static int separable(const Search *s) {
    double block[MOST][MOST];
    for (Py_ssize_t a = 0; a < s->size; a++) {
        for (Py_ssize_t b = 0; b <= a; b++) block[a][b] = s->matrix[s->chosen[a] * s->n + s->chosen[b]] - (a == b ? s->least : 0.0);
    }
    for (Py_ssize_t a = 0; a < s->size; a++) {
        if (!(block[a][a] > 0.0)) return 0;
        for (Py_ssize_t b = a + 1; b < s->size; b++) {
            for (Py_ssize_t c = a + 1; c <= b; c++) block[b][c] -= block[b][a] * block[c][a] / block[a][a];
        }
    }
    return 1;
}

/* Try each attitude after the last chosen one as the next member, at `depth`. Given those before, `residual` and `matrix`
 * (rows of n) are those of the others, which explain `gain`; `room` holds n + n n numbers for each further depth. */
static void try_members(Search *s, Py_ssize_t depth, const double *residual, const double *matrix, double gain, double *room) {
    const Py_ssize_t n = s->n, first = depth > 0 ? s->chosen[depth - 1] + 1 : 0;
    for (Py_ssize_t i = first; i < n; i++) {
        const double pivot = matrix[i * n + i], more = gain + residual[i] * residual[i] / pivot;
        if (!(pivot > 0.0)) continue;
        s->chosen[depth] = i;
        if (depth + 1 < s->size) {
            const double *row = matrix + i * n, share = residual[i] / pivot;
            double *left = room, *updated = room + n;
            const int last = depth + 2 == s->size; /* only the diagonal is needed then */
            for (Py_ssize_t j = i + 1; j < n; j++) {
                const double factor = row[j] / pivot;
                left[j] = residual[j] - row[j] * share;
                for (Py_ssize_t k = j; k < (last ? j + 1 : n); k++) updated[j * n + k] = matrix[j * n + k] - factor * row[k];
            }
            try_members(s, depth + 1, left, updated, more, updated + n * n);
        } else if (more > s->gain && separable(s)) {
            s->gain = more;
            for (Py_ssize_t a = 0; a < s->size; a++) s->best[a] = s->chosen[a];
        }
    }
}

const char model_best_subset_doc[] =
    "best_subset(residual, matrix, least, best) -> float\n\n"
    "The members S, rising, int64 (m), of which residual (n) and matrix (n, n), R, make r_S' R_SS^-1 r_S largest, among those\n"
    "whose R_SS has no eigenvalue below `least`; returns that, or -1 where there are none. m is 1 to 3.";

PyObject *model_best_subset(PyObject *module, PyObject *args) {
    enum { RESIDUAL, MATRIX, BEST, BUFFERS };
    Py_buffer v[BUFFERS];
    double least;
    (void)module;
    if (!PyArg_ParseTuple(args, "y*y*dw*", &v[RESIDUAL], &v[MATRIX], &least, &v[BEST])) return NULL;
    const Py_ssize_t n = v[RESIDUAL].len / DOUBLE_BYTES, size = v[BEST].len / INDEX_BYTES;
    const int fits = size >= 1 && size <= MOST && v[MATRIX].len == n * n * DOUBLE_BYTES;
    double gain = 0.0, *room = fits ? PyMem_Malloc(sizeof(double) * (size_t)(MOST * (n + n * n))) : NULL;
    if (room != NULL) {
        int64_t *best = v[BEST].buf;
        Search s = {.n = n, .size = size, .residual = v[RESIDUAL].buf, .matrix = v[MATRIX].buf, .least = least,
                    .gain = -1.0};
        try_members(&s, 0, s.residual, s.matrix, 0.0, room);
        for (Py_ssize_t a = 0; a < size; a++) best[a] = (int64_t)s.best[a];
        gain = s.gain;
        PyMem_Free(room);
    }
    if (!released(v, BUFFERS, fits, WRONG_BUFFERS)) return NULL;
    return room == NULL ? PyErr_NoMemory() : PyFloat_FromDouble(gain);
}
