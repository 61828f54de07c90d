"""Local gravity, the magnetic field of a place, and the Earth's rate in a unit at rest.

Gravity is as stated, normal gravity on and above the WGS 84 ellipsoid, or what a recording's head says.

Source: NIMA TR8350.2 (World Geodetic System 1984), third edition, equations 4-1 (Somigliana) and 4-3
(second-order free-air); constants from its tables 3.3 and 3.4. The magnetic field is the World Magnetic Model's, by
pygeomag.
"""

from __future__ import annotations

import math
import numbers
import re
from typing import TYPE_CHECKING, Annotated, TypeAlias, TypeVar

from msgspec import Struct

from imulab.display import Finding, Note
from imulab.errors import DataError, OptionError, install, quoted
from imulab.options import Group, parsed, text
from imulab.quantities import in_si, number, quantity, with_uncertainty
from imulab.units import STANDARD_GRAVITY, from_si, parse_unit

if TYPE_CHECKING:
    from imulab.recording import Recording


# Local gravity.


_EQUATORIAL_GRAVITY = 9.7803253359  # m/s^2
_SOMIGLIANA_K = 0.00193185265241  # of WGS 84, as all constants of the normal gravity
_ECCENTRICITY_SQUARED = 0.00669437999013  # of WGS 84
_SEMI_MAJOR_AXIS = 6378137.0  # m
_FLATTENING = 1.0 / 298.257223563  # of WGS 84
_M = 0.00344978650684  # omega^2 a^2 b / GM

ANOMALY = 3.5e-4
"""Standard uncertainty of normal gravity, m/s^2: 35 mGal, about the rms of free-air anomalies over the Earth."""
_UNKNOWN_HEIGHT = 400.0
"""Standard uncertainty of an unstated height, m: most people live lower than 500 m."""
_FREE_AIR = 3.086e-6  # 1/s^2
_ANYWHERE = 0.0265 / math.sqrt(3)
"""Standard uncertainty of standard gravity, m/s^2: all values from equator to pole (9.780 to 9.832) are possible."""
_TOLD_APART = 3e-6
"""Relative; far below any scale factor's uncertainty; a height of 10 m."""
_POSSIBLE = (0.5, 50.0)
"""Range of the gravity of any place, m/s^2: from a small moon's to twice Jupiter's."""
_ON_EARTH = (9.76, 9.84)  # m/s^2, with mountains and the poles
_ROUNDED = 1e-5  # m/s^2: half of the last digit of a value that is stated well enough to count as exact
_USELESS = 0.01
"""Half of the last digit, m/s^2, above which a stated value counts as rounded."""
_TO_MICRO = 1e6  # to ppm


_EXACT = "argument, taken as exact"
"""Origin of a value that was typed without an uncertainty, to five decimals or more."""

_NORMAL = "normal gravity"
"""Beginning of the origin of a value that was computed from a place."""


class Gravity(Struct, frozen=True):
    """Local gravity and its standard uncertainty, m/s^2, the origin of the value, and remarks."""

    value: float
    origin: str
    standard_uncertainty: float = 0.0
    note: str = ""

    @property
    def name(self) -> str:
        """Name that records with this gravity share: its error is the same in all of them."""
        return f"gravity {self.value!r} +- {self.standard_uncertainty!r} m/s^2"

    @property
    def option(self) -> float | str:
        """What ``--gravity`` takes to be this again: the number alone where no uncertainty of it was stated."""
        exact = not self.standard_uncertainty and self.origin != "argument"
        return self.value if exact else f"{self.value!r}+-{self.standard_uncertainty!r}"


Given = TypeVar("Given")


_GROUP = Group("gravity")
LocalGravity: TypeAlias = Annotated[float | str | Gravity | None, text("G", unit="m/s^2"), _GROUP]
Latitude: TypeAlias = Annotated[float | str | None, text("DEG", unit="deg"), _GROUP]
Height: TypeAlias = Annotated[float | str | None, text("M", unit="m"), _GROUP]


