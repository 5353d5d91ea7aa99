"""What acts on one arm, put together: planner, belief, judge and gate; its alarms.

An alarm names the believed fault once a diagnosis of the latest movements is sure of it, by the
rule of `failuretwin.data_knowledge.records.episodes`. It holds until the belief is dropped: the
reaction to a fault removes the evidence for it, so a less sure diagnosis later is no repair.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, replace
from functools import cached_property
from pathlib import Path

from failuretwin.connection.links.base import Commander
from failuretwin.connection.tracked_diagnosis import read_rows
from failuretwin.core.errors import unknown_name
from failuretwin.core.hypothesis import Diagnosis, Fault
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.records.episodes import RAISED, NamedFault, named_faults
from failuretwin.decision.acting.actor import Actor
from failuretwin.decision.acting.belief import Belief, Judge, Judgement
from failuretwin.decision.acting.believed_arm import BelievedArm
from failuretwin.decision.acting.planner import Plan, Planner, Standing, wear_weights
from failuretwin.decision.acting.safety import SafetyGate, SafetyLimits
from failuretwin.decision.acting.task import ActingSettings, TargetResult, Task
from failuretwin.decision.acting.work import Work, first_standing, would_order
from failuretwin.decision.streaming.set_up_watch import PROOF
from failuretwin.digital_model.calibrated_robot import (
    CalibratedRobot,
    HealthyLike,
    RobotLike,
    calibrated,
)
from failuretwin.inference.observation.healthy_model import HealthyModel

DIAGNOSE, FEEDBACK, OPEN = STRATEGIES = ("diagnose", "feedback", "open")
"""With a diagnosis, with the nominal Jacobian alone, or one movement a target."""


@dataclass(frozen=True)
class AlarmChange:
    """A change of the alarm.

    Attributes:
        text: A sentence.
        diagnosis: The diagnosis of the latest movements behind it.
        fault: The fault that the alarm names; None: it is clear.
        final: Whether the diagnosis counts as that of a whole run.
    """

    text: str
    diagnosis: Diagnosis
    fault: NamedFault | None
    final: bool = False


class FaultAlarm:
    """Follows the belief of an arm at work.

    Calls `report` with each change of the alarm.
    """

    def __init__(self, report: Callable[[AlarmChange], None]) -> None:
        self._report = report
        self._named: NamedFault | None = None
        self._last: Judgement | None = None
        self._free = 0

    def see(self, belief: Belief, judgement: Judgement | None) -> None:
        """Take the belief after a movement, and the judgement of it; None: there is none."""
        if judgement is None:
            return
        self._last = judgement
        believed = belief.believed
        self._free = self._free + 1 if believed is None else 0
        before = self._named
        if believed is None and before is None:
            return
        found = judgement.diagnosis(belief.since_s)
        self._named = now = None if believed is None else _named(believed.fault, found, before)
        if now is not None and now != before:
            self._report(AlarmChange(f"ALARM: {found.verdict}", found, now))
        elif now is None and before is not None:
            text = f"CLEARED: {before.motor}:{before.mode} is over"
            self._report(AlarmChange(text, found, None))

    def end(self) -> None:
        """Report the last diagnosis if it counts as that of a run.

        It does after more than `PROOF` movements without a believed fault.
        """
        if self._last is None or self._free <= PROOF:
            return
        found = self._last.diagnosis()
        self._report(AlarmChange(f"ends: {found.verdict}", found, None, final=True))


def _named(fault: Fault, found: Diagnosis, before: NamedFault | None) -> NamedFault | None:
    """Return the fault to name: the believed one if a diagnosis is sure of it, or as before."""
    own = before if before is not None and before.motor == fault.motor else None
    if own is not None and own.mode == fault.mode and own.state == RAISED:
        return own
    named = named_faults(found)
    return next((one for one in named if (one.motor, one.mode) == astuple(fault)), own)


@dataclass(frozen=True)
class Acting:
    """What acts: planner, belief and judge of one arm.

    Attributes:
        known: The arm.
        gate: What is safe.
        strategy: One of `STRATEGIES`.
        settings: How the task is carried out.
        spared: Weight of each worn motor, (motor,); None: all are sound.
        seed: Seed of the poses that are tried.
    """

    known: CalibratedRobot
    gate: SafetyGate
    strategy: str
    settings: ActingSettings
    spared: FloatArray | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if self.strategy not in STRATEGIES:
            raise unknown_name("strategy", self.strategy, STRATEGIES)

    @cached_property
    def model(self) -> HealthyModel:
        """The healthy arm."""
        return HealthyModel.of(self.known.twin, self.known.imperfections)

    @property
    def planner(self) -> Planner:
        """What plans."""
        return Planner(self.gate, self.spared, self.seed)

    def actor(self, task: Task, standing: FloatArray, tell: Callable[[str], None]) -> Actor:
        """Return what carries out a task on an arm that stands somewhere, (motor,) [rad]."""
        model = self.model
        judge = Judge(model) if self.strategy == DIAGNOSE else None
        settings = replace(self.settings, feedback=self.strategy != OPEN)
        return Actor(self.planner, model, task, Belief(model), standing, settings, judge, tell)

    def work(
        self,
        task: Task,
        commander: Commander,
        tell: Callable[[str], None],
        report: Callable[[AlarmChange | TargetResult], None] = lambda happened: None,
    ) -> Sequence[TargetResult]:
        """Carry a task out on an arm and return what became of each target.

        `report` is called with each change of the alarm, and with what became of each target.
        """
        standing = first_standing(commander)
        actor, alarm = self.actor(task, standing, tell), FaultAlarm(report)
        work = Work(actor, self.gate, commander, standing)
        reported = list[TargetResult]()

        def seen() -> None:
            alarm.see(actor.belief, actor.judgement)
            report_results()

        def report_results() -> None:
            for result in actor.results[len(reported) :]:
                reported.append(result)
                report(result)

        work.seen = seen
        work.carry_out()
        report_results()
        alarm.end()
        for line in self.planner.sparing_lines(actor.ways):
            tell(line)
        return actor.results

    def dry_run(
        self, task: Task, standing: FloatArray, tell: Callable[[str], None]
    ) -> Sequence[TargetResult]:
        """Tell what would be ordered if every target were reached at once; nothing is sent."""
        arm, planner = BelievedArm(self.model), self.planner
        results, command = [], standing
        for number, target in enumerate(task.targets, start=1):
            pose = arm.settle(command, command, 0.0)
            plan = planner.plan(target, arm, Standing(pose, command, 0.0))
            results.append(
                TargetResult(
                    target, False, math.nan, math.nan, math.nan, 0, plan.reachable, "", "dry run"
                )
            )
            tell(f"target {number}: {_planned(plan)}")
            if plan.order is not None and plan.reachable:
                command = plan.order.target
        return results


def _planned(plan: Plan) -> str:
    if plan.order is None:
        return f"no safe way: {plan.why}"
    if not plan.reachable:
        return f"out of reach by {plan.misses}"
    return would_order(plan.order)


def act(
    task: Task,
    commander: Commander,
    robot: RobotLike = "armpi_fpv",
    calibration: HealthyLike = None,
    strategy: str = DIAGNOSE,
    limits: SafetyLimits | None = None,
    history: str | Path | None = None,
    tell: Callable[[str], None] = print,
) -> Sequence[TargetResult]:
    """Carry a task out on an arm, whatever is wrong with it; the arm moves.

    Args:
        task: Where the tool shall go.
        commander: The arm.
        robot: The robot, its name or its profile.
        calibration: What `calibrate` learned of it, by name or path; None: what its profile names.
        strategy: ``diagnose``, ``feedback`` or ``open``.
        limits: What orders must keep to; None: the usual limits.
        history: CAL.history.jsonl that `diagnose --track` keeps: motors are spared by how worn they
            are; None: none is.
        tell: Called with what is found out and done, as it happens.

    Returns:
        What became of each target.

    Raises:
        InputError: If something cannot be read, or it is not known where the arm stands.
        Halted: If somebody else commands the arm, or it falls silent.
        UnsafeOrderError: If an order must not be sent.
    """
    known = calibrated(robot, calibration)
    gate = SafetyGate(known.robot, limits or SafetyLimits())
    acting = Acting(known, gate, strategy, ActingSettings())
    if history is not None:
        rows = read_rows(Path(history), known.robot.name)
        acting = replace(acting, spared=wear_weights(rows, acting.model))
    return acting.work(task, commander, tell)
