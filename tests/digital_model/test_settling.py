from __future__ import annotations

import numpy as np
import pytest

from failuretwin.digital_model.imperfections import load_imperfections
from failuretwin.digital_model.settling import Settling

RAD_PER_COUNT = np.deg2rad(0.24)


@pytest.fixture(scope="module")
def settling(armpi):
    return load_imperfections("armpi_fpv", armpi).settling


def fitted_error_counts(pose, direction_counts):
    """Settled error of the real robot [counts], as fitted to its healthy logs."""
    a = pose[:, 1]
    b = a - pose[:, 2]
    c = b + pose[:, 3]
    A4 = 0.05071 * np.sin(c)
    A3 = 0.094714 * np.sin(b) + A4
    A2 = 0.10048 * np.sin(a) + A3
    d1, d2, d3, d4 = direction_counts.T
    return np.stack(
        [
            -0.35 - 1.54 * d1,
            -1.22 - 45.7 * A2 - 1.01 * d2,
            -0.05 + 51.5 * A3 - 2.49 * d3,
            -0.65 - 59.1 * A4 - 2.64 * d4,
        ],
        axis=-1,
    )


def test_armpi_settles_where_the_healthy_logs_say(armpi, settling):
    rng = np.random.default_rng(1)
    pose = rng.uniform(-1.5, 1.5, (200, 4))
    direction = rng.choice([-1.0, 0.0, 1.0], (200, 4))

    offset = settling.offset(armpi.chain, armpi.sense, pose, direction)

    np.testing.assert_allclose(
        -offset / RAD_PER_COUNT, fitted_error_counts(pose, -direction), rtol=0, atol=1e-3
    )


def test_scatter_is_that_of_the_healthy_logs(settling):
    np.testing.assert_allclose(
        np.array(settling.scatter) / RAD_PER_COUNT, [1.4, 1.7, 1.4, 1.0], atol=1e-3
    )


def test_friction_stops_a_motor_short_of_its_target(armpi, settling):
    pose = np.zeros((1, 4))
    up, down = (
        settling.offset(armpi.chain, armpi.sense, pose, d) for d in (np.ones(4), -np.ones(4))
    )
    assert (up < down).all()


def test_batches_of_any_shape(armpi, settling):
    pose = np.random.default_rng(2).uniform(-1, 1, (2, 3, 4))
    direction = np.ones((2, 3, 4))
    together = settling.offset(armpi.chain, armpi.sense, pose, direction)

    assert together.shape == (2, 3, 4)
    alone = settling.offset(armpi.chain, armpi.sense, pose[1, 2], direction[1, 2])
    np.testing.assert_allclose(together[1, 2], alone, atol=1e-15)


def test_ideal_motors_settle_at_their_targets(armpi):
    pose = np.random.default_rng(3).uniform(-1, 1, (5, 4))
    offset = Settling.ideal(4).offset(armpi.chain, armpi.sense, pose, np.ones((5, 4)))
    np.testing.assert_array_equal(offset, np.zeros((5, 4)))
