"""What a network may look at: commands and tool paths as plain arrays, and nothing else."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.core.runs import RunTable
from failuretwin.core.types import BoolArray, FloatArray, as_floats

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True)
class Signals:
    """Commands and tool paths of many runs.

    Attributes:
        time: Uniform grid from 0, (time,) [s].
        command: (run, time, motor) [rad].
        measured: (run, time, axis) [m]; NaN = no sample.
        duration: True length of each run, (run,) [s].
    """

    time: FloatArray
    command: FloatArray
    measured: FloatArray
    duration: FloatArray

    @property
    def seen(self) -> BoolArray:
        """Where there is a reading, (run, time)."""
        within = self.time <= self.duration[:, None] + 1e-9
        return np.asarray(np.isfinite(self.measured).all(axis=-1) & within)

    @property
    def step(self) -> float:
        """Step of the grid [s]."""
        return float((self.time[-1] - self.time[0]) / (len(self.time) - 1))


def signals_of(runs: xr.Dataset) -> Signals:
    """Return the signals of a run set; reads `command`, `measured` and `duration` alone."""
    time = as_floats(runs["time"].values)
    count = runs.sizes["run"]
    duration = runs["duration"].values if "duration" in runs else np.full(count, time[-1])
    return Signals(
        time,
        as_floats(runs["command"].values),
        as_floats(runs["measured"].values),
        as_floats(duration),
    )


def signals_of_table(table: RunTable) -> Signals:
    """Return the signals of runs that have just been simulated."""
    duration = table.duration
    if duration is None:
        duration = np.full(len(table.run), table.time[-1])
    return Signals(table.time, table.command, table.measured, duration)
