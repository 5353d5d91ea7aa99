"""How what movements say changes with the shared unknowns: residuals, to first order.

    rho = L^-1 r,  Gamma = L^-1 G,  lambda = L^-1 J_k    with S = L L^T
    D^2(delta) = |rho - Gamma delta|^2                              of a healthy robot
    phi*(delta) = phi* - lambda^T Gamma delta / P
    D0^2(delta) = |rho - (I - lambda lambda^T / P) Gamma delta|^2   with motor k wherever it is best

Nothing of the arm is computed anew for another theta, so that many can be tried.

Section: docs/inference.md#shared-unknowns
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from failuretwin.core.numerics import log_fall
from failuretwin.core.types import ArrayStruct, Axes, FloatArray, IntArray
from failuretwin.inference.movements.joint_likelihood import (
    LEAST_PRECISION,
    JointLikelihood,
    MovementLikelihoods,
    joint_likelihoods,
)
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.command_loss import CommandOutcomes
from failuretwin.inference.observation.evidence import SettledEvidence, TransientSamples
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.theta.shared_unknowns import SharedLayout, columns, loads

PerOutcome = Annotated[FloatArray, Axes("run", "movement", "outcome")]
Vector = Annotated[FloatArray, Axes("run", "movement", "outcome", "axis")]
ByTheta = Annotated[FloatArray, Axes("run", "movement", "outcome", "theta")]


@dataclass(frozen=True)
class Whitened(ArrayStruct):
    """Residuals and their columns in units of their scale, (run, movement, outcome, ...).

    Attributes:
        rho: L^-1 r, (..., channel).
        gamma: L^-1 G, (..., channel, theta).
        log_norm: Log density at the centre, (...).
        levers: L^-1 J, (..., channel, motor).
        dims: Dimensions in which what is seen can differ.
    """

    rho: Vector
    gamma: Annotated[FloatArray, Axes("run", "movement", "outcome", "axis", "theta")]
    log_norm: PerOutcome
    levers: Annotated[FloatArray, Axes("run", "movement", "outcome", "axis", "motor")]
    dims: int = 3

    def off(self, delta: FloatArray) -> FloatArray:
        """Return rho - Gamma delta, (..., channel).

        Args:
            delta: Change of theta, as many axes as rho, (..., theta).
        """
        return np.asarray(self.rho - np.matmul(self.gamma, delta[..., None])[..., 0])

    def square(self, delta: FloatArray) -> FloatArray:
        """Return D^2 at theta + delta, (run, movement, outcome).

        Args:
            delta: Change of theta, (run, theta).
        """
        off = self.off(delta[:, None, None])
        return np.einsum("...k,...k->...", off, off)


@dataclass(frozen=True)
class MotorResponse(ArrayStruct):
    """The same with one motor at the angle that brings the tool nearest to where it was seen.

    Attributes:
        profile: What each movement says of the motor at theta.
        seen: Residual and columns, those of the motor's own offsets left out and all without what
            the motor itself makes up for.
        lever: lambda^T Gamma, (run, movement, outcome, theta).
        own: Derivative of where it settles if healthy by its own offsets b, c and f,
            (run, movement, outcome, 3); empty where offsets are not in doubt.
    """

    profile: JointLikelihood
    seen: Whitened
    lever: ByTheta
    own: ByTheta

    def at(
        self, delta: FloatArray, outcomes: CommandOutcomes, own_places: list[int]
    ) -> JointLikelihood:
        """Return what each movement says of the motor at theta + delta.

        Args:
            delta: Change of theta, (run, theta).
            outcomes: What may have become of each movement then.
            own_places: Places of its own offsets in theta.
        """
        profile, by_run = self.profile, delta[:, None, None]
        turned = np.einsum("...k,...k->...", self.lever, by_run)
        shift = np.einsum("...k,...k->...", self.own, by_run[..., own_places])
        possible = np.isfinite(profile.log_weight)
        return replace(
            profile,
            mode=profile.mode - turned / np.maximum(profile.precision, LEAST_PRECISION),
            min_distance2=np.where(possible, self.seen.square(delta), 0.0),
            log_weight=np.where(possible, outcomes.log_weight + self.seen.log_norm, -np.inf),
            expected=profile.expected + np.where(possible, shift, 0.0),
            faulty_baseline=profile.faulty_baseline + np.where(possible, shift, 0.0),
        )


@dataclass(frozen=True)
class LinearResponse:
    """What some runs say, at one theta and near it.

    Attributes:
        evidence: Settled positions, registered at theta.
        model: The healthy robot at theta.
        layout: What stands in theta.
        usual: What may become of each movement, whatever was seen.
        findings: What every movement says of a healthy robot by itself at theta.
        healthy: Residuals of a healthy robot under each outcome.
        motors: Residuals with each motor where it is best.
        moving: Readings on the way, registered at theta; None: they are left aside.
    """

    evidence: SettledEvidence
    model: HealthyModel
    layout: SharedLayout
    usual: CommandOutcomes
    findings: MovementLikelihoods
    healthy: Whitened
    motors: tuple[MotorResponse, ...]
    moving: TransientSamples | None = None

    @classmethod
    def of(
        cls,
        evidence: SettledEvidence,
        model: HealthyModel,
        layout: SharedLayout,
        motors: Sequence[int],
        moving: TransientSamples | None = None,
    ) -> LinearResponse:
        """Return the response of some runs.

        What may have become of each movement is judged with the doubt as scatter, so that nothing
        is left out that theta may bring back.

        Args:
            evidence: Settled positions, registered.
            model: The healthy robot; what theta holds of its doubt is no scatter.
            layout: What stands in theta.
            motors: Those to look at: none, or all in their order.
            moving: Readings on the way, registered; None: they are left aside.
        """
        usual, sharp = model.outcomes_as_seen(evidence), model
        explanation = model.explain(evidence, usual)
        outcomes = model.filtered_outcomes(evidence, usual, explanation.density)
        if layout.offsets:
            sharp = model.without_doubt
            explanation = sharp.explain(evidence, usual)
        profiles = joint_likelihoods(evidence, sharp, outcomes, motors)
        pose = sharp.settle(usual.base, usual.direction, sharp.none_held)
        place = _Place(evidence, sharp, layout)
        return cls(
            evidence,
            sharp,
            layout,
            usual,
            MovementLikelihoods(sharp, outcomes, explanation, ()),
            place.whitened(pose, usual.direction, sharp.scatter),
            tuple(place.motor(k, profile, outcomes) for k, profile in enumerate(profiles)),
            moving,
        )

    def __getitem__(self, rows: slice | IntArray) -> LinearResponse:
        """Return some of the runs alone."""
        return replace(
            self,
            evidence=self.evidence[rows],
            usual=self.usual[rows],
            findings=self.findings[rows],
            healthy=self.healthy[rows],
            motors=tuple(motor[rows] for motor in self.motors),
            moving=None if self.moving is None else self.moving[rows],
        )

    def at(self, delta: FloatArray, motors: Sequence[int]) -> RunLikelihood:
        """Return what settled positions say at theta + delta, of a healthy robot and some motors.

        Args:
            delta: Change of theta, (run, theta).
            motors: The motors; the others stand as at theta.
        """
        density = self.healthy.log_norm
        density = density + log_fall(
            self.healthy.square(delta), self.model.settling.tail_dof, self.model.sensors.dims
        )
        outcomes = self.model.filtered_outcomes(self.evidence, self.usual, density)
        profiles = [motor.profile for motor in self.motors]
        for k in motors:
            profiles[k] = self.motors[k].at(delta, outcomes, self.layout.own(k))
        explanation = replace(self.findings.explanation, density=density)
        found = replace(
            self.findings, outcomes=outcomes, explanation=explanation, profiles=tuple(profiles)
        )
        return RunLikelihood(self.evidence, self.model, remembered=found)

    def whole_at(self, delta: FloatArray) -> RunLikelihood:
        """Return what settled positions and readings on the way say at theta + delta."""
        settled = self.at(delta, range(len(self.motors)))
        return replace(settled, moving=self.moving)


@dataclass(frozen=True)
class _Place:
    """Where runs are expanded."""

    evidence: SettledEvidence
    model: HealthyModel
    layout: SharedLayout

    def motor(
        self, motor: int, profile: JointLikelihood, outcomes: CommandOutcomes
    ) -> MotorResponse:
        """Return residuals with one motor where it is best."""
        own = np.arange(self.layout.motors) == motor
        base = np.where(own, profile.place[..., None], outcomes.base)
        pose = self.model.settle(base, outcomes.direction, own)
        scale = np.where(own, 0.0, self.model.scatter)
        seen = self.whitened(pose, outcomes.direction, scale)
        seen.gamma[..., self.layout.own(motor)] = 0.0
        lever = seen.levers[..., motor]
        along = np.matmul(lever[..., None, :], seen.gamma)[..., 0, :]
        precision = np.maximum(profile.precision, LEAST_PRECISION)[..., None, None]
        gamma = seen.gamma - lever[..., None] * along[..., None, :] / precision
        derivative = np.zeros((*profile.mode.shape, 0))
        if self.layout.offsets:
            load = loads(self.model, base)[..., motor]
            parts = [np.ones_like(load), load, -outcomes.direction[..., motor]]
            derivative = np.stack(parts, axis=-1)
        rho = seen.rho - lever * (profile.mode - profile.place)[..., None]
        return MotorResponse(profile, replace(seen, rho=rho, gamma=gamma), along, derivative)

    def whitened(self, pose: FloatArray, direction: FloatArray, scale: FloatArray) -> Whitened:
        """Return whitened residuals, columns and levers."""
        point = self.evidence.point[:, :, None]
        error, jacobian, spread = self.model.residual(point, pose, scale)
        inverse = spread.inverse_root
        g = columns(self.model, pose, jacobian, direction, self.layout)
        rho = np.matmul(inverse, error[..., None])[..., 0]
        norm = spread.log_norm(self.model.settling.tail_dof)
        levers, dims = np.matmul(inverse, jacobian), self.model.sensors.dims
        return Whitened(rho, np.matmul(inverse, g), norm, levers, dims)
