"""Each IMU of a board predicted by the others: against least squares transcribed apart, and a real board."""

import json

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.display import Note
from reference.imus import make_board
from test_gyro_array_imus_fuse import true_record

PLACES = 0.02 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.3], [0.5, 0.2, 1]])


def head_of(board):
    """The truth of a board in the form that `true_record` reads."""
    head = {"serial": "B1"}
    for k in range(len(board.position)):
        for name in ("accel", "accel_bias", "position", "gyro", "gyro_bias"):
            head[f"truth_{name}_{k + 1}"] = " ".join(repr(float(v)) for v in getattr(board, name)[k].ravel())
        head[f"truth_latency_{k + 1}"] = "0 0"
    return head


def board_in_hand(places=PLACES, seed=4, turning=6.0):
    """A recording of 6 s at 200 Hz: at rest for 2 s, then turned about all axes; and the board."""
    rng = np.random.default_rng(seed)
    board = make_board(places, rng)
    time = np.arange(1200) / 200
    phase = 2 * np.pi * np.outer(time - 2, [0.7, 0.9, 1.1]) + rng.uniform(0, 6, 3)
    on = (time > 2)[:, None]
    rate, acceleration = (
        on * turning * np.sin(phase), on * turning * 2 * np.pi * np.array([0.7, 0.9, 1.1]) * np.cos(phase),
    )  # fmt: skip
    force = [0.0, 0.0, 9.81] + on * 3 * np.sin(1.7 * phase)
    readings = board.readings(force, rate, acceleration)
    readings += np.array([0.03, 1.75e-3])[:, None, None] * rng.standard_normal(readings.shape)
    columns, units = {"time": time}, {"time": "s"}
    for s, (sensor, unit) in enumerate((("accel", "m/s^2"), ("gyro", "rad/s"))):
        for k in range(len(places)):
            for i, axis in enumerate("xyz"):
                columns[f"{sensor}_{axis}_{k + 1}"] = np.ascontiguousarray(readings[:, s, k, i])
                units[f"{sensor}_{axis}_{k + 1}"] = unit
    return il.Recording(columns, units, head_of(board), "hand.csv"), board, readings


def predicted(board, readings, k):
    """Force at IMU k by the others, (n, 3): least squares over it and the angular acceleration."""
    others = [j for j in range(len(board.position)) if j != k]
    felt = [np.linalg.solve(board.accel[j], (readings[:, 0, j] - board.accel_bias[j]).T).T for j in others]
    rates = [np.linalg.solve(board.gyro[j], (readings[:, 1, j] - board.gyro_bias[j]).T).T for j in others]
    lever = [board.position[j] - board.position[k] for j in others]
    rows = np.vstack([np.hstack([np.eye(3), -np.cross(np.eye(3), r)]) for r in lever])  # al x r
    w = np.mean(rates, axis=0)
    right = np.hstack([f - np.cross(w, np.cross(w, r)) for f, r in zip(felt, lever, strict=True)])
    return np.linalg.lstsq(rows, right.T, rcond=None)[0][:3].T, np.array(felt)


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def test_numbers_are_those_of_least_squares_transcribed_apart():
    recording, board, readings = board_in_hand()
    compared = il.compare_imus(recording, calibration=true_record(recording))
    turning = recording.columns["time"] > 2.05  # a rate below 30 deg/s is rare after that
    for k, row in enumerate(compared.accel["turning"]):
        own = np.linalg.solve(board.accel[k], (readings[:, 0, k] - board.accel_bias[k]).T).T
        told, felt = predicted(board, readings, k)
        assert row.samples == pytest.approx(turning.sum(), rel=0.1)
        assert row.fused == pytest.approx(rms((told - own)[turning]), rel=0.03)
        assert row.mean == pytest.approx(rms((felt.mean(axis=0) - own)[turning]), rel=0.03)
        assert row.single == pytest.approx(rms((felt - own)[:, turning]), rel=0.03)
        assert row.mean > 10 * row.fused
        assert row.fused == pytest.approx(row.stated, rel=0.06)
    slow = recording.columns["time"] <= 2.0
    for k, row in enumerate(compared.gyro["slow"]):
        rates = [np.linalg.solve(board.gyro[j], (readings[slow, 1, j] - board.gyro_bias[j]).T).T for j in range(5)]
        assert row.fused == pytest.approx(rms(np.mean(np.delete(rates, k, axis=0), axis=0) - rates[k]), rel=0.05)
        assert row.fused == pytest.approx(row.stated, rel=0.06)
    assert not [note for note in compared.notes if not isinstance(note, Note)]