def local_gravity(stated: float | str | Gravity | None, recording: Recording) -> Gravity:
    """Return the stated gravity, else that in the recording's head, else standard gravity.

    Raises
    ------
    OptionError
        The value cannot be the gravity of any place.
    """
    if stated is None:
        local = _gravity_in_head(recording) or Gravity(
            STANDARD_GRAVITY,
            "standard gravity, none given",
            _ANYWHERE,
            f"no local gravity was given: standard gravity {STANDARD_GRAVITY} m/s^2 was used, and every scale factor "
            f"inherits its difference from the local value (0.5 % from pole to equator; {100 * _ANYWHERE / 9.8:.2g} % "
            "is in its uncertainty); give --gravity, or --latitude and --height",
        )
    elif isinstance(stated, str):
        local = stated_gravity(stated, "gravity")
    elif isinstance(stated, Gravity):
        local = stated
    elif isinstance(stated, numbers.Real):
        local = Gravity(float(stated), _EXACT)
    else:
        raise OptionError(f"gravity {quoted(stated)}: expected a number, m/s^2, or a text such as '9.81362+-0.00002'")
    _check_possible(local.value)
    return local


def _check_possible(value: float) -> None:
    low, high = _POSSIBLE
    if not low < value < high:
        raise OptionError(f"gravity {value:g}: expected the local value in m/s^2, about 9.78 to 9.83 on Earth")


def gravity_findings(gravity: Gravity, recording: Recording) -> list[str]:
    """Return findings on the gravity that was used, a sentence each."""
    head = _gravity_in_head(recording)
    if head is not None:
        allowed = _TOLD_APART * head.value + 2 * gravity.standard_uncertainty
        if abs(gravity.value - head.value) > allowed:
            stated = (
                "the place (--latitude and --height, or --place)" if gravity.origin.startswith(_NORMAL) else "--gravity"
            )
            return [
                Finding(
                    f"gravity {gravity.value:.6g} m/s^2 was used, but the head of {recording.name} says "
                    f"{head.value:.6g} m/s^2: scale factors differ by "
                    f"{_TO_MICRO * (head.value / gravity.value - 1):+.0f} ppm between the two",
                    f"correct the gravity in the head of the file, or leave {stated} out",
                )
            ]
    low, high = _ON_EARTH
    if not low <= gravity.value <= high:
        return [
            Finding(
                f"gravity {gravity.value:g} m/s^2 is found nowhere on Earth ({low} to {high} m/s^2)",
                "state the local gravity (--latitude, --height)",
            )
        ]
    if head is not None and gravity.note and abs(gravity.value - head.value) > _TOLD_APART * head.value:
        other = f"the head of {recording.name} says {head.value:.6g} m/s^2 (--gravity keeps that)"
        return [Note(f"{gravity.note}; {other}")]
    return [gravity.note] if gravity.note else []


def gravity_option(
    gravity: str | None,
    latitude: float | str | None,
    height: float | str | None,
    label: str,
    *,
    beside: bool = False,
) -> Gravity | None:
    """Return the gravity that options state, or None; `label` makes the name of an option in messages (``"--{}"``).

    `beside` as for `at_place`.

    Raises
    ------
    OptionError
        An option is no quantity of its kind, is out of range, or does not go with another.
    """
    gravity_of_place = at_place(gravity, latitude, height, label, beside=beside)
    return (
        stated_gravity(gravity_of_place, label.format("gravity"))
        if isinstance(gravity_of_place, str)
        else gravity_of_place
    )


