"""Load torques against MuJoCo, potential energy and the arithmetic of a level arm."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from failuretwin import load_robot
from failuretwin.digital_model.robot import bundled_robots
from failuretwin.digital_model.urdf.file import read_urdf

SLIDER = """<robot name="slider">
  <link name="base"/>
  <joint name="turn" type="revolute">
    <parent link="base"/><child link="arm"/><origin xyz="0.1 0 0.2" rpy="0.3 -0.2 0.5"/>
    <axis xyz="0.6 0 0.8"/><limit lower="-2" upper="2" effort="1" velocity="1"/>
  </joint>
  <link name="arm"><inertial><origin xyz="0.05 0.02 -0.03"/><mass value="1.5"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="slide" type="prismatic">
    <parent link="arm"/><child link="rod"/><origin xyz="0 0.3 0" rpy="1.2 0 0"/>
    <axis xyz="0 0.8 0.6"/><limit lower="-0.2" upper="0.2" effort="1" velocity="1"/>
  </joint>
  <link name="rod"><inertial><origin xyz="0.1 0 0.2"/><mass value="0.7"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="side" type="revolute">
    <parent link="arm"/><child link="ballast"/><origin xyz="0 -0.4 0.1"/>
    <axis xyz="1 0 0"/><limit lower="-2" upper="2" effort="1" velocity="1"/>
  </joint>
  <link name="ballast"><inertial><origin xyz="0 0 -0.1"/><mass value="0.4"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
</robot>"""


def mujoco_torque(file, joints, poses):
    """Return what MuJoCo says gravity does to `joints` (pose, joint); the others are at zero."""
    spec = mujoco.MjSpec.from_file(str(file))
    spec.compiler.fusestatic = False
    model = spec.compile()
    data = mujoco.MjData(model)
    places = [model.joint(name).qposadr[0] for name in joints]
    freedoms = [model.joint(name).dofadr[0] for name in joints]
    torque = []
    for pose in poses:
        data.qpos[:] = 0.0
        data.qpos[places] = pose
        mujoco.mj_forward(model, data)
        torque.append(-data.qfrc_bias[freedoms])
    return np.array(torque)


@pytest.mark.parametrize("name", bundled_robots())
def test_load_torque_is_that_of_mujoco(name):
    robot = load_robot(name)
    poses = np.random.default_rng(0).uniform(-2.0, 2.0, (100, len(robot.motors)))
    expected = mujoco_torque(
        robot.folder / robot.profile.urdf, [m.joint for m in robot.motors], poses
    )
    np.testing.assert_allclose(robot.loads.torque(poses), expected, rtol=0, atol=1e-9)
    assert np.abs(expected).max() > 0.1


def test_slanting_axes_sliders_and_side_branches(tmp_path):
    file = tmp_path / "slider.urdf"
    file.write_text(SLIDER)
    urdf, joints = read_urdf(file), ["turn", "slide"]
    chain = urdf.chain("base", "rod", joints)
    loads = urdf.loads("base", chain)
    poses = np.random.default_rng(1).uniform(-0.2, 0.2, (50, 2)) * [10.0, 1.0]
    expected = mujoco_torque(file, joints, poses)
    np.testing.assert_allclose(loads.torque(poses), expected, rtol=0, atol=1e-9)


def test_a_payload_pulls_at_the_tool_point(armpi):
    """By virtual work: its torque is weight times how much the tool sinks with each joint."""
    poses = np.random.default_rng(2).uniform(-1.0, 1.0, (20, 4))
    payload = np.linspace(0.01, 0.5, 20)
    more = armpi.loads.torque(poses, payload) - armpi.loads.torque(poses)
    _, jacobian = armpi.chain.position_and_jacobian(poses)
    np.testing.assert_allclose(more, -9.81 * payload[:, None] * jacobian[:, 2], atol=1e-12)
