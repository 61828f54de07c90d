"""The words that the options of a warm-up test take."""

from __future__ import annotations

MODELS = ("interval-cubic", "knot-cubic", "knot-log-cubic", "exponential")
EXITS = ("zero", "hold", "taper")
BEYOND = ("zero", "hold")
LAWS = ("smooth", "bent")
POOLS = ("unit", "type")
TEMPERATURES = "-40,-30,-20,-10,0,40,50,60"
"""Calibration temperatures of the source, degC."""