def test_a_record_that_does_not_hold_is_said():
    recording, _, _ = board_in_hand()
    head = dict(recording.metadata)
    for axis in "2", "3":  # two IMUs exchanged on paper
        head[f"truth_position_{axis}"] = recording.metadata[f"truth_position_{5 - int(axis)}"]
    exchanged = il.Recording(recording.columns, recording.units, head, "hand.csv")
    compared = il.compare_imus(recording, calibration=true_record(exchanged))
    said = [note for note in compared.notes if not isinstance(note, Note)]
    assert len(said) == 1
    assert "the calibration does not hold for this recording" in said[0]
    assert "IMU 2 3" in said[0]


def test_a_record_of_another_board_is_said_at_rest_too():
    recording, _, _ = board_in_hand()
    other = il.Recording(recording.columns, recording.units, {"serial": "B2"}, "hand.csv")
    record, serial = true_record(recording), "hand.csv: serial B2, but the record was made for B1"
    compared = il.compare_imus(other, calibration=record)
    assert [note for note in compared.notes if not isinstance(note, Note)] == [serial]
    assert serial in il.fuse_imus(other, calibration=record).notes
    foreign = true_record(board_in_hand(seed=5)[0])
    lines = [note for note in il.compare_imus(recording, calibration=foreign).notes if not isinstance(note, Note)]
    assert any("slower than 30 deg/s, the mean of the others is nearer to the accelerometers" in line for line in lines)
    assert any("slower than 30 deg/s, the gyroscopes of IMU 1 2 3 4 5 are" in line for line in lines)


def test_a_stuck_sensor_is_said_as_fuse_says_it():
    recording, _, _ = board_in_hand()
    gyro = recording.columns["gyro_x_2"].copy()
    stuck = {
        f"gyro_{axis}_2": np.where(np.arange(1200) > 700, gyro[700], recording.columns[f"gyro_{axis}_2"])
        for axis in "xyz"
    }
    spoilt = il.Recording({**recording.columns, **stuck}, recording.units, recording.metadata, "hand.csv")
    compared = il.compare_imus(spoilt, calibration=true_record(recording))
    (line,) = [note for note in compared.notes if "stuck" in note]
    assert not isinstance(line, Note)
    assert line in il.fuse_imus(spoilt, calibration=true_record(recording)).notes


def test_a_reading_that_is_no_number_hides_no_other():
    recording, _, _ = board_in_hand()
    columns = dict(recording.columns)
    for axis in "xyz":
        columns[f"gyro_{axis}_2"] = columns[f"gyro_{axis}_2"] * np.where(np.arange(1200) > 700, 1.2, 1.0)
    columns["gyro_x_4"] = np.where(np.arange(1200) == 900, np.nan, columns["gyro_x_4"])
    spoilt = il.Recording(columns, recording.units, recording.metadata, "hand.csv")
    lines = il.compare_imus(spoilt, calibration=true_record(recording)).notes
    assert any("turning, the gyroscopes of IMU 2 are" in line for line in lines if not isinstance(line, Note))


def test_slow_turning_accuses_no_record():
    """Fused others are noisier than their mean, since they extrapolate: no sign of a wrong calibration."""
    recording, _, _ = board_in_hand(PLACES[:4] * 0.3, turning=0.9)
    compared = il.compare_imus(recording, calibration=true_record(recording))
    assert all(row.fused > row.mean for row in compared.accel["turning"])
    assert not [note for note in compared.notes if not isinstance(note, Note)]


def test_rows_that_others_do_not_determine_do_not_hide_the_rest():
    recording, _, _ = board_in_hand(PLACES[:4])
    columns = dict(recording.columns)
    lost = np.arange(1200) == 900
    for k in (1, 2, 3):
        columns[f"gyro_x_{k}"] = np.where(lost, np.nan, columns[f"gyro_x_{k}"])
        columns[f"accel_x_{k}"] = np.where(lost, np.nan, columns[f"accel_x_{k}"])
    spoilt = il.Recording(columns, recording.units, recording.metadata, "hand.csv")
    whole, compared = (il.compare_imus(each, calibration=true_record(recording)) for each in (recording, spoilt))
    assert compared.accel["turning"][3].fused == pytest.approx(whole.accel["turning"][3].fused, rel=0.02)
    assert "m/s² from the fused others" in compared.headline()


