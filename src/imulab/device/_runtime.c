/* Python face of the C core: buffers in, buffers out, the interpreter's lock released, no arithmetic. */
#include "buffers.h"

#include "imulab.h"

enum { MOST = 512 }; /* columns in one call */
#define CAPSULE "imulab.unit"
#define READ(columns) ((const il_real *const *)(columns)) /* which are not written to */

typedef struct {
    il_unit unit;
    il_real *memory;
} held_unit;

static void forget(PyObject *capsule) {
    held_unit *held = PyCapsule_GetPointer(capsule, CAPSULE);
    if (held != NULL) PyMem_Free(held->memory);
    PyMem_Free(held);
}

static il_unit *unit_of(PyObject *capsule, uint32_t needed) {
    held_unit *held = PyCapsule_GetPointer(capsule, CAPSULE);
    if (held == NULL) return NULL;
    if (needed != 0 && !(held->unit.has & needed)) {
        PyErr_SetString(PyExc_ValueError, "the table has no section for this call");
        return NULL;
    }
    return &held->unit;
}

/* ---- buffers ------------------------------------------------------------------------------------------------------- */

typedef struct {
    Py_buffer view[MOST];
    int count;
} buffers;

static void release(buffers *b) {
    while (b->count > 0) PyBuffer_Release(&b->view[--b->count]);
}

/* The memory of a C-contiguous array of one type, of `n` items (any number if negative); NULL with an exception set. */
static void *memory_of(buffers *b, PyObject *object, char type, Py_ssize_t n, int writable) {
    Py_buffer *view = &b->view[b->count];
    int flags = PyBUF_C_CONTIGUOUS | PyBUF_FORMAT | (writable ? PyBUF_WRITABLE : 0);
    if (b->count == MOST) {
        PyErr_SetString(PyExc_ValueError, "too many columns");
        return NULL;
    }
    if (PyObject_GetBuffer(object, view, flags) != 0) return NULL;
    b->count++;
    const char *format = view->format != NULL ? view->format : "B";
    int same = format[0] == type && format[1] == '\0';
    if (!same && !(type == 'B' && format[0] == '?') && !(type == 'I' && format[0] == 'L' && view->itemsize == 4)) {
        PyErr_Format(PyExc_TypeError, "expected an array of type '%c', found '%s'", type, format);
        return NULL;
    }
    if (type != 'B' && (uintptr_t)view->buf % (size_t)view->itemsize != 0) {
        PyErr_SetString(PyExc_ValueError, "expected an aligned array");
        return NULL;
    }
    if (n >= 0 && view->len / view->itemsize != n) {
        PyErr_Format(PyExc_ValueError, "expected %zd items, found %zd", n, view->len / view->itemsize);
        return NULL;
    }
    return view->buf;
}

static Py_ssize_t items(const buffers *b, int index) {
    return b->view[index].len / b->view[index].itemsize;
}

/* Columns of a tuple, each float64 of the same length; None gives NULL where that is allowed. `*n` < 0 takes the first's. */
static int columns_of(buffers *b, PyObject *tuple, Py_ssize_t expected, Py_ssize_t *n, int writable, int optional,
                      il_real **out) {
    if (!PyTuple_Check(tuple) || PyTuple_Size(tuple) != expected) {
        PyErr_Format(PyExc_TypeError, "expected a tuple of %zd arrays", expected);
        return 0;
    }
    for (Py_ssize_t i = 0; i < expected; i++) {
        PyObject *item = PyTuple_GetItem(tuple, i);
        out[i] = NULL;
        if (optional && item == Py_None) continue;
        out[i] = memory_of(b, item, 'd', *n, writable);
        if (out[i] == NULL) return 0;
        if (*n < 0) *n = items(b, b->count - 1);
    }
    return 1;
}

/* ---- functions ----------------------------------------------------------------------------------------------------- */

