"""Records to tables: turning points, what a record lacks, numbers that floats cannot hold, and the layout of bytes."""

import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest

import madeup
from imulab.device.tables import KINDS, monotone_range, pack
from imulab.device.unit import ArraySettings, DeviceUnit, array_table
from imulab.errors import RecordError
from imulab.procedures.apply import tables_of
from imulab.procedures.warmup.device import warmup_table
from imulab.records.calibration import Parameter


def fields_of(table):
    return {field.name: field.values for field in table.fields}


def test_a_table_has_the_record_s_numbers():
    record = madeup.tumble(2, gyro=True, sensitive=True)
    accel, gyro = tables_of(record)
    assert (accel.kind, gyro.kind) == ("tumble", "gyro")
    fields = fields_of(accel)
    assert fields["order"] == 2
    assert fields["gain"].tolist() == [1 / record.value(f"scale_factor_{a}") for a in "xyz"]
    assert fields["misalignment"].tolist() == [record.value(f"misalignment_{p}") for p in ("yx", "zx", "zy")]
    assert fields["nonlinearity"].tolist() == [[record.value(f"k2_{a}") for a in "xyz"]]
    matrix = np.eye(3)
    for i, a in enumerate("xyz"):
        for j, b in enumerate("xyz"):
            matrix[i, j] = 1.0 if i == j else record.value(f"gyro_misalignment_{a}{b}")
    np.testing.assert_allclose(fields_of(gyro)["turn"] @ matrix, np.eye(3), atol=1e-15)
    assert fields_of(gyro)["sensitivity"][0, 1] == record.value("gyro_g_sensitivity_xy")


@pytest.mark.parametrize(
    ("k", "low", "high"),
    [
        ([], -np.inf, np.inf),
        ([0.0], -np.inf, np.inf),
        ([0.5], -0.5, np.inf),  # s + s^2/2 turns at s = -1
        ([-0.5], -np.inf, 0.5),
        ([0.0, -1 / 3], -2 / 3, 2 / 3),  # s - s^3/3 turns at +-1
        ([0.0, 1 / 3], -np.inf, np.inf),
        ([0.0, 0.0, -0.25], -np.inf, 0.75),  # s - s^4/4 turns at 1
        ([0.0, 0.0, 0.0, 0.0], -np.inf, np.inf),
    ],
)
def test_the_range_ends_at_the_turning_points_next_to_zero(k, low, high):
    np.testing.assert_allclose(monotone_range(np.array(k)), (low, high), rtol=1e-12)


def test_the_range_is_that_of_a_fine_search():
    rng = np.random.default_rng(1)
    for _ in range(20):
        k = rng.uniform(-0.2, 0.2, 4)
        s = np.linspace(-20, 20, 40_001)
        a = s + sum(c * s ** (p + 2) for p, c in enumerate(k))
        rising = np.diff(a) > 0
        zero = 20_000
        last = zero + int(np.argmin(rising[zero:])) if not rising[zero:].all() else None
        first = zero - int(np.argmin(rising[:zero][::-1])) if not rising[:zero].all() else None
        low, high = monotone_range(k)
        assert (high == np.inf) == (last is None)
        assert (low == -np.inf) == (first is None)
        if last is not None:
            assert high == pytest.approx(a[last], abs=1e-4)
        if first is not None:
            assert low == pytest.approx(a[first], abs=1e-4)


def changed(record, name, value=None, unit=None):
    old = record.parameters[name]
    new = Parameter(old.value if value is None else value, None, unit or old.unit)
    return replace(record, parameters={**record.parameters, name: new})


