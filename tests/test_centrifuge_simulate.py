"""The simulated centrifuge test against the table of lines worked out by hand."""

from dataclasses import replace

import numpy as np
import pytest

from imulab.errors import OptionError
from imulab.procedures.centrifuge.manifest import Manifest, Run, make_manifest
from imulab.procedures.centrifuge.simulate import AxisTruth, FogTruth, RigTruth, Simulation, Truth, typical_truth
from reference import centrifuge as reference

G, DEG_H = reference.G, reference.DEG_H
RATE = 100.0

# Rates with whole periods in 90 s: table 0.7 Hz, net 1/9 Hz.
TABLE, NET = 2 * np.pi * 0.7, 2 * np.pi / 9
NUMBERS = {
    "K": 3.3 * DEG_H / G, "scale_x": 3e-3, "scale_f": -2e-3, "bias_x": 12 * DEG_H, "bias_f": 0.4 * DEG_H, "mu_x": 1e-3,
    "mu_f": 4e-4, "quadratic": 0.01 * DEG_H / G**2, "cubic": 2e-4 * DEG_H / G**3, "tilt": np.radians(10 / 3600),
    "tilt_phase": 0.7, "flexure": 2e-7 / G, "flexure_phase": 2.1, "earth": 11.6 * DEG_H, "earth_phase": 1.0,
    "base": 2e-4, "base_phase": 0.3,
}  # fmt: skip


def truth() -> Truth:
    n = NUMBERS
    return Truth(
        AxisTruth(bias=n["bias_x"], D_x=n["K"], quadratic=n["quadratic"], cubic=n["cubic"], scale_error=n["scale_x"],
                  out_of_plane=n["mu_x"]),
        None,
        FogTruth(bias=n["bias_f"], scale_error=n["scale_f"], out_of_plane=n["mu_f"]),
        RigTruth(tilt=n["tilt"], tilt_phase=n["tilt_phase"], flexure=n["flexure"], flexure_phase=n["flexure_phase"],
                 base_tilt=n["base"], base_phase=n["base_phase"], earth_rate=n["earth"], earth_phase=n["earth_phase"]),
    )  # fmt: skip


def manifest(sense: int = 1, spin_axis: str = "up") -> Manifest:
    return Manifest(2.0, (Run("run.csv", 1, "loaded", TABLE + NET, TABLE, sense, spin_axis),))


def recorded(simulation, run=None):
    blocks = list(simulation(run or simulation.manifest.runs[-1]))
    return {name: np.concatenate([block.si(name) for block in blocks]) for name in blocks[0].columns}


def line(values, chi, times):
    return 2 * np.mean(values * np.exp(-1j * times * chi))


@pytest.mark.parametrize("channel", ["x", "fog"])
def test_the_table_of_lines_can_be_read_off_the_spectrum(channel):
    columns = recorded(Simulation(manifest(), truth(), RATE, 90.0, 5.0))
    expected = reference.table_of_lines(NUMBERS, TABLE + NET, TABLE, manifest().force(manifest().runs[0]))[channel]
    values = columns["dtg_x" if channel == "x" else "fog"]
    chi = columns["table_angle"]
    assert values.mean() == pytest.approx(expected["0"], rel=1e-9)
    for times in (1, 2, 3):
        assert line(values, chi, times) == pytest.approx(expected[str(times)], abs=1e-9 * abs(expected["1"]))
    at_net = 2 * np.mean(values * np.exp(-1j * NET * columns["time"]))
    assert at_net == pytest.approx(expected["net"], abs=1e-9 * NUMBERS["earth"])
    # Nothing else: these lines are the whole signal.
    rest = values - expected["0"] - np.real(expected["net"] * np.exp(1j * NET * columns["time"]))
    for times in (1, 2, 3):
        rest = rest - np.real(expected[str(times)] * np.exp(1j * times * chi))
    assert np.abs(rest).max() < 1e-9 * np.abs(values).max()


def test_y_sees_what_is_fixed_in_the_arm_a_quarter_turn_after_x():
    tilted = Truth(AxisTruth(), AxisTruth(), FogTruth(), RigTruth(tilt=5e-5, tilt_phase=0.4))
    columns = recorded(Simulation(manifest(), tilted, RATE, 90.0, 5.0))
    x, y = (line(columns[name], columns["table_angle"], 1).conjugate() for name in ("dtg_x", "dtg_y"))
    assert y == pytest.approx(1j * x, rel=1e-9)


