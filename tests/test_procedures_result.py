"""Results that show themselves: text, HTML, figures in notebooks and files, data frames, and what is done next."""

import json
import os
import re
import subprocess
import sys
import time
from importlib.resources import files

import numpy as np
import pandas
import polars
import pytest

import imulab as il
from imulab.cli import main
from imulab.errors import DataError, ImulabError, OptionError, RecordError
from imulab.procedures.views import exhibits_of
from imulab.report import plots as plots_module
from imulab.report.noise_figures import thinned
from imulab.report.plots import Plot
from imulab.report.traces import Figure
from test_report import browse

G = 9.80665


@pytest.fixture(scope="module")
def recording():
    return il.simulate_tumble(attitudes=24, order=2, knock=7, seed=4, gravity=G)


@pytest.fixture(scope="module")
def fit(recording):
    return il.fit_tumble(il.find_attitudes(recording), order=2, gravity=G)


def tumble():
    return il.fit_tumble(il.find_attitudes(il.simulate_tumble(order=1, gravity=G)), order=5, gravity=G)


def array():
    return il.calibrate_array(il.simulate_array(experiment="static", duration=60.0))


def warmup():
    temperatures = (-40.0, 0.0, 60.0)
    cycles = [il.simulate_power_cycle(at, seed=(1, number)) for number in (1, 2) for at in temperatures]
    return il.fit_warmup(cycles, temperatures=temperatures, model="exponential")


@pytest.fixture(scope="module")
def centrifuge(tmp_path_factory):
    folder = tmp_path_factory.mktemp("centrifuge") / "test"
    made = ["--levels", "1,10,20", "--duration", "60 s", "--static-duration", "30 s", "-o", str(folder)]
    assert main(["centrifuge", "simulate", *made]) == 0
    return folder / "manifest.toml"


@pytest.mark.parametrize("made", [tumble, array, warmup])
def test_every_result_shows_itself_in_twelve_lines_and_as_a_table(made):
    result = made()
    record = result.calibration
    for shown in (record, result):
        lines = repr(shown).splitlines()
        assert len(lines) <= 12
        assert max(map(len, lines)) < 250
    assert (result.parameters, result.verdict) == (record.parameters, record.verdict)
    assert record.sensor["serial"] in repr(result)
    assert record.verdict.state in repr(result)
    assert exhibits_of(record).headline in repr(record)
    page = result._repr_html_()
    every = page.partition("<details>")[2] or page  # those that show a table of their own first
    assert every.count("<tr>") == len(record.parameters) + 1
    assert "standard uncertainty" in page
    figures = [item.title for item in exhibits_of(record).items if isinstance(item, Figure)]
    assert [plot.name for plot in result.plot()] == figures


def test_the_parameters_of_a_text_are_those_of_the_record_in_engineering_units(fit):
    (line,) = [line for line in repr(fit.calibration).splitlines() if line.split()[0] == "bias"]
    found = re.fullmatch(r"  bias +x (\S+) ± (\S+), y (\S+) ± (\S+), z (\S+) ± (\S+) mg", line)
    for number, axis in enumerate("xyz"):
        bias = fit.calibration.parameters[f"bias_{axis}"]
        value, uncertainty = float(found[2 * number + 1]), float(found[2 * number + 2])
        assert value * 9.80665e-3 == pytest.approx(bias.value, abs=0.06 * uncertainty * 9.80665e-3)
        assert uncertainty * 9.80665e-3 == pytest.approx(bias.standard_uncertainty, rel=0.06)


def rows_of(text):
    """Cells of the table in a result's text, which stand two spaces apart or more."""
    titles, *rows = [re.split(r"  +", line.strip()) for line in text.splitlines() if line.startswith("  ")]
    return titles, {row[0]: row[1:] for row in rows}


def pair(cell):
    return [float(part) for part in cell.split(" ± ")]


def test_an_array_shows_bias_and_angle_random_walk_of_each_gyro():
    made = array()
    titles, rows = rows_of(repr(made))
    assert titles[1:3] == ["bias, deg/s", "ARW, deg/√h"]
    assert len(rows) == made.calibration.model["elements"]
    for number, cells in enumerate(rows.values(), start=1):
        bias = made.calibration.parameters[f"bias_{number}"]
        value, u = pair(cells[0])
        assert value == pytest.approx(np.degrees(bias.value), abs=0.06 * u)
        assert u == pytest.approx(np.degrees(bias.standard_uncertainty), rel=0.06)


