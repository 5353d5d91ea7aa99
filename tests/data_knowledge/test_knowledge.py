from __future__ import annotations

import pytest

from failuretwin.core.hypothesis import HEALTHY, MAGNITUDE_UNITS, UNKNOWN, Hypothesis
from failuretwin.data_knowledge.failure_modes import failure_modes, plain_name, prior_odds


def test_every_fault_mode_has_a_complete_row():
    assert set(failure_modes()) == set(MAGNITUDE_UNITS)
    for mode in failure_modes().values():
        assert "{motor}" in mode.name
        assert mode.mechanisms
        assert 0.0 < mode.prior_odds <= 1.0
        assert all((mode.effect, mode.shows, mode.advice.endswith("."), mode.source))


def test_beliefs_of_the_modes():
    """Odds against healthy, probability that it was there before the run, sizes."""
    believed = {
        name: (mode.prior_odds, mode.before_run, tuple(mode.sizes))
        for name, mode in failure_modes().items()
    }
    assert believed == {
        "stuck": (1.0, 0.5, ()),
        "steady_state_error": (1.0, 0.9, ()),
        "slow": (0.3, 0.9, (0.15, 0.85)),
        "lag": (0.3, 0.9, (0.06, 0.4)),
        "backlash": (0.3, 0.9, (0.02, 0.15)),
        "drift": (0.2, 0.9, (0.005, 0.06)),
        "intermittent": (0.2, 0.9, (0.1, 0.9)),
        "torque_loss": (0.2, 0.9, (0.25, 0.8)),
        "encoder_bias": (0.3, 0.9, (0.02, 0.85)),
        "encoder_scale": (0.2, 0.9, (0.03, 0.75)),
        "lost_commands": (0.2, 0.9, (0.2, 1.0)),
    }


@pytest.mark.parametrize(
    ("text", "plain"),
    [
        ("motor_3:stuck", "motor 3 stuck"),
        ("motor_1:steady_state_error", "motor 1 misses its targets"),
        ("motor_1:stuck+motor_2:drift", "motor 1 stuck and motor 2 drifts"),
    ],
)
def test_a_hypothesis_in_plain_words(text, plain):
    assert plain_name(Hypothesis.parse(text)) == plain


def test_states_without_a_fault_have_names_too():
    assert plain_name(HEALTHY) == "healthy"
    assert "none of the known faults" in plain_name(UNKNOWN)


def test_odds_of_two_faults_multiply():
    both = Hypothesis.parse("motor_1:slow+motor_2:drift")

    assert prior_odds(HEALTHY) == 1.0
    assert prior_odds(both) == pytest.approx(0.3 * 0.2)
