"""A stream that does not fit the profile blames no motor; a fault in one that does is one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from failuretwin import BayesDiagnoser
from failuretwin.connection.links.base import OK
from failuretwin.core.hypothesis import CLEAR, RAISED, Alarm, Episode
from failuretwin.core.runs import concatenate, run_set
from failuretwin.decision.streaming.monitor import FaultMonitor
from failuretwin.decision.streaming.set_up_watch import RUN, SetUpWatch, StreamRuns
from failuretwin.inference.seen_runs import set_up_finding
from failuretwin.inference.set_ups.log_correction import LogCorrection
from failuretwin.inference.set_ups.set_ups import mistakes

NONE = LogCorrection.none(4)
I4 = np.eye(4)
ERRORS = ["healthy", "motor_3:steady_state_error"]
"""What looks like a zero that is off; with motors that may be stuck it takes twice as long."""
FAULTS = ["healthy", "motor_2:stuck", "motor_3:steady_state_error"]
"""Some of what a mistake may look like."""


def watching(twin, hypotheses=FAULTS):
    """Return a watch for a few faults."""
    return FaultMonitor(BayesDiagnoser(twin, hypotheses=hypotheses, whole_run=False), 1.0)


def made(robot, words):
    """Return what makes a log with a mistake of one that fits."""
    return next(one.correction.inverse for one in mistakes(robot) if words in one.what)


def answers(watch, samples, wrong=NONE):
    return [watch.update(t, wrong.command(c), wrong.point(p)) for t, c, p in samples]


def blamed(told):
    return {answer.alarm.cause for answer in told if answer.alarm.state == RAISED}


def check_named(twin, watch, samples, wrong, words):
    """Check that a mistake is named and no motor blamed; return what was said."""
    told = answers(watch, samples, made(twin.robot, wrong))
    assert blamed(told) == set()
    last = told[-1].diagnosis
    assert last.undecided.startswith("the log does not fit the profile")
    assert words in last.undecided
    assert words in watch.set_up
    assert last.run == "stream"
    return told


@pytest.mark.parametrize(
    ("wrong", "words", "movements"),
    [
        ("motor 2 turns", "motor 2 turns the other way", 5),
        ("degrees", "commands look like degrees", 11),
    ],
)
def test_a_mistake_is_named_and_no_motor_blamed(twin, work, wrong, words, movements):
    check_named(twin, watching(twin), work(movements), wrong, words)


def test_movements_that_fit_nothing_are_not_healthy(twin, work):
    """Faults are rarer than odd movements of an arm that nobody has seen at work yet."""
    words = "the commands of motor 3 and motor 4 are swapped"
    watch = watching(twin, [*FAULTS, "motor_2:steady_state_error"])
    told = check_named(twin, watch, work(11), "motor 3 and motor 4", words)
    shown = [a.diagnosis for a in told if a.diagnosis is not None and a.time > 5.8]
    assert shown[0].undecided.startswith("the first movements do not end where")
    assert all(d.undecided or d.posterior["healthy"] < 0.95 for d in shown)


def test_a_tool_that_is_rounded_is_noisier_and_no_fault(twin, work):
    watch, step_m = watching(twin), 0.01
    before = watch.believed.model.path_noise
    coarse = [(t, c, np.round(p / step_m) * step_m) for t, c, p in work(12)]
    told = answers(watch, coarse)
    assert blamed(told) == set()
    assert not [a for a in told if a.diagnosis is not None and "stands still" in str(a.diagnosis)]
    (line,) = watch.rounding
    assert "rounded to 10 mm" in line
    after = watch.believed.model.path_noise
    assert after == pytest.approx(np.hypot(before, step_m / np.sqrt(12.0)))


def test_a_tool_that_is_not_rounded_is_not_said_to_be(twin, work):
    watch = watching(twin)
    answers(watch, work(6))
    assert watch.rounding == ()


@pytest.mark.parametrize("noise_m", [0.0, 1e-3])
def test_an_arm_that_obeys_nothing_is_not_healthy(twin, work, rng, noise_m):
    """Also where the sensor's noise hides that it stands still."""
    samples = work(11)
    still = [(t, c, samples[0][2] + rng.normal(0.0, noise_m, 3)) for t, c, _ in samples]
    watch = watching(twin)
    told = answers(watch, still)
    known = [a.diagnosis for a in told if a.diagnosis is not None]
    assert known
    assert all(d.undecided for d in known)
    assert "stands still" in known[-1].undecided
    assert {a.state for a in told if a.time > 1.0} == {OK}  # there are readings
    assert watch.set_up is None


