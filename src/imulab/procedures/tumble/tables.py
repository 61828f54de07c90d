"""The tables of a tumble record, from the record alone."""

from __future__ import annotations

from imulab.procedures.tumble.engineering import engineering_rows, micro_g, propagated_rows, small_g
from imulab.procedures.tumble.sections import Prior, Trials, fit_of, model_of
from imulab.records.calibration import Calibration
from imulab.report.elements import ReportTable, format_uncertain, plain_number

_AGREE = 10.0
"""Per cent by which the widths of two kinds of intervals may differ before it matters."""


def _basis(record: Calibration) -> str:
    """Say what the uncertainties rest on."""
    fit = fit_of(record)
    freedom = fit.freedom
    if fit.noise != "known" and freedom is None:
        return "As many parameters as attitudes: nothing tells the noise, and no uncertainty is stated."
    if fit.noise != "known":
        return f"Noise estimated from the residuals; Student's t with {freedom:.0f} degrees of freedom."
    if not fit.excess.value or freedom is None:
        return "Noise known from the attitudes' own scatter; normal quantiles."
    return (
        f"Noise known from the attitudes' own scatter, with {small_g(fit.excess.value)} more for each "
        f"attitude, as its residual makes plausible; Student's t with {freedom:.0f} effective degrees of freedom."
    )


def parameters_table(record: Calibration) -> ReportTable:
    """Return the parameters with their uncertainties."""
    fit, model = fit_of(record), model_of(record)
    factors = {False: fit.coverage_factor_95, True: None if fit.gyro is None else fit.gyro.coverage_factor_95}
    rows = []
    for row in engineering_rows(record):
        factor = factors[row.name.startswith("gyro_")]
        value, uncertainty = row.text()
        interval = "not stated"
        if row.interval is not None and row.standard_uncertainty is not None:
            interval = " to ".join(format_uncertain(end, row.standard_uncertainty)[0] for end in row.interval)
        elif row.standard_uncertainty is not None and factor is not None:
            half = factor * row.standard_uncertainty
            interval = " to ".join(format_uncertain(row.value + s * half, row.standard_uncertainty)[0] for s in (-1, 1))
        order_known = "–" if row.given_order is None else format_uncertain(row.value, row.given_order)[1]
        given = [] if fit.blend is None else [order_known]
        rows.append([row.name, value, uncertainty, *given, interval, row.unit])
    basis = _basis(record)
    if fit.blend is not None:
        basis += (
            f" The standard uncertainty holds whatever the order is, up to {fit.blend.highest_order}; beside it what "
            f"it would be if order {model.order} were known to be right."
        )
    turned = ""
    if fit.gyro is not None:
        turned = (
            f" Gyroscopes: M = S (T ω + b + G f), Student's t with {fit.gyro.degrees_of_freedom} degrees of freedom."
        )
    if fit.mag is not None:
        turned += (
            f" Magnetometers: the law of the accelerometers with the field m for f, T with six misalignments, outputs "
            f"renamed {model.mag_axes}; Student's t."
        )
    return ReportTable(
        title="Parameters",
        caption=f"M = S (A + b), A = s + k2 s² + …, s = T f. {basis} Gauge: {model.gauge}.{turned}",
        columns=[
            "parameter",
            "value",
            "standard uncertainty",
            *([] if fit.blend is None else [f"if order {model.order} is right"]),
            "95 % interval",
            "unit",
        ],
        rows=rows,
    )


def propagated_table(record: Calibration, trials: Trials) -> ReportTable:
    """Return the intervals by propagation of distributions beside the linear ones."""
    rows = propagated_rows(record, trials)
    failed = f", {trials.failed} more did not converge" if trials.failed else ""
    return ReportTable(
        title="Monte Carlo",
        message=_agreement(rows),
        caption=f"95 % intervals of {trials.trials} trials (JCGM 101{failed}) beside the linear ones. A ratio far "
        "from 1 means that the model is not linear over its own uncertainty: trust the trials then.",
        columns=["parameter", "linear", "Monte Carlo", "ratio of widths", "unit"],
        rows=rows,
    )


def _agreement(rows: list[list[str]]) -> str:
    """Say within what the linear and the Monte Carlo intervals agree."""
    if not rows:
        return ""
    name, *_, ratio, _ = max(rows, key=lambda row: abs(float(row[3]) - 1))
    percent = 100 * abs(float(ratio) - 1)
    apart = f"{plain_number(percent, 2)} % ({name})"
    if percent <= _AGREE:
        return f"The linear and the Monte Carlo intervals agree: their widths within {apart}."
    return (
        f"The linear and the Monte Carlo intervals differ: their widths by up to {apart}. Use the "
        "Monte Carlo intervals."
    )


def shares_table(prior: Prior) -> ReportTable:
    """Return what each parameter owes to the prior."""
    rows = [[name, f"{100 * share:.0f} %", f"{100 * (1 - share):.0f} %"] for name, share in prior.shares.items()]
    return ReportTable(
        title="Prior and data",
        caption=f"Where the knowledge of each parameter comes from: the prior (a record of {prior.created}) or "
        "these attitudes; variance now over that of the prior with what it aged since.",
        columns=["parameter", "from the prior", "from the data"],
        rows=rows,
    )


def orders_table(record: Calibration) -> ReportTable:
    """Return what the choice of the order rests on."""
    fit, chosen = fit_of(record), model_of(record).order
    rows, highlight = [], None
    for index, row in enumerate(fit.orders):
        if row.order == chosen:
            highlight = index
        rows.append(
            [
                str(row.order),
                str(row.parameters),
                plain_number(micro_g(row.rms), 4),
                plain_number(micro_g(row.leave_one_out), 4) if row.leave_one_out is not None else "–",
                f"{row.f_probability:.2g}" if row.f_probability is not None else "–",
                f"{row.bic:.1f}" if row.bic is not None else "–",
                plain_number(micro_g(row.largest_uncertainty), 3) if row.largest_uncertainty is not None else "–",
                plain_number(row.condition_number, 3),
                "yes" if row.observable else f"no, rank {row.rank} of {row.parameters}",
            ]
        )
    huber = " Rms of all attitudes, a down-weighted one by its weight." if fit.loss == "huber" else ""
    return ReportTable(
        title="Choice of the order",
        caption="A higher order fits closer (rms) whether it is right or not. It is taken only if it also predicts "
        "attitudes it has not seen better (leave-one-out), by more than the error of that comparison, if the F-test "
        "finds the gain significant, and if the attitudes can observe it: nowhere on the sphere may the predicted "
        f"uncertainty of |f| exceed 4 times the scatter at order 1.{huber}",
        columns=[
            "order",
            "parameters",
            "rms, µg",
            "leave-one-out, µg",
            "F-test p",
            "BIC",
            "largest u(|f|), µg",
            "condition",
            "observable",
        ],
        rows=rows,
        highlight=highlight,
    )
