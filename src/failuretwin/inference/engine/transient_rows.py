"""A motor that follows its command later, or makes its ramps more slowly, seen on its way.

    late by z:    q(t - z)
    slow:         begin + (goal - begin) min(1, (t - start) / (k ramp)),    k the ramp factor

A slow motor goes for the goal of each movement from where the movement before left it. On a curve
the way from one moment to the next counts as such a movement.

Section: docs/inference.md#moments-on-the-way
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin.core.movements import AGES_S
from failuretwin.core.numerics import log_of
from failuretwin.core.types import BoolArray, FloatArray, IntArray, as_floats
from failuretwin.failure_behavior.mode import FaultMode
from failuretwin.inference.engine.moments import Moments
from failuretwin.inference.engine.moved_motor import Angle, MovedMotor, taken
from failuretwin.inference.engine.offset_rows import (
    best_sizes,
    moment_intervals,
    movement_intervals,
    size_prior,
)
from failuretwin.inference.engine.rows import Rows, Scene, sampled

LEAST_S = 1e-6
"""Shortest time that is divided by [s]."""


def transient_rows(scene: Scene, motor: int, mode: FaultMode) -> Rows:
    """Return the rows of a motor that is later or slower, with each onset."""
    early = scene.priors.onset.before_run(mode.mode)
    sizes = scene.priors.sizes_of(mode, scene.model, motor)
    slow = bool(mode.ramp_factor(np.array(sizes.ends))[1] != 1.0)  # from the next movement on
    intervals = movement_intervals(scene) if slow else moment_intervals(scene)
    first = np.arange(scene.moments.count)
    moving = MovedMotor(scene, motor, False, _angle(scene, motor, mode, first), first)
    best = best_sizes(moving, sizes, mode.signed, alike=False)
    log_prior, onsets = log_of(intervals.weights(early)), sampled(*intervals.samples(early))
    return moving.rows(*best, log_prior, size_prior(sizes, mode.signed), onsets)


def _angle(scene: Scene, motor: int, mode: FaultMode, first: IntArray) -> Angle:
    """Return the angle of a motor on its way by the size of its fault.

    Args:
        scene: The runs.
        motor: Index of the motor.
        mode: Its mode.
        first: First moment affected in each row, (row,).
    """
    ramps = Ramps.of(scene.moments, motor, scene.model.lag_s)
    behind, lost = scene.moments.behind[:, :, motor], as_floats(scene.moments.lost)

    def angle(x: FloatArray, outcome: IntArray) -> FloatArray:
        factor, late_s = (
            of(x.ravel()).reshape(x.shape) for of in (mode.ramp_factor, mode.dead_time)
        )
        off = _late(behind, late_s)
        if (factor != 1.0).any():
            off = off + ramps.off(factor, first)
        settled, missed = (taken(values, outcome)[..., motor] for values in (scene.pose, lost))
        return settled[..., None] + (1.0 - missed[..., None]) * off

    return angle


def _late(behind: FloatArray, late_s: FloatArray) -> FloatArray:
    """Return by how much a motor is off that follows its command later.

    Args:
        behind: How far it is behind the command if it follows `AGES_S` later, (run, moment, age)
            [rad].
        late_s: How much later, (run, row, node) [s].

    Returns:
        (run, row, moment, node) [rad].
    """
    place = np.interp(late_s, AGES_S, np.arange(len(AGES_S), dtype=np.float64))
    low = np.minimum(place.astype(np.int64), len(AGES_S) - 2)
    run = np.arange(len(behind))[:, None, None]
    before, after = (behind[run, :, low + k] for k in (0, 1))  # (run, row, node, moment)
    return np.swapaxes(before + (place - low)[..., None] * (after - before), 2, 3)


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
