"""Names and types of the topics that a robot is connected by; TOML, Python and defaults agree."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from failuretwin.core.config import from_table, read_toml
from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.bags.messages import Kind
from failuretwin.data_knowledge.bags.topics import KINDS, Role
from failuretwin.digital_model.robot import Robot

AUTHORS_TYPE = "cm/msg_cm"
"""Type of the message of the data set's authors; any other package may define the same fields."""
MONITORING = Kind.MONITORING
STANDARD_TYPES = {kind.value.replace("/msg/", "/"): kind for kind in Kind if kind is not MONITORING}
"""Kinds of the standard types by their ROS 1 names."""
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
            if foreign or kind not in KINDS[role]:
                raise InputError(
                    f"{role}_type is {type_!r}, which cannot be the {role}. Expected "
                    f"{', '.join(k.value for k in KINDS[role])}."
                )

    @property
    def wait_s(self) -> float:
        """How long readings wait for commands that arrive later than their stamps [s]."""
        if self.commands_late_s is not None:
            return self.commands_late_s
        streamed = kind_of_type(self.command_type) is Kind.JOINT_STATE
        return SET_POINTS_LATE_S if streamed else 0.0

    def check_fits(self, robot: Robot) -> None:
        """Raise InputError if a message would hold servo counts and the robot has none."""
        in_counts = [type_ for _, _, type_ in self.subscribed if kind_of_type(type_) is MONITORING]
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
        ]
        return [entry for entry in found if entry[1]]


def kind_of_type(type_: str) -> Kind:
    """Return the kind of a message type; one that is not standard has the authors' fields."""
    return STANDARD_TYPES.get(type_.replace("/msg/", "/"), MONITORING)


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
