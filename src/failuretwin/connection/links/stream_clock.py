"""Stream time: the robot's stamps, without the leaps of a clock that is set while it runs."""

from __future__ import annotations

from time import time as wall_clock

import numpy as np

LEAP_S = 60.0
"""A stamp this far ahead of the newest is a clock that was set, no silence [s]."""
BACK_S = 5.0
"""A stamp this far behind the newest is a clock that was set, no message that comes late [s]."""

SET_BACK_S, SET_BACK_READINGS = 0.5, 3
"""So many readings in a row, each this far behind one that came before, are a clock that was set
back [s]; a message that comes late is one alone."""
SET_EVENTS = 10
"""So many events in a row whose stamps leap alike are a clock that was set; fewer are stamps that
make no sense."""


class StreamClock:
    """Turns stamps into a time that starts at zero and never leaps.

    Where stamps leap, the time that has passed on our own clock is taken instead: for good where
    they go on so, for the one event where its stamp makes no sense. Readings that go on behind
    those before them tell of a clock that was set back a little.

    Attributes:
        jumps: How often the clock was set.
        senseless: Events whose stamps made no sense.
    """

    def __init__(self) -> None:
        self.jumps = self.senseless = 0
        self._offset: float | None = None
        self._newest = 0.0
        self._seen_s = 0.0
        self._last_reading = -np.inf
        self._behind = 0
        self._leapt, self._leaps = np.nan, 0

    def to_stream_time(self, stamp: float, now_s: float, reading: bool = False) -> float:
        """Return the stream time of an event [s].

        Args:
            stamp: Its stamp by the robot's clock [s].
            now_s: Our own monotonic clock [s].
            reading: Whether it is a reading; commands may well come late.
        """
        if self._offset is None:
            self._offset, self._seen_s = -stamp, now_s
        time = stamp + self._offset
        leaps = not -BACK_S <= time - self._newest <= LEAP_S
        was_set = self._go_on_leaping(self.at(now_s) - stamp) if leaps else False
        if not leaps:
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

    def _go_on_leaping(self, offset: float) -> bool:
        """Return whether events have leapt alike for a while.

        Args:
            offset: What our own clock is ahead of the stamp that leaps [s].
        """
        alike = abs(offset - self._leapt) <= BACK_S
        self._leaps, self._leapt = self._leaps + 1 if alike else 1, offset
        self.senseless += 1
        if self._leaps < SET_EVENTS:
            return False
        self.senseless -= self._leaps
        self._leaps = 0
        return True

    def _is_set_back(self, stamp: float) -> bool:
        """Return whether readings have gone on behind those before them for a while."""
        if stamp < self._last_reading - SET_BACK_S:
            self._behind += 1
        else:
            self._last_reading, self._behind = max(stamp, self._last_reading), 0
        return self._behind >= SET_BACK_READINGS

    def at(self, now_s: float) -> float:
        """Return the stream time [s] at a time of our own clock [s]; 0 until an event comes."""
        if self._offset is None:
            return self._newest
        return self._newest + max(0.0, now_s - self._seen_s)

    def stamp(self, time: float) -> float:
        """Return what the robot's clock would say at a stream time, both [s].

        Until it has said anything, it is taken to agree with ours.
        """
        if self._offset is None:
            return wall_clock()
        return time - self._offset
