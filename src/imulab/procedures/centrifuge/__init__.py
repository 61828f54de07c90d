"""Centrifuge test: the drift of a gyroscope with specific force. Here are the words that the options take."""

from __future__ import annotations

METHODS = ("least-squares", "fourier")
CURVES: dict[str, tuple[int, ...]] = {"constant": (), "c1": (1,), "c2": (2,), "c1+c2": (1, 2)}
"""Curves of K(a): name to the powers of a beside the constant."""
