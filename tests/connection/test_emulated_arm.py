from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from failuretwin.connection.emulated_arm import EmulatedArm, Emulation, Shifts
from failuretwin.connection.links.base import CommandSent, Reading
from failuretwin.core.errors import InputError
from failuretwin.digital_model.nonidealities import NO_IMPERFECTIONS
from failuretwin.failure_behavior.injection import ScheduledFault, state_at

pytest.importorskip("mujoco")


def life(robot, imperfections, faults=(), seconds=60.0, seed=0):
    schedule = tuple(ScheduledFault.parse(text, robot.motor_names) for text in faults)
    work = Shifts(break_s=0.0, duration_s=seconds)
    arm = EmulatedArm(Emulation(robot, imperfections, schedule, seed), shifts=work)
    return list(iter(lambda: arm.poll(0.0), None))


def readings(events):
    found = [event for event in events if isinstance(event, Reading)]
    return np.array([r.time for r in found]), np.array([r.position for r in found])


def settled_errors(events):
    """Return start and error of each movement at its last reading, where it is late in it."""
    starts, errors, command, last = [], [], None, None
    for event in events:
        if isinstance(event, Reading):
            last = event
            continue
        if command is not None and last.time > command.time + 1.5:
            starts.append(command.time)
            errors.append(last.position - command.target)
        command = event
    return np.array(starts), np.array(errors)


def test_events_come_in_order_and_commands_every_two_seconds(armpi, measured_armpi):
    events = life(armpi, measured_armpi, seconds=60.0)
    assert np.all(np.diff([event.time for event in events]) >= 0.0)
    commands = [event.time for event in events if isinstance(event, CommandSent)]
    assert commands[0] == 1.0
    pauses = np.diff(commands)
    assert np.all((pauses > 1.99) & (pauses < 2.05 + measured_armpi.timing.late_s[1]))
    time, _ = readings(events)
    assert 7.0 < len(time) / 60.0 <= 10.0  # 10 Hz but for what a stalled bus swallows


def test_the_same_seed_gives_the_same_life(armpi, measured_armpi):
    one, two, other = (life(armpi, measured_armpi, seconds=20.0, seed=s) for s in (1, 1, 2))
    assert_array_equal(readings(one)[1], readings(two)[1])
    assert not np.array_equal(readings(one)[1][:50], readings(other)[1][:50])


@pytest.mark.parametrize("mode", ["stuck", "steady_state_error"])
def test_what_a_fault_does_is_the_difference_to_the_same_life_without_it(
    armpi, measured_armpi, mode
):
    with_it, without = (
        life(armpi, measured_armpi, faults) for faults in ([f"motor_1:{mode}@20-40"], [])
    )
    told = [
        np.array([e.target for e in events if isinstance(e, CommandSent)])
        for events in (with_it, without)
    ]
    assert_array_equal(*told)
    (time, here), (_, there) = readings(with_it), readings(without)
    off = np.nan_to_num(np.abs(here - there))
    assert np.all(off[time < 20.0] == 0.0)
    assert np.median(off[(time > 23.0) & (time < 40.0), 0]) > 0.02
    assert off[:, 3].max() < 0.01


def test_a_healthy_arm_goes_where_it_is_told(armpi, measured_armpi):
    _, errors = settled_errors(life(armpi, measured_armpi, seconds=100.0))
    # Settled errors of the real arm are a few counts of 0.24 deg; a lost command is far off.
    assert np.nanmedian(np.abs(np.rad2deg(errors))) < 1.5


def test_a_stuck_motor_stands_still_until_it_is_repaired(armpi):
    events = life(armpi, NO_IMPERFECTIONS, ["motor_3:stuck@10-20"], seconds=30.0)
    time, position = readings(events)
    inside = (time > 10.05) & (time < 20.0)
    assert np.ptp(position[inside, 2]) < np.deg2rad(1.5)  # the joint flexes behind its gear
    assert np.ptp(position[inside, 1]) > np.deg2rad(5.0)
    starts, errors = settled_errors(events)
    after = starts > 20.5
    assert after.any()
    assert np.abs(errors[after, 2]).max() < np.deg2rad(3.0)


