"""Records to firmware: the C core with the unit's numbers and a self-test as a library, or one blob loaded at run time.

The C core in one file with the unit's numbers and a self-test, as a library of Arduino, PlatformIO and Zephyr, or
as one blob that is loaded at run time.

Sources: Arduino library specification (library.properties, src, examples); PlatformIO library.json; Zephyr modules
(zephyr/module.yml, build.cmake and build.kconfig).
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imulab._version import VERSION
from imulab.device.tables import KINDS, DeviceTable, Field
from imulab.device.unit import make_blob
from imulab.errors import OptionError
from imulab.exporters import ExportOptions
from imulab.exporters.texts import c_comment, in_c_comment, markdown_code, property_value
from imulab.files import replacing
from imulab.procedures.apply import tables_of_all
from imulab.procedures.registry import section
from imulab.records.calibration import Calibration

# The exported folder as a library of Arduino, PlatformIO and Zephyr: manifests, and sources that include the core.


NAME = "imulab_unit"


def firmware_file(name: str) -> str:
    """Return a template file of exported folders."""
    return (files("imulab.exporters") / "firmware" / name).read_text(encoding="utf-8")


def libraries(unit: str) -> dict[str, str]:
    """Return names and contents of the files that make a unit's folder a library; they differ only in its name."""
    sentence = f"Compensation of {unit}."
    properties = {
        "name": NAME,
        "version": VERSION,
        "author": "imulab",
        "maintainer": "imulab",
        "sentence": sentence,
        "paragraph": "Turns raw outputs of inertial sensors into corrected ones.",
        "category": "Sensors",
        "architectures": "*",
        "includes": f"{NAME}.h",
    }
    manifest = {
        "name": NAME,
        "version": VERSION,
        "description": sentence,
        "frameworks": "*",
        "platforms": "*",
        "headers": f"{NAME}.h",
        "build": {"srcDir": "src", "includeDir": "src", "flags": ["-DIMULAB_UNIT_LIBRARY"]},
    }
    sources = (f"{NAME}.h", "imulab_core.c", "imulab_numbers.c")
    return {
        "library.properties": "".join(f"{key}={property_value(value)}\n" for key, value in properties.items()),
        "library.json": json.dumps(manifest, indent=2) + "\n",
        **{f"src/{name}": firmware_file(name) for name in sources},
        **{f"zephyr/{name}": firmware_file(name) for name in ("module.yml", "Kconfig", "CMakeLists.txt")},
    }


# Records to one blob: the tables that the C core loads at run time.


def export_blob(records: Sequence[Calibration], folder: Path, options: ExportOptions) -> list[Path]:
    """Write ``unit.blob``.

    Raises
    ------
    RecordError
        A record lacks something, two give the same table, or a number is beyond the range of a float.
    OptionError
        The file cannot be written.
    """
    data = make_blob(records, tables_of_all(records, options.fusions, options.files))
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OptionError(f"{folder}: the folder cannot be made: {error.strerror}") from None
    target = folder / "unit.blob"
    with replacing(target) as stream:
        stream.write(data)
    return [target]


# Records to C: the core in one file, the unit's numbers, and a self-test against this computer's results.


_HEADERS = ("real.h", "array.h", "robust.h", "imus.h")
_CHECKOUT = Path(__file__).resolve().parents[3] / "runtime"
_ELEMENTS = 32  # IL_ARRAY_ELEMENTS of imulab.h
_OWN_INCLUDE = re.compile(r'^#include "(?:imulab|real|array|robust|imus)\.h"\n', re.MULTILINE)


def export_c(records: Sequence[Calibration], folder: Path, options: ExportOptions) -> list[Path]:
    """Write the core, the unit's numbers, a self-test with its golden vectors, a Makefile and a README.

    Raises
    ------
    RecordError
        A record lacks something, or two give the same table.
    OptionError
        The folder cannot be written to.
    """
    tables = tables_of_all(records, options.fusions, options.files)
    blob = make_blob(records, tables)
    words = _words(records, tables, len(blob))
    contents = {
        "imulab.h": _header(tables),
        "imulab.c": _amalgamation(),
        "unit.h": _unit_h(records, tables),
        "unit.c": _unit_c(records, tables),
        "golden.h": _golden_h(tables, blob),
        "selftest.c": firmware_file("selftest.c"),
        "Makefile": firmware_file("Makefile"),
        "README.md": _rendered("README.md.j2", words),
        **libraries(_unit_name(records)),
        "examples/Corrected/Corrected.ino": _rendered("Corrected.ino.j2", words),
    }
    try:
        for name in contents:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OptionError(f"{folder}: the folder cannot be made: {error.strerror}") from None
    for name, text in contents.items():
        with replacing(folder / name) as stream:
            stream.write(text.encode("utf-8"))
    with replacing(folder / "unit.blob") as stream:
        stream.write(blob)
    return [folder / name for name in (*contents, "unit.blob")]


