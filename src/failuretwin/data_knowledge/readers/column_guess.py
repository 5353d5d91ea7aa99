"""Column maps guessed from the names and numbers of a CSV file.

A file with unambiguous column names is read without a map. Otherwise a guess is written for the
user to check; an unchecked guess is never used.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from failuretwin.core.errors import InputError, counted
from failuretwin.core.runs import AXES
from failuretwin.data_knowledge.readers.column_map import (
    FILL_IN,
    SERVO,
    AngleColumns,
    ColumnMap,
    CommandColumns,
    TimeColumn,
    ToolColumns,
    map_text,
)
from failuretwin.data_knowledge.readers.table import Table, separator_of
from failuretwin.digital_model import DEFAULT_ROBOT
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.urdf.file import read_urdf

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


def unambiguous_columns(path: Path, robot: Robot) -> ColumnMap:
    """Return the column map of a CSV file whose column names leave nothing open.

    Raises:
        InputError: If they leave anything open; the text lists what, and the candidates.
    """
    guess = _guess(path, robot)
    if guess.doubts:
        raise InputError(
            f"{path}: needs a column map, for the names of its columns leave open: "
            f"{'; '.join(guess.doubts)}. {guess.commands_text(robot)}Add --columns MAP.toml: if "
            "that file does not exist yet, a guess is written there for you to check."
        )
    return guess.columns


@dataclass(frozen=True)
class _Guess:
    """Column map that header and numbers of a CSV file suggest.

    Attributes:
        columns: The map, with `FILL_IN` for motors without a column.
        names: Names of all columns.
        commands: Columns that look like commands.
        doubts: Open questions; none where the names answer all of them.
    """

    columns: ColumnMap
    names: Sequence[str]
    commands: Sequence[str]
    doubts: Sequence[str]

    def commands_text(self, robot: Robot) -> str:
        """Return the column of each motor and the robot's name; empty if all have a column."""
        told = self.columns.command.columns
        if FILL_IN not in told:
            return ""
        found = ", ".join(
            f"{motor.joint} ({'no column' if column == FILL_IN else column})"
            for motor, column in zip(robot.motors, told, strict=True)
        )
        default = ", the default where --robot names none" if robot.name == DEFAULT_ROBOT else ""
        return (
            f"The robot was taken to be {robot.name} ({counted(len(told), 'motor')}){default}. "
            f"Its joints: {found}. In this file {counted(len(self.commands), 'column')} may be "
            "commands. --robot NAME|PROFILE names another robot. "
        )


def _guess(path: Path, robot: Robot) -> _Guess:
    """Return the column map that header and numbers of a CSV file suggest.

    Raises:
        InputError: If the file has fewer columns that may be commands than the robot has motors.
    """
    separator = separator_of(path)
    table = _Guessed.read(path, separator)
    found = _candidates(table.words, robot)
    first = {part: _firsts(candidates) for part, candidates in found.items()}
    command, position, tool = _filled(found[COMMAND]), first[READING], first[PLACE]
    time = (*first[TIME], table.increasing())[0]
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
            kind="target" if first[DURATION] else "sampled",
            duration_columns=first[DURATION],
            duration_unit=table.duration_unit(first[DURATION]),
        ),
        tool=ToolColumns((tool[0], tool[1], tool[2]), table.length_unit(tool)) if tool else None,
        position=AngleColumns(position, units[1], slide_unit=slide_unit) if position else None,
        run=next(iter(first[RUN]), None),
        separator=separator,
    )
    doubts = [*_choices(found, robot), *_lacking(first, table.words)]
    doubts += [d for c in turning for d in table.unsaid(c, ANGLE_NAMES, LARGEST_RAD)]
    doubts += [d for c in (*sliding, tool) for d in table.unsaid(c, LENGTH_NAMES, LARGEST_M)]
    guess = _Guess(columns, list(table.words), _command_columns(found, table.words), doubts)
    if len(guess.commands) < len(command):
        raise InputError(
            f"{path}: has too few columns of commands for this robot, and no column map can mend "
            f"that. {guess.commands_text(robot)}Otherwise log a command for each motor."
        )
    return guess


