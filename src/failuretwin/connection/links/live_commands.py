"""The reference that commands ask for, as it unfolds."""

from __future__ import annotations

import heapq
from bisect import insort
from dataclasses import dataclass
from itertools import count

import numpy as np

from failuretwin.connection.links.base import CommandSent, Event
from failuretwin.core.types import FloatArray

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

CAPACITY = 10_000
"""Events that are held back at most; beyond it the oldest go on without waiting."""


class Sequencer:
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
            self._waiting[0][0] <= now - self._hold_s or len(self._waiting) > CAPACITY
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
