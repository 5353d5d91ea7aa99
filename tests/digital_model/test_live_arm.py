from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from failuretwin.digital_model.nonidealities import Schedule
from failuretwin.digital_model.physics.engine import LiveArms, PhysicsEngine
from failuretwin.digital_model.twin import Drive
from failuretwin.failure_behavior.random_movements import RandomMovements

pytest.importorskip("mujoco")

TIME = np.arange(1000) * 0.01


@pytest.fixture(scope="module")
def reference(armpi):
    return RandomMovements().draw(armpi, Schedule(), np.random.default_rng(3)).reference(TIME)[0]


@pytest.mark.parametrize("cuts", [[], [1, 2, 700], [123, 500]])
def test_stretches_are_one_run_of_the_engine(armpi, reference, cuts):
    engine = PhysicsEngine(armpi)
    held = np.zeros(reference.shape, dtype=bool)
    held[300:620, 1] = True
    weakness = np.zeros(reference.shape)
    weakness[400:, 2] = 0.5
    whole = engine.angles(Drive(reference[None], held[None], weakness[None]), TIME)[0]
    arm = LiveArms(engine, reference[:1], 0.01, np.zeros(1))
    parts = [arm.angle]
    for part in np.split(np.arange(1, len(TIME)), cuts):
        # The engine holds a gear from the sample on where that begins, a step earlier.
        parts.append(
            arm.follow(reference[None, part], held[None, part - 1], weakness[None, part])[0]
        )
    assert_array_equal(np.concatenate(parts), whole)


def test_a_payload_pulls_the_arm_down(armpi):
    pose = np.array([[0.0, 0.8, 0.0, 0.0]] * 2)
    arms = LiveArms(PhysicsEngine(armpi), pose, 0.01, np.array([0.0, 0.05]))
    light, heavy = np.abs(arms.angle - pose)[:, 1]
    assert heavy > light > 0.0
