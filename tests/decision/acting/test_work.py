"""A task through a commander: rest by readings, the gate, the dead man, somebody else's command."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
import pytest
from small_world import task_of

from failuretwin import Fault
from failuretwin.connection.emulated_arm import EmulatedArm, Emulation
from failuretwin.connection.links.base import CommandSent, LinkCounts, Order, Reading
from failuretwin.core.errors import InputError
from failuretwin.decision.acting import work as work_module
from failuretwin.decision.acting.actor import Actor
from failuretwin.decision.acting.belief import Belief, Judge
from failuretwin.decision.acting.planner import Planner
from failuretwin.decision.acting.safety import SafetyGate, UnsafeOrderError
from failuretwin.decision.acting.task import Target, Task, read_task
from failuretwin.decision.acting.work import (
    Halted,
    RestWatch,
    Work,
    first_standing,
)
from failuretwin.failure_behavior.injection import ScheduledFault


def work_of(model, commander, task, judge=None, gate=None):
    gate = gate or SafetyGate(model.twin.robot)
    standing, said = first_standing(commander), []
    actor = Actor(
        Planner(gate), model, task, Belief(model), standing, judge=judge, tell=said.append
    )
    return Work(actor, gate, commander, standing), said


class Fake:
    """An arm that jumps to what it is told 0.1 s later, read ten times a second."""

    name, ended, counts = "fake", False, LinkCounts()

    def __init__(self, model, events=()):
        self.twin = model.twin
        self.now, self.sent = 0.0, []
        self.standing = np.zeros(4)
        self.extra = deque(events)
        self.silent = False

    def poll(self, timeout_s):
        if self.silent:
            return None
        self.now += 0.1
        if self.extra and self.extra[0].time <= self.now:
            return self.extra.popleft()
        return Reading(self.now, self.twin.path(self.standing), self.standing)

    def send(self, order):
        self.sent.append(order)
        self.standing = order.target

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass


@pytest.fixture
def exact(model):
    from failuretwin.digital_model.nonidealities import NO_IMPERFECTIONS

    return replace(model, imperfections=NO_IMPERFECTIONS)


def test_a_task_is_carried_out(exact, armpi):
    arm = Fake(exact)
    work, _ = work_of(exact, arm, task_of(armpi, 4))
    work.carry_out()
    assert [result.reached for result in work.actor.results] == [True] * 4
    assert len(arm.sent) == 4


def test_the_first_movement_is_seen_of_an_arm_whose_clock_began_long_ago(exact, armpi):
    arm, heard = Fake(exact), []
    arm.now = 1.7e9
    work, _ = work_of(exact, arm, task_of(armpi, 4))
    work.hear = heard.append
    work.carry_out()
    assert [result.movements for result in work.actor.results] == [1] * 4
    assert all(isinstance(event, Reading) for event in heard)
    assert len(heard) > 20


def test_somebody_elses_command_ends_the_work(exact, armpi):
    foreign = CommandSent(2.0, np.full(4, 0.3), np.ones(4))
    arm = Fake(exact, [foreign])
    work, _ = work_of(exact, arm, task_of(armpi, 6))
    with pytest.raises(Halted, match="somebody else"):
        work.carry_out()
    assert len(arm.sent) < 6


def test_an_arm_that_falls_silent_gets_no_order(monkeypatch, exact, armpi):
    monkeypatch.setattr(work_module, "SILENCE_S", 0.05)
    arm = Fake(exact)
    work, _ = work_of(exact, arm, task_of(armpi, 3))
    arm.silent = True
    with pytest.raises(Halted, match="says nothing"):
        work.carry_out()
    assert arm.sent == []


def test_what_the_gate_refuses_is_not_sent(exact, armpi):
    class Narrow(SafetyGate):
        def wrong(self, order, ways):
            return "it is Sunday" if len(ways) == 1 else ""

    arm = Fake(exact)
    work, _ = work_of(exact, arm, task_of(armpi, 3), gate=Narrow(armpi))
    with pytest.raises(UnsafeOrderError, match="Sunday"):
        work.carry_out()
    assert arm.sent == []


def test_rest_is_seen_by_readings_not_by_a_clock(model):
    twin = model.twin
    before, after = (twin.path(np.array(pose)) for pose in ([0.0] * 4, [0.5, 0.3, 0.0, 0.0]))
    late = 1.2
    watch = RestWatch(model, 0.0, 0.5, before, float(np.linalg.norm(after - before)))
    seen = None
    for k in range(1, 80):
        time = 0.1 * k
        share = np.clip((time - late) / 0.5, 0.0, 1.0)
        found = watch.take(Reading(time, before + share * (after - before)))
        if found is not None:
            seen = time, found
            break
    assert seen is not None
    assert seen[0] > late + 0.5
    np.testing.assert_allclose(seen[1], after, atol=1e-3)


def test_a_tool_that_never_rests_is_not_seen(model):
    watch = RestWatch(model, 0.0, 0.5, None, 0.1)
    rng = np.random.default_rng(0)
    point = model.twin.path(np.zeros(4))
    found = [watch.take(Reading(0.1 * k, point + 0.02 * rng.normal(size=3))) for k in range(60)]
    assert found == [None] * 60


def test_an_emulated_arm_with_a_stuck_motor(model, armpi):
    pytest.importorskip("mujoco")
    schedule = (ScheduledFault(Fault("motor_3", "stuck"), 6.0),)
    arm = EmulatedArm(Emulation(armpi, model.imperfections, schedule, 2))
    work, said = work_of(model, arm, task_of(armpi, 7, 5), Judge(model))
    work.carry_out()
    assert str(work.actor.belief.believed.fault) == "motor_3:stuck"
    assert sum(result.reached for result in work.actor.results) >= 5
    assert any("plan with the motor held" in text for text in said)


def test_where_an_arm_stands(exact):
    arm = Fake(exact)
    np.testing.assert_array_equal(first_standing(arm), np.zeros(4))


# Tasks from files.


def test_a_task_from_csv(tmp_path):
    path = tmp_path / "task.csv"
    path.write_text("x, y, z, dx, dy, dz, tolerance\n0.1, 0, 0.2, , , , \n0,0.1,0.2,0,0,-2,0.01\n")
    task = read_task(path)
    assert task.targets[0] == Target((0.1, 0.0, 0.2))
    assert task.targets[1].tolerance_m == 0.01
    np.testing.assert_array_equal(task.targets[1].axis, [0.0, 0.0, -1.0])
    assert task.name == "task"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("x,y\n1,2\n", "lacks column z"),
        ("x,y,z\n", "holds no target"),
        ("x,y,z\n1,2,three\n", "line 2: z is 'three'"),
        ("x,y,z,dx,dy,dz\n1,2,3,1,,\n", "a direction needs"),
        ("x,y,z,tolerance\n1,2,3,-1\n", "expected a distance"),
        ("x,y,z,dx,dy,dz\n1,2,3,0,0,0\n", "direction is 0, 0, 0"),
        ("x,y,z\n1,2,nan\n", "not finite"),
    ],
)
def test_a_task_that_makes_no_sense_is_refused(tmp_path, text, said):
    path = tmp_path / "task.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=said):
        read_task(path)


def test_a_task_needs_a_target():
    with pytest.raises(InputError, match="one target"):
        Task(())


def test_an_order_holds_target_and_time():
    order = Order(np.zeros(4), np.ones(4))
    assert order.duration.max() == 1.0
