"""The files of the C core: none depends on itself, and every name that firmware sees has the core's prefix."""

import graphlib
import re
import shutil
import subprocess

import pytest

from conftest import REPOSITORY

RUNTIME = REPOSITORY / "runtime"
HEADERS = sorted(RUNTIME.glob("*.h"))
SOURCES = sorted(RUNTIME.glob("*.c"))
OURS = re.compile(r"(il_|IL_|IMULAB_)\w+")


def plain(path):
    """The code of a file, without comments."""
    return re.sub(r"/\*.*?\*/", " ", path.read_text(encoding="utf-8"), flags=re.DOTALL)


def no_circle(arrows):
    try:
        graphlib.TopologicalSorter(arrows).prepare()
    except graphlib.CycleError as error:
        pytest.fail(f"in a circle: {' <- '.join(map(str, error.args[1]))}")


def test_no_file_includes_itself_by_way_of_others():
    folders = [RUNTIME, *{path.parent for path in (REPOSITORY / "src").rglob("*.c")}]
    files = [path for folder in folders for path in folder.glob("*.[ch]")]
    arrows = {path.name: set(re.findall(r'#include "(.+?)"', plain(path))) for path in files}
    assert arrows["robust.h"] == {"array.h"}
    no_circle(arrows)


@pytest.fixture(scope="module")
def symbols(tmp_path_factory):
    """Of each source, the names that it defines for others, and those that it takes from elsewhere."""
    tools = [shutil.which(name) for name in ("cc", "nm")]
    if None in tools:
        pytest.skip("no C compiler (cc) with nm on this machine")
    compiler, nm = tools
    folder, found = tmp_path_factory.mktemp("core"), {}
    for source in SOURCES:
        binary = folder / f"{source.stem}.o"
        subprocess.run([compiler, "-std=c99", "-c", source, "-o", binary], check=True)
        lines = subprocess.run([nm, "-g", binary], check=True, capture_output=True, text=True).stdout.splitlines()
        kinds = [line.split()[-2:] for line in lines]
        found[source.name] = (
            {name.lstrip("_") for kind, name in kinds if kind != "U"},
            {name.lstrip("_") for kind, name in kinds if kind == "U"},
        )
    return found


def test_no_files_call_each_other_in_a_circle(symbols):
    home = {name: source for source, (defined, _) in symbols.items() for name in defined}
    arrows = {source: {home[name] for name in taken if name in home} for source, (_, taken) in symbols.items()}
    assert arrows["robust.c"] == {"robust_motion.c", "robust_standing.c", "robust_well.c"}
    no_circle(arrows)


def test_every_name_that_the_linker_sees_has_the_prefix(symbols):
    defined = {name for names, _ in symbols.values() for name in names}
    assert len(defined) > 25
    assert {name for name in defined if not name.startswith("il_")} == set()


@pytest.mark.parametrize("header", HEADERS, ids=[path.name for path in HEADERS])
def test_every_name_of_a_header_has_the_prefix(header):
    text = plain(header)
    names = re.findall(r"^\s*#\s*define\s+(\w+)", text, re.MULTILINE)
    code = re.sub(r"^\s*#.*?(?<!\\)$", "", text, flags=re.MULTILINE)
    names += re.findall(r"\}\s*(\w+)\s*;", code)  # of structs and enumerations
    names += re.findall(r"^(?:static inline\s+|extern\s+)?\w[\w *]*?[ *](\w+)\(", code, re.MULTILINE)
    for body in re.findall(r"\benum\s*\{(.*?)\}", code, re.DOTALL):
        names += [each.partition("=")[0].strip() for each in body.split(",") if each.strip()]
    assert len(names) > 5
    assert [name for name in names if not OURS.fullmatch(name)] == []
