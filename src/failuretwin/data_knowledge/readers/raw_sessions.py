"""Raw session folders: three CSV files as the robot's own logger writes them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.foreign import files_below
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.core.runs import STEP_S, RunSet, RunTable, Truth, concatenate
from failuretwin.core.types import MS_PER_S, FloatArray
from failuretwin.data_knowledge.readers.table import Table
from failuretwin.data_knowledge.readers.timed_log import (
    Samples,
    Targets,
    TimedLog,
    gridded,
    path_of_readings,
    uniform_grid,
)
from failuretwin.digital_model.robot import Robot

COMMAND_FILE = "trajectory_monitoring_cmd.csv"
DURATION_FILE = "trajectory_monitoring_cmd_duration.csv"
POSITION_FILE = "trajectory_monitoring_position.csv"
RAMP_RANGE_MS = (1.0, 60000.0)
"""Shortest and longest time to reach a target that makes sense [ms]."""
SESSION_FILES = (COMMAND_FILE, DURATION_FILE, POSITION_FILE)


@dataclass(frozen=True)
class RawSession:
    """One session in servo counts and the robot's own clock, motors in chain order.

    Attributes:
        folder: Where it was read.
        command_time: Stamps of the command rows, (row,) [s].
        target_counts: Targets, (row, motor) [counts].
        ramp_s: Time to reach them, (row, motor) [s].
        reading_time: Stamps of the readings, (reading,) [s].
        reading_counts: Readings as logged, glitches included, (reading, motor) [counts].
    """

    folder: Path
    command_time: FloatArray
    target_counts: FloatArray
    ramp_s: FloatArray
    reading_time: FloatArray
    reading_counts: FloatArray

    @property
    def name(self) -> str:
        """Name of the session: that of its folder."""
        return self.folder.name


def find_sessions(path: Path) -> list[Path]:
    """Return every session folder at or below `path`, in order of their names.

    Raises:
        InputError: If a folder holds some but not all of the three files.
    """
    folders = sorted({file.parent for name in SESSION_FILES for file in files_below(path, name)})
    for folder in folders:
        missing = [name for name in SESSION_FILES if not (folder / name).is_file()]
        if missing:
            raise InputError(
                f"{folder}: a session needs three files, {', '.join(SESSION_FILES)}; "
                f"missing: {', '.join(missing)}."
            )
    return folders


def read_session(folder: Path, robot: Robot) -> RawSession:
    """Read a session folder.

    Raises:
        InputError: If a file cannot be read, lacks a column, holds something that is no number,
            runs backwards in time, or has no sound reading at all.
    """
    columns = [motor.log_column for motor in robot.motors]
    if not all(columns):
        raise InputError(
            f"robot {robot.name!r} has no log_column for some motors; raw sessions need one for "
            "each. Add them to the profile."
        )
    command = _read_table(folder / COMMAND_FILE, columns)
    duration = _read_table(folder / DURATION_FILE, columns)
    reading = _read_table(folder / POSITION_FILE, columns)
    if len(command) != len(duration):
        raise InputError(
            f"{folder}: {COMMAND_FILE} has {len(command)} rows and {DURATION_FILE} "
            f"{len(duration)}. Expected a duration for every command."
        )
    if len(reading) < 2:
        raise InputError(
            f"{folder / POSITION_FILE}: has {len(reading)} readings, expected two at least."
        )
    if not robot.servo_units.valid(reading[:, 1:]).all(axis=1).any():
        raise InputError(
            f"{folder / POSITION_FILE}: no reading lies within the servo's range of "
            f"{robot.servo_units.low:g} to {robot.servo_units.high:g} counts in every motor. "
            "Check the servo bus; this log cannot be used."
        )
    units = robot.servo_units
    _check_range(command[:, 1:], (units.low, units.high), folder / COMMAND_FILE, columns)
    _check_range(duration[:, 1:], RAMP_RANGE_MS, folder / DURATION_FILE, columns)
    return RawSession(
        folder=folder,
        command_time=command[:, 0],
        target_counts=command[:, 1:],
        ramp_s=duration[:, 1:] / MS_PER_S,
        reading_time=reading[:, 0],
        reading_counts=reading[:, 1:],
    )


def _check_range(
    values: FloatArray, limits: tuple[float, float], path: Path, columns: Sequence[str]
) -> None:
    low, high = limits
    wrong = np.argwhere((values < low) | (values > high))
    if len(wrong):
        row, column = wrong[0]
        raise InputError(
            f"{path}: line {row + 2}, column {columns[column]}: got {values[row, column]:g}, "
            f"expected {low:g} to {high:g}."
        )


def _read_table(path: Path, columns: Sequence[str]) -> FloatArray:
    """Return stamps and the given columns of a CSV file, (row, 1 + column), checked."""
    table = Table.read(path)
    wanted = ["timestamp", *columns]
    for column in wanted:
        if f"{column}.1" in table.names:  # pandas' name for a second column of that name
            raise InputError(f"{path}: has two columns {column!r}. Remove one of them.")
    values = table.numbers(wanted, gaps=False)
    steps = np.diff(values[:, 0])
    if np.any(steps <= 0):
        row = int(np.argmax(steps <= 0))
        raise InputError(
            f"{path}: time runs backwards or stands still at line {row + 3} (from "
            f"{values[row, 0]:.6f} to {values[row + 1, 0]:.6f} s). Sort or cut the log."
        )
    return values


# Runs out of raw sessions, in two ways.

As = Literal["measured", "published"]

READING_RATE_HZ = 10.0
"""Nominal rate of the robot's readings [Hz]."""
GAP_S = 0.5
"""A longer silence between two readings is a gap [s]; the nominal step is 0.1 s."""
PUBLISHED_TIME = np.linspace(0.0, 10.0, 1000)
"""Time grid of the published runs [s]."""
PUBLISHED_FREEZE = 49
"""0-based sample from which the authors froze the motor of a stuck label."""


