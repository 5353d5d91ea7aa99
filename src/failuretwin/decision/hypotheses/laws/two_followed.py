"""Two motors that are off, followed through a run: what became of each movement, step by step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.decision.evidence.two_angles import WAYS, TwoAngles
from failuretwin.decision.hypotheses.laws.two_amounts import Belief, Lines

SHOWS = np.array([[True, True], [True, False], [False, True]])
"""Which of two faults a movement shows, (state, motor): either may begin late, or come and go."""
LOG_SHOWS = np.log([0.8, 0.1, 0.1])
"""How probable that is; assumed."""
SEEDS = 6
"""Movements, spread over the run, from which a course of the run is followed."""


@dataclass(frozen=True)
class Course:
    """What became of the movements of each run, and what that says.

    Attributes:
        says: Log density of each movement given those met before it, (run, kind, movement).
        way: Which way of `TwoAngles` each one took, (run, kind, movement); -1: none.
        angle: Where the two motors stand by the amounts learnt, (run, kind, movement, motor)
            [rad].
    """

    says: FloatArray
    way: IntArray
    angle: FloatArray


def follow(seen: TwoAngles, lines: Lines, usable: BoolArray, outlier: float) -> Course:
    """Return the most probable course of each run among those begun at different movements.

    Args:
        seen: What each movement says of the two angles.
        lines: Where the motors may stand.
        usable: Movements with evidence, (run, movement).
        outlier: Log density of the tool being anywhere, times its rate.
    """
    count = usable.shape[1]
    starts = np.unique(np.linspace(0, count - 1, min(SEEDS, count)).astype(np.int64))
    found: Course | None = None
    for start in starts.tolist():
        order = [start, *(m for m in range(count) if m != start)]
        for way in range(WAYS):
            course = _follow(seen, lines, usable, outlier, order, way)
            found = course if found is None else _better(course, found)
    assert found is not None
    return found


def _better(one: Course, other: Course) -> Course:
    """Return the more probable course of each run and kind."""
    ahead = one.says.sum(axis=-1) > other.says.sum(axis=-1)
    return Course(
        np.where(ahead[..., None], one.says, other.says),
        np.where(ahead[..., None], one.way, other.way),
        np.where(ahead[..., None, None], one.angle, other.angle),
    )


def _follow(
    seen: TwoAngles,
    lines: Lines,
    usable: BoolArray,
    outlier: float,
    order: Sequence[int],
    way: int,
) -> Course:
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
    belief = Belief(mean, np.concatenate([variance, np.zeros((runs, kinds, 1))], axis=-1))
    says = np.zeros((runs, kinds, movements))
    taken = np.full((runs, kinds, movements), -1)
    for met, m in enumerate(order):
        log_at, slope, error, spread = _options(seen, lines, belief, m)
        if met == 0:
            only = np.arange(log_at.shape[-1]) == way
            best = np.full((runs, kinds), np.argmax(only))
        else:
            best = np.argmax(log_at, axis=-1)
        at = _pick(log_at, best)
        here = usable[:, m, None] & (at > outlier)
        learnt = belief.after(_pick(slope, best), _pick(error, best), _pick(spread, best))
        belief = learnt.where(here, belief)
        says[:, :, m] = np.where(usable[:, m, None], np.maximum(at, outlier), 0.0)
        taken[:, :, m] = np.where(here, best % seen.log_weight.shape[-1], -1)
    angle = (
        np.moveaxis(lines.centre, 1, 2) + np.moveaxis(lines.slope, 1, 2) * belief.mean[:, :, None]
    )
    return Course(says, taken, angle)


def _options(
    seen: TwoAngles, lines: Lines, belief: Belief, m: int
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


def _pick(values: FloatArray, option: IntArray) -> FloatArray:
    """Return the values (run, kind, option, ...) of one option each."""
    index = option.reshape(*option.shape, *(1,) * (values.ndim - 2))
    return np.take_along_axis(values, index, axis=2)[:, :, 0]
