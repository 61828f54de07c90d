"""Times of foreign files: times of day, dates with slashes, a serial monitor's arrow, counters that wrap, packets."""

import datetime

import numpy as np
import pytest

import imulab as il
from imulab.errors import DataError, ReadError

COLUMNS = '[columns]\ntime = {{ from = 0, {} }}\naccel_x = {{ from = {}, unit = "g" }}\n'


@pytest.fixture
def read(tmp_path, monkeypatch):
    """Return a function that reads lines through a layout, in blocks of some size."""

    def times(lines, how='unit = "iso"', *, top='delimiter = ","\n', accel=1, size=1 << 21):
        monkeypatch.setattr("imulab.readers.text._BLOCK_BYTES", size)
        (tmp_path / "a.txt").write_text("".join(f"{line}\n" for line in lines))
        (tmp_path / "l.toml").write_text(top + COLUMNS.format(how, accel))
        return il.read(tmp_path / "a.txt", tmp_path / "l.toml", name="a.txt")

    return times


@pytest.mark.parametrize("size", [64, 1 << 21])
def test_times_of_day_go_on_past_midnight(read, size):
    seconds = 86_390 + np.arange(200) * 0.1 + np.where(np.arange(200) > 150, 86_400, 0)
    clock = [f"{int(s // 3600 % 24):02}:{int(s // 60 % 60):02}:{s % 60:06.3f},1" for s in seconds + 1e-6]
    assert read(clock, size=size).time == pytest.approx(np.arange(200) * 0.1, abs=1e-6)


def test_dates_keep_their_epoch_and_times_of_day_theirs(read):
    dated = read(["2024-12-11T17:41:40.250Z,1", "2024-12-11T17:41:40.500Z,1"])
    at = datetime.datetime(2024, 12, 11, 17, 41, 40, 250_000, datetime.UTC).timestamp()
    number, _, unit = dated.metadata["epoch"].partition(" ")
    assert (float(number), unit) == (at, "s")
    assert read(["17:41:40.250,1", "17:41:40.500,1"]).metadata["epoch"] == "63700.250000000 s after midnight"


def test_show_says_the_date_of_a_file_with_dates(imulab, tmp_path):
    (tmp_path / "a.csv").write_text("".join(f"2024-12-11T17:41:{40 + k}Z,1\n" for k in range(9)))
    (tmp_path / "l.toml").write_text('delimiter = ","\n' + COLUMNS.format('unit = "iso"', 1))
    shown = imulab("show", "a.csv", "--layout", "l.toml").stdout
    assert "time 0.0 to 8.0 s (2024-12-11 17:41:40 UTC), until 2024-12-11 17:41:48 UTC" in shown
    assert imulab("convert", "a.csv", "--layout", "l.toml", "-o", "b.csv").returncode == 0
    assert "(2024-12-11 17:41:40 UTC)" in imulab("show", "b.csv").stdout


def test_a_time_of_day_that_falls_by_less_than_half_a_day_runs_backwards(read):
    with pytest.raises(ReadError, match=r"row 2 \(line 2\), column time: time runs backwards: expected 17:41:40.500"):
        read(["17:41:40.500,1", "17:41:40.250,1"])


@pytest.mark.parametrize(
    ("text", "day_first", "seconds"),
    [
        ("11/12/2024 17:41:40.250", True, datetime.datetime(2024, 12, 11, 17, 41, 40, 250_000)),
        ("11/12/2024 17:41:40.250", False, datetime.datetime(2024, 11, 12, 17, 41, 40, 250_000)),
        ("31/12/2024 17:41:40", None, datetime.datetime(2024, 12, 31, 17, 41, 40)),
        ("12/31/2024 5:41:40 PM", None, datetime.datetime(2024, 12, 31, 17, 41, 40)),
        ("12/12/2024 12:00:00 AM", None, datetime.datetime(2024, 12, 12)),
        ("1.2.2024 7:01:02,5", True, datetime.datetime(2024, 2, 1, 7, 1, 2, 500_000)),
        ("2024/12/11 17:41:40:250", None, datetime.datetime(2024, 12, 11, 17, 41, 40, 250_000)),
        ("2024-12-11T17:41:40.25+02:00", True, datetime.datetime(2024, 12, 11, 15, 41, 40, 250_000)),
    ],
)
def test_dates_in_the_order_that_the_layout_says(read, text, day_first, seconds):
    """The day before, in ISO 8601, is the origin: Python's own dates give the difference."""
    how = 'unit = "iso"' + ("" if day_first is None else f", day_first = {str(day_first).lower()}")
    found = read(["2024-01-01 00:00:00;1", f"{text};1"], how, top='delimiter = ";"\n')
    assert found.time[1] == (seconds - datetime.datetime(2024, 1, 1)).total_seconds()


