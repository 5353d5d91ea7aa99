"""A first guess at a column map, from names and numbers: always shown, never used unseen."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.csv_log import SERVO, load_csv
from failuretwin.digital_model.robot import Robot

if TYPE_CHECKING:
    import pandas as pd

COMMAND_WORDS = {"cmd", "command", "commanded", "target", "desired", "ref", "reference", "goal"}
COMMAND_WORDS |= {"setpoint", "set", "sp", "des"}
DURATION_WORDS = {"duration", "dur", "ramp"}
TOOL_WORDS = {"tool", "tcp", "ee", "eef", "tip", "end", "effector", "flange", "hand"}
TIME_WORDS = {"t", "time", "timestamp", "stamp", "clock"}
RUN_WORDS = {"run", "trial", "episode", "cycle"}


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
    """

    time: tuple[str, str] = ("", "s")
    command: tuple[tuple[str, ...], str] = ((), "rad")
    position: tuple[tuple[str, ...], str] = ((), "rad")
    duration: tuple[tuple[str, ...], str] = ((), "s")
    tool: tuple[tuple[str, ...], str] = ((), "m")
    run: str = ""
    separator: str = ","
    names: tuple[str, ...] = field(default=())


def guess_columns(path: Path, robot: Robot) -> Guess:
    """Return what the columns of a CSV file seem to be, from its header and numbers."""
    separator = _separator(path)
    table = load_csv(path, separator)
    words = {str(name): _words(str(name)) for name in table}
    time = _first(words, TIME_WORDS) or _increasing(table)
    run = _first(words, RUN_WORDS)
    rest = {name: found for name, found in words.items() if name not in (time, run)}
    durations = {name: found for name, found in rest.items() if found & DURATION_WORDS}
    rest = {name: found for name, found in rest.items() if name not in durations}
    tool = _tool(rest)
    rest = {name: found for name, found in rest.items() if name not in tool}
    commands = {name: found for name, found in rest.items() if found & COMMAND_WORDS}
    readings = {name: found for name, found in rest.items() if name not in commands}
    command, position = _by_motor(commands, robot), _by_motor(readings, robot)
    if not command:  # a log without words for commands: its only angles must be them
        command, position = position, ()
    duration = _by_motor(durations, robot) or tuple(durations)[:1]
    return Guess(
        time=(time, _time_unit(table, time, words)),
        command=(command, _angle_unit(table, command, words, robot)),
        position=(position, _angle_unit(table, position, words, robot)),
        duration=(duration, _duration_unit(table, duration, words)),
        tool=(tool, _length_unit(table, tool, words)),
        run=run,
        separator=separator,
        names=tuple(words),
    )


def _separator(path: Path) -> str:
    try:
        with path.open(encoding="utf-8") as file:
            header = file.readline()
    except (OSError, UnicodeDecodeError):
        return ","
    return max(",;\t", key=header.count)


def _words(name: str) -> set[str]:
    """Return the words and numbers in a column's name, in lower case."""
    spaced = re.sub(r"([a-z])([A-Z])", r"\1 \2", name)
    return set(re.findall(r"[a-z]+|\d+", spaced.lower()))


def _first(words: Mapping[str, set[str]], wanted: set[str]) -> str:
    return next((name for name, found in words.items() if found & wanted), "")


def _increasing(table: pd.DataFrame) -> str:
    """Return the first column whose numbers only grow."""
    for name in table:
        values = _values(table, [str(name)])[:, 0]
        if len(values) > 1 and np.all(np.diff(values) > 0):
            return str(name)
    return ""


def _by_motor(words: Mapping[str, set[str]], robot: Robot) -> tuple[str, ...]:
    """Return a column for each motor: by joint or motor name, else by number from 1 or 0."""
    for key in ("joint", "name"):
        named = [getattr(motor, key).lower() for motor in robot.motors]
        hits = [next((n for n in words if motor in n.lower()), "") for motor in named]
        if all(hits) and len(set(hits)) == len(hits):
            return tuple(hits)
    for start in (1, 0):
        numbered = [str(start + k) for k in range(len(robot.motors))]
        hits = [next((n for n, found in words.items() if k in found), "") for k in numbered]
        if all(hits):
            return tuple(hits)
    return ()


def _tool(words: Mapping[str, set[str]]) -> tuple[str, ...]:
    candidates = {name: found for name, found in words.items() if found & {"x", "y", "z"}}
    not_desired = {n: found for n, found in candidates.items() if not found & COMMAND_WORDS}
    named = {n: found for n, found in not_desired.items() if found & TOOL_WORDS} or not_desired
    hits = [next((n for n, found in named.items() if axis in found), "") for axis in "xyz"]
    return tuple(hits) if all(hits) else ()


def _values(table: pd.DataFrame, columns: Sequence[str]) -> FloatArray:
    import pandas as pd

    part = table[list(columns)].apply(pd.to_numeric, errors="coerce")
    return part.to_numpy(dtype=np.float64)


def _named_unit(
    columns: Sequence[str], words: Mapping[str, set[str]], units: Sequence[str]
) -> str | None:
    """Return the unit that the names of the columns state, if they do."""
    for unit in units:
        if columns and all(unit in words[column] for column in columns):
            return unit
    return None


def _time_unit(table: pd.DataFrame, column: str, words: Mapping[str, set[str]]) -> str:
    if not column:
        return "s"
    named = _named_unit([column], words, ("ms", "us", "ns"))
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
    named = _named_unit(columns, words, ("ms", "us", "ns"))
    if named or not columns:
        return named or "s"
    return "ms" if np.nanmedian(_values(table, columns)) > 50.0 else "s"


def _angle_unit(
    table: pd.DataFrame, columns: Sequence[str], words: Mapping[str, set[str]], robot: Robot
) -> str:
    named = _named_unit(columns, words, ("rad", "deg"))
    if named or not columns:
        return named or "rad"
    size = float(np.nanmedian(np.abs(_values(table, columns))))
    if robot.profile.servo_units is not None and size > 180.0:
        return SERVO
    return "deg" if float(np.nanmax(np.abs(_values(table, columns)))) > 2.0 * np.pi else "rad"


def _length_unit(table: pd.DataFrame, columns: Sequence[str], words: Mapping[str, set[str]]) -> str:
    named = _named_unit(columns, words, ("mm", "cm"))
    if named or not columns:
        return named or "m"
    return "mm" if float(np.nanmax(np.abs(_values(table, columns)))) > 10.0 else "m"


def column_map_text(guess: Guess, source: str, robot: Robot) -> str:
    """Return a commented column map that holds the guess, ready to be corrected.

    Args:
        guess: What the columns seem to be.
        source: Name of the file it was made from.
        robot: The robot, whose motors the comments name.
    """
    motors = ", ".join(f"{motor.name} ({motor.joint})" for motor in robot.motors)
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
        *_duration_lines(guess),
        "# sign = [1, 1, -1, 1]   # where the log turns the other way",
        "# zero = [0, 0, 0, 0]    # value that the robot calls 0, in the unit above",
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
    ]


def _quote(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("\t", "\\t")
    return f'"{escaped}"'


def _list(names: Sequence[str]) -> str:
    return "[" + ", ".join(_quote(name) for name in names) + "]"
