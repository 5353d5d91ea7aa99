from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from failuretwin import BayesDiagnoser, Priors, SetupPrior
from failuretwin.core.hypothesis import (
    HEALTHY,
    UNKNOWN,
    Hypothesis,
    paper_hypotheses,
    single_faults,
)
from failuretwin.data_knowledge.generate import Plan, simulate
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.inference import posterior as weighing
from failuretwin.inference.expected_bayes_factors import expected_log_bayes_factors
from failuretwin.inference.faults.marginal import MarginalLikelihood
from failuretwin.inference.faults.unknown import unknown_likelihood
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.evidence import settled_evidence
from failuretwin.inference.posterior import marginal_likelihoods

TWO_AT_ONCE = (
    Hypothesis.parse("motor_1:steady_state_error+motor_3:steady_state_error"),
    Hypothesis.parse("motor_2:steady_state_error+motor_4:steady_state_error"),
)


@pytest.fixture(scope="module")
def diagnoser(twin, armpi):
    return BayesDiagnoser(twin, hypotheses=(*paper_hypotheses(armpi.motor_names), UNKNOWN))


KNOWN_SET_UP = Priors(setup=SetupPrior.known())
"""Without the search for wrong set-ups, which takes longer than everything else."""


@pytest.fixture(scope="module", params=["known", pytest.param("asked", marks=pytest.mark.slow)])
def either(request, twin, diagnoser):
    """The same where nothing but a fault can explain a run, and where a wrong set-up may too."""
    priors = KNOWN_SET_UP if request.param == "known" else Priors()
    return BayesDiagnoser(twin, hypotheses=diagnoser.hypothesis_set, priors=priors)


@pytest.fixture(scope="module")
def thrown_off(armpi):
    """Two motors at once miss every target by 8 to 12 degrees."""
    from failuretwin.failure_behavior.modes import SteadyStateError
    from failuretwin.failure_behavior.registry import MODES

    known = load_calibration("armpi_fpv", armpi).imperfections
    error = SteadyStateError(magnitude=(0.14, 0.21), onset_s=(0.0, 0.0))
    modes = {**MODES, "steady_state_error": error}
    return simulate(Plan(armpi, TWO_AT_ONCE, 8, 6, known, modes=modes))


def test_two_faults_that_are_not_offered_are_unknown(either, thrown_off):
    """No single fault brings the tool there; it is not said to be one of those offered."""
    found = either.diagnose(thrown_off.isel(run=[*range(5), *range(8, 13)]))
    told = [d.diagnosis for d in found]
    assert told.count("unknown") >= 0.9 * len(found)
    for d in (d for d in found if d.diagnosis == "unknown"):
        assert "something that none of the known faults explains" in d.verdict
        assert (d.magnitude, d.magnitude_90, d.magnitude_unit) == (None, None, None)


def test_two_faults_that_are_offered_are_known(twin, armpi, thrown_off):
    offered = (*paper_hypotheses(armpi.motor_names), *TWO_AT_ONCE, UNKNOWN)
    found = BayesDiagnoser(twin, hypotheses=offered, priors=KNOWN_SET_UP).diagnose(
        thrown_off.isel(run=[0, 8])
    )
    assert [d.diagnosis for d in found] == [d.truth for d in found]


FOREIGN = ("encoder_scale", "drift", "lag", "lost_commands")


def foreign(twin, armpi, modes):
    """Return faults of modes that are not offered, clearly apart from everything that is."""
    known = load_calibration("armpi_fpv", armpi).imperfections
    faults = [h for h in single_faults(armpi.motor_names, modes) if h.faults]
    runs = simulate(Plan(armpi, faults, 5, 9, known))
    nearest = expected_log_bayes_factors(
        twin, runs, known, paper_hypotheses(armpi.motor_names)
    ).nearest
    return runs.isel(run=np.flatnonzero(nearest >= 8.0))


@pytest.mark.slow
def test_modes_that_are_not_offered_are_unknown(twin, armpi, diagnoser):
    found = diagnoser.diagnose(foreign(twin, armpi, FOREIGN))
    assert {d.truth.split(":")[1] for d in found} == set(FOREIGN)
    assert np.mean([d.diagnosis == "unknown" for d in found]) >= 0.9


