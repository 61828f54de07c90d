"""A tumble record as a prior over temperature, and a thermal record as the prior of a tumble test."""

from dataclasses import replace

import numpy as np
import pytest

import imulab as il
from conftest import some_of
from imulab.cli import main
from imulab.procedures.thermal import solve as solving
from imulab.procedures.thermal.model import Laws
from imulab.procedures.thermal.solve import ThermalProblem, solve
from reference import thermal as reference

G = reference.G
LAWS = Laws(-20.0, 60.0, (3, 2, 1))
PER_HOLD = ("reading", "covariance", "temperature", "rate", "step", "shared", "recording", "group")


def problem(rng, triad, noise=20e-6, step=0.0):
    soaks = [reference.soak(triad, rng, t, 12, noise * G, 1e-4 * G) for t in (-20, 0, 25, 45, 60)]
    n = 60
    return ThermalProblem(
        reading=np.vstack([outputs for outputs, _ in soaks]) / G,
        covariance=np.tile(np.eye(3) * noise**2, (n, 1, 1)),
        temperature=np.concatenate([at for _, at in soaks]),
        rate=np.zeros(n), step=np.full(n, step), shared=np.ones(n, dtype=bool),
        recording=np.repeat(np.arange(5), 12), group=np.full(n, -1), tilt=2e-4, zero=np.zeros(3),
    )  # fmt: skip


def part(whole, kept):
    chosen = {name: getattr(whole, name)[kept] for name in PER_HOLD}
    chosen["recording"] = np.unique(chosen["recording"], return_inverse=True)[1]
    return replace(whole, **chosen)


@pytest.mark.parametrize("step", [0.0, 0.03])
@pytest.mark.parametrize("seed", some_of(2, range(3)))
def test_a_prior_and_the_rest_are_the_joint_fit(seed, step, monkeypatch):
    """To 1e-4 of a standard deviation (rms over the coefficients; the second order leaves 2e-4 in single ones).

    Each fit finds an excess of its own beyond the noise, which is left out here.
    """
    monkeypatch.setattr(solving, "fit_excess", lambda *_: (0.0, np.inf))
    rng = np.random.default_rng([6, seed])
    whole = problem(rng, reference.Triad(rng), step=step)
    middle = whole.recording == 2
    one = solve(replace(part(whole, middle), step=np.zeros(12)), Laws(24.0, 26.0, (0, 0, 0)), tau=0.0)
    rest = replace(part(whole, ~middle), known=(25.0, one.coefficients, one.covariance))
    joint, known = solve(whole, LAWS, tau=1e-4), solve(rest, LAWS, tau=1e-4)
    u = np.sqrt(np.diag(joint.covariance))
    off = (known.coefficients - joint.coefficients) / u
    assert np.sqrt((off**2).mean()) < 1e-4
    assert np.abs(off).max() < 3e-4
    assert np.sqrt(np.diag(known.covariance)) / u == pytest.approx(1, abs=1e-4)


@pytest.fixture(scope="module")
def made():
    recordings = il.simulate_thermal()
    later = il.simulate_thermal("10,33", attitudes=6)
    return il.fit_thermal(list(recordings)).calibration, list(later)


def truth(temperature):
    from imulab.procedures.thermal.simulate import thermal_truth

    return {name: float(value[0]) for name, value in thermal_truth(np.array([temperature])).items()}


def test_a_thermal_record_is_the_prior_of_a_tumble_test_at_its_temperature(made):
    record, later = made
    few = later[0]
    found = il.fit_tumble(few, prior=record).calibration
    at = truth(found.model["temperature"]["value"])
    for name in ("scale_factor_x", "scale_factor_y", "scale_factor_z", "misalignment_yx", "misalignment_zy"):
        error = found.value(name) - at[name]
        assert abs(error) < 4 * found.parameters[name].standard_uncertainty
    assert found.parameters["scale_factor_x"].standard_uncertainty < 2e-4  # six attitudes alone do not determine it
    for name in ("bias_x", "bias_y", "bias_z"):
        assert abs(found.value(name) - at[name]) < 6e-4 * G  # this power cycle's, 0.1 mg of scatter
    assert found.fit["prior"]["probability"] > 1e-3


def test_a_thermal_prior_holds_the_laws_and_the_scatter_at_that_temperature(made):
    from imulab.procedures.thermal.device import at_temperature
    from imulab.procedures.thermal.record import predict_parameters

    record, _ = made
    values, u = (each[:, 0] for each in predict_parameters(record, np.array([33.0])))
    held = at_temperature(record, 33.0, "x.csv")
    names = list(held.parameters)
    assert [held.value(name) for name in names] == pytest.approx(values, rel=1e-12)
    tau = record.fit["between_recordings"]["bias"]["value"]
    own = [held.parameters[name].standard_uncertainty for name in names]
    assert own[:3] == pytest.approx(np.hypot(u[:3], tau), rel=1e-9)
    assert own[6:] == pytest.approx(u[6:], rel=1e-9)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda r: replace(r, columns={k: v for k, v in r.columns.items() if k != "temperature"}),
            "no column temperature",
        ),
        (lambda r: r.with_columns({"temperature": r.column("temperature") + 70}, {}), "outside the -19.8 to 60.3 degC"),
    ],
    ids=["none", "outside"],
)
def test_a_prior_elsewhere_is_refused(made, change, said):
    record, later = made
    with pytest.raises(il.errors.RecordError) as refused:
        il.fit_tumble(change(later[0]), prior=record)
    assert said in str(refused.value)


def test_a_prior_that_does_not_know_its_scatter_is_refused():
    recordings = il.simulate_thermal([-20, 60])
    record = il.fit_thermal(list(recordings), degrees="1,1,0").calibration
    with pytest.raises(il.errors.RecordError, match="does not know how far biases move"):
        il.fit_tumble(il.simulate_thermal([10, 33], attitudes=6)[0], prior=record)


def test_the_command_takes_it_and_names_the_file(made, tmp_path, monkeypatch, capsys):
    record, later = made
    monkeypatch.chdir(tmp_path)
    record.save("thermal.json")
    il.write(later[0], "few.csv")
    assert main(["tumble", "fit", "few.csv", "--prior", "thermal.json", "-o", "few.json"], project=False) == 0
    il.write(later[0].with_columns({"temperature": later[0].column("temperature") + 70}, {}), "hot.csv")
    capsys.readouterr()
    assert main(["tumble", "fit", "hot.csv", "--prior", "thermal.json", "-o", "hot.json"], project=False) == 2
    assert "thermal.json: hot.csv: made at 80" in capsys.readouterr().err
