"""Levels of all statistical tests that verdicts rest on, in one place, so that their false alarms can be added up.

Where nothing is wrong, a test still finds something in a share `level` of the data: its false alarms. A procedure makes
several tests, and a false alarm of one is a false alarm of the procedure. With tests of level a_i made n_i times each,
the share of clean data with a false alarm is at most ``sum n_i a_i`` (Boole's inequality, used so by Bonferroni),
whatever the tests have in common, and close to that where they have little. What a procedure may have in all is
`MOST_FALSE_ALARMS`; what it has is `false_alarms`.

A test of the largest of m values allows for m where it is made: its level is that of the largest. `times` counts what
is repeated beyond that, such as once for each of three axes.

Only what a user must look at counts: a finding that lowers the verdict, data that are set aside, and a check that
fails. A level that decides which terms a model has, or whether uncertainties grow by a scatter, changes numbers but not
whether their uncertainties hold; a note changes no verdict.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from math import nan
from typing import Literal, NamedTuple

Effect = Literal["verdict", "check", "model", "uncertainty", "note"]
"""What a positive test does: lowers the verdict, fails a check, adds a term, widens uncertainties, or is noted."""

_BLAMES: tuple[Effect, ...] = ("verdict", "check")


class Decision(NamedTuple):
    """A test, what it decides, and in which procedures it is made.

    Attributes
    ----------
    level
        Share of data without the effect in which the test finds it.
    effect
        What a positive test does.
    procedures
        How many such tests a procedure makes at most, by its name; the usual number where the data say how many.
    decides
        What is concluded from a positive test.
    limit
        What a statistic is held against where that is not its probability, nan elsewhere: a number of standard
        uncertainties, beyond which a share `level` of normal values lies on both sides, unless `decides` says else.
    """

    level: float
    effect: Effect
    procedures: Mapping[str, int]
    decides: str
    limit: float = nan


# Tumble test: accelerometers
TUMBLE_ORDER_TWO = Decision(0.05, "model", {"tumble": 1}, "the outputs have a quadratic term k2 (F-test)")
TUMBLE_ORDER_ABOVE_TWO = Decision(
    0.01, "model", {"tumble": 3}, "the outputs have a term k3, k4, k5: four tests at 5 % would find one too often"
)
ATTITUDE_SET_ASIDE = Decision(
    0.003, "verdict", {"tumble": 1}, "up to three attitudes were knocked, of all sets of as many: they are set aside"
)
ATTITUDES_FIT_STATED_NOISE = Decision(
    0.01, "uncertainty", {"tumble": 1}, "the attitudes' scatter is above their stated noise, so that it sets the scale"
)
ATTITUDE_STANDS_OUT = Decision(
    1e-3, "verdict", {"tumble": 1}, "an attitude that was kept lies off the others, the farthest of all of them"
)
ATTITUDE_STANDS_OUT_BY = Decision(
    5.7e-7, "verdict", {"tumble": 24}, "the same, where the level above would ask for less than 5 sigma", limit=5.0
)
ATTITUDES_SCATTER = Decision(
    0.004, "verdict", {"tumble": 1},
    "the attitudes scatter more than their own noise explains: a model whose order was stated may be too simple",
)  # fmt: skip
ATTITUDES_TOO_QUIET = Decision(1e-3, "verdict", {"tumble": 1}, "the attitudes scatter less: their noise is overstated")
RESIDUALS_FOLLOW_DIRECTION = Decision(
    0.01, "verdict", {"tumble": 1}, "the residuals are a function of direction: the model lacks terms (F-test)"
)
RESIDUALS_FOLLOW_TIME = Decision(0.01, "verdict", {"tumble": 1}, "the zeros drift over the test (F-test)")
PRIOR_CONTRADICTED = Decision(0.05, "verdict", {"tumble prior": 1}, "the unit has changed since the prior was made")
PRIOR_EXPLAINS_NOTHING = Decision(
    1e-6, "verdict", {"tumble prior": 1}, "no ageing of bias, scale factor and misalignment explains the attitudes"
)
ATTITUDES_DISTURBED = Decision(
    0.01, "uncertainty", {"tumble prior": 1, "tumble check": 1},
    "the attitudes scatter as no change of the unit makes them, which a test of the record allows for",
)  # fmt: skip
TUMBLE_CHECK = Decision(
    0.05, "check", {"tumble check": 1}, "the record no longer holds; accelerometers and magnetometers share this level"
)

# Tumble test: gyroscopes
TURN_DISAGREEMENT = Decision(1e-3, "verdict", {"tumble gyro": 1}, "a turn stands out from the others: it is set aside")
SCALE_CHANGES_WITH_RATE = Decision(
    1e-3, "verdict", {"tumble gyro": 1}, "what the turns miss depends on the rate: the output is not linear (F-test)"
)
SCALE_CHANGE = Decision(
    0.0027, "note", {"tumble gyro": 6}, "which axis's scale factor changes with the rate, once any does", limit=3.0
)
SAMPLES_LOST = Decision(
    5e-4, "verdict", {"tumble gyro": 1}, "turns miss as they do where samples are lost (restricted likelihood ratio)"
)
GYROS_UNSETTLED = Decision(
    1e-4, "verdict", {"tumble gyro": 1}, "the gyroscopes go on turning where the accelerometers are at rest (F-test)"
)
GYROS_LOW_PASSED = Decision(
    1e-4, "verdict", {"tumble gyro": 1}, "turns are smeared as by a low-pass filter of the gyroscopes (F-test)"
)
CLOCKS_DISAGREE = Decision(
    0.00047, "verdict", {"tumble gyro": 1}, "the two triads' clocks differ by more than crystals do", limit=3.5
)
SAMPLES_COME_LATE = Decision(
    6.3e-5, "note", {"tumble gyro": 1}, "the gyroscopes' samples come later than the accelerometers'", limit=4.0
)
SCALES_OFF_ALIKE = Decision(
    6.3e-5, "verdict", {"tumble gyro": 1},
    "the three scale factors are off by the same, as a wrong sample rate makes them", limit=4.0,
)  # fmt: skip
BIAS_FOLLOWS_GRAVITY = Decision(
    0.01, "model", {"tumble gyro": 1, "thermal gyro": 1}, "the outputs at rest depend on the direction of gravity"
)

# Tumble test: magnetometers
FIELD_SET_ASIDE = Decision(
    0.05, "model", {"tumble mag": 1}, "|m| and dip of an attitude, the farthest of all, do not enter the fit: noted"
)
FIELD_DISTURBED = Decision(
    0.003, "verdict", {"tumble mag": 1}, "an attitude that was set aside was disturbed, as by iron near"
)
FIELD_STEP = Decision(
    1e-3,
    "verdict",
    {"tumble mag": 1},
    "|m| and dip are others from some attitude on",
)
FIELD_STEP_BESIDE_POSE = Decision(
    0.01, "note", {"tumble mag": 1}, "the same beside all functions of the pose: pose does not explain the step too"
)
FIELD_FOLLOWS_TURNS = Decision(
    5.7e-7, "model", {"tumble mag": 1}, "the field still moves from the last attitude's in the beginning of holds",
    limit=5.0,
)  # fmt: skip
FIELD_ORDER_TWO = Decision(
    0.01, "model", {"tumble mag": 1}, "the magnetometers' outputs have a quadratic term (F-test)"
)
FIELD_SCATTERS = Decision(
    0.05, "uncertainty", {"tumble mag": 2}, "|m|, or the dip, scatters beyond its known noise: the scatter is estimated"
)
DIP_OFF_STATED = Decision(1e-3, "verdict", {"tumble mag": 1}, "the dip is not the one that was stated", limit=3.29)
HEMISPHERE_OF_DIP = Decision(
    6.3e-5, "model", {"tumble mag": 1}, "the sign of a stated dip is that of the hemisphere", limit=4.0
)
DIP_MOVES_ACCELEROMETERS = Decision(
    6.3e-5, "verdict", {"tumble mag": 9}, "field and gravity contradict each other in an accelerometer's parameter",
    limit=4.0,
)  # fmt: skip
ACCELEROMETERS_CONTRADICT_RECORD = Decision(
    1e-3, "verdict", {"tumble mag": 1}, "the attitudes contradict the accelerometers' record, which is not used"
)

# Magnetometer alone
FIELD_ALONE_STEP = Decision(1e-3, "verdict", {"magnetometer": 1}, "|m| is another from some time on")
HARD_IRON_STEP = Decision(
    1e-3, "verdict", {"magnetometer": 1}, "the hard iron is another from some time on; a small change is noted"
)
OUTPUTS_BEND = Decision(
    0.05, "uncertainty", {"magnetometer": 1},
    "|m| follows the direction as outputs with a third power of the field make it (F-test)",
)  # fmt: skip
OUTPUTS_BEND_CLEARLY = Decision(
    1e-3, "verdict", {"magnetometer": 2}, "the same, or by a square: a large term is to be looked at, a small one noted"
)
READINGS_SET_ASIDE = Decision(
    5.7e-7, "verdict", {"magnetometer": 8000}, "readings, or their means over windows, lie off all others", limit=5.0
)
MAGNETOMETER_CHECK = Decision(0.05, "check", {"magnetometer check": 1}, "the record of a magnetometer no longer holds")

# Thermal
THERMAL_POWER = Decision(
    0.01, "model", {"thermal": 9}, "the highest power of the temperature in a law is needed (Wald)"
)
THERMAL_DEGREES_TOO_LOW = Decision(
    0.005, "verdict", {"thermal": 1}, "the degrees that were stated leave out powers that are there (Wald)"
)
THERMAL_LAW_BENDS = Decision(0.01, "model", {"thermal": 1}, "the biases lie on no cubic: a spline is allowed (Wald)")
SCALES_SCATTER_BETWEEN_CYCLES = Decision(
    0.3, "uncertainty", {"thermal": 1}, "scale factors scatter from power cycle to power cycle, as far as it seems"
)
LAG_OR_LOOP = Decision(
    0.003,
    "verdict",
    {"thermal": 2, "thermal gyro": 2},
    "biases lag the temperature; they differ in warming and cooling",
)
RECORDING_DISAGREEMENT = Decision(
    0.002, "verdict", {"thermal": 2}, "a recording's biases, or scale factors, lie off those of all others"
)
HOLD_DISAGREEMENT = Decision(5.7e-7, "verdict", {"thermal": 200}, "a hold stands out from the laws", limit=5.0)
TEMPERATURE_MISSED = Decision(
    0.00047, "verdict", {"thermal": 8, "thermal gyro": 8}, "a temperature that was left out is missed: the law bends",
    limit=3.5,
)  # fmt: skip
DIRECTION_WANDERS = Decision(
    0.013,
    "uncertainty",
    {"thermal": 1},
    "a unit at rest slowly turns: limit of twice the log likelihood ratio",
    limit=5.0,
)
TURNED_IN_HOLD = Decision(
    1.2e-15, "verdict", {"thermal gyro": 200}, "the unit turned in a hold, which is left out", limit=8.0
)
SCALE_LAW_SCATTERS = Decision(
    0.005, "verdict", {"thermal gyro": 1}, "the scale factors of the recordings lie on no law that they determine"
)
THERMAL_CHECK = Decision(0.05, "check", {"thermal check": 1}, "the record over temperature no longer holds")

# Rate table
RATE_POWER = Decision(0.01, "model", {"rate": 12}, "the output has a higher power of the rate (chi-square and F-test)")
RATES_SCATTER_AS_NOISE = Decision(
    0.2, "model", {"rate": 12}, "what a polynomial leaves is more than noise, so that it tells the noise (F-test)"
)
LINE_BENDS = Decision(0.005, "verdict", {"rate": 3}, "the output bends beyond the order that was stated")
SLOPES_KINK = Decision(1e-3, "verdict", {"rate": 3}, "slopes of positive and negative rates differ", limit=3.29)
HYSTERESIS = Decision(0.006, "verdict", {"rate": 3}, "rising and falling rates differ")
HYSTERESIS_SCATTERS = Decision(
    0.01, "uncertainty", {"rate": 6}, "a sweep's loop has another shape, or visits of one rate scatter beyond noise"
)
DWELLS_SCATTER = Decision(
    0.01, "uncertainty", {"rate": 4}, "dwells scatter beyond their noise, which is added to each and noted"
)
ZEROS_WALK = Decision(
    0.01, "uncertainty", {"rate": 6}, "zeros walk over a run, by all dwells and by those about other axes"
)
RUNS_SCATTER = Decision(0.01, "uncertainty", {"rate": 1}, "scale factors differ from run to run beyond their noise")
TURNS_SCATTER = Decision(0.01, "uncertainty", {"rate turn": 3}, "whole turns about an axis scatter beyond their noise")
TURNS_LOSE_SAMPLES = Decision(
    0.003, "verdict", {"rate turn": 3}, "turns scatter beyond their stops, more likely as lost samples make them"
)
AXIS_TILTED = Decision(
    9.7e-4, "verdict", {"rate turn": 6}, "turns are about an axis farther off a body axis than misalignments reach",
    limit=3.3,
)  # fmt: skip
TURNS_ACROSS_SCATTER = Decision(
    0.01, "uncertainty", {"rate turn": 9}, "what turns show across their axis scatters beyond the noise"
)
RATE_PRIOR_CONTRADICTED = Decision(0.01, "verdict", {"rate prior": 1}, "a rate record and the earlier one disagree")
LENGTH_AT_REST_OFF = Decision(
    4.7e-4, "verdict", {"rate": 6}, "|f| at rest is not g by the accelerometers' record, a power cycle allowed for",
    limit=3.5,
)  # fmt: skip

# Centrifuge
CURVE_TERM = Decision(0.05, "model", {"centrifuge": 2}, "K(a) has a term in the specific force (chi-square)")
CURVE_MISSES = Decision(0.005, "verdict", {"centrifuge": 2}, "no curve describes K(a) within its uncertainty")
DRIFT_DIRECTION_TURNS = Decision(0.005, "verdict", {"centrifuge": 2}, "the drift's direction turns between levels")
CYCLES_SCATTER = Decision(
    0.05, "uncertainty", {"centrifuge": 3}, "runs or power cycles scatter beyond their noise, in size or direction"
)
RIG_ERROR = Decision(
    0.0027, "verdict", {"centrifuge": 6}, "an error of the rig, or a rate off the manifest's, is clear of its noise",
    limit=3.0,
)  # fmt: skip
EARTH_LINE_SEEN = Decision(
    1e-8,
    "model",
    {"centrifuge": 1},
    "a line is the Earth's rate: limit of its power over that of the noise",
    limit=20.0,
)

# Noise
NOISE_MODEL_REJECTED = Decision(
    0.01, "verdict", {"noise": 1}, "no model of the terms describes a column's noise; all columns share this level"
)
LEVEL_STEP = Decision(
    5.7e-7,
    "verdict",
    {"noise": 6000},
    "the level changes at a place: six columns, a thousand places of each",
    limit=5.0,
)
LEVEL_STEP_PERHAPS = Decision(
    6.3e-5, "model", {"noise": 6000}, "a step is taken out before it is tested again, by noise without it", limit=4.0
)
NOISE_CHANGES_SIZE = Decision(
    5.7e-7, "verdict", {"noise": 360}, "the noise is louder from some time on: six columns, sixty places of each",
    limit=5.0,
)  # fmt: skip
SENSOR_WARMS_UP = Decision(
    3e-4, "verdict", {"noise": 6}, "a column drifts as while warming up, which its slow noise does not make"
)
WARM_UP_PERHAPS = Decision(
    6.3e-5, "model", {"noise": 84}, "a drift of warming up is taken out before it is judged",
    limit=4.0,
)  # fmt: skip
FOLLOWS_COVARIATE = Decision(
    0.00137, "verdict", {"noise": 12}, "a column follows the time or the temperature", limit=3.2
)
COLUMN_STUCK = Decision(1e-6, "verdict", {"noise": 6}, "a column keeps one value for longer than its noise makes it")
SPECTRAL_LINE = Decision(1e-9, "note", {"noise": 1_000_000}, "a coefficient of the spectrum belongs to a line")
BIN_OFF_MODEL = Decision(5.7e-7, "note", {"noise": 1000}, "a bin of the spectrum is off the model", limit=5.0)
NOISE_CHECK = Decision(
    0.05, "check", {"noise check": 1}, "the noise is another than the record's; all columns share it"
)

# Array of gyroscopes
READINGS_LATE = Decision(6.3e-5, "verdict", {"gyro_array": 16}, "an element's readings come late", limit=4.0)
ELEMENT_BENDS = Decision(
    0.01, "verdict", {"gyro_array": 1}, "an element's output is not linear in the rate, the worst of all of them"
)
METHOD_FOLLOWS_LESS = Decision(
    0.0099, "verdict", {"gyro_array": 1}, "a method follows less than 95 % of the motion", limit=2.58
)

# Warm-up
STILL_DRIFTS = Decision(
    6.3e-5, "verdict", {"warmup": 72}, "a cycle still drifts in the part that counts as settled", limit=4.0
)

# Comparing records, fleets
PARAMETER_CHANGED = Decision(
    0.05, "check", {"compare": 1}, "a parameter changed between two records; all parameters share this level"
)
FLEET_DRIFT = Decision(1e-3, "check", {"fleet": 1}, "a parameter drifts with the date of the calibration")
FLEET_CHANGE = Decision(0.01, "check", {"fleet": 1}, "a unit changed since its last calibration, the largest of all")

SCALE_OFF_UNIT = 0.1
"""Relative: a scale factor that is farther off its stated unit has another unit, or the sample rate is wrong: *bad*.

