"""The figures and tables of a noise record, made from the record alone."""

from __future__ import annotations

from typing import Any

import numpy as np

from imulab.estimation.distributions import probability_fact, probability_text
from imulab.estimation.noise.analysis import PER_PARAMETER
from imulab.estimation.noise.terms import LINEAR, allan_terms, at_band_edge, terms
from imulab.procedures.noise import rejected
from imulab.procedures.noise.schema import (
    BinnedSpectrum,
    Column,
    NoiseSummary,
    drawn_of,
    fit_of,
    label,
    split,
    term_reading,
)
from imulab.records.calibration import Calibration
from imulab.report import traces as panels
from imulab.report.noise_figures import rates_of
from imulab.report.parameters import reading_unit, small_unit
from imulab.report.traces import (
    BAD,
    GOOD,
    INK,
    LEGEND,
    MARGIN,
    QUIET,
    Exhibits,
    Figure,
    ReportTable,
    band,
    log_axis,
    plain_number,
    rounded,
    scatter,
)

_DIGITS = 5  # of the numbers in a drawing
_PARTS = ("white", "1/f", "walk", "quantisation", "Gauss-Markov", "second Gauss-Markov")
_COLOURS = (BAD, "#8e6bbd", "#c99a2e", QUIET, "#4f9d69", "#4f9d69")
_MOST_CURVES = 12  # most columns with their own figure
_SEEN = 0.03
"""A part is drawn where it makes at least this share of the deviation."""
_NAMES = {"rad/s": "gyroscopes", "m/s^2": "accelerometers"}


def exhibits(record: Calibration) -> Exhibits:
    """Return what a report on this record shows."""
    fit = fit_of(record)
    names = list(fit.columns)
    items: list[Figure | ReportTable] = [_terms(record), _for_filters(record, fit), _models(fit)]
    items += [_curve(record, fit, name) for name in names[:_MOST_CURVES]]
    pages = panels.pages(names)
    items += [_ratios(record, fit, page, k, len(pages)) for k, page in enumerate(pages)]
    units = dict.fromkeys(column.unit for column in fit.columns.values())
    facts = [("length", f"{fit.length.value:.4g} s"), ("sampling rate", _rates(fit))]
    for unit in units:
        facts += _largest(fit, unit)
    return Exhibits(_headline(record, fit), facts, items)


def _largest(fit: NoiseSummary, unit: str) -> list[tuple[str, str]]:
    """Return the facts about the columns with a unit: the largest numbers that a filter needs."""
    its = [name for name, column in fit.columns.items() if column.unit == unit]
    white = max(fit.filter_white[name].value for name in its)
    walk = max(fit.filter_walk[name].value for name in its)
    kind = _NAMES.get(unit, unit)
    h = fit.horizon.value
    texts = []
    for value, size in ((white, f"{unit}/sqrt(Hz)"), (walk, f"{unit}/sqrt(s)")):
        symbol, factor = reading_unit(size).scale
        texts.append(f"{plain_number(value * factor, 3)} {symbol}")
    return [(f"{kind}, white for filters", texts[0]), (f"{kind}, walk for filters, {h:g} s", texts[1])]


def _rates(fit: NoiseSummary) -> str:
    rates = {name: 1 / column.interval.value for name, column in fit.columns.items()}
    return rates_of(rates if max(rates.values()) > 1.01 * min(rates.values()) else {"": fit.sample_rate.value})


def _headline(record: Calibration, fit: NoiseSummary) -> str:
    parts = []
    for unit in dict.fromkeys(column.unit for column in fit.columns.values()):
        name, factor = term_reading("white", unit).scale
        sizes = [record.value(f"{each}_white") * factor for each, column in fit.columns.items() if column.unit == unit]
        low, high = plain_number(min(sizes), 3), plain_number(max(sizes), 3)
        parts.append(f"{label('white', unit)} {low if low == high else f'{low} to {high}'} {name}")
    poor = [name for name, p in fit.test.items() if rejected(p, len(fit.test))]
    end = f"; the model does not fit {' '.join(poor)}" if poor else ""
    logs = f"{fit.logs} logs" if fit.logs > 1 else "a log"
    return f"At rest for {fit.length.value:.4g} s in {logs}: {'; '.join(parts)}{end}."


