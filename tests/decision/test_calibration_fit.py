"""Another robot of the same make, told from the one that a calibration is of."""

from __future__ import annotations

import pytest

from failuretwin import BayesDiagnoser
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.failure_behavior.random_movements import RandomMovements
from failuretwin.inference.calibration_fit import MISFIT, calibration_told, fits_this_robot

TRUTHS = ["healthy", "motor_2:stuck", "motor_3:steady_state_error"]
ROBOTS = ("armpi_fpv", "armpi_fpv_a_2024")


@pytest.mark.parametrize("own", ROBOTS)
@pytest.mark.parametrize("given", ROBOTS)
def test_a_calibration_fits_its_own_robot_alone(armpi, own, given):
    """Also where two runs in three are faulty."""
    works, known = (load_calibration(name, armpi) for name in (own, given))
    runs = simulate(Plan(armpi, TRUTHS, 3, 5, works.imperfections, RandomMovements(count=6)))
    fits = fits_this_robot(BayesDiagnoser(known.twin, known.imperfections).seen(runs))
    assert (fits > 0.9) if own == given else (fits < MISFIT)


def test_without_a_calibration_there_is_nothing_to_fit(armpi):
    known = load_calibration("generic", armpi)
    runs = simulate(Plan(armpi, ["healthy"], 1, 5, known.imperfections))
    for name in ("generic", "none"):
        given = load_calibration(name, armpi)
        seen = BayesDiagnoser(given.twin, given.imperfections).seen(runs)
        assert fits_this_robot(seen) is None


def test_what_is_said_of_it():
    assert "is this robot's: 97 % sure" in calibration_told("x", 0.97)
    assert "another robot of the same make" in calibration_told("x", 0.01)
