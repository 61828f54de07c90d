"""The line's statistics against SciPy, the standard library, published values and simulated populations."""

import math
import statistics
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
import scipy.stats

from fleets import G, make_fleet, write_attitudes, write_manifest
from imulab.cli import main
from imulab.errors import ImulabError
from imulab.fleet.engine import Summary
from imulab.fleet.figures import staggered, summary_table
from imulab.fleet.history import Past
from imulab.fleet.limits import Limits, load_limits, to_parameter_unit
from imulab.fleet.manifest import FleetManifest
from imulab.fleet.report import fleet_exhibits
from imulab.fleet.run import FleetState, run_fleet
from imulab.fleet.statistics import (
    capability,
    change_limit,
    changes_since,
    days_of,
    line_drift,
    line_statistics,
    outlier_limit,
)
from imulab.records.calibration import Parameter
from imulab.report.parameters import reading_unit
from imulab.report.traces import BAD, PANEL, PLOT, Figure, bulk, edge_marks, edge_note


def summary(serial, value, *, u=0.1, when="2026-01-01T00:00:00Z", unit="m/s^2", freedom=None, sha="s", inputs=("f",)):
    return Summary(
        serial, "tumble", when, when, "imulab", sha, inputs, {"bias_x": Parameter(value, u, unit)}, (), freedom
    )


def past(value, *, u=0.1, freedom=None, sha="old", created="2025-01-01T00:00:00Z", sources="other"):
    return Past("A", "tumble", created, created, sha, sources, {"bias_x": Parameter(value, u, "m/s^2")}, freedom)


# ---- spread, outliers, drift, capability ---------------------------------------------------------------------------


def test_spread_and_robust_z_are_those_of_other_libraries():
    values = np.random.default_rng(1).normal(3, 2, 41)
    (item,) = line_statistics([summary(str(i), float(v)) for i, v in enumerate(values)], {})
    assert item.mean == pytest.approx(statistics.fmean(values), rel=1e-14)
    assert item.deviation == pytest.approx(statistics.stdev(values), rel=1e-12)
    assert item.median == statistics.median(values.tolist())
    assert item.robust_deviation == pytest.approx(scipy.stats.median_abs_deviation(values, scale="normal"), rel=1e-12)
    assert item.z == pytest.approx((values - item.median) / item.robust_deviation)


def test_a_unit_far_off_stands_out_and_does_not_hide_itself():
    values = [*np.random.default_rng(2).normal(0, 1, 60), 12.0, -15.0]
    (item,) = line_statistics([summary(str(i), float(v)) for i, v in enumerate(values)], {})
    assert [s for s, o in zip(item.serials, item.outliers, strict=True) if o] == ["60", "61"]


def test_equal_values_and_few_units_stand_out_nowhere():
    for values in ([1.0] * 21, [1.0, 2.0, 9.0], [4.0]):
        (item,) = line_statistics([summary(str(i), v) for i, v in enumerate(values)], {})
        assert not item.outliers.any()


def test_a_unit_among_equal_ones_stands_out_by_the_mean_distance():
    values = [1.0] * 20 + [-1.0]  # the median distance is zero
    (item,) = line_statistics([summary(str(i), v) for i, v in enumerate(values)], {})
    assert item.robust_deviation == pytest.approx(math.sqrt(math.pi / 2) * 2 / 21, rel=1e-14)
    assert np.flatnonzero(item.outliers).tolist() == [20]


def test_few_units_of_a_procedure_have_a_table_and_no_distribution():
    items = line_statistics([summary(str(i), float(i)) for i in range(3)], {})
    state = FleetState("d", FleetManifest("m.csv", ".", ()), ())
    assert [type(item).__name__ for item in fleet_exhibits(state, items, []).items] == ["ReportTable"]
    more = line_statistics([summary(str(i), float(i)) for i in range(4)], {})
    found = [type(item).__name__ for item in fleet_exhibits(state, more, []).items]
    assert found == ["Figure", "ReportTable", "Figure"]


