from __future__ import annotations

import numpy as np
import pytest

from failuretwin import BayesDiagnoser, Plan
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.data_knowledge.generate import simulate
from failuretwin.digital_model.nonidealities import load_imperfections


@pytest.fixture(scope="session")
def live_runs(armpi):
    """Eighteen runs of the paper's nine states, with gaps, glitches, late starts."""
    imperfect = load_imperfections(armpi.name, armpi)
    return simulate(Plan(armpi, paper_hypotheses(armpi.motor_names), 2, 7, imperfect))


@pytest.fixture(scope="session")
def live_diagnoser(twin):
    return BayesDiagnoser(twin)


@pytest.fixture
def rng():
    return np.random.default_rng(0)
