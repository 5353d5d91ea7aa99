"""Which movements of a run a hypothesis explains how, at one theta and near it.

Those that are healthy and those of the faulty motor, each outcome with its probability w. What is
left of them, rho = L^-1 (r - G theta), is what theta and scatter are judged by.

Section: docs/inference.md#shared-unknowns
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.numerics import log_sum
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.inference.faults.marginal import (
    ChangePointPosterior,
    FaultModel,
    change_points,
    movement_log_likelihoods,
)
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.movements.joint_likelihood import LEAST_PRECISION
from failuretwin.inference.movements.run_likelihood import RunLikelihood, share_of
from failuretwin.inference.posterior import fault_model_of
from failuretwin.inference.theta.counted_outcomes import CountedOutcomes
from failuretwin.inference.theta.linear_response import LinearResponse, Whitened


@dataclass(frozen=True)
class OwnAngle:
    """The angle of the faulty motor in the movements that count.

    An angle that holds for the run is common to its movements; an offset that is drawn anew takes
    away all along its lever.

    Attributes:
        motor: The motor.
        lever: Its lever in units of all scatter, loosened where it is held, (counted, channel).
        beyond: By how much it is off the angle that is best for the movement, (counted,) [rad].
        doubt: Variance of the angle, (counted,) [rad2].
        precision: P, how well a movement tells it, (counted,) [1/rad2].
        left: By how much it is off for each theta, (counted, theta).
        pull: Score of theta for each unit of weight, times -1, (counted, theta).
        told: A factor of the information of theta that is left, (counted, theta).
    """

    motor: int
    lever: FloatArray
    beyond: FloatArray
    doubt: FloatArray
    precision: FloatArray
    left: FloatArray
    pull: FloatArray
    told: FloatArray


@dataclass(frozen=True)
class ExplainedMovements:
    """Movements that one state of the robot explains.

    Attributes:
        weight: Probability of the state and each outcome, (run, movement, outcome).
        counted: The outcomes that count.
        seen: Their residuals and columns, (counted, ...).
        off: Residuals at theta, (counted, channel).
        square: D^2 with what the motor's own angle adds, (counted,).
        own: The faulty motor's angle; None: all motors are healthy.
    """

    weight: FloatArray
    counted: CountedOutcomes
    seen: Whitened
    off: FloatArray
    square: FloatArray
    own: OwnAngle | None = None

    @cached_property
    def share(self) -> FloatArray:
        """Weight of those that count, (counted,)."""
        return self.counted(self.weight)


@dataclass(frozen=True)
class ExplainedRuns:
    """Some runs as one hypothesis explains them.

    Attributes:
        log_likelihood: L, (run,).
        usable: Which movements are settled, (run, movement).
        movements: Those of each state of the robot.
    """

    log_likelihood: FloatArray
    usable: BoolArray
    movements: tuple[ExplainedMovements, ...]


def explained(
    response: LinearResponse, hypothesis: Hypothesis, priors: Priors, theta: FloatArray
) -> ExplainedRuns:
    """Return how a hypothesis explains settled positions near theta.

    Args:
        response: The runs.
        hypothesis: What may be the case: healthy, or one motor that settles off.
        priors: Beliefs about onset and size.
        theta: Beside the theta of the response, (run, theta).
    """
    if hypothesis.is_healthy:
        likelihood = response.at(theta, ())
        healthy = _healthy(response, likelihood, theta, np.ones(likelihood.usable.shape))
        return ExplainedRuns(likelihood.log_healthy.sum(axis=1), likelihood.usable, (healthy,))
    motor = response.model.motor_names.index(hypothesis.faults[0].motor)
    likelihood = response.at(theta, (motor,))
    fault_model = fault_model_of(likelihood, hypothesis.faults[0], priors)
    says = movement_log_likelihoods(likelihood, fault_model)
    joint = change_points(likelihood.log_healthy, says.by_cell, fault_model.log_prior)
    found = ChangePointPosterior.of(joint)
    active = np.cumsum(np.exp(found.log_responsibility), axis=1)  # (run, movement, cell)
    sound = 1.0 - np.clip(active.sum(axis=-1), 0.0, 1.0)
    healthy = _healthy(response, likelihood, theta, sound)
    faulty = _faulty(response, likelihood, fault_model, theta, active, says.by_node)
    return ExplainedRuns(found.log_evidence, likelihood.usable, (healthy, faulty))


def _healthy(
    response: LinearResponse, likelihood: RunLikelihood, theta: FloatArray, share: FloatArray
) -> ExplainedMovements:
    """Return movements that are healthy with some probability, (run, movement)."""
    weight = likelihood.outcome_probability * share[..., None]
    counted = CountedOutcomes.of(weight)
    seen = counted.seen(response.healthy)
    off = seen.off(theta[counted.run])
    return ExplainedMovements(weight, counted, seen, off, np.einsum("ck,ck->c", off, off))


def _faulty(
    response: LinearResponse,
    likelihood: RunLikelihood,
    fault_model: FaultModel,
    theta: FloatArray,
    active: FloatArray,
    by_node: FloatArray,
) -> ExplainedMovements:
    """Return movements that are faulty with some probability.

    Args:
        response: The runs.
        likelihood: The same at theta.
        fault_model: The fault.
        theta: Beside the theta of the response, (run, theta).
        active: Probability that each movement is faulty, by cell of what is unknown,
            (run, movement, cell).
        by_node: Log density of each settled position at each node, (run, movement, node).
    """
    motor, nu = response.motors[fault_model.motor], response.model.settling.tail_dof
    profile = likelihood.profile(fault_model.motor)
    if fault_model.redrawn is not None:
        log_share = by_node[:, :, None] + fault_model.redrawn
        angle, variance = _redrawn_angle(fault_model, log_share, active, profile.mode.shape)
        slope = np.zeros_like(angle)
    else:
        angle, variance, slope = _common_angle(fault_model, active, profile.mode.shape)
    precision = np.maximum(profile.precision, LEAST_PRECISION)
    loose = 1.0 / profile.inflation(fault_model.held)
    terms = profile.log_terms(angle, fault_model.held)
    weight = share_of(terms, profile.outlier, profile.usable)
    weight = weight * np.clip(active.sum(axis=-1), 0.0, 1.0)[..., None]
    counted = CountedOutcomes.of(weight)
    seen, shares = counted.seen(motor.seen), counted(weight)
    precision, loose, along = counted(precision), counted(loose), counted(motor.lever)
    beyond = counted(profile.turned(angle - profile.mode))
    off, doubt = seen.off(theta[counted.run]), counted(variance)
    square = np.einsum("ck,ck->c", off, off) + loose * precision * beyond**2
    if fault_model.redrawn is None:
        mean = mean_pull(nu, seen.dims) * shares * loose
        left = _left_along(counted, along, mean, precision, counted(slope))
        told = left * np.sqrt(loose * precision)[:, None]
    else:
        known = np.clip(1.0 - loose * precision * doubt, 0.0, 1.0)
        left = along * (known / precision)[:, None]
        told = along * np.sqrt(loose * known / precision)[:, None]
    lever = seen.levers[..., fault_model.motor] * np.sqrt(loose)[:, None]
    pull = (loose * beyond)[:, None] * along
    own = OwnAngle(fault_model.motor, lever, beyond, doubt, precision, left, pull, told)
    return ExplainedMovements(weight, counted, seen, off, square, own)


def _left_along(
    counted: CountedOutcomes,
    lever: FloatArray,
    weight: FloatArray,
    precision: FloatArray,
    gain: FloatArray,
) -> FloatArray:
    """Return by how much a motor's angles are off for each theta, where one amount is common.

    With c = lambda^T Gamma and slopes s of the angle by the amount,

        left = c / P - s (sum w s c) / sum w P s^2

    Args:
        counted: The outcomes that count.
        lever: c, (counted, theta).
        weight: w, (counted,).
        precision: P, (counted,) [1/rad2].
        gain: s, (counted,).

    Returns:
        (counted, theta).
    """
    common = counted.total((weight * gain)[:, None] * lever)
    total = counted.total(weight * precision * gain**2)
    shift = common / np.maximum(total, 1e-12)[:, None]
    return np.asarray(lever / precision[:, None] - gain[:, None] * shift[counted.run])


def _common_angle(
    fault_model: FaultModel, active: FloatArray, shape: tuple[int, ...]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return mean and variance of each angle and its slope by what is common, (..., outcome).

    The slope is that of the regression of the angle on the size over the nodes.

    Args:
        fault_model: The fault.
        active: Probability that each movement is faulty with each node, (run, movement, node).
        shape: Runs, movements and outcomes.
    """
    total = active.sum(axis=-1, keepdims=True)
    even = np.full_like(active, 1.0 / active.shape[-1])
    share = np.where(total > 1e-9, active / np.maximum(total, 1e-9), even)
    size = np.broadcast_to(fault_model.size, (len(active), active.shape[-1]))
    angle = np.broadcast_to(fault_model.angle, (*shape[:2], active.shape[-1], shape[2]))
    mean = np.einsum("rmn,rmna->rma", share, angle)
    spread = np.einsum("rmn,rmna->rma", share, (angle - mean[:, :, None]) ** 2)
    if fault_model.held:
        return mean, spread, np.ones_like(mean)
    centre = np.einsum("rmn,rn->rm", share, size)
    away = size[:, None] - centre[..., None]
    covariance = np.einsum("rmn,rmna->rma", share * away, angle)
    variance = np.maximum(np.einsum("rmn,rmn->rm", share, away**2), 1e-18)
    return mean, spread, covariance / variance[..., None]


