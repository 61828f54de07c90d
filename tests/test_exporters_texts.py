"""Hostile texts in every text of a record, and every file of every target read by its own compiler or parser.

What a compiler or a parser sees besides comments must be what it sees of a unit with a plain name.
"""

import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from markdown_it import MarkdownIt

import imulab as il
import madeup
from imulab.errors import ImulabError
from imulab.exporters import EXPORTERS
from imulab.exporters.texts import markdown_code
from imulab.recording import Source
from test_exporters_autopilots import record as nine_axes

STUB = Path(__file__).parent / "firmware"
PLAIN = "SN1"
HOSTILE = {
    "block comment": "SN1 */ int evil(void){return 1;} /*",
    "stars": "**//* evil **/*/ int evil; /*/",
    "joined line": "evil \\",
    "trigraph": "evil ???/",
    "trigraphs": "????/??' evil ??/??/",
    "line ends": "a\nint evil; \r\n#define evil\r1\t1\tEVIL\u2028evil: 1\x85evil: 2\x0bevil\x0c\x1c",
    "c string": 'evil"); int evil = 1; ("',
    "format": "evil %s %n {{ evil }} {% evil %} ${evil} $(evil) `evil`",
    "yaml": "evil: [1, 2\n- evil: &a *a !!python/object:evil # ",
    "yaml document": "\n---\nevil: 1\n...\n",
    "no characters": "evil \ufffe\uffff\ufdd0\ud800 evil",
    "markdown": "<script>evil</script> [evil](https://example.org) ![e](https://example.org/e.png) *evil*",
    "markdown code": "``` `` ` </code><b>evil</b> ```",
    "markdown backtick": "`evil",
    "bidirectional": "evil \u202e\u2066 */ \u2069",
    "blank": "  ",
    "empty": "",
}
BLOB = re.compile(r"golden_blob\[\] = \{[\d,\s]*\}")
HOSTILE["all of them"] = " ".join(HOSTILE.values())
QUICK = ("block comment", "all of them", "empty")
INERTIAL = ("c", "px4", "ardupilot", "kalibr", "openvins", "ros", "fusion", "motioncal", "betaflight", "inav")


def renamed(record, text):
    """The record with a text in each of its texts that says nothing of the model."""
    return replace(
        record,
        sensor={"serial": text, "model": text, text: text},
        created=text,
        software=text,
        sources=(Source(text, "0" * 64),),
        warnings=(text,),
        options={"layout": text, text: text},
    )


def every_text(value, text):
    """The value with each text in it, one after another, as `text`."""
    if isinstance(value, str):
        yield text
    for key, item in value.items() if isinstance(value, dict) else ():
        for changed in every_text(item, text):
            yield {**value, key: changed}
    for index, item in enumerate(value) if isinstance(value, list | tuple) else ():
        for changed in every_text(item, text):
            yield [*value[:index], changed, *value[index + 1 :]]


