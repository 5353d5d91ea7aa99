"""The rank test of `benchmarks/ranks.py`, judged against closed-form posteriors."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np
import pytest

from failuretwin.core.errors import InputError

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"

with pytest.MonkeyPatch.context() as patch:
    patch.syspath_prepend(BENCHMARKS)
    ranks_module = importlib.import_module("ranks")

check_ranks, rank_of_truth = ranks_module.check_ranks, ranks_module.rank_of_truth
DRAWS = 99


def normal_ranks(runs, rng, width=1.0, shift=0.0):
    """Ranks under a normal prior and a normal reading; exact for width 1 and shift 0."""
    truth = rng.normal(size=runs)
    reading = truth + rng.normal(size=runs)
    mean, spread = reading / 2 + shift, width * np.sqrt(0.5)
    draws = mean[:, None] + spread * rng.normal(size=(runs, DRAWS))
    return rank_of_truth(draws, truth, rng)


def test_rank_is_the_number_of_draws_below():
    draws = np.array([[1.0, 2.0, 3.0], [1.0, 2.0, 3.0], [1.0, 2.0, 3.0]])
    ranks = rank_of_truth(draws, np.array([0.0, 2.5, 9.0]), np.random.default_rng(0))
    assert ranks.tolist() == [0, 2, 3]


def test_ties_are_broken_by_chance_so_that_ranks_stay_uniform():
    rng = np.random.default_rng(1)
    before = rng.random(4000) < 0.4  # of the prior: a point with mass
    truth = np.where(before, 0.0, rng.random(4000))
    draws = np.where(rng.random((4000, DRAWS)) < 0.4, 0.0, rng.random((4000, DRAWS)))
    check = check_ranks(rank_of_truth(draws, truth, rng), DRAWS, rng)
    assert min(check.chi2_p, check.ks_p) > 0.01
    unbroken = (draws < truth[:, None]).sum(axis=1)
    assert check_ranks(unbroken, DRAWS, rng).ks_p < 0.01


def test_exact_posterior_has_uniform_ranks():
    rng = np.random.default_rng(2)
    check = check_ranks(normal_ranks(5000, rng), DRAWS, rng)
    assert min(check.chi2_p, check.ks_p) > 0.01
    assert check.count.sum() == 5000
    assert check.expected.sum() == pytest.approx(5000)


@pytest.mark.parametrize(
    ("width", "shift"), [(0.8, 0.0), (1.25, 0.0), (1.0, 0.15)], ids=["narrow", "wide", "biased"]
)
def test_wrong_posterior_is_found_out(width, shift):
    rng = np.random.default_rng(3)
    check = check_ranks(normal_ranks(2000, rng, width, shift), DRAWS, rng)
    assert max(check.chi2_p, check.ks_p) < 0.01


def test_the_shape_tells_what_is_wrong():
    rng = np.random.default_rng(4)
    narrow = check_ranks(normal_ranks(4000, rng, width=0.7), DRAWS, rng).count
    assert min(narrow[0], narrow[-1]) > 1.5 * narrow[len(narrow) // 2]
    high = check_ranks(normal_ranks(4000, rng, shift=0.4), DRAWS, rng).count
    assert high[0] > 1.5 * high[-1], "estimates too high put truths at low ranks"


@pytest.mark.parametrize("runs", [40, 150])
def test_uniform_ranks_fail_each_test_as_rarely_as_stated(runs):
    rng = np.random.default_rng(runs)
    checks = [check_ranks(rng.integers(0, DRAWS + 1, runs), DRAWS, rng) for _ in range(300)]
    for p_values in ([c.chi2_p for c in checks], [c.ks_p for c in checks]):
        assert 3 <= sum(p < 0.05 for p in p_values) <= 30  # 15 expected, binomial


def test_unequal_bins_know_what_to_expect():
    ranks = np.arange(31)
    check = check_ranks(ranks, 30, np.random.default_rng(0))
    np.testing.assert_allclose(check.expected, check.count)
    assert check.chi2_p == 1.0


@pytest.mark.parametrize("ranks", [[], [-1], [100]])
def test_ranks_that_cannot_be(ranks):
    with pytest.raises(InputError, match="0 to 99"):
        check_ranks(np.array(ranks, dtype=np.int64), DRAWS, np.random.default_rng(0))
