"""Files that pretend to hold more than they do: refused in one line, in little memory and time."""

import bz2
import resource
import sqlite3
import struct
import subprocess
import sys
import zlib

import mcap.writer
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1

import bags
from imulab.errors import ReadError
from imulab.readers.formats import Budget, raise_limit, unpack

MEMORY = 1 << 30
SECONDS = 20  # of the processor, start of Python included, on a machine that others use as well


def refused(path, *options) -> str:
    """Run ``imulab show`` on a file within 1 GB more than a bare start needs; return its one line."""

    def bounded() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (4 * MEMORY, 4 * MEMORY))
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))

    code = (
        "import resource, sys; from imulab.cli import main; status = main(sys.argv[1:]); "
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, file=sys.stdout); sys.exit(status)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, "show", str(path), *map(str, options)],
        capture_output=True, text=True, preexec_fn=bounded, check=False, timeout=120,
    )  # fmt: skip
    assert done.returncode == 2, (done.returncode, done.stderr[-500:])
    assert int(done.stdout.split()[-1]) < MEMORY / 1024
    assert done.stderr.count("\n") == 1
    return done.stderr


def layout(tmp_path, columns: str) -> str:
    (tmp_path / "layout.toml").write_text(f"[columns]\n{columns}\n")
    return str(tmp_path / "layout.toml")


