"""Each mode against a plain formula or loop, and the published ones against the paper."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Fault
from failuretwin.digital_model.settling import hold
from failuretwin.failure_behavior.fault import Course, FaultGroup, FaultValue
from failuretwin.failure_behavior.mode import MotorOrders
from failuretwin.failure_behavior.modes import (
    Backlash,
    Drift,
    EncoderBias,
    Intermittent,
    Lag,
    SteadyStateError,
    Stuck,
)
from failuretwin.failure_behavior.registry import MODES

COUNT = np.deg2rad(0.24)
FREEZE = 49
"""0-based sample from which the published stuck responses are constant."""
TIME = np.arange(1000) * 0.01
STEP_AT_0 = Course("step", 0.0)


def group(mode, magnitude, course=STEP_AT_0):
    return FaultGroup.of([FaultValue(Fault("motor_1", mode.mode), magnitude, course)])


def wander(seed=0):
    """A reference that turns back at many places, (1, time)."""
    corners = np.random.default_rng(seed).uniform(-1.0, 1.0, 12)
    return np.interp(TIME, np.linspace(0.0, 9.0, 12), corners)[None]


@given(
    onset=st.floats(0.0, 12.0),
    step=st.sampled_from([0.01, 10 / 999, 0.1]),
    samples=st.integers(2, 1000),
)
def test_stuck_is_held_from_the_first_sample_at_or_after_the_onset(onset, step, samples):
    time = np.arange(samples) * step
    (held,) = Stuck().held(group(Stuck(), np.nan, Course("step", onset)), time)
    np.testing.assert_array_equal(held, time >= onset - 1e-9)


@pytest.mark.parametrize("time", [TIME, np.linspace(0, 10, 1000)])
def test_default_onset_is_the_published_sample(time, simulink):
    fault = MODES["stuck"].draw("motor_2", 5, 10.0, np.random.default_rng(0))
    angle = np.sin(np.arange(1000.0))[None, :, None]
    held = MODES["stuck"].held(FaultGroup.of([fault]), time)[..., None]
    followed = hold(angle, held, time, np.array([4.0]))

    assert np.argmax(followed != angle) == FREEZE + 1
    np.testing.assert_array_equal(followed[0, FREEZE:], angle[0, FREEZE, 0])
    # The published response with its motor stuck stands still from that very sample on.
    published = simulink["responses_rad"][simulink["label"] == 2][..., 1]
    moves = np.abs(np.diff(published, axis=1)) > 0
    assert moves[:, FREEZE - 1].all()
    assert not moves[:, FREEZE:].any()


def test_onset_is_drawn_from_its_range_and_within_the_run():
    rng = np.random.default_rng(1)
    onsets = [Stuck(onset_s=(2.0, 6.0)).draw("m", 5, 10.0, rng).onset_s for _ in range(500)]
    assert stats.kstest(onsets, "uniform", (2.0, 4.0)).pvalue > 0.01
    assert Stuck(onset_s=(20.0, 30.0)).draw("m", 5, 10.0, rng).onset_s == 10.0


def test_stuck_draws_no_magnitude():
    fault = Stuck().draw("motor_3", 5, 10.0, np.random.default_rng(0))
    assert str(fault.fault) == "motor_3:stuck"
    assert np.isnan(fault.magnitude)
    assert fault.detail("rad")["magnitude"] is None


def test_steady_state_errors_are_those_of_the_paper():
    rng = np.random.default_rng(2)
    draws = [MODES["steady_state_error"].draw("motor_1", 5, 10.0, rng) for _ in range(400)]
    errors = np.array([draw.per_movement["offset_rad"] for draw in draws]) / COUNT

    assert stats.kstest(np.abs(errors).ravel(), "uniform", (10.0, 40.0)).pvalue > 0.01
    assert stats.binomtest(int((errors > 0).sum()), errors.size).pvalue > 0.01
    assert all(draw.onset_s == 0.0 for draw in draws)
    # Drawn anew for every movement.
    between = np.corrcoef(errors.T)[np.triu_indices(5, 1)]
    assert np.abs(between).max() < 4 / np.sqrt(400)


@given(width=st.floats(0.0, 0.5), seed=st.integers(0, 50))
def test_backlash_is_the_play_operator(width, seed):
    (reference,) = wander(seed)
    (output,) = Backlash().on_reference(group(Backlash(), width), reference[None], TIME)

    here, expected = reference[0], []
    for angle in reference:
        if angle - here > width / 2:
            here = angle - width / 2
        elif here - angle > width / 2:
            here = angle + width / 2
        expected.append(here)
    np.testing.assert_allclose(output, expected, atol=1e-12)


@given(lag=st.floats(0.0, 0.5), seed=st.integers(0, 50))
def test_lag_is_the_reference_of_some_time_ago(lag, seed):
    reference = wander(seed)
    (late,) = Lag().on_reference(group(Lag(), lag), reference, TIME)
    np.testing.assert_allclose(late, np.interp(TIME - lag, TIME, reference[0]), atol=1e-9)


def test_lag_of_whole_samples_is_an_exact_shift():
    reference = wander()
    (late,) = Lag().on_reference(group(Lag(), 0.25), reference, TIME)
    np.testing.assert_allclose(late[25:], reference[0, :-25], atol=1e-12)


def test_lag_that_begins_waits_and_does_not_run_backwards():
    late = Lag().on_reference(group(Lag(), 0.2, Course("step", 4.0)), TIME[None], TIME)[0]
    expected = np.where(TIME < 4.0, TIME, np.maximum(TIME - 0.2, 3.99))
    np.testing.assert_allclose(late, expected, atol=1e-9)


def test_drift_stays_where_it_has_slipped_to():
    course = Course("intermittent", 2.0, episodes=((2.0, 3.0), (6.0, 6.5)))
    (angle,) = Drift().on_reference(group(Drift(), -0.1, course), np.zeros((1, 1000)), TIME)
    expected = np.interp(TIME, [2.0, 3.0, 6.0, 6.5], [0.0, -0.1, -0.1, -0.15])
    np.testing.assert_allclose(angle, expected, atol=1e-12)


def test_slow_divides_the_speed_of_movements_after_the_onset():
    orders = MotorOrders(
        target=np.ones((1, 3)),
        ramp_duration=np.full((1, 3), 0.6),
        start=np.array([[0.0, 2.0, 4.0]]),
        lost=np.zeros((1, 3), dtype=bool),
    )
    mode = MODES["slow"]
    ramp = group(mode, 0.8, Course("ramp", 1.0, rise_s=2.0))
    slowed = mode.on_movements(ramp, orders)
    np.testing.assert_allclose(slowed.ramp_duration, [[0.6, 0.6 / 0.6, 0.6 / 0.2]])
    assert slowed.target is orders.target


def test_signs_are_drawn_unless_told_otherwise():
    rng = np.random.default_rng(4)
    both = [EncoderBias(magnitude=(0.1, 0.1)).draw("m", 5, 10.0, rng) for _ in range(400)]
    sizes = np.array([value.magnitude for value in both])
    np.testing.assert_array_equal(np.abs(sizes), 0.1)
    assert stats.binomtest(int((sizes > 0).sum()), 400).pvalue > 0.01
    one_sided = EncoderBias(magnitude=(-0.3, -0.2), both_signs=False)
    sizes = np.array([one_sided.draw("m", 5, 10.0, rng).magnitude for _ in range(200)])
    assert stats.kstest(sizes, "uniform", (-0.3, 0.1)).pvalue > 0.01


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda: SteadyStateError(magnitude=(0.2, 0.1)), r"magnitude is \[0.2, 0.1\].* in order"),
        (lambda: SteadyStateError(magnitude=(-0.1, 0.1)), r"\[-0.1, 0.1\].* between 0 and inf"),
        (lambda: SteadyStateError(magnitude=(np.nan, 0.1)), r"magnitude is \[nan, 0.1\]"),
        (lambda: Lag(magnitude=(0.1, np.inf)), r"magnitude is \[0.1, inf\]"),
        (lambda: Intermittent(magnitude=(0.5, 1.5)), "between 0 and 1"),
        (lambda: Stuck(onset_s=(-1.0, 1.0)), r"stuck: onset_s is \[-1, 1\]"),
        (lambda: Lag(profiles=("ramp",), rise_s=(0.0, 1.0)), r"lag: rise_s is \[0, 1\]"),
        (lambda: Intermittent(episode_s=(0.0, 1.0)), r"intermittent: episode_s is \[0, 1\]"),
        (
            lambda: Lag(profiles=("intermittent",), episode_share=(0.5, 2.0)),
            r"episode_share is \[0.5, 2\]",
        ),
        (lambda: Lag(profiles=()), "lag: profiles is empty"),
    ],
)
def test_distributions_that_make_no_sense_are_refused(change, message):
    with pytest.raises(InputError, match=message):
        change()
