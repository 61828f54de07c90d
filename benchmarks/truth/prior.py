"""Units that aged since their record was made, records held against fresh attitudes, and gravity known only roughly."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray
from scenario import Scenario, Trial

import imulab as il
from imulab.gravity import Gravity, gravity_option
from imulab.recording import Recording
from imulab.records.calibration import Calibration

G = 9.80665
UG = 1e-6 * G
GROUP = "Tumble: priors, checks, gravity"
RECORD_ATTITUDES, RECORD_NOISE, NOISE = 24, 20 * UG, 60 * UG
AXES, PAIRS = "xyz", ("yx", "zx", "zy")
PLANNED = (
    (-3, -2, 100), (74, 0, 67), (74, -67, 2), (74, -67, -6), (74, -3, -67), (74, 2, -67),
    (100, 0, -5), (100, 0, 0), (74, 67, 2), (74, 67, -4), (0, 100, -1), (2, 71, 70),
    (-71, 69, 12), (-72, 11, 69), (-58, -58, 57), (7, -71, 70), (0, -100, 2), (2, -71, -70),
    (-1, 2, -100), (7, 70, -71), (-57, 59, -57), (-71, -6, -70), (-100, 0, 0), (-71, -70, -13),
)  # fmt: skip
"""Upward directions that a plan for order 3 asks for, in hundredths."""
Array = NDArray[np.float64]
Truth = dict[str, float]


def unit(rng: np.random.Generator) -> Truth:
    """Return a MEMS unit: 20 mg of bias, 1 % of scale factor, 10 mrad of misalignment."""
    found = {f"bias_{axis}": 0.02 * G * rng.standard_normal() for axis in AXES}
    found |= {f"scale_factor_{axis}": 1 + 0.01 * rng.standard_normal() for axis in AXES}
    return found | {f"misalignment_{pair}": 0.01 * rng.standard_normal() for pair in PAIRS}


def aged(rng: np.random.Generator, truth: Truth, sizes: dict[str, float]) -> Truth:
    """Return the unit with all parameters of a kind changed by a size, up or down."""
    return {
        name: value + sizes.get(name.rpartition("_")[0], 0.0) * rng.choice([-1.0, 1.0]) for name, value in truth.items()
    }


def table(
    rng: np.random.Generator, truth: Truth, count: int, noise: float, gravity: float = G, stated: float | None = None
) -> Recording:
    """Return attitudes as planned, or fewer put down anywhere, with the noise that they have, or are said to have."""
    up = np.array(PLANNED, dtype=float) if count == len(PLANNED) else rng.standard_normal((count, 3))
    f = gravity * up / np.linalg.norm(up, axis=1)[:, None]
    sensed = np.column_stack(
        [
            f[:, 0],
            f[:, 1] + truth["misalignment_yx"] * f[:, 0],
            f[:, 2] + truth["misalignment_zx"] * f[:, 0] + truth["misalignment_zy"] * f[:, 1],
        ]
    )
    bias, scale = (np.array([truth[f"{kind}_{axis}"] for axis in AXES]) for kind in ("bias", "scale_factor"))
    outputs = scale * (sensed + bias) + noise * rng.standard_normal((count, 3))
    said = noise if stated is None else stated
    columns = {f"accel_{axis}": outputs[:, i] for i, axis in enumerate(AXES)}
    columns |= {f"std_accel_{axis}": np.full(count, said) for axis in AXES}
    return Recording(columns, dict.fromkeys(columns, "m/s^2"), name="t.csv")


def fitted(
    recording: Recording, gravity: float | str | Gravity | None = G, prior: Calibration | None = None
) -> Calibration:
    """Return the record of a fit of order 1."""
    found = il.find_attitudes(recording)
    return il.fit_tumble(found, order=1, gravity=gravity, loss="square", prior=prior).calibration


def covered(record: Calibration, truth: Truth, kinds: tuple[str, ...]) -> tuple[bool, ...]:
    """Return for each parameter of some kinds whether its interval holds the truth."""
    factor = record.fit["coverage_factor_95"]
    return tuple(
        abs(p.value - truth[name]) <= factor * (p.standard_uncertainty or 0.0)
        for name, p in record.parameters.items()
        if name.rpartition("_")[0] in kinds
    )


def with_prior(seed: int, *, sizes: dict[str, float], count: int) -> Trial:
    """Update the record of a unit that has changed since."""
    rng = np.random.default_rng([seed, count, 1])
    truth = unit(rng)
    prior = fitted(table(rng, truth, RECORD_ATTITUDES, RECORD_NOISE))
    now = aged(rng, truth, sizes)
    record = fitted(table(rng, now, count, NOISE), prior=prior)
    kinds = tuple(sizes) or ("bias", "scale_factor", "misalignment")
    errors = [record.value(name) - now[name] for name in now if name.startswith("bias")]
    return Trial(
        covered(record, now, kinds),
        any("contradict each other" in text for text in record.warnings),
        float(np.sqrt(np.mean(np.square(errors)))) / UG,
    )


def check(
    seed: int, *, sizes: dict[str, float], count: int, noise: float = NOISE, stated: float | None = None
) -> Trial:
    """Hold fresh attitudes against a record."""
    rng = np.random.default_rng([seed, count, 2])
    truth = unit(rng)
    record = fitted(table(rng, truth, RECORD_ATTITUDES, RECORD_NOISE))
    fresh = table(rng, aged(rng, truth, sizes), count, noise, stated=stated)
    return Trial((), not il.check_tumble(record, il.find_attitudes(fresh), gravity=G).passed)


def gravity(seed: int, *, kind: str) -> Trial:
    """Calibrate under a gravity that is stated as people state it: 24 attitudes of 3 µg."""
    rng = np.random.default_rng([seed, 3])
    truth = unit(rng)
    latitude, height = rng.uniform(-60, 60), abs(400 * rng.standard_normal())
    sine = np.sin(np.radians(latitude)) ** 2
    normal = 9.7803253359 * (1 + 0.00193185265241 * sine) / np.sqrt(1 - 0.00669437999013 * sine)
    real = normal - 3.086e-6 * height + 35e-5 * rng.standard_normal()
    given: float | str | Gravity | None = None
    recording = table(rng, truth, 24, 3 * UG, gravity=real)
    if kind in ("latitude and height", "latitude"):
        given = gravity_option(None, f"{latitude:.3f}", f"{height:.0f}" if "height" in kind else None, "--{}")
    elif kind == "two decimals":
        given = f"{real:.2f}"
    elif kind == "stated uncertainty":
        given = f"{real + 2e-4 * rng.standard_normal():.5f}+-0.0002"
    elif kind == "head of the file":
        recording = Recording(
            recording.columns, recording.units, metadata={"gravity": f"{real:.5f} m/s^2"}, name="t.csv"
        )
    record = fitted(recording, given)
    said = any(text.startswith(("gravity ", "no local gravity")) for text in record.warnings)
    error = np.mean([record.value(f"scale_factor_{axis}") / truth[f"scale_factor_{axis}"] - 1 for axis in AXES])
    return Trial(covered(record, truth, ("scale_factor",)), said, 1e6 * float(error))


def prior_row(name: str, sizes: dict[str, float], count: int = 12, **asked: object) -> Scenario:
    """Return a row on priors."""
    return Scenario(GROUP, f"prior, {count} attitudes: {name}", partial(with_prior, sizes=sizes, count=count), **asked)  # type: ignore[arg-type]


def check_row(name: str, sizes: dict[str, float], count: int, least: float | None, noise: float = 60.0) -> Scenario:
    """Return a row on checks: the least share found, or no more than one in twenty where nothing has changed."""
    return Scenario(
        GROUP,
        f"check, {count} attitudes of {noise:g} µg: {name}",
        partial(check, sizes=sizes, count=count, noise=noise * UG),
        trials=120,
        coverage=None,
        warned=least,
        false_alarms=5.0 if least is None else None,
        source="the method's power, less 1.5 %",
    )


BIAS, SCALE = {"bias": 100 * UG}, {"scale_factor": 1e-4}
BOTH = {"bias": 300 * UG, "scale_factor": 3e-4}
ALL = {"bias": 1000 * UG, "scale_factor": 5e-4, "misalignment": 2e-4}
SCENARIOS = [
    # Where nothing has changed the price of not knowing it is wide intervals: they may cover more.
    prior_row("nothing has changed", {}, coverage=(93.0, 100.0), false_alarms=5.0, unit="µg"),
    prior_row("biases off by 60 µg", {"bias": 60 * UG}, coverage=(93.0, 97.0), unit="µg"),
    prior_row("biases off by 300 µg", {"bias": 300 * UG}, coverage=(93.0, 97.0), warned=95.0, unit="µg"),
    prior_row("scale factors off by 100 ppm", SCALE, coverage=(92.0, 97.0), unit="µg"),
    prior_row("scale factors off by 500 ppm", {"scale_factor": 5e-4}, coverage=(92.0, 97.0), warned=95.0, unit="µg"),
    prior_row("300 µg and 300 ppm", BOTH, coverage=(93.0, 98.5), warned=95.0, unit="µg"),
    prior_row("300 µg and 300 ppm", BOTH, 6, coverage=None, warned=95.0, unit="µg"),
    prior_row("1 mg, 500 ppm and 200 µrad", ALL, coverage=(88.5, 97.0), warned=95.0, unit="µg"),
    *(check_row("nothing has changed", {}, count, None) for count in (4, 12, 24)),
    check_row("100 µg", BIAS, 4, 68.5),
    check_row("100 ppm", SCALE, 4, 46.5),
    check_row("100 µg", BIAS, 12, 95.5),
    check_row("100 ppm", SCALE, 12, 73.5),
    check_row("100 µg", BIAS, 24, 98.5),
    check_row("100 ppm", SCALE, 24, 91.5),
    check_row("100 µg", BIAS, 4, 96.5, 20.0),
    check_row("100 ppm", SCALE, 4, 93.5, 20.0),
    Scenario(
        GROUP,
        "check, 24 attitudes of 60 µg said to be 20: nothing has changed",
        partial(check, sizes={}, count=24, stated=20 * UG),
        trials=120,
        coverage=None,
        false_alarms=5.0,
    ),
    *(
        Scenario(
            GROUP,
            f"gravity from {kind}",
            partial(gravity, kind=kind),
            trials=120,
            coverage=asked,
            warned=95.0 if kind != "stated uncertainty" else None,
            unit="ppm",
            source="rounding and ignorance of the place are rectangular: intervals of 1.96 u cover all of them",
        )
        for kind, asked in (
            ("latitude and height", (93.0, 97.0)),
            ("latitude", (93.0, 97.0)),
            ("two decimals", (93.0, 100.0)),
            ("stated uncertainty", (93.0, 97.0)),
            ("head of the file", (93.0, 97.0)),
            ("nothing", (93.0, 100.0)),
        )
    ),
]
