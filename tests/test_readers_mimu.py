"""MIMU4444 logs: made here frame by frame, and the real one."""

import struct

import numpy as np
import pytest

import imulab as il
from imulab.errors import ReadError
from imulab.readers.mimu import is_mimu

ACKNOWLEDGED = bytes.fromhex("a02800c8")


def frame(sequence: int, stamp: int, data: list[int]) -> bytes:
    body = struct.pack(">BHBI48h", 0xAA, sequence % 65536, 0x64, stamp % (1 << 32), *data)
    return body + struct.pack(">H", sum(body) % 65536)


def values(k: int) -> list[int]:
    return [(-1) ** j * (100 * k + j) for j in range(48)]


def log(count: int, first_stamp: int = (1 << 32) - 3_000_000) -> list[bytes]:
    return [frame(65530 + k, first_stamp + 1_024_000 * k, values(k % 300)) for k in range(count)]


def test_scale_axes_and_the_wrapped_clock(tmp_path):
    (tmp_path / "log.bin").write_bytes(ACKNOWLEDGED + b"".join(log(20)))
    recording = il.read(tmp_path / "log.bin")
    assert len(recording) == 20
    np.testing.assert_allclose(recording.time, 0.016 * np.arange(20), atol=1e-12)
    # Element i, accelerometer 6 i .. 6 i + 2, gyro 6 i + 3 .. 6 i + 5; value j of frame k is (-1)^j (100 k + j).
    np.testing.assert_allclose(recording.columns["gyro_y_3"], [(100 * k + 16) / 16.4 for k in range(20)])
    np.testing.assert_allclose(recording.columns["accel_z_8"], [(100 * k + 44) * 9.80665 / 2048 for k in range(20)])
    assert recording.units["gyro_x_1"] == "deg/s"
    assert recording.units["accel_x_1"] == "m/s^2"
    assert recording.notes == ()
    (block,) = il.read_blocks(tmp_path / "log.bin")
    assert len(block) == 20


def test_damage_is_skipped_and_said(tmp_path):
    frames = log(30)
    frames[7] = frames[7][:50] + bytes([frames[7][50] ^ 1]) + frames[7][51:]
    del frames[20:23]
    (tmp_path / "log.bin").write_bytes(ACKNOWLEDGED + b"".join(frames) + bytes(40))
    recording = il.read(tmp_path / "log.bin")
    assert len(recording) == 26
    assert recording.notes[0] == "146 bytes between frames were skipped as damaged"
    assert recording.notes[1] == "4 frames are missing from the log, the first after row 7"
    assert np.diff(recording.time).min() > 0


def test_what_follows_a_long_damage_is_read(tmp_path):
    # 30 kB of the log are overwritten, among them two wraps of the clock; the sequence says how long that was.
    frames = log(9000, first_stamp=5)
    junk = bytes([0xAA, 1, 2, 0x64]) * 7500
    (tmp_path / "log.bin").write_bytes(b"".join(frames[:40]) + junk + b"".join(frames[8540:]))
    recording = il.read(tmp_path / "log.bin")
    assert len(recording) == 40 + 460
    assert recording.notes[0] == "30000 bytes between frames were skipped as damaged"
    assert recording.notes[1] == "8500 frames are missing from the log, the first after row 40"
    assert recording.time[40] == pytest.approx(0.016 * 8540, abs=1e-9)
    (tmp_path / "tail.bin").write_bytes(b"".join(frames[:40]) + junk)
    assert il.read(tmp_path / "tail.bin").notes == ("30000 bytes between frames were skipped as damaged",)


@pytest.mark.parametrize("left", [1, 3, 4, 40, 105])
def test_a_log_cut_within_a_frame_is_read_up_to_there_with_a_warning(tmp_path, imulab, left):
    whole = ACKNOWLEDGED + b"".join(log(300))
    (tmp_path / "log.bin").write_bytes(whole + log(301)[-1][:left])
    recording = il.read(tmp_path / "log.bin")
    assert len(recording) == 300
    assert recording.notes == (f"truncated: the last frame, at byte {len(whole)}, is cut; read up to there",)
    for command in (("array", "fuse", "log.bin", "-o", "out.csv"), ("convert", "log.bin", "-o", "out.csv")):
        done = imulab(*command)
        assert done.returncode == 0, done.stderr
        assert done.stderr.count(f"log.bin: truncated: the last frame, at byte {len(whole)}") == 1
    assert "warning: truncated" in imulab("show", "log.bin").stdout


def test_fuse_says_what_was_skipped(tmp_path, imulab):
    frames = log(60)
    del frames[20:23]
    (tmp_path / "log.bin").write_bytes(b"".join(frames[:10]) + bytes(200) + b"".join(frames[10:]))
    done = imulab("array", "fuse", "log.bin", "-o", "out.csv")
    assert done.returncode == 0, done.stderr
    assert "log.bin: 200 bytes between frames were skipped as damaged" in done.stderr
    assert "log.bin: 3 frames are missing from the log, the first after row 20" in done.stderr
    assert "a gap of 0.064 s before row 21 at 0.368 s" in done.stderr


def test_it_is_recognised_by_content_alone(tmp_path):
    assert is_mimu(ACKNOWLEDGED + b"".join(log(2)))
    assert not is_mimu(ACKNOWLEDGED + log(1)[0][:100])
    assert not is_mimu(b"time [s],gyro_x [deg/s]\n" * 20)
    broken = bytearray(log(1)[0])
    broken[30] ^= 4
    assert not is_mimu(bytes(broken))
    (tmp_path / "no.bin").write_bytes(bytes(broken))
    with pytest.raises(ReadError, match="binary data"):
        il.read(tmp_path / "no.bin")


def test_the_real_log(real_data, imulab):
    file = real_data / "mimu4444" / "exp_1.bin"
    recording = il.read(file)
    assert len(recording) == 37_439
    assert recording.notes == ("truncated: the last frame, at byte 3968538, is cut; read up to there",)
    assert recording.time[-1] == pytest.approx(599.0, abs=0.1)
    x1, y2 = recording.columns["gyro_x_1"], recording.columns["gyro_y_2"]
    assert np.corrcoef(x1, -y2)[0, 1] > 0.999
    shown = imulab("show", file)
    assert shown.returncode == 0
    assert "37439 samples" in shown.stdout
    assert "gaps 0" in shown.stdout
