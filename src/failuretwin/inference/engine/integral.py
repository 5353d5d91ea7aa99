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

from failuretwin.core.compiled import compiled, inlined
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


@inlined
def _inverse_of_three(
    a: float, b: float, c: float, d: float, e: float, f: float
) -> tuple[float, float, float, float, float, float, float]:
    """Return the inverse of [[a, b, d], [b, c, e], [d, e, f]] in this order, and its determinant.

    The inverse is the adjugate over the determinant.
    """
    first, second, third = c * f - e * e, d * e - b * f, b * e - c * d
    determinant = a * first + b * second + d * third
    factor = 1.0 / determinant
    fourth, fifth, sixth = a * f - d * d, b * d - a * e, a * c - b * b
    return (
        first * factor,
        second * factor,
        fourth * factor,
        third * factor,
        fifth * factor,
        sixth * factor,
        determinant,
    )


@compiled
def invert(matrix: FloatArray) -> float:
    """Replace a positive definite matrix by its inverse; return its determinant.

    Of three channels by its adjugate, of others one sweep a channel k: with b = A_kk,
    A_ij <- A_ij - A_ik A_jk / b,    A_ik <- A_ik / b,    A_kk <- -1 / b    make -A^-1 of A.
    """
    size, determinant = len(matrix), 1.0
    if size == 3:
        a, b, c, d, e, f, determinant = _inverse_of_three(
            matrix[0, 0], matrix[1, 0], matrix[1, 1], matrix[2, 0], matrix[2, 1], matrix[2, 2]
        )
        matrix[0, 0], matrix[1, 1], matrix[2, 2] = a, c, f
        matrix[0, 1] = matrix[1, 0] = b
        matrix[0, 2] = matrix[2, 0] = d
        matrix[1, 2] = matrix[2, 1] = e
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


Room = tuple[FloatArray, FloatArray]
"""Room for a matrix and a vector of channels."""


@inlined
def _whitened(
    three: bool,
    residual: FloatArray,
    scale: FloatArray,
    mean: FloatArray,
    covariance: FloatArray,
    a: int,
    share: float,
    precision: FloatArray,
    pull: FloatArray,
) -> tuple[float, float]:
    """Write C^-1, its lower half at least, and C^-1 (r_a - m) of C = K + share S_a.

    Whole arrays are passed, each by itself: to take one out of a tuple or a row out of an array
    costs more than the sums.

    Returns:
        Squared distance of the outcome, and the determinant of C.
    """
    if three:
        return _whitened_of_three(residual, scale, mean, covariance, a, share, precision, pull)
    size, square = len(pull), 0.0
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


@inlined
def _whitened_of_three(
    residual: FloatArray,
    S: FloatArray,
    mean: FloatArray,
    K: FloatArray,
    a: int,
    share: float,
    precision: FloatArray,
    pull: FloatArray,
) -> tuple[float, float]:
    """Do the same of three channels, the most frequent number, without loops."""
    x, y, z = residual[a, 0] - mean[0], residual[a, 1] - mean[1], residual[a, 2] - mean[2]
    xx, yx, yy, zx, zy, zz, determinant = _inverse_of_three(
        K[0, 0] + S[a, 0, 0] * share,
        K[1, 0] + S[a, 1, 0] * share,
        K[1, 1] + S[a, 1, 1] * share,
        K[2, 0] + S[a, 2, 0] * share,
        K[2, 1] + S[a, 2, 1] * share,
        K[2, 2] + S[a, 2, 2] * share,
    )
    precision[0, 0], precision[1, 0], precision[1, 1] = xx, yx, yy
    precision[2, 0], precision[2, 1], precision[2, 2] = zx, zy, zz
    pull[0] = xx * x + yx * y + zx * z
    pull[1] = yx * x + yy * y + zy * z
    pull[2] = zx * x + zy * y + zz * z
    return pull[0] * x + pull[1] * y + pull[2] * z, determinant