def _redrawn_angle(
    fault_model: FaultModel, joint: FloatArray, active: FloatArray, shape: tuple[int, ...]
) -> tuple[FloatArray, FloatArray]:
    """Return mean and variance of an angle that each movement draws anew, (..., outcome).

    Args:
        fault_model: The fault.
        joint: Log weight times density of each settled position at each node of each group,
            (run, movement, group, node).
        active: Probability that each movement is faulty with each group, (run, movement, group).
        shape: Runs, movements and outcomes.
    """
    share = np.exp(joint - log_sum(joint, axis=-1)[..., None])
    share = np.einsum("rmg,rmgn->rmn", active + 1e-12, share)
    share /= share.sum(axis=-1, keepdims=True)
    angle = np.broadcast_to(fault_model.angle, (*shape[:2], share.shape[-1], shape[2]))
    mean = np.einsum("rmn,rmna->rma", share, angle)
    return mean, np.einsum("rmn,rmna->rma", share, (angle - mean[:, :, None]) ** 2)


def pull_of(square: FloatArray, nu: float, dims: int) -> FloatArray:
    """Return u, the weight that a Student t gives a deviation of squared distance D^2."""
    return np.ones_like(square) if np.isinf(nu) else (nu + dims) / (nu + square)


def mean_pull(nu: float, dims: int) -> float:
    """Return what the information of a Student t is of that of a normal with its scale."""
    return 1.0 if np.isinf(nu) else (nu + dims) / (nu + dims + 2.0)