@pytest.mark.parametrize(
    ("count", "said"), [(7, "too few units (7 of 8) to tell which stands out"), (8, "none stands")]
)
def test_nobody_is_said_to_stand_out_or_not_where_there_are_too_few_units(count, said):
    items = line_statistics([summary(str(i), float(i)) for i in range(count)], {})
    exhibits = fleet_exhibits(FleetState("d", FleetManifest("m.csv", ".", ()), ()), items, [])
    assert said in exhibits.headline
    assert (exhibits.figures[0].message == "No unit stands out.") == (count == 8)
    assert dict(exhibits.facts)["units that stand out"] == ("0" if count == 8 else "–")
    (table,) = (item for item in exhibits.items if not hasattr(item, "traces"))
    assert table.rows[0][table.columns.index("stand out")] == ("0" if count == 8 else "–")


@pytest.mark.parametrize(("count", "step"), [(8, 1), (16, 2)])
def test_units_are_counted_in_whole_numbers(count, step):
    items = line_statistics([summary(str(i), float(i % 2)) for i in range(count)], {})
    exhibits = fleet_exhibits(FleetState("d", FleetManifest("m.csv", ".", ()), ()), items, [])
    assert exhibits.figures[0].layout["yaxis"]["dtick"] == step


def test_one_unit_is_shown_to_its_uncertainty_and_has_no_spread():
    table = summary_table("Tumble", line_statistics([summary("A", 9.80665e-3 * 1.23456, u=9.80665e-6)], {}))
    row = dict(zip(table.columns, table.rows[0], strict=True))
    assert (row["median"], row["typical u"], row["unit"]) == ("1.23456", "0.00100", "mg")
    assert row["robust σ"] == row["σ"] == row["drift per day"] == "–"


@pytest.mark.slow
@pytest.mark.parametrize("count", [8, 13, 40, 200, 2000])
def test_one_normal_population_in_a_hundred_has_a_unit_beyond_the_limit(count, reduced):
    trials = 1000 if reduced else 10_000
    values = np.random.default_rng(count).standard_normal((trials, count))
    distance = np.abs(values - np.median(values, axis=1, keepdims=True))
    z = distance.max(axis=1) / (1.482602218505602 * np.median(distance, axis=1))
    found = np.mean(z > outlier_limit(count))
    assert abs(found - 0.01) < 4 * math.sqrt(0.01 * 0.99 / trials) + 0.002  # 0.002: the limits are interpolated


def test_drift_is_the_least_squares_line():
    rng = np.random.default_rng(3)
    days = 20_000 + np.sort(rng.uniform(0, 90, 50))
    values = 2 + 0.01 * (days - 20_000) + rng.normal(0, 0.3, 50)
    found = line_drift(days, values, np.ones(50, dtype=bool))
    peer = scipy.stats.linregress(days, values)
    assert found.per_day == pytest.approx(peer.slope, rel=1e-9)
    assert found.standard_uncertainty == pytest.approx(peer.stderr, rel=1e-6)
    assert found.significant == (peer.pvalue < 0.001)
    assert found.value_at_start == pytest.approx(peer.intercept + peer.slope * days.min(), rel=1e-9)


def test_drift_needs_units_and_days():
    days, values = np.arange(20.0), np.arange(20.0)
    assert line_drift(days[:7], values[:7], np.ones(7, dtype=bool)) is None
    assert line_drift(days * 1e-4, values, np.ones(20, dtype=bool)) is None
    assert line_drift(days, values, days < 5) is None
    steady = line_drift(days, np.ones(20), np.ones(20, dtype=bool))
    assert (steady.per_day, steady.significant) == (0.0, False)


def test_capability_is_the_handbooks():
    """NIST/SEMATECH e-Handbook 6.1.6: USL 20, LSL 8, mean 16, standard deviation 2 gives Cpk 0.6667."""
    values = 16 + 2 * np.array([-1.0, 1.0]) / math.sqrt(2)
    assert values.std(ddof=1) == pytest.approx(2.0)
    assert capability(values, Limits(8.0, 20.0)).cpk == pytest.approx(0.6667, abs=5e-5)
    many = capability(np.tile(values, 50) * 1.0, Limits(15.0, math.inf))
    s = np.tile(values, 50).std(ddof=1)
    assert many.cpk == pytest.approx((16 - 15) / (3 * s))
    assert many.at_least == pytest.approx(many.cpk - 1.645 * math.sqrt(1 / 900 + many.cpk**2 / 198), abs=1e-4)
    assert capability(np.ones(5), Limits(0.0, 2.0)) is None


