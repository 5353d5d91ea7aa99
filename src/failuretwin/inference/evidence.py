"""What a run says at system level: where the tool settled after each movement.

Only `command` and `measured` of the run set are looked at, here and in everything that follows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.core.movements import Movements, find_movements
from failuretwin.core.numerics import masked_median
from failuretwin.core.runs import measured_rate
from failuretwin.core.types import BoolArray, FloatArray, IntArray, as_floats
from failuretwin.inference.readings import MeasuredSamples, grid_steps, measured_samples

if TYPE_CHECKING:
    import xarray as xr

SETTLING_S = 0.15
"""Time after the end of a ramp before the tool counts as settled [s]: lag of 0.06 s, twice over."""
WINDOW_S = 0.6
"""Longest stretch at the end of a plateau that is averaged [s]; outlasts late starts."""
SILENT_PERIODS = 2.0
"""A tool that moves on time is read elsewhere so many readings after its command."""
STILL_M = 0.004
"""Spread of the readings above which the tool is still moving [m]; one count moves it 1 mm."""


JUST_AFTER_S = 1e-6
"""A plateau that nothing ends is taken to end so soon after the last reading [s]."""


@dataclass(frozen=True)
class SettledEvidence:
    """Settled tool positions of many runs.

    Attributes:
        movements: Movements found in `command`.
        point: Median of the readings at the end of each plateau, (run, movement, axis) [m]; 0 where
            there is none.
        usable: Movements with a settled point, (run, movement).
        moving: Movements whose readings do not come to rest, (run, movement).
        begin: When the readings that count begin, (run, movement) [s].
        end: End of each plateau, (run, movement) [s].
        first_reading_delay: Time from each command to the first reading after it, (run, movement)
            [s]; NaN where there is none or where straight lines fill the gaps between readings.
    """

    movements: Movements
    point: FloatArray
    usable: BoolArray
    moving: BoolArray
    begin: FloatArray
    end: FloatArray
    first_reading_delay: FloatArray

    def __getitem__(self, runs: slice) -> SettledEvidence:
        """Return the evidence of some of the runs."""
        m = self.movements
        return SettledEvidence(
            Movements(m.initial[runs], m.target[runs], m.ramp_duration[runs], m.start[runs]),
            self.point[runs],
            self.usable[runs],
            self.moving[runs],
            self.begin[runs],
            self.end[runs],
            self.first_reading_delay[runs],
        )


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


def rest_begin(start: FloatArray, ramp_duration: FloatArray, end: FloatArray) -> FloatArray:
    """Return when the readings that count for a settled point begin [s].

    Args:
        start: Start of each movement, (...) [s].
        ramp_duration: How long its ramps take, (..., motor) [s].
        end: End of its plateau, (...) [s].
    """
    reached = start + ramp_duration.max(axis=-1, initial=0.0) + SETTLING_S
    return np.maximum(reached, end - WINDOW_S)


def estimate_rest(samples: FloatArray, inside: BoolArray) -> Rest:
    """Return where the tool rests in some stretches of time.

    Args:
        samples: Tool positions, (stretch, sample, axis) [m]; NaN where there is none.
        inside: Samples that lie inside the stretch, (stretch, sample).
    """
    kept = inside & np.isfinite(samples).all(axis=-1)
    point = np.stack([masked_median(samples[..., axis], kept) for axis in range(3)], axis=-1)
    from_point = np.where(kept[..., None], samples, 0.0) - point[:, None]
    spread = masked_median(np.linalg.norm(from_point, axis=-1), kept)
    some, moving = kept.any(axis=1), spread > STILL_M
    return Rest(point, some & ~moving, some & moving)


def settled_evidence(runs: xr.Dataset) -> SettledEvidence:
    """Return where the tool settled after each movement of each run.

    Samples on lines drawn between readings do not count.

    Args:
        runs: A run set; `command` (run, time, motor) and `measured` (run, time, axis) are read.
    """
    time, readings = as_floats(runs["time"].values), measured_samples(runs)
    measured = readings.point
    movements = find_movements(as_floats(runs["command"].values), time)
    end = _plateau_ends(movements, measured, time)
    begin = rest_begin(movements.start, movements.ramp_duration, end)
    shape = movements.start.shape
    point, usable, moving = np.zeros((*shape, 3)), np.zeros(shape, bool), np.zeros(shape, bool)
    item = np.nonzero(movements.exists & (begin < end))
    found = estimate_rest(*_between(measured, time, item[0], begin[item], end[item]))
    point[item], usable[item], moving[item] = found.point, found.usable, found.moving
    first_reading_delay = _resumed(movements, readings, time, SILENT_PERIODS / measured_rate(runs))
    return SettledEvidence(movements, point, usable, moving, begin, end, first_reading_delay)


def _between(
    measured: FloatArray, time: FloatArray, run: IntArray, begin: FloatArray, end: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Return samples of some runs (item, sample, axis) and which lie between two times [s]."""
    first, stop = np.searchsorted(time, begin), np.searchsorted(time, end - 1e-9)
    at = first[:, None] + np.arange(np.max(stop - first, initial=0))
    inside = at < stop[:, None]
    return measured[run[:, None], np.minimum(at, len(time) - 1)], inside