static PyObject *load(PyObject *self, PyObject *args) {
    (void)self;
    const char *bytes;
    Py_ssize_t size;
    if (!PyArg_ParseTuple(args, "y#", &bytes, &size)) return NULL;
    size_t capacity = (size_t)size / 4 + 1;
    held_unit *held = PyMem_Calloc(1, sizeof *held);
    il_real *memory = PyMem_Malloc(capacity * sizeof(il_real));
    if (held == NULL || memory == NULL) {
        PyMem_Free(held);
        PyMem_Free(memory);
        return PyErr_NoMemory();
    }
    held->memory = memory;
    il_status status = il_table_load(&held->unit, (const uint8_t *)bytes, (size_t)size, memory, capacity);
    if (status != IL_OK) {
        PyMem_Free(memory);
        PyMem_Free(held);
        PyErr_SetString(PyExc_ValueError, il_status_text(status));
        return NULL;
    }
    return PyCapsule_New(held, CAPSULE, forget);
}

static PyObject *has(PyObject *self, PyObject *capsule) {
    (void)self;
    il_unit *unit = unit_of(capsule, 0);
    return unit == NULL ? NULL : PyLong_FromUnsignedLong(unit->has);
}

static PyObject *tumble(PyObject *self, PyObject *args) {
    (void)self;
    PyObject *capsule, *outputs, *forces, *result = NULL;
    buffers b = {.count = 0};
    il_real *in[3], *out[3];
    Py_ssize_t n = -1;
    if (!PyArg_ParseTuple(args, "OOO", &capsule, &outputs, &forces)) return NULL;
    il_unit *unit = unit_of(capsule, IL_HAS_TUMBLE);
    if (unit != NULL && columns_of(&b, outputs, 3, &n, 0, 0, in) && columns_of(&b, forces, 3, &n, 1, 0, out)) {
        unsigned flags;
        Py_BEGIN_ALLOW_THREADS
        flags = il_tumble_block(&unit->tumble, (size_t)n, READ(in), 1, out, 1);
        Py_END_ALLOW_THREADS
        result = PyLong_FromUnsignedLong(flags);
    }
    release(&b);
    return result;
}

static PyObject *gyro(PyObject *self, PyObject *args) {
    (void)self;
    PyObject *capsule, *outputs, *forces, *rates, *result = NULL;
    buffers b = {.count = 0};
    il_real *in[3], *force[3] = {NULL, NULL, NULL}, *out[3];
    Py_ssize_t n = -1;
    if (!PyArg_ParseTuple(args, "OOOO", &capsule, &outputs, &forces, &rates)) return NULL;
    il_unit *unit = unit_of(capsule, IL_HAS_GYRO);
    int given = forces != Py_None;
    if (unit != NULL && columns_of(&b, outputs, 3, &n, 0, 0, in) &&
        (!given || columns_of(&b, forces, 3, &n, 0, 0, force)) && columns_of(&b, rates, 3, &n, 1, 0, out)) {
        unsigned flags;
        Py_BEGIN_ALLOW_THREADS
        flags = il_gyro_block(&unit->gyro, (size_t)n, READ(in), given ? READ(force) : NULL, 1, out, 1);
        Py_END_ALLOW_THREADS
        result = PyLong_FromUnsignedLong(flags);
    }
    release(&b);
    return result;
}

static PyObject *mag(PyObject *self, PyObject *args) {
    (void)self;
    PyObject *capsule, *outputs, *fields, *result = NULL;
    buffers b = {.count = 0};
    il_real *in[3], *out[3];
    Py_ssize_t n = -1;
    if (!PyArg_ParseTuple(args, "OOO", &capsule, &outputs, &fields)) return NULL;
    il_unit *unit = unit_of(capsule, IL_HAS_MAG);
    if (unit != NULL && columns_of(&b, outputs, 3, &n, 0, 0, in) && columns_of(&b, fields, 3, &n, 1, 0, out)) {
        unsigned flags;
        Py_BEGIN_ALLOW_THREADS
        flags = il_mag_block(&unit->mag, (size_t)n, READ(in), 1, out, 1);
        Py_END_ALLOW_THREADS
        result = PyLong_FromUnsignedLong(flags);
    }
    release(&b);
    return result;
}

