"""The integral of one moment: what the sensors say at one time, under many hypotheses at once.

    Z = integral of N(f; m, K) [ sum over a of w_a t_nu(r_a - f; S_a) + outlier ] df

The Student t is a sum of normal distributions, t_nu(x; S) = sum of omega_q N(x; S / lambda_q) (five
of them, within 0.06 nats as far as outliers reach), so that the integral, the mean and the
covariance of f are sums in closed form. With C_aq = K + S_a / lambda_q and their shares p_aq,

    alpha = sum p_aq C_aq^-1 (r_a - m),    E[f] = m + K alpha
    B = sum p_aq (C_aq^-1 - C_aq^-1 (r_a - m)(r_a - m)^T C_aq^-1) + alpha alpha^T
    Cov[f] = K - K B K

Laplace's method at the mode, with the expected information as curvature, takes an unknown moment
for half a nat more than it says; these moments are exact. Arrays have rows of hypotheses first.

Section: docs/inference.md#integral
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy.optimize import least_squares

from failuretwin.core.numerics import log_fall, log_norm, log_sum
from failuretwin.core.types import FloatArray, IntArray, as_floats

NORMALS = 5
"""Normal distributions that stand for a Student t."""
FURTHEST = 300.0
"""Squared distance up to which they do: further off all is an outlier."""
NEARLY_NORMAL = 200.0
"""Degrees of freedom from which one normal distribution stands for it."""
KEPT = 6
"""Outcomes of a moment that are integrated in full; the rest count with their density."""


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


@dataclass(frozen=True)
class Noise:
    """Student t of the residuals.

    Attributes:
        dof: Degrees of freedom nu.
        dims: Dimension d of the density.
        log_outlier: Log density of a tool anywhere, times its rate [log 1/m^d].
    """

    dof: float
    dims: int
    log_outlier: float

    @cached_property
    def log_norm(self) -> float:
        """Log of the constant of the density."""
        return log_norm(self.dof, self.dims)

    def log_density(self, square: FloatArray, log_determinant: FloatArray) -> FloatArray:
        """Return the log density at a squared distance, with the log determinant of the scale."""
        return self.log_norm - 0.5 * log_determinant + log_fall(square, self.dof, self.dims)


@dataclass(frozen=True)
class Mixture:
    """The outcomes of one moment.

    Attributes:
        residual: r_a, (row, outcome, channel) [m].
        scale: S_a, (row, outcome, channel, channel) [m2].
        log_weight: log w_a, (row, outcome).
    """

    residual: FloatArray
    scale: FloatArray
    log_weight: FloatArray

    def __getitem__(self, rows: IntArray) -> Mixture:
        """Return some of the rows."""
        return Mixture(self.residual[rows], self.scale[rows], self.log_weight[rows])


@dataclass(frozen=True)
class MomentPosterior:
    """What one moment says.

    Attributes:
        log_evidence: log Z, (row,).
        alpha: (row, channel).
        curvature: B, (row, channel, channel).
        share: Share of each outcome, (row, outcome); what is missing to 1 is the outlier's.
    """

    log_evidence: FloatArray
    alpha: FloatArray
    curvature: FloatArray
    share: FloatArray


def moment_posterior(
    mixture: Mixture, mean: FloatArray, covariance: FloatArray, noise: Noise
) -> MomentPosterior:
    """Return what one moment says of f ~ N(mean, covariance).

    Args:
        mixture: The outcomes under each row.
        mean: m, (row, channel) [m].
        covariance: K, (row, channel, channel) [m2].
        noise: The Student t of residuals.
    """
    error = mixture.residual - mean[:, None]
    wide, log_determinant = inverse(mixture.scale + covariance[:, None])
    square = np.einsum("rai,raij,raj->ra", error, wide, error)
    glance = mixture.log_weight + noise.log_density(square, log_determinant)
    count = min(KEPT, glance.shape[1])
    kept = np.argpartition(-glance, count - 1, axis=1)[:, :count]
    rows = np.arange(len(kept))[:, None]
    error = error[rows, kept]
    factors, log_omega = scale_mixture(noise.dof, noise.dims)
    total = (
        covariance[:, None, None] + mixture.scale[rows, kept][:, :, None] / factors[:, None, None]
    )
    solved, log_determinant = inverse(total)  # (row, kept, normal, channel, channel)
    pull = np.einsum("raqij,raj->raqi", solved, error)
    square = np.einsum("rai,raqi->raq", error, pull)
    dims = noise.dims
    surplus = 0.5 * (mixture.residual.shape[-1] - dims) * np.log(factors)
    term = mixture.log_weight[rows, kept][..., None] + log_omega - surplus
    term = term - 0.5 * (square + log_determinant + dims * np.log(2.0 * np.pi))
    rest = glance + _ratio(term, glance[rows, kept])[:, None]
    np.put_along_axis(rest, kept, -np.inf, axis=1)
    top = np.maximum(np.maximum(term.max(axis=(1, 2)), rest.max(axis=1)), noise.log_outlier)
    share = np.exp(term - top[:, None, None])
    left = np.exp(rest - top[:, None])
    sum_of_all = share.sum(axis=(1, 2)) + left.sum(axis=1) + np.exp(noise.log_outlier - top)
    share /= sum_of_all[:, None, None]
    left /= sum_of_all[:, None]
    of_kept = share.sum(axis=(1, 2))  # those that are left pull as these do
    counted = share * (1.0 + left.sum(axis=1) / np.maximum(of_kept, 1e-300))[:, None, None]
    alpha = np.einsum("raq,raqi->ri", counted, pull)
    curvature = np.einsum("raq,raqij->rij", counted, solved)
    curvature -= np.einsum("raq,raqi,raqj->rij", counted, pull, pull, optimize=True)
    curvature += alpha[:, :, None] * alpha[:, None]
    np.put_along_axis(left, kept, share.sum(axis=2), axis=1)
    return MomentPosterior(top + np.log(sum_of_all), alpha, curvature, left)


def _ratio(term: FloatArray, glance: FloatArray) -> FloatArray:
    """Return the log of what kept outcomes say over their density at the first glance, (row,).

    The glance takes what is not known of f for the scale of the Student t. The outcomes that are
    left count as wrongly as those that are kept.

    Args:
        term: Integrals of the kept outcomes, (row, kept, normal).
        glance: Their density, (row, kept).
    """
    exact, rough = log_sum(term, axis=(1, 2)), log_sum(glance, axis=1)
    known = np.isfinite(exact) & np.isfinite(rough)
    return np.where(known, exact - np.where(known, rough, 0.0), 0.0)


def inverse(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return inverse and log determinant of symmetric matrices; three channels in closed form."""
    if matrix.shape[-1] != 3:
        return as_floats(np.linalg.inv(matrix)), as_floats(np.linalg.slogdet(matrix)[1])
    xx, yy, zz = matrix[..., 0, 0], matrix[..., 1, 1], matrix[..., 2, 2]
    xy, xz, yz = matrix[..., 0, 1], matrix[..., 0, 2], matrix[..., 1, 2]
    found = np.empty(matrix.shape)
    found[..., 0, 0], found[..., 1, 1] = yy * zz - yz * yz, xx * zz - xz * xz
    found[..., 2, 2] = xx * yy - xy * xy
    found[..., 0, 1] = found[..., 1, 0] = xz * yz - xy * zz
    found[..., 0, 2] = found[..., 2, 0] = xy * yz - xz * yy
    found[..., 1, 2] = found[..., 2, 1] = xy * xz - xx * yz
    determinant = xx * found[..., 0, 0] + xy * found[..., 0, 1] + xz * found[..., 0, 2]
    found /= determinant[..., None, None]
    return found, np.log(determinant)
