"""The words that the options of a tumble fit take."""

from __future__ import annotations

HIGHEST_ORDER = 5
FROM_DATA = ("auto", "blend")
ORDERS = ("auto", *map(str, range(HIGHEST_ORDER + 1)), "blend")
METHODS = ("norm", "linearised")
LOSSES = ("square", "huber", "auto")
