from __future__ import annotations

import numpy as np
import pytest

from failuretwin import BayesDiagnoser
from failuretwin.core.hypothesis import UNKNOWN, Hypothesis, paper_hypotheses
from failuretwin.data_knowledge.generation import simulate
from failuretwin.data_knowledge.plan import Plan
from failuretwin.digital_model.imperfections import load_imperfections

TWO_AT_ONCE = (
    Hypothesis.parse("motor_1:steady_state_error+motor_3:steady_state_error"),
    Hypothesis.parse("motor_2:steady_state_error+motor_4:steady_state_error"),
)


@pytest.fixture(scope="module")
def diagnoser(twin, armpi):
    return BayesDiagnoser(twin, hypotheses=(*paper_hypotheses(armpi.motor_names), UNKNOWN))


@pytest.fixture(scope="module")
def thrown_off(armpi):
    """Two motors at once miss every target by 8 to 12 degrees."""
    from failuretwin.failure_behavior.modes import MODES, SteadyStateError

    known = load_imperfections("armpi_fpv", armpi)
    error = SteadyStateError(magnitude=(0.14, 0.21), onset_s=(0.0, 0.0))
    modes = {**MODES, "steady_state_error": error}
    return simulate(Plan(armpi, TWO_AT_ONCE, 8, 6, known, modes=modes))


def test_two_faults_that_are_not_offered_are_unknown(diagnoser, thrown_off):
    """No single fault brings the tool there; it is not said to be one of those offered."""
    found = diagnoser.diagnose(thrown_off)
    told = [d.diagnosis for d in found]
    assert told.count("unknown") + told.count(None) >= 0.8 * len(found)
    assert told.count("unknown") >= 0.6 * len(found)
    for d in (d for d in found if d.diagnosis == "unknown"):
        assert d.verdict.startswith("something that none of the known faults explains")
        assert (d.magnitude, d.magnitude_90, d.magnitude_unit) == (None, None, None)


def test_two_faults_that_are_offered_are_known(twin, armpi, thrown_off):
    offered = (*paper_hypotheses(armpi.motor_names), *TWO_AT_ONCE, UNKNOWN)
    found = BayesDiagnoser(twin, hypotheses=offered).diagnose(thrown_off.isel(run=[0, 1, 8, 9]))
    assert [d.diagnosis for d in found] == [d.truth for d in found]


def test_known_faults_stay_known(diagnoser, imperfect, diagnoses):
    """Offering `unknown` turns hardly any right diagnosis."""
    rows = list(range(0, 180, 5))
    found = diagnoser.diagnose(imperfect.isel(run=rows))
    before = sum(diagnoses[i].diagnosis == diagnoses[i].truth for i in rows)
    after = sum(d.diagnosis == d.truth for d in found)
    assert after >= before - 2


def test_without_evidence_unknown_is_as_rare_as_it_was(diagnoser, imperfect):
    from failuretwin.decision.weighing import log_prior

    blind = imperfect.isel(run=[0])
    blind = blind.assign(measured=np.nan * blind["measured"])
    (found,) = diagnoser.diagnose(blind)
    prior = np.exp(
        log_prior((*paper_hypotheses(diagnoser.twin.robot.motor_names), UNKNOWN), diagnoser.priors)
    )
    assert found.posterior["unknown"] == pytest.approx(prior[-1])
