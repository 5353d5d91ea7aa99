"""A motor that is held from some time on: one angle for all moments after it.

Each onset is a row: on the plateau, where the motor had settled, or on the ramp, anywhere. Where it
had settled is as unknown as its own part of theta:

    x = was + b + c g - f d + z

Section: docs/inference.md#hypotheses
"""

from __future__ import annotations

import numpy as np
from scipy.special import ndtri

from failuretwin.core.numerics import log_of
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.inference.engine.moved_motor import FREE_RAD, Angle, MovedMotor
from failuretwin.inference.engine.rows import Onsets, Rows, Scene, sampled
from failuretwin.inference.engine.theta import loads
from failuretwin.inference.faults.priors import OnsetIntervals, plateau_or_ramp

GRID = 61
"""Held angles among which the best is looked for."""
TIED = 2.0
"""Deviation of a held angle from where the motor had settled, in its scatter."""
MARGIN = 4.0
"""What a motor that stops on its ramp may be beyond its ends, in its scatter."""
POINTS = np.linspace(0.05, 0.95, 10)
"""Where in a stretch of time onsets are sampled, as shares of its length."""
NORMAL_QUANTILES = ndtri(POINTS)
"""The same of a normal distribution, in deviations."""
AGES, LEAST_THERE = 81, 1e-4
"""Onsets that are looked at between two moments on a curve, and what a motor that was nowhere near
its held angle counts for, in what one that was there does."""
STILL_RAD = 1e-6
"""A ramp that is shorter is none [rad]."""
OFF_RAMP = 0.05
"""Share of a ramp by which a held angle may be beyond its ends and still be on it."""


def held_rows(scene: Scene, motor: int) -> Rows:
    """Return the rows of a stuck motor: each onset, on the plateau and anywhere else."""
    moments, priors = scene.moments, scene.priors
    count, scatter = moments.count, max(float(scene.model.scatter[motor]), 1e-4)
    low, high = held_range(scene, motor)
    goal = scene.settled[..., motor]
    off = goal - moments.base[:, :, 0, motor]
    was = moments.origin[..., motor] + np.concatenate([off[:, :1], off[:, :-1]], axis=1)
    intervals = stuck_intervals(scene, motor)
    known, share = priors.onset.known_s, priors.onset.free
    weight = intervals.weights(priors.onset.before_run("stuck"))
    if known is not None:
        weight = intervals.holding(known)
    first = np.repeat(np.arange(count), 2)
    moving = MovedMotor(scene, motor, True, _held_angle(count), first)
    later = MovedMotor(scene, motor, True, _held_angle(count), np.arange(count))
    best = later.best(np.linspace(low, high, GRID, axis=1), alike=True)
    free = later.refined(best, low[:, None], high[:, None])
    log_prior = np.stack(
        [
            log_of(weight[..., 0]) + np.log1p(-share),
            log_of(weight[..., 1] + share * weight[..., 0]),
        ],
        axis=2,
    )
    tied = np.tile([True, False], count)
    variance = np.where(tied, (TIED * scatter) ** 2, FREE_RAD**2) * np.ones((moments.runs, 1))
    ends = np.repeat(np.stack([was, goal]), 2, axis=2)
    start, stop = ends.min(axis=0) - MARGIN * scatter, ends.max(axis=0) + MARGIN * scatter
    centre = _flat(was, free)

    def amount_prior(x: FloatArray, run: IntArray, row: IntArray) -> FloatArray:
        begin, end = start[run, row, None], stop[run, row, None]
        between = np.where((x >= begin) & (x <= end), -np.log(end - begin), -np.inf)
        anywhere = np.log(share) - np.log(high - low)[run, None]
        ramp = np.logaddexp(np.log1p(-share) + between, anywhere)
        width = variance[run, row, None]
        normal = -0.5 * ((x - centre[run, row, None]) ** 2 / width + np.log(2.0 * np.pi * width))
        return np.where(tied[row, None], normal, ramp)

    onsets = _stuck_onsets(scene, motor, intervals, was, goal)
    if known is not None:
        onsets = sampled(np.full((*centre.shape, 1), known), np.ones((*centre.shape, 1)))
    return moving.rows(
        centre,
        variance,
        _flat(log_prior[..., 0], log_prior[..., 1]),
        amount_prior,
        onsets,
        _tie(scene, motor),
    )


def _tie(scene: Scene, motor: int) -> FloatArray:
    """Return what theta adds to where the motor had settled, (run, row, theta); 0 on ramps."""
    moments, layout = scene.moments, scene.layout
    load = loads(scene.model, scene.settled)[..., motor]
    direction = moments.direction[:, :, 0, motor]
    columns = np.stack([np.ones_like(load), load, -direction], axis=-1)
    tie = np.zeros((moments.runs, 2 * moments.count, layout.size))
    plateaus = tie[:, ::2]
    plateaus[..., layout.own(motor)] = np.concatenate([columns[:, :1], columns[:, :-1]], axis=1)
    return tie


def _flat(plateau: FloatArray, ramp: FloatArray) -> FloatArray:
    """Return values of plateaus and ramps (run, moment) as those of rows, (run, row)."""
    return np.stack([plateau, ramp], axis=2).reshape(len(plateau), -1)


