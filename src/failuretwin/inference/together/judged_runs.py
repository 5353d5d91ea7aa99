"""What runs say that are judged together: of their hypotheses, of scatter and of lost commands.

Section: docs/inference.md#folders
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.digital_model.nonidealities import LostCommand
from failuretwin.failure_behavior.mode import Signature
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.engine.posterior import ThetaPart, pooled, theta_factors, theta_parts
from failuretwin.inference.engine.scatter import outcome_shares, scatter_information
from failuretwin.inference.engine.weighing import Weighing
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.together.belief import Belief
from failuretwin.inference.together.habits import Habits, log_factors_of

LEAST_TOLD = 1e-3
"""What is less probable is not asked for scatter and losses."""
SHOWN = 4.0
"""Travel of a motor, in its scatter, from which a lost command shows."""
LEAST_LIKELY = 1e-8
"""What is less probable is not weighed again before the last pass over the runs."""


@dataclass(frozen=True)
class Judged:
    """What some of the runs say, each with its cavity.

    Attributes:
        rows: Which they are.
        weighing: The runs, about one theta.
        cavity: What was believed without them, in units.
        loose: Whether the frame of the sensor is in doubt in each part of the cavity, (part,).
    """

    rows: IntArray
    weighing: Weighing
    cavity: Belief
    loose: BoolArray

    @property
    def runs(self) -> int:
        """How many they are."""
        return len(self.rows)

    @property
    def likely(self) -> BoolArray:
        """Which hypotheses of each run may teach something, (run, hypothesis)."""
        return np.asarray(self.weighing.share.sum(axis=1) > LEAST_LIKELY)

    @cached_property
    def parts(self) -> list[ThetaPart]:
        """Theta under all that is probable, by hypothesis."""
        return theta_parts(self.weighing.evidence)

    def moments(self, loose: bool) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return theta if the frame of the sensor is in doubt, or if it is not.

        Returns:
            Probability of that (run,), mean (run, theta) and covariance (run, theta, theta).
        """
        which = self.loose[self.weighing.components.normal] == loose
        some = [part.of_components(which) for part in self.parts]
        weight = np.zeros(self.runs)
        for part in some:
            np.add.at(weight, part.picks.run, part.weight)
        return weight, *pooled(some, self.runs)

    @property
    def factors(self) -> tuple[FloatArray, FloatArray]:
        """What each run alone says of theta: Lambda (run, theta, theta) and eta (run, theta)."""
        return theta_factors(self.weighing.evidence)

    def habits(self, given: HealthyModel) -> Habits:
        """Return what the runs say of scatter and losses, (run, ...); faulty motors left out.

        A motor that is held takes the others where healthy runs do not go, under loads that their
        compliance is stretched to: what is left of those movements is not taken for scatter.

        Args:
            given: The robot as it was given.
        """
        habits, evidence = Habits.none(self.runs, given), self.weighing.evidence
        now = log_factors_of(self.weighing.likelihood.model, given)
        for part in self._telling():
            run, weight = part.picks.run, part.weight
            hypothesis = evidence.hypotheses[part.hypothesis]
            outcomes = outcome_shares(evidence, part)
            for i, entry in enumerate(given.imperfections.lost_commands):
                lost = self._losses(entry, hypothesis, part, outcomes)
                np.add.at(habits.losses[:, i], run, weight[:, None, None] * lost)
            if not _holds(hypothesis):
                told = scatter_information(evidence, part)
                shift = told.information @ now + told.score
                np.add.at(habits.precision, run, weight[:, None, None] * told.information)
                np.add.at(habits.shift, run, weight[:, None] * shift)
        habits.forget_tails(np.flatnonzero(self.weighing.likelihood.evidence.on_the_way))
        return habits

    def _telling(self) -> Iterator[ThetaPart]:
        """Yield theta where it is probable, by hypothesis; the weights of a run sum to 1."""
        kept = [part.above(LEAST_TOLD) for part in self.parts]
        total = np.full(self.runs, 1e-300)
        for part in kept:
            np.add.at(total, part.picks.run, part.weight)
        for part in kept:
            yield part.scaled(1.0 / total)

    def _losses(
        self, entry: LostCommand, hypothesis: Hypothesis, part: ThetaPart, outcomes: FloatArray
    ) -> FloatArray:
        """Return how often some motors lose a command, punctual and late, (pick, 2, 2).

        Of movements in which all of them travel; a motor that hardly does shows no loss, so that
        those of the others count without it.
        """
        likelihood, run = self.weighing.likelihood, part.picks.run
        names, late = likelihood.model.motor_names, likelihood.late
        lost = np.isin(names, entry.motors)
        faulty = np.isin(names, [fault.motor for fault in hypothesis.faults])
        told = np.zeros((len(run), 2, 2))
        if (lost & faulty).any():
            return told
        patterns = self.weighing.evidence.scene.model.lost_commands.lost
        movements, model = likelihood.evidence.movements, likelihood.model
        travel = np.abs(movements.target - movements.origin())[run]  # (pick, movement, motor)
        travels = travel > SHOWN * model.scatter
        shown = patterns & travels[:, :, None]
        hit = (shown[..., ~faulty] == lost[~faulty]).all(axis=-1)
        counts = travels[..., lost].all(axis=-1)
        for k, kind in enumerate((1.0 - late[run], late[run])):
            told[:, k, 0] = (np.where(hit, outcomes, 0.0).sum(axis=-1) * kind * counts).sum(axis=1)
            told[:, k, 1] = (outcomes.sum(axis=-1) * kind * counts).sum(axis=1)
        return told


def _holds(hypothesis: Hypothesis) -> bool:
    return any(MODES[fault.mode].signature is Signature.HELD for fault in hypothesis.faults)