def test_a_warm_up_shows_what_it_takes_off_at_power_on_and_the_error_before_and_after():
    made = warmup()
    titles, rows = rows_of(repr(made))
    assert titles[1:6] == ["power-on, -40 °C", "power-on, 0 °C", "power-on, 60 °C", "rms before", "rms after"]
    for i, (axis, cells) in enumerate(rows.items()):
        table = made.table.coefficients_at(0.0)[i]  # a sum of exponentials is their sum at the start
        assert axis == made.table.axes[i]
        factor = 206264.8 if cells[-1] == "deg/h" else 1e6 / 9.80665
        assert float(cells[1]) == pytest.approx(table.sum() * factor, rel=6e-3)
        none = next(row for row in made.models if row.label == "none")
        assert float(cells[3]) == pytest.approx(none.training[i] * factor, rel=0.06)


def test_a_centrifuge_test_shows_its_curve_and_the_change_at_the_highest_level(centrifuge):
    record = il.fit_centrifuge(centrifuge).calibration
    titles, rows = rows_of(repr(record))
    assert titles == ["axis", "K0, deg/h/g", "c1, ppm/g", "c2, ppm/g²", "change at 20 g, %"]
    for prefix, label in (("x_", "X"), ("y_", "Y")):
        cells = [pair(cell) for cell in rows[label]]
        for (value, u), name, factor in zip(cells, ("K0", "c1", "c2"), (2022767.0, 9.80665e6, 96.17e6), strict=False):
            p = record.parameters[prefix + name]
            assert value == pytest.approx(p.value * factor, abs=0.06 * u)
            assert u == pytest.approx(p.standard_uncertainty * factor, rel=0.06)
        c1, c2 = (record.value(prefix + name) for name in ("c1", "c2"))
        top = 20 * 9.80665
        C = record.cov(prefix + "c1", prefix + "c2")
        gradient = np.array([top, top**2])
        assert cells[3][0] == pytest.approx(100 * (c1 * top + c2 * top**2), abs=0.1)
        assert cells[3][1] == pytest.approx(100 * np.sqrt(gradient @ C @ gradient), rel=0.06)


def test_the_text_of_a_verdict_names_the_gravest_reason(fit):
    assert fit.calibration.verdict.state != "good"
    second = repr(fit.calibration).splitlines()[1]
    assert second.startswith(f"{fit.calibration.verdict.state}: ")
    assert fit.calibration.verdict.reasons[0][:40] in second


def test_parameters_and_covariance_as_tables_and_arrays(fit):
    record = fit.calibration
    for frame in (record.to_frame(), fit.to_frame("polars")):
        assert list(frame["parameter"]) == list(record.parameters)
        assert list(frame["value"]) == [p.value for p in record.parameters.values()]
        assert next(iter(frame["unit"])) == "m/s^2"
        np.testing.assert_allclose(frame["standard_uncertainty"].to_numpy() ** 2, np.diag(record.cov()), rtol=1e-9)
    assert isinstance(record.to_frame(), pandas.DataFrame)
    assert isinstance(record.to_frame("polars"), polars.DataFrame)
    pair = record.cov("bias_z", "bias_x")
    names = record.covariance.names
    assert pair[0, 1] == record.cov()[names.index("bias_z"), names.index("bias_x")]
    with pytest.raises(RecordError, match="lacks the covariance of bais_x"):
        record.cov("bais_x")


def test_what_is_done_next_is_what_the_functions_do(fit, recording, tmp_path):
    fit.save(tmp_path / "r.json")
    fit.report(tmp_path / "r.html")
    il.write_report(fit.calibration, tmp_path / "same.html")
    assert (tmp_path / "r.html").read_bytes() == (tmp_path / "same.html").read_bytes()
    again = il.Calibration.load(tmp_path / "r.json")
    expected = il.apply(again, recording)
    frame = fit.apply(recording.to_frame("polars"))
    arrays = fit.apply({"accel": recording.triad("accel")}, unit="m/s^2")
    assert type(frame).__module__.startswith("polars")
    for made in (fit.apply(recording), il.Recording.from_frame(frame), arrays):
        np.testing.assert_array_equal(made.triad("accel"), expected.triad("accel"))
    assert [path.name for path in fit.export("blob", tmp_path / "fw")] == ["unit.blob"]
    with pytest.raises(OptionError, match=r"unknown option 'losy'.*did you mean 'lossy'"):
        fit.export("px4", tmp_path / "fw", losy=True)


