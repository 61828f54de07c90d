"""Allan deviation against allantools, and coefficients against the noise that was put in."""

import json
import math
import re
import warnings
from html import unescape
from pathlib import Path

import allantools
import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2

import imulab as il
from imulab.cli import main
from imulab.errors import DataError, OptionError
from imulab.estimation import _allan
from imulab.estimation.column_noise import analyse, columns_noise, noise_lines
from imulab.estimation.noise.simulate import simulated
from imulab.estimation.noise_coefficients import allan_deviation
from imulab.estimation.sampling import sampling_rate
from imulab.recording import Recording, on_disk
from imulab.report.noise_figures import exhibits_of_noise, interval
from imulab.report.traces import Figure


@pytest.mark.parametrize("count", [5, 57, 1000, 65_537])
@pytest.mark.parametrize("taus", ["octave", "all"])
def test_it_equals_allantools(count, taus):
    if taus == "all" and count > 2000:
        pytest.skip("quadratic")
    samples = np.random.default_rng(count).standard_normal(count) + 300.0
    peer_taus, peer, _, _ = allantools.oadev(samples, rate=62.5, data_type="freq", taus=taus)
    mine = allan_deviation(samples, 62.5, "octave" if taus == "octave" else peer_taus)
    np.testing.assert_allclose(mine.tau, peer_taus[: len(mine.tau)], rtol=1e-15)
    np.testing.assert_allclose(mine.deviation, peer[: len(mine.tau)], rtol=1e-12)
    assert len(peer_taus) - len(mine.tau) <= 1


@pytest.mark.parametrize(("sums", "lags"), [(1, [0]), (1, [51]), (2, [1])])
def test_sums_of_lags_that_samples_do_not_have_are_refused(sums, lags):
    with pytest.raises(ValueError, match="do not go together"):
        _allan.fill_squares(np.empty(sums), np.zeros(100), np.array(lags))


def test_the_integral_is_the_running_sum_of_samples_less_their_mean_to_the_bit():
    samples = np.random.default_rng(2).standard_normal(10_000) + 3.0
    expected = np.cumsum(samples - 2.9)
    _allan.integrate(samples, 2.9)
    assert np.array_equal(samples, expected)


def test_dense_taus_are_24_a_decade_and_contain_those_of_allantools():
    samples = np.random.default_rng(1).standard_normal(20_000)
    dense = allan_deviation(samples, 10.0, "dense")
    assert np.count_nonzero((dense.tau >= 10) & (dense.tau < 100)) == 24
    _, peer, _, _ = allantools.oadev(samples, rate=10.0, data_type="freq", taus=dense.tau)
    np.testing.assert_allclose(dense.deviation, peer, rtol=1e-12)


def test_the_deviation_of_white_noise_and_its_uncertainty(reduced):
    trials = 150 if reduced else 300
    rng = np.random.default_rng(2)
    curves = [allan_deviation(rng.standard_normal(4096), 1.0) for _ in range(trials)]
    variance = np.array([c.deviation**2 for c in curves])
    np.testing.assert_allclose(variance.mean(axis=0)[:8] * curves[0].tau[:8], 1.0, rtol=0.05)
    stated = np.median([c.standard_uncertainty for c in curves], axis=0)
    np.testing.assert_allclose(np.std([c.deviation for c in curves], axis=0)[:8], stated[:8], rtol=0.15)


def coefficients(samples, rate):
    """Coefficients of a column."""
    return columns_noise([samples], rate)[0].coefficients


@pytest.mark.slow
@pytest.mark.parametrize(("walk", "low"), [(0.0, 0.9), (3e-3, 0.8)])
def test_coefficients_cover_what_was_put_in(walk, low, reduced):
    rng = np.random.default_rng(3)
    white, rate, covered = 0.2, 50.0, []
    for _ in range(10 if reduced else 60):
        n = 40_000
        wander = np.cumsum(rng.standard_normal(n))
        samples = white * np.sqrt(rate) * rng.standard_normal(n) + walk / np.sqrt(rate) * wander
        found = coefficients(samples, rate)
        covered.append(
            [
                abs(c.value - truth) <= 2 * c.standard_uncertainty and c.interval[0] <= truth <= c.interval[1]
                for c, truth in ((found.angle_random_walk, white), (found.rate_random_walk, walk))
            ]
        )
    assert np.mean(covered, axis=0).min() >= low


