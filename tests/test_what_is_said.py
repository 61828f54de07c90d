"""What commands and functions say: serial numbers, arguments, limits of what was not seen, frames for frames."""

import math
import re
import shlex
import shutil

import numpy as np
import pytest

import imulab as il
from conftest import REPOSITORY
from imulab.cli import main
from imulab.cli.app import commands
from imulab.display import Finding, one_thing
from imulab.errors import ObservabilityError, OptionError, ReadError, readable
from imulab.live.formats import LineStream, UnknownFormatError
from imulab.procedures.noise.wants import PROGRAMS
from imulab.procedures.views import exhibits_of

FITS = ("tumble fit", "tumble gyro", "tumble mag", "array calibrate", "warmup fit", "noise fit", "thermal fit")
FITS = (*FITS, "rate fit", "rate turn")


def test_every_fit_takes_a_serial_number():
    options = {command.path: {option.name for option in command.options} for command in commands()}
    for path in FITS:
        assert "serial" in options[path], path


def test_the_stated_serial_number_is_the_record_s(imulab, tmp_path):
    recording = il.simulate_tumble(gravity=9.81, attitudes=12, order=1)
    il.write(recording, tmp_path / "f.csv")
    done = imulab("tumble", "fit", "f.csv", "--gravity", "9.81", "--order", "1", "--serial", "SN 7/b", "-o", "r.json")
    assert done.returncode == 0
    assert il.load(tmp_path / "r.json").sensor["serial"] == "SN 7/b"
    for data in (recording, tmp_path / "f.csv"):
        assert il.fit_tumble(data, gravity=9.81, order=1, serial="A").calibration.sensor["serial"] == "A"
    still = il.simulate_array(experiment="static", duration=60.0)
    assert il.calibrate_array(still, serial="B").calibration.sensor["serial"] == "B"


def test_small_units_are_written_with_their_sign():
    """A typed 20 ug is read; what is printed is 20 µg, in every sentence and title (a record's option is as typed)."""
    sources = sorted((REPOSITORY / "src" / "imulab").rglob("*.py"))
    printed = {
        path.relative_to(REPOSITORY).as_posix(): re.findall(r"\} u[gs]\b|, u[gs]\"", path.read_text(encoding="utf-8"))
        for path in sources
    }
    assert {name: places for name, places in printed.items() if places} == {
        "src/imulab/procedures/tumble/solve.py": ["} ug"]
    }


def test_a_report_on_noise_says_white_noise_in_one_unit_and_what_programs_take_in_si():
    fit = il.fit_noise(il.simulate_noise(white="0.3 deg/sqrt(h)", walk=None, duration="2 min", rate=50))
    exhibits = exhibits_of(fit.calibration)
    terms, filters, *_ = exhibits.items
    (white,) = {row[-1] for row in terms.rows if row[1] == "angle random walk"}
    assert white == "deg/sqrt(h)"
    assert dict(exhibits.facts)["gyroscopes, white for filters"].endswith(f" {white}")
    assert exhibits.headline.endswith(f"{white}.")
    assert "in SI as programs take them" in filters.caption


def test_dir_lists_public_names_alone():
    assert dir(il) == sorted(il.__all__)
    assert all(hasattr(il, name) for name in dir(il))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: il.fit_tumble(),
            r"fit_tumble: missing a required argument: 'data'; expected fit_tumble\(data, .*layout=.*window=\)",
        ),
        (
            lambda: il.fit_gyro(),
            r"fit_gyro: missing required arguments: 'accel', 'data'; expected fit_gyro\(accel, data, accel_data=.*",
        ),
        (lambda: il.read("x", foo=1, bar=2), r"read: unknown options 'foo', 'bar'; known: file layout topic .*"),
        (
            lambda: il.fit_tumble("x", gravty=1, foo=2),
            r"fit_tumble: unknown options 'gravty', 'foo'; .*mean 'gravity'\?",
        ),
        (
            lambda: il.normal_gravity(),
            r"normal_gravity: missing a required argument: 'latitude'; expected normal_gravity\(.*",
        ),
    ],
)
def test_messages_about_arguments_name_all_of_them(call, message):
    with pytest.raises(OptionError) as caught:
        call()
    assert re.fullmatch(message, str(caught.value))


