"""What runs say that are judged together: of their hypotheses, of scatter and of lost commands.

Section: docs/inference.md#folders
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.numerics import log_sum
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.digital_model.nonidealities import Imperfections, LostCommand
from failuretwin.failure_behavior.mode import Signature
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.posterior import Posterior
from failuretwin.inference.theta.scatter_score import told_of_scatter
from failuretwin.inference.theta.shared_belief import Belief
from failuretwin.inference.theta.shared_likelihood import has_score
from failuretwin.inference.theta.shared_posterior import Mixture
from failuretwin.inference.theta.shared_weighing import Candidate, SharedWeighing
from failuretwin.inference.together.habits import Habits

LEAST_TOLD = 1e-3
"""What is less probable is not asked for scatter and losses."""

LEAST_LIKELY = 1e-8
"""What is less probable is not weighed again before the last pass over the runs."""


@dataclass(frozen=True)
class Judged:
    """What some of the runs say, each with its cavity.

    Attributes:
        rows: Which they are.
        weighing: The runs.
        cavity: What was believed without them, in units.
        candidates: What was found with each component of that.
        log_evidence: Log of weight times evidence, (run, candidate, hypothesis).
        loose: Whether the frame of the sensor is in doubt with each, (candidate,).
    """

    rows: IntArray
    weighing: SharedWeighing
    cavity: Belief
    candidates: Sequence[Candidate]
    log_evidence: FloatArray
    loose: BoolArray

    @property
    def share(self) -> FloatArray:
        """Probability of each hypothesis with each candidate, (run, candidate, hypothesis)."""
        height = self.log_evidence + self.weighing.log_odds
        return np.exp(height - log_sum(height, axis=(1, 2))[:, None, None])

    @property
    def likely(self) -> BoolArray:
        """Which hypotheses of each run may teach something, (run, hypothesis)."""
        return np.asarray(self.share.sum(axis=1) > LEAST_LIKELY)

    def posterior(self) -> Posterior:
        """Return the posterior over hypotheses of each run."""
        top = np.argmax(self.log_evidence, axis=1)[:, None]
        first = np.arange(len(self.candidates))[None, :, None] == top
        whole = log_sum(self.log_evidence, axis=1)[:, None]
        table = np.where(first, whole, -np.inf)
        return Mixture(self.weighing, self.candidates, table).posterior()

    def habits(self, given: Imperfections, covariance: FloatArray, at: FloatArray) -> Habits:
        """Return what the runs say of scatter and losses, (run, ...); faulty motors left out.

        A motor that is held takes the others where healthy runs do not go, under loads that their
        compliance is stretched to: what is left of those movements is not taken for scatter.

        Args:
            given: What was given of the robot.
            covariance: Of theta under each hypothesis, (run, candidate, hypothesis, theta, theta).
            at: Logarithms of scatter and tail that the runs were weighed with, (motor + 1,).
        """
        habits, priors = Habits.none(len(self.rows), given), self.weighing.priors
        for c, h, rows, share in self._telling():
            hypothesis, found = self.weighing.hypotheses[h], self.candidates[c].found
            response = found.expansion.response[rows]
            told = told_of_scatter(response, hypothesis, priors, found.theta[rows, h])
            for i, entry in enumerate(given.lost_commands):
                lost = self._losses(entry, hypothesis, rows, told.outcomes)
                habits.losses[rows, i] += share[:, None, None] * lost
            if _holds(hypothesis):
                continue
            slack = np.einsum("rntu,rtu->rn", told.slack, covariance[rows, c, h], optimize=True)
            along = told.information @ at + told.score
            along[:, :-1] += slack
            habits.precision[rows] += share[:, None, None] * told.information
            habits.shift[rows] += share[:, None] * along
        return habits

    def _telling(self) -> Iterator[tuple[int, int, IntArray, FloatArray]]:
        """Yield candidate, hypothesis, runs and their shares, where these matter.

        What has no score of its own tells as the most probable that has.
        """
        scored = np.array([has_score(h) for h in self.weighing.hypotheses])
        share = np.where(scored, self.share, 0.0)
        best = share.reshape(len(share), -1).argmax(axis=1)
        share.reshape(len(share), -1)[np.arange(len(share)), best] += 1.0 - share.sum(axis=(1, 2))
        for c, h in np.argwhere((share > LEAST_TOLD).any(axis=0)):
            rows = np.flatnonzero(share[:, c, h] > LEAST_TOLD)
            yield int(c), int(h), rows, share[rows, c, h]

    def _losses(
        self, entry: LostCommand, hypothesis: Hypothesis, rows: IntArray, outcomes: FloatArray
    ) -> FloatArray:
        """Return how often some motors lose a command, punctual and late, (run, 2, 2)."""
        names, late = self.weighing.likelihood.model.motor_names, self.weighing.likelihood.late
        lost = np.isin(names, entry.motors)
        faulty = np.isin(names, [fault.motor for fault in hypothesis.faults])
        told = np.zeros((len(rows), 2, 2))
        if (lost & faulty).any():
            return told
        patterns = self.candidates[0].found.expansion.response.usual.lost
        hit = (patterns[:, ~faulty] == lost[~faulty]).all(axis=1)
        for k, kind in enumerate((1.0 - late[rows], late[rows])):
            told[:, k, 0] = (outcomes[..., hit].sum(axis=-1) * kind).sum(axis=1)
            told[:, k, 1] = (outcomes.sum(axis=-1) * kind).sum(axis=1)
        return told


def _holds(hypothesis: Hypothesis) -> bool:
    return any(MODES[fault.mode].signature is Signature.HELD for fault in hypothesis.faults)
