"""The guide of a live session: fit of the attitudes so far, plan of those to come, and targets.

Source of the plan: D- and A-optimal attitudes of the tumble test (`imulab.procedures.tumble`, planning).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from imulab.columns import triad
from imulab.errors import ImulabError, OptionError, listed
from imulab.gravity import Gravity
from imulab.procedures.tumble.attitudes import Attitudes
from imulab.procedures.tumble.fit import TumbleFit, fit_tumble
from imulab.procedures.tumble.model import parameter_count, parameter_names
from imulab.procedures.tumble.plan import sphere_candidates
from imulab.procedures.tumble.record import FEW_DEGREES
from imulab.procedures.tumble.schema import attitudes_of, fit_of, model_of
from imulab.procedures.tumble.solve import Search, information_rows, quick_set
from imulab.quantities import quantity, split_quantity
from imulab.recording import Array, Recording
from imulab.records.calibration import Calibration
from imulab.units import STANDARD_GRAVITY, from_si, known_units, parse_unit

# Targets, such as ``bias 100 ug, scale_factor 200 ppm``.


_KINDS = {
    "bias": ("acceleration", "ug"),
    "scale_factor": ("number", "ppm"),
    "misalignment": ("angle", "urad"),
    "k2": ("acceleration", "ug"),
    "k3": ("acceleration", "ug"),
}
"""Parameters by the stem of their names; a nonlinearity as its effect at 1 g."""


@dataclass(frozen=True)
class Target:
    """Wanted standard uncertainty of the parameters with one stem: SI, relative for scale factors."""

    stem: str
    value: float
    text: str


def read_targets(text: str | None) -> tuple[Target, ...]:
    """Return the targets in a text; none for None.

    Raises
    ------
    OptionError
        The text is no list of parameters with an uncertainty each, or names one twice.
    """
    targets: list[Target] = []
    for part in (text or "").split(",") if text is not None else []:
        match = re.fullmatch(r"\s*([a-z_0-9]+)\s+(.+?)\s*", part)
        if match is None:
            raise OptionError(f"--target {text!r}: expected a list such as 'bias 100 ug, scale_factor 200 ppm'")
        stem = match[1]
        if stem not in _KINDS:
            raise OptionError(f"--target {text!r}: unknown parameter {stem!r}; known: {listed(_KINDS, stem)}")
        if any(target.stem == stem for target in targets):
            raise OptionError(f"--target {text!r}: {stem} is stated twice; expected one uncertainty for each parameter")
        kind, unit = _KINDS[stem]
        if not split_quantity(match[2], "--target", f"{stem} 100 {unit}")[1]:
            expected = f"expected one of {' '.join(known_units(kind))} after it, as in {stem} 100 {unit}"
            raise OptionError(f"--target {text!r}: {match[2]} without a unit: {expected}")
        value = quantity(match[2], "--target", kind, unit)
        if not 0 < value < float("inf"):
            raise OptionError(f"--target {text!r}: expected standard uncertainties above 0")
        targets.append(Target(stem, value, match[2]))
    return tuple(targets)


def worst_share(target: Target, record: Calibration, gravity: float) -> float:
    """Return the largest ratio of standard uncertainty to target over the target's parameters; infinite without any."""
    return max(target_shares(target, record, gravity).values(), default=float("inf"))


def target_shares(target: Target, record: Calibration, gravity: float) -> dict[str, float]:
    """Return the ratio of standard uncertainty to target for each of the target's parameters."""
    shares = {}
    for name, parameter in record.parameters.items():
        if name.rpartition("_")[0] != target.stem or parameter.standard_uncertainty is None:
            continue
        size = parameter.standard_uncertainty
        if target.stem == "scale_factor":
            size /= abs(parameter.value)
        elif target.stem[0] == "k":
            size *= gravity ** int(target.stem[1:])
        shares[name] = size / target.value
    return shares


def predicted_share(target: Target, uncertainties: dict[str, float], gravity: float) -> float:
    """Return that ratio for predicted uncertainties in units of g; 0 where the model lacks the parameter."""
    factor = gravity if target.stem == "bias" or target.stem[0] == "k" else 1.0
    sizes = [u for name, u in uncertainties.items() if name.rpartition("_")[0] == target.stem]
    return max(sizes, default=0.0) * factor / target.value


