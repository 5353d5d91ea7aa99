"""What a held motor gives by, where healthy ones scatter less."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from slide_runs import PLAIN, TARGETS

from failuretwin import Hypothesis, Plan, simulate
from failuretwin.connection.calibration.calibrate import fit_calibration
from failuretwin.digital_model.nonidealities import NO_IMPERFECTIONS, Imperfections
from failuretwin.digital_model.settling import Settling
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.evidence import settled_evidence
from failuretwin.inference.observation.healthy_model import HealthyModel

SCATTER = (0.001, 0.0, 0.003, 0.006)
SETTLING = Settling((0.0,) * 4, (0.0,) * 4, (0.0,) * 4, SCATTER, np.inf, "made up")
EXACT = Imperfections("made up", "test", settling=SETTLING)


def test_a_gear_yields_by_a_sixth_of_a_degree_where_scatter_is_less(twin):
    found = HealthyModel(twin, EXACT).held_scatter
    np.testing.assert_allclose(found, [np.sqrt(8.0) * 1e-3, 3e-3, 0.0, 0.0], atol=1e-12)


def test_ideal_motors_and_slides_do_not_yield(twin, run_on):
    np.testing.assert_array_equal(HealthyModel(twin, NO_IMPERFECTIONS).held_scatter, 0.0)
    exact = replace(PLAIN, settling=replace(PLAIN.settling, scatter=(0.0,)))
    likelihood, _ = run_on(TARGETS, TARGETS, exact)
    np.testing.assert_array_equal(likelihood.model.held_scatter, 0.0)


@pytest.mark.parametrize("off", [0.0, 0.004, -0.01])
def test_a_held_motor_lies_about_its_angle_by_what_it_gives(twin, run_of, off):
    """The tool, seen where motor 2 is off by `off`: normal, with 3 mrad of motor 2 on its lever."""
    targets = np.array([[0.3, -0.4, 0.5, 0.2]])
    seen = twin.path(targets + off * np.eye(4)[1])
    runs = run_of(targets, seen, twin.robot.motor_names)
    model = HealthyModel(twin, EXACT)
    profile = RunLikelihood(settled_evidence(runs), model).profile(1)
    _, jacobian = twin.path_and_jacobian(targets[0])
    scale = np.array([0.001, 0.003, 0.003, 0.006])
    spread = (jacobian * scale) @ (jacobian * scale).T + model.path_noise**2 * np.eye(3)
    expected = stats.multivariate_normal(np.zeros(3), spread).logpdf(
        seen[0] - twin.path(targets)[0]
    )
    angle = np.array([[[[targets[0, 1]]]]])
    found = profile.log_density(angle, held=True)[0, 0, 0]
    assert found == pytest.approx(expected + np.log(0.99), abs=0.1)


def test_a_calibration_doubts_what_changes_from_day_to_day(armpi):
    """A milliradian of a hobby servo, beside what the logs leave open."""
    runs = simulate(Plan(armpi, [Hypothesis()], 6, 2, "armpi_fpv"))
    found = fit_calibration(runs, armpi, "trial", "made up", thorough=False)
    of_logs = [(p.high - p.low) / 2.0 / 1.96 for p in found.parameters if p.name == "bias"]
    told = np.square(found.imperfections.variation.bias) - np.square(of_logs)
    np.testing.assert_allclose(told, 0.001**2, rtol=0.1)
