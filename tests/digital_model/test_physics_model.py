from __future__ import annotations

import sys
from dataclasses import replace

import lone_joint
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from failuretwin import load_robot
from failuretwin.core.errors import InputError
from failuretwin.digital_model.physics.arm import TOOL, arm_spec
from failuretwin.digital_model.physics.engine import PhysicsEngine, limit_speed, refine
from failuretwin.digital_model.physics.model import build_model
from failuretwin.digital_model.physics.motors import default_parameters, load_parameters
from failuretwin.digital_model.robot import bundled_robots
from failuretwin.digital_model.servo import first_order_lag
from failuretwin.digital_model.twin import Drive

mujoco = pytest.importorskip("mujoco")

ROBOTS = bundled_robots()


def poses_of(robot, count=50):
    low, high = np.array([motor.movement_range for motor in robot.motors]).T
    return np.random.default_rng(3).uniform(low, high, (count, len(low)))


def imported_as_it_is(robot):
    """Return MuJoCo's own reading of the URDF, and where the motors are in it."""
    judge = mujoco.MjModel.from_xml_path(str(robot.urdf_file))
    return judge, [judge.joint(motor.joint).qposadr[0] for motor in robot.motors]


@pytest.mark.parametrize("name", ROBOTS)
def test_drives_carry_what_mujoco_makes_of_the_urdf(name):
    robot = load_robot(name)
    judge, motors = imported_as_it_is(robot)
    model = build_model(robot, default_parameters(robot).motors, 0.001)
    mine, other = mujoco.MjData(model.compiled), mujoco.MjData(judge)
    share = np.random.default_rng(4).uniform(0.0, 1.0, len(motors))
    for pose in poses_of(robot):
        mine.qpos[model.drive], mine.qpos[model.flex] = share * pose, (1.0 - share) * pose
        other.qpos[motors] = pose
        mujoco.mj_forward(model.compiled, mine)
        mujoco.mj_forward(judge, other)

        expected = other.qfrc_bias[motors]
        np.testing.assert_allclose(mine.qfrc_bias[model.drive], expected, rtol=0, atol=1e-7)
        np.testing.assert_allclose(mine.qfrc_bias[model.flex], expected, rtol=0, atol=1e-7)


@pytest.mark.parametrize("name", ROBOTS)
def test_arm_resists_acceleration_as_mujoco_makes_of_the_urdf(name):
    robot = load_robot(name)
    judge, motors = imported_as_it_is(robot)
    arm = arm_spec(robot).compile()
    mine, other = mujoco.MjData(arm), mujoco.MjData(judge)
    rng = np.random.default_rng(5)
    for pose in poses_of(robot):
        speed, acceleration = rng.normal(size=(2, len(motors)))
        for model, data, at in ((arm, mine, slice(None)), (judge, other, motors)):
            data.qpos[at], data.qvel[at], data.qacc[at] = pose, speed, acceleration
            mujoco.mj_inverse(model, data)

        np.testing.assert_allclose(
            mine.qfrc_inverse, other.qfrc_inverse[motors], rtol=1e-6, atol=1e-7
        )


@pytest.mark.parametrize("name", ROBOTS)
def test_tool_is_where_the_chain_puts_it(name):
    robot = load_robot(name)
    arm = arm_spec(robot).compile()
    data = mujoco.MjData(arm)
    for pose in poses_of(robot):
        data.qpos[:] = pose
        mujoco.mj_kinematics(arm, data)
        np.testing.assert_allclose(
            data.site(TOOL).xpos, robot.chain.position(pose), rtol=0, atol=1e-9
        )


def test_gravity_is_that_of_the_base_frame(tmp_path):
    upright = lone_joint.pendulum(tmp_path)
    tilted = upright.urdf_file.read_text().replace('link name="base"/>', 'link name="root"/>')
    tilted = tilted.replace(
        '<link name="rod">',
        '<link name="base"/><joint name="tilt" type="fixed"><parent link="root"/>'
        '<child link="base"/><origin xyz="1 2 3" rpy="0.4 -0.9 1.3"/></joint><link name="rod">',
    )
    upright.urdf_file.write_text(tilted)
    arm = arm_spec(load_robot(tmp_path / "rod.toml")).compile()
    data = mujoco.MjData(arm)
    data.qpos[0] = 0.6
    mujoco.mj_forward(arm, data)

    weight = lone_joint.MASS_KG * 9.81
    expected = -weight * lone_joint.ROD_M * np.sin(0.6)
    np.testing.assert_allclose(data.qfrc_bias, expected, rtol=1e-6)