def exhibits_with_limits(values, lower, upper):
    known = {("tumble", "bias_x"): Limits(lower * 9.80665e-3, upper * 9.80665e-3)}
    units = [summary(f"U{i}", v * 9.80665e-3, when=f"2026-01-{i + 1:02d}T00:00:00Z") for i, v in enumerate(values)]
    return fleet_exhibits(FleetState("d", FleetManifest("m.csv", ".", ()), ()), line_statistics(units, known), [])


@pytest.mark.parametrize("values", [[57.9], [57.9, 57.9], [1.0, -2.0, 57.9, 0.5], [*np.linspace(-4, 4, 11), 57.9]])
def test_a_unit_beyond_its_limits_is_said_first_however_few_there_are(values):
    exhibits = exhibits_with_limits(values, -40, 40)
    broken = [f"U{i}" for i, value in enumerate(values) if value > 40]
    named, verb = ", ".join(broken), "are" if len(broken) == 2 else "is"
    assert (
        f"have their record; {named} {verb} beyond the limits of bias_x; " in exhibits.headline.replace(".", ";") + " "
    )
    assert dict(exhibits.facts)["beyond the limits"] == str(len(broken))
    first, *others = [item for item in exhibits.items if not hasattr(item, "traces")]
    assert first.title == "Units beyond their limits"
    assert [(row[0], row[4], row[5]) for row in first.rows] == [(name, "-40 to 40", "mg") for name in broken]
    every = next(table for table in others if table.title.endswith("every parameter"))
    assert every.columns.index("beyond limits") == 3  # in sight, however wide the table is
    assert every.rows[0][3] == str(len(broken))
    for figure in exhibits.figures[:1]:
        assert figure.message.startswith(f"Beyond the limits of bias_x: {named}. ")


def test_within_limits_and_without_limits():
    exhibits = exhibits_with_limits(np.linspace(-4, 4, 12), -math.inf, 40)
    assert "; none is beyond the limits; " in exhibits.headline
    assert dict(exhibits.facts)["beyond the limits"] == "0"
    bare = fleet_exhibits(
        FleetState("d", FleetManifest("m.csv", ".", ()), ()), line_statistics([summary("A", 1.0)], {}), []
    )
    assert "limit" not in bare.headline
    assert "beyond the limits" not in dict(bare.facts)
    for ends, text in (((-math.inf, 40), "at most 40"), ((60, math.inf), "at least 60")):
        tables = [item for item in exhibits_with_limits([50.0] * 3, *ends).items if not hasattr(item, "traces")]
        assert tables[0].rows[0][4] == text


def lines_of(figure, along):
    """Return range of the axis of the values, and the places of the red lines across it."""
    reds = [
        shape for shape in figure.layout["shapes"] if shape["line"] == {"color": BAD, "width": 1.5, "dash": "solid"}
    ]
    return figure.layout[f"{along}axis"].get("range"), sorted(round(shape[f"{along}0"], 6) for shape in reds)


def test_limits_are_drawn_within_the_axis_that_shows_them():
    near = exhibits_with_limits(np.linspace(-6, 4, 12), -40, 40).figures  # 3.5 times the spread away
    (low, high), drawn = lines_of(near[0], "x")
    assert drawn == [-40, 40]
    assert (low < -40, high > 40) == (True, True)
    assert lines_of(near[1], "y")[1] == []  # over the date they would press the points together
    broken = exhibits_with_limits([*np.linspace(-4, 4, 11), 57.9], -40, 40).figures
    assert lines_of(broken[0], "x")[1] == [-40, 40]
    (low, high), drawn = lines_of(broken[1], "y")
    assert drawn == [40]
    assert high > 40


