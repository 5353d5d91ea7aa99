"""Noise-free runs as they are weighed on average: what a distance is expected to cost.

A tool that settles with scatter is further from a wrong place than one without, but falls less
steeply there if its scatter has heavy tails. Both together are as if the square of the distance
had shrunk; of normal scatter it stays as it is.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np

from failuretwin.core.types import FloatArray
from failuretwin.decision.evidence.motor_profile import MotorProfile
from failuretwin.decision.evidence.scene import Scene

MOST_NATS = 40.0
"""What one movement counts at most [nats]: about what a tool that may be anywhere costs."""


def shrink(dof: float) -> float:
    """Return the factor on squared distances that makes noise-free falls expected ones.

    Of a 3-variate Student t the log density falls by (dof + 3)/2 log(1 + d2/dof) from its centre.
    Shifted by d, it loses (dof + 3)/2 log(1 + d2/(dof + 5)) on average over its own scatter:
    exactly so for small d, by Fisher's information, and within half a nat for any.

    Args:
        dof: Degrees of freedom; infinite: normal.
    """
    return 1.0 if np.isinf(dof) else dof / (dof + 5.0)


class NoiseFreeScene(Scene):
    """Noise-free runs, with densities that are expected ones, relative to a perfect fit.

    Every hypothesis has the scatter of the healthy robot, also at a motor that is held, so that
    the tool's place counts alone; a command that arrives counts as certain.
    """

    @cached_property
    def log_healthy(self) -> FloatArray:
        """Expected log density of each settled position if no motor is faulty, (run, movement).

        The tool strays along the circle of the motor that strays, not along its tangent: so that
        of the motor counts that explains the position best.
        """
        profiles = [self.profile(motor) for motor in range(len(self.model.scatter))]
        says = [p.log_density(p.expected[:, :, None], False)[..., 0] for p in profiles]
        return np.asarray(np.max(says, axis=0))

    def profile(self, motor: int) -> MotorProfile:
        """Return what each movement is expected to say of one motor, computed once."""
        if motor not in self._expected:
            self._expected[motor] = self._with_expected(super().profile(motor))
        return self._expected[motor]

    @cached_property
    def _expected(self) -> dict[int, MotorProfile]:
        return {}

    def _with_expected(self, profile: MotorProfile) -> MotorProfile:
        own = 1.0 + profile.scatter**2 * profile.precision
        factor = shrink(profile.dof)
        return replace(
            profile,
            precision=profile.precision / own * factor,
            square=profile.square * factor,
            log_weight=_relative(self.alternatives.log_weight),
            scatter=0.0,
            outlier=-MOST_NATS,
        )


def _relative(log_weight: FloatArray) -> FloatArray:
    """Return log weights of alternatives, relative to that of all commands arriving."""
    return log_weight - log_weight[..., :1]
