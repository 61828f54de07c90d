"""The plan of a test over temperature: its soaks and attitudes, and the predicted uncertainties.

Accelerometers (`exchange_attitudes`): an attitude adds the information of the gradient of ``|f|`` of a nominal sensor,
whose nine parameters are polynomials of the temperature. The offsets of the biases in each power cycle are unknowns of
standard deviation tau. Everything is in units of the noise of ``|f|`` in one attitude. Attitudes are exchanged one by
one (Fedorov 1972) for those that lower the mean variance of the corrected force over temperature and direction most.

Gyroscopes (`plan_gyroscopes`): the covariance of laws, g-sensitivities and offsets as `imulab.procedures.thermal.gyro`
fits them, from means at rest with the noise of the angle random walk and of the Earth's rate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.polynomial import legendre

from imulab.errors import ObservabilityError, OptionError
from imulab.options import FURTHER_TRIADS, measure, parsed, text
from imulab.procedures.result import PlannedAttitudes, amount
from imulab.procedures.thermal import APART, DEGREES, FOLLOWED, LEAST_SPAN, TURNED, parse_degrees, parse_further
from imulab.procedures.thermal.degrees import describe_degrees
from imulab.procedures.thermal.gyro import VERTICAL, attitude_columns
from imulab.procedures.thermal.model import SHARES, Laws, forces
from imulab.procedures.tumble.plan import (
    STARTS,
    Known,
    attitude_entry,
    candidates_of,
    noise_of,
    roll_pitch,
    shortest_path,
    sphere_candidates,
)
from imulab.quantities import RANDOM_WALK, in_si, of_units, temperature_list
from imulab.recording import Array, Data, Recording
from imulab.report.parameters import text_in
from imulab.report.plots import Plot
from imulab.report.traces import BAD, GOOD, LEGEND, Figure, figure_axis, rounded, scatter
from imulab.units import STANDARD_GRAVITY, from_si

# The search for temperatures and attitudes.


_PLACES = 41  # temperatures over which the uncertainty of a plan is averaged
_SWEEPS = 3  # of exchanges
_CLOSEST = np.cos(np.radians(3.0))
"""Two attitudes of a soak closer than this are one attitude."""
_RIDGE = 1e-6
"""Information that keeps the matrix regular while the attitudes of a start determine too little."""
_UNDETERMINED = 1e4  # variance of a coefficient, in that of one attitude, that a plan does not determine


def legendre_nodes(count: int) -> Array:
    """Return -1, the extrema of the Legendre polynomial of degree `count` - 1, and 1, shape (count,)."""
    polynomial = np.eye(count)[-1]
    inner = np.sort(legendre.legroots(legendre.legder(polynomial)).real)
    return np.concatenate([[-1.0], inner, [1.0]])


def order_soaks(count: int, soaks: int) -> list[int]:
    """Return the order of soaks at `count` temperatures: up through all, then back and forth with the others.

    The way back takes inner temperatures first, spread over the range, since these can be reached from either side.
    """
    order, last = list(range(min(count, soaks))), count - 1
    while len(order) < soaks:
        left = soaks - len(order)
        if left > count - 2:
            leg = list(range(1, count))
        else:
            leg = np.round(np.linspace(1, count - 2, left) if left > 1 else [(count - 1) / 2]).astype(int).tolist()
        order += [last - k if order[-1] == last else k for k in leg]
    return order


@dataclass(frozen=True)
class Design:
    """Soaks at temperatures (degC), a power cycle each; tau and the variance of an attitude in units of its noise."""

    laws: Laws
    temperatures: Array
    tau: float
    variance: float = 1.0

    @cached_property
    def carried(self) -> Array:
        """Derivatives of the nine parameters in each of K soaks by coefficients and offsets, shape (K, 9, c + 3 K)."""
        design, count = self.laws.design(self.temperatures), len(self.temperatures)
        derivatives = np.zeros((count, 9, self.laws.size + 3 * count))
        derivatives[:, :, : self.laws.size] = design
        for k in range(count):
            at = self.laws.size + 3 * k
            derivatives[k, :3, at : at + 3] = self.tau * np.eye(3)
        return derivatives

    @cached_property
    def places(self) -> Array:
        """Temperatures at which the variance counts, degC."""
        return np.linspace(self.laws.low, self.laws.high, _PLACES)

    @cached_property
    def weights(self) -> Array:
        """Mean variance of a component of the corrected force at each place, as matrices (places, c, c).

        Over all directions: that of the bias, and a third of those of scale factor and misalignment.
        """
        design = self.laws.design(self.places)
        matrices: Array = np.einsum("p,tpa,tpb->tab", SHARES, design, design)
        return matrices

    @cached_property
    def weight(self) -> Array:
        """Mean of `weights`."""
        mean: Array = self.weights.mean(axis=0)
        return mean

    def covariance(self, sets: Sequence[Array]) -> Array:
        """Return the covariance of coefficients and offsets with these attitudes, over the variance of an attitude."""
        information = np.diag(np.append(np.full(self.laws.size, _RIDGE), np.ones(3 * len(self.temperatures))))
        for by_soak, directions in zip(self.carried, sets, strict=True):
            rows = gradients(directions) @ by_soak
            information += rows.T @ rows / self.variance
        return np.asarray(np.linalg.inv(information), dtype=np.float64)

    def cost(self, covariance: Array) -> float:
        """Return the mean variance of a component of the corrected force, infinite if the laws are not determined."""
        of_laws = covariance[: self.laws.size, : self.laws.size]
        return (
            np.inf
            if np.diag(of_laws).max() > _UNDETERMINED * (1 + self.tau**2)
            else float(np.trace(self.weight @ of_laws))
        )

    def deviations(self, covariance: Array) -> Array:
        """Return the standard deviation of a component of the corrected force at each place, rms over directions."""
        of_laws = covariance[: self.laws.size, : self.laws.size]
        sd: Array = np.sqrt(np.einsum("tab,ba->t", self.weights, of_laws))
        return sd


def gradients(directions: Array) -> Array:
    """Return the derivatives of ``|f|`` / g by the nine parameters of a nominal sensor, shape (n, 9)."""
    nominal = np.tile(np.repeat([0.0, 1.0, 0.0], 3), (len(directions), 1))
    force, change = forces(nominal, directions)
    rows: Array = np.einsum("ni,nij->nj", force, change)
    return rows


def exchange_attitudes(design: Design, points: Array, counts: Sequence[int], seed: int) -> tuple[list[Array], Array]:
    """Return attitudes of each soak, chosen among `points`, shape (m, 3), and the resulting covariance."""
    rng = np.random.default_rng(seed)
    rows = gradients(points)
    products = (rows[:, :, None] * rows[:, None, :]).reshape(len(points), 81)
    chosen = [rng.choice(len(points), count, replace=False) for count in counts]
    covariance = design.covariance([points[selected] for selected in chosen])
    for _ in range(_SWEEPS):
        moved = False
        for soak, selected in enumerate(chosen):
            carried = design.carried[soak] / np.sqrt(design.variance)
            taken = (points @ points[selected].T > _CLOSEST).sum(axis=1)
            for place in range(len(selected)):
                old = int(selected[place])
                covariance = _update_covariance(covariance, rows[old] @ carried, -1.0)
                taken -= points @ points[old] > _CLOSEST
                by_point = carried @ covariance
                known = by_point[:, : design.laws.size]
                drop = products @ (known @ design.weight @ known.T).ravel()
                gain = drop / (1 + products @ (by_point @ carried.T).ravel())
                gain[taken > 0] = -np.inf
                best = int(np.argmax(gain))
                best = best if gain[best] > gain[old] * (1 + 1e-9) else old
                moved |= best != old
                selected[place] = best
                covariance = _update_covariance(covariance, rows[best] @ carried, 1.0)
                taken += points @ points[best] > _CLOSEST
        if not moved:
            break
    sets = [points[selected] for selected in chosen]
    return sets, design.covariance(sets)


def _update_covariance(covariance: Array, row: Array, sign: float) -> Array:
    """Return the covariance with one row of information more (`sign` 1) or less (-1)."""
    carried = covariance @ row
    updated: Array = covariance - np.outer(carried, carried) / (sign + row @ carried)
    return updated


# Prediction for the gyroscopes: rates at rest, and turns for scale factors.


NOISE, TURN_ON_SCATTER = "0.3 deg/sqrt(h)", "0.01 deg/s"


@dataclass(frozen=True)
class GyroPlan:
    """Predicted uncertainty of the gyroscopes.

    Attributes
    ----------
    deviation
        Standard deviation of a component of the corrected rate at rest at the plan's temperatures, root mean square
        over attitudes, rad/s, shape (m,).
    noise
        Angle random walk, rad/sqrt(s).
    turn_on_scatter
        Standard deviation of the biases between power cycles, rad/s.
    turns, turned_at
        Turns between attitudes from which scale factors follow, in soaks of nine attitudes or more, and the number of
        their temperatures.
    needed
        Time in which each soak has nine attitudes, s.
    """

    deviation: Array
    noise: float
    turn_on_scatter: float
    turns: int
    turned_at: int
    needed: float

    @property
    def mean(self) -> float:
        """Root of the mean square of `deviation`, rad/s."""
        return float(np.sqrt(np.mean(self.deviation**2)))

    def content(self) -> dict[str, Any]:
        """Return the same for scripts, in SI."""
        return {
            "noise": amount(self.noise, "rad/sqrt(s)"),
            "turn_on_scatter": amount(self.turn_on_scatter, "rad/s"),
            "mean": amount(self.mean, "rad/s"),
            "predicted": {"standard_uncertainty": self.deviation.tolist(), "unit": "rad/s"},
            "turns": self.turns,
            "turned_at": self.turned_at,
        }

    def sentences(self, temperature: Array) -> str:
        """Return the prediction in sentences; `temperature` as of the plan, degC."""
        worst = int(np.argmax(self.deviation))
        rates = (self.mean, self.deviation[worst], self.turn_on_scatter)
        mean, largest, scatter_text = (f"{text_in(rate, 'deg/h')} deg/h" for rate in rates)
        walk = f"{self.noise / RANDOM_WALK['deg/sqrt(h)']:.3g} deg/sqrt(h)"
        return (
            f"The gyroscopes' laws will give a component of the rate at rest to {mean}, {largest} where they are "
            f"worst, at {temperature[worst]:.0f} degC, by an angle random walk of {walk}, {scatter_text} of turn-on "
            f"scatter and the Earth's rate from unknown directions. {self._turns_sentence()}"
        )

    def _turns_sentence(self) -> str:
        """Return a sentence on the turns for scale factors."""
        if not self.turns:
            return (
                f"No soak has the {TURNED} attitudes whose turns tell scale factors: these soaks with as many take "
                f"{self.needed / 3600:.3g} h."
            )
        follow = "and how they follow it" if self.turned_at >= FOLLOWED else "taken as constant"
        at = "temperature" if self.turned_at == 1 else "temperatures"
        return f"{self.turns} turns at {self.turned_at} {at} will tell scale factors, {follow}."


def read_noise_and_scatter(
    noise: float | str | None, turn_on_scatter: float | str | None, *, asked: bool
) -> tuple[float, float] | None:
    """Return the angle random walk, rad/sqrt(s), and the scatter of biases between power cycles, rad/s.

    None where gyroscopes are not `asked` for.

    Raises
    ------
    OptionError
        One is out of range, or stated without gyroscopes.
    """
    if not asked:
        for name, value in (("gyro_noise", noise), ("gyro_turn_on_scatter", turn_on_scatter)):
            if value is not None:
                raise OptionError(f"{name}: no gyroscopes are planned; expected --with gyro beside it")
        return None
    noise = NOISE if noise is None else noise
    turn_on_scatter = TURN_ON_SCATTER if turn_on_scatter is None else turn_on_scatter
    walk = of_units(noise, "gyro_noise", RANDOM_WALK)
    tau = in_si(turn_on_scatter, "gyro_turn_on_scatter", "rate", "deg/s")
    if not 0 < walk < 1:
        raise OptionError(f"gyro_noise {noise!r}: expected more than 0, less than 1 rad/sqrt(s)")
    if not 0 <= tau < 1:
        raise OptionError(f"gyro_turn_on_scatter {turn_on_scatter!r}: expected 0 or more, less than 1 rad/s")
    return walk, tau


def plan_gyroscopes(
    laws: Laws, places: Array, soaks: Sequence[tuple[float, Array]], times: tuple[float, float], walk: float, tau: float
) -> GyroPlan:
    """Return the predicted uncertainty of gyroscopes in these soaks.

    Parameters
    ----------
    laws
        Laws of the accelerometers; the gyroscopes' biases have the same degree.
    places
        Temperatures at which to predict, degC, shape (m,).
    soaks
        Temperature, degC, and upward directions, (n, 3), of each.
    times
        Time of a soak, and of an attitude, all of which counts as rest, s.
    walk, tau
        Results of `read_noise_and_scatter`.
    """
    size, walked = laws.degrees[0] + 1, walk**2 / times[1] * np.eye(3)
    information = np.zeros((3 * (size + 3), 3 * (size + 3)))
    for temperature, up in soaks:
        law = np.tile(laws.design(np.array([temperature]))[0, 0, :size], (len(up), 1))
        rows = np.einsum("nc,ij->nijc", np.hstack([law, up]), np.eye(3)).reshape(len(up), 3, -1)
        new_columns = attitude_columns(up, None)
        weight = np.linalg.inv(walked + new_columns @ np.swapaxes(new_columns, 1, 2))
        common = np.einsum("nij,njc->ic", weight, rows)  # by an offset of the power cycle
        share = tau**2 * np.linalg.inv(np.eye(3) + tau**2 * weight.sum(axis=0))
        information += np.einsum("nia,nij,njb->ab", rows, weight, rows) - common.T @ share @ common
    blocks = np.linalg.inv(information).reshape(3, size + 3, 3, size + 3)
    covariance = np.einsum("iaib->ab", blocks) / 3
    functions = laws.design(places)[:, 0, :size]
    at_rest = np.einsum("ma,ab,mb->m", functions, covariance[:size, :size], functions)
    # Each of the three g-sensitivities along its own axis contains the vertical part of the Earth's rate.
    felt = (np.trace(covariance[size:, size:]) + VERTICAL**2) / 3
    counts = [len(up) for _, up in soaks]
    enough = [(temperature, count) for (temperature, _), count in zip(soaks, counts, strict=True) if count >= TURNED]
    return GyroPlan(
        deviation=np.sqrt(at_rest + felt),
        noise=walk,
        turn_on_scatter=tau,
        turns=sum(count - 1 for _, count in enough),
        turned_at=len({temperature for temperature, _ in enough}),
        needed=len(soaks) * (times[0] + TURNED * times[1]),
    )


# The plan: prediction, CSV to measure by, sheet and figure.


_ROWS = 9  # temperatures of the printed table
_RATE = "#7a4f9a"


@dataclass(frozen=True)
class PlannedSoak:
    """One power cycle at one temperature.

    Attributes
    ----------
    temperature
        Temperature, degC.
    warming
        Whether it is reached from below.
    directions
        Upward directions in the body frame, in the order that turns least, shape (n, 3).
    start, duration
        Start and duration of soak and attitudes, s.
    """

    temperature: float
    warming: bool
    directions: Array
    start: float
    duration: float


@dataclass(frozen=True)
class Tried:
    """A number of soaks that the time allows, attitudes in each, and deviations of the corrected force, m/s^2."""

    soaks: int
    attitudes: int
    mean: float
    worst: float


@dataclass(frozen=True, repr=False)
class ThermalPlan(PlannedAttitudes):
    """Soaks and attitudes of a calibration over temperature, and the predicted uncertainty.

    Attributes
    ----------
    soaks
        The soaks in their order.
    degrees
        Degrees of bias, scale factor and misalignment.
    temperature, deviation
        Temperatures over the range, degC, and the standard deviation of a component of the corrected force there, root
        mean square over directions, m/s^2, shape (m,).
    mean
        Root mean square of `deviation`, m/s^2.
    noise
        Noise of ``|f|`` in one attitude, m/s^2.
    noise_from
        Its source, in brackets; empty for a stated number.
    turn_on_scatter
        Standard deviation of the biases between power cycles, m/s^2.
    time
        Available time, s.
    tried
        The numbers of soaks that were compared.
    gyro
        Prediction for the gyroscopes, None unless it was asked for.
    """

    sheet_title: ClassVar[str] = "Thermal plan"
    soaks: tuple[PlannedSoak, ...]
    degrees: tuple[int, int, int]
    temperature: Array
    deviation: Array
    mean: float
    noise: float
    noise_from: str
    turn_on_scatter: float
    time: float
    tried: tuple[Tried, ...]
    gyro: GyroPlan | None = None

    @property
    def duration(self) -> float:
        """Duration of all soaks and attitudes, s."""
        return self.soaks[-1].start + self.soaks[-1].duration

    @property
    def lead(self) -> str:
        """The plan and its prediction in a few sentences."""
        counts = [len(soak.directions) for soak in self.soaks]
        each = f"{counts[0]}" if min(counts) == max(counts) else f"{min(counts)} or {max(counts)}"
        again = len(self.soaks) - len({soak.temperature for soak in self.soaks})
        places = len(self.soaks) - again
        spoken = describe_degrees(self.degrees)
        back = f" ({again} of them back at one)" if again else ""
        low, high = self.temperature[[0, -1]]
        worst = int(np.argmax(self.deviation))
        free = 3 * (len(self.soaks) - self.degrees[0] - 1)  # beside laws of the biases
        forces = (self.noise, self.turn_on_scatter, self.mean, self.deviation[worst])
        noise, turn_on, mean, largest = (f"{text_in(force, 'ug')} µg" for force in forces)
        return (
            f"{len(self.soaks)} soaks, a power cycle each, at {places} temperatures{back}, {each} attitudes in each "
            f"({sum(counts)} in all), {_hours_text(self.duration)} of {_hours_text(self.time)}. For degrees {spoken}, "
            f"a noise of {noise} in |f| per attitude{self.noise_from} and {turn_on} of "
            f"turn-on scatter the laws will give a component of the force to {mean} (standard deviation, "
            f"mean over {low:g} to {high:g} degC), {largest} where they are worst, at "
            f"{self.temperature[worst]:.0f} degC; the turn-on offset of each later power cycle comes on top. "
            f"{free} independent offsets will tell the turn-on scatter."
            + ("" if self.gyro is None else f" {self.gyro.sentences(self.temperature)}")
        )

    @property
    def predicted(self) -> list[tuple[str, str, str]]:
        """Standard deviation of the corrected force, and rate, at temperatures over the range: name, text and unit."""
        places = np.linspace(0, len(self.temperature) - 1, _ROWS).round().astype(int).tolist()
        at = [f"at {self.temperature[k]:.0f} degC" for k in places]
        rows = [
            (f"corrected force {place}", text_in(self.deviation[k], "ug"), "µg")
            for place, k in zip(at, places, strict=True)
        ]
        if self.gyro is not None:
            rates = self.gyro.deviation[places].tolist()
            rows += [
                (f"corrected rate {place}", text_in(u, "deg/h"), "deg/h") for place, u in zip(at, rates, strict=True)
            ]
        return rows

    def shown(self) -> tuple[str, list[str], list[list[str]]]:
        """Return the plan in a few sentences, and the schedule."""
        rows = [
            [str(k), f"{soak.temperature:.1f}", _side_text(soak), str(len(soak.directions)), _hours_text(soak.start),
             _hours_text(soak.start + soak.duration)]
            for k, soak in enumerate(self.soaks, 1)
        ]  # fmt: skip
        return self.lead, ["soak", "degC", "reached by", "attitudes", "from, h:min", "to, h:min"], rows

    def tables(self) -> list[tuple[list[str], list[list[str]]]]:
        """Return the numbers of soaks that were compared, and the predicted deviations of force and rate."""
        rows = [
            [str(each.soaks), str(each.attitudes), text_in(each.mean, "ug"), text_in(each.worst, "ug")]
            for each in self.tried
        ]
        return [
            (["soaks", "attitudes in each", "mean sd, µg", "worst sd, µg"], rows),
            (["predicted sd of", "value", "unit"], [list(row) for row in self.predicted]),
        ]

    def content(self) -> dict[str, Any]:
        """Return the plan for scripts, in SI."""
        gyro = {} if self.gyro is None else {"gyro": self.gyro.content()}
        return {
            "degrees": list(self.degrees),
            "duration": amount(self.duration, "s"),
            "noise": amount(self.noise, "m/s^2"),
            "turn_on_scatter": amount(self.turn_on_scatter, "m/s^2"),
            "mean": amount(self.mean, "m/s^2"),
            "predicted": {
                "temperature": self.temperature.tolist(),
                "standard_uncertainty": self.deviation.tolist(),
                "unit": "m/s^2",
            },
            "soaks": [
                {
                    "temperature": soak.temperature,
                    "reached_by": "warming" if soak.warming else "cooling",
                    "start": soak.start,
                    "duration": soak.duration,
                    "up": soak.directions.tolist(),
                }
                for soak in self.soaks
            ],
            "compared": [
                {"soaks": each.soaks, "attitudes": each.attitudes, "mean": each.mean, "worst": each.worst}
                for each in self.tried
            ],
            **gyro,
        }

    def recording(self) -> Recording:
        """Return the attitudes of all soaks as a table."""
        counts = [len(soak.directions) for soak in self.soaks]
        up = np.vstack([soak.directions for soak in self.soaks])

        def each(values: list[float]) -> Array:
            return np.repeat(np.array(values, dtype=np.float64), counts)

        columns = {
            "soak": each([float(k) for k in range(1, len(counts) + 1)]),
            "set_point": each([round(soak.temperature, 1) for soak in self.soaks]),
            "warming": each([float(soak.warming) for soak in self.soaks]),
            "start": each([round(soak.start / 60, 3) for soak in self.soaks]),
            "number": np.concatenate([np.arange(1.0, n + 1) for n in counts]),
            **{f"up_{name}": np.round(up[:, i], 6) + 0.0 for i, name in enumerate("xyz")},
        }
        angles = np.round(np.degrees(roll_pitch(up)), 3) + 0.0
        columns |= {"roll": angles[:, 0], "pitch": angles[:, 1]}
        units = dict.fromkeys(columns, "1") | {"set_point": "degC", "start": "min", "roll": "deg", "pitch": "deg"}
        degrees = ",".join(map(str, self.degrees))
        return Recording(columns=columns, units=units, metadata={"degrees": degrees}, name="thermal plan")

    def pictures(self) -> list[dict[str, Any]]:
        """Return what the sheet shows of each attitude, soak by soak."""
        pictures = []
        for number, soak in enumerate(self.soaks, 1):
            heading = (
                f"Soak {number}: {soak.temperature:.1f} degC, reached by {_side_text(soak)}, {_hours_text(soak.start)}"
            )
            for index, up in enumerate(soak.directions):
                of_soak = {"heading": "" if index else heading}
                pictures.append(of_soak | attitude_entry(f"{number}.{index + 1}", up))
        return pictures

    def plot(self) -> Plot:
        """Return the standard deviation of the corrected force, and rate, over temperature, with the soaks."""
        places, at = rounded(self.temperature), np.array([soak.temperature for soak in self.soaks])
        deviation = from_si(self.deviation, "ug")
        at_soaks = np.interp(at, self.temperature, deviation)
        name, line = "predicted" if self.gyro is None else "force", {"color": GOOD, "width": 2}
        traces = [
            scatter(places, rounded(deviation, 3), "lines", name=name, line=line),
            scatter(rounded(at), rounded(at_soaks, 3), "markers", name="soaks", marker={"color": BAD, "size": 8}),
        ]
        layout = {
            "xaxis": figure_axis("temperature, degC"),
            "yaxis": figure_axis("sd of the corrected force, µg", rangemode="tozero"),
            "legend": LEGEND,
        }
        if self.gyro is not None:
            rate = rounded(from_si(self.gyro.deviation, "deg/h"), 3)
            line = {"color": _RATE, "width": 2, "dash": "dash"}
            traces.insert(1, scatter(places, rate, "lines", name="rate at rest", line=line, yaxis="y2"))
            right = figure_axis("sd of the rate at rest, deg/h", rangemode="tozero", overlaying="y", side="right")
            layout |= {"yaxis2": {**right, "showgrid": False}, "margin": {"r": 75}}
        caption = "Of a component, root mean square over directions, without the turn-on offset of the day."
        return Plot(Figure("What the laws will give", caption, traces, layout, message=self.lead), "Thermal plan")


def _side_text(soak: PlannedSoak) -> str:
    return "warming" if soak.warming else "cooling"


def _hours_text(seconds: float) -> str:
    minutes = round(seconds / 60)
    return f"{minutes // 60}:{minutes % 60:02d} h"


# The best plan for a time in the chamber.


_FEWEST, _MOST, _SOAKS = 3, 40, 24
"""Fewest and most attitudes of a soak; most soaks."""
_SCANNED = 12
"""Attitudes of a soak by which numbers of soaks are compared: more of them change the sizes, not their order."""
_STARTS, _AS_GOOD = 4, 1.02  # starts of the search; plans within 2 % of the least mean variance count as good
_ROOM = 23.0  # degC, from which the chamber starts


def plan_thermal(
    temperatures: Annotated[Sequence[float] | str, parsed(temperature_list, "LOW,HIGH", unit="degC")] = "-20,60",
    *,
    time: Annotated[float | str, measure("time", "min")] = "8 h",
    soak: Annotated[float | str, measure("time", "min")] = "45 min",
    attitude: Annotated[float | str, measure("time", "min")] = "1 min",
    noise: Annotated[float | Known, text("60ug|FILE")] = "60 ug",
    turn_on_scatter: Annotated[float | str, measure("acceleration", "mg", "SIZE")] = "0.1 mg",
    degrees: Annotated[str | tuple[int, int, int], text("B,S,M")] = DEGREES,
    from_: Annotated[Data, text("sphere|FILE", STARTS)] = "sphere",
    with_: Annotated[str | Sequence[str], text("gyro", ("gyro",)), FURTHER_TRIADS] = (),
    gyro_noise: Annotated[float | str | None, text("N", unit="deg/sqrt(h)"), FURTHER_TRIADS] = None,
    gyro_turn_on_scatter: Annotated[float | str | None, measure("rate", "deg/s", "SIZE"), FURTHER_TRIADS] = None,
) -> ThermalPlan:
    """Choose soaks and attitudes for a calibration over temperature, and predict the corrected force over the range.

    Numbers of soaks that the time allows are compared by the mean variance of the corrected force over temperature and
    direction, with the offsets of each power cycle in it: ``tr(W (sum_k B_k' R_k' R_k B_k)^-1)``, R_k the gradients of
    ``|f|`` in soak k and B_k the basis at its temperature. Temperatures are the ends of the range and the extrema of
    the Legendre polynomial; what is left of the soaks comes back to inner ones from the other side.

    Parameters
    ----------
    temperatures
        Lowest and highest temperature. In degC.
    time
        In the chamber, all told. In s.
    soak
        Until the unit has the next temperature. In s.
    attitude
        For one attitude, the turn to it included. In s.
    noise
        Noise of ``|f|`` in one attitude, or a recording or record that has it. In m/s^2; as for `plan_tumble`.
    turn_on_scatter
        What biases move by from one power cycle to the next. Standard deviation of each, m/s^2.
    degrees
        Of bias, scale factor and misalignment. The laws that the plan is for.
    from_
        As for `plan_tumble`.
    with_
        gyro: say what the same soaks give of the gyroscopes, too.
    gyro_noise
        Angle random walk of the gyroscopes; 0.3 deg/sqrt(h) if not given. In rad/sqrt(s), over all of an attitude's
        time.
    gyro_turn_on_scatter
        What their biases move by from one power cycle to the next; 0.01 deg/s if not given. Standard deviation of each,
        rad/s.

    Raises
    ------
    OptionError
        A value is out of range, the time too short, or one is of gyroscopes that nobody asked for.
    ObservabilityError
        No choice among the attitudes determines the laws.

    Source: Fedorov, Theory of Optimal Experiments (1972); Atkinson, Donev and Tobias (2007).

    Examples
    --------
    >>> import imulab as il
    >>> plan = il.plan_thermal("-20,60", time="8 h", noise="60 ug")
    >>> len(plan.soaks), [round(soak.temperature) for soak in plan.soaks][:5]
    (8, [-20, -6, 20, 46, 60])
    """
    laws, count = _read_laws(temperatures, degrees)
    sizes = {
        name: _check_positive(in_si(value, name, "time", "min"), name)
        for name, value in (("time", time), ("soak", soak), ("attitude", attitude))
    }
    sigma, source = noise_of(noise)
    tau = in_si(turn_on_scatter, "turn_on_scatter", "acceleration", "mg") / STANDARD_GRAVITY
    if not 0 <= tau < 1:
        raise OptionError(f"turn_on_scatter {turn_on_scatter!r}: expected 0 or more, less than 1 g")
    further = read_noise_and_scatter(gyro_noise, gyro_turn_on_scatter, asked=bool(parse_further(with_, "with_")))
    stated = candidates_of(from_)
    points = sphere_candidates() if stated is None else stated
    options = _soaks_in_time(count, **sizes)
    best = [(each, _scan(laws, count, each, tau / sigma, points)) for each in options]
    if not np.isfinite([cost for _, (cost, _) in best]).any():
        where = from_ if isinstance(from_, str) else "from_"
        raise ObservabilityError(
            f"{where}: {len(points)} candidate attitudes, {options[-1][1]} in each soak, cannot separate the "
            f"coefficients of degrees {','.join(map(str, laws.degrees))}; expected more time, lower degrees or other "
            "candidates"
        )
    (soaks, _), _ = min(best, key=lambda each: each[1][0])
    design = _make_design(laws, count, soaks, tau / sigma)
    covariance, sets = _search_attitudes(design, points, _count_attitudes(design, **sizes))
    deviation = sigma * STANDARD_GRAVITY * design.deviations(covariance)
    unit = sigma * STANDARD_GRAVITY
    soaks_of = tuple(_schedule(design, sets, sizes["soak"], sizes["attitude"]))
    gyro = None
    if further is not None:
        placed = [(each.temperature, each.directions) for each in soaks_of]
        gyro = plan_gyroscopes(laws, design.places, placed, (sizes["soak"], sizes["attitude"]), *further)
    return ThermalPlan(
        soaks=soaks_of,
        degrees=laws.degrees,
        temperature=design.places,
        deviation=deviation,
        mean=unit * float(np.sqrt(design.cost(covariance))),
        noise=unit,
        noise_from=source,
        turn_on_scatter=tau * STANDARD_GRAVITY,
        time=sizes["time"],
        tried=tuple(
            Tried(k, n, unit * float(np.sqrt(cost)), unit * worst) for (k, n), (cost, worst) in best if cost < np.inf
        ),
        gyro=gyro,
    )


def _read_laws(temperatures: Sequence[float] | str, degrees: Any) -> tuple[Laws, int]:
    """Return the laws of a plan, and the number of its temperatures."""
    ends = temperature_list(temperatures, "temperatures")
    if len(ends) != 2 or not -100 <= ends[0] < ends[1] <= 150 or ends[1] - ends[0] < LEAST_SPAN:
        raise OptionError(
            f"temperatures {temperatures!r}: expected the lowest and the highest temperature, -100 to 150 degC, "
            f"{LEAST_SPAN:g} K or more apart, such as -20,60"
        )
    wanted = parse_degrees(degrees if isinstance(degrees, str) else ",".join(map(str, degrees)), "degrees")
    if isinstance(wanted, str):
        raise OptionError("degrees 'auto': a plan needs degrees, such as 3,2,1, the highest that auto tries")
    count = max(wanted) + 2
    laws = Laws(ends[0], ends[1], wanted)
    if np.diff(legendre_nodes(count)).min() * laws.half <= APART:
        raise OptionError(
            f"temperatures {temperatures!r}: {count} temperatures, which degree {max(wanted)} takes, would lie within "
            f"{APART:g} K of each other: expected a wider range, or lower degrees"
        )
    return laws, count


def _check_positive(value: float, name: str) -> float:
    """Return a time, s, if it is above 0."""
    if not 0 < value < 1e8:
        raise OptionError(f"{name} {value:g} s: expected more than 0 s")
    return value


def _soaks_in_time(count: int, time: float, soak: float, attitude: float) -> list[tuple[int, int]]:
    """Return the numbers of soaks that the time allows, each with its mean number of attitudes."""
    most = min(int((time + 1e-6) // (soak + _FEWEST * attitude)), _SOAKS)
    if most < count:
        least = count * (soak + _FEWEST * attitude)
        raise OptionError(
            f"time {time / 60:.6g} min: allows {most} soaks of {soak / 60:.6g} min and {_FEWEST} attitudes of "
            f"{attitude / 60:.6g} min; expected {least / 60:.6g} min or more for {count} temperatures, or lower degrees"
        )
    return [(k, min(int((time + 1e-6 - k * soak) // (k * attitude)), _MOST)) for k in range(count, most + 1)]


def _make_design(laws: Laws, count: int, soaks: int, tau: float) -> Design:
    """Return the design of soaks at `count` temperatures."""
    return Design(laws, (laws.middle + laws.half * legendre_nodes(count))[order_soaks(count, soaks)], tau)


def _scan(laws: Laws, count: int, option: tuple[int, int], tau: float, points: Array) -> tuple[float, float]:
    """Return mean variance and largest deviation for a number of soaks, by at most 12 attitudes of less noise."""
    soaks, attitudes = option
    used = min(attitudes, _SCANNED, len(points))
    design = replace(_make_design(laws, count, soaks, tau), variance=used / attitudes)
    _, covariance = exchange_attitudes(design, points, [used] * soaks, 1)
    return design.cost(covariance), float(design.deviations(covariance).max())


def _count_attitudes(design: Design, time: float, soak: float, attitude: float) -> list[int]:
    """Return the number of attitudes of each soak that the time allows; a remainder goes to the ends first."""
    soaks = len(design.temperatures)
    whole = min(int((time + 1e-6 - soaks * soak) // attitude), soaks * _MOST)
    far = np.argsort(-np.abs(design.laws.place(design.temperatures)), kind="stable")
    counts = np.full(soaks, whole // soaks)
    counts[far[: whole % soaks]] += 1
    return [int(n) for n in counts]


def _search_attitudes(design: Design, points: Array, counts: Sequence[int]) -> tuple[Array, list[Array]]:
    """Return covariance and attitudes of the best of several starts: of the good ones that of the least maximum."""
    counts = [min(count, len(points)) for count in counts]
    best = [exchange_attitudes(design, points, counts, seed) for seed in range(1, _STARTS + 1)]
    least = min(design.cost(covariance) for _, covariance in best)
    good = [each for each in best if design.cost(each[1]) <= _AS_GOOD * least]
    sets, covariance = min(good, key=lambda each: float(design.deviations(each[1]).max()))
    return covariance, sets


def _schedule(design: Design, sets: Sequence[Array], soak: float, attitude: float) -> list[PlannedSoak]:
    """Return the soaks in their order, and whether each is reached by warming."""
    soaks, start, before = list[PlannedSoak](), 0.0, _ROOM
    for temperature, directions in zip(design.temperatures.tolist(), sets, strict=True):
        duration = soak + len(directions) * attitude
        soaks.append(PlannedSoak(temperature, temperature > before, shortest_path(directions), start, duration))
        start, before = start + duration, temperature
    return soaks
