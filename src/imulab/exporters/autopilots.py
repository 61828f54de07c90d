"""Records to the parameters of the autopilots PX4 and ArduPilot.

An offset and a scale of each axis, over temperature too.

Both programs subtract an offset that follows the temperature, clipped to a range, and multiply by a scale factor that
does not. So ``O(T) = S(T) b(T)`` of each axis becomes a cubic (least squares at 64 Chebyshev nodes), the scale the
reciprocal of the middle of S; what S and misalignment do over temperature is lost, and said in figures.

A record over temperature fills ``TC_A0_*`` too. Source: PX4 src/lib/sensor_calibration (Accelerometer.hpp,
Gyroscope.hpp), src/modules/temperature_compensation (TemperatureCompensation.cpp) and the QGroundControl parameter
file: lines vehicle, component, name, value, type with tabs between; type 6 is int32, 9 is float.

Source: ArduPilot AP_InertialSensor_Backend, _rotate_and_correct_accel (rotate, subtract the offset, scale; since
October 2015, pull request 3029: Copter 3.4, Plane 3.5); over temperature AP_InertialSensor_tempcal.cpp. Lines
``NAME,value``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from imulab.errors import OptionError
from imulab.exporters import ExportOptions
from imulab.exporters.matrices import FieldCorrection, ardupilot_rows, px4_rows, symmetric
from imulab.exporters.model import (
    AXES,
    NEGLIGIBLE,
    ROTATION_NOT_TOLD,
    UnitModel,
    accel_terms,
    check_si,
    gyro_terms,
    held_accelerometers,
    magnetometers_alone,
    one_unit,
    origin_of,
    refuse_raw,
    settle_losses,
    single_precision,
    write_one,
)
from imulab.exporters.texts import hash_comments
from imulab.procedures.registry import procedure_of
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.records.triads import AccelerometerLaws, text_in_g
from imulab.units import STANDARD_GRAVITY

# Common to both autopilots: offset and scale of each accelerometer, and offset of each gyroscope.


@dataclass(frozen=True)
class AutopilotCorrections:
    """``(raw - offset) * scale``, m/s^2, and ``raw - rest``, rad/s, on each axis, shape (3,); rest None without gyros.

    With the magnetometers, None where there are none, and comments on what is left out.
    """

    unit: UnitModel
    offset: Array
    scale: Array
    rest: Array | None
    mag: FieldCorrection | None
    lost: list[str]


def corrections(
    records: Sequence[Calibration], target: str, options: ExportOptions, check: Callable[[Array, Array], None]
) -> AutopilotCorrections:
    """Return the corrections that an autopilot can hold; `check` refuses offsets and scales out of its range.

    Raises
    ------
    OptionError
        The autopilot cannot hold the record.
    """
    unit = one_unit(records, target)
    refuse_raw(unit, target)
    accel, error, how = held_accelerometers(
        unit, lambda held: lambda output: (output - held.scale * held.bias) / held.scale, misalignment=False
    )
    offset, scale = accel.scale * accel.bias, 1 / accel.scale
    check(offset, scale)
    gyro = unit.gyro
    lost = settle_losses(
        target,
        (accel_terms(unit.accel, misalignment=True), error),
        gyro_terms(gyro, bias=False) if gyro is not None else ([], []),
        how=how,
        options=options,
    )
    mag = None
    if unit.mag is not None:
        mag, left_out = symmetric(unit.mag, target, options, turned=options.mag_mount == "external")
        lost += left_out
    return AutopilotCorrections(unit, offset, scale, None if gyro is None else gyro.scale * gyro.bias, mag, lost)


# Over temperature: a cubic of the offset in the temperature, and one scale.


_NODES = np.cos(np.pi * (np.arange(64) + 0.5) / 64)
_CORNERS = np.array([corner for corner in product((-1.0, 0.0, 1.0), repeat=3) if any(corner)])
_FORCES = STANDARD_GRAVITY * _CORNERS / np.linalg.norm(_CORNERS, axis=1)[:, None]


@dataclass(frozen=True)
class OffsetLaw:
    """``(raw - offset(T)) * scale``, m/s^2: offsets as cubics of ``T - reference``, rows of powers, (4, 3).

    Both are None of a record without accelerometers. `rest`: the same of the gyroscopes, rad/s, ``raw - rest(T)``, None
    without; `lost`: comments on what is left out; `origin`: where the numbers come from.
    """

    low: float
    high: float
    reference: float
    offset: Array | None
    scale: Array | None
    rest: Array | None
    lost: list[str]
    origin: list[str]


def offset_law(
    records: Sequence[Calibration], target: str, options: ExportOptions, reference: float | None = None
) -> OffsetLaw | None:
    """Return the offsets over temperature that an autopilot can hold, about `reference` or the middle of the range.

    None where no record is over temperature.

    Raises
    ------
    OptionError
        There is another record beside it, outputs are in counts or volts, or something is lost and that was not asked
        for.
    RecordError
        The record lacks a coefficient.
    """
    over = [record for record in records if procedure_of(record).over_temperature]
    if not over:
        return None
    if len(records) != 1:
        raise OptionError(f"{target}: a {over[0].procedure} record goes alone, found {len(records)} records")
    laws = procedure_of(over[0]).laws(over[0])
    if laws is None:
        return _law_of_rates(over[0], target, reference)
    check_si(target, "accelerometers", laws.unit)
    middle, half = 0.5 * (laws.low + laws.high), 0.5 * (laws.high - laws.low)
    about = middle if reference is None else reference
    temperature = middle + half * _NODES
    held = laws.parameters(temperature)
    design = ((temperature - about) / half)[:, None] ** np.arange(4)
    exact = held[:, 3:6] * held[:, :3]
    offset = np.linalg.lstsq(design, exact)[0]
    bent = float(np.abs(design @ offset - exact).max())
    scale = 2 / (held[:, 3:6].max(axis=0) + held[:, 3:6].min(axis=0))
    error = (laws.output(_FORCES, temperature) - (design @ offset)[:, None, :]) * scale - _FORCES
    slope = np.abs(np.diff(design @ offset, axis=0) / np.diff(temperature)[:, None]).max() * scale.max()
    size = half ** np.arange(4.0)[:, None]
    rest, costs, follows = _rest(over[0], target, temperature, design)
    if len(laws.knots) > 2:
        costs = [f"the bends of the bias beyond a cubic, up to {text_in_g(bent)}", *costs]
    lost = _settle(target, laws, error, float(slope), costs, options) + follows
    return OffsetLaw(
        laws.low,
        laws.high,
        about,
        offset / size,
        scale,
        None if rest is None else rest / size,
        lost,
        origin_of(over[0]),
    )


def _law_of_rates(record: Calibration, target: str, reference: float | None) -> OffsetLaw:
    """Return the offsets of a record of gyroscopes alone; accelerometers stay as they are."""
    low, high = record.model["range"]
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    about = middle if reference is None else reference
    temperature = middle + half * _NODES
    rest, costs, follows = _rest(record, target, temperature, ((temperature - about) / half)[:, None] ** np.arange(4))
    assert rest is not None
    kept = "gyroscopes alone, from rest: scale factors are not told, and what the autopilot has of accelerometers stays"
    return OffsetLaw(
        low, high, about, None, None, rest / half ** np.arange(4.0)[:, None], [kept, *costs, *follows],
        origin_of(record),
    )  # fmt: skip


def _rest(
    record: Calibration, target: str, temperature: Array, design: Array
) -> tuple[Array | None, list[str], list[str]]:
    """Return the gyroscopes' offset as coefficients of a design, the error from all that is left out, and a comment."""
    laws = procedure_of(record).gyro_laws(record)
    if laws is None:
        return None, [], []
    if laws.unit != "rad/s":
        raise OptionError(
            f"{target}: corrects rates in rad/s, but the record is for gyroscopes with outputs in {laws.unit}; fit "
            "without --with gyro"
        )
    triads = laws.at(temperature)
    exact = np.array([triad.scale * triad.bias for triad in triads])
    rest = np.linalg.lstsq(design, exact)[0]
    slope = np.abs(np.diff(design @ rest, axis=0) / np.diff(temperature)[:, None]).max()
    worst = max(triads, key=lambda triad: float(np.abs(triad.gain - np.eye(3)).sum(axis=1).max()))
    names, costs = gyro_terms(worst, bias=False)
    lost = [f"{' '.join(names)}, which changes outputs by {', '.join(costs)}"] if names else []
    if len(laws.knots) > 2:
        bent = np.degrees(3600 * np.abs(design @ rest - exact).max())
        lost.insert(0, f"the bends of the gyroscopes' bias beyond a cubic, up to {bent:.3g} deg/h")
    follows = f"the offset of the gyroscopes changes by up to {np.degrees(slope) * 3600:.3g} deg/h per K"
    return rest, lost, [follows]


