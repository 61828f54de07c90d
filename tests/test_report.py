"""The report: complete, self-contained, safe, and drawn by a real browser without a network."""

import itertools
import re
import subprocess
from dataclasses import replace
from html import unescape

import numpy as np
import pytest

import imulab as il
from benchpage import PATIENCE
from conftest import REPOSITORY, table
from imulab.errors import RecordError
from imulab.procedures.views import exhibits_of, render_record
from imulab.records.calibration import Calibration, Covariance, Parameter
from imulab.report import render_page
from imulab.report.traces import Exhibits, Figure, ReportTable, correlation_map, format_uncertain, log_axis, narrow
from reference import tumble as reference

G = 9.80665
WRITTEN = REPOSITORY / "tests" / "data" / "written_by" / "0.2.0"


@pytest.fixture(scope="module")
def record():
    recording = il.simulate_tumble(attitudes=24, order=2, knock=7, seed=4)
    return il.fit_tumble(il.find_attitudes(recording), gravity=G, loss="huber").calibration


def browse(chromium, tmp_path, page, *options):
    """Run headless Chromium on a file, cut off from any network."""
    return subprocess.run(
        [
            chromium, "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
            "--disable-background-networking", "--disable-component-update", "--disable-sync",
            "--host-resolver-rules=MAP * ~NOTFOUND", f"--user-data-dir={tmp_path / 'profile'}",
            "--window-size=1100,3600", "--virtual-time-budget=15000", *options, page.as_uri(),
        ],
        capture_output=True, text=True, timeout=PATIENCE, check=True,
    ).stdout  # fmt: skip


def opened(browser, path, width, **options):
    """A report in a browser, once its figures are drawn."""
    page = browser.new_page(viewport={"width": width, "height": 900}, **options)
    page.set_default_timeout(1000 * PATIENCE)
    page.goto(path.as_uri())
    page.wait_for_selector("html[data-drawn]", state="attached")
    return page


@pytest.mark.slow
def test_a_browser_draws_every_figure_without_a_network(record, chromium, tmp_path):
    il.write_report(record, tmp_path / "r.html")
    dom = browse(chromium, tmp_path, tmp_path / "r.html", "--dump-dom")
    figures = [item for item in exhibits_of(record).items if isinstance(item, Figure)]
    assert f'data-drawn="{len(figures)}"' in dom
    assert dom.count('class="plot-container') == len(figures)
    for title in ("attitude", "after, µg", "before, mg", "time, s", "standard deviation, mg"):
        assert f">{title}<" in dom  # axis titles are drawn as SVG text


def test_the_page_refers_to_nothing_outside(record, tmp_path):
    il.write_report(record, tmp_path / "r.html")
    page = (tmp_path / "r.html").read_text()
    own = re.sub(r"<script>.*?</script>", "", page, flags=re.DOTALL)
    assert not re.search(r"""(?:src|href|@import|url\()\s*=?\s*["']?(?:https?:)?//""", own)
    assert page.count("</html>") == 1


@pytest.mark.parametrize("name", ["tumble", "thermal_gyro", "centrifuge"])
def test_powers_in_units_are_written_in_one_way(tmp_path, name):
    il.write_report(il.load(WRITTEN / f"{name}.json"), tmp_path / "r.html")
    page = re.sub(r"<script>.*?</script>", "", (tmp_path / "r.html").read_text(encoding="utf-8"), flags=re.DOTALL)
    assert "²" in page
    assert re.findall(r"\S*(?:/[sKg]|\))\^\S*", page) == []


def test_the_report_says_what_the_record_holds(record, tmp_path):
    il.write_report(record, tmp_path / "r.html")
    page = re.sub(r"<script>.*?</script>", "", (tmp_path / "r.html").read_text(), flags=re.DOTALL)
    assert "SIM-0004" in page
    assert "down-weighted" in page
    assert page.index('class="verdict look"') < page.index("Residual |f|")
    assert page.index("Provenance") > page.index("Correlation of the parameters")
    assert record.to_dict()["content_sha256"] in page
    for name in ("bias_x", "scale_factor_z", "misalignment_zy", "k2_y"):
        assert name in page


