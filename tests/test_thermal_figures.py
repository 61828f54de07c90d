"""What the figures of a thermal record draw, held against the coefficients, covariance and holds of the record."""

import re
from dataclasses import replace

import numpy as np
import pytest

import imulab as il
from imulab.procedures.thermal.figures import exhibits
from reference import thermal as reference

G = reference.G
NOISE = 60e-6
MILLI_G = 9.80665e-3


def soaks(attitudes):
    """Tables of attitudes at five temperatures."""
    rng = np.random.default_rng(41)
    triad, made = reference.Triad(rng), []
    for number, at in enumerate((-20, 0, 20, 40, 60)):
        outputs = np.array([triad.output(G * u, at, np.zeros(3)) for u in reference.directions(rng, attitudes)])
        outputs += NOISE * G * rng.standard_normal(outputs.shape)
        columns = {f"accel_{a}": outputs[:, k] for k, a in enumerate("xyz")}
        columns |= {f"std_accel_{a}": np.full(attitudes, NOISE * G) for a in "xyz"}
        units = dict.fromkeys(columns, "m/s^2") | {"temperature": "degC"}
        columns["temperature"] = at + 1e-3 * (-1.0) ** np.arange(attitudes)
        made.append(il.Recording(columns, units, {"gravity": f"{G} m/s^2"}, f"soak_{number}"))
    return made


@pytest.fixture(scope="module")
def record():
    return il.fit_thermal(soaks(14), degrees="3,2,1", gravity=f"{G}+-0").calibration


def figure_of(record, title):
    return next(item for item in exhibits(record).figures if item.title == title)


def law(record, name, temperature):
    """Return a law of the record and its u at temperatures, by its powers."""
    names = [each for each in record.parameters if re.fullmatch(rf"{name}(_t\d)?", each)]
    away = np.asarray(temperature) - record.model["reference_temperature"]["value"]
    powers = away[:, None] ** np.arange(len(names))
    u = np.sqrt(np.einsum("ni,ij,nj->n", powers, record.cov(*names), powers))
    return powers @ [record.value(each) for each in names], u


def test_misalignments_are_drawn_as_changes_from_values_that_the_caption_has(record):
    figure = figure_of(record, "Misalignment over temperature")
    named = float(re.search(r"value at (\S+) degC", figure.caption)[1])
    for name in ("yx", "zx", "zy"):
        stated = float(re.search(rf"\b{name} (-?[\d.]+)", figure.caption)[1])
        trace = next(each for each in figure.traces if each.get("name") == name)
        values, _ = law(record, f"misalignment_{name}", trace["x"])
        at_named, _ = law(record, f"misalignment_{name}", [named])
        assert stated == pytest.approx(1e3 * at_named[0], abs=5e-3)
        np.testing.assert_allclose(trace["y"], 1e3 * (values - at_named), atol=1e-3)