@pytest.mark.parametrize("library", ["pandas", "polars"])
def test_a_frame_is_corrected_to_a_frame_of_its_library(library):
    pytest.importorskip(library)
    recording = il.simulate_tumble(gravity=9.81, attitudes=12, order=1)
    fit = il.fit_tumble(recording, gravity=9.81, order=1)
    frame = recording.to_frame(library)
    for record in (fit, fit.calibration):
        corrected = record.apply(frame)
        assert type(corrected) is type(frame)
        assert list(corrected.columns) == list(frame.columns)
        expected = fit.apply(recording)
        assert isinstance(expected, il.Recording)
        np.testing.assert_array_equal(np.asarray(corrected["accel_y [m/s^2]"]), expected.columns["accel_y"])


@pytest.fixture(scope="module")
def noise():
    log = il.simulate_noise(white="0.3 deg/sqrt(h)", rate=50.0, duration="10 min", columns=["gyro_z"])
    return il.fit_noise(log)


def test_what_was_not_seen_is_a_limit_and_not_zero(noise):
    limit = noise.calibration.parameters["gyro_z_walk"].interval_95[1]
    assert noise.calibration.parameters["gyro_z_walk"].unseen_limit == limit > 0
    assert re.search(r"gyro_z_walk +< \d", repr(noise))
    assert f"gyro_z_walk < {limit:.2g} rad/s/sqrt(s)" in str(noise.calibration)
    assert not re.search(r"\b0 (deg|rad)", repr(noise) + str(noise.calibration))
    frame = noise.to_frame("polars")
    row = dict(zip(frame.columns, frame.row(list(frame["parameter"]).index("gyro_z_walk")), strict=True))
    assert math.isnan(row["value"])
    assert row["below"] == limit
    white = dict(zip(frame.columns, frame.row(0), strict=True))
    assert math.isnan(white["below"])
    assert white["value"] > 0


def test_what_a_filter_wants_of_a_saved_record(imulab, tmp_path, noise):
    noise.save(tmp_path / "n.json")
    for program in PROGRAMS:
        done = imulab("noise", "fit", "n.json", "--for", program)
        assert done.returncode == 0
        wanted = {key: f"{value:.4g}" for key, value in noise.wants(program).items()}
        assert dict(line.split(": ") for line in done.stdout.splitlines()) == wanted
    text = imulab("noise", "fit", "--help").stdout
    assert all(program in text for program in PROGRAMS)
    done = imulab("show", "n.json").stdout
    assert re.search(r"column +N_h +unit +K_h +95 % of K_h +unit", done)
    assert "rad/s/sqrt(Hz)" in done
    il.fit_tumble(il.simulate_tumble(gravity=9.81, attitudes=12, order=1), gravity=9.81, order=1).save(
        tmp_path / "t.json"
    )
    done = imulab("noise", "fit", "t.json", "--for", "px4")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)


def test_single_rows_without_numbers_are_bridged_in_a_tumble_test():
    recording = il.simulate_tumble(gravity=9.81, attitudes=16, order=1)
    columns = {name: values.copy() for name, values in recording.columns.items()}
    columns["accel_y"][[700, 1500, 1501]] = np.nan
    columns["gyro_z"][2000] = np.nan
    torn = recording.with_columns(columns, {})
    whole = il.fit_tumble(recording, order=1, gravity=9.81).calibration
    fit = il.fit_tumble(torn, order=1, gravity=9.81).calibration
    for name, parameter in whole.parameters.items():
        assert abs(fit.parameters[name].value - parameter.value) < 0.2 * parameter.standard_uncertainty
    assert any("3 rows without numbers (the first row 701) bridged from their neighbours" in w for w in fit.warnings)
    both = il.fit_gyro(whole, torn).calibration
    expected = il.fit_gyro(whole, recording).calibration.parameters["gyro_scale_factor_z"]
    found = both.parameters["gyro_scale_factor_z"]
    assert abs(found.value - expected.value) < 0.2 * expected.standard_uncertainty
    columns["accel_y"][700:706] = np.nan
    with pytest.raises(il.ImulabError, match=r"row 701.*, column accel_y: expected a finite number, found nan"):
        il.fit_tumble(recording.with_columns(columns, {}), order=1, gravity=9.81)


