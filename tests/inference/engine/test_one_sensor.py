"""Runs of one set share a sensor: its noise is found by all of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import failuretwin as ft
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.core.numerics import log_sum
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.inference.engine.registration import (
    ANOTHER_SENSOR,
    TELLS_NATS,
    _of_one_sensor,
    robot_weighing,
)
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.evidence import settled_evidence

NOISE_M = 0.002
RUNS = 8


@pytest.fixture(scope="module")
def noisy(armpi):
    """Healthy runs whose tool is read with a noise that nobody told."""
    known = load_calibration("armpi_fpv", armpi).imperfections
    readings = replace(known.readings, noise_m=NOISE_M)
    return simulate(
        Plan(armpi, ["healthy"], RUNS, 3, imperfections=replace(known, readings=readings))
    )


def called_faulty(diagnoses):
    return sum(d.diagnosis != "healthy" for d in diagnoses)


@pytest.mark.slow
def test_a_noisy_sensor_is_found_by_its_runs_together(noisy):
    diagnoser = ft.BayesDiagnoser("armpi_fpv")
    alone = [diagnoser.diagnose(noisy.isel(run=[i]))[0] for i in range(RUNS)]
    together = diagnoser.diagnose(noisy)
    assert called_faulty(together) <= 1
    assert called_faulty(alone) >= 3


@pytest.fixture(scope="module")
def weighing(noisy):
    model = ft.BayesDiagnoser("armpi_fpv").healthy_model
    likelihood = RunLikelihood(settled_evidence(noisy.isel(run=slice(0, 6))), model)
    return robot_weighing(likelihood, paper_hypotheses(model.motor_names), Priors())


def test_weights_are_those_by_the_other_runs(weighing):
    """By what each run says of each noise, one run and one noise after the other."""
    noise, weight = weighing.components.noise_m, np.exp(weighing.components.log_weight)
    joint = np.exp(log_sum(weighing.log_evidence + weighing.log_odds, axis=2))
    (shared,) = _of_one_sensor([weighing])
    levels = sorted(set(noise.tolist()))
    prior = {n: weight[noise == n].sum() for n in levels}
    for i in range(6):
        product = dict(prior)
        for j in range(6):
            if j != i:
                says = {n: joint[j, noise == n].sum() / prior[n] for n in levels}
                best = max(says.values())
                for n in levels:
                    product[n] *= max(says[n], best * np.exp(-TELLS_NATS))
        total = sum(product.values())
        for n in levels:
            expected = (1 - ANOTHER_SENSOR) * product[n] / total + ANOTHER_SENSOR * prior[n]
            found = np.exp(shared.components.log_weight[i, noise == n]).sum()
            assert found == pytest.approx(expected, rel=1e-9)


def test_a_run_without_others_keeps_its_prior(weighing):
    alone = replace(weighing, likelihood=weighing.likelihood[:1], place=weighing.place[:1])
    (shared,) = _of_one_sensor([alone])
    weights = shared.components.log_weight[0]
    np.testing.assert_allclose(weights, alone.components.log_weight, atol=1e-12)
    np.testing.assert_allclose(shared.log_evidence, alone.log_evidence, atol=1e-12)