@pytest.mark.slow
def test_the_bound_of_cpk_holds_in_nineteen_of_twenty_lines(reduced):
    trials = 1000 if reduced else 10_000
    rng = np.random.default_rng(4)
    true = 4 / 3
    below = [capability(rng.standard_normal(60), Limits(-4.0, math.inf)).at_least < true for _ in range(trials)]
    assert abs(np.mean(below) - 0.95) < 4 * math.sqrt(0.05 * 0.95 / trials) + 0.005  # Bissell's is an approximation


# ---- change since last time ----------------------------------------------------------------------------------------


def test_a_change_is_held_against_both_uncertainties():
    (change,) = changes_since([summary("A", 1.5, u=0.3)], {"A": [past(1.0, u=0.4)]})
    assert change.standard_uncertainty == pytest.approx(0.5)
    assert change.deviations == pytest.approx(1.0)
    assert not change.same_files


def test_few_degrees_of_freedom_count_for_less():
    """Welch and Satterthwaite's effective degrees of freedom, and the same chance in a normal distribution."""
    (change,) = changes_since([summary("A", 2.0, u=0.3, freedom=4)], {"A": [past(0.0, u=0.4, freedom=10)]})
    freedom = 0.5**4 / (0.3**4 / 4 + 0.4**4 / 10)
    chance = 2 * scipy.stats.t.sf(2.0 / 0.5, freedom)
    assert 2 * scipy.stats.norm.sf(change.deviations) == pytest.approx(chance, rel=1e-9)
    (back,) = changes_since([summary("A", -2.0, u=0.3, freedom=4)], {"A": [past(0.0, u=0.4, freedom=10)]})
    assert back.deviations == pytest.approx(-change.deviations)
    (known,) = changes_since([summary("A", 2.0, u=0.3, freedom=4)], {"A": [past(0.0, u=0.4)]})
    assert known.deviations > change.deviations


def test_the_last_calibration_is_the_one_before_this_one():
    kept = [past(1.0, sha="a"), past(2.0, sha="s", created="2026-01-01T00:00:00Z"), past(9.0, sha="later")]
    assert changes_since([summary("A", 2.0, sha="s")], {"A": kept})[0].old == 1.0
    assert changes_since([summary("A", 2.0, sha="s")], {"A": kept[1:]}) == []
    assert changes_since([summary("A", 2.0, sha="s")], {}) == []
    unknown = changes_since([summary("A", 2.0, sha="not yet in")], {"A": kept[:2]})
    assert unknown[0].old == 2.0


def test_other_units_of_measure_and_missing_uncertainties():
    assert changes_since([summary("A", 2.0, unit="count")], {"A": [past(1.0)]}) == []
    (change,) = changes_since([summary("A", 2.0, u=None)], {"A": [past(1.0)]})
    assert change.deviations is None


def test_the_limit_of_changes_is_for_all_of_them_together():
    assert 2 * scipy.stats.norm.sf(change_limit(1)) == pytest.approx(0.01)
    assert 1000 * 2 * scipy.stats.norm.sf(change_limit(1000)) == pytest.approx(0.01)


# ---- dates, units, limits ------------------------------------------------------------------------------------------


def test_dates():
    day = datetime(2026, 3, 1, tzinfo=UTC).timestamp() / 86400
    assert days_of("2026-03-01") == day
    assert days_of("2026-03-01T12:00:00Z") == day + 0.5
    assert days_of("2026-03-01T01:00:00+01:00") == day
    assert days_of("yesterday") is None