def test_flicker_noise_is_read_as_bias_instability():
    rng = np.random.default_rng(4)
    n, size = 1 << 17, 0.5
    spectrum = rng.standard_normal(n // 2) + 1j * rng.standard_normal(n // 2)
    frequency = np.arange(1, n // 2 + 1) / n
    # Density B^2 / (2 pi f), two-sided (IEEE Std 952), so B^2 / (pi f) one-sided; a line k of irfft adds 2 |X|^2 / n^2.
    lines = np.concatenate([[0], spectrum * size * np.sqrt(n / (4 * np.pi * frequency))])
    found = coefficients(np.fft.irfft(lines, n), 1.0)
    assert found.bias_instability.value == pytest.approx(size, rel=0.15)


DEG = np.pi / 180


ARW, BI = 0.3 * DEG / 60, 10.8 * DEG / 3600


def flicker(n: int, size: float, rng: np.random.Generator) -> np.ndarray:
    """1/f noise of bias instability `size`, by its spectrum (IEEE Std 952)."""
    lines = rng.standard_normal(n // 2) + 1j * rng.standard_normal(n // 2)
    lines *= size * np.sqrt(n / (4 * np.pi * np.arange(1, n // 2 + 1) / n))
    return np.fft.irfft(np.concatenate([[0], lines]), n)


def behind_a_filter(n: int, rate: float, corner: float, rng: np.random.Generator) -> np.ndarray:
    """White noise of ARW behind a first-order low-pass filter, with flicker of BI, rad/s."""
    pole = np.exp(-2 * np.pi * corner / rate)
    white = ARW * np.sqrt(rate) * lfilter([1 - pole], [1, -pole], rng.standard_normal(n + 1000))[1000:]
    return white + flicker(n, BI, rng)


@pytest.mark.parametrize("corner", [42.0, 5.0])
def test_a_low_pass_filter_does_not_spoil_the_coefficients(corner, reduced):
    # From all averaging times the fit gives ARW 0 and a bias instability ten times too large, both without a doubt.
    trials = 5 if reduced else 15
    rng = np.random.default_rng(8)
    within, u = [], []
    for _ in range(trials):
        found = coefficients(behind_a_filter(100_000, 200.0, corner, rng), 200.0)
        assert found.filtered
        for c, truth in ((found.angle_random_walk, ARW), (found.bias_instability, BI)):
            within.append(abs(c.value - truth) < 2 * c.standard_uncertainty)
        u.append(found.angle_random_walk.standard_uncertainty / ARW)
    assert np.mean(within) > 0.85
    assert np.median(u) < 0.035
    assert max(u) < 0.07  # where octaves agree at 1.6 Hz only


def test_a_curve_that_is_of_no_such_noise_gives_no_number():
    rng = np.random.default_rng(9)
    rate, n = 100.0, 100_000
    time = np.arange(n) / rate
    sway = 0.01 * np.sin(2 * np.pi * time / 40) + 0.02 * rng.standard_normal(n)
    (noise,) = columns_noise([sway], rate)
    found = noise.coefficients
    assert np.isnan(found.bias_instability.value)
    assert "the noise is not that of the model" in found.bias_instability.reason
    assert np.isnan(found.rate_random_walk.standard_uncertainty)
    # Its fast part is white noise all the same, and the mean is not better known than the curve's far end says.
    assert found.angle_random_walk.value == pytest.approx(0.002, rel=0.03)
    assert noise.mean_uncertainty(n / rate) > 2e-4  # white noise alone: 6e-5
    assert noise.fitted(noise.curve.tau) is None


def test_gauss_markov_noise_is_no_1_f_noise_and_no_walk():
    x = np.concatenate(list(simulated({"white": 0.1, "gm1_sigma": 0.1, "gm1_time": 10.0}, 0.02, 200_000, 3)))
    found = coefficients(x, 50.0)
    assert found.angle_random_walk.interval[0] < 0.1 < found.angle_random_walk.interval[1]
    for each in (found.bias_instability, found.rate_random_walk):
        assert np.isnan(each.value)
        assert "a Gauss-Markov process of" in each.reason


def test_quantisation_is_told_from_white_noise():
    rng = np.random.default_rng(10)
    rate, n, step = 100.0, 60_000, 5 * DEG / 3600
    white = 1.5e-4  # rad/s/sqrt(Hz)
    angle = np.cumsum(white * np.sqrt(rate) * rng.standard_normal(n)) / rate + 3.14e-3 * np.arange(n) / rate
    counted = np.diff(step * np.round(angle / step)) * rate  # an integrating gyro counts whole steps of angle
    found = coefficients(counted, rate)
    q = found.quantisation
    assert abs(q.value - step / np.sqrt(12)) < 3 * q.standard_uncertainty
    assert abs(found.angle_random_walk.value - white) < 3 * found.angle_random_walk.standard_uncertainty
    assert coefficients(white * np.sqrt(rate) * rng.standard_normal(n), rate).quantisation.reason


def test_steps_of_the_output_larger_than_the_noise_give_no_number():
    rng = np.random.default_rng(11)
    noise = 0.1 + rng.standard_normal(20_000)
    for lsb, known in ((1.0, True), (4.0, False)):
        samples = lsb * np.round(noise / lsb)
        found = coefficients(samples, 50.0)
        assert (found.angle_random_walk.reason == "") == known
        if known:  # rounding adds LSB^2 / 12
            arw = found.angle_random_walk
            assert abs(arw.value - np.sqrt((1 + lsb**2 / 12) / 50)) < 3 * arw.standard_uncertainty
        else:
            assert "steps that are" in found.angle_random_walk.reason


@pytest.mark.slow
def test_lines_of_the_spectrum_are_named_and_do_not_count_as_noise():
    rng = np.random.default_rng(12)
    rate, n = 62.5, 20_000
    samples = rng.standard_normal(n) + 0.8 * np.sin(2 * np.pi * 9.29 * np.arange(n) / rate)
    (found,) = columns_noise([samples], rate)
    assert found.lines == pytest.approx([9.29], abs=0.01)
    assert abs(found.coefficients.angle_random_walk.value - 1 / np.sqrt(rate)) < 0.02 / np.sqrt(rate)
    assert "column gyro_x" not in noise_lines({"gyro_x": found})[0]
    assert "gyro_x 9.29" in noise_lines({"gyro_x": found})[0]
    false = columns_noise(list(rng.standard_normal((40, 5000))), 1.0)
    assert sum(len(each.lines) for each in false) <= 1


def test_a_coefficient_is_null_with_a_reason_in_json(imulab, tmp_path):
    import imulab as il

    recording = _recording(gyro_x=np.full(3000, 0.5), gyro_y=np.random.default_rng(1).standard_normal(3000))
    il.write_csv(recording, tmp_path / "r.csv")
    printed = json.loads(imulab("allan", "r.csv", "--json").stdout)["columns"]["gyro_x"]["angle_random_walk"]
    assert (printed["value"], printed["standard_uncertainty"]) == (None, None)
    assert printed["reason"] == "all samples are the same: a dead sensor"
    shown = imulab("allan", "r.csv")
    assert "not determined" in shown.stdout
    assert "column gyro_x: noise coefficients not determined: all samples are the same" in shown.stderr


@pytest.mark.parametrize(
    ("samples", "rate", "taus", "error", "text"),
    [
        (np.zeros(2), 1.0, "octave", DataError, "at least 3 samples"),
        (np.array([0.0, np.nan, 1.0, 2.0]), 1.0, "octave", DataError, "finite"),
        (np.zeros(10), 0.0, "octave", OptionError, "sampling rate 0"),
        (np.zeros(10), 1.0, "decade", OptionError, "expected octave or dense"),
        (np.zeros(10), 1.0, "octve", OptionError, "octave or dense; did you mean 'octave'?"),
        (np.zeros(10), 1.0, np.array([99.0]), OptionError, "expected averaging times from 1 s to 4 s"),
    ],
)
def test_what_cannot_be_analysed_is_refused(samples, rate, taus, error, text):
    with pytest.raises(error, match=text):
        allan_deviation(samples, rate, taus)


def _recording(**columns):
    n = len(next(iter(columns.values())))
    units = {name: "deg/s" if name.startswith("gyro") else "s" if name == "time" else "g" for name in columns}
    return Recording(columns={"time": np.arange(n) / 10, **columns}, units={"time": "s", **units}, name="r.csv")


def test_analysis_of_a_recording_is_in_si():
    rng = np.random.default_rng(5)
    found = analyse(_recording(gyro_x=rng.standard_normal(5000), accel_x=rng.standard_normal(5000)))
    assert json.loads(json.dumps(found)) == found
    gyro = found["columns"]["gyro_x"]
    assert gyro["angle_random_walk"]["unit"] == "rad/s/sqrt(Hz)"
    assert gyro["angle_random_walk"]["value"] == pytest.approx(np.radians(1) / np.sqrt(10), rel=0.05)
    assert found["columns"]["accel_x"]["angle_random_walk"]["value"] == pytest.approx(9.80665 / np.sqrt(10), rel=0.05)


def test_coarse_stamps_do_not_change_the_sampling_rate():
    noise = np.random.default_rng(7).standard_normal(7000)
    coarse = Recording({"time": np.round(np.arange(7000) / 0.7), "gyro_x": noise}, {"time": "ms", "gyro_x": "deg/s"})
    rate, notes = sampling_rate(coarse)
    assert notes == []
    assert rate == pytest.approx(700, rel=1e-3)
    late = coarse.with_columns({"time": coarse.columns["time"] + np.where(np.arange(7000) >= 3500, 5000.0, 0.0)}, {})
    rate, notes = sampling_rate(late)
    assert len(notes) == 1
    assert rate == pytest.approx(700, rel=1e-3)
    kept = np.arange(7000) % 10 != 3  # every tenth sample missing at 100 Hz: gaps, and still 100 Hz
    rate, notes = sampling_rate(Recording({"time": np.arange(7000)[kept] * 10.0}, {"time": "ms"}))
    assert "700 gaps in time, the longest 0.02 s" in notes[0]
    assert rate == pytest.approx(100, rel=1e-9)


def test_the_command_prints_tables_and_json_and_refuses_in_one_line(imulab, tmp_path):
    import imulab as il

    rng = np.random.default_rng(6)
    good = _recording(gyro_x=rng.standard_normal(2000))
    il.write_csv(good, tmp_path / "r.csv")
    done = imulab("allan", "r.csv")
    assert done.returncode == 0, done.stderr
    assert "angle random walk" in done.stdout
    assert "deg/sqrt(h)" in done.stdout
    assert json.loads(imulab("allan", "r.csv", "--json", "--taus", "dense").stdout)["columns"]["gyro_x"]["tau"]
    time = good.columns["time"] + np.where(np.arange(2000) >= 1000, 5.0, 0.0)
    il.write_csv(good.with_columns({"time": time}, {}), tmp_path / "gap.csv")
    assert "1 gap in time, the longest 5.1 s after row 1000 (line" in imulab("allan", "gap.csv").stderr
    (tmp_path / "notime.csv").write_text("gyro_x [deg/s]\n1\n2\n3\n4\n")
    (tmp_path / "nosensor.csv").write_text("time [s],foo\n1,1\n2,2\n3,1\n4,2\n")
    for file, text in (("notime.csv", "no column time"), ("nosensor.csv", "no sensor column")):
        refused = imulab("allan", file)
        assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
        assert text in refused.stderr


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


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="only Linux tells what a process has in memory")
def test_memory_of_columns_on_disk_is_given_back_after_each():
    def mapped():
        status = Path("/proc/self/status").read_text()
        return 1024 * int(status.partition("RssFile:")[2].split()[0])

    n, names = 1 << 18, [f"gyro_{k}" for k in range(1, 9)]
    rng = np.random.default_rng(1)
    block = Recording({name: rng.standard_normal(n) for name in names}, dict.fromkeys(names, "rad/s"))
    recording = on_disk(iter([block]))
    columns_noise([block.column(names[0])], 100.0)  # what it imports is a file, too
    before = mapped()
    columns_noise([recording.column(name) for name in names], 100.0)
    assert mapped() - before < 4 * 8 * n  # of eight columns


def test_a_single_row_is_refused_without_a_warning_of_numpy(tmp_path, capsys):
    (tmp_path / "one.csv").write_text("time [s],gyro_x [deg/s]\n0,1\n")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert main(["allan", str(tmp_path / "one.csv")]) == 2
    assert capsys.readouterr().err.endswith("one.csv: 1 sample is too few; expected at least 3\n")


@pytest.mark.parametrize("command", [("allan", "x.csv"), ("tumble", "check", "r.json", "x.csv")])
@pytest.mark.parametrize(
    ("report", "words"),
    [
        ("x.csv", "would overwrite x.csv"),
        ("r.pdf", "reports are HTML"),
        ("r.txt", "r.txt: a report is HTML; expected a name that ends in .html"),
    ],
)
def test_a_report_takes_the_place_of_no_input(imulab, tmp_path, command, report, words):
    (tmp_path / "x.csv").write_text(still())
    done = imulab(*command, "--report", report)
    assert done.returncode == 2
    assert words in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["x.csv"]


def test_a_coefficient_that_does_not_show_is_printed_below_its_interval(imulab, tmp_path):
    still = tmp_path / "still.csv"
    imulab("noise", "simulate", "--white", "0.3 deg/sqrt(h)", "--duration", "10 min", "-o", still)
    walk = json.loads(imulab("allan", still, "--json").stdout)["columns"]["gyro_y"]["rate_random_walk"]
    assert walk["value"] == 0
    limit = walk["interval_95"][1] * 3600 * 180 / math.pi * 60
    shown = re.search(r"gyro_y +rate random walk +< ([\d.]+) +deg/h/sqrt\(h\)\n", imulab("allan", still).stdout)
    assert float(shown[1]) == pytest.approx(limit, rel=0.05)
