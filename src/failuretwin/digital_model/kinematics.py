"""Serial chains in batches: tool position, Jacobian, joint frames, gravity torques and reach.

Every joint turns about (or slides along) the z axis of its own frame; between two such frames lies
a constant transform. Position and Jacobian are carried from the tip to the base as three
coordinates; entries of the constants that are 0 or 1 cost nothing.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.types import FloatArray, as_floats

# Vectors of three coordinates, each a number or an array over poses.

Scalar = float | FloatArray
"""A coordinate: common to all poses (float) or one per pose (array)."""
Vector = tuple[Scalar, Scalar, Scalar]
Scalars = FloatArray | Sequence[float]
"""One number per joint, or per joint and pose."""

GRAVITY = 9.81
"""Acceleration of free fall, along -z of the base [m/s2]."""

CHUNK = 8000
"""Poses per block: 64 kB an array, so that the working set stays in the second-level cache."""


def _chunks(count: int) -> Iterator[slice]:
    """Return slices of `CHUNK` that cover `count` poses."""
    return (slice(start, start + CHUNK) for start in range(0, count, CHUNK))


def _scale(factor: float, value: Scalar) -> Scalar:
    """Return `factor` times `value`."""
    if factor == 0.0 or (isinstance(value, float) and value == 0.0):
        return 0.0
    if factor == 1.0:
        return value
    return -value if factor == -1.0 else factor * value


def _add(a: Scalar, b: Scalar) -> Scalar:
    """Return `a` plus `b`."""
    if isinstance(a, float) and a == 0.0:
        return b
    if isinstance(b, float) and b == 0.0:
        return a
    return a + b


def _times(factor: Scalar, vector: FloatArray) -> Vector:
    x, y, z = (factor * value if value else 0.0 for value in vector.tolist())
    return x, y, z


def _plus(a: Vector, b: Vector) -> Vector:
    return _add(a[0], b[0]), _add(a[1], b[1]), _add(a[2], b[2])


def _turn(T: FloatArray, v: Vector) -> Vector:
    """Return the direction `v` turned by the constant transform `T`."""
    rows = T[:3, :3].tolist()
    x, y, z = (_add(_add(_scale(r[0], v[0]), _scale(r[1], v[1])), _scale(r[2], v[2])) for r in rows)
    return x, y, z


def _move(T: FloatArray, v: Vector) -> Vector:
    """Return the point `v` moved by the constant transform `T`."""
    x, y, z = T[:3, 3].tolist()
    return _plus(_turn(T, v), (x, y, z))


def _spin(c: Scalar, s: Scalar, v: Vector) -> Vector:
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
        axis: Axis of the joint in the frame that the URDF gives it; z of the joint frame here.
        low: Lower limit [rad or m]; -inf when unlimited.
        high: Upper limit [rad or m]; inf when unlimited.
    """

    name: str
    prismatic: bool
    T_pj: FloatArray
    low: float = -np.inf
    high: float = np.inf
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)

    @cached_property
    def to_urdf(self) -> FloatArray:
        """Rotation (3, 3) of this frame in the frame that the URDF gives the joint."""
        return rotation_to_z(self.axis)


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
        """Return tool positions (..., 3) [m], base frame, for `q` (..., joint) [rad or m]."""
        flat = self._flatten(q)
        out = np.empty((len(flat), 3))
        for rows in _chunks(len(flat)):
            point, _ = self._carry(flat[rows].T.copy(), derivatives=False)
            for axis in range(3):
                out[rows, axis] = point[axis]
        return out.reshape(*np.shape(q)[:-1], 3)

    def position_and_jacobian(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return tool positions (..., 3) [m] and Jacobians (..., 3, joint) [m/rad or m/m].

        Both are in the base frame; `q` are joint values in chain order, (..., joint) [rad or m].
        """
        flat = self._flatten(q)
        point_out = np.empty((len(flat), 3))
        jacobian = np.empty((len(flat), 3, len(self.joints)))
        for rows in _chunks(len(flat)):
            point, columns = self._carry(flat[rows].T.copy(), derivatives=True)
            for axis in range(3):
                point_out[rows, axis] = point[axis]
                for j, column in enumerate(columns):
                    jacobian[rows, axis, j] = column[axis]
        lead = np.shape(q)[:-1]
        return point_out.reshape(*lead, 3), jacobian.reshape(*lead, 3, len(self.joints))

    def frames(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the frames of all joints, before each moves, and of the tool, in the base frame.

        Joint values are in chain order, (..., joint) [rad or m].

        Returns:
            Rotations (..., joint + 1, 3, 3), whose third column is the joint's axis, and origins
            (..., joint + 1, 3) [m]; the last ones are those of the tool frame.
        """
        found = np.moveaxis(self.frames_by_joint(q), -1, 0).reshape(*np.shape(q)[:-1], -1, 4, 3)
        return np.swapaxes(found[..., :3, :], -1, -2), found[..., 3, :]

    def frames_by_joint(self, q: FloatArray) -> FloatArray:
        """Return x, y, z axis and origin of joints and tool, (joint + 1, 4, coordinate, pose)."""
        values = self._flatten(q).T
        count = values.shape[1]
        cosine, sine = np.cos(values), np.sin(values)
        found = np.empty((len(self.joints) + 1, 4, 3, count))
        here = np.zeros((4, 3, count))
        here[[0, 1, 2], [0, 1, 2]] = 1.0
        for j, T in enumerate([*(joint.T_pj for joint in self.joints), self.T_jt]):
            np.matmul(T.T, here.reshape(4, -1), out=found[j].reshape(4, -1))
            if j == len(self.joints):
                break
            here = found[j].copy()
            if self.joints[j].prismatic:
                here[3] += values[j] * here[2]
            else:
                x, y = found[j, :2]
                here[0], here[1] = cosine[j] * x + sine[j] * y, cosine[j] * y - sine[j] * x
        return found

    def rotation_and_derivative(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the tool's rotation R (..., 3, 3) in the base frame and dR/dq (..., 3, 3, joint).

        dR/dq_j = [axis_j]x R [1/rad]; 0 for a joint that slides. Joint values are in chain order,
        (..., joint) [rad or m].
        """
        frames, lead = self.frames_by_joint(q), np.shape(q)[:-1]
        turns = np.array([float(not joint.prismatic) for joint in self.joints])
        tool, axis = frames[-1, :3], frames[:-1, 2] * turns[:, None, None]
        slope = cross(axis[:, None], tool, -2)  # (joint, tool axis, coordinate, pose)
        shape = (*lead, 3, 3)
        return tool.T.reshape(shape), slope.transpose(3, 2, 1, 0).reshape(*shape, -1)

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

        Each derivative starts at its joint as a simple vector; the joints below turn it like any
        direction.
        """
        point: Vector = tuple(float(x) for x in self.T_jt[:3, 3])  # type: ignore[assignment]
        columns: list[Vector] = []
        for joint, value in zip(reversed(self.joints), q[::-1], strict=True):
            tangent: Vector = (0.0, 0.0, 1.0)
            if joint.prismatic:
                point = (point[0], point[1], _add(point[2], value))
            else:
                c, s = np.cos(value), np.sin(value)
                point = _spin(c, s, point)
                columns = [_spin(c, s, column) for column in columns]
                tangent = (_scale(-1.0, point[1]), point[0], 0.0)
            if derivatives:
                columns = [_turn(joint.T_pj, column) for column in (tangent, *columns)]
            point = _move(joint.T_pj, point)
        return point, columns


def cross(a: FloatArray, b: FloatArray, axis: int = -1) -> FloatArray:
    """Return a x b of vectors along `axis`, with less overhead than `numpy.cross`."""
    (ax, ay, az), (bx, by, bz) = np.moveaxis(a, axis, 0), np.moveaxis(b, axis, 0)
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis)


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


@dataclass(frozen=True)
class Loads:
    """Masses carried by the joints of a chain.

    Attributes:
        chain: The chain from base to tool.
        mass: Mass between each joint and the next, (joint,) [kg].
        centre: Its centre in the frame that turns with the joint, (joint, 3) [m].
    """

    chain: SerialChain
    mass: FloatArray
    centre: FloatArray

    def torque(self, q: FloatArray, payload: FloatArray | float = 0.0) -> FloatArray:
        """Return the torque of gravity on every joint, (..., joint) [N m or N].

        Args:
            q: Joint values in the physical sense, (..., joint) [rad or m].
            payload: Mass at the tool point, () or the leading axes of `q` [kg].
        """
        q = as_floats(q)
        flat = q.reshape(-1, q.shape[-1])
        carried = np.broadcast_to(payload, q.shape[:-1]).reshape(-1) if np.any(payload) else None
        if len(flat) == 1:  # plain numbers: ten times as fast as arrays of one
            extra = 0.0 if carried is None else float(carried[0])
            value, cosine, sine = (x[0].tolist() for x in (flat, np.cos(flat), np.sin(flat)))
            return as_floats(self._carry(value, cosine, sine, extra)).reshape(q.shape)
        out = np.empty_like(flat)
        for rows in _chunks(len(flat)):
            own = flat[rows].T.copy()
            mass = 0.0 if carried is None else carried[rows]
            for joint, value in enumerate(self._carry(own, np.cos(own), np.sin(own), mass)):
                out[rows, joint] = value
        return out.reshape(q.shape)

    def _carry(self, q: Scalars, cosine: Scalars, sine: Scalars, payload: Scalar) -> list[Scalar]:
        """Return the torque of each joint for `q`, its cosine and sine, (joint, pose) or (joint,).

        Gravity is carried from base to tip, mass times position from tip to base; the torque is
        their cross product about the joint's axis.
        """
        down = self._gravity(cosine, sine)
        mass = payload
        moment = _times(payload, self.chain.T_jt[:3, 3])
        torque: list[Scalar] = []
        for j in reversed(range(len(q))):
            joint = self.chain.joints[j]
            mass = _add(mass, float(self.mass[j]))
            moment = _plus(moment, _times(float(self.mass[j]), self.centre[j]))
            if joint.prismatic:
                torque.append(mass * down[j][2])
                moment = (moment[0], moment[1], _add(moment[2], mass * q[j]))
            else:
                moment = _spin(cosine[j], sine[j], moment)
                torque.append(_add(moment[0] * down[j][1], -(moment[1] * down[j][0])))
            moment = _plus(_turn(joint.T_pj, moment), _times(mass, joint.T_pj[:3, 3]))
        return torque[::-1]

    def _gravity(self, cosine: Scalars, sine: Scalars) -> list[Vector]:
        """Return gravity in the frame of each joint before it turns [m/s2]."""
        here: Vector = (0.0, 0.0, -GRAVITY)
        seen = []
        for joint, c, s in zip(self.chain.joints, cosine, sine, strict=True):
            here = _turn(joint.T_pj.T, here)
            seen.append(here)
            if not joint.prismatic:
                here = _spin(c, -s, here)
        return seen


# Levers and reach, by random poses.

POSES = 256
SEED = 0
"""Fixed, so that reports are reproducible."""

CANNOT_MOVE = 1e-9
"""Largest lever arm that is rounding error [m/rad or m/m]."""

FREE_RANGE = np.pi
"""Range on either side of zero for a joint without limits [rad or m]."""

ASCENT_STEPS = 100


def has_range(low: float, high: float) -> bool:
    """Return whether limits form a range; exporters write 0 and 0 for unknown ones."""
    return bool(np.isfinite(low) and np.isfinite(high) and low < high)


def levers(chain: SerialChain) -> FloatArray:
    """Return the largest tool speed per unit speed of each joint, (joint,) [m/rad, m/m]."""
    _, jacobian = chain.position_and_jacobian(_poses(chain)[2])
    return np.linalg.norm(jacobian, axis=-2).max(axis=0)


def idle_axes(chain: SerialChain) -> tuple[bool, bool, bool]:
    """Return the axes of the base along which no joint moves the tool."""
    _, jacobian = chain.position_and_jacobian(_poses(chain)[2])
    x, y, z = (np.abs(jacobian).max(axis=(0, 2)) < CANNOT_MOVE).tolist()
    return x, y, z


def farthest_reach(chain: SerialChain) -> float:
    """Return the largest distance of the tool from the base frame's origin found [m].

    Gradient ascent from random poses within the limits.
    """
    low, high, poses = _poses(chain)
    scale, farthest = 1.0, 0.0
    for step in np.linspace(1.0, 0.01, ASCENT_STEPS):
        point, jacobian = chain.position_and_jacobian(poses)
        distance = np.linalg.norm(point, axis=-1)
        scale = scale if farthest else float(distance.max()) or 1.0
        farthest = max(farthest, float(distance.max()))
        outward = point / np.maximum(distance, 1e-12)[:, None]
        slope = np.einsum("pa,paj->pj", outward, jacobian)
        poses = np.clip(poses + step * slope / scale, low, high)
    return farthest


def _poses(chain: SerialChain) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return lowest and highest joint values (joint,) and random poses between (pose, joint)."""
    limits = [(joint.low, joint.high) for joint in chain.joints]
    tried = [span if has_range(*span) else (-FREE_RANGE, FREE_RANGE) for span in limits]
    low, high = np.array(tried).T
    return low, high, np.random.default_rng(SEED).uniform(low, high, (POSES, len(low)))
