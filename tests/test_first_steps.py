"""What a new user meets first: files of another instrument, slips of the pen, folders for files; what is said then."""

import csv
import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import imulab as il
from imulab.errors import DataError, ImulabError, OptionError, ReadError, UnitError
from imulab.quantities import quantity
from imulab.readers.layout import EXAMPLE, load_layout
from imulab.recording import Recording
from imulab.units import STANDARD_GRAVITY as G

DOCS = Path(__file__).resolve().parents[1] / "docs"


@pytest.fixture(scope="module")
def recording():
    return il.simulate_tumble(order=1, gravity=9.81, attitudes=20, hold=2.0, gyro=False, seed=3)


@pytest.mark.parametrize(
    ("title", "message"),
    [
        ("timestamp_ms", "column 'timestamp_ms': expected the name 'time', in a title such as 'time [ms]'"),
        ("Time (us)", "column 'Time (us)': expected the name 'time', in a title such as 'time [us]'"),
        ("t", "column 't': expected the name 'time'"),
        ("accel_x (m/s^2)", "column 'accel_x (m/s^2)': expected a title such as 'accel_x [m/s^2]'"),
        ("Gyro_X deg/s", "column 'Gyro_X deg/s': expected a title such as 'gyro_x [deg/s]'"),
    ],
)
def test_a_clock_of_another_name_is_no_table_of_attitudes(tmp_path, title, message):
    path = tmp_path / "logger.csv"
    path.write_text(f"{title},accel_x [g],accel_y [g],accel_z [g]\n0,0,0,1\n10,0,0,1\n")
    with pytest.raises(UnitError) as caught:
        il.read(path)
    assert str(caught.value) == f"{path}: {message}"


@pytest.mark.parametrize("title", ["timestamp_sample", "times", "tms [V]"])
def test_other_names_that_begin_alike_are_kept(tmp_path, title):
    path = tmp_path / "logger.csv"
    path.write_text(f"time [s],{title}\n0,1\n1,2\n")
    assert len(il.read(path).columns) == 2


def test_columns_of_other_names_call_for_a_layout():
    foreign = Recording(columns={"time": np.zeros(1), "ax": np.zeros(1)}, units={"time": "s", "ax": "1"}, name="f.csv")
    with pytest.raises(DataError, match=r"found time ax; rename .* df\.rename\(columns=\{'ax': 'accel_x'\}\)"):
        foreign.column("accel_x")
    read = replace(foreign, from_file=True)
    with pytest.raises(DataError, match=r"^f.csv: no column accel_x; found time ax; a layout says .*--layout"):
        read.column("accel_x")
    ours = replace(foreign, columns={"time": np.zeros(1), "accel_y": np.zeros(1)}, units={"time": "s", "accel_y": "g"})
    with pytest.raises(DataError, match=r"^f.csv: no column accel_x; found time accel_y$"):
        ours.column("accel_x")


@pytest.mark.parametrize("content", ["time [ms];accel_x [g]\n0;1\n", "0.0,1.0\n1.0,2.0\n"])
def test_who_is_told_to_write_a_layout_is_shown_one(imulab, tmp_path, content):
    (tmp_path / "f.csv").write_text(content)
    done = imulab("show", "f.csv")
    assert done.returncode == 2
    assert done.stderr.endswith("--layout FILE.toml (imulab show --formats has an example)\n")
    shown = imulab("show", "--formats").stdout
    assert EXAMPLE in shown
    (tmp_path / "l.toml").write_text(EXAMPLE)
    assert load_layout(tmp_path / "l.toml").columns["accel_z"].origin == 3
    assert tomllib.loads(EXAMPLE)["metadata"] == {"serial": "SN42"}
    assert "".join(f"    {line}\n" for line in EXAMPLE.splitlines()) in (DOCS / "recordings.md").read_text()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"time [s] accel_x [g]\n0 1\n", "titles 'time [s] accel_x [g]': separated by blanks, expected ','"),
        (b"time [s],accel_x [g],\n0,1,\n", "line 1: a column without a name (a comma at the end of the line?)"),
        ("time [s],accel_x [g]\n0,1\n".encode("utf-16"), "expected text, found binary data (UTF-16? expected UTF-8)"),
    ],
)
def test_what_a_spreadsheet_saved_is_named(tmp_path, content, message):
    path = tmp_path / "f.csv"
    path.write_bytes(content)
    with pytest.raises((ReadError, UnitError)) as caught:
        il.read(path)
    assert str(caught.value).startswith(f"{path}: {message}")


