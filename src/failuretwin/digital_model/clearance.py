"""How near an arm comes to the floor and to itself: its links as capsules round straight lines.

    gap of links i, j = distance of their lines - 2 radius

No URDF is asked for shapes, and the physics engine knows no contacts: a link is the line from one
joint to the next, the base that from its frame to the first joint, all of one radius. Links that
join, or that lie side by side in most poses of the arm's own movements, are not pairs.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from failuretwin.core.types import FloatArray, IntArray
from failuretwin.digital_model.kinematics import SerialChain
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import poses_in_range

RADIUS_OF_REACH = 0.04
"""Radius of links as a share of the arm's reach; assumed: 12 mm of an arm of 0.3 m, 5 cm of one of
1.3 m."""
OFTEN = 0.2
"""Links that come nearer than their radii in so many poses of healthy movements are neighbours."""
SHORTEST_LINK = 1e-6
"""Joints that share a place have no link between them [m]."""


@dataclass(frozen=True)
class Clearance:
    """Gaps of the links of a robot, in the physical sense of its angles and the frame of its base.

    Attributes:
        robot: The robot.
        radius_m: Radius of its links [m].
        floor_m: Height below which no joint and no tool may come, in the base frame [m].
    """

    robot: Robot
    radius_m: float
    floor_m: float = 0.0

    @classmethod
    def of(
        cls, robot: Robot, radius_m: float | None = None, floor_m: float | None = None
    ) -> Clearance:
        """Return that of a robot.

        Args:
            robot: The robot.
            radius_m: Radius of its links [m]; None: by its reach.
            floor_m: Height of the floor [m]; None: that of its base, or of its lowest joint where
                that lies lower.
        """
        if radius_m is None:
            radius_m = RADIUS_OF_REACH * robot.reach
        if floor_m is None:
            fixed = joint_points(robot.loads.chain, np.zeros(len(robot.motors)))[1, 2]
            floor_m = min(0.0, float(fixed))
        return cls(robot, radius_m, floor_m)

    @cached_property
    def pairs(self) -> IntArray:
        """Links that must keep apart, (pair, 2): 0 is the base, the last carries the tool."""
        points = joint_points(self.robot.loads.chain, poses_in_range(self.robot))
        length = np.linalg.norm(np.diff(points, axis=-2), axis=-1).max(axis=0)
        links = np.flatnonzero(length > SHORTEST_LINK)
        some = [(i, j) for a, i in enumerate(links) for j in links[a + 2 :]]
        if not some:
            return np.zeros((0, 2), dtype=np.int64)
        found = np.array(some)
        close = self._distances(points, found) < 2.0 * self.radius_m
        return found[close.mean(axis=0) < OFTEN]

    @cached_property
    def _first_moved(self) -> int:
        """Index of the first point that any joint moves."""
        points = joint_points(self.robot.loads.chain, poses_in_range(self.robot))
        moved = np.ptp(points, axis=0).max(axis=-1) > SHORTEST_LINK
        return int(np.argmax(moved))

    def points(self, pose: FloatArray) -> FloatArray:
        """Return base, joints and tool, (..., point, 3) [m], of poses in the log's sense."""
        return joint_points(self.robot.loads.chain, pose * self.robot.sense)

    def gap(self, pose: FloatArray) -> FloatArray:
        """Return the least gap between links, (...) [m]; below 0 they touch.

        Args:
            pose: Angles in the log's sense, (..., motor) [rad].
        """
        return self._gap(self.points(pose))

    def height(self, pose: FloatArray) -> FloatArray:
        """Return how far the lowest moving joint or the tool is above the floor, (...) [m]."""
        return self._height(self.points(pose))

    def gap_and_height(self, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return both, each (...) [m], for poses (..., motor) [rad]."""
        points = self.points(pose)
        return self._gap(points), self._height(points)

    def margin(self, pose: FloatArray) -> FloatArray:
        """Return the lesser of gap and height, (...) [m]; below 0 a pose is not allowed."""
        return np.minimum(*self.gap_and_height(pose))

    def _gap(self, points: FloatArray) -> FloatArray:
        if len(self.pairs) == 0:
            return np.full(points.shape[:-2], np.inf)
        apart = self._distances(points, self.pairs)
        return np.asarray(apart.min(axis=-1) - 2.0 * self.radius_m)

    def _height(self, points: FloatArray) -> FloatArray:
        z = points[..., self._first_moved :, 2]
        return np.asarray(z.min(axis=-1) - self.floor_m)

    def _distances(self, points: FloatArray, pairs: IntArray) -> FloatArray:
        """Return how far the lines of pairs of links are apart, (..., pair) [m]."""
        a, b = pairs.T
        return segment_distance(
            points[..., a, :], points[..., a + 1, :], points[..., b, :], points[..., b + 1, :]
        )


def joint_points(chain: SerialChain, q: FloatArray) -> FloatArray:
    """Return base, joints and tool as points, (..., joint + 2, 3) [m], for q (..., joint)."""
    rotation, origin = chain.frames(q)
    base = np.zeros((*q.shape[:-1], 1, 3))
    points = np.concatenate([base, origin], axis=-2)
    slides = np.array([float(joint.prismatic) for joint in chain.joints])
    points[..., 1:-1, :] += (slides * q)[..., None] * rotation[..., :-1, :, 2]
    return points


def segment_distance(
    start_a: FloatArray, end_a: FloatArray, start_b: FloatArray, end_b: FloatArray
) -> FloatArray:
    """Return the least distance of straight lines of given ends, (...) [m].

    The nearest points of two lines are found on both without ends, then brought back to the ends,
    first on a, then on b, then on a again; exact for lines that have a length.

    Args:
        start_a: (..., 3) [m]; the others alike.
        end_a: The other end of the first.
        start_b: One end of the second.
        end_b: The other end of it.
    """
    along_a, along_b, between = end_a - start_a, end_b - start_b, start_a - start_b
    aa, bb = _dot(along_a, along_a), _dot(along_b, along_b)
    ab, a0, b0 = _dot(along_a, along_b), _dot(along_a, between), _dot(along_b, between)
    crossing = aa * bb - ab**2
    safe = np.where(crossing > 1e-12 * aa * bb, crossing, np.inf)
    s = np.clip((ab * b0 - a0 * bb) / safe, 0.0, 1.0)
    t = np.clip((ab * s + b0) / np.maximum(bb, 1e-18), 0.0, 1.0)
    s = np.clip((ab * t - a0) / np.maximum(aa, 1e-18), 0.0, 1.0)
    gap = between + s[..., None] * along_a - t[..., None] * along_b
    return np.sqrt(_dot(gap, gap))


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(np.sum(a * b, axis=-1))