def _terms(record: Calibration) -> ReportTable:
    rows = []
    units = {name: column.unit for name, column in fit_of(record).columns.items()}
    for name, p in record.parameters.items():
        column, term = split(name)
        unit, factor = reading_unit(p.unit, name).scale
        ends = p.interval_95 or (p.value, p.value)
        if p.value == 0 and term != "ramp":
            value, interval = "not seen", f"below {plain_number(ends[1] * factor, 2)}"
        else:
            value, interval = _between(p.value * factor, ends[0] * factor, ends[1] * factor)
        rows.append([column, label(term, units.get(column, "")), value, interval, unit])
    return ReportTable(
        "Noise terms",
        "Value and 95 % interval, from the profile of the likelihood. Angle (velocity) random walk: the white noise of "
        "the rate (specific force). 1/f noise: the level below which no averaging helps. Rate (acceleration) random "
        "walk: how the zero wanders. Gauss-Markov noise: its standard deviation, and the time over which it is "
        "correlated. Not seen: the record is as well described without, and larger than the limit it is not.",
        ["column", "term", "value", "95 % interval", "unit"],
        rows,
    )


def _between(value: float, low: float, high: float) -> tuple[str, str]:
    """Return a value and its interval with as many digits as the interval justifies."""
    width = max(high - low, 1e-12 * abs(value), 1e-300)
    places = max(0, 1 - int(np.floor(np.log10(width))))
    return f"{value:.{places}f}", f"{low:.{places}f} to {high:.{places}f}"


def _for_filters(record: Calibration, fit: NoiseSummary) -> ReportTable:
    rows = []
    times = fit.bias_uncertainty[next(iter(fit.columns))].time.value
    for name, column in fit.columns.items():
        unit, factor = small_unit(column.unit).scale
        bias = fit.bias_uncertainty[name]
        means = dict(zip(bias.time.value, bias.standard_uncertainty.value, strict=False))
        white, walk = fit.filter_white[name], fit.filter_walk[name]
        most = walk.interval_95[1]
        # Models without slow noise may have all the weight; what the log leaves room for is the limit of K.
        if not most and (slow := record.parameters.get(f"{name}_walk")) is not None:
            most = slow.unseen_limit or 0.0
        rows.append(
            [
                name,
                f"{white.value:.3g}",
                f"{column.unit}/sqrt(Hz)",
                f"{walk.value:.2g}" if walk.value else f"< {most:.2g}" if most else "not seen",
                f"{walk.interval_95[0]:.2g} to {most:.2g}" if most else "–",
                f"{column.unit}/sqrt(s)",
                *(plain_number(means[t] * factor, 2) if t in means else "–" for t in times),
                unit,
            ]
        )
    return ReportTable(
        "For filters, and means at rest",
        f"A filter knows white noise and a random walk alone. N_h and K_h are such that over "
        f"{fit.horizon.value:g} s without aiding it predicts what the fitted noise does, in SI as programs take them; "
        "the 95 % interval is that of K_h. Then the standard uncertainty of a mean over so many seconds at rest as a "
        "measure of the bias. Vibration is not in a log at rest.",
        ["column", "N_h", "unit", "K_h", "95 % of K_h", "unit", *(f"u, {t:.3g} s" for t in times), "unit of u"],
        rows,
    )


