"""A robot: the kinematics of its URDF, and its motors by its profile."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.resources import files
from pathlib import Path

import numpy as np

from failuretwin.core.config import from_table, read_toml
from failuretwin.core.errors import InputError, unknown_name
from failuretwin.core.types import BoolArray, FloatArray, frozen_array
from failuretwin.digital_model.geometry import SensorFrame, seen_chain, with_tool
from failuretwin.digital_model.kinematics import (
    CANNOT_MOVE,
    Loads,
    SerialChain,
    has_range,
    idle_axes,
    levers,
)
from failuretwin.digital_model.profile import Motor, Profile
from failuretwin.digital_model.servo import ServoUnits
from failuretwin.digital_model.urdf.file import read_urdf

HELD_BEYOND = 0.1
"""Share of its travel by which a motor may be held beyond its ends: limits are not stops."""


@dataclass(frozen=True)
class Robot:
    """A robot that can be simulated and diagnosed.

    Attributes:
        profile: Its profile.
        chain: Kinematics as the tool sensor sees it, in the sensor's frame; one joint per motor.
        loads: Masses that its motors carry; their chain is in the frame of the base link.
        source: File of its profile.
        frame: Displacement of the sensor from its place in the profile; None: not displaced.
    """

    profile: Profile
    chain: SerialChain
    loads: Loads
    source: Path
    frame: SensorFrame | None = None

    def seen_from(self, frame: SensorFrame | None) -> Robot:
        """Return the robot as seen by a displaced sensor; the scale of sliding arms is ignored."""
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
        """Folder of the profile."""
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
        """Limits of the joints in the log's sense, (motor, low | high) [rad or m]; inf: none."""
        ends = np.array([(joint.low, joint.high) for joint in self.chain.joints])
        known = [has_range(low, high) for low, high in ends.tolist()]
        ends[~np.array(known)] = -np.inf, np.inf
        return frozen_array(np.sort(ends * self.sense[:, None], axis=1))

    @cached_property
    def travel(self) -> FloatArray:
        """Possible angles of each motor, (motor, low | high) [rad or m].

        Default: the limits of its joint, at most one full turn about the middle of its movements,
        since angles a turn apart give the same tool position.
        """
        return frozen_array([self._travel_of(k) for k in range(len(self.motors))])

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

    def held_beyond(self, motor: int) -> float:
        """Return by how much a motor may be held beyond its travel [rad or m].

        At most so far that no two held angles are the same: beyond a full turn all come again.
        """
        length = float(np.ptp(self.travel[motor]))
        margin = HELD_BEYOND * length
        return margin if self.slides[motor] else min(margin, max(0.0, math.pi - 0.5 * length))

    @cached_property
    def slides(self) -> BoolArray:
        """Which motors slide [m] instead of turning [rad], (motor,)."""
        return np.array([joint.prismatic for joint in self.chain.joints])

    def own_unit(self, motor: str, unit: str) -> str:
        """Return the unit of a magnitude at a motor: m instead of rad where it slides."""
        if not unit.startswith("rad"):
            return unit
        slides = self.slides[self.motor_names.index(motor)]
        return unit.replace("rad", "m", 1) if slides else unit

    @cached_property
    def resting_pose(self) -> FloatArray:
        """Pose of an arm without a stated one: as near to 0 as it moves, (motor,) [rad]."""
        return np.array([float(np.clip(0.0, *motor.movement_range)) for motor in self.motors])

    @cached_property
    def idle_axes(self) -> tuple[bool, bool, bool]:
        """Axes of the tool position along which no motor moves it."""
        return idle_axes(self.chain)

    @cached_property
    def reach(self) -> float:
        """Upper bound of the tool's distance from the base [m]: links and slides end to end."""
        chain = self.loads.chain
        links = [*(joint.T_pj for joint in chain.joints), chain.T_jt]
        slides = np.abs([m.movement_range for m in self.motors]).max(axis=1)[self.slides]
        return float(sum(np.linalg.norm(T[:3, 3]) for T in links) + slides.sum())

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


def bundled_folder() -> Path:
    """Return the folder of the bundled robots."""
    return Path(str(files("failuretwin.digital_model") / "robots"))


def bundled_robots() -> list[str]:
    """Return the names of the bundled robots."""
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

    Angles are in radians; of a motor that slides, millimetres are shown.
    """
    if motor and robot.own_unit(motor, unit) != unit:
        return 1e3, unit.replace("rad", "mm", 1)
    if not unit.startswith("rad"):
        return 1.0, unit
    if robot.profile.servo_units is not None:
        return 1.0 / abs(robot.servo_units.rad_per_count), unit.replace("rad", "counts", 1)
    return float(np.rad2deg(1.0)), unit.replace("rad", "deg", 1)
