"""Gyro array: several gyroscopes on one axis, or three, fused into one better.

And the words that the options of its commands take.
"""

from __future__ import annotations

# The words that the options of an array's commands take.


EXPERIMENTS = {"static": (100.0, 2000.0), "dynamic": (50.0, 100.0), "moving": (100.0, 120.0)}
"""Sampling rate, Hz, and duration, s, of each."""
OF_THE_SOURCE = ("static", "dynamic")
MOUNTINGS = ("same", "alternate")
UNITS = ("rad/s", "deg/s", "deg/h")
FAULTS = ("dead", "stuck", "spikes", "jump", "nan", "saturation")
