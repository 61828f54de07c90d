"""Options on the command line, made from the one definition that manifests and functions share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib import import_module
from inspect import Parameter, signature
from typing import Annotated, Any

import typer

from imulab.procedures.options import ELEMENT, FLAG, READING, Option, read_options

READ = (*READING, ELEMENT)
"""How a recording is read."""


def reading(texts: Mapping[str, str | None]) -> dict[str, Any]:
    """Return the options of `imulab.read`, from the texts of those that a command has."""
    return read_options([option for option in READ if option.name in texts], texts, FLAG)


def with_options(options: Sequence[Option]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return a decorator that puts the options in the place of a command's parameter `options`.

    The command gets the texts that were given by the names of the options, None where none was.
    """

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        def run(**given: Any) -> Any:
            texts = {option.name: _text(given.pop(option.keyword)) for option in options}
            return command(options=texts, **given)

        parameters: list[Parameter] = []
        for parameter in signature(command, eval_str=True).parameters.values():
            parameters += map(_parameter, options) if parameter.name == "options" else [parameter]
        parameters = [parameter.replace(kind=Parameter.KEYWORD_ONLY) for parameter in parameters]
        run.__name__, run.__doc__ = command.__name__, command.__doc__
        run.__signature__ = signature(command).replace(parameters=parameters)  # type: ignore[attr-defined]
        run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        return run

    return decorate


def _parameter(option: Option) -> Parameter:
    """An option as a parameter of a command, which typer reads."""
    if option.switch:
        kind: Any = Annotated[bool, typer.Option(option.flag, help=option.help)]
        return Parameter(option.keyword, Parameter.KEYWORD_ONLY, default=False, annotation=kind)
    offered = _beginning(option.choices) if option.choices else None
    info = typer.Option(option.flag, metavar=option.shows, help=option.help, autocompletion=offered)
    return Parameter(
        option.keyword, Parameter.KEYWORD_ONLY, default=option.default, annotation=Annotated[str | None, info]
    )


def one_of(choices: Iterable[str], help: str, *flags: str, metavar: str | None = None) -> Any:  # noqa: A002
    """Return an option of few words, which its help lists and a shell completes."""
    words = tuple(choices)
    return typer.Option(*flags, metavar=metavar or "|".join(words), help=help, autocompletion=_beginning(words))


def lists(where: str) -> Callable[[str], list[str]]:
    """Return what completes a word of a list that costs an import: ``imulab.exporters:EXPORTERS``."""
    module, _, name = where.partition(":")
    return lambda incomplete: _beginning(getattr(import_module(module), name))(incomplete)


def _beginning(choices: Iterable[str]) -> Callable[[str], list[str]]:
    def words(incomplete: str) -> list[str]:
        return [choice for choice in choices if choice.startswith(incomplete)]

    return words


def _text(value: Any) -> str | None:
    return {True: "yes", False: "no"}[value] if isinstance(value, bool) else value