def at_place(
    gravity: Given,
    latitude: float | str | None,
    height: float | str | None,
    label: str = "{}",
    *,
    beside: bool = False,
) -> Given | Gravity:
    """Return normal gravity at a stated place, else `gravity`; errors as for `gravity_option`.

    Latitude in rad and height in m, or texts; the last digit of a text counts as rounded. `beside` says that the
    latitude tells the Earth's rate too, and so may stand beside a gravity, which then counts.
    """
    names = {name: label.format(name) for name in ("gravity", "latitude", "height")}
    if beside and gravity is not None and height is None:
        return gravity
    if gravity is not None and (latitude is not None or height is not None):
        raise OptionError(
            f"{names['gravity']} together with {names['latitude']} or {names['height']}: expected one or the other"
        )
    if latitude is None:
        if height is not None:
            raise OptionError(f"{names['height']} without {names['latitude']}: expected both")
        return gravity
    angle = in_si(latitude, names["latitude"], "angle", "deg")
    above = in_si(height, names["height"], "length", "m") if height is not None else 0.0
    value = normal_gravity(angle, above)
    half = min(_half_digit(latitude, "angle", "deg") if isinstance(latitude, str) else 0.0, math.pi / 2 - abs(angle))
    rounding = abs(normal_gravity(angle + half) - normal_gravity(angle - half)) / math.sqrt(12)
    unknown = 0.0 if height is not None else _UNKNOWN_HEIGHT * _FREE_AIR
    uncertainty = math.hypot(ANOMALY, rounding, unknown)
    where = f"{above:g} m" if height is not None else f"not given: 0 m ± {_UNKNOWN_HEIGHT:g} m"
    return Gravity(
        value,
        f"{_NORMAL} at latitude {math.degrees(angle):.6g} deg, height {where} (WGS 84)",
        uncertainty,
        Note(
            f"gravity {value:.6g} m/s^2 is normal gravity, from which that of a place differs: "
            f"{from_si(uncertainty, 'ug'):.3g} µg"
            + (" (the height was not given; --height lowers it)" if unknown else "")
            + " are part of every scale factor's uncertainty; a surveyed value (--gravity "
            "9.81362+-0.00002) does without"
        ),
    )


def stated_gravity(text: str, option: str) -> Gravity:
    """Return a text such as ``9.81362``, ``9.81362+-0.00002`` or ``9.81362 m/s^2 ± 20 ug`` as gravity.

    A value of fewer than five decimals without an uncertainty of its own counts as rounded: half of its last digit over
    the square root of 3 is its standard uncertainty.

    Raises
    ------
    OptionError
        It is none (the message begins with `option`), or cannot be the gravity of any place.
    """
    first, second = with_uncertainty(text)
    value = quantity(first, option, "acceleration", "m/s^2")
    _check_possible(value)
    if second is not None:
        uncertainty = quantity(second, f"{option} {text!r}, uncertainty", "acceleration", "m/s^2")
        if not 0 <= uncertainty < 0.1 * abs(value):
            raise OptionError(
                f"{option} {text!r}: expected a standard uncertainty of 0 or more, below a tenth of the value"
            )
        return Gravity(value, "argument", uncertainty)
    half = _half_digit(first, "acceleration", "m/s^2")
    if half <= _ROUNDED:
        return Gravity(value, _EXACT)
    uncertainty = half / math.sqrt(3)
    if uncertainty > _USELESS * value:
        raise OptionError(
            f"{option} {text!r}: gravity to {100 * uncertainty / value:.0f} % makes no scale factor; expected the "
            "local value in m/s^2, about 9.78 to 9.83 on Earth"
        )
    return Gravity(
        value,
        "argument, rounded",
        uncertainty,
        Note(
            f"gravity {value:.6g} m/s^2 counts as rounded: {_TO_MICRO * uncertainty / value:.3g} ppm are part of every "
            f"scale factor's uncertainty; give five decimals, or say how well it is known ({option} "
            f"{value:.6g}+-0.0001, +-0 if exact)"
        ),
    )


def _half_digit(text: str, kind: str, unit: str) -> float:
    """Return half of the last digit of a number with a unit, in SI; 0 for one with an exponent."""
    match = re.fullmatch(r"\s*[-+]?\d*\.?(\d*)\s*([^\d\s].*)?", text)
    if match is None:
        return 0.0
    return quantity(f"{0.5 * 10.0 ** -len(match[1]):.20f}{match[2] or ''}", "", kind, unit)


