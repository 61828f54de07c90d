"""Records in the files of other programs, read back by those programs' own formulas."""

import json
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest

import imulab as il
import madeup
from imulab.cli import main
from imulab.errors import OptionError, RecordError
from imulab.exporters import EXPORTERS, ExportOptions, export, firmware_c
from imulab.recording import Recording
from imulab.records.calibration import Calibration, Covariance, Parameter
from reference import programs

G = 9.80665


AXES = "xyz"


def record(
    seed=1,
    *,
    order=1,
    unit="m/s^2",
    scale=1.0,
    spread=0.02,
    misalignment=0.01,
    nonlinearity=1e-5,
    gyro=None,
    gyro_spread=0.02,
    g_sensitivity=1e-5,
) -> Calibration:
    rng = np.random.default_rng(seed)
    p = {}

    def put(name, value, its):
        p[name] = Parameter(float(value), 1e-4, its)

    for a in AXES:
        put(f"bias_{a}", rng.normal() * 0.2, "m/s^2")
    for a in AXES:
        put(f"scale_factor_{a}", scale * (1 + spread * rng.uniform(-1, 1)), f"{unit}/(m/s^2)")
    for pair in ("yx", "zx", "zy"):
        put(f"misalignment_{pair}", misalignment * rng.normal(), "rad")
    for power in range(2, order + 1):
        for a in AXES:
            its = "1/(m/s^2)" if power == 2 else f"1/(m/s^2)^{power - 1}"
            put(f"k{power}_{a}", nonlinearity * rng.normal() * 0.1 ** (power - 2), its)
    model = {"order": order, "gravity": {"value": G, "unit": "m/s^2", "from": "argument"}, "output_unit": unit}
    if gyro:
        model["gyro_output_unit"] = gyro
        factor = {"rad/s": 1.0, "deg/s": 180 / np.pi, "count": 1000.0}[gyro]
        for i in AXES:
            put(f"gyro_bias_{i}", 0.01 * rng.normal(), "rad/s")
            put(f"gyro_scale_factor_{i}", factor * (1 + gyro_spread * rng.normal()), f"{gyro}/(rad/s)")
            for j in AXES:
                if i != j:
                    put(f"gyro_misalignment_{i}{j}", gyro_spread * rng.normal(), "rad")
                if g_sensitivity:
                    put(f"gyro_g_sensitivity_{i}{j}", g_sensitivity * rng.normal(), "rad/s/(m/s^2)")
    return Calibration(
        procedure="tumble",
        parameters=p,
        covariance=Covariance((), ()),
        model=model,
        fit={},
        sensor={"serial": f"SN{seed}"},
    )


def other(procedure) -> Calibration:
    return Calibration(procedure=procedure, parameters={}, covariance=Covariance((), ()), model={}, fit={})


def raw(unit="m/s^2", gyro=None, scale=1.0, seed=5) -> Recording:
    rng = np.random.default_rng(seed)
    columns = {f"accel_{a}": scale * rng.uniform(-30, 30, 500) for a in AXES}
    units = dict.fromkeys(columns, unit)
    if gyro:
        columns |= {f"gyro_{a}": rng.uniform(-3, 3, 500) for a in AXES}
        units |= {f"gyro_{a}": gyro for a in AXES}
    return Recording(columns, units)


def biases(text, name):
    """The constant biases, which Kalibr and OpenVINS have as a comment."""
    match = re.search(rf"b of the {name} = \[(.*?)\]", text)
    return np.array([float(value) for value in match[1].split(",")])


# --- exact where the format can hold it --------------------------------------------------------------------------


