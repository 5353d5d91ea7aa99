"""Items as ROS messages, as plain values that every kind of ROS can be given."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from failuretwin.connection.links.base import Answer, CommandSent, Reading
from failuretwin.connection.links.statuses import RateLimiter, Status, statuses
from failuretwin.core.config import from_table, read_toml
from failuretwin.core.errors import InputError
from failuretwin.core.types import MS_PER_S, FloatArray
from failuretwin.data_knowledge.bag_messages import (
    MONITORING,
    NS_PER_S,
    Kind,
    Role,
    check_role,
    kind_of_type,
)
from failuretwin.digital_model.robot import Robot

# Names and types of the topics that a robot is connected by; TOML, Python and defaults agree.

AUTHORS_TYPE = "cm/msg_cm"
"""Type of the message of the data set's authors; any other package may define the same fields."""
STANDARD_PACKAGES = ("std_msgs", "sensor_msgs", "geometry_msgs", "trajectory_msgs", "nav_msgs")
"""Packages of ROS itself: their other types have none of the fields that are looked for."""
TOPIC_NAME = re.compile(r"[~/]?[A-Za-z]\w*(/[A-Za-z]\w*)*")
"""What ROS accepts as the name of a topic."""
SET_POINTS_LATE_S = 0.5
"""How long readings wait for set-points that come as a stream [s]: until the next has come, it is
not known where the reference was in between. Enough for two a second."""


@dataclass(frozen=True)
class RosTopics:
    """Topics of a robot. The defaults are those of the data set's authors.

    Attributes:
        command: Topic of the commands.
        command_type: Its type: a JointTrajectory, a JointState, or a message with the authors'
            fields under any name.
        position: Topic of motor readings; empty: none. Without a tool topic, the tool's position
            is computed from them.
        position_type: Its type: a JointState or a message with the authors' fields.
        tool: Topic of the tool's position in the base frame; empty: none.
        tool_type: Its type: a PointStamped or a PoseStamped.
        goal: Topic of the goals that the motors report to have received; empty: none.
        goal_type: Its type: as of motor readings.
        diagnostics: Topic of the diagnosis.
        commands_late_s: How much later than their stamps commands may arrive [s]; readings wait
            that long for them. The authors' programs publish a command two seconds after it was
            sent. None: not at all, or for `SET_POINTS_LATE_S` where set-points come as a stream.
    """

    command: str = "position_monitoring"
    command_type: str = AUTHORS_TYPE
    position: str = "condition_monitoring"
    position_type: str = AUTHORS_TYPE
    tool: str = ""
    tool_type: str = "geometry_msgs/PointStamped"
    goal: str = ""
    goal_type: str = "sensor_msgs/JointState"
    diagnostics: str = "/diagnostics"
    commands_late_s: float | None = None

    def __post_init__(self) -> None:
        if not self.command:
            raise InputError("no topic of commands is named. Without commands nothing is known.")
        if not self.position and not self.tool:
            raise InputError(
                "neither a topic of motor readings (`position`) nor of the tool's position (`tool`)"
                " is named. Name one of them."
            )
        if not 0.0 <= self.wait_s <= 60.0:
            raise InputError(f"commands_late_s is {self.wait_s:g}, expected 0 to 60 [s].")
        for role, name, type_ in self.subscribed:
            if not TOPIC_NAME.fullmatch(name):
                raise InputError(
                    f"{role} is {name!r}, which is no name of a topic. Expected letters, digits, _ "
                    "and /, such as /arm_controller/command."
                )
            kind = kind_of_type(type_)
            foreign = kind is MONITORING and type_.split("/")[0] in STANDARD_PACKAGES
            check_role(role, None if foreign else kind, f"{role}_type is {type_!r}, which")

    @property
    def wait_s(self) -> float:
        """How long readings wait for commands that arrive later than their stamps [s]."""
        if self.commands_late_s is not None:
            return self.commands_late_s
        streamed = kind_of_type(self.command_type) is Kind.JOINT_STATE
        return SET_POINTS_LATE_S if streamed else 0.0

    def check_fits(self, robot: Robot) -> None:
        """Raise InputError if a message would hold servo counts and the robot has none."""
        in_counts = [
            type_ for _, _, type_ in self.subscribed if kind_of_type(type_) is Kind.MONITORING
        ]
        has_counts = robot.profile.servo_units and all(motor.log_column for motor in robot.motors)
        if in_counts and not has_counts:
            raise InputError(
                f"{in_counts[0]} holds servo counts, but the profile of robot {robot.name!r} lacks "
                "servo_units or a log_column of some motor. Name topics of standard types in a "
                "file for --topics (docs/live.md)."
            )

    @property
    def subscribed(self) -> list[tuple[Role, str, str]]:
        """Role, name and type of every topic that is listened to."""
        found: list[tuple[Role, str, str]] = [
            ("command", self.command, self.command_type),
            ("tool", self.tool, self.tool_type),
            ("position", self.position, self.position_type),
            ("goal", self.goal, self.goal_type),
        ]
        return [entry for entry in found if entry[1]]


def load_topics(path: Path) -> RosTopics:
    """Load topics from a TOML file with the fields of `RosTopics`; what it leaves out is default.

    Raises:
        InputError: If the file cannot be read, names a key that does not exist, or makes no sense.
    """
    try:
        return from_table(RosTopics, read_toml(path), str(path))
    except InputError as error:
        where = "" if str(error).startswith(str(path)) else f"{path}: "
        raise InputError(f"{where}{error}") from error


DIAGNOSTICS_TYPE = "diagnostic_msgs/DiagnosticArray"


