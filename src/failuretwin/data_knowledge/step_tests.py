"""Step tests: one motor sent there and back, read fast; CSV files known by their header.

Rows with a `command` are commands: there `position` is the target and `command` the duration [ms].
They may stand a little after their time. The file's name says which servo it is (`motor_6`).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.foreign import files_below
from failuretwin.core.types import MS_PER_S, BoolArray, FloatArray, frozen_array
from failuretwin.data_knowledge.readers.table import Table, first_line
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.servo import ServoUnits

# What keeps a step of a step test from telling of a healthy motor.

REST_S = 0.3
"""Time at the end of a step in which the motor should rest [s]."""
FEWEST, FEWEST_AT_REST = 20, 5
"""Readings below which nothing is said of a step, and of where it ends."""
SLOWEST_S, LONGEST_HOLE_S = 0.03, 0.06
"""Times between readings that are too long to follow a step of a tenth of a second [s]."""
SMALLEST_COUNTS = 10.0
"""Travel below which rounding hides the motion [counts]."""
MOVES, ARRIVES = 0.25, 0.8
"""Shares of its travel below which a motor does not move, or is held back."""
RESTLESS_COUNTS = 12.0
"""Largest wandering of a motor at rest [counts]."""


def flaw_of_readings(time: FloatArray, rest: FloatArray) -> str:
    """Return what keeps readings about a step from telling anything, or nothing.

    `time` counts from the command, (reading,) [s]; `rest` are the readings at the end [counts].
    """
    if len(time) < FEWEST or len(rest) < FEWEST_AT_REST or time[0] > -REST_S:
        return "has too few readings before, during or after it"
    period = float(np.median(np.diff(time)))
    if period > SLOWEST_S:
        return f"was read every {period:.3f} s, expected {SLOWEST_S:g} s or faster"
    hole = float(np.diff(time[time > -SLOWEST_S]).max())
    if hole > LONGEST_HOLE_S:
        return f"has a gap of {hole:.2f} s in its readings"
    if np.ptp(rest) > RESTLESS_COUNTS:
        return "does not come to rest"
    return ""


def flaw_of_motion(start: float, settled: float, target: float) -> str:
    """Return why a motor is not healthy, or nothing; angles are in servo counts."""
    travel = target - start
    if abs(travel) < SMALLEST_COUNTS:
        return f"is told to move by {abs(travel):.0f} counts only"
    share = (settled - start) / travel
    if share < MOVES:
        return "does not move although commanded"
    if share < ARRIVES:
        return f"is held back: it covers {100.0 * share:.0f} % of its travel"
    if share > 2.0 - ARRIVES:
        return f"goes too far: {100.0 * share:.0f} % of its travel"
    return ""


HEADER = "timestamp,position,command,time_since_start,position_degree"
SERVO = re.compile(r"motor_\d+")
BEFORE_S, AFTER_S = 0.4, 1.5
"""Time that counts before and after a command [s]."""
GLITCH_COUNTS, GLITCH_SPEED = 10.0, 3.0
"""A reading is spoilt if it lies this far outside the range [counts], or this far and what the
motor covers between readings at this multiple of its speed limit from the median of five."""


@dataclass(frozen=True)
class StepTest:
    """One command of a step test and what followed.

    Attributes:
        source: Folder and name of the file.
        number: Number of the command in it, from 1.
        motor: Name of the motor; empty where it is none of the robot's.
        target: Where it was sent [rad].
        duration: In which time [s].
        start: Where it rested before [rad].
        settled: Where it rested after [rad].
        time: Times of the readings since the stamp of the command, (reading,) [s].
        position: Readings without spoilt ones, (reading,) [rad].
        flaw: Why it tells nothing of a healthy motor; empty where it does.
    """

    source: str
    number: int
    motor: str
    target: float
    duration: float
    start: float
    settled: float
    time: FloatArray
    position: FloatArray
    flaw: str

    @property
    def travel(self) -> float:
        """Distance covered, signed [rad]."""
        return self.settled - self.start


def is_step_test(path: Path) -> bool:
    """Return whether a file has exactly the header of a step test."""
    return path.suffix == ".csv" and path.is_file() and first_line(path) == HEADER


def find_step_tests(path: Path) -> list[Path]:
    """Return every step test at or below `path`, in order of their names."""
    files = sorted(files_below(path, "*.csv")) if path.is_dir() else [path]
    return [file for file in files if is_step_test(file)]


def read_step_test(path: Path, robot: Robot) -> list[StepTest]:
    """Read the steps of one file; those that tell nothing carry the reason.

    Raises:
        InputError: If the file cannot be read, holds something that is no number, or no command.
    """
    table = _read_table(path)
    command = table[:, 2] != 0.0
    if not command.any():
        raise InputError(
            f"{path}: no row has a command. Expected rows whose `command` is the duration [ms] and "
            "whose `position` is the target."
        )
    motor, flaw = _motor(path, robot)
    readings = table[~command, :2]
    sound = readings[_sound(readings, robot, motor)]
    stamps = np.append(table[command, 0], np.inf)
    source = f"{path.parent.name}/{path.name}"
    return [
        _step((source, i + 1, motor), row, stamps[i + 1], sound, robot.servo_units, flaw)
        for i, row in enumerate(table[command])
    ]


def _read_table(path: Path) -> FloatArray:
    """Return the rows in order of their stamps, (row, 3): stamp, position, command."""
    table = Table.read(path).numbers(["timestamp", "position", "command"], gaps=False)
    return table[np.argsort(table[:, 0], kind="stable")]


def _motor(path: Path, robot: Robot) -> tuple[str, str]:
    """Return the motor in the name of a file, or the flaw of the name."""
    named = SERVO.search(path.stem)
    if named is None:
        return "", "is in a file whose name does not say which servo it is (motor_N)"
    for motor in robot.motors:
        if motor.log_column == named.group():
            return motor.name, ""
    return "", f"is of servo {named.group()}, which is none of the robot's motors"


def _sound(readings: FloatArray, robot: Robot, motor: str) -> BoolArray:
    """Return which readings are not spoilt: near the servo's range and near their neighbours."""
    from scipy.ndimage import median_filter

    units, time, counts = robot.servo_units, readings[:, 0], readings[:, 1]
    fastest = max(m.speed_limit for m in robot.motors if motor in (m.name, ""))
    period = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    reach = GLITCH_COUNTS + GLITCH_SPEED * fastest / units.rad_per_count * period
    inside = (counts > units.low - GLITCH_COUNTS) & (counts < units.high + GLITCH_COUNTS)
    near = np.abs(counts - median_filter(counts, 5, mode="nearest")) < reach
    return np.asarray(inside & near)