@pytest.mark.parametrize("unit", ["m/s^2", "g"])
@pytest.mark.parametrize("target", ["px4", "ardupilot"])
def test_autopilots_correct_as_apply_does(tmp_path, target, unit):
    scale = 1 / G if unit == "g" else 1.0
    rec = record(unit=unit, scale=scale, misalignment=0.0, gyro="rad/s", gyro_spread=0.0, g_sensitivity=0.0)
    (file,) = export(target, [rec], tmp_path / "out")
    values, accel, gyro = getattr(programs, target)(file)
    recording = raw(unit, "rad/s", scale)
    mine = il.apply(rec, recording)
    outputs = recording.triad("accel") * (G if unit == "g" else 1.0)  # PX4 and ArduPilot have raw outputs in m/s^2
    single = np.finfo(np.float32).eps
    np.testing.assert_allclose(accel(outputs), mine.triad("accel"), rtol=0, atol=2 * 31 * single)
    np.testing.assert_allclose(gyro(recording.triad("gyro")), mine.triad("gyro"), rtol=0, atol=2 * 3 * single)
    text = file.read_text()
    assert "lossy" not in text
    assert "no axes are turned" in text
    if target == "px4":
        assert values["CAL_ACC0_ID"] == 0
        assert "device id 0" in text


@pytest.mark.parametrize(("device", "warned"), [((), True), (("--device-id", "1246218"), False)])
def test_a_file_that_px4_would_ignore_is_said(folder, capsys, device, warned):
    record(9, misalignment=0.0).save("one.json")
    assert main(["export", "--to", "px4", "one.json", "-o", "out", *device]) == 0
    line = "px4: CAL_ACC0_ID = 0: PX4 ignores this calibration until it is the sensor's number (--device-id)"
    assert (f"imulab: warning: {line}\n" in capsys.readouterr().err) == warned


@pytest.mark.parametrize("gyro", ["rad/s", "deg/s", None])
@pytest.mark.parametrize("target", ["kalibr", "openvins"])
def test_toolboxes_correct_as_apply_does(tmp_path, target, gyro):
    rec = record(3, gyro=gyro, misalignment=0.03, gyro_spread=0.03, g_sensitivity=1e-3)
    (file,) = export(target, [rec], tmp_path)
    imu, corrected = getattr(programs, target)(file)
    recording = raw(gyro=gyro)
    mine = il.apply(rec, recording)
    text = file.read_text()
    rates = recording.triad("gyro") * (np.pi / 180 if gyro == "deg/s" else 1.0) if gyro else np.zeros((500, 3))
    b_w = biases(text, "gyroscopes") if gyro else np.zeros(3)
    a, w = corrected(recording.triad("accel"), rates, biases(text, "accelerometers"), b_w)
    np.testing.assert_allclose(a, mine.triad("accel"), rtol=0, atol=1e-12)
    if gyro:
        expected = mine.triad("gyro") * (np.pi / 180 if gyro == "deg/s" else 1.0)
        np.testing.assert_allclose(w, expected, rtol=0, atol=1e-12)
    assert "accelerometer_noise_density" not in imu
    assert "# not known, to be filled in" in text


@pytest.mark.parametrize(("unit", "scale"), [("m/s^2", 1.0), ("g", 1 / G), ("count", 400.0)])
def test_imu_calib_corrects_as_apply_does(tmp_path, unit, scale):
    rec = record(4, unit=unit, scale=scale, misalignment=0.03)
    (file,) = export("ros", [rec], tmp_path)
    recording = raw(unit, scale=scale)
    outputs = recording.triad("accel") * (G if unit == "g" else 1.0)  # imu_calib gets messages in m/s^2
    np.testing.assert_allclose(
        programs.imu_calib(file)(outputs), il.apply(rec, recording).triad("accel"), rtol=0, atol=1e-12
    )


