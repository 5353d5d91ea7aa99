"""What a run says at system level: where the tool settled after each movement, and its way there.

Only `command` and the sensors that are believed, `measured` if nothing else is said, are looked at,
here and in everything that follows.

    e_m = median of the readings of the last 0.6 s at rest after movement m

Section: docs/inference.md#moments
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Annotated

import numpy as np

from failuretwin.core.movements import Movements, Stretches, find_movements
from failuretwin.core.numerics import masked_median
from failuretwin.core.runs import GOAL_VARIABLE, measured_rate
from failuretwin.core.types import ArrayStruct, Axes, BoolArray, FloatArray, IntArray, as_floats
from failuretwin.inference.observation.log_quality import (
    LogQuality,
    drop_invalid,
    log_quality,
    sensor_quality,
)
from failuretwin.inference.observation.readings import MeasuredSamples, grid_steps, measured_samples
from failuretwin.inference.observation.settings import USUAL, InferenceSettings

if TYPE_CHECKING:
    import xarray as xr

    from failuretwin.inference.observation.sensors import SensorStack

SETTLING_S = 0.15
"""Time after the end of a ramp before the tool counts as settled [s]: lag of 0.06 s, twice over."""
WINDOW_S = 0.6
"""Longest stretch at the end of a plateau that is averaged [s]; outlasts late starts."""
SILENT_PERIODS = 2.0
"""A tool that moves on time is read elsewhere so many readings after its command."""
JUST_AFTER_S = 1e-6
"""A plateau that nothing ends is taken to end so soon after the last reading [s]."""
MOST_READINGS = 12
"""Readings of one movement that are looked at on the way; more say nothing new, as all share one
lag."""


@dataclass(frozen=True)
class Evidence:
    """What a run set says at system level, each part worked out once, when it is asked for.

    Attributes:
        runs: The run set; `command` (run, time, motor) [rad] and `measured` (run, time, axis) [m]
            are read.
        settings: How near is at rest.
        sensors: What is believed; None: the tool's position alone.
    """

    runs: xr.Dataset
    settings: InferenceSettings = USUAL
    sensors: SensorStack | None = None

    @cached_property
    def time(self) -> FloatArray:
        """The grid of the runs, (time,) [s]."""
        return as_floats(self.runs["time"].values)

    @cached_property
    def command(self) -> FloatArray:
        """What the motors were told, (run, time, motor) [rad]."""
        return as_floats(self.runs["command"].values)

    @cached_property
    def readings(self) -> MeasuredSamples:
        """The readings behind the samples of the run set."""
        return self.sensors.read(self.runs) if self.sensors else measured_samples(self.runs)

    @cached_property
    def quality(self) -> list[LogQuality]:
        """Defects of the log of each run."""
        if self.sensors and not self.sensors.sees_tool:
            return sensor_quality(self.runs, self.readings)
        alone = self.sensors is None or self.sensors.tool_alone
        tool = self.readings if alone else measured_samples(self.runs)
        return log_quality(self.runs, tool, self.settings)

    @cached_property
    def sound(self) -> Evidence:
        """The same without spoilt readings."""
        runs = drop_invalid(self.runs, self.quality)
        return self if runs is self.runs else replace(self, runs=runs)

    @cached_property
    def settled(self) -> SettledEvidence:
        """Where the tool settled after each movement; lines drawn between readings do not count."""
        time, readings = self.time, self.readings
        movements = find_movements(self.command, time)
        end = _plateau_ends(movements, readings.point, time)
        begin = rest_begin(movements.start, movements.ramp_duration, end)
        silence = SILENT_PERIODS / measured_rate(self.runs)
        found = replace(
            SettledEvidence.empty(
                run=len(end),
                movement=end.shape[1],
                motor=movements.initial.shape[1],
                axis=readings.point.shape[-1],
            ),
            movements=movements,
            begin=begin,
            end=end,
            first_reading_delay=_first_reading_delay(movements, readings, time, silence),
        )
        item = np.nonzero(movements.exists & (begin < end))
        samples, inside = _between(readings.point, time, item[0], begin[item], end[item])
        found.settle(item, estimate_rest(samples, inside, self._moving_spread_m))
        if self.sensors and self.sensors.goals:
            goal = _last_known(as_floats(self.runs[GOAL_VARIABLE].values))
            last = np.searchsorted(time, np.nan_to_num(end) - 1e-9)
            there = np.take_along_axis(goal, np.maximum(last - 1, 0)[..., None], axis=1)
            found.arrived[:] = self.sensors.has_arrived(there, movements.target)
        return found

    @cached_property
    def transient(self) -> TransientSamples:
        """The readings of each movement before those that `settled` has used.

        Of densely sampled paths readings are left out evenly, so that no two lie closer than the
        true rate of the sensor says; samples on lines drawn between readings do not count.
        """
        time, settled, readings = self.time, self.settled, self.readings
        read, least_step = self.read, 0.9 / measured_rate(self.runs)
        start, until = settled.movements.start, settled.transient_until
        points = self.sensors.read_on_way(self.runs, readings) if self.sensors else readings.point
        found = TransientSamples.empty(
            run=len(start),
            movement=start.shape[1],
            reading=MOST_READINGS,
            axis=points.shape[-1],
        )
        for run, movement in np.argwhere(settled.movements.exists & (until > start)):
            first, stop = np.searchsorted(time, [start[run, movement], until[run, movement] - 1e-9])
            rows = first + np.flatnonzero(read[run, first:stop])
            item, point = (run, movement), points[run, rows]
            found.take_in(item, start[item], time[rows], point, least_step)
        return found

    @cached_property
    def read(self) -> BoolArray:
        """Where there is a reading, lines drawn between readings aside, (run, time)."""
        read = self.readings.seen.copy()
        for run in np.flatnonzero(self.readings.filled):
            read[run] &= _corners(self.readings.point[run], grid_steps(self.runs))
        return read

    @property
    def _moving_spread_m(self) -> float:
        if self.sensors is None:
            return self.settings.moving_spread_m
        return self.sensors.moving_spread_m(self.settings)


def settled_evidence(runs: xr.Dataset) -> SettledEvidence:
    """Return where the tool settled after each movement of each run, of an arm of usual size."""
    return Evidence(runs).settled


PerMovement = Annotated[FloatArray, Axes("run", "movement", empty=np.nan)]
MovementMask = Annotated[BoolArray, Axes("run", "movement", empty=False)]


@dataclass(frozen=True)
class SettledEvidence(ArrayStruct):
    """Settled tool positions of many runs.

    Attributes:
        movements: Movements found in `command`.
        point: Median of the readings at the end of each plateau, (run, movement, axis) [m], an axis
            for each channel of what is believed; 0 where there is none.
        usable: Movements with a settled point, (run, movement).
        moving: Movements whose readings do not come to rest, (run, movement).
        begin: When the readings that count begin, (run, movement) [s].
        end: End of each plateau, (run, movement) [s].
        first_reading_delay: Time from each command to the first reading after it, (run, movement)
            [s]; NaN where there is none or where straight lines fill the gaps between readings.
        arrived: Whether each motor reports to have received the command, (run, movement, motor);
            NaN where it does not tell.
        too_seldom: Runs that hardly rest, whose commands are too far apart to tell the way between
            them, (run,).
    """

    movements: Movements
    point: Annotated[FloatArray, Axes("run", "movement", "axis")]
    usable: MovementMask
    moving: MovementMask
    begin: PerMovement
    end: PerMovement
    first_reading_delay: PerMovement
    arrived: Annotated[FloatArray, Axes("run", "movement", "motor", empty=np.nan)]
    too_seldom: Annotated[BoolArray, Axes("run", empty=False)]

    @property
    def transient_until(self) -> FloatArray:
        """Until when readings are on the way, (run, movement) [s]."""
        return np.where(self.usable, self.begin, self.end)

    @property
    def on_the_way(self) -> BoolArray:
        """Which runs have readings on the way in place of rests, (run,)."""
        return Stretches.of(self.movements).on_the_way

    @property
    def moments_on_the_way(self) -> int:
        """How many readings on the way stand for movements without a rest."""
        return int((self.usable & ~Stretches.of(self.movements).at_rest).sum())

    @property
    def numbers(self) -> IntArray:
        """Number of each movement in its run, from 1, (run, movement)."""
        return Stretches.of(self.movements).movement + 1

    def alike(self, runs: IntArray) -> SettledEvidence:
        """Return some runs that are all seen at rest, or all on the way."""
        some = self[runs]
        if isinstance(some.movements, Stretches) and not some.on_the_way.any():
            return replace(some, movements=some.movements.as_movements)
        return some

    def padded(self, movements: int) -> SettledEvidence:
        """Return these runs with room for so many movements at least."""
        runs, here = self.usable.shape
        wide = self.blank(runs, max(here, movements))
        wide.put((slice(None), slice(0, here)), self)
        return wide

    def followed_by(self, evidence: SettledEvidence) -> SettledEvidence:
        """Return these runs with others behind them; shorter ones are padded."""
        (runs, here), (new, there) = self.usable.shape, evidence.usable.shape
        both = self.blank(runs + new, max(here, there))
        both.put((slice(0, runs), slice(0, here)), self)
        both.put((slice(runs, None), slice(0, there)), evidence)
        return both

    def settle(self, item: tuple[IntArray, ...], rest: Rest) -> None:
        """Write down where tools rest after some movements, given by run and movement."""
        self.point[item], self.usable[item], self.moving[item] = (
            rest.point,
            rest.usable,
            rest.moving,
        )


@dataclass(frozen=True)
class TransientSamples(ArrayStruct):
    """Readings on the way, for each movement of many runs.

    Attributes:
        since: Time since the movement was commanded, (run, movement, reading) [s].
        point: Tool position, (run, movement, reading, axis) [m]; 0 where there is none.
        seen: Readings that are there, (run, movement, reading).
    """

    since: Annotated[FloatArray, Axes("run", "movement", "reading")]
    point: Annotated[FloatArray, Axes("run", "movement", "reading", "axis")]
    seen: Annotated[BoolArray, Axes("run", "movement", "reading", empty=False)]

    def where(self, wanted: BoolArray) -> TransientSamples:
        """Return the evidence of some of the movements alone, (run, movement)."""
        return replace(self, seen=self.seen & wanted[..., None])

    def take_in(
        self,
        item: tuple[int, int],
        start: float,
        time: FloatArray,
        point: FloatArray,
        least_step: float,
    ) -> None:
        """Write down what was read on the way of a movement.

        Args:
            item: Its run and its number.
            start: When it was commanded [s].
            time: When the tool was read, sorted, (reading,) [s].
            point: Tool positions, (reading, axis) [m].
            least_step: Least time between two readings [s]; others are left out.
        """
        kept = _spread_out(time, least_step)
        self.seen[item] = np.arange(MOST_READINGS) < len(kept)
        self.since[item][: len(kept)] = time[kept] - start
        self.point[item][: len(kept)] = point[kept]


@dataclass(frozen=True)
class Rest:
    """Where the tool rests in some stretches of time, (stretch, ...).

    Attributes:
        point: Median of the readings, (stretch, axis) [m]; 0 where there is none.
        usable: Whether there are readings and they come to rest.
        moving: Whether there are readings that do not come to rest.
    """

    point: FloatArray
    usable: BoolArray
    moving: BoolArray


def _last_known(values: FloatArray) -> FloatArray:
    """Return values (run, time, motor) with the last one before where there is none."""
    known = np.isfinite(values)
    index = np.where(known, np.arange(values.shape[1])[None, :, None], 0)
    return np.take_along_axis(values, np.maximum.accumulate(index, axis=1), axis=1)


def rest_begin(start: FloatArray, ramp_duration: FloatArray, end: FloatArray) -> FloatArray:
    """Return when the readings that count for a settled point begin [s].

    Args:
        start: Start of each movement, (...) [s].
        ramp_duration: How long its ramps take, (..., motor) [s].
        end: End of its plateau, (...) [s].
    """
    reached = start + ramp_duration.max(axis=-1, initial=0.0) + SETTLING_S
    return np.maximum(reached, end - WINDOW_S)


def estimate_rest(samples: FloatArray, inside: BoolArray, moving_spread_m: float) -> Rest:
    """Return where the tool rests in some stretches of time.

    Args:
        samples: Tool positions, (stretch, sample, axis) [m]; NaN where there is none.
        inside: Samples that lie inside the stretch, (stretch, sample).
        moving_spread_m: Median distance from their median above which it is still moving [m].
    """
    kept = inside & np.isfinite(samples).all(axis=-1)
    point = np.stack(
        [masked_median(samples[..., axis], kept) for axis in range(samples.shape[-1])], axis=-1
    )
    from_point = np.where(kept[..., None], samples, 0.0) - point[:, None]
    spread = masked_median(np.linalg.norm(from_point, axis=-1), kept)
    some, moving = kept.any(axis=1), spread > moving_spread_m
    return Rest(point, some & ~moving, some & moving)


def _between(
    measured: FloatArray, time: FloatArray, run: IntArray, begin: FloatArray, end: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Return samples of some runs (item, sample, axis) and which lie between two times [s]."""
    first, stop = np.searchsorted(time, begin), np.searchsorted(time, end - 1e-9)
    at = first[:, None] + np.arange(np.max(stop - first, initial=0))
    inside = at < stop[:, None]
    return measured[run[:, None], np.minimum(at, len(time) - 1)], inside


