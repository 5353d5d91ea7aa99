from __future__ import annotations

import pytest

from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.inference.observation.healthy_model import HealthyModel


@pytest.fixture(scope="session")
def model():
    known = load_calibration(None, "armpi_fpv")
    return HealthyModel.of(known.twin, known.imperfections)
