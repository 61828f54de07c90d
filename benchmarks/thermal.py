"""Thermal: time of the calibration over temperature, 12 attitudes at each of five temperatures."""

from __future__ import annotations

import time

from timing import Row, seconds

import imulab as il

COUNT = 1000
DIFFERENT = 20
"""Units that are simulated; a fit takes as long the second time."""


def rows() -> list[Row]:
    units = [[*il.simulate_thermal(attitudes=12, seed=seed)] for seed in range(DIFFERENT)]
    stated, fitted, auto = seconds(
        lambda: il.fit_thermal(units[0], degrees="3,2,1", turn_on_scatter="0.1 mg"),
        lambda: il.fit_thermal(units[0], degrees="3,2,1"),
        lambda: il.fit_thermal(units[0]),
        repeats=15,
        clock=time.process_time,
    )
    begin = time.process_time()
    for number in range(COUNT):
        il.fit_thermal(units[number % DIFFERENT], degrees="3,2,1")
    batch = time.process_time() - begin
    what = "five recordings of 100 s at 50 Hz to a record, holds found"
    return [
        (f"{what}, turn-on scatter stated", f"{1e3 * stated:.0f} ms", "solve alone <= 10 ms"),
        (f"{what}, turn-on scatter found", f"{1e3 * fitted:.0f} ms", "<= 200 ms"),
        (f"{what}, degrees chosen", f"{1e3 * auto:.0f} ms", "<= 1 s"),
        (
            f"{COUNT:,} such fits one after another, turn-on scatter found",
            f"{batch:.1f} s of processor time",
            "<= 12 s",
        ),
    ]
