"""Topics of a robot on ROS, and readings, commands and answers from and to their messages."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from failuretwin.connection.links.base import Answer, CommandSent, Event, Item, Reading
from failuretwin.connection.links.ros_transport import Outgoing
from failuretwin.connection.links.statuses import Status, statuses
from failuretwin.connection.links.stream_time import SHORTEST_S, Ramp
from failuretwin.core.config import from_table, read_toml
from failuretwin.core.errors import InputError
from failuretwin.core.types import MS_PER_S, FloatArray
from failuretwin.data_knowledge.readers.bag_messages import (
    NS_PER_S,
    ROLES,
    BagMessage,
    Kind,
    Role,
    check_role,
    kind_of_type,
    topic_rows,
)
from failuretwin.data_knowledge.readers.bags import motor_rows
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin

# Topics: names, types and roles, from TOML or Python.

AUTHORS_TYPE = "cm/msg_cm"
"""Type of the message of the data set's authors; other packages may define the same fields."""
STANDARD_PACKAGES = ("std_msgs", "sensor_msgs", "geometry_msgs", "trajectory_msgs", "nav_msgs")
"""Packages of ROS itself, whose types never have the authors' fields."""
TOPIC_NAME = re.compile(r"[~/]?[A-Za-z]\w*(/[A-Za-z]\w*)*")
"""Topic names that ROS accepts."""
SET_POINTS_LATE_S = 0.5
"""Time that readings wait for streamed set-points [s]; enough for two set-points a second. The
reference between two set-points is known when the second has come."""


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
        tool_type: Its type: a PointStamped, a PoseStamped or a TFMessage.
        goal: Topic of the goals that the motors report as received; empty: none.
        goal_type: Its type: a JointState or a message with the authors' fields.
        diagnostics: Topic of the diagnosis.
        commands_late_s: Longest delay of commands after their stamps [s]; readings wait that long
            for them. The authors' programs publish a command two seconds after they send it.
            None: no waiting, or `SET_POINTS_LATE_S` if set-points are streamed.
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
                    f"{role} is {name!r}, which is not a topic name. Expected letters, digits, _ "
                    "and /, such as /arm_controller/command."
                )
            kind = kind_of_type(type_)
            foreign = kind is Kind.MONITORING and type_.split("/")[0] in STANDARD_PACKAGES
            check_role(role, None if foreign else kind, f"{role}_type is {type_!r}, which")

    @property
    def wait_s(self) -> float:
        """Time that readings wait for late commands [s]."""
        if self.commands_late_s is not None:
            return self.commands_late_s
        streamed = kind_of_type(self.command_type) is Kind.JOINT_STATE
        return SET_POINTS_LATE_S if streamed else 0.0

    def check_fits(self, robot: Robot) -> None:
        """Raise InputError if messages hold servo counts and the robot's profile has none."""
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
        """Role, name and type of every topic of the robot."""
        named = [role for role in ROLES if getattr(self, role)]
        return [(role, getattr(self, role), getattr(self, f"{role}_type")) for role in named]


def load_topics(path: Path | None) -> RosTopics:
    """Return the topics in a TOML file with the fields of `RosTopics`; None: the defaults.

    Raises:
        InputError: If the file cannot be read, or has an unknown key or an invalid value.
    """
    return RosTopics() if path is None else from_table(RosTopics, read_toml(path), str(path))


# Reading.

STILL_RAD = 1e-9
"""Largest difference of two samples that count as equal [rad]."""
LARGEST = 100.0
"""Largest valid angle [rad] and tool coordinate [m]."""
LONGEST_S = 600.0
"""Longest valid duration of a command [s]."""


def motor_reading(time: float, angle: FloatArray, twin: DigitalTwin) -> Reading:
    """Return motor readings with the tool position computed from them, as in the published data.

    Angles are (motor,) [rad], NaN where one is missing; then there is no tool position.
    """
    if np.isfinite(angle).all():
        return Reading(time, twin.path(angle), angle)
    return Reading(time, position=angle)