def _models(fit: NoiseSummary) -> ReportTable:
    rows = []
    for name, column in fit.columns.items():
        price = {each.model: each.deviance + PER_PARAMETER * int(terms(each.model).sum()) for each in column.candidates}
        weight = {each.model: each.weight for each in column.candidates}
        others = sorted(price.keys() - {column.chosen}, key=price.__getitem__)
        heavy = max(weight, key=weight.__getitem__)
        rows.append(
            [
                name,
                column.chosen,
                f"{others[0]} +{max(price[others[0]] - price[column.chosen], 0.0):.1f}" if others else "–",
                ", ".join(f"{each} {weight[each]:.0%}" for each in dict.fromkeys([column.chosen, heavy])),
                probability_fact(column.test.probability) if column.test.degrees_of_freedom else "–",
                f"{fit.band[name].value:.4g}",
                f"{100 * column.ripple:.2g}",
                str(column.spikes),
                str(len(column.lines)),
                str(len(column.steps)),
            ]
        )
    return ReportTable(
        "Models",
        "Chosen terms, N white, B 1/f, K walk, G Gauss-Markov, Q quantisation (a G of the shortest time that the "
        "band tells is a filter or vibration, and counts as white noise): those of the least deviance plus "
        f"{PER_PARAMETER:g} for each parameter, so that no term is named without need; next, and by how much its sum "
        "is larger: within 4 the log hardly tells the two apart. The weight in all averages, such as what filters "
        "get, counts a parameter as 2, so that no term is lost that may be there: the model of the largest weight "
        "may be another one. Then the probability of the test of fit (of a good model below 0.01 in one record of a "
        "hundred); the highest frequency used; by how much bins are off the model; what was taken for no noise.",
        ["column", "chosen", "next", "weights", "p of fit", "up to, Hz", "ripple, %", "spikes", "lines", "steps"],
        rows,
    )


def _curve(record: Calibration, fit: NoiseSummary, name: str) -> Figure:
    column, allan = fit.columns[name], drawn_of(record, name).allan
    unit, factor = small_unit(column.unit).scale
    tau, measured, fitted, low, high = (
        np.array(each) for each in (allan.tau, allan.measured, allan.fitted, allan.low, allan.high)
    )
    parts = _parts(column, tau)
    floor = 0.5 * factor * min(float(fitted.min()), float(measured[measured > 0].min(initial=np.inf)))
    traces: list[dict[str, Any]] = [band(tau, factor * low, factor * high, GOOD, _DIGITS, name="95 % band")]
    for k, title in enumerate(_PARTS):
        part = factor * parts[k]
        if (parts[k] > _SEEN * fitted).any() and np.count_nonzero(parts.any(axis=1)) > 1:
            visible = np.where(part > floor, part, np.nan)
            style = {"color": _COLOURS[k], "width": 1.2, "dash": "dash" if k % 2 else "dot"}
            traces.append(scatter(rounded(tau, _DIGITS), rounded(visible, _DIGITS), "lines", name=title, line=style))
    shown = measured > 0
    traces += [
        scatter(rounded(tau, _DIGITS), rounded(factor * fitted, _DIGITS), "lines", name=f"fitted, {column.chosen}",
                line={"color": GOOD, "width": 2}),
        scatter(rounded(tau[shown], _DIGITS), rounded(factor * measured[shown], _DIGITS), "markers", name="the record",
                marker={"color": INK, "size": 7, "symbol": "circle-open"},
                hovertemplate=f"%{{x:.3g}} s: %{{y:.3g}} {unit}<extra></extra>"),
    ]  # fmt: skip
    at = int(np.argmin(fitted))
    p = column.test.probability
    return Figure(
        title=f"Allan deviation, {name}",
        message=f"The fitted deviation is least, {plain_number(float(factor * fitted[at]), 2)} {unit}, at "
        f"{plain_number(float(tau[at]), 2)} s; "
        + (f"the model does not fit ({probability_text(p)})." if rejected(p, len(fit.test)) else "the model fits."),
        caption="Deviation between neighbouring means over the averaging time. Circles: the record without its lines. "
        "Line: the chosen model, N white, B 1/f, K walk, G Gauss-Markov, Q quantisation; dashed and dotted: its parts. "
        "Shaded: the 95 % band of all models that the record "
        "allows, each by its weight. The last circles are of few means.",
        traces=traces,
        layout={
            "xaxis": log_axis("averaging time, s"),
            "yaxis": log_axis(f"Allan deviation, {unit}", automargin=True),
            "legend": LEGEND,
            "margin": MARGIN,
        },
        height=430,
    )


