"""The alarm rule: a budget that is kept, two states, episodes that are told once."""

from __future__ import annotations

import numpy as np
import pytest

from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import CLEAR, RAISED, SUSPECTED
from failuretwin.decision.streaming.alarm_rule import AlarmRule

NAMES = ["healthy", "motor_1:stuck", "motor_2:stuck"]
PER_H = 0.04


def odds(total, first=1.0):
    """Return the posterior of faults with odds `total`, the first of them with a share."""
    faulty = total / (1.0 + total)
    return np.array([1.0 - faulty, first * faulty, (1.0 - first) * faulty])


def test_the_threshold_is_the_bound_of_the_budget():
    """Faults in 100 hours over a third of the false alarms in 100 hours."""
    assert np.exp(AlarmRule(NAMES, PER_H).log_odds) == pytest.approx(4.0 / 3.0)
    assert np.exp(AlarmRule(NAMES, PER_H, 10.0).log_odds) == pytest.approx(0.4 / 3.0)


def test_states_from_clear_over_suspected_to_an_alarm_and_back():
    rule = AlarmRule(NAMES, PER_H)
    told = [rule.see(float(k), odds(x)) for k, x in enumerate([1e-4, 0.05, 1.4, 1.0, 0.01, 1e-4])]
    assert [alarm.state for alarm in told] == [CLEAR, SUSPECTED, RAISED, RAISED, CLEAR, CLEAR]
    assert [alarm.cause for alarm in told] == ["", *["motor_1:stuck"] * 3, "", ""]
    assert told[1].episode is None
    raised, over = told[2].episode, told[4].episode
    assert (raised.number, raised.cause, raised.raised_s) == (1, "motor_1:stuck", 2.0)
    assert (raised.cleared_s, raised.duration_s) == (None, None)
    assert [alarm.threshold for alarm in told[1:4]] == [None, *[pytest.approx(4.0 / 7.0)] * 2]
    assert (over.number, over.cleared_s, over.duration_s) == (1, 4.0, 2.0)
    assert told[3].concerns("motor_1")
    assert not told[3].concerns("motor_2")


def test_an_alarm_waits_for_a_name_but_not_for_ever():
    rule = AlarmRule(NAMES, PER_H)
    states = [rule.see(float(k), odds(100.0, 0.6), 0.001).state for k in range(5)]
    assert states == [SUSPECTED, SUSPECTED, SUSPECTED, RAISED, RAISED]
    quick = AlarmRule(NAMES, PER_H)
    assert quick.see(0.0, odds(100.0, 0.96), 0.001).state == RAISED


def test_another_cause_is_another_episode():
    rule = AlarmRule(NAMES, PER_H)
    rule.see(0.0, odds(100.0))
    assert rule.see(1.0, odds(100.0, 0.5)).episode.number == 1  # nothing else stands out
    other = rule.see(2.0, odds(100.0, 0.01))
    assert (other.episode.number, other.cause) == (2, "motor_2:stuck")


def test_a_robot_that_is_often_suspected_in_vain_needs_more_to_alarm():
    """Chance allows some hundred times the budget of suspicions; more raise the bar."""
    rule = AlarmRule(NAMES, PER_H)
    usual = rule.log_odds
    for k in range(400):
        rule.see(2.0 * k, odds(0.2), 0.01)
        rule.see(2.0 * k + 1.0, odds(1e-4), 0.01)
    assert rule.hours == pytest.approx(8.0)
    assert 100 < rule.passed < 400  # what is suspected at last takes more, too
    assert rule.log_odds - usual == pytest.approx(np.log((1.0 + rule.passed) / 25.0))


def test_a_robot_that_does_what_its_model_says_keeps_the_bound():
    rule = AlarmRule(NAMES, PER_H)
    usual = rule.log_odds
    for k in range(100):
        rule.see(float(k), odds(1e-4), 0.5)
    assert rule.log_odds == usual


@pytest.mark.parametrize("budget", [0.0, -1.0, np.nan, 2000.0])
def test_a_senseless_budget_is_refused(budget):
    with pytest.raises(InputError, match="false alarms in 100 hours"):
        AlarmRule(NAMES, PER_H, budget)