@pytest.mark.parametrize(
    ("record", "message"),
    [
        (changed(madeup.tumble(1), "scale_factor_y", 0.0), "a scale factor of 0"),
        (changed(madeup.tumble(1, gyro=True), "gyro_scale_factor_y", 0.0), "a scale factor of 0"),
        (changed(madeup.tumble(1), "bias_x", unit="mg"), "has bias_x in 'mg', expected 'm/s\\^2'"),
        (replace(madeup.tumble(1), model={"order": 6, "output_unit": "count"}), "order 6, expected a whole number"),
        (
            replace(madeup.tumble(1), model={"order": 1.0, "output_unit": "count"}),
            "order: .*, found 1.0",
        ),
        (
            replace(madeup.tumble(1), model={"order": True, "output_unit": "count"}),
            "order: .*, found True",
        ),
        (replace(madeup.centrifuge(), parameters={}), "lacks x_K0"),
        (
            replace(
                madeup.centrifuge(),
                parameters={n: p for n, p in madeup.centrifuge().parameters.items() if n != "y_direction"},
            ),
            "has no y_direction: it was made without table_angle",
        ),
        (replace(madeup.warmup(), sections={}), "lacks its table"),
    ],
)
def test_records_that_cannot_be_are_refused(record, message):
    with pytest.raises(RecordError, match=message):
        tables_of(record)


def test_a_centrifuge_of_one_axis_leaves_the_other_alone():
    whole = madeup.centrifuge()
    one = replace(whole, parameters={n: p for n, p in whole.parameters.items() if n[0] == "y" and n != "y_c2"})
    fields = fields_of(tables_of(one)[0])
    assert fields["has"].tolist() == [0, 1]
    assert fields["c2"].tolist() == [0, 0]  # a term that model choice dropped means 0
    out, _ = DeviceUnit.of(*tables_of(one)).centrifuge([np.full(2, 9.8), np.zeros(2)], [np.zeros(2), np.zeros(2)])
    assert (out[0] == 0).all()
    assert (out[1] != 0).all()


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("model", "spline", "model 'spline'"),
        ("exit", "never", "exit 'never'"),
        ("coefficients", [[[0.0] * 4] * 2] * 3, r"coefficients of shape \(3, 2, 4\), expected \(8, 2, 4\)"),
    ],
)
def test_warmup_tables_that_do_not_fit_are_refused(key, value, message):
    with pytest.raises(RecordError, match=message):
        warmup_table({**madeup.warmup().sections["table"], key: value})


def test_numbers_beyond_a_float_are_refused_by_name():
    record = changed(madeup.tumble(1), "bias_x", 1e300)
    assert pack(tables_of(record), 8)
    with pytest.raises(RecordError, match=r"tumble bias: .* is beyond what 4 bytes hold"):
        pack(tables_of(record), 4)


@pytest.mark.parametrize("width", [4, 8])
def test_the_layout_is_that_of_the_document(width):
    record = madeup.tumble(2)
    text = {"b": "µ", "a": 1}
    data = pack(tables_of(record), width, text)
    assert data[:8] == b"\x89IMULAB\n"
    assert struct.unpack_from("<HHI", data, 8) == (1, width, len(data))
    assert struct.unpack("<I", data[-4:])[0] == zlib.crc32(data[:-4])
    described = b'{"a": 1, "b": "\xc2\xb5"}'
    assert struct.unpack_from("<II", data, 16) == (0, len(described))
    at = 24 + len(described)
    assert data[24:at] == described
    kind, size, order = struct.unpack_from("<III", data, at)
    assert (kind, order) == (KINDS["tumble"], 2)
    assert size == 4 + 18 * width == len(data) - at - 8 - 4
    numbers = np.frombuffer(data, f"<f{width}", 18, at + 12)
    fields = fields_of(tables_of(record)[0])
    expected = np.concatenate(
        [fields[n].ravel() for n in ("gain", "bias", "misalignment", "low", "high", "nonlinearity")]
    )
    assert np.array_equal(numbers, expected.astype(f"<f{width}"))


def test_an_array_table_announces_its_optional_tables():
    table = array_table(ArraySettings("robust", 4, bias=np.zeros(4), weights=np.ones(4)))
    words = struct.unpack_from("<11I", table.payload(4))
    assert words[:3] == (4, 4, 1)
    assert words[10] == 0b01001
    assert len(table.payload(4)) == 4 * (11 + 6 + 4 + 4)
