from __future__ import annotations

import numpy as np
import pytest

from failuretwin import DigitalTwin, load_robot
from failuretwin.digital_model.clearance import Clearance, segment_distance


def test_distance_of_segments_against_brute_force():
    rng = np.random.default_rng(0)
    ends = rng.normal(size=(4, 400, 3))
    found = segment_distance(*ends)
    share = np.linspace(0.0, 1.0, 161)[:, None]
    for i in range(400):
        a = ends[0, i] + share * (ends[1, i] - ends[0, i])
        b = ends[2, i] + share * (ends[3, i] - ends[2, i])
        brute = np.linalg.norm(a[:, None] - b[None], axis=-1).min()
        assert found[i] <= brute + 1e-12
        assert brute - found[i] < 0.02


def test_segments_that_cross_touch_and_lie_along_each_other():
    x, y, z = np.eye(3)
    assert segment_distance(-x, x, -y, y) == pytest.approx(0.0)
    assert segment_distance(-x, x, z - y, z + y) == pytest.approx(1.0)
    assert segment_distance(0 * x, x, 3 * x, 4 * x) == pytest.approx(2.0)
    assert segment_distance(0 * x, x, y, x + y) == pytest.approx(1.0)
    assert segment_distance(0 * x, x, 2 * x + y, 2 * x + 2 * y) == pytest.approx(np.sqrt(2.0))


@pytest.mark.parametrize("name", ["ur5e", "panda", "so101"])
def test_the_last_point_is_the_tool(name):
    robot = load_robot(name)
    clearance, twin = Clearance.of(robot), DigitalTwin(robot)
    low, high = np.array([motor.movement_range for motor in robot.motors]).T
    pose = np.random.default_rng(0).uniform(low, high, (20, len(low)))
    np.testing.assert_allclose(clearance.points(pose)[:, -1], twin.path(pose), atol=1e-12)


@pytest.mark.parametrize("name", ["armpi_fpv", "ur5e", "panda", "so101"])
def test_usual_movements_are_clear(name):
    robot = load_robot(name)
    low, high = np.array([motor.movement_range for motor in robot.motors]).T
    pose = np.random.default_rng(3).uniform(low, high, (2000, len(low)))
    assert np.mean(Clearance.of(robot).margin(pose) > 0.0) > 0.999


def test_an_arm_that_folds_onto_itself_or_bows_to_the_floor(armpi):
    clearance, upright = Clearance(armpi, 0.02), np.zeros(4)
    assert clearance.margin(upright) > 0.01
    folded = np.array([0.0, 1.57, -2.09, 2.09])  # the hand comes down onto the base
    assert clearance.gap_and_height(folded)[0] < -0.005
    bowed = np.array([0.0, 1.57, -0.9, 0.6])
    assert clearance.gap_and_height(bowed)[1] < 0.0
    assert Clearance.of(armpi, floor_m=-0.5).gap_and_height(bowed)[1] > 0.0


def test_wider_links_leave_less(armpi):
    pose = np.array([0.2, -0.6, 1.2, -1.0])
    thin, thick = Clearance(armpi, 0.005), Clearance(armpi, 0.01)
    shared = [pair for pair in thin.pairs.tolist() if pair in thick.pairs.tolist()]
    assert shared == thin.pairs.tolist()
    assert thin.gap_and_height(pose)[0] - thick.gap_and_height(pose)[0] == pytest.approx(0.01)
