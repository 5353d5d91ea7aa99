"""Settled errors of healthy motors (bias, gravity sag, friction), and held gears."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from failuretwin.core.config import AtLeastZero, Bounded, Bounds
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.robot import Robot


@dataclass(frozen=True)
class Settling(Bounded):
    """Settled error of each motor and its scatter; one value per motor in chain order.

        error = bias + compliance * load - friction * direction + scatter * t_dof

    The load is the gravity torque of links and payload at the actual pose; friction stops the motor
    short of its target in the direction of travel.

    Attributes:
        bias: Constant error [rad].
        compliance: Yielding per load torque [rad/(N m)].
        friction: Distance by which it stops short [rad].
        scatter: Scale of the random error from movement to movement [rad].
        tail_dof: Degrees of freedom of the scatter's Student t distribution; small = heavy tails.
        source: Source of the values.
        payload: Mass at the tool point in addition to the URDF [kg].
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
        """Return the settling of motors that always reach their targets."""
        zero = (0.0,) * motors
        return cls(zero, zero, zero, zero, np.inf, "ideal motors")

    def offset(self, robot: Robot, pose: FloatArray, direction: FloatArray) -> FloatArray:
        """Return the mean settled error of a healthy motor, (..., motor) [rad], log's sense.

        `pose` are approximate settled angles, `direction` the signs of the last travels, (...,
        motor) each, log's sense.
        """
        offset = np.asarray(self.bias) - np.asarray(self.friction) * direction
        if not any(self.compliance):
            return offset
        return offset + sag(robot, pose, np.asarray(self.compliance), self.payload)


def poses_in_range(robot: Robot) -> FloatArray:
    """Return 500 random physical poses within the motors' ranges, (pose, motor) [rad]."""
    low, high = np.array([motor.movement_range for motor in robot.motors]).T
    return np.random.default_rng(0).uniform(low, high, (500, len(low))) * robot.sense


def loads_in_range(robot: Robot, payload: float) -> FloatArray:
    """Return gravity torques at `poses_in_range`, (pose, motor) [N m]."""
    return robot.loads.torque(poses_in_range(robot), payload)


def largest_load(robot: Robot, payload: float) -> FloatArray:
    """Return the largest gravity torque of each motor in its range, (motor,) [N m]."""
    return np.abs(loads_in_range(robot, payload)).max(axis=0)


def sag(
    robot: Robot, pose: FloatArray, compliance: FloatArray, payload: FloatArray | float
) -> FloatArray:
    """Return the displacement of every motor by gravity, (..., motor) [rad], log's sense.

    Angles are (..., motor) [rad], yieldings (..., motor) [rad/(N m)]; the mass at the tool point
    [kg] has the leading axes of the pose, or none.
    """
    return robot.sense * compliance * robot.loads.torque(pose * robot.sense, payload)


def hold(
    position: FloatArray, held: BoolArray | None, time: FloatArray, speed_limit: FloatArray
) -> FloatArray:
    """Return the angles of motors that are held at times.

    A held motor keeps its angle at the first held sample. Released, it returns to the free motion
    at its speed limit.

    Args:
        position: Free motion, (run, time, motor) [rad].
        held: Whether a motor is held, (run, time, motor); None: never.
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
    """Return `hold` of motors (time, case) released at least once; `reach` [rad] is a step's."""
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
