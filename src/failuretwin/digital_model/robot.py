"""A robot: the kinematics of its URDF and what its profile says of its motors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from typing import Annotated

import numpy as np

from failuretwin.core.config import Bounded, Bounds, from_table, read_toml
from failuretwin.core.errors import InputError, unknown_name
from failuretwin.core.types import BoolArray, FloatArray, ServoUnits, frozen_array
from failuretwin.digital_model.geometry import (
    AS_STATED,
    NO_OFFSET,
    NOT_MOVED,
    Geometry,
    Pose,
    SensorFrame,
    seen_chain,
    with_tool,
)
from failuretwin.digital_model.kinematics import (
    CANNOT_MOVE,
    Loads,
    SerialChain,
    has_range,
    idle_axes,
    levers,
)
from failuretwin.digital_model.sensor_profile import SensorProfile
from failuretwin.digital_model.servo import ServoLoop
from failuretwin.digital_model.urdf import Triple, read_urdf

POSES = ("log", "physical")


FASTEST = 1e3
"""Largest speed limit that makes sense [rad/s or m/s]."""
FARTHEST = 1e3
"""Largest target, and farthest place of a tool [rad or m]."""
SpeedLimit = Annotated[float, Bounds(1e-6, FASTEST)]
Angles = Annotated[tuple[float, float], Bounds(-FARTHEST, FARTHEST, in_order=True)]


@dataclass(frozen=True)
class Motor(Bounded):
    """One motor that can move the tool point.

    Attributes:
        name: Name in run sets and hypotheses, such as ``motor_1``.
        joint: Name of the URDF joint that it turns.
        loop: Its closed position loop.
        speed_limit: Largest speed [rad/s].
        movement_range: Lowest and highest target of random movements [rad].
        travel: Lowest and highest angle that it may stand at [rad]; None: the limits of its joint.
        sense: Physical angle = sense * angle in commands and logs; +1 or -1.
        log_column: Column of raw logs that belongs to it.
        home: Angle at rest, round which random movements keep where the limits are wide [rad];
            None: the middle of the limits.
    """

    name: str
    joint: str
    loop: ServoLoop
    speed_limit: SpeedLimit
    movement_range: Angles
    travel: tuple[float, float] | None = None
    sense: float = 1.0
    log_column: str = ""
    home: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sense not in (1.0, -1.0):
            raise InputError(f"motor {self.name!r}: sense is {self.sense}, expected 1 or -1.")
        ranges = {"movement_range": self.movement_range, "travel": self.travel}
        for name, ends in ranges.items():
            if ends is not None and not -FARTHEST <= ends[0] < ends[1] <= FARTHEST:
                raise InputError(
                    f"motor {self.name!r}: {name} is {list(ends)}, expected the lowest and the "
                    "highest angle [rad]."
                )
        if self.home is not None and not abs(self.home) <= FARTHEST:
            raise InputError(
                f"motor {self.name!r}: home is {self.home:g}, expected an angle [rad]."
            )
        if set(self.name) & set(":+,") or not self.name:
            raise InputError(
                f"motor name {self.name!r} cannot stand in hypotheses. Leave out ':', '+', ','."
            )


Place = Annotated[Triple, Bounds(-FARTHEST, FARTHEST)]


@dataclass(frozen=True)
class Profile(Bounded):
    """What a TOML profile says beside the URDF.

    Attributes:
        name: Name of the robot.
        urdf: URDF file, relative to the profile.
        base_link: Link that carries the base frame.
        tool_link: Link that carries the tool point.
        motors: Motors that can move the tool point, in chain order.
        tool_xyz: The tool point, in the frame of the tool link [m].
        base_xyz_rpy: Pose of the base link in the frame of the tool positions that the sensor
            tells; see `failuretwin.digital_model.geometry`.
        geometry: How the arm differs from its URDF, and the sensor from a true one.
        sensor_pose: Which angles the tool sensor's path belongs to: ``log`` (a virtual sensor
            that applies the kinematics to angles in the log's sense) or ``physical``.
        servo_units: Count scale of commands and readings in raw logs, if they use one.
        imperfections: Imperfections of the healthy robot, a TOML file relative to the profile.
        physics: Motors and gears for the physics engine, a TOML file relative to the profile.
        inference: Lengths and angles by which its runs are read, where they are not the usual
            ones; see `InferenceSettings`.
        arm_class: What kind of arm it is, for what is believed of it before it is calibrated; see
            `failuretwin.digital_model.arm_classes`. Empty: by its reach.
        sources: Where each group of numbers comes from.
        sensors: Sensors beside that of the tool's position, where they are not as usual.
    """

    name: str
    urdf: str
    base_link: str
    tool_link: str
    motors: tuple[Motor, ...]
    tool_xyz: Place = NO_OFFSET
    base_xyz_rpy: Annotated[Pose, Bounds(-FARTHEST, FARTHEST)] = NOT_MOVED
    geometry: Geometry = AS_STATED
    sensor_pose: str = "physical"
    servo_units: ServoUnits | None = None
    imperfections: str | None = None
    physics: str | None = None
    inference: dict[str, float] = field(default_factory=dict)
    arm_class: str = ""
    sources: dict[str, str] = field(default_factory=dict)
    sensors: tuple[SensorProfile, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sensor_pose not in POSES:
            raise unknown_name("sensor_pose", self.sensor_pose, POSES)
        if not self.motors:
            raise InputError(f"profile {self.name!r} has no motors. Expected at least one.")


@dataclass(frozen=True)
class Robot:
    """A robot that can be simulated and diagnosed.

    Attributes:
        profile: Its profile.
        chain: Its kinematics as the tool sensor sees it, in the sensor's frame; one joint for each
            motor.
        loads: What its motors carry; their chain is in the frame of the base link.
        source: The file of its profile.
        frame: Where the sensor was found to stand beside the profile; None: where that says.
    """

    profile: Profile
    chain: SerialChain
    loads: Loads
    source: Path
    frame: SensorFrame | None = None

    def seen_from(self, frame: SensorFrame | None) -> Robot:
        """Return the robot as a sensor sees it that stands there; None: where the profile says.

        With joints that slide, the scale is left out.
        """
        if frame == self.frame:
            return self
        geometry = self.profile.geometry
        chain = seen_chain(self.loads.chain, self.profile.base_xyz_rpy, geometry.sensor_scale)
        if frame is not None:
            chain = seen_chain(chain, frame.xyz_rpy, self._scale_in(frame))
        return replace(self, chain=chain, frame=frame)

    @property
    def sensor_scale(self) -> float:
        """Length that the sensor reports for a metre of the arm [-]."""
        return self.profile.geometry.sensor_scale * self._scale_in(self.frame)

    def _scale_in(self, frame: SensorFrame | None) -> float:
        return 1.0 if frame is None or self.slides.any() else frame.scale

    @property
    def folder(self) -> Path:
        """Where the profile lies."""
        return self.source.parent

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

    @cached_property
    def limits(self) -> FloatArray:
        """Limits of the joints in the sense of commands, (motor, low | high) [rad or m].

        Infinite where the URDF has none.
        """
        ends = np.array([(joint.low, joint.high) for joint in self.chain.joints])
        known = [has_range(low, high) for low, high in ends.tolist()]
        ends[~np.array(known)] = -np.inf, np.inf
        return frozen_array(np.sort(ends * self.sense[:, None], axis=1))

    @cached_property
    def travel(self) -> FloatArray:
        """Where each motor may stand, (motor, low | high) [rad or m].

        What its profile says; else the limits of its joint, of one that turns no more than a full
        turn about the middle of its movements, for angles a turn apart are one to the tool.
        """
        found = np.array([self._travel_of(k) for k in range(len(self.motors))])
        return frozen_array(found)

    def _travel_of(self, k: int) -> tuple[float, float]:
        motor, (low, high) = self.motors[k], self.limits[k].tolist()
        if motor.travel is not None:
            return motor.travel
        if self.slides[k]:
            return (low, high) if math.isfinite(high - low) else motor.movement_range
        if high - low <= 2.0 * math.pi:
            return low, high
        middle = 0.5 * sum(motor.movement_range)
        return max(low, middle - math.pi), min(high, middle + math.pi)

    @cached_property
    def slides(self) -> BoolArray:
        """Which motors slide [m] instead of turning [rad], (motor,)."""
        return np.array([joint.prismatic for joint in self.chain.joints])

    def own_unit(self, motor: str, unit: str) -> str:
        """Return the unit of a magnitude at a motor: in metres where it slides, not in radians."""
        if not unit.startswith("rad"):
            return unit
        slides = self.slides[self.motor_names.index(motor)]
        return unit.replace("rad", "m", 1) if slides else unit

    @cached_property
    def resting_pose(self) -> FloatArray:
        """Where an arm stands that is not asked, taken as near 0 as it moves, (motor,) [rad]."""
        return np.array([float(np.clip(0.0, *motor.movement_range)) for motor in self.motors])

    @cached_property
    def idle_axes(self) -> tuple[bool, bool, bool]:
        """Axes of the tool's position along which no motor moves it."""
        return idle_axes(self.chain)

    @cached_property
    def reach(self) -> float:
        """How far the tool can be from the base at most [m]: links and slides laid end to end."""
        chain = self.loads.chain
        links = sum(float(np.linalg.norm(joint.T_pj[:3, 3])) for joint in chain.joints)
        slides = sum(
            max(abs(end) for end in motor.movement_range)
            for motor, slides in zip(self.motors, self.slides, strict=True)
            if slides
        )
        return links + slides + float(np.linalg.norm(chain.T_jt[:3, 3]))

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
            if path.suffix == ".urdf":
                raise InputError(
                    f"{path}: is a URDF; a robot is named by its profile. Make one: "
                    f"failuretwin robot init {path} --out {path.stem}.toml, then --robot "
                    f"{path.stem}.toml."
                )
            error = unknown_name("robot", str(name_or_path), bundled_robots())
            raise InputError(f"{error} Or give the path of a profile that ends in .toml.")
        path = bundled_folder() / f"{name_or_path}.toml"
    profile = from_table(Profile, read_toml(path), str(path))
    _check_unique([motor.name for motor in profile.motors], "motor name", path)
    joints = [motor.joint for motor in profile.motors]
    _check_unique(joints, "joint", path)
    return _assembled(profile, path)


