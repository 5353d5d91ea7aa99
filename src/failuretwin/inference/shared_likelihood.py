"""What runs say of a hypothesis, as a function of the shared unknowns near their best values.

    log p(run | h, theta + d) ~ L + b^T d - 1/2 d^T A d

By Fisher's identity the score b is the mean of the complete score over all that is unknown; by
Louis's identity the information A is the complete information less what the unknown angle of the
faulty motor takes away. With weights w of outcomes and states, u = (nu + d)/(nu + D^2),

    b = sum w u Gamma^T rho,    A = sum w (nu + d)/(nu + d + 2) Gamma^T Gamma - missing

A motor with an active fault says nothing of its own offsets. An angle that holds for the run is
common to its movements; an offset that is drawn anew takes away all along its lever.

Section: docs/shared_unknowns.md
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.numerics import log_sum
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.failure_behavior.mode import Signature
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.counted_outcomes import CountedOutcomes
from failuretwin.inference.joint_likelihood import LEAST_PRECISION
from failuretwin.inference.linear_response import LinearResponse, Whitened
from failuretwin.inference.marginal import (
    ChangePointPosterior,
    FaultModel,
    change_points,
    movement_log_likelihoods,
)
from failuretwin.inference.posterior import fault_model_of
from failuretwin.inference.priors import Priors
from failuretwin.inference.run_likelihood import RunLikelihood, share_of
from failuretwin.inference.scatter_score import mean_pull, pull_of, scatter_sums, with_own


@dataclass(frozen=True)
class LocalLikelihood:
    """The log likelihood of some runs near one theta of each.

    Attributes:
        theta: Where it is expanded, (run, theta).
        log_likelihood: L, (run,).
        score: b, (run, theta).
        information: A, (run, theta, theta).
        misfit: Mean D^2 of what is explained, (run,); 3 if all is well.
        scatter_score: Derivative of L by the logarithms of the scatter of each motor and of its
            degrees of freedom, (run, motor + 1); a faulty motor says nothing of its own.
        scatter_information: Expected information about these, (run, motor + 1, motor + 1).
        scatter_slack: What a covariance C of theta adds to the score of scatters, tr(slack C),
            (run, motor, theta, theta): theta was fitted to the same movements.
        outcomes: Expected share of each outcome of each movement, (run, movement, outcome).
    """

    theta: FloatArray
    log_likelihood: FloatArray
    score: FloatArray
    information: FloatArray
    misfit: FloatArray
    scatter_score: FloatArray
    scatter_information: FloatArray
    scatter_slack: FloatArray
    outcomes: FloatArray

    def __getitem__(self, rows: IntArray) -> LocalLikelihood:
        """Return that of some of the runs alone."""
        return LocalLikelihood(*(getattr(self, field.name)[rows] for field in fields(self)))

    def with_rows(self, rows: IntArray, some: LocalLikelihood) -> LocalLikelihood:
        """Return the same with that of some of the runs replaced."""

        def replaced(name: str) -> FloatArray:
            values = np.array(getattr(self, name))
            values[rows] = getattr(some, name)
            return values

        return LocalLikelihood(*(replaced(field.name) for field in fields(self)))


def local_likelihood(
    response: LinearResponse, hypothesis: Hypothesis, priors: Priors, theta: FloatArray
) -> LocalLikelihood:
    """Return what settled positions say of a hypothesis near theta.

    Args:
        response: The runs.
        hypothesis: What may be the case; one that `has_score`.
        priors: Beliefs about onset and size.
        theta: Beside the theta of the response, (run, theta).
    """
    if hypothesis.is_healthy:
        likelihood = response.at(theta, ())
        sums = _healthy_sums(response, likelihood, theta, np.ones(likelihood.usable.shape))
        return sums.local(theta, likelihood.log_healthy.sum(axis=1), likelihood.usable)
    motor = response.model.motor_names.index(hypothesis.faults[0].motor)
    likelihood = response.at(theta, (motor,))
    fault_model = fault_model_of(likelihood, hypothesis.faults[0], priors)
    says = movement_log_likelihoods(likelihood, fault_model)
    joint = change_points(likelihood.log_healthy, says.by_cell, fault_model.log_prior)
    found = ChangePointPosterior.of(joint)
    active = np.cumsum(np.exp(found.log_responsibility), axis=1)  # (run, movement, cell)
    faulty = np.clip(active.sum(axis=-1), 0.0, 1.0)
    sums = _healthy_sums(response, likelihood, theta, 1.0 - faulty)
    sums += _faulty_sums(response, likelihood, fault_model, theta, active, says.by_node)
    return sums.local(theta, found.log_evidence, likelihood.usable)


OUTLYING = 100.0
"""Squared distance that stands for "nowhere near" when the fit of a run is judged."""


@dataclass(frozen=True)
class _Sums:
    """Sums over the movements of each run: b, A, D^2 and scatter; and the weights of outcomes."""

    score: FloatArray
    information: FloatArray
    square: FloatArray
    scatter_score: FloatArray
    scatter_information: FloatArray
    scatter_slack: FloatArray
    weight: FloatArray

    def __add__(self, other: _Sums) -> _Sums:
        both = ((getattr(self, f.name), getattr(other, f.name)) for f in fields(self))
        return _Sums(*(one + two for one, two in both))

    def local(
        self, theta: FloatArray, log_likelihood: FloatArray, usable: BoolArray
    ) -> LocalLikelihood:
        """Return the local likelihood that has these sums."""
        count = np.maximum(usable.sum(axis=1), 1)
        explained = self.weight.sum(axis=(1, 2))
        misfit = (self.square + OUTLYING * (count - explained)) / count
        spread = (self.scatter_score, self.scatter_information, self.scatter_slack)
        return LocalLikelihood(
            theta, log_likelihood, self.score, self.information, misfit, *spread, self.weight
        )


def has_score(hypothesis: Hypothesis) -> bool:
    """Return whether settled positions have a score under it: healthy, or one motor settles off.

    For the rest, which settle as healthy ones or hold two faults or any, the best theta of these
    has to do.
    """
    if not hypothesis.known or len(hypothesis.faults) > 1:
        return False
    signatures = [MODES[fault.mode].signature for fault in hypothesis.faults]
    return not set(signatures) & {Signature.TRANSIENT, Signature.MISSED}


def _healthy_sums(
    response: LinearResponse, likelihood: RunLikelihood, theta: FloatArray, share: FloatArray
) -> _Sums:
    """Return the sums of movements that are healthy with some probability, (run, movement)."""
    model = response.model
    weight = likelihood.outcome_probability * share[..., None]
    counted = CountedOutcomes.of(weight)
    seen = counted.seen(response.healthy)
    off = seen.off(theta[counted.run])
    square, nu = np.einsum("ck,ck->c", off, off), model.settling.tail_dof
    known, shares = np.zeros_like(off), counted(weight)
    spread = scatter_sums(counted, seen, off, known, square, shares, model.scatter, nu)
    told = _theta_sums(counted, seen, off, square, shares, nu)
    return _Sums(*told, counted.total(square * shares), *spread, weight)


def _theta_sums(
    counted: CountedOutcomes,
    seen: Whitened,
    off: FloatArray,
    square: FloatArray,
    weight: FloatArray,
    nu: float,
) -> tuple[FloatArray, FloatArray]:
    """Return score (run, theta) and information (run, theta, theta) of some movements.

    Args:
        counted: The outcomes that count.
        seen: Their residuals and columns.
        off: Residuals at theta, (counted, 3).
        square: D^2, (counted,).
        weight: How much each counts, (counted,).
        nu: Degrees of freedom of the scatter.
    """
    pulled = (pull_of(square, nu, seen.dims) * weight)[:, None] * off
    score = np.matmul(pulled[:, None], seen.gamma)[:, 0]
    scaled = seen.gamma * np.sqrt(mean_pull(nu, seen.dims) * weight)[:, None, None]
    information = np.matmul(np.swapaxes(scaled, -1, -2), scaled)
    return counted.total(score), counted.total(information)


def _faulty_sums(
    response: LinearResponse,
    likelihood: RunLikelihood,
    fault_model: FaultModel,
    theta: FloatArray,
    active: FloatArray,
    by_node: FloatArray,
) -> _Sums:
    """Return the sums of movements that are faulty with some probability.

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
    else:
        angle, variance, slope = _common_angle(fault_model, active, profile.mode.shape)
    precision = np.maximum(profile.precision, LEAST_PRECISION)
    loose = 1.0 / profile.inflation(fault_model.held)
    terms = profile.log_terms(angle, fault_model.held)
    weight = share_of(terms, profile.outlier, profile.usable)
    weight = weight * np.clip(active.sum(axis=-1), 0.0, 1.0)[..., None]
    counted = CountedOutcomes.of(weight)
    seen, shares = counted.seen(motor.seen), counted(weight)
    precision, loose, lever = counted(precision), counted(loose), counted(motor.lever)
    beyond = counted(profile.turned(angle - profile.mode))
    off, doubt = seen.off(theta[counted.run]), counted(variance)
    square = np.einsum("ck,ck->c", off, off) + loose * precision * beyond**2
    others = np.where(
        np.arange(response.layout.motors) == fault_model.motor, 0.0, response.model.scatter
    )
    pull = pull_of(square, nu, seen.dims) * shares * loose
    mean = mean_pull(nu, seen.dims) * shares * loose
    if fault_model.redrawn is None:
        left = _left_along(counted, lever, mean, precision, counted(slope))
        scaled = left * np.sqrt(mean * precision)[:, None]
    else:
        known = np.clip(1.0 - loose * precision * doubt, 0.0, 1.0)
        left = lever * (known / precision)[:, None]
        scaled = lever * np.sqrt(mean * known / precision)[:, None]
    own = seen.levers[..., fault_model.motor] * np.sqrt(loose)[:, None]
    turned = off - own * beyond[:, None]
    unknown = own * np.sqrt(doubt)[:, None]
    whole = with_own(seen, fault_model.motor, own, precision, left)
    spread = scatter_sums(counted, whole, turned, unknown, square, shares, others, nu)
    score, information = _theta_sums(counted, seen, off, square, shares, nu)
    score = score - counted.total((pull * beyond)[:, None] * lever)
    information = information + counted.total(scaled[:, :, None] * scaled[:, None])
    return _Sums(score, information, counted.total(square * shares), *spread, weight)


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