@pytest.mark.parametrize(
    ("wrong", "words", "movements"),
    [
        (replace(NONE, z=np.deg2rad(6.0) * I4[2]), "motor 3 stands -6", 6),
        (replace(NONE, t=np.array([0.0, 0.0, 0.02])), "does not seem to stand where", 11),
    ],
)
def test_zeros_and_frames_are_no_faults(twin, work, wrong, words, movements):
    watch = watching(twin, ERRORS)
    told = answers(watch, work(movements), wrong)
    assert blamed(told) == set()
    assert words in told[-1].diagnosis.undecided


def test_a_motor_that_sticks_from_the_first_movement_on_is_blamed(twin, work):
    watch = watching(twin, FAULTS[:2])
    told = answers(watch, work(11, stuck=[(1, 0, 11)]))
    assert blamed(told) == {"motor_2:stuck"}
    assert watch.set_up == ""


def test_a_robot_that_fits_is_said_to(twin, work):
    watch = watching(twin)
    samples = work(11)
    told = answers(watch, samples[:100])
    assert watch.set_up is None
    told = answers(watch, samples[100:])
    assert (watch.set_up, watch.fit.seen, told[-1].alarm.state) == ("", 11, CLEAR)


def test_a_stream_is_asked_as_a_log_is(twin, work, armpi):
    """Cut by hand into the same runs, the log has the same finding."""
    wrong, step = made(armpi, "motor 2 turns"), 0.1
    samples = [(t, wrong.command(c), wrong.point(p)) for t, c, p in work(2 * RUN)]
    runs = StreamRuns()
    for sample in samples:
        runs.add(*sample)
    found = runs.runs(armpi)
    assert (found.sizes["run"], runs.begun) == (2, 2 * RUN)
    time, command, point = (np.array(column) for column in zip(*samples, strict=True))
    turns = np.flatnonzero(np.any(np.diff(command, axis=0), axis=1))
    begins = turns[np.diff(turns, prepend=-9) > 1]
    cut = begins[RUN]
    parts = [
        run_set(step * np.arange(len(time[rows])), command[rows], point[rows])
        for rows in (slice(0, cut + 1), slice(cut, None))
    ]
    by_hand = concatenate(parts)
    diagnoser = BayesDiagnoser(twin, hypotheses=["healthy"], whole_run=False)
    said = [set_up_finding(diagnoser.seen(one).set_ups()) for one in (found, by_hand)]
    assert said[0] == said[1]
    assert "motor 2 turns the other way" in said[0]


def test_an_alarm_that_changes_its_motor_is_none(twin):
    watch = SetUpWatch(BayesDiagnoser(twin))
    causes = ["motor_1:stuck", "motor_3:stuck", "motor_2:stuck"]
    alarms = [Alarm(RAISED, c, Episode(k + 1, c, 9.0 * k)) for k, c in enumerate(causes)]
    assert [watch.against(alarm) for alarm in alarms[:2]] == ["", ""]
    assert "changes (motor 1 and motor 3 and motor 2)" in watch.against(alarms[2])
    assert watch.against(Alarm()) == ""
    assert watch.against(alarms[0]) == ""


def test_an_error_is_not_blamed_on_the_first_movements(twin):
    """A zero that is off looks like it; a motor that sticks looks like no set-up."""
    watch = SetUpWatch(BayesDiagnoser(twin))
    for cause, said in (("motor_1:steady_state_error", True), ("motor_1:stuck", False)):
        alarm = Alarm(RAISED, cause, Episode(1, cause, 3.0))
        assert ("a few movements more tell" in watch.against(alarm)) == said


@pytest.mark.parametrize("fitted", [True, False])
def test_motors_that_are_blamed_in_turn_are_named_once(twin, fitted):
    """Where the log has fitted the profile, it is not the profile that is doubted."""
    watch = SetUpWatch(BayesDiagnoser(twin))
    watch._fitted, watch._runs.begun = fitted, 50
    told = [
        watch.against(Alarm(RAISED, cause, Episode(number, cause, 10.0 * number)))
        for number, cause in enumerate(3 * ["motor_1:stuck", "motor_3:stuck"], 1)
    ]
    assert told[:2] == ["", ""]
    assert len(set(told[2:])) == 1
    assert "motor 1 and motor 3" in told[-1]
    assert ("in turn: two faults" in told[-1]) == fitted
    assert ("the log does not fit" in told[-1]) != fitted
