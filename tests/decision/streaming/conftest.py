from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from failuretwin import BayesDiagnoser, Plan
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.core.movements import Movements
from failuretwin.data_knowledge.generate import simulate
from failuretwin.decision.streaming.monitor import monitor
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.nonidealities import NO_IMPERFECTIONS
from failuretwin.failure_behavior.random_movements import RandomMovements


@pytest.fixture(scope="session")
def live_runs(armpi):
    """Eighteen runs of the paper's nine states, with gaps, glitches, late starts."""
    imperfect = load_calibration(armpi.name, armpi).imperfections
    return simulate(
        Plan(armpi, paper_hypotheses(armpi.motor_names), 2, 7, imperfect, RandomMovements(count=3))
    )


@pytest.fixture(scope="session")
def live_diagnoser(twin):
    return BayesDiagnoser(twin)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


PERIOD_S = 2.04
STEP_S = 0.1


@pytest.fixture
def watcher(twin):
    """What watches an exact arm."""
    return monitor(twin, NO_IMPERFECTIONS)


def work_of(twin, rng, movements, stuck=()):
    """Return samples of a healthy, exact arm: a random movement every two seconds, seen at 10 Hz.

    Each of `stuck` is a motor, and the movements in which it stays where it is.
    """
    low, high = np.array([motor.movement_range for motor in twin.robot.motors]).T
    target = rng.uniform(0.5 * low, 0.5 * high, (1, movements, len(low)))
    start = 0.5 + PERIOD_S * np.arange(movements)[None]
    commanded = Movements(np.zeros((1, len(low))), target, np.full(target.shape, 0.8), start)
    time = np.arange(round((0.5 + PERIOD_S * movements) / STEP_S)) * STEP_S
    reference = commanded.reference(time)[0]
    angles = reference.copy()
    for motor, first, last in stuck:
        begin, end = (0.3 + PERIOD_S * number for number in (first, last))
        inside = (time >= begin) & (time < end)
        angles[inside, motor] = angles[np.argmax(inside), motor]
    points = twin.path(angles) + rng.normal(0.0, 3e-4, (len(time), 3))
    return list(zip(time.tolist(), reference, points, strict=True))


@pytest.fixture
def work(twin, rng):
    """Make samples of an arm at work."""
    return partial(work_of, twin, rng)


@pytest.fixture(scope="session")
def told_of_repaired(twin):
    """Answers about an exact arm whose motor 2 is stuck from movement 6 to movement 12 of 24."""
    watch = monitor(twin, NO_IMPERFECTIONS)
    samples = work_of(twin, np.random.default_rng(0), 24, [(1, 6, 12)])
    return [watch.update(*sample) for sample in samples]
