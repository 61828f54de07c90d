"""The dwells of a run on a rate table under noise, ripple, knocks, slow tables and coarse outputs: all of them."""

import numpy as np
import pytest

import imulab as il
from imulab.procedures.rate.dwells import find_dwells
from imulab.procedures.rate.schema import RateTest, Run
from reference.rate import DEGREE

UP = [0, 10, 50, 100, 200, 300]
WAY = [*UP, *UP[-2::-1], *(-r for r in UP[1:]), *(-r for r in UP[-2::-1])]
USUAL = {"density": 0.005, "hold": 8.0, "frequency": 100.0, "acceleration": 200.0}
CONDITIONS = {
    "1e-5 deg/s/sqrt(Hz)": {"density": 1e-5},
    "1e-4 deg/s/sqrt(Hz)": {"density": 1e-4},
    "1e-3 deg/s/sqrt(Hz)": {"density": 1e-3},
    "5e-3 deg/s/sqrt(Hz)": {},
    "0.02 deg/s/sqrt(Hz)": {"density": 0.02},
    "0.05 deg/s/sqrt(Hz)": {"density": 0.05},
    "2 s": {"hold": 2.0},
    "2 s, 0.05 deg/s/sqrt(Hz)": {"hold": 2.0, "density": 0.05},
    "ripple once a turn": {"ripple": 1e-3},
    "ripple and 1e-5 deg/s/sqrt(Hz)": {"ripple": 1e-3, "density": 1e-5},
    "knocks": {"knocks": 5},
    "coarse outputs": {"step": 0.25},
    "coarse outputs without noise": {"step": 0.25, "density": 0.0},
    "a slow table": {"acceleration": 20.0},
    "a quick table that rings": {"acceleration": 2000.0, "ring": 0.02},
    "drift": {"drift": 0.1},
    "20 Hz": {"frequency": 20.0},
    "1 kHz, no order": {"frequency": 1000.0, "shuffled": True},
}


def simulated(
    seed, *, density, hold, frequency, acceleration, ripple=0.0, knocks=0, step=0.0, ring=0.0, drift=0.0, shuffled=False
):
    """A run, its commanded rates, deg/s, and from when to when the table was at each, s."""
    rng = np.random.default_rng(seed)
    way = [WAY[k] for k in rng.permutation(len(WAY))] if shuffled else WAY
    way = [r for k, r in enumerate(way) if k == 0 or r != way[k - 1]]
    times, rates, spans = [0.0], [float(way[0])], []
    for rate in way:
        ramp = abs(rate - rates[-1]) / acceleration
        times += [times[-1] + ramp, times[-1] + ramp + hold]
        rates += [rate, rate]
        spans.append((times[-2], times[-1]))
    time = np.arange(int(times[-1] * frequency)) / frequency
    table = np.interp(time, times, rates)
    angle = np.cumsum(table) / frequency
    table = table * (1 + ripple * np.sin(np.radians(angle)))
    for begin, _ in spans[1:]:
        since = time - begin
        table = table + np.where(since > 0, ring * 50 * np.exp(-np.maximum(since, 0) / 0.1) * np.cos(60 * since), 0.0)
    out = (1 + 0.02 * rng.standard_normal()) * table + 0.5 * rng.standard_normal() + drift * time / time[-1]
    for at in rng.uniform(0, time[-1], knocks):
        out = out + np.where(np.abs(time - at) < 0.05, 20.0, 0.0)
    out = out + density * np.sqrt(frequency / 2) * rng.standard_normal(len(time))
    if step:
        out = np.round(out / step) * step
    rest = density * np.sqrt(frequency / 2) * rng.standard_normal((2, len(time)))
    columns = {"time": time, "gyro_x": rest[0], "gyro_y": rest[1], "gyro_z": out}
    units = {name: "s" if name == "time" else "deg/s" for name in columns}
    return il.Recording(columns, units, name="run.csv"), way, spans


@pytest.mark.slow
@pytest.mark.parametrize("name", CONDITIONS)
def test_every_dwell_is_found_and_none_at_a_wrong_rate(name, reduced):
    for seed in range(3 if reduced else 30):
        made, way, spans = simulated(seed, **{**USUAL, **CONDITIONS[name]})
        test = RateTest((Run("run.csv", "+z", tuple(np.array(way) * DEGREE)),))
        found = find_dwells(made, test, 0)
        seen = set()
        for start, stop, rate in zip(found.start, found.stop, np.array(found.rate) / DEGREE, strict=True):
            (k,) = [k for k, (a, b) in enumerate(spans) if a <= (start + stop) / 2 <= b]
            assert spans[k][0] <= start < stop <= spans[k][1]
            assert rate == pytest.approx(way[k], abs=1e-9)
            seen.add(k)
        assert len(seen) == len(way), f"seed {seed}"
