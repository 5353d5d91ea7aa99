"""Recorded ROS data as runs: ROS 1 bags, ROS 2 bags and MCAP files, read without ROS.

Angles are taken in the sense of the robot's commands, tool positions in its base frame.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import cast

import numpy as np

from failuretwin.core.errors import InputError, unknown_name
from failuretwin.core.runs import GOAL_VARIABLE
from failuretwin.core.types import FloatArray, IntArray, as_floats
from failuretwin.data_knowledge.readers.bag_file import read_messages, read_topics
from failuretwin.data_knowledge.readers.bag_messages import (
    GOAL_TOPIC,
    KINDS,
    NS_PER_S,
    ROLES,
    BagMessage,
    BagTopic,
    BagTopics,
    Kind,
    Role,
    Rows,
    check_role,
    topic_rows,
)
from failuretwin.data_knowledge.readers.timed_log import Samples, Targets, TimedLog, held
from failuretwin.digital_model.robot import Robot

CLOCK_GAP_NS = 3600 * NS_PER_S
"""A silence of this length [ns] means that the stamps come from more than one clock."""


def read_bag(path: Path, robot: Robot, topics: BagTopics | None = None) -> TimedLog:
    """Read a ROS 1 bag (.bag), a ROS 2 bag (folder or .db3) or an MCAP file.

    Joints that the robot does not have are ignored. Without `topics` those are read whose type and
    name fit.

    Returns:
        One log, named after the file; its time counts from its first stamp.

    Raises:
        InputError: If it cannot be read, holds nothing that is understood, leaves a choice between
            topics, or lacks a joint.
    """
    recording = _Recording(path, robot, topics or BagTopics())
    command, tool = recording.commands(), recording.rows("tool")
    position = recording.rows("position", needed=tool is None)
    goal = recording.rows("goal")
    if tool is None and position is not None:
        _check_whole(position)
    zero_ns = _first_stamp([t for t in (command, tool, position) if t is not None], path)
    return TimedLog(
        name=path.name if path.is_dir() else path.stem,
        command=_command(command, position, zero_ns),
        tool=None if tool is None else _samples(tool, zero_ns),
        position=None if position is None else _samples(position, zero_ns),
        sensors={} if goal is None else {GOAL_VARIABLE: _samples(goal, zero_ns)},
    )


def read_targets(path: Path, robot: Robot) -> Targets | None:
    """Read targets from a bag that holds commands alone, such as `failuretwin design` writes.

    Returns:
        The targets, their times from the first; None: it holds readings too, or no targets.

    Raises:
        InputError: If it cannot be read, or lacks a joint.
    """
    recording = _Recording(path, robot, BagTopics())
    fitting = recording.fitting
    if fitting["tool"] or fitting["position"] or not fitting["command"]:
        return None
    rows = recording.commands()
    command = _command(rows, None, int(rows.stamp_ns[0])) if len(rows.stamp_ns) else None
    return command if isinstance(command, Targets) else None


# Which topic of a recording is what: commands, the tool's position, motor readings.

EXPECTED: dict[Role, str] = {
    "command": "no commands. Expected a JointTrajectory, or joint values on a topic that has "
    "`command` or `position_monitoring` in its name",
    "position": "neither tool positions nor motor readings. Expected a PointStamped, PoseStamped, "
    "TFMessage or JointState, or a topic `condition_monitoring`",
}
"""Text for a recording in which no topic fits a role that is needed."""
COMMAND_WORDS = ("command", "cmd", "position_monitoring")
"""A topic of joint values with one of these in its name holds commands."""
WISH_WORDS = (*COMMAND_WORDS, "desired", "goal", "reference", "setpoint", "target")
"""A topic with one of these in its name holds no readings."""
LISTED_TOPICS = 20
"""Topics that an error text lists at most."""


class _Recording:
    """A recording of a robot: its topics, those that fit each role, and their messages."""

    def __init__(self, path: Path, robot: Robot, named: BagTopics) -> None:
        self.path, self.robot, self.found = path, robot, read_topics(path)
        self.fitting = {role: self._fitting(role, getattr(named, role)) for role in ROLES}
        if not any(topic.count and topic.kind for topic in self.found):
            kinds = ", ".join(kind.value for kind in Kind)
            raise InputError(
                f"{path}: holds no messages that are understood. Expected {kinds}. "
                f"Found: {_listed(self.found)}."
            )

    def _fitting(self, role: Role, name: str | None) -> list[BagTopic]:
        """Return the topics that can play a role: the one named, or all that type and name allow.

        Raises:
            InputError: If the topic named does not exist, is empty or cannot play the role.
        """
        if name is None:
            return [topic for topic in self.found if topic.count and _suits(role, topic)]
        same = [topic for topic in self.found if topic.name.strip("/") == name.strip("/")]
        if not same:
            names = [topic.name for topic in self.found]
            raise InputError(f"{self.path}: {unknown_name('topic', name, names)}")
        (topic,) = same
        check_role(role, topic.kind, f"{self.path}: topic {topic}")
        if topic.count == 0:
            raise InputError(
                f"{self.path}: topic {topic} is empty. Name another one as the {role}."
            )
        return same

    @cached_property
    def messages(self) -> dict[str, list[BagMessage]]:
        """Messages of all topics that fit a role, by topic."""
        names = {topic.name for topics in self.fitting.values() for topic in topics}
        return read_messages(self.path, sorted(names))

    def commands(self) -> Rows:
        """Return the rows of the topic with the commands, each motor with a value somewhere.

        Raises:
            InputError: If there is none, or as `rows`.
        """
        rows = cast("Rows", self.rows("command", needed=True))
        never = np.flatnonzero(~np.isfinite(rows.value).any(axis=0))
        if len(never):
            names = ", ".join(self.robot.motor_names[k] for k in never)
            raise InputError(f"{rows.where}: no command holds a value for {names}. Record them.")
        return rows

    def rows(self, role: Role, *, needed: bool = False) -> Rows | None:
        """Return the rows of the topic for a role; a topic of other joints counts only if needed.

        Raises:
            InputError: If there are several topics, none that is needed, or a motor is missing.
        """
        read = {topic: self._read(topic, role) for topic in self.fitting[role]}
        ours = [topic for topic, rows in read.items() if self._is_ours(topic, rows, role)]
        if len(ours) > 1:
            example = f'{role} = "{ours[0].name}"'
            raise InputError(
                f"{self.path}: several topics could be the {role}: {_listed(ours)}. Name one, such "
                f"as {example}, under [topics] in a TOML file for --columns or in BagTopics in "
                "Python."
            )
        if needed and not read:
            raise InputError(
                f"{self.path}: holds {EXPECTED[role]}; if another topic holds them, name it under "
                "[topics] in a TOML file for --columns or in BagTopics in Python. Found: "
                f"{_listed(self.found)}."
            )
        chosen = [read[topic] for topic in ours] or list(read.values())[: int(needed)]
        if role == "tool" or not chosen:
            return chosen[0] if chosen else None
        return motor_rows(chosen[0], self.robot)

    def _read(self, topic: BagTopic, role: Role) -> Rows:
        kind = cast("Kind", topic.kind)  # one that fits the role
        where = f"{self.path}: topic {topic.name}"
        return topic_rows(self.messages[topic.name], kind, role, where, self.robot)

    def _is_ours(self, topic: BagTopic, rows: Rows, role: Role) -> bool:
        """Return whether a topic names a motor of this robot; transforms may be of anything."""
        if role != "tool":
            schemes = _schemes(self.robot, in_counts=False).values()
            return any(set(scheme) & set(rows.names) for scheme in schemes)
        return topic.kind is not Kind.TRANSFORMS or len(rows.stamp_ns) > 0


def _suits(role: Role, topic: BagTopic) -> bool:
    kind, name = topic.kind, topic.name.lower()
    if kind not in KINDS[role]:
        return False
    if role == "goal":
        return topic.name == GOAL_TOPIC
    if role == "command":
        return kind is Kind.TRAJECTORY or any(word in name for word in COMMAND_WORDS)
    return not any(word in name for word in WISH_WORDS)


def _listed(topics: Sequence[BagTopic]) -> str:
    shown = [str(topic) for topic in topics[:LISTED_TOPICS]]
    if len(topics) > LISTED_TOPICS:
        shown.append(f"and {len(topics) - LISTED_TOPICS} more")
    return ", ".join(shown) or "no topics"


# Joints of a recording as motors of the robot.


def motor_rows(rows: Rows, robot: Robot) -> Rows:
    """Return the angles of the robot's motors [rad], without rows that name none of them."""
    columns = _motor_columns(rows, robot)
    angle = rows.value[:, columns]
    if rows.in_counts:
        units = robot.servo_units
        # A reading out of range is a glitch; a command out of range is one for the end stop.
        sound = np.isfinite(angle) if rows.duration is not None else units.valid(angle)
        angle = np.where(sound, units.to_rad(angle), np.nan)
    duration = None if rows.duration is None else rows.duration[:, columns]
    motors = Rows(rows.where, rows.stamp_ns, angle, tuple(robot.motor_names), duration)
    return motors.take(np.asarray(np.isfinite(angle).any(axis=1)))