def _held_angle(count: int) -> Angle:
    def angle(x: FloatArray, outcome: IntArray) -> FloatArray:
        del outcome
        return np.repeat(x[:, :, None], count, axis=2)

    return angle


def held_range(scene: Scene, motor: int) -> tuple[FloatArray, FloatArray]:
    """Return the lowest and the highest angle at which a motor may be held, (run,) [rad] each."""
    robot, moments = scene.model.twin.robot, scene.moments
    (low, high), margin = robot.travel[motor], robot.held_beyond(motor)
    told = np.concatenate([moments.origin[:, :1, motor], moments.target[..., motor]], axis=1)
    lowest, highest = told.min(axis=1), told.max(axis=1)
    return np.minimum(low, lowest) - margin, np.maximum(high, highest) + margin


def stuck_intervals(scene: Scene, motor: int) -> OnsetIntervals:
    """Return plateau and ramp before each moment, (run, moment, plateau | ramp) [s].

    Readings on the way tell by how much they trail their commands.
    """
    moments, model = scene.moments, scene.model
    ramp = moments.ramp * (1.0 - model.shortening)
    trailed = moments.time - moments.start - ramp.max(axis=-1)
    on_way = moments.speed[:, :, 0].any(axis=-1)
    start = moments.start + np.where(on_way, trailed, model.lag_s)
    return plateau_or_ramp(start, start + ramp[..., motor])


def _stuck_onsets(
    scene: Scene, motor: int, intervals: OnsetIntervals, was: FloatArray, goal: FloatArray
) -> Onsets:
    """Return the onset of each row: anywhere on a plateau, on a ramp when it passed the angle.

    A motor that was stuck before the run got stuck at 0.

    On a ramp of length T from `was` to `goal`, held at x give or take d, with lag give or take l,

        t = begin + T (x - was) / (goal - was),    var(t) = T^2 (d^2 + s^2) / (goal - was)^2 + l^2

    with s the scatter of the motor about its command. On a curve, by the command q(a) of age a,

        p(t = time - a) ~ N(x; q(a), d^2 + s^2 + b^2)

    with b what it is off by chance on its way.
    """
    model = scene.model
    begin, length = np.nan_to_num(intervals.begin), intervals.length
    lag, scatter = np.hypot(*model.lag_deviations_s), float(model.scatter[motor])
    share, curved = np.full(len(POINTS), 1.0 / len(POINTS)), scene.moments.on_curves
    way_s = scene.moments.way_s

    def of_row(run: int, row: int, amount: FloatArray) -> tuple[FloatArray, FloatArray]:
        m, on_ramp = divmod(row, 2)
        parts = begin[run, m, :, None] + POINTS * length[run, m, :, None]  # (part, sample)
        if row == 0:
            return np.append(parts[0], 0.0), np.append(share, 1.0)
        if not on_ramp:
            return parts[0], share
        first, travel = was[run, m], goal[run, m] - was[run, m]
        held, deviation = amount
        if curved[run, m]:
            by_chance = scene.moments.late[run, m, 0, motor] + scene.moments.bent[run, m, 0, motor]
            width = np.sqrt(deviation**2 + scatter**2 + by_chance)
            way, when = scene.moments.way[run, m, motor], way_s[run, m]
            told = when, goal[run, m] + way - way[-1]
            return _on_a_curve(told, length[run, m, 1], held, width, lag)
        passed = (held - first) / travel if abs(travel) > STILL_RAD else np.inf
        if not -OFF_RAMP < passed < 1.0 + OFF_RAMP:
            return parts.ravel()[::2], share
        ramp = length[run, m, 1]
        spread = np.hypot(ramp * np.hypot(deviation, scatter) / travel, lag)
        middle = begin[run, m, 1] + np.clip(passed, 0.0, 1.0) * ramp
        return np.maximum(middle + spread * NORMAL_QUANTILES, 0.0), share

    return of_row


def _on_a_curve(
    told: tuple[FloatArray, FloatArray], since_s: float, held: float, width: float, lag_s: float
) -> tuple[FloatArray, FloatArray]:
    """Return onsets before a moment on a curve [s] and their shares: when the motor was there.

    Args:
        told: When [s] it would be where [rad] up to that moment if it were not held, (sample,).
        since_s: How long before it its stretch begins [s].
        held: Held angle [rad].
        width: Deviation of the motor from it where it stopped [rad].
        lag_s: Deviation of the lag [s].
    """
    age, (when, angle) = np.linspace(0.0, since_s, AGES), told
    was = np.interp(when[-1] - age, when, angle)
    spread = np.hypot(width, np.gradient(was) / np.sqrt(12.0))  # and between two ages
    there = width / spread * np.exp(-0.5 * ((held - was) / spread) ** 2)
    share = np.repeat(there + LEAST_THERE, len(NORMAL_QUANTILES))
    onset = when[-1] - age[:, None] + lag_s * NORMAL_QUANTILES
    return np.maximum(onset, 0.0).ravel(), share / share.sum()
