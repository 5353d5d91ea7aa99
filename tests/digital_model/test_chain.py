from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from failuretwin.core.errors import InputError
from failuretwin.digital_model.kinematics import SerialChain, rotation_to_z
from failuretwin.digital_model.robot import bundled_folder
from failuretwin.digital_model.urdf.file import read_urdf

SAME_PLACE_M = 1e-9


@dataclass(frozen=True)
class RandomArm:
    """A URDF text with `moving` joints from link0 to `tool`, and a branch that leads elsewhere."""

    xml: str
    moving: tuple[str, ...]
    tool: str


def random_arm(rng: np.random.Generator) -> RandomArm:
    count = int(rng.integers(1, 9))
    kinds = rng.choice(["revolute", "continuous", "prismatic", "fixed"], count).tolist()
    kinds[rng.integers(count)] = "revolute"
    joints = [_joint(f"joint{i}", k, f"link{i}", f"link{i + 1}", rng) for i, k in enumerate(kinds)]
    joints.append(_joint("branch", "revolute", f"link{rng.integers(count)}", "elsewhere", rng))
    names = [f"link{i}" for i in range(count + 1)] + ["elsewhere"]
    xml = (
        '<robot name="random"><mujoco><compiler fusestatic="false"/></mujoco>'
        f"{''.join(map(_link, names))}{''.join(joints)}</robot>"
    )
    moving = tuple(f"joint{i}" for i, kind in enumerate(kinds) if kind != "fixed")
    return RandomArm(xml, moving, f"link{count}")


def _link(name: str) -> str:
    return (
        f'<link name="{name}"><inertial><mass value="1"/>'
        '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    )


def _joint(name: str, kind: str, parent: str, child: str, rng: np.random.Generator) -> str:
    main_axis = np.eye(3)[rng.integers(3)] * rng.choice([-1, 1])
    axis = main_axis if rng.random() < 0.5 else rng.normal(size=3)
    rpy = rng.uniform(-np.pi, np.pi, 3) * (rng.random(3) < 0.5)
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{_text(rng.normal(size=3))}" rpy="{_text(rpy)}"/>'
        f'<axis xyz="{_text(axis)}"/><limit lower="-4" upper="4" effort="1" velocity="1"/></joint>'
    )


def _text(values: np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in values)


def chain_of(arm: RandomArm, folder) -> SerialChain:
    path = folder / "arm.urdf"
    path.write_text(arm.xml)
    return read_urdf(path).chain("link0", arm.tool, arm.moving)


def mujoco_position_and_jacobian(mujoco, model, joints, tool, poses):
    """Return what the physics engine makes of `poses` (pose, joint); other joints are at zero."""
    state = mujoco.MjData(model)
    value = [model.joint(name).qposadr[0] for name in joints]
    speed = [model.joint(name).dofadr[0] for name in joints]
    positions, jacobians = [], []
    for pose in poses:
        state.qpos[value] = pose
        mujoco.mj_kinematics(model, state)
        mujoco.mj_comPos(model, state)
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jacBody(model, state, jacobian, None, model.body(tool).id)
        positions.append(state.body(tool).xpos.copy())
        jacobians.append(jacobian[:, speed])
    return np.array(positions), np.array(jacobians)


def assert_same(got, expected):
    for mine, judge in zip(got, expected, strict=True):
        np.testing.assert_allclose(mine, judge, rtol=0, atol=SAME_PLACE_M)


def test_bundled_robot_agrees_with_the_physics_engine(armpi):
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_path(str(bundled_folder() / armpi.profile.urdf))
    poses = np.random.default_rng(1).uniform(-2.0, 2.0, (300, 4))
    joints = [motor.joint for motor in armpi.motors]

    judge = mujoco_position_and_jacobian(mujoco, model, joints, armpi.profile.tool_link, poses)

    assert_same(armpi.chain.position_and_jacobian(poses), judge)
    assert_same([armpi.chain.position(poses)], judge[:1])


@pytest.mark.parametrize("seed", range(60))
def test_random_arms_agree_with_the_physics_engine(seed, tmp_path):
    mujoco = pytest.importorskip("mujoco")
    rng = np.random.default_rng(seed)
    arm = random_arm(rng)
    poses = rng.uniform(-3.0, 3.0, (10, len(arm.moving)))

    chain = chain_of(arm, tmp_path)
    judge = mujoco_position_and_jacobian(
        mujoco, mujoco.MjModel.from_xml_string(arm.xml), arm.moving, arm.tool, poses
    )

    assert_same(chain.position_and_jacobian(poses), judge)
    assert_same([chain.position(poses)], judge[:1])


