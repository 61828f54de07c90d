"""The gyroscope triad from what people have: data to a record of both triads."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from typing import Any, Unpack

from imulab.earth import at_latitude
from imulab.procedures.inputs import Record, as_record, as_recording
from imulab.procedures.result import Result
from imulab.procedures.tumble import gyro
from imulab.procedures.tumble.gyro import GyroFit
from imulab.procedures.tumble.gyrorecord import with_gyro
from imulab.procedures.tumble.segment import find_attitudes
from imulab.quantities import in_si
from imulab.reading import Data, Reading
from imulab.records.calibration import Calibration


@dataclass(frozen=True, repr=False)
class BothTriads(Result):
    """Result of `fit_gyro`: the record of both triads, and what was found of the gyroscopes."""

    calibration: Calibration
    gyro: GyroFit


def fit_gyro(
    accel: Record,
    data: Data,
    *,
    accel_data: Data | None = None,
    fit_bias: bool = False,
    g_sensitivity: str = "auto",
    clock: float | str = "50 ppm",
    clock_of: str = "gyro",
    noise: Record | None = None,
    latitude: float | str | None = None,
    **reading: Unpack[Reading],
) -> BothTriads:
    """Calibrate a gyroscope triad from the turns between static attitudes.

    ``M = S (T w + b + G f)``: between two attitudes the turn that the gyroscopes see must carry the first direction of
    gravity into the second (Tedaldi, Pretto, Menegatti, ICRA 2014); at rest ``M = S (b + G f)``.

    Parameters
    ----------
    accel
        Tumble record of the accelerometers, or its file.
    data
        A file, recording, data frame or arrays by name with time and both triads, or the gyroscopes alone.
    accel_data
        The same of the accelerometers, on the same clock, where they are not in `data`.
    fit_bias
        Fit the biases to the turns too, instead of taking them from the outputs at rest.
    g_sensitivity
        Whether the zero changes with specific force: ``yes``, ``no``, or ``auto`` where the data show it.
    clock
        Relative standard uncertainty of the rate of the clock: common to the three scale factors.
    clock_of
        Whose time counts where the two triads have clocks of their own: ``gyro`` or ``accel``.
    noise
        Record of `fit_noise` of the same gyroscopes, or its file: the biases are no more certain than it says of a mean
        over the time at rest.
    latitude
        Of the place, rad or a text such as ``"48.1 deg"``: the vertical part of the Earth's rate is taken off the
        outputs at rest. Without it that counts as g-sensitivity or scatter, as the level part always does.
    reading
        How arrays and files are to be understood: `rate` or `time`, `unit` or `units`; `layout`, `topic`, `instance`,
        `window`, `element`.

    Raises
    ------
    RecordError
        `accel` is no tumble record, or `noise` no noise record of these gyroscopes.
    SegmentError
        Fewer than eight turns between attitudes.
    DataError
        The columns are missing or not finite, or the gyroscopes do not turn as gravity does.
    ObservabilityError
        The turns cannot separate the parameters.
    OptionError
        `g_sensitivity`, `clock`, `clock_of` or `latitude` has a value that cannot be.

    Examples
    --------
    >>> import imulab as il
    >>> recording = il.simulate_tumble(gravity=9.81)
    >>> accelerometers = il.fit_tumble(recording, order=1, gravity=9.81).calibration
    >>> both = il.fit_gyro(accelerometers, recording).calibration
    >>> truth = float(recording.metadata["truth_gyro_scale_factor_x"])
    >>> abs(both.parameters["gyro_scale_factor_x"].value / truth - 1) < 1e-3
    True
    """
    known = as_record(accel, "fit_gyro: accel")
    recording = as_recording(data, reading, fit_gyro, lambda samples: {"gyro": samples})
    own = recording
    if accel_data is not None:
        named = isinstance(accel_data, str | PathLike)
        given: dict[str, Any] = {key: reading.get(key) for key in ("layout", "element") if named}
        own = as_recording(accel_data, given, fit_gyro, name="accel_data")
    found = gyro.fit_gyro(
        known, find_attitudes(own), recording, fit_bias=fit_bias, sensitivity=g_sensitivity,
        clock=in_si(clock, "clock", "number", "ppm"), clock_of=clock_of,
        noise=None if noise is None else as_record(noise, "fit_gyro: noise"), earth=at_latitude(latitude),
    )  # fmt: skip
    return BothTriads(with_gyro(known, found, recording, own), found)
