"""Fresh attitudes against a record, to test whether it still holds."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Unpack

import numpy as np

from imulab.columns import triad
from imulab.errors import OptionError, RecordError
from imulab.estimation.least_squares import chi_square_probability
from imulab.estimation.ranked import median
from imulab.gravity import Gravity, at_place, local_gravity
from imulab.procedures.inputs import Record, as_record
from imulab.procedures.result import Drawn
from imulab.procedures.tumble.apply import output_factor
from imulab.procedures.tumble.attitudes import Attitudes
from imulab.procedures.tumble.checks import check_fresh, made_from
from imulab.procedures.tumble.engineering import small_g
from imulab.procedures.tumble.given import TumbleData, as_attitudes
from imulab.procedures.tumble.mag.check import FEWEST, MagCheck, check_mag
from imulab.procedures.tumble.model import length_noise, norm_and_jacobian, parameter_names
from imulab.procedures.tumble.prior import FALSE_ALARM, SCATTERED, contradiction, known_of, scatter
from imulab.procedures.tumble.record import Scaling, scaled_parameters
from imulab.procedures.tumble.sections import attitudes_of, fit_of, model_of
from imulab.quantities import in_si
from imulab.reading import Reading
from imulab.recording import Array
from imulab.records.calibration import Calibration
from imulab.report.elements import Exhibits
from imulab.verdict import Note


@dataclass(frozen=True, repr=False)
class Check(Drawn):
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

    def exhibits(self) -> Exhibits:
        """Return what its report shows."""
        from imulab.procedures.tumble.checkfigures import exhibits_of_check

        return exhibits_of_check(self, self.attitudes)

    def __repr__(self) -> str:
        p = "" if self.probability is None else f", p = {self.probability:.2g}"
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
        return FALSE_ALARM if self.mag is None or self.probability is None else FALSE_ALARM / 2

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


def check_tumble(
    record: Record,
    data: TumbleData,
    *,
    limit: float | str | None = None,
    gravity: float | str | Gravity | None = None,
    latitude: float | str | None = None,
    height: float | str | None = None,
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
        Largest ``| |f| - g |`` that passes, m/s^2 or a text such as ``"2 mg"``, beside the test.
    gravity
        Where the attitudes were measured, as for `fit_tumble`; else that of the recording's head, or of the record.
    latitude, height
        Instead of gravity, as for `fit_tumble`.
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
        The magnitudes are nowhere near gravity.

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
    local = _gravity(record, at_place(gravity, latitude, height), attitudes)
    attitudes = _in_unit_of(record, attitudes)
    g, order = local.value, model_of(record).order
    scale = g * np.array([record.value(f"scale_factor_{axis}") for axis in "xyz"])
    scaling = Scaling(np.zeros(3), np.abs(scale))
    theta = scaled_parameters(np.array([record.value(name) for name in parameter_names(order)]), scaling, g)
    norm, jacobian, _, _ = norm_and_jacobian(theta[None], (attitudes.mean / scaling.scale)[None], order)
    covariance, of_noise = _noise(record, attitudes, scaling)
    motion = None if attitudes.motion is None else attitudes.motion.scaled(scaling.scale)
    lengthening, own = length_noise(theta[None], jacobian, covariance[None], motion)
    seen, rows = (norm - 1 - lengthening)[0], jacobian[0]
    residuals = g * (norm[0] - 1 if motion is None else seen)
    check_fresh(residuals, g, attitudes.recording.name)
    notes = [*([local.note] if local.note else []), *of_noise]
    if made_from(record, attitudes.recording):
        notes.append("the record was made from this recording, which therefore says nothing of whether it still holds")
    if not record.covariance.names:
        return Check(residuals, None, None, None, local, limit, tuple(notes), attitudes)
    mag = _mag(record, attitudes, notes)
    own_variance = np.maximum(own[0] + _excess(record, g), 1e-24)  # data without noise leave rounding
    more = scatter(rows, seen, own_variance)
    if more > 0:
        notes.append(
            f"the attitudes scatter by {1e6 * np.sqrt(more):.3g} µg beyond their noise, which no change of the record "
            "explains and the test allows for: holds that were disturbed, or a model of too low an order"
        )
    known = known_of(record, scaling, local, attitudes.unit)
    common = 0.0 if known.shared else (local.standard_uncertainty / g) ** 2
    noise = np.diag(own_variance + more) + common
    value, probability = contradiction(seen, rows, known.covariance, noise)
    freedom = _freedom(record)
    if freedom is not None:
        from imulab.estimation.special import fdtrc

        probability = float(fdtrc(len(seen), freedom, value / len(seen)))
    total = g * np.sqrt(np.diag(rows @ known.covariance @ rows.T + noise))
    return Check(residuals, total, value, probability, local, limit, tuple(notes), attitudes, mag)


def _mag(record: Calibration, attitudes: Attitudes, notes: list[str]) -> MagCheck | None:
    """Test the magnetometers where there are any; a note says why not where only the record has them."""
    if fit_of(record).mag is None:
        return None
    name = attitudes.recording.name
    if not all(column in attitudes.recording for column in triad("mag")):
        notes.append(Note(f"{name}: no magnetometers in it: the record's accelerometers alone are tested"))
    elif len(attitudes) < FEWEST:
        notes.append(Note(f"{name}: {len(attitudes)} attitudes; magnetometers are tested by {FEWEST} or more"))
    else:
        return check_mag(record, attitudes)
    return None


def _gravity(record: Calibration, given: float | str | Gravity | None, attitudes: Attitudes) -> Gravity:
    """What was given, else the head's, else that of the record."""
    if given is None and "gravity" not in attitudes.recording.metadata:
        stated = model_of(record).gravity
        value, uncertainty = float(stated.value), float(stated.standard_uncertainty or 0.0)
        sentence = f"gravity {value:.6g} m/s^2 was taken from the record, as if measured at the same place"
        return Gravity(value, stated.from_, uncertainty, Note(sentence))
    return local_gravity(given, attitudes.recording)


def _in_unit_of(record: Calibration, attitudes: Attitudes) -> Attitudes:
    unit = model_of(record).output_unit
    factor = output_factor(attitudes.recording.name, "accel", attitudes.unit, unit)
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
    """Variance of the record's own attitudes beyond their noise, if that was seen: fresh ones will have it too."""
    fit = fit_of(record)
    freedom, reduced = fit.degrees_of_freedom, fit.reduced_chi_square
    if fit.noise != "known" or not reduced or freedom < 1:
        return 0.0
    if chi_square_probability(reduced * freedom, freedom) > SCATTERED:
        return 0.0
    return (fit.excess.value / g) ** 2


def _freedom(record: Calibration) -> float | None:
    """Degrees of freedom where the record's uncertainties rest on a scatter of few residuals; None: noise was known."""
    fit = fit_of(record)
    return None if fit.noise == "known" else float(fit.degrees_of_freedom)
