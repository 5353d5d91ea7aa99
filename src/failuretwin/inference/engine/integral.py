"""The integral of one moment: what the sensors say at one time, under many hypotheses at once.

    Z = integral of N(f; m, K) [ sum over a of w_a t_nu(r_a - f; S_a) + outlier ] df

The Student t is a sum of normal distributions, t_nu(x; S) = sum of omega_q N(x; S / lambda_q) (five
of them, within 0.06 nats as far as outliers reach), so that the integral, the mean and the
covariance of f are sums in closed form. With C_aq = K + S_a / lambda_q and their shares p_aq,

    alpha = sum p_aq C_aq^-1 (r_a - m),    E[f] = m + K alpha
    B = sum p_aq (C_aq^-1 - C_aq^-1 (r_a - m)(r_a - m)^T C_aq^-1) + alpha alpha^T
    Cov[f] = K - K B K

Laplace's method at the mode, with the expected information as curvature, takes an unknown moment
for half a nat more than it says; these moments are exact. Arrays have rows of hypotheses last, and
matrices are packed (`symmetric`), so that each step runs over all rows at once.

Section: docs/inference.md#integral
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache

import numpy as np
from scipy.optimize import least_squares

from failuretwin.core.numerics import log_fall, log_norm
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.inference.engine import symmetric

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
        residual: r_a, (channel, outcome, row) [m].
        scale: S_a, packed, (entry, outcome, row) [m2].
        log_weight: log w_a, (outcome, row).
    """

    residual: FloatArray
    scale: FloatArray
    log_weight: FloatArray

    def __getitem__(self, rows: IntArray) -> Mixture:
        """Return some of the rows."""
        if len(rows) == self.log_weight.shape[-1]:  # all of them
            return self
        return Mixture(self.residual[..., rows], self.scale[..., rows], self.log_weight[:, rows])

    @classmethod
    def joined(cls, parts: Sequence[Mixture]) -> Mixture:
        """Return the rows of several mixtures as one; outcomes that a row has not weigh nothing."""
        if len(parts) == 1:
            return parts[0]
        most = max(len(one.log_weight) for one in parts)
        padded = [one._padded(most - len(one.log_weight)) for one in parts]
        names = [field.name for field in fields(cls)]
        return cls(*(np.concatenate([getattr(one, n) for one in padded], -1) for n in names))

    def _padded(self, more: int) -> Mixture:
        """Return the same with more outcomes, as the last one, that weigh nothing."""
        if more == 0:
            return self
        last = [(0, 0), (0, more), (0, 0)]
        return Mixture(
            np.pad(self.residual, last, mode="edge"),
            np.pad(self.scale, last, mode="edge"),
            np.pad(self.log_weight, last[1:], constant_values=-np.inf),
        )

    @property
    def by_row(self) -> tuple[FloatArray, FloatArray]:
        """r_a (row, outcome, channel) and S_a (row, outcome, channel, channel)."""
        return self.residual.T, np.swapaxes(symmetric.unpacked(self.scale), 0, 1)


