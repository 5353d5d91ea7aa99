"""A motor that sticks now and then while it follows a curve."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

import failuretwin as ft
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.numerics import log_of
from failuretwin.failure_behavior.fault import draw_episodes
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.engine.episode_rows import ages, begun
from failuretwin.inference.engine.registration import robot_weighing
from failuretwin.inference.engine.rows import Episodes
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from inference.engine.test_on_the_way import ROBOT, STEP_S, curve, moments, zigzag
from little_logs import exact_run

HYPOTHESES = [
    "healthy",
    *(
        f"motor_{k}:{mode}"
        for k in (1, 2, 3)
        for mode in ("stuck", "steady_state_error", "lag", "intermittent")
    ),
]


def sticking(command, motor, episodes):
    """Return what an arm does whose motor stays where it is in some episodes [s]."""
    followed = command.copy()
    for begin, end in episodes:
        first, last = round(begin / STEP_S), round(end / STEP_S)
        followed[first:last, motor] = followed[first, motor]
    return followed


def test_ages_are_those_of_drawn_episodes():
    rng = np.random.default_rng(2)
    episodes = np.array(draw_episodes(0.0, 40_000.0, 0.5, (0.5, 2.0), rng))
    begin, end = episodes.T
    time = rng.uniform(0.0, 40_000.0, 200_000)
    which = np.searchsorted(begin, time) - 1
    age = (time - begin[which])[time < end[which]]
    edges, probability = ages((0.5, 2.0))
    seen, _ = np.histogram(age, edges)
    assert seen / seen.sum() == pytest.approx(probability, abs=0.01)


def test_share_and_onset_are_those_of_all_ways_to_stick():
    """An episode begins with the onset; a fault from before the run may be in none."""
    rng = np.random.default_rng(5)
    count, usual, age = 6, 0.4, np.array([0.7, 0.3])
    held, (sound, other) = rng.uniform(0.05, 1.0, (count, 2)), rng.uniform(0.05, 1.0, (2, count))
    begins = rng.uniform(0.1, 0.45, (count, 2))
    total = usual * held @ age + (1.0 - usual) * sound + other
    prior, sizes = rng.dirichlet(np.ones(count)), np.array([0.2, 0.4, 0.7])
    nothing = np.zeros((1, count, 1))
    episodes = Episodes(
        np.array([usual]),
        np.array([-1, 0, 1]),
        age,
        begins[None],
        sizes,
        log_of(prior)[None],
        nothing,
        nothing,
    )
    told = usual * held * age / total[:, None], (1.0 - usual) * sound / total
    expected = np.zeros((count, len(sizes)))
    for (first, early), (k, size) in product(enumerate(prior), enumerate(sizes)):
        for ways in product((None, 0, 1), repeat=count):  # the age of an episode; None: in none
            weight = early
            for m, sticks in enumerate(ways):
                there = size * age if m >= first else np.zeros(2)
                there = begins[m] if m == first > 0 else there
                share = 1.0 - there.sum() if sticks is None else there[sticks]
                known = sound[m] if sticks is None else held[m, sticks]
                weight *= share * (known + other[m])
            expected[first, k] += weight
    assert episodes.posterior(0, 0, 0, told) == pytest.approx(expected / expected.sum(), rel=1e-9)
    later = expected * (np.arange(count) >= 2)[:, None]
    assert episodes.posterior(0, 0, 2, told) == pytest.approx(later / later.sum(), rel=1e-9)


def test_an_episode_that_begins_in_a_gap_is_as_old_as_drawn_ones():
    rng = np.random.default_rng(6)
    for gap in (0.3, 1.1, 3.0):
        old, length = rng.uniform(0.0, gap, 200_000), rng.uniform(0.5, 2.0, 200_000)
        seen, _ = np.histogram(old[old < length], ages((0.5, 2.0))[0])
        assert begun(np.array([gap]), (0.5, 2.0))[0] == pytest.approx(seen / 200_000, abs=0.005)


@pytest.mark.parametrize("motor", [0, 1, 2])
def test_a_motor_that_sticks_on_a_curve_is_found(motor):
    command, episodes = curve(12.0), [(1.0, 2.2), (3.5, 4.3), (5.6, 7.2), (9.0, 10.1)]
    runs = exact_run(ROBOT, command, sticking(command, motor, episodes))
    (found,) = ft.diagnose(runs, ROBOT, "generic", hypotheses=HYPOTHESES)
    assert str(found.diagnosis) == f"motor_{motor + 1}:intermittent"
    assert found.probability > 0.9
    share = sum(end - begin for begin, end in episodes) / 12.0
    assert found.magnitude_90[0] < share < found.magnitude_90[1]
    assert found.onset_90[0] <= 1.0
    worst = max(found.evidence, key=lambda one: one.nats)
    assert worst.nats > 1.0


def test_an_onset_in_mid_run_lies_in_its_interval():
    command, episodes = curve(16.0), [(9.0, 10.8), (11.5, 13.0), (13.8, 15.6)]
    runs = exact_run(ROBOT, command, sticking(command, 1, episodes))
    (found,) = ft.diagnose(runs, ROBOT, "generic", hypotheses=HYPOTHESES)
    assert str(found.diagnosis) == "motor_2:intermittent"
    assert found.onset_90[0] <= 9.0 <= found.onset_90[1]


def test_a_motor_that_stays_where_it_is_for_good_does_not_stick_now_and_then():
    command = curve(8.0)
    runs = exact_run(ROBOT, command, sticking(command, 1, [(3.0, 8.1)]))
    (found,) = ft.diagnose(runs, ROBOT, "generic", hypotheses=HYPOTHESES)
    assert str(found.diagnosis) == "motor_2:stuck"


@pytest.mark.parametrize("way", ["ramps", "curve"])
def test_a_run_of_which_the_engine_is_asked_nothing_keeps_its_evidence(way):
    """A motor that misses movements of ramps is weighed at the theta of the best other fault."""
    command = zigzag() if way == "ramps" else curve()
    followed = sticking(command, 1, [(0.9, 2.6), (3.1, 4.6)])
    healthy, seen = moments(exact_run(ROBOT, command, followed))
    hypotheses = [Hypothesis.parse(name) for name in HYPOTHESES]
    weighing = robot_weighing(RunLikelihood(seen, healthy), hypotheses, ft.Priors())
    sticks = HYPOTHESES.index("motor_2:intermittent")
    asked = np.zeros((1, len(hypotheses)), dtype=bool)
    asked[0, sticks] = True
    alone = replace(weighing, asked=asked)
    told = (one.by_hypothesis[0, sticks] for one in (alone, weighing))
    assert next(told) == pytest.approx(next(told), abs=0.3)
    assert np.isfinite(alone.share).all()


def test_the_mode_says_that_it_comes_in_episodes():
    assert MODES["intermittent"].in_episodes
    assert not MODES["lost_commands"].in_episodes
    assert not MODES["stuck"].in_episodes