Uncalibrated sensors stay within it (ADXL345: 230 to 282 counts/g), and no two units are so near.
"""

SCALE_OF_ANOTHER_UNIT = 0.2
"""Relative: accelerometers that are farther off their stated unit than this have another one: *bad*."""

NINE_AXES = ("tumble", "tumble gyro", "tumble mag")
"""The parts of a tumble test of accelerometers, gyroscopes and magnetometers."""

MOST_FALSE_ALARMS: Mapping[tuple[str, ...], float] = {
    ("tumble",): 0.03,
    NINE_AXES: 0.04,
    ("thermal", "thermal gyro"): 0.04,
    ("magnetometer",): 0.04,
    ("rate",): 0.04,
    ("noise",): 0.04,
    ("gyro_array",): 0.04,
    ("centrifuge",): 0.04,
    ("warmup",): 0.04,
    ("tumble check",): 0.05,
    ("magnetometer check",): 0.05,
    ("thermal check",): 0.05,
    ("noise check",): 0.05,
    ("compare",): 0.05,
}
"""Largest share of clean tests that may get another verdict than *good*, or fail a check, by all tests together."""


def all_decisions() -> dict[str, Decision]:
    """Return every decision of this module by its name."""
    return {name: value for name, value in globals().items() if isinstance(value, Decision)}


def false_alarms(procedures: Iterable[str]) -> float:
    """Return the largest share of clean data with a false alarm: ``sum n_i a_i`` over what lowers a verdict."""
    names = tuple(procedures)
    return sum(
        decision.level * decision.procedures.get(name, 0)
        for decision in all_decisions().values()
        if decision.effect in _BLAMES
        for name in names
    )
