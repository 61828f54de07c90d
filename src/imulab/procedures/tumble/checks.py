"""Is this a tumble test of an accelerometer at all? One clear sentence for each way in which it may not be."""

from __future__ import annotations

import numpy as np

from imulab.columns import triad
from imulab.errors import DataError, RecordError
from imulab.estimation.decisions import SCALE_OFF_UNIT
from imulab.estimation.likely_unit import ANOTHER_RANGE, no_gravity, unit_instead
from imulab.estimation.rows import median
from imulab.procedures.tumble import HIGHEST_ORDER
from imulab.procedures.tumble.attitudes import Attitudes, Motion
from imulab.procedures.tumble.model import GAUGE, parameter_names
from imulab.procedures.tumble.schema import data_of, model_of
from imulab.procedures.tumble.solve import TumbleSolution
from imulab.recording import Array, Recording
from imulab.records.calibration import Calibration
from imulab.units import from_si, parse_unit, to_si

_TILTED = 20.0  # deg: smaller changes of the upward direction are no tilts
_MANY_ROWS = 200  # rows of a table of means from which samples may have been taken for attitudes
_ENOUGH_TO_TELL = 5  # attitudes in which an axis that works has turned
_DEAD_SPAN = 0.02  # of the largest span of the three axes: an axis that spans less is dead
_GYRO_SPAN = 0.05  # of the swing within the recording: outputs whose holds differ by less are rates
_PROPORTIONAL = 0.9999  # correlation of two axes from which one is a copy of the other
_FARTHEST = 5.0  # times the usual magnitude, or its inverse: such an attitude is no specific force
_ANOTHER_UNIT = 2.5  # times g, or its inverse, beyond which nothing is fitted; half and twice g are judged after
_FLAT = 0.05  # of the largest extent of the outputs: flatter ones do not show their centre
_FAR_ZERO = 0.3  # of g: where the zero is nearer, a fit may start from 0
_WORST_RMS = 0.1  # g: what a fit may leave; more is no triad of accelerometers at rest
_LEAST_EIGENVALUE = 1e-12  # of a stated correlation matrix, for rounding
_SHAKES, _LEAST_SHORTENING = 3.0, 2e-5  # standard uncertainties of |f| in an attitude; of g


def check_attitudes(attitudes: Attitudes, gravity: float, zero: Array) -> None:
    """Check that attitudes can be those of an accelerometer triad under `gravity`, m/s^2; `zero` is their `far_zero`.

    Raises
    ------
    DataError
        A gyroscope's recording, a dead or doubled axis, a wrong unit.
    """
    _check_turned(attitudes)
    _check_magnitude(attitudes, gravity, zero)


def _check_turned(attitudes: Attitudes) -> None:
    name, unit = attitudes.recording.name, attitudes.unit
    span = np.ptp(attitudes.mean, axis=0)
    columns = triad("accel")
    for axis, column in enumerate(columns):
        for other in range(axis):
            if np.array_equal(attitudes.mean[:, axis], attitudes.mean[:, other]):
                raise DataError(
                    f"{name}: columns {columns[other]} and {column} hold the same samples; "
                    f"expected three different axes"
                )
    if len(attitudes) >= _ENOUGH_TO_TELL and (span > 0).all():
        centred = attitudes.mean - attitudes.mean.mean(axis=0)
        centred = centred / np.linalg.norm(centred, axis=0)
        correlation = centred.T @ centred
        for axis, other in ((1, 0), (2, 0), (2, 1)):
            if abs(correlation[axis, other]) > _PROPORTIONAL:
                raise DataError(
                    f"{name}: columns {columns[other]} and {columns[axis]} are proportional (correlation "
                    f"{correlation[axis, other]:+.5f} over the attitudes); expected three different axes"
                )
    if attitudes.swing is not None and len(attitudes) >= _ENOUGH_TO_TELL:
        swing = float(attitudes.swing.max())
        if span.max() < _GYRO_SPAN * swing:
            raise DataError(
                f"{name}: columns accel_x accel_y accel_z: at rest the outputs change by {span.max():.3g} {unit} from "
                f"attitude to attitude, while moving by {swing:.3g} {unit}; expected gravity to turn through the axes: "
                "is this a gyroscope's recording?"
            )
    if len(attitudes) >= _ENOUGH_TO_TELL and span.min() < _DEAD_SPAN * span.max():
        axis = int(np.argmin(span))
        raise DataError(
            f"{name}: column {columns[axis]}: the output changes by only {span[axis]:.3g} {unit} over the "
            f"{len(attitudes)} attitudes, the other axes by up to {span.max():.3g} {unit}: a dead axis, or one that "
            "was never turned towards the vertical"
        )


