"""What a user states of the place of a magnetometer's test: the dip and the hemisphere, alone and all in one go."""

from __future__ import annotations

import numpy as np
import pytest

import imulab as il
from imulab.cli import main
from imulab.errors import DataError, OptionError
from imulab.procedures.tumble.mag.solve import stated_place
from imulab.recording import Recording
from reference import magnetometer as reference

G = 9.80665
DIP = 67.0


def recording(seed=3, noise=1e-3):
    rng = np.random.default_rng(seed)
    truth = reference.random_unit(rng, np.radians(DIP), np.eye(3), size=48.0)
    turned = np.array([reference.random_rotation(rng) for _ in range(24)])
    outputs, mag = reference.simulate(truth, turned, rng, accel=3e-4, field=noise, dip=0.0)
    columns = {f"accel_{a}": outputs[:, i] for i, a in enumerate("xyz")}
    columns |= {f"mag_{a}": mag[:, i] for i, a in enumerate("xyz")}
    return Recording(columns, {c: "g" if c[0] == "a" else "uT" for c in columns}, name="table.csv")


def fitted(**stated):
    return il.fit_mag(recording(), gravity=G, order=2, **stated).calibration


def test_a_stated_dip_changes_nothing_but_what_is_said_of_it():
    plain, told = fitted(), fitted(dip=np.radians(DIP))
    assert told.parameters == plain.parameters
    assert told.covariance == plain.covariance
    assert not any("stated" in warning and "dip" in warning for warning in told.warnings)
    assert not any("hemisphere" in warning for warning in told.warnings)  # the dip's sign says it
    assert told.options["dip"] == [np.radians(DIP), np.radians(0.2)]
    assert told.options["hemisphere"] == "north"


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_dip_off_by_more_than_both_uncertainties_is_said_in_one_sentence(sign):
    found = fitted().parameters["dip"]
    own = found.standard_uncertainty
    for off, said in ((1.8, False), (2.1, True)):
        both = np.hypot(own, np.radians(0.1))
        stated = (found.value - sign * off * both, np.radians(0.1))
        record = fitted(dip=stated)
        sentences = [warning for warning in record.warnings if "deg stated" in warning]
        assert len(sentences) == said
        assert (record.verdict.state == "good") != said
        if said:
            assert f"{off:.1f} standard uncertainties" in sentences[0]
            assert ("more than" if sign > 0 else "less than") in sentences[0]
            assert record.verdict.reasons == tuple(sentences)


def test_a_dip_of_another_place_is_refused():
    for stated in ("70+-0.2 deg", 70.0 * np.pi / 180, "67.6 +/- 0.01 deg", "64±0.1"):
        with pytest.raises(DataError, match=r"was stated: they differ by [0-9]+ standard uncertainties") as refused:
            fitted(dip=stated)
        assert "\n" not in str(refused.value)
    fitted(dip="67.4+-0.01")  # beyond 4 standard uncertainties, within half a degree
    fitted(dip="69+-0.8")
    with pytest.raises(DataError, match="that of the northern hemisphere"):
        fitted(dip="-67")


@pytest.mark.parametrize(
    ("stated", "said"),
    [
        ({"dip": "167"}, "expected -90 to 90 deg"),
        ({"dip": "67+-20"}, "a standard uncertainty of 0 to 10 deg"),
        ({"dip": 67.0}, "expected -90 to 90 deg"),  # rad
        ({"dip": "steep"}, "expected a number"),
        ({"dip": "67+-a bit"}, "uncertainty"),
        ({"dip": (1.0, 0.1, 0.1)}, "expected rad"),
        ({"dip": True}, "expected rad"),
        ({"dip": float("nan")}, "expected -90 to 90 deg"),
        ({"dip": "-67", "hemisphere": "north"}, "dip of the southern hemisphere, hemisphere of the northern"),
        ({"dip": "67", "latitude": "-47 deg"}, "dip of the northern hemisphere, latitude of the southern"),
        ({"latitude": "47 deg", "hemisphere": "south"}, "latitude of the northern hemisphere, hemisphere of the south"),
        ({"hemisphere": "up"}, "expected north or south"),
    ],
)
def test_what_cannot_be_is_refused_before_there_is_data(stated, said):
    arguments = {"hemisphere": None, "latitude": None, "dip": None} | stated
    with pytest.raises(OptionError, match=said):
        stated_place(**arguments)
    if "latitude" not in stated:
        with pytest.raises(OptionError, match=said):
            il.fit_tumble(recording(), gravity=G, order=2, with_="mag", **stated)


