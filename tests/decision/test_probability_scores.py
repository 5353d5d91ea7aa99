"""Scores of probabilities and comparisons, judged against scikit-learn, scipy and closed forms."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import bootstrap
from sklearn.calibration import calibration_curve
from sklearn.metrics import brier_score_loss, log_loss

from failuretwin.core.errors import InputError
from failuretwin.decision.scoring import (
    adaptive_edges,
    brier_score,
    calibrated_error,
    log_score,
    log_score_gain,
    mcnemar,
    reliability,
)

NAMES = ("a", "b", "c", "d")


@pytest.fixture
def forecasts():
    """Probabilities of 200 runs, as an array and by name, and the truth drawn from them."""
    rng = np.random.default_rng(4)
    chance = rng.dirichlet(np.full(4, 0.7), size=200)
    truth = [NAMES[rng.choice(4, p=p)] for p in chance]
    return chance, [dict(zip(NAMES, map(float, p), strict=True)) for p in chance], truth


def test_log_score_is_the_log_loss_of_scikit_learn(forecasts):
    chance, posterior, truth = forecasts
    assert log_score(truth, posterior).mean() == pytest.approx(log_loss(truth, chance))


def test_brier_score_is_that_of_scikit_learn(forecasts):
    chance, posterior, truth = forecasts
    expected = brier_score_loss(truth, chance, labels=NAMES, scale_by_half=False)
    assert brier_score(truth, posterior).mean() == pytest.approx(expected)


def test_ends_of_the_scales():
    certain = {"a": 1.0, "b": 0.0}
    assert brier_score(["a", "b", "c"], [certain] * 3).tolist() == [0.0, 2.0, 2.0]
    assert log_score(["a", "b", "c"], [certain] * 3).tolist() == [0.0, np.inf, np.inf]
    assert not np.signbit(log_score(["a"], [certain])[0])


@pytest.mark.parametrize("rule", [brier_score, log_score])
def test_honest_probabilities_score_best_on_average(rule):
    honest = np.array([0.5, 0.3, 0.2])

    def expected(stated):
        posterior = dict(zip("abc", stated, strict=True))
        return honest @ np.array([rule([true], [posterior])[0] for true in "abc"])

    rng = np.random.default_rng(1)
    others = [expected(stated) for stated in rng.dirichlet(np.ones(3), size=300)]
    assert expected(honest) < min(others)


def answers(count, seed=0):
    """Confidence of runs, and whether they are right as often as that."""
    rng = np.random.default_rng(seed)
    confidence = rng.beta(4, 1, size=count)
    return confidence, rng.random(count) < confidence


SIZES = {"seed": st.integers(0, 1000), "count": st.integers(1, 300)}


@given(**SIZES)
def test_equal_bins_are_those_of_scikit_learn(seed, count):
    confidence, right = answers(count, seed)
    ours = reliability(confidence, right)
    filled = ours.count > 0
    share, mean = calibration_curve(right, confidence, n_bins=10, strategy="uniform")
    np.testing.assert_allclose(ours.right[filled] / ours.count[filled], share)
    np.testing.assert_allclose(ours.confidence[filled], mean)
    assert ours.count.sum() == count


@given(**SIZES)
def test_adaptive_bins_share_out_the_runs_in_order_of_confidence(seed, count):
    confidence, right = answers(count, seed)
    ours = reliability(confidence, right, adaptive_edges(confidence))
    assert len(ours.count) == min(10, count)
    assert np.ptp(ours.count) <= 1
    parts = np.split(np.argsort(confidence), np.cumsum(ours.count)[:-1])
    assert ours.right.tolist() == [right[part].sum() for part in parts]
    gaps = [abs(right[part].sum() - confidence[part].sum()) for part in parts]
    assert ours.error == pytest.approx(sum(gaps) / count)


def test_error_is_the_gap_weighed_by_runs():
    confidence = np.array([0.55, 0.6, 0.95, 0.95, 0.95])
    right = np.array([True, False, True, True, False])
    bins = reliability(confidence, right)
    # (0.5, 0.6] holds its upper edge: 0.575 said, 1 of 2 right; (0.9, 1]: 0.95 said, 2 of 3 right.
    expected = 2 / 5 * (0.575 - 1 / 2) + 3 / 5 * (0.95 - 2 / 3)
    assert bins.error == pytest.approx(expected)
    assert bins.count.tolist() == [0, 0, 0, 0, 0, 2, 0, 0, 0, 3]


def test_runs_of_one_confidence_form_one_adaptive_bin():
    confidence, right = np.full(10, 0.7), np.arange(10) < 4
    bins = reliability(confidence, right, adaptive_edges(confidence))
    assert bins.count[bins.count > 0].tolist() == [10]
    assert bins.error == pytest.approx(0.3)


def test_error_of_chance_is_what_calibrated_answers_show():
    confidence, _ = answers(120)
    rng = np.random.default_rng(5)
    shown = [reliability(confidence, rng.random(120) < confidence).error for _ in range(2000)]
    ours = calibrated_error(confidence, np.random.default_rng(6), draws=2000)
    assert ours.shape == (2000,)
    np.testing.assert_allclose(
        np.quantile(ours, [0.05, 0.5, 0.95]), np.quantile(shown, [0.05, 0.5, 0.95]), rtol=0.06
    )


def test_overconfidence_stands_out_from_chance():
    confidence, _ = answers(2000)
    rng = np.random.default_rng(7)
    honest = rng.random(2000) < confidence
    limit = np.quantile(calibrated_error(confidence, rng), 0.99)
    assert reliability(confidence, honest).error < limit
    assert reliability(np.sqrt(confidence), honest).error > 2 * limit


@pytest.mark.parametrize("confidence", [[], [1.2], [np.nan]])
def test_values_that_are_no_probabilities_are_refused(confidence):
    with pytest.raises(InputError, match="within 0 to 1"):
        reliability(np.array(confidence), np.ones(len(confidence), dtype=bool))


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
