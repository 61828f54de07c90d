"""A magnetometer triad alone, waved through all directions or turned level: hard and soft iron in the body's gauge.

``M = D m + h`` with a field m of one magnitude and a symmetric D. A rotation between the magnetometers' axes and the
body shows in no magnitude, and is not told; accelerometers beside them tell it (``tumble mag`` on attitudes at rest).
"""

from __future__ import annotations

AXES = "xyz"
GAUGE = "body, rotation not told"
FEWEST = {3: 12, 2: 8}
"""Readings that a fit takes at least, by the number of axes that were turned."""
ALL_WAYS, LEVEL = "all ways", "level"
