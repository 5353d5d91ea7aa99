"""What the logs say between the plateaus: late starts, gaps, glitches, and ramps for the timing."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.connection.calibration.rates import Rate
from failuretwin.connection.calibration.settled_part import SettledPart
from failuretwin.connection.calibration.timing_fit import Transients, motion
from failuretwin.core.movements import Movements, find_movements
from failuretwin.core.runs import measured_rate
from failuretwin.core.types import BoolArray, FloatArray, as_floats
from failuretwin.data_knowledge.true_readings import true_readings
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import Settling, sag
from failuretwin.digital_model.twin import DigitalTwin

if TYPE_CHECKING:
    import xarray as xr

LATE_S = 0.15
"""A movement that outlasts the usual time to the next command by this much started late [s]."""
STEADY_S = 0.05
"""Commands whose spacing scatters less than this come at a steady pace [s]."""
AFTER_RAMP_S = 0.25
"""Readings up to this long after a ramp still tell of its timing [s]."""
USUAL_LAG_S = 0.03
"""Lag with which the tool path's poses are guessed, for the sag on the way [s]."""
GAP_PERIODS = 4.0
"""A silence of this many periods of the readings is a gap."""


@dataclass(frozen=True)
class Lateness:
    """Late starts of a stalled bus, read off the times between commands.

    Attributes:
        known: Whether commands come at a steady pace, so that lateness can be told.
        late: How late each movement started, (run, movement) [s]; 0 punctual, NaN not known.
        period: Usual time from command to command [s].
    """

    known: bool
    late: FloatArray
    period: float

    @property
    def delayed(self) -> BoolArray:
        """Which movements surely started late, (run, movement)."""
        return np.asarray(self.late > 0.0)

    @property
    def punctual(self) -> BoolArray:
        """Which movements surely started on time, (run, movement).

        The last one of a run holds up no other: it is taken for punctual only if all others were.
        """
        return np.asarray(self.late == 0.0) if self.delayed.any() else ~self.delayed


def lateness(movements: Movements) -> Lateness:
    """Return how late movements started: a late start holds up the next command."""
    spacing = np.diff(movements.start, axis=1)
    late = np.full(movements.start.shape, np.nan)
    seen = spacing[np.isfinite(spacing)]
    if len(seen) < 3:
        return Lateness(False, late, float("nan"))
    period = float(np.median(seen))
    spread = 1.4826 * float(np.median(np.abs(seen - period)))
    if spread > STEADY_S:
        return Lateness(False, late, period)
    excess = spacing - period
    late[:, :-1] = np.where(np.isfinite(excess), np.where(excess > LATE_S, excess, 0.0), np.nan)
    return Lateness(True, late, period)


def gap_starts(runs: xr.Dataset, movements: Movements, late: FloatArray) -> FloatArray:
    """Return when readings stop before late starts, after the movement before, (gap,) [s]."""
    time, rate = as_floats(runs["time"].values), measured_rate(runs)
    seen = true_readings(runs).seen
    found = []
    for run, movement in np.argwhere(np.nan_to_num(late) > 0.0):
        if movement == 0:
            continue
        begin, end = movements.start[run, movement - 1], movements.start[run, movement]
        inside = time[seen[run] & (time > begin) & (time < end + late[run, movement])]
        holes = np.flatnonzero(
            np.diff(np.append(inside, end + late[run, movement])) > GAP_PERIODS / rate
        )
        if len(holes):
            found.append(inside[holes[0]] + 0.5 / rate - begin)
    return np.array(found)


def glitch_rates(runs: xr.Dataset) -> list[Rate] | None:
    """Return the share of spoilt readings of each motor; None where motors were not read."""
    if "position" not in runs:
        return None
    finite = np.isfinite(as_floats(runs["position"].values))
    rows = int(finite.any(axis=2).sum())
    return [Rate(rows - int(finite[..., motor].sum()), rows) for motor in range(finite.shape[2])]


def transients(
    runs: xr.Dataset,
    movements: Movements,
    late: Lateness,
    part: SettledPart,
    settling: Settling,
    robot: Robot,
) -> Transients:
    """Return the readings on ramps that began on time and at a known place.

    Args:
        runs: The runs of the observations.
        movements: Their movements.
        late: How late they started.
        part: Sorted settled movements.
        settling: Where motors settle.
        robot: The robot.
    """
    time = as_floats(runs["time"].values)
    used = _on_time(movements, late, part, time)
    of_motors = part.observations.position is not None
    reading = as_floats(runs["position"].values) if of_motors else true_readings(runs).point
    free = unloaded_movements(movements, settling)
    if of_motors:
        pose = np.nan_to_num(reading)
    else:
        none = np.zeros(len(movements.start))
        pose = motion(free, time, DigitalTwin(robot), none, none, USUAL_LAG_S)
    return Transients(
        movements=free,
        yielding=sag(robot, pose, np.asarray(settling.compliance), settling.payload),
        reading=reading,
        of_motors=of_motors,
        used=used & np.isfinite(reading).all(axis=2),
        time=time,
    )


def _on_time(
    movements: Movements, late: Lateness, part: SettledPart, time: FloatArray
) -> BoolArray:
    """Return which times belong to a ramp that began on time at a known place, (run, time)."""
    on_time = _sound(movements, part) & late.punctual
    used = np.zeros((len(movements.start), len(time)), dtype=bool)
    for run, movement in np.argwhere(on_time):
        begin = movements.start[run, movement]
        end = begin + np.nanmax(movements.ramp_duration[run, movement]) + AFTER_RAMP_S
        used[run] |= (time >= begin) & (time < end)
    return used


def _sound(movements: Movements, part: SettledPart) -> BoolArray:
    """Return which movements began and ended where the fit says, (run, movement)."""
    good, seen = np.zeros(movements.start.shape, dtype=bool), part.observations
    fine = ~part.odd & (part.arrived > 0.5).all(axis=1)
    good[seen.run[fine], seen.number[fine]] = True
    before = np.ones_like(good)
    before[:, 1:] = good[:, :-1]
    return good & before


def unloaded_movements(movements: Movements, settling: Settling) -> Movements:
    """Return the movements with the targets at which motors would settle without load."""
    bias, friction = np.asarray(settling.bias), np.asarray(settling.friction)
    travel = np.nan_to_num(movements.target) - np.nan_to_num(movements.origin())
    return replace(
        movements,
        initial=movements.initial + bias,
        target=movements.target + bias - friction * np.sign(travel),
    )


def movements_of(runs: xr.Dataset) -> Movements:
    """Return the movements of a run set."""
    return find_movements(as_floats(runs["command"].values), as_floats(runs["time"].values))
