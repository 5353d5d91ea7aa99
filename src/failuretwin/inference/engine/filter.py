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
from functools import cached_property

import numpy as np

from failuretwin.core.numerics import log_of, log_sum
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.inference.engine.integral import Mixture, Noise, moment_posterior
from failuretwin.inference.engine.symmetric import packed, unpacked


@dataclass(frozen=True)
class FilterRows:
    """Rows with the normal distribution of f = G theta + H z over all moments.

    Attributes:
        mixture_at: The outcomes of a moment under each row.
        usable: Moments with readings, (row, moment).
        kept: Probability that the outcome of the moment before holds on, (row, moment).
        mean: G mu, (row, moment, channel) [m].
        covariance: G V G^T, (row, moment * channel, moment * channel) [m2].
        lever: H, (row, moment, channel, amount).
        variance: Of each amount, (row, amount).
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

    @classmethod
    def joined(cls, parts: Sequence[FilterRows]) -> FilterRows:
        """Return several sets of rows as one."""
        if len(parts) == 1:
            return parts[0]

        def join(name: str) -> FloatArray:
            return np.concatenate([getattr(one, name) for one in parts])

        return cls(
            lambda m: Mixture.joined([one.mixture_at(m) for one in parts]),
            np.concatenate([one.usable for one in parts]),
            join("kept"),
            join("mean"),
            join("covariance"),
            join("lever"),
            join("variance"),
            parts[0].noise,
        )

    @property
    def prior(self) -> tuple[FloatArray, FloatArray]:
        """Mean (row, number) and covariance (row, number, number) of f and, last, z."""
        rows, moments, channels = self.mean.shape
        size, amounts = moments * channels, self.variance.shape[1]
        crossed = self._flat_lever * self.variance[:, None]
        whole = np.zeros((rows, size + amounts, size + amounts))
        whole[:, :size, :size] = self.spread
        whole[:, :size, size:] = crossed
        whole[:, size:, :size] = np.swapaxes(crossed, 1, 2)
        whole[:, range(size, size + amounts), range(size, size + amounts)] = self.variance
        mean = self.mean.reshape(rows, size)
        return np.concatenate([mean, np.zeros((rows, amounts))], axis=1), whole

    @property
    def spread(self) -> FloatArray:
        """K, (row, moment * channel, moment * channel) [m2]."""
        flat = self._flat_lever
        return self.covariance + (flat * self.variance[:, None]) @ np.swapaxes(flat, 1, 2)

    @property
    def _flat_lever(self) -> FloatArray:
        rows, moments, channels, amounts = self.lever.shape
        return self.lever.reshape(rows, moments * channels, amounts)


@dataclass(frozen=True)
class RowsPosterior:
    """What all moments say of some rows.

    Attributes:
        log_evidence: Log density of each moment given those before it, (row, moment).
        alpha: What the integral of each moment says, (row, moment, channel).
        curvature: B, (row, moment, channel, channel).
        ahead: Mean of f without the moment, (row, moment, channel) [m].
        doubt: Covariance of f without the moment, (row, moment, channel, channel) [m2].
        share: Share of each outcome when its moment came, (row, moment, outcome).
        log_weight: Log of its weight before that, (row, moment, outcome).
        mean: Mean of f given all moments, (row, moment, channel) [m].
        amount: Mean of z given all moments, (row, amount).
        amount_spread: Its covariance, (row, amount, amount).
    """

    log_evidence: FloatArray
    alpha: FloatArray
    curvature: FloatArray
    ahead: FloatArray
    doubt: FloatArray
    share: FloatArray
    log_weight: FloatArray
    mean: FloatArray
    amount: FloatArray
    amount_spread: FloatArray

    @property
    def total(self) -> FloatArray:
        """Log density of all moments, (row,)."""
        return np.asarray(self.log_evidence.sum(axis=1))

    @cached_property
    def sites(self) -> tuple[FloatArray, FloatArray]:
        """W and b of the normal factor that stands for each moment, as `site` returns them."""
        return site(self.alpha, self.curvature, self.ahead, self.doubt)

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
        if len(parts) == 1:
            return parts[0]
        most = max(one.share.shape[-1] for one in parts)
        same = [one.with_outcomes(most) for one in parts]
        names = [field.name for field in fields(cls)]
        return cls(*(np.concatenate([getattr(one, n) for one in same]) for n in names))

    def with_outcomes(self, count: int) -> RowsPosterior:
        """Return the same with more outcomes, which weigh nothing, or without such ones."""
        more = count - self.share.shape[-1]
        if more <= 0:
            share, log_weight = self.share[..., :count], self.log_weight[..., :count]
        else:
            behind = [(0, 0), (0, 0), (0, more)]
            share = np.pad(self.share, behind)
            log_weight = np.pad(self.log_weight, behind, constant_values=-np.inf)
        return replace(self, share=share, log_weight=log_weight)


def filter_rows(rows: FilterRows) -> RowsPosterior:
    """Return what moments say of rows, one after the other."""
    count, moments, channels = rows.mean.shape
    size, usable = moments * channels, rows.usable
    f, whole = rows.prior
    log_evidence = np.zeros((count, moments))
    alpha, ahead = np.zeros((2, count, moments, channels))
    curvature, doubt = np.zeros((2, count, moments, channels, channels))
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
            found = moment_posterior(mixture[some], here.T, packed(spread), rows.noise)
            pull, B = found.alpha.T, unpacked(found.curvature)
            log_evidence[some, m], share[:, some] = found.log_evidence, found.share
            alpha[some, m], curvature[some, m], ahead[some, m], doubt[some, m] = (
                pull,
                B,
                here,
                spread,
            )
            cross = whole[some, :, at]
            f[some] += np.matmul(cross, pull[..., None])[..., 0]
            whole[some] -= np.matmul(np.matmul(cross, B), np.swapaxes(cross, -1, -2))
        if m:  # a moment that was not seen leaves what was known of its movement
            unseen = (rows.kept[:, m] > 0.0) & ~usable[:, m]
            share = np.where(unseen, shares[-1], share)
        shares.append(share)
    return RowsPosterior(
        log_evidence,
        alpha,
        curvature,
        ahead,
        doubt,
        np.moveaxis(np.stack(shares), -1, 0),
        np.moveaxis(np.stack(weights), -1, 0),
        f[:, :size].reshape(count, moments, channels),
        f[:, size:],
        whole[:, size:, size:],
    )


def filter_together(
    parts: Sequence[FilterRows], before: Sequence[RowsPosterior] | None, outcomes: Sequence[int]
) -> list[RowsPosterior]:
    """Return what moments say of several sets of rows, all at once.

    Args:
        parts: The sets.
        before: What the filter has found, to weigh every moment again given all others; None: the
            filter finds it.
        outcomes: Of each set.
    """
    rows = FilterRows.joined(parts)
    found = filter_rows(rows) if before is None else refine(rows, RowsPosterior.joined(before))
    ends = np.cumsum([len(one.usable) for one in parts]).tolist()
    places = [slice(*pair) for pair in zip([0, *ends[:-1]], ends, strict=True)]
    return [found[at].with_outcomes(n) for at, n in zip(places, outcomes, strict=True)]


def _carried(
    log_weight: FloatArray, share: FloatArray, before: FloatArray, kept: FloatArray
) -> FloatArray:
    """Return the log weights of outcomes given what the moment before said of them, same axes.

    What an outlier leaves open is as it was before.

    Args:
        log_weight: Weights that nothing is known of, (outcome, row).
        share: Share of each when the moment before came, (outcome, row).
        before: Log of its weight then, (outcome, row).
        kept: Probability that it holds on, (row,).
    """
    found = log_weight.copy()
    some = np.flatnonzero((kept > 0.0) & np.isfinite(before).any(axis=0))
    total, stays = log_sum(log_weight[:, some], axis=0), kept[some]
    usual = np.exp(before[:, some] - log_sum(before[:, some], axis=0))
    known = share[:, some]
    known = known + np.maximum(1.0 - known.sum(axis=0), 0.0) * usual
    fresh = np.exp(log_weight[:, some] - total)
    found[:, some] = log_of(stays * known + (1.0 - stays) * fresh) + total
    return found


def site(
    alpha: FloatArray, curvature: FloatArray, mean: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return W (..., channel, channel) and b (..., channel) of the factor that stands for a moment.

        Cov[f] = (K^-1 + W)^-1    W = (I - B K)^-1 B,    b = W E[f] + alpha

    Args:
        alpha: What the moment says, (..., channel).
        curvature: B, (..., channel, channel).
        mean: m, (..., channel) [m].
        covariance: K, (..., channel, channel) [m2].
    """
    eye = np.eye(mean.shape[-1])
    W = np.linalg.solve(eye - curvature @ covariance, curvature)
    values, vectors = np.linalg.eigh(0.5 * (W + np.swapaxes(W, -1, -2)))
    W = (vectors * np.maximum(values, 0.0)[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    middle = mean + np.matmul(covariance, alpha[..., None])[..., 0]
    return W, np.matmul(W, middle[..., None])[..., 0] + alpha


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
    again = RowsPosterior(*(getattr(found, field.name).copy() for field in fields(found)))
    for m in range(usable.shape[1]):
        some = np.flatnonzero(usable[:, m])
        if not len(some):
            continue
        here, spread = sites.without(m, some)
        mixture = replace(rows.mixture_at(m)[some], log_weight=found.log_weight[some, m].T)
        says = moment_posterior(mixture, here.T, packed(spread), rows.noise)
        alpha, B = says.alpha.T, unpacked(says.curvature)
        W, b = site(alpha, B, here, spread)
        log_evidence[some, m] = says.log_evidence - _log_integral(W, b, here, spread)
        again.alpha[some, m], again.curvature[some, m] = alpha, B
        again.ahead[some, m], again.doubt[some, m] = here, spread
        again.share[some, m] = says.share.T
        sites.put(m, some, W, b)
    total = log_evidence.sum(axis=1) + sites.log_integral
    again.mean[:], again.amount[:], again.amount_spread[:] = sites.moments
    again.log_evidence[:] += (total - found.total)[:, None] / usable.shape[1]
    agree = np.flatnonzero(np.abs(total - found.total) < AGREE_NATS)
    return found.with_rows(agree, again[agree])


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
        information, shift = (part.copy() for part in found.sites)
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
    def moments(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Mean of f (row, moment, channel), mean and covariance of z (row, amount, ...)."""
        size = self.shift.shape[1] * self.shift.shape[2]
        f = self.f[:, :size].reshape(self.shift.shape)
        return f, self.f[:, size:], self.whole[:, size:, size:]

    @property
    def log_integral(self) -> FloatArray:
        """Log of the integral of the prior times all factors, (row,)."""
        W, b = _stacked(self.information, self.shift, self.f.shape[1])
        return _log_integral(W, b, self.prior_mean, self.prior)


def _at(m: int, shift: FloatArray) -> slice:
    channels = shift.shape[-1]
    return slice(m * channels, (m + 1) * channels)


def _stacked(
    information: FloatArray, shift: FloatArray, numbers: int
) -> tuple[FloatArray, FloatArray]:
    """Return the factors of all moments as one of f and z, of so many numbers."""
    rows, moments, _ = shift.shape
    W, b = np.zeros((rows, numbers, numbers)), np.zeros((rows, numbers))
    for m in range(moments):
        at = _at(m, shift)
        W[:, at, at], b[:, at] = information[:, m], shift[:, m]
    return W, b


def _given(
    mean: FloatArray, prior: FloatArray, information: FloatArray, shift: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return mean and covariance of f and z given the factors of all moments."""
    W, b = _stacked(information, shift, mean.shape[-1])
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
