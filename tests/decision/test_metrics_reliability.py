from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sklearn.calibration import calibration_curve

from failuretwin.core.errors import InputError
from failuretwin.decision.scoring_rules import (
    adaptive_edges,
    calibrated_error,
    equal_edges,
    reliability,
)


def answers(count, seed=0):
    """Confidence of runs, and whether they are right as often as that."""
    rng = np.random.default_rng(seed)
    confidence = rng.beta(4, 1, size=count)
    return confidence, rng.random(count) < confidence


SIZES = {"seed": st.integers(0, 1000), "bins": st.integers(1, 15), "count": st.integers(1, 300)}


@given(**SIZES)
def test_equal_bins_are_those_of_scikit_learn(seed, bins, count):
    confidence, right = answers(count, seed)
    ours = reliability(confidence, right, equal_edges(bins))
    filled = ours.count > 0
    share, mean = calibration_curve(right, confidence, n_bins=bins, strategy="uniform")
    np.testing.assert_allclose(ours.right[filled] / ours.count[filled], share)
    np.testing.assert_allclose(ours.confidence[filled], mean)
    assert ours.count.sum() == count


@given(**SIZES)
def test_adaptive_bins_share_out_the_runs_in_order_of_confidence(seed, bins, count):
    confidence, right = answers(count, seed)
    ours = reliability(confidence, right, adaptive_edges(confidence, bins))
    assert len(ours.count) == min(bins, count)
    assert np.ptp(ours.count) <= 1
    parts = np.split(np.argsort(confidence), np.cumsum(ours.count)[:-1])
    assert ours.right.tolist() == [right[part].sum() for part in parts]
    gaps = [abs(right[part].sum() - confidence[part].sum()) for part in parts]
    assert ours.error == pytest.approx(sum(gaps) / count)


def test_error_is_the_gap_weighed_by_runs():
    confidence = np.array([0.55, 0.6, 0.95, 0.95, 0.95])
    right = np.array([True, False, True, True, False])
    bins = reliability(confidence, right, equal_edges(10))
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
    edges = equal_edges(10)
    rng = np.random.default_rng(5)
    shown = [
        reliability(confidence, rng.random(120) < confidence, edges).error for _ in range(2000)
    ]
    ours = calibrated_error(confidence, edges, np.random.default_rng(6), draws=2000)
    assert ours.shape == (2000,)
    np.testing.assert_allclose(
        np.quantile(ours, [0.05, 0.5, 0.95]), np.quantile(shown, [0.05, 0.5, 0.95]), rtol=0.06
    )


def test_overconfidence_stands_out_from_chance():
    confidence, _ = answers(2000)
    rng = np.random.default_rng(7)
    honest = rng.random(2000) < confidence
    edges = equal_edges(10)
    limit = np.quantile(calibrated_error(confidence, edges, rng), 0.99)
    assert reliability(confidence, honest, edges).error < limit
    assert reliability(np.sqrt(confidence), honest, edges).error > 2 * limit


@pytest.mark.parametrize(
    ("confidence", "edges", "words"),
    [
        ([], [0, 1], "no runs"),
        ([1.2], [0, 2], "outside 0 to 1"),
        ([np.nan], [0, 1], "outside 0 to 1"),
        ([0.3], [0.5, 1], "beyond the edges 0.5 to 1"),
    ],
)
def test_what_is_no_confidence(confidence, edges, words):
    with pytest.raises(InputError, match=words):
        reliability(np.array(confidence), np.ones(len(confidence), dtype=bool), np.array(edges))


def test_no_bins():
    with pytest.raises(InputError, match="expected 1 or more"):
        equal_edges(0)
