"""What a person at a notebook gets wrong ends in one sentence, whatever the function."""

import numpy as np
import pytest

import imulab as il


@pytest.fixture(scope="module")
def recording():
    return il.simulate_tumble(attitudes=12, order=1, hold="2 s")


@pytest.fixture(scope="module")
def fit(recording):
    return il.fit_tumble(recording, order=1)


NO_FILE = "expected the name of a file, found "
WRONG = {
    "load a number": (lambda r, f: il.load(3), NO_FILE + "3"),
    "load nothing": (lambda r, f: il.load(None), NO_FILE + "None"),
    "load a recording": (lambda r, f: il.load(r), NO_FILE),
    "read a number": (lambda r, f: il.read(3), NO_FILE + "3"),
    "read bytes": (lambda r, f: il.read(b"x.csv"), NO_FILE + "b'x.csv'"),
    "read a recording": (lambda r, f: il.read(r), NO_FILE),
    "write swapped": (lambda r, f: il.write("x.csv", r), NO_FILE),
    "write_csv swapped": (lambda r, f: il.write_csv("x.csv", r), NO_FILE),
    "write an array": (lambda r, f: il.write_csv(np.ones((3, 3)), "x.csv"), "expected a Recording to write"),
    "save to a number": (lambda r, f: f.save(3), NO_FILE + "3"),
    "save a record to nothing": (lambda r, f: f.calibration.save(None), NO_FILE + "None"),
    "save a figure to a number": (lambda r, f: f.plot().save(3), NO_FILE + "3"),
    "a manifest of a number": (lambda r, f: il.load_manifest(3), NO_FILE + "3"),
    "gravity in a list": (lambda r, f: il.fit_tumble(r, gravity=[9.81]), r"gravity \[9.81\]: expected a number"),
    "latitude as text": (lambda r, f: il.normal_gravity("52 N", 0), "latitude '52 N': expected a number"),
    "a frame of an array": (lambda r, f: il.Recording.from_frame(np.ones((3, 3))), "expected a data frame of pandas"),
    "a frame of a mapping": (lambda r, f: il.Recording.from_frame({"a": [1]}), "expected a data frame of pandas"),
    "metadata as text": (
        lambda r, f: il.Recording.from_arrays(accel=np.ones((3, 3)), unit="g", metadata="x"),
        "metadata: expected a mapping",
    ),
    "units as text": (lambda r, f: il.Recording({"accel_x": np.ones(3)}, "g"), "units: expected a mapping"),
    "columns as an array": (lambda r, f: il.Recording(np.ones((3, 3)), {}), "columns: expected a mapping"),
}


@pytest.mark.parametrize("call", WRONG)
def test_it_ends_in_one_sentence(call, recording, fit, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    function, message = WRONG[call]
    with pytest.raises(il.ImulabError, match=message) as caught:
        function(recording, fit)
    assert "\n" not in str(caught.value)
    assert not any(tmp_path.iterdir())
