"""Geometry of an arm in addition to its URDF: sensor frame, zero angles and joint corrections.

    p_seen = (1 + k) R(rpy) p_base + xyz,     T_pc' = T_pc T(xyz_j, rpy_j) Rot(axis_j, zero_j)

p_base is the tool point in the base link's frame and p_seen its position by the sensor [m]; k is
the sensor's scale error [-]. T_pc is the pose of joint j in its parent link by the URDF; the
correction is in the joint's own frame, and the joint angle is sense * command + zero.

Section: docs/another_arm.md#fit-the-frame-and-the-geometry
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from failuretwin.core.config import AtLeastZero, Bounded, Bounds
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.kinematics import SerialChain, cross, rotation_to_z
from failuretwin.digital_model.urdf.file import Triple, Urdf, UrdfJoint, transform

NO_OFFSET = (0.0, 0.0, 0.0)
NOT_MOVED = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
Pose = tuple[float, float, float, float, float, float]
"""x, y, z [m], roll, pitch, yaw [rad]: rotations about the fixed axes x, y, z, in this order."""


@dataclass(frozen=True)
class JointCorrection:
    """Difference of a joint from the URDF.

    Attributes:
        joint: Name in the URDF.
        zero: URDF angle [rad] or position [m] at command 0.
        xyz: True origin of its frame, in the URDF's frame of the joint [m].
        rpy: Rotation of its frame there [rad].
    """

    joint: str
    zero: float = 0.0
    xyz: Triple = NO_OFFSET
    rpy: Triple = NO_OFFSET

    def apply(self, joint: UrdfJoint) -> UrdfJoint:
        """Return the corrected joint; its limits are those of commands."""
        T = joint.T_pc @ transform(self.xyz, self.rpy)
        moved = np.eye(4)
        if joint.type == "prismatic":
            moved[:3, 3] = self.zero * np.asarray(joint.axis)
        else:
            moved[:3, :3] = turned_about(joint.axis, self.zero)
        low, high = joint.low - self.zero, joint.high - self.zero
        return replace(joint, T_pc=T @ moved, low=low, high=high)


@dataclass(frozen=True)
class Geometry(Bounded):
    """Fitted geometry of arm and sensor, in addition to frames and tool point.

    Attributes:
        joints: Joints that differ from the URDF.
        sensor_scale: Length that the sensor reports for a metre, 1 + k [-].
        sensor_noise_m: Standard deviation of the fit's residual on each axis [m]; 0: unknown.
        source: Source of the values.
    """

    joints: tuple[JointCorrection, ...] = ()
    sensor_scale: Annotated[float, Bounds(0.5, 2.0)] = 1.0
    sensor_noise_m: AtLeastZero = 0.0
    source: str = ""

    def apply(self, urdf: Urdf) -> Urdf:
        """Return the URDF with corrected joints."""
        return urdf.with_joints({c.joint: c.apply for c in self.joints})


@dataclass(frozen=True)
class SensorFrame(Bounded):
    """Displacement of the tool sensor from its place in the profile.

        x_seen = scale R(rpy) x_profile + xyz

    Attributes:
        xyz_rpy: Pose of the profile's sensor frame in the actual one.
        scale: Length that the sensor reports for a metre of the profile's sensor [-].
    """

    xyz_rpy: Pose = NOT_MOVED
    scale: Annotated[float, Bounds(0.5, 2.0)] = 1.0

    def after(self, first: SensorFrame | None) -> SensorFrame:
        """Return this displacement applied after a first one."""
        if first is None:
            return self
        before, this = (transform(f.xyz_rpy[:3], f.xyz_rpy[3:]) for f in (first, self))
        turn = this[:3, :3]
        x, y, z = (this[:3, 3] + self.scale * turn @ before[:3, 3]).tolist()
        return SensorFrame(
            (x, y, z, *roll_pitch_yaw(turn @ before[:3, :3])), self.scale * first.scale
        )


AS_STATED = Geometry()
"""No difference from the URDF."""


def with_tool(chain: SerialChain, tool_xyz: Triple) -> SerialChain:
    """Return the chain to a tool point given in the frame of the tool link [m]."""
    if tool_xyz == NO_OFFSET:
        return chain
    return replace(chain, T_jt=chain.T_jt @ transform(tool_xyz, NO_OFFSET))


def seen_chain(chain: SerialChain, base_xyz_rpy: Pose, scale: float = 1.0) -> SerialChain:
    """Return the chain to the tool point in the sensor's frame and scale.

    `base_xyz_rpy` is the pose of the base link in the sensor's frame; with sliding joints the scale
    must be 1.
    """
    if base_xyz_rpy == NOT_MOVED and scale == 1.0:
        return chain
    first, *others = (replace(joint, T_pj=_scaled(joint.T_pj, scale)) for joint in chain.joints)
    x, y, z, roll, pitch, yaw = base_xyz_rpy
    first = replace(first, T_pj=transform((x, y, z), (roll, pitch, yaw)) @ first.T_pj)
    return SerialChain((first, *others), _scaled(chain.T_jt, scale))


def geometry_columns(chain: SerialChain, q: FloatArray, scale: float = 1.0) -> FloatArray:
    """Return the derivative of the tool position by small corrections of every joint's frame.

        dp/dxyz_j = scale R_j,    dp/drpy_j[k] = R_j[:, k] x (p - p_j)

    R_j and p_j are the rotation and origin of joint j's URDF frame before the joint moves, p is the
    tool position. To first order `JointCorrection(xyz=..., rpy=...)` has this effect. The chain is
    as the sensor sees it, see `seen_chain`; joint values are (..., joint) [rad or m].

    Returns:
        (..., 3, 6 * joint): x, y, z [m/m] and roll, pitch, yaw [m/rad] of the first joint, then of
        the next.
    """
    frames, count = chain.frames_by_joint(q), len(chain.joints)
    columns = np.empty((count, 6, 3, frames.shape[-1]))
    for j, joint in enumerate(chain.joints):
        axes = (joint.to_urdf @ frames[j, :3].reshape(3, -1)).reshape(3, 3, -1)
        columns[j, :3] = scale * axes
        columns[j, 3:] = cross(axes, frames[-1, 3] - frames[j, 3], -2)
    return columns.reshape(6 * count, 3, -1).T.reshape(*np.shape(q)[:-1], 3, 6 * count)


def _scaled(T: FloatArray, scale: float) -> FloatArray:
    T = T.copy()
    T[:3, 3] *= scale
    return T


def turned_about(axis: Triple, angle: float) -> FloatArray:
    """Return the rotation (3, 3) about a unit vector by an angle [rad]."""
    frame = rotation_to_z(axis)
    return np.asarray(frame @ transform(NO_OFFSET, (0.0, 0.0, angle))[:3, :3] @ frame.T)


def roll_pitch_yaw(R: FloatArray) -> Triple:
    """Return the URDF angles of a rotation (3, 3) [rad]."""
    pitch = float(np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0])))
    if np.hypot(R[0, 0], R[1, 0]) < 1e-12:  # roll and yaw are about one axis: all is roll
        return float(np.arctan2(-R[1, 2], R[1, 1])), pitch, 0.0
    return (
        float(np.arctan2(R[2, 1], R[2, 2])),
        pitch,
        float(np.arctan2(R[1, 0], R[0, 0])),
    )
