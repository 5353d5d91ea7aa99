"""The filter: moment by moment, each a Laplace integral in the numbers of one moment.

Rows of hypotheses carry the normal distribution of f = G theta + H z over all their moments,

    f ~ N(G mu, K),    K = G V G^T + var(z) H H^T

Moments of one movement share its outcome: what one says of it is the weight with which the next
begins. A moment m replaces its likelihood by a normal factor of f_m with information W and shift
b = W f_m + alpha (assumed-density filter). Given all factors,

    a = (I + W K)^-1 (b - W G mu),    theta | row: mu + V G^T a,  V - V G^T (I + W K)^-1 W G V

Section: docs/inference.md#filter
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from failuretwin.core.numerics import log_of, log_sum
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.inference.engine.integral import (
    Mixture,
    MomentPosterior,
    Noise,
    moment_posterior,
)


@dataclass(frozen=True)
class FilterRows:
    """Rows with the normal distribution of f = G theta + H z over all moments.

    Attributes:
        mixture_at: The outcomes of a moment under each row.
        usable: Moments with readings, (row, moment).
        kept: Probability that the outcome of the moment before holds on, (row, moment).
        mean: G mu, (row, moment, channel) [m].
        covariance: G V G^T, (row, moment * channel, moment * channel) [m2].
        lever: H, (row, moment, channel).
        variance: var(z), (row,); 0 without an amount.
        noise: The Student t of residuals.
    """

    mixture_at: Callable[[int], Mixture]
    usable: BoolArray
    kept: FloatArray
    mean: FloatArray
    covariance: FloatArray
    lever: FloatArray
    variance: FloatArray
    noise: Noise

    @property
    def prior(self) -> tuple[FloatArray, FloatArray]:
        """Mean (row, number) and covariance (row, number, number) of f and, last, z."""
        rows, moments, channels = self.mean.shape
        size, variance = moments * channels, self.variance[:, None]
        flat = self.lever.reshape(rows, size)
        whole = np.zeros((rows, size + 1, size + 1))
        whole[:, :size, :size] = self.spread
        whole[:, :size, size] = whole[:, size, :size] = variance * flat
        whole[:, size, size] = self.variance
        return np.concatenate([self.mean.reshape(rows, size), np.zeros((rows, 1))], axis=1), whole

    @property
    def spread(self) -> FloatArray:
        """K, (row, moment * channel, moment * channel) [m2]."""
        flat = self.lever.reshape(self.covariance.shape[:2])
        return self.covariance + self.variance[:, None, None] * flat[:, :, None] * flat[:, None]


@dataclass(frozen=True)
class RowsPosterior:
    """What all moments say of some rows.

    Attributes:
        log_evidence: Log density of each moment given those before it, (row, moment).
        information: W, (row, moment, channel, channel).
        shift: b, (row, moment, channel).
        share: Share of each outcome when its moment came, (row, moment, outcome).
        log_weight: Log of its weight before that, (row, moment, outcome).
        mean: Mean of f given all moments, (row, moment, channel) [m].
        amount: Mean and variance of z given all moments, (row, 2).
    """

    log_evidence: FloatArray
    information: FloatArray
    shift: FloatArray
    share: FloatArray
    log_weight: FloatArray
    mean: FloatArray
    amount: FloatArray

    @property
    def total(self) -> FloatArray:
        """Log density of all moments, (row,)."""
        return np.asarray(self.log_evidence.sum(axis=1))

    def __getitem__(self, rows: IntArray | slice) -> RowsPosterior:
        """Return some of the rows."""
        return RowsPosterior(*(getattr(self, field.name)[rows] for field in fields(self)))

    def with_rows(self, places: IntArray, some: RowsPosterior) -> RowsPosterior:
        """Return the same with some of the rows replaced."""
        names = [field.name for field in fields(self)]
        values = {name: getattr(self, name).copy() for name in names}
        for name in names:
            values[name][places] = getattr(some, name)
        return RowsPosterior(**values)

    @classmethod
    def joined(cls, parts: Sequence[RowsPosterior]) -> RowsPosterior:
        """Return the posteriors of several sets of rows as one."""
        names = [field.name for field in fields(cls)]
        return cls(*(np.concatenate([getattr(one, n) for one in parts]) for n in names))


def filter_rows(rows: FilterRows) -> RowsPosterior:
    """Return what moments say of rows, one after the other."""
    count, moments, channels = rows.mean.shape
    size, usable = moments * channels, rows.usable
    f, whole = rows.prior
    log_evidence = np.zeros((count, moments))
    information = np.zeros((count, moments, channels, channels))
    shift = np.zeros((count, moments, channels))
    shares, weights = list[FloatArray](), list[FloatArray]()
    for m in range(moments):
        mixture = rows.mixture_at(m)
        if rows.kept[:, m].any():
            carried = _carried(mixture.log_weight, shares[-1], weights[-1], rows.kept[:, m])
            mixture = replace(mixture, log_weight=carried)
        weights.append(mixture.log_weight)
        share = np.zeros(mixture.log_weight.shape)
        some = np.flatnonzero(usable[:, m])
        if len(some):
            at = slice(m * channels, (m + 1) * channels)
            here, spread = f[some, at], whole[some, at, at]
            found = moment_posterior(mixture[some], here, spread, rows.noise)
            log_evidence[some, m], share[some] = found.log_evidence, found.share
            information[some, m], shift[some, m] = site(found, here, spread)
            cross = whole[some, :, at]
            f[some] += np.matmul(cross, found.alpha[..., None])[..., 0]
            W = information[some, m]
            taken = np.linalg.solve(np.eye(channels) + W @ spread, W)
            whole[some] -= np.matmul(np.matmul(cross, taken), np.swapaxes(cross, -1, -2))
        if m:  # a moment that was not seen leaves what was known of its movement
            unseen = (rows.kept[:, m] > 0.0) & ~usable[:, m]
            share = np.where(unseen[:, None], shares[-1], share)
        shares.append(share)
    return RowsPosterior(
        log_evidence,
        information,
        shift,
        np.stack(shares, axis=1),
        np.stack(weights, axis=1),
        f[:, :size].reshape(count, moments, channels),
        np.stack([f[:, size], whole[:, size, size]], axis=1),
    )


def _carried(
    log_weight: FloatArray, share: FloatArray, before: FloatArray, kept: FloatArray
) -> FloatArray:
    """Return the log weights of outcomes given what the moment before said of them, same axes.

    What an outlier leaves open is as it was before.

    Args:
        log_weight: Weights that nothing is known of, (row, outcome).
        share: Share of each when the moment before came, (row, outcome).
        before: Log of its weight then, (row, outcome).
        kept: Probability that it holds on, (row,).
    """
    found = log_weight.copy()
    some = np.flatnonzero((kept > 0.0) & np.isfinite(before).any(axis=1))
    total, stays = log_sum(log_weight[some], axis=1)[:, None], kept[some, None]
    usual = np.exp(before[some] - log_sum(before[some], axis=1)[:, None])
    known = share[some] + np.maximum(1.0 - share[some].sum(axis=1), 0.0)[:, None] * usual
    found[some] = log_of(stays * known + (1.0 - stays) * np.exp(log_weight[some] - total)) + total
    return found


def site(
    found: MomentPosterior, mean: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return W and b of the normal factor that stands for a moment.

        Cov[f] = (K^-1 + W)^-1    W = (I - B K)^-1 B,    b = W E[f] + alpha

    Args:
        found: What the moment says.
        mean: m, (row, channel) [m].
        covariance: K, (row, channel, channel) [m2].
    """
    eye = np.eye(mean.shape[-1])
    W = np.linalg.solve(eye - found.curvature @ covariance, found.curvature)
    values, vectors = np.linalg.eigh(0.5 * (W + np.swapaxes(W, -1, -2)))
    W = (vectors * np.maximum(values, 0.0)[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    middle = mean + np.matmul(covariance, found.alpha[..., None])[..., 0]
    return W, np.matmul(W, middle[..., None])[..., 0] + found.alpha


AGREE_NATS = 1.5
"""A second look at the moments counts where it moves the evidence by less: else they contradict
each other under this row, and one normal distribution does not hold what they leave open."""


def refine(rows: FilterRows, found: RowsPosterior) -> RowsPosterior:
    """Return what moments say of rows, each weighed given all others (expectation propagation).

    With factors (W, b) of the moments, N_-m the distribution without that of m, and Z_m its
    integral,

        log p = sum over m of [ log Z_m - log integral of N_-m exp(-1/2 f^T W f + b^T f) ]
                + log integral of N(f; G mu, K) prod over m of exp(-1/2 f^T W f + b^T f)

    Args:
        rows: The rows.
        found: What the filter has found.
    """
    sites, usable = _Sites.of(rows, found), rows.usable
    log_evidence = np.zeros(usable.shape)
    shares = found.share.copy()
    for m in range(usable.shape[1]):
        some = np.flatnonzero(usable[:, m])
        if not len(some):
            continue
        here, spread = sites.without(m, some)
        mixture = replace(rows.mixture_at(m)[some], log_weight=found.log_weight[some, m])
        says = moment_posterior(mixture, here, spread, rows.noise)
        W, b = site(says, here, spread)
        log_evidence[some, m] = says.log_evidence - _log_integral(W, b, here, spread)
        shares[some, m] = says.share
        sites.put(m, some, W, b)
    total = log_evidence.sum(axis=1) + sites.log_integral
    agree = np.abs(total - found.total) < AGREE_NATS
    f, z = sites.moments
    return RowsPosterior(
        found.log_evidence + np.where(agree, total - found.total, 0.0)[:, None] / usable.shape[1],
        np.where(agree[:, None, None, None], sites.information, found.information),
        np.where(agree[:, None, None], sites.shift, found.shift),
        np.where(agree[:, None, None], shares, found.share),
        found.log_weight,
        np.where(agree[:, None, None], f, found.mean),
        np.where(agree[:, None], z, found.amount),
    )


@dataclass
class _Sites:
    """The normal distribution of f and z with the factors of all moments.

    Attributes:
        prior_mean: (row, number).
        prior: K, (row, number, number).
        information: W of each moment, (row, moment, channel, channel).
        shift: b, (row, moment, channel).
        f: Mean given all factors, (row, number).
        whole: Covariance given all factors, (row, number, number).
    """

    prior_mean: FloatArray
    prior: FloatArray
    information: FloatArray
    shift: FloatArray
    f: FloatArray
    whole: FloatArray

    @classmethod
    def of(cls, rows: FilterRows, found: RowsPosterior) -> _Sites:
        prior_mean, prior = rows.prior
        information, shift = found.information.copy(), found.shift.copy()
        f, whole = _given(prior_mean, prior, information, shift)
        return cls(prior_mean, prior, information, shift, f, whole)

    def without(self, m: int, some: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return mean and covariance of f_m without the factor of a moment."""
        at = _at(m, self.shift)
        W, spread, f = self.information[some, m], self.whole[some, at, at], self.f[some, at]
        cavity = np.linalg.solve(np.eye(f.shape[-1]) - spread @ W, spread)
        values, vectors = np.linalg.eigh(0.5 * (cavity + np.swapaxes(cavity, -1, -2)))
        cavity = (vectors * np.maximum(values, 0.0)[..., None, :]) @ np.swapaxes(vectors, -1, -2)
        pull = self.shift[some, m] - np.matmul(W, f[..., None])[..., 0]
        return f - np.matmul(cavity, pull[..., None])[..., 0], cavity

    def put(self, m: int, some: IntArray, W: FloatArray, b: FloatArray) -> None:
        """Take the new factor of a moment."""
        at = _at(m, self.shift)
        more, pull = W - self.information[some, m], b - self.shift[some, m]
        spread, f, cross = self.whole[some, at, at], self.f[some, at], self.whole[some, :, at]
        system = np.eye(f.shape[-1]) + more @ spread
        pull = pull - np.matmul(more, f[..., None])[..., 0]
        alpha = np.linalg.solve(system, pull[..., None])
        taken = np.linalg.solve(system, more)
        self.f[some] += np.matmul(cross, alpha)[..., 0]
        self.whole[some] -= cross @ taken @ np.swapaxes(cross, -1, -2)
        self.information[some, m], self.shift[some, m] = W, b

    @property
    def moments(self) -> tuple[FloatArray, FloatArray]:
        """Mean of f (row, moment, channel), and mean and variance of z (row, 2)."""
        f = self.f[:, :-1].reshape(self.shift.shape)
        return f, np.stack([self.f[:, -1], self.whole[:, -1, -1]], axis=1)

    @property
    def log_integral(self) -> FloatArray:
        """Log of the integral of the prior times all factors, (row,)."""
        W, b = _stacked(self.information, self.shift)
        return _log_integral(W, b, self.prior_mean, self.prior)


def _at(m: int, shift: FloatArray) -> slice:
    channels = shift.shape[-1]
    return slice(m * channels, (m + 1) * channels)


def _stacked(information: FloatArray, shift: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the factors of all moments as one of f and z."""
    rows, moments, channels = shift.shape
    size = moments * channels
    W, b = np.zeros((rows, size + 1, size + 1)), np.zeros((rows, size + 1))
    for m in range(moments):
        at = _at(m, shift)
        W[:, at, at], b[:, at] = information[:, m], shift[:, m]
    return W, b


def _given(
    mean: FloatArray, prior: FloatArray, information: FloatArray, shift: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return mean and covariance of f and z given the factors of all moments."""
    W, b = _stacked(information, shift)
    system = np.eye(mean.shape[-1]) + W @ prior
    pull = b - np.matmul(W, mean[..., None])[..., 0]
    alpha = np.linalg.solve(system, pull[..., None])
    whole = prior - prior @ np.linalg.solve(system, W @ prior)
    return mean + np.matmul(prior, alpha)[..., 0], whole


def _log_integral(
    W: FloatArray, b: FloatArray, mean: FloatArray, covariance: FloatArray
) -> FloatArray:
    """Return log of the integral of N(f; mean, covariance) exp(-1/2 f^T W f + b^T f), (row,)."""
    system = np.eye(mean.shape[-1]) + W @ covariance
    pull = b - np.matmul(W, mean[..., None])[..., 0]
    moved = np.matmul(covariance, np.linalg.solve(system, pull[..., None]))[..., 0]
    value = np.sum(mean * (b + pull), axis=-1) + np.sum(pull * moved, axis=-1)
    return np.asarray(0.5 * (value - np.linalg.slogdet(system)[1]))
