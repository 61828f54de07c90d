"""The same tasks call by call with imulab, lmfit, imucal and allantools: lines of user code, time, and what comes out.

The functions whose names begin with a task are what a user writes; their lines are counted without head and docstring.
"""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import numpy as np
from timing import Row, seconds

import imulab as il

G = 9.81
AXES = "xyz"


def tumble_imulab(frame: Any) -> Any:
    fit = il.fit_tumble(frame, gravity=G)
    return fit.calibration


def tumble_lmfit(frame: Any) -> Any:
    """Attitudes by hand, at a threshold that somebody chose; order 1 alone."""
    from lmfit import Parameters, minimize

    samples = frame[[f"accel_{axis} [m/s^2]" for axis in "xyz"]].to_numpy()
    windows = samples[: len(samples) // 100 * 100].reshape(-1, 100, 3)
    quiet = windows.std(axis=1).max(axis=1) < 0.02
    starts = np.flatnonzero(quiet & ~np.roll(quiet, 1))
    means, errors = [], []
    for start in starts:
        stop = start + int(np.argmin(quiet[start:])) if not quiet[start:].all() else len(quiet)
        hold = windows[start:stop].reshape(-1, 3)
        means.append(hold.mean(axis=0))
        errors.append(hold.std(axis=0).mean() / np.sqrt(len(hold)))
    means, errors = np.array(means), np.array(errors)
    wanted = Parameters()
    for axis in "xyz":
        wanted.add(f"bias_{axis}", 0.0)
        wanted.add(f"scale_{axis}", 1.0)
    for pair in ("yx", "zx", "zy"):
        wanted.add(f"misalignment_{pair}", 0.0)

    def residual(p):
        scale = np.array([p[f"scale_{axis}"].value for axis in "xyz"])
        bias = np.array([p[f"bias_{axis}"].value for axis in "xyz"])
        t = np.eye(3)
        t[1, 0], t[2, 0], t[2, 1] = (p[f"misalignment_{pair}"].value for pair in ("yx", "zx", "zy"))
        force = np.linalg.solve(t, (means / scale - bias).T).T
        return (np.linalg.norm(force, axis=1) - G) / errors

    return minimize(residual, wanted, scale_covar=False)


def tumble_imucal(regions: Any) -> Any:
    """The six level positions and three turns about the axes, cut out by hand, which imucal needs."""
    from imucal import FerrarisCalibration

    calibration = FerrarisCalibration(grav=G)
    return calibration.compute(regions, 100.0, from_acc_unit="m/s^2", from_gyr_unit="deg/s")


def allan_imulab(samples: Any) -> Any:
    return il.allan_deviation(samples, rate=100.0)


def allan_allantools(samples: Any) -> Any:
    from allantools import oadev

    tau, deviation, error, _ = oadev(samples, rate=100.0, data_type="freq", taus="octave")
    return tau, deviation, error


def noise_imulab(still: Any) -> Any:
    return il.fit_noise(still)


def noise_allantools(still: Any) -> Any:
    """White noise read off the curve at one averaging time, and the bias instability at its lowest point."""
    from allantools import oadev

    rate = 1 / float(np.median(np.diff(still.time)))
    tau, deviation, _, _ = oadev(still.column("gyro_z"), rate=rate, data_type="freq", taus="octave")
    white = np.interp(1.0, tau, deviation)
    return white, deviation.min() / 0.664


def lines_of(function: Callable[..., Any]) -> int:
    """Lines of code of a function, without its head, docstring and blank lines."""
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(function))).body
    assert isinstance(tree, ast.FunctionDef)
    tree.body = tree.body[1:] if ast.get_docstring(tree) else tree.body
    return len(ast.unparse(tree).splitlines()) - 1


def rows() -> list[Row]:
    missing = [name for name in ("lmfit", "imucal", "allantools") if find_spec(name) is None]
    if missing:
        return [("call by call beside peers", f"not measured: {' '.join(missing)} not installed", "")]
    return [*tumbling(), *noises()]