def _assembled(profile: Profile, path: Path) -> Robot:
    """Return the robot of a profile that lies at `path`."""
    urdf = profile.geometry.apply(read_urdf(path.parent / profile.urdf))
    joints = [motor.joint for motor in profile.motors]
    chain = urdf.chain(profile.base_link, profile.tool_link, joints)
    order = [joint.name for joint in chain.joints]
    if joints != order:
        raise InputError(
            f"{path}: motors are listed for joints {', '.join(joints)}; from base to tool the "
            f"order is {', '.join(order)}. List the motors in that order."
        )
    chain = with_tool(chain, profile.tool_xyz)
    for motor, lever in zip(profile.motors, levers(chain), strict=True):
        if lever < CANNOT_MOVE:
            raise InputError(
                f"{path}: motor {motor.name!r} ({motor.joint}) cannot move the tool point, so no "
                "tool path can tell of it. Leave it out, or choose another tool_link."
            )
    scale = profile.geometry.sensor_scale
    if scale != 1.0 and any(joint.prismatic for joint in chain.joints):
        raise InputError(
            f"{path}: geometry: sensor_scale is {scale:g}, expected 1 for an arm with a joint that "
            "slides. Put the scale into the unit of the logs."
        )
    seen = seen_chain(chain, profile.base_xyz_rpy, scale)
    return Robot(profile, seen, urdf.loads(profile.base_link, chain), path)


def _check_unique(names: Sequence[str], kind: str, path: Path) -> None:
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{path}: {kind} {name!r} is used twice. Give each motor its own.")


def shown_unit(unit: str, robot: Robot, motor: str = "") -> tuple[float, str]:
    """Return factor and name of the unit that people read: servo counts or degrees for angles.

    Args:
        unit: That of the figure; angles in radians.
        robot: The robot.
        motor: The motor that the figure is of; of one that slides, millimetres.
    """
    if motor and robot.own_unit(motor, unit) != unit:
        return 1e3, unit.replace("rad", "mm", 1)
    if not unit.startswith("rad"):
        return 1.0, unit
    if robot.profile.servo_units is not None:
        return 1.0 / abs(robot.servo_units.rad_per_count), unit.replace("rad", "counts", 1)
    return float(np.rad2deg(1.0)), unit.replace("rad", "deg", 1)
