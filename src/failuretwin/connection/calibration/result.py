"""The result of a calibration: imperfections with error bars and where they come from."""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from failuretwin import __version__
from failuretwin.core.config import read_toml
from failuretwin.core.errors import InputError, OutputError, counted
from failuretwin.data_knowledge.store import check_writable, write_text
from failuretwin.digital_model.calibrated_robot import (
    CALIBRATION_TABLE,
    CalibratedLoop,
    CalibratedRobot,
    with_loops,
)
from failuretwin.digital_model.geometry import SensorFrame
from failuretwin.digital_model.nonidealities import Imperfections
from failuretwin.digital_model.robot import Robot

SETTLING_UNITS = {
    "bias": "rad",
    "compliance": "rad/(N m)",
    "friction": "rad",
    "scatter": "rad",
}
"""Units of the parameters of `Settling` that each motor has."""
Z_95 = 1.959963984540054
"""Half the 95 % interval of a normal distribution, in standard deviations."""


@dataclass(frozen=True)
class Parameter:
    """One figure learned from the logs.

    Attributes:
        name: What it is, such as ``compliance``.
        motor: The motor it belongs to; empty for the whole robot.
        unit: Its unit.
        value: Best value.
        low: Lower end of its 95 % interval.
        high: Upper end.
        identified: Whether the logs say it; otherwise the interval is mostly that of the prior.
        note: What keeps the logs from saying it and which movement would, or empty.
        deviations: How far it lies from the mean of such robots, in their standard deviations;
            None: such robots were no prior.
    """

    name: str
    motor: str
    unit: str
    value: float
    low: float
    high: float
    identified: bool = True
    note: str = ""
    deviations: float | None = None

    @classmethod
    def normal(
        cls,
        name: str,
        motor: str,
        unit: str,
        value: float,
        deviation: float,
        identified: bool = True,
        note: str = "",
        deviations: float | None = None,
    ) -> Parameter:
        """Return a parameter with a normal posterior, given its standard deviation."""
        low, high = value - Z_95 * deviation, value + Z_95 * deviation
        return cls(name, motor, unit, value, low, high, identified, note, deviations)

    @property
    def exponential(self) -> Parameter:
        """The parameter of which this is the logarithm."""
        value, low, high = np.exp([self.value, self.low, self.high]).tolist()
        return replace(self, value=value, low=low, high=high)


@dataclass(frozen=True)
class LeftOut:
    """A movement that did not count, because it does not look like one of a healthy motor.

    Attributes:
        run: Name of the run.
        movement: Number of the movement in it, from 1; 0 for the whole run.
        motor: The motor that stands out; empty where none does by itself.
        reason: What it did.
    """

    run: str
    movement: int
    motor: str
    reason: str


@dataclass(frozen=True)
class HeldOut:
    """How well a fit to all other sessions predicts one session.

    Attributes:
        session: The session left out.
        movements: Its settled movements.
        before: Robust size of the settled error of each motor without calibration, 1.48 times its
            median size [rad]; of the three axes of the tool [m] where the log has no readings.
        after: The same about what the fit to the others predicts.
        gain: Mean log density of a movement under the fit, minus that with the figures of its
            class, what its arms differ by counted as scatter [nats].
        gain_error: Standard error of `gain`.
    """

    session: str
    movements: int
    before: tuple[float, ...]
    after: tuple[float, ...]
    gain: float
    gain_error: float


def mean_gain(held_out: tuple[HeldOut, ...]) -> tuple[float, float]:
    """Return the mean gain over all movements [nats] and half its 95 % interval."""
    count = np.array([entry.movements for entry in held_out], dtype=float)
    gain = np.array([entry.gain for entry in held_out])
    error = np.array([entry.gain_error for entry in held_out])
    share = count / count.sum()
    return float(share @ gain), 1.96 * float(np.sqrt(np.sum((share * error) ** 2)))


