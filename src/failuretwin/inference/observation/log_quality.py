"""What is wrong with a log itself, before anyone asks what is wrong with the robot.

Section: docs/inference.md#moments
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.core.movements import Movements
from failuretwin.core.runs import AXES, measured_rate
from failuretwin.core.types import BoolArray, FloatArray, as_floats
from failuretwin.digital_model.robot import Robot
from failuretwin.inference.observation.readings import MeasuredSamples, measured_samples
from failuretwin.inference.observation.settings import USUAL, InferenceSettings

if TYPE_CHECKING:
    import xarray as xr

GAP_S = 0.5
"""A longer silence is a gap [s], whatever the rate."""
CLOCK_JUMP_S = 5.0
"""A longer silence is more likely a jump of the clock [s]; stalls of the bus last up to 4 s."""
SPARSE_S, FEW_READINGS = 10.0, 20
"""Readings that come so far apart [s], more than a few, show nothing of an arm; milliseconds taken
for seconds do."""
LEAST_RATE_HZ = 2.0
"""Slower readings can miss a plateau of a second [Hz]."""
GLITCH_M = 0.03
"""A single reading this far from both its neighbours is a glitch [m]."""
STILL_M = 1e-9
"""A sensor that reports the very same number is frozen [m]; a live one flickers by a count."""
FROZEN_S = 2.5
"""Shortest time that a channel must stand still to be called frozen [s]; a plateau is shorter."""
FROZEN_TRAVEL_RAD = 0.2
"""Travel of two motors that must show at the tool [rad], about 12 degrees; one may be stuck."""
NEARLY_STILL_S = 4.0
"""A tool that stands nearly still for so long is dead, or its sensor [s]; a plateau and a late
start last 3 s."""
LOOK_S = 0.1
"""Readings are looked at no more often than this for a tool that stands nearly still [s]."""
DEAD_SHARE = 0.6
"""A tool that stands still for more than this share of a run says nothing [-]."""
NEAR_ZERO_M = 0.002
"""Nearer to zero than this a coordinate can stand still because a motor does [m]: it then moves in
the plane of the others. No motor can hold a coordinate at another value while the arm moves."""
SHOWN = 3
"""Times listed for each kind of defect; the rest is counted."""


@dataclass(frozen=True)
class LogQuality:
    """Defects of one log.

    Attributes:
        remarks: What is wrong, a line each, with times.
        fatal: Why no verdict can be had from it; empty where one can.
        spoilt: Stretches of time whose readings say nothing of the arm [s].
    """

    remarks: tuple[str, ...] = ()
    fatal: str = ""
    spoilt: tuple[tuple[float, float], ...] = ()


def log_quality(
    runs: xr.Dataset,
    readings: MeasuredSamples | None = None,
    settings: InferenceSettings = USUAL,
) -> list[LogQuality]:
    """Return the defects of each run's log.

    Lines drawn across a gap do not hide it.

    Args:
        runs: A run set; `command` and `measured` are read.
        readings: The readings of the same runs, where they are known already.
        settings: How near is still, and which axes always are.
    """
    time, rate = as_floats(runs["time"].values), measured_rate(runs)
    command = as_floats(runs["command"].values)
    point = (readings or measured_samples(runs)).point
    return [_quality(time, c, m, rate, settings) for c, m in zip(command, point, strict=True)]


SLACK = 0.01
"""Share of a range by which a command may leave it unremarked: limits are often rounded."""
BEYOND = "commands go beyond"
BEYOND_USUAL = f"{BEYOND} movement_range"
"""Begin of the remarks on commands outside the joint limits, and outside the usual ranges."""


def commands_beyond(robot: Robot, movements: Movements, run: int) -> list[str]:
    """Return where the commands of a run leave what the profile of the robot says, a line each.

    Args:
        robot: The robot.
        movements: The movements.
        run: Index of the run.
    """
    told = movements.target[run][movements.exists[run]]
    if not len(told):
        return []
    lowest, highest = told.min(axis=0), told.max(axis=0)
    expected = np.array([motor.movement_range for motor in robot.motors])
    lines, remarked = [], np.zeros(len(expected), dtype=bool)
    for ranges, name, means in (
        (robot.limits, "the limits of their joints", "are units, zeros and senses right?"),
        (expected, "movement_range", "what the profile says of usual loads may not hold there"),
    ):
        slack = SLACK * np.where(np.isfinite(ranges).all(axis=1), np.ptp(expected, axis=1), 0.0)
        beyond = (lowest < ranges[:, 0] - slack) | (highest > ranges[:, 1] + slack)
        which = np.flatnonzero(beyond & ~remarked)
        remarked |= beyond
        if len(which):
            spans = [_span(robot, int(k), lowest[k], highest[k], ranges[k]) for k in which]
            lines.append(f"{BEYOND} {name}: {', '.join(spans)}; {means}")
    return lines


def _span(robot: Robot, motor: int, low: float, high: float, expected: FloatArray) -> str:
    """Return how far a motor is told to go, and within what it was expected."""
    factor, unit = (1e3, "mm") if robot.slides[motor] else (float(np.rad2deg(1.0)), "deg")
    name, (first, last) = robot.motor_names[motor].replace("_", " "), factor * expected
    return (
        f"{name} from {factor * low:.0f} to {factor * high:.0f} {unit} "
        f"(expected {first:.0f} to {last:.0f})"
    )


def sensor_quality(runs: xr.Dataset, readings: MeasuredSamples) -> list[LogQuality]:
    """Return the defects of each run's log where the tool's position is not seen.

    Args:
        runs: A run set; `command` is read.
        readings: The readings of the sensors that are believed.
    """
    time, rate = as_floats(runs["time"].values), measured_rate(runs)
    told = as_floats(runs["command"].values)
    found = []
    for command, point, seen in zip(told, readings.point, readings.seen, strict=True):
        if seen.sum() < 2:
            found.append(LogQuality(fatal="the log holds no readings of the sensors"))
            continue
        remarks = (*_timing(time[seen], rate), *_gaps(time[seen], rate))
        frozen = [_frozen(time, command, values, seen) for values in point.T]
        dead = "the sensors stand still though motors are told to move: they are dead"
        alone = command.shape[-1] == 1  # that motor may be stuck
        found.append(LogQuality(remarks, dead if all(frozen) and not alone else ""))
    return found


def drop_invalid(runs: xr.Dataset, quality: Sequence[LogQuality]) -> xr.Dataset:
    """Return the runs with spoilt readings missing; the given run set stays as it is."""
    if not any(q.spoilt for q in quality):
        return runs
    time, measured = as_floats(runs["time"].values), runs["measured"].values.copy()
    for run, log in enumerate(quality):
        for begin, end in log.spoilt:
            measured[run, (time >= begin - 1e-9) & (time <= end + 1e-9)] = np.nan
    return runs.assign(measured=(runs["measured"].dims, measured))


def _quality(
    time: FloatArray,
    command: FloatArray,
    measured: FloatArray,
    rate: float,
    settings: InferenceSettings,
) -> LogQuality:
    seen = np.asarray(np.isfinite(measured).all(axis=1))
    if seen.sum() < 2:
        return LogQuality(fatal="the log holds no readings of the tool")
    apart = float(np.median(np.diff(time[seen])))
    if apart > SPARSE_S and seen.sum() > FEW_READINGS:
        return LogQuality(
            fatal=f"readings come {apart:.3g} s apart: times seem to be in milliseconds, expected "
            "seconds"
        )
    remarks = [
        *_partial_readings(time, measured, seen),
        *_timing(time[seen], rate),
        *_gaps(time[seen], rate),
        *_glitches(time[seen], measured[seen]),
    ]
    frozen = [_frozen(time, command, values, seen) for values in measured.T]
    still = [stretch for stretch in frozen if stretch is not None]
    if len(still) == len(frozen):
        return _still_tool(tuple(remarks), still, time[seen])
    near = settings.nearly_still_m
    nearly = _nearly_still(time, command, measured[seen], time[seen], near)
    if nearly is not None:
        return _still_tool(tuple(remarks), [nearly], time[seen])
    spoilt = []
    channels = zip(AXES, measured.T, frozen, settings.idle_axes, strict=True)
    for axis, values, stretch, idle in channels:
        if stretch is None or idle:
            continue
        remark = f"{axis} stands still {_times([stretch])} while the arm moves"
        if abs(values[np.searchsorted(time, stretch[0] - 1e-9)]) < NEAR_ZERO_M:
            remarks.append(f"{remark}: a dead sensor channel, or a stuck motor holds it at zero")
        else:
            remarks.append(f"{remark}: a dead sensor channel")
            spoilt.append(stretch)
    return LogQuality(tuple(remarks), spoilt=tuple(spoilt))


def _still_tool(
    remarks: tuple[str, ...], still: Sequence[tuple[float, float]], at: FloatArray
) -> LogQuality:
    """Return the quality of a log whose tool stands still on all axes."""
    begin, end = max(begin for begin, _ in still), min(end for _, end in still)
    remark = f"the tool stands still {_times([(begin, end)])} though motors are told to move"
    fatal = ""
    if end - begin > DEAD_SHARE * (at[-1] - at[0]):
        fatal = (
            "the tool stands still though motors are told to move: the sensor or the whole arm is "
            "dead"
        )
    return LogQuality((*remarks, remark), fatal, ((begin, end),))


def _partial_readings(time: FloatArray, measured: FloatArray, seen: BoolArray) -> list[str]:
    partial = np.isfinite(measured).any(axis=1) & ~seen
    if not partial.any():
        return []
    return [f"{partial.sum()} readings lack an axis, the first at {time[partial][0]:.1f} s"]


def _timing(at: FloatArray, rate: float) -> list[str]:
    """Return remarks on the rate of the readings and on the scatter of their times."""
    steps = np.diff(at)
    typical = float(np.median(steps))
    if typical < 0.5 / rate:  # drawn out to a finer grid: no times of their own
        return []
    remarks = []
    if typical > 1.0 / LEAST_RATE_HZ:
        remarks.append(f"only {1.0 / typical:.1f} readings a second: rests may go unseen")
    if abs(typical * rate - 1.0) > 0.2:
        remarks.append(f"readings come at {1.0 / typical:.1f} Hz, not at {rate:.1f} Hz")
    jitter = 1.4826 * float(np.median(np.abs(steps - typical)))
    if jitter > 0.2 * typical:
        remarks.append(f"the times of the readings scatter by {1000.0 * jitter:.0f} ms")
    grid = float(steps.min())  # times are rounded to the grid, so steps differ by some of it
    lacking = steps > 1.5 * typical + min(2.0 * grid, 0.5 * typical)
    missing = int(np.sum(lacking & (steps <= max(3.0 * typical, GAP_S))))
    if missing > 1:
        remarks.append(f"{missing} times a reading or two are missing")
    return remarks


def _gaps(at: FloatArray, rate: float) -> list[str]:
    steps = np.diff(at)
    limit = max(3.0 / rate, GAP_S)
    jumps = steps > CLOCK_JUMP_S
    remarks = []
    for kind, which in (
        ("no readings", (steps > limit) & ~jumps),
        ("no readings, or the clock jumped,", jumps),
    ):
        if which.any():
            stretches = list(zip(at[:-1][which], at[1:][which], strict=True))
            remarks.append(f"{kind} {_times(stretches)}")
    return remarks


def _glitches(at: FloatArray, point: FloatArray) -> list[str]:
    """Return a remark on readings that leap away from both neighbours and back."""
    if len(point) < 3:
        return []
    before = np.linalg.norm(point[1:-1] - point[:-2], axis=1)
    after = np.linalg.norm(point[1:-1] - point[2:], axis=1)
    across = np.linalg.norm(point[2:] - point[:-2], axis=1)
    leap = np.minimum(before, after)
    glitch = (leap > GLITCH_M) & (across < 0.5 * leap)
    if not glitch.any():
        return []
    times = [f"{t:.1f}" for t in at[1:-1][glitch]]
    return [f"{len(times)} glitch{'es' * (len(times) > 1)} at {_listed(times)} s"]


def _frozen(
    time: FloatArray, command: FloatArray, values: FloatArray, seen: BoolArray
) -> tuple[float, float] | None:
    """Return the longest stretch [s] in which a channel stands still though motors travel."""
    at, reading = time[seen], values[seen]
    changes = np.flatnonzero(np.abs(np.diff(reading)) > STILL_M)
    edges = np.concatenate([[0], changes + 1, [len(reading)]])
    longest = int(np.argmax(np.diff(edges)))
    first, last = int(edges[longest]), int(edges[longest + 1]) - 1
    begin, end = float(at[first]), float(at[last])
    if end - begin < FROZEN_S or not _told_to_move(time, command, at[first : last + 1]):
        return None
    return begin, end


def _nearly_still(
    time: FloatArray, command: FloatArray, point: FloatArray, at: FloatArray, radius: float
) -> tuple[float, float] | None:
    """Return the longest stretch [s] in which the tool stays near one place though told to move.

    Args:
        time: Uniform grid, (time,) [s].
        command: References, (time, motor) [rad].
        point: Readings, (reading, axis) [m].
        at: When they were taken, (reading,) [s].
        radius: How near [m].
    """
    every = max(1, int(LOOK_S / np.median(np.diff(at))))
    best, first = (0, 0), 0
    for last in range(0, len(at), every):
        if np.abs(point[last] - point[first]).max() > radius:
            first = last
        elif at[last] - at[first] > at[best[1]] - at[best[0]]:
            best = (first, last)
    near = np.abs(point[best[1] :] - point[best[0]]).max(axis=1) <= radius
    leaves = len(near) if near.all() else int(np.argmin(near))
    last = best[1] + leaves - 1
    begin, end = float(at[best[0]]), float(at[last])
    if end - begin < NEARLY_STILL_S or not _told_to_move(time, command, at[best[0] : last + 1]):
        return None
    return begin, end


def _told_to_move(time: FloatArray, command: FloatArray, still: FloatArray) -> bool:
    """Return whether motors are told to move between the readings of a stretch, (reading,) [s].

    The first may bear a time from before the bus stalled, and the movement may have been then.
    """
    there = (time >= still[min(1, len(still) - 1)]) & (time <= still[-1])
    return bool(should_move(np.ptp(command[there], axis=0)))


def should_move(travel: FloatArray) -> BoolArray:
    """Return where motors are told to travel so far that no single stuck one could hide it.

    Args:
        travel: Range of their references, (..., motor) [rad]; NaN where not known.

    Returns:
        (...).
    """
    return np.asarray(np.sort(travel, axis=-1)[..., -2:].min(axis=-1) > FROZEN_TRAVEL_RAD)


def _times(stretches: Sequence[tuple[float, float]]) -> str:
    return _listed([f"from {begin:.1f} to {end:.1f} s" for begin, end in stretches])


def _listed(items: Sequence[str]) -> str:
    more = f" and {len(items) - SHOWN} more" if len(items) > SHOWN else ""
    return ", ".join(items[:SHOWN]) + more