def test_sloppy_urdf_is_used(tmp_path):
    more = """<link name="horn"><visual><geometry><mesh filename="missing.stl"/></geometry></visual>
    </link><joint name="follows" type="revolute"><parent link="rod"/><child link="horn"/>
    <axis xyz="0 0 1"/><mimic joint="swing"/><limit lower="0" upper="-1"/></joint>
    <transmission name="t"/><gazebo/>"""
    robot = lone_joint.pendulum(tmp_path, inertial="", more=more, effort=0)

    time = np.arange(101) * 0.01
    reference = np.clip(time, 0.0, 0.5)[None, :, None]
    moved = PhysicsEngine(robot).angles(Drive(reference), time)

    np.testing.assert_allclose(moved[0, -1], 0.5, atol=np.deg2rad(0.2))


@pytest.mark.parametrize("name", ROBOTS)
def test_derived_motors_sag_no_more_than_assumed(name):
    robot = load_robot(name)
    judge, motors = imported_as_it_is(robot)
    data = mujoco.MjData(judge)
    compliance = [motor.compliance for motor in default_parameters(robot).motors]
    sags = []
    for pose in poses_of(robot, 500):
        data.qpos[motors] = pose * robot.sense
        mujoco.mj_forward(judge, data)
        sags.append(np.abs(data.qfrc_bias[motors] * compliance))

    assert np.deg2rad(0.25) < np.max(sags) < np.deg2rad(0.525)


def test_parameters_of_the_armpi_are_found(armpi):
    parameters = load_parameters(armpi)
    assert [motor.name for motor in parameters.motors] == armpi.motor_names
    assert load_parameters(load_robot("ur5e")) is None


def test_parameters_of_another_robot_are_refused(armpi):
    other = load_parameters(armpi)
    with pytest.raises(InputError, match="motor_1, motor_2, motor_3, motor_4; 'so101' has motor_1"):
        PhysicsEngine(load_robot("so101"), other)


@pytest.mark.parametrize(
    ("field", "value"), [("stiffness", 0.0), ("friction", -0.1), ("armature", np.inf)]
)
def test_impossible_motors_are_refused(field, value):
    with pytest.raises(InputError, match=f"{field} is {value:g}, expected a number"):
        replace(lone_joint.MOTOR, **{field: value})


def test_missing_mujoco_says_how_to_install_it(armpi, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(InputError) as error:
        PhysicsEngine(armpi).angles(Drive(np.zeros((1, 2, 4))), np.arange(2.0))
    assert str(error.value).startswith("the physics engine needs mujoco (")
    assert str(error.value).endswith("Install it: pip install 'failuretwin[physics]'.")


REFERENCES = arrays(np.float64, (2, 30, 2), elements=st.floats(-3, 3))
SPEED = np.array([5.0, 2.0])


@given(REFERENCES)
def test_references_keep_to_the_speed_limit(reference):
    limited = limit_speed(reference, 0.01, SPEED)

    assert (np.abs(np.diff(limited, axis=1)) <= SPEED * 0.01 * (1 + 1e-6)).all()
    np.testing.assert_array_equal(limited[:, 0], reference[:, 0])
    np.testing.assert_array_equal(limit_speed(reference, 0.01, 1e6 * SPEED), reference)
    held = np.concatenate([reference, np.repeat(reference[:, -1:], 700, axis=1)], axis=1)
    reached = limit_speed(held, 0.01, SPEED)[:, -1]
    np.testing.assert_allclose(reached, reference[:, -1], atol=1e-9)


def test_refined_samples_lie_on_straight_lines():
    samples = np.random.default_rng(6).normal(size=(3, 8, 2))
    fine = refine(samples, 4)
    at = np.arange(29) / 4.0
    for run in range(3):
        for motor in range(2):
            line = np.interp(at, np.arange(8), samples[run, :, motor])
            np.testing.assert_allclose(fine[run, :, motor], line, atol=1e-15)


def test_filter_of_a_ramp_has_its_closed_form():
    time = np.arange(200) * 0.003
    ramp = 2.0 * time + np.array([[1.0], [-1.0]])
    for tau in (0.05, 0.001):
        out = first_order_lag(ramp, ramp[:, 0], 0.003, tau)
        lag = tau * (1.0 - np.exp(-time / tau))
        np.testing.assert_allclose(out, ramp - 2.0 * lag, atol=1e-13)