def _gravity_in_head(recording: Recording) -> Gravity | None:
    """Return the gravity in a comment ``# gravity: 9.81362 m/s^2`` of the recording, or None."""
    text = recording.metadata.get("gravity")
    if text is None:
        return None
    try:
        stated = stated_gravity(text, "gravity")
    except OptionError:
        return None
    relative = _TO_MICRO * stated.standard_uncertainty / stated.value
    size = f"{relative:.3g} ppm" if relative < 999.5 else f"{relative / 1e4:.2g} %"
    known = f" (± {size})" if relative else ""
    words = (
        f"gravity {stated.value:.6g} m/s^2{known} was taken from the head of {recording.name}, "
        "as no option gave another"
    )
    exact = ", taken as exact" * (stated.origin == _EXACT)
    return Gravity(stated.value, f"head of {recording.name}{exact}", stated.standard_uncertainty, Note(words))


def checked_latitude(latitude: float, name: str = "latitude") -> float:
    """Return a latitude, rad; a wrong one is refused with the words of `normal_gravity`, under this name."""
    if not isinstance(latitude, numbers.Real):
        raise OptionError(f"{name} {quoted(latitude)}: expected a number, in rad and m")
    if not abs(latitude) <= math.pi / 2 * (1 + 1e-12):
        degrees = 2 * math.pi < abs(latitude) <= 90.0
        hint = f'; numbers are rad, degrees are written "{latitude:g} deg"' if degrees else ""
        raise OptionError(f"{name} {math.degrees(latitude):g} deg: expected -90 to 90 deg{hint}")
    return latitude


def normal_gravity(latitude: float | str, height: float | str = 0.0) -> float:
    """Return the magnitude of normal gravity.

    ``gamma = gamma_e (1 + k sin^2 phi) / sqrt(1 - e^2 sin^2 phi)``, continued to the height h by
    ``1 - 2 (1 + f + m - 2 f sin^2 phi) h / a + 3 (h / a)^2``. The real gravity of a place differs from it by the
    local anomaly, typically 10 to 50 ug, rarely more than 200 ug (`ANOMALY` stands for it where it is not known).

    Parameters
    ----------
    latitude
        Geodetic latitude, rad, -pi/2 to pi/2; or a text as on the command line, ``"48.1 deg"``.
    height
        Height above the ellipsoid, m, -500 to 10000; or a text.

    Returns
    -------
    float
        Normal gravity, m/s^2.

    Raises
    ------
    OptionError
        Latitude or height out of range.

    Examples
    --------
    On the equator, at the poles, and a kilometre above the latitude of 45 degrees:

    >>> import math
    >>> import imulab as il
    >>> latitudes = (0.0, math.pi / 2, math.pi / 4)
    >>> [round(il.normal_gravity(at, height), 5) for at, height in zip(latitudes, (0.0, 0.0, 1000.0))]
    [9.78033, 9.83218, 9.80311]
    >>> round(il.normal_gravity("48.1 deg", "520 m"), 5)
    9.80739
    """
    latitude = checked_latitude(in_si(latitude, "latitude", "angle", "deg") if isinstance(latitude, str) else latitude)
    if isinstance(height, str):
        height = in_si(height, "height", "length", "m")
    if not isinstance(height, numbers.Real):
        raise OptionError(f"height {quoted(height)}: expected a number, in rad and m")
    if not -500.0 <= height <= 10000.0:
        raise OptionError(f"height {height:g} m: expected -500 to 10000 m")
    sine_squared = math.sin(latitude) ** 2
    on_ellipsoid = (
        _EQUATORIAL_GRAVITY * (1 + _SOMIGLIANA_K * sine_squared) / math.sqrt(1 - _ECCENTRICITY_SQUARED * sine_squared)
    )
    ratio = height / _SEMI_MAJOR_AXIS
    free_air = 1 - 2 * (1 + _FLATTENING + _M - 2 * _FLATTENING * sine_squared) * ratio + 3 * ratio**2
    return on_ellipsoid * free_air


# The Earth's rate in a unit at rest: along the vertical known by the latitude, across it of unknown heading.


EARTH = 7.292115e-5
"""Rate of the Earth, rad/s (WGS 84)."""


