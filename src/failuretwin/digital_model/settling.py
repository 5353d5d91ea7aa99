"""Where motors come to rest: bias, gravity sag, friction, and gears that hold them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from failuretwin.core.config import AtLeastZero, Bounded, Bounds
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.robot import Robot


@dataclass(frozen=True)
class Settling(Bounded):
    """Settled error of each motor and its scatter; one value for each motor in chain order.

    A motor gives way under the load torque of the links and the payload in the pose that the arm
    is really in; friction stops it short of its target, seen in the direction of travel.

    Attributes:
        bias: Constant error [rad].
        compliance: Yielding for each unit of load torque [rad/(N m)].
        friction: How far it stops short [rad].
        scatter: Scale of what is left, from movement to movement [rad].
        tail_dof: Degrees of freedom of the scatter's Student t distribution; small = heavy tails.
        source: Where the figures come from.
        payload: Mass carried at the tool point beside what the URDF knows [kg].
    """

    bias: Annotated[tuple[float, ...], Bounds(-7.0, 1e3)] = ()
    compliance: Annotated[tuple[float, ...], Bounds(-1e3, 1e3)] = ()
    friction: Annotated[tuple[float, ...], Bounds(-7.0, 1e3)] = ()
    scatter: Annotated[tuple[float, ...], Bounds(0.0, 1e3)] = ()
    tail_dof: Annotated[float, Bounds(0.1, np.inf)] = np.inf
    source: str = ""
    payload: AtLeastZero = 0.0

    @classmethod
    def ideal(cls, motors: int) -> Settling:
        """Return the settling of a motor that always reaches its target."""
        zero = (0.0,) * motors
        return cls(zero, zero, zero, zero, np.inf, "ideal motors")

    def offset(self, robot: Robot, pose: FloatArray, direction: FloatArray) -> FloatArray:
        """Return the mean settled error of a healthy motor.

        Args:
            robot: The robot.
            pose: Angles that the arm settles near, in the log's sense, (..., motor) [rad].
            direction: Sign of each motor's last travel in the log's sense, (..., motor).

        Returns:
            Settled angle minus commanded angle in the log's sense, (..., motor) [rad].
        """
        offset = np.asarray(self.bias) - np.asarray(self.friction) * direction
        if not any(self.compliance):
            return offset
        return offset + sag(robot, pose, np.asarray(self.compliance), self.payload)


def poses_in_range(robot: Robot) -> FloatArray:
    """Return 500 physical poses spread over the motors' ranges, (pose, motor) [rad]."""
    low, high = np.array([motor.movement_range for motor in robot.motors]).T
    return np.random.default_rng(0).uniform(low, high, (500, len(low))) * robot.sense


def loads_in_range(robot: Robot, payload: float) -> FloatArray:
    """Return gravity torques at `poses_in_range`, (pose, motor) [N m]."""
    return robot.loads.torque(poses_in_range(robot), payload)


def largest_load(robot: Robot, payload: float) -> FloatArray:
    """Return the largest gravity torque that each motor meets in its range, (motor,) [N m]."""
    return np.abs(loads_in_range(robot, payload)).max(axis=0)


def sag(
    robot: Robot, pose: FloatArray, compliance: FloatArray, payload: FloatArray | float
) -> FloatArray:
    """Return how far gravity moves every motor, (..., motor) [rad], log's sense.

    Args:
        robot: The robot.
        pose: Angles that the arm is in, in the log's sense, (..., motor) [rad].
        compliance: Yielding of each motor, (..., motor) [rad/(N m)].
        payload: Mass at the tool point, () or the leading axes of `pose` [kg].
    """
    return robot.sense * compliance * robot.loads.torque(pose * robot.sense, payload)


def hold(
    position: FloatArray, held: BoolArray | None, time: FloatArray, speed_limit: FloatArray
) -> FloatArray:
    """Return the angles of motors that are held at times.

    While held, a motor keeps the angle that it has at the first such sample. After that it makes
    for the free motion at its speed limit, and follows it once it has caught up.

    Args:
        position: Free motion, (run, time, motor) [rad].
        held: When a motor is held, (run, time, motor); None: never.
        time: Uniform grid, (time,) [s].
        speed_limit: Largest speed of each motor, (motor,) [rad/s].

    Returns:
        (run, time, motor) [rad]; the given array where nothing is held.
    """
    if held is None:
        return position
    first = np.argmax(held, axis=1)[:, None]
    angle = np.take_along_axis(position, first, axis=1)
    followed = np.where(held, angle, position)
    run, motor = np.nonzero((held[:, :-1] & ~held[:, 1:]).any(axis=1))
    if len(run):
        reach = speed_limit[motor] * (time[-1] - time[0]) / (len(time) - 1)
        followed[run, :, motor] = _let_go(position[run, :, motor].T, held[run, :, motor].T, reach).T
    return followed


def _let_go(position: FloatArray, held: BoolArray, reach: FloatArray) -> FloatArray:
    """Return `hold` of motors (time, case) let go at least once, with (case,) `reach` a step."""
    followed = np.empty_like(position)
    here = followed[0] = position[0]
    behind = np.zeros(len(reach), dtype=bool)
    for k in range(1, len(position)):
        stays = held[k] & held[k - 1]
        near = np.clip(position[k], here - reach, here + reach)
        here = np.where(stays, here, np.where(behind, near, position[k]))
        behind = stays | (behind & (here != position[k]))
        followed[k] = here
    return followed
