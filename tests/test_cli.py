"""The command line as a user meets it."""

import json
import subprocess
import sys
from html import unescape
from pathlib import Path

import numpy as np
import pytest

import imulab as il
from conftest import REPOSITORY
from imulab.cli import main
from imulab.cli.demo import SCENARIOS

G = "9.80665"


def test_version(imulab):
    assert imulab("--version").stdout == f"imulab {il.__version__}\n"


@pytest.mark.parametrize("arguments", [[], ["tumble"], ["tumble", "fit"], ["apply"], ["show"], ["report"], ["demo"]])
def test_every_command_has_help(imulab, arguments):
    done = imulab(*arguments, "--help")
    assert done.returncode == 0
    assert done.stdout.startswith("Usage: imulab")


def test_importing_imulab_imports_nothing_heavy():
    code = (
        "import sys, imulab; print(sorted({m.split('.')[0] for m in sys.modules} & "
        "{'numpy','scipy','polars','plotly','pydantic','dask','rosbags','typer','rich','jinja2'}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


def test_the_version_is_printed_before_anything_else_is_imported():
    code = (
        "import sys; from imulab.cli import main; main(['--version']); "
        "print({'typer', 'pathlib', 'numpy'} & set(sys.modules), "
        "sum(m.partition('.')[0] == 'imulab' for m in sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == f"imulab {il.__version__}\nset() 4\n"


def test_help_imports_no_numerics():
    code = (
        "import sys; from imulab.cli import main; main(['--help']); "
        "print({'numpy','scipy','pydantic','jinja2'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.endswith("set()\n")


def test_a_fit_and_noise_load_no_package_that_takes_longer_than_they_do(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    il.write_csv(il.simulate_tumble(order=1, gravity=9.81, seed=1), "tumble.csv")
    heavy = (
        "{'scipy.special._basic', 'scipy.optimize', 'scipy.linalg', 'scipy.signal', 'scipy.fft', 'numpy.f2py', "
        "'numpy.testing', 'numpy.ma'}"
    )
    for words in (["tumble", "fit", "tumble.csv", "--gravity", "9.81"], ["allan", "tumble.csv"]):
        code = f"import sys; from imulab.cli import main; print(main({words}), {heavy} & set(sys.modules))"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        assert done.stdout.endswith("\n0 set()\n")


def test_a_plain_fit_imports_no_code_for_what_it_does_not_do(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    il.write_csv(il.simulate_tumble(order=1, gravity=9.81, seed=1), "tumble.csv")
    rooms = (
        "imulab.procedures.tumble.mag.", "imulab.procedures.tumble.montecarlo", "imulab.procedures.tumble.device",
        "imulab.procedures.apply", "imulab.procedures.exporting", "imulab.exporters", "imulab.device.unit",
        "imulab.report.plots", "imulab.live", "imulab.fleet", "scipy", "rich", "jinja2",
    )  # fmt: skip
    code = (
        "import sys; from imulab.cli import main; main(['tumble', 'fit', 'tumble.csv', '--gravity', '9.81']); "
        f"print([name for name in sys.modules if name.startswith({rooms})])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.endswith("\n[]\n")


def test_no_submodule_hides_a_public_function():
    """Importing a submodule puts it where its package looks names up: imulab.apply must stay the function."""
    import importlib
    import pkgutil

    for module in pkgutil.walk_packages(il.__path__, "imulab."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    assert callable(il.apply)
    assert {m.name.split(".")[1] for m in pkgutil.walk_packages(il.__path__, "imulab.")}.isdisjoint(il.__all__)


def test_public_names_all_resolve():
    for name in il.__all__:
        assert getattr(il, name) is not None
    assert set(il.__all__) <= set(dir(il))
    with pytest.raises(AttributeError, match="no attribute 'frob'"):
        il.frob  # noqa: B018


def test_simulate_fit_apply_show_report(imulab, tmp_path):
    """The whole way, and the corrected data against the simulated truth."""
    assert imulab("tumble", "simulate", "-o", "t.csv", "--seed", "5", "--attitudes", "20").returncode == 0
    done = imulab("tumble", "fit", "t.csv", "--gravity", G, "-o", "t.json", "--report", "t.html")
    assert done.returncode == 0, done.stderr
    assert "record: t.json" in done.stdout
    assert "report: t.html" in done.stdout
    shown = imulab("show", "t.json").stdout
    assert "tumble calibration of SIM-0005" in shown
    assert "source t.csv SHA-256" in shown
    assert imulab("report", "t.json", "-o", "again.html").returncode == 0
    assert (tmp_path / "again.html").read_bytes() == (tmp_path / "t.html").read_bytes()
    assert imulab("apply", "t.json", "t.csv", "-o", "c.csv").returncode == 0
    raw, corrected = il.read(tmp_path / "t.csv"), il.read(tmp_path / "c.csv")
    assert list(corrected.columns) == list(raw.columns)
    assert corrected.metadata == raw.metadata
    np.testing.assert_array_equal(corrected.column("gyro_x"), raw.column("gyro_x"))
    pieces = il.find_attitudes(raw).pieces
    error = corrected.triad("accel") - raw.triad("truth_accel")
    means = np.array([error[a:b].mean(axis=0) for a, b, _ in pieces])
    assert np.abs(means).max() < 5e-4 * 9.80665


def test_apply_writes_to_standard_output_what_it_writes_to_a_file(imulab, imulab_process, tmp_path):
    imulab("tumble", "simulate", "-o", "t.csv", "--attitudes", "16", "--hold", "2", "--order", "1")
    imulab("tumble", "fit", "t.csv", "--gravity", G, "-o", "t.json", "--order", "1")
    imulab("apply", "t.json", "t.csv", "-o", "c.csv")
    text = (tmp_path / "c.csv").read_text()
    assert imulab("apply", "t.json", "t.csv").stdout == text
    assert imulab_process("apply", "t.json", "-", stdin=(tmp_path / "t.csv").read_text()).stdout == text


def test_json_prints_the_record_alone(imulab, tmp_path):
    imulab("tumble", "simulate", "-o", "t.csv", "--attitudes", "16", "--hold", "2", "--order", "1")
    done = imulab("tumble", "fit", "t.csv", "--gravity", G, "--order", "1", "-o", "t.json", "--json")
    assert json.loads(done.stdout) == json.loads((tmp_path / "t.json").read_text())
    assert imulab("show", "t.json", "--json").stdout == (tmp_path / "t.json").read_text()


def test_normal_gravity_is_recorded_with_its_origin(imulab):
    imulab("tumble", "simulate", "-o", "t.csv", "--attitudes", "16", "--hold", "2", "--order", "1")
    done = imulab("tumble", "fit", "t.csv", "--latitude", "-33.9", "--height", "40", "--order", "1", "--json")
    gravity = json.loads(done.stdout)["model"]["gravity"]
    assert gravity["value"] == pytest.approx(il.normal_gravity(np.radians(-33.9), 40.0), rel=1e-15)
    assert gravity["from"] == "normal gravity at latitude -33.9 deg, height 40 m (WGS 84)"


def test_without_gravity_a_warning_goes_to_standard_error(imulab, tmp_path):
    imulab("tumble", "simulate", "-o", "t.csv", "--attitudes", "16", "--hold", "2", "--order", "1")
    text = (tmp_path / "t.csv").read_text()
    (tmp_path / "t.csv").write_text("\n".join(line for line in text.split("\n") if not line.startswith("# gravity")))
    done = imulab("tumble", "fit", "t.csv", "--order", "1")
    assert done.returncode == 0
    assert done.stderr.startswith("imulab: warning: no local gravity was given")
    assert done.stderr.count("\n") == 1


def test_show_describes_a_recording(imulab):
    imulab("tumble", "simulate", "-o", "t.csv", "--attitudes", "16", "--hold", "2")
    shown = imulab("show", "t.csv").stdout
    assert "t.csv: 6200 samples" in shown
    assert "duration 61.99 s, rate 100 Hz, gaps 0" in shown
    assert "serial: SIM-0001" in shown
    assert "temperature" in shown


def test_a_reader_that_closes_the_pipe_ends_the_command_quietly(tmp_path):
    run = [sys.executable, "-m", "imulab"]
    for command in (["tumble", "simulate", "-o", "t.csv"], ["tumble", "fit", "t.csv", "--gravity", G, "-o", "t.json"]):
        subprocess.run([*run, *command], cwd=tmp_path, check=True, capture_output=True)
    with subprocess.Popen(
        [*run, "apply", "t.json", "t.csv"], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        process.stdout.readline()
        process.stdout.close()
        error = process.stderr.read()
    assert error == ""
    assert process.returncode == 141


@pytest.mark.slow
def test_the_demonstration_makes_what_it_names(imulab, tmp_path):
    done = imulab("demo", "here")
    assert done.returncode == 0, done.stderr
    names = {p.name for p in (tmp_path / "here").iterdir()}
    assert {"tumble.csv", "tumble.json", "tumble.html", "tumble_corrected.csv"} <= names
    for name in ("tumble", "array", "warmup", "centrifuge", "noise"):
        assert {f"{name}.json", f"{name}.html"} <= names
    assert {"imulab.c", "imulab.h", "unit.c", "README.md"} <= {
        p.name for p in (tmp_path / "here" / "firmware").iterdir()
    }
    assert {"line", "fleet.html"} <= names
    index = (tmp_path / "here" / "index.html").read_text()
    assert 'href="fleet.html"' in index
    for name in ("tumble", "array", "warmup", "centrifuge", "noise"):
        verdict = il.load(tmp_path / "here" / f"{name}.json").verdict
        assert verdict.state == ("look" if name == "tumble" else "good")  # one attitude is knocked
        assert f'class="state {verdict.state}"' in index
        assert all(reason in unescape(index) for reason in verdict.reasons[:1])
    fleet = "12 of 12 units have their record: 12 good; LINE-0005 is beyond the limits of bias_x; LINE-0005 stands out"
    assert f"{fleet}; bias_z drifts over the date" in done.stdout
    assert "LINE-0007 changed since the last calibration" in done.stdout
    assert sum(path.stat().st_size for path in (tmp_path / "here").rglob("*") if path.is_file()) < 30 * 2**20
    assert il.load(tmp_path / "here" / "tumble.json").model["order"] == 2
    assert "±" in done.stdout
    assert "set aside" in done.stdout
    assert "self-test: pass" in done.stdout
    assert done.stdout.rstrip().splitlines()[-1] == f"open {Path('here') / 'index.html'}"
    record = il.load(tmp_path / "here" / "tumble.json")
    truth = il.read(tmp_path / "here" / "tumble.csv").metadata
    for name, parameter in record.parameters.items():
        error = (parameter.value - float(truth[f"truth_{name}"])) / parameter.standard_uncertainty
        assert abs(error) < 4, name


def test_how_much_the_demonstration_runs_is_said(capsys):
    assert len([scenario for scenario in SCENARIOS if scenario.record.endswith(".json")]) == 5
    said = "five procedures and a fleet on simulated instruments"
    assert main(["demo", "--help"]) == 0
    pages = [(REPOSITORY / name).read_text() for name in ("README.md", "docs/quickstart.md")]
    assert all(said in text for text in (capsys.readouterr().out, *pages))


def test_no_path_of_a_machine_is_in_the_sources():
    import os

    home = os.path.expanduser("~") + "/"  # noqa: PTH111
    for path in [*(REPOSITORY / "src").rglob("*.py"), *(REPOSITORY / "docs").rglob("*.md")]:
        assert home not in path.read_text(), path


def test_apply_warns_once_beyond_what_the_test_has_seen(imulab, tmp_path):
    imulab("tumble", "simulate", "-o", "t.csv", "--attitudes", "20", "--hold", "3", "--order", "2")
    imulab("tumble", "fit", "t.csv", "--gravity", G, "-o", "t.json", "--order", "2")
    lines = (tmp_path / "t.csv").read_text().splitlines()
    titles = next(i for i, line in enumerate(lines) if line.startswith("time"))
    fields = lines[titles + 3].split(",")
    lines[titles + 3] = ",".join([fields[0], "50.0", *fields[2:]])
    (tmp_path / "wild.csv").write_text("\n".join(lines) + "\n")
    done = imulab("apply", "t.json", "wild.csv", "-o", "c.csv")
    assert done.returncode == 0
    assert done.stderr.startswith("imulab: warning: wild.csv: 1 samples beyond 2 g (up to 5.")
    _, said = done.stderr.splitlines()
    rows = len(il.read(tmp_path / "t.csv"))
    assert said == f"imulab: note: {rows} rows of wild.csv corrected by t.json: c.csv"
    assert imulab("apply", "t.json", "t.csv", "-o", "c.csv").stderr == said.replace("wild", "t") + "\n"
    assert imulab("apply", "t.json", "t.csv", "-o", "c.csv", "--quiet").stderr == ""
    assert imulab("apply", "t.json", "t.csv").stderr.endswith("corrected by t.json: standard output\n")
    twice = imulab("apply", "t.json", "t.json", "t.csv", "-o", "twice.csv")
    assert twice.returncode == 2
    assert "t.csv: already corrected by t.json" in twice.stderr
    assert not (tmp_path / "twice.csv").exists()


def test_output_that_cannot_be_written_is_a_refusal(tmp_path):
    run = [sys.executable, "-m", "imulab"]
    subprocess.run([*run, "tumble", "simulate", "-o", "t.csv"], cwd=tmp_path, check=True, capture_output=True)
    with open("/dev/full", "w") as full:  # noqa: PTH123
        done = subprocess.run(
            [*run, "show", "t.csv"], cwd=tmp_path, stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert done.returncode == 2
    assert done.stderr == "imulab: standard output: cannot be written: No space left on device\n"


def test_a_terminal_without_greek_letters_is_no_fault(tmp_path):
    run = [sys.executable, "-m", "imulab"]
    subprocess.run([*run, "tumble", "simulate", "-o", "t.csv"], cwd=tmp_path, check=True, capture_output=True)
    done = subprocess.run(
        [*run, "tumble", "fit", "t.csv", "--gravity", G],
        cwd=tmp_path, env={"PYTHONIOENCODING": "ascii", "PATH": ""}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


def test_a_link_keeps_its_name_and_a_device_stays_a_device(imulab, tmp_path):
    (tmp_path / "target.json").write_text("old")
    (tmp_path / "link.json").symlink_to(tmp_path / "target.json")
    imulab("tumble", "simulate", "-o", "t.csv", "--attitudes", "16", "--hold", "2", "--order", "1")
    done = imulab("tumble", "fit", "t.csv", "--gravity", G, "--order", "1", "-o", "link.json")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "link.json").is_symlink()
    assert il.load(tmp_path / "target.json").model["order"] == 1
    done = imulab("tumble", "fit", "t.csv", "--gravity", G, "--order", "1", "-o", "/dev/null", "--json")
    assert done.returncode == 0, done.stderr
    assert not (tmp_path / "/dev/null").is_file()


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_a_full_device_behind_a_link_is_named_as_it_was_given(imulab, tmp_path, ending):
    (tmp_path / "a.csv").write_text("time [s],accel_x [g]\n0,1\n1,2\n")
    (tmp_path / f"out.{ending}").symlink_to("/dev/full")
    done = imulab("convert", "a.csv", "-o", f"out.{ending}")
    assert done.returncode == 2
    assert done.stderr == f"imulab: out.{ending}: cannot be written: No space left on device\n"