class EarthRate(Struct, frozen=True):
    """The Earth's rate at a latitude, rad: north of the equator it points up, south of it down."""

    latitude: float

    @property
    def vertical(self) -> float:
        """Its upward part, rad/s."""
        return EARTH * math.sin(self.latitude)

    @property
    def level(self) -> float:
        """Size of its level part, which points north, rad/s."""
        return EARTH * math.cos(self.latitude)

    def note(self) -> Note:
        """Return its entry in a record."""
        vertical, level = (f"{from_si(rate, 'deg/h'):.1f} deg/h" for rate in (self.vertical, self.level))
        return Note(
            f"gyro: of the Earth's rate at latitude {math.degrees(self.latitude):.4g} deg the vertical part, "
            f"{vertical}, was taken off; the level part, {level}, whose heading is unknown, is in the uncertainties"
        )


def at_latitude(latitude: float | str | None, name: str = "latitude") -> EarthRate | None:
    """Return the Earth's rate at a latitude, rad or a text, None where none is given; `name` is what messages call it.

    Raises
    ------
    OptionError
        It is no latitude.
    """
    return None if latitude is None else EarthRate(checked_latitude(in_si(latitude, name, "angle", "deg"), name))


# The magnetic field of a place and date.


_NANO, _KILO = 1e-9, 1e3
_FIELDS = (5e-6, 2e-4)
"""Magnitudes that the field can have near the Earth's surface, T: from a quarter of the least to thrice the most."""
_MODEL_YEARS = 2015, 2030
"""First year, and the one after the last, of the models that pygeomag carries with their uncertainties."""


class Site(Struct, frozen=True):
    """A place: geodetic latitude and longitude, rad, and height, m; None where it is not stated."""

    latitude: float
    longitude: float
    height: float | None = None


class ModelField(Struct, frozen=True):
    """Magnitude, T, dip and declination, rad, of the Earth's field by a model, each with its standard uncertainty.

    `model` names it, ``WMM-2025``, and `date` the day. The dip is positive where the field points down, the declination
    where it points east of true north.
    """

    magnitude: tuple[float, float]
    dip: tuple[float, float]
    declination: tuple[float, float]
    model: str
    date: str


def site(text: str, name: str = "place") -> Site:
    """Return the place of a text ``48.1,11.6`` or ``48.1,11.6,520``: latitude and longitude, deg, and height, m.

    Raises
    ------
    OptionError
        It is none; a latitude beyond 90 deg beside a longitude within is named as exchanged.
    """
    parts = text.split(",") if isinstance(text, str) else ()
    if len(parts) not in (2, 3):
        raise OptionError(
            f"{name} {quoted(text)}: expected latitude and longitude, deg, and perhaps the height, m: 48.1,11.6,520"
        )
    latitude, longitude, *height = (number(part.strip(), f"{name} {quoted(text)}") for part in parts)
    if 90 < abs(latitude) <= 180 and abs(longitude) <= 90:
        raise OptionError(
            f"{name} {quoted(text)}: latitude {latitude:g} deg is beyond 90: are latitude and longitude exchanged? "
            f"expected {longitude:g},{latitude:g}"
        )
    if not abs(latitude) <= 90:
        raise OptionError(f"{name} {quoted(text)}: latitude {latitude:g} deg: expected -90 to 90")
    if not abs(longitude) <= 180:
        raise OptionError(f"{name} {quoted(text)}: longitude {longitude:g} deg: expected -180 to 180")
    if height and not -500 <= height[0] <= 10000:
        raise OptionError(f"{name} {quoted(text)}: height {height[0]:g} m: expected -500 to 10000")
    return Site(math.radians(latitude), math.radians(longitude), height[0] if height else None)


