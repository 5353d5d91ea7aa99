"""Where a healthy motor settles, relative to its command: bias, gravity sag and friction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin.core.types import FloatArray
from failuretwin.digital_model.chain import SerialChain


@dataclass(frozen=True)
class Settling:
    """Settled error of each motor and its scatter; one value for each motor in chain order.

    The joint gives way under the weight it carries, so the error grows with the lever arm
    dz/dq of the tool (how much the tool rises when the joint turns), taken in the physical
    pose; friction stops it short of its target, seen in the direction of travel.

    Attributes:
        bias: Constant error [rad].
        sag: Yielding for each metre of lever arm [rad/m].
        friction: How far it stops short [rad].
        scatter: Scale of what is left, from movement to movement [rad].
        tail_dof: Degrees of freedom of the scatter's Student t distribution; small = heavy tails.
        source: Where the figures come from.
    """

    bias: tuple[float, ...]
    sag: tuple[float, ...]
    friction: tuple[float, ...]
    scatter: tuple[float, ...]
    tail_dof: float
    source: str

    @classmethod
    def ideal(cls, motors: int) -> Settling:
        """Return the settling of a motor that always reaches its target."""
        zero = (0.0,) * motors
        return cls(zero, zero, zero, zero, np.inf, "ideal motors")

    def offset(
        self, chain: SerialChain, sense: FloatArray, pose: FloatArray, direction: FloatArray
    ) -> FloatArray:
        """Return the mean settled error of a healthy motor.

        Args:
            chain: Kinematics of the robot.
            sense: +1 or -1 by motor, (motor,); physical angle = sense * angle in the log.
            pose: Angles that the arm settles near, in the log's sense, (..., motor) [rad].
            direction: Sign of each motor's last travel in the log's sense, (..., motor).

        Returns:
            Settled angle minus commanded angle in the log's sense, (..., motor) [rad].
        """
        friction = np.asarray(self.friction) * direction
        sag = np.asarray(self.sag)
        if not sag.any():
            return np.asarray(self.bias) - friction
        _, jacobian = chain.position_and_jacobian(pose * sense)
        lever_arm = jacobian[..., 2, :]
        return np.asarray(self.bias) - sense * sag * lever_arm - friction
