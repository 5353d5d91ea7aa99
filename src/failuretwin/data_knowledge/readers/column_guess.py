"""Column maps guessed from the names and numbers of a CSV file.

A file whose column names leave nothing open is read without a map. Otherwise a guess is written for
the user to check; an unchecked guess is never used.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.readers.csv_log import (
    BLANKS,
    SERVO,
    AngleColumns,
    ColumnMap,
    CommandColumns,
    TimeColumn,
    ToolColumns,
    first_line,
    load_csv,
)
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.urdf.file import read_urdf

if TYPE_CHECKING:
    import pandas as pd

COMMAND_WORDS = {"cmd", "command", "commanded", "target", "desired", "ref", "reference", "goal"}
COMMAND_WORDS |= {"setpoint", "set", "sp", "des"}
DURATION_WORDS = {"duration", "dur", "ramp"}
TOOL_WORDS = {"tool", "tcp", "ee", "eef", "tip", "end", "effector", "flange", "hand"}
TIME_WORDS = {"t", "time", "timestamp", "stamp", "clock"}
RUN_WORDS = {"run", "trial", "episode", "cycle"}
READING_WORDS = {"actual", "act", "measured", "meas", "reading", "state", "encoder", "feedback"}
OTHER_WORDS = {"qd", "qdd", "vel", "velocity", "speed", "acc", "acceleration", "current", "moment"}
OTHER_WORDS |= {"torque", "effort", "force", "load", "temp", "temperature", "voltage", "power"}
"""Words of columns that are no angles and no places."""
ANGLE_NAMES = {"rad": ("rad", "radian", "radians"), "deg": ("deg", "degree", "degrees")}
LENGTH_NAMES = {"mm": ("mm",), "cm": ("cm",), "m": ("m",)}
TIME_NAMES = {"ms": ("ms",), "us": ("us",), "ns": ("ns",)}
LARGEST_RAD, LARGEST_M = 2.0 * np.pi, 10.0
"""Numbers larger than these are no angles in rad and no places of a tool in m."""


@dataclass(frozen=True)
class Guess:
    """Column map guessed from a CSV file.

    Attributes:
        columns: The map; columns without a candidate are empty.
        names: Names of all columns.
        doubts: Open questions; empty where the names answer all of them.
    """

    columns: ColumnMap
    names: tuple[str, ...]
    doubts: tuple[str, ...]


def told_columns(path: Path, robot: Robot) -> ColumnMap:
    """Return the column map of a CSV file whose column names leave nothing open.

    Raises:
        InputError: If they leave anything open; the text lists what, and the candidates.
    """
    guess = guess_columns(path, robot)
    if guess.doubts:
        raise InputError(
            f"{path}: needs a column map, for the names of its columns leave open: "
            f"{'; '.join(guess.doubts)}. Add --columns MAP.toml: if that file does not exist yet, "
            "a guess is written there for you to check."
        )
    return guess.columns


def guess_columns(path: Path, robot: Robot) -> Guess:
    """Return the column map of a CSV file as its header and numbers suggest it."""
    separator = _separator(path)
    table = _Table(load_csv(path, separator))
    found = _candidates(table.words, robot)
    command, position, tool = map(_firsts, (found.command, found.position, found.tool))
    durations, time = _firsts(found.duration), next(iter(found.time), "") or table.increasing()
    turning = [_of_kind(columns, robot, False) for columns in (command, position)]
    sliding = [_of_kind(columns, robot, True) for columns in (command, position)]
    slide_unit = table.length_unit(sliding[0] or sliding[1])
    units = [table.angle_unit(columns, robot) for columns in turning]
    columns = ColumnMap(
        time=TimeColumn(time, table.time_unit(time)),
        command=CommandColumns(
            command,
            units[0],
            slide_unit=slide_unit,
            kind="target" if durations else "sampled",
            duration_columns=durations,
            duration_unit=table.duration_unit(durations),
        ),
        tool=ToolColumns((tool[0], tool[1], tool[2]), table.length_unit(tool)) if tool else None,
        position=AngleColumns(position, units[1], slide_unit=slide_unit) if position else None,
        run=next(iter(found.run), None),
        separator=separator,
    )
    doubts = [*_choices(found, robot), *_lacking(found, table.words)]
    doubts += [d for c in turning for d in table.unsaid(c, ANGLE_NAMES, LARGEST_RAD)]
    doubts += [d for c in (*sliding, tool) for d in table.unsaid(c, LENGTH_NAMES, LARGEST_M)]
    return Guess(columns, tuple(table.words), tuple(doubts))


@dataclass(frozen=True)
class _Table:
    """A CSV file with every cell as text."""

    cells: pd.DataFrame

    @cached_property
    def words(self) -> dict[str, set[str]]:
        """Words of each column's name."""
        return {str(name): _words(str(name)) for name in self.cells}

    def values(self, columns: Sequence[str]) -> FloatArray:
        """Return columns as numbers, (row, column); NaN for text."""
        import pandas as pd

        part = self.cells[list(columns)].apply(pd.to_numeric, errors="coerce")
        return part.to_numpy(dtype=np.float64)

    def largest(self, columns: Sequence[str]) -> float:
        """Return the largest magnitude in some columns."""
        return float(np.nanmax(np.abs(self.values(columns)), initial=0.0))

    def increasing(self) -> str:
        """Return the first column whose numbers only grow, or an empty text."""
        for name in self.words:
            values = self.values([name])[:, 0]
            if len(values) > 1 and np.all(np.diff(values) > 0):
                return name
        return ""

    def named_unit(self, columns: Sequence[str], names: Mapping[str, Sequence[str]]) -> str | None:
        """Return the unit that the names of the columns state, if they do."""
        for unit, said in names.items():
            if columns and all(self.words[column] & set(said) for column in columns):
                return unit
        return None

    def unsaid(
        self, columns: Sequence[str], names: Mapping[str, Sequence[str]], largest: float
    ) -> list[str]:
        """Return a doubt where columns cannot be in SI units and name no other unit."""
        if not columns or self.named_unit(columns, names) or self.largest(columns) <= largest:
            return []
        units, size = " or ".join(f"_{unit}" for unit in names), self.largest(columns)
        return [f"the unit of {columns[0]}, whose numbers reach {size:g} (its name has no {units})"]

    def time_unit(self, column: str) -> str:
        """Return the unit of the times: stated, or by their size and step."""
        if not column:
            return "s"
        named, values = self.named_unit([column], TIME_NAMES), self.values([column])[:, 0]
        if named or not np.isfinite(values).any():
            return named or "iso"
        for limit, unit in ((1e17, "ns"), (1e14, "us"), (1e11, "ms")):
            if self.largest([column]) > limit:
                return unit
        step = float(np.nanmedian(np.diff(values))) if len(values) > 1 else 0.0
        return "ms" if step >= 2.0 else "s"

    def duration_unit(self, columns: Sequence[str]) -> str:
        """Return the unit of the times to reach targets."""
        named = self.named_unit(columns, TIME_NAMES)
        if named or not columns:
            return named or "s"
        return "ms" if np.nanmedian(self.values(columns)) > 50.0 else "s"

    def angle_unit(self, columns: Sequence[str], robot: Robot) -> str:
        """Return the unit of angles: stated, or by their size."""
        named = self.named_unit(columns, ANGLE_NAMES)
        if named or not columns:
            return named or "rad"
        size = float(np.nanmedian(np.abs(self.values(columns))))
        if robot.profile.servo_units is not None and size > 180.0:
            return SERVO
        return "deg" if self.largest(columns) > LARGEST_RAD else "rad"

    def length_unit(self, columns: Sequence[str]) -> str:
        """Return the unit of lengths: stated, or by their size."""
        named = self.named_unit(columns, LENGTH_NAMES)
        if named or not columns:
            return named or "m"
        return "mm" if self.largest(columns) > LARGEST_M else "m"