def level(rng, samples):
    """Specific force, m/s^2, and field, uT, of a unit on a table that is turned about the vertical between holds."""
    headings = np.repeat(np.arange(16) * 2 * np.pi / 16, samples)
    field = 20 * np.column_stack([np.cos(headings), -np.sin(headings), np.full(len(headings), -2.0)])
    noise = rng.normal(0, 0.01, (2, len(headings), 3))
    return np.array([0.0, 0.0, 9.81]) + noise[0], field + noise[1]


def test_a_unit_that_was_never_tilted_is_told_so_as_a_table_and_as_a_recording():
    rng = np.random.default_rng(11)
    accel, mag = level(rng, 200)
    units = {"accel": "m/s^2", "mag": "uT"}
    recording = il.Recording.from_arrays(accel=accel, mag=mag, rate=50.0, units=units)
    table = il.Recording.from_arrays(accel=accel[::200], mag=mag[::200], units=units)
    for data in (recording, table):
        with pytest.raises(
            ObservabilityError, match="order 1: the unit was never tilted, the same axis is up within 1 deg"
        ):
            il.fit_tumble(data, order=1, gravity=9.81)
        with pytest.raises(il.ImulabError, match="never tilted"):
            il.fit_mag(data, gravity=9.81)
    with pytest.raises(ObservabilityError) as caught:
        il.fit_tumble(recording, order=1, gravity=9.81)
    assert re.search(r"(1 attitude determines|\d attitudes determine) 0 of", str(caught.value))
    assert str(caught.value).endswith("would help most")


def test_one_is_no_plural():
    assert one_thing("f.csv: 1 attitudes, 21 attitudes, 1 spikes") == "f.csv: 1 attitude, 21 attitudes, 1 spike"
    assert str(OptionError("1 samples")) == "1 sample"
    assert str(Finding("1 rows are bridged; 0.1 rows")) == "1 row are bridged; 0.1 rows"


def streamed(pattern):
    stream, blocks = LineStream("live"), []
    for k in range(300):
        blocks += stream.feed(f"{pattern.format(k % 5)}\r\n".encode(), 0.01 * k)
    return stream, blocks + stream.finish()


def test_raw_lines_with_decimals_are_those_of_motioncal_where_their_size_is():
    whole, blocks = streamed("Raw:12,-33,819{},1,-4,1,201,-30,410")
    assert (whole.format, len(blocks[-1])) == ("MotionCal Raw:", 1)
    decimal, blocks = streamed("Raw:12.25,-33.1,819{}.5,1.2,-0.4,0.1,201.5,-30.2,410.9")
    assert decimal.format == "MotionCal Raw:"
    assert decimal.counts.damaged == 0
    assert blocks[-1].columns["accel_x"][0] == 12.25 / 8192
    with pytest.raises(UnknownFormatError) as caught:
        streamed("Raw:0.12,-0.33,9.8{},0.01,-0.02,0.03,20.15,-3.02,41.09")
    assert caught.value.guess is not None
    assert 'prefix = "Raw:"\n' in caught.value.guess.toml
    assert 'accel_z = { from = 2, unit = "m/s^2" }' in caught.value.guess.toml


def test_the_gravest_reason_stands_once_on_a_terminal(imulab, tmp_path, monkeypatch):
    recording = il.simulate_tumble(gravity=9.81, attitudes=12, order=1)
    axes = [f"accel_{axis}" for axis in "xyz"]
    il.write(recording.with_columns({axis: recording.columns[axis] * 1.3 for axis in axes}, {}), tmp_path / "f.csv")
    words = ["tumble", "fit", "f.csv", "--gravity", "9.81", "--order", "1", "-o", "r.json"]
    apart = imulab(*words)
    (reason, *_) = il.load(tmp_path / "r.json").verdict.reasons
    assert reason in apart.stdout
    assert reason in apart.stderr
    monkeypatch.setattr("imulab.cli.show._on_terminal", lambda: True)
    together = imulab(*words)
    assert (together.stdout + together.stderr).count(reason) == 1


