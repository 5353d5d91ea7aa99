"""Items as ROS messages, as plain values that every kind of ROS can be given."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from failuretwin.connection.links.diagnostic_status import Status
from failuretwin.connection.links.ros_topics import RosTopics, kind_of_type
from failuretwin.connection.links.values import CommandSent, Reading
from failuretwin.core.errors import InputError
from failuretwin.core.types import FloatArray
from failuretwin.core.units import MS_PER_S
from failuretwin.data_knowledge.bags.messages import NS_PER_S, Kind
from failuretwin.digital_model.robot import Robot

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
