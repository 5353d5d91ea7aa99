"""Raw session folders: three CSV files as the robot's own logger writes them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np

from failuretwin.core.errors import InputError, unknown_name
from failuretwin.core.foreign import check_memory, files_below
from failuretwin.core.hypothesis import paper_hypotheses
from failuretwin.core.movements import Movements, stack_movements
from failuretwin.core.runs import RunTable, Truth, padded_bytes
from failuretwin.core.types import MS_PER_S, FloatArray, as_floats
from failuretwin.data_knowledge.readers.csv_log import load_csv, numbers
from failuretwin.data_knowledge.readers.timed_log import check_clock, check_grid
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin

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
    table = load_csv(path)
    wanted = ["timestamp", *columns]
    for column in wanted:
        if column not in table:
            raise InputError(
                f"{path}: missing a column: {unknown_name('column', column, map(str, table))}"
            )
        if f"{column}.1" in table:  # the reader's name for a second column of that name
            raise InputError(f"{path}: column {column!r} stands there twice. Remove one of them.")
    values = numbers(table, wanted, path, gaps=False)
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
GRID_STEP_S = 0.01
"""Step of the time grid that measured readings are put on [s]."""
GAP_S = 0.5
"""A longer silence between two readings is a gap [s]; the nominal step is 0.1 s."""
PUBLISHED_TIME = np.linspace(0.0, 10.0, 1000)
"""Time grid of the published runs [s]."""
PUBLISHED_FREEZE = 49
"""0-based sample from which the authors froze the motor of a stuck label."""


@dataclass(frozen=True)
class RowSpan:
    """Command rows of one run within a session.

    Attributes:
        first: First row of the run.
        stop: Row after its last one.
    """

    first: int
    stop: int


def split_session(session: RawSession, robot: Robot) -> list[RowSpan]:
    """Return which command rows form the runs of a session.

    Sessions of random movements send the arm home (every motor at the middle of its scale), make
    the movements of a run and repeat the last one; home and repeat belong to no run. A session
    without a repeated row is one run from its first row on.
    """
    units, target = robot.servo_units, session.target_counts
    home = np.flatnonzero(np.all(target == (units.low + units.high) / 2.0, axis=1))
    groups = list(pairwise([*home, len(target)]))
    if not any(_ends_in_repeat(target[first:stop]) for first, stop in groups):
        return [RowSpan(0, len(target))]
    spans = [
        RowSpan(int(first) + 1, int(stop) - int(_ends_in_repeat(target[first:stop])))
        for first, stop in groups
    ]
    return [span for span in spans if span.stop > span.first]


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
) -> RunTable:
    """Return the runs of a session.

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
    make = _measured_run if how == "measured" else _published_run
    spans = split_session(session, robot)
    for span in spans:
        _check_length(session, span)
    runs = [make(session, robot, span, label) for span in spans]
    length = max(len(run.command) for run in runs)
    check_memory(
        padded_bytes(len(runs), length, len(robot.motors)), str(session.folder), "its runs"
    )
    step = GRID_STEP_S if how == "measured" else PUBLISHED_TIME[1]
    return RunTable(
        run=[f"{session.name}/run_{i + 1:02d}" for i in range(len(runs))],
        motor=robot.motor_names,
        time=np.arange(length) * step if how == "measured" else PUBLISHED_TIME,
        command=np.stack([_lengthen(run.command, length, hold=True) for run in runs]),
        measured=np.stack([_lengthen(run.measured, length, hold=False) for run in runs]),
        measured_rate_hz=READING_RATE_HZ,
        duration=np.array([(len(run.command) - 1) * step for run in runs]),
        movements=stack_movements([run.movements for run in runs]),
        truth=None if label is None else _truth(label, runs, robot),
        position=np.stack([_lengthen(run.position, length, hold=False) for run in runs]),
    )


@dataclass(frozen=True)
class _Run:
    """One run on its own grid: command, position (time, motor) [rad], measured (time, axis) [m]."""

    command: FloatArray
    measured: FloatArray
    position: FloatArray
    movements: Movements
    held: float


def _measured_run(session: RawSession, robot: Robot, span: RowSpan, label: int | None) -> _Run:
    units = robot.servo_units
    begin, end = _measured_window(session, span)
    stamps = np.concatenate([session.command_time[span.first : span.stop], session.reading_time])
    check_clock(stamps[(stamps >= begin) & (stamps <= end)], str(session.folder))
    check_grid((end - begin) / GRID_STEP_S, len(stamps), str(session.folder))
    time = as_floats(np.arange(round((end - begin) / GRID_STEP_S) + 1) * GRID_STEP_S)
    movements = _movements(session, robot, span, begin, _initial_counts(session, span, begin))
    inside = (session.reading_time >= begin) & (session.reading_time <= end)
    kept = inside & ~_before_gap(session)
    counts = session.reading_counts[kept]
    angle = np.where(units.valid(counts), units.to_rad(counts), np.nan)
    at = session.reading_time[kept] - begin
    held = np.nan
    if label is not None and 1 <= label <= len(robot.motors):
        freeze = PUBLISHED_TIME[PUBLISHED_FREEZE]
        motor = label - 1
        raw = np.interp(freeze, session.reading_time - begin, session.reading_counts[:, motor])
        held = float(units.to_rad(raw))
        angle[(at >= freeze) & np.isfinite(angle[:, motor]), motor] = held
    position = np.full((len(time), len(robot.motors)), np.nan)
    position[np.minimum(np.rint(at / GRID_STEP_S).astype(int), len(time) - 1)] = angle
    measured = np.full((len(time), 3), np.nan)
    sound = np.isfinite(position).all(axis=1)
    measured[sound] = DigitalTwin(robot).path(position[sound])
    return _Run(movements.reference(time)[0], measured, position, movements, held)


