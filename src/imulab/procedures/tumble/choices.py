"""The words that the options of a tumble test take."""

from __future__ import annotations

HIGHEST_ORDER = 5
FROM_DATA = ("auto", "blend")
ORDERS = ("auto", *map(str, range(HIGHEST_ORDER + 1)), "blend")
METHODS = ("norm", "linearised")
LOSSES = ("square", "huber", "auto")
CRITERIA = ("A", "D")
STARTS = ("sphere", "fixture:15", "head:15")
"""Where attitudes may lie, with steps of any number of degrees."""
SENSITIVITIES = ("auto", "yes", "no")
CLOCKS = ("gyro", "accel")
MAG_ORDERS = ("1", "2", "auto")
HEMISPHERES = ("north", "south")
FURTHER = ("gyro", "mag")
"""Triads that can be fitted on the attitudes of the accelerometers."""