def field_at(place: Site, date: str, name: str = "date") -> ModelField:
    """Return the field of the World Magnetic Model at a place, on a day such as ``2026-11-28``.

    The standard uncertainties are those of the model's error model, with the field of the crust; iron of a building is
    in none of them.

    Raises
    ------
    OptionError
        The text is no date, the models do not cover it, or the package with the models is not installed.

    Source: Chulliat et al., The US/UK World Magnetic Model for 2020-2025 (NOAA 2020), and that for 2025-2030.
    """
    from datetime import date as day_of

    try:
        day = day_of.fromisoformat(date.strip()[:10])
    except ValueError:
        raise OptionError(f"{name} {quoted(date)}: expected a day such as 2026-11-28") from None
    first, end = _MODEL_YEARS
    if not first <= day.year < end:
        raise OptionError(f"{name} {day}: the World Magnetic Models here cover the years {first} to {end - 1}")
    try:
        from pygeomag import GeoMag
    except ImportError:
        raise OptionError(
            f"the magnetic field of a place needs pygeomag, which is not here: {install('place')}"
        ) from None
    start = day_of(day.year, 1, 1).toordinal()
    year = day.year + (day.toordinal() - start) / (day_of(day.year + 1, 1, 1).toordinal() - start)
    model = GeoMag(base_year=day.year)
    field = model.calculate(
        glat=math.degrees(place.latitude),
        glon=math.degrees(place.longitude),
        alt=(place.height or 0.0) / _KILO,
        time=year,
    )
    known = field.calculate_uncertainty()
    return ModelField(
        (_NANO * field.f, _NANO * known.f),
        (math.radians(field.i), math.radians(known.i)),
        (math.radians(field.d), math.radians(known.d)),
        model.model,
        str(day),
    )


StatedSite: TypeAlias = Annotated[str | Site | None, parsed(site, "LAT,LON[,HEIGHT]", unit="deg, m"), _GROUP]


def of_place(
    place: str | Site | None,
    gravity: object,
    latitude: float | str | None,
    height: float | str | None = None,
    label: str = "{}",
) -> tuple[float | str | None, float | str | None]:
    """Return latitude and height: those of a stated place, else as stated; no height beside a stated gravity.

    Raises
    ------
    OptionError
        Latitude or height are stated beside the place.
    """
    if place is None:
        return latitude, height
    if latitude is not None or height is not None:
        names = [label.format(name) for name in ("place", "latitude", "height")]
        raise OptionError(f"{names[0]} together with {names[1]} or {names[2]}: expected one or the other")
    where = place if isinstance(place, Site) else site(place, label.format("place"))
    return where.latitude, None if gravity is not None else where.height


def stated_site(
    place: str | Site | None, date: str | None, latitude: float | str | None, height: float | str | None
) -> Site | None:
    """Return the place of a test; refuse what contradicts it, and a date without one."""
    if place is None:
        if date is not None:
            raise OptionError("date without place: expected both")
        return None
    if latitude is not None or height is not None:
        raise OptionError("place together with latitude or height: expected one or the other")
    return place if isinstance(place, Site) else site(place, "place")


def field_of_test(where: Site, date: str | None, recording: Recording) -> ModelField:
    """Return the model's field on the stated day, else on that in the head of the recording."""
    day = date or recording.metadata.get("date")
    if day is None:
        raise OptionError(
            f"place without date: the field changes with time, and the head of {recording.name} has no date; "
            "expected the day of the test, as 2026-11-28"
        )
    return field_at(where, day)


def field_note(field: ModelField) -> Note:
    """Return what a record says of a model's field."""
    return Note(
        f"mag: by {field.model} the field of the place has {1e6 * field.magnitude[0]:.2f} ± "
        f"{1e6 * field.magnitude[1]:.2f} uT, dip {math.degrees(field.dip[0]):.2f} ± {math.degrees(field.dip[1]):.2f} "
        f"deg, declination {math.degrees(field.declination[0]):+.2f} ± {math.degrees(field.declination[1]):.2f} deg; "
        "iron of a building may change each by more"
    )


def check_field_magnitude(length: float, unit: str, name: str, field: float | None) -> None:
    """Refuse a unit in which the magnitude of the outputs, `length`, cannot be that of the field, T.

    Raises
    ------
    DataError
        The unit is one of field, and the magnitude is off by a factor of 2 of what was stated, or nowhere on Earth.
    """
    known = parse_unit(unit)
    if known.quantity != "magnetic field":
        return
    tesla = length * known.factor
    low, high = (field / 2, 2 * field) if field is not None else _FIELDS
    if not low <= tesla <= high:
        expected = f"{1e6 * field:.4g} uT" if field is not None else "25 to 65 uT on Earth"
        raise DataError(
            f"{name}: columns mag_x mag_y mag_z: the field turns through {length:.4g} {unit} ({1e6 * tesla:.4g} uT), "
            f"expected {expected}: is the unit wrong?"
        )
