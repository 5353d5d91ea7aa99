"""Readings, commands and answers as ROS messages of plain values."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from failuretwin.connection.links.base import Answer, CommandSent, Item, Reading
from failuretwin.connection.links.ros_codec import Outgoing
from failuretwin.connection.links.ros_topics import RosTopics
from failuretwin.connection.links.statuses import RateLimiter, Status, statuses
from failuretwin.core.errors import InputError
from failuretwin.core.types import MS_PER_S, FloatArray
from failuretwin.data_knowledge.readers.bag_messages import NS_PER_S, Kind, kind_of_type
from failuretwin.digital_model.robot import Robot

DIAGNOSTICS_TYPE = "diagnostic_msgs/DiagnosticArray"


class RosWriter:
    """Writes readings and commands as the robot itself would.

    Args:
        robot: The robot.
        topics: Its topics.

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
        self._origin = np.zeros(len(robot.motors))

    def start_at(self, angle: FloatArray) -> None:
        """Set the angles from which the next command starts, (motor,) [rad]."""
        self._origin = angle

    @property
    def topics(self) -> list[tuple[str, str]]:
        """Name and type of every topic that may be written to."""
        return [(name, type_) for _, name, type_ in self._topics.subscribed]

    def messages(self, item: Item) -> list[Outgoing]:
        """Return the messages of a reading or command; none for an answer."""
        if isinstance(item, Reading):
            return self._of_reading(item)
        return [self.command(item)] if isinstance(item, CommandSent) else []

    def command(self, command: CommandSent) -> Outgoing:
        """Return the message of a command."""
        type_ = self._topics.command_type
        if kind_of_type(type_) is Kind.TRAJECTORY:
            content = self._trajectory(command)
        else:
            content = self._joints(command.time, command.target, type_)
            # The authors' message has no field for durations; they write them as temperatures.
            content["temperature"] = (command.duration * MS_PER_S).tolist()
        self._origin = command.target
        return Outgoing(self._topics.command, type_, content)

    def _of_reading(self, reading: Reading) -> list[Outgoing]:
        topics, time, messages = self._topics, reading.time, []
        for topic, type_, angle in (
            (topics.position, topics.position_type, reading.position),
            (topics.goal, topics.goal_type, reading.goal),
        ):
            if topic and angle is not None:
                messages.append(Outgoing(topic, type_, self._joints(time, angle, type_)))
        if topics.tool and np.isfinite(reading.tool).all():
            messages.append(Outgoing(topics.tool, topics.tool_type, self._tool(reading)))
        return messages

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
        unknown = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
        return {"header": header, "pose": {"position": point, "orientation": unknown}}

    def _trajectory(self, command: CommandSent) -> dict[str, Any]:
        """Return a trajectory with one point per time of arrival, which makes it exact."""
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
                    "time_from_start": _stamp(float(due)),
                }
            )
        names = [motor.joint for motor in self._robot.motors]
        return {"header": _header(command.time), "joint_names": names, "points": points}


def _header(time: float) -> dict[str, Any]:
    return {"seq": 0, "stamp": _stamp(time), "frame_id": ""}


def _stamp(time: float) -> dict[str, int]:
    secs, nsecs = divmod(round(time * NS_PER_S), NS_PER_S)
    return {"secs": secs, "nsecs": nsecs}


class DiagnosticsWriter:
    """Writes answers as diagnostics: every second, and at once when a status gets worse.

    Args:
        robot: The robot.
        topic: Topic of the diagnosis.
    """

    def __init__(self, robot: Robot, topic: str) -> None:
        self._robot = robot
        self._limiter = RateLimiter()
        self.topics = [(topic, DIAGNOSTICS_TYPE)]

    def messages(self, item: Item) -> list[Outgoing]:
        """Return the message of an answer if one is due; none for a reading or command."""
        if not isinstance(item, Answer):
            return []
        current = statuses(item, self._robot.motor_names)
        if not self._limiter.due(current, time.monotonic()):
            return []
        array = [self._status(status) for status in current]
        content = {"header": _header(item.time), "status": array}
        return [Outgoing(*self.topics[0], content)]

    def _status(self, status: Status) -> dict[str, Any]:
        return {
            "level": status.level,
            "name": f"failuretwin: {status.name}",
            "message": status.message,
            "hardware_id": self._robot.name,
            "values": [{"key": key, "value": value} for key, value in status.values.items()],
        }
