"""The Allan deviation of samples at a rate, or of a column of a file, recording or data frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from os import PathLike
from typing import Annotated, Any, ClassVar, TypeAlias, Unpack

import numpy as np

from imulab.errors import DataError, OptionError, listed
from imulab.estimation import TAUS, noise_coefficients
from imulab.estimation.column_noise import FEWEST, bridged_samples, curves_and_noise, noise_columns, samples_noise
from imulab.estimation.noise_coefficients import NoiseCoefficients, coefficients_dict
from imulab.estimation.sampling import sampling_rate
from imulab.frames import is_frame, unmasked
from imulab.options import PROGRAM, READING, choice, parsed
from imulab.procedures.result import OWN_CLOCKS, Drawn, as_blocks, as_recording
from imulab.quantities import span
from imulab.recording import Array, Data, Part, Recording, Window, check_finite, is_large, on_disk
from imulab.report.traces import Exhibits, Figure, ReportTable, format_uncertain
from imulab.units import si_unit

Noise: TypeAlias = tuple[NoiseCoefficients | None, tuple[str, ...]]


def _no_noise() -> Noise:
    return None, ()


@dataclass(frozen=True, repr=False)
class AllanCurve(Drawn, noise_coefficients.DeviationCurve):
    """Allan deviation of a column, in SI, or of samples of an unknown unit.

    Attributes
    ----------
    tau
        Averaging times, s, shape (t,).
    deviation, standard_uncertainty
        Allan deviation and its standard uncertainty, in the unit of the samples, shape (t,).
    freedom
        Equivalent degrees of freedom, shape (t,).
    name, unit
        Name and unit of the samples.
    """

    name: str = "samples"
    unit: str = "1"
    _analyse: Callable[[], Noise] = _no_noise

    subject: ClassVar[str] = "Allan deviation"

    @cached_property
    def _noise(self) -> Noise:
        return self._analyse()

    @property
    def coefficients(self) -> NoiseCoefficients | None:
        """Noise coefficients of a sensor's column, as ``imulab allan`` prints them, or of samples without a column.

        Those of samples are estimated on first use. Other columns, and fewer than 50 samples, have none.
        """
        return self._noise[0]

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on the column, its rows and its coefficients, a sentence each."""
        return self._noise[1]

    def __repr__(self) -> str:
        from imulab.report.parameters import small_unit

        unit, factor = small_unit(self.unit).scale
        return self._text(factor, "" if self.unit == "1" else f" {unit}")

    def exhibits(self) -> Exhibits:
        """Return the coefficients, if there are any, the curve with its 95 % interval, and a table of it."""
        from imulab.report.noise_figures import allan_figure, coefficient_rows, coefficients_table
        from imulab.report.parameters import small_unit

        unit, factor = small_unit(self.unit).scale
        pairs = zip(self.deviation.tolist(), self.standard_uncertainty.tolist(), strict=True)
        rows = [
            [f"{tau:.6g}", *format_uncertain(deviation * factor, u * factor)]
            for tau, (deviation, u) in zip(self.tau.tolist(), pairs, strict=True)
        ]
        table = ReportTable(self.subject, "", ["averaging time, s", f"deviation, {unit}", "standard uncertainty"], rows)
        least = int(np.argmin(self.deviation))
        headline = (
            f"Allan deviation of {self.name} over {rows[0][0]} to {rows[-1][0]} s; least {' ± '.join(rows[least][1:])} "
            f"{unit} at {rows[least][0]} s."
        )
        items: list[Figure | ReportTable] = [allan_figure({self.name: vars(self)}, [self.name]), table]
        if self.coefficients is not None:
            its = {"unit": self.unit, **coefficients_dict(self.coefficients, self.unit)}
            items.insert(0, coefficients_table(coefficient_rows({"columns": {self.name: its}})))
        return Exhibits(headline, [], items)