def untilted(means: Array) -> str:
    """Return that a unit was never tilted, where its mean outputs have one direction; else nothing."""
    lengths = np.linalg.norm(means, axis=1, keepdims=True)
    directions = means / np.where(lengths > 0, lengths, 1.0)
    middle = directions.mean(axis=0)
    if not lengths.all() or not middle.any():
        return ""
    spread = np.degrees(np.arccos(np.clip(directions @ middle / np.linalg.norm(middle), -1, 1)).max())
    if not spread < _TILTED:
        return ""
    return f": the unit was never tilted, the same axis is up within {max(spread, 1.0):.0f} deg in all of them"


def _check_magnitude(attitudes: Attitudes, gravity: float, zero: Array) -> None:
    unit = parse_unit(attitudes.unit)
    if unit.quantity != "acceleration" or untilted(attitudes.mean):  # an offset and gravity cannot be told apart
        return
    lengths = to_si(np.linalg.norm(attitudes.mean - zero, axis=1), unit.symbol)
    force = median(lengths)
    if not gravity / _ANOTHER_UNIT <= force <= _ANOTHER_UNIT * gravity:
        other = unit_instead(force / gravity, unit.symbol, SCALE_OFF_UNIT) or "UNIT"
        another_range = no_gravity(force, unit.symbol).action == ANOTHER_RANGE
        mend = ANOTHER_RANGE if another_range else f"is the unit wrong? --unit accel={other} states another"
        raise DataError(
            f"{attitudes.recording.name}: columns accel_x accel_y accel_z: the specific force at rest is about "
            f"{from_si(force, unit.symbol):.4g} {unit.symbol}, expected {from_si(gravity, unit.symbol):.4g} "
            f"{unit.symbol}: {mend}"
        )
    magnitude = lengths / gravity
    far = (magnitude < 1 / _FARTHEST) | (magnitude > _FARTHEST)
    if far.any():
        index = int(np.argmax(far))
        raise DataError(
            f"{attitudes.recording.name}: {attitudes.label(index)}, columns accel_x accel_y accel_z: "
            f"the specific force is {from_si(magnitude[index] * gravity, unit.symbol):.4g} {unit.symbol}, expected "
            f"about {from_si(gravity, unit.symbol):.4g} {unit.symbol}{_untimed(attitudes)}"
        )


def far_zero(mean: Array) -> Array:
    """Return the centre of the sphere that outputs at rest lie on, shape (3,); 0 where it is near, or not to be told.

    ``|M|^2 = 2 c M + d`` by least squares: firmware that takes gravity off leaves offsets of 1 g and more.
    """
    size = float(np.abs(mean).max())
    if len(mean) < _ENOUGH_TO_TELL or not size:
        return np.zeros(3)
    scaled = mean / size
    middle, squares = scaled.mean(axis=0), (scaled**2).sum(axis=1)
    centred = scaled - middle
    normal = centred.T @ centred
    spread = np.linalg.eigvalsh(normal)
    if spread[0] <= _FLAT**2 * spread[-1]:
        return np.zeros(3)
    zero = np.linalg.solve(2 * normal, centred.T @ squares)
    radius_squared = squares.mean() - 2 * zero @ middle + zero @ zero
    return size * zero if zero @ zero > _FAR_ZERO**2 * radius_squared else np.zeros(3)


def _untimed(attitudes: Attitudes) -> str:
    """Return what to say of a table that may be a recording whose time was left out."""
    if attitudes.trace is not None or len(attitudes) <= _MANY_ROWS:
        return ""
    return "; without a column time every row is an attitude: a recording needs one, or a layout with sample_rate"


