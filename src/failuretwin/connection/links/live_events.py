"""From what a live robot says to readings and commands in the order of their times."""

from __future__ import annotations

import heapq
import time
from bisect import insort
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from threading import Lock
from typing import Any, Self

import numpy as np

from failuretwin.connection.links.base import CommandSent, Event, EventQueue, LinkCounts, Reading
from failuretwin.connection.links.ros_messages import RosTopics
from failuretwin.core.errors import InputError
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.bag_file import BagMessage
from failuretwin.data_knowledge.bag_messages import (
    KINDS,
    NS_PER_S,
    Kind,
    Role,
    joint_rows,
    tool_rows,
)
from failuretwin.data_knowledge.bags import Track, motor_track
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin

# What was commanded, while a robot is at work.

Corner = tuple[float, FloatArray]
"""Time [s] and angles (motor,) [rad]."""


@dataclass(frozen=True)
class _Ramp:
    """Straight lines of all motors from one pose to another."""

    start: float
    origin: FloatArray
    target: FloatArray
    duration: FloatArray

    def at(self, time: float) -> FloatArray:
        since = np.full_like(self.duration, time - self.start)
        share = np.divide(since, self.duration, out=np.ones_like(since), where=self.duration > 0.0)
        return np.asarray(self.origin + np.clip(share, 0.0, 1.0) * (self.target - self.origin))


class LiveReference:
    """Follows commands: where every motor's reference stands, and where its corners are.

    A command that comes while another runs takes over from where the reference has come to. One
    that is still to come is replaced by any that is sent for the same time or earlier.

    Attributes:
        late_s: The longest time by which a command came too late to begin when it should [s].
    """

    def __init__(self) -> None:
        self.late_s = 0.0
        self._ramp: _Ramp | None = None
        self._pending: list[CommandSent] = []
        self._known_until = -np.inf

    def start_at(self, pose: FloatArray) -> None:
        """Say where the arm stands before the first command, (motor,) [rad]; later: nothing."""
        if self._ramp is None:
            zero = np.zeros_like(pose)
            self._ramp = _Ramp(-np.inf, pose, pose, zero)

    def add(self, command: CommandSent) -> None:
        """Take a command; its time may be now, to come, or a little in the past."""
        self._pending = [one for one in self._pending if one.time < command.time]
        insort(self._pending, command, key=lambda one: one.time)

    def corners_to(self, time: float) -> list[Corner]:
        """Return the corners since the last call, up to a time [s], and the reference then.

        Nothing is returned before the first command or the first pose.
        """
        corners: list[Corner] = []
        while self._pending and self._pending[0].time <= time:
            self._begin(self._pending.pop(0), corners)
        self._bends(time, corners)
        if self._ramp is not None and time > self._known_until:
            corners.append((time, self._ramp.at(time)))
        self._known_until = max(self._known_until, time)
        return corners

    def _begin(self, command: CommandSent, corners: list[Corner]) -> None:
        # What has been told cannot be taken back: a command that comes late starts late.
        start = max(command.time, self._known_until)
        self._bends(start, corners)
        if self._ramp is None:
            origin = command.target
        else:
            origin = self._ramp.at(start)
            if start > self._known_until:
                corners.append((start, origin))
                self._known_until = start
        lost = start - command.time
        self.late_s = max(self.late_s, lost)
        duration = np.maximum(command.duration - lost, 0.0)
        self._ramp = _Ramp(start, origin, command.target, duration)

    def _bends(self, time: float, corners: list[Corner]) -> None:
        """Add the ends of the ramps that lie before a time [s]."""
        if self._ramp is None:
            return
        for end in np.unique(self._ramp.start + self._ramp.duration):
            if self._known_until < end < time:
                corners.append((float(end), self._ramp.at(float(end))))
                self._known_until = float(end)


# Events in the order of their times, where commands may arrive later than readings.

HELD_BACK = 10_000
"""Events that are held back at most; beyond it the oldest go on without waiting."""


