"""Residuals under a record parted in two: what a recording has in common, as power cycles have, and the rest."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imulab.estimation.least_squares import chi_square_probability
from imulab.procedures.thermal.degrees import tail
from imulab.procedures.thermal.rows import Rows
from imulab.recording import Array

_SEEN = 1e-6


def parted(
    rows: Rows, whole: Array, noise: Array, unknown: Array, rank: int | None, *, by_share: bool = True
) -> tuple[float | None, float | None]:
    """Return the probabilities of the residuals within recordings, and of what each has in common as an offset.

    `whole` and `noise` are covariances with and without laws and power cycles, `unknown` the columns of what each
    recording leaves free, (N, k). `rank` is that of the offsets that told the scatter between power cycles, 0 where it
    was stated; where it is None nothing is known of it, and what is in common is not tested. `by_share`: the more of an
    offset's variance is noise, the more degrees of freedom it has (Satterthwaite); a scatter that came out small by
    chance makes that share small, too, so that it errs where power cycles move outputs by more than noise does.
    """
    from scipy.linalg import solve_triangular

    factor = np.linalg.cholesky(whole)

    def white(columns: Array) -> Array:
        found: Array = solve_triangular(factor, columns, lower=True, check_finite=False)
        return found

    turns = _basis(white(unknown))
    offsets = white(rows.offsets[0])
    offsets = _basis(offsets - turns @ (turns.T @ offsets))
    residual = white(rows.residual)
    residual = residual - turns @ (turns.T @ residual)
    shared = offsets.T @ residual
    rest, spare = residual - offsets @ shared, len(residual) - turns.shape[1] - offsets.shape[1]
    within = chi_square_probability(float(rest @ rest), spare) if spare else None
    if rank is None or not len(shared):
        return within, None
    inner = white(white(noise).T)
    share = 1 - float(np.trace(offsets.T @ inner @ offsets)) / len(shared) if by_share else 1.0
    freedom = rank / max(share, 1e-3) ** 2 if rank else np.inf
    return within, tail(float(shared @ shared) / len(shared), len(shared), freedom)


def _basis(columns: Array) -> Array:
    """Return an orthonormal basis of the columns, shape (n, rank)."""
    if not columns.shape[1]:
        return columns
    u, values, _ = np.linalg.svd(columns, full_matrices=False)
    kept: NDArray[np.bool_] = values > _SEEN * max(float(values[0]), 1e-300)
    found: Array = u[:, kept]
    return found