@dataclass(frozen=True)
class Calibration:
    """What healthy logs teach of a robot.

    Attributes:
        imperfections: The twin's imperfections, with the doubt about them as variation.
        parameters: Every figure with its 95 % interval.
        sessions: Names of the sessions it was fitted to.
        runs: Number of runs.
        movements: Number of settled movements that count, and of moments on the way.
        used_readings: Whether the motors' own readings were used, or the tool path alone.
        left_out: What was left out.
        held_out: How well it predicts sessions that it has not seen.
        remarks: What else the user should know, in sentences.
        loops: Servo loops from step tests; motors without any keep those of the profile. Timing is
            what is left on top of them.
        frame: Where the tool sensor stands beside what the profile says; None: as that says.
        moments: Of the movements, those that are moments on the way of an arm that hardly rests.
    """

    imperfections: Imperfections
    parameters: tuple[Parameter, ...]
    sessions: tuple[str, ...]
    runs: int
    movements: int
    used_readings: bool
    left_out: tuple[LeftOut, ...] = ()
    held_out: tuple[HeldOut, ...] = ()
    remarks: tuple[str, ...] = ()
    loops: tuple[CalibratedLoop, ...] = ()
    frame: SensorFrame | None = None
    moments: int = 0

    @property
    def extent(self) -> str:
        """From how many movements, moments on the way and runs it was learned, in words."""
        rests, seen = self.movements - self.moments, list[str]()
        if rests or not self.moments:
            seen.append(counted(rests, "settled movement"))
        if self.moments:
            seen.append(f"{counted(self.moments, 'moment')} on the way")
        return f"{' and '.join(seen)} of {counted(self.runs, 'run')}"

    def applied_to(self, robot: Robot) -> CalibratedRobot:
        """Return a robot with these loops, frame and imperfections, as from the file of this.

        Raises:
            InputError: If the calibration names a motor that the robot does not have.
        """
        known = with_loops(robot, self.loops).seen_from(self.frame)
        return CalibratedRobot(known, self.imperfections)

    @property
    def beats_uncalibrated(self) -> bool | None:
        """Whether unseen sessions say that this is better than no calibration; None: no say."""
        if not self.held_out:
            return None
        gain, error = mean_gain(self.held_out)
        return gain - error > 0.0


# Calibrations as TOML files: the imperfections, which the twin reads, and how they were found.

ORIGIN = ("robot", "failuretwin_version")
"""Keys of the file's table beside the fields of `Calibration`: what it is of and who wrote it."""


def save_calibration(calibration: Calibration, robot: Robot, path: str | Path) -> None:
    """Write a calibration as TOML; a file of that name is replaced at the end, all at once.

    Raises:
        OutputError: If it cannot be written; the old file is as before.
    """
    write_text(calibration_text(calibration, robot), Path(path))


def calibration_text(calibration: Calibration, robot: Robot) -> str:
    """Return a calibration as TOML, the text of its file."""
    import tomli_w

    record = _plain(calibration)
    table = record.pop("imperfections")
    origin = dict(zip(ORIGIN, (robot.name, __version__), strict=True))
    return (
        "# What a healthy robot does that its twin does not, learned from its logs: [calibration]\n"
        "# says how. Angles in rad in the sense of the logs, times in s.\n"
        f"{tomli_w.dumps({**table, CALIBRATION_TABLE: {**origin, **record}})}"
    )


def check_calibration_file(path: Path, robot: Robot, name: str) -> None:
    """Raise an error unless a calibration can be written to `path`: worth asking before work.

    It only replaces a calibration of the same robot that has the same name.
    """
    if path.suffix != ".toml":
        raise InputError(f"{path}: a calibration ends in .toml.")
    check_writable(path)
    if not path.exists():
        return
    table = read_toml(path)
    record = table.get(CALIBRATION_TABLE, {})
    of = record.get("robot", "") if isinstance(record, dict) else ""
    if of not in ("", robot.name) or table.get("name") != name:
        raise OutputError(
            f"{path}: holds calibration {table.get('name', '')!r} of robot {of!r}, expected "
            f"{name!r} of {robot.name!r}, or no file. Choose another --out; if it is the same "
            "robot, remove the file first."
        )


def _plain(value: Any) -> Any:
    """Return a dataclass as TOML values: no None, lists for tuples, numbers with few digits."""
    if is_dataclass(value) and not isinstance(value, type):
        named = {field.name: getattr(value, field.name) for field in fields(value)}
        return {name: _plain(item) for name, item in named.items() if item is not None}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.6g}")
    return value
