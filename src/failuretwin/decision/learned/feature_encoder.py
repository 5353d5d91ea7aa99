"""Features of runs for networks: the paper's two sets, and residuals in motor space (`robust`).

The robust features compare each reading with the pose of a healthy arm: the command with the mean
lag, sag and friction of the calibration. For each motor they hold the turn of this motor that
brings the tool nearest to the reading (exact: a joint moves the tool on a circle) and the remaining
distance, both compressed by asinh. Points without a reading are zero and marked by a mask.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from failuretwin.core.errors import InputError, unknown_name
from failuretwin.core.runs import RunTable
from failuretwin.core.types import BoolArray, FloatArray, IntArray, as_floats
from failuretwin.digital_model.nonidealities import NO_IMPERFECTIONS, Imperfections
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import Settling
from failuretwin.digital_model.twin import DigitalTwin

if TYPE_CHECKING:
    import xarray as xr

# Commands and tool paths as plain arrays.


@dataclass(frozen=True)
class Signals:
    """Commands and tool paths of many runs.

    Attributes:
        time: Uniform grid from 0, (time,) [s].
        command: (run, time, motor) [rad].
        measured: (run, time, axis) [m]; NaN = no sample.
        duration: True length of each run, (run,) [s].
    """

    time: FloatArray
    command: FloatArray
    measured: FloatArray
    duration: FloatArray

    @property
    def seen(self) -> BoolArray:
        """Whether there is a reading, (run, time)."""
        within = self.time <= self.duration[:, None] + 1e-9
        return np.asarray(np.isfinite(self.measured).all(axis=-1) & within)

    @property
    def step(self) -> float:
        """Step of the grid [s]."""
        return float((self.time[-1] - self.time[0]) / (len(self.time) - 1))


def signals_of(runs: xr.Dataset | RunTable) -> Signals:
    """Return the signals of runs; reads `time`, `command`, `measured` and `duration` alone."""
    time, command = as_floats(runs.time), as_floats(runs.command)
    duration = getattr(runs, "duration", None)
    if duration is None:
        duration = np.full(len(command), time[-1])
    return Signals(time, command, as_floats(runs.measured), as_floats(duration))


# The paper's feature sets: every tenth of 1000 samples, over the first ten seconds.

POINTS = 100
"""Points of each run."""
PERIOD_S = 0.1
"""Time between points [s]: every tenth sample of the published 100 Hz."""


def original_features(signals: Signals) -> FloatArray:
    """Return commands [rad] and measured tool position [m], (run, point, motor + axis)."""
    command, measured = _at_points(signals)
    return np.concatenate([command, measured], axis=-1)


def augmented_features(twin: DigitalTwin, signals: Signals) -> FloatArray:
    """Return the kinematics of the command and the residual, (run, point, 6) [m]."""
    command, measured = _at_points(signals)
    desired = twin.path(command)
    return np.concatenate([desired, measured - desired], axis=-1)


def _at_points(signals: Signals) -> tuple[FloatArray, FloatArray]:
    """Return commands (run, point, motor) and interpolated readings (run, point, axis).

    After the end of a run, its last values are held.
    """
    stride = max(1, round(PERIOD_S / signals.step))
    index = np.minimum(stride * np.arange(POINTS), len(signals.time) - 1)
    seen, at = signals.seen, signals.time[index]
    measured = np.zeros((len(signals.command), POINTS, 3))
    for run in np.flatnonzero(seen.any(axis=1)):
        known = seen[run]
        for axis in range(3):
            readings = signals.measured[run, known, axis]
            measured[run, :, axis] = np.interp(at, signals.time[known], readings)
    return signals.command[:, index], measured


SHARED = ("x", "y", "z", "seen")
"""Channels that belong to no motor; turn, misfit, angle and command of each motor precede them."""

TURN_RAD = 0.01
"""Turns are linear below this and logarithmic above [rad]: 2.4 counts."""
DISTANCE_M = 0.002
"""The same for distances [m]: half a degree at the length of the arm."""
DAMPING_M = 0.003
"""Distance of the tool from a joint axis at which the turn is halved [m]."""


def mean_lag_s(robot: Robot, imperfections: Imperfections) -> FloatArray:
    """Return the mean lag of each motor of a healthy robot behind its command, (motor,) [s]."""
    timing = imperfections.timing
    common = float(np.mean(timing.delay_s) + np.mean(timing.lag_s))
    # 1 / I: delay of the loop (P s + I) / (s (tau s + 1)^2 + P s + I) at low frequency.
    return np.array([common + 1.0 / motor.loop.I for motor in robot.motors])


def _points(signals: Signals) -> tuple[IntArray, FloatArray]:
    """Return the sample index of each point and 1 where it is a reading, else 0; (run, point).

    Points divide a run evenly; the last of several readings within one point is used.
    """
    runs = len(signals.command)
    last = np.floor(signals.duration[:, None] / signals.step + 1e-6)  # sample of each run
    share = np.arange(len(signals.time)) / np.maximum(last, 1.0)
    index = ((np.arange(POINTS) + 0.5) / POINTS * last).astype(np.int64)
    seen = np.zeros((runs, POINTS))
    run, sample = np.nonzero(signals.seen)
    point = np.minimum((share[run, sample] * POINTS).astype(np.int64), POINTS - 1)
    index[run, point] = sample  # the last of several wins
    seen[run, point] = 1.0
    return index, seen


def _direction(command: FloatArray) -> FloatArray:
    """Return the sign of each motor's last travel, (run, time, motor); 0 before the first."""
    sign = np.zeros_like(command)
    sign[:, 1:] = np.sign(np.diff(command, axis=1))
    when = np.where(sign != 0.0, np.arange(command.shape[1])[:, None], 0)
    last = np.maximum.accumulate(when, axis=1)
    return np.take_along_axis(sign, last, axis=1)


