"""The Earth's rate in gyroscopes at rest: what is known of it, what all holds share, and what is new in each attitude.

Its vertical part v is the same along up in all holds, as a g-sensitivity is. Without a latitude v is one unknown of
all, of variance EARTH^2 / 3: the mean over all directions of the Earth's axis. The level part takes another heading in
each attitude; it is known by its size alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from imulab.earth import EARTH, EarthRate
from imulab.procedures.thermal.rows import one_hot
from imulab.recording import Array

VERTICAL = EARTH / np.sqrt(3)
"""Standard deviation of v without a latitude, rad/s; that of each level component is as large."""
_ASKEW = 0.03
"""Part of the Earth's rate that is sensed across itself: gyroscopes are askew, or their scale factors off, by that."""


def new_in_each(up: Array, earth: EarthRate | None) -> Array:
    """Return columns of unit variance for what each attitude has of its own, rad/s, shape (n, 3, 3); `up` is (n, 3)."""
    along = up[:, :, None] * up[:, None, :]
    level = VERTICAL if earth is None else earth.level / np.sqrt(2)
    found: Array = level * (np.eye(3) - along) + _ASKEW * EARTH * along
    return found


def earth_at_rest(force: Array, attitude: NDArray[np.int64], earth: EarthRate | None) -> tuple[Array, Array]:
    """Return what is known of the Earth's rate, (3 n,), and columns of unit variance for what is not, (3 n, k).

    Under specific forces (n, 3); `attitude` is the number of the attitude of each hold, (n,).
    """
    up = force / np.linalg.norm(force, axis=1, keepdims=True)
    own = np.einsum("nk,nij->nikj", one_hot(attitude), new_in_each(up, earth)).reshape(up.size, -1)
    if earth is None:
        return np.zeros(up.size), np.hstack([own, VERTICAL * up.reshape(-1, 1)])
    return (earth.vertical * up).ravel(), own