def test_a_figure_is_found_by_number_or_words(fit):
    plots = fit.plot()
    assert fit.plot("SPHERE").name == plots["Attitudes on the sphere"].name == plots[1].name
    assert [plot.name for plot in plots[1:3]] == [plots[1].name, plots[2].name]
    assert len(repr(plots).splitlines()) <= 12
    with pytest.raises(OptionError, match="plot 'spear': no such figure; expected one of 'Residual"):
        fit.plot("spear")
    with pytest.raises(OptionError, match=r"plot 'the': .* figures of that name; expected one of"):
        fit.plot("the")


def test_a_notebook_gets_json_and_html_and_the_library_once(fit, monkeypatch):
    cell = [("a", 1)]
    monkeypatch.setattr(plots_module, "_where", lambda: cell[0])
    monkeypatch.setattr(plots_module, "_FIRST", plots_module._First())
    sizes = []
    for cell[0] in [("a", 1), ("a", 1), ("b", 2), ("a", 3), ("c", 4)]:
        bundle = fit.plot("sphere")._repr_mimebundle_()
        sizes.append(len(bundle["text/html"]))
    drawn = bundle["application/vnd.plotly.v1+json"]
    assert json.loads(json.dumps(drawn, allow_nan=False))["layout"]["title"]["text"] == "Attitudes on the sphere"
    carried = [size > 400_000 for size in sizes]
    assert carried == [True, False, False, True, False]  # the first cell brings it again when it runs again
    assert max(sizes) < 800_000
    assert min(sizes) < 30_000
    monkeypatch.setitem(sys.modules, "google.colab", pytest)
    assert len(fit.plot("sphere")._repr_mimebundle_()["text/html"]) > 400_000


@pytest.mark.slow
def test_a_browser_draws_what_a_notebook_gets_without_a_network(fit, chromium, tmp_path, monkeypatch):
    monkeypatch.setattr(plots_module, "_FIRST", plots_module._First())
    monkeypatch.setattr(plots_module, "_where", lambda: ("a", 1))
    outputs = "".join(plot._repr_mimebundle_()["text/html"] for plot in fit.plot())
    (tmp_path / "cells.html").write_text(f"<!doctype html><meta charset=utf-8>{outputs}")
    dom = browse(chromium, tmp_path, tmp_path / "cells.html", "--dump-dom")
    assert dom.count('class="plot-container') == len(fit.plot())
    assert "after, µg" in dom


@pytest.mark.parametrize("made", [tumble, warmup])
@pytest.mark.slow
def test_no_legend_lies_on_a_title(made, chromium, tmp_path):
    figures = [plot.to_dict() for plot in made().plot()]
    library = files("imulab.report").joinpath("vendor", "plotly-cartesian.min.js").read_text()
    script = """
        const boxes = (place, name) => [...place.querySelectorAll(name)].map(one => one.getBoundingClientRect());
        Promise.all(figures.map(figure => {
            const place = document.body.appendChild(document.createElement("div"));
            return Plotly.newPlot(place, figure.data, {...figure.layout, width: 900}).then(() => {
                const [title] = boxes(place, ".gtitle"), legends = boxes(place, ".legend .bg");
                return legends.map(legend => legend.top - title.bottom);
            });
        })).then(gaps => { document.title = "gaps " + gaps.flat().map(Math.round).join(" ") });
    """
    page = tmp_path / "titles.html"
    page.write_text(
        f"<!doctype html><meta charset=utf-8><body><script>{library}</script>"
        f"<script>const figures = {json.dumps(figures)};{script}</script>"
    )
    dom = browse(chromium, tmp_path, page, "--dump-dom")
    gaps = [int(gap) for gap in re.search("<title>gaps ([^<]+)", dom)[1].split()]
    assert gaps
    assert min(gaps) >= 0


def test_a_figure_is_saved_as_a_page(fit, tmp_path):
    fit.plot("sphere").save(tmp_path / "one.html")
    fit.plot().save(tmp_path / "all.html")
    one, every = (
        re.sub(r"<script>.*?</script>", "", (tmp_path / name).read_text(), flags=re.DOTALL)
        for name in ("one.html", "all.html")
    )
    assert one.count("<figure>") == 1
    assert every.count("<figure>") == len(fit.plot())
    assert "Provenance" not in one