# A normal distribution of theta times a local likelihood: its integral and what is left of it.


@dataclass(frozen=True)
class Normal:
    """Normal distributions of theta, one a run, by precision and precision times mean.

    Attributes:
        precision: (run, theta, theta).
        shift: Precision times mean, (run, theta).
    """

    precision: FloatArray
    shift: FloatArray

    @property
    def mean(self) -> FloatArray:
        """(run, theta)."""
        return np.asarray(np.linalg.solve(self.precision, self.shift[..., None])[..., 0])

    def times(self, says: LocalLikelihood) -> Normal:
        """Return the distribution given what runs say, to second order."""
        turn = np.einsum("rtu,ru->rt", says.information, says.theta)
        return Normal(self.precision + says.information, self.shift + says.score + turn)

    def log_density(self, theta: FloatArray) -> FloatArray:
        """Return the log density, but for the constant of pi, (run,)."""
        away = theta - self.mean
        square = np.einsum("rt,rtu,ru->r", away, self.precision, away)
        return 0.5 * (np.linalg.slogdet(self.precision)[1] - square)


def integrated(prior: Normal, says: LocalLikelihood) -> FloatArray:
    """Return log of the integral of prior times likelihood over theta, by Laplace's method, (run,).

    L + log N(theta; prior) - 1/2 log |P^-1 + A| + 1/2 log |P^-1|, with `says` at the best theta
    """
    posterior = np.linalg.slogdet(prior.precision + says.information)[1]
    return says.log_likelihood + prior.log_density(says.theta) - 0.5 * posterior