def test_modes_without_a_law_are_unknown(twin, armpi, monkeypatch):
    """Wrong scales, as if nobody had ever thought of them, nor of anything like them."""

    def few(likelihood, known):
        others = every(likelihood, known)
        return [h for h in others if h.faults[0].mode in ("stuck", "steady_state_error")]

    every = weighing.unlisted
    monkeypatch.setattr(weighing, "unlisted", few)
    offered = (*paper_hypotheses(armpi.motor_names), UNKNOWN)
    found = BayesDiagnoser(twin, hypotheses=offered, priors=KNOWN_SET_UP).diagnose(
        foreign(twin, armpi, ("encoder_scale",))
    )
    assert np.mean([d.diagnosis == "unknown" for d in found]) >= 0.8


@pytest.mark.parametrize(
    "rows", [slice(1, None, 6), pytest.param(slice(None), marks=pytest.mark.slow)]
)
def test_known_faults_stay_known(twin, either, imperfect, rows):
    """Offering `unknown` turns hardly any right diagnosis: 1.7 % of 900 (docs/inference.md)."""
    some = imperfect.isel(run=rows)
    without = BayesDiagnoser(twin, priors=KNOWN_SET_UP).diagnose(some)
    right = [d.diagnosis == d.truth for d in without]
    found = either.diagnose(some.isel(run=np.flatnonzero(right)))
    assert np.mean([d.diagnosis == d.truth for d in found]) >= 0.95


def test_known_hypotheses_weigh_the_same_beside_unknown(diagnoser, imperfect, armpi):
    likelihood = RunLikelihood(
        settled_evidence(imperfect.isel(run=[0, 10, 50])), diagnoser.healthy_model
    )
    nine = paper_hypotheses(armpi.motor_names)
    alone = marginal_likelihoods(likelihood, nine, diagnoser.priors)
    beside = marginal_likelihoods(likelihood, (*nine, UNKNOWN), diagnoser.priors)
    for one, other in zip(alone, beside[:-1], strict=True):
        np.testing.assert_array_equal(one.log_evidence, other.log_evidence)


def test_unknown_counts_its_best_explanation_alone(diagnoser, imperfect):
    """A left-out fault that explains a run counts by its odds; poor ones beside it add nothing."""
    likelihood = RunLikelihood(
        settled_evidence(imperfect.isel(run=[0, 10])), diagnoser.healthy_model
    )
    sure = MarginalLikelihood(
        np.full(2, 500.0), *(np.zeros((2, 5)).__getitem__,) * 2, lambda run: None
    )

    def says(unlisted):
        return unknown_likelihood(likelihood, lambda other: sure, unlisted, []).log_evidence

    good = replace(sure, log_evidence=np.full(2, 600.0))
    expected = np.log(0.3 * 0.5) + 600.0
    np.testing.assert_allclose(says([(0.3, good)]), expected)
    np.testing.assert_allclose(says([(0.3, good), *[(0.3, sure)] * 20]), expected)


def test_without_evidence_unknown_is_as_rare_as_it_was(diagnoser, imperfect):
    from failuretwin.inference.posterior import log_prior

    blind = imperfect.isel(run=[0])
    blind = blind.assign(measured=np.nan * blind["measured"])
    (found,) = diagnoser.diagnose(blind)
    prior = np.exp(
        log_prior((*paper_hypotheses(diagnoser.twin.robot.motor_names), UNKNOWN), diagnoser.priors)
    )
    assert found.posterior["unknown"] == pytest.approx(prior[-1])


@pytest.mark.parametrize(("count", "least"), [(4, 3), pytest.param(8, 7, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "name",
    [
        pytest.param("motor_1:stuck+motor_2:stuck", marks=pytest.mark.slow),
        "motor_2:encoder_bias+motor_3:stuck",
        "motor_2:encoder_scale",
    ],
)
def test_what_is_named_is_not_taken_for_unknown(twin, measured_armpi, name, count, least):
    """Also where ends of movements are unseen, and two held motors point elsewhere than each."""
    truth = Hypothesis.parse(name)
    runs = simulate(Plan(twin.robot, [truth], count, 13, measured_armpi))
    offered = [HEALTHY, truth, Hypothesis.parse("motor_1:stuck"), UNKNOWN]
    found = BayesDiagnoser(twin, measured_armpi, offered, KNOWN_SET_UP).diagnose(runs)
    assert sum(d.diagnosis == name for d in found) >= least