def check_residuals(attitudes: Attitudes, solution: TumbleSolution, gravity: float) -> None:
    """Check after the fit that |f| = g holds at all.

    Raises
    ------
    DataError
        It is off by more than a tenth of g in the median attitude.
    """
    typical = median(np.abs(solution.deviations[0]))
    if not typical < _WORST_RMS:
        raise DataError(
            f"{attitudes.recording.name}: the calibrated magnitudes miss gravity ({gravity:.5g} m/s^2) by "
            f"{typical * gravity:.3g} m/s^2 in the median attitude: these are not static attitudes of an accelerometer"
        )


def shake_warnings(motion: Motion | None, solution: TumbleSolution) -> list[str]:
    """Say that holds shake too fast for magnitudes to be averaged, if that may matter: a tilt to and fro shortens f."""
    if motion is None:
        return []
    shake = median(motion.shake.sum(axis=1))
    if shake / 2 < max(_SHAKES * median(np.sqrt(solution.own_variance[0])), _LEAST_SHORTENING):
        return []
    return [
        f"the unit shakes by {1e3 * np.sqrt(shake):.2g} mg rms within an eighth of a second while it is held: if it "
        f"tilts to and fro, as in a hand that trembles, scale factors are up to {1e6 * shake / 2:.2g} ppm too small; "
        "put it on something firm"
    ]


def check_fresh(residuals: Array, gravity: float, name: str) -> None:
    """Check that fresh attitudes can be held against a record at all: |f| - g of each, shape (n,), and g, m/s^2.

    Raises
    ------
    DataError
        The magnitudes are nowhere near gravity.
    """
    force = median(residuals) + gravity
    if not gravity / 2 <= force <= 2 * gravity:
        raise DataError(
            f"{name}: columns accel_x accel_y accel_z: the specific force at rest is about {force:.4g} m/s^2 under the "
            f"record, expected {gravity:.4g} m/s^2: a wrong unit, or a record of another unit?"
        )


def check_uncorrected(record: Calibration, recording: Recording) -> None:
    """Check that a recording was not corrected by the record that it is to be held against.

    Raises
    ------
    DataError
        It was: what is left says nothing of the unit.
    """
    digest = record.to_dict()["content_sha256"]
    for entry in recording.corrected_by:
        name, _, corrected = entry.rpartition(" sha256:")
        if corrected == digest:
            raise DataError(
                f"{recording.name}: already corrected by {name}: a second time would take its errors off twice; "
                "expected the recording as it was measured"
            )


def made_from(record: Calibration, recording: Recording) -> bool:
    """Return whether a record was made from samples of this recording, and not from another window of its file."""
    source, time = recording.source, recording.time
    if source is None or source.sha256 not in [made.sha256 for made in record.sources]:
        return False
    held = data_of(record).attitudes
    if time is None or not len(time) or held is None:
        return True
    return any(b >= time[0] and a <= time[-1] for a, b in held.stretches)


def check_prior(record: Calibration) -> None:
    """Check that a record can be a prior: a normal distribution of all its parameters, in this model and gauge.

    Raises
    ------
    RecordError
        The message says what is missing.
    """
    if record.procedure != "tumble":
        raise RecordError(f"a {record.procedure} record cannot be a prior; expected a tumble record")
    if not record.covariance.names:
        raise RecordError("a record that states no uncertainties cannot be a prior")
    model = model_of(record)
    order = model.order
    if order > HIGHEST_ORDER:
        raise RecordError(f"a record of order {order} cannot be a prior; expected 0 to {HIGHEST_ORDER}")
    if model.cross:
        raise RecordError("a record with cross terms cannot be a prior")
    if model.gauge != GAUGE:
        raise RecordError(f"a record in the gauge {model.gauge!r} cannot be a prior; expected {GAUGE!r}")
    for name in parameter_names(order):
        if name not in record.parameters or name not in record.covariance.names:
            raise RecordError(f"the record has no {name}, or no covariance of it, and cannot be a prior")
    block = record.covariance.block(parameter_names(order))
    for name, variance in zip(parameter_names(order), np.diag(block).tolist(), strict=True):
        if not 0 < variance < np.inf:
            raise RecordError(f"the record's {name} has the variance {variance:g}; a prior needs more than 0 for each")
    spread = np.sqrt(np.diag(block))
    if not np.linalg.eigvalsh(block / np.outer(spread, spread))[0] > _LEAST_EIGENVALUE:
        raise RecordError("the record's covariance is not positive definite, and cannot be a prior")
