"""Attitudes from what people have: a file, a recording, a data frame, arrays, or means with their covariances."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from imulab.errors import DataError, OptionError
from imulab.procedures.inputs import as_recording
from imulab.procedures.tumble.attitudes import Attitudes
from imulab.procedures.tumble.segment import find_attitudes
from imulab.reading import Data, Reading, Sampling
from imulab.recording import Array

TumbleData: TypeAlias = Attitudes | Data
_SYMMETRIC = 1e-9


def as_attitudes(
    data: TumbleData,
    reading: Mapping[str, Any] | Reading | Sampling,
    function: Callable[..., Any],
    covariance: ArrayLike | None = None,
) -> Attitudes:
    """Return data as static attitudes.

    Parameters
    ----------
    data
        Attitudes; or data, in which they are found; without a time each row is one.
    reading
        How data are to be understood.
    function
        What was called with them, for messages.
    covariance
        Of the means, in the squared unit of the outputs, shape (3, 3) for all or (n, 3, 3), where rows are attitudes.

    Raises
    ------
    DataError
        The covariances are none, or of something else; and what `as_recording` and `find_attitudes` raise.
    OptionError
        They are given twice, or for a recording with time, which says itself what they are.
    """
    called = function.__name__
    if isinstance(data, Attitudes):
        for key, value in reading.items():
            if value is not None:
                raise OptionError(f"{called}: {key} does not go with attitudes, which were found already")
        found = data
    else:
        found = find_attitudes(as_recording(data, reading, function))
    if covariance is None:
        return found
    if found.covariance is not None:
        why = "std_* columns state it" if found.trace is None else "the recording itself says how certain they are"
        raise OptionError(f"{called}: covariance: {why}; expected means of attitudes without")
    return replace(found, covariance=_checked(covariance, len(found), called))


def _checked(covariance: ArrayLike, count: int, called: str) -> Array:
    """Return covariances of shape (n, 3, 3)."""
    try:
        given = np.asarray(covariance, dtype=np.float64)
    except (TypeError, ValueError):
        raise DataError(f"{called}: covariance: expected numbers") from None
    if given.shape not in ((3, 3), (count, 3, 3)):
        raise DataError(f"{called}: covariance: expected the shape (3, 3) or ({count}, 3, 3), found {given.shape}")
    matrices = np.array(np.broadcast_to(given, (count, 3, 3)))
    largest = np.abs(matrices).max(axis=(1, 2), initial=0.0)[:, None, None]
    if not np.isfinite(matrices).all() or (np.abs(matrices - matrices.swapaxes(1, 2)) > _SYMMETRIC * largest).any():
        raise DataError(f"{called}: covariance: expected symmetric matrices of finite numbers")
    if (np.linalg.eigvalsh(matrices) <= 0).any():
        raise DataError(f"{called}: covariance: expected positive definite matrices")
    return matrices
