"""A motor that is off by a size that holds for the run, or grows.

Section: docs/inference.md#hypotheses
"""

from __future__ import annotations

import numpy as np

from failuretwin.core.numerics import log_of
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.digital_model.settling import sag
from failuretwin.failure_behavior.fault import Arrival
from failuretwin.failure_behavior.mode import FaultMode, Signature
from failuretwin.inference.engine.moved_motor import ARRIVED, FREE_RAD, Angle, MovedMotor, taken
from failuretwin.inference.engine.rows import AmountPrior, Rows, Scene, sampled
from failuretwin.inference.faults.fault_sizes import SizePrior, coarse_sizes
from failuretwin.inference.faults.priors import OnsetIntervals

LONG_S = 10.0
"""A fault that does not change has been there for so long [s]."""
CELLS = 3
"""Onsets within a stretch of time to sum over, of a fault that grows."""


def offset_rows(scene: Scene, motor: int, mode: FaultMode) -> Rows:
    """Return the rows of a fault whose size holds for the run, with each onset."""
    early = scene.priors.onset.before_run(mode.mode)
    sizes = scene.priors.sizes_of(mode, scene.model, motor)
    intervals = moment_intervals(scene)
    count, growing = scene.moments.count, mode.signature is Signature.GROWING_OFFSET
    if growing:
        points = (np.arange(CELLS) + 0.5) / CELLS
        onset, share = intervals.samples(early, points)  # (run, moment, sample)
        samples = onset.shape[-1]
        log_prior = log_of(intervals.weights(early)[..., None] * share).reshape(len(onset), -1)
        first = np.repeat(np.arange(count), samples)
        at = onset.reshape(len(onset), -1)
        since = np.maximum(scene.moments.time[:, None] - at[..., None], 0.0)
        width = intervals.length.repeat(samples, axis=1)[..., None] / CELLS
        onsets = np.maximum(at[..., None] + width * np.linspace(-0.4, 0.4, 5), 0.0)
        shares = np.full(onsets.shape, 0.2)
    else:
        log_prior, first = log_of(intervals.weights(early)), np.arange(count)
        since = np.full((1, 1, 1), LONG_S)
        onsets, shares = intervals.samples(early)
    moving = MovedMotor(scene, motor, False, _offset_angle(scene, motor, mode, since), first)
    best = best_sizes(moving, sizes, mode.signed, alike=not growing)
    return moving.rows(*best, log_prior, size_prior(sizes, mode.signed), sampled(onsets, shares))


def constant_rows(
    scene: Scene, motor: int, sizes: SizePrior, early: float, first: IntArray
) -> Rows:
    """Return the rows of an error of either sign that stays as it is.

    Args:
        scene: The runs.
        motor: Index of the motor.
        sizes: Sizes of the error [rad].
        early: Probability that it was there before the run.
        first: The first moment that each row affects, (row,): the first of all, or others.
    """
    moments, intervals = scene.moments, moment_intervals(scene)
    done = np.ones_like(moments.done) if first[0] == 0 else moments.done

    def angle(x: FloatArray, outcome: IntArray) -> FloatArray:
        settled = taken(scene.pose, outcome)[..., motor, None]
        return settled + x[:, :, None] * done[:, None, :, motor, None]

    moving = MovedMotor(scene, motor, False, angle, first)
    onset, share = intervals.samples(early)
    onsets = sampled(onset[:, first], share[:, first])
    log_prior = log_of(intervals.weights(early)[:, first])
    best = best_sizes(moving, sizes, signed=True, alike=True)
    return moving.rows(*best, log_prior, size_prior(sizes, signed=True), onsets)


