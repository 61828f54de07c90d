"""Gyro array: several gyroscopes on one axis, or three, fused into a better one. Here are the options' values."""

from __future__ import annotations

EXPERIMENTS = {"static": (100.0, 2000.0), "dynamic": (50.0, 100.0), "moving": (100.0, 120.0)}
"""Sampling rate, Hz, and duration, s, of each."""
OF_THE_SOURCE = ("static", "dynamic")
MOUNTINGS = ("same", "alternate")
UNITS = ("rad/s", "deg/s", "deg/h")
FAULTS = ("dead", "stuck", "spikes", "jump", "nan", "saturation")
