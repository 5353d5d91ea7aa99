"""A robot: the kinematics of its URDF and what its profile says of its motors."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from string import Template

import numpy as np

from failuretwin.core.config import from_table, read_toml
from failuretwin.core.errors import InputError, unknown_name
from failuretwin.core.types import FloatArray, ServoUnits, frozen_array
from failuretwin.digital_model.kinematics import (
    CANNOT_MOVE,
    Loads,
    SerialChain,
    has_range,
    levers,
)
from failuretwin.digital_model.servo import ServoLoop
from failuretwin.digital_model.urdf import UrdfJoint, read_urdf
from failuretwin.digital_model.urdf_check import JointReport, UrdfReport

POSES = ("log", "physical")


@dataclass(frozen=True)
class Motor:
    """One motor that can move the tool point.

    Attributes:
        name: Name in run sets and hypotheses, such as ``motor_1``.
        joint: Name of the URDF joint that it turns.
        loop: Its closed position loop.
        speed_limit: Largest speed [rad/s].
        movement_range: Lowest and highest target of random movements [rad].
        sense: Physical angle = sense * angle in commands and logs; +1 or -1.
        log_column: Column of raw logs that belongs to it.
    """

    name: str
    joint: str
    loop: ServoLoop
    speed_limit: float
    movement_range: tuple[float, float]
    sense: float = 1.0
    log_column: str = ""

    def __post_init__(self) -> None:
        if self.sense not in (1.0, -1.0):
            raise InputError(f"motor {self.name!r}: sense is {self.sense}, expected 1 or -1.")
        if not self.movement_range[0] < self.movement_range[1]:
            raise InputError(
                f"motor {self.name!r}: movement_range is {list(self.movement_range)}, expected the "
                "lowest and the highest target [rad]."
            )
        if set(self.name) & set(":+,") or not self.name:
            raise InputError(
                f"motor name {self.name!r} cannot stand in hypotheses. Leave out ':', '+', ','."
            )


@dataclass(frozen=True)
class Profile:
    """What a TOML profile says beside the URDF.

    Attributes:
        name: Name of the robot.
        urdf: URDF file, relative to the profile.
        base_link: Link that carries the base frame.
        tool_link: Link whose origin is the tool point.
        motors: Motors that can move the tool point, in chain order.
        sensor_pose: Which angles the tool sensor's path belongs to: ``log`` (a virtual sensor
            that applies the kinematics to angles in the log's sense) or ``physical``.
        servo_units: Count scale of commands and readings in raw logs, if they use one.
        imperfections: Imperfections of the healthy robot, a TOML file relative to the profile.
        physics: Motors and gears for the physics engine, a TOML file relative to the profile.
        inference: Lengths and angles by which its runs are read, where they are not the usual
            ones; see `InferenceSettings`.
        sources: Where each group of numbers comes from.
    """

    name: str
    urdf: str
    base_link: str
    tool_link: str
    motors: tuple[Motor, ...]
    sensor_pose: str = "physical"
    servo_units: ServoUnits | None = None
    imperfections: str | None = None
    physics: str | None = None
    inference: dict[str, float] = field(default_factory=dict)
    sources: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.sensor_pose not in POSES:
            raise unknown_name("sensor_pose", self.sensor_pose, POSES)
        if not self.motors:
            raise InputError(f"profile {self.name!r} has no motors. Expected at least one.")


@dataclass(frozen=True)
class Robot:
    """A robot that can be simulated and diagnosed.

    Attributes:
        profile: Its profile.
        chain: Its kinematics; one joint for each motor.
        loads: What its motors carry.
        folder: Where the profile lies.
    """

    profile: Profile
    chain: SerialChain
    loads: Loads
    folder: Path

    @property
    def name(self) -> str:
        """Name of the robot."""
        return self.profile.name

    @property
    def motors(self) -> tuple[Motor, ...]:
        """Motors that can move the tool point, in chain order."""
        return self.profile.motors

    @property
    def motor_names(self) -> list[str]:
        """Names of the motors in chain order."""
        return [motor.name for motor in self.motors]

    @cached_property
    def sense(self) -> FloatArray:
        """Physical angle = sense * angle in the log, (motor,)."""
        return frozen_array([motor.sense for motor in self.motors])

    @cached_property
    def sensor_sense(self) -> FloatArray:
        """Sense of the pose that the tool sensor's path belongs to, (motor,)."""
        log = self.profile.sensor_pose == "log"
        return frozen_array(np.ones(len(self.motors)) if log else self.sense)

    @property
    def servo_units(self) -> ServoUnits:
        """Count scale of raw logs.

        Raises:
            InputError: If the profile has none.
        """
        if self.profile.servo_units is None:
            raise InputError(
                f"robot {self.name!r} has no servo units. Add a [servo_units] table to its profile."
            )
        return self.profile.servo_units

    @property
    def urdf_file(self) -> Path:
        """The URDF."""
        return self.folder / self.profile.urdf

    @property
    def imperfections_file(self) -> Path | None:
        """File with the imperfections of the healthy robot, if the profile names one."""
        return self._beside(self.profile.imperfections)

    @property
    def physics_file(self) -> Path | None:
        """File with motors and gears for the physics engine, if the profile names one."""
        return self._beside(self.profile.physics)

    def _beside(self, name: str | None) -> Path | None:
        return None if name is None else self.folder / name


