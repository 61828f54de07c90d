"""Simulated logs at rest with stated noise, column by column and block by block."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from imulab.columns import triad
from imulab.errors import OptionError, RecordError
from imulab.estimation.noise.simulate import simulated
from imulab.options import measure, repeated, text
from imulab.procedures.noise.schema import Markov, by_name, fit_of, given_terms, term_unit
from imulab.procedures.result import Record, as_record
from imulab.quantities import in_si, whole
from imulab.recording import Array, Recording
from imulab.records.calibration import Calibration
from imulab.units import STANDARD_GRAVITY, from_si

RATE, DURATION = "100 Hz", "1 h"
_SHOWN = {"rad/s": "deg/s", "m/s^2": "m/s^2"}
_SENSORS = {"rad/s": "gyro", "m/s^2": "accel"}
_MOST_SAMPLES, _MOST_AT_ONCE = 1e11, 3e8  # of a simulated log; of one that is held in memory, all columns together
_NAME = re.compile(r"[A-Za-z]\w*")


@dataclass(frozen=True)
class NoiseLog:
    """A log to simulate: its noise by column, SI, in the order of `NAMES`, and the columns' SI units."""

    values: Mapping[str, Array]
    units: Mapping[str, str]
    rate: float
    count: int
    seed: int
    sensor: Mapping[str, str]

    def blocks(self) -> Iterator[Recording]:
        """Yield the log in blocks, of which no more than one is in memory."""
        interval = 1 / self.rate
        seeds = np.random.SeedSequence(self.seed).generate_state(len(self.values)).tolist()
        streams = [
            simulated(by_name(values), interval, self.count, seed)
            for values, seed in zip(self.values.values(), seeds, strict=True)
        ]
        shown = {name: _SHOWN.get(unit, unit) for name, unit in self.units.items()}
        start, axes = 0, triad("accel")  # all three at rest show gravity
        upright = axes[-1] if all(self.units.get(axis) == "m/s^2" for axis in axes) else None
        for parts in zip(*streams, strict=True):
            columns = {"time": np.arange(start, start + len(parts[0])) / self.rate}
            for (name, unit), part in zip(shown.items(), parts, strict=True):
                samples = part + STANDARD_GRAVITY if name == upright else part
                columns[name] = from_si(samples, unit) if unit in _SHOWN.values() else samples
            yield Recording(columns, {"time": "s", **shown}, self._head(), name="simulated log at rest")
            start += len(parts[0])

    def _head(self) -> dict[str, str]:
        head = {"model": "simulated noise", **self.sensor}
        for column, values in self.values.items():
            for term, value in by_name(values).items():
                head[f"truth_{column}_{term}"] = f"{value!r} {term_unit(term, self.units[column])}"
        return head


def noise_log(
    *,
    from_: Record | None,
    white: float | str | None,
    flicker: float | str | None,
    walk: float | str | None,
    quantisation: float | str | None,
    gm: Markov | Sequence[Markov] | None,
    rate: float | str | None,
    duration: float | str,
    columns: str | Sequence[str] | None,
    seed: int | str,
) -> NoiseLog:
    """Return a log to simulate; arguments and errors as for `simulate_noise`."""
    terms = {"white": white, "flicker": flicker, "walk": walk, "quantisation": quantisation, "gm": gm}
    names = read_names(columns)
    sensor: Mapping[str, str] = {}
    if from_ is None:
        unit = next((u for u, sensor in _SENSORS.items() if names and names[0].startswith(sensor)), None)
        stated = given_terms(unit or "rad/s", **terms)  # type: ignore[arg-type]
        if unit and stated.unit in _SENSORS and stated.unit != unit:
            raise OptionError(
                f"columns {' '.join(names or ())}: noise of an output in {stated.unit} is of no such sensor"
            )
        names = names or [f"{_SENSORS.get(stated.unit, 'gyro')}_{axis}" for axis in "xyz"]
        values, units = dict.fromkeys(names, stated.values), dict.fromkeys(names, stated.unit)
        hertz = in_si(RATE if rate is None else rate, "rate", "frequency", "Hz")
    else:
        for name, value in terms.items():
            if value not in (None, (), []):
                raise OptionError(f"{name}: the record says that already; expected either terms or a record")
        record = as_record(from_, "simulate_noise")
        values, units, record_rate = terms_of(record, names)
        sensor = {key: str(record.sensor[key]) for key in ("serial",) if key in record.sensor}
        hertz = record_rate if rate is None else in_si(rate, "rate", "frequency", "Hz")
    seconds, number = in_si(duration, "duration", "time", "s"), whole(seed, "seed")
    if not 1e-3 <= hertz <= 1e6:
        raise OptionError(f"rate {hertz:g} Hz: expected 0.001 to 1e6")
    if not 2 <= seconds * hertz <= _MOST_SAMPLES:
        raise OptionError(f"duration {seconds:g} s: expected 2 to {_MOST_SAMPLES:.0e} samples at {hertz:g} Hz")
    if number < 0:
        raise OptionError(f"seed {number}: expected a whole number from 0")
    return NoiseLog(values, units, hertz, round(seconds * hertz), number, sensor)


