"""The published first-order iteration to its source's letter: where it rests, and which attitudes it forbids."""

import numpy as np
import pytest

import imulab as il
from conftest import table
from imulab.errors import DataError, OptionError
from reference import tumble as reference

G = 9.81362
ARCSECOND = np.pi / 180 / 3600
SOURCE = (5e-6, 2e-6 * G, 3 * ARCSECOND)


def outputs(directions, *, seed=3, part=0.5):
    """Outputs of a MEMS triad whose errors are scaled by `part`."""
    truth = reference.random_truth(np.random.default_rng(seed), 2)
    nominal = {name: float(name[0] == "s") for name in truth}
    truth = {name: nominal[name] + part * (value - nominal[name]) for name, value in truth.items()}
    return np.array([reference.forward(G * up, truth, 2) for up in directions])


def fit(data, **options):
    return il.fit_tumble(
        il.find_attitudes(table(data, "m/s^2", None)), order=2, gravity=G, method="linearised", **options
    ).calibration


def test_each_error_of_the_model_is_its_own_unknown_of_the_sources_equation():
    """The signs and the pairing of products that docs/tumble_method.md states, from the forward model alone."""
    names, size = reference.names(2), 1e-6
    ups = reference.random_attitudes(np.random.default_rng(1), 40)
    for place, name in enumerate(names):
        truth = {each: float(each[0] == "s") for each in names}
        truth[name] += size * {"b": G, "k": 1 / G}.get(name[0], 1.0)
        x, y, z = a = np.array([reference.forward(G * up, truth, 2) for up in ups]).T / G
        products = [x * y, z * x, y * z]  # for m_yx, m_zx and m_zy
        design = np.array([*a, *a**2, *products, *a**3]).T
        unknowns = np.linalg.lstsq(design, ((a**2).sum(axis=0) - 1) / 2, rcond=None)[0]
        np.testing.assert_allclose(unknowns / size, np.eye(len(names))[place], rtol=0, atol=1e-4)


def test_the_threshold_decides_how_many_passes_are_made():
    """As many as in the transcription of the source, which knows nothing of this one."""
    data = outputs(reference.random_attitudes(np.random.default_rng(1), 30))
    start = {f"scale_factor_{axis}": 1.0 for axis in "xyz"}
    passes = []
    for factor in (1e4, 1.0, 1e-4, 1e-7):
        limits = tuple(factor * value for value in SOURCE)
        found = fit(data, threshold=limits)
        expected = reference.linearised_passes(data, 2, G, start, (limits[0], limits[1] / G, limits[2]))[1]
        assert found.fit["iterations"] == expected
        assert found.options["threshold"] == pytest.approx(limits, rel=1e-12)
        passes.append(expected)
    assert passes == sorted(set(passes))
    default = fit(data)
    assert default.fit["iterations"] == passes[1]
    assert default.options["threshold"] == pytest.approx(SOURCE, rel=1e-12)


@pytest.mark.parametrize("alone", [0, 1, 2])
def test_each_of_the_three_changes_counts(alone):
    data = outputs(reference.random_attitudes(np.random.default_rng(1), 30))
    loose = [1.0, G, 1.0]
    limits = [1e-9 * value if index == alone else value for index, value in enumerate(loose)]
    assert fit(data, threshold=limits).fit["iterations"] > fit(data, threshold=loose).fit["iterations"]


def test_a_threshold_below_rounding_is_refused_with_what_the_last_pass_changed():
    data = outputs(reference.random_attitudes(np.random.default_rng(1), 30))
    with pytest.raises(DataError, match=r"not at rest after 50 passes: .* the threshold is 1e-14 ppm, "):
        fit(data, threshold=(1e-20, 1e-20 * G, 1e-20))


@pytest.mark.parametrize(
    ("threshold", "message"),
    [
        ((1e-6, 1e-6), "expected three changes above 0"),
        ((1e-6, 0.0, 1e-6), "expected three changes above 0"),
        ((1e-6, np.nan, 1e-6), "threshold: expected numbers or a text, found"),
        ((1e-6, np.inf, 1e-6), "expected three changes above 0"),
    ],
)
def test_thresholds_that_are_none_are_refused(threshold, message):
    with pytest.raises(OptionError, match=message):
        fit(outputs(np.eye(3)), threshold=threshold)


def test_the_command_and_the_fleet_take_a_threshold(imulab, tmp_path):
    il.write(il.simulate_tumble(attitudes=24, order=1, hold=2.0, gravity=G, seed=4), tmp_path / "t.csv")
    fit_it = ["tumble", "fit", "t.csv", "--gravity", str(G), "--order", "1"]
    text = "1e-3 ppm, 1e-3 ug, 0.001 arcsec"
    done = imulab(*fit_it, "--method", "linearised", "--threshold", text, "-o", "t.json")
    assert done.returncode == 0, done.stderr
    held = il.load(tmp_path / "t.json")
    assert held.options["threshold"] == pytest.approx([1e-9, 1e-9 * 9.80665, 1e-3 * ARCSECOND])
    assert imulab(*fit_it, "--method", "linearised", "-o", "d.json").returncode == 0
    assert held.fit["iterations"] > il.load(tmp_path / "d.json").fit["iterations"]
    (tmp_path / "m.csv").write_text(
        f'serial,procedure,file,gravity,order,method,threshold\nSN1,tumble,t.csv,{G},1,linearised,"{text}"\n'
    )
    done = imulab("fleet", "run", "m.csv", "-o", "out")
    assert done.returncode == 0, done.stderr
    assert il.load(tmp_path / "out" / "SN1.json").options["threshold"] == held.options["threshold"]
    for arguments, message in (
        (["--threshold", text], "--threshold needs method linearised, found method norm"),
        (["--method", "linearised", "--threshold", "5 ppm"], "--threshold '5 ppm': expected three changes, of scale"),
        (["--method", "linearised", "--threshold", "2 ug,5 ppm,3 arcsec"], "--threshold '2 ug': expected a number, or"),
        (["--method", "linearised", "--threshold", "5 ppm,0 ug,3 arcsec"], "--threshold '5 ppm,0 ug,3 arcsec': exp"),
        (["--method", "linearised", "--threshold", "1e999,2,3"], "--threshold '1e999,2,3': expected three finite"),
    ):
        refused = imulab(*fit_it, *arguments, "-o", "no.json")
        assert refused.returncode == 2
        assert refused.stderr.startswith(f"imulab: {message}"), refused.stderr
        assert refused.stderr.count("\n") == 1
        assert not (tmp_path / "no.json").exists()


def test_an_axis_vertical_in_two_attitudes_is_warned_of_by_name():
    apart = [
        up
        for up in reference.random_attitudes(np.random.default_rng(1), 40)
        if np.abs(up).max() < np.cos(np.radians(8))
    ]
    once = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], *apart])
    assert not [warning for warning in fit(outputs(once)).warnings if "vertical" in warning]
    tilted = [0.0, np.sin(np.radians(2)), -np.cos(np.radians(2))]
    twice = np.array([*once, tilted])
    (warning,) = [warning for warning in fit(outputs(twice)).warnings if "vertical" in warning]
    last = len(twice)
    where = f"row 1 (line 2), row {last} (line {last + 1})"
    assert warning.startswith(f"axis z is vertical within 3 deg in 2 attitudes ({where}): the source of method")
    norm = il.fit_tumble(il.find_attitudes(table(outputs(twice), "m/s^2", None)), order=2, gravity=G).calibration
    assert not [warning for warning in norm.warnings if "vertical" in warning]
    assert "threshold" not in norm.options