def _settle(
    target: str, laws: AccelerometerLaws, error: Array, slope: float, costs: list[str], options: ExportOptions
) -> list[str]:
    """Refuse losses, or return and report the comments on them, with the errors from all that is left out."""
    span = f"from {laws.low:g} to {laws.high:g} degC"
    follows = [f"the offset changes by up to {text_in_g(slope)} per K {span}"]
    worst, left = float(np.abs(error).max()), list(costs)
    if worst > NEGLIGIBLE * STANDARD_GRAVITY:
        rms = float(np.sqrt(np.mean(error**2)))
        left.insert(
            0,
            "scale factor over temperature and misalignment, which changes outputs at 1 g by "
            f"{text_in_g(rms)} rms, up to {text_in_g(worst)}, {span}",
        )
    if not left:
        return follows
    what = "; ".join(left)
    if not options.lossy:
        raise OptionError(f"{target} cannot hold {what}; add --lossy to leave it out")
    options.tell(f"{target}: left out (lossy): {what}")
    return [f"left out (lossy): {what}", *follows]


# PX4 parameters: ``(raw - CAL_ACC0_OFF) * CAL_ACC0_SCALE`` in m/s^2, ``raw - CAL_GYRO0_OFF`` in rad/s, on each
# axis.


_INT32, _FLOAT = 6, 9  # MAV_PARAM_TYPE of MAVLink
_CAL_SCALES = (0.1, 3.0)  # as PX4's CAL_ACC_*SCALE takes
_LARGEST_ID = 2**31 - 1  # of PX4's CAL_ACC_ID, a signed 32-bit parameter
_PX4_THERMAL = (
    "corrected = (raw - X1 d - X2 d^2 - X3 d^3 - OFF) * SCALE, m/s^2, d = T - TREF, T in degC held within TMIN to TMAX",
    "PX4 takes a new temperature only where it has moved by more than 1 K; TC_A_ENABLE needs a reboot",
)
_PX4_RATES = "gyroscopes: the same with TC_G, TC_G0 and CAL_GYRO0, rad/s, without SCALE"
_PX4_RATES_ALONE = (
    "corrected = raw - X1 d - X2 d^2 - X3 d^3 - OFF, rad/s, d = T - TREF, T in degC held within TMIN to TMAX",
    "PX4 takes a new temperature only where it has moved by more than 1 K; TC_G_ENABLE needs a reboot",
)


