"""Column maps: which column of a table is what, in which unit.

Section: docs/reading_logs.md
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from failuretwin.core.config import from_table, read_toml
from failuretwin.core.errors import InputError, check_name
from failuretwin.core.runs import GOAL_VARIABLE
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.data_knowledge.readers.table import Table
from failuretwin.data_knowledge.readers.timed_log import SHAPES, Samples, Targets, TimedLog, held
from failuretwin.digital_model.robot import Robot

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
LENGTH_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
ANGLE_UNITS = {"rad": 1.0, "deg": np.pi / 180.0}
SERVO = "servo"
"""Unit of angles in servo counts."""
ISO = "iso"
"""Unit of times that are dates."""
FILL_IN = "FILL IN"
"""Entry of a guessed map that the user must replace with the name of a column."""
CORRECTION = "correction"
"""Table of a column map that is not about columns: the correction of a wrong set-up."""


@dataclass(frozen=True)
class TimeColumn:
    """Time of each row.

    Attributes:
        column: Its name.
        unit: s, ms, us, ns, or iso for dates with times.
    """

    column: str
    unit: str = "s"

    def __post_init__(self) -> None:
        check_name("unit", self.unit, [*TIME_UNITS, ISO])

    def seconds(self, table: Table) -> FloatArray:
        """Return the times of the rows from that of the first on, (row,) [s]."""
        import pandas as pd

        if self.unit != ISO:
            values = table.numbers([self.column])[:, 0]
            if not np.all(np.isfinite(values)):
                raise InputError(f"{table.path}: column {self.column} has rows without a time.")
            return as_floats((values - values[0]) * TIME_UNITS[self.unit])
        table.check([self.column])
        try:
            stamps = pd.to_datetime(table.cells[self.column], format="ISO8601", utc=True)
        except ValueError as error:
            raise InputError(
                f"{table.path}: column {self.column} is no ISO 8601 time: {error}."
            ) from error
        return as_floats((stamps - stamps.iloc[0]).dt.total_seconds())


def _present(time: FloatArray, values: FloatArray) -> Samples:
    """Return the rows that hold any value."""
    return Samples(time, values).take(np.asarray(np.isfinite(values).any(axis=1)))


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

    def __post_init__(self) -> None:
        check_name("unit", self.unit, [*ANGLE_UNITS, SERVO])
        check_name("unit", self.slide_unit, LENGTH_UNITS)

    def check_motors(self, robot: Robot, where: str) -> None:
        """Raise InputError unless there is one column, sign and zero for each motor."""
        _check_distinct(self.columns, where)
        check_entries("columns", len(self.columns), robot, where)
        for name in ("sign", "zero"):
            check_entries(name, len(getattr(self, name)) or len(robot.motors), robot, where)

    def to_robot(self, values: FloatArray, robot: Robot) -> FloatArray:
        """Return logged angles (row, motor) in the robot's sense [rad, m of a slide].

        NaN stands for counts out of range.
        """
        if self.unit == SERVO:
            units = robot.servo_units
            angle = np.where(units.valid(values), units.to_rad(values), np.nan)
            zero = units.to_rad(np.asarray(self.zero)) if self.zero else 0.0
        else:
            turns, slides = ANGLE_UNITS[self.unit], LENGTH_UNITS[self.slide_unit]
            scale = np.where(robot.slides, slides, turns)
            angle, zero = values * scale, np.asarray(self.zero or 0.0) * scale
        return as_floats((angle - zero) * np.asarray(self.sign or 1.0))

    def angles(self, table: Table, time: FloatArray, robot: Robot) -> Samples:
        """Return the angles in the rows at times (row,) [s], in the robot's sense."""
        return _present(time, self.to_robot(table.numbers(self.columns), robot))


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

    def __post_init__(self) -> None:
        super().__post_init__()
        check_name("kind", self.kind, ("sampled", "target"))
        check_name("unit", self.duration_unit, TIME_UNITS)
        if self.kind == "target" and not self.duration_columns and self.duration_s is None:
            raise InputError(
                "targets need to know how long a movement takes. Name duration_columns, or give "
                "duration_s for all."
            )

    def commands(self, table: Table, time: FloatArray, robot: Robot) -> Samples | Targets:
        """Return the commands in the rows at times (row,) [s]."""
        samples = self.angles(table, time, robot)
        if len(samples.time) == 0:
            raise InputError(f"{table.path}: no row holds a command. Check the [command] columns.")
        if self.kind == "sampled":
            return samples
        # A log may repeat the target in every row; a movement begins where it changes.
        target = held(samples.value)
        new = np.concatenate([[True], np.any(np.diff(target, axis=0) != 0.0, axis=1)])
        duration = np.array(self.duration_s, dtype=np.float64)
        if self.duration_columns:
            rows = np.isin(time, samples.time[new])
            scale = TIME_UNITS[self.duration_unit]
            duration = table.numbers(self.duration_columns)[rows] * scale
        return Targets(samples.time[new], target[new], np.broadcast_to(duration, target[new].shape))


@dataclass(frozen=True)
class ToolColumns:
    """Position of the tool in the base frame.

    Attributes:
        columns: x, y and z.
        unit: m, cm or mm.
    """

    columns: tuple[str, str, str]
    unit: str = "m"

    def __post_init__(self) -> None:
        check_name("unit", self.unit, LENGTH_UNITS)


