"""Readings and commands from ROS messages: one reader per topic."""

from __future__ import annotations

from typing import Any

import numpy as np

from failuretwin.connection.links.base import CommandSent, Event, Reading
from failuretwin.connection.links.ros_topics import RosTopics
from failuretwin.core.errors import InputError
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.readers.bag_file import BagMessage
from failuretwin.data_knowledge.readers.bag_messages import (
    KINDS,
    NS_PER_S,
    Kind,
    Role,
    Rows,
    topic_rows,
)
from failuretwin.data_knowledge.readers.bags import motor_rows
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin

STILL_RAD = 1e-9
"""Largest difference of two samples that count as equal [rad]."""
LARGEST = 100.0
"""Largest valid angle [rad] and tool coordinate [m]."""
LONGEST_S = 600.0
"""Longest valid duration of a command [s]."""


def motor_reading(time: float, angle: FloatArray, twin: DigitalTwin) -> Reading:
    """Return motor readings with the tool position computed from them, as in the published data.

    Args:
        time: Time by the robot's clock [s].
        angle: (motor,) [rad], NaN where one is missing; then there is no tool position.
        twin: Kinematics of the robot.
    """
    complete = bool(np.isfinite(angle).all())
    return Reading(time, twin.path(angle) if complete else np.full(3, np.nan), angle)


def goal_reading(time: float, goal: FloatArray) -> Reading:
    """Return a reading of nothing but the goals that the motors report, (motor,) [rad]."""
    return Reading(time, np.full(3, np.nan), goal=goal)


class SampledCommands:
    """Converts samples of a reference, as controllers stream them, into commands.

    The reference is taken as a straight line between two samples. The line is known when the second
    sample has come, so each command has the time of the sample before it.
    """

    def __init__(self) -> None:
        self._before: tuple[float, FloatArray] | None = None

    def add(self, time: float, value: FloatArray) -> CommandSent | None:
        """Return the command that a sample completes, None while the reference stands still.

        Args:
            time: Time of the sample [s].
            value: The reference, (motor,) [rad].
        """
        before, self._before = self._before, (time, value)
        if before is None:
            return CommandSent(time, value, np.zeros(len(value)))
        if time <= before[0] or np.abs(value - before[1]).max() < STILL_RAD:
            return None
        return CommandSent(before[0], value, np.full(len(value), time - before[0]))


class RosReader:
    """Converts the messages of one topic into events.

    Args:
        robot: The robot.
        role: Role of the topic.
        topics: All topics. Motor readings give the tool position only if no tool topic is named.
    """

    def __init__(self, robot: Robot, role: Role, topics: RosTopics) -> None:
        self._robot = robot
        self._twin = DigitalTwin(robot)
        self._role = role
        self._sees_tool = bool(topics.tool)
        self._where = next(f"topic {name}" for r, name, _ in topics.subscribed if r == role)
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
        if kind not in KINDS[self._role]:
            raise InputError(f"{self._where}: {kind.value} cannot be the {self._role}.")
        rows = topic_rows([BagMessage(received_ns, content)], kind, self._role, self._where)
        if self._role != "tool":
            rows = motor_rows(rows, self._robot)
        if self._role == "command":
            return self._commands(rows)
        return self._readings(rows.stamp_ns.tolist(), rows.value)

    def _readings(self, stamps_ns: list[int], values: FloatArray) -> list[Event]:
        checked = self._checked(values, LARGEST)
        rows = zip(stamps_ns, checked, strict=True)
        return [self._reading(stamp / NS_PER_S, row) for stamp, row in rows]

    def _reading(self, time: float, value: FloatArray) -> Reading:
        if self._role == "tool":
            return Reading(time, value)
        if self._role == "goal":
            return goal_reading(time, value)
        if self._sees_tool:
            return Reading(time, np.full(3, np.nan), value)
        return motor_reading(time, value, self._twin)

    def _commands(self, rows: Rows) -> list[Event]:
        targets = self._checked(rows.value, LARGEST)
        times = (rows.stamp_ns / NS_PER_S).tolist()
        if rows.duration is None:
            samples = zip(times, targets, strict=True)
            sampled = [self._samples.add(time, self._completed(row)) for time, row in samples]
            return [command for command in sampled if command is not None]
        durations = self._checked(rows.duration, LONGEST_S)
        events: list[Event] = []
        for row, time in enumerate(times):
            target, longest = self._completed(targets[row]), float(np.nanmax(durations[row]))
            if row == 0 and len(times) > 1 and not longest > 0.0 and self._target is not None:
                continue  # the first point of a trajectory may only repeat the present pose
            self._target = target
            duration = np.where(durations[row] >= 0, durations[row], longest)
            events.append(CommandSent(time, target, duration))
        return events

    def _completed(self, target: FloatArray) -> FloatArray:
        """Return a target in which motors that are not named keep their last target."""
        if self._target is not None:
            return np.where(np.isfinite(target), target, self._target)
        if not np.isfinite(target).all():
            raise InputError(f"{self._where}: the first command does not name every motor.")
        return target

    def _checked(self, values: FloatArray, largest: float) -> FloatArray:
        if np.any(np.abs(values) > largest):
            raise InputError(
                f"{self._where}: a message holds {np.nanmax(np.abs(values)):g}, expected values up "
                f"to {largest:g}."
            )
        return values
