from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.metrics import confusion_matrix, f1_score, precision_recall_fscore_support

from failuretwin.decision.proportions import NO_VERDICT, judged_truth, score, wilson_interval

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
    assert (c.runs, c.recall, c.f1) == (1, 0.0, 0.0)
    assert np.isnan(c.precision)
    assert scores.macro_f1 == pytest.approx((4 / 7 + 1 / 2 + 0) / 3)


def test_a_class_that_is_neither_true_nor_said_has_no_scores():
    scores = score(["a"], ["a"], [{"a": 0.9, "b": 0.1}])
    b = scores.by_class()[1]
    assert (b.name, b.runs) == ("b", 0)
    assert np.isnan([b.precision, b.recall, b.f1]).all()
    assert scores.macro_f1 == 1.0


pairs = st.lists(st.tuples(st.sampled_from("abc"), st.sampled_from([*"abcd", None])), min_size=1)


@given(pairs)
def test_scores_are_those_of_scikit_learn(answers):
    truth, said = [true for true, _ in answers], [said for _, said in answers]
    scores = score(truth, said, [{"a": 0.5, "b": 0.5}] * len(answers))
    words = [NO_VERDICT if word is None else word for word in said]
    labels = list(scores.classes)
    np.testing.assert_array_equal(scores.confusion, confusion_matrix(truth, words, labels=labels))
    ours = np.array([(row.precision, row.recall, row.f1) for row in scores.by_class()]).T
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
    assert scores.log_scores.impossible == 1
    assert scores.log_scores.mean_of_rest == pytest.approx(
        -np.log([0.5, 0.8, 0.25, 0.5, 0.1]).mean()
    )


def test_certainty_of_the_truth_costs_nothing():
    scores = score(["a", "b"], ["a", "b"], [{"a": 1.0, "b": 0.0}, {"a": 0.0, "b": 1.0}])
    assert scores.log_score == 0.0
    assert scores.accuracy == 1.0


def test_truth_that_no_hypothesis_stands_for_counts_as_wrong():
    scores = score(["d"], ["a"], [{"a": 0.9, "b": 0.1}])
    assert (scores.right, scores.runs) == (0, 1)
    assert scores.log_score == np.inf
    assert np.isnan(scores.log_scores.mean_of_rest)
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
