"""What makes the readings of a robot say nothing of its motors, seen reading by reading."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from failuretwin.core.types import ArrayStruct, Axes, BoolArray, FloatArray, IntArray
from failuretwin.inference.observation.evidence import SettledEvidence
from failuretwin.inference.observation.log_quality import (
    FROZEN_S,
    NEAR_ZERO_M,
    NEARLY_STILL_S,
    STILL_M,
    LogQuality,
    should_move,
)
from failuretwin.inference.observation.settings import InferenceSettings

DEAD = LogQuality(
    fatal="the tool stands still though motors are told to move: the sensor or the arm is dead"
)
UNTOLD = LogQuality(
    fatal="the tool moves though no command came: commands do not arrive here, or something else "
    "moves the arm"
)
TWO = LogQuality(
    fatal="readings jump between two places: two robots, or two sensors, speak on one topic"
)

# Tools that stand still though motors are told to move: a dead sensor, or a dead arm.


STILL_FOR_S = np.array([FROZEN_S, FROZEN_S, FROZEN_S, NEARLY_STILL_S])
"""Shortest time for which each axis must stand still to be called frozen, and the tool [s]."""
TOLD_FOR_S = 0.5
"""Time for which motors must have been told to move by then [s]: an arm lags behind."""


@dataclass(frozen=True)
class FrozenSensorDetector(ArrayStruct):
    """Watches the tools of many robots, by the same rules as `log_quality`.

    Four values of each robot may stand still: each axis, as long as it reports the very same
    number, and the tool as a whole, as long as it stays near one place. Either counts from the
    second reading on: the first may bear a time from before the bus stalled.

    Attributes:
        number: What each axis reports, (robot, axis) [m].
        place: Where the tool is, (robot, axis) [m].
        since_s: Since when each stands still, (robot, value) [s]; inf: one reading says so.
        low: Least references since then, (robot, value, motor) [rad].
        high: Greatest ones.
        told_s: Since when these have been far enough apart that it should have moved,
            (robot, value) [s]; inf: they are not.
    """

    number: Annotated[FloatArray, Axes("run", "axis", empty=np.nan)]
    place: Annotated[FloatArray, Axes("run", "axis", empty=np.nan)]
    since_s: Annotated[FloatArray, Axes("run", "value", empty=np.nan)]
    low: Annotated[FloatArray, Axes("run", "value", "motor", empty=np.nan)]
    high: Annotated[FloatArray, Axes("run", "value", "motor", empty=np.nan)]
    told_s: Annotated[FloatArray, Axes("run", "value", empty=np.inf)]

    def still_since(self, robot: int) -> float:
        """Return since when the tool of a robot has stood where it stands [s]."""
        return float(min(self.since_s[robot, 3], self.since_s[robot, :3].max()))

    def see(
        self,
        time: FloatArray,
        read: BoolArray,
        points: FloatArray,
        command: FloatArray,
        near_m: float,
        flickers: bool = True,
    ) -> tuple[BoolArray, BoolArray]:
        """Take readings and say what is dead.

        Args:
            time: When they were taken, (robot,) [s].
            read: Robots that were read, (robot,).
            points: Tool positions of all, (robot, axis) [m].
            command: References of all, as far as known, (robot, motor) [rad].
            near_m: A tool that stays this near stands still [m].
            flickers: Whether a live axis at rest reports another number now and then; one that
                is rounded need not.

        Returns:
            Tools among those read that stand still, (robot,), and channels that do alone,
            (robot, axis).
        """
        anew = np.repeat(read[:, None], 4, axis=1)
        with np.errstate(invalid="ignore"):
            anew[:, :3] &= ~(np.abs(points - self.number) <= STILL_M)
            anew[:, 3] &= ~(np.abs(points - self.place).max(axis=1) <= near_m)
        self.number[anew[:, :3]], self.place[anew[:, 3]] = points[anew[:, :3]], points[anew[:, 3]]
        second = read[:, None] & ~anew & np.isposinf(self.since_s)
        at = np.broadcast_to(time[:, None], self.since_s.shape)
        self.since_s[anew], self.since_s[second] = np.inf, at[second]
        reference = np.broadcast_to(command[:, None], self.low.shape)
        self.low[anew | second] = self.high[anew | second] = reference[anew | second]
        np.fmin(self.low, reference, out=self.low)
        np.fmax(self.high, reference, out=self.high)
        told = should_move(self.high - self.low)
        self.told_s[:] = np.where(told, np.fmin(self.told_s, at), np.inf)
        still_for = STILL_FOR_S if flickers else STILL_FOR_S.max()
        with np.errstate(invalid="ignore"):
            still = (at - self.since_s >= still_for) & (at - self.told_s >= TOLD_FOR_S)
        still &= read[:, None]
        dead = still[:, 3] | still[:, :3].all(axis=1)
        # One at zero may be held there by a stuck motor; see `log_quality`.
        alone = still[:, :3] & ~dead[:, None] & (np.abs(self.number) > NEAR_ZERO_M)
        return dead, alone


def rests_throughout(evidence: SettledEvidence, settings: InferenceSettings) -> bool:
    """Return whether a tool rests in one place though motors were told to move.

    It sees what no reading shows that comes with more noise than the tool may move.
    """
    usable = evidence.usable
    points, target = evidence.point[usable][:, :3], evidence.movements.target[usable]
    if len(points) < 2 or not should_move(np.ptp(target, axis=0)):
        return False
    away = np.linalg.norm(points - points.mean(axis=0), axis=1)
    return bool(np.sqrt(np.mean(away**2)) <= 0.5 * settings.nearly_still_m)


# Tools that move though nobody has told the motors to.

UNTOLD_S = 0.25
"""Time that a tool must have been away from where it rested to be called moving without a command
[s]; glitches of readings are shorter."""
RESTED_S = 0.15
"""Time in the same place that shows a tool at rest before the first command [s]."""


@dataclass(frozen=True)
class UntoldMotion(ArrayStruct):
    """Watches for tools that leave the place where they rest though no command came.

    One that rests elsewhere than it was told to, and goes there, has had its last command again.

    Attributes:
        place: Where each tool stood when it was last seen to move, (robot, axis) [m].
        since_s: Since when it has stood there, (robot,) [s].
        rest: Where it rested last, since its last command, (robot, axis) [m]; NaN: not yet.
        away_s: Since when it has been away from where it rested, (robot,) [s]; NaN: it is not.
        untold: Whether it moves without a command, (robot,); it stands until the next.
        unknown: Whether readings came before any reference was known, (robot,): the first command
            then says where the arm goes, but not that it moves.
    """

    place: Annotated[FloatArray, Axes("run", "axis", empty=np.nan)]
    since_s: Annotated[FloatArray, Axes("run", empty=np.nan)]
    rest: Annotated[FloatArray, Axes("run", "axis", empty=np.nan)]
    away_s: Annotated[FloatArray, Axes("run", empty=np.nan)]
    untold: Annotated[BoolArray, Axes("run", empty=False)]
    unknown: Annotated[BoolArray, Axes("run", empty=False)]

    def see(
        self,
        time: FloatArray,
        points: FloatArray,
        rest: FloatArray,
        told: BoolArray,
        overdue: BoolArray,
        known: BoolArray,
        near_m: tuple[float, float],
        told_place: Callable[[IntArray], FloatArray],
    ) -> BoolArray:
        """Take readings and return which tools are away from where they rested, (robot,).

        Args:
            time: When they were taken, (robot,) [s].
            points: Tool positions, (robot, axis) [m]; NaN where there is none.
            rest: Where tools came to rest after their last command, (robot, axis) [m]; NaN: they
                may be on their way.
            told: Robots that have had a command, (robot,); of others the first rest counts.
            overdue: Those that must have come to rest since, (robot,): so does theirs, and that
                they move where none was seen.
            known: Robots whose reference is known, (robot,).
            near_m: How near is the same place, and how far away is moved [m].
            told_place: Where the tools of some robots were told to go, (robot, axis) [m].
        """
        same_place_m, moved_m = near_m
        read = np.isfinite(points).all(axis=1)
        self.unknown[read & ~known] = True
        first = self.unknown & known & ~told
        self.begin(np.flatnonzero(first))
        told = told | first
        with np.errstate(invalid="ignore"):
            stands = read & (np.linalg.norm(points - self.place, axis=1) <= same_place_m)
        anew = read & ~stands
        self.place[anew], self.since_s[anew] = points[anew], time[anew]
        rested = stands & (~told | overdue) & np.isnan(self.rest[:, 0])
        rested &= time - self.since_s >= RESTED_S
        self.rest[rested] = self.place[rested]
        rests = np.isfinite(rest[:, 0]) & np.isnan(self.away_s)
        self.rest[rests] = rest[rests]
        with np.errstate(invalid="ignore"):
            away = read & (np.linalg.norm(points - self.rest, axis=1) > moved_m)
        away |= overdue & anew & np.isnan(self.rest[:, 0])
        left = np.flatnonzero(away)
        aim = told_place(left) if len(left) else points[left]
        off_before = np.linalg.norm(self.rest[left] - aim, axis=1)
        off = np.linalg.norm(points[left] - aim, axis=1)
        halts = stands[left] & (time[left] - self.since_s[left] >= RESTED_S) & (off > moved_m)
        away[left[(off_before > moved_m) & (off < off_before) & ~halts]] = False
        self.away_s[read & ~away] = np.nan
        leaves = away & np.isnan(self.away_s)
        self.away_s[leaves] = time[leaves]
        with np.errstate(invalid="ignore"):
            self.untold[time - self.away_s >= UNTOLD_S] = True
        return np.isfinite(self.away_s) | self.untold

    def begin(self, robots: IntArray) -> None:
        """Take note of robots that have had a command."""
        self.away_s[robots], self.rest[robots], self.untold[robots] = np.nan, np.nan, False


# Readings that jump to and fro: two robots, or two sensors, on one topic.

JUMP_BACK, NO_JUMP = 3.0, -1.0
"""What a reading counts that is back where the one before the last was, and any other."""
SPLIT, MOST_JUMPS = 9.0, 300.0
"""Sum from which readings come from two places: three in a row; and what it then is: one that
pauses is still there for half a minute of ten readings a second."""
BACK = 0.5
"""A reading is back if it is nearer to the one before the last than this share of the jump."""


@dataclass(frozen=True)
class TwoPlaces(ArrayStruct):
    """Watches for readings that come from two places in turn, however often each speaks.

    Attributes:
        last: The newest reading, (robot, axis) [m].
        before: The one before it.
        jumps: Jumps to and fro of late, (robot,).
        split: Whether there are two, (robot,).
    """

    last: Annotated[FloatArray, Axes("run", "axis", empty=np.nan)]
    before: Annotated[FloatArray, Axes("run", "axis", empty=np.nan)]
    jumps: Annotated[FloatArray, Axes("run")]
    split: Annotated[BoolArray, Axes("run", empty=False)]

    def see(self, points: FloatArray, moved_m: float) -> BoolArray:
        """Take readings and return the robots whose readings come from two places, (robot,).

        Points are (robot, axis) [m], NaN where there is none; a jump of less than `moved_m` [m] is
        none.
        """
        read = np.isfinite(points).all(axis=1)
        with np.errstate(invalid="ignore"):
            jump = np.linalg.norm(points - self.last, axis=1)
            back = np.linalg.norm(points - self.before, axis=1)
            jumped = (jump > moved_m) & (back < BACK * jump)
        step = np.where(jumped, JUMP_BACK, NO_JUMP)
        self.jumps[read] = np.clip(self.jumps + step, 0.0, MOST_JUMPS)[read]
        self.before[read], self.last[read] = self.last[read], points[read]
        self.split[self.jumps >= SPLIT] = True
        self.jumps[self.split & (self.jumps >= SPLIT) & jumped & read] = MOST_JUMPS
        self.split[self.jumps <= 0.0] = False
        return self.split.copy()