_PX4_MAG = "magnetometers: corrected = ROT (K (raw - OFF)), gauss, K of SCALE and ODIAG"


def export_px4(records: Sequence[Calibration], folder: Path, options: ExportOptions) -> list[Path]:
    """Write ``imulab.params``.

    Raises
    ------
    OptionError
        PX4 cannot hold the record.
    """
    if (largest := max(options.device_id, options.mag_device_id)) > _LARGEST_ID:
        raise OptionError(f"px4: device id {largest}; expected at most {_LARGEST_ID}")
    alone = magnetometers_alone(records, "px4")
    if alone is not None:
        options = replace(options, mag_device_id=options.mag_device_id or options.device_id)
        held_mag, lost = symmetric(alone[1], "px4", options, turned=True)
        rows = px4_rows(held_mag, options, turned=False)
        return _write_px4(folder, origin_of(alone[0]), rows, [_PX4_MAG, ROTATION_NOT_TOLD, *lost], options)
    law = offset_law(records, "px4", options)
    if law is not None:
        return _write_px4(
            folder,
            law.origin,
            _px4_thermal_rows(law, options),
            [
                *(_PX4_RATES_ALONE if law.offset is None else _PX4_THERMAL),
                *([] if law.rest is None or law.offset is None else [_PX4_RATES]),
                *law.lost,
            ],
            options,
        )
    held = corrections(records, "px4", options, _check_px4)
    device = str(options.device_id)
    values: list[tuple[str, float | str]] = [("CAL_ACC0_ID", device)]
    values += [(f"CAL_ACC0_{a}OFF", v) for a, v in zip("XYZ", held.offset, strict=True)]
    values += [(f"CAL_ACC0_{a}SCALE", v) for a, v in zip("XYZ", held.scale, strict=True)]
    if held.rest is not None:
        values.append(("CAL_GYRO0_ID", device))
        values += [(f"CAL_GYRO0_{a}OFF", v) for a, v in zip("XYZ", held.rest, strict=True)]
    comments = ["corrected = (raw - OFF) * SCALE, m/s^2; gyroscopes: raw - OFF, rad/s; single precision"]
    if held.mag is not None:
        values += px4_rows(held.mag, options)
        comments += [_PX4_MAG]
    return _write_px4(folder, held.unit.origin, values, [*comments, *held.lost], options)


