"""What movements say of how far motors scatter and of which commands were lost.

Score and information of the logarithms of each motor's scatter, and of the degrees of freedom that
they have in common.

Section: docs/inference.md#shared-unknowns
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import digamma, polygamma

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.types import FloatArray
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.theta.counted_outcomes import CountedOutcomes
from failuretwin.inference.theta.explained_movements import (
    ExplainedMovements,
    OwnAngle,
    explained,
    mean_pull,
    pull_of,
)
from failuretwin.inference.theta.linear_response import LinearResponse, Whitened


@dataclass(frozen=True)
class ScatterTold:
    """What some runs say of scatter and lost commands under one hypothesis, at one theta.

    Attributes:
        score: Derivative of the log likelihood by the logarithms of the scatter of each motor and
            of its degrees of freedom, (run, motor + 1); a faulty motor says nothing of its own.
        information: Expected information about these, (run, motor + 1, motor + 1).
        slack: What a covariance C of theta adds to the score of scatters, tr(slack C),
            (run, motor, theta, theta): theta was fitted to the same movements.
        outcomes: Expected share of each outcome of each movement, (run, movement, outcome).
    """

    score: FloatArray
    information: FloatArray
    slack: FloatArray
    outcomes: FloatArray

    def __add__(self, other: ScatterTold) -> ScatterTold:
        return ScatterTold(
            self.score + other.score,
            self.information + other.information,
            self.slack + other.slack,
            self.outcomes + other.outcomes,
        )


def told_of_scatter(
    response: LinearResponse, hypothesis: Hypothesis, priors: Priors, theta: FloatArray
) -> ScatterTold:
    """Return what settled positions say of scatter and lost commands under a hypothesis.

    Args:
        response: The runs.
        hypothesis: What may be the case; one that `has_score`.
        priors: Beliefs about onset and size.
        theta: Beside the theta of the response, (run, theta).
    """
    runs = explained(response, hypothesis, priors, theta)
    scatter, nu = response.model.scatter, response.model.settling.tail_dof
    first, *rest = (_told(some, scatter, nu) for some in runs.movements)
    return sum(rest, first)


def _told(movements: ExplainedMovements, scatter: FloatArray, nu: float) -> ScatterTold:
    """Return what movements say of the logarithms of each motor's scatter, and of nu.

    With a = s^2 lambda^T lambda, p = 3 axes, u as of `pull_of`, residuals of mean rho and
    covariance d d^T, D^2 their mean square, and G = S (Lambda^T Lambda - Lambda^T d d^T Lambda) S,

        score = sum w (u s^2 ((lambda^T rho)^2 + (lambda^T d)^2) - a)
        information = sum w 2 ((nu + p) G_kl^2 - G_kk G_ll) / (nu + p + 2)
        score of log nu = sum w nu/2 (psi((nu + p)/2) - psi(nu/2) - p/nu - log(1 + D^2/nu)
                          + u D^2/nu)
        information = sum w (nu^2/4 (psi'(nu/2) - psi'((nu + p)/2))
                      - p (nu + p + 4) nu / (2 (nu + p) (nu + p + 2)))
        information of log s_k and log nu = -sum w 2 nu G_kk / ((nu + p) (nu + p + 2))

    (Lange, Little and Taylor, JASA 84 (1989) 881, for a multivariate t with d = 0). The last row
    and column are those of nu; with nu infinite they are 0. Slack is that of the scatter alone.

    Args:
        movements: The movements.
        scatter: Scale of each motor's scatter, (motor,) [rad].
        nu: Degrees of freedom of the scatter.
    """
    counted, weight, seen = movements.counted, movements.share, movements.seen
    off, unknown, own_angle = movements.off, np.zeros_like(movements.off), movements.own
    if own_angle is not None:
        scatter = np.where(np.arange(len(scatter)) == own_angle.motor, 0.0, scatter)
        off = off - own_angle.lever * own_angle.beyond[:, None]
        unknown = own_angle.lever * np.sqrt(own_angle.doubt)[:, None]
        seen = _with_own(seen, own_angle)
    motors, dims = len(scatter), seen.dims
    square = movements.square + np.einsum("ck,ck->c", unknown, unknown)
    u = pull_of(square, nu, dims)
    levers = seen.levers * scatter
    transposed = np.swapaxes(levers, -1, -2)
    moved = np.matmul(transposed, off[..., None])[..., 0]
    doubt = np.matmul(transposed, unknown[..., None])[..., 0]
    gram = np.matmul(transposed, levers)
    own = np.diagonal(gram, axis1=-2, axis2=-1)
    score = (u[:, None] * (moved**2 + doubt**2) - own) * weight[:, None]
    doubt = doubt / np.maximum(np.linalg.norm(unknown, axis=-1, keepdims=True), 1.0)
    gram = gram - doubt[..., :, None] * doubt[..., None, :]
    own = np.diagonal(gram, axis1=-2, axis2=-1)
    inert = 0.0 if np.isinf(nu) else 2.0 / (nu + dims + 2.0)
    told = 2.0 * mean_pull(nu, dims) * gram**2 - inert * own[:, :, None] * own[:, None]
    information = np.zeros((counted.runs, motors + 1, motors + 1))
    information[:, :motors, :motors] = counted.total(told * weight[:, None, None])
    along = np.matmul(transposed, seen.gamma) * np.sqrt(u * weight)[:, None, None]
    tail = np.zeros_like(square)
    if np.isfinite(nu):
        tail, each = _tail_score(square, nu, dims)
        crossed = -2.0 * nu / ((nu + dims) * (nu + dims + 2.0)) * own
        information[:, motors, motors] = counted.total(each * weight)
        information[:, :motors, motors] = counted.total(crossed * weight[:, None])
        information[:, motors, :motors] = information[:, :motors, motors]
    whole = counted.total(np.concatenate([score, (tail * weight)[:, None]], axis=1))
    return ScatterTold(whole, information, _slack(counted, along), movements.weight)


def _slack(counted: CountedOutcomes, along: FloatArray) -> FloatArray:
    """Return the sum of outer products of (counted, motor, theta), (run, motor, theta, theta)."""
    return counted.total(along[..., :, None] * along[..., None, :])


def _tail_score(square: FloatArray, nu: float, dims: int) -> tuple[FloatArray, float]:
    """Return the score of log nu of each D^2, same shape, and the information of one."""
    whole, half = nu + dims, 0.5 * nu
    middle = digamma(0.5 * whole) - digamma(half) - dims / nu
    slope = middle - np.log1p(square / nu) + whole * square / (nu * (nu + square))
    each = half**2 * (polygamma(1, half) - polygamma(1, 0.5 * whole))
    return half * slope, float(each - dims * (whole + 4.0) * nu / (2.0 * whole * (whole + 2.0)))


def _with_own(seen: Whitened, own: OwnAngle) -> Whitened:
    """Return columns and levers with what a motor itself makes up for, its own scatter counted."""
    lever = seen.levers[..., own.motor]
    along = np.matmul(lever[..., None, :], seen.levers) / own.precision[..., None, None]
    levers = seen.levers - (lever - own.lever)[..., None] * along
    gamma = seen.gamma + own.lever[..., None] * own.left[..., None, :]
    return replace(seen, levers=levers, gamma=gamma)
