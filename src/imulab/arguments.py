"""Checks of a call's arguments against its annotations: a wrong type or an unknown keyword ends in one sentence."""

from __future__ import annotations

import builtins
import inspect
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, wraps
from numbers import Integral, Real
from os import PathLike
from types import UnionType
from typing import Annotated, Any, ForwardRef, ParamSpec, TypeAlias, TypeVar, Union, Unpack, get_args, get_origin

from imulab.errors import OptionError, listed, quoted

P = ParamSpec("P")
R = TypeVar("R")

_WORDS = {float: "a number", int: "a whole number", bool: "True or False", str: "a text", Callable: "a function"}
_NAMES = {"Calibration": "a record", "Result": "a record", "Loaded": "a record", "ndarray": "numbers"}
Folder: TypeAlias = Annotated[str | PathLike[str], "the name of a folder"]


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """Return a function that first refuses arguments of other types than its annotations state.

    What may be a number or a text is left to the function, which knows its unit, and so is what is annotated with a
    type that stands for anything. ``Annotated[TYPE, "a list of ..."]`` says what a message calls a type.

    Raises
    ------
    OptionError
        An argument has another type or is NaN, is missing, or is none of the function's.
    """

    @wraps(function)
    def called(*args: P.args, **kwargs: P.kwargs) -> R:
        _check_call(function, args, kwargs)
        return function(*args, **kwargs)

    return called


def check(value: object, hint: Any, called: str) -> None:
    """Refuse a value of another type; `called` is its name in messages; errors as for `checked`."""
    kinds = set(members(hint))
    if (str in kinds and kinds & {float, int}) or _fits(value, hint):
        return
    for each in kinds:
        if get_origin(each) is Mapping and isinstance(value, Mapping):
            for key, item in value.items():
                check(item, get_args(each)[1], f"{called}[{key!r}]")
    raise OptionError(f"{called}: expected {_expected(hint)}, found {described(value)}")


def check_fields(instance: Any) -> None:
    """Refuse fields of a dataclass with other types than its annotations state; errors as for `checked`."""
    kind: Any = type(instance)
    for name, hint in hints(kind).items():
        check(getattr(instance, name), hint, name)


class Unknown:
    """Stands for a name in an annotation that is imported for type checkers only."""

    def __class_getitem__(cls, _: Any) -> type[Unknown]:
        return cls


@cache
def types_of(owner: Any) -> dict[str, Any]:
    """Return the types of a function's parameters or a class's fields; `Unknown` for names that do not exist."""
    owner = inspect.unwrap(owner)
    names, types = _Names(vars(sys.modules[owner.__module__])), {}
    for name, text in inspect.get_annotations(owner).items():
        text = text.__forward_arg__ if isinstance(text, ForwardRef) else text
        try:
            types[name] = eval(text, {}, names) if isinstance(text, str) else text
        except AttributeError:  # of a module that is imported for type checkers alone
            types[name] = Unknown
    return types


class _Names(dict[str, Any]):
    """The names of a module; those of Python itself, and `Unknown`, for all others."""

    def __missing__(self, name: str) -> Any:
        return getattr(builtins, name, Unknown)


@cache
def hints(owner: Any) -> dict[str, Any]:
    """Return the types in the annotations of a function or class, as far as known at run time."""
    return {name: hint for name, hint in types_of(owner).items() if not _is_unknown(hint)}


def _is_unknown(hint: Any) -> bool:
    return hint is Unknown or any(map(_is_unknown, hint if isinstance(hint, list) else get_args(hint)))


def metadata(hint: Any) -> tuple[Any, ...]:
    """Return the arguments of ``Annotated``, the outermost first, or those of the members of a union."""
    if get_origin(hint) is Annotated:
        inner, *more = get_args(hint)
        return (*reversed(more), *metadata(inner))
    return tuple(each for member in _union(hint) for each in metadata(member))


def members(hint: Any) -> tuple[Any, ...]:
    """Return the types of a union, without None and without arguments of ``Annotated``."""
    if get_origin(hint) is Annotated:
        return members(get_args(hint)[0])
    parts = _union(hint)
    return tuple(each for part in parts for each in members(part)) if parts else (hint,) * (hint is not type(None))


def _union(hint: Any) -> tuple[Any, ...]:
    return get_args(hint) if get_origin(hint) in (Union, UnionType) else ()


def described(value: object) -> str:
    """Return a value in the words of a message."""
    kind = type(value)
    if kind.__name__ == "Calibration":
        return f"a {getattr(value, 'procedure', '')} record (arguments in the wrong order?)"
    if hasattr(value, "calibration"):
        return f"a {type(value).__name__} (arguments in the wrong order?)"
    if kind.__name__ == "Recording":
        return f"the recording {getattr(value, 'name', '')} (arguments in the wrong order?)"
    if kind.__module__.partition(".")[0] == "imulab":
        return kind.__name__
    if kind.__name__ == "LazyFrame":
        return "a LazyFrame, which collect() makes a data frame"
    shape = getattr(value, "shape", None)
    return f"{kind.__name__} of shape {shape}" if isinstance(shape, tuple) and shape else quoted(value)


@cache
def _expected_by(
    function: Callable[..., Any],
) -> tuple[inspect.Signature, dict[str, inspect.Parameter], dict[str, Any]]:
    """Return a function's signature, its parameters that have names, and the types of those that are checked."""
    signature = inspect.signature(function)
    parameters = {key: p for key, p in signature.parameters.items() if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)}
    return signature, parameters, {key: hint for key, hint in hints(function).items() if key in parameters}