def _px4_thermal_rows(law: OffsetLaw, options: ExportOptions) -> list[tuple[str, float | str]]:
    device, rows = str(options.device_id), list[tuple[str, float | str]]()
    if law.offset is not None and law.scale is not None:
        _check_px4(law.offset[0], law.scale)
        rows = [*_over_temperature("A", law, law.offset, device), ("CAL_ACC0_ID", device)]
        rows += [(f"CAL_ACC0_{a}OFF", v) for a, v in zip("XYZ", law.offset[0], strict=True)]
        rows += [(f"CAL_ACC0_{a}SCALE", v) for a, v in zip("XYZ", law.scale, strict=True)]
    if law.rest is None:
        return rows
    rows += [*_over_temperature("G", law, law.rest, device), ("CAL_GYRO0_ID", device)]
    return rows + [(f"CAL_GYRO0_{a}OFF", v) for a, v in zip("XYZ", law.rest[0], strict=True)]


def _over_temperature(sensor: str, law: OffsetLaw, offset: Array, device: str) -> list[tuple[str, float | str]]:
    """Return ``TC_A0_*`` or ``TC_G0_*``, whose offset at the reference is in the calibration at one temperature."""
    rows: list[tuple[str, float | str]] = [(f"TC_{sensor}_ENABLE", "1"), (f"TC_{sensor}0_ID", device)]
    rows += [(f"TC_{sensor}0_{k}", v) for k, v in (("TREF", law.reference), ("TMIN", law.low), ("TMAX", law.high))]
    powers = np.vstack([np.zeros(3), offset[1:]])
    return rows + [(f"TC_{sensor}0_X{power}_{axis}", powers[power, axis]) for power in range(4) for axis in range(3)]


def _check_px4(offset: Array, scale: Array) -> None:
    for axis, value in zip(AXES, scale, strict=True):
        if not _CAL_SCALES[0] <= value <= _CAL_SCALES[1]:
            raise OptionError(
                f"px4: scale of axis {axis} is {value:.4g}; PX4 takes {_CAL_SCALES[0]} to {_CAL_SCALES[1]}"
            )


