"""A calibrated robot: its own servo loops, and its differences from the twin.

A calibration file holds imperfections, whose timing adds to the servo loops, and may hold those
loops. They only describe a robot together, so both are read here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from failuretwin.core.config import Bounded, from_table, read_toml
from failuretwin.core.errors import InputError, unknown_name
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.geometry import SensorFrame
from failuretwin.digital_model.nonidealities import (
    NO_IMPERFECTIONS,
    SETTLING_LISTS,
    Imperfections,
)
from failuretwin.digital_model.profile import Motor, SpeedLimit
from failuretwin.digital_model.robot import Robot, load_robot
from failuretwin.digital_model.servo import ServoLoop
from failuretwin.digital_model.settling import Settling, largest_load
from failuretwin.digital_model.twin import DigitalTwin

CALIBRATION_TABLE = "calibration"
"""Table of a calibration file with robot, servo loops and sensor frame."""


@dataclass(frozen=True)
class CalibratedLoop(Bounded):
    """Servo loop of a motor from its step tests.

    Attributes:
        motor: Its name.
        P: Proportional gain [-].
        I: Integral gain [1/s].
        filter_s: Time constant of the input filter [s].
        speed_limit: Largest speed [rad/s].
    """

    motor: str
    P: float
    I: float  # noqa: E741 - the field's name for an integral gain
    filter_s: float
    speed_limit: SpeedLimit

    def __post_init__(self) -> None:
        super().__post_init__()
        ServoLoop(self.P, self.I, self.filter_s)  # checks the gains

    def of(self, motor: Motor) -> Motor:
        """Return a motor with this loop and speed limit."""
        loop = ServoLoop(self.P, self.I, self.filter_s)
        return replace(motor, loop=loop, speed_limit=self.speed_limit)


@dataclass(frozen=True)
class CalibratedRobot:
    """A robot with calibrated servo loops, and its differences from their twin.

    Attributes:
        robot: The robot; motors without a calibrated loop keep the profile's.
        imperfections: Differences from the twin; their timing adds to these loops. They carry the
            name and protocol of the calibration.
    """

    robot: Robot
    imperfections: Imperfections

    @property
    def twin(self) -> DigitalTwin:
        """Digital twin with the calibrated servo loops."""
        return DigitalTwin(self.robot)


@runtime_checkable
class Learned(Protocol):
    """Result of a calibration."""

    def applied_to(self, robot: Robot) -> CalibratedRobot:
        """Return the calibrated robot."""


RobotLike = DigitalTwin | CalibratedRobot | Robot | str | Path
"""A robot in any form: a twin, a calibrated robot, a bundled name or a profile."""
HealthyLike = Imperfections | Learned | str | Path | None
"""Healthy behaviour: values, a calibration, its name or path; None: by the robot's profile."""


def calibrated(robot: RobotLike, healthy: HealthyLike = None) -> CalibratedRobot:
    """Return a robot with its healthy behaviour.

    A `CalibratedRobot` is returned unchanged where nothing is said of its healthy behaviour.
    """
    if isinstance(robot, CalibratedRobot) and healthy is None:
        return robot
    model = robot.robot if isinstance(robot, DigitalTwin | CalibratedRobot) else load_robot(robot)
    if isinstance(healthy, Imperfections):
        return CalibratedRobot(model, healthy)
    if isinstance(healthy, Learned):
        return healthy.applied_to(model)
    return load_calibration(healthy, model)


def with_loops(robot: Robot, loops: Sequence[CalibratedLoop]) -> Robot:
    """Return a robot with other servo loops and speed limits for some of its motors."""
    found = {loop.motor: loop for loop in loops}
    for name in found:
        if name not in robot.motor_names:
            raise unknown_name("motor", name, robot.motor_names)
    if not found:
        return robot
    motors = tuple(found[m.name].of(m) if m.name in found else m for m in robot.motors)
    return replace(robot, profile=replace(robot.profile, motors=motors))


GENERIC = "generic"
"""Name of the prior of the arm's class, whatever its profile names."""


def load_calibration(
    name_or_path: str | Path | None, robot: Robot | str | Path = "armpi_fpv"
) -> CalibratedRobot:
    """Load a calibration, or imperfections written by hand.

    Args:
        name_or_path: ``none``; ``generic`` for the prior of the arm's class; the name of `robot`
            for the calibration of its profile, the name of another file in that folder, or a TOML
            file. None: the calibration of its profile, ``generic`` if it names none.
        robot: The robot, its name or its profile.

    Raises:
        InputError: If there is no such calibration, or it belongs to another robot or does not fit
            its motors.
    """
    robot = load_robot(robot)
    if str(name_or_path) == GENERIC or (name_or_path is None and robot.imperfections_file is None):
        return CalibratedRobot(robot, generic_imperfections(robot))
    if str(name_or_path) == "none":
        return CalibratedRobot(robot, NO_IMPERFECTIONS)
    path = _file_of(str(name_or_path or robot.name), robot)
    return calibration_from_table(read_toml(path), robot, path)