@dataclass(frozen=True)
class Outgoing:
    """A message to be sent.

    Attributes:
        topic: Its topic.
        type: Its type, by its ROS 1 name.
        content: Its fields; stamps and durations are tables of `secs` and `nsecs`.
    """

    topic: str
    type: str
    content: dict[str, Any]


def stamp_of(time: float) -> dict[str, int]:
    """Return a time [s] as ROS holds it."""
    secs, nsecs = divmod(round(time * NS_PER_S), NS_PER_S)
    return {"secs": secs, "nsecs": nsecs}


def diagnostics_message(
    found: Sequence[Status], time: float, topics: RosTopics, robot: Robot
) -> Outgoing:
    """Return statuses as a message."""
    array = [
        {
            "level": status.level,
            "name": f"failuretwin: {status.name}",
            "message": status.message,
            "hardware_id": robot.name,
            "values": [{"key": key, "value": value} for key, value in status.values.items()],
        }
        for status in found
    ]
    content = {"header": _header(time), "status": array}
    return Outgoing(topics.diagnostics, DIAGNOSTICS_TYPE, content)


class RosWriter:
    """Says readings and commands as the robot itself would.

    Args:
        robot: The robot.
        topics: Its topics.

    Raises:
        InputError: If commands are to be a stream of samples, which single commands cannot be, or
            the robot has no servo counts where the messages have them.
    """

    def __init__(self, robot: Robot, topics: RosTopics) -> None:
        if kind_of_type(topics.command_type) is Kind.JOINT_STATE:
            raise InputError(
                "command_type is sensor_msgs/JointState, a stream of samples, which cannot be "
                "published here. Expected trajectory_msgs/JointTrajectory or the authors' message."
            )
        topics.check_fits(robot)
        self._robot = robot
        self._topics = topics
        self._origin = np.zeros(len(robot.motors))

    def start_at(self, angle: FloatArray) -> None:
        """Take the angles (motor,) [rad] that the next command starts from."""
        self._origin = angle

    @property
    def topics(self) -> list[tuple[str, str]]:
        """Name and type of every topic that may be written to."""
        return [(name, type_) for _, name, type_ in self._topics.subscribed]

    def reading(self, reading: Reading) -> list[Outgoing]:
        """Return what is published of a reading."""
        topics, found = self._topics, []
        if topics.position and reading.position is not None:
            content = self._joints(reading.time, reading.position, topics.position_type)
            found.append(Outgoing(topics.position, topics.position_type, content))
        if topics.goal and reading.goal is not None:
            content = self._joints(reading.time, reading.goal, topics.goal_type)
            found.append(Outgoing(topics.goal, topics.goal_type, content))
        if topics.tool and np.isfinite(reading.tool).all():
            found.append(Outgoing(topics.tool, topics.tool_type, self._tool(reading)))
        return found

    def command(self, command: CommandSent) -> list[Outgoing]:
        """Return what is published of a command."""
        type_ = self._topics.command_type
        if kind_of_type(type_) is Kind.TRAJECTORY:
            content = self._trajectory(command)
        else:
            content = self._joints(command.time, command.target, type_)
            # The authors' message has no field for durations; theirs are where temperatures belong.
            content["temperature"] = (command.duration * MS_PER_S).tolist()
        self._origin = command.target
        return [Outgoing(self._topics.command, type_, content)]

    def _joints(self, time: float, angle: FloatArray, type_: str) -> dict[str, Any]:
        motors, header = self._robot.motors, _header(time)
        if kind_of_type(type_) is Kind.JOINT_STATE:
            return {
                "header": header,
                "name": [motor.joint for motor in motors],
                "position": angle.tolist(),
                "velocity": [],
                "effort": [],
            }
        return {
            "header": header,
            "name": [motor.log_column for motor in motors],
            "position": self._robot.servo_units.to_counts(angle).tolist(),
            "temperature": [],
            "voltage": [],
        }

    def _tool(self, reading: Reading) -> dict[str, Any]:
        header = {**_header(reading.time), "frame_id": self._robot.profile.base_link}
        point = dict(zip("xyz", reading.tool.tolist(), strict=True))
        if kind_of_type(self._topics.tool_type) is Kind.POINT:
            return {"header": header, "point": point}
        upright = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}  # the orientation is not known
        return {"header": header, "pose": {"position": point, "orientation": upright}}

    def _trajectory(self, command: CommandSent) -> dict[str, Any]:
        """Return a trajectory with a point wherever a motor arrives; lines between are exact."""
        points = []
        for due in np.unique(command.duration):
            share = np.divide(
                due, command.duration, out=np.ones_like(command.target), where=command.duration > 0
            )
            angle = self._origin + np.minimum(share, 1.0) * (command.target - self._origin)
            points.append(
                {
                    "positions": angle.tolist(),
                    "velocities": [],
                    "accelerations": [],
                    "effort": [],
                    "time_from_start": stamp_of(float(due)),
                }
            )
        names = [motor.joint for motor in self._robot.motors]
        return {"header": _header(command.time), "joint_names": names, "points": points}


def _header(time: float) -> dict[str, Any]:
    return {"seq": 0, "stamp": stamp_of(time), "frame_id": ""}


# Answers as diagnostics messages, when it is time for one.


class DiagnosticsPublisher:
    """Writes a message every second, and at once when a status gets worse.

    Args:
        robot: The robot.
        topics: Names the topic.
    """

    def __init__(self, robot: Robot, topics: RosTopics) -> None:
        self._robot = robot
        self._topics = topics
        self._beat = RateLimiter()

    def message(self, answer: Answer) -> Outgoing | None:
        """Return the message for an answer, None if it is not time for one."""
        found = statuses(answer, self._robot.motor_names)
        if not self._beat.due(found, time.monotonic()):
            return None
        return diagnostics_message(found, answer.time, self._topics, self._robot)
