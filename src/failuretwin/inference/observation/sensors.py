"""The sensors that are believed, as one: channels in one unit, a residual and its covariance.

    e = w (y seen - y(q)),    J = w dy/dq,    S = J diag(s^2) J^T + sn^2 I

with w = sn / noise for each channel, sn the noise of a settled tool position [m]: so that every
channel is as noisy as that, and a length. Of the tool's position w is 1. On the way w stands for
what a reading may be off by there.

Section: docs/sensors.md#one-residual-for-all-sensors
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.core.errors import InputError, unknown_name
from failuretwin.core.runs import GOAL_VARIABLE
from failuretwin.core.types import BoolArray, FloatArray, as_floats
from failuretwin.digital_model.nonidealities import Imperfections
from failuretwin.digital_model.sensors import SENSORS, Encoders, Sensor, Tool, sensor_of
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.inference.observation.readings import MeasuredSamples, measured_samples
from failuretwin.inference.observation.settings import NOISE_FACTOR, InferenceSettings

if TYPE_CHECKING:
    import xarray as xr

TOOL_ALONE = (Tool.kind,)
"""What is believed where nothing else is said: the position of the tool."""
GOALS = "goals"
"""Believed beside sensors: which goal each motor reports to have received. It tells of commands
that do not arrive, and nothing of the pose."""
SAME_GOAL = 1e-3
"""Goals that differ by less than this share of a motor's travel are the same [-]."""
SHOWS_NOTHING = 0.1
"""A motor that moves what is seen by less than this share of its noise, all the way round, does not
show [-]."""


def parse_sensing(text: str) -> tuple[str, ...]:
    """Return the names in a text such as ``tool+encoders``, in the order of `SENSORS`, goals last.

    Raises:
        InputError: If a sensor is unknown, or none tells of the pose at rest.
    """
    names, known = [name.strip() for name in text.split("+")], (*SENSORS, GOALS)
    for name in names:
        if name not in known:
            raise unknown_name("sensor", name, known)
    if not any(name in SENSORS and SENSORS[name].at_rest for name in names):
        raise InputError(f"{text}: tells nothing of where the arm rests. Add tool.")
    return tuple(kind for kind in known if kind in names)


def sensing_of(runs: xr.Dataset, sensing: str | None) -> tuple[str, ...]:
    """Return the sensors to believe of a run set.

    Args:
        runs: The run set.
        sensing: What is asked for, such as ``tool+encoders``; None: the tool's position where the
            run set has it, else all others that it has, but for the readings of the motors.

    Raises:
        InputError: If it has no reading of one that is asked for.
    """
    there = [kind for kind, of in SENSORS.items() if _has_readings(runs, of.variable)]
    if sensing is None:
        others = [kind for kind in there if kind != Encoders.kind]
        alone = Tool.kind in there or not any(SENSORS[kind].at_rest for kind in others)
        return TOOL_ALONE if alone else tuple(others)
    there += [GOALS] if _has_readings(runs, GOAL_VARIABLE) else []
    asked = parse_sensing(sensing)
    for kind in asked:
        if kind not in there:
            variable = GOAL_VARIABLE if kind == GOALS else SENSORS[kind].variable
            raise InputError(
                f"the runs hold no readings of {kind} (variable `{variable}`); they hold "
                f"{', '.join(there) or 'none of any sensor'}."
            )
    return asked


def _has_readings(runs: xr.Dataset, variable: str) -> bool:
    return variable in runs and bool(np.isfinite(runs[variable].values).any())