@inlined
def _write_glance(
    three: bool, moment: Moment, noise: Noise, room: Room, glance: FloatArray
) -> float:
    """Write log weight and density of each outcome, what is left of f as scatter.

    Returns:
        The largest.
    """
    largest, (residual, scale, log_weight, mean, covariance) = -np.inf, moment
    precision, pull = room
    for a in range(len(glance)):
        glance[a] = -np.inf
        if log_weight[a] > -np.inf:
            square, determinant = _whitened(
                three, residual, scale, mean, covariance, a, 1.0, precision, pull
            )
            said = log_weight[a] + log_density(noise, square, determinant)
            if not np.isnan(said):  # else no double holds the scale beside what is known
                glance[a] = said
        largest = max(largest, glance[a])
    return largest


@inlined
def _add_outcomes(
    three: bool,
    moment: Moment,
    noise: Noise,
    room: Room,
    top: float,
    share: FloatArray,
    alpha: FloatArray,
    curvature: FloatArray,
) -> tuple[float, float]:
    """Add what the normal distributions of outcomes say of f, times their height.

    Args:
        three: Whether there are three channels.
        moment: The outcomes.
        noise: The Student t.
        room: Room.
        top: Log of the height that counts as 1.
        share: Log of each outcome at a glance; becomes its height, weight times integral, if it is
            integrated in full, else minus its height at a glance.
        alpha: Sum of height C^-1 (r - m), (channel,).
        curvature: Sum of height (C^-1 - C^-1 (r - m)(r - m)^T C^-1), its lower half.

    Returns:
        Heights of the outcomes that are integrated in full, and what they were at a glance.
    """
    size, (residual, scale, log_weight, mean, covariance) = len(alpha), moment
    (precision, pull), factors, log_omega = room, noise.factors, noise.log_omega
    constant, surplus = -top - 0.5 * noise.dims * np.log(2.0 * np.pi), 0.5 * (size - noise.dims)
    least = min(top - KEPT_NATS, share.max())
    exact, rough = 0.0, 0.0
    for a in range(len(share)):
        glance = np.exp(share[a] - top)
        if not share[a] >= least or share[a] == -np.inf:
            share[a] = -glance
            continue
        rough, total = rough + glance, 0.0
        for q in range(len(factors)):
            square, determinant = _whitened(
                three, residual, scale, mean, covariance, a, 1.0 / factors[q], precision, pull
            )
            log_height = constant + log_omega[q] + log_weight[a] - 0.5 * square
            if surplus != 0.0:
                log_height -= surplus * np.log(factors[q])
            height = np.exp(log_height) / np.sqrt(determinant)
            total += height
            for i in range(size):
                alpha[i] += height * pull[i]
                for j in range(i + 1):
                    curvature[i, j] += height * (precision[i, j] - pull[i] * pull[j])
        share[a] = total
        exact += total
    return exact, rough


@inlined
def _finish(alpha: FloatArray, curvature: FloatArray, counted: float) -> None:
    """Make alpha and B of sums of heights, of which each counts so much."""
    for i in range(len(alpha)):
        alpha[i] *= counted
        for j in range(i + 1):
            curvature[i, j] = curvature[i, j] * counted + alpha[i] * alpha[j]
            curvature[j, i] = curvature[i, j]


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
    if len(alpha) == 3:
        return _integral(True, moment, noise, share, alpha, curvature)
    return _integral(False, moment, noise, share, alpha, curvature)


@inlined
def _integral(
    three: bool,
    moment: Moment,
    noise: Noise,
    share: FloatArray,
    alpha: FloatArray,
    curvature: FloatArray,
) -> float:
    """Do what `moment_integral` does; whether there are three channels is told as a constant."""
    count, size = len(share), len(alpha)
    room = np.empty((size, size)), np.empty(size)
    top = max(_write_glance(three, moment, noise, room, share), noise.log_outlier)
    alpha[:], curvature[:] = 0.0, 0.0
    exact, rough = _add_outcomes(three, moment, noise, room, top, share, alpha, curvature)
    # What is left of f counts as scatter at the glance: wrong by as much for the others.
    ratio, left = exact / rough if rough > 0.0 and exact > 0.0 else 1.0, 0.0
    for a in range(count):
        if share[a] < 0.0:
            share[a] *= -ratio
            left += share[a]
    whole = exact + left + np.exp(noise.log_outlier - top)
    for a in range(count):
        share[a] /= whole
    # Those that are left pull as these do.
    _finish(alpha, curvature, (1.0 + left / max(exact, 1e-300)) / whole)
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
