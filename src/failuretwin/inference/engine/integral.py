"""The integral of one moment: what the sensors say at one time.

    Z = integral of N(f; m, K) [ sum over a of w_a t_nu(r_a - f; S_a) + outlier ] df

The Student t is a sum of normal distributions, t_nu(x; S) = sum of omega_q N(x; S / lambda_q) (five
of them, within 0.06 nats as far as outliers reach), so that the integral, the mean and the
covariance of f are sums in closed form. With C_aq = K + S_a / lambda_q and their shares p_aq,

    alpha = sum p_aq C_aq^-1 (r_a - m),    E[f] = m + K alpha
    B = sum p_aq (C_aq^-1 - C_aq^-1 (r_a - m)(r_a - m)^T C_aq^-1) + alpha alpha^T
    Cov[f] = K - K B K

Laplace's method at the mode, with the expected information as curvature, takes an unknown moment
for half a nat more than it says; these moments are exact.

Section: docs/inference.md#integral
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from failuretwin.core.compiled import compiled
from failuretwin.core.numerics import log_fall, log_norm
from failuretwin.core.types import FloatArray

NORMALS = 5
"""Normal distributions that stand for a Student t."""
FURTHEST = 300.0
"""Squared distance up to which they do: further off all is an outlier."""
NEARLY_NORMAL = 200.0
"""Degrees of freedom from which one normal distribution stands for it."""
KEPT_NATS = 5.0
"""Outcomes of a moment that are integrated in full: the best, and those so near to it or to the
outlier; the rest count with their density."""
NEGLIGIBLE = 1e-14
"""Normal distributions with a smaller share pull at nothing."""


@lru_cache
def scale_mixture(dof: float, dims: int) -> tuple[FloatArray, FloatArray]:
    """Return lambda and log omega, (normal,), of the normals that stand for a Student t.

    Args:
        dof: Degrees of freedom nu.
        dims: Dimension d.
    """
    if dof > NEARLY_NORMAL:
        return np.ones(1), np.zeros(1)
    square = np.r_[0.0, np.geomspace(0.1, FURTHEST, 80)]
    exact = log_norm(dof, dims) + log_fall(square, dof, dims)

    def off(x: FloatArray) -> FloatArray:
        log_lambda, log_omega = x[:NORMALS], x[NORMALS:]
        terms = log_omega + 0.5 * dims * (log_lambda - np.log(2.0 * np.pi))
        terms = terms - 0.5 * np.exp(log_lambda) * square[:, None]
        return np.logaddexp.reduce(terms, axis=1) - exact

    low, high = 0.8 * (dof + dims) / (dof + FURTHEST), 1.0 + 2.4 / np.sqrt(dof)
    start = np.geomspace(low, high, NORMALS)
    weight = 0.5 * dof * (np.log(start) - start)
    found = least_squares(off, np.r_[np.log(start), weight - np.logaddexp.reduce(weight)])
    return np.exp(found.x[:NORMALS]), found.x[NORMALS:]


class Noise(NamedTuple):
    """Student t of the residuals.

    Attributes:
        dof: Degrees of freedom nu.
        dims: Dimension d of the density.
        log_outlier: Log density of a tool anywhere, times its rate [log 1/m^d].
        log_norm: Log of the constant of the density.
        factors: lambda of the normal distributions that stand for it, (normal,).
        log_omega: Their log weights, (normal,).
    """

    dof: float
    dims: int
    log_outlier: float
    log_norm: float
    factors: FloatArray
    log_omega: FloatArray

    @classmethod
    def of(cls, dof: float, dims: int, log_outlier: float) -> Noise:
        """Return a Student t of so many degrees of freedom and dimensions."""
        return cls(
            float(dof), dims, float(log_outlier), log_norm(dof, dims), *scale_mixture(dof, dims)
        )


@compiled
def log_density(noise: Noise, square: float, determinant: float) -> float:
    """Return the log density at a squared distance, with the determinant of the scale."""
    if np.isinf(noise.dof):
        fall = -0.5 * square
    else:
        fall = -0.5 * (noise.dof + noise.dims) * np.log1p(square / noise.dof)
    return noise.log_norm - 0.5 * np.log(determinant) + fall


@compiled
def invert(matrix: FloatArray) -> float:
    """Replace a positive definite matrix by its inverse; return its determinant.

    Of three channels by its adjugate, of others one sweep a channel k: with b = A_kk,
    A_ij <- A_ij - A_ik A_jk / b,    A_ik <- A_ik / b,    A_kk <- -1 / b    make -A^-1 of A.
    """
    size, determinant = len(matrix), 1.0
    if size == 3:
        a, b, c = matrix[0, 0], matrix[1, 0], matrix[1, 1]
        d, e, f = matrix[2, 0], matrix[2, 1], matrix[2, 2]
        first, second, third = c * f - e * e, d * e - b * f, b * e - c * d
        determinant = a * first + b * second + d * third
        factor = 1.0 / determinant
        matrix[0, 0], matrix[1, 1] = first * factor, (a * f - d * d) * factor
        matrix[2, 2] = (a * c - b * b) * factor
        matrix[0, 1] = matrix[1, 0] = second * factor
        matrix[0, 2] = matrix[2, 0] = third * factor
        matrix[1, 2] = matrix[2, 1] = (b * d - a * e) * factor
        return determinant
    for k in range(size):
        pivot = matrix[k, k]
        determinant *= pivot
        for i in range(size):
            if i != k:
                scaled = matrix[i, k] / pivot
                for j in range(size):
                    if j != k:
                        matrix[i, j] -= scaled * matrix[k, j]
        for i in range(size):
            matrix[i, k] /= pivot
            matrix[k, i] = matrix[i, k]
        matrix[k, k] = -1.0 / pivot
    for i in range(size):
        for j in range(size):
            matrix[i, j] = -matrix[i, j]
    return determinant


Work = tuple[FloatArray, FloatArray]
"""Room for a matrix and a vector of channels."""


class Moment(NamedTuple):
    """One moment under one row.

    Attributes:
        residual: r_a, (outcome, channel) [m].
        scale: S_a, (outcome, channel, channel) [m2].
        log_weight: log w_a, (outcome,).
        mean: m, (channel,) [m].
        covariance: K, (channel, channel) [m2].
    """

    residual: FloatArray
    scale: FloatArray
    log_weight: FloatArray
    mean: FloatArray
    covariance: FloatArray


@compiled
def _whitened(
    moment: Moment, a: int, factor: float, precision: FloatArray, pull: FloatArray
) -> tuple[float, float]:
    """Write C^-1 and C^-1 (r - m) of C = K + S_a / factor.

    Returns:
        Squared distance of the outcome, and the determinant of C.
    """
    residual, scale, mean, covariance = (
        moment.residual,
        moment.scale,
        moment.mean,
        moment.covariance,
    )
    size, square, share = len(pull), 0.0, 1.0 / factor
    for i in range(size):
        for j in range(size):
            precision[i, j] = covariance[i, j] + scale[a, i, j] * share
    determinant = invert(precision)
    for i in range(size):
        total = 0.0
        for j in range(size):
            total += precision[i, j] * (residual[a, j] - mean[j])
        pull[i] = total
        square += total * (residual[a, i] - mean[i])
    return square, determinant


@compiled
def _write_glance(moment: Moment, noise: Noise, work: Work, glance: FloatArray) -> int:
    """Write log weight and density of each outcome, what is left of f as scatter.

    Returns:
        The likeliest outcome.
    """
    best = 0
    for a in range(len(glance)):
        glance[a] = -np.inf
        if moment.log_weight[a] > -np.inf:
            square, determinant = _whitened(moment, a, 1.0, *work)
            glance[a] = moment.log_weight[a] + log_density(noise, square, determinant)
        if glance[a] > glance[best]:
            best = a
    return best


@compiled
def _write_heights(
    moment: Moment, noise: Noise, work: Work, a: int, top: float, height: FloatArray
) -> float:
    """Write weight times integral of the normal distributions of an outcome, over exp(top).

    Returns:
        Their sum.
    """
    size, total = len(moment.mean), 0.0
    for q in range(len(height)):
        factor = noise.factors[q]
        square, determinant = _whitened(moment, a, factor, *work)
        surplus = 0.5 * (size - noise.dims) * np.log(factor)
        constant = noise.log_omega[q] - surplus - 0.5 * noise.dims * np.log(2.0 * np.pi)
        log_height = constant + moment.log_weight[a] - 0.5 * square - top
        height[q] = np.exp(log_height) / np.sqrt(determinant)
        total += height[q]
    return total


@compiled
def _write_pooled(
    moment: Moment,
    noise: Noise,
    work: Work,
    share: FloatArray,
    alpha: FloatArray,
    curvature: FloatArray,
) -> None:
    """Write alpha and B by the share of each normal distribution, (outcome, normal)."""
    size, (precision, pull) = len(alpha), work
    for a in range(len(share)):
        for q in range(share.shape[1]):
            weight = share[a, q]
            if weight > NEGLIGIBLE:
                _whitened(moment, a, noise.factors[q], precision, pull)
                for i in range(size):
                    alpha[i] += weight * pull[i]
                    for j in range(size):
                        curvature[i, j] += weight * (precision[i, j] - pull[i] * pull[j])
    for i in range(size):
        for j in range(size):
            curvature[i, j] += alpha[i] * alpha[j]


@compiled
def moment_integral(
    moment: Moment, noise: Noise, share: FloatArray, alpha: FloatArray, curvature: FloatArray
) -> float:
    """Return log Z of f ~ N(m, K); write what the moment says.

    Args:
        moment: The outcomes of the moment.
        noise: The Student t of residuals.
        share: Share of each outcome, (outcome,), written; what is missing to 1 is the outlier's.
        alpha: (channel,), written.
        curvature: B, (channel, channel), written.
    """
    count, size, glance = len(share), len(alpha), share
    work = np.empty((size, size)), np.empty(size)
    best = _write_glance(moment, noise, work, glance)
    top = max(glance[best], noise.log_outlier)
    height, exact, rough = np.zeros((count, len(noise.factors))), 0.0, 0.0
    kept = np.zeros(count, dtype=np.bool_)
    for a in range(count):
        kept[a] = glance[a] > top - KEPT_NATS or (a == best and glance[a] > -np.inf)
        if kept[a]:
            rough += np.exp(glance[a] - top)
            share[a] = _write_heights(moment, noise, work, a, top, height[a])
            exact += share[a]
    # What is left of f counts as scatter at the glance: wrong by as much for the others.
    ratio, left = exact / rough if rough > 0.0 and exact > 0.0 else 1.0, 0.0
    for a in range(count):
        if not kept[a]:
            share[a] = np.exp(glance[a] - top) * ratio
            left += share[a]
    whole = exact + left + np.exp(noise.log_outlier - top)
    # Those that are left pull as these do.
    counted = (1.0 + left / max(exact, 1e-300)) / whole
    for a in range(count):
        share[a] /= whole
        for q in range(height.shape[1]):
            height[a, q] *= counted
    alpha[:], curvature[:] = 0.0, 0.0
    _write_pooled(moment, noise, work, height, alpha, curvature)
    return float(top + np.log(whole))


@compiled
def log_total(values: FloatArray) -> float:
    """Return log(sum(exp(values))); -inf where all are."""
    top = -np.inf
    for a in range(len(values)):
        top = max(top, values[a])
    if not np.isfinite(top):
        return float(top)
    total = 0.0
    for a in range(len(values)):
        total += np.exp(values[a] - top)
    return float(top + np.log(total))
