"""Goals that motors report: a lost command is known, and a stuck motor shows at once."""

from __future__ import annotations

import numpy as np
import pytest

from failuretwin import BayesDiagnoser
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import CLEAR, RAISED
from failuretwin.core.runs import run_set
from failuretwin.decision.streaming.fleet import StreamingFleet
from failuretwin.decision.streaming.monitor import FaultMonitor, monitor

MOTOR = 0
"""The motor of the ArmPi FPV that loses one command in twenty."""
FEW = ["healthy", "motor_1:stuck", "motor_1:steady_state_error", "motor_2:stuck"]


def watching(twin, sensing):
    """Return a watch for a few faults, by some sensors."""
    return FaultMonitor(BayesDiagnoser(twin, hypotheses=FEW, whole_run=False, sensing=sensing))


@pytest.fixture
def reported(work, twin, rng):
    """Samples of a calibrated arm with the goal that each motor has received.

    From a movement on motor 1 stays where it was; `lost` says whether its goals came at all.
    """

    def samples(movements, stays_from=99, lost=False):
        found, stood, goal = [], None, np.zeros(4)
        for t, reference, _ in work(movements):
            angle = reference.copy()
            if t > 0.3 + 2.04 * stays_from:
                stood = angle[MOTOR] if stood is None else stood
                angle[MOTOR] = stood
            goal = reference.copy()
            if lost and stood is not None:
                goal[MOTOR] = stood
            found.append((t, reference, twin.path(angle) + rng.normal(0.0, 3e-4, 3), None, goal))
        return found

    return samples


def test_a_healthy_arm_raises_nothing(twin, reported):
    watch = monitor(twin, sensing="tool+goals")
    told = [watch.update(*sample) for sample in reported(9)]
    assert {answer.alarm.state for answer in told} == {CLEAR}


def test_a_stuck_motor_that_received_its_goal_is_named_within_a_movement(twin, reported):
    """From the tool alone it may as well have lost its commands."""
    samples, raised = reported(13, stays_from=4), {}
    for sensing in ("tool", "tool+goals"):
        watch = watching(twin, sensing)
        told = (watch.update(*sample) for sample in samples)
        at = next(answer for answer in told if answer.alarm.state == RAISED)
        assert at.alarm.cause == "motor_1:stuck"
        raised[sensing] = (at.time - 0.5 - 2.04 * 6) / 2.04
    assert raised["tool+goals"] < 1.0
    assert raised["tool"] > 3.0


def test_a_motor_whose_goals_do_not_come_is_not_stuck(twin, reported):
    samples, states = reported(12, stays_from=4, lost=True), {}
    for sensing in ("tool", "tool+goals"):
        watch = watching(twin, sensing)
        told = [watch.update(*sample) for sample in samples]
        states[sensing] = {answer.alarm.state for answer in told}
    assert RAISED in states["tool"]
    assert RAISED not in states["tool+goals"]
    assert "motor 1 reports that its commands do not arrive" in told[-1].diagnosis.undecided


def test_a_stream_says_what_the_batch_says(twin, reported):
    samples = reported(5, stays_from=2)
    time, command, point, _, goal = zip(*samples, strict=True)
    fleet = StreamingFleet(BayesDiagnoser(twin, whole_run=False, sensing="tool+goals"), 1)
    for t, c, p, g in zip(time, command, point, goal, strict=True):
        fleet.update(t, c[None], p[None], None, g[None])
    fleet.conclude()
    runs = run_set(
        np.array(time), np.array(command), np.array(point), sensors={"goal": np.array(goal)}
    )
    found = {}
    for sensing in ("tool", "tool+goals"):
        diagnoser = BayesDiagnoser(twin, whole_run=False, sensing=sensing)
        found[sensing] = diagnoser.diagnose(runs)[0].posterior
    streamed = dict(zip(fleet.hypotheses, fleet.posterior[0], strict=True))
    assert streamed == pytest.approx(found["tool+goals"], abs=1e-6)
    stuck = "motor_1:stuck"
    assert 1.0 - found["tool+goals"][stuck] < 0.1 * (1.0 - found["tool"][stuck])


def test_goals_alone_tell_nothing_of_where_an_arm_rests(twin):
    with pytest.raises(InputError, match="Add tool"):
        monitor(twin, sensing="goals")