FOREIGN = ("time [s]", "ax [m/s^2]", "ay [m/s^2]", "az [m/s^2]")


def _write_foreign(path):
    """Write a Parquet file whose columns are no sensor's, which blocks are read from without a layout."""
    columns = np.column_stack([np.arange(600) / 100, *np.full((3, 600), 9.8)])
    pytest.importorskip("polars").DataFrame(dict(zip(FOREIGN, columns.T, strict=True))).write_parquet(path)


PYTHON = re.compile(r"from_frame|\bdf\.|\bil\.|metadata=|reset_index|\w+=\{")


@pytest.mark.parametrize(
    "words",
    [
        *(f"{path} foreign.parquet" for path in (*FITS, "array fuse", "allan", "magnetometer fit")),
        "warmup fit still.csv",
        "warmup fit still.parquet",
        "tumble gyro foreign.parquet --accel tumble.json",
        "apply tumble.json foreign.parquet",
        "tumble check tumble.json foreign.parquet",
        "apply warm.json still.csv",
        "apply warm.json still.parquet",
    ],
)
@pytest.mark.usefixtures("home")
def test_no_command_gives_advice_in_python(imulab, words):
    done = imulab(*words.split())
    assert done.returncode == 2
    assert not PYTHON.search(done.stderr), done.stderr


@pytest.fixture
def home(tmp_path, shelf):
    """Fill the folder that commands run in with the files of `shelf`."""
    shutil.copytree(shelf, tmp_path, dirs_exist_ok=True)


@pytest.fixture(scope="module")
def shelf(tmp_path_factory):
    """Return a folder with recordings of a unit at rest, of foreign titles, and two records."""
    folder = tmp_path_factory.mktemp("said")
    still = il.simulate_tumble(gravity=9.81, attitudes=12, order=1)
    for name in ("still.csv", "still.parquet"):
        il.write(still, folder / name)
    il.fit_tumble(still, gravity=9.81, order=1).calibration.save(folder / "tumble.json")
    cycles = il.simulate_warmup((-20.0, 0.0, 20.0), cycles=2, rate=5.0)
    il.fit_warmup(cycles, temperatures=(-20.0, 0.0, 20.0), model="exponential").calibration.save(folder / "warm.json")
    _write_foreign(folder / "foreign.parquet")
    return folder


@pytest.mark.usefixtures("home")
def test_a_power_on_temperature_is_asked_for_in_the_file_or_its_column(imulab):
    for words in ("warmup fit still.csv", "apply warm.json still.csv", "apply warm.json still.parquet"):
        said = imulab(*words.split()).stderr
        assert "expected a line such as '# power_on_temperature: " in said, words
        assert "--temperature-column" in said, words


@pytest.mark.parametrize("path", ["magnetometer fit", "noise fit", "allan", "warmup fit", "array fuse", "tumble fit"])
@pytest.mark.usefixtures("home")
def test_a_missing_column_is_said_with_what_is_there(imulab, path):
    said = imulab(*path.split(), "foreign.parquet").stderr
    assert "; found time ax ay az; a layout says where columns of other names are" in said
    said = imulab("magnetometer", "fit", "still.csv").stderr
    assert "no column mag_x mag_y mag_z; found time accel_x accel_y accel_z" in said


