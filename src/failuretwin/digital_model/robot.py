"""A robot: the kinematics of its URDF and what its profile says of its motors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from importlib.resources import files
from pathlib import Path

import numpy as np

from failuretwin.core.config import from_table, read_toml
from failuretwin.core.errors import InputError, unknown_name
from failuretwin.core.types import FloatArray, frozen_array
from failuretwin.core.units import ServoUnits
from failuretwin.digital_model.chain import SerialChain
from failuretwin.digital_model.loads import Loads, loads_of
from failuretwin.digital_model.mobility import CANNOT_MOVE, levers
from failuretwin.digital_model.servo import ServoLoop
from failuretwin.digital_model.urdf import read_root, read_urdf
from failuretwin.digital_model.urdf_links import read_links

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
        name = self.profile.imperfections
        return None if name is None else self.folder / name

    @property
    def physics_file(self) -> Path | None:
        """File with motors and gears for the physics engine, if the profile names one."""
        name = self.profile.physics
        return None if name is None else self.folder / name


def bundled_folder() -> Path:
    """Return the folder of the robots that come with the package."""
    return Path(str(files("failuretwin.digital_model") / "robots"))


def bundled_robots() -> list[str]:
    """Return the names of the robots that come with the package."""
    return sorted(path.stem for path in bundled_folder().glob("*.toml"))


def load_robot(name_or_path: str | Path) -> Robot:
    """Load a bundled robot by name, or any robot by the path of its TOML profile.

    Raises:
        InputError: If there is no such robot or its profile or URDF cannot be used.
    """
    return _load_profile(_find_profile(name_or_path))


def _find_profile(name_or_path: str | Path) -> Path:
    path = Path(name_or_path)
    if path.suffix == ".toml":
        return path
    if str(name_or_path) not in bundled_robots():
        error = unknown_name("robot", str(name_or_path), bundled_robots())
        raise InputError(f"{error} Or give the path of a profile that ends in .toml.")
    return bundled_folder() / f"{name_or_path}.toml"


def _load_profile(path: Path) -> Robot:
    profile = from_table(Profile, read_toml(path), str(path))
    _check_unique([motor.name for motor in profile.motors], "motor name", path)
    joints = [motor.joint for motor in profile.motors]
    _check_unique(joints, "joint", path)
    urdf_file = path.parent / profile.urdf
    urdf = read_urdf(urdf_file)
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
    links = read_links(read_root(urdf_file))
    return Robot(profile, chain, loads_of(urdf, links, profile.base_link, chain), path.parent)


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
