"""Accelerometers calibrated over temperature: one error model for the range in which a unit is used."""
