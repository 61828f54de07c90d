"""Attitudes: what segmentation hands to a tumble fit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imulab.recording import Array, Recording

POOL_DEGREES = 10.0
"""Weight, in degrees of freedom, of the noise pooled over all attitudes against an attitude's own."""


@dataclass(frozen=True)
class Trace:
    """Windowed variance of a triad over time (sum of the axes), in the squared unit of its columns.

    ``threshold`` is the variance below which a window is at rest, ``quiet`` that of the quietest stretch.
    """

    time: Array
    variance: Array
    threshold: float
    quiet: float

    def describe(self) -> str:
        """Return the trace in a few words, for a message."""
        below = np.count_nonzero(self.variance <= self.threshold) / len(self.variance)
        low, middle, high = np.sqrt(np.quantile(self.variance, [0.05, 0.5, 0.95]))
        return (
            f"standard deviation within a window {low:.3g} (quietest 5 %), {middle:.3g} (median), {high:.3g} "
            f"(95 %); {100 * below:.0f} % of the time below the threshold {np.sqrt(self.threshold):.3g}"
        )


@dataclass(frozen=True)
class Motion:
    """How each attitude moved while it was held, as far as the mean magnitude of f in it depends on that.

    The mean of the magnitudes differs from the magnitude of the mean by the motion, and their scatter is the noise.
    Both follow from the blocks of a hold through df/dM, which is known only when the fit is done.

    Attributes
    ----------
    lengthening
        ``C_w / N - D``, (n, 3, 3): covariance of the mean by white noise, which makes |f| too long, less the motion,
        which makes the magnitude of the mean too short; in the squared unit of the outputs.
    moments
        Covariance of the attitude's means of x, y, z, xx, yy, zz, xy, xz, yz about its mean, from batches, (n, 9, 9).
    usual
        Covariance of the mean that white noise alone would leave, pooled over the attitudes: what tells noisy axes from
        quiet ones, but not how strong the noise is at low frequencies; (n, 3, 3).
    freedom
        Degrees of freedom of `moments`, shape (n,).
    shake
        Variance of each axis within the blocks beyond white noise, which is faster than they tell, shape (n, 3).
    """

    lengthening: Array
    moments: Array
    usual: Array
    freedom: Array
    shake: Array

    def scaled(self, scale: Array) -> Motion:
        """Return it for outputs that are divided by `scale`, shape (3,)."""
        square = scale[:, None] * scale
        each = np.concatenate([scale, scale**2, square[[0, 0, 1], [1, 2, 2]]])
        return Motion(
            self.lengthening / square,
            self.moments / (each[:, None] * each),
            self.usual / square,
            self.freedom,
            self.shake / scale**2,
        )

    def __getitem__(self, which: NDArray[Any]) -> Motion:
        """Return it for some of the attitudes."""
        return Motion(
            self.lengthening[which], self.moments[which], self.usual[which], self.freedom[which], self.shake[which]
        )


@dataclass(frozen=True)
class Attitudes:
    """Static attitudes of one tumble test.

    Attributes
    ----------
    mean
        Mean output of the triad in each attitude, shape (n, 3), in `unit`.
    covariance
        Covariance of each mean, shape (n, 3, 3), or None where nothing is known of the noise.
    samples
        Number of samples behind each mean, shape (n,).
    start, stop
        Time of the first and last sample, s, shape (n,); row numbers for a table of attitudes.
    unit
        Unit of the outputs as in the file.
    recording
        Where they come from.
    temperature
        Mean temperature of the test, degC, if known.
    trace
        The variance trace that the attitudes were found in; None for a table.
    pieces
        Static stretches as rows (first sample, last sample + 1, attitude), for a continuous recording.
    swing
        Range of each axis over the whole recording, motion included, shape (3,).
    motion
        How they moved while they were held; None for a table.
    notes
        What a user should know of how they were found.
    numbers
        Where some were set aside: the place of each among all that were found, shape (n,).

    Examples
    --------
    >>> import imulab as il
    >>> attitudes = il.find_attitudes(il.simulate_tumble(order=1, seed=1))
    >>> attitudes.mean.shape, attitudes.covariance.shape, attitudes.unit
    ((24, 3), (24, 3, 3), 'm/s^2')
    """

    mean: Array
    covariance: Array | None
    samples: NDArray[np.int64]
    start: Array
    stop: Array
    unit: str
    recording: Recording
    temperature: float | None = None
    trace: Trace | None = None
    pieces: NDArray[np.int64] | None = None
    swing: Array | None = None
    motion: Motion | None = None
    notes: tuple[str, ...] = ()
    numbers: NDArray[np.intp] | None = None

    def __repr__(self) -> str:
        return f"Attitudes({len(self)} of {self.recording.name}, in {self.unit})"

    def __len__(self) -> int:
        return len(self.mean)

    def label(self, index: int) -> str:
        """Return how messages name an attitude: by its row, or by its time."""
        number = index if self.numbers is None else int(self.numbers[index])
        if self.trace is None:
            return self.recording.place(int(self.start[index]) - self.recording.first_row)
        return f"attitude {number + 1} ({self.start[index]:.1f} to {self.stop[index]:.1f} s)"

    def times(self) -> str:
        """Return when the attitudes were found, for a message."""
        shown = [f"{a:.0f} to {b:.0f} s" for a, b in zip(self.start[:12], self.stop[:12], strict=True)]
        return ", ".join(shown) + (", ..." if len(self) > 12 else "")

    def only(self, kept: NDArray[np.intp]) -> Attitudes:
        """Return some of the attitudes under the labels that they had; the stretches at rest are left out."""
        return replace(
            self,
            mean=self.mean[kept],
            covariance=None if self.covariance is None else self.covariance[kept],
            samples=self.samples[kept],
            start=self.start[kept],
            stop=self.stop[kept],
            pieces=None,
            motion=None if self.motion is None else self.motion[kept],
            numbers=kept if self.numbers is None else self.numbers[kept],
        )