def _explained(
    origin: FloatArray, axis: FloatArray, tool: FloatArray, measured: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the turn of each joint that brings the tool nearest [rad] and the rest [m]."""
    here, there = tool[..., None, :] - origin, measured[..., None, :] - origin
    along = np.sum(axis * (there - here), axis=-1)
    here = here - np.sum(axis * here, axis=-1, keepdims=True) * axis
    there = there - np.sum(axis * there, axis=-1, keepdims=True) * axis
    sine = np.sum(axis * np.cross(here, there), axis=-1)
    cosine = np.sum(here * there, axis=-1)
    across = np.linalg.norm(here, axis=-1) - np.linalg.norm(there, axis=-1)
    turn = np.arctan2(sine, cosine)
    lever = np.sum(here * here, axis=-1)
    return turn * lever / (lever + DAMPING_M**2), np.hypot(along, across)


def _compressed(values: FloatArray, scale: float) -> FloatArray:
    return np.arcsinh(values / scale) / 3.0


# Named feature sets.

FEATURE_SETS = ("original", "augmented", "robust")
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class FeatureEncoder:
    """Encodes runs as features for a network.

    Attributes:
        features: One of `FEATURE_SETS`.
        robot: The robot.
        healthy: Healthy behaviour that the robust features expect, such as a calibration.
    """

    features: str
    robot: Robot
    healthy: Imperfections = NO_IMPERFECTIONS

    def __post_init__(self) -> None:
        if self.features not in FEATURE_SETS:
            raise unknown_name("feature set", self.features, FEATURE_SETS)
        sliding = [joint.name for joint in self.robot.chain.joints if joint.prismatic]
        if sliding and self.features == "robust":
            raise InputError(
                f"robust features know joints that turn, and {', '.join(sliding)} of "
                f"{self.robot.name!r} slides. Use another method."
            )

    def encode(self, signals: Signals) -> Floats:
        """Return features (run, point, channel)."""
        if self.features == "robust":
            return self.residuals(signals).astype(np.float32)
        if self.features == "original":
            return original_features(signals).astype(np.float32)
        return augmented_features(DigitalTwin(self.robot), signals).astype(np.float32)

    def residuals(self, signals: Signals) -> FloatArray:
        """Return residuals in motor space, the robust features, (run, point, channel)."""
        index, seen = _points(signals)
        run, known = np.arange(len(index))[:, None], seen[..., None]
        pose = self._healthy_pose(signals, index)
        rotation, point = self.robot.chain.frames(pose * self.robot.sensor_sense)
        origin, axis, tool = point[..., :-1, :], rotation[..., :-1, :, 2], point[..., -1, :]
        measured = np.where(known, signals.measured[run, index], tool)
        turn, misfit = _explained(origin, axis, tool, measured)
        turn = turn * self.robot.sensor_sense
        off = _compressed(measured - tool, DISTANCE_M) * known
        turned, left = _compressed(turn, TURN_RAD), _compressed(misfit, DISTANCE_M)
        where = (turned * known, left * known, (pose + turn) * known, pose)
        per_motor = np.stack(where, axis=-1)
        return np.concatenate([per_motor.reshape(*pose.shape[:2], -1), off, known], axis=-1)

    def _healthy_pose(self, signals: Signals, index: IntArray) -> FloatArray:
        """Return the pose of a healthy arm at samples `index`, (run, point, motor) [rad]."""
        command, lag = signals.command, mean_lag_s(self.robot, self.healthy)
        place = np.maximum(index[..., None] - lag / signals.step, 0.0)
        low = place.astype(np.int64)
        high = np.minimum(low + 1, command.shape[1] - 1)
        run, motor = np.arange(len(index))[:, None, None], np.arange(command.shape[2])
        before, after = command[run, low, motor], command[run, high, motor]
        pose = before + (place - low) * (after - before)
        direction = _direction(command)[run, low, motor]
        settling = self.healthy.settling or Settling.ideal(len(lag))
        return pose + settling.offset(self.robot, pose, direction)
