"""The C core in Python: settings and tables of a unit as bytes, blobs and streams."""

from __future__ import annotations

# The methods by which the C core fuses an array.


STARTS = ("first", "zero")
"""Biases to start from: those of the first samples, or none."""
METHODS = ("mean", "support", "least-squares", "feedback", "robust", "covariance", "kalman")
