"""A simulated unit on a rate table: a run for each face and cycle, with its true parameters.

The equation of the model stands here a second time, so that fit and simulation do not share errors.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from imulab.display import Shown
from imulab.errors import OptionError, readable
from imulab.files import write_text
from imulab.gravity import EARTH, checked_latitude
from imulab.options import measure, text
from imulab.procedures.rate import AXES, RATES, parse_rates
from imulab.procedures.rate.schema import RateTest, Run, manifest_text
from imulab.quantities import fraction, in_si, whole
from imulab.recording import Array, Recording
from imulab.units import from_si
from imulab.writers import write_csv

_ACCELERATION = np.radians(200.0)  # rad/s^2, of the table
_LOWEST, _HIGHEST, _SHORTEST = 0.05, 2.0, 20.0  # Hz and s, of a sweep
_MOST_SAMPLES, _MOST_RUNS = 1e7, 1000  # of a run, and of all
_FINER = 8  # points between samples at which the lag is integrated
_SCALE, _TILT, _ZERO = 5e-3, 3e-3, np.radians(0.3)


@dataclass(frozen=True, repr=False)
class RateRecordings(Shown):
    """The recordings of a simulated rate test and the manifest that names them.

    Attributes
    ----------
    test
        The test as its manifest states it.
    recordings
        The recording of each run.
    truth
        True parameters under the names of the record.
    """

    test: RateTest
    recordings: tuple[Recording, ...]
    truth: dict[str, float]

    def save(self, folder: str | Path) -> None:
        """Write the recordings, ``test.toml`` and ``truth.json`` into a folder, which is made."""
        where = Path(folder)
        with readable(folder):
            where.mkdir(parents=True, exist_ok=True)
        for run, recording in zip(self.test.runs, self.recordings, strict=True):
            write_csv(recording, where / run.file)
        write_text(where / "truth.json", json.dumps(self.truth, indent=1) + "\n")
        note = "simulated; the truth is in truth.json, in the units of the record"
        write_text(where / "test.toml", manifest_text(self.test, [note]))

    def shown(self) -> tuple[str, list[str], list[list[str]]]:
        """Return the headline and a table of the runs."""
        rows = [
            [run.file, run.mounting, f"{len(recording)}"]
            for run, recording in zip(self.test.runs, self.recordings, strict=True)
        ]
        return f"Rate test of {len(rows)} runs", ["file", "mounting", "samples"], rows


def simulate_rate(
    rates: Annotated[Sequence[float] | str, text("R,R,...", unit="deg/s")] = RATES,
    *,
    faces: Annotated[str, text("A,A,...")] = "+x,+y,+z",
    cycles: int | str = 1,
    hold: Annotated[float | str | None, measure("time", "s")] = None,
    noise: Annotated[float | str, measure("rate", "deg/s")] = "0.03 deg/s",
    rate: Annotated[float | str, measure("frequency", "Hz")] = "100 Hz",
    bend: Annotated[float | str, text("FRACTION")] = "0",
    loop: Annotated[float | str, text("FRACTION")] = "0",
    latitude: Annotated[float | str, measure("angle", "deg")] = "48 deg",
    table: Annotated[float | str, text("FRACTION")] = "0",
    sweep: Annotated[float | str | None, measure("time", "s")] = None,
    lag: Annotated[float | str, measure("time", "s")] = "0 s",
    seed: int | str = 1,
) -> RateRecordings:
    """Simulate a unit on a rate table: up through the rates, down, and the same the other way round, for each face.

    ``M = S (s + k3 s^3 + loop) + S b``, ``s = T w``, with the Earth's rate in w; or a sweep in place of the steps.

    Parameters
    ----------
    rates
        Sizes of the rates. In rad/s, or deg/s in a text.
    faces
        Body axes up along the table axis, one after the other.
    cycles
        Runs of each face.
    hold
        Time at each rate; 8 s if not given. In s.
    noise
        Standard deviation of one sample. In rad/s.
    rate
        Samples per second. In Hz.
    bend
        Largest part of k3, a fraction of the largest rate.
    loop
        Rising less falling at rate 0, a fraction of the largest rate.
    latitude
        Latitude of the place. In rad.
    table
        Standard deviation of what all rates are off by, a fraction.
    sweep
        Duration of a swept sine, 0.05 to 2 Hz, in place of steps. In s; a sine of the largest rate, and the table's
        rate is recorded.
    lag
        Time constant of the gyroscopes. Of a first-order lag, s.
    seed
        Seed of the random numbers.

    Raises
    ------
    OptionError
        An option cannot be used; the message says which.

    Examples
    --------
    >>> import imulab as il
    >>> len(il.simulate_rate(cycles=2, hold="1 s").recordings)
    6
    """
    sizes = np.unique(np.abs(parse_rates(rates, "rates") if isinstance(rates, str) else np.asarray(rates, dtype=float)))
    words = faces.split(",")
    if not all(len(word) == 2 and word[0] in "+-" and word[1] in AXES for word in words):
        raise OptionError(f"faces {faces!r}: expected body axes such as +x,+y,+z")
    if sweep is not None and hold is not None:
        raise OptionError("hold: a sweep rests at no rate; expected hold or sweep, not both")
    duration, period = in_si(hold or "8 s", "hold", "time", "s"), 1 / in_si(rate, "rate", "frequency", "Hz")
    spread = in_si(noise, "noise", "rate", "deg/s")
    place = checked_latitude(in_si(latitude, "latitude", "angle", "deg"))
    common, bent, split = fraction(table, "table"), fraction(bend, "bend"), fraction(loop, "loop")
    if sizes.size < 2 or not duration >= 1 or not 0 < period <= 0.1:
        raise OptionError("rates, hold, rate: expected two rates or more, a hold of 1 s or more, and 10 Hz or more")
    swept, constant = None if sweep is None else in_si(sweep, "sweep", "time", "s"), in_si(lag, "lag", "time", "s")
    _check_length(duration * (4 * sizes.size - 3), swept, period, whole(cycles, "cycles") * len(words))
    if not 0 <= constant <= 1:
        raise OptionError(f"lag {lag}: expected a time constant of 0 to 1 s")
    rng = np.random.default_rng(whole(seed, "seed"))
    scale, zero = 1 + _SCALE * rng.standard_normal(3), _ZERO * rng.standard_normal(3)
    turn = np.eye(3) + _TILT * rng.standard_normal((3, 3)) * (1 - np.eye(3))
    off = common * rng.standard_normal()
    k3 = bent / sizes[-1] ** 2
    way = np.concatenate([sizes, sizes[-2::-1], -sizes[1:], -sizes[-2::-1]])
    runs, recordings = [], []
    for word in words:
        for cycle in range(1, whole(cycles, "cycles") + 1):
            axis, sign = AXES.index(word[1]), 1.0 if word[0] == "+" else -1.0
            time, table_rate, rising = (
                _step_through(way, duration, period) if swept is None else _sweep_sine(float(sizes[-1]), swept, period)
            )
            body = np.zeros((len(time), 3))
            body[:, axis] = sign * (table_rate * (1 + off) + EARTH * np.sin(place))
            angle = np.cumsum(table_rate) * period
            body[:, (axis + 1) % 3] += EARTH * np.cos(place) * np.cos(angle)
            body[:, (axis + 2) % 3] -= EARTH * np.cos(place) * np.sin(angle) * sign
            along = body @ turn.T
            along = along + k3 * along**3
            along[:, axis] += sign * split * sizes[-1] / 2 * rising * (1 - (table_rate / sizes[-1]) ** 2)
            output = scale * (_lag(along, constant, period) + zero) + spread * rng.standard_normal(along.shape)
            name = f"{'np'[sign > 0]}{word[1]}_{cycle}.csv"
            recordings.append(_recording(time, output, name, None if swept is None else table_rate))
            runs.append(Run(name, word, tuple(way.tolist()) if swept is None else None, sweep=swept is not None))
    test = RateTest(tuple(runs), common, 0.0, 0.0, place, name="test.toml")
    return RateRecordings(test, tuple(recordings), _name_truth(scale, zero, turn, k3, swept and constant))


def _check_length(steps: float, swept: float | None, period: float, runs: int) -> None:
    """Refuse a sweep, s, that is too short, runs that are too long to be kept in memory, and too many of them."""
    if swept is not None and not (swept >= _SHORTEST and period <= 0.1 / _HIGHEST):
        raise OptionError(f"sweep, rate: expected {_SHORTEST:g} s or longer, and {_HIGHEST / 0.1:g} Hz or more")
    samples, option = (steps, "hold") if swept is None else (swept, "sweep")
    if samples / period > _MOST_SAMPLES:
        raise OptionError(f"{option}: {samples / period:.3g} samples in a run; expected at most {_MOST_SAMPLES:.0e}")
    if runs > _MOST_RUNS:
        raise OptionError(f"cycles: {runs} runs in all; expected at most {_MOST_RUNS}")


def _step_through(way: Array, hold: float, period: float) -> tuple[Array, Array, Array]:
    """Return time, the table's rate and whether it rose (1) or fell (-1) last, at a bounded acceleration."""
    times, rates = [0.0], [way[0]]
    for number, target in enumerate(way):
        times += [times[-1] + max(abs(target - rates[-1]) / _ACCELERATION, 1e-9)] if number else []
        rates += [target] if number else []
        times.append(times[-1] + hold)
        rates.append(target)
    time = np.asarray(np.arange(int(times[-1] / period)) * period, dtype=np.float64)
    table = np.interp(time, times, rates)
    step = np.sign(np.diff(way, prepend=way[0] - 1))
    part = np.searchsorted(np.array(times[1::2]), time)
    return time, np.asarray(table), np.asarray(step[np.minimum(part, len(step) - 1)])


