"""What a calibration says it was learned from, and what its command warns of."""

from dataclasses import replace

import pytest

import failuretwin as ft
from failuretwin.app.commands.learn import _wrong_set_up
from failuretwin.app.reports.calibration_report import calibration_parts
from failuretwin.core.hypothesis import HEALTHY
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.nonidealities import Schedule
from failuretwin.digital_model.robot import load_robot
from failuretwin.failure_behavior.random_movements import RandomMovements
from failuretwin.inference.engine.theta import has_geometry
from failuretwin.inference.seen_runs import SeenRuns
from failuretwin.inference.set_ups.wrong_setup import ELSEWHERE

ENDLESS = RandomMovements(count=6, period_s=1.2, ramp_shares=(1.0,))
LABELS = ["fault", "fault_detail", "onset", "magnitude", "position"]


def healthy_runs(robot, like, movements=None):
    """Three runs of a healthy robot; movements that are given follow each other without a rest."""
    own = replace(like, lost_commands=())
    own = own if movements is None else replace(own, schedule=Schedule(period_s=(1.2, 1.2)))
    plan = Plan(robot, [HEALTHY], 3, seed=5, imperfections=own, movements=movements)
    return simulate(plan).drop_vars(LABELS, errors="ignore")


@pytest.fixture(scope="module")
def restless(armpi, measured_armpi):
    """A calibration by runs without a rest, whose path is computed."""
    return ft.calibrate(healthy_runs(armpi, measured_armpi, ENDLESS), armpi)


def test_a_calibration_of_an_arm_that_never_rests_counts_moments(armpi, restless):
    found = restless
    head = str(calibration_parts(found, armpi)[0])
    assert f"{found.movements} moments on the way of 3 runs" in head
    assert "settled" not in head
    assert (
        replace(found, movements=3, moments=1).extent
        == "2 settled movements and 1 moment on the way of 3 runs"
    )


@pytest.mark.parametrize("place", ["", f"{ELSEWHERE} (99.0%)"])
def test_scatter_is_no_wrong_set_up_for_a_calibration(armpi, measured_armpi, monkeypatch, place):
    """A calibration learns it; only a sensor that stands elsewhere is warned of."""
    scatter = "the motors seem to scatter about 2.5 times as much as when they were calibrated"
    told = "; ".join(filter(None, (place, scatter)))
    monkeypatch.setattr(SeenRuns, "elsewhere", lambda _: told)
    said = _wrong_set_up(healthy_runs(armpi, measured_armpi), armpi)
    assert ("failuretwin doctor" in said) == bool(place)


def test_what_was_learned_beside_joint_frames_counts_beside_them():
    """Runs on the way of an arm whose tool is watched do not tell frames from zeros."""
    ur5e = load_robot("ur5e")
    found = ft.calibrate(healthy_runs(ur5e, generic_imperfections(ur5e), ENDLESS), ur5e)
    assert found.imperfections.frames_in_doubt
    assert has_geometry(ft.BayesDiagnoser(ur5e, found.imperfections).healthy_model)


def test_a_path_that_is_computed_leaves_no_frame_in_doubt(restless):
    assert not restless.imperfections.frames_in_doubt
