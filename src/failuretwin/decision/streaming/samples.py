"""The samples of the last seconds, of all robots at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from failuretwin.core.arrays import ArrayStruct, Axes
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.inference.log_quality import (
    FROZEN_S,
    NEAR_ZERO_M,
    NEARLY_STILL_S,
    STILL_M,
    should_move,
)

KEEP_S = 30.0
"""How long samples are kept [s]; movements that take longer are not found."""
FIRST_ROOM = 64
"""Samples that there is room for at first."""


class SampleBuffer:
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

    def state(self) -> dict[str, np.ndarray]:
        """Return all samples, by name."""
        return {
            "samples/time": self.time,
            "samples/command": self.command,
            "samples/measured": self.measured,
        }

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Take over the samples of another stream, in the order of their times."""
        named = (state[name] for name in self.state())
        for time, command, measured in zip(*named, strict=True):
            self.add(float(time), command, measured)

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


# Tools that stand still though motors are told to move: a dead sensor, or a dead arm.


STILL_FOR_S = np.array([FROZEN_S, FROZEN_S, FROZEN_S, NEARLY_STILL_S])
"""Shortest time for which each axis must stand still to be called frozen, and the tool [s]."""


@dataclass(frozen=True)
class FrozenSensorDetector(ArrayStruct):
    """Watches the tools of many robots, by the same rules as `log_quality`.

    Four values of each robot may stand still: each axis, as long as it reports the very same
    number, and the tool as a whole, as long as it stays near one place.

    Attributes:
        number: What each axis reports, (robot, axis) [m].
        place: Where the tool is, (robot, axis) [m].
        since_s: Since when each stands still, (robot, value) [s].
        low: Least references since then, (robot, value, motor) [rad].
        high: Greatest ones.
    """

    number: Annotated[FloatArray, Axes("run", "axis", empty=np.nan)]
    place: Annotated[FloatArray, Axes("run", "axis", empty=np.nan)]
    since_s: Annotated[FloatArray, Axes("run", "value", empty=np.nan)]
    low: Annotated[FloatArray, Axes("run", "value", "motor", empty=np.nan)]
    high: Annotated[FloatArray, Axes("run", "value", "motor", empty=np.nan)]

    def still_since(self, robot: int) -> float:
        """Return since when the tool of a robot has stood where it stands [s]."""
        return float(min(self.since_s[robot, 3], self.since_s[robot, :3].max()))

    def see(
        self, time: float, read: BoolArray, points: FloatArray, command: FloatArray, near_m: float
    ) -> tuple[BoolArray, BoolArray]:
        """Take readings and say what is dead.

        Args:
            time: When they were taken [s].
            read: Robots that were read, (robot,).
            points: Tool positions of all, (robot, axis) [m].
            command: References of all, as far as known, (robot, motor) [rad].
            near_m: A tool that stays this near stands still [m].

        Returns:
            Tools among those read that stand still, (robot,), and channels that do alone,
            (robot, axis).
        """
        anew = np.repeat(read[:, None], 4, axis=1)
        with np.errstate(invalid="ignore"):
            anew[:, :3] &= ~(np.abs(points - self.number) <= STILL_M)
            anew[:, 3] &= ~(np.abs(points - self.place).max(axis=1) <= near_m)
        self.number[anew[:, :3]], self.place[anew[:, 3]] = points[anew[:, :3]], points[anew[:, 3]]
        self.since_s[anew] = time
        reference = np.broadcast_to(command[:, None], self.low.shape)
        self.low[anew] = self.high[anew] = reference[anew]
        np.fmin(self.low, reference, out=self.low)
        np.fmax(self.high, reference, out=self.high)
        with np.errstate(invalid="ignore"):
            still = (time - self.since_s >= STILL_FOR_S) & should_move(self.high - self.low)
        still &= read[:, None]
        dead = still[:, 3] | still[:, :3].all(axis=1)
        # One at zero may be held there by a stuck motor; see `log_quality`.
        alone = still[:, :3] & ~dead[:, None] & (np.abs(self.number) > NEAR_ZERO_M)
        return dead, alone
