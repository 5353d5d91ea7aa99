"""Not one order outside: limits, speed, floor, own links, whatever is wrong or believed."""

from __future__ import annotations

import numpy as np
import pytest
from small_world import SmallWorld, believed, carry_out, task_of

from failuretwin import InputError, load_robot
from failuretwin.connection.links.base import Order
from failuretwin.decision.acting.belief import Belief
from failuretwin.decision.acting.believed_arm import BelievedArm
from failuretwin.decision.acting.planner import Planner, Standing
from failuretwin.decision.acting.safety import RISE_S, SafetyGate, SafetyLimits
from failuretwin.decision.acting.task import Target
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.inverse_kinematics import usable_limits
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.observation.healthy_model import HealthyModel

FINER = 7
"""An outside look at ways, with so many poses between those that the gate looks at."""


def lines(robot, pose):
    """Points of base, joints and tool by the chain's own kinematics, link by link, (point, 3)."""
    points, here = [np.zeros(3)], np.eye(4)
    for joint, angle in zip(robot.loads.chain.joints, pose * robot.sense, strict=True):
        here = here @ joint.T_pj
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
        here = here @ turn
        points.append(here[:3, 3])
    return np.array([*points, (here @ robot.loads.chain.T_jt)[:3, 3]])


def apart(points, i, j, count=40):
    share = np.linspace(0.0, 1.0, count)[:, None]
    a = points[i] + share * (points[i + 1] - points[i])
    b = points[j] + share * (points[j + 1] - points[j])
    return np.linalg.norm(a[:, None] - b[None], axis=-1).min()


def violations(gate, previous, order, samples=FINER):
    """What an order does that it must not, seen from outside the gate."""
    robot, found = gate.robot, []
    low, high = robot.limits.T
    if np.any(order.target < low - 1e-9) or np.any(order.target > high + 1e-9):
        found.append("limits")
    travel = np.abs(order.target - previous)
    top = np.array([motor.speed_limit for motor in robot.motors])
    if np.any(travel / order.duration > gate.limits.speed_share * top * (1 + 1e-9)):
        found.append("speed")
    if np.any(4 * travel / order.duration**2 > top / RISE_S * (1 + 1e-9)):
        found.append("acceleration")
    for share in np.linspace(0.0, 1.0, samples):
        points = lines(robot, previous + share * (order.target - previous))
        if points[gate.clearance._first_moved :, 2].min() < gate.clearance.floor_m - 1e-9:
            found.append("floor")
        for i, j in gate.clearance.pairs:
            if apart(points, i, j) < 2 * gate.clearance.radius_m - 1e-9:
                found.append(f"links {i} and {j}")
    return found


def random_case(model, gate, rng):
    """One random arm, belief and target: the order that is planned for it, and from where."""
    robot = model.twin.robot
    low, high = np.array([motor.movement_range for motor in robot.motors]).T
    command = BelievedArm(model).rounded(rng.uniform(low, high))
    motor, fault = int(rng.integers(len(low))), None
    mode = str(rng.choice([*MODES, "healthy"]))
    if mode != "healthy":
        least, most = MODES[mode].considered
        size = float(rng.uniform(least, most)) if np.isfinite(most) else np.nan
        angle = float(rng.uniform(*robot.travel[motor])) if rng.random() < 0.7 else np.nan
        fault = believed(robot, motor, mode, size, angle)
    arm = BelievedArm(model, fault)
    pose = arm.settle(command, command, 0.0)
    scale = robot.reach
    point = rng.uniform([-scale, -scale, -0.1 * scale], [scale, scale, scale])
    planner = Planner(gate, rng.random(len(low)) if rng.random() < 0.3 else None)
    direction = tuple(rng.normal(size=3)) if rng.random() < 0.3 else None
    plan = planner.plan(
        Target(tuple(point), direction, 0.005 if direction is None else 0.1),
        arm,
        Standing(pose, command, float(rng.uniform(0.0, 9.0)), rng.normal(size=len(low))),
    )
    return command, plan


def model_of(name):
    known = load_calibration(None, name)
    return HealthyModel.of(known.twin, known.imperfections)


def look_at_cases(name, count, seed):
    model = model_of(name)
    gate, rng, planned = SafetyGate(model.twin.robot), np.random.default_rng(seed), 0
    for _ in range(count):
        command, plan = random_case(model, gate, rng)
        if plan.order is not None:
            planned += 1
            assert violations(gate, command, plan.order) == []
    return planned