@dataclass(frozen=True)
class SensorColumns:
    """Readings of another sensor, in SI units.

    Attributes:
        variable: Its variable in a run set, such as ``accelerometer``.
        columns: One for each channel.
    """

    variable: str
    columns: tuple[str, ...]

    def __post_init__(self) -> None:
        check_name("sensor variable", self.variable, SHAPES)
        count = math.prod(SHAPES[self.variable])
        if len(self.columns) != count:
            raise InputError(
                f"{self.variable}: {len(self.columns)} columns, expected {count}, one a channel."
            )


@dataclass(frozen=True)
class ColumnMap:
    """Columns of a table.

    Attributes:
        time: Time of each row.
        command: Commands of the motors.
        tool: Position of the tool; without it the path is computed from motor readings.
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

    def logs(self, path: Path, robot: Robot) -> list[TimedLog]:
        """Return the runs in a CSV file.

        Raises:
            InputError: If the file cannot be read or lacks a column, or a value is no number.
        """
        table = Table.read(path, self.separator, self.decimal)
        if self.run is None:
            return [self._log(table, robot, path.stem)]
        return [self._log(part, robot, f"{path.stem}/{key}") for key, part in table.parts(self.run)]

    def _log(self, table: Table, robot: Robot, name: str) -> TimedLog:
        """Return the rows of one run as a log."""
        time, tool = self.time.seconds(table), self.tool
        sensors = {one.variable: _present(time, table.numbers(one.columns)) for one in self.sensors}
        if self.goal is not None:
            sensors[GOAL_VARIABLE] = self.goal.angles(table, time, robot)
        return TimedLog(
            name=name,
            command=self.command.commands(table, time, robot),
            tool=None
            if tool is None
            else _present(time, table.numbers(tool.columns) * LENGTH_UNITS[tool.unit]),
            position=None if self.position is None else self.position.angles(table, time, robot),
            sensors=sensors,
        )


def read_column_map(path: Path, robot: Robot) -> ColumnMap:
    """Read a column map and check that it fits the robot.

    Raises:
        InputError: If the file is wrong or does not name what the robot needs.
    """
    table = {name: part for name, part in read_toml(path).items() if name != CORRECTION}
    _check_filled(path)
    mapping = from_table(ColumnMap, table, str(path))
    if mapping.tool is None and mapping.position is None and not mapping.sensors:
        raise InputError(f"{path}: needs a [tool] table, or [position] to compute the path from.")
    if mapping.tool is not None:
        _check_distinct(mapping.tool.columns, f"{path}: tool")
    anchored = any(one.kind == "wire" and one.anchor for one in robot.profile.sensors)
    if any(one.variable == "wire" for one in mapping.sensors) and not anchored:
        raise InputError(
            f"{path}: a wire, but {robot.name!r} does not say where it begins. Add a table "
            '[[sensors]] with kind = "wire" and anchor = [x, y, z] to its profile [m, base link].'
        )
    for name in ("command", "position", "goal"):
        angles = getattr(mapping, name)
        if angles is not None:
            angles.check_motors(robot, f"{path}: {name}")
    return mapping


def _check_filled(path: Path) -> None:
    """Raise InputError if a line of a map, comments aside, still holds `FILL_IN`."""
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        if f'"{FILL_IN}"' in line.partition("#")[0]:
            raise InputError(
                f"{path}: line {number} is not filled in: {line.strip()}. Replace each "
                f'"{FILL_IN}" with the name of a column.'
            )


def check_entries(name: str, count: int, robot: Robot, where: str) -> None:
    """Raise InputError unless a list of a map has one entry for each motor."""
    if count != len(robot.motors):
        raise InputError(
            f"{where}: {name} has {count} entries, expected {len(robot.motors)}, one for each "
            f"motor of {robot.name!r} ({', '.join(robot.motor_names)})."
        )


def _check_distinct(columns: Sequence[str], where: str) -> None:
    for column in columns:
        if list(columns).count(column) > 1:
            raise InputError(f"{where}: column {column!r} is named twice. Each needs its own.")


def map_text(title: str, hints: str, content: ColumnMap | Mapping[str, Any]) -> str:
    """Return a guessed map as TOML, under comments that say how to check it.

    The comments begin with `title`, which names the log. What is unknown or empty is left out.
    """
    table = asdict(content) if isinstance(content, ColumnMap) else content
    comments = [f"{title}. A GUESS: check every line.", *hints.splitlines()]
    return "".join(f"# {line}\n" for line in comments) + _toml(table)


def _toml(table: Mapping[str, Any]) -> str:
    """Return a table as TOML, whose texts, numbers and lists are those of JSON."""
    known = {key: value for key, value in table.items() if value not in (None, ())}
    lines = [
        f"{key} = {json.dumps(value, ensure_ascii=False)}\n"
        for key, value in known.items()
        if not isinstance(value, Mapping)
    ]
    tables = [
        f"\n[{key}]\n{_toml(value)}" for key, value in known.items() if isinstance(value, Mapping)
    ]
    return "".join([*lines, *tables])