@dataclass(frozen=True)
class SensorStack:
    """Sensors that are believed together.

    Attributes:
        twin: Kinematics.
        sensors: The sensors; one at least tells of the pose at rest.
        unit_m: sn, the noise of every channel [m].
        rough_m: What is added to it on the way [m].
        goals: Whether motors are believed about the goals that they have received.
    """

    twin: DigitalTwin
    sensors: tuple[Sensor, ...]
    unit_m: float
    rough_m: float
    goals: bool = False

    @classmethod
    def of(
        cls,
        sensing: Sequence[str],
        twin: DigitalTwin,
        imperfections: Imperfections,
        unit_m: float,
        rough_m: float,
    ) -> SensorStack:
        """Return the sensors of these names, as the calibration, then the profile, has them."""
        told, kinds = (imperfections.sensors, twin.robot.profile.sensors), set(sensing) - {GOALS}
        sensors = tuple(sensor_of(kind, twin, *told) for kind in sensing if kind in kinds)
        return cls(twin, sensors, unit_m, rough_m, GOALS in sensing)

    @cached_property
    def tool_alone(self) -> bool:
        """Whether the position of the tool alone is believed."""
        return [sensor.kind for sensor in self.sensors] == [Tool.kind]

    @cached_property
    def at_rest(self) -> tuple[Sensor, ...]:
        """Those that tell of the pose at rest."""
        return tuple(sensor for sensor in self.sensors if sensor.at_rest)

    @cached_property
    def registered(self) -> slice | None:
        """Channels of the sensor whose registration is theta's: the tool's, else the first in 3-D.

        What is not known of the others counts as noise.
        """
        first = 0
        for sensor in self.at_rest:
            if sensor.channels == 3:
                return slice(first, first + 3)
            first += sensor.channels
        return None

    @cached_property
    def in_doubt(self) -> Sensor | None:
        """The sensor beside the tool's whose constant errors are integrated out, if there is."""
        if self.registered is None or self.at_rest[0].kind == Tool.kind:
            return None
        sensor = next(sensor for sensor in self.at_rest if sensor.channels == 3)
        return sensor if sensor.doubt or sensor.turn_doubt else None

    @property
    def channels(self) -> int:
        """Channels at rest."""
        return sum(sensor.channels for sensor in self.at_rest)

    @property
    def dims(self) -> int:
        """In how many dimensions they can differ."""
        return sum(sensor.dims for sensor in self.at_rest)

    @property
    def channels_on_way(self) -> int:
        """Channels on the way."""
        return sum(sensor.channels for sensor in self.sensors)

    @property
    def dims_on_way(self) -> int:
        """In how many dimensions they can differ."""
        return sum(sensor.dims for sensor in self.sensors)

    @property
    def sees_tool(self) -> bool:
        """Whether the position of the tool is among them."""
        return self.sensors[0].kind == Tool.kind

    @property
    def tells_all_at_rest(self) -> bool:
        """Whether what is seen at rest shows every motor that moves the tool."""
        return any(sensor.kind in (Tool.kind, Encoders.kind) for sensor in self.at_rest)

    @property
    def accelerates(self) -> bool:
        """Whether what is seen on the way is more than the poses that are passed."""
        return any(type(s).along is not Sensor.along and s.kind != Tool.kind for s in self.sensors)

    # What is expected.

    def expected(self, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return channels at rest, (..., channel) [m], and J, (..., channel, motor) [m/rad]."""
        if self.tool_alone:
            return self.twin.path_and_jacobian(pose)
        told = [sensor.expected(pose) for sensor in self.at_rest]
        value = np.concatenate([v for v, _ in told], axis=-1) * self._scale
        return value, np.concatenate([J for _, J in told], axis=-2) * self._scale[:, None]

    def value(self, pose: FloatArray) -> FloatArray:
        """Return channels at rest, (..., channel) [m]."""
        return self.twin.path(pose) if self.tool_alone else self.expected(pose)[0]

    def along(self, pose: FloatArray, step_s: FloatArray) -> FloatArray:
        """Return channels along a motion, (..., time, channel) [m].

        Args:
            pose: Angles at even times, (..., time, motor) [rad].
            step_s: Time between two, (...) [s].
        """
        if self.tool_alone:
            return self.twin.path(pose)
        parts = [sensor.along(pose, step_s) for sensor in self.sensors]
        return np.concatenate(parts, axis=-1) * self._scale_on_way

    def jacobian_on_way(self, pose: FloatArray) -> FloatArray:
        """Return J of what is seen on the way, arms at rest, (..., channel, motor) [m/rad]."""
        if self.tool_alone:
            return self.twin.path_and_jacobian(pose)[1]
        parts = [sensor.expected(pose)[1] for sensor in self.sensors]
        return np.concatenate(parts, axis=-2) * self._scale_on_way[:, None]

    def log_anywhere(self, noise_m: float) -> float:
        """Return the log density of channels at rest if the arm may stand anyhow [log 1/m^dims].

        Where channels lie on a surface, as noise of this size has it across that.
        """
        found = 0.0
        for sensor in self.at_rest:
            found += sensor.log_anywhere - sensor.dims * float(np.log(self._scale_of(sensor)))
        return found - (self.channels - self.dims) * float(np.log(noise_m))

    @cached_property
    def log_anywhere_on_way(self) -> float:
        """The same of a reading on the way, without what noise has across a surface."""
        found = 0.0
        for sensor in self.sensors:
            scale = float(np.log(self._scale_of(sensor, on_way=True)))
            found += sensor.log_anywhere_on_way - sensor.dims * scale
        return found

    def _scale_of(self, sensor: Sensor, on_way: bool = False) -> float:
        if sensor.kind == Tool.kind:
            return 1.0
        if on_way:
            return float(np.hypot(self.unit_m, self.rough_m)) / sensor.noise_on_way
        doubt = 0.0 if sensor is self.in_doubt else sensor.doubt
        return self.unit_m / float(np.hypot(sensor.noise, doubt))

    @cached_property
    def _scale(self) -> FloatArray:
        return np.repeat(
            [self._scale_of(s) for s in self.at_rest], [s.channels for s in self.at_rest]
        )

    @cached_property
    def _scale_on_way(self) -> FloatArray:
        scales = [self._scale_of(sensor, on_way=True) for sensor in self.sensors]
        return np.repeat(scales, [sensor.channels for sensor in self.sensors])

    @property
    def deviations(self) -> tuple[float, float]:
        """Return the deviations of constant error [m] and turn [rad] of the sensor in doubt."""
        sensor = self.in_doubt
        if sensor is None:
            return 0.0, 0.0
        return sensor.doubt * self._scale_of(sensor), sensor.turn_doubt

    @property
    def unit_on_way(self) -> float:
        """Length on the way of a length at rest of the registered sensor [-]."""
        if self.registered is None:
            return 1.0
        first = self.registered.start
        return float(self._scale_on_way[first] / self._scale[first])

    # What was seen.

    def read(self, runs: xr.Dataset) -> MeasuredSamples:
        """Return the readings at rest; one counts where all sensors have theirs."""
        tool = measured_samples(runs) if self.at_rest[0].kind == Tool.kind else None
        if tool is not None and self.tool_alone:
            return tool
        point = self._channels(runs, self.at_rest, tool) * self._scale
        seen = np.asarray(np.isfinite(point).all(axis=-1))
        point = np.where(seen[..., None], point, np.nan)
        none = np.zeros_like(seen)
        if tool is None:
            return MeasuredSamples(point, seen, none, np.zeros(len(seen), dtype=bool))
        return MeasuredSamples(point, seen, tool.assumed & seen, tool.filled)

    def reading(self, tool: FloatArray, position: FloatArray) -> FloatArray:
        """Return single readings of tool and motors at rest, (..., channel) [m].

        NaN where one of those that are believed is missing.

        Args:
            tool: Position of the tool, (..., axis) [m].
            position: Angles that the motors report, (..., motor) [rad].
        """
        if self.tool_alone:
            return tool
        told = {Tool.kind: tool, Encoders.kind: position}
        parts = [sensor.to_channels(told[sensor.kind]) for sensor in self.at_rest]
        point = np.concatenate(parts, axis=-1) * self._scale
        return np.where(np.isfinite(point).all(axis=-1, keepdims=True), point, np.nan)

    def has_arrived(self, goal: FloatArray, target: FloatArray) -> FloatArray:
        """Return whether motors report to have received a target; NaN where they do not tell.

        Goals count as the same within a count of the servo, or a thousandth of the travel: a
        command that moves a motor by less says nothing if it is lost.

        Args:
            goal: Goals that they report, (..., motor) [rad].
            target: Targets, same axes [rad].
        """
        robot = self.twin.robot
        near = SAME_GOAL * np.ptp(robot.travel, axis=1)
        if robot.profile.servo_units is not None:
            near = np.maximum(near, abs(robot.servo_units.rad_per_count))
        same = (np.abs(goal - target) < near).astype(np.float64)
        return np.where(np.isfinite(goal) & np.isfinite(target), same, np.nan)

    def read_on_way(self, runs: xr.Dataset, readings: MeasuredSamples) -> FloatArray:
        """Return what is seen on the way, (run, time, channel) [m].

        Args:
            runs: The run set.
            readings: What `read` returned.
        """
        if self.tool_alone:
            return readings.point
        return self._channels(runs, self.sensors, None) * self._scale_on_way

    def _channels(
        self, runs: xr.Dataset, sensors: Sequence[Sensor], tool: MeasuredSamples | None
    ) -> FloatArray:
        parts = [sensor.to_channels(as_floats(runs[sensor.variable].values)) for sensor in sensors]
        if tool is not None:
            parts[0] = tool.point
        return np.concatenate(parts, axis=-1)

    def moving_spread_m(self, settings: InferenceSettings) -> float:
        """Return the median distance from their median above which readings are of a motion [m]."""
        noise = NOISE_FACTOR * float(np.sqrt(self.channels)) * self.unit_m
        if self.at_rest[0].kind != Tool.kind:
            return noise
        return settings.moving_spread_m if self.tool_alone else max(settings.moving_spread_m, noise)

    # Where a motor stands.

    def angles(self, point: FloatArray) -> FloatArray:
        """Return the readings of the motors, where they are believed, (..., motor) [rad].

        Args:
            point: What was seen, (..., channel) [m].
        """
        return np.asarray(point[..., -len(self.twin.robot.motors) :] / self._scale[-1])

    def nearest(self, pose: FloatArray, own: BoolArray, point: FloatArray) -> FloatArray:
        """Return the angle of each motor that brings what is expected near to what was seen.

        By the reading of the motor itself, where it is believed; else by the circle, or line, on
        which the motor takes the channels that run on one: three poses tell it. A wire's length
        goes with the cosine of the angle; of its two angles the nearer counts.

        Args:
            pose: Angles of all motors, (..., motor) [rad].
            own: Which motor is meant, (own, ..., motor).
            point: What was seen, (..., channel) [m].

        Returns:
            (own, ...) [rad].
        """
        here = np.sum(pose * own, axis=-1)
        told = [sensor.kind for sensor in self.at_rest]
        if Encoders.kind in told:
            return np.broadcast_to(np.sum(self.angles(point) * own, axis=-1), here.shape)
        turned = np.array([0.0, 0.5 * np.pi, np.pi])[:, None]
        at = np.where(own[..., None, :], turned, pose[..., None, :])
        circular = np.repeat([s.circular for s in self.at_rest], [s.channels for s in self.at_rest])
        if not circular.any():
            return self._nearest_on_wire(at, here, point[..., 0])
        value = self.value(at)[..., circular]
        first, quarter, half = value[..., 0, :], value[..., 1, :], value[..., 2, :]
        centre = 0.5 * (first + half)
        cosine, sine, toward = first - centre, quarter - centre, point[..., circular] - centre
        found = np.arctan2(np.sum(toward * sine, axis=-1), np.sum(toward * cosine, axis=-1))
        found = found + 2.0 * np.pi * np.rint((here - found) / (2.0 * np.pi))
        if not self.tool_alone:
            shows = np.linalg.norm(cosine, axis=-1) > SHOWS_NOTHING * self.unit_m
            found = np.where(shows, found, here)
        slides = self.twin.robot.slides
        if not slides.any():
            return np.asarray(found)
        along = (half - first) / np.pi
        length = np.maximum(np.sum(along**2, axis=-1), 1e-12)
        reached = np.sum((point[..., circular] - first) * along, axis=-1) / length
        return np.where((own & slides).any(axis=-1), reached, found)

    def _nearest_on_wire(
        self, at: FloatArray, here: FloatArray, length_m: FloatArray
    ) -> FloatArray:
        """Return the angles at which a wire is as long as it was seen, l^2 = a + b cos(q - c).

        Args:
            at: Poses with the motor at 0, a quarter and half a turn, (own, ..., 3, motor) [rad].
            here: Where it should be, (own, ...) [rad].
            length_m: What was seen, (...) [m].
        """
        first, quarter, half = np.moveaxis(self.value(at)[..., 0] ** 2, -1, 0)
        centre = 0.5 * (first + half)
        size = np.maximum(np.hypot(first - centre, quarter - centre), 1e-12)
        middle = np.arctan2(quarter - centre, first - centre)
        off = np.arccos(np.clip((length_m**2 - centre) / size, -1.0, 1.0))
        ways = np.stack([middle + off, middle - off])
        ways = ways + 2.0 * np.pi * np.rint((here - ways) / (2.0 * np.pi))
        best = np.where(np.abs(ways[0] - here) <= np.abs(ways[1] - here), ways[0], ways[1])
        return np.asarray(np.where(size > 1e-9, best, here))
