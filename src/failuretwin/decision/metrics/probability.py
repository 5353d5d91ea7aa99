"""Proper scores: what the stated probabilities are worth. Honest probabilities score best."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class LogScore:
    """Log score (Good, J. R. Stat. Soc. B 1952): minus the log probability of the truth.

    Attributes:
        nats: Surprise at the truth of each run, (run,) [nats]; infinite where the truth was given
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
    """Return the log score of each run.

    Args:
        truth: True hypothesis of each run.
        posterior: Probabilities of each run; a truth that is not among them has none.
    """
    chance = np.array([p.get(t, 0.0) for p, t in zip(posterior, truth, strict=True)])
    with np.errstate(divide="ignore"):  # no probability: an infinite surprise, as it should be
        return LogScore(-np.log(chance) + 0.0)  # + 0.0: no surprise is 0, not -0


def brier_score(truth: Sequence[str], posterior: Sequence[Mapping[str, float]]) -> FloatArray:
    """Return the Brier score of each run: sum over hypotheses of (probability - truth)^2.

    The original form for several classes (Brier, Monthly Weather Review 1950): 0 is perfect, 2 is
    certainty of something wrong. A truth that no hypothesis stands for adds 1.

    Args:
        truth: True hypothesis of each run.
        posterior: Probabilities of each run.
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
    bins, and some may be empty.

    Args:
        confidence: Stated probability of each run, (run,).
        bins: Most bins to make.

    Raises:
        InputError: If there is not one bin and one run at least.
    """
    _check_confidence(confidence)
    ordered, sections = np.sort(confidence), min(len(equal_edges(bins)) - 1, len(confidence))
    first = np.ceil(np.arange(1, sections) * len(ordered) / sections).astype(np.int64)
    between = (ordered[first - 1] + ordered[first]) / 2  # no edge lies on a run, but for ties
    return np.r_[0.0, np.unique(between), 1.0]


def reliability(confidence: FloatArray, right: BoolArray, edges: FloatArray) -> Reliability:
    """Sort runs into bins of confidence and count how often they are right.

    Args:
        confidence: Probability of the most probable hypothesis, (run,).
        right: Whether that is the truth, (run,).
        edges: Increasing edges that enclose every confidence, (bins + 1,).

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
    these (consistency resampling, Broecker & Smith, Weather and Forecasting 2007).

    Args:
        confidence: Stated probability of each run, (run,); taken to be true.
        edges: Edges of the bins, as for `reliability`.
        rng: Source of chance.
        draws: How many sets of answers to draw.

    Returns:
        Expected calibration error of each set, (draws,).
    """
    _check_confidence(confidence)
    inside = _bin_of(confidence, edges)
    order = np.argsort(inside, kind="stable")
    first = np.flatnonzero(np.diff(inside[order], prepend=-1))
    sorted_confidence = confidence[order]
    errors = np.empty(draws)
    for i in range(draws):
        surplus = (rng.random(len(confidence)) < sorted_confidence) - sorted_confidence
        errors[i] = np.abs(np.add.reduceat(surplus, first)).sum() / len(confidence)
    return errors


def _bin_of(confidence: FloatArray, edges: FloatArray) -> IntArray:
    return np.searchsorted(edges[1:-1], confidence, side="left").astype(np.int64)


def _check_confidence(confidence: FloatArray) -> None:
    if confidence.size == 0:
        raise InputError("there are no runs. Expected the confidence of one at least.")
    if not np.all((confidence >= 0.0) & (confidence <= 1.0)):
        raise InputError("confidence holds values outside 0 to 1. Expected probabilities.")


# Shares of runs, with the interval that so few runs allow.

Z_95 = 1.959963984540054
"""Two-sided 95 % point of the normal distribution."""


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Return the Wilson 95 % interval of a share (Wilson, JASA 1927)."""
    if trials == 0:
        return 0.0, 1.0
    share, z2 = successes / trials, Z_95**2
    centre = (share + z2 / (2 * trials)) / (1 + z2 / trials)
    spread = math.sqrt(share * (1 - share) / trials + z2 / (4 * trials**2))
    half = Z_95 * spread / (1 + z2 / trials)
    return max(0.0, centre - half), min(1.0, centre + half)


@dataclass(frozen=True)
class Share:
    """So many of so many.

    Attributes:
        count: How many.
        total: Of how many.
    """

    count: int
    total: int

    @property
    def value(self) -> float:
        """The share; NaN of nothing."""
        return self.count / self.total if self.total else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson 95 % interval; everything where there is nothing."""
        return wilson_interval(self.count, self.total)


# Do 90 % intervals hold the truth in 90 % of the runs?


