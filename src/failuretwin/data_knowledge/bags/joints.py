"""Which column of recorded joint values belongs to which motor of the robot."""

from __future__ import annotations

import re
from collections.abc import Sequence

from failuretwin.core.errors import InputError
from failuretwin.digital_model.robot import Robot


def names_a_motor(names: Sequence[str], robot: Robot) -> bool:
    """Return whether any of the names can stand for a motor of the robot."""
    return any(set(scheme) & set(names) for scheme in _schemes(robot, in_counts=False).values())


def motor_columns(names: Sequence[str], robot: Robot, where: str, *, in_counts: bool) -> list[int]:
    """Return the column of each motor among `names`, in chain order.

    All motors are named in one way: by joint, by motor, by log column, or by the number that the
    log column ends in. The same name may mean two motors in two ways (the log column ``motor_1``
    of the ArmPi is not its motor 1), so the ways are never mixed and their order matters: values
    in counts come from the servo bus, angles from a driver that knows joints.

    Args:
        names: Names of the columns.
        robot: The robot.
        where: Name of the file and topic for error texts.
        in_counts: Whether the values are servo counts.

    Raises:
        InputError: If a motor is missing.
    """
    schemes = _schemes(robot, in_counts=in_counts)
    column = {name: index for index, name in enumerate(names)}
    for wanted in schemes.values():
        if all(name in column for name in wanted):
            return [column[name] for name in wanted]
    best = max(schemes.values(), key=lambda wanted: sum(name in column for name in wanted))
    missing = [name for name in best if name not in column]
    ways = "; ".join(f"{kind} {', '.join(wanted)}" for kind, wanted in schemes.items())
    raise InputError(
        f"{where}: values for {', '.join(missing)} are missing; it names "
        f"{', '.join(names) or 'no joint at all'}. Expected all motors of {robot.name!r} by one of "
        f"these: {ways}."
    )


def _schemes(robot: Robot, *, in_counts: bool) -> dict[str, list[str]]:
    """Return the names of the motors in each way of naming them all, the likeliest first."""
    bus: dict[str, list[str]] = {}
    if all(motor.log_column for motor in robot.motors):
        bus["log columns"] = [motor.log_column for motor in robot.motors]
        numbers = [re.search(r"\d+$", motor.log_column) for motor in robot.motors]
        bus["servo numbers"] = [match.group() for match in numbers if match]
        if len(bus["servo numbers"]) < len(robot.motors):
            del bus["servo numbers"]
    arm = {"joints": [motor.joint for motor in robot.motors], "motors": robot.motor_names}
    return bus | arm if in_counts else arm | bus
