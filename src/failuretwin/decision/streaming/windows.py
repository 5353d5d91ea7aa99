"""The last movements of many robots, and where the tool was seen after each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin.core.movements import Movements
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.data_knowledge.moving_evidence import MOST_READINGS, MovingEvidence
from failuretwin.data_knowledge.settled_evidence import Rest, SettledEvidence


@dataclass
class Windows:
    """The last movements of each robot, oldest first; times are those of the stream.

    Attributes:
        count: Movements that there are, (robot,).
        forgotten: Movements that there were before them, (robot,).
        zero_s: When the window begins: with the stream or its oldest movement, (robot,) [s].
        initial: Reference before the oldest movement, (robot, motor) [rad].
        target: (robot, movement, motor) [rad]; NaN where there is no movement, like all that
            follows.
        ramp_duration: (robot, movement, motor) [s].
        start: (robot, movement) [s].
        begin: When the readings that count begin, (robot, movement) [s].
        end: End of each plateau, (robot, movement) [s].
        resumed: Time from each command to the first reading after it, (robot, movement) [s]; NaN
            where there was none yet.
        point: Where the tool rests, (robot, movement, axis) [m]; 0 where that is not known.
        usable: Movements after which it rests, (robot, movement).
        moving: Movements whose readings do not come to rest, (robot, movement).
        since: Times of readings on the way after the start, (robot, movement, reading) [s].
        way: Those readings, (robot, movement, reading, axis) [m].
        seen: Readings that are there, (robot, movement, reading).
    """

    count: IntArray
    forgotten: IntArray
    zero_s: FloatArray
    initial: FloatArray
    target: FloatArray
    ramp_duration: FloatArray
    start: FloatArray
    begin: FloatArray
    end: FloatArray
    resumed: FloatArray
    point: FloatArray
    usable: BoolArray
    moving: BoolArray
    since: FloatArray
    way: FloatArray
    seen: BoolArray

    @classmethod
    def empty(cls, robots: int, movements: int, motors: int) -> Windows:
        """Return windows of so many movements at most, without any yet."""
        shape = (robots, movements)
        return cls(
            count=np.zeros(robots, dtype=np.int64),
            forgotten=np.zeros(robots, dtype=np.int64),
            zero_s=np.full(robots, np.nan),
            initial=np.full((robots, motors), np.nan),
            target=np.full((*shape, motors), np.nan),
            ramp_duration=np.full((*shape, motors), np.nan),
            start=np.full(shape, np.nan),
            begin=np.full(shape, np.nan),
            end=np.full(shape, np.nan),
            resumed=np.full(shape, np.nan),
            point=np.zeros((*shape, 3)),
            usable=np.zeros(shape, dtype=bool),
            moving=np.zeros(shape, dtype=bool),
            since=np.zeros((*shape, MOST_READINGS)),
            way=np.zeros((*shape, MOST_READINGS, 3)),
            seen=np.zeros((*shape, MOST_READINGS), dtype=bool),
        )

    def full(self, robot: int) -> bool:
        """Return whether the oldest movement of a robot must go before another can be added."""
        return bool(self.count[robot] == self.start.shape[1])

    def append(self, robot: int, movements: Movements, number: int) -> None:
        """Add a movement of a robot.

        Args:
            robot: Index of the robot.
            movements: Movements of a single run, by the time of the stream.
            number: Which of them.
        """
        if self.count[robot] == 0:
            self.initial[robot] = movements.origin()[0, number]
        place = int(self.count[robot])
        self.target[robot, place] = movements.target[0, number]
        self.ramp_duration[robot, place] = movements.ramp_duration[0, number]
        self.start[robot, place] = movements.start[0, number]
        self.count[robot] += 1

    def settle(self, robot: IntArray, place: IntArray, end: FloatArray, rest: Rest) -> None:
        """Say where tools rest after movements.

        Args:
            robot: Indices of robots, (item,).
            place: Their movements, (item,).
            end: Ends of the plateaus, (item,) [s].
            rest: Where the tools rest, by item.
        """
        at = robot, place
        self.end[at] = end
        self.point[at], self.usable[at], self.moving[at] = rest.point, rest.usable, rest.moving

    def see_on_way(self, robot: int, place: int, time: FloatArray, point: FloatArray) -> None:
        """Say what was read on the way of a movement.

        Args:
            robot: Index of the robot.
            place: The movement.
            time: When, (reading,) [s].
            point: Tool positions, (reading, axis) [m].
        """
        self.seen[robot, place] = np.arange(MOST_READINGS) < len(time)
        self.since[robot, place, : len(time)] = time - self.start[robot, place]
        self.way[robot, place, : len(time)] = point

    def evidence(self, robots: IntArray) -> SettledEvidence:
        """Return where the tools of some robots settled; times count from `zero_s`."""
        some = slice(0, int(self.count[robots].max(initial=0)))
        zero = self.zero_s[robots, None]
        movements = Movements(
            self.initial[robots],
            self.target[robots, some],
            self.ramp_duration[robots, some],
            self.start[robots, some] - zero,
        )
        return SettledEvidence(
            movements,
            self.point[robots, some],
            self.usable[robots, some],
            self.moving[robots, some],
            self.begin[robots, some] - zero,
            self.end[robots, some] - zero,
            self.resumed[robots, some],
        )

    def on_way(self, robots: IntArray) -> MovingEvidence:
        """Return what was read on the way of the same movements."""
        some = slice(0, int(self.count[robots].max(initial=0)))
        return MovingEvidence(
            self.since[robots, some], self.way[robots, some], self.seen[robots, some]
        )

    def forget_oldest(self, robot: int) -> None:
        """Drop the oldest movement of a robot."""
        if self.count[robot] > 1:
            self.initial[robot] = self.evidence(np.array([robot])).movements.origin()[0, 1]
        times = (self.start, self.begin, self.end, self.resumed)
        for values in (self.target, self.ramp_duration, *times,
                       self.point, self.usable, self.moving, self.since, self.way,
                       self.seen):  # fmt: skip
            values[robot, :-1] = values[robot, 1:].copy()
        for values in (self.target, self.ramp_duration, *times):
            values[robot, -1] = np.nan
        self.point[robot, -1] = 0.0
        self.usable[robot, -1] = self.moving[robot, -1] = False
        self.seen[robot, -1] = False
        self.zero_s[robot] = self.start[robot, 0]
        self.count[robot] -= 1
        self.forgotten[robot] += 1