@pytest.mark.parametrize("skip_lines", [0, 1, 3])
def test_comments_of_a_foreign_file_are_metadata(tmp_path, skip_lines):
    head = "# power_on_temperature: -20\n# serial: of the file\n# free text\n"
    path, layout = tmp_path / "f.csv", tmp_path / "l.toml"
    column = '{ from = "%s", unit = "%s" }'
    layout.write_text(
        f'delimiter = ";"\nheader = true\nskip_lines = {skip_lines}\n[columns]\n'
        f"time = {column % ('ms', 'ms')}\ngyro_x = {column % ('w', 'dps')}\n"
        '[metadata]\nserial = "of the layout"\n'
    )
    for titles in ("ms;w", "# ms;w"):
        path.write_text(f"{head}{titles}\n0;1.5\n10;2.5\n")
        found = il.read(path, layout)
        assert found.metadata["power_on_temperature"] == "-20"
        assert found.metadata["serial"] == "of the layout"
        np.testing.assert_allclose(found.si("gyro_x"), np.radians([1.5, 2.5]), rtol=1e-15)
    layout.write_text(
        'delimiter = ";"\n[columns]\ntime = { from = 0, unit = "ms" }\ngyro_x = { from = 1, unit = "dps" }\n'
    )
    path.write_text(f"{head}0;1.5\n10;2.5\n")
    assert il.read(path, layout).metadata == {"power_on_temperature": "-20", "serial": "of the file"}


def test_decimal_commas_are_read_where_the_layout_says_so(tmp_path):
    path, layout = tmp_path / "f.csv", tmp_path / "l.toml"
    path.write_text("t;a\n0;-9,81\n1;1,5e-3\n2;\n3;7\n")
    columns = '[columns]\ntime = { from = "t", unit = "s" }\naccel_x = { from = "a", unit = "g" }\n'
    layout.write_text(f'delimiter = ";"\n{columns}')
    with pytest.raises(
        ReadError, match=r"found '-9,81' \(a decimal .* a point\); decimal = \",\" in the layout reads it$"
    ):
        il.read(path, layout)
    layout.write_text(f'delimiter = ";"\ndecimal = ","\n{columns}')
    np.testing.assert_array_equal(il.read(path, layout).column("accel_x"), [-9.81, 1.5e-3, np.nan, 7.0])
    for unfit in ('delimiter = ","\ndecimal = ","\n', 'decimal = "\'"\n', "decimal = 1\n"):
        layout.write_text(unfit + columns)
        with pytest.raises(ReadError, match=r"expected '\.' or ',', and another sign than the delimiter"):
            il.read(path, layout)


@pytest.mark.parametrize(("spelling", "symbol"), [("LSB", "count"), ("dps", "deg/s"), ("°/h", "deg/h")])
def test_units_as_data_sheets_write_them(tmp_path, spelling, symbol):
    path = tmp_path / "f.csv"
    path.write_text(f"time [s],gyro_x [{spelling}]\n0,1\n1,2\n", encoding="utf-8")
    assert il.read(path).units["gyro_x"] == symbol


@pytest.mark.parametrize("text", ["9,81", "9,81 m/s^2", "1,5e-3"])
def test_a_decimal_comma_in_an_option_is_named(text):
    with pytest.raises(OptionError) as caught:
        quantity(text, "--gravity", "acceleration", "m/s^2")
    assert str(caught.value) == f"--gravity {text!r}: a decimal comma? expected a point"


def test_folders_in_place_of_files_are_named(tmp_path):
    (tmp_path / "cycles").mkdir()
    with pytest.raises(ReadError, match=r"no ROS 2 bag \(no .mcap or .db3 in it\)$"):
        il.read(tmp_path / "cycles")
    (tmp_path / "cycles" / "one.csv").write_text("time [s]\n0\n")
    with pytest.raises(ReadError, match=r"; name the files in it: .*cycles/\*.csv$"):
        il.read(tmp_path / "cycles")
    with pytest.raises(ReadError, match="expected a layout file, found a folder"):
        load_layout(tmp_path / "cycles")
    with pytest.raises(ReadError, match="expected a manifest file, found a folder"):
        il.load_manifest(tmp_path / "cycles")


def test_gravity_that_is_not_that_of_the_files_head_is_warned_of(recording):
    attitudes = il.find_attitudes(recording)
    warned = il.fit_tumble(attitudes, order=1, gravity=9.80665).calibration.warnings
    assert any("the head of simulated tumble says 9.81 m/s^2: scale factors differ by +342 ppm" in w for w in warned)
    (said,) = il.fit_tumble(attitudes, order=1).calibration.warnings
    assert said.startswith("gravity 9.81 m/s^2 (± 294 ppm) was taken from the head of simulated tumble")
    assert not il.fit_tumble(attitudes, order=1, gravity=9.81).calibration.warnings
    for unread in ("9,81", "local", ""):
        other = replace(recording, metadata={"gravity": unread})
        assert not il.fit_tumble(il.find_attitudes(other), order=1, gravity=9.81).calibration.warnings


