"""Program that shows the columns of a file for the page in its own process, or writes the layout that was stated there.

``python -P -m imulab.live.page.columns FILE`` prints a JSON object: ``titles``, ``rows`` (the first), ``columns`` (what
is known of each), ``supposed``. With a second argument, the JSON of ``columns`` ([[place, name, unit], ..]) and
``sample_rate``, it prints the ``toml`` of their layout. What cannot be is an ``error``.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from msgspec import structs

from imulab.errors import ImulabError
from imulab.quantities import quantity
from imulab.readers.stated import columns_of_table, layout_of_columns, table_of_file

_ROWS = 6  # that are shown


def described(file: str, stated: dict[str, Any] | None) -> dict[str, Any]:
    """Return what the page is told; errors as for `table_of_file` and `layout_of_columns`."""
    name = Path(file).name
    table = table_of_file(file)
    if stated is None:
        columns, supposed = columns_of_table(table, name)
        rows = [[field[:40] for field in row[: len(table.titles)]] for row in table.rows[:_ROWS]]
        return {"columns": [structs.asdict(column) for column in columns], "rows": rows, "supposed": supposed}
    rate = stated.get("sample_rate")
    chosen = {int(place): (str(column), str(unit)) for place, column, unit in stated["columns"]}
    seconds = None if not rate else quantity(str(rate), "rows in a second", "frequency", "Hz")
    return {"toml": layout_of_columns(table, chosen, seconds, name)}


def main() -> int:
    """Print what the page asked for; return 2 where it cannot be."""
    try:
        print(json.dumps(described(sys.argv[1], json.loads(sys.argv[2]) if sys.argv[2:] else None)))
    except (ImulabError, MemoryError) as error:
        print(
            json.dumps({"error": str(error) or f"{Path(sys.argv[1]).name}: too large for the memory of this machine"})
        )
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
