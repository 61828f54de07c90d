"""Centrifuge test.

The acceleration-sensitive drift of a gyroscope; and the words that the options of a reduction take.
"""

from __future__ import annotations

# The words that the options of a centrifuge reduction take.


METHODS = ("least-squares", "fourier")
CURVES: dict[str, tuple[int, ...]] = {"constant": (), "c1": (1,), "c2": (2,), "c1+c2": (1, 2)}
"""Curves of K(a): name to the powers of a beside the constant."""