def bundled_folder() -> Path:
    """Return the folder of the robots that come with the package."""
    return Path(str(files("failuretwin.digital_model") / "robots"))


def bundled_robots() -> list[str]:
    """Return the names of the robots that come with the package."""
    return sorted(path.stem for path in bundled_folder().glob("*.toml"))


def load_robot(name_or_path: str | Path | Robot) -> Robot:
    """Load a bundled robot by name, or any robot by the path of its TOML profile.

    A robot that is loaded already is returned as it is.

    Raises:
        InputError: If there is no such robot or its profile or URDF cannot be used.
    """
    if isinstance(name_or_path, Robot):
        return name_or_path
    path = Path(name_or_path)
    if path.suffix != ".toml":
        if str(name_or_path) not in bundled_robots():
            error = unknown_name("robot", str(name_or_path), bundled_robots())
            raise InputError(f"{error} Or give the path of a profile that ends in .toml.")
        path = bundled_folder() / f"{name_or_path}.toml"
    profile = from_table(Profile, read_toml(path), str(path))
    _check_unique([motor.name for motor in profile.motors], "motor name", path)
    joints = [motor.joint for motor in profile.motors]
    _check_unique(joints, "joint", path)
    urdf = read_urdf(path.parent / profile.urdf)
    chain = urdf.chain(profile.base_link, profile.tool_link, joints)
    order = [joint.name for joint in chain.joints]
    if joints != order:
        raise InputError(
            f"{path}: motors are listed for joints {', '.join(joints)}; from base to tool the "
            f"order is {', '.join(order)}. List the motors in that order."
        )
    for motor, lever in zip(profile.motors, levers(chain), strict=True):
        if lever < CANNOT_MOVE:
            raise InputError(
                f"{path}: motor {motor.name!r} ({motor.joint}) cannot move the tool point, so no "
                "tool path can tell of it. Leave it out, or choose another tool_link."
            )
    return Robot(profile, chain, urdf.loads(profile.base_link, chain), path.parent)


def _check_unique(names: Sequence[str], kind: str, path: Path) -> None:
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{path}: {kind} {name!r} is used twice. Give each motor its own.")


def shown_unit(unit: str, robot: Robot) -> tuple[float, str]:
    """Return factor and name of the unit that people read: servo counts or degrees for angles."""
    if not unit.startswith("rad"):
        return 1.0, unit
    if robot.profile.servo_units is not None:
        return 1.0 / abs(robot.servo_units.rad_per_count), unit.replace("rad", "counts", 1)
    return float(np.rad2deg(1.0)), unit.replace("rad", "deg", 1)


# A commented robot profile, written from what a URDF states and plain assumptions elsewhere.

PROFILE_TEMPLATE = "profile.template"
"""A profile with $placeholders, the last table being that of one motor. Its gains are near those
published for the bus servos of the ArmPi FPV."""