def split_session(session: RawSession, robot: Robot) -> list[range]:
    """Return which command rows form the runs of a session.

    Sessions of random movements send the arm home (every motor at the middle of its scale), make
    the movements of a run and repeat the last one; home and repeat belong to no run. A session
    without a repeated row is one run from its first row on.
    """
    units, target = robot.servo_units, session.target_counts
    home = np.flatnonzero(np.all(target == (units.low + units.high) / 2.0, axis=1))
    groups = list(pairwise([*home, len(target)]))
    if not any(_ends_in_repeat(target[first:stop]) for first, stop in groups):
        return [range(len(target))]
    spans = [
        range(int(first) + 1, int(stop) - int(_ends_in_repeat(target[first:stop])))
        for first, stop in groups
    ]
    return [span for span in spans if span]


def _ends_in_repeat(target: FloatArray) -> bool:
    return len(target) > 2 and np.array_equal(target[-1], target[-2])


def label_of(session: RawSession) -> int:
    """Return the published label that the folder name ends in.

    Raises:
        InputError: If the name does not end in ``_label_K``.
    """
    match = re.search(r"_label_([0-8])$", session.name)
    if match is None:
        raise InputError(
            f"{session.folder}: --published-labels takes the truth from folder names that end in "
            f"_label_0 to _label_8; this one is {session.name!r}. Leave the option out."
        )
    return int(match.group(1))


def session_runs(
    session: RawSession, robot: Robot, how: As, *, published_labels: bool = False
) -> RunSet:
    """Return the runs of a session as one run set.

    Args:
        session: The raw session.
        robot: The robot it is of.
        how: ``measured`` or ``published``.
        published_labels: Take the truth from the folder's name, and freeze the labelled motor of
            labels 1 to 4 as the authors did (the robot itself was healthy).

    Raises:
        InputError: If the session holds no complete run.
    """
    label = label_of(session) if published_labels else None
    spans = split_session(session, robot)
    for span in spans:
        _check_length(session, span)
    runs = [_run(session, robot, span, how, label) for span in spans]
    names = [f"{session.name}/run_{number:02d}" for number in range(1, len(runs) + 1)]
    return concatenate(
        [replace(run, run=[name]).to_dataset() for run, name in zip(runs, names, strict=True)]
    )


def _run(session: RawSession, robot: Robot, span: range, how: As, label: int | None) -> RunTable:
    window = _measured_window if how == "measured" else _published_window
    begin, time, readings = window(session, robot, span)
    units, rows = robot.servo_units, slice(span.start, span.stop)
    initial = _initial_counts(session, span, begin, how)
    command = Targets(
        time=session.command_time[rows] - begin,
        target=units.to_rad(session.target_counts[rows]),
        duration=session.ramp_s[rows],
        initial=units.to_rad(initial),
    )
    position = Samples(readings.time, units.to_rad(readings.value))
    truth = None if label is None else _frozen(label, position, session, begin, robot)
    tool = Samples(readings.time, path_of_readings(position.value, robot))
    log = TimedLog(session.name, command, position=position)
    return replace(gridded(log, tool, robot, time, 0.0, READING_RATE_HZ), truth=truth)


