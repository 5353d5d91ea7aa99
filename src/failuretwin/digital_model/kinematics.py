"""Kinematics of a serial chain, batched: tool position and its Jacobian.

Every joint turns about (or slides along) the z axis of its own frame; what lies between two such
frames is a constant transform. The tool point is carried from the tip to the base as three
coordinates, and entries of the constants that are 0 or 1 cost nothing.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.types import FloatArray, as_floats

# Vectors of three coordinates, each a number or an array over poses.

Scalar = float | FloatArray
"""A coordinate: the same for every pose (float) or one per pose (array)."""
Vector = tuple[Scalar, Scalar, Scalar]

CHUNK = 8000
"""Poses at a time: 64 kB an array, so that the working set stays in the second-level cache."""


def chunks(count: int) -> Iterator[slice]:
    """Return slices of `CHUNK` that cover `count` poses."""
    return (slice(start, start + CHUNK) for start in range(0, count, CHUNK))


def scale(factor: float, value: Scalar) -> Scalar:
    """Return `factor` times `value`."""
    if factor == 0.0 or (isinstance(value, float) and value == 0.0):
        return 0.0
    if factor == 1.0:
        return value
    return -value if factor == -1.0 else factor * value


def add(a: Scalar, b: Scalar) -> Scalar:
    """Return `a` plus `b`."""
    if isinstance(a, float) and a == 0.0:
        return b
    if isinstance(b, float) and b == 0.0:
        return a
    return a + b


def turn(T: FloatArray, v: Vector) -> Vector:
    """Return the direction `v` turned by the constant transform `T`."""
    rows = T[:3, :3].tolist()
    x, y, z = (add(add(scale(r[0], v[0]), scale(r[1], v[1])), scale(r[2], v[2])) for r in rows)
    return x, y, z


def move(T: FloatArray, v: Vector) -> Vector:
    """Return the point `v` moved by the constant transform `T`."""
    x, y, z = turn(T, v)
    offset = T[:3, 3].tolist()
    return add(x, offset[0]), add(y, offset[1]), add(z, offset[2])


def spin(c: FloatArray, s: FloatArray, v: Vector) -> Vector:
    """Return `v` turned about z by the angles with cosine `c` and sine `s`."""
    x, y, z = v
    x_zero = isinstance(x, float) and x == 0.0
    y_zero = isinstance(y, float) and y == 0.0
    if x_zero and y_zero:
        return v
    if x_zero:
        return -(s * y), c * y, z
    if y_zero:
        return c * x, s * x, z
    return c * x - s * y, s * x + c * y, z


@dataclass(frozen=True)
class Joint:
    """One moving joint of a chain, with its axis along z of the joint frame.

    Attributes:
        name: Name in the URDF.
        prismatic: True if it slides [m], False if it turns [rad].
        T_pj: Pose of the joint frame (at zero) in the frame of the joint before it, (4, 4).
        low: Lower limit [rad or m]; -inf when unlimited.
        high: Upper limit [rad or m]; inf when unlimited.
    """

    name: str
    prismatic: bool
    T_pj: FloatArray
    low: float = -np.inf
    high: float = np.inf


@dataclass(frozen=True)
class SerialChain:
    """A chain of joints from the base to the tool point.

    Attributes:
        joints: Moving joints from base to tool.
        T_jt: Pose of the tool frame in the frame of the last joint.
    """

    joints: tuple[Joint, ...]
    T_jt: FloatArray

    def __post_init__(self) -> None:
        if not self.joints:
            raise InputError("a chain needs one moving joint at least; this one has none.")

    def position(self, q: FloatArray) -> FloatArray:
        """Return tool positions in the base frame.

        Args:
            q: Joint values in chain order, (..., joint) [rad or m].

        Returns:
            (..., 3) [m].
        """
        flat = self._flatten(q)
        out = np.empty((len(flat), 3))
        for rows in chunks(len(flat)):
            point, _ = self._carry(flat[rows].T.copy(), derivatives=False)
            for axis in range(3):
                out[rows, axis] = point[axis]
        return out.reshape(*np.shape(q)[:-1], 3)

    def position_and_jacobian(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return tool positions (..., 3) [m] and their derivative by the joints.

        Args:
            q: Joint values in chain order, (..., joint) [rad or m].

        Returns:
            Positions (..., 3) [m] and Jacobians (..., 3, joint) [m/rad or m/m], base frame.
        """
        flat = self._flatten(q)
        point_out = np.empty((len(flat), 3))
        jacobian = np.empty((len(flat), 3, len(self.joints)))
        for rows in chunks(len(flat)):
            point, columns = self._carry(flat[rows].T.copy(), derivatives=True)
            for axis in range(3):
                point_out[rows, axis] = point[axis]
                for j, column in enumerate(columns):
                    jacobian[rows, axis, j] = column[axis]
        lead = np.shape(q)[:-1]
        return point_out.reshape(*lead, 3), jacobian.reshape(*lead, 3, len(self.joints))

    def _flatten(self, q: FloatArray) -> FloatArray:
        q = as_floats(q)
        if q.ndim == 0 or q.shape[-1] != len(self.joints):
            raise InputError(
                f"joint values have shape {q.shape}; the last axis must hold the "
                f"{len(self.joints)} joints {', '.join(joint.name for joint in self.joints)}."
            )
        return q.reshape(-1, len(self.joints))

    def _carry(self, q: FloatArray, *, derivatives: bool) -> tuple[Vector, list[Vector]]:
        """Carry the tool point from tip to base for `q` (joint, pose).

        Each derivative starts at its joint, where it is a simple vector, and is then turned like
        any direction by the joints below.
        """
        point: Vector = tuple(float(x) for x in self.T_jt[:3, 3])  # type: ignore[assignment]
        columns: list[Vector] = []
        for joint, value in zip(reversed(self.joints), q[::-1], strict=True):
            if joint.prismatic:
                columns = [turn(joint.T_pj, column) for column in columns]
                if derivatives:
                    columns.insert(0, turn(joint.T_pj, (0.0, 0.0, 1.0)))
                point = move(joint.T_pj, (point[0], point[1], add(point[2], value)))
            else:
                c, s = np.cos(value), np.sin(value)
                turned = spin(c, s, point)
                columns = [turn(joint.T_pj, spin(c, s, column)) for column in columns]
                if derivatives:
                    tangent = (scale(-1.0, turned[1]), turned[0], 0.0)
                    columns.insert(0, turn(joint.T_pj, tangent))
                point = move(joint.T_pj, turned)
        return point, columns


def rotation_to_z(axis: Sequence[float]) -> FloatArray:
    """Return the rotation (3, 3) whose third column is the unit vector along `axis`.

    For axes along x, y or z it holds only zeros and ones.
    """
    z = np.asarray(axis, dtype=np.float64)
    z = z / np.linalg.norm(z)
    helper = np.eye(3)[(int(np.argmax(np.abs(z))) + 1) % 3]
    x = helper - z * (helper @ z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])
