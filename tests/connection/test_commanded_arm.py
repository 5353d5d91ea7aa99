from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from failuretwin import Fault
from failuretwin.connection.emulated_arm import PACED_SLICE_S, EmulatedArm, Emulation
from failuretwin.connection.links import replay
from failuretwin.connection.links.base import CommandSent, Order, Reading
from failuretwin.connection.links.replay import Pace
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.nonidealities import NO_IMPERFECTIONS
from failuretwin.failure_behavior.injection import ScheduledFault

pytest.importorskip("mujoco")
PLAIN = replace(NO_IMPERFECTIONS, name="plain")


def arm_of(robot, imperfections=PLAIN, faults=(), seed=0):
    schedule = tuple(ScheduledFault(Fault(*fault), 0.0) for fault in faults)
    return EmulatedArm(Emulation(robot, imperfections, schedule, seed))


def wait(arm, seconds):
    """Let time pass; return readings and commands."""
    events, until = [], None
    while True:
        event = arm.poll(1.0)
        until = event.time + seconds if until is None else until
        if event.time > until:
            return events
        events.append(event)


def order(target, duration=0.6):
    return Order(np.asarray(target, dtype=float), np.full(len(target), duration))


def test_it_goes_where_it_is_told_and_says_so(armpi):
    arm = arm_of(armpi)
    wait(arm, 0.3)
    target = np.array([0.4, -0.3, 0.5, 0.2])
    arm.send(order(target))
    np.testing.assert_array_equal(arm.standing, target)
    events = wait(arm, 2.0)
    commands = [event for event in events if isinstance(event, CommandSent)]
    assert len(commands) == 1
    np.testing.assert_array_equal(commands[0].target, target)
    readings = [event for event in events if isinstance(event, Reading)]
    np.testing.assert_allclose(readings[-1].position, target, atol=0.06)  # sag and friction
    times = [event.time for event in events]
    assert times == sorted(times)


class Clock:
    """A clock that goes on by waiting alone."""

    now = 0.0

    def monotonic(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


def test_by_a_clock_an_order_begins_at_once(armpi, monkeypatch):
    """The time of a slice does not pass before it is due, however long polls may wait."""
    clock = Clock()
    monkeypatch.setattr(replay, "time", clock)
    arm = EmulatedArm(Emulation(armpi, PLAIN), Pace(1.0))
    while clock.now < 0.4:
        arm.poll(0.01)
    sent = clock.now
    arm.send(order([0.4, -0.3, 0.5, 0.2]))
    found = [event for _ in range(100) if isinstance(event := arm.poll(0.01), CommandSent)]
    assert len(found) == 1
    assert sent <= found[0].time <= sent + PACED_SLICE_S + 1e-6


def test_it_rests_until_it_is_told(armpi):
    arm = arm_of(armpi)
    before = arm.angle
    wait(arm, 3.0)
    np.testing.assert_allclose(arm.angle, before, atol=1e-3)


def test_a_held_motor_stays_and_the_others_move(armpi):
    arm = arm_of(armpi, faults=[("motor_2", "stuck")])
    wait(arm, 0.3)
    arm.send(order([0.4, -0.5, 0.3, 0.2]))
    wait(arm, 2.0)
    assert abs(arm.angle[1]) < 0.02
    assert arm.angle[0] == pytest.approx(0.4, abs=0.06)


def test_a_motor_that_is_told_nothing_new_keeps_its_error(armpi):
    arm = arm_of(armpi, faults=[("motor_1", "steady_state_error")])
    wait(arm, 0.3)
    arm.send(order([0.4, 0.0, 0.0, 0.0]))
    wait(arm, 2.0)
    there = arm.angle[0]
    assert abs(there - 0.4) > 0.03
    for bend in (0.2, 0.4, -0.3):
        arm.send(order([0.4, 0.0, bend, 0.0]))
        wait(arm, 2.0)
        assert arm.angle[0] == pytest.approx(there, abs=2e-3)
    errors = []
    for turn in (0.5, 0.3, 0.45):
        arm.send(order([turn, 0.0, 0.0, 0.0]))
        wait(arm, 2.0)
        errors.append(arm.angle[0] - turn)
    assert np.ptp(errors) > 0.01


def test_a_bus_that_stalls_makes_orders_wait(armpi):
    known = load_calibration("armpi_fpv", armpi)
    timing = replace(known.imperfections.timing, late_rate=1.0)
    arm = arm_of(armpi, replace(known.imperfections, timing=timing, variation=None))
    wait(arm, 0.3)
    arm.send(order([0.4, 0.0, 0.0, 0.0]))
    first = wait(arm, 1.0)
    sent = next(event.time for event in first if isinstance(event, CommandSent))
    arm.send(order([-0.4, 0.0, 0.0, 0.0]))
    later = wait(arm, 4.0)
    again = next(event.time for event in later if isinstance(event, CommandSent))
    assert again - sent > 1.5
    times = [event.time for event in (*first, *later) if isinstance(event, Reading)]
    assert np.max(np.diff(times)) > 0.5


def test_the_same_seed_is_the_same_arm(armpi):
    known = load_calibration("armpi_fpv", armpi)
    found = []
    for _ in range(2):
        arm = arm_of(armpi, known.imperfections, seed=4)
        wait(arm, 0.3)
        arm.send(order([0.3, 0.2, 0.1, 0.0]))
        found.append([event.tool for event in wait(arm, 1.0) if isinstance(event, Reading)])
    np.testing.assert_array_equal(found[0], found[1])
