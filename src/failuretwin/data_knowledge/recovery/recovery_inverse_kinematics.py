"""Whole servo units out of tool positions, for arms that turn about one axis and bend in a plane.

The first joint turns a plane that contains its axis; three more joints bend the arm within this
plane. A tool position then gives the first motor by its direction, and of the three others two
are enumerated and one is solved. In the plane, points are complex numbers: radius + i height.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from failuretwin.core.errors import InputError
from failuretwin.core.types import BoolArray, FloatArray, ServoUnits
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin

ComplexArray = NDArray[np.complex128]

EXACT_M = 1e-9
"""Two tool positions this near are the same [m]; published paths are exact to 1e-15 m."""
PLANE_TOLERANCE = 1e-9
"""What an axis or an offset of a chain may be off by [rad or m]."""
MOTORS = 4
"""Motors of such an arm: one turns the plane, three bend the arm within it."""


@dataclass(frozen=True)
class Counts:
    """Whole servo units of every motor that are searched.

    Attributes:
        low: Lowest, (motor,).
        high: Highest, (motor,).
    """

    low: FloatArray
    high: FloatArray

    def hold(self, counts: FloatArray) -> BoolArray:
        """Return which rows of `counts` (..., motor) lie within; NaN counts as within."""
        outside = (counts < self.low) | (counts > self.high)
        return np.asarray(~outside.any(axis=-1))


@dataclass(frozen=True)
class PlaneArm:
    """An arm whose first joint turns a plane and whose other joints bend within it.

    Attributes:
        robot: The robot.
        origin: A point on the first axis, (axis,) [m].
        radial: Direction of the plane's radius while motor 1 is at zero, (axis,).
        sideways: Direction into which motor 1 turns the radius, (axis,).
        height: Direction of the first axis, (axis,).
        shoulder: Where the second joint is in the plane [m].
        links: From the second, third and fourth joint to the next one or the tool, at zero, [m].
        sense: Angle in the plane = sense * angle in the log, (motor,).
    """

    robot: Robot
    origin: FloatArray
    radial: FloatArray
    sideways: FloatArray
    height: FloatArray
    shoulder: complex
    links: tuple[complex, complex, complex]
    sense: FloatArray

    @property
    def units(self) -> ServoUnits:
        """Count scale of the motors."""
        return self.robot.servo_units

    @cached_property
    def movement_counts(self) -> Counts:
        """Units within the ranges of random movements."""
        return _whole_counts(self.units, [motor.movement_range for motor in self.robot.motors])

    @cached_property
    def all_counts(self) -> Counts:
        """Units within the joints' limits: a run may begin outside the movements' range."""
        limits = [
            (joint.low * motor.sense, joint.high * motor.sense)
            for joint, motor in zip(self.robot.chain.joints, self.robot.motors, strict=True)
        ]
        return _whole_counts(self.units, limits)

    def whole_poses(self, point: FloatArray) -> FloatArray:
        """Return the poses in whole units whose tool is at `point`.

        The ranges of random movements are searched first, and only where they hold no pose the
        limits of the joints. Within the former an arm that turns by less than 90 deg to each side
        has one pose at most: its mirror image lies outside.

        Args:
            point: Tool position in the base frame, (axis,) [m].

        Returns:
            (pose, motor) [counts]; motor 1 is NaN where the tool is on its axis.
        """
        poses = self._search(point, self.movement_counts, self._movement_wrists)
        return poses if len(poses) else self._search(point, self.all_counts, self._all_wrists)

    def poses_with_last(
        self, point: FloatArray, last: FloatArray, slack: float = 0.0
    ) -> FloatArray:
        """Return the poses with the tool at `point` for given angles of the last motor.

        Args:
            point: Tool position in the base frame, (axis,) [m].
            last: Angles of the last motor, (angle,) [rad].
            slack: Also return stretched or folded arms that do not quite reach, by this share of
                the cosine of their third joint; first guesses where few angles are tried.

        Returns:
            Poses within the joints' limits, (pose, motor) [rad].
        """
        upper, fore, hand = self.links
        outer = fore + hand * np.exp(1j * self.sense[3] * last)
        found = [np.empty((0, MOTORS))]
        for turn, goal in self._sides(point):
            reach = goal - self.shoulder
            span = (abs(reach) ** 2 - abs(upper) ** 2 - np.abs(outer) ** 2) / (
                2.0 * abs(upper) * np.abs(outer)
            )
            near = np.abs(span) <= 1.0 + slack
            stretched = np.arccos(np.clip(span[near], -1.0, 1.0))
            for bend in (stretched, -stretched):
                elbow = bend - np.angle(outer[near]) + np.angle(upper)
                arm = upper + outer[near] * np.exp(1j * elbow)
                plane = np.stack(
                    [np.angle(reach / arm), _wrapped(elbow), self.sense[3] * last[near]], axis=-1
                )
                first = np.full((len(plane), 1), turn)
                found.append(np.concatenate([first, plane], axis=1) * self.sense)
        poses = np.concatenate(found)
        inside = self.all_counts.hold(self.units.to_counts(poses).round())
        return poses[inside]

    def turns(self, points: FloatArray) -> FloatArray:
        """Return motor 1's angle [rad] up to multiples of pi, (point,), for `points` (point, 3)."""
        across = points - self.origin
        return self.sense[0] * np.arctan2(across @ self.sideways, across @ self.radial)

    def radius(self, points: FloatArray) -> FloatArray:
        """Return the distance of `points` (..., 3) from the first axis, (...) [m]."""
        across = points - self.origin
        return np.hypot(across @ self.sideways, across @ self.radial)

    def _sides(self, point: FloatArray) -> list[tuple[float, complex]]:
        """Return the angle of the plane [rad] and the point in it, tool before or behind."""
        height = float((point - self.origin) @ self.height)
        radius = float(self.radius(point))
        if radius <= EXACT_M:
            return [(np.nan, complex(0.0, height))]
        turn = float(self.sense[0] * self.turns(point))
        behind = turn - np.copysign(np.pi, turn)
        return [(turn, complex(radius, height)), (behind, complex(-radius, height))]

    def _search(self, point: FloatArray, counts: Counts, wrists: ComplexArray) -> FloatArray:
        hand = self.links[2]
        found = [np.empty((0, MOTORS))]
        for turn, goal in self._sides(point):
            first = np.round(self.units.to_counts(self.sense[0] * turn))
            if first < counts.low[0] or first > counts.high[0]:
                continue
            left = goal - wrists
            distance = left.real**2 + left.imag**2
            rows, columns = np.nonzero(
                np.abs(distance - abs(hand) ** 2) <= 2.0 * abs(hand) * 2.0 * EXACT_M
            )
            whole = np.stack([rows + counts.low[1], columns + counts.low[2]], axis=-1)
            bent = (self.units.to_rad(whole) * self.sense[1:3]).sum(axis=1)
            last = np.angle(left[rows, columns] / hand * np.exp(-1j * bent)) * self.sense[3]
            last_counts = np.round(self.units.to_counts(last))
            found.append(np.column_stack([np.full(len(whole), first), whole, last_counts]))
        poses = np.concatenate(found)
        poses = poses[counts.hold(poses)]
        turned = np.where(np.isnan(poses), 0.0, poses)
        path = DigitalTwin(self.robot).path(self.units.to_rad(turned))
        return poses[np.linalg.norm(path - point, axis=1) <= 2.0 * EXACT_M]

    @cached_property
    def _movement_wrists(self) -> ComplexArray:
        return self._wrists(self.movement_counts)

    @cached_property
    def _all_wrists(self) -> ComplexArray:
        return self._wrists(self.all_counts)

    def _wrists(self, counts: Counts) -> ComplexArray:
        """Return where the fourth joint is for all units of motors 2 and 3, (unit, unit) [m]."""
        second, third = (
            np.exp(
                1j
                * self.sense[k]
                * self.units.to_rad(np.arange(counts.low[k], counts.high[k] + 1.0))
            )
            for k in (1, 2)
        )
        upper, fore, _ = self.links
        return self.shoulder + second[:, None] * (upper + fore * third)


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
    radial = np.cross(height, across)
    offsets = np.array([T[:3, 3] - origin for T in [*T_bj[1:], T_bt]])
    points = offsets @ radial + 1j * (offsets @ height)
    links = np.diff(points)
    return PlaneArm(
        robot=robot,
        origin=origin,
        radial=radial,
        sideways=-across,
        height=height,
        shoulder=complex(points[0]),
        links=(complex(links[0]), complex(links[1]), complex(links[2])),
        sense=np.concatenate([[1.0], np.sign(along)]) * robot.sensor_sense,
    )


def _other_kind(robot: Robot, reason: str) -> InputError:
    return InputError(
        f"robot {robot.name!r}: whole servo units cannot be searched, because {reason}. Expected a "
        "first axis and three parallel axes at right angles to it, all of turning joints. "
        "Use --approximate."
    )


def _whole_counts(units: ServoUnits, ranges: Sequence[tuple[float, float]]) -> Counts:
    ends = np.sort(units.to_counts(np.array(ranges)), axis=1)
    return Counts(
        low=np.maximum(np.ceil(ends[:, 0]), units.low),
        high=np.minimum(np.floor(ends[:, 1]), units.high),
    )


def _wrapped(angle: FloatArray) -> FloatArray:
    return (angle + np.pi) % (2.0 * np.pi) - np.pi