def test_a_folder_in_place_of_a_file_is_refused_with_the_file_in_it(imulab, tmp_path):
    il.simulate_fleet(tmp_path / "line", units=8, rate=20.0)
    (tmp_path / "spin").mkdir()
    (tmp_path / "spin" / "manifest.toml").write_text("")
    (tmp_path / "spin" / "sn1.json").write_text("{}")
    wanted = {
        "centrifuge reduce spin": "spin: expected a manifest file, found a folder; it holds spin/manifest.toml",
        "rate fit spin": "a manifest or one recording, found a folder; it holds spin/manifest.toml",
        "fleet run line -o out": "a manifest, found a folder; it holds line/first.csv, line/second.csv",
        "fleet run spin -o out": "spin: expected a manifest, found a folder",
        "apply spin line/first_0001.csv": "spin: expected a file, found a folder; it holds spin/sn1.json",
        "tumble fit line/first_0001.csv --layout spin": "a layout file, found a folder; it holds spin/manifest.toml",
    }
    for words, message in wanted.items():
        done = imulab(*words.split())
        assert (done.returncode, done.stderr.strip().endswith(message)) == (2, True), done.stderr
    with (
        pytest.raises(ReadError, match=r"^the manifest of the line: expected a file, found a folder$"),
        readable("the manifest of the line", ending=".json"),
    ):
        (tmp_path / "spin").open()


@pytest.mark.parametrize(
    "words",
    ["tumble fit", "noise fit", "allan", "layout guess", "rate fit", "fleet run -o out", "export --to c -o c.c"],
)
def test_no_name_of_a_file_is_refused(imulab, words):
    done = imulab(*words.split(), "")
    assert done.returncode == 2
    line = r"imulab: an argument is empty; expected \S+, found ''; see 'imulab [\w ]+ --help'\n"
    assert re.fullmatch(line, done.stderr)


@pytest.mark.parametrize("empty", ["", " ", "\t"])
def test_an_empty_value_of_any_option_is_refused_as_that(capsys, empty):
    """A variable of a script that is not set; which file, folder or number is meant is not known."""
    options = [(command, each) for command in commands() for each in command.options if each.takes_value]
    assert len(options) > 600
    for command, each in options:
        assert main([*command.path.split(), f"{each.flags[-1]}={empty}"]) == 2
        expected = f"imulab: {each.flags[-1]} {empty!r} is empty; expected {each.shows}; see 'imulab {command.path} "
        assert capsys.readouterr().err.startswith(expected)


@pytest.mark.parametrize("words", ["warmup simulate --temperatures 0 --cycles 1 --duration 60s", "thermal simulate"])
def test_recordings_of_before_in_a_folder_are_named(imulab, tmp_path, words):
    (tmp_path / "cycles").mkdir()
    (tmp_path / "cycles" / "cycle_+99_1.csv").write_text("time [s]\n0\n")
    said = imulab(*words.split(), "-o", "cycles").stderr
    assert "cycles: 1 CSV file from before is still there (cycle_+99_1.csv): cycles/*.csv takes in" in said
    again = imulab(*words.split(), "-o", "new").stderr + imulab(*words.split(), "-o", "new").stderr
    assert "from before" not in again


@pytest.mark.parametrize(
    ("title", "advised"),
    [
        ("Accel X (m/s^2)", "accel_x [m/s^2]"),
        ("accel_x_(g)", "accel_x [g]"),
        ("Gyro X {deg/s}", "gyro_x [deg/s]"),
        ("gyro-x (deg/s)", "gyro_x [deg/s]"),
        ("accel_x/(m/s^2)", "accel_x [m/s^2]"),
        ("accel_x in g", "accel_x [g]"),
        ("Mag X (uT)", "mag_x [uT]"),
        ("Temperature 1 (what)", "temperature_1 [degC]"),
        ("accel_x (2)", "accel_x_2"),
        ("Mag_X [uT]", "mag_x"),
    ],
)
def test_the_title_that_is_advised_is_read(imulab, tmp_path, title, advised):
    rows = "".join(f"{i / 100},{i % 3}\n" for i in range(50))
    (tmp_path / "log.csv").write_text(f"time [s],{title}\n{rows}")
    said = imulab("show", "log.csv").stderr
    assert re.search(r"'([a-z0-9_]+(?: \[.*?\])?)'[^']*$", said.partition(";")[0])[1] == advised
    advised += "" if "[" in advised else " [g]" if "accel" in advised else " [uT]"
    (tmp_path / "log.csv").write_text(f"time [s],{advised}\n{rows}")
    assert imulab("show", "log.csv").returncode == 0


