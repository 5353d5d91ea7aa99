"""Two motors that are off, followed through a run: what became of each movement, step by step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.inference.two_joint_likelihood import SOLUTIONS, TwoJointLikelihood

# Where two motors stand if each is off by some amount, and what movements say of the amounts.


@dataclass(frozen=True)
class LinearOffsets:
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
class GaussianBelief:
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

    def after(self, slope: FloatArray, error: FloatArray, spread: FloatArray) -> GaussianBelief:
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
        return GaussianBelief(mean, self.spread - less)

    def where(self, some: BoolArray, other: GaussianBelief) -> GaussianBelief:
        """Return this belief for some of the (run, kind), the other for the rest."""
        return GaussianBelief(
            np.where(some[..., None], self.mean, other.mean),
            np.where(some[..., None], self.spread, other.spread),
        )


def _inverse(spread: FloatArray) -> FloatArray:
    """Return the inverse of covariances (..., 3) as matrices, (..., 2, 2)."""
    aa, bb, ab = (spread[..., k] for k in range(3))
    rows = [np.stack([bb, -ab], axis=-1), np.stack([-ab, aa], axis=-1)]
    return np.stack(rows, axis=-2) / (aa * bb - ab * ab)[..., None, None]


SHOWS = np.array([[True, True], [True, False], [False, True]])
"""Which of two faults a movement shows, (state, motor): either may begin late, or come and go."""
LOG_SHOWS = np.log([0.8, 0.1, 0.1])
"""How probable that is; assumed."""
SEEDS = 6
"""Movements, spread over the run, from which a course of the run is followed."""


@dataclass(frozen=True)
class GreedyPath:
    """What became of the movements of each run, and what that says.

    Attributes:
        says: Log density of each movement given those met before it, (run, kind, movement).
        way: Which way of `TwoJointLikelihood` each one took, (run, kind, movement); -1: none.
        angle: Where the two motors stand by the amounts learnt, (run, kind, movement, motor)
            [rad].
    """

    says: FloatArray
    way: IntArray
    angle: FloatArray


def greedy_map_path(
    seen: TwoJointLikelihood, lines: LinearOffsets, usable: BoolArray, outlier: float
) -> GreedyPath:
    """Return the most probable course of each run among those begun at different movements.

    Args:
        seen: What each movement says of the two angles.
        lines: Where the motors may stand.
        usable: Movements with evidence, (run, movement).
        outlier: Log density of the tool being anywhere, times its rate.
    """
    count = usable.shape[1]
    starts = np.unique(np.linspace(0, count - 1, min(SEEDS, count)).astype(np.int64))
    found: GreedyPath | None = None
    for start in starts.tolist():
        order = [start, *(m for m in range(count) if m != start)]
        for way in range(SOLUTIONS):
            course = _greedy_path(seen, lines, usable, outlier, order, way)
            found = course if found is None else _better(course, found)
    assert found is not None
    return found


def _better(one: GreedyPath, other: GreedyPath) -> GreedyPath:
    """Return the more probable course of each run and kind."""
    ahead = one.says.sum(axis=-1) > other.says.sum(axis=-1)
    return GreedyPath(
        np.where(ahead[..., None], one.says, other.says),
        np.where(ahead[..., None], one.way, other.way),
        np.where(ahead[..., None, None], one.angle, other.angle),
    )


def _greedy_path(
    seen: TwoJointLikelihood,
    lines: LinearOffsets,
    usable: BoolArray,
    outlier: float,
    order: Sequence[int],
    way: int,
) -> GreedyPath:
    """Return the course that begins with one way of one movement and goes on as is best each time.

    Args:
        seen: What each movement says of the two angles.
        lines: Where the motors may stand.
        usable: Movements with evidence, (run, movement).
        outlier: Log density of the tool being anywhere, times its rate.
        order: In which order movements are met.
        way: Way taken by the first of them, with both faults showing.
    """
    runs, movements, kinds, _ = lines.slope.shape
    mean, variance = (np.broadcast_to(v, (runs, kinds, 2)) for v in lines.amount)
    belief = GaussianBelief(mean, np.concatenate([variance, np.zeros((runs, kinds, 1))], axis=-1))
    says = np.zeros((runs, kinds, movements))
    taken = np.full((runs, kinds, movements), -1)
    for met, m in enumerate(order):
        log_at, slope, error, spread = _options(seen, lines, belief, m)
        if met == 0:
            only = np.arange(log_at.shape[-1]) == way
            best = np.full((runs, kinds), np.argmax(only))
        else:
            best = np.argmax(log_at, axis=-1)
        at = _select(log_at, best)
        here = usable[:, m, None] & (at > outlier)
        learnt = belief.after(_select(slope, best), _select(error, best), _select(spread, best))
        belief = learnt.where(here, belief)
        says[:, :, m] = np.where(usable[:, m, None], np.maximum(at, outlier), 0.0)
        taken[:, :, m] = np.where(here, best % seen.log_weight.shape[-1], -1)
    angle = (
        np.moveaxis(lines.centre, 1, 2) + np.moveaxis(lines.slope, 1, 2) * belief.mean[:, :, None]
    )
    return GreedyPath(says, taken, angle)


def _options(
    seen: TwoJointLikelihood, lines: LinearOffsets, belief: GaussianBelief, m: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return what may have become of a movement, by state of the faults and way of the tool.

    Returns:
        Log density, (run, kind, option), and (..., 2), (..., 2), (..., 3) for each option: slope of
        both motors, error and its covariance.
    """
    slope = np.where(SHOWS, lines.slope[:, m, :, None], 0.0)  # (run, kind, state, motor)
    centre = np.where(SHOWS, lines.centre[:, m, :, None], lines.well[:, m, None, None])
    noise = np.where(SHOWS, lines.noise[:, None], lines.well_noise)
    spread = belief.seen_at(slope)
    spread[..., :2] += noise
    expected = centre + slope * belief.mean[:, :, None]
    error = seen.angle[:, m, None, None] - expected[..., None, :]
    spread = spread[..., None, :] + seen.covariance[:, m, None, None]
    aa, bb, ab = (spread[..., k] for k in range(3))
    a, b = error[..., 0], error[..., 1]
    determinant = aa * bb - ab * ab
    square = (bb * a * a + aa * b * b - 2.0 * ab * a * b) / determinant
    log_at = -0.5 * square - 0.5 * np.log(determinant) - np.log(2.0 * np.pi)
    log_at = log_at + LOG_SHOWS[:, None] + seen.log_weight[:, m, None, None]
    slope = np.broadcast_to(slope[..., None, :], error.shape)
    shape = (*log_at.shape[:2], -1)
    return (
        log_at.reshape(shape),
        slope.reshape(*shape, 2),
        error.reshape(*shape, 2),
        spread.reshape(*shape, 3),
    )


def _select(values: FloatArray, option: IntArray) -> FloatArray:
    """Return the values (run, kind, option, ...) of one option each."""
    index = option.reshape(*option.shape, *(1,) * (values.ndim - 2))
    return np.take_along_axis(values, index, axis=2)[:, :, 0]
