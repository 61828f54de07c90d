"""A magnetometer triad alone, waved through all directions or turned level: hard and soft iron in the body's gauge.

``M = D m + h`` with a field m of one magnitude and a symmetric D. A rotation between the magnetometers' axes and the
body shows in no magnitude, and is not told; accelerometers beside them tell it (``tumble mag`` on attitudes at rest).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from numpy.typing import NDArray

AXES = "xyz"
GAUGE = "body, rotation not told"
FEWEST = {3: 12, 2: 8}
"""Readings that a fit takes at least, by the number of axes that were turned."""
ALL_WAYS, LEVEL = "all ways", "level"
TURNS = ("wave", "level")
"""How a unit is turned: waved through all directions, or turned level."""


def name_columns(samples: NDArray[Any]) -> Mapping[str, Any]:
    """Return the columns of an array without names."""
    return {"mag": samples}