@pytest.mark.parametrize(("kind", "begin"), [("png", b"\x89PNG"), ("svg", b"<svg"), ("pdf", b"%PDF")])
@pytest.mark.slow
def test_a_figure_is_saved_as_a_picture(fit, chromium, tmp_path, kind, begin):
    pytest.importorskip("kaleido")
    path = tmp_path / f"sphere.{kind}"
    fit.plot("sphere").save(path)
    assert path.read_bytes().startswith(begin)
    assert path.stat().st_size > 4000


@pytest.mark.slow
def test_a_browser_that_does_not_answer_is_ended(tmp_path):
    pytest.importorskip("kaleido")
    browser = tmp_path / "browser"
    browser.write_text("#!/bin/sh\nexec sleep 100\n")
    browser.chmod(0o755)
    script = (
        "import imulab as il, imulab.report.plots as plots\n"
        "plots._PATIENCE = 2.0\n"
        "try:\n"
        "    il.simulate_tumble(gravity=9.81).plot('accel').save('x.png')\n"
        "except il.errors.OptionError as error:\n"
        "    print(error)\n"
    )
    command = [sys.executable, "-c", script]
    environment = os.environ | {"BROWSER_PATH": str(browser)}
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout == "x.png: Chromium did not draw the picture: no answer within 2 s\n"
    assert not (tmp_path / "x.png").exists()


@pytest.mark.parametrize(
    ("name", "without", "words"),
    [
        ("x.gif", None, r"x.gif: expected a name that ends in .html, .png, .svg or .pdf"),
        (
            "x.png",
            "kaleido",
            r"x.png: a picture needs kaleido: pip install '\.\[plots\]' in imulab's source folder; .html needs nothing",
        ),
    ],
)
def test_a_figure_that_cannot_be_saved_is_refused_in_a_line(fit, tmp_path, monkeypatch, name, without, words):
    monkeypatch.chdir(tmp_path)
    if without:
        monkeypatch.setitem(sys.modules, without, None)
    with pytest.raises(OptionError, match=words):
        fit.plot("sphere").save(name)
    with pytest.raises(OptionError, match=r"ends in|a picture holds one figure"):
        fit.plot().save(name)
    assert not list(tmp_path.iterdir())


def test_a_recording_shows_itself_and_draws_its_sensors(recording):
    page = recording._repr_html_()
    assert page.count("<tr>") == len(recording.columns) + 1
    assert f"{len(recording)} samples" in page
    drawn = recording.plot("accel").figure
    assert [trace["name"] for trace in drawn.traces] == ["accel_x", "accel_y", "accel_z"]
    assert max(drawn.traces[0]["y"]) == recording.column("accel_x").max()
    assert min(drawn.traces[2]["y"]) == recording.column("accel_z").min()
    assert len(drawn.traces[0]["y"]) <= 4000
    table = il.Recording.from_arrays(accel=np.eye(3), unit="g")
    assert table.plot()[0].figure.layout["xaxis"]["title"]["text"] == "row"
    assert isinstance(table.plot("accel"), Plot)


def test_a_thinned_curve_keeps_what_stands_out_and_its_gaps():
    values = np.zeros(100_000)
    values[[12_345, 54_321]] = [7.0, -3.0]
    values[60_000:61_000] = np.nan
    place, kept = thinned(np.arange(100_000.0), values, 500)
    assert kept.size == place.size == 1000
    assert (np.nanmax(kept), np.nanmin(kept)) == (7.0, -3.0)
    assert abs(place[np.nanargmax(kept)] - 12_345) < 200
    gap = place[np.isnan(kept)]
    assert 59_900 < gap.min() < gap.max() < 61_100


def test_a_person_gets_one_line_without_a_library(fit, monkeypatch):
    for library in ("pandas", "polars"):
        monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(DataError, match="needs pandas or polars, which is not installed: pip install pandas"):
        fit.to_frame()


@pytest.mark.parametrize("data", [3.0, None, b"x.csv", "no such file.csv", [["a"]], np.zeros(5), {"accel": 3}])
def test_what_is_no_recording_is_refused_in_a_line(fit, data):
    with pytest.raises(ImulabError) as refused:
        fit.apply(data, **({} if isinstance(data, str) else {"unit": "g"}))
    assert "\n" not in str(refused.value)