static PyObject *thermal(PyObject *self, PyObject *args) {
    (void)self;
    PyObject *capsule, *temperature, *outputs, *forces, *result = NULL;
    buffers b = {.count = 0};
    il_real *in[3], *out[3];
    Py_ssize_t n = -1;
    if (!PyArg_ParseTuple(args, "OOOO", &capsule, &temperature, &outputs, &forces)) return NULL;
    il_unit *unit = unit_of(capsule, IL_HAS_THERMAL);
    if (unit != NULL && columns_of(&b, outputs, 3, &n, 0, 0, in) && columns_of(&b, forces, 3, &n, 1, 0, out)) {
        const il_real *at = memory_of(&b, temperature, 'd', n, 0);
        if (at != NULL) {
            unsigned flags;
            Py_BEGIN_ALLOW_THREADS
            flags = il_thermal_block(&unit->thermal, (size_t)n, at, READ(in), 1, out, 1);
            Py_END_ALLOW_THREADS
            result = PyLong_FromUnsignedLong(flags);
        }
    }
    release(&b);
    return result;
}

static PyObject *thermal_gyro(PyObject *self, PyObject *args) {
    (void)self;
    PyObject *capsule, *temperature, *outputs, *forces, *rates, *result = NULL;
    buffers b = {.count = 0};
    il_real *in[3], *force[3], *out[3];
    Py_ssize_t n = -1;
    if (!PyArg_ParseTuple(args, "OOOOO", &capsule, &temperature, &outputs, &forces, &rates)) return NULL;
    il_unit *unit = unit_of(capsule, IL_HAS_THERMAL_GYRO);
    int given = forces != Py_None;
    if (unit != NULL && columns_of(&b, outputs, 3, &n, 0, 0, in) &&
        (!given || columns_of(&b, forces, 3, &n, 0, 0, force)) && columns_of(&b, rates, 3, &n, 1, 0, out)) {
        const il_real *at = memory_of(&b, temperature, 'd', n, 0);
        if (at != NULL) {
            unsigned flags;
            Py_BEGIN_ALLOW_THREADS
            flags = il_thermal_gyro_block(&unit->thermal_gyro, (size_t)n, at, READ(in), given ? READ(force) : NULL, 1, out, 1);
            Py_END_ALLOW_THREADS
            result = PyLong_FromUnsignedLong(flags);
        }
    }
    release(&b);
    return result;
}

static PyObject *centrifuge(PyObject *self, PyObject *args) {
    (void)self;
    PyObject *capsule, *forces, *rates, *result = NULL;
    buffers b = {.count = 0};
    il_real *force[2], *rate[2];
    Py_ssize_t n = -1;
    if (!PyArg_ParseTuple(args, "OOO", &capsule, &forces, &rates)) return NULL;
    il_unit *unit = unit_of(capsule, IL_HAS_CENTRIFUGE);
    if (unit != NULL && columns_of(&b, forces, 2, &n, 0, 0, force) && columns_of(&b, rates, 2, &n, 1, 1, rate)) {
        unsigned flags;
        Py_BEGIN_ALLOW_THREADS
        flags = il_centrifuge_block(&unit->centrifuge, (size_t)n, READ(force), rate);
        Py_END_ALLOW_THREADS
        result = PyLong_FromUnsignedLong(flags);
    }
    release(&b);
    return result;
}

