"""Records and blobs changed at random and sealed again: each works, or is refused in words, and nothing else."""

import copy
import json
import random
import struct
import zlib

import numpy as np
import pytest

import imulab as il
from imulab.cli.show import describe_blob, describe_record
from imulab.device.unit import make_blob
from imulab.errors import ImulabError, RecordError
from imulab.procedures.apply import tables_of_all
from imulab.procedures.gyro_array.simulate import simulate_array
from imulab.procedures.registry import load_any, loads
from imulab.procedures.tumble.simulate import simulate_tumble
from imulab.procedures.views import compare_records
from imulab.procedures.warmup.simulate import simulate_power_cycle
from imulab.recording import Recording
from imulab.records.calibration import content_sha256
from test_centrifuge_apply import record_of

VALUES = [
    None, True, 0, -1, 3, 2**70, 1e308, -1e308, 1e-320, 0.5, "", "x", "nan", "count", "rad/s", [], {}, [[]], [0],
    [1.0, 2.0], [None], ["a"], {"a": 1}, {"value": None, "unit": "m/s^2"}, {"value": "x", "unit": 3}, [[[[1]]]],
    "a" * 3000,
]  # fmt: skip
OPERATIONS = ("delete", "value", "value", "value", "sign", "permute", "cut", "double", "swap", "rename")


def paths(value, at=()):
    if at:
        yield at
    items = value.items() if isinstance(value, dict) else list(enumerate(value))[:5] if isinstance(value, list) else ()
    for key, item in items:
        yield from paths(item, (*at, key))


def found_at(content, path):
    for key in path:
        content = content[key]
    return content


def mutated(content, rng):
    """A copy in which one to three things are deleted, replaced, permuted, cut, doubled, interchanged or renamed."""
    content = copy.deepcopy(content)
    for _ in range(rng.choice([1, 1, 3])):
        places = list(paths(content))
        shallow = [path for path in places if path[0] != "data"]
        path = rng.choice(shallow if shallow and rng.random() < 0.75 else places)
        parent, key = found_at(content, path[:-1]), path[-1]
        old, how = parent[key], rng.choice(OPERATIONS)
        if how == "delete":
            del parent[key]
        elif how == "value":
            parent[key] = copy.deepcopy(rng.choice(VALUES))
        elif how == "sign" and isinstance(old, int | float):
            parent[key] = rng.choice([-old, 0 * old, str(old), [old]])
        elif how == "permute" and isinstance(old, list):
            rng.shuffle(old)
        elif how == "cut" and isinstance(old, list):
            del old[rng.randrange(len(old) + 1) :]
        elif how == "double" and isinstance(old, list):
            parent[key] = old + old
        elif how == "swap":
            parent[key] = copy.deepcopy(found_at(content, rng.choice(places[:1])))
        elif how == "rename" and isinstance(parent, dict):
            parent[f"{key}_"] = parent.pop(key)
    return content


def sealed(content):
    content = {key: value for key, value in content.items() if key != "content_sha256"}
    return json.dumps(content | {"content_sha256": content_sha256(content)}).encode()


@pytest.fixture(scope="module")
def real():
    """A fitted record of each procedure, and a recording that it corrects."""
    turned = simulate_tumble(attitudes=20, order=2, hold=2.0, gravity=9.81, seed=2)
    tumble = il.fit_tumble(il.find_attitudes(turned), gravity=9.81).calibration
    array = {"elements": 3, "axes": 3}
    still = simulate_array(experiment="static", duration=20.0, **array)
    moving = simulate_array(experiment="moving", duration=20.0, **array)
    starts = [simulate_power_cycle(at, seed=[k, at + 20]) for at in (-20, 0, 20) for k in (1, 2)]
    warmup = il.fit_warmup(starts, temperatures=[-20, 0, 20], settling_time=300.0).calibration
    time = np.arange(50) * 0.02
    flown = {"dtg_x": np.sin(time), "dtg_y": np.cos(time), "accel_x": 30 * np.sin(time), "accel_y": 30 * np.cos(time)}
    units = {"dtg_x": "deg/h", "dtg_y": "deg/h", "accel_x": "m/s^2", "accel_y": "m/s^2"}
    return {
        "tumble": (tumble, turned),
        "gyro_array": (il.calibrate_array(still, moving).calibration, moving),
        "warmup": (warmup, starts[2]),
        "centrifuge": (record_of(), Recording({"time": time, **flown}, {"time": "s", **units})),
    }