def test_a_recording_without_its_time_is_told_what_it_needs(recording):
    rows = {name: recording.columns[name].copy() for name in ("accel_x", "accel_y", "accel_z")}
    table = Recording(columns=rows, units=dict.fromkeys(rows, "m/s^2"), name="t.csv")
    with pytest.raises(ImulabError, match=r"imulab layout guess t.csv --sample-rate 100Hz -o L.toml writes one"):
        il.find_attitudes(table)
    order = np.random.default_rng(2).permutation(len(table))  # in which no row goes over into the next
    rows |= {name: values[order] for name, values in rows.items()}
    table = Recording(columns=rows, units=dict.fromkeys(rows, "m/s^2"), name="t.csv")
    (note,) = il.find_attitudes(table).notes
    assert note.endswith("Then it needs a column time, or a layout with sample_rate")
    rows["accel_x"][100], rows["accel_y"][100], rows["accel_z"][100] = 0.1, 0.2, 0.1
    with pytest.raises(DataError, match=r"row 101.*expected about 9.81 m/s.2; without a column time every row is an"):
        il.fit_tumble(il.find_attitudes(table), gravity=9.81)


@pytest.mark.parametrize("command", ["noise fit", "allan", "rate turn"])
def test_samples_without_a_time_are_told_how_to_state_their_rate(imulab, tmp_path, command):
    (tmp_path / "g.csv").write_text(
        "gyro_x [deg/s],gyro_y [deg/s],gyro_z [deg/s]\n" + "0.1,0.2,0.3\n0.2,0.3,0.4\n" * 500
    )
    guess = "imulab layout guess g.csv --sample-rate 100Hz -o L.toml"
    done = imulab(*command.split(), "g.csv", *(["-o", "r.json"] if " " in command else []))
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "no column time; " in done.stderr
    assert guess in done.stderr
    assert guess in imulab("show", "g.csv").stdout
    assert imulab(*guess.split()[1:]).returncode == 0
    assert "rate 100 Hz" in imulab("show", "g.csv", "--layout", "L.toml").stdout


def test_the_noise_of_a_unit_that_moves_is_warned_of(imulab, tmp_path, recording):
    il.write_csv(recording, tmp_path / "moving.csv")
    done = imulab("allan", "moving.csv")
    assert done.returncode == 0
    assert (
        "columns accel_x accel_y accel_z: noise coefficients not determined: means over a second range over up to"
        in (done.stderr)
    )
    assert "19.1 m/s^2" in done.stderr
    assert "did the unit move?" in done.stderr
    assert done.stderr.count("\n") == 1
    rng = np.random.default_rng(9)  # the test of fit rejects one log in a hundred, of 8 among them
    for noise, drift in ((0.05, 1.0), (30.0, 0.0)):
        still = noise * rng.standard_normal(6000) + drift * np.linspace(0, 1, 6000)
        columns = {"time": np.arange(6000) / 100, "gyro_x": still}
        il.write_csv(Recording(columns=columns, units={"time": "s", "gyro_x": "deg/s"}), tmp_path / "still.csv")
        said = imulab("allan", "still.csv").stderr
        assert "did the unit move?" not in said
        assert ("the noise is not that of the model" in said) == (drift > 0)
        assert ("is more than that of any gyroscope in use" in said) == (noise > 1)
        assert said.count("\n") == 1


def test_show_puts_the_columns_before_what_else_the_head_says(imulab, tmp_path, recording):
    il.write_csv(recording, tmp_path / "t.csv")
    shown = imulab("show", "t.csv").stdout
    assert shown.index("accel_z") < shown.index("serial: SIM-0003")


