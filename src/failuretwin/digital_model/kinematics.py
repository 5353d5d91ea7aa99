"""Serial chains in batches: tool position, Jacobian, joint frames, gravity torques and reach.

Every joint turns about (or slides along) the z axis of its own frame; between two such frames lies
a constant transform. Frames are carried from the base to the tool, one pose after the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from failuretwin.core.compiled import compiled
from failuretwin.core.errors import InputError
from failuretwin.core.types import BoolArray, FloatArray, as_floats

GRAVITY = 9.81
"""Acceleration of free fall, along -z of the base [m/s2]."""


Frame = tuple[float, float, float, float, float, float, float, float, float, float, float, float]
"""Unit vectors along x, y and z of a frame, then its origin [m]: single numbers, which the compiler
keeps in registers."""


@compiled
def _base() -> Frame:
    return 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0


@compiled
def _advanced(frame: Frame, T: FloatArray) -> Frame:
    """Return the frame behind a constant transform."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz, px, py, pz = frame
    a, b, c = T[0, 0], T[1, 0], T[2, 0]
    d, e, f = T[0, 1], T[1, 1], T[2, 1]
    g, h, i = T[0, 2], T[1, 2], T[2, 2]
    u, v, w = T[0, 3], T[1, 3], T[2, 3]
    return (
        a * xx + b * yx + c * zx,
        a * xy + b * yy + c * zy,
        a * xz + b * yz + c * zz,
        d * xx + e * yx + f * zx,
        d * xy + e * yy + f * zy,
        d * xz + e * yz + f * zz,
        g * xx + h * yx + i * zx,
        g * xy + h * yy + i * zy,
        g * xz + h * yz + i * zz,
        px + u * xx + v * yx + w * zx,
        py + u * xy + v * yy + w * zy,
        pz + u * xz + v * yz + w * zz,
    )


