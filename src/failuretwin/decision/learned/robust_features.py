"""Features that carry over to a real robot: what each motor alone would have to be off by.

Every reading is compared with where a healthy arm would be: commands with the mean lag, sag and
friction of the calibration. For each motor, the turn that brings the tool nearest to the reading
(exact: a joint moves the tool on a circle) and what no turn of this motor explains tell which motor
it is; both are compressed, so that a glitch is only a little larger than a fault. Points without a
reading are zero and marked by a mask.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.decision.learned.paper_features import POINTS
from failuretwin.decision.learned.signals import Signals
from failuretwin.digital_model.imperfections import Imperfections
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import Settling

PER_MOTOR = ("turn", "misfit", "angle", "command")
"""Channels of each motor; those of the first motor come first."""
SHARED = ("x", "y", "z", "seen")
"""Channels that belong to no motor, after those of the motors."""

TURN_RAD = 0.01
"""Turns below this are shown in proportion, larger ones by their logarithm [rad]: 2.4 counts."""
DISTANCE_M = 0.002
"""The same for distances [m]: what half a degree does at the length of the arm."""
DAMPING_M = 0.003
"""A tool this near to a joint's axis says half of nothing about the joint's turn [m]."""


@dataclass(frozen=True)
class Expectation:
    """Where a healthy arm is expected to be: all of a calibration that features make use of.

    Attributes:
        name: Name of the calibration.
        protocol: How much real data it has seen.
        lag_s: Mean time by which each motor runs behind its command, (motor,) [s].
        settling: Where motors settle.
    """

    name: str
    protocol: str
    lag_s: tuple[float, ...]
    settling: Settling


def expectation_of(robot: Robot, imperfections: Imperfections) -> Expectation:
    """Return what is expected of a healthy robot with some imperfections."""
    timing = imperfections.timing
    common = float(np.mean(timing.delay_s) + np.mean(timing.lag_s))
    # 1 / I: delay of the loop (P s + I) / (s (tau s + 1)^2 + P s + I) at low frequency.
    lag = tuple(common + 1.0 / motor.loop.I for motor in robot.motors)
    settling = imperfections.settling or Settling.ideal(len(lag))
    return Expectation(imperfections.name, imperfections.protocol, lag, settling)


@dataclass(frozen=True)
class RobustFeatures:
    """Turns a run into 100 points of residuals in motor space.

    Attributes:
        robot: Kinematics and masses.
        expected: Where a healthy arm is expected to be.
    """

    robot: Robot
    expected: Expectation

    def __post_init__(self) -> None:
        sliding = [joint.name for joint in self.robot.chain.joints if joint.prismatic]
        if sliding:
            raise InputError(
                f"robust features know joints that turn, and {', '.join(sliding)} of "
                f"{self.robot.name!r} slides. Use another method."
            )

    def __call__(self, signals: Signals) -> FloatArray:
        """Return the features, (run, point, channel), each of about unit size."""
        index, seen = _points(signals)
        run = np.arange(len(index))[:, None]
        pose = self._healthy_pose(signals, index)
        origin, axis, tool = joint_frames(self.robot, pose * self.robot.sensor_sense)
        measured = np.where(seen[..., None], signals.measured[run, index], tool)
        turn, misfit = _explained(origin, axis, tool, measured)
        turn = turn * self.robot.sensor_sense
        off = _compressed(measured - tool, DISTANCE_M) * seen[..., None]
        known = seen[..., None]
        per_motor = np.stack(
            [
                _compressed(turn, TURN_RAD) * known,
                _compressed(misfit, DISTANCE_M) * known,
                (pose + turn) * known,
                pose,
            ],
            axis=-1,
        )
        flat = per_motor.reshape(*pose.shape[:2], -1)
        return np.concatenate([flat, off, seen[..., None]], axis=-1)

    def _healthy_pose(self, signals: Signals, index: IntArray) -> FloatArray:
        """Return where a healthy arm would be at some samples, (run, point, motor) [rad]."""
        command, lag = signals.command, np.asarray(self.expected.lag_s)
        place = np.maximum(index[..., None] - lag / signals.step, 0.0)
        low = place.astype(np.int64)
        high = np.minimum(low + 1, command.shape[1] - 1)
        run, motor = np.arange(len(index))[:, None, None], np.arange(command.shape[2])
        before, after = command[run, low, motor], command[run, high, motor]
        pose = before + (place - low) * (after - before)
        direction = _direction(command)[run, low, motor]
        return pose + self.expected.settling.offset(self.robot, pose, direction)


def _points(signals: Signals) -> tuple[IntArray, FloatArray]:
    """Return the sample of each point (run, point), and 1 where it is a reading, else 0.

    Points divide the length of a run evenly; of several readings in one the last counts.
    """
    runs = len(signals.command)
    last = np.floor(signals.duration[:, None] / signals.step + 1e-6)  # sample of each run
    share = np.arange(len(signals.time)) / np.maximum(last, 1.0)
    index = ((np.arange(POINTS) + 0.5) / POINTS * last).astype(np.int64)
    seen = np.zeros((runs, POINTS))
    run, sample = np.nonzero(signals.seen)
    point = np.minimum((share[run, sample] * POINTS).astype(np.int64), POINTS - 1)
    index[run, point] = sample  # the last of several stays
    seen[run, point] = 1.0
    return index, seen


def _direction(command: FloatArray) -> FloatArray:
    """Return the sign of each motor's last travel, (run, time, motor); 0 before the first."""
    sign = np.zeros_like(command)
    sign[:, 1:] = np.sign(np.diff(command, axis=1))
    when = np.where(sign != 0.0, np.arange(command.shape[1])[:, None], 0)
    last = np.maximum.accumulate(when, axis=1)
    return np.take_along_axis(sign, last, axis=1)


def joint_frames(robot: Robot, pose: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return where the joints are and point to, and where the tool is, in the base frame.

    Args:
        robot: Its chain; joints that slide are not supported.
        pose: Angles that the tool sensor's path belongs to, (..., motor) [rad].

    Returns:
        Origins (..., motor, 3) [m], unit axes (..., motor, 3) and tool points (..., 3) [m].
    """
    lead = pose.shape[:-1]
    rotation = np.broadcast_to(np.eye(3), (*lead, 3, 3))
    point = np.zeros((*lead, 3))
    origins, axes = [], []
    for joint, angle in zip(robot.chain.joints, np.moveaxis(pose, -1, 0), strict=True):
        point = point + rotation @ joint.T_pj[:3, 3]
        rotation = rotation @ joint.T_pj[:3, :3]
        origins.append(point)
        axes.append(rotation[..., :, 2])
        c, s = np.cos(angle)[..., None], np.sin(angle)[..., None]
        x, y = rotation[..., :, 0], rotation[..., :, 1]
        rotation = np.stack([c * x + s * y, c * y - s * x, rotation[..., :, 2]], axis=-1)
    tool = point + rotation @ robot.chain.T_jt[:3, 3]
    return np.stack(origins, axis=-2), np.stack(axes, axis=-2), tool


def _explained(
    origin: FloatArray, axis: FloatArray, tool: FloatArray, measured: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the turn of each joint that brings the tool nearest, and the distance left.

    Returns:
        (..., joint) [rad] and (..., joint) [m].
    """
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
