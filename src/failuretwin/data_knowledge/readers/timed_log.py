"""Any log with times becomes a run: commands as sampled or as targets, readings whenever they came.

This is the narrow waist between foreign formats (CSV, bags) and run sets. All values are in SI
units and in the sense of the robot's commands when they get here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.movements import ROUNDING_RAD, Movements
from failuretwin.core.polyline import simplify_motors
from failuretwin.core.runs import AXES, REQUIRED, STEP_S, VARIABLES, RunTable
from failuretwin.core.types import BoolArray, FloatArray, IntArray, as_floats
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin

LONGEST_SILENCE_S = 60.0
"""Longer without any command or reading is a jump of the clock [s], and no time grid spans it."""
SAMPLES_PER_STAMP = 200
"""Steps of the time grid for each command or reading: two seconds of silence on average."""
SAMPLES_ALWAYS = 100_000
"""Steps of the time grid that any log may have: a thousand seconds."""
LONGEST_STEP_S, FEWEST_STEPS = 0.35, 6
"""Set points of a stream are at most so far apart [s]; further ones are commands of their own. And
from how many a stream is told."""
STEADY, STEADY_SHARE = 0.25, 0.8
"""Largest deviation of a steady step from the median, as a share of it, or a row of the log; share
of steady steps."""


@dataclass(frozen=True)
class Samples:
    """Values at increasing times.

    Attributes:
        time: (sample,) [s].
        value: (sample, channel).
    """

    time: FloatArray
    value: FloatArray

    @property
    def rate_hz(self) -> float:
        """Typical rate of the samples [Hz]."""
        return float(1.0 / np.median(np.diff(self.time)))

    def take(self, rows: BoolArray | IntArray) -> Samples:
        """Return some of the samples."""
        return Samples(self.time[rows], self.value[rows])


@dataclass(frozen=True)
class Targets:
    """Commands as targets with the time to reach them.

    Attributes:
        time: When each was sent, (command,) [s].
        target: (command, motor) [rad].
        duration: (command, motor) [s].
        initial: Where the first ramp starts, (motor,) [rad]; None: at the last reading before it,
            or where there is none at the first target, so that no ramp is seen.
    """

    time: FloatArray
    target: FloatArray
    duration: FloatArray
    initial: FloatArray | None = None


def held(target: FloatArray) -> FloatArray:
    """Return targets (row, motor) with each NaN replaced by the one before, or else the next."""
    import pandas as pd

    return as_floats(pd.DataFrame(target).ffill().bfill())


SHAPES: Mapping[str, tuple[int, ...]] = {
    name: (len(AXES),) * (len(dims) - 2)
    for name, (dims, _) in VARIABLES.items()
    if dims[:2] == ("run", "time") and "motor" not in dims and name not in REQUIRED
}
"""Channels of the sensors that a log may hold beside tool and motors; goals have one a motor."""


@dataclass(frozen=True)
class TimedLog:
    """One run as logged.

    Attributes:
        name: Name of the run.
        command: References as sampled (sample, motor) [rad], or targets.
        tool: Tool path (sample, axis) [m]; None: computed from the motor readings, like the
            published virtual sensor.
        position: Motor readings (sample, motor) [rad], NaN where one is missing.
        sensors: Readings of other sensors, by variable of a run set, (sample, channel).
    """

    name: str
    command: Samples | Targets
    tool: Samples | None = None
    position: Samples | None = None
    sensors: Mapping[str, Samples] = field(default_factory=dict)


def timed_run(log: TimedLog, robot: Robot) -> RunTable:
    """Return a log as a run on a uniform grid, readings at their nearest grid times.

    Raises:
        InputError: If the log has no tool path, no motor readings and no other sensor, or its times
            do not increase or are so far apart that their unit must be another.
    """
    log = _distinct(log)
    tool = _tool_path(log, robot)
    _check_commands(log)
    stamps = np.unique(np.concatenate([log.command.time, tool.time]))
    begin, end = stamps[0], max(tool.time[-1], stamps[0] + STEP_S)
    time = uniform_grid(stamps, end - begin, _grid_step(stamps, tool), log.name)
    return gridded(log, tool, robot, time, begin, tool.rate_hz)


def gridded(
    log: TimedLog, tool: Samples, robot: Robot, time: FloatArray, begin: float, rate_hz: float
) -> RunTable:
    """Return a log as a run on the grid `time` (time,), which counts from `begin` [s]."""

    def placed(samples: Samples) -> FloatArray:
        return on_grid(samples, time, begin)[None]

    command, movements = _command(log, time, begin)
    return RunTable(
        run=[log.name],
        motor=robot.motor_names,
        time=time,
        command=command[None],
        measured=placed(tool),
        measured_rate_hz=rate_hz,
        movements=movements,
        position=None if log.position is None else placed(log.position),
        sensors={
            name: placed(one).reshape(1, len(time), *SHAPES.get(name, one.value.shape[1:]))
            for name, one in log.sensors.items()
        },
    )


def _distinct(log: TimedLog) -> TimedLog:
    """Return the log with one row for each time, the last of those that share it.

    Raises:
        InputError: If a part of it runs backwards in time.
    """

    def last(samples: Samples) -> Samples:
        _check_times(samples.time, log.name)
        kept = np.diff(samples.time, append=np.inf) > 0
        return samples.take(kept)

    _check_times(log.command.time, log.name)
    return replace(
        log,
        command=last(log.command) if isinstance(log.command, Samples) else log.command,
        tool=None if log.tool is None else last(log.tool),
        position=None if log.position is None else last(log.position),
        sensors={name: last(samples) for name, samples in log.sensors.items()},
    )


def _check_commands(log: TimedLog) -> None:
    values = log.command.value if isinstance(log.command, Samples) else log.command.target
    for motor, column in enumerate(values.T):
        least = 2 if isinstance(log.command, Samples) else 1
        if np.isfinite(column).sum() < least:
            raise InputError(
                f"{log.name}: motor {motor + 1} has {np.isfinite(column).sum()} commands, expected "
                f"{least} or more. Check its column or topic."
            )


def _grid_step(stamps: FloatArray, tool: Samples) -> float:
    """Return the step of the time grid [s]: the log's own, where it is even and fine enough.

    Otherwise it is the usual one, or that of a faster sensor.
    """
    steps = np.diff(stamps)
    own = float(steps.mean())
    if own <= 2.0 * STEP_S and np.ptp(steps) < 1e-3 * own:
        return own
    return min(STEP_S, 1.0 / tool.rate_hz)


def _tool_path(log: TimedLog, robot: Robot) -> Samples:
    if log.tool is not None:
        if len(log.tool.time) < 2 or log.tool.time[-1] <= log.tool.time[0]:
            raise InputError(f"{log.name}: fewer than two readings of the tool. Log for longer.")
        return log.tool
    if log.position is None and log.sensors:
        time = next(iter(log.sensors.values())).time
        return Samples(time, np.full((len(time), 3), np.nan))
    if log.position is None or len(log.position.time) < 2:
        raise InputError(
            f"{log.name}: holds neither a tool path nor motor readings. Name one of them."
        )
    return Samples(log.position.time, path_of_readings(log.position.value, robot))


def path_of_readings(position: FloatArray, robot: Robot) -> FloatArray:
    """Return the tool path of motor readings, (row, axis) [m]; NaN where a motor has none."""
    sound = np.asarray(np.isfinite(position).all(axis=1))
    path = np.full((len(position), 3), np.nan)
    path[sound] = DigitalTwin(robot).path(position[sound])
    return path


def _check_times(time: FloatArray, name: str) -> None:
    backwards = np.flatnonzero(np.diff(time) < 0)
    if len(backwards):
        row = int(backwards[0])
        raise InputError(
            f"{name}: time runs backwards after {time[row]:.3f} s (to {time[row + 1]:.3f} s). "
            "Sort the log, or cut it where its clock jumped."
        )


def uniform_grid(stamps: FloatArray, length: float, step: float, where: str) -> FloatArray:
    """Return the time grid of a run, (time,) [s].

    `stamps` are the times of its commands and readings, in any order [s].

    Raises:
        InputError: If the stamps hold a silence that no log can mean, or the grid has far more
            samples than there are stamps.
    """
    stamps = np.sort(stamps)
    steps = np.diff(stamps)
    if len(steps) and steps.max() > LONGEST_SILENCE_S:
        before = float(stamps[int(np.argmax(steps))] - stamps[0])
        raise InputError(
            f"{where}: the clock jumps by {steps.max():.0f} s, {before:.1f} s after the start. "
            "Cut the log there."
        )
    if length / step > max(SAMPLES_ALWAYS, SAMPLES_PER_STAMP * len(stamps)):
        raise InputError(
            f"{where}: its {len(stamps)} commands and readings lie {length / step:.2g} steps of "
            f"the time grid apart, expected {SAMPLES_PER_STAMP} steps each at most. Check the unit "
            "of its times: milliseconds may have been taken for seconds."
        )
    return as_floats(np.arange(round(length / step) + 1) * step)


def _command(log: TimedLog, time: FloatArray, begin: float) -> tuple[FloatArray, Movements | None]:
    """Return the reference on the grid (time, motor) [rad] and the movements, where known."""
    if isinstance(log.command, Samples):
        told = as_told(log.command)
        lines = simplify_motors(told.time - begin, told.value, ROUNDING_RAD)
        return np.stack([np.interp(time, *line) for line in lines], axis=1), None
    movements = Movements(
        initial=_initial(log, log.command)[None],
        target=log.command.target[None],
        ramp_duration=log.command.duration[None],
        start=(log.command.time - begin)[None],
    )
    return movements.reference(time)[0], movements


def as_told(command: Samples) -> Samples:
    """Return a command without the rows that repeat a set point until the next one comes.

    A log that is written faster than a stream of set points holds each for some rows: joined by
    lines, these would be stairs. A command that is held for longer is a rest, which stays.
    """
    time, value = command.time, command.value
    differs = np.any(value[1:] != value[:-1], axis=1)
    new = np.flatnonzero(np.concatenate([[True], differs]))
    apart = np.diff(time[new])
    if len(apart) < FEWEST_STEPS:
        return command
    step = float(np.median(apart))
    short = apart <= 1.5 * step
    row = float(np.median(np.diff(time)))
    steady = np.abs(apart[short] - step) <= max(STEADY * step, 1.5 * row)
    often = np.median(np.diff(new)[short]) >= 2.0
    if not (often and step <= LONGEST_STEP_S and steady.mean() >= STEADY_SHARE):
        return command
    ends = np.searchsorted(time, time[new[1:]][~short] - step, side="right") - 1
    return command.take(np.unique(np.concatenate([new, ends, [len(time) - 1]])))


def _initial(log: TimedLog, command: Targets) -> FloatArray:
    """Return where the first ramp starts, (motor,) [rad]; see `Targets`."""
    if command.initial is not None:
        return command.initial
    if log.position is not None:
        whole = np.isfinite(log.position.value).all(axis=1)
        before = np.flatnonzero((log.position.time <= command.time[0]) & whole)
        if len(before):
            return log.position.value[before[-1]]
    return command.target[0]


def on_grid(samples: Samples, time: FloatArray, begin: float = 0.0) -> FloatArray:
    """Return samples at their nearest grid times, NaN elsewhere, (time, channel)."""
    grid = np.full((len(time), samples.value.shape[1]), np.nan)
    nearest = np.rint((samples.time - begin) / (time[1] - time[0])).astype(np.int64)
    inside = (nearest >= 0) & (nearest < len(time))
    grid[nearest[inside]] = samples.value[inside]
    return grid
