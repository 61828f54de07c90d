"""Write a layout for a file of another program.

Alone, as each group of commands has a file of its own.
"""

from __future__ import annotations

from typing import Annotated, Any

import imulab as il
from imulab.cli.command import Argument, Command, option
from imulab.cli.options import call, check_outputs, note
from imulab.errors import OptionError
from imulab.options import FLAG, OUTPUT, options_of, read_options


def guess(
    file: Annotated[str, Argument("FILE", "Text file of another program.")],
    *,
    output: Annotated[str | None, option("L.toml", "Layout file to write.", "-o", "--output"), OUTPUT] = None,
    **options: Any,
) -> None:
    """Write a layout for a file, guessed from its titles.

    To L.toml, or to standard output. Comments in it say what the titles left open; a unit that neither titles nor
    readings tell is refused, and --unit states it.
    """
    check_outputs([output], [file])
    if output is not None and not output.lower().endswith(".toml"):
        raise OptionError(f"{output}: expected a name that ends in .toml")
    texts = {each.name: options[each.keyword] for each in options_of(il.guess_layout)}
    guessed = call(il.guess_layout, file, **read_options(options_of(il.guess_layout), texts, FLAG))
    for sentence in guessed.supposed:
        note(f"{file}: {sentence}")
    if output is None:
        print(guessed.toml, end="")
        return
    guessed.save(output)
    print(f"layout: {output}")


COMMANDS = (Command("layout guess", guess, lambda: [il.guess_layout]),)
