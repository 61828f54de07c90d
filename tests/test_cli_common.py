"""What every command has: help where nothing is asked, suggestions, completion, how much is said, and colours."""

import io
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import imulab as il
from imulab.cli import main
from imulab.cli import options as speech
from imulab.cli.options import naming
from imulab.errors import OptionError, UnitError, listed, meant


@pytest.fixture
def recording(imulab):
    done = imulab("tumble", "simulate", "-o", "t.csv", "--attitudes", "16", "--hold", "2", "--order", "1")
    assert done.returncode == 0
    return "t.csv"


def test_alone_it_prints_help_with_three_examples(imulab):
    done = imulab()
    assert done.returncode == 0
    assert done.stderr == ""
    assert done.stdout == imulab("--help").stdout
    examples = done.stdout.partition("Examples:\n")[2].split("\n\n")[0].splitlines()
    assert sum(line.startswith("    imulab ") for line in examples) == 3


@pytest.mark.parametrize("group", ["tumble", "array", "warmup", "centrifuge", "fleet"])
def test_a_group_alone_prints_its_help(capsys, group):
    assert main([group]) == 0
    out, err = capsys.readouterr()
    assert out.startswith(f"Usage: imulab {group} ")
    assert err == ""


def test_help_fits_on_a_screen_and_names_every_option(monkeypatch):
    from imulab.cli.app import commands
    from imulab.cli.help import command_help

    monkeypatch.setenv("COLUMNS", "80")
    for command in commands():
        text = command_help(command)
        assert len(text.splitlines()) <= 46, command.path
        assert all(option.flags[-1] in text for option in command.options)


def test_the_short_help_leaves_out_what_few_runs_need(capsys):
    texts = []
    for flag in ("--help", "--help-all"):
        assert main(["tumble", "fit", flag]) == 0
        texts.append(capsys.readouterr().out)
    assert ["Changes of scale factors" in text for text in texts] == [False, True]
    assert "explained by 'imulab tumble fit --help-all':" in texts[0]
    assert "--nonlinearity --asymmetry" in texts[0]
    assert main(["--help"]) == 0
    assert "Calibrate accelerometers and gyroscopes over temperature." in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "end"),
    [
        (["tumbel"], "; did you mean 'tumble'?"),
        (["tumble", "fitt"], "; did you mean 'fit'?"),
        (["calibrate"], "; expected array calibrate"),
        (["check"], "expected tumble check, noise check, thermal check, magnetometer check"),
        (["simulte"], "; did you mean 'simulate'?"),
        (["fleet", "simulte"], "; did you mean 'simulate'?"),
        (["array", "fuse", "x.csv", "--memory", "growin"], "a gain between 0 and 1; did you mean 'growing'?"),
        (["array", "fuse", "x.csv", "--initial-bias", "fist"], "the file of a record; did you mean 'first'?"),
        (
            ["array", "simulate", "-o", "x.csv", "--unit", "deg/m"],
            "known units: rad/s mrad/s deg/s mdeg/s deg/min deg/h",
        ),
        (["tumble", "fit", "x.csv", "--with", "gyor"], "as in gyro,mag; did you mean 'gyro'?"),
        (["tumble", "fit", "x.csv", "--instance", "al"], "or all; did you mean 'all'?"),
        (["thermal", "fit", "x.csv", "--with", "gyr"], "expected gyro; did you mean 'gyro'?"),
        (["thermal", "fit", "x.csv", "--degrees", "splne,2,1"], "at each temperature; did you mean 'spline'?"),
        (["tumble", "plan", "--attitudes", "12", "--noise", "1ug", "--with", "mga"], "did you mean 'mag'?"),
        (["noise", "fit", "x.csv", "--terms", "atuo"], "; did you mean 'auto'?"),
        (["apply", "r.json", "x.csv", "--heading", "x"], "x: no such file"),
        (["magnetometer", "plan", "--turn", "levle"], "wave or level; did you mean 'level'?"),
        (["magnetometer", "simulate", "-o", "x.csv", "--turn", "wvae"], "wave or level; did you mean 'wave'?"),
        (["live", "replya:x.csv", "--save", "s.csv", "-o", "r.json"], "; did you mean 'replay'?"),
        (["tumble", "plan", "--attitudes", "12", "--noise", "1ug", "--from", "sphre"], "; did you mean 'sphere'?"),
        (["thermal", "plan", "--from", "fixtrue:15", "-o", "x.csv"], "; did you mean 'fixture'?"),
        (["thermal", "plan", "--from", "none.csv", "-o", "x.csv"], "none.csv: no such file"),
        (["show", "--formats", "phypox"], "; did you mean 'phyphox'?"),
        (["tumble", "fit", "x.csv", "--gravty", "9.8"], "'imulab tumble fit --help'; did you mean '--gravity'?"),
        (["tumble", "fit", "x.csv", "--zzz"], "No such option: --zzz; see 'imulab tumble fit --help'"),
        (["report", "x.json", "--unit", "g"], "No such option: --unit; see 'imulab report --help'"),
        (["tumble", "fit", "x.csv", "--uint", "accel=g"], "; did you mean '--unit'?"),
        (["tumble", "fit", "x.csv", "--loss", "Huber"], "square huber auto; did you mean 'huber'?"),
        (["tumble", "fit", "x.csv", "--method", "linearized"], "did you mean 'linearised'?"),
        (["tumble", "simulate", "-o", "x.csv", "--unit", "m/s^3"], "; did you mean 'm/s^2'?"),
        (["tumble", "plan", "--attitudes", "12", "--noise", "20 ugg"], "; did you mean 'ug'?"),
        (["export", "--to", "Kalibra", "-o", "d", "x.json"], "did you mean 'kalibr'?"),
        (["warmup", "simulate", "-o", "d", "--law", "smoth"], "did you mean 'smooth'?"),
        (["array", "simulate", "-o", "x.csv", "--experiment", "dynamical"], "did you mean 'dynamic'?"),
    ],
)
def test_a_slip_of_the_pen_is_told_what_was_meant(capsys, tmp_path, monkeypatch, arguments, end):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert err.endswith(f"{end}\n")
    assert list(tmp_path.iterdir()) == []


