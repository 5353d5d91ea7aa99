"""Stream time: the robot's stamps, without the leaps of a clock that is set while it runs."""

from __future__ import annotations

import time as wall_clock

LEAP_S = 60.0
"""A stamp this far ahead of the newest is a clock that was set, no silence [s]."""
BACK_S = 5.0
"""A stamp this far behind the newest is a clock that was set, no message that comes late [s]."""


class StreamClock:
    """Turns stamps into a time that starts at zero and never leaps.

    Where the stamps leap, the time that has passed on our own clock is taken instead.
    """

    def __init__(self) -> None:
        self.jumps = 0
        self._offset: float | None = None
        self._newest = 0.0
        self._seen_s = 0.0

    def place(self, stamp: float, now_s: float) -> float:
        """Return the stream time of an event [s].

        Args:
            stamp: Its stamp by the robot's clock [s].
            now_s: Our own monotonic clock [s].
        """
        if self._offset is None:
            self._offset, self._seen_s = -stamp, now_s
        time = stamp + self._offset
        if not -BACK_S <= time - self._newest <= LEAP_S:
            self.jumps += 1
            time = self.at(now_s)
            self._offset = time - stamp
        if time >= self._newest:
            self._newest, self._seen_s = time, now_s
        return time

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
            return wall_clock.time()
        return time - self._offset