def _check_call(function: Callable[..., Any], args: tuple[Any, ...], kwargs: Mapping[str, Any]) -> None:
    name, (signature, parameters, types) = function.__qualname__, _expected_by(function)
    try:
        bound = signature.bind(*args, **kwargs).arguments
    except TypeError as error:
        unknown = [key for key in kwargs if key not in parameters]
        if unknown and not any(p.kind is p.VAR_KEYWORD for p in signature.parameters.values()):
            raise OptionError(unknown_options(name, unknown, parameters)) from None
        taken = {*list(parameters)[: len(args)], *kwargs}
        required = [key for key, p in parameters.items() if p.default is p.empty]
        missing = [key for key in required if key not in taken] if str(error).startswith("missing") else []
        problem = f"missing required arguments: {', '.join(map(repr, missing))}" if len(missing) > 1 else str(error)
        shown = [f"{key}=" if p.kind is p.KEYWORD_ONLY else key for key, p in parameters.items()]
        shown = [key for key in shown if key not in ("self", "cls")] + [f"{key}=" for key in _further(function)]
        raise OptionError(f"{name}: {problem}; expected {name}({', '.join(shown)})") from None
    for key, value in bound.items():
        if key in types and not _fits(value, types[key]):
            check(value, types[key], f"{name}: {key}")


def unknown_options(name: str, unknown: Sequence[str], known: Iterable[str]) -> str:
    """Return a refusal of all keywords that a function does not have, with the nearest to the first."""
    names = list(known)
    options = "options" if len(unknown) > 1 else "option"
    return f"{name}: unknown {options} {', '.join(map(repr, unknown))}; known: {listed(names, unknown[0])}"


def _further(function: Callable[..., Any]) -> list[str]:
    """Return the keywords that a function takes by ``**options: Unpack[...]``."""
    for key, parameter in inspect.signature(function).parameters.items():
        hint = types_of(function).get(key) if parameter.kind is parameter.VAR_KEYWORD else None
        if get_origin(hint) is Unpack:
            return [*get_args(hint)[0].__annotations__]
    return []


def _fits(value: object, hint: Any) -> bool:
    """Return whether a value has a type, as far as the value shows it."""
    kind, inner = get_origin(hint) or hint, get_args(hint)
    if kind is Annotated:
        return _fits(value, inner[0])
    if kind in (Union, UnionType):
        return any(_fits(value, each) for each in inner)
    if kind in (None, Any):
        return kind is Any or value is None
    if kind in (float, int):
        number = isinstance(value, Real if kind is float else Integral) and not isinstance(value, bool)
        return number and value == value  # not NaN
    if kind is bool:
        return isinstance(value, bool) or type(value).__name__ in ("bool", "bool_")
    if not isinstance(kind, type) or getattr(kind, "_is_protocol", False):
        return True
    if issubclass(kind, Mapping):
        return isinstance(value, Mapping) and all(_fits(each, inner[1]) for each in value.values())
    if issubclass(kind, PathLike):
        return isinstance(value, PathLike)
    if kind.__name__ == "ndarray":
        return _is_numeric(value)
    if issubclass(kind, Iterable) and inner:
        return isinstance(value, Iterable) and _fits_list(value, inner)
    return isinstance(value, kind)


def _fits_list(value: Iterable[object], inner: tuple[Any, ...]) -> bool:
    """Return whether an iterable is a list whose items have a type, or these types one after the other."""
    if isinstance(value, str | bytes | Mapping):
        return False
    if hasattr(value, "__array__") and not {*members(inner[0])} <= {float, int, str}:  # samples or a data frame
        return False
    if not hasattr(value, "__len__"):  # read as it is used
        return True
    items = list(value)
    types = inner if len(inner) > 1 and inner[1] is not Ellipsis else inner[:1] * len(items)
    return len(items) == len(types) and all(map(_fits, items, types))


def _is_numeric(value: object) -> bool:
    import numpy as np

    try:
        return np.asarray(value).dtype.kind in "iuf"
    except ValueError:  # rows of different length
        return False


def _expected(hint: Any) -> str:
    """Return a type in words."""
    for each in metadata(hint):
        if isinstance(each, str):
            return each
    kinds = members(hint)
    words = [_word(each) for each in kinds]
    if "" in words:  # a path
        others = [word for word, each in zip(words, kinds, strict=True) if word and each is not str]
        words = [*others, f"the name of {'its' if others else 'a'} file"]
    return " or ".join(dict.fromkeys(words))


def _word(hint: Any) -> str:
    """Return one type in words, an empty text for a path."""
    kind, inner = get_origin(hint) or hint, get_args(hint)
    if isinstance(kind, type) and issubclass(kind, PathLike):
        return ""
    if kind is tuple and inner[-1] is not Ellipsis:
        return f"{len(inner)} {'numbers' if {float, int} & set(members(inner[0])) else 'items'}"
    if isinstance(kind, type) and issubclass(kind, Mapping):
        return "a mapping from names"
    if inner and kind is not Callable:
        words = {float: "numbers", int: "whole numbers", str: "a list of texts"}
        return words.get(inner[0]) or (f"a list of {_named(inner[0])[2:]}s" if isinstance(inner[0], type) else "a list")
    return _WORDS.get(kind) or _named(kind)


def _named(kind: Any) -> str:
    """Return the name of a class in messages: ``a fused`` for Fused, ``a record`` for Calibration."""
    name = getattr(kind, "__name__", str(kind))
    return _NAMES.get(name) or "a " + re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower()