def test_the_budget_is_that_of_the_file_until_it_is_raised(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(bytes(1 << 20))
    assert Budget(path, "a").left == 200 << 20
    path.write_bytes(b"a")
    assert Budget(path, "a").left == 64 << 20
    raise_limit(10**12)
    try:
        assert Budget(path, "a").left == 10**12
    finally:
        raise_limit(None)
    with pytest.raises(ReadError, match=r"^a: unpacks to more than 67 MB, .* --unpack-limit SIZE raises"):
        Budget(path, "a").take(1 << 30)


@pytest.mark.parametrize(
    ("pack", "decoder"), [(zlib.compress, zlib.decompressobj), (bz2.compress, bz2.BZ2Decompressor)]
)
def test_no_more_than_a_byte_too_many_is_unpacked(pack, decoder):
    data = bytes(range(256)) * 40
    assert unpack(decoder, pack(data), len(data)) == data
    assert len(unpack(decoder, pack(data), 100)) == 101
    with pytest.raises((EOFError, OSError)):
        unpack(decoder, pack(data)[:-5], len(data))


def test_several_streams_one_behind_the_other_are_one():
    assert unpack(bz2.BZ2Decompressor, bz2.compress(b"one ") + bz2.compress(b"two"), 100) == b"one two"


MAT_HEAD = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"


def mat_variable(size: int, letter: bytes = b"x", level: int = 1) -> bytes:
    """A variable of `size` zeros (MathWorks, MAT-File Format), compressed."""
    flags = struct.pack("<IIII", 6, 8, 6, 0)
    shape = struct.pack("<IIii", 5, 8, size, 1)
    name = struct.pack("<II", 1, 1) + letter + bytes(7)
    packer = zlib.compressobj(level)
    total = len(flags) + len(shape) + len(name) + 8 + 8 * size
    parts = [packer.compress(struct.pack("<II", 14, total) + flags + shape + name + struct.pack("<II", 9, 8 * size))]
    zeros = bytes(1 << 20)
    parts += [packer.compress(zeros) for _ in range(8 * size >> 20)]
    data = b"".join(parts) + packer.flush()
    return struct.pack("<II", 15, len(data)) + data


@pytest.mark.slow
def test_a_matlab_variable_of_zeros(tmp_path):
    (tmp_path / "bomb.mat").write_bytes(MAT_HEAD + mat_variable(1 << 26))  # 512 MB in 0.5 MB
    said = refused(tmp_path / "bomb.mat", "--layout", layout(tmp_path, 'accel_x = { from = "x", unit = "g" }'))
    assert "bomb.mat: unpacks to more than" in said
    small = tmp_path / "small.mat"
    small.write_bytes(MAT_HEAD + mat_variable(9 << 20, level=9))  # 75 MB in 75 kB
    table = layout(tmp_path, 'accel_x = { from = "x", unit = "g" }')
    assert "unpacks to more than 67 MB" in refused(small, "--layout", table)
    done = subprocess.run(
        [sys.executable, "-m", "imulab", "show", str(small), "--layout", table, "--unpack-limit", "200MB"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert "small.mat: 9437184 samples" in done.stdout, done.stderr


@pytest.mark.slow
def test_a_matlab_variable_that_no_column_takes_is_not_unpacked(tmp_path, imulab):
    (tmp_path / "a.mat").write_bytes(MAT_HEAD + mat_variable(1 << 26) + mat_variable(1 << 17, b"y"))
    done = imulab("show", "a.mat", "--layout", layout(tmp_path, 'accel_x = { from = "y", unit = "g" }'))
    assert "a.mat: 131072 samples" in done.stdout, done.stderr


@pytest.mark.parametrize("kind", ["bag", "mcap"])
def test_a_bag_of_zeros(tmp_path, kind):
    path = tmp_path / f"zeros.{kind}"
    if kind == "bag":
        types = bags.typestore("bag")
        writer = Writer1(path)
        writer.set_compression(Writer1.CompressionFormat.LZ4)
        with writer:
            imu = writer.add_connection("/imu", "sensor_msgs/msg/Imu", typestore=types)
            writer.write(imu, 1, bytes(100 << 20))  # 100 MiB in 400 kB
    else:
        with path.open("wb") as stream:
            writer = mcap.writer.Writer(stream, compression=mcap.writer.CompressionType.ZSTD)
            writer.start()
            schema = writer.register_schema("sensor_msgs/msg/Imu", "ros2msg", b"")
            channel = writer.register_channel("/imu", "cdr", schema)
            writer.add_message(channel, 1, bytes(100 << 20), 1)
            writer.finish()
    assert "unpacks to more than" in refused(path)


@pytest.mark.parametrize("limit", ["lots", "0", "-1GB", "1 parsec"])
def test_a_limit_that_is_no_size_is_refused(tmp_path, imulab, limit):
    done = imulab("show", "a.csv", f"--unpack-limit={limit}")
    assert done.returncode == 2
    assert "--unpack-limit" in done.stderr
    assert "expected a size such as 500MB, 20GB or 8GiB" in done.stderr


@pytest.mark.parametrize("hidden", ["view", "computed", "recursive"])
def test_a_bag_whose_messages_are_made_up_by_sqlite(tmp_path, hidden):
    path = tmp_path / "bag.db3"
    with sqlite3.connect(path) as bag:
        bag.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)")
        bag.execute("INSERT INTO topics VALUES (1, '/imu', 'sensor_msgs/msg/Imu', 'cdr')")
        if hidden == "computed":
            bag.execute("CREATE TABLE messages(id INTEGER, topic_id, timestamp, data AS (zeroblob(1000000000)))")
            bag.execute("INSERT INTO messages VALUES (1, 1, 1)")
        elif hidden == "view":
            bag.execute(
                "CREATE VIEW messages AS SELECT 1 AS id, 1 AS topic_id, 1 AS timestamp, zeroblob(1000000000) AS data"
            )
        else:
            bag.execute(
                "CREATE VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) "
                "SELECT i AS id, 1 AS topic_id, i AS timestamp, x'00' AS data FROM n"
            )
    bag.close()
    assert "expected a plain table messages" in refused(path)


@pytest.mark.parametrize("kind", ["rows", "chunk", "external", "virtual", "link", "link through a link"])
@pytest.mark.slow
def test_an_hdf5_file_that_holds_nothing(tmp_path, kind):
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        if kind == "rows":
            file.create_dataset("x", (10**13,), "f8", chunks=(1000,), compression="gzip")
        elif kind == "chunk":
            file.create_dataset("x", (10**8,), "f8", chunks=(10**8,), compression="gzip", fillvalue=1.0)
        elif kind == "external":
            file.create_dataset("x", (100,), "f8", external=[("/dev/zero", 0, h5py.h5f.UNLIMITED)])
        elif kind == "virtual":
            made = h5py.VirtualLayout((10,), "f8")
            made[:] = h5py.VirtualSource("other.h5", "x", (10,))
            file.create_virtual_dataset("x", made)
        elif kind == "link":
            file["x"] = h5py.ExternalLink("other.h5", "x")
        else:
            with h5py.File(tmp_path / "other.h5", "w") as other:
                other["group/y"] = np.ones(9)
            file["e"] = h5py.ExternalLink("other.h5", "group")
            file["x"] = h5py.SoftLink("/e/y")
    said = refused(path, "--layout", layout(tmp_path, 'accel_x = { from = "x", unit = "g" }'))
    expected = {"external": "lie in other files", "virtual": "lie in other files"}
    expected |= {"link": "found none", "link through a link": "found none"}
    assert expected.get(kind, "unpacks to more than 67 MB") in said


def test_a_matrix_that_several_columns_share_is_counted_once(tmp_path, imulab):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("x", data=np.zeros((2 * 10**6, 3)), compression="gzip")  # 48 MB in 50 kB
    columns = "\n".join(f'accel_{axis} = {{ from = "x[{i}]", unit = "g" }}' for i, axis in enumerate("xyz"))
    done = imulab("show", "a.h5", "--layout", layout(tmp_path, columns))
    assert "2000000 samples" in done.stdout, done.stderr


def test_a_layout_that_skips_more_lines_than_there_are(tmp_path):
    (tmp_path / "a.txt").write_text("1,2,3\n")
    (tmp_path / "layout.toml").write_text(
        'delimiter = ","\nskip_lines = 1000000000000000000\n[columns]\naccel_x = { from = 0, unit = "g" }\n'
    )
    assert "no rows of data" in refused(tmp_path / "a.txt", "--layout", tmp_path / "layout.toml")


@pytest.mark.slow
def test_many_titles_above_many_short_lines(tmp_path):
    titles = ",".join(f"c{i}" for i in range(100_000))
    (tmp_path / "a.csv").write_text(titles + "\n" + "1\n" * 700_000)
    assert "row 1 (line 2): expected 100000 fields, found 1" in refused(tmp_path / "a.csv")
