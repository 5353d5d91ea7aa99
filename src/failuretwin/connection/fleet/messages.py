"""Messages of a robot to the fleet: its profile once, then readings and commands.

JSON, for people and gateways::

    {"readings": [{"t": 12.3, "tool": [0.1, 0.0, 0.3]}],
     "commands": [{"t": 12.0, "target": [0.1, 0.2, 0.0, 0.0], "duration": [1.0, 1.0, 1.0, 1.0]}]}
    {"profile": "armpi_fpv", "calibration": "TOML text, optional"}

A single reading or command may stand alone, without the list around it. Binary, a sixth of the
size: ``FT1``, the number of motors (1 byte), of readings and of commands (2 bytes each), then
float64, all little-endian: a row of time and position of each reading, and a row of time, targets
and durations of each command. Times are by the robot's clock [s], angles in rad, lengths in m.

Section: docs/fleet.md#messages
"""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from failuretwin.connection.links.base import CommandSent, Event, Reading
from failuretwin.core.errors import InputError
from failuretwin.core.types import FloatArray

MAGIC = b"FT1"
HEADER = struct.Struct("<3sBHH")
LARGEST = 256 * 1024
"""Largest message that is read [bytes]."""
MOST_EVENTS = 2000
"""Most readings and commands of a message: 100 s of a robot that is read at 10 Hz, twice over."""
LARGEST_VALUE = 1e6
"""Largest position [m], angle [rad] or duration [s]."""
LARGEST_TIME = 1e11
"""Largest stamp [s]: three thousand years; a float still tells 20 microseconds there."""
ROBOT_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
"""Names of robots; they are parts of subjects and topics."""


@dataclass(frozen=True)
class ProfileMessage:
    """What a robot is.

    Attributes:
        profile: Name of its profile.
        calibration: Its calibration, the text of a file (TOML); empty: that of its profile.
    """

    profile: str
    calibration: str = ""


@dataclass(frozen=True)
class Events:
    """Readings and commands of a message.

    Attributes:
        readings: Time [s] and tool position [m], (reading, 4); NaN where there is no position.
        commands: Time [s], targets [rad] and durations [s], (command, 1 + 2 motors).
    """

    readings: FloatArray
    commands: FloatArray

    @property
    def count(self) -> int:
        """Number of readings and commands."""
        return len(self.readings) + len(self.commands)


def parse_profile(data: bytes) -> ProfileMessage:
    """Return the profile in a message.

    Raises:
        InputError: If it is none.
    """
    table = _table(data)
    profile, calibration = table.get("profile"), table.get("calibration", "")
    if not (isinstance(profile, str) and ROBOT_NAME.fullmatch(profile)):
        raise InputError(f"profile is {_short(profile)}, expected the name of a profile.")
    if not isinstance(calibration, str):
        raise InputError(f"calibration is {_short(calibration)}, expected the text of a file.")
    return ProfileMessage(profile, calibration)


def parse_events(data: bytes, motors: int) -> Events:
    """Return the readings and commands in a message, JSON or binary.

    Args:
        data: The message.
        motors: Number of motors of the robot.

    Raises:
        InputError: If it has another form, or a value that is no finite number of a possible size.
    """
    if len(data) > LARGEST:
        raise InputError(f"a message of {len(data)} bytes, expected {LARGEST} at most.")
    found = _binary(data, motors) if data.startswith(MAGIC) else _json(data, motors)
    if found.count > MOST_EVENTS:
        raise InputError(f"{found.count} readings and commands, expected {MOST_EVENTS} at most.")
    for rows in (found.readings, found.commands):
        times, values = rows[:, 0], rows[:, 1:]
        fits = (np.abs(times) <= LARGEST_TIME).all() and (np.abs(values) <= LARGEST_VALUE).all()
        if not fits:  # also where one is NaN
            raise InputError("a time or value is NaN or too large, expected finite numbers.")
    if (found.commands[:, 1 + motors :] < 0.0).any():
        raise InputError("a duration is below 0, expected 0 or more.")
    return found


def _binary(data: bytes, motors: int) -> Events:
    if len(data) < HEADER.size:
        raise InputError(f"a binary message of {len(data)} bytes, expected {HEADER.size} or more.")
    _, own, readings, commands = HEADER.unpack_from(data)
    width = 1 + 2 * own
    size = HEADER.size + 8 * (4 * readings + width * commands)
    if own != motors or len(data) != size:
        raise InputError(
            f"a binary message of {own} motors and {len(data)} bytes, expected {motors} motors and "
            f"{size} bytes."
        )
    values = np.frombuffer(data, "<f8", offset=HEADER.size).astype(np.float64)
    return Events(
        values[: 4 * readings].reshape(readings, 4), values[4 * readings :].reshape(commands, width)
    )


def _json(data: bytes, motors: int) -> Events:
    table = _table(data)
    if not table.keys() & {"readings", "commands", "tool", "target"}:
        raise InputError(
            f"keys {_short(sorted(table))}, expected readings, commands, or one of them."
        )
    readings = table.get("readings", [table] if "tool" in table else [])
    commands = table.get("commands", [table] if "target" in table else [])
    try:
        return Events(
            _rows([[one["t"], *one["tool"]] for one in readings], 4),
            _rows(
                [[one["t"], *one["target"], *one["duration"]] for one in commands], 1 + 2 * motors
            ),
        )
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"readings or commands of another form ({type(error).__name__}: {_short(error)}). "
            f"Expected t, tool (3 numbers), or t, target and duration ({motors} numbers each)."
        ) from error


def _rows(values: list[list[Any]], width: int) -> FloatArray:
    for row in values:
        if len(row) != width or not all(type(value) in (int, float) for value in row):
            raise ValueError(f"a row of {len(row)} values")
    return np.array(values, dtype=np.float64).reshape(-1, width)


def _table(data: bytes) -> dict[str, Any]:
    if len(data) > LARGEST:
        raise InputError(f"a message of {len(data)} bytes, expected {LARGEST} at most.")
    try:
        table = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise InputError(f"neither JSON nor {MAGIC.decode()}: {_short(error)}.") from error
    if not isinstance(table, dict):
        raise InputError(f"a JSON {type(table).__name__}, expected an object.")
    return table


def _short(value: object) -> str:
    return ascii(value)[:80]


# Writing.


def profile_json(message: ProfileMessage) -> bytes:
    """Return a profile as a message."""
    return json.dumps({"profile": message.profile, "calibration": message.calibration}).encode()


def events_binary(events: Sequence[Event], motors: int) -> bytes:
    """Return readings and commands as a compact message; empty readings are left out."""
    readings = [one for one in events if isinstance(one, Reading) and np.isfinite(one.tool).all()]
    commands = [one for one in events if isinstance(one, CommandSent)]
    parts = (
        [[one.time, *one.tool] for one in readings],
        [[one.time, *one.target, *one.duration] for one in commands],
    )
    header = HEADER.pack(MAGIC, motors, len(readings), len(commands))
    return b"".join([header, *(np.array(part, dtype="<f8").tobytes() for part in parts)])