@compiled
def _moved(frame: Frame, value: float, slides: bool) -> Frame:
    """Return the frame behind a joint: turned about its z axis, or slid along it."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz, px, py, pz = frame
    if slides:
        origin = px + value * zx, py + value * zy, pz + value * zz
        return xx, xy, xz, yx, yy, yz, zx, zy, zz, *origin
    c, s = np.cos(value), np.sin(value)
    x = c * xx + s * yx, c * xy + s * yy, c * xz + s * yz
    return *x, c * yx - s * xx, c * yy - s * xy, c * yz - s * xz, zx, zy, zz, px, py, pz


@compiled
def _write_frames(
    q: FloatArray, transforms: FloatArray, slides: BoolArray, found: FloatArray
) -> None:
    """Write x, y, z axis and origin of joints and tool, (joint + 1, 4, coordinate, pose)."""
    joints = q.shape[1]
    for n in range(len(q)):
        frame = _base()
        for j in range(joints + 1):
            frame = _advanced(frame, transforms[j])
            for k in range(12):
                found[j, k // 3, k % 3, n] = frame[k]
            if j < joints:
                frame = _moved(frame, q[n, j], slides[j])


@compiled
def _write_positions(
    q: FloatArray,
    transforms: FloatArray,
    slides: BoolArray,
    point: FloatArray,
    jacobian: FloatArray,
) -> None:
    """Write tool positions (pose, 3) and, where there is room, Jacobians (pose, 3, joint)."""
    joints = q.shape[1]
    axis, origin = np.empty((joints, 3)), np.empty((joints, 3))
    for n in range(len(q)):
        frame = _base()
        for j in range(joints):
            frame = _advanced(frame, transforms[j])
            axis[j, 0], axis[j, 1], axis[j, 2] = frame[6:9]
            origin[j, 0], origin[j, 1], origin[j, 2] = frame[9:12]
            frame = _moved(frame, q[n, j], slides[j])
        p = _advanced(frame, transforms[joints])[9:12]
        point[n, 0], point[n, 1], point[n, 2] = p
        if len(jacobian):
            for j in range(joints):
                for i in range(3):
                    k, m = (i + 1) % 3, (i + 2) % 3
                    far, near = point[n, m] - origin[j, m], point[n, k] - origin[j, k]
                    turned = axis[j, k] * far - axis[j, m] * near
                    jacobian[n, i, j] = axis[j, i] if slides[j] else turned


@compiled
def _write_torques(
    q: FloatArray,
    transforms: FloatArray,
    slides: BoolArray,
    mass: FloatArray,
    centre: FloatArray,
    payload: FloatArray,
    torque: FloatArray,
) -> None:
    """Write the torque of gravity on every joint, (pose, joint): a . (sum of m (x - o)) x g.

    Args:
        q: Joint values, (pose, joint).
        transforms: Between joints, (joint + 1, 4, 4).
        slides: (joint,).
        mass: Behind each joint, (joint,) [kg].
        centre: Its centre in the frame that moves with the joint, (joint, 3) [m].
        payload: Mass at the tool point, (pose,) [kg].
        torque: Written.
    """
    joints = q.shape[1]
    axis, origin, middle = np.empty((3, joints, 3))
    for n in range(len(q)):
        frame = _base()
        for j in range(joints):
            frame = _advanced(frame, transforms[j])
            axis[j, 0], axis[j, 1], axis[j, 2] = frame[6:9]
            origin[j, 0], origin[j, 1] = frame[9:11]
            frame = _moved(frame, q[n, j], slides[j])
            xx, xy, _, yx, yy, _, zx, zy, _, px, py, _ = frame
            c, d, e = centre[j]
            middle[j, 0] = px + xx * c + yx * d + zx * e
            middle[j, 1] = py + xy * c + yy * d + zy * e
        tool = _advanced(frame, transforms[joints])
        carried = payload[n]
        x, y = carried * tool[9], carried * tool[10]
        for j in range(joints - 1, -1, -1):
            carried += mass[j]
            x += mass[j] * middle[j, 0]
            y += mass[j] * middle[j, 1]
            if slides[j]:
                torque[n, j] = -GRAVITY * carried * axis[j, 2]
            else:
                across = (x - carried * origin[j, 0]) * axis[j, 1]
                torque[n, j] = GRAVITY * (across - (y - carried * origin[j, 1]) * axis[j, 0])


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

    @cached_property
    def constants(self) -> tuple[FloatArray, BoolArray]:
        """Transforms between frames of joints, (joint + 1, 4, 4), and which joints slide."""
        transforms = np.stack([*(joint.T_pj for joint in self.joints), self.T_jt])
        return as_floats(transforms), np.array([joint.prismatic for joint in self.joints])

    def position(self, q: FloatArray) -> FloatArray:
        """Return tool positions (..., 3) [m], base frame, for `q` (..., joint) [rad or m]."""
        flat = self._flatten(q)
        point = np.empty((len(flat), 3))
        _write_positions(flat, *self.constants, point, np.empty((0, 3, 0)))
        return point.reshape(*np.shape(q)[:-1], 3)

    def position_and_jacobian(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return tool positions (..., 3) [m] and Jacobians (..., 3, joint) [m/rad or m/m].

        Both are in the base frame; `q` are joint values in chain order, (..., joint) [rad or m].
        """
        flat, lead = self._flatten(q), np.shape(q)[:-1]
        point, jacobian = np.empty((len(flat), 3)), np.empty((len(flat), 3, len(self.joints)))
        _write_positions(flat, *self.constants, point, jacobian)
        return point.reshape(*lead, 3), jacobian.reshape(*lead, 3, len(self.joints))

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
        flat = self._flatten(q)
        found = np.empty((len(self.joints) + 1, 4, 3, len(flat)))
        _write_frames(flat, *self.constants, found)
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
        return np.ascontiguousarray(q.reshape(-1, len(self.joints)))


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
        flat = np.ascontiguousarray(q.reshape(-1, q.shape[-1]))
        carried = np.array(np.broadcast_to(payload, q.shape[:-1]), dtype=np.float64).reshape(-1)
        out = np.empty(flat.shape)
        _write_torques(flat, *self.chain.constants, self.mass, self.centre, carried, out)
        return out.reshape(q.shape)


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
