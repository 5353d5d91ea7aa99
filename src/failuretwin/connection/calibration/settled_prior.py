"""What is believed of a robot's settling before its logs are seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin.core.types import FloatArray
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import largest_load

OFFSET_PRIOR_RAD = 0.03
"""Prior standard deviation of bias, friction and the largest sag [rad]: about 2 degrees."""
SCATTER_PRIOR_RAD, SCATTER_PRIOR_SPREAD = 0.007, 1.0
"""Prior median of the scatter [rad] and standard deviation of its logarithm."""
DOF_PRIOR, DOF_PRIOR_SPREAD = 5.0, 0.7
"""Prior median of the degrees of freedom and standard deviation of their logarithm."""
TOOL_NOISE_PRIOR_M, TOOL_NOISE_PRIOR_SPREAD = 0.0005, 1.0
"""Prior median of a tool sensor's own noise [m] and standard deviation of its logarithm."""


@dataclass(frozen=True)
class SettlingPrior:
    """Independent normal priors: mean and standard deviation of each parameter."""

    mean: FloatArray
    deviation: FloatArray

    @classmethod
    def of(cls, robot: Robot, payload: float, of_motors: bool) -> SettlingPrior:
        """Return priors that know how large a load the motors of the robot carry."""
        motors = len(robot.motors)
        load = np.maximum(largest_load(robot, payload), 1e-6)
        offset = np.full(motors, OFFSET_PRIOR_RAD)
        mean = np.zeros(4 * motors + 1)
        mean[3 * motors : -1], mean[-1] = np.log(SCATTER_PRIOR_RAD), np.log(DOF_PRIOR)
        compliance = np.where(load > 1e-6, OFFSET_PRIOR_RAD / load, 1e-9)
        spread = np.full(motors, SCATTER_PRIOR_SPREAD)
        deviation = np.concatenate([offset, compliance, offset, spread, [DOF_PRIOR_SPREAD]])
        if of_motors:
            return cls(mean, deviation)
        return cls(
            np.append(mean, np.log(TOOL_NOISE_PRIOR_M)),
            np.append(deviation, TOOL_NOISE_PRIOR_SPREAD),
        )

    def log_density(self, parameters: FloatArray) -> float:
        """Return the log density of parameters, but for a constant."""
        return -0.5 * float(np.sum(((parameters - self.mean) / self.deviation) ** 2))
