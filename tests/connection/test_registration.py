from __future__ import annotations

import numpy as np
import pytest
from dh_arms import UR5, forward, robot_in, urdf
from scipy.spatial.transform import Rotation

from failuretwin.connection.registration.arm import Arm, Fitted, Poses, Start
from failuretwin.connection.registration.fit import register
from failuretwin.core.errors import InputError
from failuretwin.digital_model.robot import _assembled
from failuretwin.inference.set_ups.registration import Frame

STRAIGHT = """<robot name="straight"><link name="base"/>
<joint name="turn" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/>
<limit lower="-2" upper="2" velocity="2" effort="1"/></joint><link name="a"/>
<joint name="lift" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0 0 0.1"/>
<axis xyz="0 1 0"/><limit lower="-2" upper="2" velocity="2" effort="1"/></joint><link name="b"/>
<joint name="bend" type="revolute"><parent link="b"/><child link="c"/><origin xyz="0 0 0.3"/>
<axis xyz="0 1 0"/><limit lower="-2" upper="2" velocity="2" effort="1"/></joint><link name="c"/>
<joint name="mount" type="fixed"><parent link="c"/><child link="tip"/><origin xyz="0 0 0.2"/>
</joint><link name="tip"/></robot>"""
"""An arm that is its own picture when turned by half a turn about z at zero."""
SHORT, ASIDE = tuple(figures[:4] for figures in UR5), np.array([0.08, 0.0, 0.05])
"""The first four joints of a UR5, and a tool point beside the axis of the last."""


@pytest.fixture
def robot(tmp_path):
    return robot_in(tmp_path, urdf())


def commands(rng, count, motors=5, widest=2.0):
    return rng.uniform(-widest, widest, (count, motors))


def frame(rng):
    return Rotation.random(random_state=int(rng.integers(1 << 30))), rng.uniform(-3.0, 3.0, 3)


def seen(rng, q, turn, origin, noise=3e-4, dh=UR5):
    return turn.apply(forward(q, dh)) + origin + rng.normal(0.0, noise, (len(q), 3))


def value(found, name, motor=""):
    (parameter,) = (p for p in found.parameters if (p.name, p.motor) == (name, motor))
    return parameter


def fitted_path(found, robot, q):
    made = _assembled(found.profile, robot.source)
    return made.chain.position(q * made.sensor_sense)


@pytest.mark.parametrize("sliding", [None, "joint_1", "joint_3"])
def test_slopes_are_those_of_differences(tmp_path, sliding):
    text, sense = urdf(), np.array([1.0, -1.0, 1.0, 1.0, -1.0])
    if sliding is not None:
        turns = f'name="{sliding}" type="revolute"'
        text = text.replace(turns, turns.replace("revolute", "prismatic"))
        assert "prismatic" in text
    arm, rng = Arm(robot_in(tmp_path, text)), np.random.default_rng(3)
    turn, origin = frame(rng)
    start = Start(sense, np.zeros(5), Frame(turn.as_matrix(), origin, 0.0))
    unknowns = arm.details()
    values, step = rng.normal(size=len(unknowns)) * unknowns.spread, 1e-5 * unknowns.spread
    target = commands(rng, 6)
    torque = arm.torque(target, start)

    def expected(values):
        return Fitted(arm, start, unknowns, values).expected(target, torque)

    found = Fitted(arm, start, unknowns, values).slopes(target, torque)
    for i, size in enumerate(step):
        off = size * np.eye(len(step))[i]
        differences = (expected(values + off) - expected(values - off)) / (2.0 * size)
        assert found[..., i] == pytest.approx(differences, rel=1e-5, abs=1e-7), unknowns[i]


def test_a_frame_far_off_is_found(robot):
    rng = np.random.default_rng(1)
    turn, origin = frame(rng)
    q = commands(rng, 40)
    found = register(Poses(q, seen(rng, q, turn, origin)), robot)

    fresh = commands(rng, 100)
    error = fitted_path(found, robot, fresh) - seen(rng, fresh, turn, origin, noise=0.0)
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 0.6e-3
    assert found.before_mm > 500.0
    assert 2e-4 < found.noise_m < 4e-4


@pytest.mark.parametrize("turned", [(1,), (0, 3)])
def test_senses_are_found_and_told(robot, turned):
    rng = np.random.default_rng(2)
    turn, origin = frame(rng)
    q, sense = commands(rng, 60), np.ones(5)
    sense[list(turned)] = -1.0
    found = register(Poses(q, seen(rng, q * sense, turn, origin)), robot)

    assert [motor.sense for motor in found.profile.motors] == sense.tolist()
    for motor in turned:
        assert any(f"motor_{motor + 1} turns the other way" in line for line in found.remarks)


