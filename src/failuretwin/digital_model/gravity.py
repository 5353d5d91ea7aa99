"""What gravity asks of every motor: the load torque of the links and of a payload at the tool."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.core.types import FloatArray, as_floats
from failuretwin.digital_model.kinematics import (
    Scalar,
    SerialChain,
    Vector,
    add,
    chunks,
    rotation_to_z,
    spin,
    turn,
)
from failuretwin.digital_model.urdf import LinkFacts, Urdf

GRAVITY = 9.81
"""Acceleration of free fall, along -z of the base [m/s2]."""


@dataclass(frozen=True)
class Loads:
    """Masses carried by the joints of a chain.

    Attributes:
        chain: The chain from base to tool.
        mass: Mass that moves with each joint and none beyond it, (joint,) [kg].
        centre: Its centre in the frame that turns with the joint, (joint, 3) [m].
    """

    chain: SerialChain
    mass: FloatArray
    centre: FloatArray

    def torque(self, q: FloatArray, payload: FloatArray | float = 0.0) -> FloatArray:
        """Return the torque with which gravity drives every joint.

        Args:
            q: Joint values in the physical sense, (..., joint) [rad or m].
            payload: Mass at the tool point, () or as many leading axes as `q` [kg].

        Returns:
            (..., joint) [N m, or N for a joint that slides]; positive drives the joint up.
        """
        q = as_floats(q)
        flat = q.reshape(-1, q.shape[-1])
        carried = np.broadcast_to(payload, q.shape[:-1]).reshape(-1) if np.any(payload) else None
        out = np.empty_like(flat)
        for rows in chunks(len(flat)):
            extra = 0.0 if carried is None else carried[rows]
            for joint, value in enumerate(self._carry(flat[rows].T.copy(), extra)):
                out[rows, joint] = value
        return out.reshape(q.shape)

    def _carry(self, q: FloatArray, payload: Scalar) -> list[Scalar]:
        """Return the torque of each joint for `q` (joint, pose).

        Gravity is carried from base to tip, mass times position from tip to base; at each joint
        their cross product about its axis is the torque.
        """
        cosine, sine = np.cos(q), np.sin(q)
        down = self._gravity(cosine, sine)
        mass = payload
        moment = _times(payload, self.chain.T_jt[:3, 3])
        torque: list[Scalar] = []
        for j in reversed(range(len(q))):
            joint = self.chain.joints[j]
            mass = add(mass, float(self.mass[j]))
            moment = _plus(moment, _times(float(self.mass[j]), self.centre[j]))
            if joint.prismatic:
                torque.append(mass * down[j][2])
                moment = (moment[0], moment[1], add(moment[2], mass * q[j]))
            else:
                moment = spin(cosine[j], sine[j], moment)
                torque.append(add(moment[0] * down[j][1], -(moment[1] * down[j][0])))
            moment = _plus(turn(joint.T_pj, moment), _times(mass, joint.T_pj[:3, 3]))
        return torque[::-1]

    def _gravity(self, cosine: FloatArray, sine: FloatArray) -> list[Vector]:
        """Return gravity in the frame of each joint before the joint turns [m/s2]."""
        here: Vector = (0.0, 0.0, -GRAVITY)
        seen = []
        for joint, c, s in zip(self.chain.joints, cosine, sine, strict=True):
            here = turn(joint.T_pj.T, here)
            seen.append(here)
            if not joint.prismatic:
                here = spin(c, -s, here)
        return seen


def _times(factor: Scalar, vector: FloatArray) -> Vector:
    x, y, z = (factor * value if value else 0.0 for value in vector.tolist())
    return x, y, z


def _plus(a: Vector, b: Vector) -> Vector:
    return add(a[0], b[0]), add(a[1], b[1]), add(a[2], b[2])


def loads_of(
    urdf: Urdf, links: Mapping[str, LinkFacts], base_link: str, chain: SerialChain
) -> Loads:
    """Return what each joint of a chain carries; all other joints are held at zero.

    Args:
        urdf: The file's joints.
        links: What it says of its links; links without a mass weigh nothing.
        base_link: Link that carries the base frame.
        chain: The chain from there to the tool.
    """
    names = [joint.name for joint in chain.joints]
    mass, moment = np.zeros(len(names)), np.zeros((len(names), 3))
    for link, (segment, T_jl) in _segments(urdf, base_link, names).items():
        fact = links.get(link)
        if segment >= 0 and fact is not None and fact.mass is not None:
            mass[segment] += fact.mass
            moment[segment] += fact.mass * (T_jl[:3, :3] @ fact.centre + T_jl[:3, 3])
    centre = np.divide(moment, mass[:, None], out=np.zeros_like(moment), where=mass[:, None] > 0)
    return Loads(chain, mass, centre)


def _segments(
    urdf: Urdf, base_link: str, names: Sequence[str]
) -> dict[str, tuple[int, FloatArray]]:
    """Return for each link the joint that carries it, -1 for none, and its pose in its frame."""
    found: dict[str, tuple[int, FloatArray]] = {base_link: (-1, np.eye(4))}
    waiting = [base_link]
    while waiting:
        parent = waiting.pop()
        segment, T = found[parent]
        for joint in urdf.joints:
            if joint.parent != parent or joint.child in found:
                continue
            if joint.name in names:
                T_jl = np.eye(4)
                T_jl[:3, :3] = rotation_to_z(joint.axis).T
                found[joint.child] = (names.index(joint.name), T_jl)
            else:
                found[joint.child] = (segment, T @ joint.T_pc)
            waiting.append(joint.child)
    return found