@dataclass(frozen=True)
class MomentPosterior:
    """What one moment says.

    Attributes:
        log_evidence: log Z, (row,).
        alpha: (channel, row).
        curvature: B, packed, (entry, row).
        share: Share of each outcome, (outcome, row); what is missing to 1 is the outlier's.
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
        mean: m, (channel, row) [m].
        covariance: K, packed, (entry, row) [m2].
        noise: The Student t of residuals.
    """
    error = mixture.residual - mean[:, None]
    precision, log_determinant = symmetric.inverse(mixture.scale + covariance[:, None])
    square = symmetric.dot(error, symmetric.times(precision, error))
    glance = mixture.log_weight + noise.log_density(square, log_determinant)
    best = np.argmax(glance, axis=0)
    highest = glance[best, np.arange(len(best))]
    kept = glance > np.maximum(highest, noise.log_outlier) - KEPT_NATS
    kept[best, np.arange(len(best))] = True
    row, outcome = np.nonzero(kept.T)  # outcomes of a row stand together
    begin = np.flatnonzero(np.diff(row, prepend=-1))
    terms = _Terms.of(
        error[:, outcome, row],
        mixture.scale[:, outcome, row],
        mixture.log_weight[outcome, row],
        covariance[:, row],
        noise,
    )
    # What is left of f counts as scatter at the glance: wrong by as much for the others.
    exact = _log_sum_by_row(terms.log_height, begin, row)
    rough = _log_sum_by_row(glance[outcome, row], begin, row)
    possible = np.isfinite(exact) & np.isfinite(rough)
    ratio = np.where(possible, exact - np.where(possible, rough, 0.0), 0.0)
    rest = np.where(kept, -np.inf, glance + ratio)
    top = np.maximum(np.where(possible, exact, -np.inf), noise.log_outlier)
    share = np.exp(rest - top)
    left = share.sum(axis=0)
    height = np.exp(terms.log_height - top[row])
    of_kept = np.add.reduceat(height, begin)
    total = of_kept + left + np.exp(noise.log_outlier - top)
    share[outcome, row] = height
    share /= total
    # Those that are left pull as these do.
    counted = (1.0 + left / np.maximum(of_kept, 1e-300)) / total
    alpha, curvature = terms.pooled(top, row, begin, counted)
    return MomentPosterior(top + np.log(total), alpha, curvature, share)


@dataclass(frozen=True)
class _Terms:
    """Outcomes of all rows that are integrated in full, (term,) each.

    Attributes:
        log_height: Log of weight times integral.
        log_normal: The same of each normal distribution, (normal, term).
        pull: C^-1 (r - m), (channel, normal, term).
        precision: C^-1, packed, (entry, normal, term).
    """

    log_height: FloatArray
    log_normal: FloatArray
    pull: FloatArray
    precision: FloatArray

    @classmethod
    def of(
        cls,
        error: FloatArray,
        scale: FloatArray,
        log_weight: FloatArray,
        covariance: FloatArray,
        noise: Noise,
    ) -> _Terms:
        """Integrate outcomes: r - m (channel, term), S and K packed, log w (term,)."""
        factors, log_omega = scale_mixture(noise.dof, noise.dims)
        total = covariance[:, None] + scale[:, None] / factors[:, None]
        precision, log_determinant = symmetric.inverse(total)
        error = error[:, None]
        pull = symmetric.times(precision, error)
        surplus = 0.5 * (len(error) - noise.dims) * np.log(factors)
        constant = log_omega - surplus - 0.5 * noise.dims * np.log(2.0 * np.pi)
        log_normal = -0.5 * (symmetric.dot(error, pull) + log_determinant)
        log_normal += constant[:, None]
        log_normal += log_weight
        top = log_normal.max(axis=0)
        safe = np.where(np.isfinite(top), top, 0.0)
        with np.errstate(divide="ignore"):
            log_height = np.log(np.exp(log_normal - safe).sum(axis=0)) + safe
        return cls(log_height, log_normal, pull, precision)

    def pooled(
        self, top: FloatArray, row: IntArray, begin: IntArray, counted: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return alpha (channel, row) and B (entry, row), summed over the terms of each row.

        Args:
            top: Log of what heights are shares of, (row,).
            row: Row of each term.
            begin: First term of each row, (row,).
            counted: Factor on the heights of each row, (row,).
        """
        share = np.exp(self.log_normal - top[row]) * counted[row]
        pulled = share * self.pull
        alpha = np.add.reduceat(pulled.sum(axis=1), begin, axis=-1)
        rows, columns = symmetric.entries(len(alpha))
        curvature = share * self.precision - pulled[rows] * self.pull[columns]
        return alpha, np.add.reduceat(curvature.sum(axis=1), begin, axis=-1) + symmetric.outer(
            alpha
        )


def _log_sum_by_row(values: FloatArray, begin: IntArray, row: IntArray) -> FloatArray:
    """Return log(sum(exp(values))) of the terms of each row, (row,).

    Args:
        values: (term,).
        begin: First term of each row.
        row: Row of each term.
    """
    top = np.maximum.reduceat(values, begin)
    safe = np.where(np.isfinite(top), top, 0.0)
    with np.errstate(divide="ignore"):
        return np.log(np.add.reduceat(np.exp(values - safe[row]), begin)) + safe