@pytest.mark.parametrize("target", ["kalibr", "openvins"])
def test_outputs_in_counts_stay_counts_and_the_file_says_so(tmp_path, target):
    rec = record(4, unit="count", scale=400.0, gyro="count")
    (file,) = export(target, [rec], tmp_path)
    text = file.read_text()
    assert "outputs are in count" in text
    _, corrected = getattr(programs, target)(file)
    recording = raw("count", "count", 400.0)
    a, w = corrected(
        recording.triad("accel"), recording.triad("gyro"), biases(text, "accelerometers"), biases(text, "gyroscopes")
    )
    mine = il.apply(rec, recording)
    np.testing.assert_allclose(a, mine.triad("accel"), rtol=0, atol=1e-11)
    np.testing.assert_allclose(w, mine.triad("gyro"), rtol=0, atol=1e-11)


# --- what is lost ------------------------------------------------------------------------------------------------


def largest_error(accel, rec, order):
    """The largest difference to the truth over +-1 g on each axis, by brute force with the model written out."""
    axis = np.linspace(-G, G, 41)
    force = np.array(np.meshgrid(axis, axis, axis)).reshape(3, -1).T
    t = np.array(
        [
            [1, 0, 0],
            [rec.value("misalignment_yx"), 1, 0],
            [rec.value("misalignment_zx"), rec.value("misalignment_zy"), 1],
        ]
    )
    s = force @ t.T
    reading = s.copy()
    for power in range(2, order + 1):
        reading += np.array([rec.value(f"k{power}_{a}") for a in AXES]) * s**power
    scale = np.array([rec.value(f"scale_factor_{a}") for a in AXES])
    output = scale * (reading + np.array([rec.value(f"bias_{a}") for a in AXES]))
    return np.abs(accel(output) - force).max() / G


@pytest.mark.parametrize("target", ["px4", "ardupilot", "kalibr", "openvins", "ros"])
def test_a_loss_is_refused_or_stated_with_its_largest_error(tmp_path, target):
    rec = record(6, order=3, misalignment=0.005, nonlinearity=2e-4)
    folder = tmp_path / "out"
    with pytest.raises(OptionError, match=rf"{target} cannot hold .*k2_x.*k3_z.* within \+-1 g; add --lossy"):
        export(target, [rec], folder)
    assert not folder.exists()
    (file,) = export(target, [rec], folder, ExportOptions(lossy=True))
    text = file.read_text()
    (line,) = [line for line in text.splitlines() if "left out (lossy)" in line]
    assert ("misalignment_yx" in line) == (target in ("px4", "ardupilot"))
    stated = float(re.search(r"up to ([0-9.]+) mg within", line)[1]) * 1e-3
    if target in ("px4", "ardupilot"):
        accel = getattr(programs, target)(file)[1]
    elif target == "ros":
        accel = programs.imu_calib(file)
    else:
        corrected = getattr(programs, target)(file)[1]
        b = biases(text, "accelerometers")

        def accel(output):
            return corrected(output, np.zeros_like(output), b, np.zeros(3))[0]

    assert stated == pytest.approx(largest_error(accel, rec, 3), rel=6e-3)  # three digits


@pytest.mark.parametrize(
    ("change", "refused"),
    [
        ({"misalignment": 0.0}, False),
        ({"misalignment": 2e-7}, False),  # below 1 ug
        ({"misalignment": 3e-6}, True),
        ({"misalignment": 0.0, "order": 2, "nonlinearity": 1e-9}, False),
        ({"misalignment": 0.0, "order": 2, "nonlinearity": 1e-6}, True),
        ({"misalignment": 0.0, "gyro": "rad/s", "gyro_spread": 0.0, "g_sensitivity": 0.0}, False),
        ({"misalignment": 0.0, "gyro": "rad/s", "gyro_spread": 1e-3, "g_sensitivity": 0.0}, True),
        ({"misalignment": 0.0, "gyro": "rad/s", "gyro_spread": 0.0, "g_sensitivity": 1e-4}, True),
    ],
)
@pytest.mark.parametrize("target", ["px4", "ardupilot"])
def test_one_millionth_of_g_is_the_limit(tmp_path, target, change, refused):
    rec = record(7, **change)
    if refused:
        with pytest.raises(OptionError, match="--lossy"):
            export(target, [rec], tmp_path)
        assert list(tmp_path.iterdir()) == []
    else:
        assert len(export(target, [rec], tmp_path)) == 1


