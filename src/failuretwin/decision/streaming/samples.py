"""The samples of the last seconds, of all robots at once."""

from __future__ import annotations

import numpy as np

from failuretwin.core.types import FloatArray

KEEP_S = 30.0
"""How long samples are kept [s]; movements that take longer are not found."""
FIRST_ROOM = 64
"""Samples that there is room for at first."""


class Samples:
    """Commands and readings of the last seconds, in the order of their times.

    Args:
        robots: How many robots there are.
        motors: How many motors each of them has.
    """

    def __init__(self, robots: int, motors: int) -> None:
        self._first = self._stop = 0
        self._time = np.empty(FIRST_ROOM)
        self._command = np.empty((FIRST_ROOM, robots, motors))
        self._measured = np.empty((FIRST_ROOM, robots, 3))

    @property
    def time(self) -> FloatArray:
        """Times, increasing, (sample,) [s]."""
        return self._time[self._first : self._stop]

    @property
    def command(self) -> FloatArray:
        """References, (sample, robot, motor) [rad]; NaN where not known."""
        return self._command[self._first : self._stop]

    @property
    def measured(self) -> FloatArray:
        """Tool positions, (sample, robot, axis) [m]; NaN where there is none."""
        return self._measured[self._first : self._stop]

    def add(self, time: float, command: FloatArray, measured: FloatArray) -> None:
        """Take a sample; one that comes late takes its place among the others.

        Args:
            time: When it was taken [s].
            command: References, (robot, motor) [rad]; NaN where not known.
            measured: Tool positions, (robot, axis) [m]; NaN where there is none.
        """
        self._make_room()
        at = self._stop
        if len(self.time) and time <= self.time[-1]:
            at = self._first + int(np.searchsorted(self.time, time))
            if self._time[at] == time:
                _fill(self._command[at], command)
                _fill(self._measured[at], measured)
                return
            for values in (self._time, self._command, self._measured):
                values[at + 1 : self._stop + 1] = values[at : self._stop].copy()
        self._time[at], self._command[at], self._measured[at] = time, command, measured
        self._stop += 1
        oldest = self.time[-1] - KEEP_S
        while self._time[self._first] < oldest:
            self._first += 1

    def since(self, time: float) -> slice:
        """Return the samples that are no older than a time [s]."""
        return slice(int(np.searchsorted(self.time, time)), len(self.time))

    def restore(self, time: FloatArray, command: FloatArray, measured: FloatArray) -> None:
        """Take over the samples of another stream, in the order of their times."""
        for sample in zip(time.tolist(), command, measured, strict=True):
            self.add(*sample)

    def _make_room(self) -> None:
        if self._stop < len(self._time):
            return
        count = self._stop - self._first
        room = 2 * len(self._time) if count > len(self._time) // 2 else len(self._time)
        for name in ("_time", "_command", "_measured"):
            old = getattr(self, name)
            new = np.empty((room, *old.shape[1:]))
            new[:count] = old[self._first : self._stop]
            setattr(self, name, new)
        self._first, self._stop = 0, count


def _fill(old: FloatArray, new: FloatArray) -> None:
    """Replace the values of robots (robot, ...) of which something new is known, in place."""
    known = np.isfinite(new).all(axis=-1)
    old[known] = new[known]
