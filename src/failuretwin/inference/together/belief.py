"""What is believed of what runs share: a mixture of normal distributions, and what runs add to it.

    p(theta) = sum over c of w_c N(theta; mu_c, V_c)
    p(theta | sites) ~ sum over c of w_c Z_c N(theta; (Lambda_c + Lambda)^-1 (eta_c + eta), ...)
    log Z_c = 1/2 (eta_c + eta)^T (Lambda_c + Lambda)^-1 (eta_c + eta) - 1/2 log |Lambda_c + Lambda|
              - 1/2 eta_c^T Lambda_c^-1 eta_c + 1/2 log |Lambda_c|

A site is what one run says, a normal factor of theta. Robots that fit their kind ill are a wide
component beside the usual one: a tail that is common to all runs of a robot.

Section: docs/inference.md#shared-unknowns
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin.core.numerics import log_sum
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.inference.engine.theta import Components

LEAST_PRECISION = 1e-9
"""Of a belief without some of its sites, in units of the prior's."""
LEAST_WEIGHT = 1e-8
"""Components that are less probable are forgotten for good."""


@dataclass(frozen=True)
class Normal:
    """Normal distributions of theta, one a run, by precision and precision times mean.

    Attributes:
        precision: (run, theta, theta).
        shift: Precision times mean, (run, theta).
    """

    precision: FloatArray
    shift: FloatArray

    def __getitem__(self, rows: IntArray) -> Normal:
        """Return those of some of the runs."""
        return Normal(self.precision[rows], self.shift[rows])

    @property
    def mean(self) -> FloatArray:
        """(run, theta)."""
        return np.asarray(np.linalg.solve(self.precision, self.shift[..., None])[..., 0])


