"""Topics of a robot on ROS: names, types and roles, from TOML or Python."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from failuretwin.core.config import from_table, read_toml
from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.readers.bag_messages import (
    ROLES,
    Kind,
    Role,
    check_role,
    kind_of_type,
)
from failuretwin.digital_model.robot import Robot

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
        tool_type: Its type: a PointStamped or a PoseStamped.
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
