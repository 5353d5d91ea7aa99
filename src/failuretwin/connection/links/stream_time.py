"""Stream time: the robot's clock without jumps, events in order, and the reference they draw."""

from __future__ import annotations

from bisect import bisect_right, insort
from dataclasses import dataclass
from functools import cached_property
from time import time as wall_clock

import numpy as np

from failuretwin.connection.links.base import CommandSent, Event, Reading
from failuretwin.core.types import FloatArray

LEAP_S = 60.0
"""A stamp this far ahead of the newest one is a clock that was set, not a silence [s]."""
BACK_S = 5.0
"""A stamp this far behind the newest one is a clock that was set, not a late message [s]."""
SET_BACK_S, SET_BACK_READINGS = 0.5, 3
"""Number of consecutive readings, each this far behind an earlier one [s], that show a clock that
was set back; a single one is a late message."""
SET_EVENTS = 10
"""Number of consecutive events with equal jumps that show a clock that was set; fewer are invalid
stamps."""


class StreamClock:
    """Converts stamps to a time that starts at zero and never jumps.

    After a jump of the stamps our own clock bridges the gap: permanently if the following stamps
    continue from there, for a single event if its stamp is invalid.

    Attributes:
        jumps: Number of times that the robot's clock was set.
        senseless: Number of events with invalid stamps.
    """

    def __init__(self) -> None:
        self.jumps = self.senseless = 0
        self._offset: float | None = None
        self._newest = 0.0
        self._seen_s = 0.0
        self._last_reading = -np.inf
        self._behind = 0
        self._leap, self._leaps = np.nan, 0

    def to_stream_time(self, stamp: float, now_s: float, reading: bool = False) -> float:
        """Return the stream time of an event [s], by its stamp and our own monotonic clock [s].

        A reading shows a clock that was set back; a command may just be late.
        """
        if self._offset is None:
            self._offset, self._seen_s = -stamp, now_s
        time = stamp + self._offset
        leaps = not -BACK_S <= time - self._newest <= LEAP_S
        if leaps:
            was_set = self._keeps_leaping(self.at(now_s) - stamp)
        else:
            self._leaps = 0
            was_set = reading and self._is_set_back(stamp)
        if leaps or was_set:
            time = self.at(now_s)
        if was_set:
            self.jumps += 1
            self._last_reading, self._behind = stamp if reading else -np.inf, 0
            self._offset = time - stamp
        if time >= self._newest:
            self._newest, self._seen_s = time, now_s
        return time

    def _keeps_leaping(self, offset: float) -> bool:
        """Return whether `SET_EVENTS` events have jumped alike.

        `offset` is stream time by our own clock minus the stamp [s].
        """
        alike = abs(offset - self._leap) <= BACK_S
        self._leaps, self._leap = self._leaps + 1 if alike else 1, offset
        self.senseless += 1
        if self._leaps < SET_EVENTS:
            return False
        self.senseless -= self._leaps
        self._leaps = 0
        return True

    def _is_set_back(self, stamp: float) -> bool:
        """Return whether `SET_BACK_READINGS` readings have been behind an earlier one."""
        if stamp < self._last_reading - SET_BACK_S:
            self._behind += 1
        else:
            self._last_reading, self._behind = max(stamp, self._last_reading), 0
        return self._behind >= SET_BACK_READINGS

    def at(self, now_s: float) -> float:
        """Return the stream time [s] at a time of our own clock [s]; 0 before the first event."""
        if self._offset is None:
            return self._newest
        return self._newest + max(0.0, now_s - self._seen_s)

    def stamp(self, time: float) -> float:
        """Return the robot's clock at a stream time, both [s]; ours before the first event."""
        return wall_clock() if self._offset is None else time - self._offset


HELD_BACK = 10_000
"""Maximum number of events held back; beyond it the oldest are released at once."""


def order(event: Event) -> tuple[float, bool]:
    """Return the place of an event: by its time, a command before a reading of the same time."""
    return event.time, isinstance(event, Reading)