class _Guessed(Table):
    """A table, and what names and numbers of its columns suggest."""

    @cached_property
    def words(self) -> dict[str, set[str]]:
        """Words of each column's name."""
        return {name: _words(name) for name in self.names}

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
        long = len(columns) > 0 and np.nanmedian(self.values(columns)) > 50.0
        return self.named_unit(columns, TIME_NAMES) or ("ms" if long else "s")

    def angle_unit(self, columns: Sequence[str], robot: Robot) -> str:
        """Return the unit of angles: stated, or by their size."""
        named = self.named_unit(columns, ANGLE_NAMES)
        if named or not columns:
            return named or "rad"
        values = np.abs(self.values(columns))
        size = float(np.nanmedian(values)) if np.isfinite(values).any() else 0.0
        if robot.profile.servo_units is not None and size > 180.0:
            return SERVO
        return "deg" if self.largest(columns) > LARGEST_RAD else "rad"

    def length_unit(self, columns: Sequence[str]) -> str:
        """Return the unit of lengths: stated, or by their size."""
        large = self.largest(columns) > LARGEST_M
        return self.named_unit(columns, LENGTH_NAMES) or ("mm" if large else "m")


Candidates = Mapping[str, Sequence[Sequence[str]]]
"""Columns that may be each part of a log: for each motor or axis, or one list for the whole."""
TIME, RUN, DURATION, PLACE = "time", "run", "duration", "place"
COMMAND, READING = "command", "reading"


def _candidates(words: Mapping[str, set[str]], robot: Robot) -> Candidates:
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
    command, reading = _by_motor(commands, robot), _by_motor(readings, robot)
    if not any(command):  # a log without words for commands: its only angles must be them
        command, reading = reading, []
    return {
        TIME: [time],
        RUN: [run],
        COMMAND: command,
        READING: reading,
        DURATION: ramps if _firsts(ramps) else [list(durations)] * bool(durations),
        PLACE: tool,
    }


def _words(name: str) -> set[str]:
    """Return the words and numbers in a column's name, in lower case."""
    spaced = re.sub(r"([a-z])([A-Z])", r"\1 \2", name)
    return set(re.findall(r"[a-z]+|\d+", spaced.lower()))


def _by_motor(words: Mapping[str, set[str]], robot: Robot) -> list[list[str]]:
    """Return the columns that may be each motor's: by joint name, motor name or number.

    The first of these three ways that finds a column for most motors counts.

    Numbers count the motors, or all joints that move between base and tool where there are as many
    of them. They begin at 0 if any column has a 0. Of names that hold one another, such as `lift`
    and `shoulder_lift`, the longest counts.
    """
    joints = {_plain(joint.name) for joint in read_urdf(robot.urdf_file).joints if joint.has_motor}
    found = []
    for key in ("joint", "name"):
        named = [_plain(getattr(motor, key)) for motor in robot.motors]
        known = sorted(joints | set(named), key=len)
        owner = {n: [one for one in known if one in n.lower()][-1:] for n in words}
        found.append([[name for name, of in owner.items() if of == [motor]] for motor in named])
    numbers = {int(word) for of in words.values() for word in of if word.isdigit()}
    start = 0 if 0 in numbers else 1
    count = next(k for k in range(len(numbers) + 1) if start + k not in numbers)
    found.append(
        [
            [name for name, of in words.items() if str(start + place) in of]
            for place in _places(robot, count)
        ]
    )
    return max(found, key=lambda hits: len({name for name, *_ in filter(None, hits)}))


def _plain(name: str) -> str:
    return name.lower().removesuffix("_joint")


def _of_kind(columns: Sequence[str], robot: Robot, slides: bool) -> tuple[str, ...]:
    """Return the columns, one a motor if any, of those that slide, or of those that turn."""
    return tuple(
        c for c, one in zip(columns, robot.slides, strict=False) if one == slides and c != FILL_IN
    )


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