def tumbling() -> list[Row]:
    made = il.simulate_tumble(order=1, gravity=G, seed=3)
    frame = made.to_frame("pandas")
    truth = {key[6:]: float(text) for key, text in made.metadata.items() if key.startswith("truth_")}
    regions = six_positions(truth)
    functions = {tumble_imulab: frame, tumble_lmfit: frame, tumble_imucal: regions}
    times = seconds(*(lambda f=f, data=data: f(data) for f, data in functions.items()), repeats=7)
    record, fitted, ferraris = (f(data) for f, data in functions.items())
    off = {
        "imulab": record.value("bias_x") - truth["bias_x"],
        "lmfit": fitted.params["bias_x"].value - truth["bias_x"],
        "imucal": float(ferraris.b_a[0]) / truth["scale_factor_x"] - truth["bias_x"],
    }
    u = {"imulab": record.parameters["bias_x"].standard_uncertainty, "lmfit": fitted.params["bias_x"].stderr}
    gives = {
        "imulab": f"finds the attitudes and the order, verdict: {record.verdict.state}; record, report, firmware",
        "lmfit": f"reduced chi-square {fitted.redchi:.2f}, no verdict; attitudes, model and order by hand",
        "imucal": "no uncertainty, no verdict; six level positions and three turns, cut out by hand",
    }
    return [
        (
            f"accelerometers of a tumble test by {name}",
            f"{lines_of(f)} lines, {1e3 * took:.3g} ms; bias_x off by {1e6 * off[name] / G:.0f} ug"
            f"{f', u = {1e6 * u[name] / G:.0f} ug' if name in u else ''}; {gives[name]}",
            "",
        )
        for (f, _), took, name in zip(functions.items(), times, off, strict=True)
    ]


def six_positions(truth: dict[str, float]) -> Any:
    """Signals of the same unit in the positions that imucal asks for, exactly level."""
    from imucal.ferraris_calibration import FerrarisSignalRegions

    rng = np.random.default_rng(5)
    scale, bias = (np.array([truth[f"{name}_{axis}"] for axis in AXES]) for name in ("scale_factor", "bias"))
    t = np.eye(3)
    t[1, 0], t[2, 0], t[2, 1] = (truth[f"misalignment_{pair}"] for pair in ("yx", "zx", "zy"))
    still = np.zeros((500, 3))
    signals: dict[str, Any] = {}
    for i, axis in enumerate(AXES):
        for end, sign in (("p", 1.0), ("a", -1.0)):
            mean = scale * (t @ (sign * G * np.eye(3)[i]) + bias)
            signals |= {f"acc_{axis}_{end}": mean + 7e-3 * rng.standard_normal((500, 3)), f"gyr_{axis}_{end}": still}
        signals |= {f"acc_{axis}_rot": still, f"gyr_{axis}_rot": np.tile(72.0 * np.eye(3)[i], (500, 1))}
    return FerrarisSignalRegions(**signals)


def noises() -> list[Row]:
    still = il.simulate_noise(white="0.3 deg/sqrt(h)", flicker="5 deg/h", duration="1 h", columns=["gyro_z"])
    samples = still.si("gyro_z")
    curve = seconds(lambda: allan_imulab(samples), lambda: allan_allantools(samples), repeats=7)
    ours, theirs = allan_imulab(samples), allan_allantools(samples)
    count = min(len(ours.deviation), len(theirs[1]))
    apart = np.abs(ours.deviation[:count] / theirs[1][:count] - 1).max()
    model = seconds(lambda: noise_imulab(still), lambda: noise_allantools(still), repeats=3)
    white = noise_imulab(still).calibration.parameters["gyro_z_white"]
    by_eye = np.radians(noise_allantools(still)[0]) if still.units["gyro_z"] == "deg/s" else noise_allantools(still)[0]
    truth = np.radians(0.3) / 60
    ends = [f"{100 * (value / truth - 1):+.1f} %" for value in (white.value, *white.interval_95, by_eye)]
    found = {
        "Allan deviation of 360,000 samples by imulab": (allan_imulab, curve[0], "uncertainty of any noise, plot()"),
        "the same by allantools": (allan_allantools, curve[1], f"same to {apart:.0e}; uncertainty of white noise"),
        "white noise of that log by imulab": (
            noise_imulab, model[0], f"off by {ends[0]}, 95 % interval {ends[1]} to {ends[2]}; model, verdict"
        ),
        "the same by allantools, read off the curve": (
            noise_allantools, model[1], f"off by {ends[3]}; no interval, no verdict"
        ),
    }  # fmt: skip
    return [
        (what, f"{lines_of(f)} lines, {1e3 * took:.3g} ms; {gives}", "") for what, (f, took, gives) in found.items()
    ]


if __name__ == "__main__":
    for what, found, _ in rows():
        print(f"{what}: {found}")
