from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from failuretwin.core.errors import InputError
from failuretwin.digital_model.geometry import JointCorrection, SensorFrame
from failuretwin.digital_model.physics.arm import TOOL, arm_spec
from failuretwin.digital_model.robot import _assembled, load_robot
from failuretwin.digital_model.twin import DigitalTwin

ARM = """<robot name="arm"><link name="base"/>
<joint name="turn" type="revolute"><parent link="base"/><child link="upper"/>
<axis xyz="0 0 1"/><limit lower="-1" upper="1" velocity="2" effort="3"/></joint>
<link name="upper"/>
<joint name="lift" type="revolute"><parent link="upper"/><child link="fore"/>
<origin xyz="0.3 0 0"/><axis xyz="0 -1 0"/><limit lower="-1" upper="1" velocity="2" effort="3"/>
</joint>
<link name="fore"><inertial><origin xyz="0.1 0 0"/><mass value="2"/>
<inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
</robot>"""
"""A link of 0.3 m that turns about z, and one that lifts: up is positive."""

SLIDE = '"lift" type="prismatic"'

PROFILE = """name = "arm"
urdf = "arm.urdf"
base_link = "base"
tool_link = "fore"
tool_xyz = [0.2, 0.0, 0.0]
{head}
[[motors]]
name = "motor_1"
joint = "turn"
loop = {{ P = 0.3, I = 40.0, filter_s = 0.01 }}
speed_limit = 2.0
movement_range = [-1.0, 1.0]
[[motors]]
name = "motor_2"
joint = "lift"
loop = {{ P = 0.3, I = 40.0, filter_s = 0.01 }}
speed_limit = 2.0
movement_range = [-1.0, 1.0]
{tail}"""

TURNED = "base_xyz_rpy = [1.0, 2.0, 3.0, 0.0, 0.0, 1.5707963267948966]"
LYING = "base_xyz_rpy = [0.0, 0.0, 0.0, 1.5707963267948966, 0.0, 0.0]"
LIFTED = '[geometry]\n[[geometry.joints]]\njoint = "lift"\nzero = 1.5707963267948966'
MOVED = (
    '[geometry]\n[[geometry.joints]]\njoint = "lift"\nzero = 0.3\n'
    "xyz = [0.01, -0.02, 0.03]\nrpy = [0.1, 0.2, -0.3]"
)


@pytest.fixture
def robot(tmp_path):
    def make(head="", tail=""):
        (tmp_path / "arm.urdf").write_text(ARM, encoding="utf-8")
        path = tmp_path / "arm.toml"
        path.write_text(PROFILE.format(head=head, tail=tail), encoding="utf-8")
        return load_robot(path)

    return make


@pytest.mark.parametrize(
    ("head", "tail", "expected"),
    [
        ("", "", (0.5, 0.0, 0.0)),
        (TURNED, "", (1.0, 2.5, 3.0)),  # x of the base points along y of the sensor
        (LYING, "", (0.5, 0.0, 0.0)),
        ("", LIFTED, (0.3, 0.0, 0.2)),
        (LYING, LIFTED, (0.3, -0.2, 0.0)),  # z of the base points against y of the sensor
        ("", "[geometry]\nsensor_scale = 1.1", (0.55, 0.0, 0.0)),
        (TURNED, "[geometry]\nsensor_scale = 1.1", (1.0, 2.55, 3.0)),
    ],
)
def test_where_the_tool_is_seen_at_zero(robot, head, tail, expected):
    seen = robot(head, tail).chain.position(np.zeros(2))
    np.testing.assert_allclose(seen, expected, atol=1e-12)


def test_gravity_pulls_along_the_base_whatever_the_frame_of_the_sensor(robot):
    # 2 kg at 0.1 m, lying: 9.81 * 2 * 0.1 N m against lifting; upright: none.
    assert robot(LYING).loads.torque(np.zeros(2))[1] == pytest.approx(-1.962)
    assert robot("", LIFTED).loads.torque(np.zeros(2))[1] == pytest.approx(0.0, abs=1e-12)


def test_the_physics_engine_has_the_same_tool_point(robot):
    mujoco = pytest.importorskip("mujoco")
    made = robot("", MOVED)
    model = arm_spec(made).compile()
    data = mujoco.MjData(model)
    for q in np.random.default_rng(0).uniform(-1.0, 1.0, (5, 2)):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(data.site(TOOL).xpos, made.chain.position(q), atol=1e-9)


def test_a_joint_that_is_not_there_is_refused(robot):
    with pytest.raises(InputError, match="unknown joint 'lifd'"):
        robot("", '[geometry]\n[[geometry.joints]]\njoint = "lifd"')


MOUNT = SensorFrame((0.1, -0.2, 0.3, 0.4, 0.5, 0.6), 1.05)


@pytest.mark.parametrize(("name", "frame"), [("armpi_fpv", None), ("so101", MOUNT)])
def test_geometry_columns_equal_differences_of_corrected_robots(name, frame):
    check_geometry_columns(load_robot(name).seen_from(frame))


def test_geometry_columns_of_an_arm_with_a_slide(robot, monkeypatch):
    monkeypatch.setitem(globals(), "ARM", ARM.replace('"lift" type="revolute"', SLIDE))
    arm = robot(TURNED)
    assert arm.slides.tolist() == [False, True]
    check_geometry_columns(arm)


def check_geometry_columns(robot):
    angles = np.random.default_rng(0).uniform(-0.5, 0.5, (2, 3, len(robot.motors)))
    columns = DigitalTwin(robot).geometry_columns(angles)
    for k, motor in enumerate(robot.motors):
        for place in range(6):
            ahead, behind = (
                DigitalTwin(corrected(robot, motor.joint, place, step)).path(angles)
                for step in (1e-5, -1e-5)
            )
            expected = (ahead - behind) / 2e-5
            np.testing.assert_allclose(columns[..., 6 * k + place], expected, atol=1e-9)


def corrected(robot, joint, place, step):
    values = np.zeros(6)
    values[place] = step
    correction = JointCorrection(joint, xyz=tuple(values[:3]), rpy=tuple(values[3:]))
    geometry = replace(robot.profile.geometry, joints=(correction,))
    made = _assembled(replace(robot.profile, geometry=geometry), robot.source)
    return made.seen_from(robot.frame)
