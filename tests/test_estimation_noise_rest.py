"""Logs that are read block by block give what they give in memory; those with faults are looked at as a whole."""

import json

import numpy as np
import pytest

import imulab as il
from imulab import recording as disk
from imulab.cli import main
from imulab.cli.options import GivenFiles
from imulab.errors import ImulabError
from imulab.estimation.noise.rest import at_rest, long_rest
from imulab.procedures.noise import fit, procedure
from imulab.procedures.registry import run_task
from imulab.recording import Recording
from imulab.records.calibration import json_text

RATE = 50.0


def log(seed=1, n=40_000):
    rng = np.random.default_rng(seed)
    walk = 2e-3 * np.cumsum(rng.standard_normal(n))
    return {
        "time": np.arange(n) / RATE,
        "gyro_x": rng.standard_normal(n) + walk,
        "gyro_y": rng.standard_normal(n),
        "temperature": 20 + 1e-3 * np.cumsum(rng.standard_normal(n)),
    }


UNITS = {"time": "s", "gyro_x": "deg/s", "gyro_y": "deg/s", "temperature": "degC"}


def without(columns, *rows):
    kept = np.setdiff1d(np.arange(len(columns["time"])), np.concatenate([np.arange(a, b) for a, b in rows]))
    return {name: values[kept] for name, values in columns.items()}


def blocks_of(columns, size):
    for start in range(0, len(columns["time"]), size):
        part = {name: values[start : start + size] for name, values in columns.items()}
        yield Recording(part, UNITS, name="log", first_row=start + 1)


def both(columns, size=7001):
    names = ["gyro_x", "gyro_y"]
    return at_rest(Recording(columns, UNITS, name="log"), names), long_rest(blocks_of(columns, size), names)


def holes(columns):
    for row, count in ((7000, 3), (14_002, 1), (20_000, 5), (39_998, 2)):  # across the end of a block, and of the log
        columns["gyro_x"][row : row + count] = np.nan
    return columns


@pytest.mark.parametrize("size", [7001, 1000, 39_999])
@pytest.mark.parametrize(
    "columns",
    [
        log(),
        holes(log()),
        without(log(), (6999, 7003), (14_002, 14_003), (30_000, 30_009)),
        without(log(), (7001, 7101), (22_000, 22_900)),
        without(log(), (7001, 7101), (7201, 7300), (39_900, 39_950)),
    ],
    ids=["plain", "no numbers", "short gaps", "long gaps", "short stretches"],
)
def test_blocks_give_what_the_whole_log_gives(columns, size):
    whole, parts = both(columns, size)
    assert parts is not None
    assert parts.notes == whole.notes
    assert parts.interval == pytest.approx(whole.interval, rel=1e-9)
    assert parts.duration == pytest.approx(whole.duration, rel=1e-9)
    assert parts.bridged == whole.bridged
    for name in ("gyro_x", "gyro_y"):
        for one, other in zip(parts.stretches(name), whole.stretches(name), strict=True):
            assert one.count == other.count
            np.testing.assert_allclose(one.slow, other.slow, rtol=1e-7, atol=1e-12)
            np.testing.assert_allclose(one.spectra[0].power, other.spectra[0].power, rtol=1e-9)
    for one, other in zip(parts.slow("temperature"), whole.slow("temperature"), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-7, atol=1e-12)


def faulty(kind):
    columns = log()
    if kind == "stands still":
        columns["time"][9000] = columns["time"][8999]
    elif kind == "rate":
        columns["time"] = np.cumsum(np.where(np.arange(40_000) < 20_000, 1, 2)) / RATE
    elif kind == "constant":
        columns["gyro_y"][:] = 0.25
    elif kind == "clipped":
        columns["gyro_y"] = np.clip(columns["gyro_y"], -9.0, 1.0)
    elif kind == "moves":
        columns["gyro_y"][30_000:] += 200.0
    elif kind == "bad rows":
        columns["gyro_y"][10_000:11_000] = np.nan
    elif kind == "no time":
        columns["time"][9000] = np.nan
    elif kind == "many stretches":
        columns = without(columns, *((k, k + 20) for k in range(2000, 40_000, 2000)))
    elif kind == "few":
        columns = {name: values[:400] for name, values in columns.items()}
    return columns