ASSUMED_SPEED = math.pi
"""Speed limit where the URDF states none [rad/s or m/s]."""

WIDEST_RAD = math.pi / 2
"""Farthest target of random movements from the middle of the range [rad]."""

WIDEST_M = 0.1
"""The same for a joint that slides [m]."""

LONGEST_RAMP_S = 1.0
"""Time in which the speed limit must allow the longest travel: half of a movement [s]."""


def profile_text(report: UrdfReport, profile: Path) -> str:
    """Return a TOML profile for the robot of a URDF.

    Args:
        report: The URDF, looked over without errors.
        profile: Where the profile will lie; it names the URDF relative to its own folder.

    Raises:
        InputError: If the report holds an error.
    """
    report.raise_errors()
    template = (bundled_folder() / PROFILE_TEMPLATE).read_text(encoding="utf-8")
    head, start, motor = template.partition("[[motors]]")
    speeds = [m.motor or "" for m in report.motors if m.joint.velocity is None]
    ranges = [m.motor or "" for m in report.motors if not has_range(m.joint.low, m.joint.high)]
    common = Template(head).substitute(
        name=_quote(report.name or report.source.stem),
        urdf=_quote(_relative(report.source, profile.parent)),
        base=_quote(report.base_link),
        tool=_quote(report.tool_link),
        unmoved=_unmoved(report.others),
        speeds=_quote(_origin("URDF", speeds)),
        ranges=_quote(_origin("URDF limits, narrowed to keep plateaus", ranges)),
    )
    return common + "\n".join(_motor(start + motor, one) for one in report.motors)


def _motor(template: str, report: JointReport) -> str:
    joint = report.joint
    low, high, range_note = movement_range(joint)
    return Template(template).substitute(
        name=_quote(report.motor or ""),
        joint=_quote(joint.name),
        unit="m" if joint.type == "prismatic" else "rad",
        speed=speed_limit(joint),
        speed_note="Assumed." if joint.velocity is None else "From the URDF.",
        low=low,
        high=high,
        range_note=range_note,
    )


def _unmoved(others: Sequence[JointReport]) -> str:
    if not others:
        return "\n# Every joint of the file can move the tool point, so each has a motor below.\n"
    reasons = ((_quote(other.joint.name), " ".join(other.reason.split())) for other in others)
    lines = [f"#   {name}: {reason}" for name, reason in reasons]
    head = "# Joints without a motor below, since they cannot move the tool point:"
    return "\n".join(["", head, *lines, ""])


def _origin(stated: str, assumed: Sequence[str]) -> str:
    return f"{stated}; assumed for {', '.join(assumed)}" if assumed else stated


def speed_limit(joint: UrdfJoint) -> float:
    """Return the speed limit of the URDF [rad/s or m/s], an assumed one where it has none."""
    return ASSUMED_SPEED if joint.velocity is None else joint.velocity


def movement_range(joint: UrdfJoint) -> tuple[float, float, str]:
    """Return the lowest and the highest target [rad or m] and a sentence on where they are from.

    Targets far apart leave no time at rest within a movement, so the limits are narrowed about
    their middle.
    """
    widest = WIDEST_M if joint.type == "prismatic" else WIDEST_RAD
    half = min(widest, speed_limit(joint) * LONGEST_RAMP_S / 2.0)
    if not has_range(joint.low, joint.high):
        return -half, half, "Assumed: the URDF has no limits."
    if joint.high - joint.low <= 2.0 * half:
        return joint.low, joint.high, "The limits of the URDF."
    middle = (joint.low + joint.high) / 2.0
    limits = f"{joint.low:.6g} to {joint.high:.6g}"
    note = f"Limits of the URDF ({limits}) narrowed so that a movement keeps time at rest."
    return middle - half, middle + half, note


def _relative(target: Path, folder: Path) -> str:
    """Return the way from `folder` to the file `target` with forward slashes."""
    try:
        way = os.path.relpath(target.resolve(), folder.resolve())
    except ValueError:  # another drive
        way = str(target.resolve())
    return Path(way).as_posix()


def _quote(text: str) -> str:
    """Return `text` as a TOML string; its escapes are those of JSON."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
