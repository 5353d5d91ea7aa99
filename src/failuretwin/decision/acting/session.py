"""What acts on one arm, put together: planner, belief, judge and gate."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from failuretwin.connection.links.base import Commander
from failuretwin.connection.tracked_diagnosis import read_rows
from failuretwin.core.errors import unknown_name
from failuretwin.core.types import FloatArray
from failuretwin.decision.acting.actor import Actor
from failuretwin.decision.acting.alarm import AlarmChange, FaultAlarm
from failuretwin.decision.acting.belief import Belief, Judge
from failuretwin.decision.acting.believed_arm import BelievedArm
from failuretwin.decision.acting.planner import Plan, Planner, Standing, wear_weights
from failuretwin.decision.acting.safety import SafetyGate, SafetyLimits
from failuretwin.decision.acting.task import ActingSettings, TargetResult, Task
from failuretwin.decision.acting.work import Work, first_standing, would_order
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
        report: Callable[[AlarmChange], None] = lambda change: None,
    ) -> Sequence[TargetResult]:
        """Carry a task out on an arm and return what became of each target.

        Args:
            task: The task.
            commander: The arm.
            tell: Called with what is found out and done, as it happens.
            report: Called with each change of the alarm.
        """
        standing = first_standing(commander)
        actor, alarm = self.actor(task, standing, tell), FaultAlarm(report)
        work = Work(actor, self.gate, commander, standing)
        work.seen = lambda: alarm.see(actor.belief, actor.judgement)
        work.carry_out()
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
