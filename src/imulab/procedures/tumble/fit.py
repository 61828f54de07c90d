"""Static attitudes to a calibration of the accelerometer triad."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, TypeAlias, Unpack

from numpy.typing import ArrayLike

from imulab.errors import OptionError
from imulab.estimation.least_squares import Observability
from imulab.gravity import (
    Gravity,
    Height,
    Latitude,
    LocalGravity,
    StatedSite,
    at_latitude,
    at_place,
    local_gravity,
    of_place,
)
from imulab.options import FURTHER_TRIADS, PROGRAM, RARE, choice, measure, parsed
from imulab.procedures import tumble
from imulab.procedures.result import Record, Result, as_record
from imulab.procedures.tumble import FURTHER, HEMISPHERES, LOSSES, METHODS, ORDERS
from imulab.procedures.tumble.attitudes import Attitudes, TumbleData, as_attitudes
from imulab.procedures.tumble.estimate import (
    check_options,
    checked_scaling,
    estimate_triad,
    further_triads,
    with_assumed_alignment,
)
from imulab.procedures.tumble.model import parameter_count
from imulab.procedures.tumble.record import Estimate, make_record
from imulab.procedures.tumble.schema import OrderRow, model_of
from imulab.procedures.tumble.solve import SOURCE_THRESHOLD, Threshold
from imulab.quantities import in_si, whole
from imulab.readers.streams import own_clock
from imulab.recording import Array, Reading
from imulab.records.calibration import Calibration

if TYPE_CHECKING:
    from imulab.procedures.tumble.mag.solve import Dip as StatedDip
    from imulab.procedures.tumble.mag.solve import Place
    from imulab.procedures.tumble.montecarlo import MonteCarlo


@dataclass(frozen=True, repr=False)
class TumbleFit(Result):
    """Result of a tumble fit.

    Attributes
    ----------
    calibration
        The record, with parameters in SI and their covariance.
    observability
        Rank, condition number and the combination that the attitudes determine worst.
    orders
        The table of orders, where the order was chosen from the data; empty otherwise.
    residuals
        ``|f| - g`` of each attitude, m/s^2, shape (n,).
    down_weights
        Factors of Huber's loss, shape (n,); without it ones, and zeros for attitudes set aside.

    All but the record are of the accelerometers by themselves.

    Examples
    --------
    >>> import imulab as il
    >>> fit = il.fit_tumble(il.simulate_tumble(order=1, gravity=9.81362), gravity=9.81362)
    >>> fit.residuals.shape, fit.observability.rank
    ((24,), 9)
    """

    calibration: Calibration
    observability: Observability
    orders: tuple[OrderRow, ...]
    residuals: Array
    down_weights: Array


Dip: TypeAlias = Annotated[
    float | str | tuple[float, float] | None, parsed(tumble.dip, "67.2+-0.2", unit="deg"), FURTHER_TRIADS
]


def fit_tumble(
    data: TumbleData,
    *,
    order: Annotated[int | str, parsed(tumble.order, "auto|0..5|blend", ORDERS)] = "auto",
    gravity: LocalGravity = None,
    latitude: Latitude = None,
    height: Height = None,
    place: StatedSite = None,
    method: Annotated[str, choice(METHODS)] = "norm",
    loss: Annotated[str, choice(LOSSES)] = "auto",
    nonlinearity: Annotated[tuple[float, float] | str | None, parsed(tumble.nonlinearity, "20ug,20ug"), RARE] = None,
    asymmetry: Annotated[float | str | None, measure("number", "ppm", "20ppm"), RARE] = None,
    prior: Annotated[Record | None, RARE] = None,
    ageing: Annotated[Sequence[float] | str, parsed(tumble.ageing, "100ug,100ppm[,50urad]"), RARE] = (),
    monte_carlo: Annotated[int | str | None, RARE] = None,
    cross: Annotated[bool, RARE] = False,
    threshold: Annotated[Sequence[float] | str | None, parsed(tumble.threshold, "5ppm,2ug,3arcsec"), RARE] = None,
    preset: Annotated[Sequence[float] | float | str | None, parsed(tumble.preset, "K[,K,K]"), RARE] = None,
    with_: Annotated[str | Sequence[str], parsed(further_triads, "gyro,mag", FURTHER), FURTHER_TRIADS] = (),
    field: Annotated[float | str | None, measure("magnetic field", "uT", "48.2uT"), FURTHER_TRIADS] = None,
    hemisphere: Annotated[str | None, choice(HEMISPHERES), FURTHER_TRIADS] = None,
    dip: Dip = None,
    covariance: Annotated[ArrayLike | None, PROGRAM] = None,
    progress: Callable[[int], None] = lambda _: None,
    **reading: Unpack[Reading],
) -> TumbleFit:
    """Calibrate an accelerometer triad from static attitudes.

    Method ``norm`` minimises ``sum_p w_p (|f(M_p)| - g - (tr C_p - u' C_p u) / 2g)^2`` with ``w_p = 1 / u' C_p u``;
    ``linearised`` is the published first-order iteration.

    Parameters
    ----------
    data
        A file, recording, data frame or arrays with columns ``accel_x``, ``_y``, ``_z``; the triad alone, shape (n, 3);
        or attitudes from `find_attitudes`. Without a time each row is an attitude.
    order
        auto: by prediction; 0 (bias and scale factor only) to 5; blend: all, as far as data support them. With method
        linearised ``"auto"`` is 4, as in its source; else it takes the order that predicts best among those that the
        attitudes can see, with an uncertainty that holds whatever the order.
    gravity
        Local gravity, as 9.81362 or 9.81362+-0.00002; else of the head. The standard uncertainty of such a text enters
        that of the scale factors; without one the recording's head has it, or it is standard gravity, with a warning.
    latitude
        Latitude, for normal gravity; with gyro for the Earth's rate. It stands in place of gravity, where that is
        normal gravity, as a text (``"47.4 deg"``) or in rad; what a place differs by is part of the uncertainty. With
        ``"gyro"`` it is that of `fit_gyro` too, and may stand beside gravity.
    height
        Height above the ellipsoid, for gravity. Beside the latitude.
    place
        Where it is measured: 48.1,11.6,520. Latitude, longitude and height, deg and m, in place of latitude and height.
    method
        norm: by the length of f; linearised: the published first-order iteration.
    loss
        auto: set knocked attitudes aside and name them; square: keep all; huber: limit them. ``"auto"`` sets aside what
        no order explains (and is ``"square"`` with method linearised); ``"huber"`` limits the pull of single disturbed
        ones (method norm only).
    nonlinearity
        Standard deviations of k2 (1/g^2) and k3 (1/g^3), if known. About zero, as numbers in units of 1/g and 1/g^2, or
        as ``"20ug,20ug"``; order auto or blend.
    asymmetry
        Standard deviation of half the difference of a scale factor between + and -, if known. Relative, as a number or
        as ``"20ppm"``; order auto or blend. It looks like k2, and shifts biases; unknown, it is in their uncertainties,
        beside `nonlinearity` with the standard deviation of k2.
    prior
        Earlier record of this unit, or one over temperature, as prior knowledge. A record or its file, taken as a
        normal distribution of the parameters, which is widened by what the attitudes say that it aged; gives the order
        under ``"auto"``. Needs method norm, loss square and stated or measured noise. A thermal record is one at the
        temperature of the recording.
    ageing
        What the unit may have changed since the prior, if known. Standard deviations of what biases (m/s^2), scale
        factors (1) and misalignments (rad) changed, as many as are known, or as ``"100ug,100ppm"``; the attitudes tell
        the others.
    monte_carlo
        Trials of a propagation of distributions, 1000 or more. JCGM 101, method norm only; none if not given.
    cross
        Fit cross terms k_xy, k_yz, k_zx: products of two axes. At an order that is given; no attitude is set aside
        then.
    threshold
        Changes of scale factors, biases and misalignments at which method linearised rests; the source's "5 ppm, 2 ug,
        3 arcsec" if not given. From one pass to the next, as numbers in 1, m/s^2 and rad.
    preset
        Scale factors that method linearised starts from, output per g, one for all axes or three; else nominal ones.
        Where the outputs are counts or volts, nominal is half the span of each axis, with its middle as zero.
    with_
        Further triads on the same attitudes, in one record. ``"gyro"``, ``"mag"`` or both, ``"gyro,mag"``: the record
        is that of `fit_mag` and then `fit_gyro` on the record of the accelerometers. With ``"mag"`` needs method norm,
        order auto or 1 to 5 without cross terms, and neither prior, nonlinearity nor Monte Carlo.
    field
        With mag: magnitude of the local field; else the field is 1. In T, or a text such as ``"48.2uT"``.
    hemisphere
        With mag: to check the sign of the dip; without it by the latitude.
    dip
        With mag: dip of the place, to compare with the one found. As for `fit_mag`.
    covariance
        Of means of attitudes without a time, in their squared unit, shape (3, 3) or (n, 3, 3).
    progress
        Called with the number of trials done so far.
    reading
        How arrays and files are to be understood: `rate` or `time`, `unit` or `units`; `layout`, `topic`, `instance`,
        `window`, `element`.

    Raises
    ------
    ObservabilityError
        The attitudes cannot separate the model's parameters; the message names them and what would help.
    DataError
        The attitudes cannot be those of an accelerometer triad in the given unit.
    OptionError
        An option has an unknown value, or does not go with another.
    RecordError
        The prior lacks a parameter, or has outputs in another unit.

    What the further triads are refused for is said at `fit_mag` and `fit_gyro`.

    Examples
    --------
    A simulated unit, whose true bias stands in the recording's head:

    >>> import imulab as il
    >>> recording = il.simulate_tumble(order=1, gravity=9.81)
    >>> fit = il.fit_tumble(recording, order=1, gravity=9.81)
    >>> abs(fit.calibration.parameters["bias_x"].value - float(recording.metadata["truth_bias_x"])) < 1e-3
    True

    The same of an array, with the text for people:

    >>> il.fit_tumble(recording.triad("accel"), rate=100.0, unit="m/s^2", order=1, gravity=9.81).save("unit.json")

    All nine axes of a unit:

    >>> recording = il.simulate_tumble(order=1, gravity=9.81, field="48 uT")
    >>> nine = il.fit_tumble(recording, order=1, gravity=9.81, with_="gyro,mag", field="48 uT").calibration
    >>> [nine.parameters[name].unit for name in ("bias_x", "gyro_bias_x", "mag_bias_x")]
    ['m/s^2', 'rad/s', 'T']
    """
    order = tumble.order(order, "order") if isinstance(order, str) else order
    nonlinearity, ageing, asymmetry, magnitude = _as_numbers(nonlinearity, ageing, asymmetry, field)
    threshold, preset = _iteration(threshold, preset)
    monte_carlo = None if monte_carlo is None else whole(monte_carlo, "monte_carlo")
    further = further_triads(with_, "with_")
    check_options(
        order, method, loss, monte_carlo=monte_carlo, with_prior=prior is not None, ageing=ageing, cross=cross, dip=dip,
        nonlinearity=nonlinearity, asymmetry=asymmetry, threshold=threshold, preset=preset, further=further,
        field=magnitude, hemisphere=hemisphere,
    )  # fmt: skip
    latitude, height = of_place(place, gravity, latitude, height)
    stated = _stated_place(further, hemisphere, latitude, dip)
    attitudes = as_attitudes(data, reading, fit_tumble, covariance)
    beside = "gyro" in further or place is not None
    local = local_gravity(at_place(gravity, latitude, height, beside=beside), attitudes.recording)
    scaling = checked_scaling(attitudes, local.value, method, preset)
    known, order = _known_and_order(prior, order, method, attitudes)
    rest = _threshold(threshold, local.value) if method == "linearised" else None
    estimate = estimate_triad(
        attitudes, local, scaling, order, loss, rest, nonlinearity=nonlinearity, asymmetry=asymmetry, prior=known,
        ageing=ageing, cross=cross,
    )  # fmt: skip
    options = {
        "order": order, "method": method, "loss": loss, "gravity": local.option,
        "nonlinearity": nonlinearity and list(nonlinearity), "asymmetry": asymmetry, "monte_carlo": monte_carlo,
        "cross": cross or None, "threshold": rest and rest.in_si(local.value), "preset": preset and list(preset),
    }  # fmt: skip
    trials = None if monte_carlo is None else _propagated(estimate, monte_carlo, progress)
    record = make_record(estimate, local, scaling, {k: v for k, v in options.items() if v is not None}, trials)
    return TumbleFit(
        _with_further(with_assumed_alignment(record), further, attitudes, local, loss, magnitude, stated, latitude),
        estimate.observability, estimate.orders, local.value * estimate.found.solution.deviations[0],
        estimate.found.solution.down_weights[0],
    )  # fmt: skip


def _as_numbers(
    nonlinearity: tuple[float, float] | str | None,
    ageing: Sequence[float] | str,
    asymmetry: float | str | None,
    field: float | str | None,
) -> tuple[tuple[float, float] | None, Sequence[float], float | None, float | None]:
    """Return nonlinearity, ageing, asymmetry and field, which may be texts, as numbers."""
    return (
        tumble.nonlinearity(nonlinearity, "nonlinearity") if isinstance(nonlinearity, str) else nonlinearity,
        tumble.ageing(ageing, "ageing") if isinstance(ageing, str) else ageing,
        None if asymmetry is None else in_si(asymmetry, "asymmetry", "number", "ppm"),
        None if field is None else in_si(field, "field", "magnetic field", "uT"),
    )


def _iteration(
    threshold: Sequence[float] | str | None, preset: Sequence[float] | float | str | None
) -> tuple[Sequence[float] | None, tuple[float, ...] | None]:
    """Return where method linearised rests and where it starts, as numbers."""
    rest = tumble.threshold(threshold, "threshold") if isinstance(threshold, str) else threshold
    return rest, None if preset is None else tumble.preset(preset, "preset")


def _known_and_order(
    prior: Record | None, order: int | str, method: str, attitudes: Attitudes
) -> tuple[Calibration | None, int | str]:
    """Return the prior's record, and the order: where it is auto that of the prior or of the method's source."""
    if prior is not None:
        known = prior_record(as_record(prior, "fit_tumble: prior"), attitudes)
        return known, _prior_order(known, order, attitudes)
    return None, tumble.SOURCE_ORDER if order == "auto" and method == "linearised" else order


def _stated_place(
    further: Sequence[str], hemisphere: str | None, latitude: float | str | None, dip: StatedDip | None
) -> Place | None:
    """Return what is stated of the field at a place; None without magnetometers, whose code is not imported then."""
    if "mag" not in further:
        if latitude is not None:
            in_si(latitude, "latitude", "angle", "deg")  # a wrong text is refused before data are read
        return None
    from imulab.procedures.tumble.mag.solve import parse_place

    return parse_place(hemisphere, latitude, dip)


def _with_further(
    record: Calibration,
    further: Sequence[str],
    attitudes: Attitudes,
    gravity: Gravity,
    loss: str,
    field: float | None,
    place: Place | None,
    latitude: float | str | None,
) -> Calibration:
    """Return the record with further triads, each fitted on the record of those before it."""
    if place is not None:
        from imulab.procedures.tumble.mag.fit import fit_mag

        record = fit_mag(
            attitudes, accel=record, gravity=gravity, loss=loss, field=field, hemisphere=place.hemisphere, dip=place.dip
        ).calibration
    if "gyro" in further:
        from imulab.procedures.tumble.gyro.fit import fit_gyro_triad, with_gyro

        recording = own_clock(attitudes.as_read or attitudes.recording, "gyro")
        gyro_fit = fit_gyro_triad(record, attitudes, recording, apart=False, earth=at_latitude(latitude))
        record = with_gyro(record, gyro_fit, recording, recording)
    return record


def _threshold(changes: Sequence[float] | None, gravity: float) -> Threshold:
    """Return the changes at which method linearised rests, biases in g."""
    return SOURCE_THRESHOLD if changes is None else Threshold(changes[0], changes[1] / gravity, changes[2])


def _propagated(estimate: Estimate, trials: int, progress: Callable[[int], None]) -> MonteCarlo:
    """Propagate the noise of the attitudes; refuse attitudes that tell nothing of theirs."""
    if estimate.given_order is None:
        attitudes, order = estimate.attitudes, estimate.problem.order
        raise OptionError(
            f"{attitudes.recording.name}: monte-carlo needs more attitudes than parameters, or their noise (std_* "
            f"columns); found {len(attitudes)} attitudes for {parameter_count(order)} parameters"
        )
    from imulab.procedures.tumble.montecarlo import propagate

    freedom = estimate.given_order.freedom
    return propagate(estimate.problem, estimate.solution, trials=trials, freedom=freedom, progress=progress)


def prior_record(record: Calibration, attitudes: Attitudes) -> Calibration:
    """Return a record as a prior of these attitudes: one over temperature at theirs; errors as for `at_temperature`."""
    if record.procedure != "thermal":
        return record
    from imulab.procedures.thermal.device import at_temperature

    return at_temperature(record, attitudes.temperature, attitudes.recording.name)


def _prior_order(prior: Calibration, order: int | str, attitudes: Attitudes) -> int:
    """Return the order of the prior, which is that of the fit."""
    if prior.procedure != "tumble" or not prior.covariance.names:
        raise OptionError("prior: expected a tumble record that states uncertainties")
    if attitudes.covariance is None:
        raise OptionError(
            f"{attitudes.recording.name}: a prior needs the noise of the attitudes, to be weighed against: a "
            "recording, or std_* columns"
        )
    prior_order = model_of(prior).order
    if order not in ("auto", prior_order):
        raise OptionError(f"order {order} with a prior of order {prior_order}: expected order {prior_order} or auto")
    return prior_order