def best_sizes(
    moving: MovedMotor, sizes: SizePrior, signed: bool, alike: bool
) -> tuple[FloatArray, FloatArray]:
    """Return the size of each row that explains its moments best, and the variance about it.

    Args:
        moving: The motor.
        sizes: Sizes of its fault.
        signed: Whether they have either sign.
        alike: Whether the angle does not depend on the row.
    """
    low, high = sizes.ends
    grid = np.tile(size_grid(sizes, signed), (moving.scene.moments.runs, 1))
    best, least = moving.best(grid, alike), -high if signed else low
    x = moving.refined(best, np.full((1, 1), least), np.full((1, 1), high))
    slope = np.sqrt(np.mean(moving.slope(x, ARRIVED) ** 2, axis=-1))
    return x, np.minimum(FREE_RAD / np.maximum(slope, 1e-6), 0.5 * high) ** 2


def size_grid(sizes: SizePrior, signed: bool) -> FloatArray:
    """Return sizes to look at, of both signs if they are signed, ascending, (node,)."""
    grid = coarse_sizes(*sizes.ends)
    return np.concatenate([-grid[::-1], grid]) if signed else grid


def moment_intervals(scene: Scene) -> OnsetIntervals:
    """Return the time in which an onset affects each moment first: up to that moment.

    On a curve an error of the command shows one lag later.
    """
    moments, lag_s = scene.moments, scene.model.lag_s
    begin = np.concatenate([np.zeros_like(moments.time[:, :1]), moments.time[:, :-1]], axis=1)
    begin = np.where(moments.on_curves, np.maximum(begin - lag_s, 0.0), begin)
    return OnsetIntervals(begin, moments.time)


def movement_intervals(scene: Scene) -> OnsetIntervals:
    """Return the time in which an onset affects each moment first: up to its movement.

    On a curve an error is there at once: up to the moment itself.
    """
    moments, at_once = scene.moments, moment_intervals(scene)
    start, curve = moments.start, moments.on_curves
    begin = np.concatenate([np.zeros_like(start[:, :1]), start[:, :-1]], axis=1)
    begin = np.where(curve & (moments.kept > 0.0), at_once.begin, begin)
    return OnsetIntervals(begin, np.where(curve, at_once.end, start))


def _offset_angle(scene: Scene, motor: int, mode: FaultMode, since: FloatArray) -> Angle:
    """Return the settled angle of a motor by the size of its fault.

    Args:
        scene: The runs.
        motor: Index of the motor.
        mode: Its mode.
        since: For how long the fault has been there, (run, row, moment) [s].
    """
    moments, model = scene.moments, scene.model
    travel = np.abs(moments.target - moments.origin)[..., motor]
    compliance, payload = np.asarray(model.settling.compliance), model.settling.payload

    def angle(x: FloatArray, outcome: IntArray) -> FloatArray:
        settled = taken(scene.pose, outcome)
        target, direction = (
            taken(values, outcome)[..., motor] for values in (moments.base, moments.direction)
        )
        load = np.zeros_like(target)
        if mode.needs_compliance:
            load = sag(model.twin.robot, settled, compliance, payload)[..., motor]
        parts = (target - direction * travel[:, None], target, direction, load)
        origin, goal, way, weight = (part[..., None] for part in parts)
        arrival = Arrival(origin, goal, way, since[..., None], weight)
        off = mode.settled_offset(x[:, :, None], arrival)
        return settled[..., motor, None] + off

    return angle


def size_prior(sizes: SizePrior, signed: bool) -> AmountPrior:
    """Return the prior of a size, of either sign if it is signed: all in a range as likely."""
    sides = 2.0 if signed else 1.0
    ranges = [
        (low, high, share) for (low, high), share in zip(sizes.ranges, sizes.shares, strict=True)
    ]

    def log_density(x: FloatArray, run: IntArray, row: IntArray) -> FloatArray:
        del run, row
        size = np.abs(x) if signed else x
        parts = [
            np.where((size >= low) & (size <= high), share / (sides * (high - low)), 0.0)
            for low, high, share in ranges
        ]
        return log_of(np.sum(parts, axis=0))

    return log_density
