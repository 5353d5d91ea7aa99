"""Onset and size of a fault, as the motor-wise network says them: quantiles and their calibration.

An onset has a histogram over bins of all moments, a size a sum of normal distributions. Both are
sharpened or widened until 90 % intervals hold 90 % of held-out runs: a histogram by a power of its
shares, a size by a factor on its deviations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from failuretwin.core.types import FloatArray
from failuretwin.decision.learned.moment_encoder import Tokens
from failuretwin.decision.learned.motorwise import LOG_SIZE_SCALE, LOG_WIDTHS, NORMALS, Told

QUANTILES = (0.05, 0.5, 0.95)
"""Ends and middle of the intervals of onset and size."""
HALVINGS = 50
"""Halvings of the range in which a quantile of a size lies."""
FURTHEST = 8.0
"""Ends of that range, in deviations from the outermost normal distribution."""
FACTORS = np.geomspace(0.25, 4.0, 81)
"""Factors on deviations of sizes, and powers of the shares of onsets, that are tried."""
LEAST_HELD = 20
"""Fewer held-out runs change nothing."""


@dataclass(frozen=True)
class Onset:
    """Distribution of an onset over bins.

    Attributes:
        begin: Begin of each bin, (bin,) [s].
        end: Its end.
        share: Its probability.
    """

    begin: FloatArray
    end: FloatArray
    share: FloatArray

    @classmethod
    def of(cls, told: Told, tokens: Tokens, run: int, motor: int, mode: int) -> Onset:
        """Return the onset of a fault of one motor in one run."""
        rows, bins = told.rows[run, :, motor, mode], told.bins[run, :, motor, mode]
        share = np.exp(rows - rows.max())
        inside = np.exp(bins - bins.max(axis=1, keepdims=True))
        inside /= inside.sum(axis=1, keepdims=True)
        edges = tokens.edges[run, :, motor].astype(np.float64)
        whole = (share[:, None] / share.sum() * inside).ravel()
        return cls(edges[:, :-1].ravel(), edges[:, 1:].ravel(), whole)

    def powered(self, power: float) -> Onset:
        """Return the same with p ~ p^power: above 1 narrower, below 1 wider."""
        share = self.share**power
        return Onset(self.begin, self.end, share / share.sum())

    def quantiles(self) -> FloatArray:
        """Return the quantiles, by `QUANTILES` [s]; within a bin all times are as likely."""
        below = np.r_[0.0, np.cumsum(self.share)]
        found = []
        for quantile in QUANTILES:
            at = min(int(np.searchsorted(below[1:], quantile)), len(self.share) - 1)
            inside = (quantile - below[at]) / max(below[at + 1] - below[at], 1e-12)
            width = self.end[at] - self.begin[at]
            found.append(float(self.begin[at] + np.clip(inside, 0.0, 1.0) * width))
        return np.array(found)

    def holds(self, truth: float, power: float) -> bool:
        """Return whether the interval holds the truth once the shares have a power."""
        low, _, high = self.powered(power).quantiles()
        return bool(low <= truth <= high)


@dataclass(frozen=True)
class Size:
    """A sum of normal distributions: of an angle [rad], or of the logarithm of a size.

    Attributes:
        share: Weight of each, (normal,).
        mean: Its mean.
        deviation: Its standard deviation.
    """

    share: FloatArray
    mean: FloatArray
    deviation: FloatArray

    @classmethod
    def of(
        cls, told: Told, tokens: Tokens, run: int, motor: int, mode: int, *, angle: bool
    ) -> Size:
        """Return the size of a fault of one motor in one run.

        Args:
            told: What the network says.
            tokens: The runs.
            run: Index of the run.
            motor: Index of the motor.
            mode: Index of the mode among those of the network.
            angle: Whether its size is an angle.
        """
        rows, told_size = told.rows[run, :, motor, mode], told.sizes[run, :, motor, mode]
        row = np.exp(rows - rows.max())
        weight, centre, width = told_size.reshape(len(rows), 3, NORMALS).transpose(1, 0, 2)
        share = np.exp(weight - weight.max(axis=1, keepdims=True))
        share = (row / row.sum())[:, None] * share / share.sum(axis=1, keepdims=True)
        anchor = tokens.anchor[run, :, motor].astype(np.float64)
        middle = anchor[:, 0] if angle else anchor[:, 2]
        scale = np.maximum(anchor[:, 1], 1e-4) if angle else np.full(len(rows), LOG_SIZE_SCALE)
        deviation = scale[:, None] * np.exp(np.clip(width, *LOG_WIDTHS))
        mean = middle[:, None] + scale[:, None] * centre
        return cls(share.ravel(), mean.ravel(), deviation.ravel())

    def widened(self, factor: float) -> Size:
        """Return the same with the deviations multiplied."""
        return Size(self.share, self.mean, factor * self.deviation)

    def quantiles(self) -> FloatArray:
        """Return the quantiles, by `QUANTILES`."""
        wanted = np.array(QUANTILES)
        low = np.full(len(wanted), np.min(self.mean - FURTHEST * self.deviation))
        high = np.full(len(wanted), np.max(self.mean + FURTHEST * self.deviation))
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            below = ndtr((middle[:, None] - self.mean) / self.deviation) @ self.share
            low = np.where(below < wanted, middle, low)
            high = np.where(below < wanted, high, middle)
        return np.asarray(0.5 * (low + high))

    def holds(self, truth: float, factor: float) -> bool:
        """Return whether the interval holds the truth once the deviations are multiplied."""
        below = float(self.share @ ndtr((truth - self.mean) / (factor * self.deviation)))
        return QUANTILES[0] <= below <= QUANTILES[2]


Held = tuple[float, Onset] | tuple[float, Size]
"""The truth of a run and what the network says of it."""


def fitted_factor(held: Sequence[Held], *, narrower: bool) -> float:
    """Return the factor with which intervals hold the truth as often as they say.

    Args:
        held: True values and what is said of them, of held-out runs.
        narrower: Whether a larger factor makes intervals narrower, as a power of shares does.

    Returns:
        The one with the narrowest intervals that still hold it; 1 for too few runs.
    """
    if len(held) < LEAST_HELD:
        return 1.0
    share = QUANTILES[2] - QUANTILES[0]
    order = FACTORS[::-1] if narrower else FACTORS
    for factor in order.tolist():
        if np.mean([said.holds(truth, factor) for truth, said in held]) >= share:
            return float(factor)
    return float(order[-1])
