"""The digital model in one object: commands to motor angles to the path of the tool."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from failuretwin.core.errors import InputError
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.digital_model import servo
from failuretwin.digital_model.robot import Robot


@dataclass(frozen=True)
class DigitalTwin:
    """The published twin of a healthy robot: exact servo loops and rigid kinematics.

    Works for one pose, one run or thousands of runs at once; nothing in it ever changes.
    """

    robot: Robot

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
        return servo.respond(loops, command, _uniform_step(grid))

    def path(self, position: ArrayLike) -> FloatArray:
        """Return what the tool sensor sees of motor angles.

        Args:
            position: Angles in the log's sense, (..., motor) [rad].

        Returns:
            Tool positions in the base frame, (..., axis) [m].
        """
        return self.robot.chain.position(self._sensor_pose(position))

    def path_and_jacobian(self, position: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return `path` and its derivative by the angles in the log's sense.

        Args:
            position: Angles in the log's sense, (..., motor) [rad].

        Returns:
            Tool positions (..., axis) [m] and Jacobians (..., axis, motor) [m/rad].
        """
        point, jacobian = self.robot.chain.position_and_jacobian(self._sensor_pose(position))
        if np.all(self.robot.sensor_sense == 1.0):
            return point, jacobian
        return point, jacobian * self.robot.sensor_sense

    def _sensor_pose(self, position: ArrayLike) -> FloatArray:
        position = as_floats(position)
        if np.all(self.robot.sensor_sense == 1.0):
            return position
        return position * self.robot.sensor_sense


def _uniform_step(time: FloatArray) -> float:
    steps = np.diff(time)
    if len(steps) == 0 or steps.min() <= 0 or np.ptp(steps) > 1e-3 * steps.mean():
        raise InputError(
            "`time` is not a uniform, increasing grid. Resample the commands onto one."
        )
    return float((time[-1] - time[0]) / len(steps))