NEWTON_STEPS = 2
"""Steps towards the best theta; more change nothing in the mean."""
RISING_NATS, TIMES_MORE = 2.0, 3
"""Runs whose last step has gained more are followed on, so many times as far at most: what is far
off, such as a zero that nobody has measured, is not reached in two steps."""


def search(
    response: LinearResponse,
    hypothesis: Hypothesis,
    priors: Priors,
    prior: Normal,
    start: FloatArray,
    known: LocalLikelihood | None = None,
) -> LocalLikelihood:
    """Return what runs say of a hypothesis near its most probable theta: Newton, halved if worse.

    Args:
        response: The runs.
        hypothesis: What may be the case.
        priors: Beliefs about onset and size.
        prior: Of theta, beside that of the response.
        start: Where to start, (run, theta).
        known: What they say there, where that is known.
    """
    best = known or local_likelihood(response, hypothesis, priors, start)
    best, rising = _stepped(response, hypothesis, priors, prior, best)
    for _ in range(TIMES_MORE):
        rows = np.flatnonzero(rising)
        if len(rows) == 0:
            break
        part = Normal(prior.precision[rows], prior.shift[rows])
        some, rising[rows] = _stepped(response[rows], hypothesis, priors, part, best[rows])
        best = best.with_rows(rows, some)
    return best


def _stepped(
    response: LinearResponse,
    hypothesis: Hypothesis,
    priors: Priors,
    prior: Normal,
    best: LocalLikelihood,
) -> tuple[LocalLikelihood, BoolArray]:
    """Return what runs say some steps on, and which gained much by the last of them, (run,)."""
    height = best.log_likelihood + prior.log_density(best.theta)
    theta, gain = prior.times(best).mean, np.zeros(len(height))
    for step in range(NEWTON_STEPS):
        here = local_likelihood(response, hypothesis, priors, theta)
        high = here.log_likelihood + prior.log_density(theta)
        better, gain = high > height, high - height
        best, height = _where(better, here, best), np.where(better, high, height)
        if step < NEWTON_STEPS - 1:
            newton = prior.times(best).mean
            theta = np.where(better[:, None], newton, 0.5 * (theta + best.theta))
    return best, gain > RISING_NATS


def _where(better: BoolArray, one: LocalLikelihood, other: LocalLikelihood) -> LocalLikelihood:
    """Return one local likelihood for some runs and the other for the rest."""

    def either(name: str) -> FloatArray:
        first, second = getattr(one, name), getattr(other, name)
        return np.where(better.reshape(-1, *(1,) * (first.ndim - 1)), first, second)

    return LocalLikelihood(*(either(field.name) for field in fields(one)))
