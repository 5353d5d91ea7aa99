"""Moments: what the sensors say at one time of a run, at rest after a movement or on its way.

A movement that was not seen has a moment that is not usable.

Section: docs/inference.md#moments
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from failuretwin.core.movements import WAY_SAMPLES, Stretches
from failuretwin.core.numerics import log_of
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.inference.observation.command_loss import CommandOutcomes
from failuretwin.inference.observation.evidence import SettledEvidence
from failuretwin.inference.observation.healthy_model import HealthyModel

LATE_RATE = 0.02
"""Least probability that an arm on whose way it is looked has not set out yet: a bus that stalls, a
controller that thinks; assumed."""
KEPT_ON_CURVES = 0.7
"""Probability that an error on a curve stays what it is until the next moment; assumed."""
BEND, OWN_BEND = 0.5, 0.3
"""Share of `Stretches.bend` by which motors are off, in the mean, and the deviation of each from
what they share; assumed."""
LOSSY = 3.0
"""How many times as often as usual commands get lost in some robots; assumed."""
MOST_OUTCOMES = 12
"""Outcomes of a movement that are weighed: the most probable ones."""


@dataclass(frozen=True)
class Moments:
    """Moments of some runs, in the order of time.

    Attributes:
        point: What the sensors say, (run, moment, channel) [m].
        usable: Moments with readings, (run, moment).
        target: Commanded angle at the end of the movement, (run, moment, motor) [rad].
        origin: Commanded angle before it, (run, moment, motor) [rad].
        start: Start of the movement, (run, moment) [s].
        ramp: Duration of its ramps, (run, moment, motor) [s].
        time: When the moment is, (run, moment) [s].
        base: Angles that the motors go for under each outcome, (run, moment, outcome, motor) [rad].
        direction: Sign of their last travel; on the way, of their friction, same axes.
        lost: Motors that miss their command, same axes.
        log_weight: Log probability of each outcome, (run, moment, outcome).
        lossy: Log of how much more probable each is where commands get lost `LOSSY` times as often,
            (run, moment, outcome).
        outcome: Index of each among all outcomes of the movement, (run, moment, outcome).
        speed: Of each motor, (run, moment, outcome, motor) [rad/s]; 0 at rest.
        bend: What an acceleration may put it off by, same axes [rad]; 0 at rest.
        late: Variance of each motor by uneven starts, (qd sigma)^2, same axes [rad2]; 0 at rest.
        done: Share of the movement that each motor had made, (run, moment, motor).
        kept: Probability that what became of the moment before holds on, (run, moment): 1 in one
            ramp, 0 with a new movement.
        way: Command that shows from the moment before up to each, evenly in time; the first from
            0 on, (run, moment, motor, sample) [rad]; 0 where no run is on its way.
    """

    point: FloatArray
    usable: BoolArray
    target: FloatArray
    origin: FloatArray
    start: FloatArray
    ramp: FloatArray
    time: FloatArray
    base: FloatArray
    direction: FloatArray
    lost: BoolArray
    log_weight: FloatArray
    lossy: FloatArray
    outcome: IntArray
    speed: FloatArray
    bend: FloatArray
    late: FloatArray
    done: FloatArray
    kept: FloatArray
    way: FloatArray

    @property
    def bent(self) -> FloatArray:
        """Variance of each motor by its own share of the bend, same axes as `late` [rad2]."""
        return np.asarray((OWN_BEND * self.bend) ** 2)

    def trailing(self, lag_s: FloatArray) -> Moments:
        """Return the same of motors that trail their commands by more, (motor,) [s]."""
        return replace(self, base=self.base - self.speed * lag_s)

    @property
    def way_s(self) -> FloatArray:
        """When the samples of `way` show, (run, moment, sample) [s]."""
        time = np.maximum.accumulate(self.time, axis=1)
        before = np.concatenate([np.zeros_like(time[:, :1]), time[:, :-1]], axis=1)
        share = (np.arange(WAY_SAMPLES) + 1.0) / WAY_SAMPLES
        return np.asarray(before[..., None] + (time - before)[..., None] * share)

    @property
    def on_curves(self) -> BoolArray:
        """Which moments are on a curve that has others too, (run, moment)."""
        found = (self.kept > 0.0) & (self.kept < 1.0)
        found[:, :-1] |= found[:, 1:]
        return found

    @property
    def runs(self) -> int:
        """How many runs."""
        return len(self.usable)

    @property
    def count(self) -> int:
        """How many moments a run has at most."""
        return self.usable.shape[1]


def moments_of(model: HealthyModel, evidence: SettledEvidence) -> Moments:
    """Return the moments of some runs.

    Args:
        model: The healthy robot.
        evidence: Settled positions.
    """
    usual = model.outcomes_as_seen(evidence)
    density = model.explain(evidence, usual).density
    outcomes = model.filtered_outcomes(evidence, usual, density)
    often = model.filtered_outcomes(evidence, usual, density, LOSSY).log_weight
    possible = np.isfinite(outcomes.log_weight)
    lossy = np.where(possible, often, 0.0) - np.where(possible, outcomes.log_weight, 0.0)
    movements = Stretches.of(evidence.movements)
    target, origin = np.nan_to_num(movements.target), np.nan_to_num(movements.origin())
    part = ~movements.whole[..., None] & outcomes.lost.any(axis=-1)  # lost as a whole, or not
    outcomes = replace(outcomes, log_weight=np.where(part, -np.inf, outcomes.log_weight))
    chosen, kept = _likeliest(outcomes)
    base, direction, weight = kept
    lost, way = outcomes.lost[chosen], ~movements.at_rest & movements.exists
    speed, bend = (
        np.where(lost, 0.0, values[:, :, None]) for values in (movements.speed, movements.bend)
    )
    turned = movements.direction[:, :, None]
    found = Moments(
        point=evidence.point,
        usable=evidence.usable,
        target=target,
        origin=origin,
        start=np.nan_to_num(movements.start),
        ramp=np.nan_to_num(movements.ramp_duration),
        time=np.nan_to_num(0.5 * (evidence.begin + evidence.end)),
        base=base + BEND * bend,
        direction=np.where(lost | np.isnan(turned), direction, turned),
        lost=lost,
        log_weight=weight,
        lossy=np.take_along_axis(lossy, chosen, axis=2),
        outcome=chosen,
        speed=speed,
        bend=bend,
        late=(speed * model.start_jitter_s) ** 2,
        done=movements.done,
        kept=_kept(movements, way),
        way=np.nan_to_num(movements.way),
    )
    late = np.maximum(model.late(movements, evidence.first_reading_delay), LATE_RATE)
    return _with_waiting(found, np.where(way & movements.whole, late, 0.0))


def _kept(stretches: Stretches, way: BoolArray) -> FloatArray:
    """Return how probable it is that what became of the moment before holds on, (run, moment).

    Args:
        stretches: The movements.
        way: Which are seen on the way, (run, movement).
    """
    kept = np.zeros(way.shape)
    same = way[:, 1:] & (stretches.movement[:, 1:] == stretches.movement[:, :-1])
    kept[:, 1:] = np.where(same, np.where(stretches.curved[:, 1:], KEPT_ON_CURVES, 1.0), 0.0)
    return kept


def _with_waiting(moments: Moments, late: FloatArray) -> Moments:
    """Return moments with one outcome more, if it can be: that no motor has set out yet.

    Args:
        moments: Without it.
        late: Its probability, (run, moment).
    """
    if not late.any():
        return moments
    still = np.zeros_like(moments.base[:, :, :1])
    weight = moments.log_weight
    waits = weight[..., :1] + log_of(late)[..., None]

    def more(name: str, values: FloatArray) -> FloatArray:
        return np.concatenate([getattr(moments, name), values], axis=2)

    return replace(
        moments,
        base=more("base", moments.origin[:, :, None]),
        direction=more("direction", moments.direction[:, :, :1]),
        lost=np.concatenate([moments.lost, np.ones_like(moments.lost[:, :, :1])], axis=2),
        log_weight=np.concatenate([weight + log_of(1.0 - late)[..., None], waits], axis=-1),
        lossy=np.concatenate([moments.lossy, moments.lossy[..., :1]], axis=-1),
        outcome=np.concatenate([moments.outcome, np.zeros_like(moments.outcome[..., :1])], axis=-1),
        speed=more("speed", still),
        bend=more("bend", still),
        late=more("late", still),
    )


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
