/* Numbers as text, shared by the two halves of the module: _digits.c writes tables, _json.c records. */
#ifndef IMULAB_DIGITS_H
#define IMULAB_DIGITS_H

#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030B0000
#include <Python.h>

enum { LONGEST = 25 }; /* bytes of a number and what separates it from the next */

/* Whether print_number is there: it needs integers of 128 bits and the table of powers. */
int numbers_prepared(void);

/* The shortest decimal that reads back as `value`, at `out`, as Python writes it; returns where it ends. */
char *print_number(double value, char *out);

/* The method `json`. */
extern const char json_doc[];
PyObject *json_texts(PyObject *module, PyObject *value);

#endif
