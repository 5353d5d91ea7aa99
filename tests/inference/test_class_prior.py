"""Robots that are drawn from their class are judged as honestly as the class promises."""

from __future__ import annotations

import numpy as np
import pytest

import failuretwin as ft
from failuretwin.core.runs import truth_of
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.robot import load_robot
from failuretwin.failure_behavior.modes import SteadyStateError
from failuretwin.failure_behavior.registry import MODES

ARM = "armpi_fpv"
ERRORS_RAD = (0.02, 0.08)
"""Sizes of errors that are not plain."""
SURE = 3.0


@pytest.mark.parametrize("count", [3, pytest.param(12, marks=pytest.mark.slow)])
def test_the_log_score_is_what_the_posteriors_expect(count):
    """Given a posterior p, -log p(truth) has mean H = -sum p log p and a variance by p alone."""
    usual = generic_imperfections(load_robot(ARM))
    error = SteadyStateError(magnitude=ERRORS_RAD)
    modes = {**MODES, "steady_state_error": error}
    plan = Plan(ARM, runs_per_class=count, seed=3, imperfections=usual, modes=modes)
    runs = simulate(plan)
    excess = variance = 0.0
    for found, truth in zip(ft.diagnose(runs, ARM, "generic"), truth_of(runs), strict=True):
        p = np.array([share for share in found.posterior.values() if share > 0.0])
        entropy = -np.sum(p * np.log(p))
        excess -= np.log(found.posterior[truth]) + entropy
        variance += np.sum(p * np.log(p) ** 2) - entropy**2
    assert abs(excess) < SURE * np.sqrt(variance)
