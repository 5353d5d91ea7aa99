"""Follows many robots: their movements, and where their tools come to rest after each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from failuretwin.core.movements import (
    GRID_S,
    Movements,
    find_movements,
    movements_of_samples,
)
from failuretwin.core.polyline import TURN_RAD
from failuretwin.core.types import ArrayStruct, Axes, BoolArray, FloatArray, IntArray
from failuretwin.decision.streaming.window import MovementWindow, SampleBuffer
from failuretwin.inference.observation.evidence import (
    JUST_AFTER_S,
    SETTLING_S,
    estimate_rest,
    rest_begin,
)
from failuretwin.inference.observation.healthy_model import HealthyModel

Items = tuple[IntArray, IntArray]
"""Robots and their movements, (item,) each."""

# Movements in the references of many robots, found as soon as a reference comes to rest.

STILL_STEPS = 2
"""Steps without a change after which a reference is at rest: a line needs two."""
PLATEAU_S = 1.0
"""How much of the rest before a movement is looked at [s]."""


@dataclass(frozen=True)
class References(ArrayStruct):
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

    last: Annotated[FloatArray, Axes("run", "motor", empty=np.nan)]
    stood: Annotated[FloatArray, Axes("run", "motor", empty=np.nan)]
    last_s: Annotated[FloatArray, Axes("run", empty=-np.inf)]
    still: Annotated[IntArray, Axes("run", empty=0)]
    moved: Annotated[BoolArray, Axes("run", empty=False)]
    rest_s: Annotated[FloatArray, Axes("run", empty=-np.inf)]
    before_s: Annotated[FloatArray, Axes("run", empty=-np.inf)]
    left_s: Annotated[FloatArray, Axes("run", empty=-np.inf)]

    def see(self, time: FloatArray, command: FloatArray) -> IntArray:
        """Take references and return the robots whose movements can be found now.

        What comes late, older than what is known, says nothing new of them. Times are (robot,) [s],
        references (robot, motor) [rad]; NaN where not known.
        """
        known = np.isfinite(command).all(axis=1) & (time > self.last_s)
        first = known & np.isnan(self.last[:, 0])
        with np.errstate(invalid="ignore"):
            turns = known & (np.abs(command - self.stood).max(axis=1) > TURN_RAD)
        leaves = turns & ~self.moved
        self.left_s[leaves], self.before_s[leaves] = self.last_s[leaves], self.rest_s[leaves]
        self.moved[turns] = True
        rests = first | turns
        self.rest_s[rests], self.stood[rests] = time[rests], command[rests]
        self.still[turns] = 0
        self.still[known & ~turns & ~first] += 1
        self.last[known], self.last_s[known] = command[known], time[known]
        return np.flatnonzero(known & self.moved & (self.still >= STILL_STEPS))

    def movements(self, robot: int, samples: SampleBuffer) -> Movements:
        """Return what a robot was told to do since it was last at rest, as one run."""
        self.moved[robot] = False
        begin = max(self.before_s[robot], self.left_s[robot] - PLATEAU_S)
        some = samples.since(robot, begin)
        time, command = samples.time(robot)[some], samples.command(robot)[some]
        known = np.isfinite(command).all(axis=1)
        if known.sum() < 2:  # all others are too old to be remembered
            return find_movements(self.last[None, [robot, robot]], GRID_S * np.arange(2.0))
        return movements_of_samples(command[known], time[known])


# Where the tools of many robots come to rest after their movements, seen reading by reading.

REST_S = 0.15
"""Time in the same place that shows a tool at rest while it may still be moving [s]."""

OVERDUE_S = 1.0
"""An arm that should have come to rest so long ago, however late it starts, must have [s]."""


class MovementTracker:
    """What is known of the last movements of many robots.

    `movements` are remembered of each robot, the present one included. `rate_hz` is the true rate
    of the tool sensors [Hz]; None: all readings are real. `notes_way`: whether readings on the way
    are kept.
    """

    def __init__(
        self,
        model: HealthyModel,
        robots: int,
        movements: int,
        rate_hz: float | None,
        notes_way: bool,
    ) -> None:
        motors = len(model.scatter)
        self._sensors = model.sensors
        self.samples = SampleBuffer(robots, motors, self._sensors.channels)
        self.references = References.empty(run=robots, motor=motors)
        self.window = MovementWindow.of(model, robots, movements)
        self._twin, self._settings = model.twin, model.settings
        self._least_step = 0.0 if rate_hz is None else 0.9 / rate_hz
        self._notes_way = notes_way
        self._latest_start_s, self._late_after_s = _lateness(model)

    def adopt(self, model: HealthyModel) -> None:
        """See movements as those of another healthy robot."""
        self._latest_start_s, self._late_after_s = _lateness(model)

    def take(
        self, time: FloatArray, command: FloatArray, points: FloatArray, away: BoolArray
    ) -> tuple[IntArray, ...]:
        """Take a sample of each robot.

        Args:
            time: When it was taken, (robot,) [s]; NaN: none of this robot.
            command: References, (robot, motor) [rad]; NaN where not known.
            points: Readings, the tool's position first, (robot, channel) [m]; NaN: there is none.
            away: Tools that have left where they rested though no command came, (robot,): where
                they go says nothing of the last one.

        Returns:
            Robots that have begun a movement, as far as is known by now, and robots whose tools
            are seen at rest.
        """
        self.samples.add(time, command, points)
        begun = self.references.see(time, command)
        self.find_movements(begun)
        read = np.flatnonzero(np.isfinite(points).all(axis=1))
        self.window.read_s[read] = np.maximum(self.window.read_s[read], time[read])
        return begun, self.look(read[~away[read]])

    def see_goals(self, goal: FloatArray) -> IntArray:
        """Take the goals that motors have received and return the robots of which that is news.

        They tell of the present movement, once the reference has come to rest. Goals are (robot,
        motor) [rad]; NaN where a motor does not tell.
        """
        window = self.window
        some = np.flatnonzero((window.count > 0) & ~self.references.moved)
        at = some, window.count[some] - 1
        arrived = self._sensors.has_arrived(goal[some], window.settled.movements.target[at])
        before = window.settled.arrived[at]
        arrived = np.where(np.isfinite(arrived), arrived, before)
        news = ~((arrived == before) | np.isnan(arrived)).all(axis=1)
        window.settled.arrived[at] = arrived
        window.renew((at[0][news], at[1][news]))
        return some[news]

    def rest(self) -> FloatArray:
        """Return where tools rest after their present movement, (robot, axis) [m].

        NaN where that is not known, or the reference has moved on.
        """
        window = self.window
        robots = np.arange(len(window.count))
        last = np.maximum(window.count - 1, 0)
        known = window.settled.usable[robots, last] & (window.count > 0) & ~self.references.moved
        return np.where(known[:, None], window.settled.point[robots, last, :3], np.nan)

    def overdue(self, time: FloatArray) -> BoolArray:
        """Return which arms must have come to rest by a time, (robot,) [s], however late."""
        window = self.window
        robots, last = np.arange(len(window.count)), np.maximum(window.count - 1, 0)
        now = window.settled.movements[robots, last]
        lasts = now.ramp_duration.max(axis=-1) + self._latest_start_s + OVERDUE_S
        there = (window.count > 0) & ~self.references.moved
        with np.errstate(invalid="ignore"):
            return np.asarray(there & (time - now.start > lasts))

    def find_movements(self, robots: IntArray) -> None:
        """Add the movements of the references of some robots, up to now."""
        window, samples = self.window, self.samples
        fresh = robots[np.isnan(window.zero_s[robots])]
        window.zero_s[fresh] = [samples.time(robot)[0] for robot in fresh.tolist()]
        each = [self.references.movements(robot, samples) for robot in robots.tolist()]
        count = np.array([found.start.shape[1] for found in each], dtype=np.int64)
        for number in range(count.max(initial=0)):
            some = np.flatnonzero(count > number)
            rows, one = robots[some], _joined([each[i].since(number)[:, :1] for i in some])
            later = window.count[rows] > 0
            last = rows[later], window.count[rows[later]] - 1
            self._settle(last, one.start[later, 0])
            for robot, place in zip(*(part.tolist() for part in last), strict=True):
                self.see_on_way(robot, place)
            window.append(rows, one)

    def look(self, robots: IntArray) -> IntArray:
        """See where tools rest by now and return the robots whose tools do.

        A tool that has just come to rest, or may not have set out yet, is left for later readings;
        so is one whose reference moves: how, will be known when that comes to rest.
        """
        at, begin, end = self._due(*self._present(robots[~self.references.moved[robots]]))
        if len(at[0]) == 0:
            return at[0]
        samples, time, inside = self._readings(at[0], begin, end)
        inside = _since_rest(samples[..., :3], time, inside, self._settings.same_place_m)
        found = estimate_rest(samples, inside, self._sensors.moving_spread_m(self._settings))
        waits = self._under_way(at) | self._may_start_late(at, found.point[:, :3])
        found = replace(found, usable=found.usable & ~waits)
        self.window.settled.settle(at, found)
        return at[0][found.usable]

    def conclude(self, robots: IntArray) -> None:
        """See where tools rest after present movements, taking them to be over."""
        self._settle(*self._present(robots))

    def _present(self, robots: IntArray) -> tuple[Items, FloatArray]:
        """Return the robots that have a movement and readings, which, and when these end [s]."""
        some = robots[(self.window.count[robots] > 0) & np.isfinite(self.window.read_s[robots])]
        return (some, self.window.count[some] - 1), self.window.read_s[some] + JUST_AFTER_S

    def see_on_way(self, robot: int, place: int) -> None:
        """Note what was read on the way of a movement, until the tool rested."""
        self._resume(robot, place)
        if not self._notes_way:
            return
        settled, at = self.window.settled, (robot, place)
        start, until = settled.movements.start[at], settled[at].transient_until
        some = self.samples.since(robot, float(start))
        time, point = self.samples.time(robot)[some], self.samples.measured(robot)[some]
        there = np.isfinite(point).all(axis=1) & (time < until - 1e-9)
        self.window.transient.take_in(at, start, time[there], point[there], self._least_step)

    def spoil(self, robot: int, since_s: float) -> None:
        """Forget the readings of a robot since a time [s], and what they said of its movements."""
        settled = self.window.settled
        self.samples.measured(robot)[self.samples.since(robot, since_s)] = np.nan
        for place in range(int(self.window.count[robot])):
            if settled.end[robot, place] > since_s:
                at = np.array([robot]), np.array([place])
                settled.point[at], settled.usable[at], settled.moving[at] = 0.0, False, False
                self._settle(at, settled.end[at])
                self.see_on_way(robot, place)

    def _settle(self, at: Items, end: FloatArray) -> None:
        """See where tools rest after movements that end.

        Robots and movements `at`, and the ends of their plateaus [s], are (item,) each.
        """
        at, begin, end = self._due(at, end)
        if len(begin):
            samples, _, inside = self._readings(at[0], begin, end)
            found = estimate_rest(samples, inside, self._sensors.moving_spread_m(self._settings))
            self.window.settled.settle(at, found)

    def _due(self, at: Items, end: FloatArray) -> tuple[Items, FloatArray, FloatArray]:
        """Return robots that may be at rest, their movements, and when to look [s]."""
        settled, now = self.window.settled, self.window.settled.movements[at]
        begin = rest_begin(now.start, now.ramp_duration, end)
        settled.begin[at], settled.end[at] = begin, end
        self.window.renew(at)
        over = begin < end
        return (at[0][over], at[1][over]), begin[over], end[over]

    def _readings(
        self, robots: IntArray, begin: FloatArray, end: FloatArray
    ) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return samples (robot, sample, channel) [m], their times [s], and which to take."""
        samples, time = self.samples.readings_since(robots, begin - 1e-9)
        return samples, time, time < end[:, None] - 1e-9

    def _under_way(self, at: Items) -> BoolArray:
        """Return which movements must still be on their way, as readings came back late."""
        settled = self.window.settled
        for k in np.flatnonzero(np.isnan(settled.first_reading_delay[at])):
            self._resume(int(at[0][k]), int(at[1][k]))
        delay, now = settled.first_reading_delay[at], settled.movements[at]
        lasts = delay + now.ramp_duration.max(axis=-1) + SETTLING_S
        over = self.window.read_s[at[0]] - now.start > lasts
        return np.asarray((delay > self._late_after_s) & ~over)

    def _resume(self, robot: int, place: int) -> None:
        """Note when readings came back after the command of a movement."""
        settled, samples = self.window.settled, self.samples
        if np.isfinite(settled.first_reading_delay[robot, place]):
            return
        start = float(settled.movements.start[robot, place])
        some = samples.since(robot, start)
        there = np.isfinite(samples.measured(robot)[some]).all(axis=1)
        if there.any():
            first = samples.time(robot)[some][np.argmax(there)]
            settled.first_reading_delay[robot, place] = first - start

    def _may_start_late(self, at: Items, point: FloatArray) -> BoolArray:
        """Return which tools still rest where they did before, and may yet set out, (robot,)."""
        (robots, place), settled = at, self.window.settled
        known, before = settled.movements, (robots, np.maximum(place - 1, 0))
        later = place > 0
        told = np.where(later[:, None], known.target[before], known.initial[robots])
        seen = (later & settled.usable[before])[:, None]
        rested = np.where(seen, settled.point[before][:, :3], self._twin.path(told))
        unmoved = np.linalg.norm(point - rested, axis=1) < self._settings.unmoved_m
        since = self.window.read_s[robots] - known.start[at]
        return np.asarray(unmoved & (since < self._latest_start_s))


