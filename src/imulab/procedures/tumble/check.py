"""Fresh attitudes against a record, to test whether it still holds, and how that is shown."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Unpack

import numpy as np
from numpy.typing import NDArray

from imulab.columns import triad
from imulab.device.unit import output_factor
from imulab.display import Finding, Note
from imulab.errors import OptionError, RecordError
from imulab.estimation.decisions import ATTITUDES_DISTURBED, TUMBLE_CHECK
from imulab.estimation.distributions import f_tail, probability_fact, probability_text
from imulab.estimation.least_squares import chi_square_probability
from imulab.estimation.rows import median
from imulab.gravity import Gravity, Height, Latitude, LocalGravity, StatedSite, at_place, local_gravity, of_place
from imulab.options import measure
from imulab.procedures.result import Record, RecordCheck, as_record, columns_as_rows
from imulab.procedures.tumble.attitudes import Attitudes, TumbleData, as_attitudes
from imulab.procedures.tumble.checks import check_fresh, check_uncorrected, made_from
from imulab.procedures.tumble.model import length_noise, norm_and_jacobian, parameter_names
from imulab.procedures.tumble.record import Scaling, scaled_parameters
from imulab.procedures.tumble.schema import attitudes_of, fit_of, model_of
from imulab.quantities import in_si
from imulab.recording import Array, Reading
from imulab.records.calibration import Calibration
from imulab.records.sections import StatedGravity, entries
from imulab.report.parameters import micro_g, reading_unit, small_g
from imulab.report.traces import (
    BAD,
    PLOT,
    QUIET,
    Exhibits,
    Figure,
    ReportTable,
    bulk,
    edge_marks,
    edge_note,
    figure_axis,
    format_uncertain,
    marker,
    number_axis,
    rounded,
    scatter,
    table,
)
from imulab.units import from_si

if TYPE_CHECKING:
    from imulab.procedures.tumble.mag.check import MagCheck

# The result of a test of a tumble record by fresh attitudes: verdict, and each residual beside its uncertainty.


_BEYOND = 2.0
"""Standard uncertainties beyond which a residual is marked."""
_BEYOND_BOTH = float(np.sqrt(2 * np.log(20.0)))
"""The same of two at once, which one in twenty exceeds by chance."""
_LEAST = 1e-300
"""The least probability that is told as a number."""


@dataclass(frozen=True, repr=False)
class Check(RecordCheck):
    """How well a record still holds.

    Attributes
    ----------
    residuals
        ``|f| - g`` of each attitude under the record, m/s^2, shape (n,).
    standard_uncertainty
        Of each, from the record's covariance and the attitude's noise, m/s^2, shape (n,); None where the record states
        no uncertainties.
    chi_square
        ``r' (J V J' + C)^-1 r``, with as many degrees of freedom as attitudes; None likewise.
    probability
        Of so large a value, did the record hold; None likewise.
    gravity
        That was used.
    limit
        Largest ``| |f| - g |`` that passes, m/s^2; None: the test alone decides.
    notes
        What a user must know of the test, a sentence each.
    attitudes
        That were tested.
    mag
        The same of the magnetometers; None where the record or the recording has none.
    """

    residuals: Array
    standard_uncertainty: Array | None
    chi_square: float | None
    probability: float | None
    gravity: Gravity
    limit: float | None
    notes: tuple[str, ...]
    attitudes: Attitudes
    mag: MagCheck | None = None

    subject: ClassVar[str] = "Tumble check"
    data: ClassVar[str] = "file"

    def __repr__(self) -> str:
        p = "" if self.probability is None else f", {probability_text(self.probability)}"
        worst = small_g(abs(float(self.residuals[self.worst])))
        return (
            f"Check({'pass' if self.passed else 'fail'}{p}, {len(self.residuals)} attitudes, the farthest off is "
            f"number {self.worst + 1} by {worst})"
        )

    @property
    def passed(self) -> bool:
        """Whether the tests find no contradiction at 5 %, and every attitude is within the limit, if there is one."""
        within = self.limit is None or bool((np.abs(self.residuals) <= self.limit).all())
        return within and self.accelerometers_agree and self.magnetometers_agree

    @property
    def false_alarm(self) -> float:
        """Probability below which a test fails: 5 % shared by those that are made."""
        return TUMBLE_CHECK.level if self.mag is None or self.probability is None else TUMBLE_CHECK.level / 2

    @property
    def accelerometers_agree(self) -> bool:
        """Whether |f| = g holds under the record."""
        return self.probability is None or self.probability >= self.false_alarm

    @property
    def magnetometers_agree(self) -> bool:
        """Whether |m| and dip stay the same under the record; so where there are none."""
        return self.mag is None or self.mag.probability >= self.false_alarm

    @property
    def worst(self) -> int:
        """Index of the attitude that is farthest off."""
        return int(np.argmax(np.abs(self.residuals)))

    @property
    def limit_alone(self) -> bool:
        """Whether the test would pass without the limit."""
        return self.probability is not None and self.accelerometers_agree and self.magnetometers_agree

    def meaning(self) -> str:
        """Return what the test says, in words."""
        if self.passed:
            return "the attitudes agree with the record"
        if self.limit_alone:
            return "no change of the unit is shown, but an attitude is beyond the limit"
        if self.accelerometers_agree:
            return "hard or soft iron has changed since the record was made, or iron was near"
        return "the unit has changed since the record was made, or gravity, unit or attitudes are not as assumed"

    def next_step(self, record: str, files: Sequence[str]) -> str:
        """Return what to do, or to know, where the test failed."""
        if self.limit_alone:
            return "the limit is smaller than the uncertainty of the attitudes can tell"
        if self.accelerometers_agree:
            return (
                "measure again away from iron, or 'imulab tumble mag FILE -o NEW.json' with 16 or more attitudes for a "
                "record that follows the change"
            )
        return (
            f"measure again, or 'imulab tumble fit {' '.join(files)} --prior {record} -o NEW.json' for a record that "
            "follows the change"
        )

    def summary(self) -> str:
        """Return p and the largest residual."""
        n, worst = len(self.attitudes), self.worst
        test = "not tested, the record states no uncertainties"
        if self.probability is not None:
            test = f"{probability_text(self.probability, _LEAST)} (chi-square {self.chi_square:.3g} of {n})"
        limit = "" if self.limit is None else f", limit {small_g(self.limit)}"
        return (
            f"{test}, {n} attitudes, largest |f| - g {small_g(self.residuals[worst])} "
            f"({self.attitudes.label(worst)}){limit}"
        )

    def measured(self) -> list[str]:
        """Return the tests, and the residual of every attitude."""
        lines = [self.summary(), *self._of_magnetometers()]
        for k, value in enumerate(self.residuals.tolist()):
            u = "" if self.standard_uncertainty is None else f" ± {small_g(self.standard_uncertainty[k])}"
            field = ""
            if self.mag is not None:
                field = f", |m| {100 * self.mag.magnitude[k]:+.2f} %, dip {np.degrees(self.mag.dip[k]):+.2f} deg"
            beyond = "  beyond the limit" if self.limit is not None and abs(value) > self.limit else ""
            lines.append(f"{self.attitudes.label(k)}: {small_g(value)}{u}{field}{beyond}")
        return lines

    def _of_magnetometers(self) -> list[str]:
        mag = self.mag
        if mag is None:
            return []
        worst, agree = mag.worst, "stay the same" if self.magnetometers_agree else "do not stay the same"
        magnitude = format_uncertain(100 * mag.common[0], 100 * mag.common_uncertainty[0])
        dip = format_uncertain(*np.degrees([mag.common[1], mag.common_uncertainty[1]]).tolist())
        lines = [
            f"magnetometers: |m| and dip {agree}, {probability_text(mag.probability, _LEAST)}, farthest off |m| "
            f"{100 * mag.magnitude[worst]:+.2g} %, dip {np.degrees(mag.dip[worst]):+.2g} deg "
            f"({self.attitudes.label(worst)})",
            f"field against that of the record: |m| {' ± '.join(magnitude)} %, dip {' ± '.join(dip)} deg (not tested: "
            "of the place)",
        ]
        if not self.magnetometers_agree and mag.explained >= self.false_alarm:
            read = reading_unit(mag.unit, "mag_bias_x")
            places = 2 if mag.unit == "T" else 4
            change = ", ".join(f"{value * read.factor:+.{places}f}" for value in mag.hard_iron.tolist())
            lines.append(
                f"a hard iron that changed by ({change}) {read.symbol} explains it ({probability_text(mag.explained)})"
            )
        return lines

    def content(self) -> dict[str, Any]:
        """Return what was measured, for scripts, in SI."""
        n = len(self.attitudes)
        stated = [None] * n if self.standard_uncertainty is None else self.standard_uncertainty
        residuals = columns_as_rows(
            label=(self.attitudes.label(k) for k in range(n)), residual=self.residuals, standard_uncertainty=stated
        )
        return {
            "p": self.probability,
            "chi_square": self.chi_square,
            "degrees_of_freedom": n,
            "limit": None if self.limit is None else {"value": self.limit, "unit": "m/s^2"},
            "gravity": entries(StatedGravity.of(self.gravity)),
            "attitudes": residuals,
            **({} if self.mag is None else {"mag": self.mag.content()}),
        }

    def stated(self) -> list[tuple[str, str]]:
        """Return gravity."""
        return [("gravity", f"{self.gravity.value:.9g} m/s^2")]

    def exhibits(self) -> Exhibits:
        """Return what its report shows."""
        facts = [("attitudes", str(len(self.attitudes))), ("largest |f| − g", small_g(self.residuals[self.worst]))]
        if self.probability is not None:
            facts.insert(0, ("p, if nothing changed", probability_fact(self.probability, _LEAST)))
        if self.limit is not None:
            facts.append(("limit", small_g(self.limit)))
        fields = [] if self.mag is None else [_fields(self, self.mag)]
        return self.exhibits_with(facts, [_residuals(self), *fields, _table(self)], f"; {self.summary()}")

    def beyond(self) -> NDArray[np.bool_]:
        """Return which attitudes are beyond the limit, or beyond twice their uncertainty, shape (n,)."""
        size = np.abs(self.residuals)
        beyond = np.zeros(len(size), dtype=bool)
        if self.limit is not None:
            beyond |= size > self.limit
        if self.standard_uncertainty is not None:
            beyond |= size > _BEYOND * self.standard_uncertainty
        return beyond


def _residuals(check: Check) -> Figure:
    attitudes, beyond = check.attitudes, check.beyond()
    number = list(range(1, len(attitudes) + 1))
    residual = from_si(check.residuals, "ug")
    labels = [attitudes.label(k) for k in range(len(attitudes))]
    trace = scatter(
        number, residual.tolist(), "markers", marker=marker(beyond, 9), text=labels,
        hovertemplate="%{text}<br>%{y:.1f} µg<extra></extra>",
    )  # fmt: skip
    room, bars = 0.0, " The record states no uncertainties."
    if check.standard_uncertainty is not None:
        half = (_BEYOND * from_si(check.standard_uncertainty, "ug")).tolist()
        trace["error_y"] = {"type": "data", "array": half, "color": QUIET, "thickness": 1, "width": 3}
        room = float(np.median(half))
        bars = (
            " Bars: twice the standard uncertainty, from record and attitude; one in twenty lies farther off by chance."
        )
    far = bulk(residual, room=room, pixels=PLOT)
    edges = [] if far is None else edge_marks(far, residual, number, [small_g(v) for v in check.residuals.tolist()])
    ends = [] if check.limit is None else [-micro_g(check.limit), micro_g(check.limit)]
    line = {"type": "line", "xref": "paper", "x0": 0, "x1": 1, "line": {"color": BAD, "dash": "dash", "width": 1.5}}
    count = int(beyond.sum())
    return Figure(
        title="Residual |f| − g of each fresh attitude under the record",
        message=f"{count} of {len(number)} attitudes {'lies' if count == 1 else 'lie'} beyond "
        f"{'the limit or ' if ends else ''}twice the standard uncertainty.",
        caption=f"f is the specific force by the record, g local gravity.{bars}"
        f"{' Dashed: the limit.' if ends else ''} Red diamonds lie beyond."
        + edge_note(0 if far is None else int(far.beyond.sum())),
        traces=[trace, *edges],
        layout={
            "xaxis": number_axis("attitude", number),
            "yaxis": figure_axis("|f| − g, µg", zeroline=True, zerolinecolor=QUIET)
            | ({} if far is None else {"range": [far.low, far.high]}),
            "showlegend": False,
            "shapes": [{**line, "y0": end, "y1": end} for end in ends],
        },
    )


def _fields(check: Check, mag: MagCheck) -> Figure:
    """Return |m| and dip of each fresh attitude, less what all have in common."""
    attitudes = check.attitudes
    number = list(range(1, len(attitudes) + 1))
    far = np.hypot(mag.magnitude / mag.magnitude_uncertainty, mag.dip / mag.dip_uncertainty) > _BEYOND_BOTH
    labels, traces = [attitudes.label(k) for k in range(len(attitudes))], []
    for values, sigma, unit, place in (
        (100 * mag.magnitude, 100 * mag.magnitude_uncertainty, "%", "y2"),
        (np.degrees(mag.dip), np.degrees(mag.dip_uncertainty), "deg", "y"),
    ):
        bars = {"type": "data", "array": rounded(2 * sigma), "color": QUIET, "thickness": 1, "width": 3}
        traces.append(
            scatter(number, rounded(values), "markers", marker=marker(far, 8), error_y=bars, text=labels, yaxis=place,
                    hovertemplate=f"%{{text}}<br>%{{y:+.2f}} {unit}<extra></extra>")
        )  # fmt: skip
    return Figure(
        title="Magnitude and dip of the field in each fresh attitude under the record",
        message=f"{int(far.sum())} of {len(number)} attitudes {'lies' if far.sum() == 1 else 'lie'} beyond what "
        "one in twenty does by chance.",
        caption="|m| and dip less what all attitudes have in common, which is of the place. Bars: twice the "
        "standard uncertainty, from the record and the scatter of its attitudes.",
        traces=traces,
        layout={
            "xaxis": number_axis("attitude", number),
            "yaxis": figure_axis("dip, deg", domain=[0, 0.46], zeroline=True),
            "yaxis2": figure_axis("|m|, %", domain=[0.54, 1], zeroline=True),
            "showlegend": False,
        },
        height=460,
    )


def _table(check: Check) -> ReportTable:
    u, beyond = check.standard_uncertainty, check.beyond()
    columns: dict[str, Callable[[int], str]] = {
        "attitude": check.attitudes.label,
        "|f| − g": lambda k: small_g(check.residuals[k]),
        "u": lambda k: "not stated" if u is None else small_g(u[k]),
        "(|f| − g) / u": lambda k: "–" if u is None else f"{check.residuals[k] / u[k]:+.1f}",
        "remark": lambda k: "beyond" if beyond[k] else "",
    }
    return table(
        "Attitudes",
        "Residual |f| − g under the record, its standard uncertainty u, and their ratio. The test weighs all attitudes "
        f"together, with what their errors share; it fails where p is below {100 * check.false_alarm:g} %.",
        columns,
        range(len(check.attitudes)),
    )


# Fresh attitudes against a record, to test whether it still holds.


def check_tumble(
    record: Record,
    data: TumbleData,
    *,
    limit: Annotated[float | str | None, measure("acceleration", "mg")] = None,
    gravity: LocalGravity = None,
    latitude: Latitude = None,
    height: Height = None,
    place: StatedSite = None,
    **reading: Unpack[Reading],
) -> Check:
    """Test whether fresh attitudes contradict an existing record, without refitting.

    ``r' (J V J' + C)^-1 r`` against chi-square, with r the residuals ``|f| - g`` under the record, J their derivatives
    by its parameters, V its covariance and C the attitudes' noise. Of magnetometers, where record and attitudes have
    them, ``|m|`` and dip are tested likewise, but for what all have in common: the attitudes may be of another place. A
    record that holds fails once in twenty tests.

    Parameters
    ----------
    record
        Of procedure tumble, or its file.
    data
        A file, recording, data frame, arrays or attitudes, as for `fit_tumble`. Where nothing is known of their noise,
        that of the record's own attitudes counts.
    limit
        Largest ``| |f| - g |`` that passes, beside the test. In m/s^2, or a text such as ``"2 mg"``.
    gravity
        Local gravity where they were measured; else of the file's head, else of the record. As for `fit_tumble`.
    latitude, height, place
        As for `fit_tumble`.
    reading
        How arrays and files are to be understood, as for `fit_tumble`.

    Raises
    ------
    RecordError
        The record is of another procedure, has cross terms, or states no uncertainties and there is no limit.
    UnitError
        The attitudes' unit cannot be converted to the record's.
    OptionError
        The limit is not above 0, or gravity cannot be.
    DataError
        The magnitudes are nowhere near gravity, or the recording was corrected by this record.

    Examples
    --------
    >>> import imulab as il
    >>> first = il.simulate_tumble(gravity=9.81)
    >>> truth = {key[6:]: float(text) for key, text in first.metadata.items() if key.startswith("truth_")}
    >>> second = il.simulate_tumble(gravity=9.81, truth=truth, seed=2)
    >>> il.check_tumble(il.fit_tumble(first, gravity=9.81).calibration, second, gravity=9.81).passed
    True
    """
    record = as_record(record, "check_tumble")
    limit = None if limit is None else in_si(limit, "limit", "acceleration", "mg")
    attitudes = as_attitudes(data, reading, check_tumble)
    if record.procedure != "tumble":
        raise RecordError(f"a {record.procedure} record cannot be checked by attitudes; expected a tumble record")
    if model_of(record).cross:
        raise RecordError("a record with cross terms cannot be checked; expected one without, of the same attitudes")
    if limit is not None and not limit > 0:
        raise OptionError(f"limit {limit:g} m/s^2: expected more than 0")
    if limit is None and not record.covariance.names:
        raise RecordError("the record states no uncertainties to test against; expected a fixed limit (--limit 1mg)")
    check_uncorrected(record, attitudes.recording)
    latitude, height = of_place(place, gravity, latitude, height)
    local = _gravity(record, at_place(gravity, latitude, height, beside=place is not None), attitudes)
    attitudes = _convert_attitudes(record, attitudes)
    g, order = local.value, model_of(record).order
    scale = g * np.array([record.value(f"scale_factor_{axis}") for axis in "xyz"])
    scaling = Scaling(np.zeros(3), np.abs(scale))
    theta = scaled_parameters(np.array([record.value(name) for name in parameter_names(order)]), scaling, g)
    norm, jacobian, _, _ = norm_and_jacobian(theta[None], (attitudes.mean / scaling.scale)[None], order)
    covariance, of_noise = _noise(record, attitudes, scaling)
    motion = None if attitudes.motion is None else attitudes.motion.scaled(scaling.scale)
    lengthening, noise_variance = length_noise(theta[None], jacobian, covariance[None], motion)
    relative_residuals, rows = (norm - 1 - lengthening)[0], jacobian[0]
    residuals = g * (norm[0] - 1 if motion is None else relative_residuals)
    check_fresh(residuals, g, attitudes.recording.name)
    notes = [*([local.note] if local.note else []), *of_noise]
    if made_from(record, attitudes.recording):
        notes.append(Finding(_MADE_FROM_IT, "check with a fresh recording"))
    if not record.covariance.names:
        return Check(residuals, None, None, None, local, limit, tuple(notes), attitudes)
    from imulab.procedures.tumble.prior import contradiction, known_of
    from imulab.procedures.tumble.prior import scatter_beyond_noise as prior_scatter

    mag = _mag(record, attitudes, notes)
    own_variance = np.maximum(noise_variance[0] + _excess(record, g), 1e-24)  # data without noise leave rounding
    more = prior_scatter(rows, relative_residuals, own_variance)
    if more > 0:
        notes.append(_describe_scatter(more))
    known = known_of(record, scaling, local, attitudes.unit)
    common = 0.0 if known.shared else (local.standard_uncertainty / g) ** 2
    noise = np.diag(own_variance + more) + common
    value, probability = contradiction(relative_residuals, rows, known.covariance, noise)
    freedom = _freedom(record)
    if freedom is not None:
        probability = float(f_tail(value / len(relative_residuals), len(relative_residuals), freedom))
    total = g * np.sqrt(np.diag(rows @ known.covariance @ rows.T + noise))
    return Check(residuals, total, value, probability, local, limit, tuple(notes), attitudes, mag)


_MADE_FROM_IT = "the record was made from this recording, which therefore says nothing of whether it still holds"


def _describe_scatter(variance: float) -> str:
    """Return the finding of attitudes that scatter beyond their noise by a variance, g^2."""
    return Finding(
        f"the attitudes scatter by {1e6 * np.sqrt(variance):.3g} µg beyond their noise, which no change of the "
        "record explains and the test allows for: holds that were disturbed, or a model of too low an order",
        "record the attitudes again, each held still until it has settled",
    )


def _mag(record: Calibration, attitudes: Attitudes, notes: list[str]) -> MagCheck | None:
    """Test the magnetometers where there are any; a note says why not where only the record has them."""
    if fit_of(record).mag is None:
        return None
    from imulab.procedures.tumble.mag.check import FEWEST, check_mag

    name = attitudes.recording.name
    if not all(column in attitudes.recording for column in triad("mag")):
        notes.append(Note(f"{name}: no magnetometers in it: the record's accelerometers alone are tested"))
    elif len(attitudes) < FEWEST:
        notes.append(Note(f"{name}: {len(attitudes)} attitudes; magnetometers are tested by {FEWEST} or more"))
    else:
        return check_mag(record, attitudes)
    return None


def _gravity(record: Calibration, requested: float | str | Gravity | None, attitudes: Attitudes) -> Gravity:
    """What was given, else the head's, else that of the record."""
    if requested is None and "gravity" not in attitudes.recording.metadata:
        stated = model_of(record).gravity
        value, uncertainty = float(stated.value), float(stated.standard_uncertainty or 0.0)
        sentence = f"gravity {value:.6g} m/s^2 was taken from the record, as if measured at the same place"
        return Gravity(value, stated.from_, uncertainty, Note(sentence))
    return local_gravity(requested, attitudes.recording)


