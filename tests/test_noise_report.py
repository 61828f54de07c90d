"""The reports of ``imulab allan`` and ``imulab tumble check``."""

import re
from html import unescape

import numpy as np
import pytest
from scipy.stats import chi2

import imulab as il
from imulab.estimation.column_noise import analyse
from imulab.report.noise_figures import exhibits_of_noise, interval
from imulab.report.traces import Figure

RATE = 50.0


def still(spike=0.0):
    """Three gyroscopes at rest, deg/s; one sample of the second is off by `spike`."""
    rng = np.random.default_rng(5)
    data = 0.1 * rng.standard_normal((6000, 3)) + [0.5, -0.2, 0.1]
    data[3000:3003, 1] += spike
    head = "time [s],gyro_x [deg/s],gyro_y [deg/s],gyro_z [deg/s]\n"
    rows = (f"{k / RATE:.3f},{a:.6f},{b:.6f},{c:.6f}" for k, (a, b, c) in enumerate(data.tolist()))
    return head + "\n".join(rows) + "\n"


def text_of(page):
    """The page without scripts and style."""
    return unescape(re.sub(r"<(script|style)>.*?</\1>", "", page, flags=re.DOTALL))


def test_the_allan_report_begins_with_the_verdict_and_the_coefficients(imulab, tmp_path):
    (tmp_path / "still.csv").write_text(still())
    done = imulab("allan", "still.csv", "--report", "r.html")
    assert done.returncode == 0, done.stderr
    assert "report: r.html" in done.stdout
    page = text_of((tmp_path / "r.html").read_text())
    assert page.index('class="verdict') < page.index("Noise coefficients") < page.index("Allan deviation, gyro_x")
    row = re.search(
        r"gyro_x</td><td[^>]*>angle random walk</td><td>([\d.]+)</td><td>([\d.]+)</td><td[^>]*>([^<]+)", page
    )
    value, u = float(row[1]), float(row[2])
    assert row[3] == "deg/sqrt(h)"
    assert abs(value - 0.1 / np.sqrt(RATE) * 60) < 4 * u  # N = sigma / sqrt(rate), per sqrt(h)
    figures = re.findall(r'role="img" aria-label="([^"]+)"', page)
    assert [label.split(",")[0] for label in figures] == ["Allan deviation", "The samples less their mean"]


def test_the_shaded_interval_is_that_of_chi_square(tmp_path):
    (tmp_path / "still.csv").write_text(still())
    column = analyse(il.read(tmp_path / "still.csv"))["columns"]["gyro_x"]
    freedom = il.allan_deviation(il.read(tmp_path / "still.csv").si("gyro_x"), RATE).freedom
    low, high = interval(column)
    deviation = np.array(column["deviation"])
    assert low == pytest.approx(deviation * np.sqrt(freedom / chi2.ppf(0.975, freedom)), rel=1e-6)
    assert high == pytest.approx(deviation * np.sqrt(freedom / chi2.ppf(0.025, freedom)), rel=1e-6)


def test_a_spike_does_not_flatten_the_samples(tmp_path):
    (tmp_path / "still.csv").write_text(still(spike=30.0))
    recording = il.read(tmp_path / "still.csv")
    figure = [f for f in exhibits_of_noise(analyse(recording), recording).items if isinstance(f, Figure)][-1]
    low, high = figure.layout["yaxis2"]["range"]
    assert -2 < low < -0.2
    assert 0.2 < high < 2
    marks = [trace for trace in figure.traces if "text" in trace]
    assert [float(text) for trace in marks for text in trace["text"]] == pytest.approx([30.0], abs=0.6)
    assert "range" not in figure.layout["yaxis"]
    assert "1 point beyond the axis" in figure.caption


def checked(imulab, tmp_path, *options):
    """A record and a check of it by fresh attitudes, and the page."""
    for seed, name in ((4, "one.csv"), (4, "two.csv")):
        done = imulab("tumble", "simulate", "--order", "1", "--attitudes", "20", "--seed", str(seed), "-o", name)
        assert done.returncode == 0, done.stderr
    assert imulab("tumble", "fit", "one.csv", "--gravity", "9.81+-0", "-o", "r.json").returncode == 0
    done = imulab("tumble", "check", "r.json", "two.csv", "--report", "r.html", *options)
    return done, text_of((tmp_path / "r.html").read_text())


@pytest.mark.parametrize(("gravity", "verdict", "status"), [("9.81+-0", "pass", 0), ("9.80+-0", "fail", 1)])
def test_the_check_report_says_pass_or_fail_first(imulab, tmp_path, gravity, verdict, status):
    done, page = checked(imulab, tmp_path, "--gravity", gravity)
    assert done.returncode == status, done.stderr
    assert re.search(r"<h1>\s*Tumble check: (\w+)", page)[1] == verdict
    said = done.stdout.splitlines()[0]
    assert said.startswith(verdict)
    assert said.partition(": ")[2] in page
    assert ('class="verdict bad"' in page) == (verdict == "fail")
    rows = re.findall(r"<td>(attitude \d+) [^<]*</td><td>([^<]+)</td><td>([^<]+)</td><td>([^<]+)", page)
    assert [name for name, *_ in rows] == [f"attitude {k}" for k in range(1, 21)]
    size = {"µg": 1.0, "mg": 1e3}
    for _, residual, u, ratio in rows:
        (a, unit_a), (b, unit_b) = residual.split(), u.split()
        assert float(a) * size[unit_a] / (float(b) * size[unit_b]) == pytest.approx(float(ratio), abs=0.06, rel=0.02)


@pytest.mark.parametrize("command", [("allan", "x.csv"), ("tumble", "check", "r.json", "x.csv")])
@pytest.mark.parametrize(("report", "words"), [("x.csv", "would overwrite x.csv"), ("r.pdf", "reports are HTML")])
def test_a_report_takes_the_place_of_no_input(imulab, tmp_path, command, report, words):
    (tmp_path / "x.csv").write_text(still())
    done = imulab(*command, "--report", report)
    assert done.returncode == 2
    assert words in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["x.csv"]
