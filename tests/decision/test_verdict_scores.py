"""Scores of verdicts and intervals, judged against scikit-learn and scipy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest, norm
from sklearn.metrics import confusion_matrix, f1_score, precision_recall_fscore_support

from failuretwin.decision.scoring import (
    NO_VERDICT,
    Coverage,
    IntervalCase,
    Share,
    count_alarms,
    coverage_by_mode,
    judged_truth,
    score_diagnoses,
)

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
    return score_diagnoses(TRUTH, SAID, posterior)


def test_confusion_has_a_row_for_each_truth(scores):
    order = [scores.classes.index(name) for name in "abc"]
    np.testing.assert_array_equal(
        scores.confusion[np.ix_(order, order)], [[2, 1, 0], [1, 1, 0], [1, 0, 0]]
    )
    assert (scores.right, scores.runs) == (3, 6)
    assert scores.accuracy == 0.5
    assert scores.interval == Share(3, 6).interval


def test_classes_are_scored_apart(scores):
    order = [scores.classes.index(name) for name in "abc"]
    nothing = float("nan")
    expected = [(2 / 4, 2 / 3, 2 * 2 / (4 + 3)), (0.5, 0.5, 0.5), (nothing, 0.0, 0.0)]
    np.testing.assert_allclose(scores.ratios[order], expected)
    assert scores.confusion[order].sum(axis=1).tolist() == [3, 2, 1]
    assert scores.macro_f1 == pytest.approx((4 / 7 + 1 / 2 + 0) / 3)


def test_a_class_that_is_neither_true_nor_said_has_no_scores():
    scores = score_diagnoses(["a"], ["a"], [{"a": 0.9, "b": 0.1}])
    assert scores.classes[1] == "b"
    assert np.isnan(scores.ratios[1]).all()
    assert scores.macro_f1 == 1.0


pairs = st.lists(st.tuples(st.sampled_from("abc"), st.sampled_from([*"abcd", None])), min_size=1)


@given(pairs)
def test_scores_are_those_of_scikit_learn(answers):
    truth, said = [true for true, _ in answers], [said for _, said in answers]
    scores = score_diagnoses(truth, said, [{"a": 0.5, "b": 0.5}] * len(answers))
    words = [NO_VERDICT if word is None else word for word in said]
    labels = list(scores.classes)
    np.testing.assert_array_equal(scores.confusion, confusion_matrix(truth, words, labels=labels))
    ours = scores.ratios.T
    expected = precision_recall_fscore_support(
        truth, words, labels=labels, zero_division=float("nan")
    )
    np.testing.assert_allclose(ours[0], expected[0])
    np.testing.assert_allclose(ours[1], expected[1])
    occurs = np.isfinite(ours[2])
    np.testing.assert_allclose(ours[2][occurs], expected[2][occurs])
    macro = f1_score(truth, words, labels=sorted(set(truth)), average="macro", zero_division=0.0)
    assert scores.macro_f1 == pytest.approx(macro)


def test_the_log_score_says_when_the_truth_was_ruled_out(scores):
    assert scores.log_score == np.inf
    np.testing.assert_allclose(scores.nats, [*-np.log([0.5, 0.8, 0.25, 0.5, 0.1]), np.inf])


def test_certainty_of_the_truth_costs_nothing():
    scores = score_diagnoses(["a", "b"], ["a", "b"], [{"a": 1.0, "b": 0.0}, {"a": 0.0, "b": 1.0}])
    assert scores.log_score == 0.0
    assert scores.accuracy == 1.0


def test_truth_that_no_hypothesis_stands_for_counts_as_wrong():
    scores = score_diagnoses(["d"], ["a"], [{"a": 0.9, "b": 0.1}])
    assert (scores.right, scores.runs) == (0, 1)
    assert scores.log_score == np.inf
    assert set(scores.classes) == {"a", "b", "d"}


@pytest.mark.parametrize(
    ("truth", "hypotheses", "right"),
    [
        ("motor_2:drift", ["healthy", "motor_1:stuck", "unknown"], "unknown"),
        ("motor_1:stuck+motor_2:drift", ["healthy", "motor_1:stuck", "unknown"], "unknown"),
        ("motor_1:stuck", ["healthy", "motor_1:stuck", "unknown"], "motor_1:stuck"),
        ("motor_2:drift", ["healthy", "motor_1:stuck"], "motor_2:drift"),
        ("healthy", ["motor_1:stuck", "unknown"], "healthy"),
    ],
)
def test_unknown_means_every_fault_that_is_not_named(truth, hypotheses, right):
    assert judged_truth(truth, hypotheses) == right


@given(trials=st.integers(1, 4000), share=st.floats(0, 1))
def test_wilson_interval_is_that_of_scipy(trials, share):
    successes = round(share * trials)
    expected = binomtest(successes, trials).proportion_ci(method="wilson")
    share = Share(successes, trials)
    np.testing.assert_allclose(share.interval, expected, rtol=1e-9, atol=1e-12)
    assert share.value == successes / trials


def test_a_share_of_nothing_is_not_known():
    assert Share(0, 0).interval == (0.0, 1.0)
    assert np.isnan(Share(0, 0).value)


def test_any_other_verdict_on_a_healthy_run_is_a_false_alarm():
    alarms = count_alarms(["healthy"] * 5, ["healthy", "motor_1:stuck", "unknown", None, "healthy"])
    assert alarms.false_alarms == Share(2, 5)
    assert alarms.healthy_abstained == 1
    assert alarms.missed == Share(0, 0)


def test_a_fault_is_missed_where_no_alarm_is_raised_whatever_its_name():
    said = ["motor_1:stuck", "motor_2:stuck", "unknown", "healthy", None, None]
    alarms = count_alarms(["motor_1:stuck"] * 5 + ["unknown"], said)
    assert alarms.missed == Share(3, 6)
    assert alarms.faulty_abstained == 2
    assert alarms.false_alarms == Share(0, 0)


def test_truths_are_counted_on_either_side():
    cases = [
        IntervalCase("stuck", "onset", 1.0, 2.0, truth) for truth in (0.5, 1.0, 1.5, 2.0, 2.5, 3.0)
    ]
    cases.append(IntervalCase("drift", "onset", 0.0, 0.0, 0.0))
    assert coverage_by_mode(cases) == [
        Coverage("stuck", "onset", Share(3, 6), below=1, above=2, points=0),
        Coverage("drift", "onset", Share(1, 1), below=0, above=0, points=1),
    ]


def test_intervals_of_an_exact_posterior_cover_what_they_say():
    """Also where runs were chosen by what the data say, as a diagnosis chooses them."""
    rng = np.random.default_rng(0)
    truth = rng.normal(size=20_000)
    mean = (truth + rng.normal(size=20_000)) / 2
    half = norm.ppf(0.95) * np.sqrt(0.5)
    chosen = mean > 0.3
    cases = [
        IntervalCase("stuck", "magnitude", m - half, m + half, t)
        for m, t in zip(mean[chosen], truth[chosen], strict=True)
    ]
    (coverage,) = coverage_by_mode(cases)
    low, high = coverage.inside.interval
    assert low < 0.9 < high
    assert high - low < 0.02
