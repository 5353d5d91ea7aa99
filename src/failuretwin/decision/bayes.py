"""Bayesian diagnosis from settled poses: which hypothesis explains where the tool came to rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.core.diagnosis import Diagnosis
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Hypothesis, paper_hypotheses
from failuretwin.core.runs import check_runs, truth_of
from failuretwin.core.types import FloatArray
from failuretwin.decision.evidence import SettledEvidence, settled_evidence
from failuretwin.decision.healthy import Alternatives, HealthyModel
from failuretwin.decision.quadrature import log_sum
from failuretwin.decision.steady_state_error import (
    ERROR_RANGES,
    ErrorEvidence,
    Range,
    error_evidence,
)
from failuretwin.decision.stuck import OnsetPrior, StuckEvidence, stuck_evidence
from failuretwin.decision.wording import quality_of, verdict
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
        if not 0.0 <= low < high:
            raise InputError(f"--sse-range is {low:g} {high:g}, expected 0 <= LOW < HIGH.")
        count = robot.servo_units.rad_per_count
        priors = replace(priors, error_ranges=((low * count, high * count),))
    if onset_s is not None:
        if not onset_s >= 0.0:
            raise InputError(f"--onset is {onset_s:g} s, expected 0 or more.")
        priors = replace(priors, onset=replace(priors.onset, known_s=onset_s))
    return priors


@dataclass(frozen=True)
class BayesDiagnoser:
    """Posterior over hypotheses from the settled tool positions of a run.

    Attributes:
        twin: Digital twin of the robot.
        imperfections: How the healthy robot differs from it; None: as its profile says.
        hypotheses: What may be the case, all equally likely; None: the paper's classes.
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
        evidence = settled_evidence(runs)
        if evidence.movements.start.shape[1] == 0:
            raise InputError(
                "no run holds a movement: `command` never leaves its first value. Expected runs "
                "of one movement at least."
            )
        names = [str(name) for name in runs["run"].values]
        known = truth_of(runs)
        truth: list[str | None] = [None] * len(names) if known is None else list(known)
        results = []
        for first in range(0, len(names), CHUNK_RUNS):
            part = slice(first, first + CHUNK_RUNS)
            results += self._diagnose_part(evidence[part], names[part], truth[part])
        return results

    def _check(self, runs: xr.Dataset) -> None:
        check_runs(runs, "the run set")
        motors = [str(name) for name in runs["motor"].values]
        if motors != self.twin.robot.motor_names:
            raise InputError(
                f"the run set has motors {', '.join(motors)}; robot {self.twin.robot.name!r} has "
                f"{', '.join(self.twin.robot.motor_names)}. Name the right robot (--robot)."
            )

    def _diagnose_part(
        self, evidence: SettledEvidence, names: Sequence[str], truth: Sequence[str | None]
    ) -> list[Diagnosis]:
        model = self.healthy_model
        alternatives = model.alternatives(evidence.movements)
        healthy = model.log_healthy(evidence, alternatives)
        found: dict[Hypothesis, FaultEvidence] = {}
        columns = []
        for hypothesis in self._hypotheses:
            if hypothesis.is_healthy:
                columns.append(healthy.sum(axis=1))
                continue
            found[hypothesis] = self._weigh(hypothesis, evidence, model, alternatives, healthy)
            columns.append(found[hypothesis].log_evidence)
        log_likelihood = np.stack(columns, axis=1)
        log_posterior = log_likelihood - log_sum(log_likelihood, axis=1)[:, None]
        return [
            self._conclude(run, names[run], truth[run], np.exp(log_posterior[run]), found, evidence)
            for run in range(len(names))
        ]

    def _weigh(
        self,
        hypothesis: Hypothesis,
        evidence: SettledEvidence,
        model: HealthyModel,
        alternatives: Alternatives,
        healthy: FloatArray,
    ) -> FaultEvidence:
        fault = hypothesis.faults[0]
        motor = self.twin.robot.motor_names.index(fault.motor)
        if fault.mode == "stuck":
            return stuck_evidence(evidence, model, alternatives, healthy, motor, self.priors.onset)
        return error_evidence(evidence, model, alternatives, motor, self.priors.error_ranges)

    def _conclude(
        self,
        run: int,
        name: str,
        truth: str | None,
        posterior: FloatArray,
        found: dict[Hypothesis, FaultEvidence],
        evidence: SettledEvidence,
    ) -> Diagnosis:
        imperfections = self.healthy_model.imperfections
        best = self._hypotheses[int(np.argmax(posterior))]
        diagnosis = Diagnosis(
            run=name,
            truth=truth,
            posterior={str(h): float(p) for h, p in zip(self._hypotheses, posterior, strict=True)},
            quality=quality_of(evidence, run),
            protocol=imperfections.protocol,
            method=f"bayes, settled poses; healthy behaviour: {imperfections.name}",
        )
        if best in found:
            diagnosis = _estimate(diagnosis, best, found[best], run)
        return replace(
            diagnosis, verdict=verdict(diagnosis, enough=bool(evidence.usable[run].any()))
        )


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
