from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from failuretwin.core.movements import stack_movements
from failuretwin.digital_model.nonidealities import Schedule
from failuretwin.failure_behavior.random_movements import RandomMovements

RANGE_DEG = np.array([80.0, 50.0, 50.0, 50.0])
"""Targets in the paper lie within plus or minus this, by motor."""
WHOLE = Schedule((0.01, 0.11), (2.0, 2.04), whole_counts=True)


def draw(robot, schedule=None, runs=400, plan=None):
    rng = np.random.default_rng(0)
    plan = plan or RandomMovements()
    return stack_movements([plan.draw(robot, schedule or Schedule(), rng) for _ in range(runs)])


@pytest.fixture(scope="module")
def movements(armpi):
    return draw(armpi)


def test_runs_are_those_of_the_paper(movements):
    assert movements.target.shape == (400, 5, 4)
    assert RandomMovements().duration_s == 10.0
    np.testing.assert_array_equal(movements.initial, 0.0)
    np.testing.assert_allclose(movements.start, np.tile(2.0 * np.arange(5), (400, 1)))


@pytest.mark.parametrize("motor", range(4))
def test_targets_are_spread_evenly_over_the_range(movements, motor):
    targets = np.rad2deg(movements.target[..., motor]).ravel()
    edge = RANGE_DEG[motor]
    assert np.abs(targets).max() <= edge
    assert stats.kstest(targets, "uniform", (-edge, 2 * edge)).pvalue > 0.01


def test_ramps_take_the_three_lengths_of_the_paper(movements):
    lengths, counts = np.unique(movements.ramp_duration.round(9), return_counts=True)
    np.testing.assert_allclose(lengths, [0.6, 0.8, 1.0])
    assert stats.chisquare(counts).pvalue > 0.01


def test_ramps_are_never_faster_than_the_published_cap(armpi):
    hasty = draw(armpi, plan=RandomMovements(ramp_shares=(0.1,)))
    before = np.concatenate([hasty.initial[:, None], hasty.target[:, :-1]], axis=1)
    travel = np.rad2deg(np.abs(hasty.target - before))

    capped = travel > 272.0 * 0.2
    assert 0.2 < capped.mean() < 0.8
    np.testing.assert_allclose(hasty.ramp_duration[~capped], 0.2)
    np.testing.assert_allclose(travel[capped] / hasty.ramp_duration[capped], 272.0)


def test_reference_moves_at_most_as_far_in_a_step_as_published(armpi):
    hasty = draw(armpi, runs=20, plan=RandomMovements(ramp_shares=(0.05,)))
    steps = np.diff(hasty.reference(np.arange(1000) * 0.01), axis=1)
    assert np.rad2deg(np.abs(steps)).max() == pytest.approx(2.72)


def test_targets_are_whole_counts_when_the_schedule_says_so(armpi, movements):
    def counts(m):
        return (120.0 - np.rad2deg(m.target)) / 0.24

    whole = counts(draw(armpi, WHOLE))
    np.testing.assert_allclose(whole, whole.round(), atol=1e-9)
    assert np.abs(counts(movements) - counts(movements).round()).max() > 0.4


def test_starts_follow_the_schedule(armpi):
    start = draw(armpi, WHOLE).start
    assert stats.kstest(start[:, 0], "uniform", (0.01, 0.10)).pvalue > 0.01
    assert stats.kstest(np.diff(start).ravel(), "uniform", (2.0, 0.04)).pvalue > 0.01


def test_the_generator_alone_decides(armpi):
    once, again = draw(armpi, WHOLE, runs=3), draw(armpi, WHOLE, runs=3)
    np.testing.assert_array_equal(once.target, again.target)
    np.testing.assert_array_equal(once.start, again.start)
