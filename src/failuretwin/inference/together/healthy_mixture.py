"""Whose healthy behaviour this robot has: a calibration may be of another robot, or of other weeks.

Each candidate model c has a filter of its own; what a movement says of the candidate is its
predictive density under it, faults and repairs included:

    w_c <- [ (1 - e) w_c + e / n ] p_c(movement | before),    p(h | all) = sum over c of w_c p_c(h)

divided by their sum, with n candidates and e the probability that the robot has changed. One that
has is healthy at first: what its candidate took for a fault before says nothing of it. So a
robot that its calibration does not fit is judged by what arms of its kind are like, and a misfit
that lasts does not add up to a fault.

Section: docs/inference.md#streams
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from failuretwin.core.numerics import log_sum
from failuretwin.core.types import ArrayStruct, Axes, FloatArray
from failuretwin.inference.together.fault_filter import FaultBelief, FaultEvidence, FaultFilter

FOREIGN = 0.1
"""Probability that a calibration is of another robot, or no longer true; assumed."""
CHANGED = 1e-6
"""Probability that a robot has become another since the movement before: exchanged, readjusted;
assumed."""


@dataclass(frozen=True)
class MixtureBelief(ArrayStruct):
    """What is believed of some robots by all candidates.

    Attributes:
        log_weight: Log probability of each candidate, (robot, candidate).
        beliefs: What each of them makes of the robots.
        explained: Log density of the last movement given those before it, (robot,).
    """

    log_weight: Annotated[FloatArray, Axes("run", "candidate")]
    beliefs: tuple[FaultBelief, ...]
    explained: Annotated[FloatArray, Axes("run")]


@dataclass(frozen=True)
class HealthyMixture:
    """Candidates for the healthy behaviour of a robot.

    Attributes:
        filters: The filter of each candidate; all have the same hypotheses.
        prior: Probability of each candidate, (candidate,).
    """

    filters: Sequence[FaultFilter]
    prior: FloatArray

    def begin(self, robots: int) -> MixtureBelief:
        """Return what is believed before any movement."""
        log_weight = np.tile(np.log(self.prior), (robots, 1))
        beliefs = tuple(one.begin(robots) for one in self.filters)
        return MixtureBelief(log_weight, beliefs, np.zeros(robots))

    def advance(
        self, belief: MixtureBelief, seen: Sequence[FaultEvidence], movement: int
    ) -> MixtureBelief:
        """Return what is believed after one movement more.

        Args:
            belief: What was believed before it.
            seen: What movements say by each candidate.
            movement: Which of them.
        """
        before = np.exp(belief.log_weight)
        came = CHANGED / len(self.filters) * (1.0 - before)
        weight = before * (1.0 - CHANGED + CHANGED / len(self.filters)) + came
        parts = zip(self.filters, belief.beliefs, seen, (came / weight).T, strict=True)
        beliefs = tuple(one.advance(held, says, movement, new) for one, held, says, new in parts)
        density = np.stack(
            [
                says.healthy[:, movement] + after.log_predictive
                for says, after in zip(seen, beliefs, strict=True)
            ],
            axis=1,
        )
        joint = np.log(weight) + density
        explained = log_sum(joint, axis=1)
        return MixtureBelief(joint - explained[:, None], beliefs, explained)

    def posterior(self, belief: MixtureBelief) -> FloatArray:
        """Return the probability of each hypothesis, (robot, hypothesis)."""
        weight = np.exp(belief.log_weight)
        parts = zip(self.filters, belief.beliefs, strict=True)
        by_candidate = np.stack([one.posterior(what) for one, what in parts], axis=1)
        return np.einsum("rc,rch->rh", weight, by_candidate)
