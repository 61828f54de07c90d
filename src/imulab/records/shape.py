"""The shape of a record: what its parts are, so that a forged or damaged one is refused where it is read.

A shape is a test of a plain value, a mapping of keys to shapes (each key may be absent, others are ignored), or a list
of one shape and, if its length matters, a number or the name of a count that is the same throughout the record.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from imulab.errors import RecordError

LARGEST = 1e100
"""No quantity of a sensor is larger; squares and cubes of what is not are numbers."""


@dataclass(frozen=True)
class _Kind:
    """A plain value: what messages call it, and its test."""

    name: str
    fits: Callable[[Any], bool]


@dataclass(frozen=True)
class _Or:
    """A value of this shape, or null."""

    shape: Any


@dataclass(frozen=True)
class _Each:
    """A mapping of any names to values of one shape."""

    shape: Any


def _is_number(value: Any) -> bool:
    return type(value) in (int, float)


NUMBER = _Kind("a number", _is_number)
POSITIVE = _Kind("a number above 0", lambda value: _is_number(value) and value > 0)
SIZE = _Kind("a number of 0 or more", lambda value: _is_number(value) and value >= 0)
COUNT = _Kind("a whole number of 0 or more", lambda value: type(value) is int and 0 <= value < 2**53)
TEXT = _Kind("a text", lambda value: isinstance(value, str))
FLAG = _Kind("true or false", lambda value: type(value) is bool)
MAYBE = _Or(NUMBER)
QUANTITY = {"value": NUMBER, "unit": TEXT, "standard_uncertainty": _Or(SIZE)}
_LENGTH = {"value": SIZE, "unit": TEXT}
_TEMPERATURE = {"temperature": QUANTITY}
_ELEMENT_NUMBERS = {"value": NUMBER, "unit": TEXT}

_ATTITUDES = {
    "label": [TEXT, "attitudes"],
    "start": [MAYBE, "attitudes"],
    "stop": [MAYBE, "attitudes"],
    "samples": [_Or(COUNT), "attitudes"],
    "mean": [[NUMBER, 3], "attitudes"],
    "covariance": _Or([[[NUMBER, 3], 3], "attitudes"]),
    "force": [[NUMBER, 3], "attitudes"],
    "residual": [NUMBER, "attitudes"],
    "residual_before": [NUMBER, "attitudes"],
    "standard_uncertainty": _Or([MAYBE, "attitudes"]),
    "lengthening": _Or([NUMBER, "attitudes"]),
    "down_weight": [NUMBER, "attitudes"],
}
_TUMBLE = {
    "model": {
        "order": COUNT,
        "output_unit": TEXT,
        "gyro_output_unit": TEXT,
        "gravity": {**QUANTITY, "value": POSITIVE},
        **_TEMPERATURE,
    },
    "fit": {
        "rms": _LENGTH,
        "attitudes": COUNT,
        "degrees_of_freedom": NUMBER,
        "effective_degrees_of_freedom": _Or(SIZE),
        "coverage_factor_95": SIZE,
        "excess": _LENGTH,
        "noise": TEXT,
        "set_aside": [COUNT],
        "shared": _Each(_Each(NUMBER)),
    },
    "data": {"attitudes": _ATTITUDES, "trace": {"time": [NUMBER, "trace"], "deviation": [NUMBER, "trace"]}},
}
_ARRAY = {
    "model": {"kind": TEXT, "elements": COUNT, "axes": [TEXT, "axes"], "aligned": FLAG, "unit": TEXT, **_TEMPERATURE},
    "fit": {"sample_rate": {"value": POSITIVE, "unit": TEXT}, "duration": {"value": POSITIVE, "unit": TEXT}},
    "correlation": {
        "averaging_time": {"value": POSITIVE, "unit": TEXT},
        "matrix": [[[NUMBER, "elements"], "elements"], "axes"],
        "covariance": [[[NUMBER, "elements"], "elements"], "axes"],
        "standard_uncertainty": [[[NUMBER, "elements"], "elements"], "axes"],
        "weights": [[NUMBER, "elements"], "axes"],
        "limit": [_LENGTH, "axes"],
    },
}
_ROW = {"model": TEXT, "chosen": FLAG, "scales": [NUMBER], "training": [MAYBE, "axes"]}
_WARMUP = {
    "model": {"model": TEXT, "settling_time": {"value": POSITIVE, "unit": TEXT}, **_TEMPERATURE},
    "fit": {
        "axes": [TEXT, "axes"],
        "axis_units": [TEXT, "axes"],
        "exit_rms": [MAYBE, "axes"],
        "noise": [MAYBE, "axes"],
        "models": [_ROW],
    },
    "table": {
        "model": TEXT,
        "exit": TEXT,
        "beyond": TEXT,
        "tolerance": SIZE,
        "temperatures": [NUMBER],
        "axes": [TEXT, "axes"],
        "units": [TEXT, "axes"],
        "coefficients": [[[NUMBER, "terms"], "axes"], "rows"],
        "slopes": [[[NUMBER, "terms"], "axes"], "rows"],
        "settling_time": POSITIVE,
        "taper_time": POSITIVE,
        "time_scale": _Or(POSITIVE),
        "time_constants": [POSITIVE],
    },
    "data": {
        "cycles": [
            {
                "file": TEXT,
                "serial": _Or(TEXT),
                "power_on_temperature": NUMBER,
                "calibration_temperature": NUMBER,
                "settled_mean": [MAYBE, "axes"],
                "curve": [[MAYBE], "axes"],
            }
        ]
    },
}
_LINE = {"A": NUMBER, "B": NUMBER, "covariance": [[NUMBER, 2], 2], "unit": TEXT}
_CYCLE = {"power_cycle": NUMBER, "x": _Each(QUANTITY), "y": _Each(QUANTITY)}
_CENTRIFUGE = {
    "model": {"radius": QUANTITY, "gravity": QUANTITY, "reference": QUANTITY, **_TEMPERATURE},
    "fit": {
        "coverage_factor_95": _Each(NUMBER),
        "degrees_of_freedom": _Each(NUMBER),
        "power_cycles": [_CYCLE],
        "method": TEXT,
    },
    "levels": [
        {"level": COUNT, "specific_force": {"value": POSITIVE, "unit": TEXT}, "runs": [COUNT], "x": _LINE, "y": _LINE}
    ],
    "runs": [
        {"file": TEXT, "power_cycle": NUMBER, "role": TEXT, "sense": NUMBER, "specific_force": _LENGTH}
        | {"x": _LINE, "y": _LINE}
    ],
}
_SHAPES: dict[str, Any] = {"tumble": _TUMBLE, "gyro_array": _ARRAY, "warmup": _WARMUP, "centrifuge": _CENTRIFUGE}


def check_shape(content: Mapping[str, Any], procedure: str) -> None:
    """Check that the parts of a record are what its procedure writes, and that they fit each other.

    Raises
    ------
    RecordError
        One is not; the message names the place, what was expected and what was found.
    """
    _bounded(content, "")
    counts: dict[str, tuple[int, str]] = {}
    _check(content, _SHAPES.get(procedure, {}), "", counts)
    if procedure == "gyro_array" and "elements" in content:
        _check(content["elements"], [_element(content), "elements"], ".elements", counts)
    for axis, matrix in enumerate(content.get("correlation", {}).get("covariance", ())):
        if not all(row[i] > 0 for i, row in enumerate(matrix)):
            raise RecordError(f"correlation.covariance[{axis}]: expected variances above 0")


_SECTIONS: dict[str, dict[str, Any]] = {
    "tumble": {"output_unit": TEXT},
    "gyro": {"output_unit": TEXT},
    "centrifuge": {"axes": [TEXT], "highest": SIZE},
    "warmup": {"axes": [TEXT, "columns"], "units": [TEXT, "columns"], "range": [NUMBER, 2], "end": SIZE},
    "array": {"elements": COUNT, "axes": COUNT, "method": TEXT, "rate": POSITIVE},
}


def check_blob_text(text: Any, kinds: list[str]) -> None:
    """Check that what a blob says of its sections, of these kinds, in this order, is what `export` writes.

    Raises
    ------
    RecordError
        It is not; the message names the place.
    """
    counts: dict[str, tuple[int, str]] = {}
    _check(text, {"sensor": _Each(TEXT), "software": TEXT, "records": [TEXT], "sections": [{"kind": TEXT}]}, "", counts)
    _bounded(text, "")
    missing = [key for key in ("sensor", "software", "records", "sections") if key not in text]
    if missing:
        raise RecordError(f"its text lacks {missing[0]}")
    said = [section.get("kind") for section in text["sections"]]
    if said != kinds:
        raise RecordError(f"its text speaks of {' '.join(map(str, said))}, but it holds {' '.join(kinds)}")
    for number, section in enumerate(text["sections"]):
        shape = _SECTIONS[section["kind"]]
        absent = [key for key in shape if key not in section]
        if absent:
            raise RecordError(f"sections[{number}]: lacks {absent[0]}")
        _check(section, shape, f".sections[{number}]", counts)


def _element(content: Mapping[str, Any]) -> Any:
    """The shape of an array's element: numbers for one axis, lists over x, y, z for three."""
    axes = content.get("model", {}).get("axes")
    many = isinstance(axes, list) and len(axes) > 1
    noise = {
        "value": [MAYBE, "axes"] if many else MAYBE,
        "standard_uncertainty": [MAYBE, "axes"] if many else MAYBE,
        "unit": TEXT,
    }
    plain = {**noise, "value": [NUMBER, "axes"] if many else NUMBER}
    square = [[NUMBER, "axes"], "axes"]
    shape: dict[str, Any] = {"name": TEXT, "bias": plain, "scale_factor": QUANTITY}
    shape |= {"matrix": {"value": square, "standard_uncertainty": square, "unit": TEXT}}
    names = ("angle_random_walk", "bias_instability", "rate_random_walk", "quantisation")
    return shape | dict.fromkeys(names, noise)


