"""How well the directions of gravity are known that the turns of the gyroscopes are held against.

A direction is moved by the noise of its attitude across the vertical, and all of them together by the errors of the
accelerometers' parameters. The two are independent to first order: those parameters are found from |f|, along it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from imulab.procedures.tumble.apply import specific_force
from imulab.procedures.tumble.attitudes import Attitudes
from imulab.procedures.tumble.sections import fit_of
from imulab.recording import Array
from imulab.records.calibration import Calibration


def direction_covariance(record: Calibration, attitudes: Attitudes, output: Array, force: Array) -> Array:
    """Return the covariance of the upward directions, rad^2, shape (3 n, 3 n).

    Parameters
    ----------
    record
        Of the accelerometers; where it states no covariance, only the noise counts.
    attitudes
        Whose covariances are in their own unit.
    output
        Means of the attitudes in the record's unit, shape (n, 3).
    force
        Their specific force, m/s^2, shape (n, 3).
    """
    n = len(force)
    joint = np.zeros((n, 3, n, 3))
    if attitudes.covariance is not None:
        unit = float(np.linalg.norm(output) / np.linalg.norm(attitudes.mean))
        size = unit * np.sqrt(np.einsum("nii->n", attitudes.covariance).mean() / 3)
        columns = [_slope(record, output, size * np.eye(3)[axis]) / size for axis in range(3)]
        slope = np.stack(columns, axis=2)
        own = slope @ (attitudes.covariance * unit**2) @ np.swapaxes(slope, 1, 2)
        joint[range(n), :, range(n), :] = own + fit_of(record).excess.value ** 2 * np.eye(3)
    names = [name for name in record.covariance.names if not name.startswith("gyro_")]
    if names:
        matrix = record.covariance.block(names)
        sigma = np.sqrt(np.diag(matrix))
        moved = np.stack(
            [
                _force_change(record, name, size, output).ravel()
                for name, size in zip(names, sigma.tolist(), strict=True)
            ],
            axis=1,
        )
        joint += (moved @ (matrix / np.outer(sigma, sigma)) @ moved.T).reshape(n, 3, n, 3)
    length = np.linalg.norm(force, axis=1)
    up = force / length[:, None]
    across = (np.eye(3) - up[:, :, None] * up[:, None, :]) / length[:, None, None]
    found: Array = np.einsum("nij,njmk,mlk->niml", across, joint, across, optimize=True).reshape(3 * n, 3 * n)
    return found


def _slope(record: Calibration, output: Array, step: Array) -> Array:
    """Half the change of the specific force from one step before the outputs to one after, shape (n, 3)."""
    change: Array = (specific_force(record, output + step) - specific_force(record, output - step)) / 2
    return change


def _force_change(record: Calibration, name: str, sigma: float, output: Array) -> Array:
    """Change of the specific force with one standard uncertainty of a parameter, shape (n, 3)."""
    parameter = record.parameters[name]
    ends = [
        specific_force(
            replace(
                record, parameters={**record.parameters, name: replace(parameter, value=parameter.value + s * sigma)}
            ),
            output,
        )
        for s in (-1, 1)
    ]
    change: Array = (ends[1] - ends[0]) / 2
    return change
