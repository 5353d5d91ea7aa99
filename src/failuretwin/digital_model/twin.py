"""The digital model in one object: commands to motor angles to the path of the tool."""

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
    """The published twin of a healthy robot: exact servo loops and rigid kinematics.

    Works for one pose, one run or thousands of runs at once; nothing in it ever changes.
    """

    robot: Robot

    def __post_init__(self) -> None:
        object.__setattr__(self, "robot", load_robot(self.robot))

    def respond(self, command: ArrayLike, time: ArrayLike) -> FloatArray:
        """Return the motor angles that follow from commands.

        The motors are at rest at the first command; between samples the command is linear.
        The published data put each response beside the command one sample before it.

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
        """Return what the tool sensor sees, (..., axis) [m] in the base frame.

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

        Args:
            position: Motor angles in the log's sense, (..., motor) [rad].

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
        """Sense of the motors in the sensor's pose, (motor,); None: as in the log."""
        sense = self.robot.sensor_sense
        return None if np.all(sense == 1.0) else sense


def uniform_step(time: FloatArray) -> float:
    """Return the step of a uniform grid [s]; raise InputError for any other."""
    steps = np.diff(time)
    if len(steps) == 0 or steps.min() <= 0 or np.ptp(steps) > 1e-3 * steps.mean():
        raise InputError("`time` is not a uniform, increasing grid. Resample onto one.")
    return float((time[-1] - time[0]) / len(steps))


# Engines: from what the motors are told and what hampers them to the angles they take.

SAG_ROUNDS = 2
"""Rounds in which sag and pose settle together; each takes off all but a few hundredths."""


@dataclass(frozen=True)
class Drive:
    """What the motors of many runs are told, and what hampers them. Angles in the log's sense.

    Attributes:
        reference: Angles that the servo loops follow, (run, time, motor) [rad].
        held: When a motor is held by its gear, (run, time, motor); None: never.
        weakness: Share of its stiffness that a motor has lost, (run, time, motor) in [0, 1); None:
            none.
        compliance: How far each motor gives way under load, (run, motor) [rad/(N m)]; an engine
            with a stiffness of its own leaves it aside. None: rigid.
        payload: Mass carried at the tool point, (run,) [kg]; None: none.
    """

    reference: FloatArray
    held: BoolArray | None = None
    weakness: FloatArray | None = None
    compliance: FloatArray | None = None
    payload: FloatArray | None = None


class Engine(Protocol):
    """Moves a robot: the interface of the servo engine and of the physics engine."""

    @property
    def name(self) -> str:
        """What the engine is called on the command line."""
        ...

    def angles(self, drive: Drive, time: FloatArray) -> FloatArray:
        """Return the angles that the motors take, (run, time, motor) [rad], log's sense.

        The arm is at rest at the first reference; `time` is a uniform grid, (time,) [s].
        """
        ...


@dataclass(frozen=True)
class ServoEngine:
    """The published twin: exact servo loops, rigid links; motors give way as far as they are told.

    Gravity pulls at the pose that the arm is really in, and a motor that is held does not give way.
    """

    robot: Robot
    name: str = "servo"

    def angles(self, drive: Drive, time: FloatArray) -> FloatArray:
        """Return the angles that the motors take, (run, time, motor) [rad], log's sense."""
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
