"""Approach directions: planned, fed back by the believed arm, and part of what "reached" means."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_world import SmallWorld, believed, carry_out, task_of, task_with_directions

from failuretwin.decision.acting.belief import Belief
from failuretwin.decision.acting.reach import reach
from failuretwin.decision.acting.safety import SafetyGate
from failuretwin.decision.acting.task import DIRECTION_TOLERANCE_RAD, ActingSettings, Target, Task


def axis_of(robot, pose):
    """Z of the tool frame, by the chain's own frames one by one."""
    here = np.eye(4)
    for joint, angle in zip(robot.chain.joints, pose * robot.sensor_sense, strict=True):
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
        here = here @ joint.T_pj @ turn
    return (here @ robot.chain.T_jt)[:3, 2]


def ends(model, truth, belief, task, judged=True):
    """Each target's result, and how far the tool's true axis was from its direction then [rad]."""
    world, turned = SmallWorld(model, 1, truth), []
    settings = ActingSettings()
    actor = None
    for target in task.targets:
        actor = carry_out(world, belief, Task((target,)), settings, judged=judged)
        cosine = axis_of(model.twin.robot, world.pose) @ target.axis
        turned.append((actor.results[0], float(np.arccos(np.clip(cosine, -1.0, 1.0)))))
    return turned


def test_directions_are_held_by_a_healthy_arm(model, armpi):
    found = ends(model, None, None, task_with_directions(armpi, 8, 3))
    assert all(result.reached for result, _ in found)
    assert max(turned for _, turned in found) < DIRECTION_TOLERANCE_RAD + np.deg2rad(2.0)


def test_feedback_turns_the_tool_back_where_a_wrong_size_is_believed(model, armpi):
    """Half of the error is believed; without the direction fed back the tool would stay turned."""
    truth = believed(armpi, 3, "encoder_bias", 0.3)
    told = replace(truth, size=0.15, spread=0.3)
    task = task_with_directions(armpi, 8, 3)
    found = ends(model, truth, Belief(model, told), task, judged=False)
    reached = [turned for result, turned in found if result.reached]
    assert len(reached) >= 6
    assert max(reached) < DIRECTION_TOLERANCE_RAD + np.deg2rad(3.0)


def test_a_tool_that_points_elsewhere_has_not_reached_its_target(model, armpi):
    """A motor that nobody knows to be off: the tool comes to its point, turned."""
    truth = believed(armpi, 3, "encoder_bias", 0.3)
    task = task_with_directions(armpi, 8, 3)
    knows = ends(model, truth, Belief(model, believed=truth), task)
    assert sum(result.reached for result, _ in knows) >= 6
    for result, turned in knows:
        if result.reached:
            assert turned < DIRECTION_TOLERANCE_RAD + np.deg2rad(2.0)
            assert result.error_rad == pytest.approx(turned, abs=np.deg2rad(3.0))


def test_no_direction_is_asked_of_points(model, armpi):
    actor = carry_out(SmallWorld(model, 1), None, task_of(armpi, 3))
    assert [result.error_rad for result in actor.results] == [0.0] * 3


def test_a_direction_that_no_pose_has_is_out_of_reach_and_said(model, armpi):
    point = task_of(armpi, 1, 3).targets[0].position
    sideways = (-point[1], point[0], 0.0)  # across the plane in which the arm bends
    actor = carry_out(SmallWorld(model, 1), None, Task((Target(point, sideways),)))
    assert actor.results[0].movements == 0
    assert "out of reach by" in actor.results[0].why
    assert "deg" in actor.results[0].why


def test_reach_counts_directions(armpi):
    task = task_with_directions(armpi, 12, 3)
    points = Task(tuple(Target(target.position) for target in task.targets))
    across = Task(tuple(
        Target(t.position, (-t.position[1], t.position[0], 0.0)) for t in task.targets
    ))  # fmt: skip
    mixed = Task((*points.targets[:6], *across.targets[6:]))
    gate = SafetyGate(armpi)
    assert reach(gate, points).reached.sum() >= reach(gate, task).reached.sum() >= 8
    assert reach(gate, across).reached.sum() == 0
    assert reach("armpi_fpv", across).reached.sum() == 0
    assert reach(gate, mixed).reached.tolist()[6:] == [False] * 6
    assert reach(gate, mixed).reached[:6].sum() >= 4
    assert None in reach(gate, across).record()["miss_m"]
