"""Every command with nonsense in every option and file, and every kind of record with nonsense in every field.

Each ends with exit status 0 or 2, in bounded time and memory; 1 would be a fault of imulab. What is tried is drawn
anew where it is a part of all, with a fixed seed in the quick run.
"""

import copy
import json
import os
import random
import shutil
from pathlib import Path

import pytest

import imulab as il
import nonsense
from conftest import some_of
from imulab.cli.show import describe_record
from imulab.errors import ImulabError
from imulab.exporters import EXPORTERS
from imulab.procedures.registry import loads
from test_records_forged import VALUES, found_at, paths, sealed

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")

SAMPLE, SHARES = 40, 40
"""Calls of the quick run; tests that the slow run divides all calls into."""
RECORDS = {
    "tumble.json": "tumble.csv",
    "six.json": "six.csv",
    "array.json": "still.csv",
    "spin.json": "spin/c1_1g.csv",
    "warm.json": "cold/cycle_+0_1.csv",
    "noise.json": "rest.csv",
    "hot.json": "hot/tumble_20.csv",
    "rate.json": "turned/pz_1.csv",
}
ALWAYS = [
    "rate simulate --faces +z --sweep 1e400 -o OUT",
    "rate simulate --faces +z --rates 50,100 --hold 1e9 -o OUT",
    "tumble simulate --hold 1e9 -o OUT.csv",
    "tumble simulate --hold 1e300 -o OUT.csv",
    "rate turn one.csv -o OUT.json",
    "centrifuge reduce fast.toml -o OUT.json",
    "noise simulate --white 1e300 -o OUT.csv",
    "tumble simulate --attitudes " + "9" * 300 + " -o OUT.csv",
]


@pytest.fixture(scope="module")
def inputs(made_once):
    def fill(folder):
        nonsense.make_inputs(folder)
        (folder / "one.csv").write_text("time [s],gyro_x [deg/s],gyro_y [deg/s],gyro_z [deg/s]\n0,1,2,3\n")
        manifest = (folder / "spin" / "manifest.toml").read_text().replace('file = "', 'file = "spin/')
        lines = ["arm_rate = 1e308" if line.startswith("arm_rate") else line for line in manifest.splitlines()]
        (folder / "fast.toml").write_text("\n".join(lines))

    return made_once("nonsense", fill)


