/* How every extension module begins and ends: Python's limited API (one binary for every version from 3.11 on), buffers given
 * back, and the table of the module's functions. */
#ifndef IMULAB_BUFFERS_H
#define IMULAB_BUFFERS_H

#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030B0000
#include <Python.h>
#include <stdint.h>

#define DOUBLE_BYTES ((Py_ssize_t)sizeof(double))
#define INDEX_BYTES ((Py_ssize_t)sizeof(int64_t))

/* Give buffers back. Returns whether they fit; an exception says what is wrong where they do not. */
static inline int released(Py_buffer *buffers, int count, int fits, const char *wrong) {
    for (int i = 0; i < count; i++) PyBuffer_Release(&buffers[i]);
    if (!fits) PyErr_SetString(PyExc_ValueError, wrong);
    return fits;
}

#define WRONG_BUFFERS "buffers that do not go together"

static inline PyObject *done(Py_buffer *buffers, int count, int fits) {
    return released(buffers, count, fits, WRONG_BUFFERS) ? Py_NewRef(Py_None) : NULL;
}

#define METHOD(name) {#name, name, METH_VARARGS, name##_doc}

/* The module `name`, from its docstring and its methods. */
#define MODULE(name, doc, ...)                                                                            \
    static PyMethodDef methods[] = {__VA_ARGS__, {NULL, NULL, 0, NULL}};                                  \
    static struct PyModuleDef definition = {PyModuleDef_HEAD_INIT, #name, doc, 0, methods, NULL, NULL, NULL, NULL}; \
    PyMODINIT_FUNC PyInit_##name(void) { return PyModule_Create(&definition); }

#endif
