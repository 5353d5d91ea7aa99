"""Bayesian diagnosis: which hypothesis explains where the tool went, and how surely."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.connection.healthy import HealthyModel
from failuretwin.core.diagnosis import Diagnosis, MovementEvidence
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Hypothesis, paper_hypotheses
from failuretwin.core.quadrature import log_sum
from failuretwin.core.runs import check_motors, check_runs, truth_of
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.data_knowledge.log_quality import LogQuality, log_quality, without_spoilt
from failuretwin.data_knowledge.moving_evidence import MovingEvidence, moving_evidence
from failuretwin.data_knowledge.settled_evidence import SettledEvidence, settled_evidence
from failuretwin.decision.assessment import lost_commands, unused_movements, why_undecided
from failuretwin.decision.priors import Priors
from failuretwin.decision.scene import Scene
from failuretwin.decision.weighing import check_weighable, log_prior, shows_on_way, weigh_all
from failuretwin.decision.weight import Estimate, Weight
from failuretwin.decision.wording import explanation, verdict
from failuretwin.digital_model.imperfections import Imperfections, default_imperfections
from failuretwin.digital_model.twin import DigitalTwin

if TYPE_CHECKING:
    import xarray as xr

CHUNK_RUNS = 64
"""Runs of five movements at a time: keeps the work on nodes in about 100 MB."""

LEVELS = (0.05, 0.5, 0.95)
"""Quantiles that are told: the ends of a 90 % interval and the median."""


@dataclass(frozen=True)
class _Weighed:
    """Some runs with every hypothesis weighed.

    Attributes:
        scene: The runs.
        log_posterior: (run, hypothesis).
        weights: What the runs say of each hypothesis, in their order.
    """

    scene: Scene
    log_posterior: FloatArray
    weights: Sequence[Weight]


@dataclass(frozen=True)
class BayesDiagnoser:
    """Posterior over hypotheses from where the tool settled in a run, and how it got there.

    Attributes:
        twin: Digital twin of the robot.
        imperfections: How the healthy robot differs from it; None: as its profile says.
        hypotheses: What may be the case, with the prior odds of the table of
            failure modes; None: the paper's classes.
        priors: Beliefs about onset and size.
        whole_run: Whether readings on the way count beside settled poses, where it is known how
            late this robot starts to move.
    """

    twin: DigitalTwin
    imperfections: Imperfections | None = None
    hypotheses: Sequence[Hypothesis] | None = None
    priors: Priors = field(default_factory=Priors)
    whole_run: bool = True

    def __post_init__(self) -> None:
        for hypothesis in self._hypotheses:
            check_weighable(hypothesis)

    @cached_property
    def _hypotheses(self) -> Sequence[Hypothesis]:
        return self.hypotheses or paper_hypotheses(self.twin.robot.motor_names)

    @cached_property
    def healthy_model(self) -> HealthyModel:
        """What a healthy run looks like."""
        imperfections = self.imperfections or default_imperfections(self.twin.robot)
        return HealthyModel(self.twin, imperfections)

    def diagnose(self, runs: xr.Dataset) -> list[Diagnosis]:
        """Return the diagnosis of each run of a run set.

        Reads `command` and `measured` alone; the truth, where there is any, is only passed on.

        Raises:
            InputError: If the run set is of another robot or no run holds a movement.
        """
        self._check(runs)
        quality = log_quality(runs)
        sound = without_spoilt(runs, quality)
        evidence = settled_evidence(sound)
        if evidence.movements.start.shape[1] == 0:
            raise InputError(
                "no run holds a movement: `command` never leaves its first value. Expected runs "
                "of one movement at least."
            )
        moving = self._on_way(sound, evidence)
        names = [str(name) for name in runs["run"].values]
        faults = truth_of(runs)
        truth: list[str | None] = [None] * len(names) if faults is None else list(faults)
        results = []
        chunk = _runs_at_a_time(evidence.movements.start.shape[1])
        for first in range(0, len(names), chunk):
            rows = slice(first, first + chunk)
            weighed = self._weigh(evidence[rows], None if moving is None else moving[rows])
            for run in range(len(weighed.log_posterior)):
                at = first + run
                results.append(self._conclude(weighed, run, names[at], truth[at], quality[at]))
        return results

    def _on_way(self, runs: xr.Dataset, evidence: SettledEvidence) -> MovingEvidence | None:
        """Return the readings on the way that count; None where there are none.

        Where a motor settled says all about most faults, and more reliably, so readings on the
        way count beside it only where some hypothesis shows nowhere else.
        """
        if not (self.whole_run and self.healthy_model.knows_timing):
            return None
        moving = moving_evidence(runs, evidence)
        if any(shows_on_way(hypothesis) for hypothesis in self._hypotheses):
            return moving
        unseen = ~evidence.usable
        unseen[:, 1:] |= unseen[:, :-1]  # what follows tells where it ended
        return moving.where(unseen)

    def _check(self, runs: xr.Dataset) -> None:
        check_runs(runs, "the run set")
        check_motors(runs, self.twin.robot.name, self.twin.robot.motor_names)
        known, end = self.priors.onset.known_s, float(runs["time"].values[-1])
        if known is not None and known > end:
            raise InputError(f"the onset is given as {known:g} s, but the runs end at {end:g} s.")

    def _weigh(self, evidence: SettledEvidence, moving: MovingEvidence | None) -> _Weighed:
        scene = Scene(evidence, self.healthy_model, moving)
        weights = weigh_all(scene, self._hypotheses, self.priors)
        log_joint = np.stack([w.log_evidence for w in weights], axis=1) + log_prior(
            self._hypotheses
        )
        return _Weighed(scene, log_joint - log_sum(log_joint, axis=1)[:, None], weights)

    def _conclude(
        self, weighed: _Weighed, run: int, name: str, truth: str | None, quality: LogQuality
    ) -> Diagnosis:
        evidence, imperfections = weighed.scene.evidence, self.healthy_model.imperfections
        order = np.argsort(-weighed.log_posterior[run], kind="stable")
        ranked = [self._hypotheses[i] for i in order]
        best = weighed.weights[order[0]]
        undecided = why_undecided(
            quality,
            evidence,
            run,
            float(np.exp(weighed.log_posterior[run, order[0]])),
            best.settled[run],
            self.healthy_model.outlier_log_density,
        )
        # Without a verdict nothing is learnt: the prior stands.
        posterior = np.exp(log_prior(self._hypotheses) if undecided else weighed.log_posterior[run])
        used = "settled poses" if weighed.scene.moving is None else "whole run"
        diagnosis = Diagnosis(
            run=name,
            truth=truth,
            posterior={str(h): float(p) for h, p in zip(self._hypotheses, posterior, strict=True)},
            quality=(*quality.remarks, *unused_movements(evidence, run)),
            undecided=undecided,
            protocol=imperfections.protocol,
            method=f"bayes, {used}; healthy behaviour: {imperfections.name}",
        )
        losses: list[str] = []
        if not undecided:
            diagnosis = replace(diagnosis, evidence=_evidence(weighed, run, order))
            estimate = best.estimate(run)
            losses = self._losses(weighed, estimate, ranked[0])
            diagnosis = _with_estimate(diagnosis, ranked[0], estimate)
        return replace(
            diagnosis,
            verdict=verdict(diagnosis, ranked),
            explanation=explanation(diagnosis, ranked, losses),
        )

    def _losses(self, weighed: _Weighed, estimate: Estimate, hypothesis: Hypothesis) -> list[str]:
        """Return the commands that seem not to have arrived if `hypothesis` is true."""
        lost = weighed.scene.alternatives.lost
        faulty = [fault.motor for fault in hypothesis.faults]
        return lost_commands(estimate.became, lost, self.twin.robot.motor_names, faulty)


def _runs_at_a_time(movements: int) -> int:
    """Return how many runs of so many movements to weigh at a time: nodes grow with the square."""
    return max(1, min(CHUNK_RUNS, 25 * CHUNK_RUNS // max(movements, 1) ** 2))


def _evidence(weighed: _Weighed, run: int, order: IntArray) -> tuple[MovementEvidence, ...]:
    """Return what each usable movement says of the best hypothesis against the second."""
    if len(order) < 2:
        return ()
    best, second = (weighed.weights[i].by_movement[run] for i in order[:2])
    usable = np.flatnonzero(weighed.scene.evidence.usable[run])
    return tuple(MovementEvidence(int(m) + 1, float(best[m] - second[m])) for m in usable)


def _with_estimate(diagnosis: Diagnosis, hypothesis: Hypothesis, estimate: Estimate) -> Diagnosis:
    """Return the diagnosis with onset and magnitude of the fault that is most probable."""
    if estimate.onset is not None:
        early, middle, late = estimate.onset.quantiles(LEVELS).tolist()
        diagnosis = replace(diagnosis, onset_s=middle, onset_90=(early, late))
    if estimate.size is not None:
        low, half, high = estimate.size.quantiles(LEVELS).tolist()
        unit = hypothesis.faults[0].magnitude_unit
        diagnosis = replace(
            diagnosis, magnitude=half, magnitude_unit=unit, magnitude_90=(low, high)
        )
    return diagnosis
