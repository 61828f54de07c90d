"""Texts of files and records as a forger would write them: nothing reaches a terminal, an export or a page as code."""

import json
import re
import subprocess
from dataclasses import replace

import pytest

import imulab as il
import madeup
from imulab.cli import main
from imulab.device.tables import pack
from imulab.device.unit import load_blob
from imulab.errors import RecordError
from imulab.procedures.apply import tables_of_all
from imulab.procedures.registry import loads
from imulab.procedures.tumble.simulate import simulate_tumble
from imulab.recording import Recording
from imulab.records.calibration import content_sha256

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
    (tmp_path / "evil.csv").write_text("# serial: \x1b]0;owned\x07SN\u202e1\ntime [s],accel_x [g]\n0,1\n1,1\n")
    assert main(["show", str(tmp_path / "evil.csv")]) == 0
    shown = capsys.readouterr()
    assert "serial: \\x1b]0;owned\\x07SN\\u202e1" in shown.out
    (tmp_path / "title.csv").write_text("time [s],acc\x1b[31mel [g]\n0,1\n")
    assert main(["show", str(tmp_path / "title.csv")]) == 2
    assert "\x1b" not in capsys.readouterr().err


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