def test_what_is_proportional_to_the_arm_rate_changes_sign_with_the_sense():
    both = Truth(AxisTruth(D_x=NUMBERS["K"]), None, FogTruth(), RigTruth(tilt=5e-5, tilt_phase=0.4, flexure=1e-8))
    lines = []
    for sense in (1, -1):
        columns = recorded(Simulation(manifest(sense), both, RATE, 90.0, 5.0))
        chi = np.unwrap(columns["table_angle"])
        assert np.sign(chi[-1] - chi[0]) == sense
        lines.append([line(columns[name], chi, 1) for name in ("dtg_x", "fog")])
    (x_plus, fog_plus), (x_minus, fog_minus) = lines
    assert fog_minus == pytest.approx(-fog_plus, rel=1e-9)
    drift = NUMBERS["K"] * manifest().force(manifest().runs[0])
    assert (x_plus + x_minus) / 2 == pytest.approx(drift, rel=1e-9)


def test_the_spin_axis_cross_terms_change_sign_with_the_spin_axis():
    cross = Truth(AxisTruth(D_x=NUMBERS["K"], cross_y=NUMBERS["K"] / 50), None, FogTruth(), RigTruth())
    up, down = (
        line(recorded(Simulation(manifest(1, side), cross, RATE, 90.0, 5.0))["dtg_x"],
             recorded(Simulation(manifest(1, side), cross, RATE, 90.0, 5.0))["table_angle"], 1)
        for side in ("up", "down")
    )  # fmt: skip
    force = manifest().force(manifest().runs[0])
    assert (up - down) / 2 == pytest.approx(-1j * G * NUMBERS["K"] / 50 * force, rel=1e-9)


def test_a_delayed_fog_shows_an_earlier_angle():
    late = truth()
    late = replace(late, fog=replace(late.fog, delay=1e-3))
    prompt, delayed = (
        line(c["fog"], c["table_angle"], 1)
        for c in (recorded(Simulation(manifest(), t, RATE, 90.0, 5.0)) for t in (truth(), late))
    )
    assert delayed == pytest.approx(prompt * np.exp(-1j * TABLE * 1e-3), rel=1e-9)


def test_differential_flexure_and_growth_of_k():
    a = manifest().force(manifest().runs[0])
    bent = Truth(AxisTruth(D_x=1e-6, D_y=2e-6, c1=1e-3, c2=1e-4, differential_flexure=1e-8, differential_phase=0.9))
    columns = recorded(Simulation(manifest(), bent, RATE, 90.0, 5.0))
    expected = (1 + 1e-3 * a + 1e-4 * a**2) * (1e-6 - 2e-6j) * a + (TABLE + NET) * 1e-8 * a * np.exp(0.9j)
    assert line(columns["dtg_x"], columns["table_angle"], 1) == pytest.approx(expected, rel=1e-9)


def test_noise_is_an_angle_random_walk_and_the_same_every_time():
    noisy = Truth(
        AxisTruth(angle_random_walk=1e-5, markov=1e-5, markov_time=0.5), None, FogTruth(angle_random_walk=2e-5)
    )
    simulation = Simulation(manifest(), noisy, RATE, 900.0, 5.0, seed=3)
    fog, again = recorded(simulation)["fog"], recorded(simulation)["fog"]
    np.testing.assert_array_equal(fog, again)
    assert fog.std() == pytest.approx(2e-5 * np.sqrt(RATE), rel=0.01)
    x = recorded(simulation)["dtg_x"]
    # 45,000 samples, correlated over 0.5 s: 900 independent ones, whose variance is known to 5 %.
    assert x.var() == pytest.approx(1e-10 * RATE + 1e-10, rel=0.05)
    slow = np.mean((x[1:] - x.mean()) * (x[:-1] - x.mean()))
    assert slow == pytest.approx(1e-10 * np.exp(-1 / RATE / 0.5), rel=0.4)


def test_blocks_of_any_size_join_to_the_same_recording():
    simulation = Simulation(manifest(), truth(), RATE, 20.0, 5.0)
    whole = recorded(simulation)["dtg_x"]
    pieces = np.concatenate([block.si("dtg_x") for block in simulation.blocks(manifest().runs[0], 77)])
    np.testing.assert_allclose(pieces, whole, rtol=0, atol=1e-18)


def test_a_static_run_stands_still():
    test = make_manifest(levels=[G], radius=2.0, net_rate=np.radians(40))
    quiet = typical_truth()
    quiet = Truth(
        replace(quiet.x, angle_random_walk=0.0, drift=0.0), None, replace(quiet.fog, angle_random_walk=0.0), quiet.rig
    )
    columns = recorded(Simulation(test, quiet, 10.0, 60.0, 30.0), test.runs[0])
    assert np.ptp(columns["dtg_x"]) < 1e-15
    assert np.ptp(columns["fog"]) < 1e-15


@pytest.mark.parametrize(
    "change", [{"sample_rate": 1.0}, {"duration": 0.0}, {"seed": -1}, {"unit": "deg"}, {"ramp": -1.0}]
)
def test_values_out_of_range_are_refused(change):
    with pytest.raises(OptionError):
        Simulation(manifest(), truth(), **change)