@pytest.mark.parametrize(
    "kind", ["stands still", "rate", "constant", "clipped", "moves", "bad rows", "no time", "many stretches", "few"]
)
def test_a_faulty_log_is_looked_at_as_a_whole(kind):
    assert long_rest(blocks_of(faulty(kind), 7001), ["gyro_x", "gyro_y"]) is None


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["plain", "moves"])
def test_a_large_file_gives_the_record_of_a_small_one(tmp_path, monkeypatch, kind):
    file = tmp_path / "log.csv"
    il.write_csv(Recording(holes(faulty(kind)), UNITS, {"serial": "7"}), file)
    options = {option.name: None for option in procedure.TASK.options} | {"regress": "temperature"}

    def outcome():
        try:
            record = run_task("noise", [str(file)], options, GivenFiles())
        except ImulabError as error:
            return str(error), [], {}, []
        values = [parameter.value for parameter in record.parameters.values()]
        return list(record.parameters), values, record.sensor, record.warnings

    small = outcome()
    monkeypatch.setattr(disk, "LARGE", 0)
    large = outcome()
    assert large[0] == small[0]
    assert large[1] == pytest.approx(small[1], rel=1e-4)
    assert large[2:] == small[2:]


def test_the_rows_are_not_kept(monkeypatch):
    """What is held does not grow with the log beyond the samples that are transformed as a whole."""
    from imulab.estimation.noise import rest as module
    from imulab.estimation.noise import spectrum

    monkeypatch.setattr(spectrum, "WHOLE", 1 << 12)
    monkeypatch.setattr(spectrum, "STRETCH", 1 << 11)
    seen = []
    add = module.Accumulator.add

    def watched(self, samples):
        add(self, samples)
        seen.append(self._held)

    monkeypatch.setattr(module.Accumulator, "add", watched)
    assert long_rest(blocks_of(log(), 1000), ["gyro_x"]) is not None
    assert max(seen) <= 1 << 12
    assert len(seen) == 2 * 40