def test_a_motor_that_misses_its_targets_does_so_while_it_is_faulty(armpi):
    events = life(armpi, NO_IMPERFECTIONS, ["motor_2:steady_state_error@20-60"], seconds=90.0)
    starts, errors = settled_errors(events)
    faulty = (starts > 20.0) & (starts < 60.0)
    # The paper's errors are 10 to 50 counts; the arm itself adds its sag.
    assert np.median(np.abs(np.rad2deg(errors[faulty, 1]))) > 4.0
    healthy_again = starts > 60.0
    assert np.abs(np.rad2deg(errors[healthy_again, 1])).max() < 3.0


def test_motors_report_the_last_goal_that_arrived(armpi, measured_armpi):
    """Whatever they do with it: a stuck motor receives its goals, a lost command never comes."""
    events = life(armpi, measured_armpi, ["motor_2:stuck@0-400"], seconds=400.0)
    told, arrived = None, []
    for event, after in pairwise(events):
        if isinstance(event, CommandSent):
            told = event.target
        elif told is not None and isinstance(after, CommandSent):
            arrived.append(event.goal == told)
    lost = 1.0 - np.mean(arrived, axis=0)
    rates = dict.fromkeys(armpi.motor_names, 0.0)
    for entry in measured_armpi.lost_commands:
        for motor in entry.motors:
            rates[motor] += entry.rate
    expected = np.array(list(rates.values()))
    assert len(arrived) > 100
    assert np.all(np.abs(lost - expected) < 4.0 * np.sqrt((expected + 0.01) / len(arrived)))


def test_readings_are_the_tool_path_of_the_motors(armpi, twin, measured_armpi):
    for event in life(armpi, measured_armpi, seconds=20.0):
        if isinstance(event, Reading) and np.isfinite(event.tool).all():
            assert_allclose(event.tool, twin.path(event.position), atol=1e-12)


def test_a_fault_that_never_ends_stays(armpi):
    time, position = readings(life(armpi, NO_IMPERFECTIONS, ["motor_1:stuck@5"], seconds=40.0))
    assert np.ptp(position[time > 5.05, 0]) < np.deg2rad(1.0)


def test_a_motor_that_sticks_now_and_then_misses_some_movements_until_it_is_repaired(armpi):
    fault = ["motor_1:intermittent@5-65"]
    start, error = settled_errors(life(armpi, NO_IMPERFECTIONS, fault, seconds=100.0))
    off = np.abs(error) > np.deg2rad(4.0)  # more than gravity and friction do
    there = (start > 5.0) & (start < 63.0)
    assert not off[:, 1:].any()
    assert not off[~there & ((start < 3.0) | (start > 65.0)), 0].any()
    assert 2 <= off[there, 0].sum() < 0.7 * there.sum()


def test_a_fault_beside_one_that_comes_and_goes_has_the_luck_that_it_has_alone(armpi):
    other = "motor_3:steady_state_error@0"
    _, alone = settled_errors(life(armpi, NO_IMPERFECTIONS, [other], seconds=30.0))
    both = life(armpi, NO_IMPERFECTIONS, [other, "motor_1:intermittent@0"], seconds=30.0)
    assert_allclose(settled_errors(both)[1][:, 2], alone[:, 2], atol=np.deg2rad(1.0))


@pytest.mark.parametrize("text", ["motor_3:stuck", "motor_3:stuck@", "motor_3@5", "@5", "x@1.2.3"])
def test_a_fault_in_another_form_is_refused(armpi, text):
    with pytest.raises(InputError, match=r"MOTOR:MODE"):
        ScheduledFault.parse(text, armpi.motor_names)


@pytest.mark.parametrize("text", ["motor_3:stuck@80-40", "motor_3:stuck@40-40"])
def test_a_fault_that_ends_before_it_begins_is_refused(armpi, text):
    with pytest.raises(InputError, match="an end after it"):
        ScheduledFault.parse(text, armpi.motor_names)


def test_the_state_at_a_time(armpi):
    names = armpi.motor_names
    texts = ["motor_3:stuck@40-80", "motor_1:drift@60-70"]
    schedule = [ScheduledFault.parse(text, names) for text in texts]
    states = {t: state_at(schedule, t, names) for t in (0.0, 40.0, 65.0, 75.0, 80.0)}
    assert states == {
        0.0: "healthy",
        40.0: "motor_3:stuck",
        65.0: "motor_1:drift+motor_3:stuck",
        75.0: "motor_3:stuck",
        80.0: "healthy",
    }
