"""Healthy arms that pick up a load between two movements of a run."""

import importlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import failuretwin as ft
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.data_knowledge.generate import Plan
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.robot import load_robot
from failuretwin.inference.engine.healthy_rows import healthy_rows, usual_load_kg
from failuretwin.inference.engine.moments import moments_of
from failuretwin.inference.engine.rows import Scene
from failuretwin.inference.engine.theta import layout_of
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.evidence import Evidence
from failuretwin.inference.observation.healthy_model import HealthyModel

BENCHMARKS = Path(__file__).parents[3] / "benchmarks"
PICKED_UP_S = 5.9

with pytest.MonkeyPatch.context() as patch:
    patch.syspath_prepend(BENCHMARKS)
    loads = importlib.import_module("load_changes")


@pytest.fixture(scope="module")
def known():
    return load_calibration("armpi_fpv")


@pytest.fixture(scope="module")
def healthy(known):
    """Twelve runs of the arm that the calibration describes, by the load that it picks up [kg]."""
    plan = Plan(known.robot, ["healthy"], 12, 3, known.imperfections)
    return {kg: loads.picked_up(known.robot, kg, PICKED_UP_S, plan) for kg in (0.0, 0.2)}


def scene_of(runs, model, moving=False):
    settled = Evidence(runs, model.settings).sound.settled
    layout = layout_of(model, moving)
    nothing = np.zeros((layout.size, layout.size))
    moments = moments_of(model, RunLikelihood(settled, model).evidence)
    return Scene.of(model.without_doubt, moments, Priors(), layout, nothing)


def settled_as(model, settling):
    return replace(model.imperfections, settling=settling)


def chances_of_healthy(runs):
    hypotheses = paper_hypotheses(load_robot("armpi_fpv").motor_names)
    found = ft.BayesDiagnoser("armpi_fpv", hypotheses=hypotheses).diagnose(runs)
    return np.array([d.posterior["healthy"] for d in found if d.diagnosis])


def test_a_load_speaks_less_for_a_fault(healthy, monkeypatch):
    log_chance = np.log(chances_of_healthy(healthy[0.2]))
    monkeypatch.setattr("failuretwin.inference.engine.healthy_rows.LOAD_RATE", 0.0)
    before = np.log(chances_of_healthy(healthy[0.2]))
    assert np.mean(log_chance - before) > 0.5


def test_arms_without_a_load_are_as_healthy_as_before(healthy, monkeypatch):
    now = chances_of_healthy(healthy[0.0])
    monkeypatch.setattr("failuretwin.inference.engine.healthy_rows.LOAD_RATE", 0.0)
    np.testing.assert_allclose(now, chances_of_healthy(healthy[0.0]), atol=2e-3)


def test_the_lever_is_what_a_mass_moves(healthy, known):
    model = HealthyModel.of(known).without_doubt
    scene = scene_of(healthy[0.0], model)
    rows, moments = healthy_rows(scene), scene.moments
    heavy = replace(model.settling, payload=model.settling.payload + 1e-3)
    loaded = replace(model, imperfections=settled_as(model, heavy))
    direction = moments.direction[:, :, 0]
    pose = loaded.settle(moments.base[:, :, 0], direction, model.none_held)
    moved = (model.sensors.expected(pose)[0] - scene.shown[0][:, :, 0]) / 1e-3
    for row in range(1, rows.lever.shape[1]):
        assert not rows.lever[:, row, :row].any()
        np.testing.assert_allclose(rows.lever[:, row, row:], moved[:, row:], rtol=0.35, atol=0.02)
    assert not rows.lever[:, 0].any()


def test_prior_of_a_load(healthy, known):
    model = HealthyModel.of(known)
    rows = healthy_rows(scene_of(healthy[0.0], model))
    chance = np.exp(rows.log_prior)
    np.testing.assert_allclose(chance.sum(axis=1), 1.0)
    np.testing.assert_allclose(chance[:, 1:].sum(axis=1), 0.004)
    np.testing.assert_allclose(rows.variance[:, 1:], usual_load_kg(model) ** 2)
    assert usual_load_kg(model) == pytest.approx(0.134, abs=0.01)
    assert not rows.variance[:, 0].any()


def test_a_motor_yields_half_as_much_more_or_less(healthy, known):
    model = HealthyModel.of(known)
    one = replace(model.settling, compliance=(0.0, 0.0, 0.1, 0.0))
    scene = scene_of(healthy[0.0], replace(model, imperfections=settled_as(model, one)))
    rows = healthy_rows(scene)
    lever = 0.5 * usual_load_kg(model) * rows.lever[:, 1:, :, None]
    more = (rows.outcomes.beside - scene.healthy.beside[:, None])[:, 1:, :, 0]
    np.testing.assert_allclose(more, lever * np.swapaxes(lever, -1, -2), atol=1e-12)


@pytest.mark.parametrize(("name", "kg"), [("so101", 0.16), ("ur5e", 5.6), ("panda", 5.2)])
def test_usual_loads_are_those_of_data_sheets(name, kg):
    assert usual_load_kg(HealthyModel.of(load_calibration(None, name))) == pytest.approx(kg, 0.05)


def test_motors_that_do_not_yield_and_arms_on_their_way_have_one_row(healthy, known):
    model = HealthyModel.of(known)
    stiff = replace(model.settling, compliance=(0.0,) * 4)
    rigid = replace(model, imperfections=settled_as(model, stiff))
    for one in (scene_of(healthy[0.0], rigid), scene_of(healthy[0.0], model, moving=True)):
        assert healthy_rows(one).log_prior.shape[1] == 1
