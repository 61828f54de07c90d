"""The magnetometer triad from the attitudes of a tumble test: hard iron, soft iron, alignment to the accelerometers."""
