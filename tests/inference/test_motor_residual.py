"""The residual of a run that no known fault explains, judged by the displacement that was made."""

from __future__ import annotations

import json
import re
from dataclasses import asdict

import numpy as np
import pytest

import failuretwin as ft
from failuretwin.core.config import from_table
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.failure_behavior.registry import load_modes
from failuretwin.inference.faults.motor_residual import lone_motor, motor_residual


def seen(tmp_path, motor, size, hypotheses=("healthy", "unknown")):
    """Return a diagnoser, and a run with a motor that is off by so much [rad]."""
    file = tmp_path / "modes.toml"
    file.write_text(
        f"[encoder_bias]\nmagnitude = [{size}, {size}]\nboth_signs = false\n"
        'onset_s = [0, 0]\nprofiles = ["step"]\n'
    )
    plan = ft.Plan("armpi_fpv", [f"{motor}:encoder_bias"], 1, 3, modes=load_modes(file))
    return ft.BayesDiagnoser("armpi_fpv", "armpi_fpv", hypotheses), ft.simulate(plan)


def check(told, motor, size):
    assert (told.motor, told.unit) == (motor, "rad")
    np.testing.assert_allclose(told.displacement, size, atol=0.03)
    deviation = np.array(told.deviation)
    assert np.all((deviation > 0.0) & (deviation < 0.03))
    assert set(told.direction) <= {-1.0, 0.0, 1.0}
    assert np.ptp(told.angle) > 0.3


@pytest.mark.parametrize(("motor", "size"), [("motor_2", 0.15), ("motor_3", -0.15)])
def test_the_motor_and_its_displacement_are_those_of_the_fault(tmp_path, motor, size):
    diagnoser, runs = seen(tmp_path, motor, size)
    check(motor_residual(diagnoser.seen(runs).sample, 0), motor, size)


@pytest.mark.parametrize(("motor", "size"), [("motor_2", 0.6), ("motor_3", -0.4)])
def test_a_motor_that_alone_explains_movements_is_named(tmp_path, motor, size):
    diagnoser, runs = seen(tmp_path, motor, size)
    likelihood = diagnoser.seen(runs).sample
    told = lone_motor(likelihood, 0, likelihood.usable[0])
    name, off = re.fullmatch(
        r"(motor \d) alone explains it, up to (\S+) deg off: .*", told
    ).groups()
    assert name == motor.replace("_", " ")
    assert float(off) == pytest.approx(np.rad2deg(size), abs=2.0)


def test_no_motor_is_named_where_two_explain_movements_or_none_does(tmp_path):
    diagnoser, runs = seen(tmp_path, "motor_2", 0.6)
    likelihood = diagnoser.seen(runs).sample
    nowhere = np.zeros_like(likelihood.usable[0])
    assert lone_motor(likelihood, 0, nowhere) == ""
    shift = np.array([0.0, 0.0, 0.3])
    away = runs.assign(measured=(runs["measured"].dims, runs["measured"].values + shift))
    likelihood = diagnoser.seen(away).sample
    assert lone_motor(likelihood, 0, likelihood.usable[0]) == ""


def test_a_run_with_errors_beyond_those_that_are_considered_names_its_motor(tmp_path):
    """Thirty degrees or more, where the paper has up to ten."""
    file = tmp_path / "modes.toml"
    file.write_text("[steady_state_error]\nmagnitude = [0.5, 0.7]\n")
    truth = "motor_2:steady_state_error"
    runs = ft.simulate(ft.Plan("armpi_fpv", [truth], 1, 1, modes=load_modes(file)))
    (found,) = ft.diagnose(runs, hypotheses=["healthy", truth, "motor_1:stuck", "motor_3:stuck"])
    assert "motor 2 alone explains it, up to " in found.undecided


@pytest.mark.slow
def test_an_unknown_run_has_a_residual_and_a_known_one_none(tmp_path):
    diagnoser, runs = seen(tmp_path, "motor_3", -0.15, ("healthy", "motor_1:stuck", "unknown"))
    (told,) = diagnoser.diagnose(runs)
    assert told.diagnosis == "unknown"
    check(told.residual, "motor_3", -0.15)
    known, runs = seen(tmp_path, "motor_3", -0.15, ("healthy", "motor_3:encoder_bias"))
    assert known.diagnose(runs)[0].residual is None


def test_a_residual_goes_through_json(tmp_path):
    diagnoser, runs = seen(tmp_path, "motor_2", 0.15)
    told = motor_residual(diagnoser.seen(runs).sample, 0)
    diagnosis = Diagnosis("run", {"unknown": 1.0}, residual=told)
    assert from_table(Diagnosis, json.loads(json.dumps(asdict(diagnosis))), "") == diagnosis