@pytest.mark.parametrize(
    ("unit", "value", "shown", "text"),
    [
        ("m/s^2", 9.80665, "mg", 1000.0),
        ("rad", 1e-3, "mrad", 1.0),
        ("rad/s", math.radians(1) / 3600, "deg/h", 1.0),
        ("m/s^2/(m/s^2)", 1.0001, "ppm off nominal", 100.0),
        ("T", 2.5e-5, "uT", 25.0),
        ("uT/T", 1.0002e6, "ppm off nominal", 200.0),
        ("count/T", 3e7, "count/uT", 30.0),
        ("1/(m/s^2)", 1e-6 / 9.80665, "µg/g²", 1.0),
        ("1/(m/s^2)^2", 1e-6 / 9.80665**2, "µg/g³", 1.0),
        ("rad/s/(m/s^2)", math.radians(1) / 3600 / 9.80665, "deg/h/g", 1.0),
        ("count/(m/s^2)", 512.0, "count/g", 5021.0048),
        ("m/s^2/K^2", 9.80665e-6, "µg/K²", 1.0),
    ],
)
def test_units_that_people_read(unit, value, shown, text):
    read = reading_unit(unit)
    assert read.symbol == shown
    assert read.of(value) == pytest.approx(text, rel=1e-9)
    for typed in (shown, shown.replace("µ", "u").replace("²", "^2").replace("³", "^3")):
        assert to_parameter_unit(text, typed, unit) == pytest.approx(value, rel=1e-12)
    assert to_parameter_unit(value, unit, unit) == value


UNITS = {("tumble", f"bias_{a}"): "m/s^2" for a in "xyz"} | {("tumble", "scale_factor_x"): "m/s^2/(m/s^2)"}


def test_limits_by_name_and_pattern(tmp_path):
    path = tmp_path / "l.toml"
    path.write_text(
        '[tumble]\n"bias_*" = { lower = -20, upper = 20, unit = "mg" }\nbias_z = { upper = 0.5, unit = "m/s^2" }\n'
        'scale_factor_x = { lower = -100, upper = 100, unit = "ppm" }\n'
    )
    found = load_limits(str(path), UNITS)
    assert found["tumble", "bias_x"].upper == pytest.approx(0.020 * 9.80665)
    assert found["tumble", "bias_z"] == Limits(-math.inf, 0.5)
    assert found["tumble", "scale_factor_x"].lower == pytest.approx(0.9999)


BAD_LIMITS = {
    "no toml": ("[tumble", "the limits file is not TOML"),
    "unknown procedure": ("[tumbel]\n", "unknown procedure 'tumbel'; known procedures: tumble array"),
    "no table": ("tumble = 3\n", "tumble: expected lines such as bias_x"),
    "unknown parameter": (
        '[tumble]\nbias_w = { upper = 1, unit = "mg" }\n',
        "tumble: no parameter 'bias_w'; parameters: bias_x bias_y bias_z scale_factor_x",
    ),
    "no record of it": ('[array]\nx = { upper = 1, unit = "mg" }\n', "none, there is no record of this procedure"),
    "no line": ("[tumble]\nbias_x = 3\n", "tumble: bias_x: expected { lower = -20"),
    "unknown key": (
        '[tumble]\nbias_x = { uper = 1, unit = "mg" }\n',
        "unknown key 'uper'; known keys: lower upper unit",
    ),
    "no unit": ("[tumble]\nbias_x = { upper = 1 }\n", "tumble: bias_x: expected a unit, and lower or upper or both"),
    "no end": ('[tumble]\nbias_x = { unit = "mg" }\n', "expected a unit, and lower or upper or both"),
    "no number": ('[tumble]\nbias_x = { upper = "1", unit = "mg" }\n', "bias_x: upper: expected a number, found '1'"),
    "infinite": ('[tumble]\nbias_x = { upper = inf, unit = "mg" }\n', "bias_x: upper: expected a number, found inf"),
    "other unit": ('[tumble]\nbias_x = { upper = 1, unit = "deg" }\n', "unit 'deg': expected m/s^2 or mg"),
    "crossed": ('[tumble]\nbias_x = { lower = 2, upper = 1, unit = "mg" }\n', "lower 2 is not below upper 1"),
}


@pytest.mark.parametrize("case", BAD_LIMITS)
def test_bad_limits_are_refused(case, tmp_path):
    text, expected = BAD_LIMITS[case]
    (tmp_path / "l.toml").write_text(text)
    with pytest.raises(ImulabError, match=r"l.toml: ") as caught:
        load_limits(str(tmp_path / "l.toml"), UNITS)
    assert expected in str(caught.value)