_Window = tuple[float, FloatArray, Samples]
"""Start of a run by the session's clock, its time grid from there, and its readings in counts."""


def _measured_window(session: RawSession, robot: Robot, span: range) -> _Window:
    """Return the window from the last reading before a run to the next command, as measured."""
    stamps = session.reading_time
    command = float(session.command_time[span.start])
    begin = _last_reading_before(session, command)
    begin = command if begin is None or begin < command - 2.0 * GAP_S else begin
    end = float(np.append(session.command_time, np.inf)[span.stop])
    end = min(end, float(stamps[-1]))
    both = np.concatenate([session.command_time[span.start : span.stop], stamps])
    inside = both[(both >= begin) & (both <= end)]
    time = uniform_grid(inside, end - begin, STEP_S, str(session.folder))
    # A reading before a gap stalled: it was taken at some time within the gap.
    stalled = np.append(np.diff(stamps) > GAP_S, False)
    kept = (stamps >= begin) & (stamps <= end) & ~stalled
    counts = session.reading_counts[kept]
    counts = np.where(robot.servo_units.valid(counts), counts, np.nan)
    return begin, time, Samples(stamps[kept] - begin, counts)


def _published_window(session: RawSession, robot: Robot, span: range) -> _Window:
    """Return the window of the published length, with readings drawn out by straight lines."""
    begin = _last_reading_before(session, session.command_time[span.start])
    if begin is None:
        raise InputError(
            f"{session.folder}: no reading before the first command of a run, which the published "
            "form starts from. Read it as measured."
        )
    at = session.reading_time - begin
    lines = [np.interp(PUBLISHED_TIME, at, m, right=np.nan) for m in session.reading_counts.T]
    return begin, PUBLISHED_TIME, Samples(PUBLISHED_TIME, np.stack(lines, axis=1))


def _last_reading_before(session: RawSession, stamp: float) -> float | None:
    """Return the stamp of the last reading before `stamp` [s], None if there is none."""
    index = int(np.searchsorted(session.reading_time, stamp)) - 1
    return None if index < 0 else float(session.reading_time[index])


def _check_length(session: RawSession, span: range) -> None:
    """Raise InputError unless the readings outlast the first ramp of a run."""
    reached = session.command_time[span.start] + session.ramp_s[span.start].max()
    if session.reading_time[-1] < reached:
        raise InputError(
            f"{session.folder}: the readings end before the first movement of the run does (line "
            f"{span.start + 2} of {COMMAND_FILE}). A run needs one whole movement at least."
        )


def _initial_counts(session: RawSession, span: range, begin: float, how: As) -> FloatArray:
    """Return where the first ramp starts, (motor,) [counts].

    It is the target before it, where the session holds one; else the reading at the start, as
    published; else (the log starts later) the first target, so that no ramp is seen.
    """
    if span.start > 0 and how == "measured":
        return session.target_counts[span.start - 1]
    index = int(np.searchsorted(session.reading_time, begin))
    if session.reading_time[index] > session.command_time[span.start]:
        return session.target_counts[span.start]
    return session.reading_counts[index]


def _frozen(
    label: int, position: Samples, session: RawSession, begin: float, robot: Robot
) -> Truth:
    """Return the truth of a label; the motor of a stuck one is frozen in the readings [rad]."""
    stuck, held = 1 <= label <= len(robot.motors), np.nan
    if stuck:
        freeze, angle = PUBLISHED_TIME[PUBLISHED_FREEZE], position.value[:, label - 1]
        raw = session.reading_counts[:, label - 1]
        counts = np.interp(freeze, session.reading_time - begin, raw)
        held = float(robot.servo_units.to_rad(counts))
        angle[(position.time >= freeze) & np.isfinite(angle)] = held
    fault = str(paper_hypotheses(robot.motor_names)[label])
    return Truth(
        fault=[fault],
        detail=[{"source": "published label", "label": label, "frozen_afterwards": stuck}],
        onset=np.array([published_onset(fault, PUBLISHED_TIME)]),
        magnitude=np.array([held]),
    )


def published_onset(fault: str, time: FloatArray) -> float:
    """Return the onset of a published fault on the grid `time` (time,) [s]; NaN: healthy."""
    if fault == "healthy":
        return float("nan")
    return float(time[PUBLISHED_FREEZE]) if fault.endswith(":stuck") else 0.0