def _bounded(value: Any, where: str) -> None:
    """Refuse numbers that no quantity has."""
    if isinstance(value, dict):
        for key, item in value.items():
            _bounded(item, f"{where}.{key}")
    elif isinstance(value, list):
        if value and set(map(type, value)) <= {float, int} and min(value) >= -LARGEST and max(value) <= LARGEST:
            return
        for index, item in enumerate(value):
            _bounded(item, f"{where}[{index}]")
    elif _is_number(value) and not -LARGEST <= value <= LARGEST:
        raise _wrong(where, f"a number of at most {LARGEST:g}", value)


def _check(value: Any, shape: Any, where: str, counts: dict[str, tuple[int, str]]) -> None:
    if isinstance(shape, _Kind):
        if not shape.fits(value):
            raise _wrong(where, shape.name, value)
    elif isinstance(shape, _Or):
        if value is not None:
            _check(value, shape.shape, where, counts)
    elif isinstance(shape, list):
        _check_list(value, shape, where, counts)
    else:
        if not isinstance(value, dict):
            raise _wrong(where, "named values", value)
        each = shape.shape if isinstance(shape, _Each) else None
        for key, item in value.items():
            if each is not None or key in shape:
                _check(item, shape[key] if each is None else each, f"{where}.{key}", counts)


def _check_list(value: Any, shape: list[Any], where: str, counts: dict[str, tuple[int, str]]) -> None:
    if not isinstance(value, list):
        raise _wrong(where, "a list", value)
    if len(shape) > 1:
        count, of = (shape[1], "") if isinstance(shape[1], int) else counts.setdefault(shape[1], (len(value), where))
        if len(value) != count:
            as_there = f", as {of.lstrip('.')} has" if of else ""
            raise RecordError(f"{where.lstrip('.')}: expected {count} entries{as_there}, found {len(value)}")
    if shape[0] is NUMBER and set(map(type, value)) <= {float, int}:
        return
    for index, item in enumerate(value):
        _check(item, shape[0], f"{where}[{index}]", counts)


def _wrong(where: str, expected: str, value: Any) -> RecordError:
    text = repr(value)
    return RecordError(
        f"{where.lstrip('.')}: expected {expected}, found {text if len(text) <= 60 else text[:57] + '...'}"
    )
