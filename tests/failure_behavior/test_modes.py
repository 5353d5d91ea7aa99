from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from failuretwin.core.errors import InputError
from failuretwin.failure_behavior.modes import MODES, SteadyStateError, Stuck

COUNT = np.deg2rad(0.24)
FREEZE = 49
"""0-based sample from which the published stuck responses are constant."""


def motion(samples):
    return np.sin(np.arange(samples))


@given(
    onset=st.floats(0.0, 12.0),
    step=st.sampled_from([0.01, 10 / 999, 0.1]),
    samples=st.integers(2, 1000),
)
def test_stuck_keeps_the_first_angle_at_or_after_the_onset(onset, step, samples):
    time = np.arange(samples) * step
    angle = motion(samples)

    held = Stuck().hold(angle, time, onset)

    after = time >= onset - 1e-9
    np.testing.assert_array_equal(held[~after], angle[~after])
    np.testing.assert_array_equal(held[after], np.full(after.sum(), angle[after][:1]))


@pytest.mark.parametrize("time", [np.arange(1000) * 0.01, np.linspace(0, 10, 1000)])
def test_default_onset_is_the_published_sample(time, simulink):
    rng = np.random.default_rng(0)
    fault = MODES["stuck"].draw("motor_2", 5, 10.0, rng)
    angle = motion(1000)
    held = MODES["stuck"].hold(angle, time, fault.onset_s)

    assert np.argmax(held != angle) == FREEZE + 1
    np.testing.assert_array_equal(held[FREEZE:], angle[FREEZE])
    # The published response with its motor stuck stands still from that very sample on.
    published = simulink["responses_rad"][simulink["label"] == 2][..., 1]
    moves = np.abs(np.diff(published, axis=1)) > 0
    assert moves[:, FREEZE - 1].all()
    assert not moves[:, FREEZE:].any()


def test_stuck_leaves_what_it_is_given_as_it_is():
    angle = motion(100)
    before = angle.copy()
    Stuck().hold(angle, np.arange(100) * 0.01, 0.3)
    np.testing.assert_array_equal(angle, before)


def test_stuck_onset_is_drawn_from_its_range_and_within_the_run():
    rng = np.random.default_rng(1)
    onsets = [Stuck((2.0, 6.0)).draw("motor_1", 5, 10.0, rng).onset_s for _ in range(500)]
    assert stats.kstest(onsets, "uniform", (2.0, 4.0)).pvalue > 0.01
    assert Stuck((20.0, 30.0)).draw("motor_1", 5, 10.0, rng).onset_s == 10.0


def test_stuck_draws_no_error():
    fault = Stuck().draw("motor_3", 5, 10.0, np.random.default_rng(0))
    assert str(fault.fault) == "motor_3:stuck"
    assert not fault.offset.any()
    assert np.isnan(fault.magnitude)


def test_steady_state_errors_are_those_of_the_paper():
    rng = np.random.default_rng(2)
    draws = [MODES["steady_state_error"].draw("motor_1", 5, 10.0, rng) for _ in range(400)]
    errors = np.array([draw.offset for draw in draws]) / COUNT

    assert stats.kstest(np.abs(errors).ravel(), "uniform", (10.0, 40.0)).pvalue > 0.01
    assert stats.binomtest(int((errors > 0).sum()), errors.size).pvalue > 0.01
    assert all(draw.onset_s == 0.0 for draw in draws)


def test_steady_state_error_is_redrawn_for_every_movement():
    rng = np.random.default_rng(3)
    errors = np.array([SteadyStateError().draw("m", 5, 10.0, rng).offset for _ in range(400)])
    assert (np.ptp(errors, axis=1) > 0).all()
    between = np.corrcoef(errors.T)[np.triu_indices(5, 1)]
    assert np.abs(between).max() < 4 / np.sqrt(400)


def test_magnitude_of_a_steady_state_error_is_its_rms():
    fault = SteadyStateError().draw("motor_1", 5, 10.0, np.random.default_rng(4))
    assert fault.magnitude == pytest.approx(np.linalg.norm(fault.offset) / np.sqrt(5))
    assert fault.detail()["offset_rad"] == fault.offset.tolist()


def test_steady_state_error_acts_on_targets_alone():
    angle = motion(100)
    held = SteadyStateError().hold(angle, np.arange(100) * 0.01, 0.3)
    np.testing.assert_array_equal(held, motion(100))


@pytest.mark.parametrize("bounds", [(0.2, 0.1), (-0.1, 0.1), (np.nan, 0.1)])
def test_error_bounds_must_be_in_order(bounds):
    with pytest.raises(InputError, match="expected 0 <= low <= high"):
        SteadyStateError(bounds)