@pytest.mark.slow
def test_user_text_is_escaped_everywhere(record, chromium, tmp_path):
    evil = "<script>document.title='owned'</script><img src=x onerror=\"document.title='owned'\">"
    hostile = replace(
        record,
        sensor={"serial": evil, "model": evil},
        warnings=(evil,),
        options={**record.options, evil: evil},
        data={**record.data, "attitudes": {**record.data["attitudes"], "label": [evil] * record.fit["attitudes"]}},
    )
    il.write_report(hostile, tmp_path / "r.html")
    dom = browse(chromium, tmp_path, tmp_path / "r.html", "--dump-dom")
    assert "<title>owned" not in dom
    assert 'data-drawn="4"' in dom


def test_a_report_needs_nothing_but_the_saved_record(record, tmp_path):
    record.save(tmp_path / "r.json")
    il.write_report(record, tmp_path / "now.html")
    il.write_report(il.load(tmp_path / "r.json"), tmp_path / "later.html")
    assert (tmp_path / "now.html").read_bytes() == (tmp_path / "later.html").read_bytes()


def test_a_record_without_the_data_for_its_figures_has_its_parameters_and_says_what_is_not_there(record, tmp_path):
    il.write_report(replace(record, data={}), tmp_path / "r.html")
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert "The record lacks data.attitudes: its parameters alone are shown; fit again for all figures." in page
    for name in record.parameters:
        assert f">{name}<" in page


def test_names_keep_their_capitals_where_a_record_lacks_data():
    value = Parameter(1e-6, 1e-9, "rad/s/(m/s^2)")
    record = Calibration("centrifuge", {"x_K_1": value}, Covariance((), ()), {"order": 1}, {})
    assert exhibits_of(record).headline.startswith("The record lacks x_K0, or the K of any level: its parameters")


def test_a_record_with_something_else_in_place_of_the_data_for_its_figures_is_refused(record, tmp_path):
    with pytest.raises(RecordError, match=r"^data\.attitudes: expected "):
        il.write_report(replace(record, data={**record.data, "attitudes": 1.0}), tmp_path / "r.html")
    assert not list(tmp_path.iterdir())


def test_a_table_of_attitudes_without_uncertainties_has_a_report(tmp_path):
    rng = np.random.default_rng(1)
    truth = reference.random_truth(rng, 1)
    data = np.array([reference.forward(G * u, truth, 1) for u in reference.random_attitudes(rng, 9)])
    record = il.fit_tumble(il.find_attitudes(table(data)), order=1, gravity=G).calibration
    il.write_report(record, tmp_path / "r.html")
    assert "not stated" in (tmp_path / "r.html").read_text()


def test_engineering_units_of_the_parameter_table(record):
    rows = {row[0]: row for item in exhibits_of(record).items if isinstance(item, ReportTable) for row in item.rows}
    mg, ppm = 9.80665e-3, 1e-6
    assert float(rows["bias_x"][1]) == pytest.approx(record.value("bias_x") / mg, abs=1e-3)
    assert float(rows["scale_factor_y"][1]) == pytest.approx((record.value("scale_factor_y") - 1) / ppm, abs=1)
    assert float(rows["misalignment_zx"][1]) == pytest.approx(record.value("misalignment_zx") * 1e3, abs=1e-3)
    assert float(rows["k2_z"][1]) == pytest.approx(record.value("k2_z") * 9.80665 * 1e6, abs=1)
    assert [rows[n][-1] for n in ("bias_x", "scale_factor_x", "misalignment_yx", "k2_x")] == [
        "mg", "ppm off nominal", "mrad", "µg/g²",
    ]  # fmt: skip
    low, high = map(float, rows["bias_x"][-2].split(" to "))
    half = record.fit["coverage_factor_95"] * record.parameters["bias_x"].standard_uncertainty / mg
    assert high - low == pytest.approx(2 * half, abs=2e-3)


