"""The most probable numbers of an arm given settled poses, and how surely poses tell them.

    log p(x | poses) = sum_i log t_4(r_i; sigma^2 I) - 1/2 sum_k (x_k / spread_k)^2
    r_i = seen_i - expected_i(x)

Poses scatter as a Student t in three dimensions, so that one that lost a command counts for little;
sigma is fitted too. The covariance is that of an M-estimator: with the weight w = (4 + 3) / (4 + d)
of a pose at the squared distance d = |r|^2 / sigma^2,

    A = mean w (1 - 2 d / (3 (4 + d))),   B = mean w^2 |r|^2 / 3,   C = (J^T J A^2 / B + I)^-1

in units of what was believed before.

Section: docs/inference.md#calibration-and-geometry
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from failuretwin.connection.registration.arm import Arm, Fitted, Start, Unknowns
from failuretwin.connection.registration.poses import Poses
from failuretwin.core.numerics import log_student
from failuretwin.core.types import FloatArray, as_floats

DOF = 4.0
"""Degrees of freedom of the scatter of poses, as of healthy readings."""
DIMS = 3.0
LEAST_SIGMA_M = 1e-6
"""Scatter below that of any sensor [m]: exact poses, as of a twin."""
SIGMA_ROUNDS = 6
"""Rounds in which scatter and numbers settle together; each starts where the last one ended."""
SETTLED = 0.02
"""Relative change of the scatter that ends them."""


@dataclass(frozen=True)
class Posterior:
    """An arm fitted to poses.

    Attributes:
        fitted: Its most probable numbers.
        covariance: In units of what was believed before, (unknown, unknown).
        sigma: Scatter of poses on each axis, robustly [m].
        noise: Standard deviation that stands for what poses scatter [m]; see the module.
        log_likelihood: Of the poses at the mode, for comparing starts.
    """

    fitted: Fitted
    covariance: FloatArray
    sigma: float
    noise: float
    log_likelihood: float

    @property
    def deviation(self) -> FloatArray:
        """Standard deviation of each number, (unknown,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)) * self.fitted.unknowns.spread)


def fit(
    arm: Arm, start: Start, unknowns: Unknowns, poses: Poses, begin: FloatArray | None = None
) -> Posterior:
    """Return an arm fitted to poses.

    Args:
        arm: The arm.
        start: Senses, zeros and frame to start from.
        unknowns: What is asked.
        poses: Settled poses.
        begin: Numbers to begin at, (unknown,); None: 0.
    """
    spread = unknowns.spread
    torque = arm.torque(poses.target, start)

    def residual(x: FloatArray) -> FloatArray:
        expected = Fitted(arm, start, unknowns, x * spread).expected(poses.target, torque)
        return np.asarray(poses.point - expected)

    x = np.zeros(len(unknowns)) if begin is None else begin / spread
    sigma = _sigma(residual(x), np.inf)
    for _ in range(SIGMA_ROUNDS):
        x = _mode(residual, x, sigma)
        before, sigma = sigma, _sigma(residual(x), sigma)
        if abs(sigma - before) < SETTLED * sigma:
            break
    r = residual(x)
    freedom = DIMS * len(poses)
    lost = min(_told(residual, x, sigma), 0.9 * freedom)
    noise = _effective(r, sigma) * float(np.sqrt(freedom / (freedom - lost)))
    J = _jacobian(residual, x)
    covariance = as_floats(np.linalg.inv(J.T @ J / noise**2 + np.eye(len(x))))
    density = log_student(r, np.zeros((*r.shape, 1)), sigma**2, DOF)
    return Posterior(
        Fitted(arm, start, unknowns, x * spread), covariance, sigma, noise, float(density.sum())
    )


Residual = Callable[[FloatArray], FloatArray]


def _mode(residual: Residual, x: FloatArray, sigma: float) -> FloatArray:
    """Return the mode: the log density of a pose as a square, with the prior beside it."""

    def terms(x: FloatArray) -> FloatArray:
        r = residual(x)
        square = np.maximum(np.einsum("ia,ia->i", r, r) / sigma**2, 1e-30)
        shrunk = np.sqrt((DOF + DIMS) * np.log1p(square / DOF) / square) / sigma
        return np.concatenate([(r * shrunk[:, None]).ravel(), x])

    return np.asarray(least_squares(terms, x, method="lm", max_nfev=40 * (len(x) + 1)).x)


def _sigma(r: FloatArray, sigma: float) -> float:
    """Return the scatter at which its likelihood is greatest, from that before."""
    square = np.einsum("ia,ia->i", r, r)
    if np.isinf(sigma):
        sigma = float(np.sqrt(np.median(square) / 2.4))  # median of chi2_3 is 2.4
    for _ in range(30):
        sigma = max(sigma, LEAST_SIGMA_M)
        weight = (DOF + DIMS) / (DOF + square / sigma**2)
        sigma = float(np.sqrt(np.mean(weight * square) / DIMS))
    return max(sigma, LEAST_SIGMA_M)


def _effective(r: FloatArray, sigma: float) -> float:
    square = np.einsum("ia,ia->i", r, r)
    d = square / sigma**2
    weight = (DOF + DIMS) / (DOF + d)
    slope = float(np.mean(weight * (1.0 - 2.0 * d / (DIMS * (DOF + d)))))
    return max(float(np.sqrt(np.mean(weight**2 * square) / DIMS)) / slope, LEAST_SIGMA_M)


def _told(residual: Residual, x: FloatArray, sigma: float) -> float:
    """Return how many numbers the poses tell rather than the prior: the trace of J^T J C."""
    J = _jacobian(residual, x) / sigma
    size = np.linalg.svd(J, compute_uv=False) ** 2
    return float(np.sum(size / (1.0 + size)))


def _jacobian(residual: Residual, x: FloatArray) -> FloatArray:
    """Return derivatives of the residuals by central differences, (3 pose, unknown)."""
    steps = 1e-4 * np.eye(len(x))
    columns = [(residual(x + step) - residual(x - step)).ravel() / 2e-4 for step in steps]
    return np.stack(columns, axis=1)
