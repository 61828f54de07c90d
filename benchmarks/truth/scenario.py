"""A scenario: one disturbance, habit or default, tried many times against a known truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Trial:
    """What came out of one simulated test.

    Attributes
    ----------
    covered
        For each quantity asked for, whether its stated 95 % interval holds the truth; empty where nothing was stated.
    warned
        Whether the product said what is wrong: a warning or note that names it, a refusal, an attitude set aside.
    error
        Error of the quantity that the scenario is about, in the scenario's unit; NaN where nothing was stated.
    """

    covered: tuple[bool, ...] = ()
    warned: bool = False
    error: float = float("nan")


@dataclass(frozen=True)
class Scenario:
    """One row of the table.

    Attributes
    ----------
    group, name
        Procedure, and what is disturbed or chosen, with its size.
    trial
        Seed to what came out; a module-level function or `functools.partial` of one, so that processes can share it.
    trials
        How many seeds.
    coverage
        Lowest and highest share of intervals that hold the truth, in %, or None where only a warning is asked.
    warned
        Least share of trials that must be warned of, in %, or None.
    false_alarms
        Most trials that may be warned of, in %, where nothing is wrong; or None.
    largest_error
        Largest rms of `Trial.error`, or None.
    unit
        Of `Trial.error`.
    source
        Where the asked figures come from, where they are not 93 to 97 % or 95 %.
    """

    group: str
    name: str
    trial: Callable[[int], Trial]
    trials: int = 100
    coverage: tuple[float, float] | None = (93.0, 97.0)
    warned: float | None = None
    false_alarms: float | None = None
    largest_error: float | None = None
    unit: str = ""
    source: str = ""
