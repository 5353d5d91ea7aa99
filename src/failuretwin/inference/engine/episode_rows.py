"""A motor that sticks now and then while it follows a curve.

In an episode it stays where the command was when the episode began, a time a before:

    angle = q(t - a) - q(t) beside the usual one,    p(a) ~ P(L > a)

with the length L of an episode, uniform over the range of its mode. A moment falls into an episode
with the share of time s that episodes fill, which is the size of the fault; the outcomes of a
moment are nodes over a, each widened by what the motor is told to move within it.

Section: docs/inference.md#moments-on-the-way
"""

from __future__ import annotations

import numpy as np

from failuretwin.core.numerics import log_of
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.failure_behavior.mode import FaultMode, Range
from failuretwin.inference.engine.moments import Moments
from failuretwin.inference.engine.outcomes import Outcomes
from failuretwin.inference.engine.rows import Episodes, Rows, Scene, sampled
from failuretwin.inference.faults.priors import OnsetIntervals

EARLY_SHARES, SHARES = 4, 2
"""Shares of the time that episodes fill, to sum over: of a fault from before the run, and of one
that begins at a later moment."""
NODES = 24
"""Shares of the time of which the posterior is told."""
AGES = 10
"""Times since an episode began, to sum over."""


def episode_rows(scene: Scene, motor: int, mode: FaultMode) -> Rows:
    """Return the rows of a motor that sticks in episodes, with each share and onset.

    Args:
        scene: The runs; those on curves tell of it.
        motor: Index of the motor.
        mode: Its mode, whose size is the share of time.
    """
    moments = scene.moments
    earlier = np.concatenate([np.zeros_like(moments.time[:, :1]), moments.time[:, :-1]], axis=1)
    intervals = OnsetIntervals(earlier, moments.time)  # a motor that stands shows it at once
    early = scene.priors.onset.before_run(mode.mode)
    number = np.r_[EARLY_SHARES, np.full(moments.count - 1, SHARES)]
    first = np.repeat(np.arange(moments.count), number)
    share = np.concatenate([_middles(*mode.considered, count) for count in number.tolist()])
    edges, probability = ages(mode.episode_s)
    outcomes = Outcomes.joined(scene.healthy, _held(scene, motor, edges))
    usual = moments.log_weight.shape[-1]
    weight, (onset, part) = intervals.weights(early), intervals.samples(early)
    nothing = np.zeros((moments.runs, len(first)))
    return Rows(
        log_of(weight[:, first]) - np.log(number[first]),
        first,
        outcomes.with_rows(),
        _log_weight(moments, first, share, probability),
        np.r_[np.arange(usual), np.zeros(AGES, dtype=np.int64)],
        scene.columns[:, None, :, 0],
        scene.columns_of,
        np.zeros((*nothing.shape, moments.count, moments.point.shape[-1])),
        nothing,
        nothing,
        onsets=sampled(onset[:, first], part[:, first]),
        episodes=Episodes(
            share,
            np.r_[np.full(usual, -1), np.arange(AGES)],
            probability,
            begun(intervals.length, mode.episode_s),
            _middles(*mode.considered, NODES),
            log_of(weight),
            onset,
            part,
        ),
    )


def ages(length_s: Range) -> tuple[FloatArray, FloatArray]:
    """Return the edges of times since an episode began, (age + 1,) [s], and their probabilities.

    Args:
        length_s: Range of the lengths of episodes, uniform [s].
    """
    edges = np.linspace(0.0, length_s[1], AGES + 1)
    lasts = _lasts(0.5 * (edges[1:] + edges[:-1]), length_s)
    return edges, lasts / lasts.sum()


def begun(gap_s: FloatArray, length_s: Range) -> FloatArray:
    """Return how probable it is that an episode has begun in a gap and lasts, (..., age).

    Args:
        gap_s: Gaps in which one begins at any time, (...) [s].
        length_s: Range of the lengths of episodes, uniform [s].
    """
    edges, gap = ages(length_s)[0], np.maximum(gap_s, 1e-9)[..., None]
    within = np.clip(np.minimum(edges[1:], gap) - edges[:-1], 0.0, None)
    return np.asarray(_lasts(edges[:-1] + 0.5 * within, length_s) * within / gap)


def _lasts(age_s: FloatArray, length_s: Range) -> FloatArray:
    """Return P(L > a) of ages a, (age,) [s]."""
    low, high = length_s
    return np.asarray(np.clip((high - age_s) / max(high - low, 1e-9), 0.0, 1.0))


def _middles(low: float, high: float, count: int) -> FloatArray:
    """Return the middles of some equal parts of a range, (part,)."""
    return low + (high - low) * (np.arange(count) + 0.5) / count


def _held(scene: Scene, motor: int, edges: FloatArray) -> Outcomes:
    """Return the outcomes in which the motor stands for some time, (run, moment, age, ...)."""
    moments, model = scene.moments, scene.model
    behind = _behind(moments, motor, edges)  # (run, moment, edge)
    base, late, beside, direction = (
        np.repeat(values[:, :, :1], len(edges) - 1, axis=2)
        for values in (moments.base, moments.late, moments.bent, moments.direction)
    )
    base[..., motor] += 0.5 * (behind[..., 1:] + behind[..., :-1])
    late[..., motor] = 0.0
    beside[..., motor] = np.diff(behind, axis=-1) ** 2 / 12.0
    pose = model.settle(base, direction, model.none_held)
    return Outcomes.of_poses(moments, model.sensors.expected(pose), model.scatter**2, late, beside)


def _behind(moments: Moments, motor: int, age_s: FloatArray) -> FloatArray:
    """Return how far the command of a motor was from now some times ago, (run, moment, age)."""
    found = np.zeros((*moments.time.shape, len(age_s)))
    time, way = moments.way_s, moments.way[:, :, motor]
    for run in range(moments.runs):
        when, told = time[run].ravel(), way[run].ravel()
        now = np.interp(time[run, :, -1], when, told)
        found[run] = np.interp(time[run, :, -1:] - age_s, when, told) - now[:, None]
    return found


def _log_weight(
    moments: Moments, first: IntArray, share: FloatArray, probability: FloatArray
) -> FloatArray:
    """Return the log weight of each outcome, (run, row, moment, outcome).

    Args:
        moments: The moments.
        first: First moment affected in each row, (row,).
        share: Share of the time that episodes fill, (row,).
        probability: Of each age, (age,).
    """
    faulty = np.arange(moments.count) >= first[:, None]
    held = np.where(faulty, share[:, None], 0.0)[None, :, :, None]
    usual = np.repeat(moments.log_weight[:, None], len(first), axis=1)
    arrives = usual[..., :1]
    stands = arrives + log_of(held) + log_of(probability)
    return np.concatenate([arrives + log_of(1.0 - held), usual[..., 1:], stands], axis=-1)