def terms_of(record: Calibration, names: Sequence[str] | None) -> tuple[dict[str, Array], dict[str, str], float]:
    """Return the chosen noise of a record's columns, SI, shape (8,) each, their SI units and the sampling rate, Hz.

    Raises
    ------
    RecordError
        The record is of another procedure.
    OptionError
        It has no such column.
    """
    if record.procedure != "noise":
        raise RecordError(f"from_: a {record.procedure} record; expected one of noise fit")
    fit = fit_of(record)
    for name in names or ():
        if name not in fit.columns:
            raise OptionError(f"columns {name}: the record has {' '.join(fit.columns)}")
    kept = list(names or fit.columns)
    values = {name: np.array(fit.columns[name].values) for name in kept}
    return values, {name: fit.columns[name].unit for name in kept}, fit.sample_rate.value


def read_names(columns: str | Sequence[str] | None) -> list[str] | None:
    """Return names of columns from a list or a text like ``gyro_x,gyro_y``; errors as for `simulate_noise`."""
    if columns is None:
        return None
    names = [name.strip() for name in columns.split(",")] if isinstance(columns, str) else list(columns)
    if not names or len(set(names)) < len(names) or not all(_NAME.fullmatch(name) for name in names):
        raise OptionError(f"columns {columns!r}: expected names of columns, each once, such as gyro_x,gyro_y")
    return names


def simulate_noise(
    *,
    white: Annotated[float | str | None, text("N")] = None,
    flicker: Annotated[float | str | None, text("B")] = None,
    walk: Annotated[float | str | None, text("K")] = None,
    quantisation: Annotated[float | str | None, text("Q")] = None,
    gm: Annotated[Markov | Sequence[Markov] | None, repeated("SIGMA:TIME")] = None,
    from_: Record | None = None,
    rate: Annotated[float | str | None, measure("frequency", "Hz")] = None,
    duration: Annotated[float | str, measure("time", "s")] = DURATION,
    columns: Annotated[str | Sequence[str] | None, text("A,A,...")] = None,
    seed: int | str = 1,
) -> Recording:
    """Simulate a log at rest of given noise about a level of 0, in the time domain.

    The terms are independent, and those of each column; `fit_noise` has their meaning. Texts have units, numbers are in
    SI: rad/s of a gyroscope, m/s^2 of an accelerometer.

    Parameters
    ----------
    white
        White noise, 0.3 deg/sqrt(h) or 100 ug/sqrt(Hz); SI without a unit. N, angle or velocity random walk,
        unit/sqrt(Hz).
    flicker
        1/f noise, such as 5 deg/h; SI without a unit. B, in the unit of the output.
    walk
        Random walk, such as 3 deg/h/sqrt(h); SI without a unit. K, rate or acceleration random walk, unit/sqrt(s).
    quantisation
        Quantisation of the angle, such as 1 arcsec; SI without a unit. Q, of the angle or velocity, unit s.
    gm
        Gauss-Markov noise, such as '20 deg/h:300 s'; once or twice; SI without units. Standard deviation and
        correlation time.
    from_
        In place of terms: those of a record of noise fit. Or its file, whose chosen models are simulated, column by
        column.
    rate
        Sampling rate; that of the record, or 100 Hz. In Hz.
    duration
        Duration of the log. In s.
    columns
        Those of the record, or three axes of the sensor. That the terms are of.
    seed
        Seed of the random numbers.

    Raises
    ------
    OptionError
        A value is out of range, or the log does not fit into memory: ``imulab noise simulate`` writes it in blocks.
    RecordError
        The record is of another procedure.

    Examples
    --------
    >>> import imulab as il
    >>> log = il.simulate_noise(white="0.3 deg/sqrt(h)", flicker="5 deg/h", duration="10 min")
    >>> len(log), list(log.columns)
    (60000, ['time', 'gyro_x', 'gyro_y', 'gyro_z'])

    Source: IEEE Std 952 (terms); Keshner (1982), 1/f noise as a sum of Gauss-Markov processes.
    """
    log = noise_log(
        from_=from_, white=white, flicker=flicker, walk=walk, quantisation=quantisation, gm=gm, rate=rate,
        duration=duration, columns=columns, seed=seed,
    )  # fmt: skip
    if log.count * (len(log.values) + 1) > _MOST_AT_ONCE:
        raise OptionError(
            f"duration {log.count / log.rate:g} s: {log.count} samples of {len(log.values)} columns at once; "
            "imulab noise simulate writes as many in blocks"
        )
    blocks = list(log.blocks())
    columns_ = {name: np.concatenate([block.columns[name] for block in blocks]) for name in blocks[0].columns}
    return Recording(columns_, blocks[0].units, blocks[0].metadata, name=blocks[0].name)
