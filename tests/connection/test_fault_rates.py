"""Rates of faults that a fleet teaches: closed forms, and simulated fleets with known rates."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import gamma as gamma_of
from scipy.stats import poisson

from failuretwin import Priors
from failuretwin.connection.fault_rates import (
    WEIGHT,
    FaultRate,
    LearnedRates,
    reweighted,
    table_rates,
)
from failuretwin.core.hypothesis import Hypothesis, paper_hypotheses
from failuretwin.data_knowledge.records.fleet import FleetFaults
from failuretwin.inference.faults.prior_odds import log_prior
from failuretwin.inference.together.fault_filter import RATES

MOTORS = [f"motor_{k}" for k in range(1, 5)]
PAPER = paper_hypotheses(MOTORS)
TABLE = 5e-3


def rate(confirmed, hours):
    return FaultRate("motor_1:stuck", TABLE, confirmed, hours)


@pytest.mark.parametrize(("confirmed", "hours"), [(0, 0.0), (0, 2000.0), (3, 500.0), (12, 9000.0)])
def test_mean_and_interval_are_those_of_the_posterior(confirmed, hours):
    """Against the integral of prior times likelihood."""

    def weight(value):
        prior = gamma_of.pdf(value, WEIGHT, scale=TABLE / WEIGHT)
        return prior * poisson.pmf(confirmed, value * hours)

    top = 40.0 * rate(confirmed, hours).mean_per_h
    total = quad(weight, 0.0, top, limit=200)[0]
    mean = quad(lambda value: value * weight(value), 0.0, top, limit=200)[0] / total
    found = rate(confirmed, hours)
    assert found.mean_per_h == pytest.approx(mean, rel=1e-6)
    low, high = found.interval_per_h
    assert quad(weight, 0.0, low)[0] / total == pytest.approx(0.05, abs=1e-6)
    assert quad(weight, 0.0, high, limit=200)[0] / total == pytest.approx(0.95, abs=1e-6)


def test_without_anything_seen_the_table_stands():
    learned = LearnedRates.of(FleetFaults("arm", 0, 0.0, {}), PAPER)
    assert set(learned.factors.values()) == {1.0}
    priors = Priors(fault_factors=learned.factors)
    np.testing.assert_array_equal(log_prior(PAPER, priors), log_prior(PAPER, Priors()))


def test_the_rates_of_the_table_are_those_of_each_motor():
    table = table_rates(PAPER)
    assert len(table) == 8
    for motor in MOTORS:
        own = sum(value for name, value in table.items() if name.startswith(motor))
        assert own == pytest.approx(RATES.faults_per_1000_h / 1000.0)


def covered(truth, hours, rng):
    """Return the share of fleets whose 90 % interval holds the true rate."""
    counts = rng.poisson(truth * hours)
    found = np.array([rate(int(n), h).interval_per_h for n, h in zip(counts, hours, strict=True)])
    return np.mean((found[:, 0] <= truth) & (truth <= found[:, 1]))


def test_intervals_hold_the_rates_of_simulated_fleets():
    """1,000 fleets whose rates are drawn from the prior: 90 % intervals hold 86 to 94 %."""
    rng = np.random.default_rng(0)
    truth = rng.gamma(WEIGHT, TABLE / WEIGHT, 1000)
    hours = rng.uniform(100.0, 20_000.0, 1000)
    assert 0.86 <= covered(truth, hours, rng) <= 0.94


@pytest.mark.parametrize("times", [0.2, 1.0, 3.0])
def test_intervals_hold_rates_that_the_table_has_wrong(times):
    """1,000 fleets with one rate, far from the table's too, seen long enough."""
    truth = np.full(1000, times * TABLE)
    hours = np.full(1000, 40_000.0)
    assert 0.86 <= covered(truth, hours, np.random.default_rng(1)) <= 0.94


def fleet(hours, **confirmed):
    named = {f"{motor}:stuck": count for motor, count in confirmed.items()}
    return LearnedRates.of(FleetFaults("arm", 31, hours, named), PAPER)


@pytest.mark.parametrize("hours", [0.0, 100.0, 10_000.0])
@pytest.mark.parametrize("before", [0, 1, 12])
def test_one_wrong_confirmation_moves_no_odds_by_more_than_its_weight(hours, before):
    priors = [
        log_prior(PAPER, Priors(fault_factors=fleet(hours, motor_1=count).factors))
        for count in (before, before + 1)
    ]
    odds = [prior - prior[0] for prior in priors]
    moved = odds[1] - odds[0]
    at = PAPER.index(Hypothesis.parse("motor_1:stuck"))
    assert moved[at] == pytest.approx(np.log1p(1.0 / (WEIGHT + before)))
    assert moved[at] <= np.log(1.5) + 1e-12
    assert np.abs(np.delete(moved, at)).max() < 1e-12
    assert np.abs(np.exp(priors[1]) - np.exp(priors[0])).max() <= 0.25 * np.log(1.5)


def test_reweighting_a_posterior_is_diagnosing_with_the_other_prior():
    rng = np.random.default_rng(2)
    names = [str(h) for h in PAPER]
    likelihood = rng.normal(0.0, 2.0, len(PAPER))
    factors = fleet(3000.0, motor_1=3, motor_2=1).factors

    def posterior(priors):
        weight = np.exp(likelihood + log_prior(PAPER, priors))
        return dict(zip(names, weight / weight.sum(), strict=True))

    found = reweighted(posterior(Priors()), factors)
    assert found == pytest.approx(posterior(Priors(fault_factors=factors)))


def test_the_line_says_what_the_rates_rest_on():
    told = fleet(24.0 * 365.0, motor_1=12).line
    assert told.startswith("12 confirmed faults of 31 robots (arm); ")
    assert "most often motor 1 stuck" in told
    assert fleet(24.0).line == "0 confirmed faults of 31 robots (arm)"


def test_a_wrong_confirmation_in_twenty_changes_no_ranking_of_clear_evidence():
    """1,000 verdicts with 5 % wrong confirmations: the fault that is named stays the same."""
    rng = np.random.default_rng(3)
    right = fleet(20_000.0, motor_1=20, motor_2=10, motor_3=5, motor_4=5).factors
    wrong = fleet(20_000.0, motor_1=20, motor_2=10, motor_3=5, motor_4=7).factors
    names, changed = [str(h) for h in PAPER], 0
    for _ in range(1000):
        told = rng.normal(0.0, 1.0, len(PAPER))
        told[rng.integers(len(PAPER))] += 12.0
        weight = np.exp(told + log_prior(PAPER, Priors()))
        posterior = dict(zip(names, weight / weight.sum(), strict=True))
        one, other = (reweighted(posterior, factors) for factors in (right, wrong))
        changed += max(one, key=one.__getitem__) != max(other, key=other.__getitem__)
    assert changed == 0