def test_a_time_of_day_below_a_date_is_no_date(read):
    with pytest.raises(ReadError, match=r"row 2 \(line 2\), column time: expected a date and time .*found '17:41:41'"):
        read(["2024-12-11 17:41:40,1", "17:41:41,1"])


def test_a_date_that_fits_both_ways_is_refused_with_the_key(read):
    with pytest.raises(ReadError, match=r"row 2 \(line 2\), column time: '11/12/2024 .*day_first = true or false"):
        read(["13/12/2024 17:41:40,1", "11/12/2024 17:41:40,1"])
    with pytest.raises(ReadError, match="expected a date and time"):
        read(["13/12/2024 17:41:40,1"], 'unit = "iso", day_first = false')
    with pytest.raises(ReadError, match="day_first in the layout says"):
        read(["22.11.2024 17:41:40,1"])
    for damaged in ("25:00:00", "11/13/13/2024 1:02:03", "32/12/2024 1:02:03", "12/11/2024", "13:00:00 PM", "1:2:3"):
        with pytest.raises(ReadError, match="expected a date and time"):
            read([f"{damaged},1"], 'unit = "iso", day_first = true')


@pytest.mark.parametrize("size", [64, 1 << 21])
@pytest.mark.parametrize(
    ("line", "top", "how", "accel"),
    [
        ("{} -> {},0.2", 'delimiter = ","\n', 'unit = "iso"', 1),
        ("{} -> ,{},0.2", 'delimiter = ","\n', 'unit = "iso"', 1),
        ("{} -> {} 0.2", 'delimiter = "whitespace"\n', 'unit = "iso"', 2),
        ("{} -> IMU\t{}\t0.2", 'delimiter = "\\t"\nprefix = "IMU"\n', 'unit = "iso"', 1),
        ("{} -> a/g: {} 0.2", 'delimiter = "whitespace"\nprefix = "a/g:"\n', 'unit = "iso"', 1),
    ],
    ids=["comma", "own field", "blanks", "prefix", "prefix and blanks"],
)
def test_a_serial_monitor_writes_the_time_of_each_line(read, line, top, how, accel, size):
    lines = [line.format(f"23:59:59.{980 + 10 * k}" if k < 2 else f"00:00:00.0{k - 2}0", 0.5 * k) for k in range(10)]
    found = read(lines, how, top=top, accel=accel, size=size)
    assert found.time == pytest.approx(np.arange(10) * 0.01, abs=1e-9)
    assert found.column("accel_x").tolist() == [0.5 * k for k in range(10)]


def test_a_serial_monitor_s_time_is_left_out_where_no_date_is_taken(read):
    lines = [f"13:58:48.1{k}6 -> {k},{0.5 * k}" for k in range(10)]
    found = read(lines, 'unit = "s"')
    assert found.time.tolist() == list(range(10))
    assert found.column("accel_x").tolist() == [0.5 * k for k in range(10)]


