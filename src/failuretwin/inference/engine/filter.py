"""The filter: moment by moment, each an integral in the numbers of one moment.

A pick is a row of a hypothesis in one run by one component. It carries the normal distribution of
f = G theta + H z over all its moments,

    f ~ N(G mu, K),    K = G V G^T + var(z) H H^T

Moments of one movement share its outcome: what one says of it is the weight with which the next
begins. A moment m replaces its likelihood by a normal factor of f_m with information W and shift
b = W f_m + alpha (assumed-density filter). Given all factors,

    a = (I + W K)^-1 (b - W G mu),    theta | row: mu + V G^T a,  V - V G^T (I + W K)^-1 W G V

Section: docs/inference.md#filter
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from failuretwin.core.compiled import compiled
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.inference.engine.integral import Moment, Noise, log_total, moment_integral


class Tables(NamedTuple):
    """What rows say of outcomes and of f.

    Attributes:
        residual: r_a less what theta moves it by beside f, (normal, place, moment, outcome,
            channel) [m].
        scatter: J diag(s^2) J^T, (place, moment, outcome, channel, channel) [m2].
        late: J diag(u) J^T, same axes [m2]; without channels where all moments are at rest.
        extra: Variance of single motors, and of theta where outcomes differ from f, (normal, place,
            moment, outcome, channel, channel) [m2].
        log_weight: Log probability of each outcome, (weight place, moment, outcome).
        mean: G mu, (normal, place, moment, channel) [m].
        covariance: G V G^T, (normal, place, moment * channel, moment * channel) [m2].
    """

    residual: FloatArray
    scatter: FloatArray
    late: FloatArray
    extra: FloatArray
    log_weight: FloatArray
    mean: FloatArray
    covariance: FloatArray


class Places(NamedTuple):
    """Where picks stand in the tables, and what is true of each, (pick, ...).

    Attributes:
        normal: Of each pick.
        place: Of each pick.
        weight_place: Of each pick.
        variance: Factors on the variance of scatter and of uneven starts, and variance of the
            noise [m2], (pick, 3).
        usable: Moments with readings, (pick, moment).
        kept: Probability that the outcome of the moment before holds on, (pick, moment).
        lever: H, (pick, moment, channel).
        amount: var(z), (pick,).
    """

    normal: IntArray
    place: IntArray
    weight_place: IntArray
    variance: FloatArray
    usable: BoolArray
    kept: FloatArray
    lever: FloatArray
    amount: FloatArray


class RowsPosterior(NamedTuple):
    """What all moments say of some picks.

    Attributes:
        log_evidence: Log density of each moment given those before it, (pick, moment).
        alpha: What the integral of each moment says, (pick, moment, channel).
        curvature: B, (pick, moment, channel, channel).
        ahead: Mean of f without the moment, (pick, moment, channel) [m].
        doubt: Covariance of f without the moment, (pick, moment, channel, channel) [m2].
        share: Share of each outcome when its moment came, (pick, moment, outcome).
        log_weight: Log of its weight before that, (pick, moment, outcome).
        mean: Mean of f given all moments, (pick, moment, channel) [m].
        amount: Mean and variance of z given all moments, (pick, 2).
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

    @classmethod
    def zeros(cls, picks: int, moments: int, channels: int, outcomes: int) -> RowsPosterior:
        """Return a posterior to be written."""
        moment = picks, moments
        vector, matrix = (*moment, channels), (*moment, channels, channels)
        shapes = (moment, vector, matrix, vector, matrix, (*moment, outcomes))
        parts = [np.zeros(shape) for shape in shapes]
        parts += [np.full((*moment, outcomes), -np.inf), np.zeros(vector), np.zeros((picks, 2))]
        return cls(*parts)

    @property
    def total(self) -> FloatArray:
        """Log density of all moments, (pick,)."""
        return np.asarray(self.log_evidence.sum(axis=1))

    @property
    def sites(self) -> tuple[FloatArray, FloatArray]:
        """W (pick, moment, channel, channel) and b of the factors that stand for moments."""
        W, b = np.zeros(self.curvature.shape), np.zeros(self.alpha.shape)
        _write_sites(self, W, b)
        return W, b

    def some(self, picks: IntArray | slice) -> RowsPosterior:
        """Return some of the picks."""
        return RowsPosterior(*(values[picks] for values in self))

    def with_picks(self, places: IntArray, some: RowsPosterior) -> RowsPosterior:
        """Return the same with some of the picks replaced."""
        found = RowsPosterior(*(values.copy() for values in self))
        for values, new in zip(found, some, strict=True):
            values[places] = new
        return found

    @classmethod
    def joined(cls, parts: Sequence[RowsPosterior]) -> RowsPosterior:
        """Return several as one."""
        return cls(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def filter_picks(tables: Tables, picks: Places, noise: Noise) -> RowsPosterior:
    """Return what moments say of picks, one after the other."""
    count, moments, channels = picks.lever.shape
    found = RowsPosterior.zeros(count, moments, channels, tables.residual.shape[3])
    _filter(tables, picks, noise, found)
    return found


AGREE_NATS = 1.5
"""A second look at the moments counts where it moves the evidence by less: else they contradict
each other under this row, and one normal distribution does not hold what they leave open."""
LEAST_DETERMINANT = 1e-4
"""Determinant of I - K W from which the factor of a moment can be taken out of K without loss."""


def refine(tables: Tables, picks: Places, noise: Noise, found: RowsPosterior) -> RowsPosterior:
    """Return what moments say of picks, each weighed given all others (expectation propagation).

    With factors (W, b) of the moments, N_-m the distribution without that of m, and Z_m its
    integral,

        log p = sum over m of [ log Z_m - log integral of N_-m exp(-1/2 f^T W f + b^T f) ]
                + log integral of N(f; G mu, K) prod over m of exp(-1/2 f^T W f + b^T f)

    Args:
        tables: What rows say.
        picks: The picks.
        noise: The Student t of residuals.
        found: What the filter has found.
    """
    again = RowsPosterior(*(values.copy() for values in found))
    _refine(tables, picks, noise, *found.sites, again)
    agree = np.flatnonzero(np.abs(again.total - found.total) < AGREE_NATS)
    return found.with_picks(agree, again.some(agree))


@compiled
def _prior(tables: Tables, picks: Places, i: int) -> tuple[FloatArray, FloatArray]:
    """Return mean and covariance of f and, last, z."""
    n, place, variance = picks.normal[i], picks.place[i], picks.amount[i]
    known, covariance, H = tables.mean[n, place], tables.covariance[n, place], picks.lever[i]
    size, channels = covariance.shape[-1], known.shape[-1]
    mean, whole = np.zeros(size + 1), np.zeros((size + 1, size + 1))
    for a in range(size):
        mean[a] = known[a // channels, a % channels]
        whole[a, size] = whole[size, a] = variance * H[a // channels, a % channels]
    for a in range(size):
        for b in range(size):
            whole[a, b] = covariance[a, b] + whole[a, size] * H[b // channels, b % channels]
    whole[size, size] = variance
    return mean, whole


@compiled
def _write_scales(
    tables: Tables, picks: Places, i: int, m: int, log_weight: FloatArray, scale: FloatArray
) -> None:
    """Write S_a of the outcomes of one moment that are possible, (outcome, channel, channel)."""
    n, place, (factor, uneven, noise) = picks.normal[i], picks.place[i], picks.variance[i]
    scatter, late, extra = tables.scatter, tables.late, tables.extra
    outcomes, channels, _ = scale.shape
    moves = late.shape[-1] > 0
    for a in range(outcomes):
        if log_weight[a] == -np.inf:
            continue
        for c in range(channels):
            for d in range(channels):
                of_motors = factor * scatter[place, m, a, c, d]
                if moves:
                    of_motors += uneven * late[place, m, a, c, d]
                scale[a, c, d] = of_motors + extra[n, place, m, a, c, d]
            scale[a, c, c] += noise


@compiled
def _carry(found: RowsPosterior, i: int, m: int, kept: float) -> None:
    """Make the log weights of outcomes those given what the moment before said of them.

    What an outlier leaves open is as it was before.

    Args:
        found: With the weights that nothing is known of.
        i: The pick.
        m: The moment.
        kept: Probability that the outcome of the moment before holds on.
    """
    weight, share, before = (
        found.log_weight[i, m],
        found.share[i, m - 1],
        found.log_weight[i, m - 1],
    )
    total, all_before = log_total(weight), log_total(before)
    if kept == 0.0 or all_before == -np.inf:
        return
    told = 0.0
    for a in range(len(weight)):
        told += share[a]
    left = max(1.0 - told, 0.0)
    for a in range(len(weight)):
        if weight[a] == before[a] == -np.inf:
            continue
        known = share[a] + left * np.exp(before[a] - all_before)
        fresh = np.exp(weight[a] - total)
        weight[a] = np.log(kept * known + (1.0 - kept) * fresh) + total


@compiled
def _put_aside(found: RowsPosterior, i: int, m: int, f: FloatArray, whole: FloatArray) -> None:
    """Keep what is known of the numbers of a moment without it."""
    ahead, doubt = found.ahead[i, m], found.doubt[i, m]
    channels = len(ahead)
    at = m * channels
    for c in range(channels):
        ahead[c] = f[at + c]
        for d in range(channels):
            doubt[c, d] = whole[at + c, at + d]


@compiled
def _integrate(
    tables: Tables,
    picks: Places,
    noise: Noise,
    found: RowsPosterior,
    i: int,
    m: int,
    scale: FloatArray,
) -> float:
    """Write what a moment says of its numbers to `found`; return log Z. `scale` is room."""
    log_weight = found.log_weight[i, m]
    _write_scales(tables, picks, i, m, log_weight, scale)
    moment = Moment(
        tables.residual[picks.normal[i], picks.place[i], m],
        scale,
        log_weight,
        found.ahead[i, m],
        found.doubt[i, m],
    )
    return moment_integral(
        moment, noise, found.share[i, m], found.alpha[i, m], found.curvature[i, m]
    )


@compiled
def _conclude(found: RowsPosterior, i: int, f: FloatArray, whole: FloatArray) -> None:
    """Keep what is known of f and z given all moments."""
    _, moments, channels = found.mean.shape
    size = moments * channels
    for a in range(size):
        found.mean[i, a // channels, a % channels] = f[a]
    found.amount[i, 0], found.amount[i, 1] = f[size], whole[size, size]


@compiled
def _filter(tables: Tables, picks: Places, noise: Noise, found: RowsPosterior) -> None:
    """Write what moments say of picks to `found`."""
    count, moments, channels = picks.lever.shape
    outcomes = found.share.shape[-1]
    scale = np.empty((outcomes, channels, channels))
    for i in range(count):
        f, whole = _prior(tables, picks, i)
        for m in range(moments):
            for a in range(outcomes):
                found.log_weight[i, m, a] = tables.log_weight[picks.weight_place[i], m, a]
            if m and picks.kept[i, m] > 0.0:
                _carry(found, i, m, picks.kept[i, m])
                if not picks.usable[i, m]:  # leaves what was known of its movement
                    for a in range(outcomes):
                        found.share[i, m, a] = found.share[i, m - 1, a]
            if picks.usable[i, m]:
                _put_aside(found, i, m, f, whole)
                found.log_evidence[i, m] = _integrate(tables, picks, noise, found, i, m, scale)
                if np.isnan(found.log_evidence[i, m]):
                    _leave_out(found, i, m, noise)
                _take(f, whole, m * channels, found.alpha[i, m], found.curvature[i, m])
        _conclude(found, i, f, whole)


@compiled
def _leave_out(found: RowsPosterior, i: int, m: int, noise: Noise) -> None:
    """Write that a moment is an outlier: what is known of it beforehand is exact but for rounding.

    Many channels without noise leave covariances that double precision cannot hold.
    """
    found.log_evidence[i, m] = noise.log_outlier
    found.share[i, m] = 0.0
    found.alpha[i, m] = 0.0
    found.curvature[i, m] = 0.0


@compiled
def _take(f: FloatArray, whole: FloatArray, at: int, pull: FloatArray, B: FloatArray) -> None:
    """Take what a moment says of its numbers: f += K pull, K -= K B K."""
    size, channels = len(f), len(pull)
    cross = whole[at : at + channels].copy()
    for i in range(size):
        for c in range(channels):
            f[i] += cross[c, i] * pull[c]
        for c in range(channels):
            crossed = 0.0
            for d in range(channels):
                crossed += cross[d, i] * B[d, c]
            for j in range(size):
                whole[i, j] -= crossed * cross[c, j]


@compiled
def _product(A: FloatArray, B: FloatArray) -> FloatArray:
    """Return A B of small matrices, without the overhead of a library."""
    found = np.zeros((A.shape[0], B.shape[1]))
    for i in range(A.shape[0]):
        for k in range(A.shape[1]):
            for j in range(B.shape[1]):
                found[i, j] += A[i, k] * B[k, j]
    return found


@compiled
def _moved(A: FloatArray, x: FloatArray) -> FloatArray:
    """Return A x of a small matrix."""
    found = np.zeros(len(A))
    for i in range(len(A)):
        for k in range(len(x)):
            found[i] += A[i, k] * x[k]
    return found


@compiled
def _taken_by_site(
    f: FloatArray, whole: FloatArray, at: int, W: FloatArray, b: FloatArray
) -> float:
    """Multiply N(f; mean, covariance) by the factor of a moment; return the log of its integral.

    The factor is exp(-1/2 f_m^T W f_m + b^T f_m).
    """
    channels, value = len(b), 0.0
    here, pull, spread = np.empty(channels), np.empty(channels), np.empty((channels, channels))
    for c in range(channels):
        here[c] = f[at + c]
        for d in range(channels):
            spread[c, d] = whole[at + c, at + d]
    system, determinant = _inverse_beside(W, spread)
    moved = _moved(W, here)
    for c in range(channels):
        pull[c] = b[c] - moved[c]
    _take(f, whole, at, _moved(system, pull), _product(system, W))
    for c in range(channels):
        value += here[c] * (b[c] + pull[c]) + pull[c] * (f[at + c] - here[c])
    return 0.5 * (value - np.log(determinant))


@compiled
def _inverse_beside(W: FloatArray, K: FloatArray) -> tuple[FloatArray, float]:
    """Return (I + W K)^-1 and the determinant of I + W K."""
    system, found = _product(W, K), np.eye(len(W))
    for i in range(len(W)):
        system[i, i] += 1.0
    return found, _eliminate(system, found)


@compiled
def _eliminate(system: FloatArray, found: FloatArray) -> float:
    """Multiply `found` by the inverse of a matrix, by elimination with pivots.

    Returns:
        The determinant of the matrix, which becomes the identity.
    """
    size, determinant = len(system), 1.0
    for k in range(size):
        best = k
        for i in range(k + 1, size):
            if abs(system[i, k]) > abs(system[best, k]):
                best = i
        if best != k:
            determinant = -determinant
            for j in range(size):
                system[k, j], system[best, j] = system[best, j], system[k, j]
                found[k, j], found[best, j] = found[best, j], found[k, j]
        determinant *= system[k, k]
        for i in range(size):
            _subtract(system, found, i, k)
    return determinant


@compiled
def _subtract(system: FloatArray, found: FloatArray, i: int, k: int) -> None:
    """Take a row k so often from row i that column k of it is 0, or make it 1 in row k itself."""
    factor = system[i, k] / system[k, k] if i != k else 1.0 - 1.0 / system[k, k]
    for j in range(len(system)):
        system[i, j] -= factor * system[k, j]
        found[i, j] -= factor * found[k, j]


@compiled
def _made_positive(matrix: FloatArray) -> FloatArray:
    """Return a matrix as the nearest that is symmetric and not negative."""
    size = len(matrix)
    found, test = np.empty((size, size)), np.empty((size, size))
    for i in range(size):
        for j in range(size):
            found[i, j] = test[i, j] = 0.5 * (matrix[i, j] + matrix[j, i])
    if not _is_positive(test):
        values, vectors = np.linalg.eigh(found)
        for i in range(size):
            for j in range(size):
                found[i, j] = 0.0
                for k in range(size):
                    found[i, j] += vectors[i, k] * max(values[k], 0.0) * vectors[j, k]
    return found


@compiled
def _is_positive(matrix: FloatArray) -> bool:
    """Return whether a symmetric matrix, which is overwritten, is positive definite."""
    for k in range(len(matrix)):
        if not matrix[k, k] > 0.0:
            return False
        for i in range(k + 1, len(matrix)):
            for j in range(k + 1, i + 1):
                matrix[i, j] -= matrix[i, k] * matrix[j, k] / matrix[k, k]
    return True


@compiled
def _site(
    alpha: FloatArray, B: FloatArray, mean: FloatArray, K: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return W and b of the factor that stands for a moment.

        Cov[f] = (K^-1 + W)^-1    W = (I - B K)^-1 B,    b = W E[f] + alpha

    Args:
        alpha: What the moment says.
        B: The same.
        mean: m [m].
        K: Covariance of f without the moment [m2].
    """
    size = len(mean)
    negative, middle = np.empty((size, size)), _moved(K, alpha)
    for i in range(size):
        middle[i] += mean[i]
        for j in range(size):
            negative[i, j] = -B[i, j]
    W = _made_positive(_product(_inverse_beside(negative, K)[0], B))
    b = _moved(W, middle)
    for i in range(size):
        b[i] += alpha[i]
    return W, b


@compiled
def _write_site(found: RowsPosterior, i: int, m: int, W: FloatArray, b: FloatArray) -> None:
    """Write the factor that stands for a moment to W and b."""
    W_m, b_m = _site(found.alpha[i, m], found.curvature[i, m], found.ahead[i, m], found.doubt[i, m])
    for c in range(len(b)):
        b[c] = b_m[c]
        for d in range(len(b)):
            W[c, d] = W_m[c, d]


@compiled
def _write_sites(found: RowsPosterior, W: FloatArray, b: FloatArray) -> None:
    for i in range(len(W)):
        for m in range(W.shape[1]):
            _write_site(found, i, m, W[i, m], b[i, m])


@compiled
def _take_out(found: RowsPosterior, i: int, m: int, W: FloatArray, b: FloatArray) -> bool:
    """Take the factor of a moment out of what is known of its numbers with it.

    Returns:
        Whether that is accurate: all is lost by rounding if hardly anything else tells of them.
    """
    channels = len(b)
    spread, here, negative = found.doubt[i, m], found.ahead[i, m], np.empty((channels, channels))
    pull = _moved(W, here)
    for c in range(channels):
        pull[c] = b[c] - pull[c]
        for d in range(channels):
            negative[c, d] = -W[c, d]
    inverse, determinant = _inverse_beside(spread, negative)
    doubt = _made_positive(_product(inverse, spread))
    moved = _moved(doubt, pull)
    for c in range(channels):
        here[c] -= moved[c]
        for d in range(channels):
            spread[c, d] = doubt[c, d]
    return determinant > LEAST_DETERMINANT


@compiled
def _given_others(
    tables: Tables, picks: Places, i: int, m: int, W: FloatArray, b: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return mean and covariance of f and z given the factors of all moments but one."""
    f, whole = _prior(tables, picks, i)
    for k in range(len(b)):
        if k != m:
            _taken_by_site(f, whole, k * b.shape[1], W[k], b[k])
    return f, whole


@compiled
def _exchange(
    found: RowsPosterior,
    i: int,
    m: int,
    f: FloatArray,
    whole: FloatArray,
    W: FloatArray,
    b: FloatArray,
) -> float:
    """Put a new factor of a moment in the place of the one before, in f and in W and b.

    Returns:
        The log integral of the new factor over its numbers without it.
    """
    channels = len(b)
    more, pull = np.empty((channels, channels)), np.empty(channels)
    mean, covariance = np.empty(channels), np.empty((channels, channels))
    for c in range(channels):
        pull[c], mean[c] = -b[c], found.ahead[i, m, c]
        for d in range(channels):
            more[c, d], covariance[c, d] = -W[c, d], found.doubt[i, m, c, d]
    _write_site(found, i, m, W, b)
    for c in range(channels):
        pull[c] += b[c]
        for d in range(channels):
            more[c, d] += W[c, d]
    _taken_by_site(f, whole, m * channels, more, pull)
    return _taken_by_site(mean, covariance, 0, W, b)


@compiled
def _refine(
    tables: Tables, picks: Places, noise: Noise, W: FloatArray, b: FloatArray, found: RowsPosterior
) -> None:
    """Write what each moment says given all others to `found`; W and b are written too."""
    count, moments, channels = picks.lever.shape
    scale = np.empty((found.share.shape[-1], channels, channels))
    for i in range(count):
        f, whole = _prior(tables, picks, i)
        for m in range(moments):
            _taken_by_site(f, whole, m * channels, W[i, m], b[i, m])
        gained = 0.0
        for m in range(moments):
            gained -= found.log_evidence[i, m]
            if picks.usable[i, m]:
                _put_aside(found, i, m, f, whole)
                if not _take_out(found, i, m, W[i, m], b[i, m]):
                    mean, covariance = _given_others(tables, picks, i, m, W[i], b[i])
                    _put_aside(found, i, m, mean, covariance)
                gained += _integrate(tables, picks, noise, found, i, m, scale)
                gained -= _exchange(found, i, m, f, whole, W[i, m], b[i, m])
        f, whole = _prior(tables, picks, i)
        for m in range(moments):
            gained += _taken_by_site(f, whole, m * channels, W[i, m], b[i, m])
        _conclude(found, i, f, whole)
        for m in range(moments):
            found.log_evidence[i, m] += gained / moments