def _published_run(session: RawSession, robot: Robot, span: RowSpan, label: int | None) -> _Run:
    units = robot.servo_units
    begin = _last_reading_before(session, session.command_time[span.first])
    if begin is None:
        raise InputError(
            f"{session.folder}: no reading before the first command of a run, which the published "
            "form starts from. Read it as measured."
        )
    first = int(np.searchsorted(session.reading_time, begin))
    time = PUBLISHED_TIME
    movements = _movements(session, robot, span, begin, session.reading_counts[first])
    raw = np.stack(
        [
            np.interp(time, session.reading_time - begin, counts, right=np.nan)
            for counts in session.reading_counts.T
        ],
        axis=1,
    )
    position = units.to_rad(raw)
    held = np.nan
    if label is not None and 1 <= label <= len(robot.motors):
        position[PUBLISHED_FREEZE:, label - 1] = held = position[PUBLISHED_FREEZE, label - 1]
    measured = DigitalTwin(robot).path(position)
    return _Run(movements.reference(time)[0], measured, position, movements, float(held))


def _last_reading_before(session: RawSession, stamp: float) -> float | None:
    """Return the stamp of the last reading before `stamp` [s], None if there is none."""
    index = int(np.searchsorted(session.reading_time, stamp)) - 1
    return None if index < 0 else float(session.reading_time[index])


def _check_length(session: RawSession, span: RowSpan) -> None:
    """Raise InputError unless the readings outlast the first ramp of a run."""
    reached = session.command_time[span.first] + session.ramp_s[span.first].max()
    if session.reading_time[-1] < reached:
        raise InputError(
            f"{session.folder}: the readings end before the first movement of the run does (line "
            f"{span.first + 2} of {COMMAND_FILE}). A run needs one whole movement at least."
        )


def _measured_window(session: RawSession, span: RowSpan) -> tuple[float, float]:
    """Return begin and end of a run [s]: from the last reading before it to the next command."""
    command = float(session.command_time[span.first])
    begin = _last_reading_before(session, command)
    begin = command if begin is None or begin < command - 2.0 * GAP_S else begin
    last = float(session.reading_time[-1])
    end = float(session.command_time[span.stop]) if span.stop < len(session.command_time) else last
    end = min(end, last)
    return begin, end


def _initial_counts(session: RawSession, span: RowSpan, begin: float) -> FloatArray:
    """Return where the first ramp starts, (motor,) [counts].

    It is the target before it, where the session holds one; else the reading at the start, as
    published; else (the log starts later) the first target, so that no ramp is seen.
    """
    if span.first > 0:
        return session.target_counts[span.first - 1]
    index = int(np.searchsorted(session.reading_time, begin))
    if session.reading_time[index] > session.command_time[span.first]:
        return session.target_counts[span.first]
    return session.reading_counts[index]


def _movements(
    session: RawSession, robot: Robot, span: RowSpan, begin: float, initial_counts: FloatArray
) -> Movements:
    rows = slice(span.first, span.stop)
    units = robot.servo_units
    return Movements(
        initial=units.to_rad(initial_counts)[None],
        target=units.to_rad(session.target_counts[rows])[None],
        ramp_duration=session.ramp_s[rows][None],
        start=(session.command_time[rows] - begin)[None],
    )


def _before_gap(session: RawSession) -> np.ndarray:
    """Return the readings whose read stalled: stamped before a gap, taken at some time in it."""
    return np.append(np.diff(session.reading_time) > GAP_S, False)


def _lengthen(values: FloatArray, length: int, *, hold: bool) -> FloatArray:
    """Return `values` (time, ...) with `length` samples, the last held or NaN appended."""
    fill = values[-1] if hold else np.full(values.shape[1:], np.nan)
    return np.concatenate([values, np.broadcast_to(fill, (length - len(values), len(fill)))])


def _truth(label: int, runs: list[_Run], robot: Robot) -> Truth:
    fault = str(paper_hypotheses(robot.motor_names)[label])
    stuck = 1 <= label <= len(robot.motors)
    onset = PUBLISHED_TIME[PUBLISHED_FREEZE] if stuck else (np.nan if label == 0 else 0.0)
    detail = {"source": "published label", "label": label, "frozen_afterwards": stuck}
    return Truth(
        fault=[fault] * len(runs),
        detail=[detail] * len(runs),
        onset=np.full(len(runs), onset),
        magnitude=np.array([run.held for run in runs]),
    )
