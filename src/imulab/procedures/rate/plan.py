"""How long a rate table must stay at each rate, or how many turns by hand are needed, and the resulting uncertainties.

The mean of a dwell of length T has the variance ``N^2 / T + (0.664 B)^2``, N the angle random walk and B the bias
instability (IEEE Std 952). The predicted uncertainties are those of the fit, `solve`, at dwells of that variance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from imulab.errors import ObservabilityError, OptionError, RecordError, listed
from imulab.files import write_text
from imulab.gravity import EARTH, checked_latitude
from imulab.options import measure, parsed, text
from imulab.procedures.rate import FENCE, MOUNTINGS, ORDERS, RATES, parse_fraction, parse_rates
from imulab.procedures.rate.schema import RateTest, Run, manifest_text
from imulab.procedures.rate.solve import RateProblem, model_parameters, solve
from imulab.procedures.result import PlannedTest, Record, amount, as_record
from imulab.quantities import RANDOM_WALK, fraction, in_si, of_units, whole, whole_number
from imulab.recording import Array
from imulab.report.parameters import ReadingUnit, reading_unit, text_in
from imulab.report.plots import Plot
from imulab.report.traces import BAD, GOOD, LEGEND, Figure, figure_axis, log_axis, plain_number, scatter
from imulab.units import from_si

# Turns by hand against a fence.


_TURNS = 1000  # on and back that a plan asks for at most


@dataclass(frozen=True, repr=False)
class TurnPlan(PlannedTest):
    """How many whole turns by hand reach a wanted uncertainty: n on and n back, with a stop after each.

    Attributes
    ----------
    turns
        Turns on, and as many back.
    wanted
        Wanted relative standard uncertainty of the scale factor.
    reached
        Relative standard uncertainty for 1 to n turns on and as many back, shape (n,).
    """

    turns: int
    wanted: float
    reached: Array

    @property
    def stops(self) -> int:
        """Rests at the fence, the first included."""
        return 2 * self.turns + 1

    def shown(self) -> tuple[str, list[str], list[list[str]]]:
        """Return how many turns it takes, and what fewer would give."""
        rows = [[str(n), str(2 * n + 1), f"{1e6 * u:.3g}"] for n, u in enumerate(self.reached.tolist(), 1)]
        head = (
            f"{self.turns} turn{'s' * (self.turns > 1)} on and {self.turns} back about each axis, {self.stops} stops, "
            f"reach {1e6 * self.reached[-1]:.3g} ppm; wanted {1e6 * self.wanted:.6g} ppm"
        )
        return head, ["turns each way", "stops", "u of the scale factor, ppm"], rows

    def content(self) -> dict[str, Any]:
        """Return the plan for scripts."""
        reached = [{"turns": n, "relative_uncertainty": u} for n, u in enumerate(self.reached.tolist(), 1)]
        return {"turns": self.turns, "stops": self.stops, "wanted": self.wanted, "reached": reached}

    def save(self, path: str | Path) -> None:
        """Refuse: turns by hand need no file.

        Raises
        ------
        OptionError
            Always.
        """
        raise OptionError(f"{path}: turns by hand have no manifest; expected --turn without -o")

    def plot(self) -> Plot:
        """Return the uncertainty over the number of turns, beside the wanted one."""
        number = list(range(1, self.turns + 1))
        figure = _plan_figure(
            "Turns by hand",
            "u(S)/S: relative standard uncertainty of the scale factor.",
            (figure_axis("turns each way", dtick=max(1, round(self.turns / 20))), number),
            "u(S)/S, ppm",
            {"reached": (1e6 * self.reached).tolist(), "wanted": [1e6 * self.wanted] * self.turns},
            f"{self.shown()[0]}.",
        )
        return Plot(figure, "Plan of turns")


def _plan_figure(
    title: str,
    caption: str,
    x: tuple[dict[str, Any], list[Any]],
    y_title: str,
    curves: dict[str, list[float]],
    message: str,
) -> Figure:
    """Return the predicted curve and the wanted one, dashed, over `x`, an axis and its values."""
    lines = ({"color": GOOD, "width": 2}, {"color": BAD, "width": 1.5, "dash": "dash"})
    traces = [
        scatter(x[1], values, mode, name=name, line=line)
        for (name, values), mode, line in zip(curves.items(), ("lines+markers", "lines"), lines, strict=True)
    ]
    layout = {"xaxis": x[0], "yaxis": log_axis(y_title), "legend": LEGEND}
    return Figure(title, caption, traces, layout, message=message)


def plan_turns(wanted: float, fence: float) -> TurnPlan:
    """Return the plan of turns by hand: ``u = fence / sqrt(2) / (2 pi sqrt(sum (j_k - mean j)^2))``."""
    if not 0 < fence < 1:
        raise OptionError(f"fence {fence:g}: expected the uncertainty of the difference of two stops, such as 0.5 deg")
    reached: list[float] = []
    for n in range(1, _TURNS + 1):
        made = np.concatenate([np.arange(n + 1), np.arange(n)])  # turns made at each stop, on and back
        reached.append(fence / math.sqrt(2) / (2 * math.pi * float(np.sqrt(np.sum((made - made.mean()) ** 2)))))
        if reached[-1] <= wanted:
            return TurnPlan(n, wanted, np.array(reached))
    raise OptionError(
        f"turn {1e6 * wanted:.3g} ppm: {_TURNS} turns on and back reach {1e6 * reached[-1]:.3g} ppm; expected a rate "
        "table (rate fit) for that"
    )


# A rate table.


_OF = ("full", "reading")
_FLOOR = 0.664
"""Allan deviation of flicker noise over B (IEEE Std 952)."""
_LEAST, _SETTLING = 5.0, 0.6
"""Shortest dwell, and the part of a dwell that `find_dwells` leaves out at its ends, s."""
_LONGEST, _LONGEST_TURN = 600.0, 60.0  # s of a dwell, and of a whole turn, that a plan asks for


@dataclass(frozen=True)
class PlannedRate:
    """The stay at one rate.

    Attributes
    ----------
    rate
        Rate, rad/s.
    duration
        Duration of each stay, the settling at its ends included, s.
    uncertainty, wanted
        Predicted and wanted standard uncertainty of the mean of a stay, rad/s.
    """

    rate: float
    duration: float
    uncertainty: float
    wanted: float

    @property
    def turns(self) -> float:
        """Turns of the table in a stay, without the settling at its ends."""
        return self.rate * (self.duration - _SETTLING) / (2 * math.pi)


@dataclass(frozen=True, repr=False)
class RatePlan(PlannedTest):
    """A planned rate test.

    Attributes
    ----------
    test
        Its manifest.
    rates
        The stays, by size of rate, ascending.
    duration
        Duration of one run without the time between rates, s.
    predicted
        Standard uncertainty of each parameter, SI, under the names of the record.
    warnings
        Wanted uncertainties that are out of reach, with what to do.
    """

    test: RateTest
    rates: tuple[PlannedRate, ...]
    duration: float
    predicted: dict[str, float]
    warnings: tuple[str, ...]

    def shown(self) -> tuple[str, list[str], list[list[str]]]:
        """Return the duration and the predicted uncertainties in a sentence, and the stay at each rate as a table."""
        largest = self.rates[-1].rate
        rows = [
            [
                text_in(each.rate, "deg/s", 6),
                f"{each.duration:.1f}",
                f"{each.turns:.1f}",
                f"{1e6 * each.uncertainty / largest:.3g}",
                f"{1e6 * each.wanted / largest:.3g}",
            ]
            for each in self.rates
        ]
        total = len(self.test.runs) * self.duration
        head = (
            f"{len(self.test.runs)} runs of {self.duration / 60:.1f} min, {total / 3600:.1f} h at the table's rates; "
            f"predicted standard uncertainties at most: {self._predicted_text()}"
        )
        return head, ["rate, deg/s", "stay, s", "turns", "u, ppm of full", "wanted"], rows

    def _predicted_text(self) -> str:
        """Return the largest predicted uncertainty of each kind of parameter, and what the plan does not know."""
        kinds = (
            ("gyro_scale_factor", "scale factors", ReadingUnit("ppm", 1e6)),
            ("gyro_misalignment", "misalignments", reading_unit("rad")),
            ("gyro_bias", "biases", reading_unit("rad/s")),
        )
        phrases = []
        for stem, label, read in kinds:
            most = max((u for name, u in self.predicted.items() if name.startswith(stem)), default=None)
            if most is not None:
                phrases.append(f"{label} {plain_number(most * read.factor, 2)} {read.symbol}")
        table = "what all rates of the table have in common (--table-uncertainty)"
        beside = [table] if self.test.relative_uncertainty is None else []
        beside += ["the mounting, in every misalignment"] * any("misalignment" in name for name in self.predicted)
        return ", ".join(phrases) + (f"; on top come {' and '.join(beside)}" if beside else "")

    def content(self) -> dict[str, Any]:
        """Return the plan for scripts, in SI."""
        units = {"rate": "rad/s", "duration": "s", "uncertainty": "rad/s", "wanted": "rad/s"}
        return {
            "runs": len(self.test.runs),
            "duration": amount(self.duration, "s"),
            "rates": [{name: amount(getattr(rate, name), unit) for name, unit in units.items()} for rate in self.rates],
            "predicted": self.predicted,
            "warnings": list(self.warnings),
        }

    def findings(self) -> tuple[str, ...]:
        """Return what is out of reach, with what to do."""
        return self.warnings

    def save(self, path: str | Path) -> None:
        """Write the list of stays, run by run, where the name ends in .csv, else the manifest.

        Raises
        ------
        OptionError
            The file cannot be written.
        """
        stay = {each.rate: each.duration for each in self.rates}
        if not str(path).lower().endswith(".csv"):
            stays = ", ".join(f"{text_in(rate, 'deg/s', 6)}: {time:.1f} s" for rate, time in stay.items())
            comments = [
                f"Stay at each rate, deg/s, either way round: {stays}.",
                f"Predicted: {self._predicted_text()}.",
            ]
            write_text(path, manifest_text(self.test, comments, to_fill_in=True))
            return
        lines = ["run,file,mounting,rate [deg/s],stay [s]"]
        for number, run in enumerate(self.test.runs, 1):
            lines += [
                f"{number},{run.file},{run.mounting},{text_in(rate, 'deg/s', 9)},{stay[abs(rate)]:.1f}"
                for rate in run.rates or ()
            ]
        write_text(path, "\n".join(lines) + "\n")

    def plot(self) -> Plot:
        """Return the uncertainty of one stay at each rate, beside the wanted one."""
        largest = self.rates[-1].rate
        figure = _plan_figure(
            "What each stay will give",
            "u: standard uncertainty of the mean of one stay; full scale is the largest rate.",
            (figure_axis("rate, deg/s"), [from_si(each.rate, "deg/s") for each in self.rates]),
            "u, ppm of full scale",
            {
                "predicted": [1e6 * each.uncertainty / largest for each in self.rates],
                "wanted": [1e6 * each.wanted / largest for each in self.rates],
            },
            f"{self.shown()[0]}.",
        )
        return Plot(figure, "Rate plan")


def plan_rate(
    rates: Annotated[Sequence[float] | str, text("R,R,...", unit="deg/s")] = RATES,
    *,
    arw: Annotated[float | str | None, text("N", unit="deg/sqrt(h)")] = None,
    bias_instability: Annotated[float | str | None, measure("rate", "deg/h", "B")] = None,
    noise: Record | None = None,
    uncertainty: Annotated[float | str, text("FRACTION")] = "20 ppm",
    of: Annotated[str, text("full|reading", ("full", "reading"))] = "full",
    faces: Annotated[str, text("A,A,...")] = "+x,+y,+z",
    cycles: int | str = 3,
    order: Annotated[int | str, parsed(whole_number, "N")] = "1",
    latitude: Annotated[float | str | None, measure("angle", "deg")] = None,
    table_uncertainty: Annotated[float | str | None, text("FRACTION")] = None,
    turn: Annotated[float | str | None, text("FRACTION")] = None,
    fence: Annotated[float | str, measure("angle", "deg")] = FENCE,
) -> RatePlan | TurnPlan:
    """Plan a test on a rate table: how long to stay at each rate, and what the test will then give.

    ``T = N^2 / (u^2 - (0.664 B)^2)``, 5 s or more and whole turns; u is the standard uncertainty of the mean of a stay.

    Parameters
    ----------
    rates
        Sizes of the rates. In rad/s, or deg/s in a text; each is visited up and down, either way round.
    arw
        Angle random walk. N of the worst gyroscope, rad/sqrt(s).
    bias_instability
        Bias instability. B of the worst gyroscope, rad/s.
    noise
        Both, from a record of noise fit. Or its file.
    uncertainty
        Wanted of the mean of a stay, a fraction.
    of
        Fraction of what: the largest rate (full) or each (reading).
    faces
        Body axes up along the table axis, one after the other.
    cycles
        Runs of each face; 5 for repeatability. Of scale factors.
    order
        Highest power of the rate that the fit is to have. 1 to 5.
    latitude
        Latitude of the place, for the manifest. In rad.
    table_uncertainty
        Standard uncertainty that all rates have in common, such as 20ppm. A fraction, for the manifest and for what is
        predicted.
    turn
        Turns by hand in place of a table, such as 0.02%. The wanted relative standard uncertainty of scale factors by
        whole turns.
    fence
        Of those turns: uncertainty of the difference of two stops. Standard uncertainty, rad.

    Raises
    ------
    OptionError
        An option cannot be used; the message says which.
    RecordError
        The record holds no noise of gyroscopes.
    ObservabilityError
        There are too few rates for the order.

    Source: IEEE Std 952 (noise of a mean); GUM (JCGM 100:2008).

    Examples
    --------
    >>> import imulab as il
    >>> il.plan_rate("0,100,300", arw="0.3 deg/sqrt(h)", uncertainty="10 ppm").save("plan.toml")
    >>> il.plan_rate(turn="0.02 %").turns
    5
    """
    if turn is not None:
        return plan_turns(fraction(turn, "turn"), in_si(fence, "fence", "angle", "deg"))
    listed_rates = np.asarray(parse_rates(rates, "rates") if isinstance(rates, str) else rates, dtype=np.float64)
    sizes = np.unique(np.abs(listed_rates))
    if sizes.size < 2:
        raise OptionError(f"rates {rates!r}: expected two sizes of rates or more")
    words, count = faces.split(","), whole(cycles, "cycles")
    if not words or not set(words) <= {*MOUNTINGS}:
        raise OptionError(f"faces {faces!r}: expected body axes such as +x,+y,+z")
    if not 1 <= count <= 100:
        raise OptionError(f"cycles {count}: expected 1 to 100")
    if str(order) not in ORDERS[1:]:
        raise OptionError(f"order {order!r}: expected one of {listed(ORDERS[1:], str(order))}")
    if of not in _OF:
        raise OptionError(f"of {of!r}: expected one of {listed(_OF, of)}")
    wanted = fraction(uncertainty, "uncertainty")
    if not 0 < wanted < 1:
        raise OptionError(f"uncertainty {wanted:g}: expected more than 0 and less than 1, such as 20 ppm")
    walk, floor = _read_noise(arw, bias_instability, noise)
    planned = tuple(_plan_stay(float(rate), sizes, wanted, of, walk, floor) for rate in sizes)
    way = np.concatenate([sizes, sizes[-2::-1], -sizes[sizes > 0], -sizes[-2::-1]])
    runs = tuple(
        Run(f"{'p' if word[0] == '+' else 'n'}{word[1]}_{cycle}.csv", word, tuple((way + 0.0).tolist()))
        for word in words
        for cycle in range(1, count + 1)
    )
    common = None if table_uncertainty is None else parse_fraction(table_uncertainty, "table_uncertainty")
    place = None if latitude is None else checked_latitude(in_si(latitude, "latitude", "angle", "deg"))
    test = RateTest(runs, common, latitude=place, name="plan")
    stay = {each.rate: each.duration for each in planned}
    return RatePlan(
        test=test,
        rates=planned,
        duration=float(sum(stay[abs(rate)] for rate in way.tolist())),
        predicted=_predict(test, {each.rate: each for each in planned}, int(order)),
        warnings=tuple(_warn_out_of_reach(planned, floor, common, wanted)),
    )


def _read_noise(arw: float | str | None, instability: float | str | None, noise: Record | None) -> tuple[float, float]:
    """Return angle random walk, rad/sqrt(s), and the floor that bias instability sets to a mean, rad/s."""
    if noise is None:
        if arw is None:
            raise OptionError("arw: expected the angle random walk, such as 0.3 deg/sqrt(h), or a record of noise fit")
        walk = of_units(arw, "arw", RANDOM_WALK)
        level = 0.0 if instability is None else in_si(instability, "bias_instability", "rate", "deg/h")
    else:
        for name, value in (("arw", arw), ("bias_instability", instability)):
            if value is not None:
                raise OptionError(f"{name}: the record of noise says that already; expected one or the other")
        held = as_record(noise, "plan_rate").parameters
        columns = [name.removesuffix("_white") for name in held if name.startswith("gyro") and name.endswith("_white")]
        if not columns:
            raise RecordError("noise: the record holds no noise of gyroscopes; expected a record of noise fit")
        worst = {kind: [held[f"{c}_{kind}"].value for c in columns if f"{c}_{kind}" in held]
                 for kind in ("white", "flicker")}  # fmt: skip
        walk, level = max(worst["white"]), max(worst["flicker"], default=0.0)
    if not (0 < walk < math.inf and 0 <= level < math.inf):
        raise OptionError("arw, bias_instability: expected more than 0, and 0 or more")
    return walk, _FLOOR * level


def _plan_stay(rate: float, sizes: Array, share: float, basis: str, walk: float, floor: float) -> PlannedRate:
    """Return the stay at a rate: ``T = N^2 / (u^2 - (0.664 B)^2)``, at least 5 s and whole turns.

    `share` is the wanted uncertainty as a fraction of the largest rate, or of the rate itself with `basis` "reading".
    """
    reading = rate if rate > 0 else float(sizes[sizes > 0][0])  # no mean reaches a fraction of rate 0
    wanted = share * (float(sizes[-1]) if basis == "full" else reading)
    room = wanted**2 - floor**2
    length = min(max(_LEAST, walk**2 / room if room > 0 else _LONGEST), _LONGEST)
    turn = 2 * math.pi / rate if rate else math.inf
    if turn <= _LONGEST_TURN:
        length = math.ceil(length / turn - 1e-9) * turn
    return PlannedRate(rate, length + _SETTLING, math.hypot(walk / math.sqrt(length), floor), wanted)


def _predict(test: RateTest, planned: dict[float, PlannedRate], order: int) -> dict[str, float]:
    """Return the standard uncertainties that the fit of such a test states."""
    rows: dict[str, list[Any]] = {name: [] for name in ("run", "axis", "sign", "table", "variance", "level")}
    for number, run in enumerate(test.runs):
        for rate in run.rates or ():
            angle = rate * (planned[abs(rate)].duration - _SETTLING)
            level = (math.sin(angle) / angle, (1 - math.cos(angle)) / angle) if angle else (1.0, 0.0)
            of_dwell = (number, run.axis, run.sign, rate, planned[abs(rate)].uncertainty ** 2, level)
            for name, value in zip(rows, of_dwell, strict=True):
                rows[name].append(value)
    axis, sign, table = (np.array(rows[name]) for name in ("axis", "sign", "table"))
    sizes = len(np.unique(table))
    if sizes < order + 2:
        raise ObservabilityError(f"{sizes} different rates, expected {order + 2} or more for order {order}")
    body = sign * (table + (0.0 if test.latitude is None else EARTH * math.sin(test.latitude)))
    gyros = tuple(sorted({run.axis for run in test.runs}))
    mean = np.column_stack([np.where(axis == gyro, body, 0.0) for gyro in gyros])
    variance = np.repeat(np.array(rows["variance"])[:, None], len(gyros), axis=1)
    problem = RateProblem(
        gyros=gyros, run=np.array(rows["run"]), axis=axis, sign=sign, rate=body, table=table, mean=mean,
        variance=variance, level=np.array(rows["level"]), rate_uncertainty=test.rate_spread(table),
    )  # fmt: skip
    names, _, matrix, _, _ = model_parameters(test, problem, solve(problem, (order,) * len(gyros)), "rad/s")
    return dict(zip(names, np.sqrt(np.diag(matrix)).tolist(), strict=True))


def _warn_out_of_reach(planned: Sequence[PlannedRate], floor: float, common: float | None, wanted: float) -> list[str]:
    """Return warnings of wanted uncertainties that the plan does not reach, and why."""
    messages, largest = [], planned[-1].rate
    short = [each for each in planned if each.uncertainty > 1.001 * each.wanted]
    if short:
        at = ", ".join(text_in(each.rate, "deg/s", 6) for each in short)
        worst = max(short, key=lambda each: each.uncertainty / each.wanted)
        why = (
            f"bias instability alone makes {1e6 * floor / largest:.3g} ppm of full scale"
            if floor >= worst.wanted
            else f"it takes more than {_LONGEST / 60:.0f} min at a rate"
        )
        messages.append(
            f"out of reach at {at} deg/s: {why}; expected a larger --uncertainty, larger rates or --of full"
        )
    if common is not None and common > wanted:
        messages.append(
            f"every scale factor keeps the {1e6 * common:.3g} ppm that all rates of the table have in common, more "
            "than what is wanted; nonlinearity does not"
        )
    return messages
