"""Many units: one task per unit, on this machine or a cluster; restartable, with history and the line's statistics."""

ENGINES = ("local", "dask")
