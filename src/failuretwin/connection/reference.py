"""The reference that commands ask for, as it unfolds."""

from __future__ import annotations

from bisect import insort
from dataclasses import dataclass

import numpy as np

from failuretwin.connection.links.values import CommandSent
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