def allan_deviation(
    data: Data,
    rate: float | None = None,
    taus: Annotated[str | Array, choice(TAUS)] = "octave",
    *,
    column: Annotated[str | None, PROGRAM] = None,
    window: Annotated[Window | None, parsed(span, "FROM:TO", unit="s"), READING] = None,
    **reading: Unpack[Part],
) -> AllanCurve:
    """Compute the overlapping Allan deviation of evenly spaced samples, and noise coefficients of a sensor's column.

    ``sigma^2(m / rate) = sum_k (x_{k+2m} - 2 x_{k+m} + x_k)^2 / (2 (m / rate)^2 (N - 2m))``, x the integral of the
    samples less their mean, N its length (NIST SP 1065). Of a column of 50 samples or more of a gyroscope or an
    accelerometer, rows that are no readings are bridged, and coefficients come with the curve, as ``imulab allan`` does
    it. With 50 samples or more without a column come coefficients, too; of these samples the few that are no numbers
    are bridged, and counted in the notes.

    Parameters
    ----------
    data
        Rate or specific force, shape (n,), n >= 3, in any unit; or a file, recording, data frame or arrays by name, of
        which one column is taken, in SI.
    rate
        Sampling rate, Hz, of samples without a time.
    taus
        dense: 24 a decade. ``octave``: m = 1, 2, 4 ...; or averaging times in s, shape (t,), which are rounded to whole
        numbers of samples.
    column
        Which column of several.
    window
        As for `fit_tumble`.
    reading
        How arrays and files are to be understood: `time`, `unit` or `units`; `layout`, `topic`, `instance`, `element`.

    Raises
    ------
    DataError
        Fewer than 3 samples, or samples that are not finite; of 50 or more of them, of a sensor's column or without
        one, more than 1 %.
    OptionError
        `taus` or `rate` cannot be used, or which column is meant is not said.

    Examples
    --------
    Readings that alternate by 1 differ by 2 from one to the next, and not at all in pairs:

    >>> import numpy as np
    >>> import imulab as il
    >>> curve = il.allan_deviation(np.tile([1.0, -1.0], 8), rate=10.0, taus=np.array([0.1, 0.2]))
    >>> curve.tau.tolist(), [round(float(each), 6) for each in curve.deviation]
    ([0.1, 0.2], [1.414214, 0.0])

    A column of a recording, which knows its rate:

    >>> still = il.simulate_array(experiment="static", duration=60.0)
    >>> il.allan_deviation(still, column="gyro_1").tau[:3].round(3).tolist()
    [0.01, 0.02, 0.04]
    >>> il.allan_deviation(still, column="gyro_1").coefficients.angle_random_walk.reason
    ''
    """
    if not isinstance(data, str | PathLike | Recording | Mapping) and not is_frame(data) and _is_line(data):
        if rate is None:
            raise OptionError("allan_deviation: samples without a time: expected rate=, in Hz")
        for name, value in {**reading, "column": column, "window": window}.items():
            if value is not None:
                raise OptionError(f"allan_deviation: {name} does not go with such data: samples have their rate alone")
        return _samples_curve(unmasked(data).astype(np.float64), rate, taus)
    stated: dict[str, Any] = {**reading, "rate": rate, "window": window}
    if isinstance(data, str | PathLike) and is_large(data):
        recording = on_disk(as_blocks(data, stated, allan_deviation, clock=OWN_CLOCKS)[0])
    else:
        recording = as_recording(data, stated, allan_deviation, clock=OWN_CLOCKS)
    clocks = recording.clocks
    names = [name for stamped in clocks.values() for name in stamped]
    chosen = column or (names[0] if len(names) == 1 else None)
    if chosen not in names:
        problem = "several columns" if column is None else f"no column {column!r}"
        raise OptionError(
            f"allan_deviation: {recording.name}: {problem}; expected column=, one of {listed(names, column)}"
        )
    recording = recording.stream(next(clock for clock, stamped in clocks.items() if chosen in stamped))
    unit = si_unit(recording.units[chosen])
    if chosen in noise_columns(recording) and len(recording) >= FEWEST:
        _, _, noises, notes = curves_and_noise(recording, [chosen], taus)
        its = noises[chosen]
        known = its.coefficients, tuple(notes)
        return AllanCurve(**vars(its.curve), name=chosen, unit=unit, _analyse=lambda: known)
    check_finite(recording, [chosen])
    curve = noise_coefficients.allan_deviation(recording.si(chosen), sampling_rate(recording)[0], taus)
    return AllanCurve(**vars(curve), name=chosen, unit=unit)


def _samples_curve(samples: Array, rate: float, taus: str | Array) -> AllanCurve:
    if len(samples) < FEWEST:
        return AllanCurve(**vars(noise_coefficients.allan_deviation(samples, rate, taus)))
    readings, notes = bridged_samples(samples, rate)
    curve = noise_coefficients.allan_deviation(readings, rate, taus)
    return AllanCurve(**vars(curve), _analyse=partial(_noise_of_samples, readings, rate, tuple(notes)))


def _noise_of_samples(samples: Array, rate: float, notes: tuple[str, ...]) -> Noise:
    noise, more = samples_noise(samples, rate)
    return noise.coefficients, (*notes, *more)


def _is_line(data: object) -> bool:
    """Return whether data are a sequence of numbers."""
    try:
        array = np.asarray(data)
    except ValueError:
        return False
    if array.dtype.kind not in "iufb":
        return False
    if array.ndim == 0:
        raise DataError(f"allan_deviation: data: expected samples, found the number {array}")
    return array.ndim == 1