@pytest.mark.parametrize(
    ("value", "uncertainty", "expected"),
    [
        (12.34567, 0.0321, ("12.346", "0.032")),
        (12.34567, 0.0996, ("12.35", "0.10")),
        (-7153.4, 21.3, ("-7153", "21")),
        (123456.7, 1234.0, ("123500", "1200")),
        (-0.0012, 0.83, ("0.00", "0.83")),
        (1.5, None, ("1.5", "not stated")),
        (1.5, 0.0, ("1.5", "not stated")),
    ],
)
def test_values_are_written_to_the_second_digit_of_their_uncertainty(value, uncertainty, expected):
    assert format_uncertain(value, uncertainty) == expected


def test_words_stand_at_the_left():
    rows = [["1", "a.csv", "2.7e-13", "few.csv: " + "too few attitudes " * 5, "–"], ["2", "12.csv", "–", "", "–"]]
    shown = ReportTable("T", "", ["run", "file", "p", "reason", "none"], rows)
    page = re.sub(r"<script>.*?</script>", "", render_page("T", "", Exhibits("", [], [shown])), flags=re.DOTALL)
    assert re.findall("<td(.*?)>", page)[:5] == ["", ' class="text"', "", ' class="text"', ""]
    shown = ReportTable("T", "", ["name", "value", "unit"], [["soft_xx", "1.2", "1"]])  # the number 1 is a unit, too
    page = re.sub(r"<script>.*?</script>", "", render_page("T", "", Exhibits("", [], [shown])), flags=re.DOTALL)
    assert re.findall("<td(.*?)>", page) == ["", "", ' class="unit"']


def test_every_figure_has_a_text_alternative_and_a_tied_caption(record):
    exhibits = exhibits_of(record)
    page = re.sub(r"<script>.*?</script>", "", render_page("T", "", exhibits), flags=re.DOTALL)
    figures = [item for item in exhibits.items if isinstance(item, Figure)]
    found = re.findall(r'id="plot-(\d+)" role="img" aria-label="([^"]+)" aria-describedby="([^"]+)"', page)
    assert [int(number) for number, *_ in found] == list(range(len(figures)))
    for figure, (_, label, caption) in zip(figures, found, strict=True):
        assert unescape(label).startswith(figure.title)
        assert figure.message in unescape(label)
        assert page.count(f'id="{caption}"') == 1


def test_a_knocked_attitude_stands_at_the_edge_of_the_residuals_with_its_value(record):
    figure = next(f for f in exhibits_of(record).items if isinstance(f, Figure))
    low, high = figure.layout["yaxis"]["range"]
    residual = 1e6 * np.array(record.data["attitudes"]["residual"]) / G
    beyond = np.flatnonzero((residual < low) | (residual > high))
    mark = figure.traces[-1]
    assert beyond.tolist() == [7]
    assert mark["x"] == [8]
    assert float(mark["text"][0].split()[0]) == pytest.approx(residual[7] / 1e3, abs=0.01)  # mg
    assert figure.traces[1]["marker"]["symbol"][7] != figure.traces[1]["marker"]["symbol"][0]
    assert "1 point beyond the axis" in figure.caption


