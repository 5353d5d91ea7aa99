"""Faults that stay until they are repaired, against sums over every sequence of states."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from failuretwin import InputError
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.inference.together.fault_course import FaultCourse

NAMES = ["healthy", "motor_1:stuck", "motor_2:steady_state_error"]
PRIOR = np.array([0.5, 0.2, 0.3])
STEP = np.array(
    [
        [0.98, 0.02 * 0.4, 0.02 * 0.6],  # a healthy robot fails once in fifty runs, by the odds
        [0.02 * 0.98 / 0.992, 0.98, 0.02 * 0.012 / 0.992],  # repaired once in fifty, and failed
        [0.02 * 0.98 / 0.988, 0.02 * 0.008 / 0.988, 0.98],  # anew by then as a healthy one fails
    ]
)


def judged(*shares, undecided=()):
    """Return diagnoses with these posteriors, (run, hypothesis)."""
    return [
        Diagnosis(
            run=f"run_{i}",
            posterior=dict(zip(NAMES, share, strict=True)),
            undecided="no reading" if i in undecided else "",
        )
        for i, share in enumerate(shares)
    ]


def by_force(likelihood):
    """Weight of every sequence of states: {states: probability}, not normalised."""
    weights = {}
    for states in product(range(3), repeat=len(likelihood)):
        weight = PRIOR[states[0]] * likelihood[0][states[0]]
        for before, now, says in zip(states, states[1:], likelihood[1:], strict=False):
            weight *= STEP[before, now] * says[now]
        weights[states] = weight
    return weights


SHARES = np.array(
    [[0.7, 0.1, 0.2], [0.55, 0.3, 0.15], [0.2, 0.1, 0.7], [0.05, 0.15, 0.8], [0.3, 0.1, 0.6]]
)


def test_states_are_summed_over_all_sequences():
    course = FaultCourse.of(judged(*SHARES), PRIOR)
    weights = by_force(SHARES / PRIOR)
    total = sum(weights.values())
    expected = np.zeros((5, 3))
    for states, weight in weights.items():
        for run, state in enumerate(states):
            expected[run, state] += weight / total
    np.testing.assert_allclose(course.posterior, expected, rtol=1e-9)
    assert course.log_evidence == pytest.approx(np.log(total), rel=1e-12)
    assert tuple(course.path) == max(weights, key=weights.get)


def test_the_first_run_is_that_at_which_sequences_enter_the_state():
    shares = np.array([[0.9, 0.02, 0.08], [0.6, 0.02, 0.38], [0.3, 0.02, 0.68], [0.02, 0.0, 0.98]])
    shares = np.vstack([shares, [[0.02, 0.0, 0.98]] * 3])
    course = FaultCourse.of(judged(*shares), PRIOR)
    begun = np.zeros(len(shares))
    for states, weight in by_force(np.maximum(shares, 1e-300) / PRIOR).items():
        for run, state in enumerate(states):
            if state == 2 and (run == 0 or states[run - 1] != 2):
                begun[run] += weight
    share = np.cumsum(begun) / begun.sum()
    (faulty,) = (e for e in course.episodes if not e.hypothesis.is_healthy)
    assert faulty.first_90 == (np.argmax(share >= 0.05), np.argmax(share >= 0.95))
    assert faulty.first_90[0] < faulty.first_90[1]


def test_what_is_told_is_a_sentence_for_each_fault():
    well, error = [0.9, 0.05, 0.05], [0.02, 0.0, 0.98]
    (line,) = FaultCourse.of(judged(*[well] * 4, *[error] * 5)).verdict
    assert line.startswith("motor 2 misses its targets since run 5 of 9 (run_4)")
    assert line.endswith("over 99.9 % sure")
    (line,) = FaultCourse.of(judged(*[error] * 4)).verdict
    assert line == "motor 2 misses its targets in all 4 runs, over 99.9 % sure"
    (line,) = FaultCourse.of(judged(*[well] * 4, *[error] * 5, *[well] * 8)).verdict
    assert "in runs 5 to 9 of 17" in line
    assert "not any more since" in line
    (line,) = FaultCourse.of(judged(*[well] * 6)).verdict
    assert line.startswith("healthy in all 6 runs")


def test_one_odd_run_among_many_changes_nothing():
    odd = [0.2, 0.75, 0.05]
    course = FaultCourse.of(judged(*[[0.9, 0.05, 0.05]] * 5, odd, *[[0.9, 0.05, 0.05]] * 5))
    assert [str(e.hypothesis) for e in course.episodes] == ["healthy"]


def test_runs_without_a_verdict_say_nothing():
    error = [0.02, 0.0, 0.98]
    wild = judged(error, [0.0, 1.0, 0.0], error, undecided={1})
    (episode,) = FaultCourse.of(wild).episodes
    assert str(episode.hypothesis) == "motor_2:steady_state_error"
    assert (episode.first, episode.last) == (0, 2)


def test_other_hypotheses_in_between_are_refused():
    mixed = [*judged([0.5, 0.2, 0.3]), Diagnosis(run="x", posterior={"healthy": 1.0})]
    with pytest.raises(InputError, match="all with the same hypotheses"):
        FaultCourse.of(mixed)
    with pytest.raises(InputError, match="one run at least"):
        FaultCourse.of([])


def test_runs_that_say_nothing_are_no_healthy_robot():
    """Even odds of three states: healthy is the likeliest way to go on, and yet one in three."""
    third = np.full(3, 1.0 / 3.0)
    silent = FaultCourse.of(judged(*[third] * 4, undecided=range(4)), third)
    (said,) = silent.verdict
    assert said.startswith("cannot tell, because healthy in all ")


def test_one_fault_may_follow_another_without_a_healthy_run_between():
    surely = np.eye(3) * 0.997 + 0.001
    runs = judged(*surely[[0, 0, 1, 1, 1, 2, 2, 2]])
    found = FaultCourse.of(runs, PRIOR)
    told = [(str(e.hypothesis), e.first, e.last) for e in found.episodes]
    assert told == [(NAMES[0], 0, 1), (NAMES[1], 2, 4), (NAMES[2], 5, 7)]
    assert found.verdict[1].startswith("motor 2 misses its targets since run 6 of 8")
