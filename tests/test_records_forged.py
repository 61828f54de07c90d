"""Records and blobs changed at random and sealed again: each works, or is refused in words, and nothing else."""

import copy
import json
import random
import re
import struct
import subprocess
import zlib
from dataclasses import replace

import numpy as np
import pytest

import imulab as il
import madeup
from imulab.cli import main
from imulab.cli.show import describe_blob, describe_record
from imulab.device.tables import pack
from imulab.device.unit import load_blob, make_blob
from imulab.errors import ImulabError, RecordError
from imulab.procedures.apply import tables_of_all
from imulab.procedures.gyro_array.simulate import simulate_array
from imulab.procedures.registry import load_any, loads
from imulab.procedures.tumble.simulate import simulate_tumble
from imulab.procedures.views import compare_records
from imulab.procedures.warmup.simulate import simulate_power_cycle
from imulab.recording import Recording
from imulab.records.calibration import content_sha256
from test_centrifuge_device import record_of

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


@pytest.mark.slow
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


@pytest.mark.slow
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


HIDDEN = ["\n", "\x1b[2J", "\x85", "\u2028", "\u2029", "\u202e", "\u2066", "\x00", "\x7f"]


def forged(**changes) -> bytes:
    """A record whose content is altered, sealed again as a forger can."""
    content = {key: value for key, value in madeup.tumble(1).to_dict().items() if key != "content_sha256"} | changes
    return json.dumps(content | {"content_sha256": content_sha256(content)}).encode()


@pytest.mark.parametrize("hidden", HIDDEN)
@pytest.mark.parametrize(
    ("where", "change"),
    [
        ("sensor.serial", lambda text: {"sensor": {"serial": f"SN{text}42"}}),
        ("software", lambda text: {"software": f"imulab{text}"}),
        (r"warnings\[1\]", lambda text: {"warnings": ["fine", f"look{text}here"]}),
        (r"data\.labels\[2\]", lambda text: {"data": {"labels": [1.0, 2.0, text]}}),
        ("options", lambda text: {"options": {f"gravity{text}": 9.81}}),
    ],
)
def test_a_record_with_hidden_characters_is_refused_naming_the_place(hidden, where, change):
    with pytest.raises(RecordError, match=rf"r\.json: {where}.* holds a control or bidirectional character"):
        loads(forged(**change(hidden)), "r.json")


@pytest.mark.parametrize("created", ["yesterday", '*/ int x = system("id"); /*', "2026-11-20T12:00:00Z # evil", ""])
def test_a_record_made_at_no_time_is_refused(created):
    with pytest.raises(RecordError, match=r"r\.json: created: expected a time such as 2026-11-20T12:00:00Z"):
        loads(forged(created=created), "r.json")


@pytest.mark.parametrize("created", ["2026-11-20T12:00:00Z", "2026-11-20T12:00:00.123+01:00"])
def test_a_record_made_at_a_time_is_read(created):
    assert loads(forged(created=created), "r.json").created == created


def test_what_imulab_writes_it_reads(tmp_path):
    odd = replace(madeup.tumble(1), warnings=("file\u2028name\x1b.csv: odd",), options={"layout\n": "a\u202eb"})
    odd.save(tmp_path / "r.json")
    assert il.load(tmp_path / "r.json").warnings == ("file\\u2028name\\x1b.csv: odd",)
    assert il.load(tmp_path / "r.json").options == {"layout\\x0a": "a\\u202eb"}


@pytest.mark.parametrize("hidden", HIDDEN)
def test_no_text_of_a_record_adds_a_line_to_an_export(tmp_path, hidden):
    record = madeup.tumble(1)
    record = replace(
        record,
        sensor={"serial": f"SN{hidden}1\t1\tEVIL"},
        created=f"now{hidden}EVIL",
        model={**record.model, "output_unit": "m/s^2"},
        parameters={
            name: replace(
                p, unit=p.unit.replace("count", "m/s^2"), value=1.0 + p.value / 1e6 if "scale" in name else p.value
            )
            for name, p in record.parameters.items()
        },
    )
    for target in ("px4", "ardupilot", "kalibr", "openvins", "ros"):
        for path in il.export(target, [record], tmp_path / target, lossy=True):
            lines = path.read_text(encoding="utf-8").splitlines()  # splits at every line end that Unicode knows
            assert not any(line.lstrip().startswith(("EVIL", "1\t1\tEVIL")) for line in lines)
            assert all(line.startswith(("#", "//", "%")) for line in lines if "EVIL" in line)


