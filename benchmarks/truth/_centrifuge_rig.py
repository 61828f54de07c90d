"""A centrifuge with a counter-rotating table, simulated apart from imulab: its equations of motion in NumPy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import imulab as il
from imulab.procedures.centrifuge.manifest import parse_manifest

G = 9.80665
DEG_PER_HOUR = np.pi / 180 / 3600
EARTH = 15.041 * DEG_PER_HOUR
RADIUS = 2.0
NET = np.radians(40.0)


@dataclass(frozen=True)
class Rig:
    """A test: drift ``K0 (1 + c1 a + c2 a^2)`` in deg/h/g and 1/g, its direction, and what disturbs it (SI)."""

    levels: tuple[float, ...] = (1.0, 2.0, 5.0, 10.0, 15.0, 20.0)
    K0: float = 3.3
    c1: float = 0.0
    c2: float = 0.0
    direction: float = 0.6
    walk: float = 0.01  # deg/sqrt(h)
    fog_walk: float = 0.005
    tilt: float = np.radians(10 / 3600)
    delay: float = 0.0  # of the FOG, s
    flicker: float = 0.0  # rms of noise with a correlation time of 3 s in X and Y, rad/s
    cycles: int = 2
    both_senses: bool = False
    encoder: bool = True
    rate: float = 20.0
    seconds: float = 60.0

    def factor(self, a: np.ndarray) -> np.ndarray:
        """K at specific forces in m/s^2, rad/s/(m/s^2)."""
        g = np.asarray(a) / G
        return self.K0 * DEG_PER_HOUR / G * (1 + self.c1 * g + self.c2 * g**2)

    def manifest(self) -> dict:
        """The manifest as TOML would read."""
        runs = []
        for cycle in range(1, self.cycles + 1):
            runs.append({"file": f"c{cycle}_static.csv", "power_cycle": cycle, "role": "static"})
            for level in self.levels:
                arm = float(np.degrees(np.sqrt(level * G / RADIUS)))
                common = {"power_cycle": cycle, "role": "loaded", "arm_rate": arm}
                runs += [
                    {
                        **common,
                        "file": f"c{cycle}_{level:g}g_{sense}.csv",
                        "table_rate": arm - float(np.degrees(NET)),
                        "sense": sense,
                    }
                    for sense in ((1, -1) if self.both_senses else (1,))
                ]
        return {"radius": {"value": RADIUS, "unit": "m"}, "rates": {"unit": "deg/s"}, "run": runs}

    def recording(self, run: dict, rng: np.random.Generator) -> il.Recording:
        """One recording of a run."""
        loaded = run["role"] == "loaded"
        n = round((self.seconds if loaded else 30.0) * self.rate)
        t = np.arange(n) / self.rate
        sense = run.get("sense", 1)
        arm, table = (np.radians(run[k]) * sense if loaded else 0.0 for k in ("arm_rate", "table_rate"))
        a = arm**2 * RADIUS
        start = rng.uniform(0, 2 * np.pi)

        def common(time: np.ndarray, psi: float) -> np.ndarray:
            chi = start + table * time
            earth = 0.7 * EARTH * np.cos(0.3 - (arm - table) * time - psi)
            return earth - arm * self.tilt * np.cos(chi + 0.4 - psi)

        chi = start + table * t
        K = float(self.factor(np.array(a)))
        columns = {"time": t}
        units = {"time": "s"}
        for name, psi in (("dtg_x", 0.0), ("dtg_y", np.pi / 2)):
            drift = K * a * np.cos(chi - self.direction - psi) + 20 * DEG_PER_HOUR
            noise = self.walk * np.pi / 180 / 60 * np.sqrt(self.rate) * rng.standard_normal(n)
            if self.flicker:
                noise = noise + self.flicker * _markov(n, 1 / self.rate, 3.0, rng)
            columns[name] = (common(t, psi) + drift + noise) / DEG_PER_HOUR
            units[name] = "deg/h"
        noise = self.fog_walk * np.pi / 180 / 60 * np.sqrt(self.rate) * rng.standard_normal(n)
        columns["fog"] = (common(t - self.delay, 0.0) + 3 * DEG_PER_HOUR + noise) / DEG_PER_HOUR
        units["fog"] = "deg/h"
        if self.encoder:
            columns["table_angle"] = np.degrees(chi) % 360.0
            units["table_angle"] = "deg"
        return il.Recording(columns=columns, units=units, name=run["file"])

    def reduce(self, seed: int, change=None, **options):
        """Simulate and reduce a test; `change` may spoil a recording: (run, recording, rng) -> recording."""
        rng = np.random.default_rng(seed)
        table = self.manifest()
        made = {}
        for run in table["run"]:
            recording = self.recording(run, rng)
            made[run["file"]] = recording if change is None else change(run, recording, rng)
        test = parse_manifest(table, "manifest.toml")
        return il.fit_centrifuge(test, lambda run: [made[run.file]], **options)


def _markov(n: int, step: float, time: float, rng: np.random.Generator) -> np.ndarray:
    """First-order noise of unit variance: filtered in the frequency domain, then scaled."""
    m = 2 * n
    f = np.fft.rfftfreq(m, step)
    white = np.fft.rfft(rng.standard_normal(m))
    x = np.fft.irfft(white / np.sqrt(1 + (2 * np.pi * f * time) ** 2), m)
    expected = np.sqrt(np.mean(1 / (1 + (2 * np.pi * np.fft.fftfreq(m, step) * time) ** 2)))
    return x[:n] / expected
