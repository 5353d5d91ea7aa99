from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import expon

from failuretwin.core.errors import InputError
from failuretwin.decision.proportions import Share, alarm_threshold, delays_after_onset

TIME = np.arange(11.0)
HEALTHY = [0.1, 0.2, 0.1, 0.3, 0.2, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1]


def step(at, level=0.9):
    """Probability that rises at an instant."""
    return np.where(at <= TIME, level, 0.05)


def measured(fault, true_fault, onset, share=0.0):
    """Delays of faulty runs beside one healthy run."""
    fault, true_fault = np.atleast_2d(fault), np.atleast_2d(true_fault)
    return delays_after_onset(
        TIME,
        np.vstack([HEALTHY, fault]),
        np.vstack([np.zeros_like(TIME), true_fault]),
        np.r_[np.nan, onset],
        share,
    )


def test_delay_is_the_time_from_onset_to_alarm():
    found = measured([step(5), step(2)], [step(7), step(2)], [3.0, 0.0])
    assert found.threshold == 0.3
    assert found.detection.delay.tolist() == [2.0, 2.0]
    assert found.isolation.delay.tolist() == [4.0, 2.0]
    assert found.false_alarms == Share(0, 1)
    assert found.detection.median == 2.0


def test_run_that_ends_without_an_alarm_is_censored():
    found = measured([step(99), step(4)], [step(99), step(99)], [3.0, 3.0])
    assert found.detection.delay.tolist() == [np.inf, 1.0]
    assert found.isolation.delay.tolist() == [np.inf, np.inf]
    assert found.detection.followed.tolist() == [7.0, 7.0]
    assert found.detection.never == Share(1, 2)
    assert found.isolation.never == Share(2, 2)
    assert found.isolation.median == np.inf


def test_alarm_before_the_onset_is_no_delay():
    found = measured([step(1), step(4)], [step(1), step(4)], [3.0, 3.0])
    np.testing.assert_array_equal(found.detection.delay, [np.nan, 1.0])
    np.testing.assert_array_equal(found.isolation.delay, [np.nan, 1.0])
    assert found.early == Share(1, 2)
    assert found.detection.never == Share(0, 1)


def test_another_fault_in_front_is_no_isolation():
    fault = step(3)
    found = measured([fault, fault], [0.5 * fault, 0.51 * fault], [3.0, 3.0])
    assert found.isolation.delay.tolist() == [np.inf, 0.0]
    assert found.detection.delay.tolist() == [0.0, 0.0]


def test_no_answer_is_no_alarm():
    silent = np.where(TIME > 6, np.nan, step(99))
    found = measured(silent, silent, [2.0])
    assert found.detection.delay.tolist() == [np.inf]
    assert found.detection.followed.tolist() == [4.0]


@given(
    seed=st.integers(0, 10_000),
    runs=st.integers(1, 60),
    share=st.floats(0, 0.99),
    levels=st.sampled_from([3, 1000]),
)
def test_threshold_keeps_false_alarms_at_the_stated_share_and_is_the_lowest(
    seed, runs, share, levels
):
    healthy = np.random.default_rng(seed).integers(0, levels, (runs, 5)) / levels
    threshold = alarm_threshold(healthy, share)

    def alarms(above):
        return (healthy > above).any(axis=1).sum()

    assert alarms(threshold) <= share * runs + 1e-6
    below = [value for value in np.unique(healthy) if value < threshold]
    assert all(alarms(value) > share * runs for value in below)


def test_higher_share_of_false_alarms_is_never_slower():
    rng = np.random.default_rng(0)
    time = np.arange(0.0, 10.0, 0.1)
    onset = np.where(np.arange(300) < 150, np.nan, rng.uniform(1, 6, 300))
    drift = np.where(time > np.nan_to_num(onset, nan=99.0)[:, None], 0.15, 0.0)
    walk = np.cumsum(drift + rng.normal(0, 0.3, (300, 100)), axis=1)
    fault = 1 / (1 + np.exp(3 - walk))
    medians = []
    for share in (0.0, 0.05, 0.2, 0.5):
        found = delays_after_onset(time, fault, 0.9 * fault, onset, share)
        assert found.false_alarms.value <= share
        medians.append(found.detection.median)
        kept = np.isfinite(found.detection.delay)
        assert (found.isolation.delay[kept] >= found.detection.delay[kept]).all()
    assert medians == sorted(medians, reverse=True)
    assert medians[0] > medians[-1]


def test_median_is_right_though_runs_end_too_soon():
    """Delays with a known median, cut off at random: leaving the cut ones out would be too low."""
    rng = np.random.default_rng(1)
    time = np.arange(0.0, 6.0, 0.02)
    delay = rng.exponential(3.0, 3000)
    end = rng.uniform(0.2, 6.0, 3000)
    fault = np.where(time >= delay[:, None], 1.0, 0.0)
    fault[time > end[:, None]] = np.nan
    fault = np.vstack([np.zeros_like(time), fault])
    onset = np.r_[np.nan, np.zeros(3000)]
    found = delays_after_onset(time, fault, fault, onset, 0.0)
    assert found.detection.never.value > 0.3
    expected = expon(scale=3.0).median()
    assert found.detection.median == pytest.approx(expected, rel=0.06)
    assert np.median(found.detection.delay[np.isfinite(found.detection.delay)]) < 0.7 * expected


@pytest.mark.parametrize(
    ("onset", "share", "words"),
    [
        ([np.nan, np.nan], 0.0, "no faulty runs"),
        ([1.0, 2.0], 0.0, "no healthy runs"),
        ([np.nan, 1.0], 1.0, "expected 0 <= rate < 1"),
        ([np.nan, 1.0, 2.0], 0.0, "expected both"),
    ],
)
def test_delays_need_both_kinds_of_runs(onset, share, words):
    fault = np.zeros((2, 11))
    with pytest.raises(InputError, match=words):
        delays_after_onset(TIME, fault, fault, np.array(onset), share)
