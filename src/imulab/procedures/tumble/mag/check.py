"""The test whether |m| and dip of fresh attitudes are constant under a record with magnetometers.

Since the place may be another one, only their constancy is tested. r holds |m| over the record's field less 1, and the
dips less the record's; c are two unknowns that all |m| and all dips have in common. The test is

    min over c of (r - X c)' (J V J' + N)^-1 (r - X c) / (2n - 2)   against F(2n - 2, nu)

with J the derivatives of r by the record's parameters of both triads, V their covariance, N the scatter of the record's
own attitudes, and nu the redundancy of these. With three more columns, the derivatives by the hard iron, the same test
shows whether a change of hard iron alone explains the residuals, and which.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from imulab.columns import triad
from imulab.device.unit import output_factor
from imulab.estimation.distributions import f_tail
from imulab.procedures.tumble.attitudes import Attitudes
from imulab.procedures.tumble.device import field_in_body, specific_force
from imulab.procedures.tumble.mag.heading import Law, read_law
from imulab.procedures.tumble.mag.model import average_outputs, dip_angles
from imulab.procedures.tumble.schema import fit_of, mag_model_of
from imulab.recording import Array
from imulab.records.calibration import Calibration

FEWEST = 4  # attitudes that leave |m| and dip degrees of freedom beside the place's field
_PASSES = 5  # Gauss-Newton steps for a change of hard iron
_LEAST_FREE = 3.0  # degrees of freedom; the mean of F, which is matched, exists above 2


@dataclass(frozen=True)
class MagCheck:
    """How well the magnetometers of a record still hold.

    Attributes
    ----------
    magnitude, dip
        Residuals of each attitude beside what all have in common: parts of the field, and rad, shape (n,).
    magnitude_uncertainty, dip_uncertainty
        Their standard uncertainties by the record's covariance and scatter, shape (n,).
    common, common_uncertainty
        Deviations of |m| (part of the field) and dip (rad) from the record that all attitudes share, as at another
        place, and their standard uncertainties.
    probability
        Probability of such a scatter if the record holds.
    hard_iron
        Change of hard iron that explains the attitudes best, in the unit of the record's biases, shape (3,).
    explained
        Probability of the residuals after such a change.
    unit
        Unit of the record's biases: T, or 1 where they are parts of the field.
    """

    magnitude: Array
    dip: Array
    magnitude_uncertainty: Array
    dip_uncertainty: Array
    common: Array
    common_uncertainty: Array
    probability: float
    hard_iron: Array
    explained: float
    unit: str

    @property
    def worst(self) -> int:
        """Index of the attitude that is farthest off, in units of its uncertainties."""
        off = (self.magnitude / self.magnitude_uncertainty) ** 2 + (self.dip / self.dip_uncertainty) ** 2
        return int(np.argmax(off))

    def content(self) -> dict[str, Any]:
        """Return the same for scripts, in SI."""
        return {
            "p": self.probability,
            "common": {
                name: {
                    "value": float(self.common[k]),
                    "standard_uncertainty": float(self.common_uncertainty[k]),
                    "unit": unit,
                }
                for k, (name, unit) in enumerate((("magnitude", "1"), ("dip", "rad")))
            },
            "magnitude": self.magnitude.tolist(),
            "dip": {"value": self.dip.tolist(), "unit": "rad"},
            "hard_iron_change": {"value": self.hard_iron.tolist(), "p": self.explained},
        }


def check_mag(record: Calibration, attitudes: Attitudes) -> MagCheck:
    """Test whether the magnitude and the dip of fresh attitudes stay the same under a record.

    Parameters
    ----------
    record
        A record with magnetometers.
    attitudes
        Four attitudes or more, in the record's unit, of a recording with magnetometers.

    Raises
    ------
    DataError
        An attitude has no samples of the magnetometers, or numbers that are none.
    UnitError
        Their unit cannot be converted to the record's.
    RecordError
        The record lacks a parameter or its covariance.
    """
    law, fit, n = read_law(record), fit_of(record).mag, len(attitudes)
    assert fit is not None
    means = average_outputs(attitudes, np.arange(n))
    factor = output_factor(attitudes.recording.name, triad("mag"), means.unit, mag_model_of(record).mag_output_unit)
    field = field_in_body(record, means.mean * factor)
    force = specific_force(record, attitudes.mean)
    length, dip = float(record.model["field"]["value"]), record.value("dip")
    slopes, _ = _slopes(law, force, field, length)
    noise, freedom = _noise_variance(record, n)
    total = slopes @ law.covariance @ slopes.T + np.diag(noise)
    common: Array = np.kron(np.eye(2), np.ones((n, 1))).astype(np.float64)
    offsets, left, value, of_common = _fit_generalised(_deviations(force, field, length, dip), common, total)
    moved, after = np.zeros(3), value
    for _ in range(_PASSES):  # |m| is not linear in a large change of hard iron
        there = field - moved @ np.linalg.inv(law.mag.turn).T
        design = np.hstack([common, _slopes(law, force, there, length)[1]])
        step, _, after, _ = _fit_generalised(_deviations(force, there, length, dip), design, total)
        moved = moved - step[2:]
    sigma = np.sqrt(np.diag(total))
    return MagCheck(
        left[:n], left[n:], sigma[:n], sigma[n:], offsets, np.sqrt(np.diag(of_common)),
        float(f_tail(value / (2 * n - 2), 2.0 * n - 2, freedom)),
        moved,
        float(f_tail(after / (2 * n - 5), 2.0 * n - 5, freedom)),
        record.model.get("field", {}).get("unit", "1"),
    )  # fmt: skip


def _deviations(force: Array, field: Array, length: float, dip: float) -> Array:
    """Return |m| over the record's less 1, and then the dips less the record's, shape (2n,)."""
    return np.concatenate([np.linalg.norm(field, axis=1) / length - 1, dip_angles(field, force) - dip])


def _slopes(law: Law, force: Array, field: Array, length: float) -> tuple[Array, Array]:
    """Return the derivatives of |m| and then of the dips by all parameters, (2n, p), and by hard iron, (2n, 3)."""
    f_length, m_length = np.linalg.norm(force, axis=1)[:, None], np.linalg.norm(field, axis=1)[:, None]
    u, e = field / m_length, force / f_length
    dip = dip_angles(field, force)[:, None]
    t, v = -(e + u * np.sin(dip)) / np.cos(dip) / m_length, -(u + e * np.sin(dip)) / np.cos(dip) / f_length
    of_mag = np.vstack([law.mag.slopes(field, u / length), law.mag.slopes(field, t)])
    of_accel = np.vstack([law.accel.slopes(force, np.zeros_like(force)), law.accel.slopes(force, v)])
    return np.hstack([of_mag, of_accel]), of_mag[:, :3]


def _noise_variance(record: Calibration, count: int) -> tuple[Array, float]:
    """Return the variances of |m| and dip by the scatter of the record's own attitudes, and degrees of freedom.

    With a share h of an attitude in its own fit, its residual has 1 - h of the noise's variance, and its leave-one-out
    error 1 / (1 - h) of it. The product of both root mean squares is therefore the variance of the noise, and their
    ratio the share of an attitude that is free. The degrees of freedom are those of the one F whose mean is the mean of
    the two.
    """
    fit = fit_of(record).mag
    assert fit is not None
    scatter = [residual.rms * residual.leave_one_out for residual in (fit.magnitude, fit.dip)]
    free = [
        max(fit.attitudes * residual.rms / residual.leave_one_out, _LEAST_FREE) for residual in (fit.magnitude, fit.dip)
    ]
    mean = sum(each / (each - 2) for each in free) / 2
    return np.repeat(scatter, count), 2 * mean / (mean - 1)


def _fit_generalised(values: Array, design: Array, covariance: Array) -> tuple[Array, Array, float, Array]:
    """Return parameters, residuals, their weighted sum of squares and the parameters' covariance, by GLS."""
    root = np.linalg.cholesky(covariance)
    rows, whitened = np.linalg.solve(root, design), np.linalg.solve(root, values)
    size = np.linalg.norm(rows, axis=0)
    parameters = np.linalg.lstsq(rows / size, whitened, rcond=None)[0] / size
    spread = np.linalg.inv((rows / size).T @ (rows / size)) / np.outer(size, size)
    left = whitened - rows @ parameters
    return parameters, values - design[:, :2] @ parameters[:2], float(left @ left), spread
