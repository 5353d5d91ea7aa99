from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest

from failuretwin.decision.metrics import score, wilson_interval


@given(trials=st.integers(1, 4000), share=st.floats(0, 1))
def test_wilson_interval_is_that_of_scipy(trials, share):
    successes = round(share * trials)
    expected = binomtest(successes, trials).proportion_ci(method="wilson")
    np.testing.assert_allclose(wilson_interval(successes, trials), expected, rtol=1e-9, atol=1e-12)


def test_wilson_interval_of_nothing_is_everything():
    assert wilson_interval(0, 0) == (0.0, 1.0)


TRUTH = ["a", "a", "a", "b", "b", "c"]
SAID = ["a", "a", "b", "b", "a", "a"]
CHANCE = [0.5, 0.8, 0.25, 0.5, 0.1, 0.0]
"""Probability that was given to the truth."""


@pytest.fixture
def scores():
    posterior = []
    for truth, chance in zip(TRUTH, CHANCE, strict=True):
        others = [name for name in "abc" if name != truth]
        posterior.append(dict.fromkeys(others, (1 - chance) / 2) | {truth: chance})
    return score(TRUTH, SAID, posterior)


def test_confusion_has_a_row_for_each_truth(scores):
    order = [scores.classes.index(name) for name in "abc"]
    np.testing.assert_array_equal(
        scores.confusion[np.ix_(order, order)], [[2, 1, 0], [1, 1, 0], [1, 0, 0]]
    )
    assert (scores.right, scores.runs) == (3, 6)
    assert scores.accuracy == 0.5
    assert scores.interval == wilson_interval(3, 6)


def test_classes_are_scored_apart(scores):
    a, b, c = (next(row for row in scores.by_class() if row.name == name) for name in "abc")
    assert (a.runs, a.precision, a.recall) == (3, 2 / 4, pytest.approx(2 / 3))
    assert a.f1 == pytest.approx(2 * 2 / (4 + 3))
    assert (b.runs, b.precision, b.recall, b.f1) == (2, 0.5, 0.5, 0.5)
    assert (c.runs, c.recall) == (1, 0.0)
    assert np.isnan(c.precision)
    assert np.isnan(c.f1)


def test_log_score_is_the_mean_surprise_at_the_truth(scores):
    surprise = -np.log([0.5, 0.8, 0.25, 0.5, 0.1, 1e-12])
    assert scores.log_score == pytest.approx(surprise.mean())


def test_certainty_of_the_truth_costs_nothing():
    scores = score(["a", "b"], ["a", "b"], [{"a": 1.0, "b": 0.0}, {"a": 0.0, "b": 1.0}])
    assert scores.log_score == 0.0
    assert scores.accuracy == 1.0


def test_truth_that_no_hypothesis_stands_for_counts_as_wrong():
    scores = score(["d"], ["a"], [{"a": 0.9, "b": 0.1}])
    assert (scores.right, scores.runs) == (0, 1)
    assert scores.log_score == pytest.approx(-np.log(1e-12))
    assert set(scores.classes) == {"a", "b", "d"}
