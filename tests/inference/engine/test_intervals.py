"""Intervals of onset, held angle and size against the truth of simulated runs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import failuretwin as ft
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.digital_model.calibrated_robot import calibrated
from failuretwin.digital_model.robot import load_robot
from failuretwin.failure_behavior.registry import MODES

MOTORS = ("motor_1", "motor_2", "motor_3", "motor_4")


def judged(imperfections, robot, mode, count, **faults):
    """Diagnose runs in which motors whose motion shows at the tool are faulty."""
    modes = {**MODES, mode: replace(MODES[mode], **faults)}
    names = [f"{motor}:{mode}" for motor in MOTORS]
    runs = simulate(Plan(robot, names, count, 5, imperfections, modes=modes))
    among = list(dict.fromkeys(["healthy", *names, "motor_3:steady_state_error", "motor_3:stuck"]))
    found = ft.BayesDiagnoser(robot, imperfections, hypotheses=among).diagnose(runs)
    right = [(d, run) for run, d in enumerate(found) if d.diagnosis == d.truth]
    assert len(right) > 0.8 * len(found)
    return right, runs


def share_inside(found, runs, interval, truth):
    held = [
        getattr(d, interval)[0] <= float(runs[truth].values[run]) <= getattr(d, interval)[1]
        for d, run in found
    ]
    return np.mean(held)


@pytest.fixture(scope="module")
def so101():
    known = calibrated(load_robot("so101"))
    return known.imperfections, known.robot


@pytest.fixture(scope="module")
def stuck(so101):
    return judged(*so101, "stuck", 12, onset_s=(0.3, 6.0))


def test_held_angles_of_an_arm_of_a_class_lie_in_their_intervals(stuck):
    assert share_inside(*stuck, "magnitude_90", "magnitude") > 0.8


def test_onsets_of_an_arm_of_a_class_lie_in_their_intervals(stuck):
    assert share_inside(*stuck, "onset_90", "onset") > 0.75


def test_a_motor_that_was_stuck_before_the_run_is_held_where_its_own_zero_puts_it():
    """What is known of an arm of a class is not where it settles, but where such arms do."""
    known = calibrated(load_robot("panda"))
    found, runs = judged(known.imperfections, known.robot, "stuck", 12, onset_s=(0.0, 0.0))
    assert share_inside(found, runs, "magnitude_90", "magnitude") > 0.8
    assert share_inside(found, runs, "onset_90", "onset") > 0.8


def test_sizes_of_errors_of_an_arm_of_a_class_lie_in_their_intervals(so101):
    found, runs = judged(*so101, "steady_state_error", 12)
    assert share_inside(found, runs, "magnitude_90", "magnitude") > 0.65


def test_sizes_are_as_fine_as_what_is_seen(so101):
    """The errors of movements are drawn anew, and the size of a run is their rms."""
    known, robot = so101
    still = (0.0,) * 5
    exact = replace(known.settling, friction=still, compliance=still, scatter=(1e-4,) * 5)
    precise = replace(known, settling=exact, variation=None, of_class=False)
    found, runs = judged(precise, robot, "steady_state_error", 3, magnitude=(0.08, 0.12))
    for diagnosis, run in found:
        truth = float(runs["magnitude"].values[run])
        low, high = diagnosis.magnitude_90
        assert diagnosis.magnitude == pytest.approx(truth, rel=0.02)
        assert high - low < 0.08 * truth
