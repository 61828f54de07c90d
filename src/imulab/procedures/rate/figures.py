"""The figures and tables of a rate record: residuals over the rate or of each turn, linearity, sweeps."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from imulab.estimation.distributions import probability_fact
from imulab.procedures.rate.schema import (
    AxisFit,
    DwellResiduals,
    RatePrior,
    RateRecord,
    SweptRun,
    WholeTurns,
    model_of,
    rate_of,
    turns_of,
)
from imulab.records.calibration import Calibration
from imulab.report.parameters import Row, parameters_table, reading_unit, rows_of, text_in, with_zero_outputs
from imulab.report.traces import (
    BAD,
    GOOD,
    INK,
    Exhibits,
    Figure,
    Group,
    ReportTable,
    figure_axis,
    format_uncertain,
    number_text,
    plain_number,
    points,
    table,
)
from imulab.units import from_si

_PPM = 1e6  # to ppm
_LOOKS = (("rising", "triangle-up", BAD), ("falling", "triangle-down", GOOD), ("turning", "circle", INK))
_TURN_LOOKS = (("x", "circle", INK), ("y", "diamond", GOOD), ("z", "square", BAD))


def exhibits(record: Calibration) -> Exhibits:
    """Return the figures and tables of a record."""
    if record.model.get("from") == "turns":
        return _turns_exhibits(record)
    rate_record = rate_of(record)
    axes = rate_record.model.axes
    largest = from_si(rate_record.model.largest_rate.value, "deg/s")
    worst = max(record.value(f"gyro_nonlinearity_{a}") for a in axes) * _PPM
    headline = (
        f"Gyroscopes {' '.join(axes)} over {largest:.4g} deg/s: a line leaves {plain_number(worst, 3)} ppm of the "
        "largest rate at most."
    )
    common = rate_record.fit.table_uncertainty
    facts = [
        ("runs", str(rate_record.fit.runs)),
        ("dwells", str(rate_record.fit.dwells)),
        ("rates from", rate_record.fit.rates_from),
        ("common to all rates", "not stated" if common is None else f"{number_text(common, _PPM)} ppm"),
    ]
    items: list[Figure | ReportTable] = [
        parameters_table(
            rows(record),
            "Bias, scale factor and misalignment in the frame of the faces on which the unit was mounted; nonlinearity "
            "and hysteresis as parts of the largest rate.",
        ),
        *([] if rate_record.fit.prior is None else [_prior_table(rate_record.fit.prior, record)]),
        *(_residual_figure(a, rate_record.data.dwells) for a in axes),
        _linearity_table(record, rate_record),
        *([] if rate_record.fit.sweeps is None else [_sweep_table(rate_record.fit.sweeps)]),
        _budget(record, rate_record),
    ]
    return Exhibits(headline, facts, items)


def rows(record: Calibration) -> list[Row]:
    """Return the parameters as they are read, with what counts and volts are at zero rate."""
    return with_zero_outputs(record, rows_of(record), "gyro_", model_of(record).gyro_output_unit)


def exhibit_gyroscopes(record: Calibration) -> Exhibits:
    """Return the exhibits of the gyroscopes in a record of both triads (``--accel``), without their parameters."""
    fit, data = record.fit["rate"], record.data["rate"]
    by_hand = "turns" in data
    axes = sorted(set(data["turns" if by_hand else "dwells"]["axis"]))
    rate_part = replace(
        record,
        procedure="rate",
        parameters={name: p for name, p in record.parameters.items() if name.startswith("gyro_")},
        model={**record.model, "axes": "".join(axes), "from": "turns" if by_hand else "steps"},
        fit=fit,
        data=data,
    )
    shown = exhibits(rate_part)
    return replace(shown, items=shown.items[1:])


def _residual_figure(axis: str, dwells: DwellResiduals) -> Figure:
    """Return the residuals of one gyroscope over the rate, rising and falling rates apart."""
    rate, residual, u = (np.array(values) for values in (dwells.rate, dwells.residual, dwells.standard_uncertainty))
    members, direction = np.array(dwells.axis) == axis, np.array(dwells.direction)
    return points(
        f"What the best line leaves of gyro_{axis}",
        "Each dwell, in ppm of the largest rate; bars: one standard uncertainty by its noise. Rising and "
        "falling rates that lie apart are hysteresis; a bend that both follow is nonlinearity.",
        ("rate, deg/s", from_si(rate, "deg/s")),
        ("residual, ppm of the largest rate", residual * _PPM),
        u * _PPM,
        [Group(label, members & (direction == label), symbol, colour) for label, symbol, colour in _LOOKS],
    )


def _linearity_table(record: Calibration, rate_record: RateRecord) -> ReportTable:
    """Return nonlinearity, asymmetry, hysteresis and repeatability of each gyroscope, ppm."""
    fits = rate_record.fit.axes

    def size(kind: str) -> Callable[[str], str]:
        names = f"gyro_{kind}_{{}}".format
        return lambda a: number_text(record.value(names(a)) if names(a) in record.parameters else None, _PPM)

    return table(
        "What a line does not hold, ppm",
        "Nonlinearity: largest residual of a rate over the largest rate; noise alone stays below the next column with "
        "95 %, and leaves as much as was found with probability p. Order: highest power of the rate in the model; "
        "what its powers leave is the largest residual beside them. Asymmetry: slope of positive less slope of "
        "negative rates. Hysteresis: largest rising less falling, of which noise alone makes some; loop: the same at "
        "rate 0 by all rates, with its u; p of loop is the probability that noise makes it. "
        "Repeatability: standard deviation of the scale factor over runs, and that which noise makes.",
        {
            "gyro": str,
            "nonlinearity": size("nonlinearity"),
            "95 % by noise": lambda a: number_text(fits[a].by_noise, _PPM),
            "p of noise": lambda a: probability_fact(fits[a].probability),
            "order": lambda a: _order_and_residual(record, fits[a], a)[0],
            "powers leave": lambda a: _order_and_residual(record, fits[a], a)[1],
            "asymmetry": size("asymmetry"),
            "hysteresis": size("hysteresis"),
            "loop": lambda a: _loop_texts(record, fits[a], a)[0],
            "u": lambda a: _loop_texts(record, fits[a], a)[1],
            "p of loop": lambda a: "–" if (loop := fits[a].loop) is None else probability_fact(loop),
            "repeatability": lambda a: number_text(fits[a].repeatability, _PPM),
            "by noise": lambda a: number_text(fits[a].repeatability_by_noise, _PPM),
        },
        rate_record.model.axes,
    )


def _loop_texts(record: Calibration, axis_fit: AxisFit, name: str) -> tuple[str, str]:
    """Return the fitted loop and its uncertainty, ppm; dashes for records from before it was fitted."""
    if "fitted_loop" not in record.fit["axes"][name] or axis_fit.fitted_loop is None:
        return "–", "–"
    return format_uncertain(axis_fit.fitted_loop * _PPM, (axis_fit.fitted_loop_uncertainty or 0.0) * _PPM)


def _order_and_residual(record: Calibration, axis_fit: AxisFit, name: str) -> tuple[str, str]:
    """Return the order of a gyroscope and the largest residual beside its powers, ppm; old records have one order."""
    if "order" not in record.fit["axes"][name]:
        return str(record.model["gyro_order"]), "–"
    return str(axis_fit.order), number_text(axis_fit.by_polynomial, _PPM)


def _budget(record: Calibration, rate_record: RateRecord) -> ReportTable:
    """Return the parts of the relative uncertainty of each scale factor, ppm: dwells, table, and both."""
    common = rate_record.fit.table_uncertainty or 0.0

    def parts(axis: str) -> tuple[float, float, float]:
        scale = record.parameter(f"gyro_scale_factor_{axis}")
        whole = (scale.standard_uncertainty or 0.0) / abs(scale.value)
        return math.sqrt(max(whole**2 - common**2, 0.0)), common, whole

    earlier = ", of the earlier record too" if "prior" in record.fit else ""
    return table(
        "What the uncertainty of a scale factor is made of, ppm",
        f"Dwells: noise, errors of single rates, and what scatters beyond them{earlier}; more dwells make it smaller. "
        "Table: what all rates have in common, which no number of dwells makes smaller.",
        {
            "parameter": lambda a: f"gyro_scale_factor_{a}",
            "dwells": lambda a: number_text(parts(a)[0], _PPM),
            "table": lambda a: number_text(parts(a)[1], _PPM),
            "all": lambda a: number_text(parts(a)[2], _PPM),
        },
        rate_record.model.axes,
    )


def _sweep_table(sweeps: Sequence[SweptRun]) -> ReportTable:
    """Return the table of the sweeps of a record: delay, ms, and bandwidth, Hz."""
    rows = []
    for sweep in sweeps:
        delay, u = format_uncertain(1e3 * sweep.delay, 1e3 * sweep.delay_uncertainty)
        width, u_width = "–", "–"
        if sweep.bandwidth is not None:
            width, u_width = format_uncertain(sweep.bandwidth, sweep.bandwidth_uncertainty)
        elif sweep.bandwidth_beyond is not None:
            width = f"> {plain_number(sweep.bandwidth_beyond, 2)}"
        rows.append([sweep.file, sweep.axis, number_text(sweep.frequency, digits=4), delay, u, width, u_width])
    return ReportTable(
        "Sweeps",
        "Delay of the gyroscope behind the table, and the frequency where a first-order lag with the same fall of "
        "amplitude is at -3 dB. Of one sine, whose frequency is given, the scale factor is the amplitude there.",
        ["file", "gyro", "sine, Hz", "delay, ms", "u", "bandwidth, Hz", "u"],
        rows,
    )


# An earlier record beside the test.


def _prior_table(prior: RatePrior, record: Calibration) -> ReportTable:
    """Return each parameter by the prior, by the test without it, and by the fit of both together."""
    rows = []
    for name, parameter in prior.parameters.items():
        read = reading_unit(parameter.test.unit, name)
        estimates = (parameter.prior, parameter.test, record.parameter(name))
        rows.append([name, *(" ± ".join(read.texts(p.value, p.standard_uncertainty)) for p in estimates), read.symbol])
    chance = (
        "" if prior.probability is None else f" Probability of such differences: {probability_fact(prior.probability)}."
    )
    return ReportTable(
        "The earlier record and this test",
        "Each alone, and both as one fit, the result, ± standard uncertainties. What all rates of one table, or "
        f"one clock, have in common does not fall with a second test.{chance}",
        ["parameter", "earlier", "this test", "both", "unit"],
        rows,
    )


# Whole turns by hand.


def _turns_exhibits(record: Calibration) -> Exhibits:
    """Return the figures and tables of a record of turns."""
    section = turns_of(record)
    turns, fit = section.data.turns, section.fit
    worst = max(
        (p.standard_uncertainty or 0.0) / abs(p.value) for n, p in record.parameters.items() if "scale_factor" in n
    )
    fence = f"{plain_number(from_si(fit.fence.value, 'deg'), 2)} deg"
    items: list[Figure | ReportTable] = [
        parameters_table(rows(record), "Per clock where no uncertainty of it was stated."),
        *([] if fit.prior is None else [_prior_table(fit.prior, record)]),
        _turns_table(turns),
    ]
    if len(turns.axis) > len(set(turns.axis)):  # a single turn about each axis has no residual
        items.append(_turns_figure(turns))
    return Exhibits(
        f"{fit.turns} turns against a fence of {fence}: scale factors are known to {number_text(worst, _PPM)} ppm or "
        "better.",
        [("turns", str(fit.turns)), ("fence", fence)],
        items,
    )


def _turns_table(turns: WholeTurns) -> ReportTable:
    """Return count, angle and residual of each turn."""
    columns: dict[str, Callable[[int], str]] = {
        "gyro": lambda k: turns.axis[k],
        "from, s": lambda k: f"{turns.start[k]:.1f}",
        "to, s": lambda k: f"{turns.stop[k]:.1f}",
        "turns": lambda k: f"{turns.count[k]:+.0f}",
        "angle, deg": lambda k: f"{from_si(turns.angle[k], 'deg'):.2f}",
        "residual, deg": lambda k: f"{from_si(turns.residual[k], 'deg'):+.3f}",
        "u, deg": lambda k: text_in(turns.standard_uncertainty[k], "deg", 2),
    }
    reading = "Stated angle of each, and what is left of it by the scale factor of these turns."
    return table("Turns", reading, columns, range(len(turns.axis)))


def _turns_figure(turns: WholeTurns) -> Figure:
    """Return the residual of each turn, in order, by gyroscope."""
    axis = np.array(turns.axis)
    return points(
        "What is left of each turn",
        "By the scale factor of these turns. Bars: one standard uncertainty, of both stops and of the zero.",
        (figure_axis("turn", dtick=1), np.arange(1, len(axis) + 1)),
        ("residual, deg", np.degrees(turns.residual)),
        np.degrees(turns.standard_uncertainty),
        [Group(f"gyro_{name}", axis == name, symbol, colour) for name, symbol, colour in _TURN_LOOKS],
    )