def test_only_what_is_near_is_suggested():
    assert meant(["huber", "square"], "HUBER") == "; did you mean 'huber'?"
    assert meant(["+z", "-z"], "z") == ""
    assert meant(["+z", "-z"], "+Z") == "; did you mean '+z'?"
    assert meant(["huber", "square"], "median") == ""
    assert meant(["growing"], "growing") == ""  # what is wrong is elsewhere, as in growing:x
    assert listed(iter(["auto", "0"]), 7) == "auto 0"


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("tumble fit --loss s", ["square"]),
        ("export --to k", ["kalibr"]),
        ("warmup fit --model ", ["auto", "interval-cubic", "knot-cubic", "knot-log-cubic", "exponential"]),
        ("centrifuge reduce --curve c", ["constant", "c1", "c2", "c1+c2"]),
        ("array fuse --method k", ["kalman"]),
        ("tumble c", ["check"]),
        ("tumble gyro --clock", ["--clock", "--clock-of"]),
    ],
)
def test_a_shell_completes_commands_options_and_values(words, expected):
    words = f"imulab {words}"
    environment = os.environ | {
        "_IMULAB_COMPLETE": "complete_bash",
        "COMP_WORDS": words,
        "COMP_CWORD": str(len(words.split(" ")) - 1),
    }
    done = subprocess.run(
        [sys.executable, "-c", "from imulab.cli import run; run()"], env=environment, capture_output=True, text=True
    )
    assert done.stdout.split() == expected
    assert (done.returncode, done.stderr) == (0, "")


OF_FEW_WORDS = {
    "tumble plan": ["--criterion", "--from", "--method"],
    "tumble gyro": ["--g-sensitivity", "--clock-of"],
    "array simulate": ["--experiment", "--mounting", "--fault", "--unit"],
    "array fuse": ["--method", "--memory", "--initial-bias"],
    "array compare": ["--experiment", "--memory"],
    "allan": ["--taus"],
    "warmup simulate": ["--law"],
    "export": ["--to"],
    "noise fit": ["--for"],
    "fleet run": ["--engine"],
}


@pytest.mark.parametrize("path", OF_FEW_WORDS)
def test_an_option_of_few_words_offers_them(path):
    from imulab.cli.app import commands

    (command,) = (command for command in commands() if command.path == path)
    options = {flag: option for option in command.options for flag in option.flags}
    for name in OF_FEW_WORDS[path]:
        words = options[name].words
        assert words
        assert all(words)
        assert options[name].default is None or options[name].default in words