class SampledCommands:
    """Converts samples of a reference, as controllers stream them, into commands.

    The reference is taken as a straight line between two samples. The line is known when the second
    sample has come, so each command has the time of the sample before it.
    """

    def __init__(self) -> None:
        self._before: tuple[float, FloatArray] | None = None

    def add(self, time: float, value: FloatArray) -> CommandSent | None:
        """Return the command that a sample completes, None while the reference stands still.

        Samples have a time [s] and the reference then, (motor,) [rad].
        """
        before, self._before = self._before, (time, value)
        if before is None:
            return CommandSent(time, value, np.zeros(len(value)))
        if time <= before[0] or np.abs(value - before[1]).max() < STILL_RAD:
            return None
        return CommandSent(before[0], value, np.full(len(value), time - before[0]))


class RosReader:
    """Converts the messages of the topic with one role into events.

    Motor readings give the tool position only if no tool topic is named.
    """

    def __init__(self, robot: Robot, role: Role, topics: RosTopics) -> None:
        self._robot = robot
        self._twin = DigitalTwin(robot)
        self._role = role
        self._sees_tool = bool(topics.tool)
        self._where = f"topic {getattr(topics, role)}"
        self._samples = SampledCommands()
        self._target: FloatArray | None = None

    def events(self, content: Any, kind: Kind, received_ns: int) -> list[Event]:
        """Return the events in a message.

        Args:
            content: The message: an object with the fields of its kind, stamps with `sec` and
                `nanosec`.
            kind: Its kind.
            received_ns: Time of arrival [ns], used if the stamp is zero.

        Raises:
            InputError: If it is invalid.
        """
        check_role(self._role, kind, f"{self._where}: {kind.value}")
        message = BagMessage(received_ns, content)
        rows = topic_rows([message], kind, self._role, self._where, self._robot)
        if self._role != "tool":
            rows = motor_rows(rows, self._robot)
        self._check(rows.value, LARGEST)
        times = (rows.stamp_ns / NS_PER_S).tolist()
        if self._role != "command":
            return list(map(self._reading, times, rows.value))
        if rows.duration is not None:
            return list(self._targets(times, rows.value, rows.duration))
        samples = zip(times, map(self._completed, rows.value), strict=True)
        return [sent for sample in samples if (sent := self._samples.add(*sample)) is not None]

    def _reading(self, time: float, value: FloatArray) -> Reading:
        if self._role == "position" and not self._sees_tool:
            return motor_reading(time, value, self._twin)
        return Reading(time, **{self._role: value})

    def _targets(
        self, times: list[float], targets: FloatArray, durations: FloatArray
    ) -> Iterator[CommandSent]:
        self._check(durations, LONGEST_S)
        for row, target in enumerate(targets):
            duration, longest = durations[row], float(np.nanmax(durations[row]))
            if row == 0 and len(times) > 1 and not longest > 0.0 and self._target is not None:
                continue  # the first point of a trajectory may only repeat the present pose
            self._target = self._completed(target)
            duration = np.where(duration >= 0, duration, longest)
            yield CommandSent(times[row], self._target, duration)

    def _completed(self, target: FloatArray) -> FloatArray:
        """Return a target in which motors that are not named keep their last target."""
        if self._target is not None:
            return np.where(np.isfinite(target), target, self._target)
        if not np.isfinite(target).all():
            raise InputError(f"{self._where}: the first command does not name every motor.")
        return target

    def _check(self, values: FloatArray, largest: float) -> None:
        if np.any(np.abs(values) > largest):
            raise InputError(
                f"{self._where}: a message holds {np.nanmax(np.abs(values)):g}, expected values up "
                f"to {largest:g}."
            )


# Writing.

DIAGNOSTICS_TYPE = "diagnostic_msgs/DiagnosticArray"
PERIOD_S = 1.0
"""Time between two diagnoses when no status gets worse [s]."""


