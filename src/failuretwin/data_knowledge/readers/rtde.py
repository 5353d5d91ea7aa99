"""Universal Robots RTDE recordings: text with blanks or commas, known by its header.

The recorder writes one row each controller cycle, in SI units. ``target_q`` is where the joints are
told to be, ``actual_q`` where their encoders are, and ``actual_TCP_pose`` what the controller
computes from the encoders with the arm's own kinematic calibration: no second sensor. That of the
tool flange is ``actual_tool_accelerometer`` [m/s2]; it is left out where a joint that is no motor
of the profile moves and turns it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.readers.column_map import (
    AngleColumns,
    ColumnMap,
    CommandColumns,
    SensorColumns,
    TimeColumn,
    ToolColumns,
)
from failuretwin.data_knowledge.readers.table import Table, first_line, separator_of
from failuretwin.data_knowledge.readers.timed_log import TimedLog
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin

TIME, TARGET, ACTUAL, TCP = "timestamp", "target_q_", "actual_q_", "actual_TCP_pose_"
ACCELEROMETER = "actual_tool_accelerometer_"
UR_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
"""Joints of every Universal Robots arm in the order of `target_q`, by the names of its URDFs."""
STILL_RAD = 0.01
"""A joint that is told to go no farther stands still [rad]."""
TCP_FAR_M = 0.02
"""A TCP this far from the profile's tool point [m] is another point: arms of one type differ from
their common Denavit-Hartenberg table by millimetres."""


def is_rtde(path: Path) -> bool:
    """Return whether a text file has the header of an RTDE recording."""
    names, separator = _header(path)
    leads = (TCP,) if separator in ",;" else (TARGET, ACTUAL, TCP)
    return TIME in names and any(name.startswith(leads) for name in names)


def _header(path: Path) -> tuple[list[str], str]:
    """Return the names of the columns, and the separator between them."""
    separator = separator_of(path)
    return first_line(path).replace(separator, " ").split(), separator


def read_rtde(path: Path, robot: Robot) -> TimedLog:
    """Read an RTDE recording; joints that are no motors of the arm are left out.

    Raises:
        InputError: If it cannot be read, lacks `target_q` or all of what the arm did, the robot's
            joints are not those of the recording, or its TCP is not the robot's tool point.
    """
    names, separator = _header(path)
    index = _joint_index(robot, path)
    target, actual = ([f"{lead}{i}" for i in index] for lead in (TARGET, ACTUAL))
    tool = [f"{TCP}{i}" for i in range(3)]
    force = tuple(f"{ACCELEROMETER}{i}" for i in range(3))
    lacking = [name for name in target if name not in names]
    if lacking:
        raise InputError(
            f"{path}: an RTDE recording without {', '.join(lacking)}. Add target_q to the recipe."
        )
    has_tool, has_actual = set(tool) <= set(names), set(actual) <= set(names)
    has_force = set(force) <= set(names) and _held(path, separator, names, index)
    if not (has_tool or has_actual or has_force):
        raise InputError(
            f"{path}: an RTDE recording with neither actual_TCP_pose nor actual_q of every joint "
            "nor an actual_tool_accelerometer that motors of the profile alone turn. Add one of "
            "them to the recipe."
        )
    mapping = ColumnMap(
        time=TimeColumn(TIME),
        command=CommandColumns(tuple(target)),
        tool=ToolColumns((tool[0], tool[1], tool[2])) if has_tool else None,
        position=AngleColumns(tuple(actual)) if has_actual else None,
        separator=separator,
        sensors=(SensorColumns("accelerometer", force),) if has_force else (),
    )
    (log,) = mapping.logs(path, robot)
    _check_tcp(log, robot, path)
    return log


def _held(path: Path, separator: str, names: list[str], index: list[int]) -> bool:
    """Return whether joints that are no motors stand still: the flange turns with all of them."""
    others = [f"{TARGET}{i}" for i in range(len(UR_JOINTS)) if i not in index]
    others = [name for name in others if name in names]
    if not others:
        return True
    target = Table.read(path, separator).numbers(others)
    return bool(np.ptp(target, axis=0).max(initial=0.0) < STILL_RAD)


def _joint_index(robot: Robot, path: Path) -> list[int]:
    """Return which of the recording's six joints each motor turns."""
    joints = [motor.joint.removesuffix("_joint") for motor in robot.motors]
    if not set(joints) <= set(UR_JOINTS):
        raise InputError(
            f"{path}: an RTDE recording has the joints {', '.join(UR_JOINTS)}; {robot.name!r} has "
            f"{', '.join(joints)}. Choose the arm with --robot, or say which column is what with "
            "--columns MAP.toml."
        )
    return [UR_JOINTS.index(joint) for joint in joints]


def _check_tcp(log: TimedLog, robot: Robot, path: Path) -> None:
    """Raise InputError where the recorded TCP is not the tool point of the robot."""
    if log.tool is None or log.position is None:
        return
    rows = np.isin(log.position.time, log.tool.time)
    tool = log.tool.value[np.isin(log.tool.time, log.position.time)]
    path_m = DigitalTwin(robot).path(log.position.value[rows])
    off = float(np.nanmedian(np.linalg.norm(tool - path_m, axis=1)))
    if off > TCP_FAR_M:
        raise InputError(
            f"{path}: its TCP lies {1000 * off:.0f} mm from the tool point of {robot.name!r} "
            f"({robot.profile.tool_link!r}). Put where the TCP is in that link's frame into the "
            "profile as tool_xyz = [x, y, z] [m], or leave actual_TCP_pose out of the recording: "
            "the path is then computed from actual_q."
        )