def _sweep_sine(largest: float, duration: float, period: float) -> tuple[Array, Array, Array]:
    """Return time, the rate of a swept sine, whose frequency rises evenly, and whether it rises (1) or falls (-1)."""
    time = np.asarray(np.arange(int(duration / period)) * period, dtype=np.float64)
    phase = 2 * np.pi * (_LOWEST * time + (_HIGHEST - _LOWEST) * time**2 / (2 * duration))
    return time, np.asarray(largest * np.sin(phase)), np.sign(np.cos(phase))


def _lag(rate: Array, constant: float, period: float) -> Array:
    """Return smooth rates (n, 3) behind a first-order lag, by straight lines between finer samples."""
    if not constant:
        return rate
    from scipy.interpolate import CubicSpline
    from scipy.signal import lfilter

    step, count = period / _FINER, len(rate)
    fine = CubicSpline(np.arange(count), rate)(np.arange(_FINER * (count - 1) + 1) / _FINER)
    kept, mean = np.exp(-step / constant), -np.expm1(-step / constant) * constant / step
    # The state before is that of a unit that has long turned at the first rate.
    lagging, _ = lfilter([1 - mean, mean - kept], [1.0, -kept], fine, axis=0, zi=mean * fine[:1])
    return np.asarray(lagging[::_FINER])


def _recording(time: Array, output: Array, name: str, table: Array | None) -> Recording:
    columns = {"time": time, **{f"gyro_{a}": from_si(output[:, k], "deg/s") for k, a in enumerate(AXES)}}
    if table is not None:
        columns["table_rate"] = from_si(table, "deg/s")
    return Recording(columns, {key: "s" if key == "time" else "deg/s" for key in columns}, {"serial": "SIM"}, name=name)


def _name_truth(scale: Array, zero: Array, turn: Array, k3: float, delay: float | None) -> dict[str, float]:
    parameters = {f"gyro_bias_{a}": float(zero[i]) for i, a in enumerate(AXES)}
    parameters |= {f"gyro_scale_factor_{a}": float(from_si(scale[i], "deg/s")) for i, a in enumerate(AXES)}
    parameters |= {
        f"gyro_misalignment_{a}{b}": float(turn[i, j]) for i, a in enumerate(AXES) for j, b in enumerate(AXES) if i != j
    }
    parameters |= {} if delay is None else {f"gyro_delay_{a}": delay for a in AXES}
    return parameters | {f"gyro_k3_{a}": float(k3) for a in AXES}
