"""Calibration records: what was found, written whole, read back checked, and compared."""
