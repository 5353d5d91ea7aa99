"""Single runs of a robot that nobody has calibrated, or of one of the kind of a calibrated one.

The components are those of theta, scatter and noise; what a run had to assume of its robot is told
with it.

Section: docs/inference.md#runs
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.numerics import log_sum
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.arm_classes import GENERIC_NAME
from failuretwin.inference.engine.moments import moments_of
from failuretwin.inference.engine.posterior import marginal_likelihoods, theta_posterior
from failuretwin.inference.engine.rows import Scene
from failuretwin.inference.engine.runs import RunsEvidence, has_rows
from failuretwin.inference.engine.theta import REGISTRATION, layout_of, robot_components
from failuretwin.inference.faults.marginal import MarginalLikelihood
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.posterior import Posterior, log_prior
from failuretwin.inference.set_ups.set_ups import odd_zero
from failuretwin.inference.theta.shared_unknowns import layout_of as doubted_layout

CHUNK_RUNS = 16
"""Runs that are weighed at a time: columns of all rows and outcomes stay below 100 MB."""
TOLD = 0.9
"""Probability from which a run says what it had to assume of its robot."""


def speaks_of(likelihood: RunLikelihood, hypotheses: Sequence[Hypothesis]) -> bool:
    """Return whether the engine weighs these runs: at rest, offsets unknown, all faults in rows."""
    if likelihood.moving is not None or not doubted_layout(likelihood.model).offsets:
        return False
    healthy = any(h.is_healthy for h in hypotheses)
    return healthy and all(has_rows(h) for h in hypotheses)


def runs_evidence(
    likelihood: RunLikelihood, hypotheses: Sequence[Hypothesis], priors: Priors
) -> list[RunsEvidence]:
    """Return the evidence of runs, so many at a time as fit in memory."""
    model, odds = likelihood.model, log_prior(hypotheses, priors)
    factors = model.imperfections.name == GENERIC_NAME and model.scatter_factor == 1.0
    found = []
    for at in range(0, len(likelihood.usable), CHUNK_RUNS):
        moments = moments_of(model, likelihood.evidence[slice(at, at + CHUNK_RUNS)])
        layout = layout_of(model.without_doubt)
        components = robot_components(model, layout, factors)
        covariance = components.covariance[0]
        scene = Scene.of(model.without_doubt, moments, priors, layout, covariance)
        found.append(RunsEvidence(scene, hypotheses, components, odds))
    return found


def evidence_by_hypothesis(
    likelihood: RunLikelihood, hypotheses: Sequence[Hypothesis], priors: Priors
) -> FloatArray:
    """Return log p(run | h), (run, hypothesis)."""
    parts = runs_evidence(likelihood, hypotheses, priors)
    return np.concatenate([one.by_hypothesis for one in parts])


def unknown_robot_posterior(
    likelihood: RunLikelihood, hypotheses: Sequence[Hypothesis], priors: Priors
) -> Posterior:
    """Weigh every hypothesis by runs of an unknown robot; see `speaks_of`."""
    parts = [_Part(one) for one in runs_evidence(likelihood, hypotheses, priors)]
    odds = log_prior(hypotheses, priors)
    log_joint = np.concatenate([one.evidence.by_hypothesis for one in parts]) + odds
    return Posterior(
        likelihood,
        hypotheses,
        odds,
        log_joint - log_sum(log_joint, axis=1)[:, None],
        [_joined([one.weights[h] for one in parts]) for h in range(len(hypotheses))],
        [said for one in parts for said in one.remarks],
        [said for one in parts for said in one.odd_zeros],
    )


def _joined(parts: Sequence[MarginalLikelihood]) -> MarginalLikelihood:
    """Return what several sets of runs say of a hypothesis as one."""
    if len(parts) == 1:
        return parts[0]

    def at(run: int) -> tuple[MarginalLikelihood, int]:
        part, own = divmod(run, CHUNK_RUNS)
        return parts[part], own

    return MarginalLikelihood(
        np.concatenate([one.log_evidence for one in parts]),
        lambda run: at(run)[0].by_movement(at(run)[1]),
        lambda run: at(run)[0].settled(at(run)[1]),
        lambda run: at(run)[0].estimate(at(run)[1]),
    )


@dataclass(frozen=True)
class _Part:
    """Some of the runs.

    Attributes:
        evidence: What they say.
    """

    evidence: RunsEvidence

    @cached_property
    def weights(self) -> list[MarginalLikelihood]:
        """What the runs say of each hypothesis."""
        return marginal_likelihoods(self.evidence)

    @property
    def remarks(self) -> list[str]:
        """What each run had to assume of its robot; empty where nothing."""
        evidence, components = self.evidence, self.evidence.components
        height = log_sum(evidence.log_evidence + evidence.log_odds, axis=2)
        share = np.exp(height - log_sum(height, axis=1)[:, None])
        usual = evidence.scene.model.path_noise
        wide, noisy = components.sigma > 1.0, components.noise_m > 1.5 * usual
        told = []
        for one in share:
            said = []
            if one[wide].sum() > TOLD:
                factor = components.sigma[int(np.argmax(np.where(wide, one, 0.0)))]
                said.append(
                    f"the motors seem to scatter about {factor:g} times as much as arms of this "
                    "class do; judged so"
                )
            if one[noisy].sum() > TOLD:
                noise = 1e3 * components.noise_m[int(np.argmax(np.where(noisy, one, 0.0)))]
                said.append(
                    f"the sensor seems noisier than is known of it: by about {noise:.2g} mm; "
                    "judged so"
                )
            told.append("; ".join(said))
        return told

    @property
    def odd_zeros(self) -> list[str]:
        """Which zero of each run is far off what such robots do; empty where none is."""
        scene = self.evidence.scene
        motors = scene.layout.motors
        zeros = slice(REGISTRATION, REGISTRATION + motors)
        usual = np.sqrt(np.diag(self.evidence.components.covariance[0]))[zeros]
        mean, covariance = theta_posterior(self.evidence)
        deviation = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))[:, zeros]
        sure = np.maximum(np.abs(mean[:, zeros]) - 2.0 * deviation, 0.0) / usual
        robot = scene.model.twin.robot
        return [odd_zero(robot, *pair) for pair in zip(mean[:, zeros], sure, strict=True)]
