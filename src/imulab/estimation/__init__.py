"""What is inferred from numbers whatever the procedure: least squares, noise, sampling, rows to leave out."""

TAUS = ("octave", "dense")
"""Averaging times that have a name: a factor of two apart, or 24 a decade."""