def _convert_attitudes(record: Calibration, attitudes: Attitudes) -> Attitudes:
    unit = model_of(record).output_unit
    factor = output_factor(attitudes.recording.name, triad("accel"), attitudes.unit, unit)
    return replace(
        attitudes,
        mean=attitudes.mean * factor,
        covariance=None if attitudes.covariance is None else attitudes.covariance * factor**2,
        motion=None if attitudes.motion is None else attitudes.motion.scaled(np.full(3, 1 / factor)),
        unit=unit,
    )


def _noise(record: Calibration, attitudes: Attitudes, scaling: Scaling) -> tuple[Array, list[str]]:
    """Covariance of the attitudes, g^2, shape (n, 3, 3), and a note on where it is from."""
    if attitudes.covariance is not None:
        return attitudes.covariance / (scaling.scale[:, None] * scaling.scale), []
    g, chi_square = model_of(record).gravity.value, fit_of(record).reduced_chi_square
    stated = attitudes_of(record).standard_uncertainty
    sigma = median(np.array(stated)) if stated else float(np.sqrt(chi_square)) if chi_square else 0.0
    note = Note(
        f"nothing is known of the noise of these attitudes: the {1e6 * sigma / g:.3g} µg of those that the record was "
        "made from were used; a recording, or std_* columns, would say"
    )
    return np.broadcast_to((sigma / g) ** 2 * np.eye(3), (len(attitudes), 3, 3)), [note]


def _excess(record: Calibration, g: float) -> float:
    """Return the excess variance of the record's own attitudes, if significant: fresh ones are taken to have it too."""
    fit = fit_of(record)
    freedom, reduced = fit.degrees_of_freedom, fit.reduced_chi_square
    if fit.noise != "known" or not reduced or freedom < 1:
        return 0.0
    if chi_square_probability(reduced * freedom, freedom) > ATTITUDES_DISTURBED.level:
        return 0.0
    return (fit.excess.value / g) ** 2


def _freedom(record: Calibration) -> float | None:
    """Degrees of freedom where the record's uncertainties rest on a scatter of few residuals; None: noise was known."""
    fit = fit_of(record)
    return None if fit.noise == "known" else float(fit.degrees_of_freedom)