@pytest.fixture
def there(inputs, tmp_path, monkeypatch):
    """A folder of copies of the inputs, which some nonsense names as output."""
    shutil.copytree(inputs, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def complaint(words):
    """What is wrong with the end of a call, or nothing."""
    status, said = nonsense.outcome(words)
    checks = status == 1 and "check" in words[:2] and "internal error" not in said
    ended = status == 0 or checks or (status == 2 and "Traceback" not in said and "\x1b[31m" not in said)
    return "" if ended else f"{' '.join(words)[:300]!r}: {status} {said[-300:]}"


@pytest.mark.parametrize("command", nonsense.CALLS)
@pytest.mark.slow
def test_the_calls_work_as_they_are(command, there):
    status, said = nonsense.outcome([*command.split(), *nonsense.words_of(there, nonsense.CALLS[command], "OUT")])
    assert status == 0, said


@pytest.mark.parametrize("line", ALWAYS)
def test_a_known_nonsense_is_refused(line, there):
    status, said = nonsense.outcome(nonsense.words_of(there, line, "OUT"))
    assert (status, said.count("\n")) == (2, 1), said
    assert len(said) < 500
    assert not list(there.glob("OUT*"))


@pytest.mark.slow
def test_some_nonsense_ends_in_words(there):
    calls = nonsense.calls(there)
    assert len({path for path, _, _ in calls}) == len(nonsense.CALLS)
    chosen = random.Random(42).sample(calls, SAMPLE)
    assert [text for _, _, words in chosen if (text := complaint(words))] == []


@pytest.mark.slow
@pytest.mark.parametrize("share", some_of(4, range(SHARES)))
def test_all_nonsense_ends_in_words(share, there, reduced):
    calls = nonsense.calls(there)[share::SHARES]
    chosen = random.Random(share).sample(calls, 10) if reduced else calls
    assert [text for _, _, words in chosen if (text := complaint(words))] == []


def uses(record, recording, folder):
    """What is done with a record that was read."""
    yield lambda: describe_record(record)
    yield lambda: il.write_report(record, folder / "OUT.html")
    yield lambda: il.apply(record, recording)
    yield lambda: il.fuse(recording, calibration=record)
    yield lambda: il.compare_records(record, record)
    for target in EXPORTERS:
        yield lambda target=target: il.export(target, [record], folder / "OUT", lossy=True)


def faults(name, content, places, inputs, folder):
    """Faults of a record that is changed at some places, a line each."""
    recording = il.read(inputs / RECORDS[name])
    wrong = []
    for place, value in places:
        changed = copy.deepcopy(content)
        parent, key = found_at(changed, place[:-1]), place[-1]
        if value is sealed:
            del parent[key]
        else:
            parent[key] = copy.deepcopy(value)
        try:
            record = loads(sealed(changed), "r.json")
        except (ImulabError, ValueError):  # ValueError: of what no JSON holds
            continue
        for number, use in enumerate(uses(record, recording, folder)):
            try:
                use()
            except ImulabError:
                continue
            except Exception as error:
                wrong.append(f"{name} {place} = {value!r:.60}: use {number}: {type(error).__name__}: {error}")
                break
    return wrong


def mutations(content):
    """All places of a record, each with each nonsense; `sealed` stands for a place that is deleted."""
    places = [place for place in paths(content) if place[0] not in ("content_sha256", "options")]
    return [(place, value) for place in places for value in (*VALUES, sealed, 1e99, -1e99, 1e-99, 2**53)]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("name", RECORDS)
def test_some_forged_fields_are_refused_or_used(name, inputs, tmp_path):
    content = json.loads((inputs / name).read_text())
    chosen = random.Random(name).sample(mutations(content), 15)
    assert faults(name, content, chosen, inputs, tmp_path) == []


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("share", some_of(1, range(10)))
@pytest.mark.parametrize("name", RECORDS)
def test_all_forged_fields_are_refused_or_used(name, share, inputs, tmp_path, reduced):
    content = json.loads((inputs / name).read_text())
    all_of_them = mutations(content)[share::10]
    chosen = random.Random(f"{name} {share}").sample(all_of_them, 10) if reduced else all_of_them
    assert faults(name, content, chosen, inputs, tmp_path) == []


FORGED = {
    "hot.json, an interval of one": (
        "hot.json",
        lambda c: c["parameters"]["bias_x"].update(interval_95=[0.0]),
        "interval_95: expected 2 entries, found 1",
    ),
    "an interval of four": (
        "tumble.json",
        lambda c: c["parameters"]["bias_x"].update(interval_95=[-1, 0, 1, 2]),
        "expected 2 entries, found 4",
    ),
    "scale factor 0": (
        "tumble.json",
        lambda c: c["parameters"]["scale_factor_y"].update(value=0.0),
        "scale_factor_y: a scale factor of 0",
    ),
    "over temperature": (
        "hot.json",
        lambda c: c["parameters"]["scale_factor_x"].update(value=0),
        "scale_factor_x: a scale factor of 0",
    ),
    "no covariance": (
        "tumble.json",
        lambda c: forge_correlations(c["covariance"]["matrix"]),
        "a combination of parameters has a variance below 0",
    ),
    "no list": (
        "array.json",
        lambda c: c["elements"][0]["bias"].update(standard_uncertainty=[1e-5]),
        "bias.standard_uncertainty: expected",
    ),
    "terms": (
        "noise.json",
        lambda c: c["model"]["terms"].update(gyro_x="NXZ"),
        "model.terms.gyro_x: expected letters of",
    ),
    "interval next to nothing": (
        "noise.json",
        lambda c: c["data"]["columns"]["gyro_x"]["spectra"][0].update(interval=1e-320),
        "spectra[0].interval: expected a number above 0",
    ),
    "uncertainty next to nothing": (
        "six.json",
        lambda c: c["data"]["attitudes"]["standard_uncertainty"].__setitem__(2, 1e-320),
        "attitudes.standard_uncertainty[2]: expected 0, or a number of 1e-100 or more",
    ),
    "whole number of a list": (
        "noise.json",
        lambda c: c["fit"]["columns"]["gyro_x"]["candidates"][0]["values"].__setitem__(3, 2**70),
        "candidates[0].values[3]: expected a whole number of at most 9.22337e+18",
    ),
    "whole number": (
        "tumble.json",
        lambda c: next(iter(c["fit"]["shared"].values())).update(bias_y=2**70),
        "bias_y: expected a whole number of at most 9.22337e+18",
    ),
    "term": (
        "noise.json",
        lambda c: c["parameters"].update(gyro_x_odd=c["parameters"].pop("gyro_x_walk")),
        "gyro_x_odd: expected a column",
    ),
}


def forge_correlations(matrix):
    """Make three parameters correlated by -0.9 with each other, which no covariance is."""
    for i in range(3):
        for j in range(3):
            if i != j:
                matrix[i][j] = -0.9 * (matrix[i][i] * matrix[j][j]) ** 0.5


@pytest.mark.parametrize("case", FORGED)
def test_what_a_record_may_hold_is_checked_where_it_is_read(case, inputs):
    name, forge, words = FORGED[case]
    content = json.loads((inputs / name).read_text())
    forge(content)
    with pytest.raises(ImulabError, match=r"^r\.json: ") as caught:
        loads(sealed(content), "r.json")
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("spin.json", ("parameters", "y_K_2", "value")),
        ("six.json", ("data", "attitudes", "standard_uncertainty", 2)),
    ],
)
def test_a_zero_that_is_divided_by_is_not_drawn_or_weighed(name, place, inputs, tmp_path):
    content = json.loads((inputs / name).read_text())
    assert faults(name, content, [(place, 0)], inputs, tmp_path) == []


def test_every_record_that_imulab_makes_is_read(inputs):
    for name in RECORDS:
        assert il.load(Path(inputs) / name).procedure
