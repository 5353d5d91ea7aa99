from __future__ import annotations

import numpy as np
import pytest

from failuretwin import DigitalTwin, InputError, load_robot
from failuretwin.digital_model.inverse_kinematics import (
    POINTER_M,
    InverseKinematics,
    feedback_factor,
    tool_points,
    usable_limits,
)
from failuretwin.digital_model.kinematics import Joint, SerialChain, rotation_to_z

ROBOTS = ("armpi_fpv", "ur5e", "panda", "so101")


def poses(robot, count, seed=0):
    low, high = usable_limits(robot)
    return np.random.default_rng(seed).uniform(low, high, (count, len(low)))


@pytest.mark.parametrize("name", ROBOTS)
def test_frames_say_what_the_chain_says(name):
    robot, twin = load_robot(name), DigitalTwin(load_robot(name))
    q = poses(robot, 40)
    point, jacobian = InverseKinematics.of(robot).tool(q)
    expected, slope = twin.path_and_jacobian(q)
    np.testing.assert_allclose(point, expected, atol=1e-12)
    np.testing.assert_allclose(jacobian, slope, atol=1e-12)


def test_a_joint_that_slides():
    along = np.eye(4)
    along[:3, :3] = rotation_to_z([1.0, 0.0, 0.0])
    chain = SerialChain((Joint("turn", False, np.eye(4)), Joint("slide", True, along)), np.eye(4))
    q = np.array([[0.7, 0.3], [-2.0, -0.1]])
    point, jacobian = tool_points(chain, q)
    expected, slope = chain.position_and_jacobian(q)
    np.testing.assert_allclose(point, expected, atol=1e-15)
    np.testing.assert_allclose(jacobian, slope, atol=1e-15)
    np.testing.assert_allclose(point[0], [0.3 * np.cos(0.7), 0.3 * np.sin(0.7), 0.0], atol=1e-15)


@pytest.mark.parametrize("name", ROBOTS)
def test_what_a_pose_reaches_is_reached_within_limits(name):
    robot = load_robot(name)
    kinematics, rng = InverseKinematics.of(robot), np.random.default_rng(1)
    goal = kinematics.tool(poses(robot, 60, 2))[0]
    found = kinematics.solve(goal, kinematics.starts(24, rng))
    best = found.miss_m.argmin(axis=1)
    pose = found.pose[np.arange(60), best]
    assert np.mean(found.miss_m.min(axis=1) < 1e-4) > 0.98
    assert found.miss_m.min(axis=1).max() < 1e-3  # in a corner of the limits few starts get there
    at = DigitalTwin(robot).path(pose)
    np.testing.assert_allclose(np.linalg.norm(at - goal, axis=1), found.miss_m.min(1), atol=1e-12)
    assert np.all((found.pose >= kinematics.low - 1e-12) & (found.pose <= kinematics.high + 1e-12))


@pytest.mark.parametrize("motor", range(4))
def test_a_locked_motor_stays_and_the_rest_beats_a_dense_grid(armpi, motor):
    kinematics, rng = InverseKinematics.of(armpi), np.random.default_rng(motor)
    angle = float(rng.uniform(*armpi.travel[motor]))
    goal = kinematics.tool(poses(armpi, 12, 5))[0]
    start = kinematics.starts(16, rng)
    start[:, motor] = angle
    locked = np.arange(4) == motor
    found = kinematics.solve(goal, start, locked)
    assert np.all(found.pose[..., motor] == angle)
    axes = [
        np.linspace(low, high, 28) if k != motor else np.array([angle])
        for k, (low, high) in enumerate(zip(kinematics.low, kinematics.high, strict=True))
    ]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 4)
    tool = DigitalTwin(armpi).path(grid)
    brute = np.array([np.linalg.norm(tool - point, axis=1).min() for point in goal])
    assert np.all(found.miss_m.min(axis=1) <= brute + 1e-6)


def test_a_motor_held_beyond_its_limits_stays_there(armpi):
    kinematics = InverseKinematics.of(armpi)
    start = np.zeros((3, 4))
    start[:, 1] = 1.9
    found = kinematics.solve(np.array([[0.1, 0.0, 0.2]]), start, np.arange(4) == 1)
    assert np.all(found.pose[..., 1] == 1.9)


def test_two_links_in_a_plane_against_the_closed_form():
    robot = load_robot("armpi_fpv")
    kinematics = InverseKinematics.of(robot)
    # Motors 2 and 3 alone, motor 4 straight: upper arm and forearm with the hand on it.
    upper, fore, shoulder = 0.10048, 0.094714 + 0.05071, 0.028505 + 0.0361
    bend, lift = 0.9, 0.4  # in the sense of the logs, in which paths are told
    pose = np.array([0.0, lift, bend, 0.0])
    goal = kinematics.tool(pose[None])[0]
    distance = np.hypot(np.linalg.norm(goal[0, :2]), goal[0, 2] - shoulder)
    cosine = (distance**2 - upper**2 - fore**2) / (2 * upper * fore)
    start = kinematics.starts(20, np.random.default_rng(0))
    start[:, [0, 3]] = 0.0
    found = kinematics.solve(goal, start, np.array([True, False, False, True]))
    near = found.pose[0][found.miss_m[0] < 1e-5]
    assert len(near) > 3
    np.testing.assert_allclose(np.cos(near[:, 2]), cosine, atol=1e-3)


