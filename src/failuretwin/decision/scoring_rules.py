"""Proper scoring rules, calibration of probabilities, and comparison of two methods."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class LogScore:
    """Log score: minus the log probability of the truth (Good, J. R. Stat. Soc. B 1952).

    `nats` are those of each run, (run,); infinite where the truth has probability 0. No floor.
    """

    nats: FloatArray

    @property
    def mean(self) -> float:
        """Mean [nats per run]; infinite if any run is."""
        return float(np.mean(self.nats))

    @property
    def impossible(self) -> int:
        """Number of runs whose truth has probability 0."""
        return int(np.isinf(self.nats).sum())

    @property
    def mean_of_rest(self) -> float:
        """Mean over the other runs [nats per run]; NaN if there are none."""
        rest = self.nats[np.isfinite(self.nats)]
        return float(np.mean(rest)) if rest.size else float("nan")


def log_score(truth: Sequence[str], posterior: Sequence[Mapping[str, float]]) -> LogScore:
    """Return the log score of each run; a truth missing from its posterior has probability 0."""
    chance = np.array([p.get(t, 0.0) for p, t in zip(posterior, truth, strict=True)])
    with np.errstate(divide="ignore"):
        return LogScore(-np.log(chance) + 0.0)  # + 0.0 turns -0 into 0


def brier_score(truth: Sequence[str], posterior: Sequence[Mapping[str, float]]) -> FloatArray:
    """Return the Brier score of each run, sum over hypotheses of (probability - truth)^2.

    0 is perfect, 2 is the worst (Brier, Monthly Weather Review 1950). A truth missing from its
    posterior adds 1.
    """
    pairs = list(zip(posterior, truth, strict=True))
    squares = [sum((c - (name == true)) ** 2 for name, c in p.items()) for p, true in pairs]
    return np.array(squares) + [true not in p for p, true in pairs]


# Reliability and calibration error.

EQUAL_EDGES = np.linspace(0.0, 1.0, 11)
"""Edges of ten bins of equal width."""
ADAPTIVE_BINS = 10
DRAWS = 1000
"""Simulated sets of answers behind the calibration error by chance."""


@dataclass(frozen=True)
class Reliability:
    """Reliability diagram: runs in bins of stated probability, low < probability <= high.

    Attributes:
        edges: Edges of the bins, (bins + 1,).
        count: Runs of each bin, (bins,).
        right: Correctly diagnosed runs of each bin, (bins,).
        confidence: Mean stated probability of each bin, (bins,); NaN where empty.
    """

    edges: FloatArray
    count: IntArray
    right: IntArray
    confidence: FloatArray

    @property
    def error(self) -> float:
        """Expected calibration error (Naeini et al., AAAI 2015; Guo et al., ICML 2017)."""
        gap = np.abs(self.right - self.count * np.nan_to_num(self.confidence))
        return float(gap.sum() / self.count.sum())


def adaptive_edges(confidence: FloatArray) -> FloatArray:
    """Return edges of bins of about equal counts (Nixon et al., CVPR 2019).

    Edges lie midway between runs; ties share a bin, so there may be fewer than `ADAPTIVE_BINS`.
    """
    ordered, bins = np.sort(confidence), min(ADAPTIVE_BINS, len(confidence))
    first = np.ceil(np.arange(1, bins) * len(ordered) / bins).astype(np.int64)
    between = (ordered[first - 1] + ordered[first]) / 2
    return np.r_[0.0, np.unique(between), 1.0]


def reliability(
    confidence: FloatArray, right: BoolArray, edges: FloatArray = EQUAL_EDGES
) -> Reliability:
    """Return the reliability diagram of stated probabilities and whether each was right, (run,).

    Raises:
        InputError: If there are no runs or a value is not a probability.
    """
    if not confidence.size or not np.all((confidence >= 0.0) & (confidence <= 1.0)):
        raise InputError("expected the stated probability of at least one run, within 0 to 1.")
    inside, bins = np.searchsorted(edges[1:-1], confidence, side="left"), len(edges) - 1
    count = np.bincount(inside, minlength=bins)
    total = np.bincount(inside, weights=confidence, minlength=bins)
    mean = np.full(bins, np.nan)
    np.divide(total, count, out=mean, where=count > 0)
    return Reliability(edges, count, np.bincount(inside[right], minlength=bins), mean)


def calibrated_error(
    confidence: FloatArray, rng: np.random.Generator, draws: int = DRAWS
) -> FloatArray:
    """Return calibration errors of a perfectly calibrated method, (draws,), in equal bins.

    Answers are drawn from the stated probabilities, (run,) (consistency resampling: Broecker &
    Smith, Weather and Forecasting 2007).
    """
    runs = len(confidence)
    drawn = (rng.random(runs) < confidence for _ in range(draws))
    return np.array([reliability(confidence, right).error for right in drawn])


# Simulation-based calibration: rank of the truth among posterior draws.

RANK_BINS = 20


@dataclass(frozen=True)
class RankCheck:
    """Tests whether ranks are uniform.

    Attributes:
        count: Runs in each bin, (bin,).
        expected: Expected runs in each bin, (bin,).
        chi2_p: P value of the chi-squared test over the bins.
        ks_p: P value of the Kolmogorov-Smirnov test; ties broken at random.
    """

    count: IntArray
    expected: FloatArray
    chi2_p: float
    ks_p: float


def rank_of_truth(draws: FloatArray, truth: FloatArray, rng: np.random.Generator) -> IntArray:
    """Return the number of posterior draws below the truth, (run,), ties broken at random.

    Takes independent draws (run, draw) and true values (run,). Without random ties a point mass,
    such as an onset before the run, would make the ranks non-uniform.
    """
    below = (draws < truth[:, None]).sum(axis=1)
    ties = (draws == truth[:, None]).sum(axis=1)
    return below + rng.integers(0, ties + 1)


def check_ranks(ranks: IntArray, draws: int, rng: np.random.Generator) -> RankCheck:
    """Test whether ranks, (run,), are uniform over 0..draws (Talts et al. 2018).

    Raises:
        InputError: If there are no ranks, or some are not within 0..draws.
    """
    from scipy.stats import chisquare, kstest

    if ranks.size == 0 or draws < 1 or ranks.min() < 0 or ranks.max() > draws:
        raise InputError(f"ranks do not lie within 0 to {draws}, or there are none.")
    bins = min(RANK_BINS, draws + 1)
    bin_of = np.arange(draws + 1) * bins // (draws + 1)
    count = np.bincount(bin_of[ranks], minlength=bins)
    expected = np.bincount(bin_of) * len(ranks) / (draws + 1)
    spread = (ranks + rng.random(len(ranks))) / (draws + 1)
    chi2_p, ks_p = chisquare(count, expected).pvalue, kstest(spread, "uniform").pvalue
    return RankCheck(count, expected, float(chi2_p), float(ks_p))


# Two methods on the same runs.

RESAMPLES = 10_000
"""Bootstrap samples."""
BATCH = 100
"""Bootstrap samples in memory at a time."""


@dataclass(frozen=True)
class McNemar:
    """Exact McNemar test (McNemar, Psychometrika 1947).

    Attributes:
        both: Runs that both methods got right.
        first_only: Runs that only the first got right.
        second_only: Runs that only the second got right.
        neither: Runs that neither got right.
        p: Two-sided binomial probability of a split at least as uneven.
    """

    both: int
    first_only: int
    second_only: int
    neither: int
    p: float


@dataclass(frozen=True)
class LogScoreGain:
    """Log score of the first method minus that of the second; positive: the second is better.

    Attributes:
        mean: Mean over all runs [nats per run]; infinite if only one method gave a truth
            probability 0, NaN if each did so in a different run.
        finite_mean: Mean over the runs whose truth both gave a probability; NaN if there are none.
        interval: 95 % bootstrap percentile interval of `finite_mean` (Efron 1979).
        runs: Runs behind `finite_mean`.
        first_impossible: Runs whose truth only the first method gave probability 0.
        second_impossible: The same for the second method.
        both_impossible: Runs whose truth both gave probability 0; they count as no difference.
    """

    mean: float
    finite_mean: float
    interval: tuple[float, float]
    runs: int
    first_impossible: int
    second_impossible: int
    both_impossible: int


def mcnemar(first: BoolArray, second: BoolArray) -> McNemar:
    """Compare which of the same runs two methods got right, (run,) each."""
    from scipy.stats import binomtest

    cells = (first & second, first & ~second, second & ~first, ~first & ~second)
    both, first_only, second_only, neither = (int(cell.sum()) for cell in cells)
    differ = first_only + second_only
    p = float(binomtest(first_only, differ).pvalue) if differ else 1.0
    return McNemar(both, first_only, second_only, neither, p)


def log_score_gain(
    first: FloatArray, second: FloatArray, rng: np.random.Generator, draws: int = RESAMPLES
) -> LogScoreGain:
    """Compare the log scores of two methods on the same runs, (run,) [nats]."""
    lost_first, lost_second = np.isinf(first), np.isinf(second)
    with np.errstate(invalid="ignore"):  # infinities of both signs have no mean
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

    if values.size < 2:
        only = float(values[0]) if values.size else float("nan")
        return only, only
    found = bootstrap(
        (values,), np.mean, n_resamples=draws, batch=BATCH, method="percentile", random_state=rng
    ).confidence_interval
    return float(found.low), float(found.high)
