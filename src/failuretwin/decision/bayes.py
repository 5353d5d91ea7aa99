"""Bayesian diagnosis from settled poses: which hypothesis explains where the tool came to rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.connection.healthy import Alternatives, HealthyModel
from failuretwin.core.diagnosis import Diagnosis, MovementEvidence
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Hypothesis, paper_hypotheses
from failuretwin.core.quadrature import log_sum
from failuretwin.core.runs import check_motors, check_runs, truth_of
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.data_knowledge.knowledge import prior_odds
from failuretwin.data_knowledge.log_quality import LogQuality, log_quality, without_spoilt
from failuretwin.data_knowledge.settled_evidence import SettledEvidence, settled_evidence
from failuretwin.decision.assessment import lost_commands, unused_movements, why_undecided
from failuretwin.decision.steady_state_error import (
    ERROR_RANGES,
    ErrorEvidence,
    Range,
    error_evidence,
)
from failuretwin.decision.stuck import LAG_S, OnsetPrior, StuckEvidence, stuck_evidence
from failuretwin.decision.wording import explanation, verdict
from failuretwin.digital_model.imperfections import Imperfections, default_imperfections
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin

if TYPE_CHECKING:
    import xarray as xr

CHUNK_RUNS = 32
"""Runs at a time: keeps the work on held angles in about 50 MB."""

FaultEvidence = StuckEvidence | ErrorEvidence


@dataclass(frozen=True)
class Priors:
    """What is believed before the run is seen.

    Attributes:
        onset: When a motor may have got stuck.
        error_ranges: Run-level ranges of steady-state errors [rad], equally likely.
    """

    onset: OnsetPrior = field(default_factory=OnsetPrior)
    error_ranges: Sequence[Range] = ERROR_RANGES


def priors_of(
    robot: Robot, error_range_counts: tuple[float, float] | None, onset_s: float | None
) -> Priors:
    """Return priors with what is known of the faults, the default for what is not.

    Args:
        robot: The robot, for its servo units.
        error_range_counts: Range of steady-state errors [servo units].
        onset_s: Onset of stuck faults [s].

    Raises:
        InputError: If the range is not 0 <= low < high or the onset is negative.
    """
    priors = Priors()
    if error_range_counts is not None:
        low, high = error_range_counts
        if not 0.0 <= low < high < np.inf:
            raise InputError(f"--sse-range is {low:g} {high:g}, expected 0 <= LOW < HIGH.")
        count = robot.servo_units.rad_per_count
        priors = replace(priors, error_ranges=((low * count, high * count),))
    if onset_s is not None:
        if not 0.0 <= onset_s < np.inf:
            raise InputError(f"--onset is {onset_s:g} s, expected 0 or more.")
        priors = replace(priors, onset=replace(priors.onset, known_s=onset_s))
    return priors


@dataclass(frozen=True)
class _Weighed:
    """Some runs with every hypothesis weighed.

    Attributes:
        evidence: Settled positions.
        alternatives: What may have become of each movement.
        log_posterior: (run, hypothesis).
        by_movement: Log density of each movement given all others, (run, hypothesis, movement).
        found: What was found of each fault.
    """

    evidence: SettledEvidence
    alternatives: Alternatives
    log_posterior: FloatArray
    by_movement: FloatArray
    found: dict[Hypothesis, FaultEvidence]


@dataclass(frozen=True)
class BayesDiagnoser:
    """Posterior over hypotheses from the settled tool positions of a run.

    Attributes:
        twin: Digital twin of the robot.
        imperfections: How the healthy robot differs from it; None: as its profile says.
        hypotheses: What may be the case, with the prior odds of the table of
            failure modes; None: the paper's classes.
        priors: Beliefs about onset and size.
    """

    twin: DigitalTwin
    imperfections: Imperfections | None = None
    hypotheses: Sequence[Hypothesis] | None = None
    priors: Priors = field(default_factory=Priors)

    def __post_init__(self) -> None:
        for hypothesis in self._hypotheses:
            if not hypothesis.known or len(hypothesis.faults) > 1:
                raise InputError(f"hypothesis '{hypothesis}' cannot be weighed by this method.")
            for fault in hypothesis.faults:
                if fault.mode not in ("stuck", "steady_state_error"):
                    raise InputError(
                        f"fault mode {fault.mode!r} cannot be weighed by this method. Expected "
                        "stuck or steady_state_error."
                    )

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
        known, end = self.priors.onset.known_s, float(runs["time"].values[-1])
        if known is not None and known > end:
            raise InputError(f"the onset is given as {known:g} s, but the runs end at {end:g} s.")
        quality = log_quality(runs)
        evidence = settled_evidence(without_spoilt(runs, quality))
        if evidence.movements.start.shape[1] == 0:
            raise InputError(
                "no run holds a movement: `command` never leaves its first value. Expected runs "
                "of one movement at least."
            )
        names = [str(name) for name in runs["run"].values]
        faults = truth_of(runs)
        truth: list[str | None] = [None] * len(names) if faults is None else list(faults)
        results = []
        for first in range(0, len(names), CHUNK_RUNS):
            weighed = self._weigh_all(evidence[first : first + CHUNK_RUNS])
            for run in range(len(weighed.log_posterior)):
                at = first + run
                results.append(self._conclude(weighed, run, names[at], truth[at], quality[at]))
        return results

    def _check(self, runs: xr.Dataset) -> None:
        check_runs(runs, "the run set")
        check_motors(runs, self.twin.robot.name, self.twin.robot.motor_names)

    def _weigh_all(self, evidence: SettledEvidence) -> _Weighed:
        model = self.healthy_model
        alternatives = model.alternatives(evidence.movements)
        healthy = model.log_healthy(evidence, alternatives)
        found: dict[Hypothesis, FaultEvidence] = {}
        columns, by_movement = [], []
        for hypothesis in self._hypotheses:
            if hypothesis.is_healthy:
                columns.append(healthy.sum(axis=1))
                by_movement.append(healthy)
                continue
            weight = self._weigh(hypothesis, evidence, alternatives, healthy)
            found[hypothesis] = weight
            columns.append(weight.log_evidence)
            by_movement.append(weight.by_movement)
        log_prior = np.log([prior_odds(hypothesis) for hypothesis in self._hypotheses])
        log_joint = np.stack(columns, axis=1) + log_prior
        return _Weighed(
            evidence=evidence,
            alternatives=alternatives,
            log_posterior=log_joint - log_sum(log_joint, axis=1)[:, None],
            by_movement=np.stack(by_movement, axis=1),
            found=found,
        )

    def _weigh(
        self,
        hypothesis: Hypothesis,
        evidence: SettledEvidence,
        alternatives: Alternatives,
        healthy: FloatArray,
    ) -> FaultEvidence:
        fault, model = hypothesis.faults[0], self.healthy_model
        motor = self.twin.robot.motor_names.index(fault.motor)
        if fault.mode == "stuck":
            return stuck_evidence(evidence, model, alternatives, healthy, motor, self.priors.onset)
        return error_evidence(evidence, model, alternatives, motor, self.priors.error_ranges)

    def _conclude(
        self, weighed: _Weighed, run: int, name: str, truth: str | None, quality: LogQuality
    ) -> Diagnosis:
        imperfections = self.healthy_model.imperfections
        order = np.argsort(-weighed.log_posterior[run], kind="stable")
        ranked = [self._hypotheses[i] for i in order]
        undecided = why_undecided(
            quality,
            weighed.evidence,
            run,
            float(np.exp(weighed.log_posterior[run, order[0]])),
            weighed.by_movement[run, order[0]],
            self.healthy_model.outlier_log_density,
        )
        # Without a verdict nothing is learnt: the prior stands.
        prior = np.array([prior_odds(hypothesis) for hypothesis in self._hypotheses])
        posterior = prior / prior.sum() if undecided else np.exp(weighed.log_posterior[run])
        diagnosis = Diagnosis(
            run=name,
            truth=truth,
            posterior={str(h): float(p) for h, p in zip(self._hypotheses, posterior, strict=True)},
            quality=(*quality.remarks, *unused_movements(weighed.evidence, run)),
            undecided=undecided,
            protocol=imperfections.protocol,
            method=f"bayes, settled poses; healthy behaviour: {imperfections.name}",
        )
        losses: list[str] = []
        if not undecided:
            diagnosis = replace(diagnosis, evidence=_evidence(weighed, run, order))
            losses = self._losses(weighed, run, ranked[0])
            if ranked[0] in weighed.found:
                diagnosis = _estimate(diagnosis, ranked[0], weighed.found[ranked[0]], run)
        return replace(
            diagnosis,
            verdict=verdict(diagnosis, ranked),
            explanation=explanation(diagnosis, ranked, losses),
        )

    def _losses(self, weighed: _Weighed, run: int, best: Hypothesis) -> list[str]:
        """Return the commands that seem not to have arrived if `best` is true."""
        model, one = self.healthy_model, slice(run, run + 1)
        evidence, alternatives = weighed.evidence[one], weighed.alternatives[one]
        base, held = alternatives.base.copy(), model.none_held.copy()
        found, faulty = weighed.found.get(best), None
        if found is not None:
            faulty = best.faults[0].motor
            motor = self.twin.robot.motor_names.index(faulty)
            if isinstance(found, StuckEvidence):
                after = evidence.movements.start[0] >= found.onset[run, 1] - LAG_S
                base[:, after, :, motor] = found.angle[run, 1]
                held[motor] = bool(after.all())
            else:
                base[..., motor] += found.offset[one, :, None]
        pose = model.settle(base, alternatives.direction, held)
        became = model.became(evidence, alternatives, pose, held)[0]
        return lost_commands(became, alternatives.lost, self.twin.robot.motor_names, faulty)


def _evidence(weighed: _Weighed, run: int, order: IntArray) -> tuple[MovementEvidence, ...]:
    """Return what each usable movement says of the best hypothesis against the second."""
    if len(order) < 2:
        return ()
    best, second = weighed.by_movement[run, order[0]], weighed.by_movement[run, order[1]]
    usable = np.flatnonzero(weighed.evidence.usable[run])
    return tuple(MovementEvidence(int(m) + 1, float(best[m] - second[m])) for m in usable)


def _estimate(
    diagnosis: Diagnosis, hypothesis: Hypothesis, found: FaultEvidence, run: int
) -> Diagnosis:
    """Return the diagnosis with onset and magnitude of the fault that is most probable."""
    size = found.angle if isinstance(found, StuckEvidence) else found.size
    low, middle, high = (float(value) for value in size[run])
    onset = (0.0, 0.0, 0.0)
    if isinstance(found, StuckEvidence):
        early, half, late = (float(value) for value in found.onset[run])
        onset = (early, half, late)
    return replace(
        diagnosis,
        onset_s=onset[1],
        onset_90=(onset[0], onset[2]),
        magnitude=middle,
        magnitude_unit=hypothesis.faults[0].magnitude_unit,
        magnitude_90=(low, high),
    )