# The fit of the attitudes so far, and the plan of those to come.


_USUAL_ORDER = 3
"""Order that is planned for under ``auto``: its attitudes show what an order 2 would leave in the scale factors."""
_MORE = 1.5
"""Attitudes per parameter where neither a number nor a target is stated."""
_SPARE = FEW_DEGREES
"""Attitudes beyond the parameters that a fit needs to find a knocked attitude and to test its order."""
NEAR = np.cos(np.radians(12.0))
"""Cosine of the angle within which an attitude counts as the planned one."""
_HORIZON = 60
"""Most attitudes that are planned ahead: more take seconds, and hardly change which one is next."""
_OFF = 2.0
"""A plan longer or shorter than needed by more than this factor, and two attitudes, is replaced."""
_MUCH = 10.0
"""Scatter of the attitudes over their noise from which it has another cause than noise."""
_FIVE = 5  # attitudes ahead whose gain is computed together
_LOWERS = 0.05  # least relative gain in uncertainty for which a longer hold is asked
_LONGEST = 10.0  # s, the longest hold that is asked for
_PACE = 0.5  # s between two lengths that are looked at
_ROUNDS = 4  # of the search for the number of attitudes still needed
_NAME = "live recording"  # in the messages of its fit
_SEED = 1  # of the search, so that the same attitudes get the same advice
_OTHERS = 0.1
"""Weight of a parameter without a target, relative to that of the parameter with the lowest target."""
_GUESSED_NOISE = 1e-4  # g, of an attitude, before any is held
_PRIOR = 1e-2
"""Uncertainty of parameters before they are measured, in units of g: enough to weigh one hold."""


@dataclass(frozen=True)
class Attitude:
    """An accepted attitude: mean output, covariance of the mean, times and length, s."""

    number: int
    mean: Array
    covariance: Array
    start: float
    stop: float
    seconds: float
    dropped: bool = False