def calibration_from_table(
    table: dict[str, Any], robot: Robot, path: Path | str
) -> CalibratedRobot:
    """Return a robot with the calibration of a TOML table."""
    table = dict(table)
    record = _record(table.pop(CALIBRATION_TABLE, {}), path)
    if record.robot not in ("", robot.name):
        raise InputError(
            f"{path}: is a calibration of robot {record.robot!r}, not of {robot.name!r}. Name the "
            "right robot (--robot) or calibrate this one."
        )
    imperfections = _completed(from_table(Imperfections, table, str(path)), len(robot.motors))
    check_fit(imperfections, robot, path)
    _check_sane(imperfections.settling, robot, path)
    return CalibratedRobot(record.applied_to(robot), imperfections)


def _file_of(name_or_path: str, robot: Robot) -> Path:
    """Return the file of a name (the profile's or one in its folder) or a path."""
    path, own = Path(name_or_path), robot.imperfections_file
    known = {}
    if own is not None:
        known = {robot.name: own} | {p.stem: p for p in sorted(own.parent.glob("*.toml"))}
    if name_or_path in known:
        return known[name_or_path]
    if path.suffix != ".toml" and not path.exists():
        names = ", ".join(repr(name) for name in ("none", GENERIC, *known))
        raise InputError(
            f"no imperfections {name_or_path!r} of robot {robot.name!r}. Expected {names} or a "
            "TOML file, such as `failuretwin calibrate` writes."
        )
    return path


def _completed(imperfections: Imperfections, motors: int) -> Imperfections:
    """Return the imperfections with zeros for missing lists of the settling."""
    settling = imperfections.settling
    if settling is None:
        return imperfections
    whole: dict[str, Any] = {
        name: getattr(settling, name) or (0.0,) * motors for name in SETTLING_LISTS
    }
    return replace(imperfections, settling=replace(settling, **whole))


LARGEST_ERROR, LARGEST_PLAY = 1.0 / 8.0, 1.0 / 24.0
"""Largest error of a healthy motor as a share of its travel, such as 20 of 160 deg, and largest
friction and scatter, such as 7 deg: assumed, ten times that of hobby servos. Far beyond it a
healthy motor is indistinguishable from a stuck one."""


def _check_sane(settling: Settling | None, robot: Robot, path: Path | str) -> None:
    """Raise InputError unless the settled errors of a file are those of a healthy robot."""
    if settling is None:
        return
    travel = np.diff(robot.travel, axis=1)[:, 0]
    sag = np.asarray(settling.compliance) * largest_load(robot, settling.payload)
    errors = {name: np.asarray(getattr(settling, name)) for name in ("bias", "friction", "scatter")}
    for name, values in (errors | {"compliance times the largest load": sag}).items():
        share = LARGEST_PLAY if name in ("friction", "scatter") else LARGEST_ERROR
        limit = share * travel
        for k in np.flatnonzero(~(np.abs(values) <= limit)):
            raise InputError(
                f"{path}: settling: {name} of {robot.motor_names[k]!r} is {values[k]:.3g}, "
                f"expected {limit[k]:.3g} at most, {share:.1%} of where the motor may stand "
                f"({robot.travel[k, 0]:.3g} to {robot.travel[k, 1]:.3g}, by the travel of its "
                "profile or the limits of its joint). Check the unit (rad, or m where it slides), "
                "or calibrate again."
            )


@dataclass(frozen=True)
class _Record:
    """Parts of the calibration's own table that change the robot."""

    robot: str = ""
    loops: tuple[CalibratedLoop, ...] = ()
    frame: SensorFrame | None = None

    def applied_to(self, robot: Robot) -> Robot:
        """Return a robot with the calibrated loops and sensor frame."""
        with_own = with_loops(robot, self.loops)
        return with_own.seen_from(self.frame)


def _record(table: object, path: Path | str) -> _Record:
    if not isinstance(table, dict):
        raise InputError(f"{path}: {CALIBRATION_TABLE} is {table!r}, expected a table.")
    known = {name: table[name] for name in ("robot", "loops", "frame") if name in table}
    return from_table(_Record, known, f"{path}: {CALIBRATION_TABLE}")


def check_fit(imperfections: Imperfections, robot: Robot, where: Path | str) -> None:
    """Raise InputError unless imperfections fit the robot's motors; `where` names their file."""
    count = len(robot.motors)
    lists = [(t, name) for t in ("settling", "variation") for name in SETTLING_LISTS]
    for table, name in [*lists, ("readings", "glitch_rate")]:
        values = getattr(getattr(imperfections, table), name, ())
        if len(values) not in (0, count):
            raise InputError(
                f"{where}: {table}: {name} has {len(values)} values, expected {count}, one for "
                f"each motor of {robot.name!r}."
            )
    for motor in (motor for lost in imperfections.lost_commands for motor in lost.motors):
        if motor not in robot.motor_names:
            raise InputError(
                f"{where}: lost_commands: {unknown_name('motor', motor, robot.motor_names)}"
            )