def test_an_approach_direction_is_kept():
    robot = load_robot("ur5e")
    kinematics, rng = InverseKinematics.of(robot), np.random.default_rng(3)
    # Six motors would do; the five that move the tool point hold some directions only.
    q = poses(robot, 8, 4)
    frames = tool_points(robot.chain, q * robot.sensor_sense, POINTER_M)[0]
    axis = (frames[:, 3:] - frames[:, :3]) / POINTER_M
    found = kinematics.solve(frames[:, :3], kinematics.starts(40, rng), None, axis)
    score = found.miss_m + POINTER_M * found.miss_rad
    assert np.all(score.min(axis=1) < 2e-3)
    best = found.pose[np.arange(8), score.argmin(axis=1)]
    seen = tool_points(robot.chain, best * robot.sensor_sense, POINTER_M)[0]
    cosine = np.sum((seen[:, 3:] - seen[:, :3]) / POINTER_M * axis, axis=1)
    assert np.all(np.arccos(np.clip(cosine, -1, 1)) < np.deg2rad(1.0))


@pytest.mark.parametrize("motor", range(4))
def test_what_feedback_leaves_of_an_error_if_a_motor_does_not_move(armpi, motor):
    kinematics = InverseKinematics.of(armpi)
    pose = np.array([0.3, -0.4, 0.6, 0.5])
    point, jacobian = kinematics.tool(pose[None])
    rho = feedback_factor(jacobian)[0, motor]
    pose, goal = pose.copy(), point[0] + 1e-6 * np.array([0.5, -0.3, 0.7])
    inverse, left = np.linalg.pinv(jacobian[0]), []
    for _ in range(6):
        step = inverse @ (goal - kinematics.tool(pose[None])[0][0])
        step[motor] = 0.0
        pose = pose + step
        left.append(np.linalg.norm(goal - kinematics.tool(pose[None])[0][0]))
    np.testing.assert_allclose(left[-1] / left[-2], rho, atol=2e-3)


def test_limits_that_do_not_fit_are_refused(armpi):
    with pytest.raises(InputError, match="each of the 4 motors"):
        InverseKinematics(armpi, np.zeros(3), np.ones(3))
    with pytest.raises(InputError, match="above the highest"):
        InverseKinematics(armpi, np.ones(4), np.zeros(4))


def test_commands_in_counts_bound_the_limits(armpi):
    low, high = usable_limits(armpi)
    assert np.all(low >= -np.deg2rad(120.0) - 1e-12)
    assert np.all(high <= np.deg2rad(120.0) + 1e-12)
    assert low[1] == pytest.approx(-1.57)


@pytest.mark.parametrize("name", ["armpi_fpv", "ur5e", "panda"])
def test_what_mink_reaches_is_reached(name):
    mink, mujoco = pytest.importorskip("mink"), pytest.importorskip("mujoco")
    robot = load_robot(name)
    chain, kinematics = robot.loads.chain, InverseKinematics.of(robot)
    spec = mujoco.MjSpec.from_file(str(robot.urdf_file))
    last = chain.joints[-1].name
    link = next(body for body in spec.bodies if body.joints and body.joints[0].name == last)
    link.add_site(name="tool", pos=chain.T_jt[:3, 3])
    model = spec.compile()
    columns = [model.joint(joint.name).qposadr[0] for joint in chain.joints]
    task = mink.FrameTask("tool", "site", position_cost=1.0, orientation_cost=0.0)
    limits, rng = [mink.ConfigurationLimit(model)], np.random.default_rng(0)
    for pose in poses(robot, 5, 9) * 0.5:
        configuration = mink.Configuration(model)
        there = np.zeros(model.nq)
        there[columns] = pose * robot.sense
        configuration.update(there)
        goal = configuration.get_transform_frame_to_world("tool", "site")
        sensed = DigitalTwin(robot).path(pose * robot.sense * robot.sensor_sense)
        configuration.update(np.clip(np.zeros(model.nq) + 0.1, *model.jnt_range.T))
        task.set_target(goal)
        for _ in range(100):
            step = mink.solve_ik(configuration, [task], 0.1, "daqp", limits=limits)
            configuration.integrate_inplace(step, 0.1)
        found = configuration.get_transform_frame_to_world("tool", "site").translation()
        theirs = np.linalg.norm(found - goal.translation())
        if np.all(robot.sense == robot.sensor_sense):  # mink knows the physical sense alone
            np.testing.assert_allclose(sensed, goal.translation(), atol=1e-9)
        ours = kinematics.solve(sensed[None], kinematics.starts(10, rng)).miss_m.min()
        assert ours <= theirs + 1e-4
