"""What a schedule over temperature gives of the gyroscopes: rates at rest, and the turns that scale factors take.

As `imulab.procedures.thermal.gyro` fits them: the laws of the biases, the g-sensitivities and offsets of each power
cycle, from means at rest whose noise is that of the angle random walk and of the Earth's rate, whose vertical part the
g-sensitivities take up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from imulab.errors import OptionError
from imulab.procedures.thermal.choices import FOLLOWED, TURNED
from imulab.procedures.thermal.gyroearth import VERTICAL, new_in_each
from imulab.procedures.thermal.model import Laws
from imulab.quantities import RANDOM_WALK, in_si, of_units
from imulab.recording import Array
from imulab.units import from_si

NOISE, TURN_ON_SCATTER = "0.3 deg/sqrt(h)", "0.01 deg/s"


@dataclass(frozen=True)
class GyroPlan:
    """What a plan over temperature will give of the gyroscopes.

    Attributes
    ----------
    deviation
        Standard deviation of a component of the corrected rate at rest at the plan's temperatures, root mean square
        over attitudes, rad/s, shape (m,).
    noise
        Angle random walk, rad/sqrt(s).
    turn_on_scatter
        Of the biases from one power cycle to the next, rad/s.
    turns, turned_at
        Turns between attitudes that tell scale factors, and at how many temperatures: of soaks of nine attitudes or
        more.
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

    def said(self, temperature: Array) -> str:
        """Return what the plan predicts in sentences; `temperature` as of the plan, degC."""
        worst = int(np.argmax(self.deviation))
        known = f"{hourly(self.mean)} deg/h, {hourly(self.deviation[worst])} deg/h where they are worst"
        walk = f"{self.noise / RANDOM_WALK['deg/sqrt(h)']:.3g} deg/sqrt(h)"
        return (
            f"The gyroscopes' laws will give a component of the rate at rest to {known}, at "
            f"{temperature[worst]:.0f} degC, by an angle random walk of {walk}, {hourly(self.turn_on_scatter)} deg/h "
            f"of turn-on scatter and the Earth's rate from unknown directions. {self._turned()}"
        )

    def _turned(self) -> str:
        if not self.turns:
            return (
                f"No soak has the {TURNED} attitudes whose turns tell scale factors: these soaks with as many take "
                f"{self.needed / 3600:.3g} h."
            )
        follow = "and how they follow it" if self.turned_at >= FOLLOWED else "taken as constant"
        at = "temperature" if self.turned_at == 1 else "temperatures"
        return f"{self.turns} turns at {self.turned_at} {at} will tell scale factors, {follow}."


def hourly(rate: float) -> str:
    """Return a rate in deg/h, as text."""
    return f"{from_si(float(rate), 'deg/h'):.3g}"


def noise_and_scatter(
    noise: float | str | None, turn_on_scatter: float | str | None, *, asked: bool
) -> tuple[float, float] | None:
    """Return the angle random walk, rad/sqrt(s), and the scatter of biases between power cycles, rad/s.

    None where gyroscopes are not `asked` for.

    Raises
    ------
    OptionError
        One is out of range, or given where they are not asked for.
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
    """Predict what soaks give of gyroscopes.

    Parameters
    ----------
    laws
        Of the accelerometers, whose degree of the bias the gyroscopes' have too.
    places
        Temperatures at which to predict, degC, shape (m,).
    soaks
        Temperature, degC, and upward directions, (n, 3), of each.
    times
        Of a soak, and of an attitude, all of which counts as rest, s.
    walk, tau
        As of `noise_and_scatter`.
    """
    size, walked = laws.degrees[0] + 1, walk**2 / times[1] * np.eye(3)
    information = np.zeros((3 * (size + 3), 3 * (size + 3)))
    for temperature, up in soaks:
        law = np.tile(laws.design(np.array([temperature]))[0, 0, :size], (len(up), 1))
        rows = np.einsum("nc,ij->nijc", np.hstack([law, up]), np.eye(3)).reshape(len(up), 3, -1)
        own = new_in_each(up, None)
        weight = np.linalg.inv(walked + own @ np.swapaxes(own, 1, 2))
        common = np.einsum("nij,njc->ic", weight, rows)  # by an offset of the power cycle
        share = tau**2 * np.linalg.inv(np.eye(3) + tau**2 * weight.sum(axis=0))
        information += np.einsum("nia,nij,njb->ab", rows, weight, rows) - common.T @ share @ common
    blocks = np.linalg.inv(information).reshape(3, size + 3, 3, size + 3)
    covariance = np.einsum("iaib->ab", blocks) / 3
    functions = laws.design(places)[:, 0, :size]
    at_rest = np.einsum("ma,ab,mb->m", functions, covariance[:size, :size], functions)
    # Each of the three g-sensitivities along its own axis holds the vertical part of the Earth's rate.
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
