"""What the columns of a CSV file are, from their names and numbers.

Where the names tell all of it, the file is read so. Where they leave anything open, a guess is
written for the user to check, and never used unseen.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
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
    """What the columns of a file seem to be; empty where nothing fits.

    Attributes:
        time: Column of the times, and its unit.
        command: Columns of the commands in chain order, and their unit.
        position: Columns of the motor readings in chain order, and their unit.
        duration: Columns of the times to reach targets, and their unit.
        tool: Columns x, y, z, and their unit.
        run: Column that tells runs apart.
        separator: Between columns.
        names: Names of all columns.
        doubts: What the names leave open; empty where they tell all.
        slide_unit: Of commands and readings of motors that slide.
    """

    time: tuple[str, str] = ("", "s")
    command: tuple[tuple[str, ...], str] = ((), "rad")
    position: tuple[tuple[str, ...], str] = ((), "rad")
    duration: tuple[tuple[str, ...], str] = ((), "s")
    tool: tuple[tuple[str, ...], str] = ((), "m")
    run: str = ""
    separator: str = ","
    names: tuple[str, ...] = field(default=())
    doubts: tuple[str, ...] = ()
    slide_unit: str = "m"


def told_columns(path: Path, robot: Robot) -> ColumnMap:
    """Return what the columns of a CSV file are, where their names leave nothing open.

    Raises:
        InputError: If they do; it names what, and the candidates.
    """
    guess = guess_columns(path, robot)
    if guess.doubts:
        raise InputError(
            f"{path}: needs a column map, for the names of its columns leave open: "
            f"{'; '.join(guess.doubts)}. Add --columns MAP.toml: if that file does not exist yet, "
            "a guess is written there for you to check."
        )
    durations, tool, position = guess.duration, guess.tool[0], guess.position[0]
    return ColumnMap(
        time=TimeColumn(*guess.time),
        command=CommandColumns(
            guess.command[0],
            "target" if durations[0] else "sampled",
            guess.command[1],
            durations[0],
            durations[1],
            slide_unit=guess.slide_unit,
        ),
        tool=ToolColumns((tool[0], tool[1], tool[2]), guess.tool[1]) if tool else None,
        position=AngleColumns(position, guess.position[1], slide_unit=guess.slide_unit)
        if position
        else None,
        run=guess.run or None,
        separator=guess.separator,
    )


def guess_columns(path: Path, robot: Robot) -> Guess:
    """Return what the columns of a CSV file seem to be, from its header and numbers."""
    separator = _separator(path)
    table = load_csv(path, separator)
    words = {str(name): _words(str(name)) for name in table}
    found = _candidates(words, robot)
    time = next(iter(found.time), "") or _increasing(table)
    command, position, tool = (_firsts(f) for f in (found.command, found.position, found.tool))
    duration = _firsts(found.duration)
    turning = [_of_kind(columns, robot, False) for columns in (command, position)]
    sliding = [_of_kind(columns, robot, True) for columns in (command, position)]
    return Guess(
        time=(time, _time_unit(table, time, words)),
        command=(command, _angle_unit(table, turning[0], words, robot)),
        position=(position, _angle_unit(table, turning[1], words, robot)),
        slide_unit=_length_unit(table, sliding[0] or sliding[1], words),
        duration=(duration, _duration_unit(table, duration, words)),
        tool=(tool, _length_unit(table, tool, words)),
        run=next(iter(found.run), ""),
        separator=separator,
        names=tuple(words),
        doubts=(
            *_choices(found, robot),
            *_lacking(found, words),
            *(
                doubt
                for columns in turning
                for doubt in _unsaid(table, columns, words, ANGLE_NAMES, LARGEST_RAD)
            ),
            *(
                doubt
                for columns in (*sliding, tool)
                for doubt in _unsaid(table, columns, words, LENGTH_NAMES, LARGEST_M)
            ),
        ),
    )


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
    try:
        with path.open(encoding="utf-8") as file:
            header = file.readline().strip()
    except (OSError, UnicodeDecodeError):
        return ","
    likely = max(",;\t", key=header.count)
    return likely if likely in header or " " not in header else BLANKS


def _words(name: str) -> set[str]:
    """Return the words and numbers in a column's name, in lower case."""
    spaced = re.sub(r"([a-z])([A-Z])", r"\1 \2", name)
    return set(re.findall(r"[a-z]+|\d+", spaced.lower()))


def _increasing(table: pd.DataFrame) -> str:
    """Return the first column whose numbers only grow."""
    for name in table:
        values = _values(table, [str(name)])[:, 0]
        if len(values) > 1 and np.all(np.diff(values) > 0):
            return str(name)
    return ""


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


def _values(table: pd.DataFrame, columns: Sequence[str]) -> FloatArray:
    import pandas as pd

    part = table[list(columns)].apply(pd.to_numeric, errors="coerce")
    return part.to_numpy(dtype=np.float64)


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


def _unsaid(
    table: pd.DataFrame,
    columns: Sequence[str],
    words: Mapping[str, set[str]],
    names: Mapping[str, Sequence[str]],
    largest: float,
) -> list[str]:
    """Return a doubt where columns cannot be in SI units and do not say what else they are in."""
    if not columns or _named_unit(columns, words, names):
        return []
    size = float(np.nanmax(np.abs(_values(table, columns)), initial=0.0))
    if size <= largest:
        return []
    units = " or ".join(f"_{unit}" for unit in names)
    return [f"the unit of {columns[0]}, whose numbers reach {size:g} (its name has no {units})"]