def _first_reading_delay(
    movements: Movements, readings: MeasuredSamples, time: FloatArray, silence: float
) -> FloatArray:
    """Return the time from each command to the first reading after it, (run, movement) [s].

    Args:
        movements: The movements.
        readings: Readings of the same runs.
        time: Uniform grid, (time,) [s].
        silence: A tool that stays at one place for longer after a command may not be read [s].
    """
    found = np.full(movements.start.shape, np.nan)
    for run in np.flatnonzero(~readings.filled):
        start, seen = movements.start[run], readings.seen[run]
        first, sure = (_first_after(time[s], start) for s in (seen, seen & ~readings.assumed[run]))
        found[run] = np.where((first == sure) | (sure - start <= silence), first, np.nan)
    return found - movements.start


def _first_after(at: FloatArray, start: FloatArray) -> FloatArray:
    """Return the first of some times at or after each start [s]; NaN where there is none."""
    return np.append(at, np.nan)[np.searchsorted(at, start - 1e-9)]


def _plateau_ends(movements: Movements, measured: FloatArray, time: FloatArray) -> FloatArray:
    """Return when each plateau ends: with the next movement or the last reading of the run."""
    seen = np.asarray(np.isfinite(measured).all(axis=-1))
    last = len(time) - 1 - np.argmax(seen[:, ::-1], axis=1)
    stop = np.where(seen.any(axis=1), time[last] + JUST_AFTER_S, 0.0)
    following = np.full_like(movements.start, np.nan)
    following[:, :-1] = movements.start[:, 1:]
    return np.fmin(following, stop[:, None])


