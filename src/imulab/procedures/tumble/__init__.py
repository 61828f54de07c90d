"""Tumble test: an accelerometer triad calibrated with gravity as the only reference."""
