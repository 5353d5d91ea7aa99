"""Follows many robots: their movements, and where their tools come to rest after each."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from failuretwin.core.movements import Movements, find_movements, simplify
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.decision.streaming.samples import SampleBuffer
from failuretwin.decision.streaming.window import LikelihoodCache, MovementWindow
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.inference.evidence import (
    JUST_AFTER_S,
    SETTLING_S,
    Rest,
    estimate_rest,
    rest_begin,
    spread_out,
)

# Movements in the references of many robots, found as soon as a reference comes to rest.

TURN_RAD = 1e-5
"""A reference that is further than this from where it stood moves [rad]; less is noise."""
NOISE_RAD = 1e-9
"""References that typically bend by more than this from sample to sample are noisy [rad]."""
STILL_STEPS = 2
"""Steps without a change after which a reference is at rest: a line needs two."""
PLATEAU_S = 1.0
"""How much of the rest before a movement is looked at [s]."""
GRID_S = 0.01
"""Step of the grid onto which references are drawn out whose times are not even [s]."""

TWO_SAMPLES = GRID_S * np.arange(2.0)


@dataclass
class References:
    """Which references move, (robot,) each.

    Attributes:
        last: The newest that is known, (robot, motor) [rad]; NaN: none yet.
        stood: Where it stood when it last turned, (robot, motor) [rad].
        last_s: When that was [s].
        still: Steps for which it has not changed.
        moved: Whether it has moved since its movements were last found.
        rest_s: When it came to its last rest [s].
        before_s: When it came to the rest before that [s].
        left_s: When it left that rest [s].
    """

    last: FloatArray
    stood: FloatArray
    last_s: FloatArray
    still: IntArray
    moved: BoolArray
    rest_s: FloatArray
    before_s: FloatArray
    left_s: FloatArray

    @classmethod
    def unknown(cls, robots: int, motors: int) -> References:
        """Return references of which nothing is known yet."""
        return cls(
            last=np.full((robots, motors), np.nan),
            stood=np.full((robots, motors), np.nan),
            last_s=np.full(robots, -np.inf),
            still=np.zeros(robots, dtype=np.int64),
            moved=np.zeros(robots, dtype=bool),
            rest_s=np.full(robots, -np.inf),
            before_s=np.full(robots, -np.inf),
            left_s=np.full(robots, -np.inf),
        )

    def see(self, time: float, command: FloatArray) -> IntArray:
        """Take references at a time and return the robots whose movements can be found now.

        What comes late, older than what is known, says nothing new of them.

        Args:
            time: When they hold [s].
            command: (robot, motor) [rad]; NaN where not known.
        """
        known = np.isfinite(command).all(axis=1) & (time > self.last_s)
        first = known & np.isnan(self.last[:, 0])
        with np.errstate(invalid="ignore"):
            turns = known & (np.abs(command - self.stood).max(axis=1) > TURN_RAD)
        leaves = turns & ~self.moved
        self.left_s[leaves], self.before_s[leaves] = self.last_s[leaves], self.rest_s[leaves]
        self.moved |= turns
        self.rest_s[first | turns], self.stood[first | turns] = time, command[first | turns]
        self.still[turns] = 0
        self.still[known & ~turns & ~first] += 1
        self.last[known], self.last_s[known] = command[known], time
        return np.flatnonzero(known & self.moved & (self.still >= STILL_STEPS))

    def movements(self, robot: int, samples: SampleBuffer) -> Movements:
        """Return what a robot was told to do since it was last at rest, as one run.

        Args:
            robot: Its index.
            samples: What was said of late.
        """
        self.moved[robot] = False
        some = samples.since(max(self.before_s[robot], self.left_s[robot] - PLATEAU_S))
        time, command = samples.time[some], samples.command[some, robot]
        known = np.isfinite(command).all(axis=1)
        if known.sum() < 2:  # all others are too old to be remembered
            return find_movements(np.repeat(self.last[None, [robot]], 2, axis=1), TWO_SAMPLES)
        grid, values = _evenly(time[known], command[known])
        if _noisy(values):
            values = np.stack([_smooth(grid, value) for value in values.T], axis=-1)
        return find_movements(values[None], grid)


def _noisy(values: FloatArray) -> bool:
    """Return whether references (time, motor) typically bend from sample to sample."""
    bends = np.abs(np.diff(values, 2, axis=0))
    return bool(len(bends) and np.median(bends, axis=0).max() > NOISE_RAD)


def _smooth(time: FloatArray, value: FloatArray) -> FloatArray:
    """Return a noisy reference (time,) as the straight lines that it is meant to be."""
    at, corner = simplify(time, value, TURN_RAD)
    return np.asarray(np.interp(time, at, corner))


def _evenly(time: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return values (time, motor) on an even grid; what is even already stays as it is."""
    steps = np.diff(time)
    step = float(steps.min())
    multiples = steps / step
    if np.abs(multiples - np.rint(multiples)).max() < 1e-3 and step >= 0.5 * GRID_S:
        if multiples.max() < 1.5:
            return time, values
        grid = time[0] + step * np.arange(round((time[-1] - time[0]) / step) + 1)
    else:
        grid = np.append(np.arange(time[0], time[-1], GRID_S), time[-1])
        grid = np.linspace(time[0], time[-1], len(grid))
    return grid, np.stack([np.interp(grid, time, v) for v in values.T], axis=-1)


