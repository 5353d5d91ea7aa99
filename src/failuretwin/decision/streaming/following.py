"""Follows many robots: their movements, and where their tools come to rest after each."""

from __future__ import annotations

import numpy as np

from failuretwin.core.types import FloatArray, IntArray
from failuretwin.data_knowledge.moving_evidence import spread_out
from failuretwin.data_knowledge.settled_evidence import JUST_AFTER_S, rest, rest_begin
from failuretwin.decision.streaming.memory import Memory
from failuretwin.decision.streaming.reference import References
from failuretwin.decision.streaming.samples import Samples
from failuretwin.decision.streaming.windows import Windows


class Following:
    """What is known of the last movements of many robots.

    Args:
        robots: How many robots there are.
        motors: How many motors each of them has.
        movements: Movements that are remembered, the present one included.
        rate_hz: True rate of the tool sensors [Hz]; None: all readings are real.
    """

    def __init__(self, robots: int, motors: int, movements: int, rate_hz: float | None) -> None:
        self.samples = Samples(robots, motors)
        self.references = References.unknown(robots, motors)
        self.windows = Windows.empty(robots, movements, motors)
        self.memory = Memory.empty(robots, movements)
        self.read_s = np.full(robots, -np.inf)
        self._least_step = 0.0 if rate_hz is None else 0.9 / rate_hz

    def take(self, time: float, command: FloatArray, points: FloatArray) -> tuple[IntArray, ...]:
        """Take a sample.

        Args:
            time: When it was taken [s].
            command: References, (robot, motor) [rad]; NaN where not known.
            points: Tool positions, (robot, axis) [m]; NaN where there is none.

        Returns:
            Robots that have begun a movement, as far as is known by now, and robots whose tools
            are seen at rest.
        """
        self.samples.add(time, command, points)
        begun = self.references.see(time, command)
        for robot in begun:
            self.find_movements(int(robot))
        read = np.flatnonzero(np.isfinite(points).all(axis=1))
        self.read_s[read] = np.maximum(self.read_s[read], time)
        return begun, self.look(read)

    def find_movements(self, robot: int) -> None:
        """Add the movements of a reference, up to now."""
        movements, windows = self.references.movements(robot, self.samples), self.windows
        if np.isnan(windows.zero_s[robot]):
            windows.zero_s[robot] = self.samples.time[0]
        for number, start in enumerate(movements.start[0]):
            if windows.count[robot] > 0:
                self._settle(np.array([robot]), np.array([start]))
                self.see_on_way(robot)
            if windows.full(robot):
                windows.forget_oldest(robot)
                self.memory.forget_oldest(robot)
            windows.append(robot, movements, number)

    def look(self, robots: IntArray) -> IntArray:
        """See where tools rest now and return the robots whose tools do.

        Args:
            robots: Robots to look at.
        """
        some = robots[(self.windows.count[robots] > 0) & np.isfinite(self.read_s[robots])]
        return self._settle(some, self.read_s[some] + JUST_AFTER_S)

    def see_on_way(self, robot: int) -> None:
        """Note what was read on the way of the present movement, until the tool rested."""
        windows, samples = self.windows, self.samples
        at = robot, int(windows.count[robot]) - 1
        until = windows.begin[at] if windows.usable[at] else windows.end[at]
        some = samples.since(float(windows.start[at]))
        time, point = samples.time[some], samples.measured[some, robot]
        there = np.isfinite(point).all(axis=1) & (time < until - 1e-9)
        time, point = time[there], point[there]
        chosen = spread_out(time, self._least_step)
        windows.see_on_way(*at, time[chosen], point[chosen])

    def forget(self, robot: int, time: float) -> None:
        """Forget all movements of a robot; what comes next begins at a time [s]."""
        self.windows.clear(robot, time)
        self.memory.fresh[robot] = False

    def _settle(self, robots: IntArray, end: FloatArray) -> IntArray:
        """See where tools rest after present movements that end, and return those that do.

        Args:
            robots: Indices, (item,).
            end: Ends of the plateaus, (item,) [s].
        """
        windows = self.windows
        place = windows.count[robots] - 1
        at = robots, place
        begin = rest_begin(windows.start[at], windows.ramp_duration[at], end)
        windows.begin[at], windows.end[at] = begin, end
        self.memory.fresh[at] = False
        over = begin < end
        robots, place, begin, end = robots[over], place[over], begin[over], end[over]
        if len(robots) == 0:
            return robots
        some = self.samples.since(float(begin.min()))
        time = self.samples.time[some]
        inside = (time >= begin[:, None]) & (time < end[:, None] - 1e-9)
        found = rest(self.samples.measured[some, robots].swapaxes(0, 1), inside)
        windows.settle(robots, place, end, found)
        return robots[found.usable]
