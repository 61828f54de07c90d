"""How the magnetometers' outputs are scaled for the fit, and what is ready for it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from imulab.gravity import Gravity
from imulab.procedures.tumble.findings import Estimate
from imulab.procedures.tumble.mag.field import FieldMeans
from imulab.procedures.tumble.mag.model import MAGNETOMETERS
from imulab.procedures.tumble.mag.solve import Pair
from imulab.procedures.tumble.mag.start import Start, axes_of
from imulab.procedures.tumble.record import Scaling
from imulab.recording import Array


@dataclass(frozen=True)
class MagScaling:
    """Outputs are renamed by a signed permutation, less a zero, over a size: those of a field of length 1.

    Attributes
    ----------
    axes
        Row k names the output that becomes axis k, shape (3, 3).
    zero
        In renamed outputs, shape (3,).
    size
        Output per unit of the field.
    field
        Magnitude of the field, T; None where it is the unit.
    """

    axes: Array
    zero: Array
    size: float
    field: float | None

    def outputs(self, mean: Array) -> Array:
        """Return outputs, shape (n, 3), scaled."""
        scaled: Array = (mean @ self.axes.T - self.zero) / self.size
        return scaled

    def covariance(self, matrices: Array) -> Array:
        """Return covariances of outputs, shape (n, 3, 3), scaled."""
        scaled: Array = self.axes @ matrices @ self.axes.T / self.size**2
        return scaled

    def in_si(self, theta: Array) -> tuple[Array, Array]:
        """Return the parameters as they stand in a record, shape (p,), and their derivatives by theta, (p, p).

        ``S = size s / F``, ``b = (zero + size z) / S``, ``k2 = theta / F``; misalignments are the same.
        """
        unit = 1.0 if self.field is None else self.field
        scale = self.size * theta[3:6] / unit
        bias = (self.zero + self.size * theta[:3]) / scale
        values = np.concatenate([bias, scale, theta[6:12], theta[12:] / unit])
        slope = np.diag(
            np.concatenate(
                [self.size / scale, np.full(3, self.size / unit), np.ones(6), np.ones(len(theta[12:])) / unit]
            )
        )
        slope[range(3), range(3, 6)] = -bias / theta[3:6]
        return values, slope


def nominal_mag(start: Start, magnitude: float | None) -> tuple[MagScaling, Array]:
    """Return the scaling of outputs, and the magnetometers' parameters where the fit starts, order 1, shape (12,)."""
    turned: Array = np.asarray(np.linalg.inv(start.matrix), dtype=np.float64)
    axes = axes_of(turned)
    renamed = axes @ turned
    size = float(np.abs(np.diag(renamed)).mean())
    scale = np.diag(renamed) / size
    off = (renamed / np.diag(renamed)[:, None])[tuple(np.transpose(MAGNETOMETERS))]
    return MagScaling(axes, axes @ start.hard_iron, size, magnitude), np.concatenate([np.zeros(3), scale, off])


@dataclass(frozen=True)
class Ready:
    """Both triads before the joint fit.

    Attributes
    ----------
    estimate, scaling, gravity
        The accelerometers by themselves, how they are scaled, and local gravity.
    means
        The magnetometers' outputs in all attitudes.
    kept
        Which of these are used, from 0.
    mag
        How the magnetometers are scaled.
    pair, start
        What is fitted, and from where.
    order, loss
        As asked for the accelerometers by themselves.
    notes
        What a user should know already.
    """

    estimate: Estimate
    scaling: Scaling
    gravity: Gravity
    means: FieldMeans
    kept: NDArray[np.intp]
    mag: MagScaling
    pair: Pair
    start: Array
    order: int | str
    loss: str
    notes: list[str] = field(default_factory=list)