# ---- the report ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def line(tmp_path_factory):
    """Two days' calibrations of 16 units: bias_z drifts over the date, SN005 is far off, SN003 has changed since."""
    folder = tmp_path_factory.mktemp("line")
    rng = np.random.default_rng(5)
    scale, bias = 1 + rng.normal(0, 0.002, (16, 3)), rng.normal(0, 0.02, (16, 3))
    bias[:, 2] += 0.02 * np.arange(16)
    bias[5, 0] += 1.0
    rows = [
        {"serial": f"SN{i:03d}", "procedure": "tumble", "file": f"u{i}.csv", "gravity": G, "order": 1}
        for i in range(16)
    ]
    manifest = write_manifest(folder / "m.csv", rows)
    for day in (0, 1):
        for i in range(16):
            up = rng.standard_normal((16, 3))
            up *= G / np.linalg.norm(up, axis=1, keepdims=True)
            moved = np.array([0, 0.05, 0]) if (day, i) == (1, 3) else np.zeros(3)
            date = datetime(2026, 1, 1) + timedelta(days=30 * day + i)
            outputs = scale[i] * (up + bias[i] + moved) + rng.normal(0, 1e-3, (16, 3))
            write_attitudes(folder / f"u{i}.csv", outputs, f"# date: {date.isoformat()}\n")
        assert run_fleet(str(manifest), str(folder / "out"), workers=1).count("done") == 16
    (folder / "limits.toml").write_text('[tumble]\n"bias_*" = { lower = -60, upper = 60, unit = "mg" }\n')
    return folder


@pytest.mark.slow
def test_the_report_says_what_is_there(line, capsys):
    arguments = [
        "fleet",
        "report",
        str(line / "out"),
        "-o",
        str(line / "r.html"),
        "--limits",
        str(line / "limits.toml"),
    ]
    assert main(arguments) == 0
    assert capsys.readouterr().out == f"report: {line / 'r.html'}\n"
    page = (line / "r.html").read_text()
    assert 'class="verdict ' not in page  # a unit that stands out is no matter of one verdict on the line
    head = page[: page.index("<dl")]
    assert "16 of 16 units have their record" in head
    assert "SN005 is beyond the limits of bias_x; SN005 stands out; bias_z drifts over the date; " in head
    assert "SN003 changed since the last calibration" in head
    assert "the smallest Cpk is" in head
    for title in ("distribution over the units", "every parameter", "over the date", "change since each unit"):
        assert f"Tumble: {title}" in page
    stands_out = page[page.index("Units that stand out") : page.index("Largest changes")]
    assert '<td>SN005</td><td class="text">bias_x</td>' in stands_out
    changes = page[page.index("Largest changes") :]
    first = changes[changes.index("<tbody>") :][:600]
    assert '<td>SN003</td><td class="text">bias_y</td><td>5.1' in first
    assert "changed" in first
    assert "2026-01-04" in first


def test_without_history_and_limits_there_is_less_to_say(line):
    assert main(["fleet", "report", str(line / "out"), "-o", str(line / "less.html"), "--history", "none"]) == 0
    page = (line / "less.html").read_text()
    assert "change since" not in page
    assert "smallest Cpk" not in page