def _parts(column: Column, tau: np.ndarray) -> np.ndarray:
    """Return the Allan deviation of each part of the chosen model; edge of the band as white noise."""
    values = np.array(column.values)
    squares = allan_terms(values, tau, column.interval.value)
    for k in np.flatnonzero(at_band_edge(values, column.shortest_time.value)):
        squares[0] += squares[LINEAR + k]
        squares[LINEAR + k] = 0.0
    return np.asarray(np.sqrt(squares))


def _ratios(record: Calibration, fit: NoiseSummary, names: Any, page: int, pages: int) -> Figure:
    """Return the figure of the spectrum over the model, by octaves."""
    layout = panels.grid()
    traces: list[dict[str, Any]] = []
    worst = (0.0, "", 0.0)
    for index, name in enumerate(names):
        f, ratio, u = octaves(drawn_of(record, name).spectra)
        x, y = panels.names(index)
        used = f <= fit.band[name].value
        for inside, colour in ((used, GOOD), (~used, QUIET)):
            traces.append(
                scatter(rounded(f[inside], _DIGITS), rounded(ratio[inside], _DIGITS), "markers", xaxis=x, yaxis=y,
                        marker={"color": colour, "size": 6}, hovertemplate="%{x:.3g} Hz: %{y:.3g}<extra></extra>",
                        error_y={"type": "data", "array": rounded(2 * u[inside], _DIGITS), "color": colour, "width": 0})
            )  # fmt: skip
        panels.panel(layout, index, len(names), name, "record / model")
        title = {"text": "frequency, Hz", "font": {"size": 11}, "standoff": 4}
        apart = 2 if f.max() > 1e4 * f.min() else 1  # decades from tick to tick: a printed panel is narrow
        layout[panels.axis_key(x)] |= {"type": "log", "dtick": apart, "tickangle": 0, "title": title}
        top = max(1.6, min(2.9, 1.1 * float((ratio + 2 * u)[used].max(initial=1.5))))
        layout[panels.axis_key(y)]["range"] = [0.0, top]
        off = np.abs(np.log(np.maximum(ratio, 1e-9)))[used] / np.maximum(u[used], 1e-9)
        if off.size and off.max() > worst[0]:
            worst = (float(off.max()), name, float(f[used][np.argmax(off)]))
    return Figure(
        title=panels.paged("Spectrum over model, by octaves", page, pages),
        message=f"The farthest off is {name_at(worst)}."
        if worst[0] > 3
        else "No octave is farther off than three standard deviations.",
        caption="Mean of the record's power over that of the chosen model, with two standard deviations; 1 where the "
        "model holds. Grey: beyond the band that was used.",
        traces=traces,
        layout=layout,
        height=panels.height(len(names)),
    )


def name_at(worst: tuple[float, str, float]) -> str:
    """Return the octave that is farthest off, in words."""
    return f"{worst[1]} at {worst[2]:.3g} Hz, by {worst[0]:.1f} standard deviations"


def octaves(spectra: list[BinnedSpectrum]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return frequency, Hz, power over model and its standard uncertainty of each octave, shapes (o,)."""
    frequency, ratio, count = (np.concatenate(each) for each in zip(*map(_bins, spectra), strict=True))
    octave = np.floor(np.log2(frequency / frequency.min()) + 1e-9).astype(int)
    total = np.bincount(octave, count)
    kept = total > 0
    mean = np.bincount(octave, count * ratio)[kept] / total[kept]
    centre = np.exp(np.bincount(octave, count * np.log(frequency))[kept] / total[kept])
    return centre, mean, np.sqrt(2 / total[kept])


def _bins(spectrum: BinnedSpectrum) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    first, last, power, freedom, variance = (
        np.array(each, dtype=np.float64)
        for each in (spectrum.first, spectrum.last, spectrum.power, spectrum.freedom, spectrum.variance)
    )
    return (first + last) / (4 * spectrum.count * spectrum.interval), power / variance, freedom
