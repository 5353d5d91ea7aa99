"""A task: targets in their order, from Python or a CSV file, how it is carried out, its result."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.types import FloatArray

TOLERANCE_M = 0.005
"""A target is reached within this distance unless it says otherwise [m]."""
DIRECTION_TOLERANCE_RAD = float(np.deg2rad(5.0))
"""And within this angle of its approach direction [rad]."""
POSITION, DIRECTION, TOLERANCE = ("x", "y", "z"), ("dx", "dy", "dz"), "tolerance"
"""Columns of a CSV file."""


@dataclass(frozen=True)
class Target:
    """A point that the tool shall come to.

    Attributes:
        position: In the frame of the tool sensor, x, y, z [m].
        direction: Along which z of the tool frame shall point, any length; None: any way.
        tolerance_m: How near is near enough [m].
    """

    position: tuple[float, float, float]
    direction: tuple[float, float, float] | None = None
    tolerance_m: float = TOLERANCE_M

    def __post_init__(self) -> None:
        numbers = [*self.position, *(self.direction or ()), self.tolerance_m]
        if not all(math.isfinite(value) for value in numbers):
            raise InputError(f"target {self.position} holds a number that is not finite.")
        if self.tolerance_m <= 0.0:
            raise InputError(
                f"target {self.position}: tolerance is {self.tolerance_m:g}, expected a distance "
                "above 0 [m]."
            )
        if self.direction is not None and not any(self.direction):
            raise InputError(
                f"target {self.position}: direction is 0, 0, 0. Give one, or leave it out."
            )

    @property
    def point(self) -> FloatArray:
        """Where, (3,) [m]."""
        return np.asarray(self.position)

    @property
    def axis(self) -> FloatArray | None:
        """The direction as a unit vector, (3,); None: any."""
        if self.direction is None:
            return None
        axis = np.asarray(self.direction)
        return np.asarray(axis / np.linalg.norm(axis))


@dataclass(frozen=True)
class Task:
    """Targets in the order in which they are to be reached.

    Attributes:
        targets: At least one.
        name: What to call it.
    """

    targets: Sequence[Target] = field(default_factory=tuple)
    name: str = "task"

    def __post_init__(self) -> None:
        if not self.targets:
            raise InputError("a task needs one target at least; this one has none.")

    @classmethod
    def of_points(cls, points: FloatArray, tolerance_m: float = TOLERANCE_M) -> Task:
        """Return a task of points, (target, 3) [m], with any direction."""
        return cls(tuple(Target((float(x), float(y), float(z)), None, tolerance_m)
                         for x, y, z in np.asarray(points)))  # fmt: skip


def read_task(path: str | Path) -> Task:
    """Read a task from a CSV file with a header.

    Columns are x, y, z [m] in the frame of the tool sensor, and where wanted dx, dy, dz (approach
    direction) and tolerance [m].
    """
    path = Path(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = list(csv.DictReader(file, skipinitialspace=True))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read as a task ({error}).") from error
    if not rows:
        raise InputError(f"{path}: holds no target. Expected a header {', '.join(POSITION)} and a "
                         "line for each target.")  # fmt: skip
    names = {(name or "").strip() for name in rows[0]}
    lacking = [name for name in POSITION if name not in names]
    if lacking:
        raise InputError(
            f"{path}: lacks column {', '.join(lacking)}. Expected x, y, z [m], and where wanted "
            "dx, dy, dz and tolerance."
        )
    targets = [_target(row, f"{path}, line {i + 2}") for i, row in enumerate(rows)]
    return Task(tuple(targets), path.stem)


def _target(row: dict[str | None, str | None], where: str) -> Target:
    """Return the target of a row."""
    clean = {(name or "").strip(): (value or "").strip() for name, value in row.items()
             if not isinstance(value, list)}  # fmt: skip

    def number(name: str) -> float:
        try:
            return float(clean[name])
        except ValueError:
            raise InputError(f"{where}: {name} is {clean[name]!r}, expected a number.") from None

    x, y, z = (number(name) for name in POSITION)
    direction = None
    if any(clean.get(name) for name in DIRECTION):
        if not all(clean.get(name) for name in DIRECTION):
            raise InputError(f"{where}: a direction needs dx, dy and dz.")
        dx, dy, dz = (number(name) for name in DIRECTION)
        direction = dx, dy, dz
    tolerance = number(TOLERANCE) if clean.get(TOLERANCE) else TOLERANCE_M
    try:
        return Target((x, y, z), direction, tolerance)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


# How it is carried out, and what became of each target.


@dataclass(frozen=True)
class ActingSettings:
    """How a task is carried out.

    Attributes:
        most_movements: After so many a target is given up.
        feedback: Whether what the tool misses is corrected; else each target has one movement.
        most_repeats: So often a command that seems lost is sent again for one target.
        probe_every: A motor that is held is told to move once in so many targets, so that a
            repair is noticed.
        questions: So many movements of the task at most are made only to settle what is wrong,
            while that is open.
    """

    most_movements: int = 6
    feedback: bool = True
    most_repeats: int = 1
    probe_every: int = 8
    questions: int = 0


@dataclass(frozen=True)
class TargetResult:
    """What became of a target.

    Attributes:
        target: The target.
        reached: Whether the tool was seen within its tolerance.
        error_m: How far it was from it in the end [m]; NaN: it was not seen.
        error_rad: How far from its approach direction, as far as the believed arm tells [rad]; 0
            where none is asked for.
        first_error_m: The same after the first movement [m].
        movements: Movements made.
        reachable: Whether the last plan could reach it on the arm as it was believed to be.
        believed: What was believed in the end; empty: no fault.
        why: Why it was given up, empty if it was reached.
    """

    target: Target
    reached: bool
    error_m: float
    error_rad: float
    first_error_m: float
    movements: int
    reachable: bool
    believed: str
    why: str = ""

    @property
    def direction_error_rad(self) -> float | None:
        """Angle to the approach direction [rad]; None if none is asked for or it is not known."""
        unknown = self.target.direction is None or math.isnan(self.error_rad)
        return None if unknown else self.error_rad

    def record(self) -> dict[str, Any]:
        """Return the result as a JSON object; unknown errors are null."""
        return {
            "position": list(self.target.position),
            "reached": self.reached,
            "error_m": None if math.isnan(self.error_m) else self.error_m,
            "error_rad": self.direction_error_rad,
            "movements": self.movements,
            "reachable": self.reachable,
            "believed": self.believed or None,
            "why": self.why,
        }