class ReorderBuffer:
    """Buffer that puts late events into the order of their times.

    Events are held back for `hold_s` [s]; 0: only those of the future.
    """

    def __init__(self, hold_s: float = 0.0) -> None:
        self._hold_s = hold_s
        self._waiting: list[Event] = []

    def add(self, event: Event) -> None:
        """Add an event."""
        insort(self._waiting, event, key=order)

    def ready(self, now: float) -> list[Event]:
        """Return the events that are released at a stream time [s]."""
        due = bisect_right(self._waiting, now - self._hold_s, key=lambda event: event.time)
        due = max(due, len(self._waiting) - HELD_BACK)
        events, self._waiting = self._waiting[:due], self._waiting[due:]
        return events


SHORTEST_S = 1e-9
"""Shortest duration of a ramp [s]; durations of 0 are jumps."""
Corner = tuple[float, FloatArray]
"""Time [s] and angles (motor,) [rad]."""


@dataclass(frozen=True)
class Ramp:
    """Straight lines of all motors from one pose to another.

    Attributes:
        start: Common start [s].
        origin: Angles at the start, (motor,) [rad].
        target: Angles at the end, (motor,) [rad].
        duration: Durations, (motor,) [s].
    """

    start: float
    origin: FloatArray
    target: FloatArray
    duration: FloatArray

    @cached_property
    def ends(self) -> FloatArray:
        """When motors come to rest, in order, (corner,) [s]."""
        return np.unique(self.start + self.duration)

    def at(self, time: float | FloatArray) -> FloatArray:
        """Return the angles at times [s] of any shape, (..., motor) [rad]."""
        since = np.asarray(time)[..., None] - self.start
        share = np.minimum(np.maximum(since / np.maximum(self.duration, SHORTEST_S), 0.0), 1.0)
        return np.asarray(self.origin + share * (self.target - self.origin))


class LiveReference:
    """Reference of the motors while commands keep coming, as corners of straight lines.

    A command that comes while another runs starts from the present reference. It replaces pending
    commands of the same time or later.

    Attributes:
        late_s: Longest delay of a command after the time at which it should have started [s].
        ramp: The lines that are drawn; None before the first command or pose.
        pending: Commands of the future, in the order of their times.
        known_until: Time up to which corners were returned [s].
    """

    def __init__(self) -> None:
        self.late_s = 0.0
        self.ramp: Ramp | None = None
        self.pending: list[CommandSent] = []
        self.known_until = -np.inf

    def resume(self, ramp: Ramp | None, pending: list[CommandSent], known_until: float) -> None:
        """Go on from where another reference was."""
        self.ramp, self.pending, self.known_until = ramp, pending, known_until

    def start_at(self, pose: FloatArray) -> None:
        """Set the pose before the first command, (motor,) [rad]; no effect later."""
        if self.ramp is None:
            self.ramp = Ramp(-np.inf, pose, pose, np.zeros_like(pose))

    def add(self, command: CommandSent) -> None:
        """Add a command; its time may be in the future or a little in the past."""
        self.pending = [other for other in self.pending if other.time < command.time]
        insort(self.pending, command, key=lambda other: other.time)

    def corners_to(self, time: float) -> list[Corner]:
        """Return the corners since the last call, up to a time [s], and the reference then.

        Nothing is returned before the first command or pose.
        """
        corners: list[Corner] = []
        while self.pending and self.pending[0].time <= time:
            corners += self._begin(self.pending.pop(0))
        corners += self._draw_to(time)
        self.known_until = max(self.known_until, time)
        return corners

    def _begin(self, command: CommandSent) -> list[Corner]:
        """Begin a command and return the corners up to then."""
        # Corners that were returned cannot be changed: a command that comes late starts late.
        start = max(command.time, self.known_until)
        late = start - command.time
        self.late_s = max(self.late_s, late)
        corners = self._draw_to(start)
        origin = command.target if self.ramp is None else self.ramp.at(start)
        self.ramp = Ramp(start, origin, command.target, np.maximum(command.duration - late, 0.0))
        return corners

    def _draw_to(self, time: float) -> list[Corner]:
        """Return the ends of the motors' ramps up to a time [s], and the reference then."""
        ramp, known = self.ramp, self.known_until
        if ramp is None or time <= known:
            return []
        self.known_until = time
        between = ramp.ends[(known < ramp.ends) & (ramp.ends < time)]
        times = [*between.tolist(), time]
        return [(at, ramp.at(at)) for at in times]