def test_another_instruments_file_gives_what_our_own_gives(imulab, tmp_path, recording):
    """Semicolons, g, milliseconds, names of its own: the same record to the rounding of its digits."""
    il.write_csv(recording, tmp_path / "ours.csv")
    with (tmp_path / "theirs.csv").open("w", newline="") as stream:
        stream.write("# Logger 7\n# serial: SIM-0003\n")
        writer = csv.writer(stream, delimiter=";")
        writer.writerow(["ms", "ax", "ay", "az"])
        rows = np.column_stack([recording.time * 1e3, recording.triad("accel") / G])
        writer.writerows([[f"{value:.9f}" for value in row] for row in rows])
    names = "".join(f'accel_{axis} = {{ from = "a{axis}", unit = "g" }}\n' for axis in "xyz")
    text = f'delimiter = ";"\nskip_lines = 1\n[columns]\ntime = {{ from = "ms", unit = "ms" }}\n{names}'
    (tmp_path / "theirs.toml").write_text(text)
    for name, more in (("ours", []), ("theirs", ["--layout", "theirs.toml"])):
        done = imulab("tumble", "fit", f"{name}.csv", *more, "--gravity", "9.81", "--order", "1", "-o", f"{name}.json")
        assert done.returncode == 0, done.stderr
    ours, theirs = (il.load(tmp_path / f"{name}.json") for name in ("ours", "theirs"))
    assert theirs.sensor["serial"] == "SIM-0003"
    for name, parameter in ours.parameters.items():
        per_unit = G if name.startswith("scale_factor") else 1.0  # g are to m/s^2 as the outputs are
        assert theirs.parameters[name].value * per_unit == pytest.approx(
            parameter.value, abs=1e-3 * parameter.standard_uncertainty
        )


@pytest.mark.parametrize("command", ["report t.json -o", "tumble fit t.csv --gravity 9.81 -o s.json --report"])
def test_a_report_is_html(imulab, tmp_path, recording, command):
    il.write_csv(recording, tmp_path / "t.csv")
    il.fit_tumble(recording, gravity=9.81, order=1).calibration.save(tmp_path / "t.json")
    done = imulab(*command.split(), "r.txt")
    assert done.returncode == 2
    assert done.stderr == "imulab: r.txt: a report is HTML; expected a name that ends in .html\n"
    assert {each.name for each in tmp_path.iterdir()} == {"t.csv", "t.json"}


@pytest.mark.parametrize("name", ["sheet.pdf", "picture.PNG"])
def test_a_report_is_no_paper(imulab, tmp_path, recording, name):
    il.write_csv(recording, tmp_path / "t.csv")
    done = imulab("tumble", "fit", "t.csv", "--gravity", "9.81", "-o", "t.json", "--report", name)
    assert done.returncode == 2
    assert (
        done.stderr == f"imulab: {name}: no such file is written; reports are HTML (.html), which any browser prints\n"
    )
    assert [path.name for path in tmp_path.iterdir()] == ["t.csv"]


def test_a_recording_before_its_record_is_named(imulab, tmp_path, recording):
    il.write_csv(recording, tmp_path / "t.csv")
    il.fit_tumble(il.find_attitudes(recording), order=1, gravity=9.81).calibration.save(tmp_path / "t.json")
    done = imulab("apply", "t.csv", "t.json", "-o", "c.csv")
    assert done.returncode == 2
    assert done.stderr == "imulab: t.json: expected a recording as the last file, found a record: records go first\n"
    done = imulab("report", "t.csv", "-o", "r.html")
    assert done.stderr == (
        "imulab: t.csv: not a calibration record: it is not JSON (a recording?); expected the .json that a fit writes\n"
    )
    (tmp_path / "e.json").write_text("")
    done = imulab("report", "e.json", "-o", "r.html")
    assert (
        done.stderr == "imulab: e.json: not a calibration record: it is empty; expected the .json that a fit writes\n"
    )


def test_what_is_printed_of_a_recording_is_a_line(recording):
    table = Recording(columns={"accel_x": np.ones(2), "x": np.ones(2)}, units={"accel_x": "g"}, name="t.csv")
    assert repr(table) == "Recording(t.csv: 2 samples of accel_x [g], x [1])"
    assert repr(il.find_attitudes(recording)) == "Attitudes(20 of simulated tumble, in m/s^2)"


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (
            ["tumble", "plan", "--order", "1", "--attitudes", "20", "--noise", "1ug", "--from", "fixtur:15"],
            "--from 'fixtur:15': expected sphere, fixture:15, head:15 (steps in deg) or a file of directions; did you "
            "mean 'fixture'?",
        ),
        (
            ["centrifuge", "plan", "--levels", "1,2", "--uncertainty", "5"],
            "--uncertainty 5: expected 1e-07 to 1 of K (or percent, such as 0.8 %)",
        ),
    ],
)
def test_an_option_that_is_none_is_answered_with_those_there_are(imulab, command, message):
    done = imulab(*command)
    assert (done.returncode, done.stderr) == (2, f"imulab: {message}\n")


def test_lists_of_commands_are_cut_nowhere(imulab):
    groups = [[], ["tumble"], ["array"], ["warmup"], ["centrifuge"], ["noise"], ["fleet"]]
    for group in groups:
        lines = imulab(*group, "--help").stdout.split("Commands:\n")[1].split("\n\n")[0].splitlines()
        assert all(re.fullmatch(r"  \w+ +[A-Z].*\.", line) for line in lines), lines
        assert not any(line.endswith("...") for line in lines)
