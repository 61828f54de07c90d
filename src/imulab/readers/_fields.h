/* The lines and fields of a block that are wanted, without reading their numbers. */
#ifndef IMULAB_FIELDS_H
#define IMULAB_FIELDS_H

#include <Python.h>
#include <stdint.h>
#include <string.h>

/* The end of the field that begins at *p; *p moves to its first sign where blanks separate. NULL: there is no field. */
static const char *field_end(const char **p, const char *end, char delimiter) {
    const int blanks = delimiter == ' ';
    if (blanks) {
        while (*p < end && (**p == ' ' || **p == '\t')) ++*p;
        if (*p == end) return NULL;
    }
    const char *stop = *p;
    while (stop < end && *stop != delimiter && !(blanks && *stop == '\t')) stop++;
    return stop;
}

/* Whether a field holds no reading: blanks, an empty pair of quotes, or nan. */
static int is_missing(const char *p, const char *end) {
    while (p < end && (*p == ' ' || *p == '\t' || *p == '"')) p++;
    while (end > p && (end[-1] == ' ' || end[-1] == '\t' || end[-1] == '"')) end--;
    return p == end || (end - p == 3 && (p[0] | 32) == 'n' && (p[1] | 32) == 'a' && (p[2] | 32) == 'n');
}

/* Where the last of `fields` fields ends, if those with a slot >= 0 hold something; NULL if one does not. A line of more
 * than `most` fields (0: any number) is left as it is, for the parser to refuse. */
static const char *whole_end(const char *p, const char *end, char delimiter, const int32_t *slots, Py_ssize_t fields,
                             Py_ssize_t most) {
    const char *last = NULL, *stop;
    Py_ssize_t field = 0;
    for (; field < fields || most > 0; field++, p = stop + 1) {
        stop = p <= end ? field_end(&p, end, delimiter) : NULL;
        if (stop == NULL) break;
        if (field < fields) {
            if (slots[field] >= 0 && is_missing(p, stop)) return NULL;
            last = stop;
        }
    }
    if (field < fields) return NULL;
    return most > 0 && field > most ? end : last;
}

PyDoc_STRVAR(choose_doc,
             "choose(block, delimiter, out, prefix, slots, skip, most_fields=0, most_rows=-1)\n"
             "-> (size, rows, lines, incomplete)\n\n"
             "Copy to `out`, a writable buffer larger than `block`, the lines whose first field is `prefix`, without it, or\n"
             "begins with a `prefix` that ends with a colon (all lines where it is empty). With `skip`, only rows in which every field with a slot >= 0 holds a reading, cut\n"
             "behind field len(slots) - 1, and of at most `most_fields` fields; others of the prefix count as incomplete.\n"
             "Ends after `most_rows` rows; `lines` is how many lines were looked at, `size` how many bytes were written.");

static PyObject *choose(PyObject *module, PyObject *args) {
    Py_buffer block, out, prefix, slots;
    int delimiter, skip;
    Py_ssize_t most_fields = 0, most_rows = -1, rows = 0, lines = 0, incomplete = 0, size = 0;
    (void)module;
    if (!PyArg_ParseTuple(args, "y*Cw*y*y*p|nn", &block, &delimiter, &out, &prefix, &slots, &skip, &most_fields,
                          &most_rows)) {
        return NULL;
    }
    const int fits = out.len > block.len && delimiter > 0 && delimiter < 128;
    if (fits) {
        PyThreadState *thread = PyEval_SaveThread();
        const char *p = block.buf, *end = p + block.len;
        char *to = out.buf;
        while (p < end && rows != most_rows) {
            const char *stop = memchr(p, '\n', (size_t)(end - p)), *from = p;
            if (stop == NULL) stop = end;
            p = stop + 1;
            lines++;
            if (stop > from && stop[-1] == '\r') stop--;
            if (prefix.len > 0) {
                const char *first = field_end(&from, stop, (char)delimiter);
                if (first == NULL) continue;
                const char *last = first;
                while (from < last && *from == ' ') from++;
                while (last > from && last[-1] == ' ') last--;
                if (last - from < prefix.len || memcmp(from, prefix.buf, (size_t)prefix.len) != 0) continue;
                if (last - from == prefix.len) {
                    from = first < stop ? first + 1 : stop;
                } else if (from[prefix.len - 1] == ':') {
                    from += prefix.len;
                } else {
                    continue;
                }
            }
            if (skip) {
                stop = whole_end(from, stop, (char)delimiter, slots.buf, slots.len / (Py_ssize_t)sizeof(int32_t), most_fields);
                if (stop == NULL) {
                    incomplete++;
                    continue;
                }
            }
            memcpy(to, from, (size_t)(stop - from));
            to += stop - from;
            *to++ = '\n';
            rows++;
        }
        size = to - (char *)out.buf;
        PyEval_RestoreThread(thread);
    }
    PyBuffer_Release(&block);
    PyBuffer_Release(&out);
    PyBuffer_Release(&prefix);
    PyBuffer_Release(&slots);
    if (!fits) {
        PyErr_SetString(PyExc_ValueError, "the output buffer is too small for the block, or the delimiter is not ASCII");
        return NULL;
    }
    return Py_BuildValue("nnnn", size, rows, lines, incomplete);
}

#endif