static PyObject *warmup(PyObject *self, PyObject *args) {
    (void)self;
    PyObject *capsule, *ticks, *inputs, *factors, *outputs, *result = NULL;
    double temperature, tick;
    buffers b = {.count = 0};
    il_real *in[MOST], *out[MOST];
    if (!PyArg_ParseTuple(args, "OddOOOO", &capsule, &temperature, &tick, &ticks, &inputs, &factors, &outputs)) return NULL;
    il_unit *unit = unit_of(capsule, IL_HAS_WARMUP);
    if (unit == NULL) return NULL;
    int axes = unit->warmup.axes;
    if (axes > (MOST - 2) / 2) {
        PyErr_SetString(PyExc_ValueError, "too many columns");
        return NULL;
    }
    const uint32_t *when = memory_of(&b, ticks, 'I', -1, 0);
    Py_ssize_t n = when != NULL ? items(&b, 0) : 0;
    const il_real *factor = when != NULL ? memory_of(&b, factors, 'd', axes, 0) : NULL;
    if (factor != NULL && columns_of(&b, inputs, axes, &n, 0, 1, in) && columns_of(&b, outputs, axes, &n, 1, 1, out)) {
        il_warmup_state state;
        il_status status = il_warmup_start(&unit->warmup, &state, temperature, tick);
        for (int i = 0; i < axes; i++) out[i] = in[i] == NULL ? NULL : out[i];
        Py_BEGIN_ALLOW_THREADS
        if (status == IL_OK) il_warmup_block(&unit->warmup, &state, (size_t)n, when, READ(in), factor, out);
        Py_END_ALLOW_THREADS
        if (status != IL_OK) PyErr_SetString(PyExc_ValueError, il_status_text(status));
        else result = PyBool_FromLong(state.active);
    }
    release(&b);
    return result;
}

static PyObject *array_start(PyObject *self, PyObject *capsule) {
    (void)self;
    il_unit *unit = unit_of(capsule, IL_HAS_ARRAY);
    if (unit == NULL) return NULL;
    PyObject *state = PyByteArray_FromStringAndSize(NULL, (Py_ssize_t)sizeof(il_array_state));
    if (state == NULL) return NULL;
    il_status status = il_array_start(&unit->array, (il_array_state *)(void *)PyByteArray_AsString(state));
    if (status == IL_OK) return state;
    Py_DecRef(state);
    PyErr_SetString(PyExc_ValueError, il_status_text(status));
    return NULL;
}

static PyObject *array_block(PyObject *self, PyObject *args) {
    (void)self;
    PyObject *capsule, *state, *readings, *stills, *rates, *all_flags, *weights, *result = NULL;
    buffers b = {.count = 0};
    if (!PyArg_ParseTuple(args, "OOOOOOO", &capsule, &state, &readings, &stills, &rates, &all_flags, &weights)) return NULL;
    il_unit *unit = unit_of(capsule, IL_HAS_ARRAY);
    if (unit == NULL) return NULL;
    Py_ssize_t axes = unit->array.axes, width = axes * unit->array.elements;
    void *bytes = memory_of(&b, state, 'B', (Py_ssize_t)sizeof(il_array_state), 1);
    if (bytes != NULL && (uintptr_t)bytes % sizeof(il_real) != 0) {
        PyErr_SetString(PyExc_ValueError, "expected an aligned state");
        bytes = NULL;
    }
    const il_real *reading = bytes != NULL ? memory_of(&b, readings, 'd', -1, 0) : NULL;
    Py_ssize_t n = reading != NULL ? items(&b, 1) / width : 0;
    if (reading != NULL && n * width != items(&b, 1)) {
        PyErr_Format(PyExc_ValueError, "expected a multiple of %zd readings, found %zd", width, items(&b, 1));
        release(&b);
        return NULL;
    }
    il_real *rate = reading != NULL ? memory_of(&b, rates, 'd', n * axes, 1) : NULL;
    const uint8_t *still = NULL;
    uint8_t *flags = NULL;
    il_real *weight = NULL;
    int fine = rate != NULL;
    if (fine && stills != Py_None) fine = (still = memory_of(&b, stills, 'B', n, 0)) != NULL;
    if (fine && all_flags != Py_None) fine = (flags = memory_of(&b, all_flags, 'B', n * width, 1)) != NULL;
    if (fine && weights != Py_None) fine = (weight = memory_of(&b, weights, 'd', n * width, 1)) != NULL;
    if (fine) {
        unsigned met;
        Py_BEGIN_ALLOW_THREADS
        met = il_array_block(&unit->array, bytes, (size_t)n, reading, still, rate, flags, weight);
        Py_END_ALLOW_THREADS
        result = PyLong_FromUnsignedLong(met);
    }
    release(&b);
    return result;
}

