"""Normal gravity on and above the WGS 84 ellipsoid.

Source: NIMA TR8350.2 (World Geodetic System 1984), third edition, equations 4-1 (Somigliana) and 4-3
(second-order free-air); constants from its tables 3.3 and 3.4.
"""

from __future__ import annotations

import math

from imulab.errors import OptionError

_EQUATORIAL_GRAVITY = 9.7803253359  # m/s^2
_SOMIGLIANA_K = 0.00193185265241
_ECCENTRICITY_SQUARED = 0.00669437999013
_SEMI_MAJOR_AXIS = 6378137.0  # m
_FLATTENING = 1.0 / 298.257223563
_M = 0.00344978650684  # omega^2 a^2 b / GM


def normal_gravity(latitude: float, height: float = 0.0) -> float:
    """Return the magnitude of normal gravity.

    ``gamma = gamma_e (1 + k sin^2 phi) / sqrt(1 - e^2 sin^2 phi)``, continued to the height h by
    ``1 - 2 (1 + f + m - 2 f sin^2 phi) h / a + 3 (h / a)^2``. The real gravity of a place differs from it by the
    local anomaly, typically 10 to 50 ug, rarely more than 200 ug.

    Parameters
    ----------
    latitude
        Geodetic latitude, rad, -pi/2 to pi/2.
    height
        Height above the ellipsoid, m, -500 to 10000.

    Returns
    -------
    float
        Normal gravity, m/s^2.

    Raises
    ------
    OptionError
        Latitude or height out of range.
    """
    if not abs(latitude) <= math.pi / 2 * (1 + 1e-12):
        raise OptionError(f"latitude {math.degrees(latitude):g} deg: expected -90 to 90 deg")
    if not -500.0 <= height <= 10000.0:
        raise OptionError(f"height {height:g} m: expected -500 to 10000 m")
    sine_squared = math.sin(latitude) ** 2
    on_ellipsoid = (
        _EQUATORIAL_GRAVITY * (1 + _SOMIGLIANA_K * sine_squared) / math.sqrt(1 - _ECCENTRICITY_SQUARED * sine_squared)
    )
    ratio = height / _SEMI_MAJOR_AXIS
    free_air = 1 - 2 * (1 + _FLATTENING + _M - 2 * _FLATTENING * sine_squared) * ratio + 3 * ratio**2
    return on_ellipsoid * free_air
