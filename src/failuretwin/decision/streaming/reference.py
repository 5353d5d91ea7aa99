"""Movements in the references of many robots, found as soon as a reference comes to rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin.core.movements import Movements, find_movements
from failuretwin.core.polyline import simplify
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.decision.streaming.samples import Samples

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

    def movements(self, robot: int, samples: Samples) -> Movements:
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
