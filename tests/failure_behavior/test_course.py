from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.integrate import cumulative_trapezoid

from failuretwin.failure_behavior.fault import (
    Course,
    EndlessEpisodes,
    draw_episodes,
    exposures,
    severities,
)

TIME = np.arange(1000) * 0.01
EPISODES = ((2.0, 3.0), (4.5, 5.25), (9.0, 12.0))
COURSES = [
    Course("step", 3.0),
    Course("ramp", 2.0, rise_s=4.0),
    Course("intermittent", 2.0, episodes=EPISODES),
    Course("intermittent", 2.0),
]


def test_a_step_is_there_at_once():
    np.testing.assert_array_equal(severities(COURSES, TIME)[0], TIME >= 3.0 - 1e-9)


def test_a_ramp_grows_linearly():
    expected = np.interp(TIME, [2.0, 6.0], [0.0, 1.0])
    np.testing.assert_allclose(severities(COURSES, TIME)[1], expected, atol=1e-12)


def test_episodes_come_and_go():
    inside = [(start - 1e-9 < TIME) & (end - 1e-9 > TIME) for start, end in EPISODES]
    np.testing.assert_array_equal(severities(COURSES, TIME)[2], np.any(inside, axis=0))
    assert not severities(COURSES, TIME)[3].any()


def test_every_run_may_have_its_own_times():
    own = np.array([[0.0, 3.0], [4.0, 9.0], [4.4, 4.6], [2.0, 3.0]])
    expected = [[0.0, 1.0], [0.5, 1.0], [0.0, 1.0], [0.0, 0.0]]
    np.testing.assert_allclose(severities(COURSES, own), expected)


def test_exposure_is_the_integral_of_the_severity():
    integral = cumulative_trapezoid(severities(COURSES, TIME), TIME, initial=0.0)
    np.testing.assert_allclose(exposures(COURSES, TIME), integral, atol=0.03)
    # At the end: 7 s less a sample, half of the rise and the rest, all episodes so far.
    np.testing.assert_allclose(exposures(COURSES, TIME)[:, -1], [6.99, 5.99, 2.74, 0.0])


@given(
    onset=st.floats(0.0, 9.0),
    share=st.floats(0.01, 1.0),
    shortest=st.floats(0.05, 2.0),
    longer=st.floats(0.0, 2.0),
    seed=st.integers(0, 1000),
)
def test_episodes_fill_their_share_from_the_onset_on(onset, share, shortest, longer, seed):
    rng = np.random.default_rng(seed)
    episodes = np.array(draw_episodes(onset, 10.0, share, (shortest, shortest + longer), rng))

    assert episodes[0, 0] == onset
    assert episodes[-1, 1] <= 10.0 + 1e-9
    assert np.diff(episodes.ravel()).min() >= -1e-9
    assert np.diff(episodes).sum() == pytest.approx(share * (10.0 - onset))


def test_episodes_are_about_as_long_as_asked():
    rng = np.random.default_rng(0)
    drawn = [draw_episodes(0.0, 1000.0, 0.5, (0.5, 2.0), rng) for _ in range(5)]
    length = np.diff(np.concatenate(drawn))[:, 0]
    assert stats.kstest(length, "uniform", (0.5, 1.5)).statistic < 0.05


def test_nothing_to_fill_is_no_episode():
    rng = np.random.default_rng(0)
    assert draw_episodes(3.0, 10.0, 0.0, (0.5, 2.0), rng) == ()
    assert draw_episodes(10.0, 10.0, 0.5, (0.5, 2.0), rng) == ()


def test_details_name_the_parameters():
    assert [course.detail() for course in COURSES[:3]] == [
        {"shape": "step"},
        {"shape": "ramp", "rise_s": 4.0},
        {"shape": "intermittent", "episodes_s": [[2.0, 3.0], [4.5, 5.25], [9.0, 12.0]]},
    ]


@pytest.mark.parametrize("share", [0.1, 0.5, 1.0])
def test_endless_episodes_fill_their_share_in_the_long_run(share):
    endless = EndlessEpisodes(3.0, share, (0.5, 2.0), np.random.default_rng(1))
    found = np.array(endless.within(0.0, 20_000.0))
    assert found[0, 0] == 3.0
    length = np.diff(found, axis=1)
    assert np.all((length >= 0.5) & (length <= 2.0))
    assert np.all(found[1:, 0] >= found[:-1, 1])
    assert length.sum() / 20_000.0 == pytest.approx(share, rel=0.05)


def test_endless_episodes_are_the_same_in_slices():
    whole, sliced = (
        EndlessEpisodes(0.0, 0.4, (0.5, 2.0), np.random.default_rng(5)) for _ in range(2)
    )
    edges = np.linspace(0.0, 60.0, 601)
    pieces = {e for a, b in pairwise(edges) for e in sliced.within(a, b)}
    assert sorted(pieces) == list(whole.within(0.0, 60.0))
    assert whole.within(10.0, 20.0) == tuple(e for e in sorted(pieces) if e[1] > 10 and e[0] < 20)