static PyObject *imus_start(PyObject *self, PyObject *capsule) {
    (void)self;
    il_unit *unit = unit_of(capsule, IL_HAS_IMUS);
    if (unit == NULL) return NULL;
    PyObject *state = PyByteArray_FromStringAndSize(NULL, (Py_ssize_t)sizeof(il_imus_state));
    if (state == NULL) return NULL;
    (void)il_imus_start(&unit->imus, (il_imus_state *)(void *)PyByteArray_AsString(state)); /* checked as it was loaded */
    return state;
}

static PyObject *imus_block(PyObject *self, PyObject *args) {
    (void)self;
    PyObject *capsule, *state, *steps, *readings, *outputs, *all_flags, *healths, *result = NULL;
    buffers b = {.count = 0};
    if (!PyArg_ParseTuple(args, "OOOOOOO", &capsule, &state, &steps, &readings, &outputs, &all_flags, &healths)) return NULL;
    il_unit *unit = unit_of(capsule, IL_HAS_IMUS);
    if (unit == NULL) return NULL;
    const Py_ssize_t count = unit->imus.count, numbers = (Py_ssize_t)(sizeof(il_imus_fused) / sizeof(il_real));
    void *bytes = memory_of(&b, state, 'B', (Py_ssize_t)sizeof(il_imus_state), 1);
    if (bytes != NULL && (uintptr_t)bytes % sizeof(il_real) != 0) {
        PyErr_SetString(PyExc_ValueError, "expected an aligned state");
        bytes = NULL;
    }
    const il_real *step = bytes != NULL ? memory_of(&b, steps, 'd', -1, 0) : NULL;
    const Py_ssize_t n = step != NULL ? items(&b, 1) : 0;
    const il_real *reading = step != NULL ? memory_of(&b, readings, 'd', 6 * count * n, 0) : NULL;
    il_imus_fused *fused = reading != NULL ? memory_of(&b, outputs, 'd', numbers * n, 1) : NULL;
    uint8_t *flags = fused != NULL ? memory_of(&b, all_flags, 'B', n, 1) : NULL;
    uint8_t *health = flags != NULL ? memory_of(&b, healths, 'B', 2 * count * n, 1) : NULL;
    if (health != NULL) {
        unsigned met;
        Py_BEGIN_ALLOW_THREADS
        met = il_imus_block(&unit->imus, bytes, (size_t)n, step, reading, fused, flags, health);
        Py_END_ALLOW_THREADS
        result = PyLong_FromUnsignedLong(met);
    }
    release(&b);
    return result;
}

MODULE(_runtime, "The C core of imulab.",
       {"load", load, METH_VARARGS, "load(bytes): a checked table; ValueError says what is wrong with it."},
       {"has", has, METH_O, "has(unit): bits of the sections that a table holds."},
       {"tumble", tumble, METH_VARARGS, "tumble(unit, outputs, forces): flags; tuples of three float64 columns."},
       {"gyro", gyro, METH_VARARGS, "gyro(unit, outputs, forces or None, rates): flags."},
       {"mag", mag, METH_VARARGS, "mag(unit, outputs, fields): flags."},
       {"thermal", thermal, METH_VARARGS, "thermal(unit, temperatures, outputs, forces): flags."},
       {"thermal_gyro", thermal_gyro, METH_VARARGS, "thermal_gyro(unit, temperatures, outputs, forces or None, rates): flags."},
       {"centrifuge", centrifuge, METH_VARARGS, "centrifuge(unit, forces, rates): flags; rates are changed in place."},
       {"warmup", warmup, METH_VARARGS, "warmup(unit, temperature, tick, ticks, inputs, factors, outputs): whether the table covers it."},
       {"array_start", array_start, METH_O, "array_start(unit): the state of a stream, as a bytearray."},
       {"array_block", array_block, METH_VARARGS, "array_block(unit, state, readings, still, rates, flags, weights): flags met."},
       {"imus_start", imus_start, METH_O, "imus_start(unit): the state of a stream, as a bytearray."},
       {"imus_block", imus_block, METH_VARARGS, "imus_block(unit, state, steps, readings, fused, flags, health): flags met."})
