"""Simulation-based calibration: the rank of the truth among posterior draws (Talts et al. 2018)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chisquare, kstest

from failuretwin.core.errors import InputError
from failuretwin.core.types import FloatArray, IntArray

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
    """Test whether ranks, (run,), are uniform over 0..draws.

    Raises:
        InputError: If there are no ranks, or some are not within 0..draws.
    """
    if ranks.size == 0 or draws < 1 or ranks.min() < 0 or ranks.max() > draws:
        raise InputError(f"ranks do not lie within 0 to {draws}, or there are none.")
    bins = min(RANK_BINS, draws + 1)
    bin_of = np.arange(draws + 1) * bins // (draws + 1)
    count = np.bincount(bin_of[ranks], minlength=bins)
    expected = np.bincount(bin_of) * len(ranks) / (draws + 1)
    spread = (ranks + rng.random(len(ranks))) / (draws + 1)
    chi2_p, ks_p = chisquare(count, expected).pvalue, kstest(spread, "uniform").pvalue
    return RankCheck(count, expected, float(chi2_p), float(ks_p))