@pytest.mark.parametrize("name", ["armpi_fpv", "ur5e", "panda"])
def test_no_plan_of_random_arms_beliefs_and_targets_is_outside(name):
    assert look_at_cases(name, 30, 1) > 10


@pytest.mark.slow
@pytest.mark.parametrize("name", ["armpi_fpv", "ur5e", "panda", "so101"])
def test_no_plan_of_ten_thousand_is_outside(name):
    assert look_at_cases(name, 2500, 2) > 500


@pytest.mark.parametrize("seed", range(6))
def test_no_order_of_the_loop_is_outside(model, armpi, seed):
    rng = np.random.default_rng(seed)
    modes = ["stuck", "steady_state_error", "encoder_bias", "encoder_scale"]

    def drawn():
        motor, mode = int(rng.integers(4)), str(rng.choice(modes))
        size = float(rng.uniform(0.05, 0.5))
        return believed(armpi, motor, mode, size, size if mode == "stuck" else np.nan)

    world = SmallWorld(model, seed, drawn(), lost={4, 9})
    carry_out(world, Belief(model, believed=drawn()), task_of(armpi, 5, seed), steps=25)
    gate = SafetyGate(armpi)
    assert len(world.orders) > 4
    # A gate knows what was ordered, not that it was lost: ways go from order to order.
    previous = world.orders[0][0]
    for _, order in world.orders:
        assert violations(gate, previous, order) == []
        previous = order.target


def test_the_gate_says_what_is_wrong(armpi):
    gate, home = SafetyGate(armpi), np.zeros(4)
    slow = np.full(4, 3.0)

    def said(target, duration=slow):
        return gate.wrong(Order(np.array(target), duration), [(home, np.array(target))])

    assert said([0.5, 0.3, 0.2, 0.1]) == ""
    assert "leave its limits" in said([0.0, 1.8, 0.0, 0.0])
    assert "faster" in said([1.0, 0.0, 0.0, 0.0], np.full(4, 0.05))
    assert "the floor" in said([0.0, 1.57, -0.9, 0.6])
    assert "not finite" in said([np.nan, 0.0, 0.0, 0.0])
    narrow = SafetyGate(armpi, SafetyLimits(radius_m=0.016, floor_m=-1.0))
    fold = np.array([0.0, 1.57, -2.09, 2.09])
    assert "own links" in narrow.wrong(Order(fold, slow), [(home, fold)])


def test_a_way_is_looked_at_as_believed_too(armpi):
    gate, home = SafetyGate(armpi), np.zeros(4)
    target = np.array([0.3, 0.2, 0.1, 0.0])
    bowed = np.array([0.0, 1.57, -0.9, 0.6])
    order = Order(target, np.full(4, 3.0))
    assert gate.wrong(order, [(home, target)]) == ""
    assert "the floor" in gate.wrong(order, [(home, target), (home, bowed)])


def test_an_arm_that_is_too_near_may_only_get_away(armpi):
    gate = SafetyGate(armpi)
    low = np.array([0.0, 1.57, -0.9, 0.6])
    assert gate.in_the_way([(low, np.zeros(4))]) == ""
    assert gate.in_the_way([(low, low + np.array([0.0, 0.0, -0.05, 0.1]))]) != ""


def test_durations_keep_speed_and_acceleration(armpi):
    gate = SafetyGate(armpi, SafetyLimits(speed_share=0.25))
    for travel in (0.01, 0.3, 2.0):
        away = np.array([travel, 0.0, -0.5 * travel, 0.0])
        order = Order(away, np.full(4, gate.least_duration(away)))
        found = violations(gate, np.zeros(4), order, samples=1)
        assert "speed" not in found
        assert "acceleration" not in found


@pytest.mark.parametrize("wrong", [{"speed_share": 0.0}, {"speed_share": 1.5}])
def test_limits_that_make_no_sense_are_refused(wrong):
    with pytest.raises(InputError):
        SafetyLimits(**wrong)


def test_usable_limits_lie_within_those_of_the_joints():
    for name in ("armpi_fpv", "ur5e", "panda", "so101"):
        robot = load_robot(name)
        low, high = usable_limits(robot)
        assert np.all(low >= robot.limits[:, 0])
        assert np.all(high <= robot.limits[:, 1])
