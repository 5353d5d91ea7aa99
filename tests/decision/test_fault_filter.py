"""The filter over all movements against enumeration, and its likelihoods against the batch."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import pytest

from failuretwin import Plan, Priors
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import parse_hypotheses
from failuretwin.data_knowledge.generate import simulate
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.evidence import Evidence
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.together.fault_filter import FaultEvidence, FaultFilter, FaultRates
from failuretwin.inference.together.healthy_mixture import CHANGED, HealthyMixture

NAMES = ["healthy", "motor_2:stuck", "motor_2:steady_state_error", "motor_3:stuck"]
RATES = FaultRates(faults_per_1000_h=4e4, repairs_per_1000_h=6e4)
"""So many that each path counts."""


@pytest.fixture(scope="module")
def model(armpi):
    known = load_calibration(armpi.name, armpi)
    return HealthyModel(known.twin, known.imperfections)


@pytest.fixture(scope="module")
def faults(model, armpi):
    return FaultFilter(model, parse_hypotheses(NAMES, armpi.motor_names), Priors(), RATES)


def made_up(faults, movements, rng):
    """Return evidence in which all but five cells say nothing."""
    begin = faults.begin(1)
    nodes, cells = begin.held.shape[1], begin.off.shape[1]
    own = faults.held_of
    begun = np.zeros((1, movements, nodes))
    for of in np.unique(own):
        two = np.flatnonzero(own == of)[[3, 40]]
        begun[0, :, two] = np.array([0.3, 0.7])[:, None]
    held = rng.normal(0.0, 2.0, (1, movements, nodes))
    off = rng.normal(0.0, 2.0, (1, movements, cells))
    hours = rng.uniform(0.001, 0.01, (1, movements))
    return FaultEvidence(held, off, begun, hours, rng.normal(10.0, 2.0, (1, movements)))


@dataclass(frozen=True)
class Enumeration:
    """Every path through healthy and the cells, one by one, with its prior and likelihood."""

    faults: FaultFilter
    seen: FaultEvidence

    @property
    def states(self):
        nodes = np.flatnonzero(self.seen.begun[0, 0])
        cells = range(self.seen.off.shape[2])
        return [("healthy", 0), *(("held", n) for n in nodes), *(("off", c) for c in cells)]

    def came(self, state, m):
        """Return the probability that a fault has come since the movement before."""
        per_h, hours = RATES.faults_per_1000_h / 1000.0, self.seen.hours[0, m]
        kind, at = state
        if kind == "off":
            return (1.0 - np.exp(-hours * per_h / 2.0)) / self.seen.off.shape[2]
        alone = self.faults.held_of[at] == 3  # motor 2 has two modes, motor 3 has one
        rate = per_h if alone else per_h / 2.0
        return (1.0 - np.exp(-hours * rate)) * self.seen.begun[0, m, at]

    def step(self, before, after, m):
        mended = 1.0 - np.exp(-self.seen.hours[0, m] * RATES.repairs_per_1000_h / 1000.0)
        if before[0] != "healthy":
            return mended if after[0] == "healthy" else (1.0 - mended) * (after == before)
        if after[0] != "healthy":
            return self.came(after, m)
        return 1.0 - sum(self.came(state, m) for state in self.states[1:])

    def says(self, state, m):
        kind, at = state
        return 0.0 if kind == "healthy" else getattr(self.seen, kind)[0, m, at]

    def probability(self, movements):
        weight = dict.fromkeys(self.states, 0.0)
        for path in product(self.states, repeat=movements):
            p, before = 1.0, self.states[0]
            for m, state in enumerate(path):
                p *= self.step(before, state, m) * np.exp(self.says(state, m))
                before = state
            weight[path[-1]] += p
        total = sum(weight.values())
        return {state: p / total for state, p in weight.items()}


def test_the_filter_is_the_sum_over_all_onsets_and_repairs(faults):
    movements = 4
    seen = made_up(faults, movements, np.random.default_rng(1))
    belief = faults.begin(1)
    for m in range(movements):
        belief = faults.advance(belief, seen, m)
    expected = Enumeration(faults, seen).probability(movements)
    for (kind, at), probability in expected.items():
        got = belief.healthy[0] if kind == "healthy" else getattr(belief, kind)[0, at]
        np.testing.assert_allclose(got, probability, rtol=1e-10)
    posterior = faults.posterior(belief)[0]
    assert posterior.sum() == pytest.approx(1.0)
    assert posterior[0] == pytest.approx(expected["healthy", 0])
    odds = (1.0 - posterior[0]) / posterior[0]
    assert belief.log_odds[0] == pytest.approx(np.log(odds))


def test_the_predictive_density_is_that_of_the_movement_given_those_before(faults):
    seen = made_up(faults, 2, np.random.default_rng(2))
    before = faults.advance(faults.begin(1), seen, 0)
    silent = replace(seen, held=0.0 * seen.held, off=0.0 * seen.off)
    expected = faults.advance(before, silent, 1)
    mean = expected.healthy + (expected.held * np.exp(seen.held[:, 1])).sum(axis=1)
    mean += (expected.off * np.exp(seen.off[:, 1])).sum(axis=1)
    after = faults.advance(before, seen, 1)
    np.testing.assert_allclose(after.log_predictive, np.log(mean), rtol=1e-12)


@pytest.fixture(scope="module")
def stuck(model, armpi):
    """A run in which motor 3 is stuck from the beginning."""
    known = load_calibration(armpi.name, armpi).imperfections
    states = parse_hypotheses(["motor_3:stuck", "healthy"], armpi.motor_names)
    runs = simulate(Plan(armpi, states, 1, 5, known))
    return RunLikelihood(Evidence(runs, model.settings).settled, model)


def test_likelihoods_are_those_of_the_batch(faults, stuck):
    """At every held angle; the grid blurs by less than a tenth of a nat where it matters."""
    seen, grid = faults.evidence(stuck), faults.held_angles
    for motor, own in ((1, 1), (2, 3)):
        some = faults.held_of == own
        exact = stuck.profile(motor).log_density(grid[some][:, None], True)
        exact = exact - stuck.log_healthy[..., None]
        top = exact.max(axis=-1, keepdims=True)
        assert np.abs(seen.held[..., some] - exact)[exact > top - 2.0].max() < 0.35
        integral = np.log(np.exp(seen.held[..., some]).sum(axis=-1))
        fine = np.linspace(grid[some][0], grid[some][-1], 20 * some.sum())
        density = stuck.profile(motor).log_density(fine[:, None], True)
        density = density - stuck.log_healthy[..., None]
        expected = np.log(np.exp(density).sum(axis=-1) / 20.0)
        np.testing.assert_allclose(integral, expected, atol=0.05)


def test_sizes_are_what_is_left_of_their_grid_and_their_ranges(faults):
    """Held angles around one node; errors of one range, evenly over it."""
    begin = faults.begin(1)
    nodes = np.flatnonzero(faults.held_of == 1)
    held, off = np.zeros_like(begin.held), np.zeros_like(begin.off)
    held[0, nodes[9:12]] = 0.1, 0.3, 0.1
    off[0, 1] = 0.5
    belief = replace(begin, held=held, off=off)
    middle = faults.size(belief, 1).quantiles((0.5,))
    np.testing.assert_allclose(middle, faults.held_angles[nodes[10]], atol=1e-9)
    low, high = faults._sizes(faults.hypotheses[2].faults[0]).ranges[1]
    quarters = faults.size(belief, 2).quantiles((0.25, 0.5, 0.75))
    expected = low + np.array([0.25, 0.5, 0.75]) * (high - low)
    np.testing.assert_allclose(quarters, expected, atol=0.05 * (high - low))
    assert faults.size(belief, 0) is None


def test_an_unseen_movement_says_nothing(faults, stuck):
    hidden = replace(stuck.evidence, usable=np.zeros_like(stuck.evidence.usable))
    seen = faults.evidence(RunLikelihood(hidden, stuck.model))
    np.testing.assert_allclose(seen.held, 0.0, atol=1e-12)
    np.testing.assert_allclose(seen.off, 0.0, atol=1e-9)
    np.testing.assert_allclose(
        [seen.begun[..., faults.held_of == of].sum(axis=-1) for of in (1, 3)], 1.0, rtol=1e-9
    )


def test_a_stuck_motor_is_found_and_a_repair_is_noticed(faults, stuck):
    seen = faults.evidence(stuck)
    belief = faults.begin(2)
    for m in range(seen.hours.shape[1]):
        belief = faults.advance(belief, seen, m)
    assert faults.posterior(belief)[0, 3] > 0.9
    assert faults.posterior(belief)[1, 0] > 0.9
    repaired = seen[[1, 1]]
    for m in range(1, seen.hours.shape[1]):
        belief = faults.advance(belief, repaired, m)
    assert (faults.posterior(belief)[:, 0] > 0.9).all()


@pytest.mark.parametrize("names", [["healthy", "motor_1:lag"], ["motor_1:stuck"],
                                   ["healthy", "motor_1:stuck+motor_2:stuck"]])  # fmt: skip
def test_what_cannot_be_followed_is_refused(model, armpi, names):
    with pytest.raises(InputError, match="Expected healthy, stuck motors"):
        FaultFilter(model, parse_hypotheses(names, armpi.motor_names), Priors())


def test_senseless_rates_are_refused():
    with pytest.raises(InputError, match="faults_per_1000_h"):
        FaultRates(faults_per_1000_h=0.0)


def test_candidates_are_weighed_by_what_they_foretold(faults):
    """Two healthy behaviours, one movement after the other, against the product of densities."""
    rng, mixture = np.random.default_rng(3), HealthyMixture([faults, faults], np.array([0.9, 0.1]))
    seen = [made_up(faults, 3, rng), made_up(faults, 3, rng)]
    belief, alone = mixture.begin(1), [faults.begin(1), faults.begin(1)]
    weight = np.array([0.9, 0.1])
    for m in range(3):
        belief = mixture.advance(belief, seen, m)
        came = CHANGED / 2.0 * (1.0 - weight)
        weight = (1.0 - CHANGED) * weight + CHANGED / 2.0
        parts = zip(alone, seen, (came / weight)[:, None], strict=True)
        alone = [faults.advance(a, says, m, new) for a, says, new in parts]
        density = [
            np.exp(says.healthy[0, m] + a.log_predictive[0])
            for a, says in zip(alone, seen, strict=True)
        ]
        weight = weight * density
        assert belief.explained[0] == pytest.approx(np.log(weight.sum()), rel=1e-12)
        weight = weight / weight.sum()
    np.testing.assert_allclose(np.exp(belief.log_weight[0]), weight, rtol=1e-10)
    expected = sum(w * faults.posterior(a) for w, a in zip(weight, alone, strict=True))
    np.testing.assert_allclose(mixture.posterior(belief), expected, rtol=1e-10)


def test_a_robot_that_has_become_another_is_healthy_at_first(faults):
    """What a candidate that does not fit took for a fault says nothing of later movements."""
    rng, mixture = np.random.default_rng(4), HealthyMixture([faults, faults], np.array([0.5, 0.5]))
    seen = [made_up(faults, 1, rng), made_up(faults, 1, rng)]
    fits, broken = faults.begin(1), faults.begin(1)
    broken.healthy[:], broken.off[:, 0] = 1e-9, 1.0 - 1e-9
    for weight, as_from in ((1e-12, faults.begin(1)), (0.5, broken)):
        log_weight = np.log([[1.0 - weight, weight]])
        before = replace(mixture.begin(1), log_weight=log_weight, beliefs=(fits, broken))
        after = mixture.advance(before, seen, 0).beliefs[1]
        expected = faults.advance(as_from, seen[1], 0)
        np.testing.assert_allclose(after.healthy, expected.healthy, rtol=1e-4)
