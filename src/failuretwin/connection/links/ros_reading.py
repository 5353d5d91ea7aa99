"""Messages of a live robot as readings and commands; what each field means is the bags' business.

A message that makes no sense raises InputError; the link counts it and goes on.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from threading import Lock
from typing import Any

import numpy as np

from failuretwin.connection.links.base import CommandSent, Event, EventQueue, LinkCounts, Reading
from failuretwin.connection.links.live_commands import SampledCommands
from failuretwin.connection.links.recording import motor_reading
from failuretwin.connection.links.ros_messages import RosTopics
from failuretwin.core.errors import InputError
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.bags.file import BagMessage
from failuretwin.data_knowledge.bags.messages import (
    KINDS,
    NS_PER_S,
    Kind,
    Role,
    joint_rows,
    tool_rows,
)
from failuretwin.data_knowledge.bags.read import Track, motor_track
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin

LARGEST_RAD = 100.0
"""Angles beyond this make no sense [rad]."""
LARGEST_M = 100.0
"""Nor do tool positions beyond this [m]."""
LONGEST_S = 600.0
"""Nor durations [s]."""


class RosReader:
    """Reads the messages of one topic.

    Args:
        robot: The robot.
        role: What the topic says.
        topics: All topics. If one of them tells the tool's position, motor readings do not.
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
        """Return what a message says.

        Args:
            content: The message: an object with the fields of its kind, stamps with `sec` and
                `nanosec`.
            kind: Its kind.
            received_ns: When it was received [ns]; stands in for a stamp of zero.

        Raises:
            InputError: If it makes no sense.
        """
        if kind not in KINDS[self._role]:
            raise InputError(f"{self._where}: {kind.value} cannot be the {self._role}.")
        messages = [BagMessage(received_ns, content)]
        if self._role == "tool":
            rows = tool_rows(messages, kind)
            return [
                Reading(stamp / NS_PER_S, self._checked(value, LARGEST_M))
                for stamp, value in zip(rows.stamp_ns.tolist(), rows.value, strict=True)
            ]
        command = self._role == "command"
        values = joint_rows(messages, kind, self._where, command=command)
        track = motor_track(values, self._robot, self._where)
        return self._command_events(track) if command else self._position_events(track)

    def _position_events(self, track: Track) -> list[Event]:
        events: list[Event] = []
        for stamp, angle in zip(track.stamp_ns.tolist(), track.value, strict=True):
            angle = self._checked(angle, LARGEST_RAD)
            if self._sees_tool:
                events.append(Reading(stamp / NS_PER_S, np.full(3, np.nan), angle))
            else:
                events.append(motor_reading(stamp / NS_PER_S, angle, self._twin))
        return events

    def _command_events(self, track: Track) -> list[Event]:
        events: list[Event] = []
        for row, stamp in enumerate(track.stamp_ns.tolist()):
            target = self._completed(self._checked(track.value[row], LARGEST_RAD))
            if track.duration is None:
                sampled = self._samples.add(stamp / NS_PER_S, target)
                events += [] if sampled is None else [sampled]
                continue
            duration = self._checked(track.duration[row], LONGEST_S)
            if self._repeats_pose(row, track, duration):
                continue
            longest = float(np.nanmax(duration))
            self._target = target
            events.append(
                CommandSent(stamp / NS_PER_S, target, np.where(duration >= 0, duration, longest))
            )
        return events

    def _repeats_pose(self, row: int, track: Track, duration: FloatArray) -> bool:
        """Return whether a point only says where a later plan starts, which is no command."""
        at_once = not np.nanmax(duration) > 0.0
        return row == 0 and at_once and len(track.stamp_ns) > 1 and self._target is not None

    def _completed(self, target: FloatArray) -> FloatArray:
        """Return a target in which motors that are not named stay where they were sent."""
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


# Where messages of a network become events that wait to be fetched.

Decode = Callable[[], tuple[Any, Kind]]
"""Returns a message as an object with the fields of its kind, and its kind."""


class Inbox:
    """Takes messages from any thread; what makes no sense is counted and left out.

    Args:
        robot: The robot.
        topics: Its topics.
        queue: Where events wait.

    Raises:
        InputError: If messages hold servo counts and the robot has none.
    """

    def __init__(self, robot: Robot, topics: RosTopics, queue: EventQueue | None) -> None:
        topics.check_fits(robot)
        self._queue = EventQueue() if queue is None else queue
        self._readers = {role: RosReader(robot, role, topics) for role, _, _ in topics.subscribed}
        self._lock = Lock()
        self._garbage, self._last_garbage = 0, ""

    def take(self, role: Role, decode: Decode) -> None:
        """Take a message of the topic that has a role."""
        received_ns = time.time_ns()
        with self._lock:  # each publisher may have a thread
            try:
                content, kind = decode()
                events = self._readers[role].events(content, kind, received_ns)
            # Anyone may publish anything here, and a message of wrong bytes fails in struct, numpy
            # or rosbags. It is counted; the next one may be sound.
            except Exception as error:
                self._garbage += 1
                self._last_garbage = f"{type(error).__name__}: {error}"
                return
            for event in events:
                self._queue.put(event)

    def poll(self, timeout_s: float) -> Event | None:
        """Return the next event; None if none came within `timeout_s` [s]."""
        return self._queue.get(timeout_s)

    def counts(self, reconnects: int) -> LinkCounts:
        """Return what has come so far over a link that was renewed so many times."""
        return LinkCounts(
            self._queue.received,
            self._garbage,
            self._queue.dropped,
            reconnects,
            self._last_garbage,
        )
