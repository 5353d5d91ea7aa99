"""What a run says while the arm moves: readings of the tool from each start until it rests."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.core.runs import measured_rate
from failuretwin.core.types import BoolArray, FloatArray, IntArray, as_floats
from failuretwin.data_knowledge.settled_evidence import SettledEvidence
from failuretwin.data_knowledge.true_readings import grid_steps, true_readings

if TYPE_CHECKING:
    import xarray as xr

MOST_READINGS = 12
"""Readings of one movement that are looked at; more say nothing new, as all share one lag."""


@dataclass(frozen=True)
class MovingEvidence:
    """Readings on the way, for each movement of many runs.

    Attributes:
        since: Time since the movement was commanded, (run, movement, reading) [s].
        point: Tool position, (run, movement, reading, axis) [m]; 0 where there is none.
        seen: Readings that are there, (run, movement, reading).
    """

    since: FloatArray
    point: FloatArray
    seen: BoolArray

    def __getitem__(self, runs: slice) -> MovingEvidence:
        """Return the evidence of some of the runs."""
        return MovingEvidence(self.since[runs], self.point[runs], self.seen[runs])

    def where(self, wanted: BoolArray) -> MovingEvidence:
        """Return the evidence of some of the movements alone, (run, movement)."""
        return MovingEvidence(self.since, self.point, self.seen & wanted[..., None])


def moving_evidence(runs: xr.Dataset, settled: SettledEvidence) -> MovingEvidence:
    """Return the readings of each movement before those that `settled` has used.

    Of densely sampled paths readings are left out evenly, so that no two lie closer than the true
    rate of the sensor says; samples on lines drawn between readings do not count.

    Args:
        runs: A run set; `measured` (run, time, axis) is read.
        settled: Where the tool settled in the same runs.
    """
    time = as_floats(runs["time"].values)
    readings, least_step = true_readings(runs), 0.9 / measured_rate(runs)
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
    return MovingEvidence(since, point, seen)


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