def test_importing_imulab_loads_no_library_that_draws_or_tabulates():
    code = "import imulab, sys; print(*{name.split('.')[0] for name in sys.modules})"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not {"numpy", "scipy", "pandas", "polars", "plotly", "kaleido", "IPython", "jinja2", "pydantic"} & set(
        loaded
    )


def check():
    first = il.simulate_tumble(gravity=G)
    truth = {key[6:]: float(text) for key, text in first.metadata.items() if key.startswith("truth_")}
    second = il.simulate_tumble(gravity=G, truth=truth, seed=2)
    return il.check_tumble(il.fit_tumble(first, order=1, gravity=G).calibration, second, limit=2e-3, gravity=G)


def changes():
    fits = [il.fit_tumble(il.simulate_tumble(gravity=G, seed=seed), order=1, gravity=G) for seed in (1, 2)]
    return il.compare_records(*(fit.calibration for fit in fits))


def fused():
    board = il.simulate_array(session=1)
    columns = {name: values.copy() for name, values in board.columns.items()}
    columns["gyro_3"][3000:4000] = columns["gyro_3"][3000]
    columns["gyro_2"][1000:1010] = np.nan
    return il.fuse(il.Recording(columns, board.units))


def curve():
    return il.allan_deviation(il.simulate_array(experiment="static", duration=60.0), column="gyro_1")


def compared():
    return il.compare_methods(il.simulate_array(session=1))


@pytest.mark.parametrize(
    ("made", "names", "rows"),
    [
        (check, ["Residual |f| − g of each fresh attitude under the record"], 24),
        (changes, ["Change of each parameter in units of its standard uncertainty"], 9),
        (fused, ["Fused rate over time", "State of each gyro"], 6),
        (curve, ["Allan deviation, gyro_1"], 3),  # the coefficients stand first
        (
            compared,
            ["Allan deviation of each method", "Angle error over time", "Weight and health of each gyro under robust"],
            7,
        ),
    ],
)
def test_results_that_are_no_records_show_tables_and_figures(made, names, rows, tmp_path):
    result = made()
    assert [plot.name for plot in result.plot()] == names
    page = result._repr_html_()
    assert page.count("<tr>") == rows + 1
    assert page.startswith("<div><strong>")
    assert "nan" not in json.dumps(result.plot(names[0]).to_dict(), allow_nan=False)
    assert len(repr(result).splitlines()) <= 12
    result.plot(names[0]).save(tmp_path / "x.html")
    with pytest.raises(OptionError, match="plot 'no such': no such figure; expected one of"):
        result.plot("no such")


def test_the_figure_of_a_fused_rate_marks_where_gyros_fail():
    result = fused()
    rate, states = (plot.to_dict() for plot in result.plot())
    drawn = {trace["name"]: trace for trace in rate["data"]}
    assert "gyro_2" in drawn["non-finite"]["text"]
    first = drawn["non-finite"]["text"].index("gyro_2")
    assert drawn["non-finite"]["x"][first] == pytest.approx(result.time[1000])
    assert "gyro_3" in drawn["stuck"]["text"]
    assert max(drawn["rate"]["y"]) == pytest.approx(result.rate.max(), rel=1e-6)
    stuck = next(trace for trace in states["data"] if trace["name"] == "stuck")
    assert set(stuck["y"]) == {"gyro_3"}
    assert result.time[3000] < min(stuck["x"]) < max(stuck["x"]) < result.time[4010]
    whole = il.fuse(il.simulate_array(experiment="static", duration=10.0)).plot("rate").figure
    assert (len(whole.traces), whole.caption) == (1, "No gyro was flagged.")
    assert result.plot("rate").figure.caption.startswith("Marks: ")


def test_a_change_is_drawn_in_units_of_its_uncertainty():
    result = changes()
    (trace,) = result.plot("change").to_dict()["data"]
    for x, name, change in zip(trace["x"], trace["y"], result.changes, strict=True):
        assert name == change.name
        assert x == pytest.approx(change.difference / change.standard_uncertainty)
    bias = result.changes[0]
    name, difference, u, _, unit, _ = result.shown()[2][0]
    assert (name, unit) == ("bias_x", "mg")
    assert float(difference) * 9.80665e-3 == pytest.approx(bias.difference, rel=1e-3)
    assert float(u) * 9.80665e-3 == pytest.approx(bias.standard_uncertainty, rel=0.06)


