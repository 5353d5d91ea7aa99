"""What is known of each mode beforehand: odds, words, advice."""

from __future__ import annotations

import pytest

from failuretwin.core.hypothesis import HEALTHY, UNKNOWN, Hypothesis
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.advice import advice_lines, next_steps
from failuretwin.inference.explanation import plain_name
from failuretwin.inference.faults.prior_odds import prior_odds


@pytest.mark.parametrize("mode", MODES.values(), ids=lambda mode: mode.mode)
def test_every_built_in_mode_has_its_knowledge(mode):
    assert "{motor}" in mode.name
    assert 0.0 < mode.prior_odds <= 1.0
    assert 0.0 < mode.before_run <= 1.0
    fault = Hypothesis.parse(f"motor_1:{mode.mode}")
    causes, advice = advice_lines(fault, next_steps({str(fault): 1.0}))
    assert causes.startswith("possible causes: ")
    assert advice.startswith("what to do: ")
    assert advice.endswith(".")


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
    assert prior_odds(HEALTHY) == 1.0
    assert prior_odds(Hypothesis.parse("motor_1:slow")) == 0.3
    assert prior_odds(Hypothesis.parse("motor_1:slow+motor_2:drift")) == 0.3 * 0.2
