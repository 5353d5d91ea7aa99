"""What motions that never rest can show: by their moments, and as often as runs are diagnosed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import failuretwin as ft
from failuretwin.core.hypothesis import HEALTHY, single_faults
from failuretwin.core.runs import truth_of
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.nonidealities import NO_IMPERFECTIONS, Schedule
from failuretwin.digital_model.robot import load_robot
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.failure_behavior.modes import SteadyStateError
from failuretwin.failure_behavior.random_movements import RandomMovements
from failuretwin.inference.expected_bayes_factors import ExpectedLogBayesFactor
from failuretwin.inference.isolability import _motions
from failuretwin.inference.observation.healthy_model import HealthyModel

ROBOT = load_robot("armpi_fpv")
TIME = 0.01 * np.arange(801)
ERROR = "motor_1:steady_state_error"
WITHOUT_REST = RandomMovements(count=6, period_s=1.2, ramp_shares=(1.0,))
LOOP_S = 0.025
"""By how much the servo loop of the published model trails a slow command, about [s]."""
USUAL = replace(generic_imperfections(ROBOT), schedule=Schedule(period_s=(1.2, 1.2)))


def curve(seed):
    """A smooth curve through random points, (time, motor) [rad]."""
    at = np.arange(0.0, 9.0, 0.9)
    return CubicSpline(at, np.random.default_rng(seed).uniform(-0.7, 0.7, (len(at), 4)))(TIME)


def zigzag(seed):
    """Ramps of 1.2 s from target to target, none with a rest, (time, motor) [rad]."""
    ends = np.arange(0.0, 9.0, 1.2)
    targets = np.random.default_rng(seed).uniform(-0.7, 0.7, (len(ends), 4))
    return np.stack([np.interp(TIME, ends, one) for one in targets.T], axis=-1)


def test_an_arm_without_flaws_goes_along_the_curve_that_it_is_told():
    ideal = ExpectedLogBayesFactor(
        HealthyModel.of(ROBOT, NO_IMPERFECTIONS), (HEALTHY,), ft.Priors()
    )
    runs = _motions(DigitalTwin(ROBOT), curve(0), TIME)
    path = ideal.noise_free(runs, [[]], curves=True)["measured"].values[0]
    seen = np.isfinite(path).all(axis=-1)
    late = [np.interp(TIME - LOOP_S, TIME, one) for one in curve(0).T]
    wanted = DigitalTwin(ROBOT).path(np.stack(late, axis=-1)[seen])
    assert seen.sum() > 70
    np.testing.assert_allclose(path[seen], wanted, atol=0.006)  # a straight way is 0.2 m off


@pytest.mark.parametrize("motion", [pytest.param(zigzag, marks=pytest.mark.slow), curve])
def test_a_motion_that_never_rests_shows_errors_that_come_while_it_lasts(motion):
    found = ft.isolability(ROBOT, motion(0), TIME, "generic", [ERROR], onset_s=3.0)
    size = found.detected[ERROR]
    assert size is not None
    assert np.radians(1.0) < size < np.radians(6.0)  # 0.6 deg is what one rest of a known arm shows


@pytest.fixture(scope="module")
def foretold():
    """The smallest error that is found in random motions without a rest [rad]."""
    runs = simulate(Plan(ROBOT, ["healthy"], 2, 5, USUAL, WITHOUT_REST))
    commands, time = runs["command"].values, runs["time"].values
    return ft.isolability(ROBOT, commands, time, "generic", [ERROR]).detected[ERROR]


@pytest.mark.parametrize(("times", "least", "most"), [(2.0, 9, 10), (0.3, 0, 2)])
def test_runs_are_diagnosed_from_the_size_on_that_is_foretold(foretold, times, least, most):
    """Among errors of every motor; a motor that is stuck is no rival of a small one."""
    assert foretold is not None
    mode = SteadyStateError(magnitude=(times * foretold, times * foretold))
    modes = {"steady_state_error": mode}
    runs = simulate(Plan(ROBOT, [ERROR], 10, 6, USUAL, WITHOUT_REST, modes=modes))
    found = ft.diagnose(runs, ROBOT, "generic", single_faults(ROBOT.motor_names, modes))
    right = [d.diagnosis == truth for d, truth in zip(found, truth_of(runs), strict=True)]
    assert least <= sum(right) <= most
