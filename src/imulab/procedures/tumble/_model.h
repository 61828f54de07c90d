/* What the two halves of the module share: _model.c has the model, _fit.c its least squares. */
#ifndef IMULAB_MODEL_H
#define IMULAB_MODEL_H

#include "buffers.h"

/* |f| in one attitude, its derivatives (3 (order + 2) of them), and f. */
double length(const double *theta, const double *reading, int order, double *derivative, double *f);

/* The methods `fit` and `left_out`. */
extern const char fit_doc[], left_out_doc[];
PyObject *fit(PyObject *module, PyObject *args);
PyObject *left_out(PyObject *module, PyObject *args);

#endif
