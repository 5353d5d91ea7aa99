"""Runs of two robots, against densities of normal measurements by scipy."""

from __future__ import annotations

from functools import cache
from itertools import product

import numpy as np
import pytest
from scipy import stats

from failuretwin.inference.together.belief import Normal
from failuretwin.inference.together.mixed_runs import of_second_robot, two_robots

NOISE = 0.3


def measured(places):
    """Return sites of runs that each measure theta with `NOISE`, at places (run, theta)."""
    count, size = places.shape
    precision = np.tile(np.eye(size) / NOISE**2, (count, 1, 1))
    return Normal(precision, places / NOISE**2)


@cache
def of_one_robot(count):
    """Measurements of one robot, theta standard normal: by scipy."""
    return stats.multivariate_normal(cov=np.ones((count, count)) + NOISE**2 * np.eye(count))


def log_density(places):
    return of_one_robot(len(places)).logpdf(places.T).sum()


def gain(places, part):
    return log_density(places[part]) + log_density(places[~part]) - log_density(places)


def without_any(places, part):
    """The least gain where one of the runs is left out."""
    return min(gain(np.delete(places, i, 0), np.delete(part, i)) for i in range(len(part)))


@pytest.mark.parametrize("seed", range(6))
def test_one_robot_is_one(seed):
    rng = np.random.default_rng(seed)
    assert of_second_robot(measured(rng.normal(size=3) + NOISE * rng.normal(size=(12, 3)))) is None


@pytest.mark.parametrize("apart", np.linspace(0.5, 2.5, 9))
def test_one_after_the_other_is_told_from_the_gain_that_scipy_says(apart):
    """Seven nats and log n, and a change after the fifth of eleven runs."""
    rng = np.random.default_rng(3)
    part = np.arange(11) >= 5
    places = np.outer(part - 0.5, [apart, 0.0, 0.0]) + 0.1 * rng.normal(size=(11, 3))
    blocks = [np.arange(11) >= k for k in range(2, 10)]
    most = without_any(places, max(blocks, key=lambda block: gain(places, block))) - np.log(11)
    found = of_second_robot(measured(places))
    assert (found is not None) == (most > 7.0)
    if found is not None:
        np.testing.assert_array_equal(found, part)


@pytest.mark.parametrize("apart", [1.2, 1.6, 2.0, 2.4, 3.2])
def test_in_any_order_it_takes_a_bit_a_run(apart):
    rng = np.random.default_rng(5)
    part = np.array([0, 1, 0, 1, 1, 0, 0, 1, 0, 1], dtype=bool)
    places = np.outer(part - 0.5, [0.0, apart]) + 0.1 * rng.normal(size=(10, 2))
    every = [np.array(bits, dtype=bool) for bits in product((0, 1), repeat=10)]
    ways = [p for p in every if 2 <= p.sum() <= 8]
    most = without_any(places, max(ways, key=lambda p: gain(places, p))) - 10 * np.log(2.0)
    found = of_second_robot(measured(places))
    assert (found is not None) == (most > 7.0)
    if found is not None:
        assert (found == part).all() or (found == ~part).all()


def test_a_single_odd_run_is_no_robot():
    places = 0.05 * np.random.default_rng(0).normal(size=(9, 2))
    places[4] = 4.0
    assert of_second_robot(measured(places)) is None
    assert of_second_robot(measured(places[3:6])) is None


def test_the_fewer_runs_are_named():
    names = [f"run_{i}" for i in range(13)]
    line = two_robots(np.arange(13) >= 7, names)
    assert "run_7, run_8, run_9, run_10 and 2 more differ" in line
    assert "run_0, run_1 differ" in two_robots(np.arange(13) >= 2, names)
