"""Sensors on an arm: their expected readings at rest and in motion.

    tool           y = p(q)                          [m]      in the frame of the sensor
    orientation    y = R(q) / sqrt 2                 [rad]    the same; run sets hold log R(q)
    accelerometer  y = M^T R_b(q)^T (a + g z)        [m/s2]   in its own frame, a: of the tool point
    gyroscope      y = M^T R_b(q)^T omega            [rad/s]  the same; 0 at rest
    wire           y = |p_b(q) - anchor|             [m]
    encoders       y = q                             [rad, m] in the log's sense

The tool has position p and rotation R in the frame of the tool positions (p_b, R_b: of the base
link); M is the sensor's rotation on the tool link. A rotation is stored as a matrix, so that the
difference of two sets of channels is the angle between them.

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
"""Reading of an accelerometer at rest in the base frame [m/s2]."""
LONGEST_WAY = 3.0
"""Largest reading of an accelerometer in motion [g]; assumed."""
JERKY = 0.08
"""Deviation of an accelerometer in motion by bent ramps, servo transients and vibration [g]."""
UNEVEN = 0.05
"""Deviation of a gyroscope in motion, as a share of the fastest motor's speed [-]."""


@dataclass(frozen=True)
class Sensor(ABC):
    """One sensor of an arm; poses are motor angles in the log's sense, (..., motor) [rad].

    Attributes:
        twin: Kinematics of the arm.
        profile: Mount, noise and bias of this sensor; None: defaults of its kind.
    """

    twin: DigitalTwin
    profile: SensorProfile | None = None

    kind: ClassVar[str]
    """Name on the command line."""
    variable: ClassVar[str]
    """Variable of a run set that holds its readings."""
    usual_noise: ClassVar[float] = 0.0
    usual_doubt: ClassVar[float] = 0.0
    circular: ClassVar[bool] = False
    """Whether a turning motor moves its channels along a circle."""
    at_rest: ClassVar[bool] = True
    """Whether it measures the pose at rest."""

    @property
    def channels(self) -> int:
        """Number of channels."""
        return 3

    @property
    def dims(self) -> int:
        """Degrees of freedom of the channels, and of their errors."""
        return self.channels

    @property
    def noise(self) -> float:
        """Standard deviation of a reading at rest on each channel [unit]."""
        return (self.profile.noise if self.profile else 0.0) or self.usual_noise

    @property
    def doubt(self) -> float:
        """Standard deviation of the unknown constant error [unit]."""
        known = self.profile.doubt if self.profile else -1.0
        return known if known >= 0.0 else self.usual_doubt

    @property
    def turn_doubt(self) -> float:
        """Standard deviation of the mount's rotation about each axis [rad]."""
        return self.profile.turn_doubt if self.profile else 0.0

    @property
    def noise_on_way(self) -> float:
        """Standard deviation of a reading in motion [unit]."""
        return self.noise

    @abstractmethod
    def expected(self, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the channels at rest, (..., channel), and J, (..., channel, motor) [per rad]."""

    @property
    @abstractmethod
    def log_anywhere(self) -> float:
        """Log density of its channels at rest for an arbitrary pose [log 1/unit^dims]."""

    @property
    def log_anywhere_on_way(self) -> float:
        """Log density of a reading in motion for an arbitrary pose."""
        return self.log_anywhere

    def along(self, pose: FloatArray, step_s: FloatArray) -> FloatArray:
        """Return the channels along a motion, (..., time, channel).

        Args:
            pose: Angles at even times, (..., time, motor) [rad]; at rest before and after.
            step_s: Time step, (...) [s].
        """
        del step_s
        return self.expected(pose)[0]

    def to_channels(self, readings: FloatArray) -> FloatArray:
        """Return channels (..., channel) of the readings in a run set, without the known bias."""
        return readings - self._bias

    def with_errors(self, channels: FloatArray, error: FloatArray) -> FloatArray:
        """Return the readings in a run set of channels with errors (..., dims)."""
        return channels + self._bias + error

    @cached_property
    def _bias(self) -> FloatArray:
        bias = self.profile.bias if self.profile else ()
        if len(bias) not in (0, self.dims):
            raise InputError(
                f"{self.kind}: bias has {len(bias)} values, expected one for each of "
                f"{self.dims} channels."
            )
        return np.asarray(bias or [0.0] * self.dims)

    @cached_property
    def _mount(self) -> FloatArray:
        """Rotation M from the sensor's frame to the tool link's, (3, 3)."""
        rpy = self.profile.rpy if self.profile else (0.0, 0.0, 0.0)
        return np.asarray(Rotation.from_euler("xyz", rpy).as_matrix())

    def _motion(self, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return tool positions (..., time, 3) and rotations (..., time, 3, 3), base frame."""
        robot = self.twin.robot
        rotation, origin = robot.loads.chain.frames(pose * robot.sense)
        return origin[..., -1, :], rotation[..., -1, :, :]


def _neighbours(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the values before and after each, along axis 0; the ends are repeated."""
    return np.concatenate([values[:1], values[:-1]]), np.concatenate([values[1:], values[-1:]])


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
    """Rotation of the tool in the frame of the tool positions; a rotation vector in run sets."""

    kind, variable, circular = "orientation", "tool_orientation", True
    usual_noise, usual_doubt = 0.003, 0.0

    @property
    def channels(self) -> int:
        """Entries of a rotation matrix."""
        return 9

    @property
    def dims(self) -> int:
        """Degrees of freedom of a rotation."""
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
        """Uniform over all rotations, whose volume is 8 pi^2 [log 1/rad3]."""
        return -float(np.log(8.0 * np.pi**2))

    def to_channels(self, readings: FloatArray) -> FloatArray:
        """Return R / sqrt 2 by rows of rotation vectors [rad]; NaN stays NaN."""
        flat = readings.reshape(-1, 3)
        seen = np.isfinite(flat).all(axis=1)
        out = np.full((len(flat), 9), np.nan)
        turn = Rotation.from_rotvec(flat[seen]) * Rotation.from_rotvec(self._bias).inv()
        out[seen] = turn.as_matrix().reshape(-1, 9) / np.sqrt(2.0)
        return out.reshape(*readings.shape[:-1], 9)

    def with_errors(self, channels: FloatArray, error: FloatArray) -> FloatArray:
        """Return rotation vectors of a sensor turned by `error` in the tool's frame [rad]."""
        true = Rotation.from_matrix(np.sqrt(2.0) * channels.reshape(-1, 3, 3))
        turned = true * Rotation.from_rotvec(error.reshape(-1, 3))
        return np.asarray(
            (turned * Rotation.from_rotvec(self._bias)).as_rotvec().reshape(error.shape)
        )


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
        p, R = self._motion(pose)
        before, after = (np.moveaxis(x, 0, -2) for x in _neighbours(np.moveaxis(p, -2, 0)))
        force = (before - 2.0 * p + after) / np.asarray(step_s)[..., None, None] ** 2 + UP
        return np.einsum("...k,...kt->...t", force, R) @ self._mount

    @property
    def noise_on_way(self) -> float:
        """Noise with vibration and bent ramps [m/s2]."""
        return float(np.hypot(self.noise, JERKY * GRAVITY))

    @property
    def log_anywhere(self) -> float:
        """Gravity from any direction, its size within the noise [log (m/s2)^-3]."""
        return -float(np.log(4.0 * np.pi * GRAVITY**2 * np.sqrt(2.0 * np.pi) * self.noise))

    @property
    def log_anywhere_on_way(self) -> float:
        """Uniform up to `LONGEST_WAY` [log (m/s2)^-3]."""
        return -float(np.log(4.0 / 3.0 * np.pi * (LONGEST_WAY * GRAVITY) ** 3))


class Gyroscope(Sensor):
    """Angular velocity of the tool in the sensor's frame [rad/s]; zero at rest."""

    kind, variable, at_rest = "gyroscope", "gyroscope", False
    usual_noise, usual_doubt = 0.005, 0.005

    def expected(self, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return zeros for any pose."""
        return np.zeros((*pose.shape[:-1], 3)), np.zeros((*pose.shape[:-1], 3, pose.shape[-1]))

    def along(self, pose: FloatArray, step_s: FloatArray) -> FloatArray:
        """Return M^T omega with [omega]x = R^T dR/dt by central differences [rad/s]."""
        _, R = self._motion(pose)
        before, after = (np.moveaxis(x, 0, -3) for x in _neighbours(np.moveaxis(R, -3, 0)))
        rate = np.swapaxes(R, -1, -2) @ (after - before)
        skew = (rate - np.swapaxes(rate, -1, -2)) / 2.0
        vector = np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1)
        return (vector / (2.0 * np.asarray(step_s)[..., None, None])) @ self._mount

    @property
    def noise_on_way(self) -> float:
        """Noise with uneven motion [rad/s]."""
        fastest = max(motor.speed_limit for motor in self.twin.robot.motors)
        return float(np.hypot(self.noise, UNEVEN * fastest))

    @property
    def log_anywhere(self) -> float:
        """Uniform up to the speed of all motors together [log (rad/s)^-3]."""
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
        """Its start in the base link's frame [m]; default: beside the arm, on its floor."""
        reach = self.twin.robot.reach
        anchor = self.profile.anchor if self.profile else ()
        return np.asarray(anchor or (reach, 0.5 * reach, 0.0))

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
        """Uniform over the span of the arm [log 1/m]."""
        return -float(np.log(2.0 * self.twin.robot.reach))

    def to_channels(self, readings: FloatArray) -> FloatArray:
        """Return lengths (..., 1) of lengths (...) [m]."""
        return super().to_channels(readings[..., None])

    def with_errors(self, channels: FloatArray, error: FloatArray) -> FloatArray:
        """Return lengths (...) [m]."""
        return super().with_errors(channels, error)[..., 0]


class Encoders(Sensor):
    """Position readings of the motors in the log's sense [rad, m]: component level."""

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
        """Uniform over every motor's travel [log 1/rad^motors]."""
        return -float(np.log(np.ptp(self.twin.robot.travel, axis=1)).sum())


SENSORS: Mapping[str, type[Sensor]] = {
    kind.kind: kind for kind in (Tool, Orientation, Accelerometer, Gyroscope, Wire, Encoders)
}
"""Kinds of sensors by name."""


def sensor_of(kind: str, twin: DigitalTwin, *profiles: tuple[SensorProfile, ...]) -> Sensor:
    """Return a sensor of an arm.

    The first profile of this kind in the groups applies.
    """
    if kind not in SENSORS:
        raise unknown_name("sensor", kind, SENSORS)
    found = [one for group in profiles for one in group if one.kind == kind]
    return SENSORS[kind](twin, found[0] if found else None)
