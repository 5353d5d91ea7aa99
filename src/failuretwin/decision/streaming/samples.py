"""The samples of the last seconds, of all robots at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.inference.log_quality import (
    FROZEN_S,
    FROZEN_TRAVEL_RAD,
    NEAR_ZERO_M,
    NEARLY_STILL_M,
    NEARLY_STILL_S,
    STILL_M,
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


# Tools that stand still though motors are told to move: a dead sensor, or a dead arm.


@dataclass
class _StuckValue:
    """Since when values have not moved, and how far motors were told to travel meanwhile.

    Attributes:
        value: Where they stood then, (robot, value).
        since_s: (robot, value) [s].
        low: Least references since then, (robot, value, motor) [rad].
        high: Greatest ones.
    """

    value: FloatArray
    since_s: FloatArray
    low: FloatArray
    high: FloatArray

    @classmethod
    def empty(cls, robots: int, values: int, motors: int) -> _StuckValue:
        none = np.full((robots, values), np.nan)
        travel = np.full((robots, values, motors), np.nan)
        return cls(none.copy(), none.copy(), travel.copy(), travel.copy())

    def begin(self, anew: BoolArray, time: float, value: FloatArray, command: FloatArray) -> None:
        """Begin anew with some of the values (robot, value)."""
        self.value[anew], self.since_s[anew] = value[anew], time
        reference = np.broadcast_to(command[:, None], self.low.shape)
        self.low[anew], self.high[anew] = reference[anew], reference[anew]

    def follow(self, command: FloatArray) -> None:
        """Take references, (robot, motor) [rad]; NaN where not known."""
        np.fmin(self.low, command[:, None], out=self.low)
        np.fmax(self.high, command[:, None], out=self.high)

    def still_for(self, time: float, least_s: float) -> BoolArray:
        """Return which stand still though two motors at least should move, (robot, value)."""
        with np.errstate(invalid="ignore"):
            travel = np.sort(self.high - self.low, axis=-1)[..., -2:].min(axis=-1)
            return (time - self.since_s >= least_s) & (travel > FROZEN_TRAVEL_RAD)


@dataclass
class FrozenSensorDetector:
    """Watches the tools of many robots, by the same rules as `log_quality`.

    Attributes:
        channels: Coordinates that report the very same number, by axis.
        tools: Tools that stay near one place.
        place: That place, (robot, axis) [m].
    """

    channels: _StuckValue
    tools: _StuckValue
    place: FloatArray

    @classmethod
    def unknown(cls, robots: int, motors: int) -> FrozenSensorDetector:
        """Return a watch over tools that were never seen."""
        tools = _StuckValue.empty(robots, 1, motors)
        return cls(_StuckValue.empty(robots, 3, motors), tools, np.full((robots, 3), np.nan))

    def since_s(self, robot: int) -> float:
        """Return since when the tool of a robot has stood where it stands [s]."""
        return float(min(self.tools.since_s[robot, 0], self.channels.since_s[robot].max()))

    def see(
        self, time: float, read: BoolArray, points: FloatArray, command: FloatArray
    ) -> tuple[BoolArray, BoolArray]:
        """Take readings and say what is dead.

        Args:
            time: When they were taken [s].
            read: Robots that were read, (robot,).
            points: Tool positions of all, (robot, axis) [m].
            command: References of all, as far as known, (robot, motor) [rad].

        Returns:
            Tools among those read that stand still, (robot,), and channels that do alone,
            (robot, axis).
        """
        with np.errstate(invalid="ignore"):
            same = np.abs(points - self.channels.value) <= STILL_M
            near = np.abs(points - self.place).max(axis=1) <= NEARLY_STILL_M
        self.channels.begin(read[:, None] & ~same, time, points, command)
        away = read & ~near
        self.place[away] = points[away]
        self.tools.begin(away[:, None], time, points[:, :1], command)
        for watch in (self.channels, self.tools):
            watch.follow(command)
        frozen = self.channels.still_for(time, FROZEN_S)
        frozen &= read[:, None]
        still = self.tools.still_for(time, NEARLY_STILL_S)[:, 0] & read | frozen.all(axis=1)
        # One at zero may be held there by a stuck motor; see `log_quality`.
        alone = frozen & ~still[:, None] & (np.abs(self.channels.value) > NEAR_ZERO_M)
        return still, alone
