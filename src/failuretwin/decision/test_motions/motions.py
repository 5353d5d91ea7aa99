"""A sequence of test movements as a value and as a file: JSON, CSV, or a bag of commands.

Bags are for robots that we cannot command. They say neither where the arm stands at first nor when
all ends: read back, it stands where designs begin, and the last movement lasts as the longest does.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from failuretwin.connection.links.base import CommandSent, Order
from failuretwin.core.errors import InputError
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.readers.bags import read_targets
from failuretwin.data_knowledge.readers.table import first_line
from failuretwin.data_knowledge.store import write_text
from failuretwin.decision.test_motions.design import Movement
from failuretwin.digital_model.robot import Robot

STEP_S = 0.01
"""Step of a reference [s]."""
BAGS = (".mcap", ".bag")
SUFFIXES = (".json", ".csv", *BAGS)
TABLE_RAD = 1e-5
"""Angles of a table that are nearer to each other are the same [rad]; it has six digits."""
NEEDED = ("robot", "motors", "start_rad", "target_rad", "ramp_s", "seconds")
"""What a JSON file must hold."""


@dataclass(frozen=True)
class Motions:
    """Movements of a robot, one after the other.

    Attributes:
        robot: Its name.
        motors: Names of its motors in chain order.
        start: What they are told before the first, (motor,) [rad].
        target: What they are told, (movement, motor) [rad].
        ramp_s: Time of each ramp, (movement,) [s].
        seconds: Time from each to the next, (movement,) [s].
    """

    robot: str
    motors: tuple[str, ...]
    start: FloatArray
    target: FloatArray
    ramp_s: FloatArray
    seconds: FloatArray

    @classmethod
    def of(cls, robot: Robot, movements: Sequence[Movement]) -> Self:
        """Return movements of a design."""
        return cls(
            robot.name,
            tuple(robot.motor_names),
            movements[0].previous,
            np.array([movement.order.target for movement in movements]),
            np.array([float(movement.order.duration.max()) for movement in movements]),
            np.array([movement.seconds for movement in movements]),
        )

    @property
    def duration_s(self) -> float:
        """Time of all movements [s]."""
        return float(self.seconds.sum())

    @property
    def told(self) -> FloatArray:
        """What motors are told, the start first, (movement + 1, motor) [rad]."""
        return np.concatenate([self.start[None], self.target])

    @property
    def start_s(self) -> FloatArray:
        """When each movement begins, (movement,) [s]."""
        return np.concatenate([[0.0], np.cumsum(self.seconds)[:-1]])

    @property
    def orders(self) -> list[Order]:
        """The movements as orders."""
        motors = self.target.shape[1]
        return [
            Order(target, np.full(motors, ramp))
            for target, ramp in zip(self.target, self.ramp_s.tolist(), strict=True)
        ]

    @property
    def corners(self) -> tuple[FloatArray, FloatArray]:
        """Times (corner,) [s] and angles (corner, motor) [rad], straight lines between them."""
        begin, end = self.start_s, self.start_s + self.ramp_s
        time = np.append(np.stack([begin, end], axis=1).ravel(), self.duration_s)
        angle = np.stack([self.told[:-1], self.target], axis=1).reshape(-1, len(self.motors))
        return time, np.concatenate([angle, self.target[-1:]])

    def reference(self) -> tuple[FloatArray, FloatArray]:
        """Return a time grid from 0, (time,) [s], and the reference on it, (time, motor) [rad]."""
        at, angle = self.corners
        time = np.arange(0.0, self.duration_s + 0.5 * STEP_S, STEP_S)
        return time, np.stack([np.interp(time, at, one) for one in angle.T], axis=1)

    def record(self) -> dict[str, Any]:
        """Return it as a JSON object."""
        return {
            "robot": self.robot,
            "motors": list(self.motors),
            "start_rad": self.start.tolist(),
            "target_rad": self.target.tolist(),
            "ramp_s": self.ramp_s.tolist(),
            "seconds": self.seconds.tolist(),
        }

    @classmethod
    def from_record(cls, record: Any, robot: Robot, where: str) -> Self:
        """Return the motions of a JSON object."""
        if not isinstance(record, dict) or any(name not in record for name in NEEDED):
            raise InputError(
                f"{where}: holds no motions. Expected an object with {', '.join(NEEDED)}, as "
                "`failuretwin design --write` writes it."
            )
        if list(record["motors"]) != robot.motor_names:
            raise InputError(
                f"{where}: has motions of the motors {', '.join(map(str, record['motors']))}. "
                f"Expected those of {robot.name}: {', '.join(robot.motor_names)}."
            )
        try:
            start, target, ramp, seconds = (
                np.asarray(record[name], dtype=np.float64) for name in NEEDED[2:]
            )
        except (TypeError, ValueError) as error:
            raise InputError(f"{where}: holds something that is no number ({error}).") from error
        count, motors = len(ramp), len(robot.motors)
        shapes = ((motors,), (count, motors), (count,), (count,))
        found = tuple(value.shape for value in (start, target, ramp, seconds))
        finite = all(np.isfinite(value).all() for value in (start, target, ramp, seconds))
        if (
            count == 0
            or found != shapes
            or not finite
            or not np.all((ramp > 0.0) & (seconds >= ramp))
        ):
            raise InputError(
                f"{where}: start, targets, ramps and times have shapes {found}. Expected "
                f"{shapes}, finite, each time as long as its ramp at least."
            )
        return cls(str(record["robot"]), tuple(robot.motor_names), start, target, ramp, seconds)


def read_motions(path: Path, robot: Robot) -> Motions:
    """Read motions from a file, as `write_motions` or a kept check has them."""
    if path.suffix in BAGS:
        return _bag_motions(path, robot)
    try:
        text = path.read_text(encoding="utf-8")
        record = _table_record(text, str(path)) if path.suffix == ".csv" else json.loads(text)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as motions ({error}).") from error
    if isinstance(record, dict) and "motions" in record:
        record = record["motions"]
    return Motions.from_record(record, robot, str(path))


def holds_motions(path: Path, robot: Robot) -> bool:
    """Return whether a file is one that `write_motions` wrote and `read_motions` reads."""
    if path.suffix in BAGS and path.exists():
        return read_targets(path, robot) is not None
    if path.suffix != ".csv":
        return path.suffix == ".json"
    return first_line(path).split(",") == _columns(robot.motor_names)


def _bag_motions(path: Path, robot: Robot) -> Motions:
    """Return the motions of a bag of commands; see `read_motions`."""
    if not path.exists():
        raise InputError(f"{path}: cannot be read as motions (it does not exist).")
    targets = read_targets(path, robot)
    if targets is None:
        raise InputError(
            f"{path}: holds no motions. Expected a bag of commands alone, as `failuretwin design "
            "--write` writes it."
        )
    ramp, seconds = targets.duration.max(axis=1), np.diff(targets.time)
    record = {
        "robot": robot.name,
        "motors": robot.motor_names,
        "start_rad": robot.resting_pose,
        "target_rad": targets.target,
        "ramp_s": ramp,
        "seconds": np.append(seconds, max([*seconds.tolist(), ramp[-1]])),
    }
    return Motions.from_record(record, robot, str(path))


def _columns(motors: Sequence[str]) -> list[str]:
    """Return the heads of a table of motions."""
    return ["time_s", *(f"{motor}_rad" for motor in motors)]


def _table_record(text: str, where: str) -> dict[str, Any]:
    """Return the JSON object of a table: two rows a movement, and where all ends."""
    head, *rows = csv.reader(io.StringIO(text))
    table = np.array(rows, dtype=np.float64)
    whole = table.ndim == 2 and len(table) >= 3 and len(table) % 2 == 1
    if not whole or np.abs(table[2::2, 1:] - table[1::2, 1:]).max() > TABLE_RAD:
        raise InputError(
            f"{where}: holds no motions. Expected two rows for each movement, where it begins and "
            "where it has arrived, and one where all ends, as `failuretwin design --write` writes."
        )
    begin, arrived = table[0::2, 0], table[1::2, 0]
    return {
        "robot": "",
        "motors": [name.removesuffix("_rad") for name in head[1:]],
        "start_rad": table[0, 1:],
        "target_rad": table[1::2, 1:],
        "ramp_s": arrived - begin[:-1],
        "seconds": np.diff(begin),
    }


def write_motions(motions: Motions, robot: Robot, path: Path) -> None:
    """Write motions as JSON, CSV (straight lines between its rows) or a bag of commands.

    Bags are MCAP, as ROS 2 has them, or those of ROS 1 (.bag).
    """
    if path.suffix not in SUFFIXES:
        raise InputError(f"{path}: ends in {path.suffix!r}, expected {', '.join(SUFFIXES)}.")
    if path.suffix in BAGS:
        _write_commands(motions, robot, path)
        return
    text = json.dumps(motions.record()) + "\n" if path.suffix == ".json" else _csv(motions)
    write_text(text, path)


def _write_commands(motions: Motions, robot: Robot, path: Path) -> None:
    from failuretwin.connection.links.recorder import Recorder, write_bag

    commands = [
        CommandSent(begin, order.target, order.duration)
        for begin, order in zip(motions.start_s.tolist(), motions.orders, strict=True)
    ]
    if path.suffix == ".bag":
        write_bag(path, robot, commands)
        return
    with Recorder(path, robot) as recorder:
        for command in commands:
            recorder.put(command)


def _csv(motions: Motions) -> str:
    """Return corners of the reference, a row each: time [s], then angles [rad]."""
    out = io.StringIO()
    table = csv.writer(out, lineterminator="\n")
    table.writerow(_columns(motions.motors))
    for time, angles in zip(*motions.corners, strict=True):
        table.writerow([f"{time:.3f}", *(f"{angle:.6f}" for angle in angles)])
    return out.getvalue()