def _core() -> list[str]:
    """Return the names of the core's sources, as compiled and, in a checkout, as they are there."""
    folders = (files("imulab") / "core", _CHECKOUT)
    return sorted({f.name for folder in folders if folder.is_dir() for f in folder.iterdir() if f.name.endswith(".c")})


def _source(name: str) -> str:
    """Return a file of the core, as it was compiled; in a checkout it must be what the checkout has.

    Raises
    ------
    OptionError
        The checkout was changed after it was built: what is exported would not compute what the desk does.
    """
    installed = files("imulab") / "core" / name
    compiled = installed.read_text(encoding="utf-8") if installed.is_file() else None
    checkout = _CHECKOUT / name
    source = checkout.read_text(encoding="utf-8") if checkout.is_file() else None
    if compiled is None or (_CHECKOUT.is_dir() and source != compiled):
        raise OptionError(f"{name}: the compiled part is older than the source: build again (pip install -e .)")
    return compiled


def _most_elements(tables: Sequence[DeviceTable]) -> int:
    """Return the gyros per axis that the exported header allows: its default, or the number in the unit."""
    return max([_ELEMENTS, *(int(table.columns["elements"]) for table in tables if table.kind == "array")])


def _header(tables: Sequence[DeviceTable]) -> str:
    """Return imulab.h with room for the unit's array, so that no -D is needed."""
    text, default = _source("imulab.h"), f"#define IL_ARRAY_ELEMENTS {_ELEMENTS}\n"
    assert default in text
    return text.replace(default, f"#define IL_ARRAY_ELEMENTS {_most_elements(tables)}\n")


def _amalgamation() -> str:
    """Return the core's sources as one file, so that a project has one to add."""
    parts = ["/* The core of imulab in one file; the same for every unit. */\n", '#include "imulab.h"\n']
    for name in (*_HEADERS, *_core()):
        parts += [f"\n/* ==== {name} ==== */\n", _OWN_INCLUDE.sub("", _source(name))]
    return "".join(parts)


def _unit_name(records: Sequence[Calibration]) -> str:
    """Return the serial number as the records have it, or words for a unit without one."""
    return _serial(records) or "a unit without serial number"


def _serial(records: Sequence[Calibration]) -> str:
    return next((record.sensor["serial"] for record in records if record.sensor.get("serial")), "")


def _unit_h(records: Sequence[Calibration], tables: Sequence[DeviceTable]) -> str:
    kinds = {table.kind: table for table in tables}
    lines = [
        *c_comment(f"The numbers of {_unit_name(records)}."),
        "#ifndef UNIT_H",
        "#define UNIT_H",
        "",
        '#include "imulab.h"',
        "",
    ]
    lines += [f"#define UNIT_HAS_{kind.upper()} {int(kind in kinds)}" for kind in KINDS]
    lines.append(f"#define UNIT_HAS {sum(1 << (KINDS[kind] - 1) for kind in kinds)}u /* as in il_unit.has */")
    if "warmup" in kinds:
        lines.append(f"#define UNIT_WARMUP_AXES {len(kinds['warmup'].columns['axes'])}")
    if "array" in kinds:
        lines.append(f"#define UNIT_ARRAY_AXES {kinds['array'].columns['axes']}")
        lines.append(f"#define UNIT_ARRAY_ELEMENTS {kinds['array'].columns['elements']}")
    if "imus" in kinds:
        lines.append(f"#define UNIT_IMUS {kinds['imus'].columns['imus']}")
    lines += ["", "#ifdef __cplusplus", 'extern "C" {', "#endif"]
    lines += ["", *(f"extern const il_{kind} unit_{kind};" for kind in kinds), ""]
    lines += ["#ifdef __cplusplus", "}", "#endif", "#endif", ""]
    return "\n".join(lines)


def _unit_c(records: Sequence[Calibration], tables: Sequence[DeviceTable]) -> str:
    lines = [
        *c_comment(
            f"The numbers of {_unit_name(records)}; made from the records",
            *(f"  {record.procedure} {record.created} SHA-256 {_digest(record)}" for record in records),
            f"by {records[0].software}.",
        ),
        '#include "unit.h"',
        "",
        "#define R(x) ((il_real)(x))",
    ]
    for table in tables:
        lines += ["", *_definition(table)]
    return "\n".join(lines) + "\n"


