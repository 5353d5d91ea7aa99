from __future__ import annotations

import json

import numpy as np
import pytest

from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.decision.learned.feature_encoder import (
    FeatureEncoder,
    signals_of,
)
from failuretwin.digital_model.nonidealities import Imperfections, Readings
from failuretwin.digital_model.settling import Settling

PER_MOTOR = ("turn", "misfit", "angle", "command")
TURN_RAD, DISTANCE_M = 0.01, 0.002

SAGGING = Imperfections(
    "sags",
    "test",
    settling=Settling(
        bias=(0.002, 0.005, 0.0, 0.003),
        compliance=(0.0, 0.14, 0.17, 0.19),
        friction=(0.007, 0.005, 0.011, 0.011),
        scatter=(0.0,) * 4,
    ),
    readings=Readings(rate_hz=10.0),
)


def some_runs(robot, hypothesis, imperfections=SAGGING):
    return simulate(Plan(robot, (Hypothesis.parse(hypothesis),), 5, 3, imperfections))


def expecting(imperfections, robot, runs):
    """Return robust features of a robot that is expected to have some imperfections."""
    encoder = FeatureEncoder("robust", robot, imperfections)
    return encoder.encode(signals_of(runs))


def undo(values, scale):
    return scale * np.sinh(3.0 * values)


def channel(robot, features, name):
    """Return one channel of every motor, (run, point, motor)."""
    motors = len(robot.motors)
    split = features[..., : motors * len(PER_MOTOR)].reshape(*features.shape[:2], motors, -1)
    return split[..., PER_MOTOR.index(name)]


def settled(points=100):
    """Points in the last fifth of each of five movements, after the first two."""
    place = np.arange(points) % 20
    return (place >= 16) & (np.arange(points) >= 40)


def test_original_features_are_every_tenth_sample(armpi):
    runs = simulate(Plan(armpi, (Hypothesis(),), 2, 1))
    features = FeatureEncoder("original", armpi).encode(signals_of(runs))
    assert features.shape == (2, 100, 7)
    np.testing.assert_allclose(features[..., :4], runs["command"].values[:, ::10], atol=1e-6)
    np.testing.assert_allclose(features[..., 4:], runs["measured"].values[:, ::10], atol=1e-6)


def test_augmented_features_begin_straight_up_and_vanish_at_rest(armpi):
    runs = simulate(Plan(armpi, (Hypothesis(),), 1, 1))
    features = FeatureEncoder("augmented", armpi).encode(signals_of(runs))
    straight = 0.310509  # zero pose, published kinematics
    np.testing.assert_allclose(features[0, 0], [0.0, 0.0, straight, 0.0, 0.0, 0.0], atol=1e-6)
    assert np.abs(features[0, 19::20, 3:]).max() < 1e-3
    assert np.abs(features[0, :, 3:]).max() > 0.003  # the servos lag on ramps


def test_gaps_are_filled_by_straight_lines(armpi):
    runs = simulate(Plan(armpi, (Hypothesis(),), 1, 1))
    line = np.linspace(0.0, 1.0, runs.sizes["time"])[:, None] * [1.0, 2.0, 3.0]
    runs["measured"].values[0] = line
    runs["measured"].values[0, 203:477] = np.nan
    features = FeatureEncoder("original", armpi).encode(signals_of(runs))
    np.testing.assert_allclose(features[0, :, 4:], line[::10], atol=1e-6)


@pytest.mark.parametrize(("name", "channels"), [("original", 7), ("augmented", 6), ("robust", 20)])
def test_channels_of_four_motors(armpi, name, channels):
    features = FeatureEncoder(name, armpi).encode(signals_of(some_runs(armpi, "healthy")))
    assert features.shape == (5, 100, channels)
    assert np.isfinite(features).all()


def test_an_unknown_feature_set_is_refused(armpi):
    with pytest.raises(InputError, match="Did you mean 'robust'"):
        FeatureEncoder("robus", armpi)


