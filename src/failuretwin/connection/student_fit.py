"""The most probable unknowns of a model whose residuals scatter as a Student t.

    log p(x | rows) = sum_i log t_4(r_i(x); sigma^2 I) - 1/2 |x|^2

in units of what was believed before. A row that is far off, such as a pose that lost a command,
counts for little; sigma is fitted too. The covariance is that of an M-estimator: with the weight
w = (4 + n) / (4 + d) of a row in n dimensions at the squared distance d = |r|^2 / sigma^2,

    A = mean w (1 - 2 d / (n (4 + d))),   B = mean w^2 |r|^2 / n,   C = (J^T J A^2 / B + I)^-1

Section: docs/inference.md#calibration-and-geometry
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.special import gammaincinv

from failuretwin.core.numerics import log_student
from failuretwin.core.types import FloatArray, as_floats

DOF = 4.0
"""Degrees of freedom of the scatter, as of healthy readings."""
LEAST_SIGMA = 1e-6
"""Scatter below that of any sensor: exact readings, as of a twin."""
SIGMA_ROUNDS = 6
"""Rounds in which scatter and unknowns settle together; each starts where the last one ended."""
SETTLED = 0.02
"""Relative change of the scatter that ends them."""

STEP = 1e-4
"""Step of differences where the slopes of residuals have no closed form."""
LEAST_SQUARE = 1e-8
"""Squared distance below which a row weighs as one that fits exactly."""

Residual = Callable[[FloatArray], FloatArray]
"""Residuals (row, n) by the unknowns (unknown,) in units of what was believed before; or their
slopes (row, n, unknown)."""


@dataclass(frozen=True)
class StudentFit:
    """Unknowns fitted to rows.

    Attributes:
        value: The most probable unknowns, in units of what was believed before, (unknown,).
        covariance: Of the same, (unknown, unknown).
        sigma: Scatter of rows on each axis, robustly.
        noise: Standard deviation that stands for what rows scatter; see the module.
        log_likelihood: Of the rows at the mode, for comparing starts.
    """

    value: FloatArray
    covariance: FloatArray
    sigma: float
    noise: float
    log_likelihood: float


def fit_student(
    residual: Residual, begin: FloatArray, dims: int, slopes: Residual | None = None
) -> StudentFit:
    """Return the unknowns fitted to rows.

    Args:
        residual: Residuals of the rows.
        begin: Unknowns to begin with, (unknown,).
        dims: n, the dimensions in which residuals can differ; channels may be more.
        slopes: Derivatives of the residuals; None: by differences.
    """
    slopes = slopes or _differences(residual)
    x, sigma = begin, _sigma(residual(begin), np.inf, dims)
    for _ in range(SIGMA_ROUNDS):
        x = _mode(residual, slopes, x, sigma, dims)
        before, sigma = sigma, _sigma(residual(x), sigma, dims)
        if abs(sigma - before) < SETTLED * sigma:
            break
    r, J = residual(x), slopes(x).reshape(-1, len(x))
    freedom = float(dims * len(r))
    size = np.linalg.svd(J / sigma, compute_uv=False) ** 2
    lost = min(float(np.sum(size / (1.0 + size))), 0.9 * freedom)  # told by rows, not by the prior
    noise = _effective(r, sigma, dims) * float(np.sqrt(freedom / (freedom - lost)))
    covariance = as_floats(np.linalg.inv(J.T @ J / noise**2 + np.eye(len(x))))
    density = log_student(r, np.zeros((*r.shape, 1)), sigma**2, DOF)
    return StudentFit(x, covariance, sigma, noise, float(density.sum()))


def _differences(residual: Residual) -> Residual:
    """Return the slopes of residuals by central differences."""

    def slopes(x: FloatArray) -> FloatArray:
        steps = STEP * np.eye(len(x))
        each = [(residual(x + step) - residual(x - step)) / (2.0 * STEP) for step in steps]
        return np.stack(each, axis=-1)

    return slopes


def _mode(
    residual: Residual, slopes: Residual, x: FloatArray, sigma: float, dims: int
) -> FloatArray:
    """Return the mode: the log density of a row as a square, with the prior beside it.

    A row r at the squared distance d stands as f r, with f^2 = (4 + n) log(1 + d / 4) / |r|^2.
    """

    def shrunk(r: FloatArray) -> tuple[FloatArray, FloatArray]:
        square = np.maximum(np.einsum("ia,ia->i", r, r) / sigma**2, LEAST_SQUARE)
        return square, np.sqrt((DOF + dims) * np.log1p(square / DOF) / square) / sigma

    def terms(x: FloatArray) -> FloatArray:
        r = residual(x)
        return np.concatenate([(r * shrunk(r)[1][:, None]).ravel(), x])

    def jacobian(x: FloatArray) -> FloatArray:
        r, J = residual(x), slopes(x)
        square, factor = shrunk(r)
        change = 1.0 / ((DOF + square) * np.log1p(square / DOF)) - 1.0 / square  # of log f^2
        along = np.einsum("ia,iau->iu", r, J) * (change / sigma**2)[:, None]
        whole = factor[:, None, None] * (J + r[..., None] * along[:, None])
        return np.concatenate([whole.reshape(-1, len(x)), np.eye(len(x))])

    most = 40 * (len(x) + 1)
    return np.asarray(least_squares(terms, x, jacobian, method="lm", max_nfev=most).x)


def _sigma(r: FloatArray, sigma: float, dims: int) -> float:
    """Return the scatter at which its likelihood is greatest, from that before."""
    square = np.einsum("ia,ia->i", r, r)
    if np.isinf(sigma):
        sigma = float(np.sqrt(np.median(square) / (2.0 * gammaincinv(0.5 * dims, 0.5))))
    for _ in range(30):
        sigma = max(sigma, LEAST_SIGMA)
        weight = (DOF + dims) / (DOF + square / sigma**2)
        sigma = float(np.sqrt(np.mean(weight * square) / dims))
    return max(sigma, LEAST_SIGMA)


def _effective(r: FloatArray, sigma: float, dims: int) -> float:
    """Return B^1/2 / A."""
    square = np.einsum("ia,ia->i", r, r)
    d = square / sigma**2
    weight = (DOF + dims) / (DOF + d)
    slope = float(np.mean(weight * (1.0 - 2.0 * d / (dims * (DOF + d)))))
    middle = float(np.sqrt(np.mean(weight**2 * square) / dims))
    return max(middle / slope, LEAST_SIGMA)
