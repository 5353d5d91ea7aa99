"""Sensors on an arm: what each tells of a pose, at rest and on the way.

    tool           y = p(q)                          [m]      in the frame of the sensor
    orientation    y = R(q) / sqrt 2                 [rad]    the same; run sets hold log R(q)
    accelerometer  y = M^T R_b(q)^T (a + g z)        [m/s2]   in its own frame, a: of the tool point
    gyroscope      y = M^T R_b(q)^T omega            [rad/s]  the same; 0 at rest
    wire           y = |p_b(q) - anchor|             [m]
    encoders       y = q                             [rad, m] in the log's sense

with the tool at p, turned by R, in the frame of the tool positions (p_b, R_b: of the base link),
and the sensor turned by M on the tool link. Channels y are such that y seen minus y expected is
what is off, give or take noise: a rotation stands as a matrix, whose distance is the angle.

Section: docs/sensors.md
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from failuretwin.core.errors import InputError, unknown_name
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.kinematics import GRAVITY
from failuretwin.digital_model.profile import SensorProfile
from failuretwin.digital_model.twin import DigitalTwin

UP = np.array([0.0, 0.0, GRAVITY])
"""What an accelerometer at rest reads in the base frame: the push that keeps it there [m/s2]."""
LONGEST_WAY = 3.0
"""An accelerometer that may read anything on the way reads up to so many g; assumed."""
JERKY = 0.08
"""What bent ramps, servo transients and a shaking arm add to an accelerometer on the way [g]."""
UNEVEN = 0.05
"""The same of a gyroscope, as a share of the fastest motor's speed [-]."""


