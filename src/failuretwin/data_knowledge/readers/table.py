"""Tables of text: CSV files as cells, numbers, and logs through a column map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.core.errors import InputError, check_name
from failuretwin.core.foreign import check_memory, reading, stored_bytes
from failuretwin.core.runs import GOAL_VARIABLE
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.data_knowledge.readers.column_map import (
    ISO,
    LENGTH_UNITS,
    TIME_UNITS,
    AngleColumns,
    ColumnMap,
    CommandColumns,
    TimeColumn,
    ToolColumns,
)
from failuretwin.data_knowledge.readers.timed_log import Samples, Targets, TimedLog, held
from failuretwin.digital_model.robot import Robot

if TYPE_CHECKING:
    import pandas as pd

CSV_EXPANSION = 30
"""Memory of a byte of a CSV file while its cells are text: a cell of two bytes takes sixty."""
BLANKS = r"\s+"
"""Separator of columns with any number of blanks between them."""


def first_line(path: Path) -> str:
    """Return the first line of a text file, stripped; empty if it cannot be read as text."""
    try:
        with path.open(encoding="utf-8") as file:
            return file.readline().strip()
    except (OSError, UnicodeDecodeError):
        return ""


def separator_of(path: Path) -> str:
    """Return the separator of columns that the header of a file suggests."""
    header = first_line(path)
    likely = max(",;\t", key=header.count)
    return likely if likely in header or " " not in header else BLANKS


def load_csv(path: Path, separator: str = ",") -> pd.DataFrame:
    """Return a CSV file with every cell as text.

    Raises:
        InputError: If it cannot be read or holds no rows.
    """
    import pandas as pd

    size = stored_bytes(path)
    check_memory(CSV_EXPANSION * size, str(path), "its cells")
    if size == 0:
        raise InputError(f"{path}: is empty. Expected a header and rows of numbers.")
    with reading(path, "CSV", "Expected a header and rows of numbers."):
        table = pd.read_csv(path, dtype=str, sep=separator, skipinitialspace=True)
    if not isinstance(table.index, pd.RangeIndex):
        raise InputError(
            f"{path}: its rows have more cells than its header has names. Check the separator, or "
            "add the missing names."
        )
    if table.empty:
        raise InputError(f"{path}: has a header but no rows.")
    return table


def numbers(
    table: pd.DataFrame, columns: Sequence[str], path: Path, *, gaps: bool = True
) -> FloatArray:
    """Return columns as numbers, (row, column); empty cells are NaN.

    Args:
        table: Every cell as text.
        columns: Names of the columns.
        path: The file, for error texts.
        gaps: Whether cells may be empty.

    Raises:
        InputError: If a column is missing or a cell is no number.
    """
    import pandas as pd

    _check_columns(table, columns, path)
    part = table[list(columns)]
    values = part.apply(pd.to_numeric, errors="coerce").to_numpy(dtype=np.float64)
    wrong = ~np.isfinite(values)
    hint = ""
    if gaps:
        wrong &= part.notna().to_numpy()
        wrong &= ~part.apply(lambda c: c.str.strip().str.lower().isin(["nan", ""])).to_numpy()
        hint = ' For decimal commas add decimal = "," at the top of the map.'
    if wrong.any():
        row, column = np.argwhere(wrong)[0]
        line = int(part.index[row]) + 2
        raise InputError(
            f"{path}: line {line}, column {columns[column]}: got {part.iloc[row, column]!r}, "
            f"expected a number.{hint}"
        )
    return values


def _check_columns(table: pd.DataFrame, columns: Sequence[str], path: Path) -> None:
    for column in columns:
        check_name("column", column, [str(name) for name in table], f"{path}: ")


def read_mapped_csv(path: Path, mapping: ColumnMap, robot: Robot) -> list[TimedLog]:
    """Read the runs of a CSV file through a column map.

    Raises:
        InputError: If the file cannot be read or lacks a column, or a value is no number.
    """
    table = load_csv(path, mapping.separator)
    if mapping.decimal != ".":
        table = table.apply(lambda c: c.str.replace(mapping.decimal, ".", regex=False))
    if mapping.run is None:
        return [_TableLog(table, path, robot).log(path.stem, mapping)]
    _check_columns(table, [mapping.run], path)
    groups = table.groupby(mapping.run, sort=False)
    return [_TableLog(part, path, robot).log(f"{path.stem}/{key}", mapping) for key, part in groups]


@dataclass(frozen=True)
class _TableLog:
    """Rows of one run of a table, and the file and the robot that they are of."""

    table: pd.DataFrame
    path: Path
    robot: Robot

    def log(self, name: str, mapping: ColumnMap) -> TimedLog:
        """Return the run as a log."""
        time, tool, position = self._times(mapping.time), mapping.tool, mapping.position
        sensors = {
            one.variable: _present(time, self._numbers(one.columns)) for one in mapping.sensors
        }
        if mapping.goal is not None:
            sensors[GOAL_VARIABLE] = self._angles(time, mapping.goal)
        return TimedLog(
            name=name,
            command=self._commands(time, mapping.command),
            tool=None if tool is None else self._places(time, tool),
            position=None if position is None else self._angles(time, position),
            sensors=sensors,
        )

    def _places(self, time: FloatArray, tool: ToolColumns) -> Samples:
        return _present(time, self._numbers(tool.columns) * LENGTH_UNITS[tool.unit])

    def _numbers(self, columns: Sequence[str]) -> FloatArray:
        return numbers(self.table, columns, self.path)

    def _times(self, time: TimeColumn) -> FloatArray:
        """Return the times of the rows from that of the first on, (row,) [s]."""
        import pandas as pd

        if time.unit != ISO:
            values = self._numbers([time.column])[:, 0]
            if not np.all(np.isfinite(values)):
                raise InputError(f"{self.path}: column {time.column} has rows without a time.")
            return as_floats((values - values[0]) * TIME_UNITS[time.unit])
        _check_columns(self.table, [time.column], self.path)
        try:
            stamps = pd.to_datetime(self.table[time.column], format="ISO8601", utc=True)
        except ValueError as error:
            raise InputError(
                f"{self.path}: column {time.column} is no ISO 8601 time: {error}."
            ) from error
        return as_floats((stamps - stamps.iloc[0]).dt.total_seconds())

    def _angles(self, time: FloatArray, angles: AngleColumns) -> Samples:
        return _present(time, angles.to_robot(self._numbers(angles.columns), self.robot))

    def _commands(self, time: FloatArray, command: CommandColumns) -> Samples | Targets:
        samples = self._angles(time, command)
        if len(samples.time) == 0:
            raise InputError(f"{self.path}: no row holds a command. Check the [command] columns.")
        if command.kind == "sampled":
            return samples
        # A log may repeat the target in every row; a movement begins where it changes.
        target = held(samples.value)
        new = np.concatenate([[True], np.any(np.diff(target, axis=0) != 0.0, axis=1)])
        duration = np.array(command.duration_s, dtype=np.float64)
        if command.duration_columns:
            rows = np.isin(time, samples.time[new])
            scale = TIME_UNITS[command.duration_unit]
            duration = self._numbers(command.duration_columns)[rows] * scale
        return Targets(samples.time[new], target[new], np.broadcast_to(duration, target[new].shape))


def _present(time: FloatArray, values: FloatArray) -> Samples:
    """Return the rows that hold any value."""
    filled = np.isfinite(values).any(axis=1)
    return Samples(time[filled], values[filled])