@pytest.mark.parametrize(("widths", "dark"), [((390, 768, 1280), False), ((390,), True)])
@pytest.mark.slow
def test_nothing_overflows_sideways(record, browser, tmp_path, widths, dark):
    side = {f"xaxis{k}": {"domain": d, "anchor": f"y{k}"} for k, d in (("", [0, 0.45]), ("2", [0.55, 1]))}
    side |= {"yaxis": {"domain": [0, 1]}, "yaxis2": {"domain": [0, 1], "anchor": "x2"}}
    exhibits = exhibits_of(record)
    pair = Figure("Pair", "", [{"type": "scatter", "x": [1, 2], "y": [1, 2]}], side)
    wide = ReportTable("Wide", "", [f"a long title {n}" for n in range(12)], [["0.123456789 ± 0.000001"] * 12])
    (tmp_path / "r.html").write_text(
        render_page("T", "S" * 60, replace(exhibits, items=[*exhibits.items, pair, wide])), encoding="utf-8"
    )
    for width in widths:
        page = opened(browser, tmp_path / "r.html", width, color_scheme="dark" if dark else "light")
        page.wait_for_function(
            """width => {
            const right = Math.max(...[...document.querySelectorAll('svg.main-svg')]
                .map(plot => plot.getBoundingClientRect().right));
            return document.documentElement.scrollWidth <= width && width / 2 < right && right <= width;
        }""",
            arg=width,
        )
        background = page.evaluate("getComputedStyle(document.body).backgroundColor")
        assert (background == "rgb(17, 23, 27)") == dark
        page.close()


def test_panels_side_by_side_go_beneath_one_another_on_a_phone():
    layout = {
        "xaxis": {"domain": [0, 0.45], "anchor": "y"}, "yaxis": {"domain": [0, 1], "title": {"text": "mg"}},
        "xaxis2": {"domain": [0.55, 1], "anchor": "y2"},
        "yaxis2": {"domain": [0, 1], "anchor": "x2", "showticklabels": False},
        "annotations": [{"text": "right", "x": 0.55, "y": 1, "xref": "paper", "yref": "paper"}],
    }  # fmt: skip
    found = narrow(Figure("", "", [], layout))
    first, second = (found["layout"][f"yaxis{k}"] for k in ("", "2"))
    assert found["layout"]["xaxis"]["domain"] == found["layout"]["xaxis2"]["domain"] == [0, 1]
    assert first["domain"][0] > second["domain"][1]
    assert second["showticklabels"]
    assert second["title"] == {"text": "mg"}
    assert found["layout"]["annotations"][0]["y"] == second["domain"][1]
    assert narrow(Figure("", "", [], {"xaxis": {}, "yaxis": {}})) is None


def test_a_table_wider_than_its_card_says_that_it_scrolls(record, browser, tmp_path):
    wide = ReportTable("Wide", "", [f"title {n}" for n in range(7)], [["0.123456789"] * 7])
    small = ReportTable("Small", "", ["a", "b"], [["1", "2"]])
    text = render_page("T", "S", replace(exhibits_of(record), items=[wide, small]))
    (tmp_path / "r.html").write_text(text, encoding="utf-8")
    for width, displays in ((390, "block none"), (1280, "none none")):
        page = opened(browser, tmp_path / "r.html", width)
        page.wait_for_function(
            """displays => displays === [...document.querySelectorAll('.sideways')]
            .map(hint => getComputedStyle(hint).display).join(' ')""",
            arg=displays,
        )
        page.close()


@pytest.mark.slow
def test_tiles_break_no_word_and_units_stay_in_view(browser, tmp_path):
    facts = [(f"walk {n}", "272.5 deg/h/sqrt(h)") for n in range(4)]
    facts += [("not told", "scale factors, misalignments, sensitivities; accelerometers")]
    columns = ["parameter", "value", "standard uncertainty", "95 % interval", "unit"]
    wide = ReportTable("Wide", "", columns, [["mag_misalignment_xy", "-92.168", "0.095", "-92.354 to -91.982", "mrad"]])
    (tmp_path / "r.html").write_text(render_page("T", "S", Exhibits("", facts, [wide])), encoding="utf-8")
    for width in (390, 768, 1280):
        page = opened(browser, tmp_path / "r.html", width)
        lines = page.evaluate(
            """() => [...document.querySelectorAll('.facts dd')].flatMap(({ firstChild }) =>
            [...firstChild.data.matchAll(/\\S+/g)].map(word => {
              const range = document.createRange();
              range.setStart(firstChild, word.index);
              range.setEnd(firstChild, word.index + word[0].length);
              return range.getClientRects().length;
            }))"""
        )
        assert set(lines) == {1}
        assert page.evaluate("document.querySelector('td.unit').getBoundingClientRect().right") < width
        page.close()


