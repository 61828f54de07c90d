/* What the two halves of the module share: _model.c has the model, _fit.c its least squares. */
#ifndef IMULAB_MODEL_H
#define IMULAB_MODEL_H

#include "buffers.h"

/* |f| in one attitude, its derivatives (3 (order + 2) of them), and f. */
double model_length(const double *theta, const double *reading, int order, double *derivative, double *f);

/* The methods `fit` and `left_out`. */
extern const char model_fit_doc[], model_left_out_doc[];
PyObject *model_fit(PyObject *module, PyObject *args);
PyObject *model_left_out(PyObject *module, PyObject *args);

#endif
