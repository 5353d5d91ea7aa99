from __future__ import annotations

import numpy as np
import pytest

from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.settling import Settling

RAD_PER_COUNT = np.deg2rad(0.24)


@pytest.fixture(scope="module")
def settling(armpi):
    return load_calibration("armpi_fpv", armpi).imperfections.settling


def published_sag_counts(pose):
    """Sag of motors 2 to 4 of the real robot by its lever arms [counts], its published fit."""
    a = pose[:, 1]
    b = a - pose[:, 2]
    c = b + pose[:, 3]
    A4 = 0.05071 * np.sin(c)
    A3 = 0.094714 * np.sin(b) + A4
    A2 = 0.10048 * np.sin(a) + A3
    return np.stack([-45.7 * A2, 51.5 * A3, -59.1 * A4], axis=-1)


def test_armpi_sags_where_and_how_far_the_real_one_does(armpi, settling):
    """Load torque and lever arms are two measures of the same sag: they differ by a count or so."""
    pose = np.random.default_rng(1).uniform(-0.87, 0.87, (2000, 4))
    offset = settling.offset(armpi, pose, np.zeros((2000, 4))) - settling.bias
    expected = published_sag_counts(pose)
    found = -offset[:, 1:] / RAD_PER_COUNT
    assert (np.std(found - expected, axis=0) < [1.0, 0.7, 0.5]).all()
    for motor in range(3):
        assert np.corrcoef(found[:, motor], expected[:, motor])[0, 1] > 0.97
    assert not offset[:, 0].any(), "gravity does not turn a vertical axis"


def test_friction_is_that_of_the_healthy_logs(settling):
    found = np.array(settling.friction) / RAD_PER_COUNT
    np.testing.assert_allclose(found, [1.54, 1.01, 2.49, 2.64], atol=0.25)


def test_a_motor_gives_way_by_its_compliance_times_the_torque_of_a_payload(armpi):
    zero = (0.0,) * 4
    bare = Settling(zero, (0.0, 0.1, 0.1, 0.1), zero, zero, np.inf, "test")
    loaded = Settling(zero, (0.0, 0.1, 0.1, 0.1), zero, zero, np.inf, "test", payload=0.2)
    pose = np.array([0.3, np.pi / 2, 0.0, 0.0])  # the arm stretched out level
    more = loaded.offset(armpi, pose, zero) - bare.offset(armpi, pose, zero)
    arms = np.array([0.0, 0.10048 + 0.094714 + 0.05071, 0.094714 + 0.05071, 0.05071])
    sense = np.array([1.0, 1.0, -1.0, 1.0])
    # Turning about +x brings a stretched arm down on the side of -y: gravity helps.
    np.testing.assert_allclose(more, sense * 0.1 * 0.2 * 9.81 * arms, atol=1e-12)


def test_friction_stops_a_motor_short_of_its_target(armpi, settling):
    pose = np.zeros((1, 4))
    up, down = (settling.offset(armpi, pose, d) for d in (np.ones(4), -np.ones(4)))
    assert (up < down).all()


def test_batches_of_any_shape(armpi, settling):
    pose = np.random.default_rng(2).uniform(-1, 1, (2, 3, 4))
    direction = np.ones((2, 3, 4))
    together = settling.offset(armpi, pose, direction)

    assert together.shape == (2, 3, 4)
    alone = settling.offset(armpi, pose[1, 2], direction[1, 2])
    np.testing.assert_allclose(together[1, 2], alone, atol=1e-15)


def test_ideal_motors_settle_at_their_targets(armpi):
    pose = np.random.default_rng(3).uniform(-1, 1, (5, 4))
    offset = Settling.ideal(4).offset(armpi, pose, np.ones((5, 4)))
    np.testing.assert_array_equal(offset, np.zeros((5, 4)))
