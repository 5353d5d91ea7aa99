"""Arms, runs and imperfections at the ends of what is allowed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_arms import GANTRY, SCARA, small_twin

from failuretwin import BayesDiagnoser, DigitalTwin, SetupPrior, load_robot
from failuretwin.core.hypothesis import UNKNOWN, paper_hypotheses, single_faults
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.nonidealities import (
    NO_IMPERFECTIONS,
    Readings,
)
from failuretwin.failure_behavior.modes import SteadyStateError
from failuretwin.failure_behavior.random_movements import RandomMovements
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference import prepared
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.evidence import settled_evidence
from failuretwin.inference.observation.healthy_model import HealthyModel

KINDS = {
    "none": lambda robot: NO_IMPERFECTIONS,
    "generic": generic_imperfections,
    "own": lambda robot: load_calibration(None, robot).imperfections,
}


def check(diagnoses):
    for d in diagnoses:
        chance = np.array(list(d.posterior.values()))
        assert np.isfinite(chance).all()
        assert chance.sum() == pytest.approx(1.0, abs=1e-9)
        for interval in (d.onset_90, d.magnitude_90):
            assert interval is None or (np.isfinite(interval).all() and interval[0] <= interval[1])


def accuracy(diagnoses):
    return np.mean([d.diagnosis == d.truth for d in diagnoses])


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("armpi_fpv", "generic"),
        *(("ur5e", kind) for kind in ("none", "own")),
        *(("panda", kind) for kind in ("generic", "own")),
        *(("so101", kind) for kind in ("none", "own")),
    ],
)
def test_bundled_arms_are_diagnosed(name, kind):
    """Of four to six motors, calibrated or not, ideal or not: mostly right.

    Robots of a class differ by as much as its small errors; there the set-up is known.
    """
    robot = load_robot(name)
    imperfections = KINDS[kind](robot)
    runs = simulate(Plan(robot, paper_hypotheses(robot.motor_names), 1, 3, imperfections))
    priors = Priors(setup=SetupPrior.known()) if kind == "generic" else Priors()
    found = BayesDiagnoser(DigitalTwin(robot), imperfections, priors=priors).diagnose(runs)
    check(found)
    assert accuracy(found) >= (0.7 if kind == "generic" else 0.8)


@pytest.mark.parametrize("kind", ["none", "own"])
@pytest.mark.parametrize("count", [1, 5])
def test_any_mode_can_be_weighed_in_short_runs(armpi, twin, kind, count):
    """All hypotheses, `unknown` too; of a single movement hardly any can be told from others."""
    imperfections = KINDS[kind](armpi)
    modes = [mode for mode in MODES if mode != "torque_loss"]
    faults = single_faults(["motor_2"], modes)[::3]
    plan = Plan(armpi, faults, 1, 3, imperfections, RandomMovements(count=count))
    weighed = (*single_faults(["motor_2", "motor_3"], MODES), UNKNOWN)
    priors = Priors(setup=SetupPrior.known())
    check(BayesDiagnoser(twin, imperfections, weighed, priors).diagnose(simulate(plan)))


def test_runs_of_forty_movements_are_diagnosed(armpi, twin):
    """Faults for sure; of a healthy run, a motor may always have got stuck at the very end."""
    known = load_calibration(None, armpi).imperfections
    faults = paper_hypotheses(armpi.motor_names)[::4]
    runs = simulate(Plan(armpi, faults, 1, 3, known, RandomMovements(count=40)))
    some, priors = paper_hypotheses(armpi.motor_names)[::2], Priors(setup=SetupPrior.known())
    found = BayesDiagnoser(twin, known, some, priors).diagnose(runs)
    check(found)
    assert [d.diagnosis for d in found] == [d.truth for d in found]
    assert all(d.posterior[d.truth] > (0.85 if d.truth == "healthy" else 0.999) for d in found)


def test_long_runs_are_weighed_a_few_at_a_time():
    """What nodes of drift take grows with the square of the movements."""
    assert prepared.runs_at_a_time(0) == prepared.runs_at_a_time(5) == prepared.CHUNK_RUNS
    assert prepared.runs_at_a_time(60) == 1
    taken = [prepared.runs_at_a_time(count) * count**2 for count in range(5, 40)]
    assert max(taken) <= 25 * prepared.CHUNK_RUNS


@pytest.fixture(scope="module")
def gantry(tmp_path_factory):
    return small_twin(tmp_path_factory.mktemp("gantry"), "gantry", GANTRY)


@pytest.fixture(scope="module")
def scara(tmp_path_factory):
    return small_twin(tmp_path_factory.mktemp("scara"), "scara", SCARA, tool="0.2 0 0")


@pytest.mark.parametrize("arm", ["gantry", "scara"])
def test_arms_with_slides_are_diagnosed(request, arm):
    """Offsets are metres for a slide and rad for a joint that turns; a live sensor flickers."""
    twin = request.getfixturevalue(arm)
    robot = twin.robot
    known = replace(generic_imperfections(robot), readings=Readings(10.0, noise_m=1e-4))
    errors = {**MODES, "steady_state_error": SteadyStateError(magnitude=(0.08, 0.2))}
    plan = Plan(robot, paper_hypotheses(robot.motor_names), 1, 1, known, modes=errors)
    found = BayesDiagnoser(twin, known).diagnose(simulate(plan))
    check(found)
    assert accuracy(found) >= 0.85


def test_a_slide_is_where_the_tool_is(gantry, run_of):
    """Three slides at right angles: the best place of each is the tool's own coordinate."""
    targets = np.array([[0.1, 0.2, 0.3], [-0.2, 0.1, 0.1]])
    points = targets + np.array([[0.03, 0.0, -0.05], [0.0, 0.07, 0.0]])
    runs = run_of(targets, points, gantry.robot.motor_names)
    model = HealthyModel(gantry, generic_imperfections(gantry.robot))
    likelihood = RunLikelihood(settled_evidence(runs), model)
    for motor in range(3):
        profile = likelihood.profile(motor)
        np.testing.assert_allclose(profile.mode[0, :, 0], points[:, motor], atol=1e-9)
        np.testing.assert_allclose(profile.precision[0, :, 0], 1.0 / model.path_noise**2)


def test_reach_is_that_of_links_and_slides(gantry, scara):
    def reach(twin):
        return twin.robot.reach

    assert reach(gantry) == pytest.approx(0.3 + 0.4 + 0.5)
    assert reach(scara) == pytest.approx(0.2 + 0.3 + 0.25 + 0.2)


def test_angles_a_full_turn_apart_are_the_same(scara, run_of):
    """A joint held at -2.6 rad when told to go to 2.6: 3.68 is nearer, and the same."""
    targets = np.array([[0.1, 2.6, 0.5], [0.2, 2.4, -0.4]])
    settled = targets.copy()
    settled[:, 1] = -2.6
    runs = run_of(targets, scara.path(settled), scara.robot.motor_names)
    likelihood = RunLikelihood(
        settled_evidence(runs), HealthyModel(scara, generic_imperfections(scara.robot))
    )
    profile = likelihood.profile(1)
    angle = np.array([-2.6, 2.0 * np.pi - 2.6, 0.0])[:, None]
    there, again, elsewhere = profile.log_density(np.broadcast_to(angle, (1, 2, 3, 1)), True)[0].T
    np.testing.assert_allclose(there, again, atol=1e-9)
    assert (there > elsewhere + 5.0).all()
    (found,) = BayesDiagnoser(scara).diagnose(runs)
    assert found.diagnosis == "motor_2:stuck"
    assert found.magnitude == pytest.approx(-2.6, abs=0.02)