def _write_px4(
    folder: Path,
    origin: Sequence[str],
    values: Sequence[tuple[str, float | str]],
    remarks: Sequence[str],
    options: ExportOptions,
) -> list[Path]:
    """Write rows of name and value, texts as whole numbers, after comments on what they are."""
    rows = [
        (name, value, _INT32) if isinstance(value, str) else (name, single_precision(value), _FLOAT)
        for name, value in values
    ]
    unknown = [name for name, value in values if name.endswith("_ID") and value == "0"]
    by_option = {
        "--device-id": " ".join(name for name in unknown if name != "CAL_MAG0_ID"),
        "--mag-device-id": " ".join(name for name in unknown if name == "CAL_MAG0_ID"),
    }
    for option, names in by_option.items():
        if names:
            options.tell(f"px4: {names} = 0: PX4 ignores this calibration until it is the sensor's number ({option})")
    comments = [
        "PX4 parameters, " + origin[0],
        origin[1],
        "no axes are turned: the record's axes are taken as the sensor's; PX4's body frame is FRD (-g on z at rest)",
        *(
            f"device id 0: not known; PX4 ignores the calibration until {names} is that of the sensor"
            for names in by_option.values()
            if names
        ),
        *remarks,
        "",
        "Vehicle-Id Component-Id Name Value Type",
    ]
    lines = hash_comments(comments)
    lines += [f"1\t1\t{name}\t{value}\t{kind}" for name, value, kind in rows]
    if not all(np.isfinite(float(value)) for _, value, _ in rows):
        raise OptionError("px4: a parameter is beyond single precision")
    return write_one(folder, "imulab.params", lines)


# ArduPilot parameters: ``(raw - INS_ACCOFFS) * INS_ACCSCAL`` in m/s^2, ``raw - INS_GYROFFS`` in rad/s, on each
# axis.


_LARGEST_OFFSET = 3.5  # m/s^2, which ArduPilot accepts
_INS_SCALES = (0.8, 1.2)  # which ArduPilot accepts
_REFERENCE = 35.0  # degC about which ArduPilot's temperature polynomials are written
_ARDUPILOT_THERMAL = (
    "corrected = (raw - P(T) + P(CALTEMP) - OFFS) * SCAL, m/s^2, P = 1e-6 (ACC1 t + ACC2 t^2 + ACC3 t^3), t = T - 35,"
    " T in degC held within TMIN to TMAX",
    "ArduPilot's logs are corrected outputs: record the test with INS_TCAL1_ENABLE 0",
)
_ARDUPILOT_RATES_ALONE = (
    "corrected = raw - P(T) + P(CALTEMP) - OFFS, rad/s, P = 1e-6 (GYR1 t + GYR2 t^2 + GYR3 t^3), t = T - 35, T in degC "
    "held within TMIN to TMAX; ArduPilot measures OFFS again at each start unless INS_GYR_CAL is 0",
    "ENABLE 1 turns on the laws of accelerometers too, which are 0 unless set: ACC1 to ACC3",
    _ARDUPILOT_THERMAL[1],
)
_ARDUPILOT_RATES = (
    "gyroscopes: the same with GYR, GYR1_CALTEMP and GYROFFS, rad/s, without SCAL; ArduPilot measures GYROFFS again at "
    "each start unless INS_GYR_CAL is 0"
)


_AFTER_ORIENT = "of outputs after COMPASS_ORIENT, as ArduPilot logs them; the orientation is not told, and not written"
_ARDUPILOT_MAG = "magnetometers: corrected = K (raw + OFS) after ORIENT, mgauss; for 4.2 and later"