class RosWriter:
    """Writes readings and commands as the robot itself would.

    Attributes:
        origin: Angles from which the next command starts, (motor,) [rad].

    Raises:
        InputError: If commands are a stream of set-points, which cannot carry single commands, or
            messages hold servo counts and the robot's profile has none.
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
        self.origin = np.zeros(len(robot.motors))

    @property
    def topics(self) -> list[tuple[str, str]]:
        """Name and type of every topic that may be written to."""
        return [(name, type_) for _, name, type_ in self._topics.subscribed]

    def messages(self, item: Item) -> list[Outgoing]:
        """Return the messages of a reading or command; none for an answer."""
        if isinstance(item, Reading):
            return list(self._of_reading(item))
        return [self.command(item)] if isinstance(item, CommandSent) else []

    def command(self, command: CommandSent) -> Outgoing:
        """Return the message of a command."""
        topic, type_ = self._topics.command, self._topics.command_type
        if kind_of_type(type_) is Kind.TRAJECTORY:
            message = Outgoing(topic, type_, self._trajectory(command))
        else:
            message = self._joints(topic, type_, command.time, command.target)
            # The authors' message has no field for durations; they write them as temperatures.
            message.content["temperature"] = (command.duration * MS_PER_S).tolist()
        self.origin = command.target
        return message

    def _of_reading(self, reading: Reading) -> Iterator[Outgoing]:
        topics, time = self._topics, reading.time
        if topics.position and reading.position is not None:
            yield self._joints(topics.position, topics.position_type, time, reading.position)
        if topics.goal and reading.goal is not None:
            yield self._joints(topics.goal, topics.goal_type, time, reading.goal)
        if topics.tool and np.isfinite(reading.tool).all():
            yield Outgoing(topics.tool, topics.tool_type, self._tool(reading))

    def _joints(self, topic: str, type_: str, time: float, angle: FloatArray) -> Outgoing:
        motors = self._robot.motors
        if kind_of_type(type_) is Kind.JOINT_STATE:
            names, values = [motor.joint for motor in motors], angle
        else:
            names = [motor.log_column for motor in motors]
            values = self._robot.servo_units.to_counts(angle)
        content = {"header": _header(time), "name": names, "position": values.tolist()}
        return Outgoing(topic, type_, content)

    def _tool(self, reading: Reading) -> dict[str, Any]:
        header = {**_header(reading.time), "frame_id": self._robot.profile.base_link}
        point = dict(zip("xyz", reading.tool.tolist(), strict=True))
        if kind_of_type(self._topics.tool_type) is Kind.POINT:
            return {"header": header, "point": point}
        return {"header": header, "pose": {"position": point, "orientation": {"w": 1.0}}}

    def _trajectory(self, command: CommandSent) -> dict[str, Any]:
        """Return a trajectory with one point per time of arrival, which makes it exact."""
        ramp = Ramp(0.0, self.origin, command.target, command.duration)
        points = [
            {"positions": ramp.at(max(due, SHORTEST_S)).tolist(), "time_from_start": _stamp(due)}
            for due in np.unique(command.duration).tolist()
        ]
        names = [motor.joint for motor in self._robot.motors]
        return {"header": _header(command.time), "joint_names": names, "points": points}


def _header(time: float) -> dict[str, Any]:
    return {"stamp": _stamp(time)}


def _stamp(time: float) -> dict[str, int]:
    secs, nsecs = divmod(round(time * NS_PER_S), NS_PER_S)
    return {"secs": secs, "nsecs": nsecs}


class DiagnosticsWriter:
    """Writes answers as diagnostics: every second, and at once when a status gets worse.

    Attributes:
        topics: Name and type of the topic that is written to.
    """

    def __init__(self, robot: Robot, topics: RosTopics) -> None:
        self._robot = robot
        self._levels: list[int] = []
        self._due_s = -np.inf
        self.topics = [(topics.diagnostics, DIAGNOSTICS_TYPE)]

    def messages(self, item: Item) -> list[Outgoing]:
        """Return the message of an answer if one is due; none for a reading or command."""
        if not isinstance(item, Answer):
            return []
        current = statuses(item, self._robot.motor_names)
        if not self._is_due([status.level for status in current]):
            return []
        array = [self._status(status) for status in current]
        content = {"header": _header(item.time), "status": array}
        return [Outgoing(*self.topics[0], content)]

    def _is_due(self, levels: list[int]) -> bool:
        """Return whether to write these levels now."""
        now_s = time.monotonic()
        worse = any(new > old for new, old in zip(levels, self._levels, strict=False))
        if not worse and now_s < self._due_s:
            return False
        self._levels, self._due_s = levels, now_s + PERIOD_S
        return True

    def _status(self, status: Status) -> dict[str, Any]:
        return {
            "level": status.level,
            "name": f"failuretwin: {status.name}",
            "message": status.message,
            "hardware_id": self._robot.name,
            "values": [{"key": key, "value": value} for key, value in status.values.items()],
        }
