"""Clearance of an arm to the floor and to itself: links as capsules around straight lines.

    gap of links i, j = distance of their lines - 2 radius

No shapes are read from the URDF: a link is the line from one joint to the next, the base that from
its frame to the first joint, all with one radius. Adjacent links, and links that are close in most
poses of the arm's own movements, are not compared.
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
"""Radius of links as a share of the arm's reach; assumed: 12 mm for an arm of 0.3 m, 5 cm for 1.3
m."""
OFTEN = 0.2
"""Share of healthy poses from which close links count as neighbours."""
SHORTEST_LINK = 1e-6
"""Shortest distance of joints that have a link between them [m]."""


@dataclass(frozen=True)
class Clearance:
    """Gaps between the links of a robot, in the base frame.

    Attributes:
        robot: The robot.
        radius_m: Radius of its links [m].
        floor_m: Lowest height of joints and tool in the base frame [m].
    """

    robot: Robot
    radius_m: float
    floor_m: float = 0.0

    @classmethod
    def of(
        cls, robot: Robot, radius_m: float | None = None, floor_m: float | None = None
    ) -> Clearance:
        """Return the clearance of a robot.

        The radius of its links [m] is by its reach where none is given; the floor is the base, or
        the lowest joint if it is lower.
        """
        if radius_m is None:
            radius_m = RADIUS_OF_REACH * robot.reach
        if floor_m is None:
            fixed = joint_points(robot.loads.chain, np.zeros(len(robot.motors)))[1, 2]
            floor_m = min(0.0, float(fixed))
        return cls(robot, radius_m, floor_m)

    @cached_property
    def pairs(self) -> IntArray:
        """Links to compare, (pair, 2): 0 is the base, the last carries the tool."""
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

    def gap_and_height(self, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the smallest gap between links and the lowest height above the floor.

        Both (...) [m], for poses (..., motor) in the log's sense [rad]; the height is that of the
        lowest moving joint or the tool.
        """
        points = self.points(pose)
        height = points[..., self._first_moved :, 2].min(axis=-1) - self.floor_m
        if len(self.pairs) == 0:
            return np.full(points.shape[:-2], np.inf), height
        apart = self._distances(points, self.pairs)
        return np.asarray(apart.min(axis=-1) - 2.0 * self.radius_m), height

    def margin(self, pose: FloatArray) -> FloatArray:
        """Return the smaller of gap and height, (...) [m]; negative for a forbidden pose."""
        return np.minimum(*self.gap_and_height(pose))

    def _distances(self, points: FloatArray, pairs: IntArray) -> FloatArray:
        """Return the distance of the lines of pairs of links, (..., pair) [m]."""
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
    """Return the distance of two straight segments, (...) [m], given their ends (..., 3) [m].

    The nearest points of the infinite lines are clipped to the ends, first on a, then on b, then on
    a again; exact for segments of nonzero length.
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