def test_what_the_gyroscopes_lose_is_named(tmp_path):
    rec = record(8, gyro="rad/s", misalignment=0.0, gyro_spread=0.01)
    with pytest.raises(
        OptionError, match=r"gyro_scale_factor gyro_misalignment gyro_g_sensitivity.*% of the rate.*deg/s"
    ):
        export("px4", [rec], tmp_path)
    with pytest.raises(OptionError, match=r"gyro_bias.*of bias"):
        export("ros", [rec], tmp_path)


# --- refusals ----------------------------------------------------------------------------------------------------

LOG = "fit a log of the autopilot itself, or export to c or blob, which take outputs in "
REFUSALS = {
    "counts": ("px4", lambda: record(unit="count", scale=400.0), rf"px4: .* in m/s\^2.*outputs in count; {LOG}count$"),
    "volts": ("ardupilot", lambda: record(unit="V", scale=0.1), f"outputs in V; {LOG}V$"),
    "gyro counts": ("px4", lambda: record(gyro="count"), f"gyroscopes with outputs in count; {LOG}count$"),
    "scale": ("ardupilot", lambda: record(scale=0.7), r"scale of axis x is 1\.4.*0\.8 to 1\.2"),
    "px4 scale": ("px4", lambda: record(scale=20.0), r"scale of axis x is 0\.0.*0\.1 to 3"),
    "warmup": (
        "px4",
        lambda: other("warmup"),
        "cannot be exported.*time since power-on, at most.*temperature.*--to c",
    ),
    "warmup 3": (
        "kalibr",
        lambda: other("warmup"),
        "kalibr has no parameter that follows the time since power-on, at most",
    ),
    "warmup 2": ("ardupilot", lambda: other("warmup"), "warmup record cannot be exported.*time since power-on"),
    "array": ("kalibr", lambda: other("gyro_array"), "gyro_array record cannot be exported"),
    "centrifuge": ("ros", lambda: other("centrifuge"), "centrifuge record cannot be exported"),
    "unknown": ("pixhawk", record, "unknown target 'pixhawk'; known targets: c blob px4 ardupilot kalibr openvins ros"),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_what_a_target_cannot_hold_is_refused(tmp_path, case):
    target, make, message = REFUSALS[case]
    with pytest.raises(OptionError, match=message):
        export(target, [make()], tmp_path / "out", ExportOptions(lossy=True))
    assert list(tmp_path.iterdir()) == []


def test_two_records_of_one_kind_and_incomplete_records_are_refused(tmp_path):
    with pytest.raises(OptionError, match="expected one tumble record, found 2"):
        export("px4", [record(), record()], tmp_path)
    rec = record()
    lacking = Calibration(
        procedure="tumble",
        parameters={k: v for k, v in rec.parameters.items() if k != "misalignment_zx"},
        covariance=rec.covariance,
        model=rec.model,
        fit={},
    )
    with pytest.raises(RecordError, match="lacks misalignment_zx"):
        export("kalibr", [lacking], tmp_path)


def test_an_offset_that_ardupilot_does_not_take_is_refused(tmp_path):
    rec = record(misalignment=0.0)
    far = Calibration(
        procedure="tumble",
        parameters={**rec.parameters, "bias_y": Parameter(3.7, 1e-4, "m/s^2")},
        covariance=rec.covariance,
        model=rec.model,
        fit={},
    )
    with pytest.raises(OptionError, match=r"offset of axis y is 3\.\d+ m/s\^2.*at most 3\.5"):
        export("ardupilot", [far], tmp_path)


def test_ardupilots_file_says_that_a_test_from_its_logs_needs_neutral_parameters(tmp_path):
    """ArduPilot logs (raw - OFFS) SCAL: what is fitted to that replaces the parameters by the wrong ones."""
    (file,) = export("ardupilot", [record(misalignment=0.0)], tmp_path)
    assert "record the test with INS_ACCOFFS 0, INS_ACCSCAL 1 and INS_GYROFFS 0" in file.read_text(encoding="utf-8")


# --- noise -------------------------------------------------------------------------------------------------------


def noise(**changes):
    def column(unit, arw, rrw):
        return {
            "unit": unit,
            "angle_random_walk": {"value": arw, "standard_uncertainty": 0.0, "unit": f"{unit}/sqrt(Hz)"},
            "rate_random_walk": {"value": rrw, "standard_uncertainty": 0.0, "unit": f"{unit}/sqrt(s)"},
        }

    columns = {f"accel_{a}": column("m/s^2", v, 4e-6) for a, v in zip(AXES, (1e-3, 2e-3, 1.5e-3), strict=True)}
    columns |= {f"gyro_{a}": column("rad/s", 1e-4, v) for a, v in zip(AXES, (4e-7, 4e-6, 0.0), strict=True)}
    return {"format": "imulab.noise", "sample_rate": {"value": 200.0, "unit": "Hz"}, "columns": columns | changes}


@pytest.mark.parametrize("target", ["kalibr", "openvins"])
def test_noise_keys_come_from_the_allan_analysis_and_are_numbers(tmp_path, target):
    (file,) = export(target, [record(3)], tmp_path, ExportOptions(noise=noise()))
    imu, _ = getattr(programs, target)(file)
    assert imu["accelerometer_noise_density"] == 2e-3
    assert imu["accelerometer_random_walk"] == 4e-6
    assert imu["gyroscope_noise_density"] == 1e-4
    assert imu["gyroscope_random_walk"] == 4e-6
    assert imu["update_rate"] == 200.0
    assert "4.0e-06" in file.read_text()


def test_noise_that_is_not_known_is_a_comment_and_a_wrong_file_is_refused(tmp_path):
    partial = noise()
    partial["columns"] = {k: v for k, v in partial["columns"].items() if k.startswith("accel")}
    (file,) = export("kalibr", [record(3)], tmp_path, ExportOptions(noise=partial))
    imu, _ = programs.kalibr(file)
    assert "gyroscope_noise_density" not in imu
    assert "# gyroscope_noise_density is not known: not measured" in file.read_text()
    unknown = noise()
    unknown["columns"]["gyro_y"]["angle_random_walk"] |= {"value": None, "standard_uncertainty": None, "reason": "..."}
    (file,) = export("kalibr", [record(3)], tmp_path, ExportOptions(noise=unknown))
    imu, _ = programs.kalibr(file)
    assert "gyroscope_noise_density" not in imu
    assert imu["gyroscope_random_walk"] == 4e-6
    assert "# gyroscope_noise_density is not known: not determined on every axis" in file.read_text()
    for wrong, message in (
        ({"a": 1}, "^n.json: lacks 'columns'"),
        (noise(accel_x={"unit": "m/s^2"}), "^n.json: lacks angle_random_walk of accel_x"),
        (noise(accel_x={"unit": "count", "angle_random_walk": {"value": 1.0}}), "accel_x in 'count'"),
        (noise(gyro_y={"unit": "rad/s", "angle_random_walk": {"value": "x"}}), "gyro_y = 'x'"),
    ):
        with pytest.raises(OptionError, match=message):
            export("openvins", [record(3)], tmp_path / "no", ExportOptions(noise=wrong, noise_file="n.json"))
        assert not (tmp_path / "no").exists()


# --- command line ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("option", [{"mag_device_id": 88}, {"mag_mount": "internal"}], ids=str)
def test_options_of_magnetometers_have_no_effect_without_them_and_it_is_said(tmp_path, option):
    told = []
    il.export("px4", record(9, misalignment=0.0), tmp_path, device_id=7, tell=told.append, **option)
    flag = f"--{next(iter(option)).replace('_', '-')}"
    assert f"px4: {flag} has no effect: the record holds no magnetometers" in told


def test_the_command_writes_one_file_and_refuses_in_one_line(imulab, tmp_path):
    record(9, misalignment=0.0).save(tmp_path / "exact.json")
    record(9).save(tmp_path / "rec.json")
    record(9, unit="count", scale=100.0).save(tmp_path / "count.json")
    (tmp_path / "noise.json").write_text(json.dumps(noise()))
    (tmp_path / "taken").write_text("")
    (tmp_path / "empty.json").write_text("{}")
    endings = {"px4": ".params", "ardupilot": ".param", "kalibr": ".yaml", "openvins": ".yaml", "ros": ".yaml"}
    for target, ending in endings.items():
        done = imulab(
            "export", "--to", target, "exact.json", "-o", target, "--device-id", 1246218, "--noise", "noise.json"
        )
        assert done.returncode == 0, done.stderr
        (file,) = (tmp_path / target).iterdir()
        assert file.suffix == ending
        idle = {"--device-id": target != "px4", "--noise": target not in ("kalibr", "openvins")}
        assert {option: f"{target}: {option} has no effect: it is for " in done.stderr for option in idle} == idle
    assert programs.px4(tmp_path / "px4" / "imulab.params")[0]["CAL_ACC0_ID"] == 1246218
    for arguments, fragments in (
        (["--to", "px4", "rec.json", "-o", "no"], ["misalignment_yx", "within +-1 g", "--lossy"]),
        (["--to", "px4", "count.json", "-o", "no", "--lossy"], ["count"]),
        (["--to", "apm", "rec.json", "-o", "no"], ["'apm'", *EXPORTERS]),
        (
            ["--to", "px4", "exact.json", "-o", "no", "--device-id", "7", "--mag-device-id", "7"],
            ["--mag-device-id 7: expected another number than device_id"],
        ),
        (["--to", "px4", "exact.json", "-o", "no", "--device-id", "x"], ["--device-id 'x'"]),
        (["--to", "px4", "exact.json", "-o", "no", "--device-id", "-1"], ["--device-id -1"]),
        (["--to", "px4", "exact.json", "-o", "taken"], ["taken", "folder"]),
        (["--to", "kalibr", "exact.json", "-o", "no", "--noise", "none.json"], ["none.json: no such file"]),
        (["--to", "kalibr", "exact.json", "-o", "no", "--noise", "taken"], ["taken", "no JSON"]),
        (
            ["--to", "kalibr", "exact.json", "-o", "no", "--noise", "exact.json"],
            ["exact.json: expected what 'imulab allan"],
        ),
        (
            ["--to", "kalibr", "exact.json", "-o", "no", "--noise", "empty.json"],
            ["empty.json: expected what 'imulab allan"],
        ),
        (["--to", "px4", "exact.json", "-o", ""], ["-o '' is empty; expected DIR"]),
        (["--to", "px4", "noise.json", "-o", "no"], ["noise.json: not a calibration record"]),
    ):
        done = imulab("export", *arguments)
        assert done.returncode == 2, done.stderr
        assert done.stderr.count("\n") == 1
        for fragment in fragments:
            assert fragment in done.stderr
        assert not (tmp_path / "no").exists()


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    madeup.tumble(2).save("accel.json")
    madeup.tumble(1).save("again.json")
    madeup.warmup().save("warmup.json")
    replace(madeup.warmup(), sensor={"serial": "SN7"}).save("other.json")
    (tmp_path / "cut.json").write_text((tmp_path / "accel.json").read_text()[:500])
    (tmp_path / "file").write_text("x")
    return tmp_path


@pytest.mark.parametrize("target", ["c", "blob"])
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("missing.json -o out", "missing.json: no such file"),
        ("cut.json -o out", "cut.json: not a calibration record"),
        ("file -o out", "file: not a calibration record"),
        (
            "accel.json again.json -o out",
            "both take off bias and scale factor of accel_x accel_y accel_z: expected one",
        ),
        ("accel.json other.json -o out", "imulab: records of different units: SN42 SN7; expected those of one"),
        ("accel.json -o file", "expected a folder to write to, found a file"),
        ("accel.json -o file/out", "the folder cannot be made"),
        ("accel.json", "Missing option"),
        ("-o out", "Missing argument"),
    ],
)
def test_a_mistake_gets_one_line(target, arguments, message, folder, capsys):
    before = sorted(folder.rglob("*"))
    assert main(["export", "--to", target, *arguments.split()]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert message in err
    assert sorted(folder.rglob("*")) == before


def test_an_unknown_target_lists_the_known_ones(folder, capsys):
    assert main(["export", "--to", "pascal", "accel.json", "-o", "out"]) == 2
    assert "unknown target; known targets: c blob px4 ardupilot" in capsys.readouterr().err
    assert not (folder / "out").exists()


def contents(folder):
    """The files of a folder and of those in it, by their names from it on."""
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_it_says_what_it_wrote(folder, capsys):
    assert main(["export", "--to", "c", "accel.json", "warmup.json", "-o", "new/out"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert sorted(line.removeprefix("c: new/out/") for line in lines) == sorted(contents(folder / "new/out"))


def test_a_second_export_replaces_the_first(folder):
    for record in ("accel.json", "again.json", "accel.json"):
        assert main(["export", "--to", "c", record, "-o", "out"]) == 0
    first = contents(folder / "out")
    assert main(["export", "--to", "c", "accel.json", "-o", "other"]) == 0
    assert contents(folder / "other") == first


def test_a_serial_cannot_end_a_comment(folder, capsys):
    record = replace(madeup.tumble(1), sensor={"serial": "*/ int main(void) { /* \\\n??/ µ"})
    record.save("odd.json")
    assert main(["export", "--to", "c", "odd.json", "-o", "out"]) == 0
    text = (folder / "out" / "unit.c").read_text(encoding="utf-8")
    assert text.index("*/") > text.index("int main(void)")
    compiler = shutil.which("cc")
    if compiler:
        strict = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-fsyntax-only"]
        subprocess.run([compiler, *strict, folder / "out" / "unit.c", folder / "out" / "selftest.c"], check=True)


@pytest.mark.parametrize("change", ["edited", "new"])
def test_sources_that_were_changed_after_they_were_compiled_are_not_exported(folder, capsys, monkeypatch, change):
    """After a pull without a build the sources would be of two versions, and none of them that of the desk."""
    source = folder / "runtime"
    shutil.copytree(firmware_c._CHECKOUT, source)
    monkeypatch.setattr(firmware_c, "_CHECKOUT", source)
    if change == "edited":
        (source / "warmup.c").write_text((source / "warmup.c").read_text() + "/* newer */\n")
    else:
        (source / "later.c").write_text("")
    name = "warmup.c" if change == "edited" else "later.c"
    assert main(["export", "--to", "c", "accel.json", "-o", "out"]) == 2
    err = capsys.readouterr().err
    assert err == f"imulab: {name}: the compiled part is older than the source: build again (pip install -e .)\n"
    assert not (folder / "out").exists()


def test_a_record_that_does_not_follow_power_on_needs_no_power_on_temperature(folder, capsys):
    (folder / "in.csv").write_text("time [s],accel_x [count],accel_y [count],accel_z [count]\n0,1,2,3\n")
    assert main(["apply", "accel.json", "in.csv", "--temperature-column", "-o", "out.csv"]) == 0
    assert "power_on_temperature" not in (folder / "out.csv").read_text()
