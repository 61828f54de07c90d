"""The Python face of the C core: shapes and types are checked, streams go on where they stopped, to the bit."""

import subprocess
import sys
import threading
import zlib
from dataclasses import replace

import numpy as np
import pytest

import madeup
from imulab.device import METHODS, _runtime
from imulab.device.tables import pack
from imulab.device.unit import (
    ALONE,
    NOT_FINITE,
    ArraySettings,
    DeviceUnit,
    Stream,
    array_stream,
    array_table,
    fuse_table,
)
from imulab.errors import DataError, OptionError, RecordError
from imulab.procedures.apply import tables_of
from imulab.procedures.warmup import MODELS


def readings(samples=600, elements=6, axes=1, seed=1):
    """Unequal gyros seeing one slow turn, with a spike, a gap and a jump."""
    rng = np.random.default_rng(seed)
    turn = np.sin(np.arange(samples) * 0.01)[:, None, None]
    z = turn + 1e-3 * rng.uniform(0.5, 1.5, (axes, elements)) * rng.standard_normal((samples, axes, elements))
    z += 0.01 * rng.standard_normal((axes, elements))
    z[100:101, :, 0] += 5.0
    z[200:230, :, 1] = np.nan
    z[300:, :, 2] += 0.1
    return z


def settings(method, elements=6, axes=1, **more):
    rng = np.random.default_rng(2)
    if method == "covariance":
        more["weights"] = rng.uniform(0.5, 2, (axes, elements))
    if method == "kalman":
        more["gain"] = 0.01 * rng.uniform(0.5, 2, (axes, elements + 1, elements))
    return ArraySettings(method, elements, axes, rate=50.0, **more)


def same(a, b):
    return np.array_equal(a, b, equal_nan=True)


# ---- streams -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("axes", [1, 3])
@pytest.mark.parametrize("method", METHODS)
def test_block_sizes_do_not_change_a_bit(method, axes):
    z = readings(axes=axes)
    still = np.arange(len(z)) % 50 > 40
    made = settings(method, axes=axes)
    whole = Stream(made).process(z, flags=True, weights=True, still=still)
    for size in (1, 7, 64, 599):
        stream = Stream(made)
        parts = [
            stream.process(z[at : at + size], flags=True, weights=True, still=still[at : at + size])
            for at in range(0, len(z), size)
        ]
        assert same(np.concatenate([part.rate for part in parts]), whole.rate)
        assert same(np.concatenate([part.flags for part in parts]), whole.flags)
        assert same(np.concatenate([part.weights for part in parts]), whole.weights)
    bare = Stream(made).process(z, flags=False, still=still)
    assert bare.flags is None
    assert bare.weights is None
    assert same(bare.rate, whole.rate)


@pytest.mark.parametrize("method", METHODS)
def test_a_stream_goes_on_in_another_process(method, tmp_path):
    z = readings()
    whole = Stream(settings(method)).process(z).rate
    first = Stream(settings(method))
    first.process(z[:333])
    (tmp_path / "state").write_bytes(first.state())
    np.save(tmp_path / "z.npy", z[333:])
    script = (
        "import numpy as np; from imulab.device.unit import Stream\n"
        "stream = Stream.from_state(open('state', 'rb').read())\n"
        "np.save('rate.npy', stream.process(np.load('z.npy')).rate)\n"
    )
    subprocess.run([sys.executable, "-c", script], cwd=tmp_path, check=True)
    assert same(np.load(tmp_path / "rate.npy"), whole[333:])
    assert same(Stream.from_state(first.state()).process(z[333:]).rate, whole[333:])
    assert same(first.process(z[333:]).rate, whole[333:])  # taking the state changed nothing


def test_a_state_keeps_every_setting():
    made = settings("robust", bias=np.full(6, 0.01), initial_bias=np.arange(6.0), weights=np.arange(1.0, 7), memory=0.1)
    again = Stream.from_state(Stream(made).state()).settings
    for name in ArraySettings.__dataclass_fields__:
        assert np.array_equal(getattr(again, name), getattr(made, name)), name


