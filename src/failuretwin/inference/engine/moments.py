"""Moments: what the sensors say at one time of a run, the settled point after each movement.

A movement without one has a moment that is not usable.

Section: docs/inference.md#moments
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.inference.observation.command_loss import CommandOutcomes
from failuretwin.inference.observation.evidence import SettledEvidence
from failuretwin.inference.observation.healthy_model import HealthyModel

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
        direction: Sign of their last travel, same axes.
        lost: Motors that miss their command, same axes.
        log_weight: Log probability of each outcome, (run, moment, outcome).
        outcome: Index of each among all outcomes of the movement, (run, moment, outcome).
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
    outcome: IntArray

    @property
    def runs(self) -> int:
        """How many runs."""
        return len(self.usable)

    @property
    def count(self) -> int:
        """How many moments a run has at most."""
        return self.usable.shape[1]


def moments_of(model: HealthyModel, evidence: SettledEvidence) -> Moments:
    """Return the moments of some runs: the rest after each movement.

    Args:
        model: The healthy robot.
        evidence: Settled positions.
    """
    usual = model.outcomes_as_seen(evidence)
    density = model.explain(evidence, usual).density
    outcomes = model.filtered_outcomes(evidence, usual, density)
    movements = evidence.movements
    target, origin = np.nan_to_num(movements.target), np.nan_to_num(movements.origin())
    chosen, kept = _likeliest(outcomes)
    base, direction, weight = kept
    return Moments(
        point=evidence.point,
        usable=evidence.usable,
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