@dataclass(frozen=True)
class Sensor(ABC):
    """One sensor of an arm; poses are motor angles in the log's sense, (..., motor) [rad].

    Attributes:
        twin: Kinematics of the arm.
        profile: What is known of this one.
    """

    twin: DigitalTwin
    profile: SensorProfile | None = None

    kind: ClassVar[str]
    """Its name on the command line."""
    variable: ClassVar[str]
    """Variable of a run set that holds its readings."""
    usual_noise: ClassVar[float] = 0.0
    usual_doubt: ClassVar[float] = 0.0
    circular: ClassVar[bool] = False
    """Whether a motor that turns takes it along a circle."""
    at_rest: ClassVar[bool] = True
    """Whether it tells of the pose at rest."""

    @property
    def channels(self) -> int:
        """How many channels it has."""
        return 3

    @property
    def dims(self) -> int:
        """In how many dimensions they can differ."""
        return self.channels

    @property
    def noise(self) -> float:
        """Standard deviation of a reading at rest on each channel [unit]."""
        return (self.profile.noise if self.profile else 0.0) or self.usual_noise

    @property
    def doubt(self) -> float:
        """Standard deviation of a constant error that nobody knows [unit]."""
        known = self.profile is not None and self.profile.doubt >= 0.0
        return self.profile.doubt if known and self.profile else self.usual_doubt

    @property
    def turn_doubt(self) -> float:
        """Standard deviation of how it is turned on its mount, about each axis [rad]."""
        return self.profile.turn_doubt if self.profile else 0.0

    @property
    def noise_on_way(self) -> float:
        """What a reading on the way may be off by [unit]."""
        return self.noise

    @abstractmethod
    def expected(self, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the channels at rest, (..., channel), and J, (..., channel, motor) [per rad]."""

    @property
    @abstractmethod
    def log_anywhere(self) -> float:
        """Log density of its channels at rest if the arm may stand anyhow [log 1/unit^dims]."""

    @property
    def log_anywhere_on_way(self) -> float:
        """The same of a reading on the way."""
        return self.log_anywhere

    def along(self, pose: FloatArray, step_s: FloatArray) -> FloatArray:
        """Return the channels along a motion, (..., time, channel).

        Args:
            pose: Angles at even times, (..., time, motor) [rad]; at rest before and after.
            step_s: Time between two, (...) [s].
        """
        del step_s
        return self.expected(pose)[0]

    def to_channels(self, readings: FloatArray) -> FloatArray:
        """Return the channels of what a run set holds, (..., channel), what is known of it off."""
        return readings - self._bias

    def with_errors(self, channels: FloatArray, error: FloatArray) -> FloatArray:
        """Return what a run set holds of channels that err; `error` is (..., error)."""
        return channels + self._bias + error

    @property
    def errors(self) -> int:
        """How many numbers say how a reading errs."""
        return self.channels

    @cached_property
    def _bias(self) -> FloatArray:
        bias = self.profile.bias if self.profile else ()
        if len(bias) not in (0, self.errors):
            raise InputError(
                f"{self.kind}: bias has {len(bias)} values, expected one for each of "
                f"{self.errors} channels."
            )
        return np.asarray(bias or 0.0)

    @cached_property
    def _mount(self) -> FloatArray:
        """M, which takes directions of the sensor's frame to the tool link's, (3, 3)."""
        rpy = self.profile.rpy if self.profile else (0.0, 0.0, 0.0)
        return np.asarray(Rotation.from_euler("xyz", rpy).as_matrix())


class Tool(Sensor):
    """Position of the tool [m]."""

    kind, variable, circular = "tool", "measured", True

    def expected(self, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return p and its Jacobian [m, m/rad]."""
        return self.twin.path_and_jacobian(pose)

    def along(self, pose: FloatArray, step_s: FloatArray) -> FloatArray:
        """Return p along a motion [m]."""
        del step_s
        return self.twin.path(pose)

    @property
    def log_anywhere(self) -> float:
        """Log density of a tool anywhere within reach [log 1/m3]."""
        return -float(np.log(4.0 / 3.0 * np.pi * self.twin.robot.reach**3))


class Orientation(Sensor):
    """How the tool is turned in the frame of the tool positions; in run sets a rotation vector."""

    kind, variable, circular = "orientation", "tool_orientation", True
    usual_noise, usual_doubt = 0.003, 0.0

    @property
    def channels(self) -> int:
        """The entries of a matrix."""
        return 9

    @property
    def dims(self) -> int:
        """Rotations have three."""
        return 3

    @property
    def errors(self) -> int:
        """A turn about three axes of the tool's frame."""
        return 3

    def expected(self, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return R / sqrt 2 by rows and its Jacobian [rad, rad/rad]."""
        robot = self.twin.robot
        R, slope = robot.chain.rotation_and_derivative(pose * robot.sensor_sense)
        lead = pose.shape[:-1]
        jacobian = slope.reshape(*lead, 9, -1) * robot.sensor_sense
        return R.reshape(*lead, 9) / np.sqrt(2.0), jacobian / np.sqrt(2.0)

    @property
    def log_anywhere(self) -> float:
        """All rotations are as likely: their volume is 8 pi^2 [log 1/rad3]."""
        return -float(np.log(8.0 * np.pi**2))

    def to_channels(self, readings: FloatArray) -> FloatArray:
        """Return R / sqrt 2 by rows of rotation vectors [rad]; NaN stays NaN."""
        flat = readings.reshape(-1, 3)
        seen = np.isfinite(flat).all(axis=1)
        out = np.full((len(flat), 9), np.nan)
        turn = Rotation.from_rotvec(flat[seen]) * Rotation.from_rotvec(self._three()).inv()
        out[seen] = turn.as_matrix().reshape(-1, 9) / np.sqrt(2.0)
        return out.reshape(*readings.shape[:-1], 9)

    def with_errors(self, channels: FloatArray, error: FloatArray) -> FloatArray:
        """Return rotation vectors, the sensor turned by `error` in the tool's frame [rad]."""
        true = Rotation.from_matrix(np.sqrt(2.0) * channels.reshape(-1, 3, 3))
        told = (
            true * Rotation.from_rotvec(error.reshape(-1, 3)) * Rotation.from_rotvec(self._three())
        )
        return np.asarray(told.as_rotvec()).reshape(error.shape)

    def _three(self) -> FloatArray:
        return np.zeros(3) + self._bias


class Accelerometer(Sensor):
    """Specific force on the tool: gravity's direction at rest, acceleration on the way [m/s2]."""

    kind, variable, circular = "accelerometer", "accelerometer", True
    usual_noise, usual_doubt = 0.05, 0.05

    def expected(self, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return M^T R_b^T g z and its Jacobian [m/s2, m/s2/rad]."""
        robot = self.twin.robot
        R, slope = robot.loads.chain.rotation_and_derivative(pose * robot.sense)
        jacobian = GRAVITY * slope[..., 2, :, :] * robot.sense
        return GRAVITY * R[..., 2, :] @ self._mount, self._mount.T @ jacobian

    def along(self, pose: FloatArray, step_s: FloatArray) -> FloatArray:
        """Return M^T R_b^T (a + g z), a by second differences [m/s2]."""
        robot = self.twin.robot
        q = pose * robot.sense
        p = robot.loads.chain.position(q)
        before = np.concatenate([p[..., :1, :], p[..., :-1, :]], axis=-2)
        after = np.concatenate([p[..., 1:, :], p[..., -1:, :]], axis=-2)
        force = (before - 2.0 * p + after) / np.asarray(step_s)[..., None, None] ** 2 + UP
        R = robot.loads.chain.frames(q)[0][..., -1, :, :]
        return np.einsum("...k,...kt->...t", force, R) @ self._mount

    @property
    def noise_on_way(self) -> float:
        """What bends and shakes on the way adds to its noise [m/s2]."""
        return float(np.hypot(self.noise, JERKY * GRAVITY))

    @property
    def log_anywhere(self) -> float:
        """Gravity from any direction, its size as noise has it [log (m/s2)^-3]."""
        return -float(np.log(4.0 * np.pi * GRAVITY**2 * np.sqrt(2.0 * np.pi) * self.noise))

    @property
    def log_anywhere_on_way(self) -> float:
        """Anything up to some g [log (m/s2)^-3]."""
        return -float(np.log(4.0 / 3.0 * np.pi * (LONGEST_WAY * GRAVITY) ** 3))


class Gyroscope(Sensor):
    """Turn rate of the tool, in the sensor's frame [rad/s]; tells nothing at rest."""

    kind, variable, at_rest = "gyroscope", "gyroscope", False
    usual_noise, usual_doubt = 0.005, 0.005

    def expected(self, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return no turn, whatever the pose."""
        return np.zeros((*pose.shape[:-1], 3)), np.zeros((*pose.shape[:-1], 3, pose.shape[-1]))

    def along(self, pose: FloatArray, step_s: FloatArray) -> FloatArray:
        """Return M^T omega with [omega]x = R^T dR/dt by central differences [rad/s]."""
        robot = self.twin.robot
        q = pose * robot.sense
        R = robot.loads.chain.frames(q)[0][..., -1, :, :]
        before = np.concatenate([R[..., :1, :, :], R[..., :-1, :, :]], axis=-3)
        after = np.concatenate([R[..., 1:, :, :], R[..., -1:, :, :]], axis=-3)
        rate = np.swapaxes(R, -1, -2) @ (after - before)
        skew = (rate - np.swapaxes(rate, -1, -2)) / 2.0
        vector = np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1)
        return (vector / (2.0 * np.asarray(step_s)[..., None, None])) @ self._mount

    @property
    def noise_on_way(self) -> float:
        """What uneven motion adds to its noise [rad/s]."""
        fastest = max(motor.speed_limit for motor in self.twin.robot.motors)
        return float(np.hypot(self.noise, UNEVEN * fastest))

    @property
    def log_anywhere(self) -> float:
        """Any turn rate up to that of all motors together [log (rad/s)^-3]."""
        fastest = sum(motor.speed_limit for motor in self.twin.robot.motors)
        return -float(np.log(4.0 / 3.0 * np.pi * fastest**3))


class Wire(Sensor):
    """Length of a draw-wire from an anchor to the tool point [m]."""

    kind, variable = "wire", "wire"
    usual_noise, usual_doubt = 0.0005, 0.001

    @property
    def channels(self) -> int:
        """One length."""
        return 1

    @cached_property
    def anchor(self) -> FloatArray:
        """Where it begins, in the base link's frame [m]; usual: beside the arm, on its floor."""
        reach = self.twin.robot.reach
        told = self.profile.anchor if self.profile else ()
        return np.asarray(told or (reach, 0.5 * reach, 0.0))

    def expected(self, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the length and its Jacobian [m, m/rad]."""
        robot = self.twin.robot
        p, J = robot.loads.chain.position_and_jacobian(pose * robot.sense)
        away = p - self.anchor
        length = np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), 1e-9)
        slope = np.einsum("...a,...ak->...k", away / length, J) * robot.sense
        return length, slope[..., None, :]

    @property
    def log_anywhere(self) -> float:
        """Any length within what the arm can span [log 1/m]."""
        return -float(np.log(2.0 * self.twin.robot.reach))

    def to_channels(self, readings: FloatArray) -> FloatArray:
        """Return lengths (..., 1) of lengths (...) [m]."""
        return super().to_channels(readings[..., None])

    def with_errors(self, channels: FloatArray, error: FloatArray) -> FloatArray:
        """Return lengths (...) [m]."""
        return super().with_errors(channels, error)[..., 0]


class Encoders(Sensor):
    """Readings of the motors themselves, in the log's sense [rad, m]: component level."""

    kind, variable = "encoders", "position"
    usual_noise = 0.0015

    @property
    def channels(self) -> int:
        """One for each motor."""
        return len(self.twin.robot.motors)

    def expected(self, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the angles themselves."""
        motors = pose.shape[-1]
        return pose, np.broadcast_to(np.eye(motors), (*pose.shape, motors))

    @property
    def log_anywhere(self) -> float:
        """Every motor anywhere within its travel [log 1/rad^motors]."""
        return -float(np.log(np.ptp(self.twin.robot.travel, axis=1)).sum())


SENSORS: Mapping[str, type[Sensor]] = {
    kind.kind: kind for kind in (Tool, Orientation, Accelerometer, Gyroscope, Wire, Encoders)
}
"""Kinds of sensors by name."""


def sensor_of(kind: str, twin: DigitalTwin, *profiles: tuple[SensorProfile, ...]) -> Sensor:
    """Return a sensor of an arm.

    Args:
        kind: Its name.
        twin: Kinematics of the arm.
        profiles: What is said of its sensors; the first that says something of this kind counts,
            then the profile of the robot. Otherwise it is as usual.

    Raises:
        InputError: If there is no such kind.
    """
    if kind not in SENSORS:
        raise unknown_name("sensor", kind, SENSORS)
    said = [one for told in profiles for one in told if one.kind == kind]
    return SENSORS[kind](twin, said[0] if said else None)
