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
    modes = failure_modes()
    both = Hypothesis.parse("motor_1:slow+motor_2:drift")

    assert prior_odds(HEALTHY) == 1.0
    assert prior_odds(both) == modes["slow"].prior_odds * modes["drift"].prior_odds