NO_REST = Rest(np.zeros((1, 3)), np.zeros(1, dtype=bool), np.zeros(1, dtype=bool))
REST_S = 0.15
"""Time in the same place that shows a tool at rest while it may still be moving [s]."""
SAME_PLACE_M = 0.002
"""How near readings then lie [m]: some counts of the servos, and slower than 2 cm/s."""
UNMOVED_M = 0.02
"""A tool this near to where it rested before may not have set out yet [m]."""


@dataclass(frozen=True)
class Starts:
    """When movements begin after their commands.

    Attributes:
        latest_s: At the latest [s].
        late_after_s: Readings that come back later than this say that it begins late [s].
    """

    latest_s: float
    late_after_s: float


class MovementTracker:
    """What is known of the last movements of many robots.

    Args:
        robots: How many robots there are.
        twin: Digital twin of each of them.
        movements: Movements that are remembered, the present one included.
        rate_hz: True rate of the tool sensors [Hz]; None: all readings are real.
        starts: When movements begin.
    """

    def __init__(
        self,
        robots: int,
        twin: DigitalTwin,
        movements: int,
        rate_hz: float | None,
        starts: Starts,
    ) -> None:
        motors = len(twin.robot.motors)
        self.samples = SampleBuffer(robots, motors)
        self.references = References.unknown(robots, motors)
        self.windows = MovementWindow.empty(robots, movements, motors)
        self.memory = LikelihoodCache.empty(robots, movements)
        self.read_s = np.full(robots, -np.inf)
        self._twin, self._starts = twin, starts
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
                last = int(windows.count[robot]) - 1
                self._settle(np.array([robot]), np.array([last]), np.array([start]))
                self.see_on_way(robot, last)
            if windows.full(robot):
                windows.forget_oldest(robot)
                self.memory.forget_oldest(robot)
            windows.append(robot, movements, number)

    def look(self, robots: IntArray) -> IntArray:
        """See where tools rest by now and return the robots whose tools do.

        A tool that has just come to rest, or may not have set out yet, is left for later readings;
        so is one whose reference moves: how, will be known when that comes to rest.

        Args:
            robots: Robots that were read.
        """
        still = robots[~self.references.moved[robots]]
        robots, place, begin, end = self._due(*self._present(still))
        if len(robots) == 0:
            return robots
        samples, time, inside = self._readings(robots, begin, end)
        found = estimate_rest(samples, _since_rest(samples, time, inside))
        waits = self._under_way(robots, place) | self._may_start_late(robots, place, found.point)
        found = replace(found, usable=found.usable & ~waits)
        self.windows.settle(robots, place, end, found)
        return robots[found.usable]

    def conclude(self, robots: IntArray) -> None:
        """See where tools rest after present movements, taking them to be over."""
        self._settle(*self._present(robots))

    def _present(self, robots: IntArray) -> tuple[IntArray, IntArray, FloatArray]:
        """Return the robots that have a movement and readings, which, and when these end [s]."""
        some = robots[(self.windows.count[robots] > 0) & np.isfinite(self.read_s[robots])]
        return some, self.windows.count[some] - 1, self.read_s[some] + JUST_AFTER_S

    def see_on_way(self, robot: int, place: int) -> None:
        """Note what was read on the way of a movement, until the tool rested."""
        self._resume(robot, place)
        windows, samples = self.windows, self.samples
        at = robot, place
        until = windows.begin[at] if windows.usable[at] else windows.end[at]
        some = samples.since(float(windows.start[at]))
        time, point = samples.time[some], samples.measured[some, robot]
        there = np.isfinite(point).all(axis=1) & (time < until - 1e-9)
        time, point = time[there], point[there]
        chosen = spread_out(time, self._least_step)
        windows.see_on_way(*at, time[chosen], point[chosen])

    def spoil(self, robot: int, since_s: float) -> None:
        """Forget the readings of a robot since a time [s], and what they said of its movements."""
        windows = self.windows
        self.samples.measured[self.samples.since(since_s), robot] = np.nan
        for place in range(int(windows.count[robot])):
            if windows.end[robot, place] > since_s:
                at = np.array([robot]), np.array([place])
                windows.settle(*at, windows.end[at], NO_REST)
                self._settle(*at, windows.end[at])
                self.see_on_way(robot, place)

    def _settle(self, robots: IntArray, place: IntArray, end: FloatArray) -> None:
        """See where tools rest after movements that end.

        Args:
            robots: Indices, (item,).
            place: Their movements, (item,).
            end: Ends of the plateaus, (item,) [s].
        """
        robots, place, begin, end = self._due(robots, place, end)
        if len(robots):
            samples, _, inside = self._readings(robots, begin, end)
            found = estimate_rest(samples, inside)
            self.windows.settle(robots, place, end, found)

    def _due(
        self, robots: IntArray, place: IntArray, end: FloatArray
    ) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
        """Return robots that may be at rest, their movements, and when to look [s]."""
        windows, at = self.windows, (robots, place)
        begin = rest_begin(windows.start[at], windows.ramp_duration[at], end)
        windows.begin[at], windows.end[at] = begin, end
        self.memory.fresh[at] = False
        over = begin < end
        return robots[over], place[over], begin[over], end[over]

    def _readings(
        self, robots: IntArray, begin: FloatArray, end: FloatArray
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return samples (robot, sample, axis) [m], their times (sample,) [s], which to take."""
        some = self.samples.since(float(begin.min()) - 1e-9)
        time = self.samples.time[some]
        inside = (time >= begin[:, None] - 1e-9) & (time < end[:, None] - 1e-9)
        return self.samples.measured[some, robots].swapaxes(0, 1), time, inside

    def _under_way(self, robots: IntArray, place: IntArray) -> BoolArray:
        """Return which movements must still be on their way, as readings came back late."""
        windows, at = self.windows, (robots, place)
        for k in np.flatnonzero(np.isnan(windows.first_reading_delay[at])):
            self._resume(int(robots[k]), int(place[k]))
        first_reading_delay, ramp = (
            windows.first_reading_delay[at],
            windows.ramp_duration[at].max(axis=-1),
        )
        over = self.read_s[robots] - windows.start[at] > first_reading_delay + ramp + SETTLING_S
        return np.asarray((first_reading_delay > self._starts.late_after_s) & ~over)

    def _resume(self, robot: int, place: int) -> None:
        """Note when readings came back after the command of a movement."""
        windows, samples = self.windows, self.samples
        if np.isfinite(windows.first_reading_delay[robot, place]):
            return
        start = float(windows.start[robot, place])
        some = samples.since(start)
        there = np.isfinite(samples.measured[some, robot]).all(axis=1)
        if there.any():
            windows.first_reading_delay[robot, place] = samples.time[some][np.argmax(there)] - start

    def _may_start_late(self, robots: IntArray, place: IntArray, point: FloatArray) -> BoolArray:
        """Return which tools still rest where they did before, and may yet set out, (robot,)."""
        windows, before = self.windows, np.maximum(place - 1, 0)
        seen = (place > 0) & windows.usable[robots, before]
        told = np.where(place[:, None] > 0, windows.target[robots, before], windows.initial[robots])
        rested = np.where(seen[:, None], windows.point[robots, before], self._twin.path(told))
        unmoved = np.linalg.norm(point - rested, axis=1) < UNMOVED_M
        since = self.read_s[robots] - windows.start[robots, place]
        return np.asarray(unmoved & (since < self._starts.latest_s))


def _since_rest(samples: FloatArray, time: FloatArray, inside: BoolArray) -> BoolArray:
    """Return the readings from which on all are near the newest, (robot, sample).

    None where they span too short a time to tell rest from a slow start.

    Args:
        samples: Tool positions, (robot, sample, axis) [m]; NaN where there is none.
        time: When they were taken, (sample,) [s].
        inside: Samples that count, (robot, sample).
    """
    there = inside & np.isfinite(samples).all(axis=-1)
    if not there.any():
        return there
    number = np.arange(samples.shape[1])
    newest = np.where(there, number, 0).max(axis=1)
    off = samples - samples[np.arange(len(samples)), newest][:, None]
    with np.errstate(invalid="ignore"):
        far = there & (np.linalg.norm(off, axis=-1) > SAME_PLACE_M)
    kept = there & (number > np.where(far, number, -1).max(axis=1, keepdims=True))
    first = np.where(kept, time, np.inf).min(axis=1)
    return kept & (time[newest] - first >= REST_S)[:, None]
