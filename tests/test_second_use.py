"""Results used a second time: records that must not be, recordings that were corrected, windows of one file."""

import re
from dataclasses import replace

import pytest

import imulab as il
from imulab.cli import main
from imulab.display import Bad, verdict_of

G = "9.81362"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("second")
    for name, seed in (("a", 2), ("b", 1)):
        recording = il.simulate_tumble(attitudes=24, order=1, hold=3.0, gravity=float(G), seed=seed)
        il.write(recording, folder / f"{name}.csv")
    record = il.fit_tumble(il.find_attitudes(il.read(folder / "a.csv")), order=1, gravity=float(G)).calibration
    record.save(folder / "a.json")
    bad = (Bad("the unit is wrong"),)
    replace(record, warnings=bad, verdict=verdict_of(bad)).save(folder / "bad.json")
    return folder


@pytest.fixture
def run(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)

    def command(*words):
        status = main(list(words))
        found = capsys.readouterr()
        return status, found.out, found.err

    return command


def test_a_record_that_must_not_be_used_says_so_wherever_it_is_used(run, tmp_path):
    for words in (
        ["apply", "bad.json", "a.csv", "-o", str(tmp_path / "c.csv")],
        ["export", "--to", "c", "bad.json", "-o", str(tmp_path / "fw")],
    ):
        status, _, said = run(*words)
        assert status == 0
        assert "verdict is bad, do not use this result as it is: the unit is wrong" in said
    assert "verdict" not in run("apply", "a.json", "a.csv", "-o", str(tmp_path / "c.csv"))[2]


def test_a_fit_to_a_corrected_recording_says_what_it_is(run, tmp_path):
    corrected = str(tmp_path / "corrected.csv")
    assert run("apply", "a.json", "a.csv", "-o", corrected)[0] == 0
    _, out, _ = run("tumble", "fit", corrected, "--order", "1", "--gravity", G)
    assert out.startswith("look: ")
    assert "the recording was corrected by a.json: what is found is what that left" in out


def test_another_window_of_the_same_file_is_another_recording(run, tmp_path):
    first = str(tmp_path / "first.json")
    assert run("tumble", "fit", "a.csv", "--window", ":62", "--order", "1", "--gravity", G, "-o", first)[0] == 0
    assert run("tumble", "check", first, "a.csv", "--window", "62:", "--gravity", G)[1].startswith("pass: ")
    assert "was made from this recording" in run("tumble", "check", first, "a.csv", "--gravity", G)[2]
    assert run("tumble", "fit", "a.csv", "--window", "62:", "--prior", first, "--gravity", G)[0] == 0
    status, _, said = run("tumble", "fit", "a.csv", "--window", ":50", "--prior", first, "--gravity", G)
    assert status == 2
    assert "which would count twice" in said


def test_a_prior_of_another_sensor_leaves_a_result_that_must_not_be_used(run):
    status, out, said = run("tumble", "fit", "b.csv", "--prior", "a.json", "--ageing", "0ug,0ppm,0urad")
    assert status == 0
    assert out.startswith("bad: ")
    assert re.search(
        r"no ageing of bias, .* they miss the result by [\d.e+]+ µg rms, \d+ times their uncertainty", said
    )
    assert "fit without the prior" in said


def test_a_limit_below_the_noise_is_not_taken_for_a_change(run):
    status, out, _ = run("tumble", "check", "a.json", "a.csv", "--limit", "1ug", "--gravity", G)
    assert status == 1
    assert "no change of the unit is shown, but an attitude is beyond the limit\n" in out
    assert "the limit is smaller than the uncertainty of the attitudes can tell" in out


def test_a_plan_for_the_noise_of_a_recording_takes_no_model_error_for_noise(run, tmp_path):
    curved = str(tmp_path / "curved.csv")
    assert run("tumble", "simulate", "--order", "2", "--gravity", G, "-o", curved)[0] == 0
    _, out, _ = run("tumble", "plan", "--attitudes", "24", "--noise", curved)
    noise = re.search(r"noise of ([\d.]+) µg in \|f\|", out)
    assert noise is not None
    assert 20 < float(noise[1]) < 60  # 0.7 mg in each of 500 samples; k2 leaves 690 µg at order 1


@pytest.mark.parametrize(("option", "words"), [("--gravity=1g", "gravity to 29 %"), ("--gravity=10", "gravity to 3 %")])
def test_a_gravity_that_is_hardly_known_is_refused(run, option, words):
    status, _, said = run("tumble", "fit", "a.csv", option)
    assert status == 2
    assert words in said