@pytest.mark.parametrize(
    ("title", "name", "row", "factor"),
    [("Bias over temperature", "bias_x", 0, 1 / MILLI_G), ("Misalignment over temperature", "misalignment_yx", 6, 1e3)],
)
def test_bands_and_what_recordings_are_off_the_laws_have_a_panel_of_their_own(record, title, name, row, factor):
    figure = figure_of(record, title)
    beneath = [each for each in figure.traces if each.get("yaxis") == "y2"]
    band = next(each for each in beneath if each.get("fill"))
    half = len(band["x"]) // 2
    u = factor * law(record, name, band["x"][:half])[1]
    np.testing.assert_allclose(band["y"][:half], -2 * u, rtol=1e-5)
    np.testing.assert_allclose(band["y"][half:][::-1], 2 * u, rtol=1e-5)
    points, own = next(each for each in beneath if each["mode"] == "markers"), record.data["calibrations"]
    off = np.array(own["values"])[:, row] - law(record, name, own["temperature"])[0]
    np.testing.assert_allclose(points["y"], factor * off, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(
        points["error_y"]["array"], 2 * factor * np.array(own["standard_uncertainty"])[:, row], rtol=1e-4
    )


def test_bands_say_that_they_lack_power_cycles_that_are_not_known(record):
    assert "what power cycles differ by included" in figure_of(record, "Bias over temperature").caption
    between = record.fit["between_recordings"] | {"from": "unknown"}
    unknown = replace(record, fit={**record.fit, "between_recordings": between})
    assert "without what power cycles add" in figure_of(unknown, "Bias over temperature").caption


@pytest.mark.parametrize(("turned", "drawn"), [((2,), False), ((0, 2, 4), True)])
def test_scale_factors_of_gyroscopes_are_drawn_over_temperature_only_where_turns_followed_it(turned, drawn):
    at = (-20, 0, 20, 40, 60)
    some, many = (list(il.simulate_thermal(at, attitudes=count, gyro=True, seed=3)) for count in (8, 14))
    given = [many[k] if k in turned else some[k] for k in range(5)]
    shown = exhibits(il.fit_thermal(given, with_="gyro").calibration)
    titles = [each.title for each in shown.figures]
    assert ("Scale factor of the gyroscopes over temperature" in titles) is drawn
    said = dict(shown.facts).get("gyroscope scale factors", "")
    assert ("taken as the same at all temperatures" in said) is not drawn


def with_a_ramp(record):
    """Return the record as if its last recording had warmed from -20 to 60 degC, thermometers of all a bit noisy."""
    held = {name: list(each) for name, each in record.data["holds"].items()}
    ramp = np.array(held["recording"]) == "soak_4"
    rate = 1e-4 * (-1.0) ** np.arange(len(ramp))
    rate[ramp] = 0.1
    temperature = np.array(held["temperature"])
    temperature[ramp] = np.linspace(-20.0, 60.0, ramp.sum())
    held |= {"rate": rate.tolist(), "temperature": temperature.tolist()}
    return replace(record, data={**record.data, "holds": held}), ramp


def test_holds_of_a_steady_temperature_are_neither_warming_nor_cooling(record):
    changed, ramp = with_a_ramp(record)
    figure = figure_of(changed, "Residual |f| - g of each hold over temperature")
    held = {each["name"]: len(each["x"]) for each in figure.traces if "means" not in each["name"]}
    assert held == {"warming": ramp.sum(), "steady": (~ramp).sum()}


def test_many_holds_are_points_without_bars_under_means(record):
    changed, _ = with_a_ramp(record)
    traces = {
        each["name"]: each for each in figure_of(changed, "Residual |f| - g of each hold over temperature").traces
    }
    assert "error_y" not in traces["steady"]
    held = changed.data["holds"]
    own = np.array([n == "soak_2" for n in held["recording"]])  # the one at 20 degC, alone in its part of the range
    residual = 1e6 * np.array(held["residual"])[own] / 9.80665
    means = traces["steady, means"]
    place = int(np.argmin(np.abs(np.array(means["x"]) - 20)))
    assert means["y"][place] == pytest.approx(residual.mean(), rel=1e-3)
    u = residual.std(ddof=1) / np.sqrt(len(residual))
    assert means["error_y"]["array"][place] == pytest.approx(2 * u, rel=2e-3)


def test_few_holds_keep_their_bars():
    few = il.fit_thermal(soaks(12), degrees="3,2,1", gravity=f"{G}+-0").calibration
    traces = figure_of(few, "Residual |f| - g of each hold over temperature").traces
    assert [each["name"] for each in traces] == ["steady"]
    assert len(traces[0]["error_y"]["array"]) == len(traces[0]["x"])
    assert traces[0]["error_y"].get("visible", True)


def test_degrees_compared_say_of_what_error_and_probability_are():
    table = next(
        item for item in exhibits(il.fit_thermal(soaks(12)).calibration).items if item.title == "Degrees compared"
    )
    assert table.columns == [
        "degrees",
        "error at temperatures left out, µg",
        "probability that the power left out is chance",
    ]
    told = [row[2] for row in table.rows]
    assert "below 1e-12" in told
    assert "0.000" not in told
