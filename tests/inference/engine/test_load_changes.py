"""A healthy arm that picks up a load in mid-run: told, not blamed on a motor."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

import failuretwin as ft
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.digital_model.calibrated_robot import CalibratedRobot, calibrated
from failuretwin.inference.engine.healthy_rows import changes, healthy_rows, usual_mass_kg
from failuretwin.inference.engine.moments import moments_of
from failuretwin.inference.engine.rows import Scene
from failuretwin.inference.engine.theta import Layout
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.observation.evidence import settled_evidence
from failuretwin.inference.observation.healthy_model import HealthyModel

LOAD_KG, FROM_S, RUNS = 0.3, 5.0, 16


def carrying(known, mass_kg):
    """Return healthy behaviour with a load at the tool, of a robot that is as it was calibrated."""
    settling = replace(known.settling, payload=mass_kg)
    return replace(known, settling=settling, variation=None)


@pytest.fixture(scope="module")
def picked_up(armpi):
    """Runs whose readings are those of a loaded arm from some time on."""
    known = calibrated("armpi_fpv").imperfections
    bare, loaded = (
        simulate(Plan(armpi, ["healthy"], RUNS, 5, imperfections=carrying(known, mass)))
        for mass in (0.0, LOAD_KG)
    )
    later = bare["time"].values[None, :, None] >= FROM_S
    measured = np.where(later, loaded["measured"].values, bare["measured"].values)
    return bare.assign(measured=(bare["measured"].dims, measured))


def blamed(diagnoses):
    return sum(d.diagnosis not in (None, "healthy") for d in diagnoses)


def test_a_load_is_told_and_blames_no_motor(armpi, picked_up):
    found = ft.BayesDiagnoser("armpi_fpv").diagnose(picked_up)
    never = ft.BayesDiagnoser("armpi_fpv", priors=Priors(load_changes=0.0)).diagnose(picked_up)
    assert blamed(never) >= RUNS // 2
    assert blamed(found) <= blamed(never) // 3
    told = [re.search(r"carry about ([\d.]+) kg from", "; ".join(d.quality)) for d in found]
    masses = [float(one.group(1)) for one in told if one]
    assert len(masses) >= RUNS // 2
    assert np.median(masses) == pytest.approx(LOAD_KG, rel=0.25)


@pytest.fixture(scope="module")
def scene(armpi):
    known = calibrated("armpi_fpv")
    runs = simulate(Plan(armpi, ["healthy"], 3, 1, imperfections=carrying(known.imperfections, 0)))
    model = HealthyModel.of(known)
    layout = Layout(4, geometry=False)
    moments = moments_of(model, settled_evidence(runs))
    return Scene.of(model, moments, Priors(), layout, np.eye(layout.size))


def test_a_loaded_arm_gives_way_as_its_model_with_that_payload(armpi, scene):
    """Residuals and compliance columns against the poses of a model that knows the load."""
    rows, mass = healthy_rows(scene), usual_mass_kg(scene.model)
    known = calibrated("armpi_fpv").imperfections
    heavy = HealthyModel.of(CalibratedRobot(armpi, carrying(known, mass)))
    settled = heavy.settle(scene.moments.base, scene.moments.direction, heavy.none_held)
    expected, _ = scene.model.sensors.expected(settled)
    residual = scene.moments.point[:, :, None] - expected
    loaded = changes(scene.moments.count)
    seen, scale = scene.moments.usable, 0.1 * np.abs(residual - scene.healthy.residual).max()
    for row, there in enumerate(loaded):
        wanted = np.where(there[None, :, None, None], residual, scene.healthy.residual)
        off = (rows.outcomes.residual[:, row] - wanted)[seen][:, 0]
        assert np.abs(off).max() < scale


def test_rows_share_the_probability_of_a_change(scene):
    share = np.exp(healthy_rows(scene).log_prior)
    np.testing.assert_allclose(share.sum(axis=1), 1.0)
    np.testing.assert_allclose(share[:, 0], 1.0 - Priors().load_changes)


def test_a_change_comes_before_a_moment_or_ends_there():
    np.testing.assert_array_equal(
        changes(3), [[0, 0, 0], [0, 1, 1], [0, 0, 1], [1, 0, 0], [1, 1, 0]]
    )


def test_without_changes_there_is_one_row(scene):
    never = replace(scene, priors=Priors(load_changes=0.0))
    assert healthy_rows(never).log_prior.tolist() == [[0.0]] * 3
    with pytest.raises(InputError, match="below 1"):
        Priors(load_changes=1.0)


def test_faults_stay_found(armpi, picked_up):
    known = calibrated("armpi_fpv").imperfections
    faulty = simulate(Plan(armpi, paper_hypotheses(armpi.motor_names)[1:], 3, 2, known))
    right = [
        sum(
            d.diagnosis == d.truth
            for d in ft.BayesDiagnoser("armpi_fpv", priors=p).diagnose(faulty)
        )
        for p in (Priors(), Priors(load_changes=0.0))
    ]
    assert right[0] >= right[1] - 1