def _motor_columns(rows: Rows, robot: Robot) -> list[int]:
    """Return the column of each motor, in chain order.

    All motors are named in one way: by joint, by motor, by log column, or by the number that the
    log column ends in. The same name may mean two motors in two ways (the log column ``motor_1``
    of the ArmPi is not its motor 1), so the ways are never mixed and their order matters: values
    in counts come from the servo bus, angles from a driver that knows joints.

    Raises:
        InputError: If a motor is missing.
    """
    schemes = _schemes(robot, in_counts=rows.in_counts)
    column = {name: index for index, name in enumerate(rows.names)}
    for wanted in schemes.values():
        if all(name in column for name in wanted):
            return [column[name] for name in wanted]
    best = max(schemes.values(), key=lambda wanted: sum(name in column for name in wanted))
    missing = [name for name in best if name not in column]
    ways = "; ".join(f"{kind} {', '.join(wanted)}" for kind, wanted in schemes.items())
    named = ", ".join(rows.names) or "no joint at all"
    raise InputError(
        f"{rows.where}: values for {', '.join(missing)} are missing; it names {named}. Expected "
        f"all motors of {robot.name!r} by one of these: {ways}."
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


def _check_whole(position: Rows) -> None:
    """Raise an InputError if no row of readings suffices to compute the tool path from."""
    if not np.isfinite(position.value).all(axis=1).any():
        raise InputError(
            f"{position.where}: no message holds sound readings of all motors, which the tool path "
            "is computed from. Record one message for all of them, or the tool's position."
        )


def _first_stamp(tracks: Sequence[Rows], path: Path) -> int:
    """Return the earliest stamp [ns], once it is sure that all stamps are of one clock.

    Raises:
        InputError: If a silence within the recording is too long for one clock.
    """
    stamps = np.sort(np.concatenate([track.stamp_ns for track in tracks]))
    steps = np.diff(stamps)
    if len(steps) and steps.max() > CLOCK_GAP_NS:
        spans = "; ".join(
            f"{track.where.removeprefix(f'{path}: ')} from {track.stamp_ns[0] / NS_PER_S:.3f} to "
            f"{track.stamp_ns[-1] / NS_PER_S:.3f} s"
            for track in tracks
            if len(track.stamp_ns)
        )
        raise InputError(
            f"{path}: its stamps lie {steps.max() / CLOCK_GAP_NS:.1f} hours apart: {spans}. "
            "Expected one run by one clock. Set the clocks before recording, or cut the recording."
        )
    return int(stamps[0])


def _seconds(stamp_ns: IntArray, zero_ns: int) -> FloatArray:
    # Subtracted as whole numbers: today's epoch in float64 seconds is only good to 0.2 us.
    return as_floats((stamp_ns - zero_ns) / NS_PER_S)


def _samples(track: Rows, zero_ns: int) -> Samples:
    return Samples(_seconds(track.stamp_ns, zero_ns), track.value)


def _command(command: Rows, position: Rows | None, zero_ns: int) -> Samples | Targets:
    if command.duration is None:
        return _samples(command, zero_ns)
    rows = slice(int(_starts_with_known_pose(command, position)), None)
    target, duration = command.value[rows], command.duration[rows]
    known = np.isfinite(target)
    # A motor that a message leaves out stays where it was sent, for as long as the others move.
    longest = np.nanmax(np.where(known, duration, np.nan), axis=1, keepdims=True)
    return Targets(
        time=_seconds(command.stamp_ns[rows], zero_ns),
        target=held(target),
        duration=np.where(known, duration, longest),
    )


def _starts_with_known_pose(command: Rows, position: Rows | None) -> bool:
    """Return whether the first target only repeats where the readings say that the arm stands.

    Planners begin a trajectory with the pose it starts from. It is no movement, and readings tell
    the pose better: the two differ a little, which would look like a jump of the reference.
    """
    if command.duration is None or position is None:
        return False
    if len(command.stamp_ns) < 2 or len(position.stamp_ns) == 0:
        return False
    at_once = bool(np.nanmax(command.duration[0]) == 0.0)
    followed = command.stamp_ns[1] - command.stamp_ns[0] == 1
    return at_once and bool(followed) and bool(position.stamp_ns[0] <= command.stamp_ns[0])