def _joined(runs: Sequence[Movements]) -> Movements:
    """Return movements of single runs as those of many."""
    parts = ([run.initial, run.target, run.ramp_duration, run.start] for run in runs)
    return Movements(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def _lateness(model: HealthyModel) -> tuple[float, float]:
    """Return how late a movement may begin, and when readings come back of one that did [s]."""
    latest = model.imperfections.timing.late_s[1] + model.lag_s + SETTLING_S
    return latest, model.lost_commands.late_after_s


def _since_rest(
    samples: FloatArray, time: FloatArray, inside: BoolArray, same_place_m: float
) -> BoolArray:
    """Return the readings from which on all are near the newest, (robot, sample).

    None where they span too short a time to tell rest from a slow start. Samples are (robot,
    sample, axis) [m], NaN where there is none, and their times (robot, sample) [s]; those `inside`,
    (robot, sample), count.
    """
    there = inside & np.isfinite(samples).all(axis=-1)
    if not there.any():
        return there
    number = np.arange(samples.shape[1])
    newest = np.where(there, number, 0).max(axis=1)
    last = np.arange(len(samples)), newest
    off = samples - samples[last][:, None]
    with np.errstate(invalid="ignore"):
        far = there & (np.linalg.norm(off, axis=-1) > same_place_m)
    kept = there & (number > np.where(far, number, -1).max(axis=1, keepdims=True))
    first = np.where(kept, time, np.inf).min(axis=1)
    newest_s = np.where(np.isfinite(first), time[last], -np.inf)
    return kept & (newest_s - first >= REST_S)[:, None]
