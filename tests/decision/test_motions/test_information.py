from __future__ import annotations

import numpy as np
import pytest

from failuretwin.decision.test_motions.outlook import (
    expected_information,
    pairwise_distance,
)

AXIS = np.linspace(-60.0, 60.0, 200_001)


def normal(mean, deviation):
    return np.exp(-0.5 * ((AXIS - mean) / deviation) ** 2) / (deviation * np.sqrt(2.0 * np.pi))


def integral(values):
    return float(np.sum(values) * (AXIS[1] - AXIS[0]))


def distances(means, deviations, cap=np.inf):
    mean = np.array(means)[:, None]
    spread = (np.array(deviations) ** 2)[:, None, None]
    return pairwise_distance(mean, spread, np.inf, cap)


@pytest.mark.parametrize(("mean", "deviation"), [(1.5, 1.0), (0.0, 3.0), (-2.0, 0.4)])
def test_distance_is_minus_the_log_of_the_overlap(mean, deviation):
    overlap = integral(np.sqrt(normal(0.0, 1.0) * normal(mean, deviation)))
    found = distances([0.0, mean], [1.0, deviation])
    np.testing.assert_allclose(found, -np.log([[1.0, overlap], [overlap, 1.0]]), atol=1e-7)


def test_heavy_tails_and_lost_commands_bound_what_a_movement_tells():
    mean, spread = np.array([[0.0], [50.0]]), np.ones((2, 1, 1))
    normal_nats = pairwise_distance(mean, spread, np.inf, np.inf)[0, 1]
    heavy = pairwise_distance(mean, spread, 4.0, np.inf)[0, 1]
    assert heavy == pytest.approx(0.125 * 5.0 * np.log1p(2500.0 / 7.0))
    assert heavy < 0.02 * normal_nats
    assert pairwise_distance(mean, spread, 4.0, 2.0)[0, 1] == 2.0


def brute_force(means, deviations, shares, kind):
    """Mutual information of hypothesis and reading, by integrals."""
    density = np.array([normal(m, s) for m, s in zip(means, deviations, strict=True)])
    joint = shares[:, None] * density
    by_kind = np.array([joint[kind == k].sum(axis=0) for k in np.unique(kind)])
    prior = by_kind.sum(axis=1, keepdims=True) * (AXIS[1] - AXIS[0])
    whole = joint.sum(axis=0)
    ratio = np.where(by_kind > 0.0, by_kind / np.maximum(prior * whole, 1e-300), 1.0)
    return integral(np.sum(by_kind * np.log(np.maximum(ratio, 1e-300)), axis=0))


def test_one_member_each_the_estimate_is_a_lower_bound_that_is_tight_at_both_ends():
    shares, kind = np.array([0.5, 0.3, 0.2]), np.arange(3)
    for apart in (0.0, 0.5, 1.0, 2.0, 4.0, 20.0):
        means, deviations = [0.0, apart, -apart], [1.0, 1.0, 1.5 if apart else 1.0]
        found = expected_information(distances(means, deviations), np.log(shares), kind)
        true = brute_force(means, deviations, shares, kind)
        assert -1e-9 <= found <= true + 1e-6
        if apart in (0.0, 20.0):
            assert found == pytest.approx(true, abs=1e-4)


def test_sizes_of_one_hypothesis_are_not_told_apart_from_each_other():
    nats = distances([0.0, 30.0, -30.0], [1.0, 1.0, 1.0])
    log_share = np.log([0.5, 0.25, 0.25])
    found = expected_information(nats, log_share, np.array([0, 1, 1]))
    assert found == pytest.approx(np.log(2.0), abs=1e-6)
    apart = expected_information(nats, log_share, np.arange(3))
    assert apart == pytest.approx(1.5 * np.log(2.0), abs=1e-6)


def test_it_ranks_readings_as_the_true_information_does():
    rng = np.random.default_rng(1)
    shares, kind = np.array([0.4, 0.2, 0.2, 0.2]), np.array([0, 1, 2, 2])
    found, true = [], []
    for _ in range(40):
        means, deviations = 4.0 * rng.standard_normal(4), rng.uniform(0.5, 2.0, 4)
        found.append(expected_information(distances(means, deviations), np.log(shares), kind))
        true.append(brute_force(means, deviations, shares, kind))
    ranks = np.argsort(np.argsort([found, true], axis=1), axis=1)
    assert np.corrcoef(ranks)[0, 1] > 0.95
