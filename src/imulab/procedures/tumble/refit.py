"""A record at a smaller model: fitted anew to the attitudes that the record holds.

The linear part of a model with nonlinearity is not the best linear model: where the attitudes hardly separate scale
factor and k3, the one has taken what the other has given. A target that holds no k3 needs the scale factor without it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from imulab.estimation.least_squares import covariance, least_squares, leverage, observability, plausible_excess
from imulab.procedures.tumble.model import gravity_slope, norm_and_jacobian, parameter_names
from imulab.procedures.tumble.sections import data_of, model_of
from imulab.recording import Array
from imulab.records.calibration import Calibration, Covariance, Parameter

_LINEAR = 1
_WEIGHED = 3  # passes until weights and excess agree
_KEPT = 0.5  # attitudes that count for less than half were set aside by the record's own fit


def refit_linear(record: Calibration, *, misalignment: bool) -> Calibration | None:
    """Return a record of order 1, with bias and scale factor (and misalignment) fitted to the record's attitudes.

    Minimises ``sum w (|f| - g - l)^2``, l the lengthening of |f| by noise and motion that the record states, over the
    parameters that are left; w holds the scatter about the smaller model, so that the uncertainties do too.

    Parameters
    ----------
    record
        Of a tumble test.
    misalignment
        Whether the smaller model has misalignment; it is 0 otherwise.

    Returns
    -------
    Calibration or None
        The record with other parameters, covariance and rms; None where it holds no attitudes, or too few to see them.
    """
    held = data_of(record).attitudes
    free = np.arange(9 if misalignment else 6)
    if held is None:
        return None
    gravity = model_of(record).gravity
    kept = np.array(held.down_weight) >= _KEPT
    n, g = int(kept.sum()), float(gravity.value)
    if n <= len(free):
        return None
    names = parameter_names(_LINEAR)
    nominal = np.array([record.value(name) for name in names[3:6]])
    reading = (np.array(held.mean)[kept] / (nominal * g))[None]
    lengthening = np.array(held.lengthening or np.zeros(len(kept)))[kept] / g
    stated = held.standard_uncertainty
    own: Array = np.ones((1, n)) if stated is None else (np.array(stated)[kept] / g)[None] ** 2

    def model(parameters: Array) -> tuple[Array, Array]:
        theta = np.zeros((1, 9))
        theta[0, free] = parameters
        norm, jacobian = norm_and_jacobian(theta, reading, _LINEAR)[:2]
        return norm[0] - 1 - lengthening, jacobian[0][:, free]

    start: Array = np.concatenate([[record.value(name) / g for name in names[:3]], np.ones(3), np.zeros(3)])[free]
    variance: Array = own
    for _ in range(_WEIGHED):
        fit = least_squares(model, start, 1 / variance[0])
        start = fit.parameters[0]
        if stated is not None:
            spare = 1 - leverage(fit.jacobian, 1 / variance)
            variance = own + plausible_excess(fit.residuals, own, spare)[0][:, None]
    square = float((fit.residuals**2 / variance).sum()) / (n - len(free))
    # Where nothing was stated of the noise, the residuals tell it.
    factor = square if stated is None else 1.0
    seen = observability(fit.jacobian[0], 1 / (variance[0] * max(factor, np.finfo(float).tiny)))
    if seen.rank < len(free) or not fit.converged[0]:
        return None
    theta = np.zeros(9)
    theta[free] = start
    zero, relative = theta[:3], theta[3:6]
    values = np.concatenate([g * zero / relative, nominal * relative, theta[6:]])
    slope = np.diag(np.concatenate([g / relative, nominal, np.ones(3)]))
    slope[range(3), range(3, 6)] = -g * zero / relative**2
    shared = float(gravity.standard_uncertainty or 0.0) / g * gravity_slope(values, _LINEAR)
    whole = slope[:, free] @ (covariance(fit.jacobian, 1 / variance)[0] * factor) @ slope[:, free].T
    whole += np.outer(shared, shared)
    fitted = {
        name: replace(record.parameters[name], value=float(value), standard_uncertainty=float(np.sqrt(spread)))
        if name in record.parameters
        else Parameter(float(value), float(np.sqrt(spread)), "rad")
        for name, value, spread in zip(names, values, np.diag(whole), strict=True)
    }
    gyro = {name: parameter for name, parameter in record.parameters.items() if name.startswith("gyro_")}
    return replace(
        record,
        parameters=fitted | gyro,
        covariance=Covariance(tuple(names), tuple(map(tuple, whole.tolist()))),
        model={key: value for key, value in record.model.items() if key != "cross"} | {"order": _LINEAR},
        fit={"attitudes": n, "rms": {"value": g * float(np.sqrt(np.mean(fit.residuals**2))), "unit": "m/s^2"}},
    )