def _step(
    origin: tuple[str, int, str],
    row: FloatArray,
    until: float,
    readings: FloatArray,
    units: ServoUnits,
    flaw: str,
) -> StepTest:
    """Return one step.

    Args:
        origin: File, number of the command and motor.
        row: Stamp [s], target [counts] and duration [ms] of the command, (3,).
        until: Stamp of the next command [s].
        readings: Stamps [s] and sound readings [counts] of the whole file, (reading, 2).
        units: Scale of the counts.
        flaw: Flaw of the whole file.
    """
    time, counts = readings[:, 0] - row[0], readings[:, 1]
    end = min(until - row[0], AFTER_S)
    before = counts[(time > -BEFORE_S) & (time <= 0.0)]
    after = (time > -BEFORE_S) & (time <= end)
    rest = counts[after & (time > end - REST_S)]
    start, settled = (float(np.median(x)) if len(x) else np.nan for x in (before, rest))
    own = flaw_of_readings(time[after], rest) or flaw_of_motion(start, settled, row[1])
    source, number, motor = origin
    return StepTest(
        source=source,
        number=number,
        motor=motor,
        target=float(units.to_rad(row[1])),
        duration=float(row[2]) / MS_PER_S,
        start=float(units.to_rad(start)),
        settled=float(units.to_rad(settled)),
        time=frozen_array(time[after]),
        position=frozen_array(units.to_rad(counts[after])),
        flaw=" and ".join(part for part in (own, flaw) if part),
    )
