"""Motors that report themselves: believed beside the tool, in a stream as in a recorded run."""

from __future__ import annotations

import numpy as np
import pytest

from failuretwin import BayesDiagnoser
from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import CLEAR, RAISED
from failuretwin.core.runs import run_set
from failuretwin.decision.streaming.diagnoser import StreamingDiagnoser
from failuretwin.decision.streaming.fleet import StreamingFleet
from failuretwin.decision.streaming.monitor import FaultMonitor, monitor

OFF = np.deg2rad(3.0)
FEW = ["healthy", "motor_3:steady_state_error", "motor_4:steady_state_error"]


@pytest.fixture
def reported(work, twin, rng):
    """Samples of a calibrated arm, with what its motors report."""

    def samples(movements, error_from=99):
        found = []
        for t, reference, _ in work(movements):
            angle = reference.copy()
            if t > 0.5 + 2.04 * error_from:
                angle[3] += OFF
            point = twin.path(angle) + rng.normal(0.0, 3e-4, 3)
            found.append((t, reference, point, angle + rng.normal(0.0, 1.5e-3, 4)))
        return found

    return samples


def test_a_healthy_arm_raises_nothing(twin, reported):
    watch = monitor(twin, sensing="tool+encoders")
    told = [watch.update(*sample) for sample in reported(9)]
    assert {answer.alarm.state for answer in told} == {CLEAR}
    assert told[-1].diagnosis.diagnosis == "healthy"


def test_an_error_of_the_last_motor_shows_sooner(twin, reported):
    """The tool hardly shows motor 4; its own reading does."""
    samples, raised = reported(24, error_from=12), {}
    for sensing in ("tool", "tool+encoders"):
        diagnoser = BayesDiagnoser(twin, hypotheses=FEW, whole_run=False, sensing=sensing)
        watch = FaultMonitor(diagnoser)
        told = (watch.update(*sample) for sample in samples)
        at = next(answer for answer in told if answer.alarm.state == RAISED)
        raised[sensing] = at.time
        assert at.alarm.cause == "motor_4:steady_state_error"
    assert raised["tool+encoders"] < raised["tool"]


def test_a_stream_says_what_the_batch_says(twin, reported):
    samples = reported(4)
    time, command, point, position = (np.array(c) for c in zip(*samples, strict=True))
    diagnoser = BayesDiagnoser(twin, whole_run=False, sensing="tool+encoders")
    fleet = StreamingFleet(diagnoser, 1)
    for t, c, p, q in samples:
        fleet.update(t, c[None], p[None], q[None])
    fleet.conclude()
    runs = run_set(time, command, point, sensors={"position": position})
    batch = diagnoser.diagnose(runs)[0].posterior
    streamed = dict(zip(fleet.hypotheses, fleet.posterior[0], strict=True))
    assert streamed == pytest.approx(batch, abs=1e-6)


def test_a_reading_without_its_motors_does_not_count(twin, reported):
    diagnoser = BayesDiagnoser(twin, whole_run=False, sensing="tool+encoders")
    fleet = StreamingFleet(diagnoser, 1)
    for t, c, p, _ in reported(4):
        fleet.update(t, c[None], p[None])
    fleet.conclude()
    np.testing.assert_allclose(fleet.posterior[0], fleet.posterior[0, 0] * 0 + fleet._prior)


def test_what_a_stream_cannot_believe_is_refused(twin):
    for sensing, whole in (("accelerometer", False), ("tool+encoders", True)):
        with pytest.raises(InputError, match="whole_run=False"):
            StreamingDiagnoser(BayesDiagnoser(twin, whole_run=whole, sensing=sensing))
    fleet = StreamingFleet(BayesDiagnoser(twin, whole_run=False, sensing="tool+encoders"), 2)
    with pytest.raises(InputError, match="motor readings have shape"):
        fleet.update(0.0, np.zeros((2, 4)), np.zeros((2, 3)), np.zeros((1, 4)))