def test_large_zeros_are_found(robot):
    rng = np.random.default_rng(3)
    turn, origin = frame(rng)
    q, zero = commands(rng, 60), np.radians([0.0, 90.0, -30.0, 5.0, 0.0])
    found = register(Poses(q, seen(rng, q + zero, turn, origin)), robot)

    for motor, expected in ((2, 90.0), (3, -30.0), (4, 5.0)):
        assert np.degrees(value(found, "zero", f"motor_{motor}").value) == pytest.approx(
            expected, abs=0.3
        )


@pytest.mark.parametrize("arms", [3, pytest.param(10, marks=pytest.mark.slow)])
def test_truth_lies_in_95_per_cent_intervals(robot, arms):
    rng = np.random.default_rng(4)
    inside = []
    for _ in range(arms):
        turn, origin = frame(rng)
        a, d, alpha = (list(figures) for figures in UR5)
        longer = rng.normal(0.0, 0.002, 2)
        a[1] += longer[0]
        a[2] += longer[1]
        zero = np.r_[0.0, rng.normal(0.0, 0.05, 3), 0.0]
        q = commands(rng, 50)
        found = register(Poses(q, seen(rng, q + zero, turn, origin, dh=(a, d, alpha))), robot)
        truth = {(f"base {axis}", ""): x for axis, x in zip("xyz", origin, strict=True)}
        truth |= {("zero", f"motor_{j}"): zero[j - 1] for j in (2, 3, 4)}
        truth |= {("axis shift x", f"motor_{j}"): longer[j - 3] for j in (3, 4)}
        truth |= {(f"tool {axis}", ""): 0.0 for axis in "xyz"}
        for key, true in truth.items():
            parameter = value(found, *key)
            inside.append(parameter.low <= true <= parameter.high)
    assert len(inside) == 11 * arms
    assert np.mean(inside) > 0.87


def test_poses_that_lost_a_command_do_not_spoil_the_fit(robot):
    rng = np.random.default_rng(5)
    turn, origin = frame(rng)
    q = commands(rng, 80)
    point = seen(rng, q, turn, origin)
    point[::10] += rng.uniform(-0.3, 0.3, (8, 3))
    found = register(Poses(q, point), robot)

    fresh = commands(rng, 50)
    error = fitted_path(found, robot, fresh) - seen(rng, fresh, turn, origin, noise=0.0)
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 0.6e-3


def test_a_scale_that_lengths_could_explain_is_told_open(robot):
    rng = np.random.default_rng(6)
    q = commands(rng, 100)
    found = register(Poses(q, seen(rng, q, Rotation.identity(), np.zeros(3))), robot)
    assert any("sensor scale" in line and "joint_3" in line for line in found.not_told)


def test_an_arm_that_is_its_own_mirror_picture_is_told(tmp_path):
    robot = robot_in(tmp_path, STRAIGHT)
    rng = np.random.default_rng(7)
    q = commands(rng, 60, motors=3, widest=1.5)
    # The tool of the straight arm, by hand: radius and height of two links.
    lift, bend = q[:, 1], q[:, 1] + q[:, 2]
    radius, height = (
        0.3 * np.sin(lift) + 0.2 * np.sin(bend),
        0.1 + 0.3 * np.cos(lift) + 0.2 * np.cos(bend),
    )
    point = np.stack([radius * np.cos(q[:, 0]), radius * np.sin(q[:, 0]), height], axis=1)
    found = register(Poses(q, point + rng.normal(0.0, 3e-4, point.shape)), robot)

    assert [motor.sense for motor in found.profile.motors] == [1.0, 1.0, 1.0]
    either = [line for line in found.remarks if line.startswith("either as fitted, or with ")]
    assert any("motor_2, motor_3 turning the other way" in line for line in either)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda q, p: (q, 1000.0 * p), "look like millimetres"),
        (lambda q, p: (q, 100.0 * p), "look like centimetres"),
        (lambda q, p: (np.degrees(q), p), "look like degrees"),
        (lambda q, p: (q[:, [0, 2, 1, 3]], p), "motor 2 and motor 3 are swapped"),
        (lambda q, p: (q, p[::-1]), "Check that the logs are of this robot"),
    ],
)
def test_simple_mistakes_are_named_and_nothing_is_fitted(tmp_path, spoil, message):
    robot = robot_in(tmp_path, urdf(SHORT, ASIDE))
    rng = np.random.default_rng(8)
    turn, origin = frame(rng)
    q = commands(rng, 40, motors=4)
    point = turn.apply(forward(q, SHORT, ASIDE)) + origin
    with pytest.raises(InputError, match=message):
        register(Poses(*spoil(q, point)), robot)


def test_few_poses_say_how_many_would_do(robot):
    rng = np.random.default_rng(9)
    q = commands(rng, 30)
    found = register(Poses(q, seen(rng, q, *frame(rng))), robot)
    assert any("30 poses for 24 unknowns: 48 poses" in line for line in found.remarks)