def test_quiet_leaves_out_notes_and_keeps_the_result_and_warnings(imulab, recording, tmp_path):
    said = imulab("tumble", "fit", recording, "--gravity", "9.81", "--order", "1")
    assert "imulab: note: gravity 9.81 m/s^2 counts as rounded" in said.stderr
    quiet = imulab("tumble", "fit", recording, "--gravity", "9.81", "--order", "1", "-q")
    assert quiet.stdout == said.stdout
    assert quiet.stderr == ""
    text = (tmp_path / recording).read_text()
    (tmp_path / "bare.csv").write_text("".join(x for x in text.splitlines(True) if not x.startswith("# gravity")))
    assert imulab("tumble", "fit", "bare.csv", "--quiet").stderr.startswith("imulab: warning: no local gravity")


def test_verbose_says_what_was_read_and_how_long_it_took(imulab, recording):
    plain = imulab("tumble", "fit", recording, "--gravity", "9.80665")
    done = imulab("tumble", "fit", recording, "--gravity", "9.80665", "--window", "1:60", "-v")
    assert done.returncode == 0
    titles = [[line for line in out.stdout.splitlines() if "calibration of" in line] for out in (plain, done)]
    assert titles[0] == titles[1] == ["tumble calibration of SIM-0001"]
    assert f"imulab: {recording}: a text file\n" in done.stderr
    assert f"imulab: {recording}: 5901 rows, 1 to 60 s, columns time accel_x accel_y accel_z " in done.stderr
    assert done.stderr.splitlines()[-1].startswith("imulab: tumble fit took ")
    assert imulab("show", recording, "-q", "-v").stderr == (
        "imulab: --quiet together with --verbose: expected one or the other\n"
    )


def test_json_stays_alone_on_standard_output_when_much_is_said(imulab, recording):
    done = imulab("tumble", "fit", recording, "--json", "-v")
    assert json.loads(done.stdout)["procedure"] == "tumble"
    assert "rows" in done.stderr


def test_every_command_takes_both(capsys):
    from imulab.cli.app import commands

    for command in commands():
        flags = [flag for option in command.options for flag in option.flags]
        assert {"-q", "--quiet", "-v", "--verbose"} <= set(flags), command.path
        assert len(flags) == len(set(flags)), command.path


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_colours_are_for_terminals_that_want_them(monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    assert speech.coloured("good", Terminal()) == "\x1b[32mgood\x1b[0m"
    assert speech.coloured("look", Terminal()) == "\x1b[33mlook\x1b[0m"
    assert speech.coloured("bad", Terminal()) == "\x1b[31mbad\x1b[0m"
    assert speech.coloured("good", io.StringIO()) == "good"
    monkeypatch.setenv("NO_COLOR", "1")
    assert speech.coloured("good", Terminal()) == "good"
    monkeypatch.delenv("NO_COLOR")
    monkeypatch.setenv("TERM", "dumb")
    assert speech.coloured("bad", Terminal()) == "bad"


def test_what_one_command_said_is_not_said_by_the_next(capsys):
    with speech.begin(project=True):
        speech.hold("f.csv", "truncated")
        with speech.begin(project=False):
            assert speech.explained("g.csv: no") == "g.csv: no"
            speech.choose(quiet=True, verbose=False, project=True)
            assert not speech.speech().project
            speech.note("nothing")
        assert speech.explained("f.csv: no") == "f.csv: no (truncated)"
        speech.note("something")
    assert capsys.readouterr().err == "imulab: note: something\n"


def test_a_warning_is_no_note_as_well(capsys):
    with speech.begin(project=True):
        speech.hold("f.csv", "truncated")
        for message in ("truncated", "f.csv: truncated", "cut"):
            speech.note(message)
    assert capsys.readouterr().err == "imulab: warning: f.csv: truncated\nimulab: note: cut\n"


def test_a_file_is_named_once_whatever_it_is_called(tmp_path, monkeypatch):
    for name, message in (("a", "a noise record cannot be applied"), ("a", "a: no samples"), ("x.csv", "no samples")):
        with pytest.raises(OptionError, match=rf"^{name}: {message.removeprefix('a: ')}$"), naming(name):
            raise OptionError(message)
    monkeypatch.chdir(tmp_path)
    Path("u").write_text("time [s],accel_x [gg]\n0,1\n")
    with pytest.raises(UnitError, match=r"^u: column accel_x: unknown unit 'gg'"):
        il.read("u")