def test_no_text_of_a_record_becomes_c(tmp_path):
    evil = '*/ int evil = 1; /* ??/\n int evil2; \\\n"'
    record = replace(madeup.tumble(1), sensor={"serial": evil}, created=evil, software=evil)
    il.export("c", [record], tmp_path)
    built = subprocess.run(
        ["cc", "-std=c99", "-Wall", "-Wextra", "-Werror", "-trigraphs", "-c", "unit.c", "-o", "unit.o"],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert built.returncode == 0, built.stderr
    assert "evil" not in subprocess.run(["nm", "unit.o"], cwd=tmp_path, capture_output=True, text=True).stdout


def test_a_blob_with_hidden_characters_is_refused(tmp_path):
    tables = tables_of_all([madeup.tumble(1)])
    text = {"format": "imulab.blob", "sensor": {"serial": "SN\u2028"}, "software": "x", "records": []}
    sections = [{"kind": table.kind, **table.columns} for table in tables]
    (tmp_path / "unit.blob").write_bytes(pack(tables, 4, text | {"sections": sections}))
    with pytest.raises(RecordError, match=r"unit\.blob: sensor\.serial holds a control or bidirectional character"):
        load_blob(tmp_path / "unit.blob")


def test_the_terminal_sees_no_escape_sequences_of_a_file(tmp_path, capsys):
    (tmp_path / "evil.csv").write_text(
        "# serial: \x1b]0;owned\x07SN1\n# place: a\u202eb\ntime [s],accel_x [g]\n0,1\n1,1\n"
    )
    assert main(["show", str(tmp_path / "evil.csv")]) == 0
    shown = capsys.readouterr()
    assert "serial: \\x1b]0;owned\\x07SN1" in shown.out
    assert "place: a\\u202eb" in shown.out
    (tmp_path / "other.csv").write_text("# serial: SN\u202e1\ntime [s],accel_x [g]\n0,1\n1,1\n")
    assert main(["show", str(tmp_path / "other.csv")]) == 2
    assert "serial 'SN\\\\u202e1' holds a character that reverses text" in capsys.readouterr().err
    (tmp_path / "title.csv").write_text("time [s],acc\x1b[31mel [g]\n0,1\n")
    assert main(["show", str(tmp_path / "title.csv")]) == 2
    assert "\x1b" not in capsys.readouterr().err


@pytest.mark.slow
def test_a_page_loads_nothing_uploads_nothing_and_makes_no_links(tmp_path, chromium):
    recording = simulate_tumble(attitudes=15, order=1, hold=3.0, gravity=9.81, seed=2)
    record = il.fit_tumble(il.find_attitudes(recording), order=1, gravity=9.81).calibration
    link = '<a href="https://example.org/">click</a>'
    labels = {**record.data["attitudes"], "label": [link] * 15}
    evil = replace(record, sensor={"serial": link}, data={**record.data, "attitudes": labels}, warnings=(link,))
    il.write_report(evil, tmp_path / "r.html")
    page = (tmp_path / "r.html").read_text()
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]+)"', page)
    assert policy is not None
    assert policy[1].startswith("default-src &#39;none&#39;; script-src &#39;sha256-")
    drawn = subprocess.run(
        [
            chromium, "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
            "--disable-background-networking", "--disable-component-update", "--disable-sync",
            f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=15000", "--dump-dom",
            (tmp_path / "r.html").as_uri(),
        ],
        capture_output=True, text=True, timeout=120, check=True,
    ).stdout  # fmt: skip
    body = re.sub(r"<script.*?</script>", "", drawn, flags=re.DOTALL)
    assert re.search(r'data-drawn="[1-9]', drawn)  # the policy lets the page's own scripts run
    assert "<a " not in re.sub(r'<a[^>]*class="modebar-btn[^>]*>', "", body)
    assert "Share chart" not in body


def test_a_recording_from_python_is_cleaned_as_well():
    assert Recording({}, {}, metadata={"serial\n": "SN\u2028"}).metadata == {"serial\\x0a": "SN\\u2028"}