def _resumed(
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


# What a run says while the arm moves: readings of the tool from each start until it rests.

MOST_READINGS = 12
"""Readings of one movement that are looked at; more say nothing new, as all share one lag."""


@dataclass(frozen=True)
class TransientSamples:
    """Readings on the way, for each movement of many runs.

    Attributes:
        since: Time since the movement was commanded, (run, movement, reading) [s].
        point: Tool position, (run, movement, reading, axis) [m]; 0 where there is none.
        seen: Readings that are there, (run, movement, reading).
    """

    since: FloatArray
    point: FloatArray
    seen: BoolArray

    def __getitem__(self, runs: slice) -> TransientSamples:
        """Return the evidence of some of the runs."""
        return TransientSamples(self.since[runs], self.point[runs], self.seen[runs])

    def where(self, wanted: BoolArray) -> TransientSamples:
        """Return the evidence of some of the movements alone, (run, movement)."""
        return TransientSamples(self.since, self.point, self.seen & wanted[..., None])


def transient_samples(runs: xr.Dataset, settled: SettledEvidence) -> TransientSamples:
    """Return the readings of each movement before those that `settled` has used.

    Of densely sampled paths readings are left out evenly, so that no two lie closer than the true
    rate of the sensor says; samples on lines drawn between readings do not count.

    Args:
        runs: A run set; `measured` (run, time, axis) is read.
        settled: Where the tool settled in the same runs.
    """
    time = as_floats(runs["time"].values)
    readings, least_step = measured_samples(runs), 0.9 / measured_rate(runs)
    measured, read = readings.point, readings.seen.copy()
    for run in np.flatnonzero(readings.filled):
        read[run] &= _corners(measured[run], grid_steps(runs))
    start = settled.movements.start
    until = np.where(settled.usable, settled.begin, settled.end)
    shape = (*start.shape, MOST_READINGS)
    since, point = np.zeros(shape), np.zeros((*shape, 3))
    seen = np.zeros(shape, dtype=bool)
    for run, movement in np.argwhere(settled.movements.exists & (until > start)):
        first, stop = np.searchsorted(time, [start[run, movement], until[run, movement] - 1e-9])
        rows = first + np.flatnonzero(read[run, first:stop])
        rows = rows[spread_out(time[rows], least_step)]
        since[run, movement, : len(rows)] = time[rows] - start[run, movement]
        point[run, movement, : len(rows)] = measured[run, rows]
        seen[run, movement, : len(rows)] = True
    return TransientSamples(since, point, seen)


def _corners(path: FloatArray, every: int) -> BoolArray:
    """Return which samples of a filled path (time, axis) may be readings, (time,).

    Drawn out otherwise than by straight lines, as by lines between the angles of the motors: every
    so many, where it bends most.
    """
    bend = np.zeros(len(path))
    bend[1:-1] = np.linalg.norm(np.nan_to_num(np.diff(path, 2, axis=0)), axis=-1)
    phase = np.arange(len(path)) % every
    return np.asarray(phase == np.argmax(np.bincount(phase, bend)))


def spread_out(time: FloatArray, least_step: float) -> IntArray:
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