def test_the_rate_may_change_on_the_way():
    stream = Stream(settings("robust"))
    stream.process(readings(50))
    before = stream.process(readings(1)).rate
    stream.rate = 100.0
    assert stream.rate == 100.0
    assert np.isfinite(before).all()
    assert np.isfinite(stream.process(readings(50)).rate).all()
    with pytest.raises(OptionError, match="rate 0"):
        stream.rate = 0.0


def test_states_that_cannot_be_are_refused():
    state = Stream(settings("robust")).state()
    for wrong in (b"", b"imulab", b"x" * 100, state[:10], state[len(b"imulab.stream 1\n") :]):
        with pytest.raises(RecordError, match="not the state of a stream"):
            Stream.from_state(wrong)
    rng = np.random.default_rng(1)
    for at in [20, len(state) - 1, *rng.integers(16, len(state), 50)]:
        altered = bytearray(state)
        altered[at] ^= 1
        with pytest.raises(RecordError, match="cut or altered"):
            Stream.from_state(bytes(altered))
    for size in rng.integers(24, len(state), 50):
        with pytest.raises(RecordError, match="cut or altered"):
            Stream.from_state(state[:size])
    shorter = state[:-12]
    with pytest.raises(RecordError, match="another build of the core"):
        Stream.from_state(shorter + zlib.crc32(shorter).to_bytes(4, "little"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"method": "magic"}, "unknown method 'magic'; known methods: mean support"),
        ({"kernel": "round"}, "unknown kernel 'round'; known kernels: gaussian exponential"),
        ({"axes": 2}, "2 axes: expected 1 or 3"),
        ({"elements": 2}, "robust: expected 3 to 64 gyros per axis, found 2"),
        ({"elements": 65}, "found 65"),
        ({"method": "mean", "elements": 0}, "mean: expected 1 to 64"),
        ({"memory": 1.0}, "memory 1.0: expected growing, or a gain between 0 and 1"),
        ({"memory": 0.0}, "memory 0.0"),
        ({"rate": 0.0}, "rate 0.0: expected more than 0 Hz"),
        ({"rate": np.inf}, "rate inf"),
        ({"initial_bias": "last"}, "initial bias 'last': expected first, zero or biases"),
        ({"initial_bias": "frist"}, "zero or biases; did you mean 'first'?"),
        ({"initial_bias": [1.0, 2.0]}, "initial bias: expected shape"),
        ({"bias": [np.nan] * 6}, "bias: expected finite numbers"),
        ({"weights": [1.0] * 5}, "weights: expected shape"),
        ({"weights": [0.0] * 6}, "robust: the table has contents that cannot be"),
        ({"matrices": np.eye(3)}, "matrices: expected shape"),
        ({"method": "kalman"}, "kalman: the table has contents that cannot be"),
        ({"method": "covariance"}, "covariance: the table has contents that cannot be"),
        ({"start": 0}, "robust: the table has contents that cannot be"),
    ],
)
def test_settings_that_cannot_be_are_refused(change, message):
    given = {"method": "robust", "elements": 6, "axes": 1} | change
    with pytest.raises(OptionError, match=message.replace("(", r"\(")):
        Stream(ArraySettings(**given))


def test_readings_of_another_shape_are_refused():
    stream = Stream(settings("mean"))
    for shape in ((5, 5), (5, 2, 6), (6,), (5, 1, 7)):
        with pytest.raises(DataError, match=r"expected readings of shape \(m, 1, 6\)"):
            stream.process(np.zeros(shape))
    with pytest.raises(DataError, match=r"expected still of shape \(5,\)"):
        stream.process(np.zeros((5, 6)), still=np.zeros(4, dtype=bool))
    assert stream.process(np.zeros((0, 6))).rate.shape == (0, 1)


