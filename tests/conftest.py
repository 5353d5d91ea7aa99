from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

from failuretwin import DigitalTwin, load_robot

settings.register_profile("steady", deadline=None, derandomize=True)
settings.register_profile("search", deadline=None, max_examples=2000)
settings.load_profile("steady")

DATA = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def data():
    folder = Path(os.environ.get("FAILURETWIN_DATA", DATA))
    if not folder.is_dir():
        pytest.skip(f"no real logs in {folder}; set FAILURETWIN_DATA to the folder that holds them")
    return folder


@pytest.fixture(scope="session")
def simulink(data):
    """90 published runs of the Simulink model, ten of each label."""
    with np.load(data / "simulink_reference.npz") as archive:
        return {name: archive[name] for name in archive.files}


@pytest.fixture(scope="session")
def armpi():
    return load_robot("armpi_fpv")


@pytest.fixture(scope="session")
def twin(armpi):
    return DigitalTwin(armpi)
