from __future__ import annotations

import numpy as np
import pytest

from failuretwin import BayesDiagnoser, Plan
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.data_knowledge.generate import simulate
from failuretwin.digital_model.calibrated_robot import load_calibration


@pytest.fixture(scope="session")
def live_runs(armpi):
    """Eighteen runs of the paper's nine states, with gaps, glitches, late starts."""
    imperfect = load_calibration(armpi.name, armpi).imperfections
    return simulate(Plan(armpi, paper_hypotheses(armpi.motor_names), 2, 7, imperfect))


@pytest.fixture(scope="session")
def live_diagnoser(twin):
    return BayesDiagnoser(twin)


@pytest.fixture
def rng():
    return np.random.default_rng(0)
