"""The digital model: commands to motor angles to the path of the tool."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from failuretwin.core.errors import InputError
from failuretwin.core.types import BoolArray, FloatArray, as_floats
from failuretwin.digital_model import servo
from failuretwin.digital_model.geometry import geometry_columns
from failuretwin.digital_model.robot import Robot, load_robot
from failuretwin.digital_model.settling import hold, sag


@dataclass(frozen=True)
class DigitalTwin:
    """Twin of a healthy robot as published: exact servo loops and rigid kinematics.

    Immutable; works on one pose, one run or thousands of runs at once.
    """

    robot: Robot

    def __post_init__(self) -> None:
        object.__setattr__(self, "robot", load_robot(self.robot))

    def respond(self, command: ArrayLike, time: ArrayLike) -> FloatArray:
        """Return the motor angles that follow from commands.

        The motors are at rest at the first command; between samples the command is linear.
        Published data store each response one sample earlier.

        Args:
            command: Reference angles in the log's sense, (..., time, motor) [rad].
            time: Uniform time grid, (time,) [s].

        Returns:
            Angles at the same instants, (..., time, motor) [rad].

        Raises:
            InputError: If the shapes do not fit or the grid is not uniform.
        """
        command, grid = as_floats(command), as_floats(time)
        if command.ndim < 2 or command.shape[-2] != len(grid):
            raise InputError(
                f"`command` has shape {command.shape}, expected (..., {len(grid)} times, motor)."
            )
        loops = [motor.loop for motor in self.robot.motors]
        return servo.respond(loops, command, uniform_step(grid))

    def path(self, position: ArrayLike) -> FloatArray:
        """Return the tool position as the sensor sees it, (..., axis) [m].

        Args:
            position: Motor angles in the log's sense, (..., motor) [rad].
        """
        return self.robot.chain.position(self._sensor_pose(position))

    def path_and_jacobian(self, position: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return `path` and its derivative by the angles, (..., axis, motor) [m/rad]."""
        point, jacobian = self.robot.chain.position_and_jacobian(self._sensor_pose(position))
        return point, jacobian if self._turned is None else jacobian * self._turned

    def geometry_columns(self, position: ArrayLike) -> FloatArray:
        """Return the derivative of `path` by small corrections of every joint's frame.

        Motor angles are in the log's sense, (..., motor) [rad].

        Returns:
            (..., axis, 6 * motor): x, y, z [m/m] and roll, pitch, yaw [m/rad] of the first motor's
            joint, then of the next; see `failuretwin.digital_model.geometry.geometry_columns`.
        """
        robot = self.robot
        return geometry_columns(robot.chain, self._sensor_pose(position), robot.sensor_scale)

    def _sensor_pose(self, position: ArrayLike) -> FloatArray:
        position = np.asarray(position, dtype=np.float64)
        return position if self._turned is None else position * self._turned

    @cached_property
    def _turned(self) -> FloatArray | None:
        """Sense of the motors in the sensor's pose, (motor,); None: the log's sense."""
        sense = self.robot.sensor_sense
        return None if np.all(sense == 1.0) else sense


def uniform_step(time: FloatArray) -> float:
    """Return the step of a uniform grid [s]; raise InputError for any other."""
    steps = np.diff(time)
    if len(steps) == 0 or steps.min() <= 0 or np.ptp(steps) > 1e-3 * steps.mean():
        raise InputError("`time` is not a uniform, increasing grid. Resample onto one.")
    return float((time[-1] - time[0]) / len(steps))


# Engines: from references and faults to motor angles.

SAG_ROUNDS = 2
"""Iterations of sag and pose; each leaves a few hundredths of the error."""


@dataclass(frozen=True)
class Drive:
    """Input of an engine for many runs. Angles are in the log's sense.

    Attributes:
        reference: References of the servo loops, (run, time, motor) [rad].
        held: Whether the gear holds a motor, (run, time, motor); None: never.
        weakness: Share of its stiffness that a motor has lost, (run, time, motor) in [0, 1); None:
            none.
        compliance: Yielding of each motor under load, (run, motor) [rad/(N m)]; ignored by engines
            with a stiffness of their own. None: rigid.
        payload: Mass at the tool point, (run,) [kg]; None: none.
    """

    reference: FloatArray
    held: BoolArray | None = None
    weakness: FloatArray | None = None
    compliance: FloatArray | None = None
    payload: FloatArray | None = None


class Engine(Protocol):
    """Interface of the servo engine and the physics engine."""

    @property
    def name(self) -> str:
        """Name on the command line."""
        ...

    def angles(self, drive: Drive, time: FloatArray) -> FloatArray:
        """Return the motor angles, (run, time, motor) [rad], in the log's sense.

        The arm is at rest at the first reference; `time` is a uniform grid, (time,) [s].
        """
        ...


@dataclass(frozen=True)
class ServoEngine:
    """The published twin: exact servo loops, rigid links, and compliant motors.

    Gravity acts at the actual pose; a held motor does not yield.
    """

    robot: Robot
    name: str = "servo"

    def angles(self, drive: Drive, time: FloatArray) -> FloatArray:
        """Return the motor angles, (run, time, motor) [rad], in the log's sense."""
        free = DigitalTwin(self.robot).respond(drive.reference, time)
        limits = np.array([motor.speed_limit for motor in self.robot.motors])
        position = hold(free, drive.held, time, limits)
        if drive.compliance is None:
            return position
        payload = 0.0 if drive.payload is None else drive.payload[:, None]
        for _ in range(SAG_ROUNDS):
            yielding = sag(self.robot, position, drive.compliance[:, None], payload)
            if drive.weakness is not None:
                yielding /= 1.0 - drive.weakness
            position = hold(free + yielding, drive.held, time, limits)
        return position