def test_readings_at_the_end_of_the_range_do_not_count():
    recording, _, _ = board_in_hand(turning=8.3)
    record = true_record(recording)
    whole = il.compare_imus(recording, calibration=record)
    for sensor, k, change, words, share in (
        ("gyro", 2, lambda column: np.clip(column, -8, 8), {"gyro_range": "8 rad/s"}, (1 - 0.17) ** 3),
        ("accel", 1, lambda column: np.where(np.arange(1200) % 7 == 0, np.nan, column), {}, 6 / 7),
    ):
        columns = dict(recording.columns)
        columns[f"{sensor}_x_{k + 1}"] = change(columns[f"{sensor}_x_{k + 1}"])
        spoilt = il.Recording(columns, recording.units, recording.metadata, "hand.csv")
        row, before = (
            getattr(each, sensor)["turning"][k]
            for each in (il.compare_imus(spoilt, calibration=record, **words), whole)
        )
        assert row.samples == pytest.approx(share * before.samples, rel=0.15)
        assert row.fused == pytest.approx(before.fused, rel=0.1)


@pytest.mark.parametrize("places", [PLACES[:3], PLACES[:1] + np.arange(4)[:, None] * [0.01, 0, 0]], ids=["3", "line"])
def test_what_others_do_not_tell_is_refused_or_left_open(places):
    recording, _, _ = board_in_hand(places)
    if len(places) == 3:
        with pytest.raises(il.ImulabError, match="a board of 3 IMUs: expected 4 or more, to predict each"):
            il.compare_imus(recording, calibration=true_record(recording))
        return
    compared = il.compare_imus(recording, calibration=true_record(recording))
    row = compared.accel["turning"][1]
    assert row.fused == pytest.approx(row.stated, rel=0.06)  # along the line the others tell it
    assert row.mean > 3 * row.fused


def test_the_command_prints_it_writes_a_page_and_refuses(tmp_path, capsys):
    recording, _, _ = board_in_hand()
    il.write(recording, tmp_path / "b.csv")
    true_record(recording).save(tmp_path / "rec.json")
    words = ["array", "compare", str(tmp_path / "b.csv"), "--imus", "--calibration", str(tmp_path / "rec.json")]
    assert main([*words, "--report", str(tmp_path / "r.html")]) == 0
    out = capsys.readouterr().out
    assert out.startswith("good: ")
    assert "Accelerometers, faster than 30 deg/s" in out
    assert "each predicted by the others" in (tmp_path / "r.html").read_text()
    assert main([*words, "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["accel"]["turning"][4]["fused"]["unit"] == "m/s^2"
    short = {name: column[:30] for name, column in recording.columns.items()}
    il.write(il.Recording(short, recording.units, recording.metadata), tmp_path / "b.csv")
    assert main([*words, "--report", str(tmp_path / "s.html")]) == 2
    assert "no IMU has 50 samples within its range" in capsys.readouterr().err
    assert not (tmp_path / "s.html").exists()
    few = {n: c for n, c in recording.columns.items() if not n.endswith("_5")}
    il.write(il.Recording(few, {n: recording.units[n] for n in few}, {}), tmp_path / "b.csv")
    assert main(words) == 2
    assert "4 IMUs; the record has 5" in capsys.readouterr().err


@pytest.mark.slow
def test_a_real_board(real_data):
    file = real_data / "mimu4444" / "exp_1.bin"
    compared = il.compare_imus(file, calibration=il.calibrate_imus(file, gravity="9.81787+-0.0002"))
    rows = compared.accel["turning"]
    # Document: fused 1.7 to 2.1, mean 9.5 to 10.2 m/s^2, of other recordings than that of the calibration.
    assert np.median([row.fused for row in rows]) < 2.5
    assert 9.0 < np.median([row.mean for row in rows]) < 10.7
    assert max(row.fused / row.stated for row in compared.accel["slow"]) < 1.1
