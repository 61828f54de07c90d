/* What the parts of the module share: _model.c has the model, _fit.c its least squares, _subsets.c knocked attitudes. */
#ifndef IMULAB_MODEL_H
#define IMULAB_MODEL_H

#include "buffers.h"

/* |f| in one attitude, its derivatives (3 (order + 2) of them), and f. */
double model_length(const double *theta, const double *reading, int order, double *derivative, double *f);

/* The methods `fit`, `left_out` and `best_subset`. */
extern const char model_fit_doc[], model_left_out_doc[], model_best_subset_doc[];
PyObject *model_fit(PyObject *module, PyObject *args);
PyObject *model_left_out(PyObject *module, PyObject *args);
PyObject *model_best_subset(PyObject *module, PyObject *args);

#endif