def test_readings_of_any_layout_are_taken():
    z = readings()[:, 0]
    expected = Stream(settings("robust")).process(z).rate
    wide = np.zeros((len(z), 13))
    wide[:, ::2][:, :6] = z
    for same_numbers in (z.copy(order="F"), wide[:, ::2][:, :6], z.tolist(), z[:, None, :], z.astype(">f8")):
        assert same(Stream(settings("robust")).process(same_numbers).rate, expected)


def test_growing_memory_has_a_name():
    z = readings(50)
    assert same(array_stream("robust", 6, memory="growing").process(z).rate, array_stream("robust", 6).process(z).rate)


def test_fuse_table_is_a_stream_from_the_start():
    z = readings(axes=3)
    made = settings("least-squares", axes=3)
    assert same(fuse_table(array_table(made), z.reshape(len(z), -1)), Stream(made).process(z).rate)


def test_flags_say_what_was_met():
    z = readings(10)
    z[5, 0, 2:] = np.nan
    fused = Stream(settings("robust")).process(z, weights=True)
    assert (fused.flags[5, 0, 2:] & NOT_FINITE).all()
    assert (fused.flags[5, 0, :2] == ALONE).all()
    assert fused.weights[5, 0].tolist() == [0.5, 0.5, 0, 0, 0, 0]


# ---- units ---------------------------------------------------------------------------------------------------------


def test_a_unit_has_the_sections_of_its_tables_and_no_others():
    accel, gyro = tables_of(madeup.tumble(1, gyro=True))
    columns = [np.zeros(3)] * 3
    with pytest.raises(ValueError, match="the table has no section for this call"):
        DeviceUnit.of(accel).gyro(columns, None)
    with pytest.raises(ValueError, match="no section"):
        DeviceUnit.of(gyro).tumble(columns)
    with pytest.raises(ValueError, match="no section"):
        DeviceUnit.of(gyro).centrifuge(columns[:2], columns[:2])
    with pytest.raises(ValueError, match="no section"):
        DeviceUnit.of(gyro).warmup(20.0, 0.1, np.zeros(3, dtype=np.uint32), columns)
    assert _runtime.has(_runtime.load(pack([accel, gyro], 8))) == 3


def test_columns_of_other_lengths_and_types_are_refused():
    unit = _runtime.load(pack(tables_of(madeup.tumble(1)), 8))
    good = tuple(np.zeros(5) for _ in range(3))
    out = tuple(np.zeros(5) for _ in range(3))
    for wrong, message in (
        (np.zeros(4), "expected 5 items, found 4"),
        (np.zeros(5, dtype=np.float32), "expected an array of type 'd', found 'f'"),
        (np.zeros(5, dtype=np.int64), "expected an array of type 'd'"),
        (np.zeros(5, dtype=">f8"), "expected an array of type 'd'"),
        (np.zeros(10)[::2], "contiguous"),
        (np.frombuffer(bytes(41), dtype=np.uint8)[1:].view(np.float64), "aligned|type 'd'"),
        (None, "bytes-like"),
    ):
        with pytest.raises((TypeError, ValueError, BufferError), match=message):
            _runtime.tumble(unit, (good[0], wrong, good[2]), out)
        with pytest.raises((TypeError, ValueError, BufferError)):
            _runtime.tumble(unit, good, (out[0], wrong, out[2]))
    fixed = np.zeros(5)
    fixed.flags.writeable = False
    with pytest.raises((ValueError, BufferError), match=r"read-?only|writ"):
        _runtime.tumble(unit, good, (out[0], out[1], fixed))
    with pytest.raises(TypeError, match="tuple of 3 arrays"):
        _runtime.tumble(unit, good[:2], out)
    with pytest.raises(TypeError, match="tuple of 3 arrays"):
        _runtime.tumble(unit, list(good), out)
    for wrong_unit in (None, 7, object()):
        with pytest.raises(ValueError, match="PyCapsule"):
            _runtime.tumble(wrong_unit, good, out)


