"""Logs at rest to noise models, column by column."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from imulab.arguments import checked
from imulab.errors import DataError, OptionError, UnitError, listed, several
from imulab.estimation.column_noise import noise_columns
from imulab.estimation.noise.analysis import analysed, without_steps
from imulab.estimation.noise.choice import CANDIDATES
from imulab.estimation.noise.cleaning import PERHAPS
from imulab.estimation.noise.cosine import Stretch
from imulab.estimation.noise.regression import ramp_coefficients
from imulab.estimation.noise.rest import Rest, at_rest
from imulab.frames import is_frame
from imulab.procedures.noise.choices import HORIZON, NO_COVARIATE, SAY_STEPS, check_options
from imulab.procedures.noise.logs import given_log
from imulab.procedures.noise.model import ColumnModel, Drift
from imulab.procedures.noise.record import make_record
from imulab.procedures.options import names_of_columns
from imulab.procedures.result import Result
from imulab.quantities import in_si
from imulab.reading import Data, Reading
from imulab.recording import Array, Recording, Source
from imulab.records.calibration import Calibration
from imulab.units import parse_unit, si_unit

_SAME_RATE = 0.01


@dataclass(frozen=True, repr=False)
class NoiseFit(Result):
    """Result of a fit of noise models.

    Attributes
    ----------
    calibration
        The record.
    columns
        The models by column.

    Examples
    --------
    >>> import imulab as il
    >>> fit = il.fit_noise(il.simulate_noise(white="0.3 deg/sqrt(h)", rate=50.0, duration="10 min", columns=["gyro_z"]))
    >>> list(fit.columns)
    ['gyro_z']
    >>> list(fit.wants("kalibr"))
    ['gyroscope_noise_density', 'gyroscope_random_walk', 'update_rate']
    """

    calibration: Calibration
    columns: Mapping[str, ColumnModel]

    @checked
    def wants(self, for_: str, *, rate: float | str | None = None, step: float | str | None = None) -> dict[str, float]:
        """Return what a program's filter wants, by its own keys and in its own units, as ``noise fit --for`` prints it.

        Parameters
        ----------
        for_
            ``kalibr openvins vins px4 ardupilot gtsam ros matlab``.
        rate
            Samples per second that the program gets, Hz; those of the logs if not given.
        step
            Time between predictions of the filter, s; 10 ms of px4 and 12 ms of ardupilot if not given.

        Raises
        ------
        OptionError
            The program is not known, or `rate` or `step` is not above 0.
        RecordError
            No column is of a gyroscope or an accelerometer in SI.
        """
        from imulab.procedures.noise.wants import noise_for

        hertz = None if rate is None else in_si(rate, "rate", "frequency", "Hz")
        return noise_for(
            self.calibration, for_, rate=hertz, step=None if step is None else in_si(step, "step", "time", "s")
        )


def fit_noise(
    data: Data | Sequence[Data],
    *,
    terms: str = "auto",
    horizon: float | str | None = None,
    band: float | str | None = None,
    regress: str | None = NO_COVARIATE,
    columns: str | Sequence[str] | None = None,
    steps: str | None = SAY_STEPS,
    **reading: Unpack[Reading],
) -> NoiseFit:
    """Fit a model of the noise to every sensor column of logs at rest, by maximum likelihood of its spectrum.

    ``-2 ln L = sum_b d_b [ln lambda_b + P_b/lambda_b]``, P_b the mean square of the cosine coefficients in bin b, d_b
    their number, lambda_b their variance under the model: white noise N, 1/f noise B, random walk K, Gauss-Markov terms
    and quantisation.

    Parameters
    ----------
    data
        A log, or a list of logs of the same unit, whose likelihoods add up; each a file, recording, data frame or
        arrays.
    terms
        ``auto``, or the letters of the terms: N white, B 1/f, K random walk, G Gauss-Markov (GG for two), Q
        quantisation.
    horizon
        Time over which a filter predicts without aiding, s: the random walk for filters is that which predicts a mean
        over it; 10 s if not given, or the length of a shorter log.
    band
        Highest frequency to use, Hz; up to where the spectrum is flat if not given.
    regress
        ``time`` or ``temperature``: take out what follows it; ``no``: nothing.
    columns
        Which columns, as a list or a text such as ``"gyro_x,gyro_y"``; all outputs of sensors if not given.
    steps
        ``remove``: take changes of level out; ``say``: only say them.
    reading
        How arrays and files are to be understood: `rate` and `unit`; `layout`, `window` ...

    Raises
    ------
    DataError
        The unit moves, a column is constant or clipped, there are fewer than 500 samples, time does not rise.
    UnitError
        Units differ between logs.
    OptionError
        An option has a value that cannot be used.

    Examples
    --------
    White noise of .01 deg/s/sqrt(Hz) at 100 Hz, for 10 minutes:

    >>> import numpy as np
    >>> import imulab as il
    >>> rate = 0.1 * np.random.default_rng(1).standard_normal((60_000, 3))
    >>> fit = il.fit_noise({"gyro": rate}, rate=100.0, unit="deg/s")
    >>> bool(abs(np.degrees(fit.calibration.value("gyro_x_white")) - 0.01) < 2e-4)
    True

    Source: Whittle (1953); IEEE Std 952 and 647 (terms).
    """
    horizon = None if horizon is None else in_si(horizon, "horizon", "time", "s")
    band = None if band is None else in_si(band, "band", "frequency", "Hz")
    columns = names_of_columns(columns, "columns") if isinstance(columns, str) else columns
    check_options(terms, horizon, band, regress, steps)
    alone = isinstance(data, str | PathLike | Recording | Mapping | np.ndarray) or is_frame(data)
    several_logs = not alone and isinstance(data, list | tuple) and all(_is_log(each) for each in data)
    logs: list[Any] = list(data) if several_logs else [data]  # type: ignore[arg-type]
    if not logs:
        raise DataError("fit_noise: expected a log at rest, found an empty list")

    def named(samples: NDArray[Any]) -> Mapping[str, Any]:
        gyro = parse_unit(reading.get("unit") or "m/s^2").quantity == "rate"
        return {"gyro" if gyro else "accel": samples}

    sources: list[Source] = []

    def read() -> Iterator[Recording | Rest]:
        for each in logs:
            log = given_log(each, reading, fit_noise, lambda first: chosen_columns(first, columns), named)
            source = (log.recording if isinstance(log, Rest) else log).source
            sources.extend([source] if source is not None else [])
            yield log

    return fit_recordings(
        read(), terms=terms, horizon=horizon, band=band, regress=regress, columns=columns, steps=steps, sources=sources
    )  # fmt: skip


def _is_log(data: object) -> bool:
    return isinstance(data, str | PathLike | Recording | Mapping | np.ndarray) or is_frame(data)


def fit_recordings(
    recordings: Iterable[Recording | Rest],
    *,
    terms: str,
    horizon: float | None,
    band: float | None,
    regress: str | None,
    columns: Sequence[str] | None,
    steps: str | None,
    sources: Iterable[Source] = (),
) -> NoiseFit:
    """Fit noise models to the columns of recordings at rest, or of what is left of long ones: as `fit_noise`."""
    # A record holds what was asked for beyond the usual; old ones are fitted as they say.
    regress, steps = None if regress == NO_COVARIATE else regress, None if steps == SAY_STEPS else steps
    rests = read_rests(recordings, columns)
    names = chosen_columns(rests[0].recording, columns)
    longest = max(stop[1] - stop[0] for rest in rests for stop in rest.parts) * rests[0].interval
    if horizon is not None and horizon > longest:
        raise OptionError(
            f"horizon {horizon:g} s: expected at most the length of the record, {longest:.4g} s in one stretch"
        )
    temperatures = [rest.slow("temperature") for rest in rests]
    if regress == "temperature" and None in temperatures:
        where = rests[temperatures.index(None)].recording.name
        raise DataError(f"{where}: regress temperature: expected a column temperature that changes, found none")
    horizon = min(HORIZON, longest) if horizon is None else horizon
    candidates = CANDIDATES if terms == "auto" else (terms,)
    found = {name: _column(name, rests, temperatures, candidates, band, regress, steps == "remove") for name in names}
    options = {"terms": terms, "horizon": horizon, "band": band, "regress": regress, "steps": steps}
    record = make_record(found, rests, {**options, "columns": None if columns is None else names}, tuple(sources))
    return NoiseFit(record, found)


def chosen_columns(recording: Recording, columns: Sequence[str] | None) -> list[str]:
    """Return the names of the columns to fit.

    Raises
    ------
    OptionError
        One is not there.
    DataError
        There is no output of a sensor.
    """
    names = [name for name in recording.columns if name != "time"]
    if columns is not None:
        if not columns:
            raise OptionError("columns: expected one or more, found none")
        for name in columns:
            if name not in names:
                raise OptionError(f"{recording.name}: no column {name!r}; expected one of {listed(names, name)}")
        return list(columns)
    found = list(noise_columns(recording))
    if not found:
        raise DataError(
            f"{recording.name}: no sensor column (gyro_.. accel_.. dtg_.. fog); found {several(recording.columns)}"
        )
    return found


def read_rests(recordings: Iterable[Recording | Rest], columns: Sequence[str] | None) -> list[Rest]:
    """Return recordings of one unit as stretches at rest; errors as for `fit_noise`."""
    rests: list[Rest] = []
    for log in recordings:
        rest = log if isinstance(log, Rest) else at_rest(log, chosen_columns(log, columns))
        if rests:
            _check_alike(rests[0], rest, columns)
        rests.append(rest)
    return rests


def _check_alike(first: Rest, other: Rest, columns: Sequence[str] | None) -> None:
    name, one = other.recording.name, first.recording
    if abs(other.interval / first.interval - 1) > _SAME_RATE:
        raise DataError(
            f"{name}: {1 / other.interval:.4g} samples in a second, but {one.name} has {1 / first.interval:.4g}; "
            "expected logs of one rate"
        )
    names = chosen_columns(one, columns)
    if chosen_columns(other.recording, columns) != names:
        raise DataError(f"{name}: other columns than {one.name}; expected {several(names)}")
    for column in names:
        unit, expected = (si_unit(each.units[column]) for each in (other.recording, one))
        if unit != expected:
            raise UnitError(f"{name}: column {column} in {unit}, but {one.name} has it in {expected}")
    serials = [rest.recording.metadata.get("serial") for rest in (first, other)]
    if all(serials) and serials[0] != serials[1]:
        raise DataError(f"{name}: of unit {serials[1]}, but {one.name} is of {serials[0]}: expected logs of one unit")


def _column(
    name: str,
    rests: Sequence[Rest],
    temperatures: Sequence[list[Array] | None],
    candidates: tuple[str, ...],
    band: float | None,
    regress: str | None,
    flat: bool,
) -> ColumnModel:
    stretches = [each for rest in rests for each in rest.stretches(name)]
    spikes, lines = sum(each.spikes for each in stretches), _longest(stretches).lines
    analysis = analysed(stretches, candidates, band)
    found = analysis.steps(stretches, PERHAPS)
    if any(found):  # by noise that has no step: fitted to one, the model takes some of it for random walk
        without = analysed(without_steps(stretches, found), candidates, band)
        found = without.steps(stretches)
        analysis = analysed(without_steps(stretches, found), candidates, band) if flat and any(found) else analysis
    drifts = []
    for covariate, slow in _covariates(temperatures, analysis.stretches).items():
        regression = analysis.regressed(slow)
        taken, left = covariate == regress, analysis.letters
        if regression.follows or taken:
            left = analysed(regression.residual, candidates, band).letters
        drifts.append(Drift(covariate, regression, (analysis.letters, left), taken))
    for drift in drifts:
        if drift.taken:
            analysis = analysed(drift.found.residual, candidates, band)
    # Steps have the time of their log; those of several logs are told one after the other.
    return ColumnModel(
        name,
        si_unit(rests[0].recording.units[name]),
        analysis,
        spikes,
        tuple(knock for each in stretches for knock in each.knocks),
        lines,
        tuple(step for each in found for step in each),
        tuple(drifts),
    )


def _longest(stretches: Sequence[Stretch]) -> Stretch:
    return max(stretches, key=lambda each: each.count)


def _covariates(temperatures: Sequence[list[Array] | None], stretches: Sequence[Stretch]) -> dict[str, list[Array]]:
    """The slow coefficients of time, and of the temperature where all logs have one that changes, of each stretch."""
    found = {"time": [ramp_coefficients(each)[None] for each in stretches]}
    known = [each for each in temperatures if each is not None]
    if len(known) == len(temperatures):
        found["temperature"] = [each[None] for rest in known for each in rest]
    return found
