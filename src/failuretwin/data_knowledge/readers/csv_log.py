"""Any CSV log through a column map: which column is what, in which unit."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.core.config import from_table, read_toml
from failuretwin.core.errors import InputError, unknown_name
from failuretwin.core.foreign import check_memory, reading, stored_bytes
from failuretwin.core.runs import GOAL_VARIABLE
from failuretwin.core.types import BoolArray, FloatArray, as_floats
from failuretwin.data_knowledge.readers.timed_log import SHAPES, Samples, Targets, TimedLog, held
from failuretwin.digital_model.robot import Robot

if TYPE_CHECKING:
    import pandas as pd

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
LENGTH_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
ANGLE_UNITS = {"rad": 1.0, "deg": np.pi / 180.0}
SERVO = "servo"
ISO = "iso"
CSV_EXPANSION = 30
"""What a byte of a CSV file takes while its cells are text: a cell of two bytes takes sixty."""
CORRECTION = "correction"
"""Table of a column map that is not about columns: how a wrong set-up of any log is undone."""
BLANKS = r"\s+"
"""Separator of columns with any number of blanks between them."""


@dataclass(frozen=True)
class TimeColumn:
    """When a row was taken.

    Attributes:
        column: Its name.
        unit: s, ms, us, ns, or iso for dates with times.
    """

    column: str
    unit: str = "s"


@dataclass(frozen=True)
class AngleColumns:
    """Angles of the motors, one column each, in chain order.

    Attributes:
        columns: Their names.
        unit: rad, deg, or servo for the counts of the robot's profile.
        sign: 1 or -1 for each motor, where the log turns the other way; empty: all 1.
        zero: Value of each motor, in its unit, that the robot calls 0; empty: all 0.
        slide_unit: Of motors that slide: m, cm or mm.
    """

    columns: tuple[str, ...]
    unit: str = "rad"
    sign: tuple[float, ...] = ()
    zero: tuple[float, ...] = ()
    slide_unit: str = "m"


@dataclass(frozen=True)
class CommandColumns(AngleColumns):
    """Commands of the motors, one column each, in chain order.

    Attributes:
        kind: sampled (the reference at every row) or target (where to go, with a duration).
        duration_columns: For targets: time to get there, a column for each motor, or one for all.
        duration_unit: s, ms, us or ns.
        duration_s: For targets without such columns: the same time for every movement [s].
    """

    kind: str = "sampled"
    duration_columns: tuple[str, ...] = ()
    duration_unit: str = "s"
    duration_s: float | None = None


@dataclass(frozen=True)
class ToolColumns:
    """Where the tool was, in the base frame.

    Attributes:
        columns: x, y and z.
        unit: m, cm or mm.
    """

    columns: tuple[str, str, str]
    unit: str = "m"


@dataclass(frozen=True)
class SensorColumns:
    """What another sensor read, in SI units.

    Attributes:
        variable: Its variable in a run set, such as ``accelerometer``.
        columns: One for each channel.
    """

    variable: str
    columns: tuple[str, ...]

    def __post_init__(self) -> None:
        if self.variable not in SHAPES:
            raise unknown_name("sensor variable", self.variable, SHAPES)
        count = math.prod(SHAPES[self.variable])
        if len(self.columns) != count:
            raise InputError(
                f"{self.variable}: {len(self.columns)} columns, expected {count}, one a channel."
            )


@dataclass(frozen=True)
class ColumnMap:
    """Which column of a CSV is what.

    Attributes:
        time: When each row was taken.
        command: What the motors were told.
        tool: Where the tool was; without it the path is computed from motor readings.
        position: Motor readings.
        run: Column that tells runs apart; without it a file is one run.
        separator: Between columns.
        decimal: Decimal point, or comma where the log writes 0,5.
        sensors: Other sensors.
        goal: Goals that the motors report to have received.
    """

    time: TimeColumn
    command: CommandColumns
    tool: ToolColumns | None = None
    position: AngleColumns | None = None
    run: str | None = None
    separator: str = ","
    decimal: str = "."
    sensors: tuple[SensorColumns, ...] = ()
    goal: AngleColumns | None = None


def read_column_map(path: Path, robot: Robot) -> ColumnMap:
    """Read a column map and check that it fits the robot.

    Raises:
        InputError: If the file is wrong or does not name what the robot needs.
    """
    where = str(path)
    table = {name: part for name, part in read_toml(path).items() if name != CORRECTION}
    mapping = from_table(ColumnMap, table, where)
    _check_known("unit", mapping.time.unit, [*TIME_UNITS, ISO], f"{where}: time")
    command, tool = mapping.command, mapping.tool
    _check_known("kind", command.kind, ("sampled", "target"), where)
    _check_known("unit", command.duration_unit, TIME_UNITS, f"{where}: command")
    if command.kind == "target" and not command.duration_columns and command.duration_s is None:
        raise InputError(
            f"{where}: targets need to know how long a movement takes. Name duration_columns, or "
            "give duration_s for all."
        )
    if tool is None and mapping.position is None and not mapping.sensors:
        raise InputError(f"{where}: needs a [tool] table, or [position] to compute the path from.")
    if tool is not None:
        _check_known("unit", tool.unit, LENGTH_UNITS, f"{where}: tool")
        _check_distinct(tool.columns, f"{where}: tool")
    _check_anchor(mapping.sensors, where, robot)
    for name in ("command", "position", "goal"):
        angles = getattr(mapping, name)
        if angles is not None:
            _check_angles(angles, f"{where}: {name}", robot)
    return mapping


def _check_anchor(sensors: Sequence[SensorColumns], where: str, robot: Robot) -> None:
    anchored = any(one.kind == "wire" and one.anchor for one in robot.profile.sensors)
    if any(one.variable == "wire" for one in sensors) and not anchored:
        raise InputError(
            f"{where}: a wire, but {robot.name!r} does not say where it begins. Add a table "
            '[[sensors]] with kind = "wire" and anchor = [x, y, z] to its profile [m, base link].'
        )


def _check_distinct(columns: Sequence[str], where: str) -> None:
    for column in columns:
        if list(columns).count(column) > 1:
            raise InputError(f"{where}: column {column!r} is named twice. Each needs its own.")


def _check_known(what: str, name: str, valid: Iterable[str], where: str) -> None:
    if name not in valid:
        raise InputError(f"{where}: {unknown_name(what, name, valid)}")


def _check_angles(angles: AngleColumns, where: str, robot: Robot) -> None:
    _check_known("unit", angles.unit, [*ANGLE_UNITS, SERVO], where)
    _check_known("unit", angles.slide_unit, LENGTH_UNITS, where)
    _check_distinct(angles.columns, where)
    count = len(robot.motors)
    for name in ("columns", "sign", "zero"):
        values = getattr(angles, name)
        if len(values) != count and (name == "columns" or values):
            raise InputError(
                f"{where}: {name} has {len(values)} entries, expected {count}, one for each motor "
                f"of {robot.name!r} ({', '.join(robot.motor_names)})."
            )


def read_mapped_csv(path: Path, mapping: ColumnMap, robot: Robot) -> list[TimedLog]:
    """Read the runs of a CSV file through a column map.

    Raises:
        InputError: If the file cannot be read or lacks a column, or a value is no number.
    """
    table = load_csv(path, mapping.separator)
    if mapping.decimal != ".":
        table = table.apply(lambda c: c.str.replace(mapping.decimal, ".", regex=False))
    if mapping.run is None:
        return [_log(table, path.stem, path, mapping, robot)]
    check_columns(table, [mapping.run], path)
    groups = table.groupby(mapping.run, sort=False)
    return [_log(part, f"{path.stem}/{key}", path, mapping, robot) for key, part in groups]


def first_line(path: Path) -> str:
    """Return the first line of a text file, stripped; empty if it cannot be read as text."""
    try:
        with path.open(encoding="utf-8") as file:
            return file.readline().strip()
    except (OSError, UnicodeDecodeError):
        return ""


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


def check_columns(table: pd.DataFrame, columns: Sequence[str], path: Path) -> None:
    """Raise InputError unless a table has some columns."""
    for column in columns:
        if column not in table:
            raise InputError(f"{path}: {unknown_name('column', column, map(str, table))}")


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

    check_columns(table, columns, path)
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


def _log(table: pd.DataFrame, name: str, path: Path, mapping: ColumnMap, robot: Robot) -> TimedLog:
    time = _times(table, mapping.time, path)
    tool = position = None
    if mapping.tool is not None:
        scale = LENGTH_UNITS[mapping.tool.unit]
        tool = _present(time, numbers(table, mapping.tool.columns, path) * scale)

    def angles(columns: AngleColumns) -> Samples:
        return _present(time, _angles(numbers(table, columns.columns, path), columns, robot))

    if mapping.position is not None:
        position = angles(mapping.position)
    sensors = {
        one.variable: _present(time, numbers(table, one.columns, path)) for one in mapping.sensors
    }
    if mapping.goal is not None:
        sensors[GOAL_VARIABLE] = angles(mapping.goal)
    commands = _commands(table, time, mapping.command, path, robot)
    return TimedLog(name, commands, tool, position, sensors)


def _times(table: pd.DataFrame, column: TimeColumn, path: Path) -> FloatArray:
    """Return the times of the rows from that of the first on, (row,) [s]."""
    import pandas as pd

    if column.unit != ISO:
        values = numbers(table, [column.column], path)[:, 0]
        if not np.all(np.isfinite(values)):
            raise InputError(f"{path}: column {column.column} has rows without a time.")
        return as_floats((values - values[0]) * TIME_UNITS[column.unit])
    check_columns(table, [column.column], path)
    try:
        stamps = pd.to_datetime(table[column.column], format="ISO8601", utc=True)
    except ValueError as error:
        raise InputError(f"{path}: column {column.column} is no ISO 8601 time: {error}.") from error
    return as_floats((stamps - stamps.iloc[0]).dt.total_seconds())


def _present(time: FloatArray, values: FloatArray) -> Samples:
    """Return the rows that hold any value."""
    there = np.isfinite(values).any(axis=1)
    return Samples(time[there], values[there])


def _angles(values: FloatArray, columns: AngleColumns, robot: Robot) -> FloatArray:
    """Return angles [rad, m of a slide] in the robot's sense; NaN for counts out of range."""
    if columns.unit == SERVO:
        units = robot.servo_units
        angle = np.where(units.valid(values), units.to_rad(values), np.nan)
        zero = units.to_rad(np.asarray(columns.zero)) if columns.zero else 0.0
    else:
        turns, slides = ANGLE_UNITS[columns.unit], LENGTH_UNITS[columns.slide_unit]
        scale = np.where(robot.slides, slides, turns)
        angle, zero = values * scale, np.asarray(columns.zero or 0.0) * scale
    return as_floats((angle - zero) * np.asarray(columns.sign or 1.0))


def _commands(
    table: pd.DataFrame, time: FloatArray, columns: CommandColumns, path: Path, robot: Robot
) -> Samples | Targets:
    samples = _present(time, _angles(numbers(table, columns.columns, path), columns, robot))
    if len(samples.time) == 0:
        raise InputError(f"{path}: no row holds a command. Check the [command] columns.")
    if columns.kind == "sampled":
        return samples
    # A log may repeat the target in every row; a movement begins where it changes.
    target = held(samples.value)
    new = np.concatenate([[True], np.any(np.diff(target, axis=0) != 0.0, axis=1)])
    there = np.isin(time, samples.time[new])
    duration = _durations(table, there, columns, path)
    return Targets(samples.time[new], target[new], np.broadcast_to(duration, target[new].shape))


def _durations(
    table: pd.DataFrame, rows: BoolArray, columns: CommandColumns, path: Path
) -> FloatArray:
    if not columns.duration_columns:
        return np.array(columns.duration_s, dtype=np.float64)
    scale = TIME_UNITS[columns.duration_unit]
    return numbers(table, columns.duration_columns, path)[rows] * scale