def export_ardupilot(records: Sequence[Calibration], folder: Path, options: ExportOptions) -> list[Path]:
    """Write ``imulab.param``.

    Raises
    ------
    OptionError
        ArduPilot cannot hold the record.
    """
    alone = magnetometers_alone(records, "ardupilot")
    if alone is not None:
        held_mag, lost = symmetric(alone[1], "ardupilot", options, turned=True)
        of_mag = ardupilot_rows(held_mag, options, turned=False)
        return _save_ardupilot(folder, origin_of(alone[0]), of_mag, [_ARDUPILOT_MAG, _AFTER_ORIENT, *lost])
    law = offset_law(records, "ardupilot", options, _REFERENCE)
    if law is not None:
        return _save_ardupilot(
            folder,
            law.origin,
            _ardupilot_thermal_rows(law),
            [
                *(_ARDUPILOT_RATES_ALONE if law.offset is None else _ARDUPILOT_THERMAL),
                *([] if law.rest is None or law.offset is None else [_ARDUPILOT_RATES]),
                *law.lost,
            ],
        )
    held = corrections(records, "ardupilot", options, _check_ardupilot)
    rows: list[tuple[str, float]] = [(f"INS_ACCOFFS_{a}", v) for a, v in zip("XYZ", held.offset, strict=True)]
    rows += [(f"INS_ACCSCAL_{a}", v) for a, v in zip("XYZ", held.scale, strict=True)]
    if held.rest is not None:
        rows += [(f"INS_GYROFFS_{a}", v) for a, v in zip("XYZ", held.rest, strict=True)]
    if held.mag is not None:
        rows += ardupilot_rows(held.mag, options)
    comments = [
        "for Copter 3.4, Plane 3.5 and later: corrected = (raw - OFFS) * SCAL, m/s^2; older versions scale first",
        "gyroscopes: raw - OFFS, rad/s; ArduPilot measures these again at each start unless INS_GYR_CAL is 0",
        "ArduPilot's logs are corrected outputs: record the test with INS_ACCOFFS 0, INS_ACCSCAL 1 and INS_GYROFFS 0",
        *([_ARDUPILOT_MAG] if held.mag is not None else []),
        *held.lost,
    ]
    return _save_ardupilot(folder, held.unit.origin, rows, comments)


def _ardupilot_thermal_rows(law: OffsetLaw) -> list[tuple[str, float]]:
    caltemp = 0.5 * (law.low + law.high)
    rows = [("INS_TCAL1_ENABLE", 1.0), ("INS_TCAL1_TMIN", law.low), ("INS_TCAL1_TMAX", law.high)]
    if law.offset is not None and law.scale is not None:
        offset = (caltemp - law.reference) ** np.arange(4.0) @ law.offset
        _check_ardupilot(offset, law.scale)
        rows += [*_coefficients("ACC", law.offset), ("INS_ACC1_CALTEMP", caltemp)]
        rows += [(f"INS_ACCOFFS_{a}", v) for a, v in zip("XYZ", offset, strict=True)]
        rows += [(f"INS_ACCSCAL_{a}", v) for a, v in zip("XYZ", law.scale, strict=True)]
    if law.rest is None:
        return rows
    rows += _coefficients("GYR", law.rest)
    rows.append(("INS_GYR1_CALTEMP", caltemp))
    rest = (caltemp - law.reference) ** np.arange(4.0) @ law.rest
    return rows + [(f"INS_GYROFFS_{a}", v) for a, v in zip("XYZ", rest, strict=True)]


def _coefficients(sensor: str, powers: Array) -> list[tuple[str, float]]:
    return [
        (f"INS_TCAL1_{sensor}{power}_{a}", 1e6 * value)
        for power in (1, 2, 3)
        for a, value in zip("XYZ", powers[power], strict=True)
    ]


def _save_ardupilot(
    folder: Path, origin: Sequence[str], rows: Sequence[tuple[str, float]], remarks: Sequence[str]
) -> list[Path]:
    """Write rows of name and value after comments on what they are."""
    comments = [
        "ArduPilot parameters, " + origin[0],
        origin[1],
        "no axes are turned: the record's axes are taken as ArduPilot's body axes (FRD, after the board's rotation)",
        *remarks,
    ]
    lines = hash_comments(comments) + [f"{name},{single_precision(value)}" for name, value in rows]
    return write_one(folder, "imulab.param", lines)


def _check_ardupilot(offset: Array, scale: Array) -> None:
    for axis, s, o in zip(AXES, scale, offset, strict=True):
        if not _INS_SCALES[0] <= s <= _INS_SCALES[1]:
            raise OptionError(
                f"ardupilot: scale of axis {axis} is {s:.4g}; ArduPilot takes {_INS_SCALES[0]} to {_INS_SCALES[1]}"
            )
        if abs(o) > _LARGEST_OFFSET:
            raise OptionError(
                f"ardupilot: offset of axis {axis} is {o:.4g} m/s^2; ArduPilot takes at most {_LARGEST_OFFSET}"
            )
