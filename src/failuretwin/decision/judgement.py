"""Some runs with every hypothesis weighed: the posterior, and the diagnosis of each in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from failuretwin.core.diagnosis import Diagnosis, MovementEvidence
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.quadrature import log_sum
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.data_knowledge.log_quality import LogQuality
from failuretwin.decision.assessment import lost_commands, unused_movements, why_undecided
from failuretwin.decision.evidence.scene import Scene
from failuretwin.decision.hypotheses.priors import Priors
from failuretwin.decision.hypotheses.weighing import log_prior, weigh_all
from failuretwin.decision.hypotheses.weight import Estimate, Weight
from failuretwin.decision.wording import explanation, verdict

LEVELS = (0.05, 0.5, 0.95)
"""Quantiles that are told: the ends of a 90 % interval and the median."""


@dataclass(frozen=True)
class Place:
    """Where a run lies in a stream.

    Attributes:
        begin_s: When it begins [s].
        movements: Movements of the stream before it.
        before: What was said before; of a fault that is older than the run, its onset stands.
    """

    begin_s: float = 0.0
    movements: int = 0
    before: Diagnosis | None = None

    def known_onset(self, hypothesis: Hypothesis) -> Diagnosis | None:
        """Return what was said before, if that was the same fault, older than the run.

        Args:
            hypothesis: What is said now.
        """
        before = self.before
        if before is None or before.onset_s is None or before.diagnosis != str(hypothesis):
            return None
        return before if before.onset_s < self.begin_s else None


@dataclass(frozen=True)
class Judgement:
    """Some runs with every hypothesis weighed.

    Attributes:
        scene: The runs.
        hypotheses: What may be the case.
        log_prior: (hypothesis,).
        log_posterior: (run, hypothesis).
        weights: What the runs say of each hypothesis, in their order.
    """

    scene: Scene
    hypotheses: Sequence[Hypothesis]
    log_prior: FloatArray
    log_posterior: FloatArray
    weights: Sequence[Weight]

    def undecided(self, run: int, quality: LogQuality) -> str:
        """Return why a run allows no verdict, empty if it does.

        Args:
            run: Index of the run.
            quality: Defects of its log.
        """
        best = int(np.argmax(self.log_posterior[run]))
        return why_undecided(
            quality,
            self.scene.evidence,
            run,
            float(np.exp(self.log_posterior[run, best])),
            self.weights[best].settled(run),
            self.scene.model.outlier_log_density,
        )

    def posterior(self, run: int, undecided: str) -> FloatArray:
        """Return the posterior of a run, (hypothesis,).

        Args:
            run: Index of the run.
            undecided: Why it allows no verdict. Then nothing is learnt: the prior stands.
        """
        return np.exp(self.log_prior if undecided else self.log_posterior[run])

    def conclude(
        self,
        run: int,
        name: str,
        quality: LogQuality,
        truth: str | None = None,
        place: Place = Place(),
    ) -> Diagnosis:
        """Return the diagnosis of a run.

        Args:
            run: Index of the run.
            name: What to call it.
            quality: Defects of its log.
            truth: What was wrong, where known; it is only passed on.
            place: Where it lies in a stream, whose times and movements are told.
        """
        evidence, imperfections = self.scene.evidence, self.scene.model.imperfections
        order = np.argsort(-self.log_posterior[run], kind="stable")
        ranked = [self.hypotheses[i] for i in order]
        best, undecided = self.weights[order[0]], self.undecided(run, quality)
        posterior = self.posterior(run, undecided)
        used = "settled poses" if self.scene.moving is None else "whole run"
        diagnosis = Diagnosis(
            run=name,
            truth=truth,
            posterior={str(h): float(p) for h, p in zip(self.hypotheses, posterior, strict=True)},
            quality=(*quality.remarks, *unused_movements(evidence, run)),
            undecided=undecided,
            protocol=imperfections.protocol,
            method=f"bayes, {used}; healthy behaviour: {imperfections.name}",
        )
        losses: list[str] = []
        if not undecided:
            diagnosis = replace(diagnosis, evidence=self._evidence(run, order, place))
            estimate = best.estimate(run)
            losses = self._losses(estimate, ranked[0])
            diagnosis = _with_estimate(diagnosis, ranked[0], estimate, place)
        return replace(
            diagnosis,
            verdict=verdict(diagnosis, ranked),
            explanation=explanation(diagnosis, ranked, losses),
        )

    def _evidence(self, run: int, order: IntArray, place: Place) -> tuple[MovementEvidence, ...]:
        """Return what each usable movement says of the best hypothesis against the second."""
        if len(order) < 2:
            return ()
        best, second = (self.weights[i].by_movement(run) for i in order[:2])
        usable = np.flatnonzero(self.scene.evidence.usable[run])
        return tuple(
            MovementEvidence(place.movements + int(m) + 1, float(best[m] - second[m]))
            for m in usable
        )

    def _losses(self, estimate: Estimate, hypothesis: Hypothesis) -> list[str]:
        """Return the commands that seem not to have arrived if `hypothesis` is true."""
        motors = self.scene.model.twin.robot.motor_names
        faulty = [fault.motor for fault in hypothesis.faults]
        return lost_commands(estimate.became, self.scene.alternatives.lost, motors, faulty)


def judge(scene: Scene, hypotheses: Sequence[Hypothesis], priors: Priors) -> Judgement:
    """Weigh every hypothesis by some runs.

    Args:
        scene: The runs.
        hypotheses: What may be the case.
        priors: Beliefs about onset and size.
    """
    weights, prior = weigh_all(scene, hypotheses, priors), log_prior(hypotheses, priors)
    log_joint = np.stack([weight.log_evidence for weight in weights], axis=1) + prior
    log_posterior = log_joint - log_sum(log_joint, axis=1)[:, None]
    return Judgement(scene, hypotheses, prior, log_posterior, weights)


def _with_estimate(
    diagnosis: Diagnosis, hypothesis: Hypothesis, estimate: Estimate, place: Place
) -> Diagnosis:
    """Return the diagnosis with onset and magnitude of the fault that is most probable."""
    if estimate.onset is not None:
        early, middle, late = (place.begin_s + estimate.onset.quantiles(LEVELS)).tolist()
        diagnosis = replace(diagnosis, onset_s=middle, onset_90=(early, late))
        known = place.known_onset(hypothesis)
        if known is not None:
            diagnosis = replace(diagnosis, onset_s=known.onset_s, onset_90=known.onset_90)
    if estimate.size is not None:
        low, half, high = estimate.size.quantiles(LEVELS).tolist()
        unit = hypothesis.faults[0].magnitude_unit
        diagnosis = replace(
            diagnosis, magnitude=half, magnitude_unit=unit, magnitude_90=(low, high)
        )
    return diagnosis
