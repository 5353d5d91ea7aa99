"""The alarm of an arm at work, against the faults that the arm has."""

from __future__ import annotations

import pytest
from small_world import SmallWorld, believed, task_of

from failuretwin.core.hypothesis import SURE, motor_probabilities
from failuretwin.decision.acting.actor import Actor
from failuretwin.decision.acting.belief import Belief, Judge
from failuretwin.decision.acting.planner import Planner
from failuretwin.decision.acting.safety import SafetyGate
from failuretwin.decision.acting.session import FaultAlarm
from failuretwin.decision.streaming.set_up_watch import PROOF
from failuretwin.inference.observation.healthy_model import HealthyModel


@pytest.fixture(scope="module")
def model(twin, measured_armpi):
    return HealthyModel.of(twin, measured_armpi)


def changes_of(model, count, truth=None, repaired_at=None):
    """Return the changes of the alarm of an arm with a fault that is repaired some time."""
    robot, world = model.twin.robot, SmallWorld(model, truth=truth)
    task = task_of(robot, count)
    judge = Judge(model)
    actor = Actor(
        Planner(SafetyGate(robot)), model, task, Belief(model), world.command, judge=judge
    )
    found = []
    alarm = FaultAlarm(found.append)
    number = 0
    while (order := actor.next()) is not None:
        number += 1
        if number == repaired_at:
            world.truth = None
        start = world.time_s
        actor.see(world.move(order), start, world.time_s)
        alarm.see(actor.belief, actor.judgement)
    alarm.end()
    return found


def test_a_stuck_motor_raises_an_alarm_and_its_repair_clears_it(model):
    truth = believed(model.twin.robot, 2, "stuck", size=-0.4, angle=-0.4)
    found = changes_of(model, 14, truth, repaired_at=9)
    *raised, cleared = found
    assert raised
    for change in raised:
        assert (change.fault.motor, change.fault.mode) == ("motor_3", "stuck")
        assert motor_probabilities(change.diagnosis.posterior)["motor_3"] >= SURE
        assert change.text.startswith("ALARM: motor 3 stuck at -2")
    assert raised[-1].fault.state == "raised"
    assert (cleared.fault, cleared.text) == (None, "CLEARED: motor_3:stuck is over")
    assert not any(change.final for change in found)


def test_a_healthy_arm_raises_none_and_counts_as_healthy_after_enough_movements(model):
    (last,) = changes_of(model, PROOF + 1)
    assert (last.final, last.fault) == (True, None)
    assert last.diagnosis.state == "healthy"
    assert changes_of(model, 3) == []