def test_a_state_of_another_size_or_place_is_refused():
    unit = _runtime.load(pack([array_table(settings("mean"))], 8))
    state = _runtime.array_start(unit)
    z, rate = np.zeros((4, 6)), np.zeros(4)
    with pytest.raises(ValueError, match="items"):
        _runtime.array_block(unit, state[:-1], z, None, rate, None, None)
    shifted = memoryview(bytearray(len(state) + 1))[1:]
    with pytest.raises(ValueError, match="aligned state"):
        _runtime.array_block(unit, shifted, z, None, rate, None, None)
    with pytest.raises(ValueError, match="expected a multiple of 6 readings, found 5"):
        _runtime.array_block(unit, state, np.zeros(5), None, rate, None, None)
    with pytest.raises(ValueError, match="expected 4 items, found 3"):
        _runtime.array_block(unit, state, z, None, rate[:3], None, None)
    with pytest.raises(ValueError, match="expected 24 items"):
        _runtime.array_block(unit, state, z, None, rate, np.zeros(4, dtype=np.uint8), None)


def test_inputs_are_left_alone():
    table = tables_of(madeup.warmup())[0]
    raw = [np.ones(4), np.ones(4)]
    out, covered = DeviceUnit.of(table).warmup(20.0, 0.1, np.arange(4, dtype=np.uint32), raw)
    assert covered
    assert all((column == 1).all() for column in raw)
    assert (out[0] != 1).all()
    some, _ = DeviceUnit.of(table).warmup(20.0, 0.1, np.arange(4, dtype=np.uint32), [None, raw[1]])
    assert some[0] is None
    assert same(some[1], out[1])
    untouched, covered = DeviceUnit.of(table).warmup(np.nan, 0.1, np.arange(4, dtype=np.uint32), raw)
    assert not covered
    assert same(untouched[0], raw[0])
    with pytest.raises(ValueError, match="an argument or a setting that cannot be"):
        DeviceUnit.of(table).warmup(20.0, 0.0, np.arange(4, dtype=np.uint32), raw)


@pytest.mark.parametrize("model", MODELS)
def test_warmup_fills_columns_of_other_units(model):
    """From the bias alone, found by subtracting from zero; a factor of two to some power rounds nothing."""
    rng = np.random.default_rng(9)
    unit = DeviceUnit.of(*tables_of(madeup.warmup(model, "taper")))
    ticks = np.sort(rng.integers(0, int(1.3 * madeup.SETTLED / madeup.TICK), 5000)).astype(np.uint32)
    raw = list(rng.uniform(-1, 1, (2, 5000)))
    bias, _ = unit.warmup(21.5, madeup.TICK, ticks, [np.zeros(5000), np.zeros(5000)])
    into = [np.full(5000, np.nan), np.full(5000, np.nan)]
    out, covered = unit.warmup(21.5, madeup.TICK, ticks, raw, factors=[64.0, 0.5], into=into)
    assert covered
    assert out[0] is into[0]
    assert same(np.array(into), np.array([raw[0] + 64 * bias[0], raw[1] + 0.5 * bias[1]]))
    with pytest.raises(ValueError, match="expected 2 items, found 3"):
        unit.warmup(21.5, madeup.TICK, ticks, raw, factors=[1.0, 1.0, 1.0])