@pytest.mark.parametrize("size", [64, 1 << 21])
@pytest.mark.parametrize(("unit", "bits"), [("us", 32), ("ms", 16), ("s", 8)])
def test_a_counter_of_stated_width_is_carried_on(read, unit, bits, size):
    step = 20_000 if bits == 32 else 7
    counter = 2**bits - 3 * step + 1 + step * np.arange(2 * 2**bits // step if bits < 32 else 300)
    found = read([f"{value % 2**bits},1" for value in counter], f'unit = "{unit}", bits = {bits}', size=size)
    assert np.array_equal(found.column("time"), counter)


def test_a_counter_beyond_its_width_and_one_that_falls_a_little_are_refused(read):
    with pytest.raises(ReadError, match=r"row 2 \(line 2\), column time: expected a counter below 2\^16 .*found 65536"):
        read(["65535,1", "65536,1"], 'unit = "ms", bits = 16')
    found = read(["500,1", "400,1", "600,1"], 'unit = "ms", bits = 16')
    assert found.column("time").tolist() == [500, 400, 600]  # time that runs backwards, which procedures refuse


@pytest.mark.parametrize("size", [64, 200, 1 << 21])
@pytest.mark.parametrize("whose", ["first", "last"])
def test_rows_of_a_packet_are_spread_within_it(read, whose, size):
    """Packets of 4 to 11 samples at 100 Hz, three of them lost."""
    rng = np.random.default_rng(3)
    start, lines, truth = 0.0, [], []
    for packet in range(60):
        count = int(rng.integers(4, 12))
        start += 0.5 if packet == 40 else 0.0
        time = start + np.arange(1, count + 1) / 100
        start = time[-1]
        truth += time.tolist()
        lines += [f"{time[0] if whose == 'first' else time[-1]:.2f},1"] * count
    found = read(lines, 'unit = "s"', top=f'delimiter = ","\npacket = "{whose}"\n', size=size)
    assert found.time == pytest.approx(truth, abs=1e-9)


@pytest.mark.parametrize(
    ("how", "top", "said"),
    [
        ('unit = "iso", day_first = 1', "", "day_first = 1; expected true"),
        ('unit = "s", day_first = true', "", 'expected for dates only, whose unit is "iso"'),
        ('unit = "us", bits = 4', "", "bits = 4; expected 8 to 64"),
        ('unit = "iso", bits = 32', "", "bits: expected none for dates"),
        ('unit = "s"', 'packet = "middle"\n', 'packet = \'middle\'; expected "first" or "last"'),
    ],
)
def test_a_layout_that_cannot_be_is_refused(read, how, top, said):
    with pytest.raises(ReadError, match=said):
        read(["1,1"], how, top=top)


def test_movella_s_counter_is_carried_on(tmp_path):
    titles = "PacketCounter,SampleTimeFine,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z"
    stamps = (2**32 - 50_000 + 20_000 * np.arange(10)) % 2**32
    rows = [f"{k},{stamp},0,0,9.8,0,0,0" for k, stamp in enumerate(stamps)]
    (tmp_path / "dot.csv").write_text("\n".join([titles, *rows]) + "\n")
    assert np.diff(il.read(tmp_path / "dot.csv", "movella-dot").time) == pytest.approx(0.02, abs=1e-9)


@pytest.mark.parametrize("title", ["time", "when"])
@pytest.mark.parametrize("kind", ["objects", "numpy", "zone", "polars", "missing"])
def test_a_column_of_dates_is_the_time_as_an_index_is(title, kind):
    pandas, polars = pytest.importorskip("pandas"), pytest.importorskip("polars")
    recording = il.simulate_tumble(gravity=9.81)
    start = datetime.datetime(2024, 12, 11, 17, 41, 40)
    dates = [start + datetime.timedelta(seconds=float(t)) for t in recording.column("time")]
    if kind == "polars":
        frame = recording.to_frame("polars").drop("time [s]").with_columns(polars.Series(title, dates))
    else:
        frame = recording.to_frame("pandas").drop(columns="time [s]")
        held = [*dates[:5], None, *dates[6:]] if kind == "missing" else dates
        series = pandas.Series(held, dtype=object)
        frame[title] = series if kind in ("objects", "missing") else pandas.to_datetime(series, utc=kind == "zone")
    found = il.Recording.from_frame(frame)
    expected = recording.column("time").copy()
    if kind == "missing":
        expected[5] = np.nan
    assert found.units["time"] == "s"
    assert found.column("time") == pytest.approx(expected, abs=1e-6, nan_ok=True)


def test_several_columns_of_dates_need_the_name_of_time():
    pytest.importorskip("pandas")
    frame = il.simulate_tumble(gravity=9.81).to_frame("pandas").drop(columns="time [s]")
    frame["a"] = frame["b"] = datetime.datetime(2024, 12, 11)
    with pytest.raises(DataError, match=r"several columns hold dates \(a b\); expected the one of the samples called"):
        il.Recording.from_frame(frame)


def test_dates_in_json_have_an_order_too(tmp_path):
    (tmp_path / "a.json").write_text('{"t": ["11/12/2024 0:00:00", "11/12/2024 0:00:01"], "x": [1, 2]}')
    layout = '[columns]\ntime = { from = "t", unit = "iso" }\naccel_x = { from = "x", unit = "g" }\n'
    (tmp_path / "l.toml").write_text(layout)
    with pytest.raises(ReadError, match="row 1, key 't': '11/12/2024 0:00:00' may be day or month first"):
        il.read(tmp_path / "a.json", tmp_path / "l.toml")
    (tmp_path / "l.toml").write_text(layout.replace('"iso"', '"iso", day_first = false'))
    assert il.read(tmp_path / "a.json", tmp_path / "l.toml").time.tolist() == [0, 1]


@pytest.mark.parametrize("how", ['unit = "iso"', 'unit = "s"'])
@pytest.mark.parametrize("size", [256, 1 << 21])
@pytest.mark.parametrize("stray", ["back", "ahead", "swapped"])
def test_a_row_whose_time_alone_is_off_is_a_damaged_line(read, tmp_path, how, size, stray):
    at = 3600 + np.arange(300) / 100
    at[150] = {"back": 3000.25, "ahead": 9000.0, "swapped": at[151] + 0.001}[stray]
    clock = [f"2024-12-11T{int(s // 3600):02}:{int(s // 60 % 60):02}:{s % 60:06.3f}" for s in (at + 1e-6).tolist()]
    lines = [f"{clock[k] if 'iso' in how else format(at[k], '.3f')},{k}" for k in range(300)]
    if how == 'unit = "iso"':
        with pytest.raises(ReadError, match=r"time runs backwards"):
            read(lines, how, size=size)
    else:
        read(lines, how, size=size)
    found = il.read(tmp_path / "a.txt", tmp_path / "l.toml", damaged="skip", name="a.txt")
    np.testing.assert_array_equal(found.column("accel_x"), np.delete(np.arange(300), 150))
    np.testing.assert_allclose(np.diff(found.time)[:149], 0.01, atol=1e-9)
    assert [note for note in found.notes if "off alone" in note] == [
        "1 row whose time is off alone left out; the first: row 151 (line 151)"
    ]


def test_a_device_that_began_again_is_no_damaged_line(read, tmp_path):
    read([f"{t:.2f},{k}" for k, t in enumerate([*np.arange(50) / 100, *np.arange(50) / 100])], 'unit = "s"')
    found = il.read(tmp_path / "a.txt", tmp_path / "l.toml", damaged="skip")
    assert len(found) == 100
    with pytest.raises(DataError, match="a file of several runs is to be split there"):
        il.find_attitudes(
            found.with_columns(
                {f"accel_{axis}": found.column("accel_x") for axis in "xyz"},
                dict.fromkeys(("accel_x", "accel_y", "accel_z"), "g"),
            )
        )
    many = [f"{0 if k % 25 == 9 else k},1" for k in range(1000)]
    read(many, 'unit = "s"')
    with pytest.raises(ReadError, match=r"the times of 40 rows are off, the first at row 10 \(line 10\)"):
        il.read(tmp_path / "a.txt", tmp_path / "l.toml", damaged="skip")
