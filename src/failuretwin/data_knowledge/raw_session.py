"""Raw session folders: three CSV files as the robot's own logger writes them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from failuretwin.core.errors import InputError, unknown_name
from failuretwin.core.types import FloatArray
from failuretwin.core.units import MS_PER_S
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
    folders = sorted({file.parent for name in SESSION_FILES for file in path.rglob(name)})
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
    import pandas as pd

    try:
        table = pd.read_csv(path, dtype=str, skipinitialspace=True)
    except pd.errors.EmptyDataError:
        raise InputError(f"{path}: is empty. Expected a header and rows of numbers.") from None
    except (OSError, UnicodeDecodeError, pd.errors.ParserError) as error:
        raise InputError(f"{path}: cannot be read as CSV ({error}).") from error
    wanted = ["timestamp", *columns]
    for column in wanted:
        if column not in table:
            raise InputError(
                f"{path}: missing a column: {unknown_name('column', column, map(str, table))}"
            )
    for column in wanted:
        if f"{column}.1" in table:  # the reader's name for a second column of that name
            raise InputError(f"{path}: column {column!r} stands there twice. Remove one of them.")
    if table.empty:
        raise InputError(f"{path}: has a header but no rows.")
    numbers = table[wanted].apply(pd.to_numeric, errors="coerce").to_numpy(dtype=np.float64)
    bad = np.argwhere(~np.isfinite(numbers))
    if len(bad):
        row, column = bad[0]
        text = table[wanted[column]].iloc[row]
        raise InputError(
            f"{path}: line {row + 2}, column {wanted[column]}: got {text!r}, expected a number."
        )
    steps = np.diff(numbers[:, 0])
    if np.any(steps <= 0):
        row = int(np.argmax(steps <= 0))
        raise InputError(
            f"{path}: time runs backwards or stands still at line {row + 3} (from "
            f"{numbers[row, 0]:.6f} to {numbers[row + 1, 0]:.6f} s). Sort or cut the log."
        )
    return numbers
