"""A motor that sticks now and then: found, parked where it helps, and told to stay there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_world import SmallWorld, believed, carry_out, task_of

from failuretwin.decision.acting.belief import Belief, Judge
from failuretwin.decision.acting.believed_arm import BelievedArm, Seen
from failuretwin.decision.acting.reach import parking_place
from failuretwin.decision.acting.safety import SafetyGate
from failuretwin.decision.acting.task import Task
from failuretwin.digital_model.inverse_kinematics import InverseKinematics


def reached(actor):
    return sum(result.reached for result in actor.results)


def moves(actor):
    return sum(result.movements for result in actor.results)


def seen_at(model, command, previous, stands):
    """A movement after which the arm stands somewhere."""
    duration = np.full(len(command), 0.8)
    return Seen(command, previous, duration, 0.0, 1.5, model.twin.path(stands))


def test_it_is_found_parked_and_told_before_it_is_moved(model, armpi):
    truth = believed(armpi, 2, "intermittent", 0.5)
    task = task_of(armpi, 16, 3)
    world, other = SmallWorld(model, 1, truth), SmallWorld(model, 1, truth)
    ours = carry_out(world, Belief(model), task)
    alone = carry_out(other, None, task)
    assert str(ours.belief.believed.fault) == "motor_3:intermittent"
    assert reached(ours) >= reached(alone)
    assert moves(ours) < moves(alone)
    assert any("motor_3 is parked at" in text for text in ours.said)
    told, without = (np.array([o.target[2] for _, o in w.orders]) for w in (world, other))
    assert np.ptp(told[-9:]) < 0.1 < np.ptp(without[-9:])
    assert abs(told[-1] - ours.belief.believed.angle) < 0.15  # what gravity does is taken off


def test_a_target_that_needs_the_parked_motor_gets_it(model, armpi):
    truth = believed(armpi, 0, "intermittent", 0.4)
    belief = Belief(model, believed=truth, lead=8.0)
    actor = carry_out(SmallWorld(model, 2, truth), belief, task_of(armpi, 8, 3))
    assert reached(actor) == 8  # with motor 1 at rest nine targets of ten are out of reach


@pytest.mark.parametrize("seed", range(4))
def test_a_healthy_arm_is_not_taken_for_one(model, armpi, seed):
    lossy = SmallWorld(model, seed, lost={3, 9}, losers=[0])
    actor = carry_out(lossy, Belief(model), task_of(armpi, 10, seed))
    assert actor.belief.believed is None
    assert reached(actor) == 10


def test_a_parked_motor_that_stops_elsewhere_is_taken_for_stuck(model, armpi):
    start = believed(armpi, 1, "intermittent", 0.4)
    world = SmallWorld(model, 5, believed(armpi, 1, "stuck", 0.9, 0.9))
    actor = carry_out(world, Belief(model, believed=start), task_of(armpi, 8, 5))
    assert str(actor.belief.believed.fault) == "motor_2:stuck"
    assert actor.belief.believed.angle == pytest.approx(0.9, abs=0.03)


# Where to park.


def test_it_is_parked_where_all_targets_need_it(armpi):
    rng, gate = np.random.default_rng(0), SafetyGate(armpi)
    low, high = np.array([motor.movement_range for motor in armpi.motors]).T
    pose = rng.uniform(low, high, (8, 4))
    pose[:, 1] = -0.25
    tools = InverseKinematics.of(armpi).tool(pose)[0]
    pose = pose[gate.clearance.margin(pose) > 0.01]
    tools = InverseKinematics.of(armpi).tool(pose)[0]
    place = parking_place(gate, 1, Task.of_points(tools).targets, 1.2)
    there = parking_place(gate, 1, Task.of_points(tools).targets, -0.25)
    assert there.angle == -0.25
    assert there.reached.sum() == len(there.points) == len(tools)
    assert place.reached.sum() <= there.reached.sum()
    assert abs(place.angle + 0.25) < 0.4


def test_of_places_that_are_as_good_the_nearest_is_taken(armpi):
    target = task_of(armpi, 1, 3).targets
    for stands in (-0.2, 0.1):
        place = parking_place(SafetyGate(armpi), 3, target, stands)
        assert place.reached.sum() == 1
        assert place.angle == stands


# What movements say of it.


def test_a_motor_on_its_way_is_what_such_an_arm_does_and_a_healthy_one_does_not(model, armpi):
    fault = believed(armpi, 1, "intermittent", 0.5)
    arm, healthy = BelievedArm(model, fault), BelievedArm(model)
    previous, command = np.array([0.2, -0.4, 0.3, 0.1]), np.array([-0.3, 0.5, 0.0, 0.4])
    arrived = seen_at(model, command, previous, healthy.settle(command, previous, 1.5))
    midway = command.copy()
    midway[1] = 0.1
    stopped = seen_at(model, command, previous, healthy.settle(midway, previous, 1.5))
    gain = arm.log_density(arrived) - healthy.log_density(arrived)
    assert gain == pytest.approx(np.log(1.0 - 0.5 * (0.1 + 0.3)), abs=0.02)
    assert arm.log_density(stopped) > healthy.log_density(stopped) + 5.0
    assert arm.lost_command(stopped) == [1]
    assert healthy.lost_command(stopped) == []
    assert arm.lost_command(arrived) == []
    unmoved = replace(arrived, previous=np.where([False, True, False, False], command, previous))
    gain = arm.log_density(unmoved) - healthy.log_density(unmoved)
    assert abs(gain) < 0.05  # a motor that is told nothing new says nothing


def test_the_posterior_finds_it_by_a_movement_that_ended_midway(model, armpi):
    rng, healthy = np.random.default_rng(3), BelievedArm(model)
    low, high = np.array([motor.movement_range for motor in armpi.motors]).T
    window, previous = [], np.zeros(4)
    for i in range(5):
        command = rng.uniform(low, high)
        goes_for = command.copy()
        if i in (1, 3):
            goes_for[2] = previous[2] + 0.45 * (command[2] - previous[2])
        pose = healthy.settle(goes_for, previous, 0.0)
        duration = np.full(4, 0.8)
        window.append(
            Seen(command, previous, duration, 2.0 * i, 2.0 * i + 1.5, model.twin.path(pose))
        )
        previous = command
    found = Judge(model)(window, None)
    assert str(found.best) == "motor_3:intermittent"
    assert found.probability(found.best) > 0.9