@dataclass(frozen=True)
class Belief:
    """Mixtures of normal distributions of theta in units, one for each of some runs.

    Attributes:
        log_weight: Log of the probability of each component, (run, component).
        precision: (run, component, theta, theta).
        shift: Precision times mean, (run, component, theta).
    """

    log_weight: FloatArray
    precision: FloatArray
    shift: FloatArray

    @classmethod
    def of(cls, components: Components, unit: FloatArray) -> Belief:
        """Return what is believed before any run, one mixture.

        Args:
            components: What is believed of theta, the same of all runs.
            unit: Unit of each part of theta, (theta,).
        """
        precision = np.asarray(np.linalg.inv(components.covariance / np.outer(unit, unit)))
        shift: FloatArray = np.einsum("ctu,cu->ct", precision, components.mean / unit)
        log_weight = components.log_weight - log_sum(components.log_weight, axis=0)
        each = components.normal
        return cls(log_weight[None], precision[None, each], shift[None, each])

    def __getitem__(self, component: int) -> Normal:
        """Return one component alone."""
        return Normal(self.precision[:, component], self.shift[:, component])

    def only(self, components: IntArray) -> Belief:
        """Return what is believed if one of some components is true."""
        log_weight = self.log_weight[:, components]
        log_weight = log_weight - log_sum(log_weight, axis=1)[:, None]
        return Belief(log_weight, self.precision[:, components], self.shift[:, components])

    @property
    def weight(self) -> FloatArray:
        """Probability of each component, (run, component)."""
        return np.exp(self.log_weight)

    def times(self, sites: Normal) -> Belief:
        """Return what is believed given sites, a row of them for each run.

        Args:
            sites: Sums of sites; one belief may be given many rows.
        """
        precision = positive(self.precision + sites.precision[:, None], LEAST_PRECISION)
        shift = self.shift + sites.shift[:, None]
        log_weight = self.log_weight + _log_volume(precision, shift)
        log_weight = log_weight - _log_volume(self.precision, self.shift)
        return Belief(log_weight - log_sum(log_weight, axis=1)[:, None], precision, shift)

    def beside(self, precision: FloatArray) -> Belief:
        """Return the same of a longer theta, whose last places have mean 0 and are independent.

        Args:
            precision: Of the places added, (added, added).
        """
        old, new = self.precision.shape[-1], len(precision)
        whole = np.pad(self.precision, [(0, 0), (0, 0), (0, new), (0, new)])
        whole[..., old:, old:] = precision
        return Belief(self.log_weight, whole, np.pad(self.shift, [(0, 0), (0, 0), (0, new)]))

    def matched(self) -> Normal:
        """Return the normal distribution with the mean and covariance of each mixture."""
        mean, covariance = self.moments
        precision = np.asarray(np.linalg.inv(covariance))
        return Normal(precision, np.einsum("rtu,ru->rt", precision, mean))

    @property
    def moments(self) -> tuple[FloatArray, FloatArray]:
        """Mean (run, theta) and covariance (run, theta, theta)."""
        covariance = np.asarray(np.linalg.inv(self.precision))
        each = np.einsum("rctu,rcu->rct", covariance, self.shift)
        return mixed(self.weight, each, covariance)

    def log_density(self, theta: FloatArray) -> float:
        """Return the log density of one theta in units, (theta,), but for a constant."""
        away = theta - np.linalg.solve(self.precision[0], self.shift[0][..., None])[..., 0]
        square = np.einsum("ct,ctu,cu->c", away, self.precision[0], away)
        volume = np.linalg.slogdet(self.precision[0])[1]
        return float(log_sum(self.log_weight[0] + 0.5 * (volume - square), axis=0))

    def blurred(self, variance: FloatArray) -> Belief:
        """Return what is believed after a random walk of that variance, (theta,)."""
        if not variance.any():
            return self
        covariance = np.linalg.inv(self.precision)
        mean = np.einsum("rctu,rcu->rct", covariance, self.shift)
        precision = np.linalg.inv(covariance + np.diag(variance))
        return Belief(self.log_weight, precision, np.einsum("rctu,rcu->rct", precision, mean))

    def or_moved(self, variance: FloatArray, odds: float) -> Belief:
        """Return what is believed if theta may also have moved by that variance, with some odds."""
        moved, log_odds = self.blurred(variance), float(np.log(odds))
        log_weight = np.concatenate([self.log_weight, moved.log_weight + log_odds], axis=1)
        return Belief(
            log_weight - log_sum(log_weight, axis=1)[:, None],
            np.concatenate([self.precision, moved.precision], axis=1),
            np.concatenate([self.shift, moved.shift], axis=1),
        )

    def pruned(self) -> Belief:
        """Return one mixture without the components that are not to be reckoned with."""
        kept = np.flatnonzero(self.weight[0] > LEAST_WEIGHT)
        return Belief(self.log_weight[:, kept], self.precision[:, kept], self.shift[:, kept])


def mixed(
    weight: FloatArray, mean: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return mean (run, theta) and covariance (run, theta, theta) of mixtures.

    Args:
        weight: Of each part, (run, ...).
        mean: (run, ..., theta).
        covariance: (run, ..., theta, theta).
    """
    runs, size = len(weight), mean.shape[-1]
    weight, mean = weight.reshape(runs, -1), mean.reshape(runs, -1, size)
    middle = np.einsum("rk,rkt->rt", weight, mean)
    away = mean - middle[:, None]
    spread = np.einsum("rk,rktu->rtu", weight, covariance.reshape(runs, -1, size, size))
    return middle, spread + np.einsum("rk,rkt,rku->rtu", weight, away, away, optimize=True)


def positive(matrix: FloatArray, least: float) -> FloatArray:
    """Return symmetric matrices (..., n, n) with no eigenvalue below the least."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + np.swapaxes(matrix, -1, -2)))
    return np.asarray(
        (vectors * np.maximum(values, least)[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    )


def summed(sites: Normal, rows: BoolArray | slice = slice(None)) -> Normal:
    """Return the sum of some sites, of one row."""
    return Normal(sites.precision[rows].sum(axis=0)[None], sites.shift[rows].sum(axis=0)[None])


def _log_volume(precision: FloatArray, shift: FloatArray) -> FloatArray:
    """Return log of the integral of exp(shift^T x - 1/2 x^T precision x), up to a constant."""
    mean = np.linalg.solve(precision, shift[..., None])[..., 0]
    return np.asarray(0.5 * np.sum(shift * mean, axis=-1) - 0.5 * np.linalg.slogdet(precision)[1])
