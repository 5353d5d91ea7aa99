"""Frames of all joints of a chain at once: for inverse kinematics and for clearance.

    T_j = T_(j-1) T_pj D_j(q_j),    D_j a turn about z or a slide along z

Small batches of poses are fast here: a pose costs a handful of matrix products, whatever the arm.
`SerialChain.position_and_jacobian` stays faster for thousands of poses and says the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.kinematics import SerialChain


@dataclass(frozen=True)
class ChainFrames:
    """Frames of the joints and the tool of a chain, in the base frame.

    Attributes:
        chain: The chain.
        tool_z_m: A second tool point lies so far along z of the tool frame [m]; 0: none.
    """

    chain: SerialChain
    tool_z_m: float = 0.0

    @cached_property
    def _fixed(self) -> FloatArray:
        return np.stack([joint.T_pj for joint in self.chain.joints])

    @cached_property
    def _slides(self) -> BoolArray:
        return np.array([joint.prismatic for joint in self.chain.joints])

    @cached_property
    def _any_slides(self) -> bool:
        return bool(self._slides.any())

    def frames(self, q: FloatArray) -> FloatArray:
        """Return the frame of every joint, turned with it, (..., joint, 4, 4).

        Args:
            q: Joint values in the chain's own sense, (..., joint) [rad or m].
        """
        angle = np.where(self._slides, 0.0, q) if self._any_slides else q
        cosine, sine = np.cos(angle)[..., None], np.sin(angle)[..., None]
        step = np.empty((*q.shape, 4, 4))
        x, y, step[..., 2], step[..., 3] = np.moveaxis(self._fixed, -1, 0)
        step[..., 0] = cosine * x + sine * y  # a turn about z moves two columns alone
        step[..., 1] = cosine * y - sine * x
        if self._any_slides:
            step[..., 3] += np.where(self._slides, q, 0.0)[..., None] * self._fixed[..., 2]
        found = np.empty_like(step)
        here = found[..., 0, :, :] = step[..., 0, :, :]
        for j in range(1, step.shape[-3]):
            here = found[..., j, :, :] = here @ step[..., j, :, :]
        return found

    def origins(self, q: FloatArray) -> FloatArray:
        """Return base, joints and tool as points, (..., joint + 2, 3) [m]."""
        frames = self.frames(q)
        base = np.zeros((*q.shape[:-1], 1, 3))
        tool = (frames[..., -1, :, :] @ self.chain.T_jt)[..., None, :3, 3]
        return np.concatenate([base, frames[..., :3, 3], tool], axis=-2)

    def tool_points(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the tool point, or both of them, and the Jacobian.

        Returns:
            (..., 3 or 6) [m] and (..., 3 or 6, joint) [m/rad or m/m].
        """
        frames = self.frames(q)
        axis, origin = frames[..., :3, 2], frames[..., :3, 3]
        tool = frames[..., -1, :, :] @ self.chain.T_jt
        points = [tool[..., :3, 3]]
        if self.tool_z_m > 0.0:
            points.append(points[0] + self.tool_z_m * tool[..., :3, 2])
        slopes = [self._slope(axis, point[..., None, :] - origin) for point in points]
        return np.concatenate(points, axis=-1), np.concatenate(slopes, axis=-2)

    def _slope(self, axis: FloatArray, arm: FloatArray) -> FloatArray:
        """Return what unit speed of each joint does to a point, (..., 3, joint)."""
        turn = np.empty_like(arm)
        turn[..., 0] = axis[..., 1] * arm[..., 2] - axis[..., 2] * arm[..., 1]
        turn[..., 1] = axis[..., 2] * arm[..., 0] - axis[..., 0] * arm[..., 2]
        turn[..., 2] = axis[..., 0] * arm[..., 1] - axis[..., 1] * arm[..., 0]
        if self._any_slides:
            turn = np.where(self._slides[:, None], axis, turn)
        return np.swapaxes(turn, -1, -2)