@dataclass(frozen=True)
class _Candidates:
    """Columns that may be the time, the run, and each motor's or axis's part of a log."""

    time: list[str]
    run: list[str]
    duration: list[list[str]]
    tool: list[list[str]]
    command: list[list[str]]
    position: list[list[str]]


def _candidates(words: Mapping[str, set[str]], robot: Robot) -> _Candidates:
    durations = {name: found for name, found in words.items() if found & DURATION_WORDS}
    ramps = _by_motor(durations, robot)
    rest = {name: found for name, found in words.items() if name not in durations}
    time = [name for name, found in rest.items() if found & TIME_WORDS]
    run = [name for name, found in rest.items() if found & RUN_WORDS]
    rest = {
        name: found
        for name, found in rest.items()
        if name not in (*time[:1], *run[:1]) and not found & OTHER_WORDS
    }
    tool = _tool_candidates(rest)
    rest = {name: found for name, found in rest.items() if name not in _firsts(tool)}
    commands = {name: found for name, found in rest.items() if found & COMMAND_WORDS}
    readings = {name: found for name, found in rest.items() if name not in commands}
    told, read = _by_motor(commands, robot), _by_motor(readings, robot)
    if not _firsts(told):  # a log without words for commands: its only angles must be them
        told, read = read, []
    duration = ramps if _firsts(ramps) else [list(durations)] * bool(durations)
    return _Candidates(time, run, duration, tool, told, read)