@pytest.mark.slow
def test_functions_and_check_read_a_large_file_in_blocks(tmp_path, monkeypatch, capsys):
    file, later = tmp_path / "log.csv", tmp_path / "later.csv"
    il.write_csv(Recording(log(), UNITS), file)
    il.write_csv(Recording(log(2), UNITS), later)
    record = il.fit_noise(file, columns="gyro_x,gyro_y").calibration
    small = il.check_noise(record, later)
    monkeypatch.setattr(disk, "LARGE", 0)
    monkeypatch.setattr(fit, "as_recording", None)  # as a whole it is not read
    large = il.fit_noise(file, columns="gyro_x,gyro_y").calibration
    assert large.sources == record.sources
    values = {name: each.value for name, each in record.parameters.items()}
    assert {name: each.value for name, each in large.parameters.items()} == pytest.approx(values, rel=1e-4)
    found = il.check_noise(large, later)
    for name, column in small.columns.items():
        assert found.columns[name].probability == pytest.approx(column.probability, rel=0.05, abs=0.01)
    assert any("made from this recording" in note for note in il.check_noise(large, file).notes)
    large.save(tmp_path / "record.json")
    monkeypatch.setattr(GivenFiles, "recording", None)
    assert main(["noise", "check", str(tmp_path / "record.json"), str(later), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said == json.loads(json_text(found.to_json()))


def mended(kind):
    """Columns with rows that only a look at all of them tells."""
    columns = log(n=20_000)
    rng = np.random.default_rng(4)
    if kind == "held":
        return {name: np.repeat(values, 2) if name != "time" else np.arange(40_000) / RATE
                for name, values in columns.items()}  # fmt: skip
    struck = rng.choice(20_000, 60, replace=False)
    columns["gyro_y"][struck] = {"plain": columns["gyro_y"][struck], "no numbers": np.nan, "zeros": 0.0}[kind]
    if kind == "zeros":
        columns["gyro_x"] += 30.0
        columns["gyro_x"][struck] = 0.0
    return columns


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["plain", "no numbers", "zeros", "held"])
def test_the_curve_of_a_large_file_is_that_of_a_small_one_to_the_last_bit(tmp_path, monkeypatch, capsys, kind):
    file, report = tmp_path / "log.csv", tmp_path / "page.html"
    il.write_csv(Recording(mended(kind), UNITS), file)

    def outcomes():
        assert main(["allan", str(file), "--json", "--taus", "dense"]) == 0
        curve = il.allan_deviation(file, column="gyro_y")
        assert main(["allan", str(file), "--report", str(report)]) == 0
        return capsys.readouterr(), curve.deviation.tolist(), curve.coefficients, curve.notes, report.read_text()

    small = outcomes()
    monkeypatch.setattr(disk, "LARGE", 0)
    monkeypatch.setattr("imulab.readers.read", None)  # as a whole it is not read
    assert outcomes() == small


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["zeros", "held"])
def test_a_large_file_that_has_to_be_looked_at_as_a_whole_is_not_in_memory(tmp_path, monkeypatch, kind):
    file = tmp_path / "log.csv"
    il.write_csv(Recording(mended(kind), UNITS), file)
    small = il.fit_noise(file).calibration
    assert any({"zeros": "exact zeros", "held": "stands in 2 rows"}[kind] in note for note in small.warnings)
    monkeypatch.setattr(disk, "LARGE", 0)
    monkeypatch.setattr(fit, "as_recording", None)
    held = []
    rest_of = at_rest

    def watched(recording, names):
        rest = rest_of(recording, names)
        held.extend(disk.stored_as(np.empty(1), rest.recording.column(name)) for name in names)
        return rest

    monkeypatch.setattr("imulab.procedures.noise.fit.at_rest", watched)
    large = il.fit_noise(file).calibration
    assert large.parameters == small.parameters
    assert large.warnings == small.warnings
    assert large.sources == small.sources
    assert len(held) == 2
    assert all(isinstance(values.base, np.memmap) for values in held)


def test_a_full_disk_is_said_in_one_line(tmp_path, monkeypatch, capsys):
    import errno
    import io

    class Full(io.BytesIO):
        def __init__(self, buffering):
            super().__init__()

        def write(self, _):
            raise OSError(errno.ENOSPC, "No space left on device")

    file = tmp_path / "log.csv"
    il.write_csv(Recording(mended("plain"), UNITS), file)
    monkeypatch.setattr(disk, "LARGE", 0)
    monkeypatch.setattr(disk.tempfile, "TemporaryFile", Full)
    assert main(["allan", str(file)]) == 2
    found = capsys.readouterr()
    assert found.out == ""
    assert "no room in " in found.err
    assert "TMPDIR" in found.err
    assert len(found.err.splitlines()) == 1


@pytest.mark.parametrize(
    ("lost", "words"), [(0.1, "random walk comes out 5"), (0.3, "random walk comes out 20 % too large")]
)
def test_many_lost_samples_are_said_with_what_they_do_to_the_walk(lost, words):
    rng = np.random.default_rng(7)
    kept = np.sort(rng.choice(60_000, round(60_000 * (1 - lost)), replace=False))
    samples = rng.normal(0, 0.1, (60_000, 3))[kept]
    recording = il.Recording.from_arrays(gyro=samples, time=kept * 0.02, unit="deg/s", name="lossy.csv")
    record = il.fit_noise(recording, terms="N").calibration
    assert record.verdict.state == "look"
    assert any(
        "% of the samples are lost in short gaps, which were closed up" in r and words in r
        for r in record.verdict.reasons
    ), record.verdict
    assert "record again without lost samples" in record.verdict.next
    assert np.degrees(record.value("gyro_x_white")) == pytest.approx(0.1 * np.sqrt(0.02), rel=0.02)
