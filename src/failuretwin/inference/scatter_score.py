"""What movements say of how far motors scatter: score and information of logarithms.

Of the scale of each motor's scatter, and of the degrees of freedom that they have in common.

Section: docs/shared_unknowns.md
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import digamma, polygamma

from failuretwin.core.types import FloatArray
from failuretwin.inference.linear_response import Whitened


def scatter_sums(
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
        seen: Columns and levers.
        off: rho, (..., 3).
        unknown: d, same shape: what is not known of them.
        square: |rho|^2, (...).
        weight: How much each counts, (...).
        scatter: Scale of each motor's scatter, (motor,) [rad]; 0: it tells nothing.
        nu: Degrees of freedom of the scatter.
    """
    runs, size, motors = len(off), seen.gamma.shape[-1], len(scatter)
    square = square + np.einsum("...k,...k->...", unknown, unknown)
    u = pull_of(square, nu, seen.dims)
    weighted = weight[..., None]
    levers = seen.levers * scatter
    transposed = np.swapaxes(levers, -1, -2)
    moved = np.matmul(transposed, off[..., None])[..., 0]
    doubt = np.matmul(transposed, unknown[..., None])[..., 0]
    gram = np.matmul(transposed, levers)
    own = np.diagonal(gram, axis1=-2, axis2=-1)
    lead = tuple(range(1, weight.ndim))
    score = ((u[..., None] * (moved**2 + doubt**2) - own) * weighted).sum(lead)
    doubt = doubt / np.maximum(np.linalg.norm(unknown, axis=-1, keepdims=True), 1.0)
    gram = gram - doubt[..., :, None] * doubt[..., None, :]
    own = np.diagonal(gram, axis1=-2, axis2=-1)
    flat = np.reshape(own * np.sqrt(weighted), (runs, -1, motors))
    inert = 0.0 if np.isinf(nu) else 2.0 / (nu + seen.dims + 2.0)
    information = 2.0 * mean_pull(nu, seen.dims) * (gram**2 * weighted[..., None]).sum(lead)
    information -= inert * np.matmul(np.swapaxes(flat, 1, 2), flat)
    along = np.matmul(transposed, seen.gamma) * np.sqrt(u * weight)[..., None, None]
    along = np.moveaxis(np.reshape(along, (runs, -1, motors, size)), 2, 1)
    slack = np.matmul(np.swapaxes(along, -1, -2), along)
    whole = np.zeros((runs, motors + 1, motors + 1))
    whole[:, :motors, :motors] = information
    if np.isinf(nu):
        return np.pad(score, ((0, 0), (0, 1))), whole, slack
    tail, told, crossed = _tail_sums(square, weight, (own * weighted).sum(lead), nu, seen.dims)
    whole[:, motors, motors], whole[:, :motors, motors] = told, crossed
    whole[:, motors, :motors] = crossed
    return np.concatenate([score, tail[:, None]], axis=1), whole, slack


def _tail_sums(
    square: FloatArray, weight: FloatArray, own: FloatArray, nu: float, dims: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return score and information of log nu, (run,), and that with each scatter, (run, motor).

    Args:
        square: D^2, (run, ...).
        weight: How much each counts, same shape.
        own: Sum of w G_kk, (run, motor).
        nu: Degrees of freedom.
        dims: p.
    """
    whole, half = nu + dims, 0.5 * nu
    middle = digamma(0.5 * whole) - digamma(half) - dims / nu
    slope = middle - np.log1p(square / nu) + whole * square / (nu * (nu + square))
    each = half**2 * (polygamma(1, half) - polygamma(1, 0.5 * whole))
    each -= dims * (whole + 4.0) * nu / (2.0 * whole * (whole + 2.0))
    lead = tuple(range(1, weight.ndim))
    score = half * (slope * weight).sum(lead)
    return score, each * weight.sum(lead), -2.0 * nu * own / (whole * (whole + 2.0))


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