def test_titles_that_a_layout_would_read_are_answered_by_the_command_that_writes_it(imulab, tmp_path):
    for axes, clock in (("Accel {} [m/s^2]", "time [s]"), ("Accel {} (m/s^2)", "time [s]"), ("acc{}", "Time (s)")):
        rows = "".join(f"{i / 100},0.1,0.2,9.8\n" for i in range(600))
        titles = ",".join([clock, *(axes.format(axis) for axis in "XYZ")])
        (tmp_path / "log.csv").write_text(f"{titles}\n{rows}")
        assert "imulab layout guess log.csv" in imulab("tumble", "fit", "log.csv").stderr


def test_the_gravity_to_leave_out_is_that_which_was_stated(imulab, tmp_path):
    il.write(il.simulate_tumble(gravity=9.81362, attitudes=12, order=1), tmp_path / "f.csv")
    correct = "next: correct the gravity in the head of the file, or leave "
    place = f"{correct}the place (--latitude and --height, or --place) out"
    for options, said in (
        (("--latitude", "48.1", "--height", "520"), place),
        (("--place", "48.1,11.6,520"), place),
        (("--gravity", "9.80739"), f"{correct}--gravity out"),
    ):
        assert said in imulab("tumble", "fit", "f.csv", *options).stdout.splitlines()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("tumble plan --attitudes 20 --order 2 --noise 0.0002", "in ug, and less than any accelerometer has"),
        ("noise plan --white 0.3", "in SI, and more than any gyroscope has; expected a unit, as in '0.3 deg/sqrt(h)'"),
        ("noise plan --white 0.3 --walk '3 deg/h/sqrt(h)'", "more than any gyroscope has"),
        ("noise simulate --flicker 5 -o n.csv", "more than any gyroscope has; expected a unit, as in '5 deg/h'"),
        ("noise simulate --white 100 --columns accel_x -o n.csv", "more than any accelerometer has"),
    ],
)
def test_a_number_that_was_meant_in_another_unit_is_refused(imulab, words, said):
    done = imulab(*shlex.split(words))
    assert done.returncode == 2
    assert said in done.stderr


def test_what_is_stated_with_its_unit_is_taken_at_any_size(imulab):
    for words in (
        "tumble plan --attitudes 20 --order 2 --noise '0.0002 ug'",
        "tumble plan --attitudes 20 --order 2 --noise 20",
        "noise plan --white '0.3 rad/s/sqrt(Hz)'",
        "noise plan --white 1e-4",
    ):
        assert imulab(*shlex.split(words)).returncode == 0, words
    assert il.plan_noise(white=0.3).needed > 0


def test_a_row_without_any_reading_is_said_once_for_all_sensors():
    recording = il.simulate_tumble(gravity=9.81, attitudes=16, order=1)
    torn = {name: values.copy() for name, values in recording.columns.items()}
    for name in torn.keys() - {"time"}:
        torn[name][700] = np.nan
    fit = il.fit_tumble(recording.with_columns(torn, {}), order=1, gravity=9.81, with_="gyro")
    assert sum("bridged from their neighbours" in each for each in fit.calibration.warnings) == 1


def test_models_of_noise_are_named_in_words():
    fit = il.fit_noise(
        il.simulate_noise(white="0.3 deg/sqrt(h)", walk="20 deg/h/sqrt(h)", duration="5 min", rate=20, seed=2)
    )
    note = next(text for text in fit.calibration.warnings if "equally well" in text)
    models = note.partition(": ")[2].removesuffix(" describe the record about equally well")
    assert {*models.replace(" and ", ", ").split(", ")} & {"white noise (N)", "white noise + random walk (NK)"}
    assert all(re.fullmatch(r"[\w/+ -]+ \([NBKG]+\)", model) for model in models.replace(" and ", ", ").split(", "))
