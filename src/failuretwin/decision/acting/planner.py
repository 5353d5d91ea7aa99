"""Which pose to bring a target about with, on the arm as it is believed to be.

    cost = time of the way + what worn and weak motors are spared + 1000 times what misses [s]

Poses come from many starts at once. Those in the ranges of the arm's usual movements come first,
for there it is known best; what is out of reach there is looked for within the limits of its
joints. The cheapest that has a safe way is taken.

A motor is spared by how worn it is, of what the history of `diagnose --track` keeps,

    weight_k = max over bias, sag, friction of max(0, |now - first| - 1.645 deviation) / limit

Changes are counted from the first run of the history, in scatters of the motor; what its doubts
can explain is no wear.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from failuretwin.connection.links.base import Order
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.decision.acting.believed_arm import HALF_90, BelievedArm
from failuretwin.decision.acting.safety import SafetyGate
from failuretwin.decision.acting.task import DIRECTION_TOLERANCE_RAD, Target
from failuretwin.digital_model.inverse_kinematics import STARTS, InverseKinematics, Poses
from failuretwin.digital_model.settling import largest_load
from failuretwin.failure_behavior.mode import Reaction
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.together.wear_limits import WearLimits, wear_unit

NEAR_ENOUGH = 0.6
"""A plan that uses up no more of the tolerance is not looked for any further; the rest is for how
the arm settles."""
MISS_S_PER_M = 1e3
"""What a metre off the target costs beside the time of the way [s/m]."""
SPARED_S = 1.0
"""What full load of a weak or worn motor costs beside the time of the way [s]; as much as half a
turn of its travel."""
REVERSAL = 0.1
"""What turning such a motor round costs, as a share of full load [-]; assumed."""
SPARING_STARTS = 3 * STARTS
"""Poses that a search begins with where motors are spared: there is more to choose from."""
TRIED = 6
"""So many poses are looked at for a safe way, the cheapest first."""
ROUGH_M = 1e-4
"""Misses below this do not count [m]."""


@dataclass(frozen=True)
class Standing:
    """Where an arm stands.

    Attributes:
        pose: Where its motors are believed to be, (motor,) [rad].
        command: What they were told last, (motor,) [rad].
        time_s: When the next movement will be over, by its clock [s].
        travel: How far they went last, (motor,) [rad]; None: not known.
    """

    pose: FloatArray
    command: FloatArray
    time_s: float
    travel: FloatArray | None = None


@dataclass(frozen=True)
class Plan:
    """What to do about a target.

    Attributes:
        order: The movement; None: none is safe.
        pose: Where the arm shall settle, (motor,) [rad].
        miss_m: How far the tool will be from the target at least [m].
        miss_rad: And how far from its approach direction [rad].
        reachable: Whether both are within its tolerances.
        why: What stands in the way of a plan, empty if nothing does.
        unspared: The pose that would have been taken if no worn motor were spared, (motor,) [rad];
            None: none is.
    """

    order: Order | None
    pose: FloatArray
    miss_m: float
    miss_rad: float
    reachable: bool
    why: str = ""
    unspared: FloatArray | None = None

    @property
    def misses(self) -> str:
        """By how much it misses the target, in words."""
        turned = ""
        if self.miss_rad > DIRECTION_TOLERANCE_RAD:
            turned = f" and {np.rad2deg(self.miss_rad):.0f} deg"
        return f"{1e3 * self.miss_m:.0f} mm{turned}"

    def uses_up(self, target: Target) -> float:
        """Return what share of the tolerances of a target it uses up [-]."""
        return max(self.miss_m / target.tolerance_m, self.miss_rad / DIRECTION_TOLERANCE_RAD)


@dataclass(frozen=True)
class Planner:
    """Plans movements.

    Attributes:
        gate: What is safe.
        spared: Weight of each motor that is worn, (motor,) [-]; 0: sound. None: all are sound.
        seed: Seed of the poses that are tried.
    """

    gate: SafetyGate
    spared: FloatArray | None = None
    seed: int = 0

    @cached_property
    def _rng(self) -> np.random.Generator:
        return np.random.default_rng(self.seed)

    @cached_property
    def whole(self) -> InverseKinematics:
        """Poses within the limits of the joints."""
        return InverseKinematics.of(self.gate.robot)

    @cached_property
    def usual(self) -> InverseKinematics:
        """Poses within the ranges of usual movements."""
        return InverseKinematics(self.gate.robot, *self.gate.pose_limits(usual=True))

    def plan(self, target: Target, arm: BelievedArm, at: Standing) -> Plan:
        """Return the best plan for a target: safe, then near."""
        plans = list[Plan]()
        for kinematics in (self.usual, self.whole):
            found = self._poses(kinematics, target, arm, at)
            plans.append(self._cheapest_safe(found, target, arm, at))
            if plans[-1].order is not None and plans[-1].uses_up(target) <= NEAR_ENOUGH:
                return plans[-1]
        return min(plans, key=lambda plan: (plan.order is None, plan.uses_up(target)))

    def _poses(
        self, kinematics: InverseKinematics, target: Target, arm: BelievedArm, at: Standing
    ) -> Poses:
        """Return poses that bring the tool near to a target."""
        count = STARTS if self.spared is None else SPARING_STARTS
        start = kinematics.starts(count, self._rng, at.pose)
        if arm.fault is not None and arm.fault.set_aside:
            start[:, arm.fault.motor] = arm.fault.angle
        axis = None if target.axis is None else target.axis[None]
        return kinematics.solve(target.point[None], start, arm.locked, axis)

    def _cheapest_safe(self, found: Poses, target: Target, arm: BelievedArm, at: Standing) -> Plan:
        misses = MISS_S_PER_M * np.maximum(found.miss_m[0] - ROUGH_M, 0.0)
        misses += np.maximum(found.miss_rad[0] - 0.1 * DIRECTION_TOLERANCE_RAD, 0.0) * 100.0
        near = found.miss_m[0] <= target.tolerance_m
        near &= found.miss_rad[0] <= DIRECTION_TOLERANCE_RAD
        cost = misses + self.cost(found.pose[0], arm, at)
        order = np.argsort(cost)
        i, ordered, why = self._first_safe(order, found, arm, at)
        miss_m, miss_rad = float(found.miss_m[0, i]), float(found.miss_rad[0, i])
        plan = Plan(ordered, found.pose[0, i], miss_m, miss_rad, bool(near[i]), why)
        if self.spared is None or ordered is None:
            return plan
        plain = replace(self, spared=None)
        cost = misses + plain.cost(found.pose[0], arm, at)
        i, _, _ = self._first_safe(np.argsort(cost), found, arm, at)
        return replace(plan, unspared=found.pose[0, i])

    def _first_safe(
        self, order: IntArray, found: Poses, arm: BelievedArm, at: Standing
    ) -> tuple[int, Order | None, str]:
        """Return the first pose of some that has a safe way: which, its order, or why none has."""
        why = ""
        for i in order[:TRIED]:
            command = arm.command_for(found.pose[0, i], at.command, at.time_s)
            ordered, wrong = self.checked(command, arm, at)
            if not wrong:
                return int(i), ordered, ""
            why = why or wrong
        return int(order[0]), None, why

    def checked(self, command: FloatArray, arm: BelievedArm, at: Standing) -> tuple[Order, str]:
        """Return the order of a command (motor,) [rad], and why it must not be sent."""
        duration = np.full(len(command), self.gate.least_duration(command - at.command))
        order = Order(command, self._in_time(duration, arm))
        settled = arm.settle(command, at.command, at.time_s)
        return order, self.gate.wrong(order, [(at.command, command), (at.pose, settled)])

    def _in_time(self, duration: FloatArray, arm: BelievedArm) -> FloatArray:
        """Return ramps that arrive together where one motor is slow."""
        fault = arm.fault
        if fault is None or fault.reaction is not Reaction.WAIT or np.isnan(fault.size):
            return duration
        longer = duration * float(fault.mode.ramp_factor(np.array([fault.size]))[0])
        longer[fault.motor] = duration[fault.motor]
        return longer

    def cost(self, pose: FloatArray, arm: BelievedArm, at: Standing) -> FloatArray:
        """Return what poses cost, (pose,) [s]: time of the way, and what weak motors have to do.

        Poses are (pose, motor) [rad].
        """
        cost = self.way_s(pose, at)
        weight = np.zeros(pose.shape[-1]) if self.spared is None else self.spared.copy()
        if arm.fault is not None and arm.fault.reaction is Reaction.SPARE:
            weight[arm.fault.motor] += 1.0
        if not weight.any():
            return np.asarray(cost)
        effort = self.load(pose) + np.abs(pose - at.pose) / np.pi
        return np.asarray(cost + SPARED_S * ((effort + REVERSAL * turned_round(pose, at)) @ weight))

    def way_s(self, pose: FloatArray, at: Standing) -> FloatArray:
        """Return the time of the way to poses (..., motor) [rad], (...) [s]."""
        return np.asarray(np.max(np.abs(pose - at.pose) / self.gate.speed, axis=-1))

    def load(self, pose: FloatArray) -> FloatArray:
        """Return the load of each motor in poses (..., motor) [rad], in shares of its largest."""
        robot = self.gate.robot
        return np.asarray(np.abs(robot.loads.torque(pose * robot.sense)) / self._largest_load)

    @cached_property
    def _largest_load(self) -> FloatArray:
        return np.maximum(largest_load(self.gate.robot, 0.0), 1e-9)

    def sparing_lines(self, ways: Sequence[tuple[FloatArray, Standing]]) -> list[str]:
        """Return in words what sparing has changed.

        A way is the pose as it was taken and as it would have been, (2, motor) [rad], and where the
        arm stood.
        """
        if self.spared is None or not ways:
            return []
        taken, plain = np.mean([self.way_s(poses, at) for poses, at in ways], axis=0)
        load = np.mean([self.load(poses) for poses, _ in ways], axis=0)
        travel = np.mean([np.abs(poses - at.pose) for poses, at in ways], axis=0)
        turned = np.mean([turned_round(poses, at) for poses, at in ways], axis=0)
        lines = [
            f"{self.gate.robot.motor_names[k]} spared (weight {self.spared[k]:.2f}): load "
            f"{load[0, k]:.0%} instead of {load[1, k]:.0%} of its largest, {travel[0, k]:.2f} "
            f"instead of {travel[1, k]:.2f} rad a target, turned round in {turned[0, k]:.0%} "
            f"instead of {turned[1, k]:.0%}"
            for k in np.flatnonzero(self.spared).tolist()
        ]
        cost = f"{taken - plain:+.2f} s a target ({taken:.2f} instead of {plain:.2f})"
        return [*lines, f"which costs {cost}"]


def turned_round(pose: FloatArray, at: Standing) -> BoolArray:
    """Return which motors go back on the way to poses (..., motor) [rad], (..., motor)."""
    if at.travel is None:
        return np.zeros(pose.shape, dtype=bool)
    return np.asarray((pose - at.pose) * at.travel < 0.0)


# How worn motors are.

TRACKED = ("bias", "compliance", "friction")
"""What a history follows of each motor, in the order of `wear_unit`."""


def wear_weights(rows: Sequence[Mapping[str, Any]], model: HealthyModel) -> FloatArray:
    """Return how worn each motor is, in shares of what is allowed, (motor,) [-], 1 at most.

    `rows` are what `diagnose --track` keeps of each run, at least one.
    """
    change, doubt = (_change(rows, suffix) for suffix in ("", "_deviation"))
    unit = wear_unit(model).reshape(len(TRACKED), -1)
    beyond = np.maximum(np.abs(change) - HALF_90 * doubt, 0.0)
    worn = np.divide(beyond, unit, out=np.zeros_like(beyond), where=unit > 0.0)
    return np.asarray(np.minimum(worn.max(axis=0) / WearLimits().limit, 1.0))


def stopped_learning(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return why a history learns no more: what changed as no wear does; empty if it learns."""
    return str(rows[-1].get("alarm", ""))


def _change(rows: Sequence[Mapping[str, Any]], suffix: str) -> FloatArray:
    """Return last less first of what is tracked, or both deviations together, (3, motor)."""
    first, last = (
        np.array([row[f"{name}{suffix}"] for name in TRACKED], dtype=np.float64)
        for row in (rows[0], rows[-1])
    )
    return np.asarray(np.hypot(first, last) if suffix else last - first)
