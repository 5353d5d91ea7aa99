"""What movements say of how far motors scatter: score and information of logarithms.

Of the scale of each motor's scatter, and of the degrees of freedom that they have in common.

Section: docs/shared_unknowns.md
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import digamma, polygamma

from failuretwin.core.types import FloatArray
from failuretwin.inference.counted_outcomes import CountedOutcomes
from failuretwin.inference.linear_response import Whitened


def scatter_sums(
    counted: CountedOutcomes,
    seen: Whitened,
    off: FloatArray,
    unknown: FloatArray,
    square: FloatArray,
    weight: FloatArray,
    scatter: FloatArray,
    nu: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return score, information and slack of the logarithms of each motor's scatter, and of nu.

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
        counted: The outcomes that count.
        seen: Their columns and levers.
        off: rho, (counted, 3).
        unknown: d, same shape: what is not known of them.
        square: |rho|^2, (counted,).
        weight: How much each counts, (counted,).
        scatter: Scale of each motor's scatter, (motor,) [rad]; 0: it tells nothing.
        nu: Degrees of freedom of the scatter.
    """
    motors, dims = len(scatter), seen.dims
    square = square + np.einsum("ck,ck->c", unknown, unknown)
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
    slack = counted.total(along[..., :, None] * along[..., None, :])
    tail = np.zeros_like(square)
    if np.isfinite(nu):
        tail, each = _tail_score(square, nu, dims)
        crossed = -2.0 * nu / ((nu + dims) * (nu + dims + 2.0)) * own
        information[:, motors, motors] = counted.total(each * weight)
        information[:, :motors, motors] = counted.total(crossed * weight[:, None])
        information[:, motors, :motors] = information[:, :motors, motors]
    whole = np.concatenate([score, (tail * weight)[:, None]], axis=1)
    return counted.total(whole), information, slack


def _tail_score(square: FloatArray, nu: float, dims: int) -> tuple[FloatArray, float]:
    """Return the score of log nu of each D^2, same shape, and the information of one."""
    whole, half = nu + dims, 0.5 * nu
    middle = digamma(0.5 * whole) - digamma(half) - dims / nu
    slope = middle - np.log1p(square / nu) + whole * square / (nu * (nu + square))
    each = half**2 * (polygamma(1, half) - polygamma(1, 0.5 * whole))
    return half * slope, float(each - dims * (whole + 4.0) * nu / (2.0 * whole * (whole + 2.0)))


def with_own(
    seen: Whitened, motor: int, own: FloatArray, precision: FloatArray, left: FloatArray
) -> Whitened:
    """Return columns and levers with what a motor itself makes up for, its own scatter counted.

    Args:
        seen: The same without.
        motor: The motor.
        own: Its lever in units of all scatter, (..., channel).
        precision: P, (...) [1/rad2].
        left: By how much its angle is off for each theta, (..., theta).
    """
    lever = seen.levers[..., motor]
    along = np.matmul(lever[..., None, :], seen.levers) / precision[..., None, None]
    levers = seen.levers - (lever - own)[..., None] * along
    return replace(seen, levers=levers, gamma=seen.gamma + own[..., None] * left[..., None, :])


def pull_of(square: FloatArray, nu: float, dims: int) -> FloatArray:
    """Return u, the weight that a Student t gives a deviation of squared distance D^2."""
    return np.ones_like(square) if np.isinf(nu) else (nu + dims) / (nu + square)


def mean_pull(nu: float, dims: int) -> float:
    """Return what the information of a Student t is of that of a normal with its scale."""
    return 1.0 if np.isinf(nu) else (nu + dims) / (nu + dims + 2.0)
