"""A robot with the servo loops that its own step tests speak for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from failuretwin.connection.calibration.calibration import Calibration, LoopFit
from failuretwin.connection.calibration.calibration_file import load_calibration
from failuretwin.core.config import read_toml
from failuretwin.core.errors import unknown_name
from failuretwin.digital_model.imperfections import CALIBRATION_TABLE
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.servo import ServoLoop


def calibrated_robot(robot: Robot, calibration: Calibration) -> Robot:
    """Return the robot with the loops and speed limits of a calibration; others stay.

    Raises:
        InputError: If the calibration names a motor that the robot does not have.
    """
    return with_loops(robot, calibration.loops)


def with_loops(robot: Robot, loops: Sequence[LoopFit]) -> Robot:
    """Return the robot with other loops and speed limits for some of its motors.

    Raises:
        InputError: If the robot does not have such a motor.
    """
    found = {loop.motor: loop for loop in loops}
    for name in found:
        if name not in robot.motor_names:
            raise unknown_name("motor", name, robot.motor_names)
    motors = tuple(
        replace(
            motor,
            loop=ServoLoop(fit.P, fit.I, fit.filter_s),
            speed_limit=fit.speed_limit,
        )
        if (fit := found.get(motor.name))
        else motor
        for motor in robot.motors
    )
    return replace(robot, profile=replace(robot.profile, motors=motors))


def robot_as_calibrated(robot: Robot, name_or_path: str) -> Robot:
    """Return the robot that goes with imperfections, whose timing is on top of their own loops.

    Args:
        robot: The robot as its profile has it.
        name_or_path: What `load_imperfections` takes; only calibration files bring loops.

    Raises:
        InputError: If the file is a calibration that cannot be read or of another robot.
    """
    path = Path(name_or_path)
    if path.suffix != ".toml" or CALIBRATION_TABLE not in read_toml(path):
        return robot
    return calibrated_robot(robot, load_calibration(path, robot))
