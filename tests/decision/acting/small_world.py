"""An arm at rest only: where it settles after each order, faults and losses included."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from failuretwin.core.hypothesis import Fault
from failuretwin.decision.acting.actor import Actor
from failuretwin.decision.acting.belief import Belief, Judge
from failuretwin.decision.acting.believed_arm import BelievedArm, BelievedFault
from failuretwin.decision.acting.planner import Planner
from failuretwin.decision.acting.safety import SafetyGate
from failuretwin.decision.acting.task import ActingSettings, Target, Task
from failuretwin.digital_model.inverse_kinematics import InverseKinematics

PERIOD_S = 1.5


def believed(robot, motor, mode, size=np.nan, angle=np.nan, spread=0.01):
    fault = Fault(robot.motor_names[motor], mode)
    return BelievedFault(fault, motor, size, spread, 0.0, angle)


def task_of(robot, count, seed=0, tolerance_m=0.005):
    low, high = np.array([motor.movement_range for motor in robot.motors]).T
    pose = np.random.default_rng(seed).uniform(low, high, (count, len(low)))
    return Task.of_points(InverseKinematics.of(robot).tool(pose)[0], tolerance_m)


def task_with_directions(robot, count, seed=0):
    """Points and directions of poses that the arm can take."""
    low, high = np.array([motor.movement_range for motor in robot.motors]).T
    pose = np.random.default_rng(seed).uniform(low, high, (count, len(low)))
    kinematics = InverseKinematics.of(robot)
    where, along = kinematics.tool(pose)[0], kinematics.axis(pose)
    return Task(tuple(Target(tuple(w), tuple(a)) for w, a in zip(where, along, strict=True)))


@dataclass
class SmallWorld:
    """One arm, told where to go; `truth` may be exchanged at any time."""

    model: object
    seed: int = 0
    truth: BelievedFault | None = None
    lost: set = field(default_factory=set)
    losers: object = ...
    orders: list = field(default_factory=list)

    def __post_init__(self):
        self.rng = np.random.default_rng(self.seed)
        robot = self.model.twin.robot
        self.command = np.array([np.clip(0.0, *motor.movement_range) for motor in robot.motors])
        self.time_s = 0.0
        self.error = 0.0

    def move(self, order):
        self.orders.append((self.command, order))
        previous, target = self.command, order.target.copy()
        if len(self.orders) in self.lost:
            target[self.losers] = previous[self.losers]
        arm = BelievedArm(self.model, self.truth)
        pose = arm.settle(target, previous, self.time_s)
        scatter = np.asarray(self.model.settling.scatter) * self.rng.standard_normal(len(pose))
        pose = pose + np.where(arm.locked | (target == previous), 0.0, scatter)
        truth = self.truth
        if truth is not None and truth.fault.mode == "steady_state_error":
            if target[truth.motor] != previous[truth.motor]:
                sign = 1.0 if self.rng.random() < 0.5 else -1.0
                self.error = sign * self.rng.uniform(0.05, 0.2)
            pose[truth.motor] += self.error
        if truth is not None and truth.fault.mode == "intermittent" and self.rng.random() < 0.35:
            k = truth.motor  # it is held on its way, and goes on with the next movement
            pose[k] = previous[k] + self.rng.random() * (target[k] - previous[k])
        self.command, self.pose = target, pose
        self.time_s += PERIOD_S
        return self.model.twin.path(pose)


def carry_out(world, belief, task, settings=None, steps=200, each=None, spared=None, judged=True):
    """Return the actor after the task; a belief of None: the arm is taken for healthy.

    `each` is called with the number of every movement; with `judged` the belief learns.
    """
    model, robot = world.model, world.model.twin.robot
    planner, settings = Planner(SafetyGate(robot), spared), settings or ActingSettings()
    judge = Judge(model) if judged and belief is not None else None
    belief = belief or Belief(model)
    said = []
    actor = Actor(planner, model, task, belief, world.command, settings, judge, said.append)
    actor.said = said
    for number in range(steps):
        order = actor.next()
        if order is None:
            break
        if each is not None:
            each(number)
        start = world.time_s
        point = world.move(order)
        actor.see(point, start, world.time_s)
    return actor
