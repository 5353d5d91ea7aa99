"""Inverse kinematics in whole servo counts, for arms that turn about one axis and bend in a plane.

The first joint turns a plane that contains its axis; three parallel joints bend the arm within it.
A tool position and an angle of the last motor then give the other three in closed form (law of
cosines). In the plane, points are complex numbers: radius + i height.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.servo import ServoUnits
from failuretwin.digital_model.twin import DigitalTwin

EXACT_M = 1e-9
"""Largest distance of equal tool positions [m]; published paths are exact to 1e-15 m."""
STRETCHED = 1e-9
"""Rounding error of the cosine of a stretched arm's third joint."""
PLANE_TOLERANCE = 1e-9
"""Tolerance on axes and offsets of the plane [rad or m]."""
MOTORS = 4
"""Motors of the arm: one turns the plane, three bend the arm within it."""


@dataclass(frozen=True)
class Counts:
    """Range of whole servo counts, lowest and highest of every motor (motor,)."""

    low: FloatArray
    high: FloatArray

    def hold(self, counts: FloatArray) -> BoolArray:
        """Return which rows of `counts` (..., motor) lie within; NaN counts as within."""
        outside = (counts < self.low) | (counts > self.high)
        return np.asarray(~outside.any(axis=-1))

    @classmethod
    def within(cls, units: ServoUnits, ranges: Sequence[tuple[float, float]]) -> Counts:
        """Return the whole counts within ranges of angles [rad]."""
        ends = np.sort(units.to_counts(np.array(ranges)), axis=1)
        low, high = np.ceil(ends[:, 0]), np.floor(ends[:, 1])
        return cls(np.maximum(low, units.low), np.minimum(high, units.high))


@dataclass(frozen=True)
class PlaneArm:
    """An arm whose first joint turns a plane and whose other joints bend within it.

    Attributes:
        robot: The robot.
        origin: A point on the first axis, (axis,) [m].
        frame: Unit vectors at the zero of motor 1, (3, axis): radius of the plane, direction in
            which motor 1 turns it, first axis.
        shoulder: The second joint in the plane [m].
        links: From the second, third and fourth joint to the next one or the tool, at zero, [m].
        sense: Angle in the plane = sense * angle in the log, (motor,).
    """

    robot: Robot
    origin: FloatArray
    frame: FloatArray
    shoulder: complex
    links: tuple[complex, complex, complex]
    sense: FloatArray

    @property
    def units(self) -> ServoUnits:
        """Count scale of the motors."""
        return self.robot.servo_units

    @cached_property
    def movement_counts(self) -> Counts:
        """Counts within the ranges of random movements."""
        return Counts.within(self.units, [motor.movement_range for motor in self.robot.motors])

    @cached_property
    def all_counts(self) -> Counts:
        """Counts within the limits of the joints: a run may begin outside the movements' range."""
        joints = zip(self.robot.chain.joints, self.robot.motors, strict=True)
        limits = [(joint.low * motor.sense, joint.high * motor.sense) for joint, motor in joints]
        return Counts.within(self.units, limits)

    def whole_poses(self, point: FloatArray) -> FloatArray:
        """Return the poses in whole counts with the tool at `point`.

        The ranges of random movements are searched first, then the limits of the joints. An arm
        that turns by less than 90 deg to each side has at most one pose in the former, since its
        mirror image lies outside.

        Args:
            point: Tool position in the base frame, (axis,) [m].

        Returns:
            (pose, motor) [counts]; motor 1 is NaN where the tool is on its axis.
        """
        twin, on_axis = DigitalTwin(self.robot), self.radius(point) <= EXACT_M
        for counts in (self.movement_counts, self.all_counts):
            last = self.units.to_rad(np.arange(counts.low[-1], counts.high[-1] + 1.0))
            found = self.units.to_counts(np.nan_to_num(self.poses(point, last, STRETCHED)))
            whole = np.unique(found.round(), axis=0)
            reached = np.linalg.norm(twin.path(self.units.to_rad(whole)) - point, axis=1)
            whole = whole[(reached <= 2.0 * EXACT_M) & counts.hold(whole)]
            if len(whole):
                break
        whole[:, 0] = np.where(on_axis, np.nan, whole[:, 0])
        return whole

    def poses(self, point: FloatArray, last: FloatArray, slack: float = 0.0) -> FloatArray:
        """Return the poses with the tool at `point` for given angles of the last motor.

        Args:
            point: Tool position in the base frame, (axis,) [m].
            last: Angles of the last motor, (angle,) [rad].
            slack: Accepted excess of the third joint's cosine over 1: first guesses for few angles.

        Returns:
            Poses within the joints' limits, (pose, motor) [rad]; motor 1 is NaN where hidden.
        """
        upper, fore, hand = self.links
        last = self.sense[3] * last
        outer = fore + hand * np.exp(1j * last)
        found = [np.empty((0, MOTORS))]
        for turn, goal in self._sides(point):
            reach = goal - self.shoulder
            cosine = (abs(reach) ** 2 - abs(upper) ** 2 - np.abs(outer) ** 2) / (
                2.0 * abs(upper) * np.abs(outer)
            )
            stretched = np.arccos(np.clip(cosine, -1.0, 1.0))[np.abs(cosine) <= 1.0 + slack]
            near, wrist = (x[np.abs(cosine) <= 1.0 + slack] for x in (outer, last))
            for bend in (stretched, -stretched):
                elbow = bend - np.angle(near) + np.angle(upper)
                lift = np.angle(reach / (upper + near * np.exp(1j * elbow)))
                elbow = np.angle(np.exp(1j * elbow))
                found.append(np.stack([np.full_like(lift, turn), lift, elbow, wrist], axis=-1))
        poses = np.concatenate(found) * self.sense
        return poses[self.all_counts.hold(self.units.to_counts(poses).round())]

    def turns(self, points: FloatArray) -> FloatArray:
        """Return motor 1's angle [rad] up to multiples of pi, (point,), for `points` (point, 3)."""
        radial, sideways, _ = self.frame @ (points - self.origin).T
        return self.sense[0] * np.arctan2(sideways, radial)

    def radius(self, points: FloatArray) -> FloatArray:
        """Return the distance of `points` (..., 3) from the first axis, (...) [m]."""
        return np.linalg.norm(self.frame[:2] @ (points - self.origin).T, axis=0)

    def _sides(self, point: FloatArray) -> Iterator[tuple[float, complex]]:
        """Yield the angle of the plane [rad] and the point in it, tool in front and behind."""
        height, radius = float(self.frame[2] @ (point - self.origin)), float(self.radius(point))
        if radius <= EXACT_M:
            yield np.nan, complex(0.0, height)
            return
        turn = float(self.sense[0] * self.turns(point))
        yield turn, complex(radius, height)
        yield turn - np.copysign(np.pi, turn), complex(-radius, height)


