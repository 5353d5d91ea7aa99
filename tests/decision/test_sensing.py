"""Sensors beside the tool's position, as one residual: densities, search and whole diagnoses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import failuretwin as ft
from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.profile import SensorProfile
from failuretwin.digital_model.sensors import sensor_of
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.inference.diagnoser import BayesDiagnoser
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.sensors import parse_sensing, sensing_of

KINDS = ["accelerometer", "gyroscope", "orientation", "wire"]
STACKS = ["orientation", "accelerometer", "wire", "encoders", "tool+wire", "tool+orientation"]
STACKS += ["tool+accelerometer+encoders"]
CLASSES = ["healthy", "motor_2:stuck", "motor_2:steady_state_error"]


@pytest.fixture(scope="module")
def twin():
    return DigitalTwin("armpi_fpv")


@pytest.fixture(scope="module")
def model(twin):
    return HealthyModel.of(twin, "armpi_fpv")


@pytest.fixture(scope="module")
def runs():
    return simulate(Plan("armpi_fpv", CLASSES, 4, 3, "armpi_fpv", sensors=KINDS))


def poses(count=5, seed=0):
    return np.random.default_rng(seed).uniform(-0.7, 0.7, (count, 4))


def seen_at(model, pose, rng):
    """Return what noisy sensors see of a pose, in the channels of a stack, and their true noise."""
    stack, parts = model.sensors, []
    for sensor in stack.at_rest:
        value, _ = sensor.expected(pose)
        if sensor.kind == "tool":
            parts.append(value + rng.normal(0.0, model.path_noise, value.shape))
            continue
        error = rng.normal(0.0, 1.0, (*pose.shape[:-1], sensor.dims)) * sensor.noise
        noise = sensor.noise if sensor is stack.in_doubt else np.hypot(sensor.noise, sensor.doubt)
        scale = stack.unit_m / noise
        parts.append(sensor.to_channels(sensor.with_errors(value, error)) * scale)
    return np.concatenate(parts, axis=-1)


# One residual, whatever the sensor.


@pytest.mark.parametrize("sensing", STACKS)
def test_channels_of_all_sensors_are_as_noisy_as_the_tool(model, sensing):
    one = model.seen_by(parse_sensing(sensing))
    pose = np.repeat(poses(1), 4000, axis=0)
    off = seen_at(one, pose, np.random.default_rng(1)) - one.sensors.value(pose)
    rms = np.sqrt(np.sum(np.mean(off**2, axis=0)) / one.sensors.dims)
    doubted = any(sensor.doubt for sensor in one.sensors.at_rest)
    assert 0.4 < rms / one.path_noise < 1.02
    assert doubted or rms == pytest.approx(one.path_noise, rel=0.03)


@pytest.mark.parametrize("sensing", ["accelerometer", "wire", "encoders", "tool+wire"])
def test_the_density_is_that_of_scatter_and_noise(model, sensing):
    """Brute force: normal scatter of the motors, J dq, and noise, drawn and integrated out."""
    one = model.seen_by(parse_sensing(sensing))
    pose = poses(1)[0]
    value, jacobian = one.sensors.expected(pose)
    rng = np.random.default_rng(2)
    point = value + jacobian @ (0.5 * one.scatter)
    error, _, spread = one.residual(point, pose, one.scatter)
    drawn = rng.normal(size=(400_000, 4)) * one.scatter @ jacobian.T
    noise = stats.norm(0.0, one.path_noise)
    brute = np.mean(np.prod(noise.pdf(error - drawn), axis=1))
    found = spread.log_student(error, np.inf)
    assert found == pytest.approx(np.log(brute), abs=0.1)


def test_an_orientation_counts_as_three_dimensions(model):
    """But for a constant, its density is a Student t of the rotation vector that it is off by."""
    one = model.seen_by(("orientation",))
    sensor, pose = one.sensors.at_rest[0], poses(1)[0]
    value, _ = sensor.expected(pose)
    turns = np.random.default_rng(0).normal(0.0, 0.01, (5, 3))
    scale = one.sensors.unit_m / sensor.noise
    seen = sensor.to_channels(sensor.with_errors(np.tile(value, (5, 1)), turns)) * scale
    error, _, spread = one.residual(seen, pose, one.scatter)
    found = spread.log_student(error, one.settling.tail_dof)
    step, axes = 1e-6, []
    for k in range(4):  # the rotation vector that each motor turns the tool by, in its frame
        moved, _ = sensor.expected(pose + step * np.eye(4)[k])
        R, S = (np.sqrt(2.0) * m.reshape(3, 3) for m in (value, moved))
        skew = (R.T @ S - S.T @ R) / (2.0 * step)
        axes.append([skew[2, 1], skew[0, 2], skew[1, 0]])
    root = np.transpose(axes) * one.scatter
    shape = root @ root.T + sensor.noise**2 * np.eye(3)
    density = stats.multivariate_t(shape=shape, df=one.settling.tail_dof)
    np.testing.assert_allclose(np.diff(found), np.diff(density.logpdf(turns)), atol=0.02)


@pytest.mark.parametrize("sensing", STACKS)
def test_the_search_finds_the_angle_at_which_a_motor_stands(model, sensing):
    """Each motor turned by up to 0.3 rad from where it should be, all others as they should."""
    one = model.seen_by(parse_sensing(sensing))
    should, turned = poses(), np.linspace(-0.3, 0.3, 5)
    for motor in range(4):
        own = np.eye(4, dtype=bool)[motor][None, None]
        stands = should + turned[:, None] * own[0]
        point = one.sensors.value(stands)
        found = one.sensors.nearest(should, own, point)[0]
        blind = np.linalg.norm(one.sensors.expected(should)[1][..., motor], axis=-1) < 1e-9
        expected = np.where(blind, should[:, motor], stands[:, motor])
        if sensing == "wire":  # one of two angles: what is seen there is the same
            pose = np.where(own[0], found[:, None], should)
            np.testing.assert_allclose(one.sensors.value(pose), point, atol=1e-9)
        else:
            np.testing.assert_allclose(found, expected, atol=2e-3)


def test_tool_alone_is_not_scaled(model):
    pose = poses()
    value, jacobian = model.twin.path_and_jacobian(pose)
    assert model.sensors.tool_alone
    assert np.array_equal(model.sensors.expected(pose)[0], value)
    assert np.array_equal(model.sensors.expected(pose)[1], jacobian)
    ball = 4.0 / 3.0 * np.pi * model.twin.robot.reach**3
    assert model.anywhere_log_density == pytest.approx(-np.log(ball))


# Whole runs.


def test_sensors_leave_all_other_chance_as_it_was(runs):
    plain = simulate(Plan("armpi_fpv", CLASSES, 4, 3, "armpi_fpv"))
    for name in ("command", "measured", "position"):
        np.testing.assert_array_equal(runs[name].values, plain[name].values)


@pytest.mark.parametrize("kind", KINDS)
def test_simulated_readings_at_rest_are_what_is_expected(runs, kind):
    twin = DigitalTwin("armpi_fpv")
    sensor = sensor_of(kind, twin)
    still = runs["time"].values < 0.05  # before the first movement
    seen = sensor.to_channels(runs[sensor.variable].values[:, still])
    expected, _ = sensor.expected(runs["position"].values[:, still])
    off = (seen - expected)[np.isfinite(seen).all(axis=-1) & np.isfinite(expected).all(axis=-1)]
    assert len(off) and np.abs(off).max() < 5.0 * np.hypot(sensor.noise, sensor.doubt) + 0.05


@pytest.mark.parametrize("sensing", ["accelerometer", "orientation", "wire", "tool+encoders"])
def test_a_stuck_motor_is_found(runs, sensing):
    told = {"accelerometer": 0.9, "orientation": 0.9, "wire": 0.5, "tool+encoders": 0.9}
    hypotheses = ["healthy", "motor_2:stuck", "motor_3:stuck"]
    found = BayesDiagnoser("armpi_fpv", "armpi_fpv", hypotheses, sensing=sensing)
    diagnoses = found.diagnose(runs.isel(run=slice(4, 8)))
    assert np.median([d.posterior["motor_2:stuck"] for d in diagnoses]) > told[sensing]
    for diagnosis in diagnoses:
        assert diagnosis.method.endswith(f"by {sensing}; healthy behaviour: armpi_fpv")


def test_without_a_tool_the_sensors_that_are_there_are_believed(runs):
    blind = runs[["command", "accelerometer"]].assign(measured=np.nan * runs["measured"])
    asked = ft.diagnose(runs, sensing="accelerometer")
    found = ft.diagnose(blind)
    for one, other in zip(asked, found, strict=True):
        assert one.posterior == pytest.approx(other.posterior)


def test_an_accelerometer_alone_cannot_tell_what_gravity_does_not_show(runs):
    """Errors of parallel joints look alike, and those of motor 1 like none: it says so."""
    found = ft.diagnose(runs, sensing="accelerometer")
    for diagnosis in found[:4]:
        p = diagnosis.posterior
        assert p["motor_1:steady_state_error"] == pytest.approx(p["healthy"], rel=0.05)
    for diagnosis in found[9:]:  # of the first two movements only can be used
        parallel = [diagnosis.posterior[f"motor_{k}:steady_state_error"] for k in (2, 3, 4)]
        assert sum(parallel) > 0.6
        assert max(diagnosis.posterior.values()) < 0.97


def test_a_constant_error_that_is_allowed_for_is_no_fault():
    """0.4 m/s2 on the accelerometer, two degrees: told as a doubt, or not.

    Untold it counts as a noisy sensor in part.
    """
    known = load_calibration("armpi_fpv", ft.load_robot("armpi_fpv")).imperfections
    off = SensorProfile("accelerometer", bias=(0.0, 0.4, 0.0), doubt=0.0)
    hypotheses = ["healthy", "motor_2:steady_state_error"]
    plan = Plan(
        imperfections=replace(known, sensors=(off,)),
        hypotheses=hypotheses,
        runs_per_class=6,
        sensors=["accelerometer"],
    )
    seen = simulate(plan)
    healthy = {}
    for doubt in (0.0, 0.3):
        told = SensorProfile("accelerometer", doubt=doubt)
        model = replace(known, sensors=(told,))
        one = BayesDiagnoser("armpi_fpv", model, hypotheses, sensing="accelerometer")
        healthy[doubt] = [d.posterior["healthy"] for d in one.diagnose(seen)]
    assert np.mean(healthy[0.0][:6]) < 0.6
    assert np.mean(healthy[0.3][:6]) > 0.7
    assert np.mean(healthy[0.3][6:]) < 0.3


def test_a_slow_motor_shows_on_the_way():
    hypotheses = ["healthy", "motor_2:slow", "motor_2:lag"]
    plan = Plan("armpi_fpv", hypotheses, 6, 1, "armpi_fpv", sensors=["accelerometer"])
    one = BayesDiagnoser("armpi_fpv", "armpi_fpv", hypotheses, sensing="accelerometer")
    found = one.diagnose(simulate(plan))
    p = np.array([[d.posterior[h] for h in hypotheses] for d in found]).reshape(3, 6, 3).mean(1)
    assert (np.diagonal(p) > 0.5).all(), p


def test_a_gyroscope_shows_a_motor_that_gravity_does_not():
    hypotheses = ["healthy", "motor_1:stuck"]
    plan = Plan("armpi_fpv", hypotheses, 6, 1, "armpi_fpv", sensors=["accelerometer", "gyroscope"])
    seen = simulate(plan)
    stuck = {}
    for sensing in ("accelerometer", "accelerometer+gyroscope"):
        one = BayesDiagnoser("armpi_fpv", "armpi_fpv", hypotheses, sensing=sensing)
        stuck[sensing] = [d.posterior["motor_1:stuck"] for d in one.diagnose(seen)][6:]
    assert np.mean(stuck["accelerometer+gyroscope"]) > 0.95
    assert np.mean(stuck["accelerometer"]) < np.mean(stuck["accelerometer+gyroscope"])


# What is refused.


def test_what_is_not_there_is_refused(runs):
    with pytest.raises(InputError, match="unknown sensor 'sonar'"):
        BayesDiagnoser("armpi_fpv", sensing="tool+sonar")
    with pytest.raises(InputError, match="tells nothing of where the arm rests"):
        BayesDiagnoser("armpi_fpv", sensing="gyroscope")
    with pytest.raises(InputError, match="no readings of wire"):
        ft.diagnose(runs.drop_vars("wire"), sensing="wire")
    only = runs[["command", "position"]].assign(measured=np.nan * runs["measured"])
    assert sensing_of(only, None) == ("tool",)  # the motors' readings are not believed unasked
    assert sensing_of(only, "encoders") == ("encoders",)
    assert sensing_of(runs, None) == ("tool",)


def test_faults_of_encoders_are_not_weighed_by_encoders(runs):
    hypotheses = ["healthy", "motor_1:encoder_bias"]
    one = BayesDiagnoser("armpi_fpv", None, hypotheses, sensing="tool+encoders")
    with pytest.raises(InputError, match="fault of the motor's own reading"):
        one.diagnose(runs)
    with pytest.raises(InputError, match="a stream sees by tool, tool"):
        ft.StreamingDiagnoser(BayesDiagnoser("armpi_fpv", sensing="accelerometer"))


def test_a_run_set_of_plain_arrays_needs_no_tool_position():
    time = np.arange(20) * 0.1
    command, force = np.zeros((20, 4)), np.tile([0.0, 0.0, 9.81], (20, 1))
    made = ft.run_set(time, command, sensors={"accelerometer": force})
    assert np.isnan(made["measured"].values).all()
    assert made["accelerometer"].attrs["units"] == "m/s2"
    assert sensing_of(made, None) == ("accelerometer",)
    with pytest.raises(InputError, match="unknown sensor variable"):
        ft.run_set(time, command, sensors={"compass": force})
    with pytest.raises(InputError, match="Check its unit"):
        ft.run_set(time, command, sensors={"accelerometer": 1e4 * force})
