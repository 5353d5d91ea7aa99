from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.decision.learned.log_pool import (
    HybridDiagnoser,
    PoolWeights,
    fit_pool_weights,
    gated,
    log_pool,
)

CLASSES = ("healthy", "motor_1:stuck", "motor_2:stuck")


@dataclass(frozen=True)
class Says:
    """A diagnoser that always says the same."""

    chances: tuple[float, ...]
    undecided: str = ""
    classes: tuple[str, ...] = CLASSES
    magnitude: float = 0.3

    def diagnose(self, runs):
        posterior = dict(zip(self.classes, self.chances, strict=True))
        return [
            Diagnosis(
                run="run",
                posterior=posterior,
                magnitude=self.magnitude,
                onset_s=1.0,
                undecided=self.undecided,
                protocol="P0c",
            )
        ]


def test_weights_of_one_part_give_that_part():
    chances = np.random.default_rng(0).dirichlet([1.0] * 3, 20)
    other = np.roll(chances, 1, axis=1)
    np.testing.assert_allclose(log_pool(chances, other, PoolWeights(1.0, 0.0)), chances)
    np.testing.assert_allclose(log_pool(chances, other, PoolWeights(0.0, 1.0)), other)


def test_independent_witnesses_multiply():
    """Bayes' rule for two witnesses who saw different things, with equal prior odds."""
    made = log_pool(np.array([[0.8, 0.2]]), np.array([[0.6, 0.4]]), PoolWeights(1.0, 1.0))
    np.testing.assert_allclose(made, [[0.48 / 0.56, 0.08 / 0.56]])


def test_the_gate_leaves_healthy_to_the_model():
    bayes, network = np.array([[0.7, 0.2, 0.1]]), np.array([[0.1, 0.3, 0.6]])
    np.testing.assert_allclose(gated(bayes, network, 0), [[0.7, 0.1, 0.2]])


def test_a_network_sure_of_healthy_breaks_no_gate():
    made = gated(np.array([[0.2, 0.4, 0.4]]), np.array([[1.0, 0.0, 0.0]]), 0)
    np.testing.assert_allclose(made, [[0.2, 0.4, 0.4]])


def test_weights_are_recovered():
    """Truths drawn from a blend are surprised least by its weights."""
    rng = np.random.default_rng(1)
    first, second = (rng.dirichlet([0.6] * 3, 20000) for _ in range(2))
    chances = log_pool(first, second, PoolWeights(0.9, 0.4))
    truth = (rng.random((len(chances), 1)) > chances.cumsum(axis=1)).sum(axis=1)
    found = fit_pool_weights(first, second, truth)
    assert found.bayes == pytest.approx(0.9, abs=0.05)
    assert found.network == pytest.approx(0.4, abs=0.05)


def test_a_useless_witness_gets_no_weight():
    rng = np.random.default_rng(2)
    chances, noise = (rng.dirichlet([0.6] * 3, 20000) for _ in range(2))
    truth = (rng.random((len(chances), 1)) > chances.cumsum(axis=1)).sum(axis=1)
    found = fit_pool_weights(chances, noise, truth)
    assert found.bayes == pytest.approx(1.0, abs=0.05)
    assert found.network < 0.05


def test_size_and_onset_are_those_of_a_part_that_names_the_fault():
    network = Says((0.1, 0.7, 0.2), magnitude=0.7)
    (diagnosis,) = HybridDiagnoser(Says((0.1, 0.8, 0.1)), network).diagnose(None)
    assert (diagnosis.diagnosis, diagnosis.magnitude) == ("motor_1:stuck", 0.3)
    network = Says((0.1, 0.0, 0.9), magnitude=0.7)
    (diagnosis,) = HybridDiagnoser(Says((0.1, 0.5, 0.4)), network).diagnose(None)
    assert (diagnosis.diagnosis, diagnosis.magnitude) == ("motor_2:stuck", 0.7)
    parts = Says((0.02, 0.5, 0.48)), Says((0.5, 0.02, 0.48), magnitude=0.7)
    (diagnosis,) = HybridDiagnoser(*parts, PoolWeights(0.5, 0.5)).diagnose(None)
    assert (diagnosis.diagnosis, diagnosis.magnitude) == ("motor_2:stuck", None)


def test_no_verdict_of_the_model_is_none_of_both():
    both = HybridDiagnoser(Says((0.3, 0.4, 0.3), "no readings"), Says((0.0, 1.0, 0.0)))
    assert both.diagnose(None)[0].diagnosis is None


def test_parts_must_know_the_same_classes():
    other = Says((0.5, 0.5), classes=("healthy", "motor_1:drift"))
    with pytest.raises(InputError, match="motor_1:drift"):
        HybridDiagnoser(Says((0.1, 0.8, 0.1)), other).diagnose(None)