def plane_arm(robot: Robot) -> PlaneArm:
    """Return `robot` as an arm that turns about one axis and bends in a plane.

    Raises:
        InputError: If it is another kind of arm or has no servo units.
    """
    joints = robot.chain.joints
    if len(joints) != MOTORS or any(joint.prismatic for joint in joints):
        raise _other_kind(robot, "it has not exactly four turning joints")
    T_bj = [joints[0].T_pj]
    for joint in joints[1:]:
        T_bj.append(T_bj[-1] @ joint.T_pj)
    T_bt = T_bj[-1] @ robot.chain.T_jt
    height, across = T_bj[0][:3, 2], T_bj[1][:3, 2]
    along = np.array([T[:3, 2] @ across for T in T_bj[1:]])
    if abs(height @ across) > PLANE_TOLERANCE or np.any(np.abs(np.abs(along) - 1.0) > 1e-12):
        raise _other_kind(robot, "its other axes are not all at right angles to the first")
    origin = T_bj[0][:3, 3]
    if abs((T_bt[:3, 3] - origin) @ across) > PLANE_TOLERANCE:
        raise _other_kind(robot, "its tool lies beside the plane that the first axis turns")
    frame = np.stack([np.cross(height, across), -across, height])
    radial, _, upward = frame @ np.array([T[:3, 3] - origin for T in [*T_bj[1:], T_bt]]).T
    points = radial + 1j * upward
    upper, fore, hand = np.diff(points).tolist()
    sense = np.concatenate([[1.0], np.sign(along)]) * robot.sensor_sense
    return PlaneArm(robot, origin, frame, complex(points[0]), (upper, fore, hand), sense)


def _other_kind(robot: Robot, reason: str) -> InputError:
    return InputError(
        f"robot {robot.name!r}: whole servo units cannot be searched, because {reason}. Expected a "
        "first axis and three parallel axes at right angles to it, all of turning joints. "
        "Use --approximate."
    )
