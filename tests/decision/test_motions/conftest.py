from __future__ import annotations

import numpy as np
import pytest

from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.decision.acting.safety import SafetyGate
from failuretwin.decision.test_motions.design import Designer
from failuretwin.decision.test_motions.health_check import checking
from failuretwin.decision.test_motions.outlook import Outlook, of_priors
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.inference.observation.healthy_model import HealthyModel


@pytest.fixture(scope="session")
def known(armpi):
    """The ArmPi FPV with its bundled calibration."""
    return load_calibration(None, armpi)


@pytest.fixture(scope="session")
def model(known):
    """What it does when healthy."""
    return HealthyModel.of(known.twin, known.imperfections)


@pytest.fixture(scope="session")
def gate(armpi):
    """What is safe."""
    return SafetyGate(armpi)


@pytest.fixture(scope="session")
def outlook(model):
    """The paper's nine classes."""
    asked = paper_hypotheses(model.motor_names)
    return Outlook(model, of_priors(model, asked, checking(model, asked)))


@pytest.fixture(scope="session")
def designed(gate, outlook):
    """Movements of 20 s from the zero pose."""
    return Designer(gate, outlook, seed=0).sequence(np.zeros(4), 20.0)
