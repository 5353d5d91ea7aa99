from __future__ import annotations

import numpy as np
import pytest
from sklearn.metrics import brier_score_loss, log_loss

from failuretwin.decision.scoring_rules import brier_score, log_score

NAMES = ("a", "b", "c", "d")


@pytest.fixture
def forecasts():
    """Probabilities of 200 runs, as an array and by name, and the truth drawn from them."""
    rng = np.random.default_rng(4)
    chance = rng.dirichlet(np.full(4, 0.7), size=200)
    truth = [NAMES[rng.choice(4, p=p)] for p in chance]
    return chance, [dict(zip(NAMES, map(float, p), strict=True)) for p in chance], truth


def test_log_score_is_the_log_loss_of_scikit_learn(forecasts):
    chance, posterior, truth = forecasts
    assert log_score(truth, posterior).mean == pytest.approx(log_loss(truth, chance))


def test_brier_score_is_that_of_scikit_learn(forecasts):
    chance, posterior, truth = forecasts
    expected = brier_score_loss(truth, chance, labels=NAMES, scale_by_half=False)
    assert brier_score(truth, posterior).mean() == pytest.approx(expected)


def test_ends_of_the_scales():
    certain = {"a": 1.0, "b": 0.0}
    assert brier_score(["a", "b", "c"], [certain] * 3).tolist() == [0.0, 2.0, 2.0]
    assert log_score(["a", "b", "c"], [certain] * 3).nats.tolist() == [0.0, np.inf, np.inf]
    assert not np.signbit(log_score(["a"], [certain]).nats[0])


@pytest.mark.parametrize("rule", [brier_score, lambda t, p: log_score(t, p).nats])
def test_honest_probabilities_score_best_on_average(rule):
    honest = np.array([0.5, 0.3, 0.2])

    def expected(stated):
        posterior = dict(zip("abc", stated, strict=True))
        return honest @ np.array([rule([true], [posterior])[0] for true in "abc"])

    rng = np.random.default_rng(1)
    others = [expected(stated) for stated in rng.dirichlet(np.ones(3), size=300)]
    assert expected(honest) < min(others)
