"""Moments: what the sensors say at one time of a run, at rest or on the way.

A rest is the settled point at the end of a movement. Where a movement has none, some readings on
its way count, each at the pose of the command one lag earlier.

Section: docs/inference.md#moments
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.inference.observation.command_loss import CommandOutcomes
from failuretwin.inference.observation.evidence import SettledEvidence, TransientSamples
from failuretwin.inference.observation.healthy_model import HealthyModel

MOST_OUTCOMES = 12
"""Outcomes of a movement that are weighed: the most probable ones."""


@dataclass(frozen=True)
class Moments:
    """Moments of some runs, in the order of time.

    Attributes:
        movement: Movement of each moment, (run, moment).
        point: What the sensors say, (run, moment, channel) [m].
        usable: Moments with readings, (run, moment).
        done: Share of the travel of each motor that is done, (run, moment, motor); 1 at rest.
        speed: Commanded speed, (run, moment, motor) [rad/s]; 0 at rest.
        target: Commanded angle at the end of the movement, (run, moment, motor) [rad].
        origin: Commanded angle before it, (run, moment, motor) [rad].
        start: Start of the movement, (run, moment) [s].
        ramp: Duration of its ramps, (run, moment, motor) [s].
        time: When the moment is, (run, moment) [s].
        base: Angles that the motors go for under each outcome, (run, moment, outcome, motor) [rad].
        direction: Sign of their last travel, same axes.
        lost: Motors that miss their command, same axes.
        log_weight: Log probability of each outcome, (run, moment, outcome).
        outcome: Index of each among all outcomes of the movement, (run, moment, outcome).
    """

    movement: IntArray
    point: FloatArray
    usable: BoolArray
    done: FloatArray
    speed: FloatArray
    target: FloatArray
    origin: FloatArray
    start: FloatArray
    ramp: FloatArray
    time: FloatArray
    base: FloatArray
    direction: FloatArray
    lost: BoolArray
    log_weight: FloatArray
    outcome: IntArray

    @property
    def runs(self) -> int:
        """How many runs."""
        return len(self.usable)

    @property
    def count(self) -> int:
        """How many moments a run has at most."""
        return self.usable.shape[1]


def moments_of(
    model: HealthyModel,
    evidence: SettledEvidence,
    moving: TransientSamples | None = None,
) -> Moments:
    """Return the moments of some runs.

    Args:
        model: The healthy robot.
        evidence: Settled positions.
        moving: Readings on the way that count; None: rests alone.
    """
    rests = _rests(model, evidence)
    if moving is None or not moving.seen.any():
        return rests
    return _in_time([rests, *_ways(model, evidence, moving, rests)])


def _rests(model: HealthyModel, evidence: SettledEvidence) -> Moments:
    usual = model.outcomes_as_seen(evidence)
    density = model.explain(evidence, usual).density
    outcomes = model.filtered_outcomes(evidence, usual, density)
    movements = evidence.movements
    target, origin = np.nan_to_num(movements.target), np.nan_to_num(movements.origin())
    chosen, kept = _likeliest(outcomes)
    base, direction, weight = kept
    return Moments(
        movement=np.tile(np.arange(target.shape[1]), (len(target), 1)),
        point=evidence.point,
        usable=evidence.usable,
        done=np.ones_like(target),
        speed=np.zeros_like(target),
        target=target,
        origin=origin,
        start=np.nan_to_num(movements.start),
        ramp=np.nan_to_num(movements.ramp_duration),
        time=np.nan_to_num(0.5 * (evidence.begin + evidence.end)),
        base=base,
        direction=direction,
        lost=outcomes.lost[chosen],
        log_weight=weight,
        outcome=chosen,
    )


WAY = 2
"""Readings of a movement that count on its way; those that follow share its lag."""
EARLIEST, LATE = 0.3, 0.02
"""Share of the longest travel from which a reading counts, and probability of a late start up to
which it does."""


def _ways(
    model: HealthyModel, evidence: SettledEvidence, moving: TransientSamples, rests: Moments
) -> list[Moments]:
    """Return readings on the way, as many sets of one moment a movement as count."""
    late = model.late(evidence.movements, evidence.first_reading_delay)
    ramp = np.maximum(rests.ramp * (1.0 - model.shortening), 1e-3)
    since = moving.since - model.lag_s  # (run, movement, reading)
    done = since / np.maximum(ramp.max(axis=-1), 1e-3)[..., None]
    counts = moving.seen & (done > EARLIEST) & (late < LATE)[..., None]
    rank = np.cumsum(counts[..., ::-1], axis=-1)[..., ::-1]  # 1 for the last that counts
    found = []
    for k in range(1, WAY + 1):
        this = counts & (rank == k)
        usable = this.any(axis=-1)
        if not usable.any():
            continue
        at = np.argmax(this, axis=-1)[..., None]
        when = np.take_along_axis(since, at, axis=-1)
        point = np.take_along_axis(moving.point, at[..., None], axis=2)[:, :, 0]
        share = np.where(usable[..., None], np.clip(when / ramp, 0.0, 1.0), 1.0)
        speed = np.where(share < 1.0, (rests.target - rests.origin) / ramp, 0.0)
        origin = rests.origin[:, :, None]
        way = origin + (rests.base - origin) * share[:, :, None]
        found.append(
            replace(
                rests,
                point=point,
                usable=usable,
                done=share,
                speed=speed,
                time=rests.start + np.take_along_axis(moving.since, at, axis=-1)[..., 0],
                base=np.where(rests.lost, rests.base, way),
            )
        )
    return found


def _in_time(parts: list[Moments]) -> Moments:
    """Return all moments of some sets in the order of time; those without readings come last."""
    time = np.concatenate([np.where(p.usable, p.time, np.inf) for p in parts], axis=1)
    order = np.argsort(time, axis=1, kind="stable")
    most = max(int(np.isfinite(time).sum(axis=1).max(initial=0)), parts[0].usable.shape[1])
    order = order[:, :most]

    def sort(name: str) -> np.ndarray:
        values = np.concatenate([getattr(p, name) for p in parts], axis=1)
        at = order.reshape(*order.shape, *(1,) * (values.ndim - 2))
        return np.take_along_axis(values, at, axis=1)

    return Moments(**{field.name: sort(field.name) for field in fields(Moments)})


def _likeliest(
    outcomes: CommandOutcomes,
) -> tuple[IntArray, tuple[FloatArray, FloatArray, FloatArray]]:
    """Return the most probable outcomes of each movement, that every command arrives first."""
    weight = outcomes.log_weight.copy()
    weight[..., 0] = np.inf
    count = int(np.isfinite(outcomes.log_weight).sum(axis=-1).max(initial=1))
    chosen = np.argsort(-weight, axis=-1, kind="stable")[..., : min(count, MOST_OUTCOMES)]
    at = chosen[..., None]
    base = np.take_along_axis(outcomes.base, at, axis=2)
    direction = np.take_along_axis(outcomes.direction, at, axis=2)
    return chosen, (base, direction, np.take_along_axis(outcomes.log_weight, chosen, axis=2))
