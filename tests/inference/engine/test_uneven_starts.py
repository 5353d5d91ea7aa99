"""How unevenly motors start, which each run that is seen on the way sums over."""

from __future__ import annotations

import numpy as np
import pytest

from failuretwin.digital_model.arm_classes import ARM_CLASSES, generic_imperfections
from failuretwin.digital_model.robot import load_robot
from failuretwin.inference.engine.moved_motor import _middle_of_best
from failuretwin.inference.engine.theta import JITTER, OF_CLASS, layout_of, robot_components
from failuretwin.inference.observation.healthy_model import HealthyModel


@pytest.fixture(scope="module")
def model():
    robot = load_robot("ur5e")
    return HealthyModel.of(robot, generic_imperfections(robot))


def test_on_the_way_each_factor_has_its_share(model):
    found = robot_components(model, layout_of(model, moving=True), OF_CLASS)
    weight = np.exp(found.log_weight)
    assert weight.sum() == pytest.approx(1.0)
    for factor, share in {1.0: 0.4, 0.4: 0.4, 2.5: 0.2}.items():
        assert weight[found.jitter == factor].sum() == pytest.approx(share)
    assert set(found.jitter) == set(JITTER)


def test_at_rest_nothing_is_summed_over(model):
    found = robot_components(model, layout_of(model), OF_CLASS)
    assert set(found.jitter) == {1.0}


def test_controllers_are_more_punctual_than_servos_on_a_bus(model):
    servo = HealthyModel.of("so101", generic_imperfections(load_robot("so101")))
    assert model.start_jitter_s == ARM_CLASSES["industrial"].start_jitter_s == 0.006
    assert servo.start_jitter_s == 0.05


def test_of_nodes_that_say_the_same_the_middle_one_is_taken():
    says = np.array(
        [[0.0, 0.0, 1e-12, 0.0, -1e-12], [0.0, 2.0, 2.0, 2.0, 1.0], [3.0, 0.0, 0, 0, 0]]
    )
    assert _middle_of_best(says).tolist() == [2, 2, 0]