def test_threads_may_share_a_unit():
    """The interpreter's lock is released; a unit is never written to."""
    unit = DeviceUnit.of(*tables_of(madeup.tumble(4)))
    columns = [np.random.default_rng(i).uniform(-5000, 5000, 200_000) for i in range(3)]
    expected, _ = unit.tumble(columns)
    found = [None] * 4

    def work(i):
        found[i] = unit.tumble(columns)[0]

    threads = [threading.Thread(target=work, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(same(np.array(force), np.array(expected)) for force in found)


SAMPLES = 2000


def any_settings(rng, method):
    """Settings of three axes, a calibrated start and a fixed gain among them."""
    n = int(rng.integers(3, 10))
    more = {}
    if method == "robust":
        more = {
            "weights": rng.uniform(0.5, 2, (3, n)) if rng.random() < 0.4 else None,
            "memory_time": float(rng.choice([4.0, 100.0])),
            "weight_cap": float(rng.choice([0.3, 0.5, 0.9])),
        }
    if method == "covariance":
        more["weights"] = rng.uniform(0.5, 2, (3, n))
    if method == "kalman":
        more["gain"] = 0.01 * rng.uniform(0.5, 2, (3, n + 1, n))
    return ArraySettings(
        method,
        n,
        3,
        rate=50.0,
        memory=0.01 if rng.random() < 0.3 else None,
        start=int(rng.choice([1, 50])),
        initial_bias=[lambda: "first", lambda: "zero", lambda: 0.01 * rng.standard_normal((3, n))][rng.integers(3)](),
        bias=0.02 * rng.standard_normal((3, n)) if rng.random() < 0.3 else None,
        **more,
    )


def axis_suffix(settings, axis):
    """The same for one of the axes."""

    def row(value):
        return value if value is None or isinstance(value, str) else value[axis : axis + 1]

    return replace(
        settings,
        axes=1,
        initial_bias=row(settings.initial_bias),
        bias=row(settings.bias),
        weights=row(settings.weights),
        gain=row(settings.gain),
    )


def any_readings(rng, n):
    """Gyros of unlike quality, coarse ones at times, in motion, with faults of single gyros of single axes."""
    deviation = 0.05 * rng.uniform(0.5, 1.5, (3, n)) * np.where(rng.random((3, n)) < 0.1, 0.1, 1.0)
    z = 0.3 * np.sin(0.01 * np.arange(SAMPLES))[:, None, None] + deviation * rng.standard_normal((SAMPLES, 3, n))
    if rng.random() < 0.25:
        step = rng.choice([0.002, 0.02, 0.05])
        z = step * np.round(z / step)
    for _ in range(rng.integers(4)):
        begin = int(rng.integers(SAMPLES))
        end = min(SAMPLES, begin + int(rng.integers(1, rng.choice([10, SAMPLES]))))
        one = z[begin:end, rng.integers(3), rng.integers(n)]
        match rng.integers(7):
            case 0:
                one[:] = np.nan
            case 1:
                one[:] = 0.0
            case 2:
                one[:] = one[0]
            case 3:
                one[::7] += 5.0
            case 4:
                one += 0.4
            case 5:
                one += 0.03
            case 6:
                z[begin:end, rng.integers(3)] = np.nan
    return z


def compare(rng, method):
    settings = any_settings(rng, method)
    z = any_readings(rng, settings.elements)
    still = np.arange(SAMPLES) % 400 < 40 if rng.random() < 0.3 else None
    flags, weights = rng.random() < 0.6, rng.random() < 0.3
    together = Stream(settings)
    cuts = np.sort(rng.integers(0, SAMPLES, rng.integers(6)))
    parts = [
        together.process(z[rows], flags=flags, weights=weights, still=None if still is None else still[rows])
        for rows in np.split(np.arange(SAMPLES), cuts)
    ]
    share = len(together._state) // 3
    for axis in range(3):
        alone = Stream(axis_suffix(settings, axis))
        fused = alone.process(z[:, axis], flags=flags, weights=weights, still=still)
        np.testing.assert_array_equal(np.concatenate([part.rate[:, axis] for part in parts]), fused.rate[:, 0])
        if flags:
            np.testing.assert_array_equal(np.concatenate([part.flags[:, axis] for part in parts]), fused.flags[:, 0])
        if weights:
            found = np.concatenate([part.weights[:, axis] for part in parts])
            np.testing.assert_array_equal(found, fused.weights[:, 0])
        assert together._state[axis * share : (axis + 1) * share] == alone._state[:share]


def test_robust(reduced):
    for seed in range(40 if reduced else 120):
        compare(np.random.default_rng(seed), "robust")


@pytest.mark.parametrize("method", [method for method in METHODS if method != "robust"])
def test_the_other_methods(method):
    for seed in range(10):
        compare(np.random.default_rng([seed, 1]), method)
