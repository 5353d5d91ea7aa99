from __future__ import annotations

import pytest
from slide_runs import PLAIN, scene_of
from small_arms import GANTRY, small_twin

from failuretwin import BayesDiagnoser
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.digital_model.calibrated_robot import load_calibration


@pytest.fixture(scope="session")
def imperfect(armpi):
    """Eight runs of each of the paper's classes, with the imperfections of the real robot."""
    known = load_calibration("armpi_fpv", armpi).imperfections
    return simulate(Plan(armpi, paper_hypotheses(armpi.motor_names), 8, 5, known))


@pytest.fixture(scope="session")
def diagnoses(twin, imperfect):
    """What the default diagnoser says of `imperfect`."""
    return BayesDiagnoser(twin).diagnose(imperfect)


@pytest.fixture(scope="session")
def slide(tmp_path_factory):
    """An arm of one slide along x."""
    return small_twin(tmp_path_factory.mktemp("slide"), "slide", GANTRY[:1])


@pytest.fixture(scope="session")
def run_on(slide, run_of):
    """Make a scene of one run of the slide, and its densities by brute force."""

    def make(targets, stands, imperfections=PLAIN):
        return scene_of(slide, run_of, targets, stands, imperfections)

    return make
