"""Simulation-based calibration: is the truth a typical draw from its posterior?

If the truth is drawn from the prior and the run from the twin, its rank among draws from its
posterior is uniform (Talts et al., arXiv 1804.06788). Ranks that heap up in the middle mean
posteriors too wide, at both ends too narrow, at one end biased.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.types import FloatArray, IntArray

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
