from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy.stats import bootstrap

from failuretwin.core.errors import InputError
from failuretwin.decision.scoring_rules import log_score_gain, mcnemar


@pytest.mark.parametrize("only_first", range(9))
def test_mcnemar_counts_every_equally_likely_split(only_first):
    """Brute force: 8 runs on which the methods differ, 256 ways to share them out."""
    first = np.arange(8) < only_first
    ways = [sum(way) for way in product((0, 1), repeat=8)]
    uneven = sum(abs(way - 4) >= abs(only_first - 4) for way in ways)
    test = mcnemar(np.r_[first, True, True, False], np.r_[~first, True, True, False])
    assert test.p == pytest.approx(uneven / 256)
    assert (test.both, test.neither) == (2, 1)
    assert (test.first_only, test.second_only) == (only_first, 8 - only_first)


def test_methods_that_never_differ_are_as_good():
    assert mcnemar(np.ones(5, dtype=bool), np.ones(5, dtype=bool)).p == 1.0


def test_bootstrap_interval_is_that_of_scipy():
    rng = np.random.default_rng(0)
    first, second = rng.exponential(size=90), rng.exponential(size=90)
    ours = log_score_gain(first, second, np.random.default_rng(1))
    compute_posterior = bootstrap(
        (first - second,), np.mean, n_resamples=10_000, method="percentile", rng=rng
    ).confidence_interval
    np.testing.assert_allclose(
        ours.interval, (compute_posterior.low, compute_posterior.high), atol=0.01
    )
    assert ours.mean == ours.finite_mean == pytest.approx(np.mean(first) - np.mean(second))
    assert ours.runs == 90


def test_bootstrap_interval_covers_as_often_as_it_says():
    rng = np.random.default_rng(2)
    held = 0
    for _ in range(400):
        gain = 0.3 + rng.normal(size=100)
        low, high = log_score_gain(gain, np.zeros(100), rng, draws=500).interval
        held += low <= 0.3 <= high
    assert 0.91 < held / 400 < 0.98


def test_truths_that_were_ruled_out_are_told_apart():
    inf = np.inf
    first, second = np.array([1.0, inf, inf, 2.0]), np.array([0.5, 1.0, inf, 1.0])
    gain = log_score_gain(first, second, np.random.default_rng(0))
    assert gain.mean == inf
    assert gain.finite_mean == pytest.approx(0.75)
    assert (gain.runs, gain.first_impossible, gain.both_impossible) == (2, 1, 1)
    assert gain.second_impossible == 0
    other = log_score_gain(second, first, np.random.default_rng(0))
    assert (other.mean, other.finite_mean) == (-inf, -gain.finite_mean)


def test_methods_that_each_rule_out_a_truth_cannot_be_ordered():
    gain = log_score_gain(
        np.array([np.inf, 1.0]), np.array([1.0, np.inf]), np.random.default_rng(0)
    )
    assert gain.runs == 0
    assert np.isnan([gain.mean, gain.finite_mean, *gain.interval]).all()


@pytest.mark.parametrize("count", [0, 3])
def test_other_runs_cannot_be_compared(count):
    with pytest.raises(InputError, match="same runs"):
        mcnemar(np.ones(count, dtype=bool), np.ones(2 * count, dtype=bool))
    with pytest.raises(InputError, match="same runs"):
        log_score_gain(np.ones(count), np.ones(2 * count), np.random.default_rng(0))