def test_joints_without_a_motor_stay_at_zero(tmp_path):
    arm = random_arm(np.random.default_rng(3))
    assert len(arm.moving) > 2
    all_move = chain_of(arm, tmp_path)
    some_move = chain_of(RandomArm(arm.xml, arm.moving[1:-1], arm.tool), tmp_path)
    poses = np.random.default_rng(4).uniform(-3, 3, (20, len(arm.moving)))
    poses[:, [0, -1]] = 0.0

    position, jacobian = all_move.position_and_jacobian(poses)

    assert_same(some_move.position_and_jacobian(poses[:, 1:-1]), (position, jacobian[..., 1:-1]))


@pytest.mark.parametrize("seed", range(20))
def test_jacobian_is_the_slope_of_the_position(seed, tmp_path):
    rng = np.random.default_rng(100 + seed)
    arm = random_arm(rng)
    chain = chain_of(arm, tmp_path)
    poses = rng.uniform(-3.0, 3.0, (10, len(arm.moving)))
    step = 1e-5

    _, jacobian = chain.position_and_jacobian(poses)

    for joint in range(len(arm.moving)):
        ahead = chain.position(poses + step * np.eye(len(arm.moving))[joint])
        behind = chain.position(poses - step * np.eye(len(arm.moving))[joint])
        np.testing.assert_allclose(jacobian[..., joint], (ahead - behind) / (2 * step), atol=1e-8)


def test_armpi_stands_upright_at_zero(armpi):
    np.testing.assert_allclose(armpi.chain.position(np.zeros(4)), [0, 0, 0.310509], atol=1e-15)


def test_armpi_is_a_planar_arm_on_a_turntable(armpi):
    poses = np.random.default_rng(5).uniform(-2, 2, (100, 4))
    turn, a, b, c = poses[:, 0], poses[:, 1], poses[:, 1:3].sum(axis=1), poses[:, 1:].sum(axis=1)
    reach = 0.10048 * np.sin(a) + 0.094714 * np.sin(b) + 0.05071 * np.sin(c)
    height = 0.028505 + 0.0361 + 0.10048 * np.cos(a) + 0.094714 * np.cos(b) + 0.05071 * np.cos(c)

    expected = np.stack([reach * np.sin(turn), -reach * np.cos(turn), height], axis=-1)

    np.testing.assert_allclose(armpi.chain.position(poses), expected, atol=1e-15)


@pytest.mark.parametrize("lead", [(), (1,), (7,), (2, 3), (2, 3, 5), (0,), (3, 0)])
def test_shape_in_front_of_the_joints_is_kept(armpi, lead):
    poses = np.zeros((*lead, 4))
    position, jacobian = armpi.chain.position_and_jacobian(poses)

    assert armpi.chain.position(poses).shape == position.shape == (*lead, 3)
    assert jacobian.shape == (*lead, 3, 4)


def test_many_poses_give_what_each_gives_alone(armpi):
    poses = np.random.default_rng(6).uniform(-2, 2, (8003, 4))
    position, jacobian = armpi.chain.position_and_jacobian(poses)

    for row in (0, 4000, 8002):
        alone = armpi.chain.position_and_jacobian(poses[row])
        np.testing.assert_allclose(position[row], alone[0], atol=1e-15)
        np.testing.assert_allclose(jacobian[row], alone[1], atol=1e-15)
    np.testing.assert_array_equal(armpi.chain.position(poses), position)


def test_poses_stay_as_they_were(armpi):
    poses = np.random.default_rng(7).uniform(-2, 2, (5, 4))
    before = poses.copy()
    armpi.chain.position_and_jacobian(poses)[0][:] = 0.0
    np.testing.assert_array_equal(poses, before)


@pytest.mark.parametrize("shape", [(), (3,), (4, 3), (4, 5)])
def test_wrong_last_axis_names_the_joints(armpi, shape):
    with pytest.raises(InputError) as error:
        armpi.chain.position(np.zeros(shape))
    assert str(error.value) == (
        f"joint values have shape {shape}; the last axis must hold the 4 joints "
        "joint1, joint2, joint3, joint4."
    )


@given(st.tuples(*[st.floats(-10, 10)] * 3).filter(lambda axis: np.linalg.norm(axis) > 1e-3))
def test_rotation_to_z_turns_z_onto_the_axis(axis):
    R = rotation_to_z(axis)

    np.testing.assert_allclose(R[:, 2], np.array(axis) / np.linalg.norm(axis), atol=1e-15)
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-14)
    assert np.linalg.det(R) == pytest.approx(1.0)


@pytest.mark.parametrize("axis", [*np.eye(3), *-np.eye(3)])
def test_rotation_to_a_main_axis_holds_only_zeros_and_ones(axis):
    assert set(np.abs(rotation_to_z(axis)).ravel()) == {0.0, 1.0}
