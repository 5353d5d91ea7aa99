"""Where two motors stand if each is off by some amount, and what movements say of the amounts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin.core.types import BoolArray, FloatArray


@dataclass(frozen=True)
class Lines:
    """Where two motors stand after each movement: centre + slope * amount, give or take noise.

    Attributes:
        centre: (run, movement, kind, motor) [rad].
        slope: (run, movement, kind, motor), in rad for each unit of the amount.
        noise: Variance, (kind, motor) [rad2].
        amount: Mean and variance of each amount beforehand, (kind, motor) each.
        well: Where they stand if they are well, (run, movement, motor) [rad].
        well_noise: Variance then, (motor,) [rad2].
    """

    centre: FloatArray
    slope: FloatArray
    noise: FloatArray
    amount: tuple[FloatArray, FloatArray]
    well: FloatArray
    well_noise: FloatArray


@dataclass(frozen=True)
class Belief:
    """Normal belief about the amounts by which two motors are off.

    Attributes:
        mean: (run, kind, motor).
        spread: Variance of both, and their covariance, (run, kind, 3).
    """

    mean: FloatArray
    spread: FloatArray

    def seen_at(self, slope: FloatArray) -> FloatArray:
        """Return variances and covariance of slope * amount, (run, kind, ..., 3)."""
        spread = self.spread.reshape(*self.spread.shape[:2], *(1,) * (slope.ndim - 3), 3)
        a, b = slope[..., 0], slope[..., 1]
        return np.stack([a * a, b * b, a * b], axis=-1) * spread

    def after(self, slope: FloatArray, error: FloatArray, spread: FloatArray) -> Belief:
        """Return the belief once angles were off by `error`, of covariance `spread` in all."""
        a, b = slope[..., 0], slope[..., 1]
        own_a, own_b, both = (self.spread[..., k] for k in range(3))
        gain = np.stack(  # covariance of amounts and angles, (run, kind, amount, angle)
            [
                np.stack([own_a * a, both * b], axis=-1),
                np.stack([both * a, own_b * b], axis=-1),
            ],
            axis=-2,
        )
        inverse = _inverse(spread)
        pull = np.einsum("rkij,rkj->rki", inverse, error)
        mean = self.mean + np.einsum("rkij,rkj->rki", gain, pull)
        less = np.einsum("rkai,rkij,rkbj->rkab", gain, inverse, gain)
        less = np.stack([less[..., 0, 0], less[..., 1, 1], less[..., 0, 1]], axis=-1)
        return Belief(mean, self.spread - less)

    def where(self, some: BoolArray, other: Belief) -> Belief:
        """Return this belief for some of the (run, kind), the other for the rest."""
        return Belief(
            np.where(some[..., None], self.mean, other.mean),
            np.where(some[..., None], self.spread, other.spread),
        )


def _inverse(spread: FloatArray) -> FloatArray:
    """Return the inverse of covariances (..., 3) as matrices, (..., 2, 2)."""
    aa, bb, ab = (spread[..., k] for k in range(3))
    rows = [np.stack([bb, -ab], axis=-1), np.stack([-ab, aa], axis=-1)]
    return np.stack(rows, axis=-2) / (aa * bb - ab * ab)[..., None, None]