def _digest(record: Calibration) -> str:
    return str(record.to_dict()["content_sha256"])


def _definition(table: DeviceTable) -> list[str]:
    """Return the struct of one table, after the arrays that it points to."""
    pointed = [field for field in table.fields if field.pointed and field.values is not None]
    lines = [f"static const il_real {table.kind}_{field.name}[] = {{{_numbers(field.values)}}};" for field in pointed]
    lines.append(f"const il_{table.kind} unit_{table.kind} = {{")
    names = {field.name for field in pointed}
    lines += [
        f"    .{field.name} = {f'{table.kind}_{field.name}' if field.name in names else _member(field)},"
        for field in table.fields
        if field.values is not None and field.values.size
    ]
    return [*lines, "};"]


def _member(field: Field) -> str:
    values = field.values
    assert values is not None
    if values.ndim == 0:
        return str(int(values)) if field.whole else _number(float(values))
    if values.ndim == 2:
        return "{" + ", ".join("{" + _numbers(row) + "}" for row in values) + "}"
    return "{" + (", ".join(str(int(v)) for v in values) if field.whole else _numbers(values)) + "}"


def _number(value: float) -> str:
    return "IL_NAN" if np.isnan(value) else f"R({value!r})"


def _numbers(values: NDArray[Any] | None) -> str:
    return ", ".join(_number(float(value)) for value in np.asarray(values).reshape(-1))


def _golden_h(tables: Sequence[DeviceTable], blob: bytes) -> str:
    lines = [
        "/* Inputs, and what the desk made of them; for selftest.c only. */",
        "#ifndef GOLDEN_H",
        "#define GOLDEN_H",
    ]
    lines += ["", "#include <math.h>", "", '#include "imulab.h"', "", "#define IL_NAN ((il_real)NAN)"]
    lines += ["#define R(x) ((il_real)(x))"]
    for table in tables:
        lines.append("")
        for name, value in _golden_vectors(table).items():
            lines.append(_golden(f"golden_{table.kind}" + (f"_{name}" if name else ""), value))
    rows = [", ".join(map(str, blob[i : i + 24])) for i in range(0, len(blob), 24)]
    lines += ["", "static const uint8_t golden_blob[] = {", *(f"    {row}," for row in rows), "};", "", "#endif", ""]
    return "\n".join(lines)


def _golden_vectors(table: DeviceTable) -> dict[str, Any]:
    """Return names, after ``golden_<kind>_``, and values of inputs and expected outputs; an empty name is a count."""
    known = section(table.kind)
    assert known is not None
    return known.golden(table, np.random.default_rng(20250101))


def _golden(name: str, value: int | float | NDArray[Any]) -> str:
    if isinstance(value, int):
        return f"#define {name.upper()} {value}"
    if isinstance(value, float):
        return f"static const il_real {name} = {_number(value)};"
    kind = "uint32_t" if value.dtype.kind == "u" else "il_real"
    sizes = "".join(f"[{size}]" for size in value.shape)
    return f"static const {kind} {name}{sizes} = {_nested(value)};"


def _nested(value: NDArray[Any]) -> str:
    if value.ndim == 1:
        return "{" + (", ".join(f"{v}u" for v in value) if value.dtype.kind == "u" else _numbers(value)) + "}"
    return "{\n" + ",\n".join("    " + _nested(row) for row in value) + "}"


def _words(records: Sequence[Calibration], tables: Sequence[DeviceTable], blob_size: int) -> dict[str, Any]:
    """Return the words for the README and the sketch; `use` is the code that calls the core for this unit."""
    serial = _serial(records)
    words = {
        "unit": _unit_name(records),
        "unit_in_markdown": _Safe(markdown_code(serial) if serial else _unit_name(records)),
        "software_in_markdown": _Safe(markdown_code(records[0].software)),
        "blob_size": blob_size,
        "kinds": {table.kind: table.columns for table in tables},
        "first": tables[0].kind,
        "most_elements": _most_elements(tables),
    }
    return {**words, "use": _Safe(_rendered("use.c.j2", words))}


class _Safe(str):
    """A text that is in its form already."""


def _word(value: Any) -> Any:
    """Return a word of a template as it may stand in a C comment, where all texts of records stand."""
    return in_c_comment(value) if isinstance(value, str) and not isinstance(value, _Safe) else value


def _rendered(name: str, words: Mapping[str, Any]) -> str:
    """Return a template with its words in their places."""
    from jinja2 import Environment, StrictUndefined

    environment = Environment(
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, autoescape=False, finalize=_word
    )  # Markdown and C, not HTML
    return environment.from_string(firmware_file(name)).render(words).rstrip("\n") + "\n"