def _named_unit(
    columns: Sequence[str], words: Mapping[str, set[str]], names: Mapping[str, Sequence[str]]
) -> str | None:
    """Return the unit that the names of the columns state, if they do."""
    for unit, said in names.items():
        if columns and all(words[column] & set(said) for column in columns):
            return unit
    return None


def _time_unit(table: pd.DataFrame, column: str, words: Mapping[str, set[str]]) -> str:
    if not column:
        return "s"
    named = _named_unit([column], words, TIME_NAMES)
    values = _values(table, [column])[:, 0]
    if named or not np.isfinite(values).any():
        return named or "iso"
    size = float(np.nanmax(np.abs(values)))
    for limit, unit in ((1e17, "ns"), (1e14, "us"), (1e11, "ms")):
        if size > limit:
            return unit
    step = float(np.nanmedian(np.diff(values))) if len(values) > 1 else 0.0
    return "ms" if step >= 2.0 else "s"


def _duration_unit(
    table: pd.DataFrame, columns: Sequence[str], words: Mapping[str, set[str]]
) -> str:
    named = _named_unit(columns, words, TIME_NAMES)
    if named or not columns:
        return named or "s"
    return "ms" if np.nanmedian(_values(table, columns)) > 50.0 else "s"


def _angle_unit(
    table: pd.DataFrame, columns: Sequence[str], words: Mapping[str, set[str]], robot: Robot
) -> str:
    named = _named_unit(columns, words, ANGLE_NAMES)
    if named or not columns:
        return named or "rad"
    size = float(np.nanmedian(np.abs(_values(table, columns))))
    if robot.profile.servo_units is not None and size > 180.0:
        return SERVO
    return "deg" if float(np.nanmax(np.abs(_values(table, columns)))) > LARGEST_RAD else "rad"


def _length_unit(table: pd.DataFrame, columns: Sequence[str], words: Mapping[str, set[str]]) -> str:
    named = _named_unit(columns, words, LENGTH_NAMES)
    if named or not columns:
        return named or "m"
    return "mm" if float(np.nanmax(np.abs(_values(table, columns)))) > LARGEST_M else "m"


def column_map_text(guess: Guess, source: str, robot: Robot) -> str:
    """Return a commented column map that holds the guess, ready to be corrected.

    Args:
        guess: What the columns seem to be.
        source: Name of the file it was made from.
        robot: The robot, whose motors the comments name.
    """
    motors = ", ".join(f"{motor.name} ({motor.joint})" for motor in robot.motors)
    each = [1] * len(robot.motors)
    parts = [
        f"# Column map for {source}: which column is what. A GUESS: check every line.",
        f"# Columns of the file: {', '.join(guess.names)}",
        f"# Motors of {robot.name}, in this order: {motors}",
        f"separator = {_quote(guess.separator)}",
        "# run tells several runs in one file apart; leave it out where a file is one run.",
        f"run = {_quote(guess.run)}" if guess.run else '# run = "trial"',
        "",
        "[time]",
        f"column = {_quote(guess.time[0] or 'FILL IN')}",
        f"unit = {_quote(guess.time[1])}        # s, ms, us, ns, or iso (2026-01-31T12:00:00.25)",
        "",
        "[command]          # what the motors were told",
        f"columns = {_list(guess.command[0] or ['FILL IN'] * len(robot.motors))}",
        f'kind = "{"target" if guess.duration[0] else "sampled"}"'
        "   # sampled (the reference at every row) or target (where to go)",
        f"unit = {_quote(guess.command[1])}      # rad, deg, or servo (counts of the profile)",
        *([f"slide_unit = {_quote(guess.slide_unit)}"] if robot.slides.any() else []),
        *_duration_lines(guess),
        f"# sign = {[-1, *each[1:]]}   # where the log turns the other way: here the first",
        f"# zero = {[0 for _ in each]}   # value that the robot calls 0, in the unit above",
        "",
        *_tool_lines(guess),
        *_position_lines(guess),
    ]
    return "\n".join(parts) + "\n"


def _duration_lines(guess: Guess) -> list[str]:
    columns, unit = guess.duration
    if columns:
        return [f"duration_columns = {_list(columns)}", f"duration_unit = {_quote(unit)}"]
    return [
        "# For targets: duration_columns and duration_unit, or one duration_s for all movements."
    ]


def _tool_lines(guess: Guess) -> list[str]:
    columns, unit = guess.tool
    lead = "" if columns else "# "
    return [
        f"{lead}[tool]             # measured tool position in the base frame",
        f"{lead}columns = {_list(columns or ('tool_x', 'tool_y', 'tool_z'))}",
        f"{lead}unit = {_quote(unit)}         # m, cm or mm",
        "",
    ]


def _position_lines(guess: Guess) -> list[str]:
    columns, unit = guess.position
    lead = "" if columns else "# "
    return [
        f"{lead}[position]         # motor readings; only needed where there is no [tool]",
        f"{lead}columns = {_list(columns or ('q1', 'q2'))}",
        f"{lead}unit = {_quote(unit)}",
        "",
        "# [[sensors]]        # other sensors, SI units: accelerometer, gyroscope, wire, ...",
        '# variable = "accelerometer"',
        '# columns = ["ax", "ay", "az"]',
    ]


def _quote(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("\t", "\\t")
    return f'"{escaped}"'


def _list(names: Sequence[str]) -> str:
    return "[" + ", ".join(_quote(name) for name in names) + "]"
