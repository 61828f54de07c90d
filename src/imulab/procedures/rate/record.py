"""The calibration record of a rate test: parameters, what its figures need, and its warnings.

Parameters have the names of the gyroscopes in a tumble record. The mathematics is in `solve` and `dwells`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from imulab.display import Bad, Finding, Note
from imulab.estimation.decisions import DWELLS_SCATTER, HYSTERESIS, LINE_BENDS, SCALE_OFF_UNIT
from imulab.estimation.least_squares import chi_square_probability, coverage_factor
from imulab.gravity import EARTH
from imulab.procedures.rate import AXES
from imulab.procedures.rate.axes import BY_ACCELEROMETERS, TableAxes, note_lean, warn_faces
from imulab.procedures.rate.dwells import Dwells
from imulab.procedures.rate.schema import (
    AxisFit,
    Direction,
    DwellResiduals,
    RateEvidence,
    RateModel,
    RateSummary,
    RateTest,
    SweptRun,
)
from imulab.procedures.rate.solve import (
    EXACT,
    Linearity,
    RateProblem,
    RateSolution,
    model_parameters,
    temperature_slopes,
)
from imulab.recording import Array, Recording
from imulab.records.calibration import Calibration, Covariance, Parameter
from imulab.records.comparison import different_units
from imulab.records.sections import Quantity, entries
from imulab.report.parameters import text_in
from imulab.report.traces import plain_number
from imulab.units import from_si, parse_unit

# Sweeps in a rate record: delay and bandwidth of each gyroscope, and the frequency of a single sine.


def delays_and_bandwidths(test: RateTest, dwells: Sequence[Dwells]) -> dict[str, Parameter]:
    """Return ``gyro_delay_i`` and ``gyro_bandwidth_i`` of each gyroscope with sweeps, averaged by inverse variance."""
    parameters: dict[str, Parameter] = {}
    for kind, unit in (("delay", "s"), ("bandwidth", "Hz")):
        for number, axis in enumerate(AXES):
            pairs = [
                pair
                for run, run_dwells in zip(test.runs, dwells, strict=True)
                if run.axis == number
                and run_dwells.sweep is not None
                and (pair := getattr(run_dwells.sweep, kind)) is not None
            ]
            if pairs:
                values, spread = np.array(pairs).T
                weight = 1 / np.maximum(spread, 1e-12 * np.abs(values).max()) ** 2
                value, u = float(weight @ values / weight.sum()), float(1 / np.sqrt(weight.sum()))
                parameters[f"gyro_{kind}_{axis}"] = Parameter(value, u, unit)
    return parameters


def describe_motion(dwells: Sequence[Dwells]) -> str:
    """Return how the table moved, ``model.from`` of the record."""
    kinds = {run_dwells.sweep is None for run_dwells in dwells}
    return "steps" if kinds == {True} else "sweeps" if kinds == {False} else "steps and sweeps"


def summarize_sweeps(test: RateTest, dwells: Sequence[Dwells]) -> list[SweptRun]:
    """Return ``fit.sweeps``: file, axis, delay and bandwidth of each run that was a sweep."""
    return [
        SweptRun(
            file=run.file,
            axis=AXES[run.axis],
            frequency=sweep.frequency,
            delay=sweep.delay[0],
            delay_uncertainty=sweep.delay[1],
            bandwidth=None if sweep.bandwidth is None else sweep.bandwidth[0],
            bandwidth_uncertainty=None if sweep.bandwidth is None else sweep.bandwidth[1],
            bandwidth_beyond=sweep.beyond,
        )
        for run, reduced in zip(test.runs, dwells, strict=True)
        if (sweep := reduced.sweep) is not None
    ]


def note_sweeps(test: RateTest, dwells: Sequence[Dwells]) -> list[str]:
    """Return a note for each sweep that does not show hysteresis, or is of a single frequency."""
    messages: list[str] = []
    for index, run in enumerate(dwells):
        if run.sweep is None or run.sweep.loop_error is not None:
            continue
        place = test.place(index)
        if run.sweep.frequency is None:
            messages.append(
                Note(
                    f"{place}: the rate sweeps at one speed, so that the delay contains the hysteresis; a sweep of "
                    "frequencies, or steps, shows it"
                )
            )
        else:
            messages.append(
                Note(
                    f"{place}: the rate is one sine of {run.sweep.frequency:.4g} Hz: the scale factor is the amplitude "
                    "at that frequency, the delay holds hysteresis, and no bandwidth can be told from it; a sweep of "
                    "frequencies, or steps, shows that at rest, and the hysteresis"
                )
            )
    return messages


# The record.


_MATTERS = 3.0  # times the uncertainty of a bias: the Earth's rate is warned of if it is larger
_LARGEST = ("nonlinearity", "hysteresis")  # maxima of absolute values
_CLOCK = 1e-4  # relative standard uncertainty of table and clock together where none was stated
_NO_CLOCK = 0.1  # relative: no clock is so far off


def make_record(
    test: RateTest,
    recordings: Sequence[Recording],
    dwells: Sequence[Dwells],
    problem: RateProblem,
    solution: RateSolution,
    linearity: Mapping[str, Linearity],
    unit: str,
    order: str,
    axes: TableAxes | None = None,
) -> Calibration:
    """Return the record of a solution."""
    names, values, matrix, units, freedoms = model_parameters(test, problem, solution, unit, axes)
    freedoms |= _scale_factor_freedoms(test, dwells, solution, names, values.tolist(), np.diag(matrix).tolist())
    parameters = {}
    for name, value, u, parameter_unit in zip(
        names, values.tolist(), np.sqrt(np.diag(matrix)).tolist(), units, strict=True
    ):
        wide = coverage_factor(freedoms[name]) * u if name in freedoms else None
        parameters[name] = Parameter(
            value, u, parameter_unit, interval_95=None if wide is None else (value - wide, value + wide)
        )
    figures = _linearity_parameters(linearity) | delays_and_bandwidths(test, dwells)
    figures |= temperature_slopes(recordings, dwells, problem, solution)
    joint = _join_covariance(names, matrix, figures)
    heads = [recording.metadata for recording in recordings]
    sensor = {key: text for head in heads for key in ("serial", "model", "element") if (text := head.get(key))}
    temperatures = [t for recording in recordings if (t := recording.mean_temperature()) is not None]
    model = RateModel(
        gyro_order=max(solution.orders),
        gyro_output_unit=unit,
        axes="".join(linearity),
        from_=describe_motion(dwells),
        frame="the faces on which the unit was mounted" if axes is None else BY_ACCELEROMETERS,
        largest_rate=Quantity(value=_largest_rate(problem), unit="rad/s"),
        temperature=Quantity(value=float(np.mean(temperatures)), unit="degC") if temperatures else None,
    )
    return Calibration(
        procedure="rate",
        parameters=parameters | figures,
        covariance=joint,
        model=entries(model),
        fit=entries(_summarize_fit(test, problem, solution, linearity, dwells)),
        options={"order": order if order == "auto" else int(order)},
        data=entries(RateEvidence(dwells=_dwell_residuals(linearity))),
        sensor={**sensor, **test.sensor},
        sources=tuple(recording.source for recording in recordings if recording.source is not None),
        warnings=(
            *_warn_other_unit(test, recordings),
            *_warn_output_unit(parameters, unit),
            *_warn_table(test, parameters, axes is not None),
            *_warn_clock(test, recordings, dwells),
            *_warn_line(
                linearity, parameters, dict(zip((AXES[k] for k in problem.gyros), solution.orders, strict=True)), order
            ),
            *_note_rounding(problem, unit),
            *_note_scatter(problem, solution),
            *(warn_faces(test, recordings, dwells) if axes is None else note_lean(axes, test)),
            *note_sweeps(test, dwells),
        ),
    )


def _join_covariance(names: Sequence[str], matrix: Array, figures: Mapping[str, Parameter]) -> Covariance:
    """Return the covariance of parameters and figures; figures are taken as uncorrelated.

    Maxima are left out, since noise raises them: comparisons show these, and do not judge them.
    """
    known = {
        name: u
        for name, p in figures.items()
        if (u := p.standard_uncertainty) is not None and not any(f"_{kind}_" in name for kind in _LARGEST)
    }
    joined = np.diag(np.append(np.zeros(len(matrix)), np.square(list(known.values()))))
    joined[: len(matrix), : len(matrix)] = matrix
    return Covariance((*names, *known), tuple(map(tuple, joined.tolist())))


def _largest_rate(problem: RateProblem) -> float:
    """Return the largest rate of the table, rad/s."""
    return max(float(np.abs(problem.table).max()), 0.0 if problem.reach is None else float(problem.reach.max()))


def _scale_factor_freedoms(
    test: RateTest,
    dwells: Sequence[Dwells],
    solution: RateSolution,
    names: Sequence[str],
    values: Sequence[float],
    variances: Sequence[float],
) -> dict[str, float]:
    """Return the degrees of freedom of scale factors that rest on scatter of runs or of parts of sweeps.

    By Satterthwaite: the table's share has infinitely many.
    """
    freedoms = {}
    for name, value, variance in zip(names, values, variances, strict=True):
        if name.startswith("gyro_scale_factor"):
            sweeps = [
                run.sweep.freedom
                for run, place in zip(dwells, test.runs, strict=True)
                if run.sweep is not None and AXES[place.axis] == name[-1]
            ]
            freedom = sum(sweeps) if solution.cycle_freedom is None else solution.cycle_freedom
            scattered_share = 1 - (value * (test.relative_uncertainty or 0.0)) ** 2 / variance
            if freedom:
                freedoms[name] = freedom / max(scattered_share, 1e-3) ** 2
    return freedoms


def _linearity_parameters(linearity: Mapping[str, Linearity]) -> dict[str, Parameter]:
    """Return nonlinearity, asymmetry, hysteresis and threshold of each axis, from `measure_linearity`."""
    parameters = {}
    for kind, unit in (("nonlinearity", "1"), ("asymmetry", "1"), ("hysteresis", "1"), ("threshold", "rad/s")):
        for axis, axis_linearity in linearity.items():
            pair = getattr(axis_linearity, kind)
            if pair is not None:
                parameters[f"gyro_{kind}_{axis}"] = Parameter(pair[0], pair[1], unit)
    return parameters


def _summarize_fit(
    test: RateTest,
    problem: RateProblem,
    solution: RateSolution,
    linearity: Mapping[str, Linearity],
    dwells: Sequence[Dwells],
) -> RateSummary:
    """Return ``fit``: how the lines were fitted, and how well."""
    return RateSummary(
        runs=len(dwells),
        dwells=len(problem.rate),
        rates_from="the table's column" if all(run.recorded for run in dwells) else "the list of rates",
        chi_square=solution.chi_square,
        degrees_of_freedom=solution.freedom,
        between_runs=solution.cycle,
        table_uncertainty=test.relative_uncertainty,
        rate_uncertainty=Quantity(value=test.rate_uncertainty, unit="rad/s"),
        proportional_uncertainty=test.proportional_uncertainty,
        mounting_uncertainty=test.mounting_uncertainty,
        latitude=test.latitude,
        axes={
            axis: _summarize_axis(line, solution, problem.gyros.index(AXES.index(axis)))
            for axis, line in linearity.items()
        },
        sweeps=summarize_sweeps(test, dwells) or None,
    )


def _summarize_axis(line: Linearity, solution: RateSolution, number: int) -> AxisFit:
    """Return ``fit.axes`` of one gyroscope; `number` is its place among those that were fitted."""
    fitted_loop, repeatability = line.fitted_loop or (None, None), line.repeatability or (None, None)
    return AxisFit(
        probability=line.probability,
        by_noise=line.by_noise,
        loop=line.loop,
        fitted_loop=fitted_loop[0],
        fitted_loop_uncertainty=fitted_loop[1],
        repeatability=repeatability[0],
        repeatability_by_noise=repeatability[1],
        by_polynomial=line.by_polynomial,
        order=solution.orders[number],
        scatter=float(solution.scatter[number]),
    )


def _dwell_residuals(linearity: Mapping[str, Linearity]) -> DwellResiduals:
    """Return ``data.dwells``: each dwell about the axis of a gyroscope, as the figures draw it."""
    words: tuple[Direction, ...] = ("falling", "turning", "rising")
    lines = linearity.values()
    return DwellResiduals(
        axis=[axis for axis, line in linearity.items() for _ in line.rate],
        rate=[value for line in lines for value in line.rate.tolist()],
        residual=[value for line in lines for value in line.residual.tolist()],
        standard_uncertainty=[value for line in lines for value in line.uncertainty.tolist()],
        direction=[words[d + 1] for line in lines for d in line.direction.tolist()],
    )


def _warn_other_unit(test: RateTest, recordings: Sequence[Recording]) -> list[str]:
    """Return a warning where a recording and the manifest name different units."""
    pairs = (different_units((r.name, r.metadata), ("the manifest", test.sensor)) for r in recordings)
    messages: list[str] = [
        Finding(f"{other}: which is the unit?", "correct the serial number in the manifest or in the file")
        for other in pairs
        if other
    ]
    return messages[:1]


def _warn_output_unit(parameters: Mapping[str, Parameter], unit: str) -> list[str]:
    """Return a warning where scale factors are so far off that the output must be in another unit."""
    nominal = parse_unit(unit)
    if nominal.quantity != "rate":
        return []
    off = {n[-1]: p.value * nominal.factor - 1 for n, p in parameters.items() if n.startswith("gyro_scale_factor")}
    if max(map(abs, off.values())) <= SCALE_OFF_UNIT:
        return []
    offs = " ".join(f"{axis} {100 * value:+.1f} %" for axis, value in off.items())
    return [
        Bad(
            f"the scale factors are off by {offs}: is the unit ({unit}) right, or that of the table's rates?",
            "check the unit of the outputs and that of the table's rates, and correct the wrong one",
        )
    ]


def _warn_clock(test: RateTest, recordings: Sequence[Recording], dwells: Sequence[Dwells]) -> list[str]:
    """Return what is known of the recorder's clock, by which table_angle became a rate: an error of it is one of S.

    It shows where the manifest lists the rates too: ``recorded = (1 + e) listed`` over all runs, a mean for each rate.
    """
    by_angle = ["table_angle" in recording and "table_rate" not in recording for recording in recordings]
    if not any(by_angle):
        return []
    stated = test.relative_uncertainty
    runs = zip(test.runs, dwells, by_angle, strict=True)
    pairs = [
        (run.rates, reduced.rate)
        for run, reduced, angle in runs
        if angle and run.rates and any(run.rates) and reduced.sweep is None
    ]
    if not pairs:
        if stated is not None:
            return [
                Note(
                    f"table_angle became a rate by the recorder's clock: the stated {100 * stated:.3g} % of the "
                    "table must contain the uncertainty of that clock"
                )
            ]
        return [
            Finding(
                "table_angle became a rate by the recorder's clock, whose uncertainty was not stated and is in no "
                "uncertainty of a scale factor: a clock without a crystal is off by 0.3 % and more",
                "state it, with the table's (relative_standard_uncertainty, or --table-uncertainty), or list the rates "
                "that the table ran as well",
            )
        ]
    recorded = np.concatenate([rate for _, rate in pairs])
    listed = np.concatenate(
        [np.array(rates)[np.abs(rate[:, None] - np.array(rates)).argmin(axis=1)] for rates, rate in pairs]
    )
    rates, key = np.unique(listed, return_inverse=True)
    means = np.bincount(key, recorded) / np.bincount(key)
    square = float(rates @ rates)
    error = float(rates @ (means - rates)) / square if square else np.inf
    if abs(error) > _NO_CLOCK:
        largest = float(np.abs(recorded).max()), max(max(map(abs, each)) for each, _ in pairs)
        by_table_angle, in_list = (plain_number(from_si(rate, "deg/s"), 4) for rate in largest)
        return [
            Finding(
                f"the rates by table_angle, up to {by_table_angle} deg/s, are not those "
                f"listed, up to {in_list} deg/s; the scale factors are by table_angle",
                "correct the unit of table_angle, or that of the listed rates",
            )
        ]
    scatter = np.sqrt(np.sum((means - (1 + error) * rates) ** 2) / max(len(rates) - 1, 1) / square)
    limit = coverage_factor(None, 0.999) * (_CLOCK if stated is None else stated)
    if abs(error) < limit + coverage_factor(len(rates) - 1, 0.999) * float(scatter) + EXACT:
        return []
    return [
        Finding(
            f"the rates by table_angle and the recorder's clock are {100 * error:+.3g} % off those listed: one of "
            "them is wrong; the scale factors are by table_angle",
            "check the clock; if it is wrong, leave table_angle out, so that the listed rates count",
        )
    ]


def _warn_table(test: RateTest, parameters: Mapping[str, Parameter], by_axes: bool) -> list[str]:
    """Return what the stated uncertainties do not cover: the table's rates, the mounting, and the Earth's rate."""
    messages: list[str] = []
    if test.relative_uncertainty is None:
        messages.append(
            Note(
                "the uncertainty that all rates of the table have in common was not stated, and is in no uncertainty "
                "of a scale factor (relative_standard_uncertainty, or --table-uncertainty)"
            )
        )
    triad = any(name.startswith("gyro_misalignment") for name in parameters)
    if test.mounting_uncertainty is None and triad and not by_axes:
        most = max(p.standard_uncertainty or 0.0 for n, p in parameters.items() if n.startswith("gyro_misalignment"))
        messages.append(
            "the uncertainty of the mounting was not stated, and is in no uncertainty of a misalignment, of "
            f"{1e3 * most:.2g} mrad at most: state it (mounting in the manifest; 0.3 mrad across a face is usual), or "
            "take the table axis from accelerometers (--accel)"
        )
    least = min(p.standard_uncertainty or 0.0 for n, p in parameters.items() if n.startswith("gyro_bias"))
    if test.latitude is None and _MATTERS * least < EARTH:
        messages.append(
            f"the Earth's rate, up to {text_in(EARTH, 'deg/h', 2)} deg/h, stays in the biases: their uncertainty of "
            f"{text_in(least, 'deg/h', 2)} deg/h does not cover it; state the latitude (--latitude)"
        )
    return messages


def _warn_line(
    linearity: Mapping[str, Linearity], parameters: Mapping[str, Parameter], orders: Mapping[str, int], asked: str
) -> list[str]:
    """Return warnings of what the chosen powers of the rate do not compensate: bends, kinks and hysteresis."""
    messages: list[str] = []
    for axis, line in linearity.items():
        scale = parameters[f"gyro_scale_factor_{axis}"]
        known = (scale.standard_uncertainty or 0.0) / abs(scale.value)
        if line.drift is not None:
            text = (
                f"gyro_{axis}: over a run the scale factor drifts by {1e6 * line.drift[0]:.3g} ppm and the zero by "
                f"{text_in(line.drift[1], 'deg/h', 3)} deg/h: does the temperature change?"
            )
            action = "let the unit warm up, keep the temperature, and run the rates again"
            drifts = max(line.drift[0], line.drift[1] / float(np.abs(line.rate).max()))
            messages.append(Note(text) if drifts < known else Finding(text, action))
        if asked != "auto" and line.probability < LINE_BENDS.level and line.by_polynomial > line.by_noise:
            messages.append(
                Finding(
                    f"gyro_{axis}: the output bends by {1e6 * line.by_polynomial:.3g} ppm of the largest rate beyond "
                    f"order {asked}, and beyond the noise of its dwells: is a higher order supported (--order auto)?",
                    "fit with --order auto",
                )
            )
        elif asked == "auto" and line.probability < LINE_BENDS.level and orders[axis] == 1:
            residuals = {rate: np.mean(line.residual[line.rate == rate]) for rate in line.rate.tolist()}
            worst = max(residuals, key=lambda rate: abs(residuals[rate]))
            text = (
                f"gyro_{axis}: the output bends by {1e6 * line.nonlinearity[0]:.3g} ppm of the largest rate, most at "
                f"{text_in(worst, 'deg/s', 4)} deg/s, beyond the noise of its dwells, and no power of the rate "
                "predicts single rates better: may some of the table's be off, or did the zero jump? (--order 2 to 5 "
                "fits powers all the same)"
            )
            action = (
                f"compare the rates listed for {axis} with those that the table ran"
                if line.one_rate < line.bend
                else f"run more rates about {axis}, or fit with --order 3 if the table's are right"
            )
            harmless = line.nonlinearity[0] < known or min(line.one_rate, line.bend) > LINE_BENDS.level
            messages.append(Note(text) if harmless else Finding(text, action))
        if line.kink is not None:
            text = (
                f"gyro_{axis}: the slopes of positive and negative rates differ by {1e6 * line.kink:+.3g} ppm, with a "
                f"kink at 0 that no power of the rate compensates: at most {1e6 * line.by_polynomial:.3g} ppm of the "
                "largest rate are left"
            )
            action = "use the calibration for one sign of the rate, or check the table at low rates"
            messages.append(Note(text) if line.by_polynomial < known else Finding(text, action))
        if line.loop is not None and line.loop < HYSTERESIS.level and line.hysteresis is not None:
            messages.append(
                Finding(
                    f"gyro_{axis}: rising and falling rates differ by {1e6 * line.hysteresis[0]:+.3g} ppm of the "
                    "largest rate (hysteresis), which no calibration removes",
                    "check the table and the temperature, and run the rates up and down again",
                )
            )
    return messages


def _note_rounding(problem: RateProblem, unit: str) -> list[str]:
    """Return a note for each gyroscope whose output comes in steps coarser than its noise."""
    return [
        Note(
            f"gyro_{AXES[axis]}: its output comes in steps of {np.sqrt(12) * problem.rounded(i):.3g} {unit}, coarser "
            f"than its noise: each rate is read to {problem.rounded(i):.2g} {unit}, which is in the uncertainties"
        )
        for i, axis in enumerate(problem.gyros)
        if problem.rounded(i)
    ]


def _note_scatter(problem: RateProblem, solution: RateSolution) -> list[str]:
    """Return notes where dwells or scale factors scatter beyond their noise."""
    messages: list[str] = []
    if chi_square_probability(solution.chi_square, solution.freedom) < DWELLS_SCATTER.level:
        ratio = solution.chi_square / max(solution.freedom, 1)
        messages.append(
            Note(
                f"the dwells scatter more than their noise (reduced chi-square {ratio:.3g}); the uncertainties cover "
                "the added scatter"
            )
        )
    if solution.cycle:
        messages.append(
            Note(f"the scale factors differ by {1e6 * solution.cycle:.3g} ppm from run to run, beyond their noise")
        )
    return messages
