"""What the stated probabilities are worth: proper scoring rules, calibration, comparison.

Honest probabilities score best.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class LogScore:
    """Log score (Good, J. R. Stat. Soc. B 1952): minus the log probability of the truth.

    Attributes:
        nats: Log score of each run, (run,) [nats]; infinite where the truth was given
            no probability at all. Nothing is floored.
    """

    nats: FloatArray

    @property
    def mean(self) -> float:
        """Mean [nats a run]; infinite if any run is."""
        return float(np.mean(self.nats))

    @property
    def impossible(self) -> int:
        """Number of runs whose truth was given no probability."""
        return int(np.isinf(self.nats).sum())

    @property
    def mean_of_rest(self) -> float:
        """Mean over the runs whose truth was thought possible [nats a run]; NaN if there are none.

        Never a score by itself: it leaves out the worst runs.
        """
        rest = self.nats[np.isfinite(self.nats)]
        return float(np.mean(rest)) if rest.size else float("nan")


def log_score(truth: Sequence[str], posterior: Sequence[Mapping[str, float]]) -> LogScore:
    """Return the log score of each run; a truth that is not in its posterior has no probability."""
    chance = np.array([p.get(t, 0.0) for p, t in zip(posterior, truth, strict=True)])
    with np.errstate(divide="ignore"):  # no probability: an infinite score, as it should be
        return LogScore(-np.log(chance) + 0.0)  # + 0.0: certainty is 0, not -0


def brier_score(truth: Sequence[str], posterior: Sequence[Mapping[str, float]]) -> FloatArray:
    """Return the Brier score of each run: sum over hypotheses of (probability - truth)^2.

    The original form for several classes (Brier, Monthly Weather Review 1950): 0 is perfect, 2 is
    certainty of something wrong. A truth that no hypothesis stands for adds 1.
    """
    return np.array(
        [
            sum((chance - (name == true)) ** 2 for name, chance in p.items()) + (true not in p)
            for p, true in zip(posterior, truth, strict=True)
        ],
        dtype=np.float64,
    )


# Does a stated probability happen as often as it says? Reliability and calibration error.

DRAWS = 1000
"""Sets of answers drawn from a method that means what it says."""


@dataclass(frozen=True)
class Reliability:
    """Reliability diagram of the most probable hypothesis.

    A bin holds the runs with low < confidence <= high; the first holds its lower edge too.

    Attributes:
        edges: Edges of the bins, (bins + 1,).
        count: Runs of each bin, (bins,).
        right: Runs of each bin that were diagnosed right, (bins,).
        confidence: Mean stated probability of each bin, (bins,); NaN where it is empty.
    """

    edges: FloatArray
    count: IntArray
    right: IntArray
    confidence: FloatArray

    @property
    def error(self) -> float:
        """Expected calibration error: mean over runs of their bin's |right share - confidence|.

        Naeini et al., AAAI 2015; Guo et al., ICML 2017.
        """
        filled = self.count > 0
        gap = np.abs(self.right[filled] - self.count[filled] * self.confidence[filled])
        return float(gap.sum() / self.count.sum())


def equal_edges(bins: int = 10) -> FloatArray:
    """Return the edges of `bins` bins of equal width from 0 to 1.

    Raises:
        InputError: If there is not one bin at least.
    """
    if bins < 1:
        raise InputError(f"there are {bins} bins, expected 1 or more.")
    return np.linspace(0.0, 1.0, bins + 1)


def adaptive_edges(confidence: FloatArray, bins: int = 10) -> FloatArray:
    """Return edges between which about as many runs lie in each bin (Nixon et al., CVPR 2019).

    Edges lie midway between runs. Runs of equal confidence stay together, so there may be fewer
    bins than asked for, and some may be empty.

    Raises:
        InputError: If there is not one bin and one run at least.
    """
    _check_confidence(confidence)
    ordered, sections = np.sort(confidence), min(len(equal_edges(bins)) - 1, len(confidence))
    first = np.ceil(np.arange(1, sections) * len(ordered) / sections).astype(np.int64)
    between = (ordered[first - 1] + ordered[first]) / 2  # no edge lies on a run, but for ties
    return np.r_[0.0, np.unique(between), 1.0]


def reliability(confidence: FloatArray, right: BoolArray, edges: FloatArray) -> Reliability:
    """Sort runs by the probability of their verdict, (run,), and count how often it is right.

    The edges of the bins, (bins + 1,), increase and enclose every confidence.

    Raises:
        InputError: If there are no runs, a confidence is not within 0 to 1 or beyond the edges.
    """
    _check_confidence(confidence)
    if confidence.min() < edges[0] or confidence.max() > edges[-1]:
        raise InputError(
            f"confidence runs from {confidence.min():g} to {confidence.max():g}, beyond the edges "
            f"{edges[0]:g} to {edges[-1]:g}. Use equal_edges() or adaptive_edges()."
        )
    inside = _bin_of(confidence, edges)
    bins = len(edges) - 1
    count = np.bincount(inside, minlength=bins)
    total = np.bincount(inside, weights=confidence, minlength=bins)
    mean = np.full(bins, np.nan)
    np.divide(total, count, out=mean, where=count > 0)
    return Reliability(edges, count, np.bincount(inside[right], minlength=bins), mean)


def calibrated_error(
    confidence: FloatArray, edges: FloatArray, rng: np.random.Generator, draws: int = DRAWS
) -> FloatArray:
    """Return the calibration errors that a perfectly calibrated method would show by chance.

    With few runs the error is well above 0 even where every probability is true; compare with
    these (consistency resampling, Broecker & Smith, Weather and Forecasting 2007). The stated
    probabilities, (run,), are taken to be true; the error is that of each set of answers, (draws,).
    """
    _check_confidence(confidence)
    inside, runs = _bin_of(confidence, edges), len(confidence)
    order = np.argsort(inside, kind="stable")
    first, stated = np.flatnonzero(np.diff(inside[order], prepend=-1)), confidence[order]
    surplus = ((rng.random(runs) < stated) - stated for _ in range(draws))
    return np.array([np.abs(np.add.reduceat(s, first)).sum() / runs for s in surplus])


def _bin_of(confidence: FloatArray, edges: FloatArray) -> IntArray:
    return np.searchsorted(edges[1:-1], confidence, side="left").astype(np.int64)


def _check_confidence(confidence: FloatArray) -> None:
    if confidence.size == 0:
        raise InputError("there are no runs. Expected the confidence of one at least.")
    if not np.all((confidence >= 0.0) & (confidence <= 1.0)):
        raise InputError("confidence holds values outside 0 to 1. Expected probabilities.")


# Simulation-based calibration: is the truth a typical draw from its posterior?

BINS = 20
"""Most bins of the chi-squared test."""
POINTS = 50
"""Most ranks at which the distribution is compared with its band."""
NULL_DRAWS = 2000
"""Sets of uniform ranks that the band is made of."""
LEVEL = 0.95
"""Chance of uniform ranks to stay within the band everywhere."""


@dataclass(frozen=True)
class RankCheck:
    """Whether ranks are uniform: whether their distribution keeps to a band.

    Uniform ranks leave the band nowhere, at the level `LEVEL` (Saeilynoja, Buerkner and Vehtari,
    Statistics and Computing 2022): binomial intervals at each point, widened together until the
    chance of leaving any of them is right.

    Attributes:
        count: Runs in each bin of the chi-squared test, (bin,).
        expected: Runs expected there, (bin,).
        chi2_p: Chance of a chi-squared as large, if ranks were uniform.
        rank: Share of all ranks up to the point, (point,).
        ecdf: Share of runs with a rank up to there, (point,).
        low: Lower edge of the band, (point,).
        high: Upper edge of the band, (point,).
        band_p: Chance of uniform ranks to leave their narrowest band as far.
    """

    count: IntArray
    expected: FloatArray
    chi2_p: float
    rank: FloatArray
    ecdf: FloatArray
    low: FloatArray
    high: FloatArray
    band_p: float

    @property
    def uniform(self) -> bool:
        """True where the distribution stays within the band."""
        return bool(((self.low <= self.ecdf) & (self.ecdf <= self.high)).all())


def rank_of_truth(draws: FloatArray, truth: FloatArray, rng: np.random.Generator) -> IntArray:
    """Return how many draws lie below the truth, ties in random order, (run,) of 0..draw.

    Args:
        draws: Independent draws from the posterior of each run, (run, draw).
        truth: True value of each run, (run,).
        rng: Source of chance, for ties: a point of the posterior that has mass, such as "before
            the run", would spoil uniform ranks otherwise.
    """
    below = (draws < truth[:, None]).sum(axis=1)
    ties = (draws == truth[:, None]).sum(axis=1)
    return below + rng.integers(0, ties + 1)


def check_ranks(ranks: IntArray, draws: int, rng: np.random.Generator) -> RankCheck:
    """Check that ranks, (run,), of the truth among so many draws are uniform over 0..draws.

    Raises:
        InputError: If there are no ranks, or some are not within 0..draws.
    """
    from scipy.stats import chisquare

    if ranks.size == 0 or draws < 1 or ranks.min() < 0 or ranks.max() > draws:
        raise InputError(f"ranks do not lie within 0 to {draws}, or there are none.")
    bins = min(BINS, draws + 1)
    bin_of = np.arange(draws + 1) * bins // (draws + 1)
    count = np.bincount(bin_of[ranks], minlength=bins)
    expected = np.bincount(bin_of) * len(ranks) / (draws + 1)
    p, runs = float(chisquare(count, expected).pvalue), len(ranks)
    points = np.unique(np.linspace(0, draws - 1, min(POINTS, draws)).astype(np.int64))
    share = (points + 1) / (draws + 1)
    up_to = np.cumsum(np.bincount(ranks, minlength=draws + 1))[points]
    tail, column = _tail_table(runs, share), np.arange(len(share))
    steps = rng.multinomial(runs, np.diff(share, prepend=0.0, append=1.0), size=NULL_DRAWS)
    uniform = tail[np.cumsum(steps[:, :-1], axis=1), column].min(axis=1)
    kept = tail >= np.quantile(uniform, 1.0 - LEVEL, method="lower")
    low, high = kept.argmax(axis=0), runs - kept[::-1].argmax(axis=0)
    band_p = float(np.mean(uniform <= tail[up_to, column].min()))
    band = (share, up_to / runs, low / runs, high / runs)
    return RankCheck(count, expected, p, *band, band_p)


def _tail_table(runs: int, share: FloatArray) -> FloatArray:
    """Return the two-sided tail chance of 0..runs runs up to each point, (runs + 1, point)."""
    from scipy.stats import binom

    count = np.arange(runs + 1)[:, None]
    low, high = binom.cdf(count, runs, share), binom.sf(count - 1, runs, share)
    return np.minimum(1.0, 2.0 * np.minimum(low, high))


# Which of two methods is better on the same runs?

RESAMPLES = 10_000
"""Bootstrap samples."""
CHUNK = 1_000_000
"""Runs drawn at a time, so that memory stays small."""


@dataclass(frozen=True)
class McNemar:
    """Exact McNemar test of two methods on the same runs (McNemar, Psychometrika 1947).

    Counts the runs that both, only the first, only the second and neither got right.

    Attributes:
        p: Two-sided chance of a split of the runs on which they differ at least as uneven, if both
            methods were equally good (binomial with one half).
    """

    both: int
    first_only: int
    second_only: int
    neither: int
    p: float


@dataclass(frozen=True)
class LogScoreGain:
    """Nats a run that the second method saves; positive: the second is better.

    Attributes:
        mean: Mean over all runs of first minus second [nats a run]; infinite where one method
            alone ruled out a truth, NaN where each ruled out one that the other did not.
        finite_mean: The same over the runs whose truth neither ruled out; NaN if there are none.
        interval: 95 % bootstrap interval of `finite_mean` (percentiles; Efron 1979).
        runs: Runs behind `finite_mean`.
        first_impossible: Runs whose truth only the first method ruled out; so with the second.
        both_impossible: Runs whose truth both ruled out: no difference there.
    """

    mean: float
    finite_mean: float
    interval: tuple[float, float]
    runs: int
    first_impossible: int
    second_impossible: int
    both_impossible: int


def mcnemar(first: BoolArray, second: BoolArray) -> McNemar:
    """Compare which runs two methods got right, (run,) each.

    Raises:
        InputError: If they do not have the same runs.
    """
    from scipy.stats import binomtest

    _check_same_runs(first, second)
    only = int((first & ~second).sum()), int((second & ~first).sum())
    p = float(binomtest(only[0], sum(only)).pvalue) if sum(only) else 1.0
    return McNemar(int((first & second).sum()), *only, int((~first & ~second).sum()), p)


def log_score_gain(
    first: FloatArray, second: FloatArray, rng: np.random.Generator, draws: int = RESAMPLES
) -> LogScoreGain:
    """Compare the log scores of two methods run by run, (run,) [nats]; some may be infinite.

    The interval is of `draws` bootstrap samples.

    Raises:
        InputError: If they do not have the same runs.
    """
    _check_same_runs(first, second)
    lost_first, lost_second = np.isinf(first), np.isinf(second)
    with np.errstate(invalid="ignore"):  # infinities on both sides leave no mean
        gain = np.where(lost_first & lost_second, 0.0, first - second)
        mean = float(np.mean(gain))
    finite = gain[~(lost_first | lost_second)]
    return LogScoreGain(
        mean=mean,
        finite_mean=float(finite.mean()) if finite.size else float("nan"),
        interval=_bootstrap_interval(finite, rng, draws),
        runs=int(finite.size),
        first_impossible=int((lost_first & ~lost_second).sum()),
        second_impossible=int((lost_second & ~lost_first).sum()),
        both_impossible=int((lost_first & lost_second).sum()),
    )


def _bootstrap_interval(
    values: FloatArray, rng: np.random.Generator, draws: int
) -> tuple[float, float]:
    from scipy.stats import bootstrap

    if values.size < 2:  # nothing to draw from
        only = float(values[0]) if values.size else float("nan")
        return only, only
    found = bootstrap(
        (values,),
        np.mean,
        n_resamples=draws,
        batch=max(1, CHUNK // values.size),
        method="percentile",
        random_state=rng,
    ).confidence_interval
    return float(found.low), float(found.high)


def _check_same_runs(first: BoolArray | FloatArray, second: BoolArray | FloatArray) -> None:
    if first.shape != second.shape or first.ndim != 1 or first.size == 0:
        raise InputError(
            f"two methods are compared on the same runs; got {first.shape} and {second.shape}."
        )