def test_records_are_compared_from_their_files_as_by_the_command(tmp_path, capsys):
    for seed in (1, 2):
        il.fit_tumble(il.simulate_tumble(gravity=G, seed=seed), order=1, gravity=G).save(tmp_path / f"{seed}.json")
    found = il.compare_records(tmp_path / "1.json", str(tmp_path / "2.json"))
    assert main(["show", str(tmp_path / "1.json"), str(tmp_path / "2.json"), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert [each["difference"] for each in printed["changes"]] == [each.difference for each in found.changes]
    assert set(printed) == {"changes", "probability", "left_out", "models"}
    with pytest.raises(
        OptionError, match="compare_records: second: expected a record or the name of its file, found 3"
    ):
        il.compare_records(tmp_path / "1.json", 3)


def test_ten_million_rows_are_drawn_in_two_seconds_with_their_spikes():
    samples = np.random.default_rng(1).normal(size=10_000_000)
    samples[1_234_567], samples[7_654_321], samples[5_000_000] = 40.0, -55.0, np.nan
    recording = il.Recording({"time": np.arange(10_000_000) / 1e3, "gyro_x": samples}, {"time": "s", "gyro_x": "deg/s"})
    begun = time.process_time()
    (drawn,) = recording.plot("gyro").to_dict()["data"]
    assert time.process_time() - begun < 2
    x, y = np.array(drawn["x"]), np.array(drawn["y"], dtype=np.float64)
    assert len(y) <= 4000
    assert (y.max(), y.min()) == (40.0, -55.0)
    assert x[np.argmax(y)] == pytest.approx(1234.567, abs=10_000 / 2000)  # a column of pixels
    assert x[np.argmin(y)] == pytest.approx(7654.321, abs=10_000 / 2000)


def test_plans_of_chamber_and_centrifuge_are_drawn():
    chamber, on = il.plan_warmup(cycles=3).plot().figure.traces
    lengths = np.diff([[x for x in on["x"] if x is not None][k::2] for k in (0, 1)], axis=0)
    assert lengths == pytest.approx(np.full((1, 24), 600 / 3600))
    assert set(on["y"]) - {None} == {-40, -30, -20, -10, 0, 40, 50, 60}
    assert (np.diff(chamber["x"]) > 0).all()
    plan = il.plan_centrifuge("1,2,5", net_rate="40 deg/s")
    predicted, wanted = plan.plot().figure.traces
    assert predicted["x"] == pytest.approx([1, 2, 5])
    assert predicted["y"] == [100 * level.relative for level in plan.levels]
    assert wanted["y"] == [100 * plan.wanted] * 2


def test_plans_for_scripts_add_up():
    """In SI: a chamber's steps fill its duration, and levels follow from arm rates by a = w^2 r, runs from levels."""
    chamber = json.loads(json.dumps(il.plan_warmup(cycles=3).content()))
    steps = chamber["steps"]
    assert sum(step["duration"] for step in steps) == chamber["duration"]["value"]
    assert sum(step["action"] == "power on and record" for step in steps) == 3 * len(chamber["temperatures"])
    arm = json.loads(json.dumps(il.plan_centrifuge("1,10", radius="2 m", cycles=1).content()))
    forces, rates = ([level[name] for level in arm["levels"]] for name in ("specific_force", "arm_rate"))
    assert {(force["unit"], rate["unit"]) for force, rate in zip(forces, rates, strict=True)} == {("m/s^2", "rad/s")}
    assert [2.0 * rate["value"] ** 2 for rate in rates] == pytest.approx([9.80665, 98.0665])
    assert [force["value"] for force in forces] == pytest.approx([9.80665, 98.0665])
    assert arm["total"]["value"] == arm["static_duration"]["value"] + 2 * arm["duration"]["value"]
    table = json.loads(json.dumps(il.plan_rate("0,100", arw="0.3 deg/sqrt(h)", uncertainty="10 ppm").content()))
    assert [rate["rate"]["value"] for rate in table["rates"]] == pytest.approx(np.radians([0, 100]).tolist())
    assert all(rate["uncertainty"]["value"] <= rate["wanted"]["value"] for rate in table["rates"])
