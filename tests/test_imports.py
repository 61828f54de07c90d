"""The rooms of the package: which module imports which, read from the source without importing any."""

import ast
import gc
import graphlib
from functools import cache
from pathlib import Path

import pytest

SOURCE = Path(__file__).resolve().parents[1] / "src"
ROOMS = [
    {"cli", "__main__"},
    {"certificate"},
    {"fleet", "live"},
    {"procedures", "readers", "exporters", "report", "writers"},
    {"estimation", "device", "records"},
]
"""From above (design.md); everything else lies in the root, below them all."""
PROCEDURES = {path.parent.name for path in (SOURCE / "imulab" / "procedures").glob("*/procedure.py")}
KNOWN_NAMES = {
    "imulab.device.unit",
    "imulab.device.tables",
    "imulab.exporters.firmware_c",
    "imulab.columns",
    "imulab.live.sources",
}
"""Modules that name the structs of the C core, quantities or options, some of which are called as procedures are."""


@cache
def source_modules() -> dict[str, ast.Module]:
    found = {}
    gc.disable()  # it would go through millions of nodes again and again, which holds up parsing more than twice
    for path in sorted((SOURCE / "imulab").rglob("*.py")):
        name = ".".join(path.relative_to(SOURCE).with_suffix("").parts).removesuffix(".__init__")
        found[name] = ast.parse(path.read_text(encoding="utf-8"))
    gc.enable()
    return found


NAMING = (ast.Constant, ast.Import, ast.ImportFrom)


def _imported(node: ast.AST) -> set[str]:
    """What one node imports, a name in a string too; C modules left out."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.startswith("imulab."):
        return {node.value.partition(":")[0]} & source_modules().keys()
    if isinstance(node, ast.Import):
        return {each.name for each in node.names if each.name in source_modules()}
    if isinstance(node, ast.ImportFrom):
        assert not node.level, "relative imports hide from where a name comes"
        paths = {f"{node.module}.{each.name}" for each in node.names}
        modules = paths & source_modules().keys()
        return modules | ({node.module or ""} & source_modules().keys() if len(modules) < len(paths) else set())
    return set()


@cache
def arrows() -> dict[str, set[str]]:
    """What each module imports anywhere, in functions and for type checkers too.

    The face of the package hands names on, and is in nobody's way.
    """
    return {
        name: set().union(*(_imported(node) for node in ast.walk(tree) if isinstance(node, NAMING))) - {name}
        for name, tree in source_modules().items()
        if name != "imulab"
    }


def _room(name: str) -> str:
    return [*name.split("."), ""][1]


def _height(name: str) -> int:
    return next((len(ROOMS) - k for k, rooms in enumerate(ROOMS) if _room(name) in rooms), 0)


def _procedure(name: str) -> str | None:
    parts = name.split(".")
    return parts[2] if len(parts) > 2 and parts[1] == "procedures" and parts[2] in PROCEDURES else None


def test_the_graph_is_that_of_the_package():
    assert {"tumble", "gyro_array", "warmup", "centrifuge"} <= PROCEDURES
    assert "imulab.procedures.rate.procedure" in arrows()["imulab.procedures.registry"]
    assert "imulab.procedures.tumble.fit" in arrows()["imulab.procedures.tumble.procedure"]  # within a function


def test_arrows_go_down_only():
    above = {(a, b) for a in arrows() for b in arrows()[a] if _height(a) < _height(b)}
    assert not above


def test_no_circles():
    try:
        graphlib.TopologicalSorter(arrows()).prepare()
    except graphlib.CycleError as error:
        pytest.fail(f"modules import each other in a circle: {' <- '.join(error.args[1])}")


SHARED = {
    f"imulab.procedures.tumble.{name}"
    for name in ("attitudes", "plan", *(f"gyro.{part}" for part in ("rest", "solve", "turns", "estimate")))
} | {"imulab.procedures.thermal.device", "imulab.procedures.magnetometer.fit"}
"""Attitudes at rest, plans of them and the turns between them: over temperature they are those of the tumble test; and
what laws over temperature know of such a test; and magnetometers without accelerometers."""


def test_procedures_do_not_import_each_other():
    across = {(a, b) for a in arrows() for b in arrows()[a] if _procedure(a) and _procedure(b) and b not in SHARED}
    assert not {(a, b) for a, b in across if _procedure(a) != _procedure(b)}


def test_only_the_registry_reaches_into_procedures():
    free = {
        "cli",
        "live",
        "",
    }  # commands, simulated instruments, tumble with a person in the loop, public names
    inside = {a for a in arrows() for b in arrows()[a] if _procedure(b) and not _procedure(a) and _room(a) not in free}
    assert inside == {"imulab.procedures.registry"}


def _names_procedures(tree: ast.Module) -> bool:
    """Whether a module compares something with a procedure's name, or lists several."""
    names = PROCEDURES | {"array"}
    for node in ast.walk(tree):
        if isinstance(node, ast.Compare | ast.MatchValue):
            if any(isinstance(part, ast.Constant) and part.value in names for part in ast.walk(node)):
                return True
        elif isinstance(node, ast.Dict | ast.List | ast.Tuple | ast.Set):
            parts = node.keys if isinstance(node, ast.Dict) else node.elts
            if sum(isinstance(part, ast.Constant) and part.value in names for part in parts) > 1:
                return True
    return False


def test_nobody_outside_tells_procedures_apart_by_name():
    outside = {name for name, tree in source_modules().items() if _room(name) not in {"cli", "procedures"}}
    assert {name for name in outside if _names_procedures(source_modules()[name])} == KNOWN_NAMES


def _lines_of(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """How many lines a function has, its docstring apart."""
    end, first = function.end_lineno, function.body[0]
    assert end is not None
    assert first.end_lineno is not None
    documented = ast.get_docstring(function) is not None
    return end - function.lineno + 1 - (first.end_lineno - first.lineno + 1 if documented else 0)


def test_no_function_is_longer_than_a_screen():
    found = {
        f"{name}.{node.name}": _lines_of(node)
        for name, tree in source_modules().items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    }
    assert len(found) > 1000
    assert {name: lines for name, lines in found.items() if lines > 60} == {}


def test_no_file_is_two_rooms():
    lines = {
        path.relative_to(SOURCE).as_posix(): len(path.read_text(encoding="utf-8").splitlines())
        for path in [*(SOURCE / "imulab").rglob("*.[ch]"), *(SOURCE / "imulab").rglob("*.py")]
    }
    assert {name: count for name, count in lines.items() if count > 1000} == {}


def test_public_names_are_those_that_type_checkers_see():
    import imulab

    tree = ast.parse(Path(imulab.__file__).read_text(encoding="utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    assert ast.unparse(block.test) == "TYPE_CHECKING"
    seen = {name.asname: node.module for node in block.body for name in node.names}
    assert seen == {name: f"imulab.{home}" for name, home in imulab._HOME.items()}


def test_a_misspelt_name_is_answered_with_the_one_that_was_meant():
    import imulab

    with pytest.raises(AttributeError, match=r"no attribute 'fit_tumbel'; did you mean 'fit_tumble'\?"):
        imulab.fit_tumbel  # noqa: B018
    with pytest.raises(AttributeError, match=r"no attribute '__spc__'$"):
        imulab.__spc__  # noqa: B018
