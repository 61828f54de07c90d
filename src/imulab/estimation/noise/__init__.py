"""The noise of a sensor at rest: a model fitted to a whole record, its intervals, and what a filter wants of it."""
