from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from failuretwin import DigitalTwin, load_robot
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.inference.explanation import with_joint_names
from failuretwin.inference.set_ups.registration import align
from failuretwin.inference.set_ups.wrong_setup import wrong_setup

TURN = Rotation.from_euler("xyz", [20.0, -30.0, 140.0], degrees=True)


@pytest.fixture(scope="module")
def twin():
    return DigitalTwin("ur5e")


def poses(twin, count=6):
    rng = np.random.default_rng(0)
    target = rng.uniform(-1.0, 1.0, (count, len(twin.robot.motors)))
    return target, twin.path(target) + rng.normal(0.0, 1e-3, (count, 3))


def reversed_motor(target, motor):
    target = target.copy()
    target[:, motor] *= -1.0
    return target


MISTAKES = {
    "millimetres": (lambda q, p: (q, 1e3 * p), "tool positions look like millimetres"),
    "degrees": (lambda q, p: (np.degrees(q), p), "commands look like degrees"),
    "sense": (lambda q, p: (reversed_motor(q, 1), p), "motor 2 turns the other way"),
    "swapped": (
        lambda q, p: (q[:, [0, 2, 1, *range(3, q.shape[1])]], p),
        "the commands of motor 2 and motor 3 are swapped",
    ),
    "shift": (
        lambda q, p: (q, p + np.array([0.0, 0.83, 0.0])),
        "off by the same 830 mm after every movement",
    ),
    "turn": (lambda q, p: (q, TURN.apply(p) + 0.6), "in a frame turned by"),
    "columns": (lambda q, p: (q, p[:, [1, 0, 2]]), "columns x, y, z hold y, x, z"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_simple_mistake_is_named(twin, name):
    spoil, told = MISTAKES[name]
    setup = wrong_setup(twin, *spoil(*poses(twin)))
    assert setup is not None
    assert told in setup.told


def test_nothing_is_said_where_nothing_explains_it(twin):
    target, point = poses(twin, 12)
    assert wrong_setup(twin, target, point[::-1]) is None


def test_one_pose_says_nothing(twin):
    target, point = poses(twin, 1)
    assert wrong_setup(twin, target, 1e3 * point) is None


def test_a_frame_is_found_though_some_points_are_off():
    rng = np.random.default_rng(1)
    model = rng.uniform(-1.0, 1.0, (40, 3))
    seen = TURN.apply(model) + np.array([3.0, -2.0, 1.0]) + rng.normal(0.0, 1e-4, (40, 3))
    seen[::5] += rng.uniform(-0.5, 0.5, (8, 3))
    frame = align(model, seen)
    np.testing.assert_allclose(frame.R, TURN.as_matrix(), atol=1e-3)
    np.testing.assert_allclose(frame.origin, [3.0, -2.0, 1.0], atol=1e-3)


@pytest.mark.parametrize(
    ("robot", "verdict"),
    [
        ("ur5e", "motor 3 (elbow) stuck, 90 % sure"),
        ("armpi_fpv", "motor 3 stuck, 90 % sure"),  # its joints are only counted
    ],
)
def test_a_motor_that_has_but_a_number_is_named_by_its_joint(robot, verdict):
    told = Diagnosis(run="one", posterior={}, verdict="motor 3 stuck, 90 % sure")
    assert with_joint_names(told, load_robot(robot)).verdict == verdict
