"""How probable settled errors are: a linear model with the scatter of a Student t."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln, stdtr

from failuretwin.core.ellipsoid import log_student
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.robot import Robot

ROUNDING = float(1.0 / np.sqrt(12.0))
"""Standard deviation of what whole numbers round off."""
LEAST_DOF = 1.0
"""Degrees of freedom below which tails grow no heavier: where every error is far smaller than what
counts round off, ever heavier tails would fit ever better."""


@dataclass(frozen=True)
class SettledErrors:
    """Settled errors as a linear model of bias, compliance and friction, with scatter.

    Attributes:
        error: Settled minus commanded: angles (movement, motor) [rad] or tool (movement, axis) [m].
        design: Factor of bias, compliance and friction, (3, movement, motor).
        jacobian: Tool position by angle, (movement, axis, motor); None where angles were read.
        count: Step that motors are read in [rad]; 0: read as they are.
        arrived: How probable it is that each command arrived, (movement, motor): a reading counts
            by so much.
    """

    error: FloatArray
    design: FloatArray
    jacobian: FloatArray | None
    count: float
    arrived: FloatArray

    def log_likelihood(self, parameters: FloatArray) -> float:
        """Return the log likelihood of parameters as in `SettledFit.mode`.

        With the tool path alone, the logarithm of the tool sensor's noise [m] comes after them.
        """
        motors = self.design.shape[2]
        grouped = parameters[: 4 * motors].reshape(4, -1)
        linear, log_scatter = grouped[:3], grouped[3]
        dof = max(float(np.exp(parameters[4 * motors])), LEAST_DOF)
        expected = np.einsum("pik,pk->ik", self.design, linear)
        scatter = np.exp(log_scatter)
        if self.jacobian is None:
            density = log_rounded_student(self.error - expected, scatter, self.count, dof)
            return float(np.sum(density * self.arrived))
        scale = np.hypot(scatter, self.count * ROUNDING)
        moved = np.einsum("iak,ik->ia", self.jacobian, expected)
        noise = float(np.exp(2.0 * parameters[-1]))
        return float(np.sum(log_student(self.error - moved, self.jacobian * scale, noise, dof)))


def log_rounded_student(
    error: FloatArray, scale: FloatArray, count: float, dof: float
) -> FloatArray:
    """Return log densities of Student t errors that are read in whole counts.

    A reading stands for all angles within half a count, so its probability is that of all of them
    together. To widen the scale by the variance of rounding instead makes tails look lighter and
    scatter smaller than they are.

    Args:
        error: Deviations, (..., motor) [rad].
        scale: Scale of each motor, (motor,) [rad].
        count: Step of the readings [rad]; 0: none.
        dof: Degrees of freedom.

    Returns:
        Per rad, (..., motor).
    """
    away, half = np.abs(error), 0.5 * count
    if count == 0.0:
        constant = gammaln((dof + 1) / 2) - gammaln(dof / 2) - 0.5 * np.log(dof * np.pi)
        density = constant - np.log(scale) - 0.5 * (dof + 1) * np.log1p((away / scale) ** 2 / dof)
        return np.asarray(density)
    share = stdtr(dof, (half - away) / scale) - stdtr(dof, (-half - away) / scale)
    return np.log(np.maximum(share, np.finfo(float).tiny) / count)


def count_of(robot: Robot) -> float:
    """Return the step that the motors are read in [rad]; 0 without servo units."""
    if robot.profile.servo_units is None:
        return 0.0
    return float(abs(robot.servo_units.rad_per_count))


def rounding(robot: Robot) -> float:
    """Return the standard deviation of what whole servo counts round off [rad]."""
    return count_of(robot) * ROUNDING