def preprocessed(file, *options):
    """What is left of C without comments, and not a warning of the preprocessor."""
    done = subprocess.run(
        ["gcc", "-E", "-P", "-trigraphs", "-Wall", "-Wextra", "-Wcomment", "-Werror", *options, str(file)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def meaning(target, path, folder):
    """What a file says to its own compiler or parser, without its comments."""
    name, text = path.relative_to(folder).as_posix(), path.read_text(encoding="utf-8")
    if path.suffix in (".c", ".h"):
        code = preprocessed(path, "-std=c99", f"-I{folder}", f"-I{folder / 'src'}")
        return BLOB.sub("", code)  # which holds the texts as well
    if path.suffix == ".ino":
        return preprocessed(path, "-x", "c++", f"-I{folder / 'src'}", f"-I{STUB}")
    if path.suffix in (".yaml", ".yml"):
        return yaml.safe_load(text.removeprefix("%YAML:1.0\n"))
    if path.suffix == ".json":
        return {key: value for key, value in json.loads(text).items() if key != "description"}
    if path.suffix == ".properties":
        pairs = [line.split("=", 1) for line in text.splitlines()]
        return [pair for pair in pairs if pair[0] != "sentence"]
    if path.suffix == ".md":
        return document(text, folder)
    if target in ("px4", "ardupilot", "motioncal", "betaflight", "inav"):
        return [line for line in text.splitlines() if not line.startswith("#")]
    assert name in ("Makefile", "zephyr/Kconfig", "zephyr/CMakeLists.txt")
    return text


def document(text, folder):
    """The kinds of a Markdown page's parts, its code as the preprocessor leaves it, and all text but code spans."""
    parts, size = [], (folder / "unit.blob").stat().st_size
    for number in (size, size // 4):  # of a blob that holds the texts as well
        text = text.replace(str(number), "SIZE")
    for token in MarkdownIt("commonmark").enable("table").parse(text):
        if token.type == "fence":
            block = folder / "block.c"
            block.write_text('#include "unit.h"\n' * ("unit.h" not in token.content) + token.content, encoding="utf-8")
            parts.append(preprocessed(block, "-std=c99", f"-I{folder}"))
            block.unlink()
        parts.append(token.type)
        parts += [(child.type, child.content if child.type == "text" else "") for child in token.children or ()]
    return parts


def exported(target, record, folder):
    """The meanings of the files of a target."""
    files = il.export(target, record, folder, lossy=True)
    return {str(f.relative_to(folder)): meaning(target, f, folder) for f in files if f.suffix != ".blob"}


def records_of(target):
    if target == "motioncal":
        return [nine_axes()]
    if target in ("betaflight", "inav"):
        return [nine_axes(unit="count", quadratic=0.0)]
    if target == "c":
        return [madeup.tumble(2, gyro=True), madeup.centrifuge(), madeup.warmup()]
    return [nine_axes(unit="uT", gyro="rad/s" if target in ("px4", "ardupilot") else "deg/s", quadratic=0.0)]


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """What the files of a unit with a plain name say."""
    made = {}

    def of(target):
        if target not in made:
            records = [renamed(record, PLAIN) for record in records_of(target)]
            made[target] = exported(target, records, tmp_path_factory.mktemp(target))
        return made[target]

    return of


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc on this machine")
@pytest.mark.parametrize(
    ("target", "text"),
    [
        pytest.param(target, text, id=f"{target}, {name}", marks=[pytest.mark.slow] * (name not in QUICK))
        for target in INERTIAL
        for name, text in HOSTILE.items()
    ],
)
def test_a_hostile_text_says_nothing_in_any_file(target, text, plain, tmp_path):
    expected = dict(plain(target))
    found = exported(target, [renamed(record, text) for record in records_of(target)], tmp_path)
    if not text:  # "a unit without serial number", which is no code span
        expected.pop("README.md", None), found.pop("README.md", None)
    assert found == expected


def test_every_target_is_tried():
    assert {*INERTIAL, "blob"} == set(EXPORTERS)


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc on this machine")
@pytest.mark.parametrize("name", ["block comment", pytest.param("line ends", marks=pytest.mark.slow)])
@pytest.mark.parametrize("target", ["c", "fusion", "kalibr"])
def test_a_hostile_unit_or_name_of_a_model_is_refused_or_says_nothing(target, name, plain, tmp_path):
    tried = 0
    for record in records_of(target):
        for kind in ("model", "sections"):
            for changed in every_text(getattr(record, kind), HOSTILE[name]):
                tried += 1
                folder = tmp_path / str(tried)
                try:
                    found = exported(target, replace(record, **{kind: changed}), folder)
                except ImulabError:
                    assert not folder.exists()
                    continue
                assert "evil" not in str(found)
        parameter = next(iter(record.parameters), None)
        if parameter is not None:
            odd = replace(record.parameters[parameter], unit=HOSTILE[name])
            try:
                found = exported(target, replace(record, parameters={**record.parameters, parameter: odd}), tmp_path)
            except ImulabError:
                continue
            assert "evil" not in str(found)
    assert tried >= 3


@pytest.mark.parametrize("text", ["SN1", "`", "a``b", " x ", "``` x", "<b>", " "])
def test_a_code_span_shows_the_text(text):
    (inline,) = [token for token in MarkdownIt().parse(f"Unit {markdown_code(text)}.") if token.type == "inline"]
    before, span, after = inline.children
    assert (before.content, span.type, after.content) == ("Unit ", "code_inline", ".")
    assert span.content.strip() == text.strip()
