"""Doubles as the shortest decimals that read back exactly, as Python writes them, many at once."""

from __future__ import annotations

from functools import cache

import numpy as np

import imulab.writers._digits as _digits
from imulab.recording import Array
from imulab.writers.powers_of_ten import powers_of_ten


def decimal_rows(table: Array) -> bytes | memoryview:
    """Return a table, shape (rows, columns), as lines of decimals with commas between them."""
    if not table.size or not _prepare():
        return "".join(",".join(map(repr, row)) + "\n" for row in table.tolist()).encode("ascii")
    out = bytearray(25 * table.size)
    return memoryview(out)[: _digits.rows(np.ascontiguousarray(table, dtype=np.float64), table.shape[1], out)]


@cache
def _prepare() -> bool:
    """Give C its powers of ten; False where it cannot use them, and writes numbers another way."""
    return _digits.prepare(powers_of_ten())