@dataclass
class Guide:
    """The attitudes of a session and the plan of those to come.

    Attributes
    ----------
    order
        Order of the fit, as for `fit_tumble`.
    gravity
        Local gravity, or None: that of the stream's head, or standard gravity.
    targets
        Wanted uncertainties.
    planned
        Number of attitudes that the user wants, or None.
    unit
        Unit of the outputs.
    metadata
        Head of the stream.
    refusal
        Why there is no fit of the attitudes; empty if there is one.
    """

    order: int | str = "auto"
    gravity: Gravity | None = None
    targets: tuple[Target, ...] = ()
    planned: int | None = None
    unit: str = "m/s^2"
    metadata: Mapping[str, str] = field(default_factory=dict)
    attitudes: list[Attitude] = field(default_factory=list)
    fit: TumbleFit | None = None
    refusal: str = ""
    _outstanding: Array = field(default_factory=lambda: np.empty((0, 3)))
    _known: bool = False
    _beyond: bool = False

    @property
    def kept(self) -> list[Attitude]:
        """The attitudes that were not dropped."""
        return [each for each in self.attitudes if not each.dropped]

    @property
    def model_order(self) -> int:
        """Order that attitudes are planned for."""
        return self.order if isinstance(self.order, int) else _USUAL_ORDER

    @property
    def local_gravity(self) -> float:
        """Local gravity as far as known, m/s^2."""
        if self.fit is not None:
            return model_of(self.fit.calibration).gravity.value
        return self.gravity.value if self.gravity else STANDARD_GRAVITY

    @property
    def one_g(self) -> float:
        """Length of a reading at rest, in the unit of the outputs."""
        if parse_unit(self.unit).quantity == "acceleration":
            return from_si(self.local_gravity, self.unit)
        lengths = [float(np.linalg.norm(each.mean)) for each in self.kept]
        return float(np.median(lengths)) if lengths else 1.0

    def accept(self, attitude: Attitude) -> None:
        """Add an attitude, fit again and plan the next ones."""
        self.attitudes.append(attitude)
        self.refit()
        direction = self.directions()[-1]
        near = self._outstanding @ direction if len(self._outstanding) else np.empty(0)
        if near.size and near.max() > NEAR:
            self._outstanding = np.delete(self._outstanding, int(np.argmax(near)), axis=0)
            self._known = len(self._outstanding) > 0 and not self._plan_is_off()
        else:
            self._known = False

    def _plan_is_off(self) -> bool:
        """Whether the plan has far fewer or more attitudes than the scatter, beyond noise, asks for."""
        if not self.targets or self.met or not self.scatter():
            return False
        least, most = len(self._outstanding) / _OFF - 2, len(self._outstanding) * _OFF + 2
        return not least <= min(self._need(), _HORIZON) <= most

    def _need(self) -> float:
        """Return how many more attitudes the uncertainties of the fit ask for, once it is reliable; 0 before."""
        if not self.targets or self.met or self.fit is None or len(self.kept) < self._fewest_reliable:
            return 0.0
        # Variances fall in inverse proportion to the number of attitudes.
        return len(self.kept) * (max(self.shares()) ** 2 - 1)

    @property
    def _fewest_reliable(self) -> int:
        """Number of attitudes from which a fit is reliable."""
        return parameter_count(self.model_order) + _SPARE

    def scatter(self) -> str:
        """Return a message where the attitudes disagree by far more than their noise; empty otherwise."""
        if self.fit is None or len(self.kept) < self._fewest_reliable:
            return ""
        usual = float(np.median([self._attitude_noise(each.mean, each.covariance) for each in self.kept]))
        if self._excess() < _MUCH * usual:
            return ""
        higher = "--order auto" if self.order != "auto" else "a still table"
        return (
            f"the attitudes disagree by {1e3 * self._excess():.2g} mg, {self._excess() / usual:.0f} times what each "
            f"scatters by itself: more of them help little; {higher} may"
        )

    @property
    def _fewest(self) -> int:
        """Number of attitudes without which there is no fit."""
        return parameter_count(self.order if isinstance(self.order, int) else 1)

    @property
    def beyond_plan(self) -> float:
        """Attitudes over those with which a fit is due, as a ratio; 0 with a fit."""
        due = self._fewest_reliable if self.targets else self.wanted()
        return 0.0 if self.fit is not None else len(self.kept) / max(due, self._fewest)

    @property
    def missing(self) -> str:
        """What is missing for a record, in a few words; empty if one can be made."""
        if self.fit is not None:
            return ""
        short = self._fewest - len(self.kept)
        if short > 0:
            return f"at least {short} {'more ' if self.kept else ''}attitude{'s' * (short > 1)}"
        return "attitudes that differ more from each other"

    def too_simple(self) -> str:
        """Return a message where a higher order explains attitudes that would pass for knocked ones; else empty."""
        if self.fit is None:
            return ""
        return next((w for w in self.fit.calibration.warnings if w.startswith("the model is too simple")), "")

    def lengthen(self, attitude: Attitude) -> None:
        """Replace the last attitude by a longer hold of it."""
        self.attitudes[-1] = attitude

    def drop(self, number: int) -> None:
        """Drop an attitude."""
        self.attitudes[number - 1] = replace(self.attitudes[number - 1], dropped=True)
        self.refit()
        self._known = False

    def refit(self) -> None:
        """Fit the attitudes that are kept."""
        try:
            self.fit = fit_tumble(self._kept_attitudes(), order=self.order, gravity=self.gravity)
            self.refusal = ""
        except ImulabError as error:
            self.fit, self.refusal = None, str(error).removeprefix(f"{_NAME}: ")

    def _kept_attitudes(self) -> Attitudes:
        kept = self.kept
        mean = np.array([each.mean for each in kept])
        columns = {name: mean[:, k].copy() for k, name in enumerate(triad("accel"))}
        recording = Recording(columns, dict.fromkeys(columns, self.unit), self.metadata, _NAME)
        rows = np.arange(1.0, len(kept) + 1)
        return Attitudes(
            mean=mean,
            covariance=np.array([each.covariance for each in kept]),
            samples=np.ones(len(kept), dtype=np.int64),
            start=rows,
            stop=rows,
            unit=self.unit,
            recording=recording,
        )

    def directions(self) -> Array:
        """Return the upward direction of the body in each kept attitude, shape (n, 3)."""
        if not self.kept:
            return np.empty((0, 3))
        if self.fit is not None:
            force = np.array(attitudes_of(self.fit.calibration).force)
        else:
            force = np.array([each.mean for each in self.kept])
        directions: Array = force / np.linalg.norm(force, axis=1, keepdims=True)
        return directions

    def residuals(self) -> tuple[Array, NDArray[np.bool_]]:
        """Return ``|f| - g`` of each kept attitude, m/s^2, and whether it agrees with the others, shape (n,)."""
        count = len(self.kept)
        if self.fit is None:
            return np.full(count, np.nan), np.ones(count, dtype=np.bool_)
        return self.fit.residuals, self.fit.down_weights > 0

    def noise(self) -> float:
        """Return the noise of |f| of the median attitude, in units of g, with the scatter between attitudes."""
        noises = [self._attitude_noise(each.mean, each.covariance) for each in self.kept]
        usual = float(np.median(noises)) if noises else _GUESSED_NOISE
        return float(np.hypot(usual, self._excess()))

    def _attitude_noise(self, mean: Array, covariance: Array) -> float:
        up = mean / np.linalg.norm(mean)
        return float(np.sqrt(up @ covariance @ up)) / self.one_g

    def _excess(self) -> float:
        if self.fit is None:
            return 0.0
        return float(fit_of(self.fit.calibration).excess.value) / self.local_gravity

    def hold_needed(self, mean: Array, covariance: Array, seconds: float) -> float:
        """Return from which length, s, twice as long a hold lowers no parameter's standard uncertainty by 5 %.

        The planned attitudes count as measured, each with the usual noise. Searched from the present length on.
        """
        if seconds >= _LONGEST:
            return seconds
        hold_noise, excess, usual = self._attitude_noise(mean, covariance), self._excess(), self.noise()
        others = np.vstack([self.directions(), self.outstanding()])
        rows = information_rows(others, self.model_order) / usual
        row = information_rows((mean / np.linalg.norm(mean))[None], self.model_order)[0]
        base = rows.T @ rows + np.eye(rows.shape[1]) / _PRIOR**2
        lengths = np.append(np.arange(seconds, _LONGEST, _PACE), _LONGEST)
        for length in lengths.tolist():
            now, longer = (
                np.diag(
                    np.linalg.inv(base + np.outer(row, row) / (hold_noise**2 * seconds / (times * length) + excess**2))
                )
                for times in (1.0, 2.0)
            )
            if np.sqrt((longer / now).min()) >= 1 - _LOWERS:
                return float(length)
        return _LONGEST

    @property
    def met(self) -> bool:
        """Whether the targets are met, or, without any, the number of attitudes is reached."""
        if self.targets:
            enough = len(self.kept) >= self._fewest_reliable
            if not enough or self.fit is None or max(self.shares()) > 1.0:
                return False
            return fit_of(self.fit.calibration).degrees_of_freedom >= FEW_DEGREES  # fewer are remarked on
        return self.fit is not None and len(self.kept) >= self.wanted()

    def shares(self) -> list[float]:
        """Return the worst standard uncertainty over each target; infinite before a fit."""
        if self.fit is None:
            return [float("inf")] * len(self.targets)
        return [worst_share(target, self.fit.calibration, self.local_gravity) for target in self.targets]

    def parameter_shares(self) -> dict[str, float]:
        """Return the ratio of standard uncertainty to target for each parameter that has a target."""
        if self.fit is None:
            return {}
        by_target = [target_shares(target, self.fit.calibration, self.local_gravity) for target in self.targets]
        return {name: share for shares in by_target for name, share in shares.items()}

    @property
    def beyond(self) -> bool:
        """Whether the targets need more attitudes than are planned ahead."""
        return self._beyond or self._need() > _HORIZON

    def wanted(self) -> int:
        """Return how many attitudes the session will need in all, as far as known."""
        if self.planned is not None or not self.targets:
            return self.planned or int(np.ceil(_MORE * parameter_count(self.model_order)))
        left = max(len(self.outstanding()), int(not self.met))
        need = int(np.ceil(min(self._need(), _HORIZON)))
        return len(self.kept) + (need if need > left * _OFF + 2 else left)

    def outstanding(self) -> Array:
        """Return the planned attitudes, shape (k, 3)."""
        if not self._known:
            self._known = True
            self._outstanding = self._plan()
        return self._outstanding

    def _plan(self) -> Array:
        there = self.directions()
        spare = _SPARE if self.targets else 0
        least = max(parameter_count(self.model_order) + spare - len(there), 1)
        if self.planned is not None or not self.targets:
            left = self.wanted() - len(there)
            return self._planned(max(min(left, _HORIZON), least), there) if left > 0 or least > 1 else np.empty((0, 3))
        noise = self._noise_as_fitted() if self._plan_is_off() else self.noise()
        count, self._beyond = max(least, 3), False
        tried: list[int] = []
        for _ in range(_ROUNDS):
            tried.append(count)
            covariance = Search(self.model_order, "A", there).covariance(self._planned(count, there, move=False))
            share = self._predicted(covariance, noise)
            # Variances fall as the number of attitudes rises, in proportion.
            need = int(np.ceil((count + len(there)) * share**2)) - len(there)
            count, self._beyond = max(min(need, _HORIZON), least), need > _HORIZON
            if count in tried:
                break
        return self._planned(count, there)

    def _noise_as_fitted(self) -> float:
        """Return the noise, in units of g, for which the predicted uncertainties equal those of the fit so far."""
        noise = self.noise()
        now = Search(self.model_order, "A", self.directions()).covariance(np.empty((0, 3)))
        return noise * max(self.shares()) / self._predicted(now, noise)

    def _predicted(self, covariance: Array, noise: float) -> float:
        sizes = (noise * np.sqrt(np.diag(covariance))).tolist()
        named = dict(zip(parameter_names(self.model_order), sizes, strict=True))
        return max(predicted_share(target, named, self.local_gravity) for target in self.targets)

    def _weight(self) -> Array:
        """Return the weight of each parameter's variance: the lower its target, the larger."""
        names = parameter_names(self.model_order)
        shares = np.array(
            [
                max((predicted_share(t, {name: 1.0}, self.local_gravity) for t in self.targets), default=0.0)
                for name in names
            ]
        )
        weight: Array = np.maximum(shares**2, _OTHERS * (shares.max() ** 2 or 1.0))
        weight /= weight.max()
        return weight

    def _planned(self, count: int, there: Array, *, move: bool = True) -> Array:
        points = sphere_candidates()
        chosen = quick_set(Search(self.model_order, "A", there), points, count, _SEED, weight=self._weight(), move=move)
        if chosen is not None:
            return chosen
        # Readings that no unit at rest has, as of a dead axis, or attitudes too much alike: plan without them.
        fewest = max(count, parameter_count(self.model_order) + 1)
        anew = quick_set(Search(self.model_order, "A", np.empty((0, 3))), points, fewest, _SEED, move=move)
        assert anew is not None
        return anew

    def next_direction(self) -> Array | None:
        """Return the upward direction to take next: the planned one that lowers the worst axis most."""
        waiting = self.outstanding()
        if not len(waiting):
            if self.met:
                return None
            self._outstanding = waiting = self._planned(1, self.directions())
        search = Search(self.model_order, "A", self.directions())
        rows = information_rows(waiting, self.model_order)
        variance = np.diag(search.covariance(np.empty((0, 3)))).reshape(-1, 3)
        weight = (variance / variance.mean(axis=1, keepdims=True)).ravel()
        best: Array = waiting[int(np.argmax(search.gain(rows, np.empty((0, rows.shape[1])), weight)))]
        return best

    def five_more(self) -> str:
        """Return a sentence on the gain of five more attitudes for the worst bias."""
        if self.fit is None:
            return ""
        there = self.directions()
        search = Search(model_of(self.fit.calibration).order, "A", there)  # of the fit whose bias this is
        more = self._planned(_FIVE, there)
        now, then = (np.sqrt(np.diag(search.covariance(each))[:3].max()) for each in (np.empty((0, 3)), more))
        worst = max(u for axis in "xyz" if (u := self.fit.calibration.parameters[f"bias_{axis}"].standard_uncertainty))
        micro = 1e6 * worst / self.local_gravity
        return f"five more would bring the worst bias from {micro:.3g} to about {micro * then / now:.3g} µg"
