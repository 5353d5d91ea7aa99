"""A motor with a fault that changes its way: it lags, is slow, has play or follows another law.

    off(z; t) = F_z[command](t) - command(t)

with F_z the mode's own failure behavior (`on_curve`) at size z, from the onset on; between some
sizes it is interpolated. A slow motor makes its ramps in k times their duration:

    begin + (goal - begin) min(1, (t - start) / (k ramp))

It goes for the goal of each ramp from where the ramp before left it.

Section: docs/inference.md#moments-on-the-way
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin.core.numerics import log_of
from failuretwin.core.types import BoolArray, FloatArray, IntArray, as_floats
from failuretwin.failure_behavior.fault import STEP, Course, FaultGroup
from failuretwin.failure_behavior.mode import FaultMode
from failuretwin.inference.engine.moments import Moments
from failuretwin.inference.engine.moved_motor import Angle, MovedMotor, taken
from failuretwin.inference.engine.offset_rows import (
    best_sizes,
    moment_intervals,
    movement_intervals,
    size_grid,
    size_prior,
)
from failuretwin.inference.engine.rows import Rows, Scene, sampled

LEAST_S = 1e-6
"""Shortest time that is divided by [s]."""


def way_rows(scene: Scene, motor: int, mode: FaultMode) -> Rows:
    """Return the rows of a motor that follows another way than it is told, with each onset."""
    early = scene.priors.onset.before_run(mode.mode)
    sizes = scene.priors.sizes_of(mode, scene.model, motor)
    slow = bool(mode.ramp_factor(np.array(sizes.ends))[1] != 1.0)  # from the next movement on
    intervals = movement_intervals(scene) if slow else moment_intervals(scene)
    first, grid = np.arange(scene.moments.count), size_grid(sizes, mode.signed)
    way = FollowedWay.of(scene.moments, motor, mode, grid, first)
    ramps = Ramps.of(scene.moments, motor, scene.model.lag_s) if slow else None
    angle = _angle(scene, motor, mode, way, ramps, first)
    moving = MovedMotor(scene, motor, False, angle, first)
    best = best_sizes(moving, sizes, mode.signed, alike=False)
    log_prior, onsets = log_of(intervals.weights(early)), sampled(*intervals.samples(early))
    return moving.rows(*best, log_prior, size_prior(sizes, mode.signed), onsets)


def _angle(
    scene: Scene,
    motor: int,
    mode: FaultMode,
    way: FollowedWay,
    ramps: Ramps | None,
    first: IntArray,
) -> Angle:
    """Return the angle of a motor on its way by the size of its fault.

    Args:
        scene: The runs.
        motor: Index of the motor.
        mode: Mode of the fault.
        way: By how much it is off.
        ramps: Its ramps, which it makes more slowly; None: it does not.
        first: First moment affected in each row, (row,).
    """
    lost, curve = as_floats(scene.moments.lost), scene.moments.on_curves[:, None, :, None]

    def angle(x: FloatArray, outcome: IntArray) -> FloatArray:
        off = way.at(x)
        if ramps is not None:
            factor = mode.ramp_factor(x.ravel()).reshape(x.shape)
            off = np.where(curve, off, ramps.off(factor, first))
        settled, missed = (taken(values, outcome)[..., motor] for values in (scene.pose, lost))
        return settled[..., None] + (1.0 - missed[..., None]) * off

    return angle


@dataclass(frozen=True)
class FollowedWay:
    """By how much a motor is off at the moments of some runs.

    Attributes:
        sizes: Sizes of its fault, ascending, (size,).
        off: At each size, (run, row, moment, size) [rad].
    """

    sizes: FloatArray
    off: FloatArray

    @classmethod
    def of(
        cls, moments: Moments, motor: int, mode: FaultMode, sizes: FloatArray, first: IntArray
    ) -> FollowedWay:
        """Return what a fault makes of the way of a motor.

        Args:
            moments: The moments.
            motor: Index of the motor.
            mode: Mode of the fault.
            sizes: Ascending, (size,).
            first: First moment affected in each row, (row,): the fault begins with the way to it.
        """
        told_s = moments.way_s
        time = told_s[..., -1]
        begin = np.concatenate([np.zeros_like(time[:, :1]), time[:, :-1]], axis=1)
        off = np.zeros((moments.runs, len(first), moments.count, len(sizes)))
        magnitude = np.tile(sizes, len(first))
        for run, way in enumerate(moments.way[:, :, motor]):
            grid = np.linspace(0.0, max(time[run, -1], LEAST_S), way.size)
            reference = np.interp(grid, told_s[run].ravel(), way.ravel())
            courses = [Course(STEP, s) for s in begin[run, first].repeat(len(sizes)).tolist()]
            faults = FaultGroup(magnitude, courses)
            told = np.broadcast_to(reference, (len(magnitude), len(grid)))
            away = mode.on_curve(faults, told, grid) - told
            place = time[run] / grid[1]
            low = np.minimum(place.astype(np.int64), len(grid) - 2)
            found = away[:, low] + (place - low) * (away[:, low + 1] - away[:, low])
            off[run] = np.swapaxes(found.reshape(len(first), len(sizes), -1), 1, 2)
        return cls(sizes, off)

    def at(self, x: FloatArray) -> FloatArray:
        """Return it at other sizes, (run, row, node), as (run, row, moment, node) [rad]."""
        place = np.interp(x, self.sizes, np.arange(len(self.sizes), dtype=np.float64))
        low = np.minimum(place.astype(np.int64), len(self.sizes) - 2)
        before, after = (np.take_along_axis(self.off, low[:, :, None] + k, axis=3) for k in (0, 1))
        return np.asarray(before + (place - low)[:, :, None] * (after - before))


@dataclass(frozen=True)
class Ramps:
    """The ramps of a motor at the moments of some runs, (run, moment).

    Attributes:
        begin: Command at the start of the movement [rad].
        goal: Command at the end of its ramp [rad].
        told: Command at the moment [rad].
        share: Time up to the moment, over the duration of the ramp.
        whole: Time up to the next movement, over the same.
        same: Whether the moment before is of the same movement.
    """

    begin: FloatArray
    goal: FloatArray
    told: FloatArray
    share: FloatArray
    whole: FloatArray
    same: BoolArray

    @classmethod
    def of(cls, moments: Moments, motor: int, lag_s: float) -> Ramps:
        """Return the ramps of a motor whose arm trails its commands by a lag [s]."""
        told, done = moments.target[..., motor], moments.done[..., motor]
        begin, start = moments.origin[..., motor].copy(), moments.start.copy()
        same = moments.kept == 1.0
        for m in range(1, moments.count):
            for values in (begin, start):
                values[:, m] = np.where(same[:, m], values[:, m - 1], values[:, m])
        since = np.maximum(moments.time - start - lag_s, LEAST_S)
        part = (done > 0.0) & (done < 1.0)
        share = np.where(part, done, 1.0)
        ramp = np.where(part, since / share, np.minimum(moments.ramp[..., motor], since))
        ramp = np.maximum(ramp, LEAST_S)
        lasted = np.full_like(start, np.inf)
        lasted[:, :-1] = np.where(same[:, 1:], np.inf, start[:, 1:] - start[:, :-1])
        goal = begin + (told - begin) / share
        return cls(begin, goal, told, since / ramp, lasted / ramp, same)

    def off(self, factor: FloatArray, first: IntArray) -> FloatArray:
        """Return by how much the motor is off if its ramps take longer.

        Args:
            factor: How many times as long, (run, row, node).
            first: First moment affected in each row, (row,).

        Returns:
            (run, row, moment, node) [rad].
        """
        found = np.zeros((*factor.shape[:2], self.told.shape[1], factor.shape[2]))
        left = ahead = np.zeros_like(factor)  # off its begin: of this movement, of the next one
        for m in range(found.shape[2]):
            begin, goal, told, share, whole, same = (
                values[:, m, None, None] for values in vars(self).values()
            )
            left = np.where(m > first[:, None], np.where(same, left, ahead), 0.0)
            here = begin + left
            slow = (m >= first)[:, None]
            reached = here + (goal - here) * np.minimum(share / factor, 1.0)
            found[:, :, m] = np.where(slow, reached - told, 0.0)
            ends = here + (goal - here) * np.minimum(whole / factor, 1.0)
            usual = begin + (goal - begin) * np.minimum(whole, 1.0)
            ahead = np.where(slow, ends - usual, 0.0)
        return found