@dataclass(frozen=True)
class IntervalCase:
    """An interval and the truth that it should hold.

    Attributes:
        mode: Fault mode that it is about.
        quantity: What is estimated, such as ``"onset"``.
        low: Lower end, in the unit of the quantity.
        high: Upper end, in the same unit.
        truth: True value, in the same unit.
    """

    mode: str
    quantity: str
    low: float
    high: float
    truth: float


@dataclass(frozen=True)
class Coverage:
    """How often the intervals of one quantity hold the truth; ends count as inside.

    Attributes:
        mode: Fault mode.
        quantity: What is estimated.
        inside: Intervals that hold the truth, of all.
        below: Truths below their interval.
        above: Truths above their interval.
        points: Intervals without width: told or assumed rather than estimated.
    """

    mode: str
    quantity: str
    inside: Share
    below: int
    above: int
    points: int


def coverage_by_mode(cases: Iterable[IntervalCase]) -> list[Coverage]:
    """Return the coverage of each quantity of each fault mode, in order of appearance.

    Give the runs whose fault was diagnosed right: an interval says where the value lies *if* the
    diagnosis holds, and choosing runs by what the data say does not change its coverage.
    """
    groups: dict[tuple[str, str], list[IntervalCase]] = {}
    for case in cases:
        groups.setdefault((case.mode, case.quantity), []).append(case)
    return [_coverage(*key, group) for key, group in groups.items()]


def _coverage(mode: str, quantity: str, cases: list[IntervalCase]) -> Coverage:
    below = sum(case.truth < case.low for case in cases)
    above = sum(case.truth > case.high for case in cases)
    inside = Share(len(cases) - below - above, len(cases))
    points = sum(case.low == case.high for case in cases)
    return Coverage(mode, quantity, inside, below, above, points)


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
class EcdfBand:
    """Band that the distribution of uniform ranks leaves nowhere, at the level `LEVEL`.

    Saeilynoja, Buerkner and Vehtari, Statistics and Computing 2022: binomial intervals at each
    point, widened together until the chance of leaving any of them is right.

    Attributes:
        rank: Share of all ranks up to the point, (point,).
        ecdf: Share of runs with a rank up to there, (point,).
        low: Lower edge of the band, (point,).
        high: Upper edge of the band, (point,).
    """

    rank: FloatArray
    ecdf: FloatArray
    low: FloatArray
    high: FloatArray


@dataclass(frozen=True)
class RankCheck:
    """Whether ranks are uniform.

    Attributes:
        count: Runs in each bin of the chi-squared test, (bin,).
        expected: Runs expected there, (bin,).
        chi2_p: Chance of a chi-squared as large, if ranks were uniform.
        band: The distribution of the ranks and the band that it should keep to.
        band_p: Chance of uniform ranks to leave their narrowest band as far.
    """

    count: IntArray
    expected: FloatArray
    chi2_p: float
    band: EcdfBand
    band_p: float

    @property
    def uniform(self) -> bool:
        """True where the distribution stays within the band."""
        inside = (self.band.low <= self.band.ecdf) & (self.band.ecdf <= self.band.high)
        return bool(inside.all())


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
    """Check that ranks are uniform over 0..draws.

    Args:
        ranks: Rank of the truth of each run, (run,).
        draws: How many draws each truth was ranked among.
        rng: Source of chance, for the band.

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
    band, band_p = _ecdf_band(ranks, draws, rng)
    return RankCheck(count, expected, float(chisquare(count, expected).pvalue), band, band_p)


def _ecdf_band(ranks: IntArray, draws: int, rng: np.random.Generator) -> tuple[EcdfBand, float]:
    runs = len(ranks)
    points = np.unique(np.linspace(0, draws - 1, min(POINTS, draws)).astype(np.int64))
    share = (points + 1) / (draws + 1)
    count = np.cumsum(np.bincount(ranks, minlength=draws + 1))[points]
    tail, column = _tail_table(runs, share), np.arange(len(share))
    steps = rng.multinomial(runs, np.diff(share, prepend=0.0, append=1.0), size=NULL_DRAWS)
    uniform = tail[np.cumsum(steps[:, :-1], axis=1), column].min(axis=1)
    kept = tail >= np.quantile(uniform, 1.0 - LEVEL, method="lower")
    low, high = kept.argmax(axis=0), runs - kept[::-1].argmax(axis=0)
    band = EcdfBand(share, count / runs, low / runs, high / runs)
    return band, float(np.mean(uniform <= tail[count, column].min()))


def _tail_table(runs: int, share: FloatArray) -> FloatArray:
    """Return the two-sided tail chance of 0..runs runs up to each point, (runs + 1, point)."""
    from scipy.stats import binom

    count = np.arange(runs + 1)[:, None]
    low, high = binom.cdf(count, runs, share), binom.sf(count - 1, runs, share)
    return np.minimum(1.0, 2.0 * np.minimum(low, high))
