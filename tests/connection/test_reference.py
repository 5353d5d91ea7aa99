from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from failuretwin.connection.links.base import CommandSent
from failuretwin.connection.links.ros_messages import SampledCommands
from failuretwin.connection.links.stream_time import LiveReference
from failuretwin.core.movements import Movements


def command(time, target, duration):
    return CommandSent(time, np.array(target, float), np.array(duration, float))


@given(seed=st.integers(0, 10_000))
def test_the_corners_draw_the_reference_of_the_movements(seed):
    rng = np.random.default_rng(seed)
    count = 4
    start = np.cumsum(rng.uniform(0.5, 3.0, count))
    target = rng.uniform(-1.0, 1.0, (count, 2))
    ramp = rng.uniform(0.1, 2.0, (count, 2))  # some are cut off by the next command
    pose = rng.uniform(-1.0, 1.0, 2)
    expected = Movements(pose[None], target[None], ramp[None], start[None])
    reference = LiveReference()
    reference.start_at(pose)
    times = np.sort(rng.uniform(0.0, 12.0, 60))
    corners = []
    sent = 0
    for time in times:
        while sent < count and start[sent] <= time:
            reference.add(CommandSent(start[sent], target[sent], ramp[sent]))
            sent += 1
        corners += reference.corners_to(time)
    at, value = np.array([t for t, _ in corners]), np.array([v for _, v in corners])
    assert np.all(np.diff(at) > 0.0)
    grid = np.linspace(times[0], times[-1], 997)
    drawn = np.stack([np.interp(grid, at, value[:, k]) for k in range(2)], axis=1)
    assert_allclose(drawn, expected.reference(grid)[0], atol=1e-9)


def test_nothing_is_known_before_a_command_or_a_pose():
    reference = LiveReference()
    assert reference.corners_to(1.0) == []
    reference.add(command(2.0, [0.5], [1.0]))
    assert reference.corners_to(1.5) == []
    ((time, value),) = reference.corners_to(2.5)  # where it came from is not known: no ramp
    assert (time, value.tolist()) == (2.5, [0.5])


def test_a_command_that_comes_late_starts_late_and_still_arrives_in_time():
    reference = LiveReference()
    reference.start_at(np.zeros(1))
    reference.corners_to(10.0)
    reference.add(command(9.6, [1.0], [1.0]))
    (_, halfway), *_ = reference.corners_to(10.3)
    assert_allclose(halfway, [0.5])  # from 10.0 to 10.6
    (end, arrived), _ = reference.corners_to(11.0)
    assert end == pytest.approx(10.6)
    assert_allclose(arrived, [1.0])
    assert reference.late_s == pytest.approx(0.4)


def test_a_new_plan_replaces_what_is_still_to_come():
    reference = LiveReference()
    reference.start_at(np.zeros(1))
    reference.add(command(1.0, [1.0], [1.0]))
    reference.add(command(3.0, [5.0], [1.0]))
    reference.add(command(2.5, [2.0], [0.5]))
    corners = reference.corners_to(9.0)
    assert_allclose(corners[-1][1], [2.0])


@given(seed=st.integers(0, 1000))
def test_samples_of_a_reference_draw_the_same_line(seed):
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.01, 0.2, 50))
    values = np.cumsum(rng.choice([0.0, 0.0, 0.1, -0.2], (50, 2)), axis=0)
    samples, reference = SampledCommands(), LiveReference()
    corners = []
    for time, value in zip(times, values, strict=True):
        sent = samples.add(float(time), value)
        if sent is not None:
            reference.add(sent)
        corners += reference.corners_to(float(time))
    at, value = np.array([t for t, _ in corners]), np.array([v for _, v in corners])
    # Each sample is followed one sample late, from where the reference had come to.
    assert_allclose(value[-1], values[-1], atol=1e-12)
    assert np.all(np.diff(at) > 0.0)