def test_joint_axes_are_those_that_the_tool_turns_about(armpi, twin):
    """Against the derivative of the path, which is tested against finite differences."""
    pose = np.random.default_rng(0).uniform(-1.5, 1.5, (50, 4))
    rotation, place = armpi.chain.frames(pose)
    origin, axis, tool = place[:, :-1], rotation[:, :-1, :, 2], place[:, -1]
    point, jacobian = twin.path_and_jacobian(pose)
    np.testing.assert_allclose(tool, point, atol=1e-12)
    turning = np.cross(axis, tool[:, None, :] - origin)
    np.testing.assert_allclose(np.moveaxis(jacobian, -1, -2), turning, atol=1e-12)


def test_nothing_is_off_on_a_healthy_arm_at_rest(armpi):
    runs = some_runs(armpi, "healthy")
    features = FeatureEncoder("robust", armpi, SAGGING).encode(signals_of(runs))
    turn = undo(channel(armpi, features, "turn")[:, settled()], TURN_RAD)
    plain = FeatureEncoder("robust", armpi).encode(signals_of(runs))
    without = undo(channel(armpi, plain, "turn")[:, settled()], TURN_RAD)
    assert np.abs(turn).max() < 0.004  # sag is taken at the commanded pose, not at the sagging one
    assert np.abs(without).max() > 0.03  # ideal motors are expected: they do sag


@pytest.mark.parametrize("motor", [0, 1, 2, 3])
def test_a_stuck_motor_explains_all_and_keeps_its_angle(armpi, motor):
    runs = some_runs(armpi, f"motor_{motor + 1}:stuck")
    features = FeatureEncoder("robust", armpi, SAGGING).encode(signals_of(runs))
    misfit = undo(channel(armpi, features, "misfit")[:, settled()], DISTANCE_M)
    angle = channel(armpi, features, "angle")[:, settled(), motor]
    median = np.median(misfit, axis=(0, 1))
    assert np.argmin(median) == motor
    assert median[motor] < 0.004
    held = runs["magnitude"].values[:, None]
    assert np.median(np.abs(angle - held)) < 0.03


def test_errors_of_a_motor_are_read_off_its_channel(armpi):
    runs = some_runs(armpi, "motor_2:steady_state_error")
    features = FeatureEncoder("robust", armpi, SAGGING).encode(signals_of(runs))
    turn = undo(channel(armpi, features, "turn")[..., 1], TURN_RAD)[:, 19::20]
    true = [json.loads(text)["faults"][0]["offset_rad"] for text in runs["fault_detail"].values]
    assert np.median(np.abs(turn - true)) < 0.01
    assert np.corrcoef(turn.ravel(), np.ravel(true))[0, 1] > 0.95


def test_points_without_a_reading_are_marked_and_say_nothing(armpi):
    runs = some_runs(armpi, "motor_1:stuck")
    runs["measured"].values[:, 300:600] = np.nan
    features = FeatureEncoder("robust", armpi, SAGGING).encode(signals_of(runs))
    missing = slice(31, 59)
    assert not features[:, missing, -1].any()
    assert features[:, :30, -1].all()
    for name in ("turn", "misfit", "angle"):
        assert not channel(armpi, features, name)[:, missing].any()
    assert channel(armpi, features, "command")[:, missing].any()


def test_a_glitch_counts_little_more_than_a_fault(armpi):
    runs = some_runs(armpi, "healthy")
    runs["measured"].values[:, 500] = 5.0  # far outside the workspace
    features = FeatureEncoder("robust", armpi, SAGGING).encode(signals_of(runs))
    assert np.abs(features).max() < 4.0


def test_long_runs_fill_the_same_points(armpi, measured_armpi):
    """Bus stalls make runs longer than ten seconds; the points then lie further apart."""
    runs = some_runs(armpi, "healthy", measured_armpi)
    assert runs["duration"].values.max() > 11.0
    features = expecting(measured_armpi, armpi, runs)
    last = features[np.argmax(runs["duration"].values), -10:, -1]
    assert last.any()