@pytest.mark.slow
def test_the_figures_are_drawn(line, chromium, tmp_path):
    import subprocess

    main(["fleet", "report", str(line / "out"), "-o", str(tmp_path / "r.html")])
    done = subprocess.run(
        [chromium, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
         f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=8000", "--dump-dom",
         (tmp_path / "r.html").as_uri()],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert 'data-drawn="3"' in done.stdout
    assert "SN005" in done.stdout


def test_a_report_needs_records(tmp_path, capsys):
    manifest = make_fleet(tmp_path / "in", 1, order=1)
    (tmp_path / "in" / "u0.csv").unlink()
    assert main(["fleet", "run", str(manifest), "-o", str(tmp_path / "out"), "--workers", "1"]) == 2
    capsys.readouterr()
    assert main(["fleet", "report", str(tmp_path / "out"), "-o", str(tmp_path / "r.html")]) == 2
    assert "no records yet: 1 units failed" in capsys.readouterr().err
    assert not (tmp_path / "r.html").exists()


def test_a_single_far_value_does_not_flatten_the_rest():
    values = np.append(np.random.default_rng(1).normal(3.0, 1.0, 200), 4000.0)
    found = bulk(values)
    inside = values[:-1]
    assert np.flatnonzero(found.beyond).tolist() == [200]
    assert found.low < inside.min()
    assert found.high > inside.max()
    assert np.ptp(inside) / (found.high - found.low) > 0.8  # the bulk fills the axis


@pytest.mark.parametrize(
    "values",
    [
        np.random.default_rng(2).normal(size=500),
        np.random.default_rng(2).uniform(size=500),
        np.array([1.0, 2.0, 900.0]),  # too few to know what is usual
        np.ones(50),
        np.append(np.zeros(20), np.full(20, 100.0)),  # two groups, and no outlier
        np.full(9, np.nan),
    ],
)
def test_what_fits_on_one_axis_is_not_clipped(values):
    assert bulk(values) is None


def test_what_is_known_to_be_usual_sets_the_axis_with_room_for_its_bars():
    values = np.array([-1.0, 0.0, 1.0, 2.0, 60.0, -80.0])
    found = bulk(values, np.array([True, True, True, True, False, False]), room=0.5)
    assert found.low == pytest.approx(-1.5 - 0.08 * 4)
    assert found.high == pytest.approx(2.5 + 0.08 * 4)
    assert found.beyond.tolist() == [False, False, False, False, True, True]


@pytest.mark.parametrize("upright", [True, False])
def test_marks_stand_at_the_edge_with_the_value(upright):
    values = np.array([-1.0, 0.0, 1.0, 2.0, 60.0, -80.0])
    found = bulk(values, np.abs(values) < 10)
    labels = [f"{v:g} µg" for v in values]
    down, up = edge_marks(found, values, [1, 2, 3, 4, 5, 6], labels, upright=upright)
    on, along = ("y", "x") if upright else ("x", "y")
    assert (down[on], down[along], down["text"]) == ([found.low], [6], ["-80 µg"])
    assert (up[on], up[along], up["text"]) == ([found.high], [5], ["60 µg"])
    assert down["marker"]["symbol"] != up["marker"]["symbol"]


@pytest.mark.parametrize("pixels", [PANEL, PLOT])
def test_a_mark_with_its_value_stands_clear_of_the_points(pixels):
    values = np.array([-1.0, 0.0, 1.0, 2.0, 60.0, -80.0])
    found = bulk(values, np.abs(values) < 10, pixels=pixels)
    a_pixel = (found.high - found.low) / pixels
    assert (found.high - 2.0) / a_pixel > 24  # a triangle of 11 pixels, a line of 13
    assert (-1.0 - found.low) / a_pixel > 24
    above = bulk(values[:5], np.abs(values[:5]) < 10, pixels=pixels)
    assert above.low == bulk(values[:5], np.abs(values[:5]) < 10).low


def test_the_numbers_of_an_x_axis_stand_off_those_of_the_y_axis():
    figure = Figure("", "", [], {"xaxis": {"title": {"text": "a"}}, "xaxis2": {"ticklen": 2}, "yaxis": {}})
    assert figure.layout["xaxis"]["ticklen"] >= 6
    assert figure.layout["xaxis2"]["ticklen"] == 2
    assert figure.layout["yaxis"] == {}


def test_the_value_of_one_mark_stands_above_the_bars():
    assert staggered(np.array([False, True, False]), 5)[1] > 5


def test_many_marks_keep_their_values_for_hovering():
    values = np.append(np.linspace(0, 1, 100), np.linspace(50, 60, 8))
    (marks,) = edge_marks(bulk(values), values, range(108), [f"{v:.0f}" for v in values])
    assert marks["mode"] == "markers"
    assert len(marks["text"]) == 8
    assert edge_note(0) == ""
    assert "8 points" in edge_note(8)
