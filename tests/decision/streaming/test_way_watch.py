"""An arm that never rests, watched: a window of its life after the other."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline, PchipInterpolator

from failuretwin import BayesDiagnoser
from failuretwin.core.hypothesis import CLEAR, RAISED
from failuretwin.decision.streaming.monitor import FaultMonitor, monitor
from failuretwin.digital_model.robot import load_robot
from failuretwin.digital_model.twin import DigitalTwin

ROBOT = load_robot("armpi_fpv")
STEP_S, LAG_S, NOISE_M = 0.05, 0.1, 5e-4
HEALTHY, STUCK, OFF = "healthy", "motor_1:stuck", "motor_2:steady_state_error"
FEW = [HEALTHY, OFF, "motor_3:stuck", "motor_3:steady_state_error"]


def stream(seconds, seed, stuck_s=np.inf, motor=1, off_s=np.inf, off_rad=0.1, late_s=np.inf):
    """Yield time, command and reading of a smooth motion; a motor may stop, go off or be late."""
    rng = np.random.default_rng(seed)
    knots = np.arange(-1.0, seconds + 2.0, 0.9)
    told = CubicSpline(knots, rng.uniform(-0.7, 0.7, (len(knots), 4)))
    twin, held = DigitalTwin(ROBOT), None
    for k in range(round(seconds / STEP_S)):
        time = k * STEP_S
        command, seen = told(time), told(time - LAG_S)
        seen[motor] += off_rad * (time >= off_s)
        if time >= late_s:
            seen[motor] = told(time - LAG_S - 0.25)[motor]
        if time >= stuck_s:
            held = seen[motor] if held is None else held
            seen[motor] = held
        point = twin.path(seen) + rng.normal(scale=NOISE_M, size=3) if k % 2 == 0 else None
        yield time, command, point


def watch(samples, hypotheses=None):
    """Return the last answer, and the time of its alarm; the alarm ends the watch."""
    found = watching(hypotheses)
    for sample in samples:
        answer = found.update(*sample)
        if answer.alarm.state == RAISED:
            return answer, sample[0]
    return answer, None


def watching(hypotheses):
    """Return what watches an arm for some faults; None: for all that are usual."""
    if hypotheses is None:
        return monitor("armpi_fpv", "generic")
    return FaultMonitor(BayesDiagnoser("armpi_fpv", "generic", hypotheses, whole_run=False))


def test_a_healthy_arm_raises_no_alarm():
    answer, raised = watch(stream(33.0, 3))
    assert raised is None
    assert answer.alarm.state == CLEAR
    assert answer.diagnosis.posterior["healthy"] > 0.99
    assert "readings on the way" in answer.diagnosis.method


def test_a_motor_that_stops_is_named_within_three_windows():
    answer, raised = watch(stream(45.0, 6, stuck_s=20.0, motor=2), FEW)
    assert 20.0 < raised < 38.5
    assert answer.alarm.cause == "motor_3:stuck"
    assert answer.diagnosis.diagnosis == "motor_3:stuck"
    assert answer.diagnosis.onset_s == pytest.approx(20.0, abs=6.5)  # a window


def test_the_last_part_of_a_stream_counts_at_its_end():
    """Its last window is five seconds long."""
    found = watching([HEALTHY, STUCK, "motor_2:stuck", OFF])
    for sample in stream(17.0, 4, stuck_s=12.5, motor=0):
        answer = found.update(*sample)
    assert answer.alarm.state == CLEAR
    assert found.fit.moments > 5
    answer = found.conclude()
    assert answer.alarm.state == RAISED
    assert answer.alarm.cause == STUCK


def test_a_motor_that_is_late_is_told_where_nobody_asked_for_it():
    found = watching(FEW)
    for sample in stream(39.0, 3, motor=2, late_s=18.0):
        answer = found.update(*sample)
    assert answer.alarm.state == RAISED
    assert answer.alarm.cause.startswith("motor_3")
    assert answer.diagnosis.undecided.startswith("motor 3 late explains it better")


def test_an_error_that_comes_is_named():
    answer, raised = watch(stream(52.0, 7, off_s=26.0), FEW)
    assert 26.0 < raised < 50.5
    assert answer.diagnosis.diagnosis == OFF
    assert answer.diagnosis.magnitude == pytest.approx(0.1, abs=0.04)


def test_an_error_from_the_beginning_may_be_the_log():
    """A zero that is off looks like it: no motor is blamed."""
    few = [HEALTHY, OFF, "motor_2:stuck", "motor_3:steady_state_error"]
    answer, raised = watch(stream(40.0, 7, off_s=0.0, off_rad=0.15), few)
    assert raised is None
    assert answer.alarm.state == CLEAR


def stop_and_go(movements, seed, stuck_s, unseen_s):
    """Yield time, command and reading of ramps of 1 s, each with a rest of 1 s behind it.

    Motor 3 sticks from `stuck_s` on. Between the times of `unseen_s` the sensor fails behind the
    first 0.4 s of each ramp, and movements begin 0.6 s after their commands.
    """
    rng, twin = np.random.default_rng(seed), DigitalTwin(ROBOT)
    goals = rng.uniform(-0.7, 0.7, (movements + 2, 4))
    corners = np.r_[0.0, np.repeat(2.0 * np.arange(1, movements + 2), 2)]
    corners[2::2] += 1.0
    told = PchipInterpolator(corners[:-1], np.repeat(goals[: movements + 1], 2, axis=0))
    for k in range(round(2.0 * movements / STEP_S)):
        time = k * STEP_S
        fails = unseen_s[0] <= time < unseen_s[1]
        seen = told(time - (0.6 if fails else LAG_S))
        seen[2] = told(min(time, stuck_s))[2]
        point = twin.path(seen) + rng.normal(scale=NOISE_M, size=3)
        yield time, told(time), None if k % 2 or (fails and time % 2.0 > 0.4) else point


def test_an_arm_that_rests_unseen_is_not_judged_on_its_way():
    """Its fault, and since when it has it, stand."""
    found = watching(FEW)
    for sample in stop_and_go(20, 1, 8.2, (26.0, 36.0)):
        answer = found.update(*sample)
        if sample[0] > 16.0:
            assert answer.diagnosis.diagnosis == "motor_3:stuck"
            assert answer.diagnosis.onset_s == pytest.approx(8.2, abs=1.0)
            assert "settled poses" in answer.diagnosis.method