@pytest.mark.parametrize(
    ("values", "numbered"), [([1e-3, 0.2], 1), ([5.0, 41.0], "D2"), ([0.02, None, 0.035], None), ([0.0, 3.0, 40], "D2")]
)
def test_a_logarithmic_axis_of_less_than_two_decades_is_numbered_between_its_powers(values, numbered):
    traces = [{"type": "scatter", "x": [1, 10, 1e4], "y": [1, 1, 1e4]}]
    traces.append({"type": "scatter", "x": [1], "y": values, "yaxis": "y2"})
    layout = {"xaxis": log_axis("s"), "yaxis": log_axis("m"), "yaxis2": log_axis("deg/h")}
    found = Figure("", "", traces, layout).layout
    assert [found[key]["dtick"] for key in layout] == [1, 1, numbered]
    assert found["yaxis2"].get("tickformat") == (None if numbered == 1 else "~g")
    assert Figure("", "", traces, {"yaxis": log_axis("m", range=[0.2, 1.4])}).layout["yaxis"]["dtick"] == "D2"


def test_the_title_of_an_axis_may_be_a_text():
    epoch = 1.656e9
    layout = {"xaxis": {"title": "time, s"}, "yaxis": {"title": "rate, deg/s"}}
    figure = Figure("", "", [{"type": "scatter", "x": [epoch, epoch + 1], "y": [0, 1]}], layout)
    assert figure.layout["yaxis"]["title"] == {"text": "rate, deg/s"}
    assert figure.layout["xaxis"]["title"]["text"].startswith("time from 2022-06-23")
    assert figure.traces[0]["x"] == [0, 1]


def test_a_map_of_many_parameters_keeps_the_width_of_a_phone_for_its_cells():
    found = narrow(correlation_map("T", "", np.eye(37), [f"mag_misalignment_{n}" for n in range(37)], height=1092))
    assert found["layout"]["coloraxis"]["colorbar"]["orientation"] == "h"
    assert found["layout"]["yaxis"]["tickfont"]["size"] < 11
    assert found["height"] < 800


def test_a_print_hides_buttons_and_is_a4(record, chromium, tmp_path):
    il.write_report(record, tmp_path / "r.html")
    style = (tmp_path / "r.html").read_text()
    assert "size: A4" in style
    browse(chromium, tmp_path, tmp_path / "r.html", "--no-pdf-header-footer", f"--print-to-pdf={tmp_path / 'r.pdf'}")
    pdf = (tmp_path / "r.pdf").read_bytes()
    boxes = re.findall(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", pdf)
    assert {(round(float(w)), round(float(h))) for w, h in boxes} == {(595, 842)}
    assert 3 <= len(boxes) <= 5


@pytest.mark.slow
@pytest.mark.parametrize("width", [390, 768, 1280])
def test_no_cell_of_a_table_of_parameters_lies_over_another(record, browser, tmp_path, width):
    (tmp_path / "r.html").write_text(render_record(record), encoding="utf-8")
    page = opened(browser, tmp_path / "r.html", width)
    cells = page.evaluate(
        """() => [...document.querySelector('table').tBodies[0].rows].map(row =>
        [...row.cells].map(cell => cell.getBoundingClientRect()).map(box => [box.left, box.right]))"""
    )
    page.close()
    for row in cells:
        assert all(left >= before - 1 for (_, before), (left, _) in itertools.pairwise(row))
        assert row[-1][1] <= width