def _filled(candidates: Sequence[Sequence[str]]) -> tuple[str, ...]:
    """Return the first candidate for each, or `FILL_IN` where one has none."""
    return tuple(hits[0] if hits else FILL_IN for hits in candidates)


def _command_columns(found: Candidates, words: Mapping[str, set[str]]) -> list[str]:
    """Return the columns that may be commands: those that are not taken for anything else."""
    taken = {name for part in (TIME, RUN, PLACE, READING) for name in _firsts(found[part])}
    taken |= {name for hits in found[DURATION] for name in hits}
    return [
        name
        for name, of in words.items()
        if name not in taken and (of & COMMAND_WORDS or not of & OTHER_WORDS)
    ]


def _choices(found: Candidates, robot: Robot) -> list[str]:
    """Return a doubt for each part of a log that more than one column may be."""
    owners = {TIME: ["the log"], RUN: ["each row"], PLACE: [f"the tool in {axis}" for axis in AXES]}
    return [
        f"the {part} of {owner} may be {' or '.join(hits)}"
        for part, candidates in found.items()
        for owner, hits in zip(owners.get(part, robot.motor_names), candidates, strict=False)
        if len(hits) > 1
    ]


def _tool_candidates(words: Mapping[str, set[str]]) -> list[list[str]]:
    candidates = {name: found for name, found in words.items() if found & set(AXES)}
    not_desired = {n: found for n, found in candidates.items() if not found & COMMAND_WORDS}
    named = {n: found for n, found in not_desired.items() if found & TOOL_WORDS} or not_desired
    return [[name for name, found in named.items() if axis in found] for axis in AXES]


def _lacking(first: Mapping[str, Sequence[str]], words: Mapping[str, set[str]]) -> list[str]:
    """Return a doubt for each part of a log that no column was found for."""
    doubts = []
    if not first[TIME]:
        doubts.append("which column is the time")
    if not first[COMMAND] or any(words[name] & READING_WORDS for name in first[COMMAND]):
        doubts.append("which columns are the commands, one for each motor")
    if not first[PLACE] and not first[READING]:
        doubts.append("which columns are the tool (x, y, z) or the readings of the motors")
    return [f"{doubt}, of {', '.join(words)}" for doubt in doubts]


HINTS = """\
Columns of the file: {names}
Motors of {robot}, in this order: {motors}
run tells several runs in one file apart, such as run = "trial".
[time]: unit is s, ms, us, ns, or iso (2026-01-31T12:00:00.25).
[command] is what the motors were told: kind is sampled (the reference at every row) or target
(where to go, with duration_columns and duration_unit, or one duration_s for all movements);
unit is rad, deg, or servo (counts of the profile); slide_unit is that of motors that slide.
[tool] is the measured tool position in the base frame: unit is m, cm or mm.
[position] is what the motors read; it is only needed where there is no [tool].
[command] and [position] may also have
sign = {sign}   where the log turns the other way: here the first
zero = {zero}   value that the robot calls 0, in the unit of the table
[[sensors]] are other sensors in SI units, with variable = "accelerometer", "gyroscope", "wire", ...
and columns = ["ax", "ay", "az"]."""


def column_map_text(path: Path, robot: Robot) -> str:
    """Return a commented column map with the guess for a CSV file, ready to be corrected."""
    guess, count = _guess(path, robot), len(robot.motors)
    hints = HINTS.format(
        names=", ".join(guess.names),
        robot=robot.name,
        motors=", ".join(f"{motor.name} ({motor.joint})" for motor in robot.motors),
        sign=[-1] + [1] * (count - 1),
        zero=[0] * count,
    )
    time = guess.columns.time
    filled = replace(guess.columns, time=replace(time, column=time.column or FILL_IN))
    return map_text(f"Column map for {path.name}", hints, filled)
