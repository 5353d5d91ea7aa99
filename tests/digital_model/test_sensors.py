"""What sensors tell of poses and motions, against closed forms, differences and MuJoCo."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from failuretwin.core.errors import InputError
from failuretwin.digital_model.kinematics import GRAVITY
from failuretwin.digital_model.physics.arm import TOOL, arm_spec
from failuretwin.digital_model.profile import SensorProfile
from failuretwin.digital_model.robot import load_robot
from failuretwin.digital_model.sensors import SENSORS, sensor_of
from failuretwin.digital_model.twin import DigitalTwin

STEP_S = 1e-4


@pytest.fixture(scope="module", params=["armpi_fpv", "ur5e", "so101"])
def twin(request):
    return DigitalTwin(request.param)


@pytest.fixture(scope="module")
def armpi():
    return DigitalTwin("armpi_fpv")


def poses(twin, count=6, seed=0):
    low, high = np.array([motor.movement_range for motor in twin.robot.motors]).T
    return np.random.default_rng(seed).uniform(low, high, (count, len(low)))


@pytest.mark.parametrize("kind", SENSORS)
def test_jacobians_are_differences(twin, kind):
    q = poses(twin)
    told = () if kind == "tool" else (SensorProfile(kind, rpy=(0.3, -0.5, 0.8)),)
    sensor = sensor_of(kind, twin, told)
    _, jacobian = sensor.expected(q)
    for k, step in enumerate(1e-6 * np.eye(q.shape[1])):
        slope = (sensor.expected(q + step)[0] - sensor.expected(q - step)[0]) / 2e-6
        np.testing.assert_allclose(jacobian[..., k], slope, atol=1e-7)


def test_gravity_shows_the_sum_of_the_tilts_of_the_armpi(armpi):
    """Joints 2 to 4 turn about one axis, motor 3 the other way: a tool that tilts by their sum."""
    q = poses(armpi)
    tilt = q[:, 1] - q[:, 2] + q[:, 3]
    expected = GRAVITY * np.stack([0.0 * tilt, np.sin(tilt), np.cos(tilt)], axis=1)
    value, jacobian = sensor_of("accelerometer", armpi).expected(q)
    np.testing.assert_allclose(value, expected, atol=1e-9)
    np.testing.assert_allclose(jacobian[..., 0], 0.0, atol=1e-12)
    np.testing.assert_allclose(jacobian[..., 1], -jacobian[..., 2], atol=1e-12)


def test_a_mount_turns_what_is_read(armpi):
    q, rpy = poses(armpi), (0.1, -0.7, 1.2)
    plain, _ = sensor_of("accelerometer", armpi).expected(q)
    turned, _ = sensor_of(
        "accelerometer", armpi, (SensorProfile("accelerometer", rpy=rpy),)
    ).expected(q)
    np.testing.assert_allclose(Rotation.from_euler("xyz", rpy).apply(turned), plain, atol=1e-9)


def test_a_tool_that_circles_is_pulled_inwards(armpi):
    """Motor 1 turns evenly: omega^2 r towards the axis, and omega about it."""
    rate, q = 1.7, np.array([0.0, 0.5, -0.4, 0.3])
    time = STEP_S * np.arange(21)
    motion = q + rate * time[:, None] * np.eye(4)[0]
    p = armpi.robot.loads.chain.position(motion * armpi.robot.sense)[10]
    turn, _ = sensor_of("orientation", armpi).expected(motion[10] * armpi.robot.sense)
    R = np.sqrt(2.0) * turn.reshape(3, 3)
    force = R.T @ (np.array([0.0, 0.0, GRAVITY]) - rate**2 * np.array([p[0], p[1], 0.0]))
    step = np.asarray(STEP_S)
    found = sensor_of("accelerometer", armpi).along(motion, step)[10]
    np.testing.assert_allclose(found, force, atol=1e-5)
    spin = sensor_of("gyroscope", armpi).along(motion, step)[10]
    np.testing.assert_allclose(spin, R.T @ [0.0, 0.0, rate], atol=1e-5)


@pytest.mark.parametrize("name", ["armpi_fpv", "ur5e"])
def test_a_rigid_body_engine_reads_the_same_on_the_way(name):
    mujoco = pytest.importorskip("mujoco")
    robot = load_robot(name)
    spec = arm_spec(robot)
    kinds = {"accelerometer": mujoco.mjtSensor.mjSENS_ACCELEROMETER}
    kinds["gyroscope"] = mujoco.mjtSensor.mjSENS_GYRO
    for kind, of in kinds.items():
        spec.add_sensor(name=kind, type=of, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=TOOL)
    model = spec.compile()
    data = mujoco.MjData(model)
    rng, motors = np.random.default_rng(1), len(robot.motors)
    angle, speed, gain = rng.uniform(-0.7, 0.7, (3, motors))
    time = STEP_S * np.arange(-3, 4)[:, None]
    motion = angle + speed * time + 0.5 * gain * time**2  # in the log's sense
    for k, motor in enumerate(robot.motors):
        joint = model.joint(motor.joint)
        data.qpos[joint.qposadr] = motor.sense * angle[k]
        data.qvel[joint.dofadr] = motor.sense * speed[k]
        data.qacc[joint.dofadr] = motor.sense * gain[k]
    mujoco.mj_inverse(model, data)
    for kind in kinds:
        found = sensor_of(kind, DigitalTwin(robot)).along(motion, np.asarray(STEP_S))[3]
        np.testing.assert_allclose(found, data.sensor(kind).data, rtol=1e-4, atol=1e-4)


def test_distances_between_turned_tools_are_angles(twin):
    q, error = poses(twin), np.array([0.02, -0.01, 0.005])
    sensor = sensor_of("orientation", twin)
    value, _ = sensor.expected(q)
    seen = sensor.to_channels(sensor.with_errors(value, np.tile(error, (len(q), 1))))
    off = np.linalg.norm(seen - value, axis=1)
    np.testing.assert_allclose(off, np.linalg.norm(error), rtol=1e-3)


def test_a_wire_is_as_long_as_the_tool_is_far_from_its_anchor(armpi):
    x, y, z = armpi.robot.loads.chain.position(np.zeros(4))
    profile = SensorProfile("wire", anchor=(x + 0.3, y, z - 0.4))
    length, _ = sensor_of("wire", armpi, (profile,)).expected(np.zeros((1, 4)))
    assert length[0, 0] == pytest.approx(0.5)


def test_known_bias_is_taken_off(armpi):
    q = poses(armpi)
    for kind, bias in {"accelerometer": (0.1, 0.2, -0.3), "wire": (0.01,)}.items():
        sensor = sensor_of(kind, armpi, (SensorProfile(kind, bias=bias),))
        value, _ = sensor.expected(q)
        told = sensor.with_errors(value, np.zeros((len(q), sensor.dims)))
        plain = sensor_of(kind, armpi).with_errors(value, np.zeros((len(q), sensor.dims)))
        np.testing.assert_allclose(sensor.to_channels(told), value)
        assert np.abs(told - plain).max() == pytest.approx(max(np.abs(bias)))


def test_nonsense_is_refused(armpi):
    with pytest.raises(InputError, match="unknown sensor 'compass'"):
        SensorProfile("compass")
    with pytest.raises(InputError, match="anchor is"):
        SensorProfile("wire", anchor=(1.0,))
    with pytest.raises(InputError, match="bias has 2 values"):
        sensor = sensor_of("accelerometer", armpi, (SensorProfile("accelerometer", bias=(1, 2)),))
        sensor.to_channels(np.zeros((1, 3)))
