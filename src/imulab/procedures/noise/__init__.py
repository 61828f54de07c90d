"""The noise of a sensor at rest: its model, and the numbers that filters want."""