def test_a_dip_near_the_magnetic_equator_is_of_either_hemisphere():
    assert stated_place("south", None, "0.5+-0.2").hemisphere == "south"
    assert stated_place(None, "47 deg", None).hemisphere == "north"
    assert stated_place(None, "-15 deg", "-30").hemisphere == "south"
    assert stated_place(None, "5 deg", None).hemisphere is None


def test_one_command_for_all_triads_takes_what_the_magnetometers_own_takes(tmp_path, capsys):
    rec = tmp_path / "rec.csv"
    assert main(["tumble", "simulate", "--field", "48uT", "--order", "1", "-o", str(rec)]) == 0
    same = ["--order", "1", "--field", "48uT", "--hemisphere", "north", "--dip", "67.1+-0.2"]
    assert main(["tumble", "mag", str(rec), *same, "-o", str(tmp_path / "mag.json")]) == 0
    assert main(["tumble", "fit", str(rec), "--with", "mag", *same, "-o", str(tmp_path / "fit.json")]) == 0
    alone, together = il.load(tmp_path / "mag.json"), il.load(tmp_path / "fit.json")
    assert alone.parameters == together.parameters
    assert alone.warnings == together.warnings
    by_function = il.fit_tumble(str(rec), order=1, with_="mag", field="48uT", hemisphere="north", dip="67.1+-0.2 deg")
    assert by_function.calibration.options == together.options
    (tmp_path / "line.csv").write_text(
        "serial,procedure,file,with,order,field,dip,hemisphere\n"
        "A,tumble,rec.csv,mag,1,48uT,67.1+-0.2,north\n"
        "B,tumble,rec.csv,mag,1,48uT,70,\n"
    )
    capsys.readouterr()
    assert main(["fleet", "run", str(tmp_path / "line.csv"), "-o", str(tmp_path / "out"), "--workers", "1"]) == 2
    assert "70.00 deg was stated" in "".join(capsys.readouterr())
    assert il.load(tmp_path / "out" / "A.json").parameters == together.parameters


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--with", "mag", "--latitude", "-47"], "that of the northern hemisphere"),
        (["--with", "mag", "--latitude", "47", "--hemisphere", "south"], "--latitude of the northern hemisphere"),
        (["--with", "mag", "--dip", "71"], "71.00 deg was stated"),
        (["--with", "mag", "--dip", "67,1"], "--dip '67,1': a decimal comma?"),
        (["--dip", "67"], "--dip without magnetometers"),
        (["--hemisphere", "north"], "--hemisphere without magnetometers"),
        (["--with", "mag", "--hemisphere", "up"], "--hemisphere 'up': expected one of north south"),
    ],
)
def test_one_command_for_all_triads_refuses_what_contradicts_the_place(given, said, tmp_path, capsys):
    rec, out = tmp_path / "rec.csv", tmp_path / "out.json"
    main(["tumble", "simulate", "--field", "48uT", "--order", "1", "--hold", "2 s", "-o", str(rec)])
    capsys.readouterr()
    assert main(["tumble", "fit", str(rec), "--order", "1", *given, "-o", str(out)]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert len([line for line in error.splitlines() if "note:" not in line]) == 1
    assert not out.exists()