class ReorderBuffer:
    """Holds events back for a time, so that those that come late can take their place.

    Args:
        hold_s: How long an event waits for others [s]; 0: not at all.
    """

    def __init__(self, hold_s: float = 0.0) -> None:
        self._hold_s = hold_s
        self._waiting: list[tuple[float, bool, int, Event]] = []
        self._number = count()

    def add(self, event: Event) -> None:
        """Take an event."""
        entry = (event.time, not isinstance(event, CommandSent), next(self._number), event)
        heapq.heappush(self._waiting, entry)

    def ready(self, now: float) -> list[Event]:
        """Return the events that have waited for long enough at a time [s] of the stream."""
        events = []
        while self._waiting and (
            self._waiting[0][0] <= now - self._hold_s or len(self._waiting) > HELD_BACK
        ):
            events.append(heapq.heappop(self._waiting)[-1])
        return events


# Commands out of references that are only known as samples, as controllers stream them.

STILL_RAD = 1e-9
"""Samples closer than this are the same [rad]."""
FIRST_S = 0.0
"""Time that the first sample gives to get there [s]: it only says where the reference stands."""


class SampledCommands:
    """Turns samples of a reference into commands that draw the same line.

    Between two samples the reference runs straight, which is known only when the second has come:
    each command bears the time of the sample before it.
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
            return CommandSent(time, value, np.full(len(value), FIRST_S))
        if time <= before[0] or np.abs(value - before[1]).max() < STILL_RAD:
            return None
        return CommandSent(before[0], value, np.full(len(value), time - before[0]))


# Messages of a live robot as readings and commands; what each field means is the bags' business.


def motor_reading(time: float, angle: FloatArray, twin: DigitalTwin) -> Reading:
    """Return motor readings as the reading of a virtual tool sensor, as published.

    Args:
        time: By the robot's clock [s].
        angle: (motor,) [rad], NaN where one is missing; then there is no tool position.
        twin: Kinematics of the robot.
    """
    sound = bool(np.isfinite(angle).all())
    return Reading(time, twin.path(angle) if sound else np.full(3, np.nan), angle)


def goal_reading(time: float, goal: FloatArray) -> Reading:
    """Return what motors report to have received, (motor,) [rad], as a reading of nothing else."""
    return Reading(time, np.full(3, np.nan), goal=goal)


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
        if self._role == "goal":
            return self._goal_events(track)
        return self._command_events(track) if command else self._position_events(track)

    def _goal_events(self, track: Track) -> list[Event]:
        rows = zip(track.stamp_ns.tolist(), track.value, strict=True)
        return [goal_reading(s / NS_PER_S, self._checked(v, LARGEST_RAD)) for s, v in rows]

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


class NetworkSource:
    """A source that messages come to from any thread; what makes no sense is counted and left out.

    Args:
        robot: The robot.
        topics: Its topics.
        queue: Where events wait to be fetched; None: a queue of its own.

    Raises:
        InputError: If messages hold servo counts and the robot has none.
    """

    ended = False
    name = ""

    def __init__(self, robot: Robot, topics: RosTopics, queue: EventQueue | None) -> None:
        topics.check_fits(robot)
        self._queue = EventQueue() if queue is None else queue
        self._readers = {role: RosReader(robot, role, topics) for role, _, _ in topics.subscribed}
        self._lock = Lock()
        self._garbage, self._last_garbage = 0, ""

    @property
    def reconnects(self) -> int:
        """How often the far side went away and came back."""
        return 0

    @property
    def counts(self) -> LinkCounts:
        """What it has seen so far."""
        queue, garbage = self._queue, self._garbage
        return LinkCounts(
            queue.received, garbage, queue.dropped, self.reconnects, self._last_garbage
        )

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
                self.note(f"{type(error).__name__}: {error}")
                return
            for event in events:
                self._queue.put(event)

    def note(self, what: str) -> None:
        """Count a message that made no sense, or says that something is wrong."""
        self._garbage += 1
        self._last_garbage = what

    def poll(self, timeout_s: float) -> Event | None:
        """Return the next event; None if none came within `timeout_s` [s]."""
        return self._queue.get(timeout_s)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop listening."""