def _separator(path: Path) -> str:
    """Return the separator of columns that the header of a CSV file suggests."""
    header = first_line(path)
    likely = max(",;\t", key=header.count)
    return likely if likely in header or " " not in header else BLANKS


def _words(name: str) -> set[str]:
    """Return the words and numbers in a column's name, in lower case."""
    spaced = re.sub(r"([a-z])([A-Z])", r"\1 \2", name)
    return set(re.findall(r"[a-z]+|\d+", spaced.lower()))


def _by_motor(words: Mapping[str, set[str]], robot: Robot) -> list[list[str]]:
    """Return the columns that may be each motor's: by joint or motor name, else by number.

    Numbers count the motors, or all joints that move between base and tool where there are as many
    of them. They begin at 0 if any column has a 0. Of names that hold one another, such as `lift`
    and `shoulder_lift`, the longest counts.
    """
    joints = {_plain(joint.name) for joint in read_urdf(robot.urdf_file).joints if joint.has_motor}
    for key in ("joint", "name"):
        named = [_plain(getattr(motor, key)) for motor in robot.motors]
        known = sorted(joints | set(named), key=len)
        owner = {n: [one for one in known if one in n.lower()][-1:] for n in words}
        hits = [[name for name, of in owner.items() if of == [motor]] for motor in named]
        if len(set(_firsts(hits))) == len(named):
            return hits
    numbers = {int(word) for found in words.values() for word in found if word.isdigit()}
    start = 0 if 0 in numbers else 1
    count = next(k for k in range(len(numbers) + 1) if start + k not in numbers)
    return [
        [name for name, found in words.items() if str(start + place) in found]
        for place in _places(robot, count)
    ]


def _plain(name: str) -> str:
    return name.lower().removesuffix("_joint")


def _of_kind(columns: Sequence[str], robot: Robot, slides: bool) -> tuple[str, ...]:
    """Return the columns, one a motor if any, of those that slide, or of those that turn."""
    return tuple(c for c, one in zip(columns, robot.slides, strict=False) if one == slides)


def _places(robot: Robot, count: int) -> list[int]:
    """Return the place of each motor among `count` columns in joint order."""
    profile = robot.profile
    way = read_urdf(robot.urdf_file).path(profile.base_link, profile.tool_link)
    joints = [joint.name for joint in way if joint.has_motor]
    if count == len(joints):
        return [joints.index(motor.joint) for motor in robot.motors]
    return list(range(len(robot.motors)))


def _firsts(candidates: Sequence[Sequence[str]]) -> tuple[str, ...]:
    """Return the first candidate for each, or nothing where one has none."""
    return tuple(hits[0] for hits in candidates) if candidates and all(candidates) else ()


def _choices(found: _Candidates, robot: Robot) -> list[str]:
    """Return a doubt for each part of a log that more than one column may be."""
    parts = [
        ("the time", ["the log"], [found.time]),
        ("the run", ["each row"], [found.run]),
        ("the command", robot.motor_names, found.command),
        ("the reading", robot.motor_names, found.position),
        ("the duration", robot.motor_names, found.duration),
        ("the place", ["the tool in x", "the tool in y", "the tool in z"], found.tool),
    ]
    return [
        f"{what} of {name} may be {' or '.join(hits)}"
        for what, names, candidates in parts
        for name, hits in zip(names, candidates, strict=False)
        if len(hits) > 1
    ]


