"""What docstrings in numpy's style say, also where Python threw them away (``python -OO``)."""

from __future__ import annotations

import inspect
import re
import sys
from functools import cache
from pathlib import Path
from typing import Any, is_typeddict

_ENTRY = re.compile(r"^(\S[^\n]*)\n((?:[ ]+\S[^\n]*\n|\n(?=[ ]))+)", re.M)
_SENTENCE = re.compile(r".*?\.(?=\s+[A-Z\"`*]|$)", re.S)
_MARKS = re.compile(r"``\"?(.*?)\"?``|`([^`]*)`")


@cache
def docstring(owner: Any) -> str:
    """Return the docstring of a function, class or module, from its source where it has none at run time."""
    owner = inspect.unwrap(owner)
    return inspect.cleandoc(owner.__doc__) if owner.__doc__ else _from_source(owner)


def summary(owner: Any) -> str:
    """Return the first paragraph of a docstring, in one line."""
    return " ".join(docstring(owner).partition("\n\n")[0].split())


def description(owner: Any) -> str:
    """Return what a docstring says before its sections."""
    return re.split(r"\n\n\w+\n-+\n", docstring(owner))[0]


@cache
def parameters(owner: Any) -> dict[str, str]:
    """Return the first sentence that the docstring of a function says of each parameter, or of a class of each field.

    A ``TypedDict`` says of its further fields alone; those of the ones that it extends are theirs.
    """
    said: dict[str, str] = {}
    for each in _extended(owner):
        section = re.search(r"^(?:Parameters|Attributes)\n-+\n(.*?)(?:\n\n\S|\Z)", docstring(each), re.M | re.S)
        for names, text in _ENTRY.findall(f"{section[1]}\n" if section else ""):
            text = " ".join(text.split())
            first = _SENTENCE.match(text)
            plain = _MARKS.sub(r"\1\2", first[0] if first else text)
            said |= dict.fromkeys((name.strip() for name in names.split(",")), plain)
    return said


def _extended(owner: Any) -> list[Any]:
    """Return a function or class, after the typed dictionaries that it extends, which Python forgets."""
    if not is_typeddict(owner):
        return [owner]
    others = vars(sys.modules[owner.__module__]).values()
    return [x for x in others if is_typeddict(x) and x.__annotations__.keys() <= owner.__annotations__.keys()]


def _from_source(owner: Any) -> str:
    import ast  # 2 ms that no command needs

    name = owner.__name__ if inspect.ismodule(owner) else owner.__module__
    path = getattr(sys.modules.get(name), "__file__", None)
    try:
        place: Any = ast.parse(Path(path or "").read_bytes())
    except OSError:  # a module that was not read from a file
        return ""
    for name in () if inspect.ismodule(owner) else owner.__qualname__.split("."):
        kinds = (ast.FunctionDef, ast.ClassDef)
        place = next((each for each in place.body if isinstance(each, kinds) and each.name == name), None)
        if place is None:
            return ""
    return ast.get_docstring(place) or ""
