"""What an arm can still reach with one motor held: of its workspace, or of a task.

share(k, phi) = share of points with min over q, q_k = phi, of |tool(q) - point| <= tolerance
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.decision.acting.safety import SafetyGate
from failuretwin.decision.acting.task import DIRECTION_TOLERANCE_RAD, Target, Task
from failuretwin.digital_model.inverse_kinematics import (
    STARTS,
    InverseKinematics,
    feedback_factor,
    usable_limits,
)
from failuretwin.digital_model.robot import Robot, load_robot

POINTS = 300
"""Points of a workspace, unless told otherwise."""
ANGLES = 9
"""Held angles of each motor that are tried."""
LOOKED_AHEAD = 12
"""Next targets that decide where a motor is parked."""


@dataclass(frozen=True)
class Reach:
    """Which points an arm can reach with one motor held.

    Attributes:
        motor: Its name; empty: none is held.
        angle: Where it is held [rad]; NaN: it is not.
        points: (point, 3) [m], in the frame of the tool sensor.
        miss_m: How far the tool stays from each at least, (point,) [m]; infinite where no allowed
            pose has the approach direction that is asked for.
        tolerance_m: How near is near enough, (point,) [m].
    """

    motor: str
    angle: float
    points: FloatArray
    miss_m: FloatArray
    tolerance_m: FloatArray

    @property
    def reached(self) -> BoolArray:
        """Which points can be reached, (point,)."""
        return np.asarray(self.miss_m <= self.tolerance_m)

    @property
    def share(self) -> float:
        """Share of the points that can be reached."""
        return float(self.reached.mean())

    def record(self) -> dict[str, Any]:
        """Return it as a JSON object."""
        return {
            "motor": self.motor or None,
            "angle_rad": None if np.isnan(self.angle) else self.angle,
            "share": self.share,
            "points": self.points.tolist(),
            "miss_m": [miss if np.isfinite(miss) else None for miss in self.miss_m.tolist()],
            "reached": self.reached.tolist(),
        }


@dataclass(frozen=True)
class MotorReach:
    """What holding one motor costs, by where it is held.

    Attributes:
        motor: Its name.
        angle: Angles that were tried, (angle,) [rad].
        share: Share of the points that can still be reached, (angle,).
        feedback_factor: Median over the workspace of what a correction leaves of an error if the
            motor does not move and nobody knows; near 1, feedback alone never gets there.
    """

    motor: str
    angle: FloatArray
    share: FloatArray
    feedback_factor: float

    @property
    def best_angle(self) -> float:
        """The angle at which most can be reached, to park it at [rad]."""
        return float(self.angle[int(np.argmax(self.share))])

    def record(self) -> dict[str, Any]:
        """Return it as a JSON object."""
        return {
            "motor": self.motor,
            "angle_rad": self.angle.tolist(),
            "share": self.share.tolist(),
            "mean_share": float(self.share.mean()),
            "best_angle_rad": self.best_angle,
            "feedback_factor": self.feedback_factor,
        }


def workspace(robot: Robot, count: int = POINTS, seed: int = 0) -> FloatArray:
    """Return points that an arm reaches in its usual movements, (point, 3) [m]."""
    return InverseKinematics.of(robot).tool(_usual_poses(robot, count, seed))[0]


def _usual_poses(robot: Robot, count: int, seed: int) -> FloatArray:
    """Return random poses of usual movements, (pose, motor) [rad]."""
    low, high = np.array([motor.movement_range for motor in robot.motors]).T
    return np.random.default_rng(seed).uniform(low, high, (count, len(low)))


def reach(
    arm: SafetyGate | Robot | str | Path,
    points: FloatArray | Task,
    held: tuple[str, float] | None = None,
    seed: int = 0,
) -> Reach:
    """Return which points an arm can reach in poses that keep off the floor and its own links.

    Args:
        arm: The arm and what is safe; or a robot, its name or its profile, with the usual limits.
        points: (point, 3) [m], or a task, whose tolerances and directions then count.
        held: Name of a motor that is held, and its angle [rad]; None: none is.
        seed: Seed of the poses that a search begins with.

    Raises:
        InputError: If the robot has no such motor.
    """
    gate = arm if isinstance(arm, SafetyGate) else SafetyGate(load_robot(arm))
    robot = gate.robot
    kinematics, locked = InverseKinematics.of(robot), None
    start = kinematics.starts(STARTS, np.random.default_rng(seed))
    if held is not None:
        locked = np.array([name == held[0] for name in robot.motor_names])
        if not locked.any():
            raise InputError(f"robot {robot.name!r} has no motor {held[0]!r}.")
        start[:, locked] = held[1]
    targets = (points if isinstance(points, Task) else Task.of_points(points)).targets
    where = np.array([target.point for target in targets])
    tolerance = np.array([target.tolerance_m for target in targets])
    axes = {k: target.axis for k, target in enumerate(targets) if target.axis is not None}
    free, miss = [k for k in range(len(targets)) if k not in axes], np.empty(len(targets))
    for rows, axis in ((free, None), (list(axes), np.array(list(axes.values())))):
        if rows:
            found = kinematics.solve(where[rows], start, locked, axis)
            allowed = gate.clearance.margin(found.pose) >= 0.0
            allowed &= found.miss_rad <= DIRECTION_TOLERANCE_RAD
            miss[rows] = np.where(allowed, found.miss_m, np.inf).min(axis=1)
    name, angle = held if held is not None else ("", np.nan)
    return Reach(name, angle, where, miss, tolerance)


def reach_by_motor(
    gate: SafetyGate, points: FloatArray | Task, seed: int = 0
) -> Sequence[MotorReach]:
    """Return for each motor what can be reached with it held, over where it is held.

    Points are (point, 3) [m].
    """
    robot = gate.robot
    jacobian = InverseKinematics.of(robot).tool(_usual_poses(robot, POINTS, seed))[1]
    factor = np.median(feedback_factor(jacobian), axis=0)
    found = []
    for k, name in enumerate(robot.motor_names):
        angle = np.linspace(float(robot.travel[k, 0]), float(robot.travel[k, 1]), ANGLES)
        share = [reach(gate, points, (name, float(a)), seed).share for a in angle]
        found.append(MotorReach(name, angle, np.array(share), float(factor[k])))
    return found


def parking_place(gate: SafetyGate, motor: int, targets: Sequence[Target], stands: float) -> Reach:
    """Return the reach with a motor parked at the angle that keeps most of the next targets.

        angle* = argmax over angles of the number of targets that the other motors reach

    Of angles that are as good, the one nearest to the present angle. The motor, an index, still
    moves and now `stands` at an angle [rad].
    """
    low, high = (ends[motor] for ends in usable_limits(gate.robot))
    angles = np.append(np.linspace(low, high, ANGLES + 2)[1:-1], np.clip(stands, low, high))
    name, near = gate.robot.motor_names[motor], Task(tuple(targets[:LOOKED_AHEAD]))
    found = [reach(gate, near, (name, float(angle))) for angle in angles]
    return min(found, key=lambda each: (-each.reached.sum(), abs(each.angle - stands)))
