"""Robots of one fleet whose samples come at times of their own."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from failuretwin import BayesDiagnoser
from failuretwin.core.errors import InputError
from failuretwin.decision.streaming.fleet import StreamingFleet

ROBOTS = 3


@pytest.fixture(scope="module")
def samples(live_runs):
    """Time, reference and reading of each sample of three robots, their clocks apart.

    They make three movements, which takes 6.5 s.
    """
    some = live_runs.isel(run=[0, 3, 8], time=slice(0, 650))
    time = some["time"].values
    return [
        [
            (1e6 * robot + at, some["command"].values[robot, i], some["measured"].values[robot, i])
            for i, at in enumerate(time)
            if i % (1 + robot) == 0 or np.isfinite(some["measured"].values[robot, i]).all()
        ]
        for robot in range(ROBOTS)
    ]


@pytest.fixture(scope="module")
def settled(twin):
    return BayesDiagnoser(twin, whole_run=False)


def played(fleet, samples, order):
    """Feed samples round by round, those robots that `order` draws."""
    left = [list(own) for own in samples]
    while any(left):
        time, command = np.full(len(left), np.nan), np.full((len(left), 4), np.nan)
        measured = np.full((len(left), 3), np.nan)
        for robot, own in enumerate(left):
            if own and order.random() < 0.7:
                time[robot], command[robot], measured[robot] = own.pop(0)
        fleet.update(time, command, measured)
    return fleet


def test_robots_with_clocks_apart_are_judged_as_if_alone(samples, settled, rng):
    together = played(StreamingFleet(settled, ROBOTS), samples, rng)
    for robot, own in enumerate(samples):
        alone = StreamingFleet(settled, 1)
        for time, command, measured in own:
            alone.update(time, command[None], measured[None])
        np.testing.assert_allclose(together.posterior[robot], alone.posterior[0], atol=1e-12)
        assert together.times[robot] == alone.times[0]


def test_a_state_goes_on_in_a_larger_fleet(samples, settled, rng):
    first = [own[: len(own) // 2] for own in samples]
    rest = [own[len(own) // 2 :] for own in samples]
    whole = played(StreamingFleet(settled, ROBOTS), first, rng)
    larger = StreamingFleet(settled, 2 * ROBOTS)
    larger.restore(copy.deepcopy(whole.state()))
    played(whole, rest, rng)
    played(larger, [*rest, [], [], []], rng)
    np.testing.assert_allclose(larger.posterior[:ROBOTS], whole.posterior, atol=1e-12)
    assert not larger.judged[ROBOTS:].any()


def test_a_state_of_more_robots_is_refused(settled):
    with pytest.raises(ValueError):
        StreamingFleet(settled, 1).restore(StreamingFleet(settled, 2).state())


def test_one_robot_whose_time_goes_back_is_named_with_its_times(settled):
    fleet = StreamingFleet(settled, 2)
    fleet.update([100.0, 5000.0], None, np.zeros((2, 3)))
    with pytest.raises(InputError, match=r"a sample is of 60.0 s, but the newest is of 100.0 s"):
        fleet.update([60.0, np.nan], None, None)
    with pytest.raises(InputError, match="one finite number, or one of each robot"):
        fleet.update([1.0, 2.0, 3.0], None, None)