def _corners(path: FloatArray, every: int) -> BoolArray:
    """Return which samples of a filled path (time, axis) may be readings, (time,).

    Drawn out otherwise than by straight lines, as by lines between the angles of the motors: every
    so many, where it bends most.
    """
    bend = np.zeros(len(path))
    bend[1:-1] = np.linalg.norm(np.nan_to_num(np.diff(path, 2, axis=0)), axis=-1)
    phase = np.arange(len(path)) % every
    return np.asarray(phase == np.argmax(np.bincount(phase, bend)))


def _spread_out(time: FloatArray, least_step: float) -> IntArray:
    """Return which readings of a movement to look at: few, none close together, (reading,).

    Args:
        time: Their times, sorted [s].
        least_step: Least time between two [s].
    """
    kept, last = [], -np.inf
    for i, at in enumerate(time.tolist()):
        if at - last >= least_step:
            kept.append(i)
            last = at
    if len(kept) > MOST_READINGS:
        places = np.rint(np.linspace(0, len(kept) - 1, MOST_READINGS)).astype(int)
        return np.array(kept)[places]
    return np.array(kept, dtype=np.int64)


def unused_movements(evidence: SettledEvidence, run: int, before: int = 0) -> list[str]:
    """Return why movements of a run are not used, a line each.

    Args:
        evidence: Settled positions.
        run: Index of the run.
        before: Movements of the stream before the run.
    """
    lines = []
    on_the_way = bool(evidence.on_the_way[run])
    for movement in np.flatnonzero(evidence.movements.exists[run] & ~evidence.usable[run]):
        if on_the_way:
            reason = "no reading at rest or on its way"
        elif evidence.moving[run, movement]:
            reason = "the tool does not come to rest"
        else:
            reason = "no reading while the tool is at rest"
        lines.append(f"movement {before + evidence.numbers[run, movement]} not used: {reason}")
    return lines