def _tool_candidates(words: Mapping[str, set[str]]) -> list[list[str]]:
    candidates = {name: found for name, found in words.items() if found & {"x", "y", "z"}}
    not_desired = {n: found for n, found in candidates.items() if not found & COMMAND_WORDS}
    named = {n: found for n, found in not_desired.items() if found & TOOL_WORDS} or not_desired
    return [[name for name, found in named.items() if axis in found] for axis in "xyz"]


def _lacking(found: _Candidates, words: Mapping[str, set[str]]) -> list[str]:
    """Return a doubt for each part of a log that no column was found for."""
    doubts, command = [], _firsts(found.command)
    if not found.time:
        doubts.append("which column is the time")
    if not command or any(words[name] & READING_WORDS for name in command):
        doubts.append("which columns are the commands, one for each motor")
    if not _firsts(found.tool) and not _firsts(found.position):
        doubts.append("which columns are the tool (x, y, z) or the readings of the motors")
    return [f"{doubt}, of {', '.join(words)}" for doubt in doubts]


def column_map_text(guess: Guess, source: str, robot: Robot) -> str:
    """Return a commented column map that holds the guess, ready to be corrected.

    Args:
        guess: The guess.
        source: Name of its file.
        robot: The robot, whose motors the comments name.
    """
    columns, time, command = guess.columns, guess.columns.time, guess.columns.command
    motors = ", ".join(f"{motor.name} ({motor.joint})" for motor in robot.motors)
    each = [1] * len(robot.motors)
    tool = columns.tool or ToolColumns(("tool_x", "tool_y", "tool_z"))
    position = columns.position or AngleColumns(("q1", "q2"))
    no_tool, no_position = ("" if part else "# " for part in (columns.tool, columns.position))
    durations = [
        f"duration_columns = {_toml(command.duration_columns)}",
        f"duration_unit = {_toml(command.duration_unit)}",
    ]
    no_durations = [
        "# For targets: duration_columns and duration_unit, or one duration_s for all movements."
    ]
    parts = [
        f"# Column map for {source}: which column is what. A GUESS: check every line.",
        f"# Columns of the file: {', '.join(guess.names)}",
        f"# Motors of {robot.name}, in this order: {motors}",
        f"separator = {_toml(columns.separator)}",
        "# run tells several runs in one file apart; leave it out where a file is one run.",
        f"run = {_toml(columns.run)}" if columns.run else '# run = "trial"',
        "",
        "[time]",
        f"column = {_toml(time.column or 'FILL IN')}",
        f"unit = {_toml(time.unit)}        # s, ms, us, ns, or iso (2026-01-31T12:00:00.25)",
        "",
        "[command]          # what the motors were told",
        f"columns = {_toml(command.columns or ['FILL IN'] * len(robot.motors))}",
        f"kind = {_toml(command.kind)}"
        "   # sampled (the reference at every row) or target (where to go)",
        f"unit = {_toml(command.unit)}      # rad, deg, or servo (counts of the profile)",
        *([f"slide_unit = {_toml(command.slide_unit)}"] if robot.slides.any() else []),
        *(durations if command.duration_columns else no_durations),
        f"# sign = {[-1, *each[1:]]}   # where the log turns the other way: here the first",
        f"# zero = {[0 for _ in each]}   # value that the robot calls 0, in the unit above",
        "",
        f"{no_tool}[tool]             # measured tool position in the base frame",
        f"{no_tool}columns = {_toml(tool.columns)}",
        f"{no_tool}unit = {_toml(tool.unit)}         # m, cm or mm",
        "",
        f"{no_position}[position]         # motor readings; only needed where there is no [tool]",
        f"{no_position}columns = {_toml(position.columns)}",
        f"{no_position}unit = {_toml(position.unit)}",
        "",
        "# [[sensors]]        # other sensors, SI units: accelerometer, gyroscope, wire, ...",
        '# variable = "accelerometer"',
        '# columns = ["ax", "ay", "az"]',
    ]
    return "\n".join(parts) + "\n"


def _toml(value: str | Sequence[str]) -> str:
    """Return a text or a list of texts as TOML, whose escapes are those of JSON."""
    return json.dumps(value, ensure_ascii=False)
