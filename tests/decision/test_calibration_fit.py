"""Another robot of the same make, told from the one that a calibration is of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from failuretwin import BayesDiagnoser
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.failure_behavior.random_movements import RandomMovements
from failuretwin.inference.calibration_fit import MISFIT, calibration_told, fits_this_robot
from failuretwin.inference.set_up_posterior import SetUpPosterior
from failuretwin.inference.set_ups.set_ups import zero_off

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


def test_another_robot_is_weighed_where_the_set_up_is_in_doubt(armpi):
    """A zero that may be off by a little explains less than another robot does."""
    works, known = (load_calibration(name, armpi) for name in ("armpi_fpv_a_2024", "armpi_fpv"))
    plan = Plan(armpi, ["healthy"], 4, 5, works.imperfections, RandomMovements(count=6))
    runs = simulate(plan)
    prepared = BayesDiagnoser(known.twin, known.imperfections).prepare(runs)
    (told,) = prepared.set_ups.found[:1]
    zero = replace(told, set_up=zero_off(armpi, 0, np.deg2rad(1.0)))
    sure = SetUpPosterior([told], np.ones(1))
    in_doubt = SetUpPosterior([told, zero], np.array([0.9, 0.1]))
    judged = []
    for believed in (sure, in_doubt):
        again = replace(prepared)
        vars(again)["set_ups"] = believed
        judged.append([one.posterior["healthy"] for one in again.diagnose(runs)])
    np.testing.assert_allclose(judged[1], judged[0], atol=0.12)


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