def tried(do, *arguments, **options):
    """What it gives, and the words of its refusal, one of the two None; anything else that is raised fails the test."""
    try:
        return do(*arguments, **options), None
    except ImulabError as error:
        return None, str(error)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("procedure", ["tumble", "gyro_array", "warmup", "centrifuge"])
def test_a_mutated_record_works_or_is_refused_in_words(procedure, real, tmp_path, reduced):
    trials = 24 if reduced else 60
    record, recording = real[procedure]
    content, rng, loaded = json.loads(record.to_json()), random.Random(f"{procedure} 1"), 0
    for _ in range(trials):
        try:
            data = sealed(mutated(content, rng))
        except ValueError:
            continue
        forged, refusal = tried(loads, data, "r.json")
        if forged is None:
            assert refusal.startswith("r.json: ")
            assert "\n" not in refusal
            continue
        loaded += 1
        tried(describe_record, forged)
        tried(compare_records, record, forged)
        tried(il.write_report, forged, tmp_path / "r.html")
        tried(il.export, "c", [forged], tmp_path / "c")
        if procedure != "gyro_array":
            tried(il.apply, forged, recording)
        for method in ("robust", "covariance", "kalman") if procedure == "gyro_array" else ():
            tried(il.fuse, recording, il.FuseOptions(method=method, calibration=forged))
        for target in ("px4", "ardupilot", "kalibr", "openvins", "ros") if procedure == "tumble" else ():
            tried(il.export, target, [forged], tmp_path / target, lossy=True)
    assert loaded >= trials / 6


def closed(body):
    """A blob's bytes with size and CRC made to fit."""
    body = body[:12] + struct.pack("<I", len(body) + 4) + body[16:]
    return body + struct.pack("<I", zlib.crc32(body))


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("procedure", ["tumble", "gyro_array", "warmup", "centrifuge"])
def test_a_mutated_blob_works_or_is_refused_in_words(procedure, real, tmp_path, reduced):
    trials = 30 if reduced else 90
    record, recording = real[procedure]
    data = make_blob([record], tables_of_all([record]))
    size = struct.unpack_from("<I", data, 20)[0]
    text, rng, path = json.loads(data[24 : 24 + size]), random.Random(f"{procedure} 2"), tmp_path / "unit.blob"
    for number in range(trials):
        body = bytearray(data[:-4])
        at = rng.randrange(16, len(body))
        if number % 3 == 0:
            body[at] ^= 1 << rng.randrange(8)
        elif number % 3 == 1:
            body = body[:at] if rng.random() < 0.5 else body[:at] + body[at + rng.randrange(1, 40) :]
        else:
            said = json.dumps(mutated(text, rng)).encode()
            body = body[:20] + struct.pack("<I", len(said)) + said + body[24 + size :]
        path.write_bytes(closed(bytes(body)))
        blob, refusal = tried(load_any, path)
        if blob is None:
            assert "unit.blob" in refusal
            continue
        tried(describe_blob, blob)
        if procedure == "gyro_array":
            tried(lambda blob=blob: il.fuse(recording, il.FuseOptions(calibration=blob)))
        else:
            tried(il.apply, blob, recording)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: c["options"].update(gravity=1e200), r"options\.gravity: expected a number of at most 1e\+100"),
        (
            lambda c: c["data"]["attitudes"]["mean"].pop(),
            r"expected 20 entries, as data\.attitudes\.label has, found 19",
        ),
        (lambda c: c["model"].update(temperature={"value": "warm"}), r"model\.temperature\.value: expected a number"),
        (
            lambda c: c["fit"].update(shared={"g": {"bias_x": {}}}),
            r"fit\.shared\.g\.bias_x: expected a number, found {}",
        ),
        (lambda c: c["parameters"]["bias_x"].update(standard_uncertainty=-1.0), r"parameters\.bias_x: a standard unc"),
        (lambda c: c["covariance"]["matrix"][0].__setitem__(1, 1e9), "a correlation beyond 1"),
        (
            lambda c: c["covariance"]["names"].__setitem__(0, "bias_y"),
            "expected each a parameter, once, found 'bias_y'",
        ),
    ],
)
def test_what_a_forged_record_says_wrongly_is_named_with_its_place(real, change, words):
    content = json.loads(real["tumble"][0].to_json())
    change(content)
    with pytest.raises(RecordError, match=rf"^r\.json: .*{words}"):
        loads(sealed(content), "r.json")
