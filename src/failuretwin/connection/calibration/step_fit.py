"""Servo loop, speed limit and dead time of one motor from all of its step tests together.

The motion is that of the published loop with a limit on the speed that its controller asks for
(`respond_limited`). Gains and limit are common to all steps; each step has a dead time of its own
about the common one, and levels before and after it that are known to a count only. Weak priors
about the robot's profile keep what the steps do not say where it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.connection.calibration.step_motion import SHARED, StepMotion
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.step_tests import StepTest
from failuretwin.digital_model.robot import Motor

PRIOR_DEVIATION = np.array([0.15, 1.0, 0.4, 0.5, 0.03])
"""How far a motor may be from its profile: P as motors of one arm differ, I within a factor of
seven, the filter within two, the speed limit within three; dead time as buses differ."""
SIZES_APART, PINNED = 1.5, 0.05
"""Below this ratio of the largest to the smallest travel a limited motor and a lazy loop look
alike, and the logarithm of the speed limit has this prior deviation."""
PRIOR_DEAD_TIME_S = 0.01
DEAD_TIME_SCATTER_S = 0.004
"""Deviation of a step's own dead time: on ten steps of a real motor 0.0036 s."""
LEVEL_COUNTS = 0.5
"""Doubt about the levels before and after a step [counts]."""
CORRELATED = 8
"""Readings over which what is left may hang together."""
LOWEST_P, HIGHEST_P = 0.0, 5.0
STARTS = ((1.0, 0.0), (0.0, -1.0))
"""Starting points: factor on P of the profile, and what is added to log I."""


@dataclass(frozen=True)
class SharedFit:
    """What the steps of a motor have in common.

    Attributes:
        mode: P [-], log I [log 1/s], log filter time [log s], log speed limit [log rad/s] and
            dead time [s], (5,).
        deviation: Their standard deviations, (5,).
        residual: Root mean square of what is left of the readings [rad].
    """

    mode: FloatArray
    deviation: FloatArray
    residual: float


def fit_shared(steps: Sequence[StepTest], motor: Motor, rad_per_count: float) -> SharedFit:
    """Fit the motion of one motor.

    Args:
        steps: Its steps, all without flaw.
        motor: What the robot's profile says of it.
        rad_per_count: Size of a count [rad].
    """
    wide = PRIOR_DEVIATION.copy()
    if not sizes_differ(steps):
        wide[3] = PINNED
    problem = _Problem(StepMotion.of(steps, rad_per_count), _profile(motor), wide)
    starts = [np.zeros(SHARED + 3 * len(steps)) for _ in STARTS]
    for start, (factor, more) in zip(starts, STARTS, strict=True):
        start[:SHARED] = problem.profile
        start[0] *= factor
        start[1] += more
    _, mode = min((problem.solve(start, 1.0) for start in starts), key=lambda found: found[0])
    _, mode = problem.solve(mode, problem.excess(mode))
    slopes = problem.slopes(mode, problem.excess(mode))
    covariance = np.linalg.inv(slopes.T @ slopes)
    left = np.concatenate(problem.motion.misfit(mode))
    return SharedFit(
        mode=mode[:SHARED],
        deviation=np.sqrt(np.diag(covariance)[:SHARED]),
        residual=float(np.sqrt(np.mean(left**2))),
    )


def sizes_differ(steps: Sequence[StepTest]) -> bool:
    """Return whether steps are of sizes different enough to tell a speed limit from the loop."""
    travel = [abs(step.travel) for step in steps]
    return max(travel) > SIZES_APART * min(travel)


def _profile(motor: Motor) -> FloatArray:
    loop = motor.loop
    logs = np.log([loop.I, loop.filter_s, motor.speed_limit])
    return np.array([loop.P, *logs.tolist(), PRIOR_DEAD_TIME_S])


@dataclass(frozen=True)
class _Problem:
    """Least squares: readings and prior.

    Attributes:
        motion: The readings.
        profile: Prior mean of the shared parameters, (5,).
        wide: Their prior deviation, (5,).
    """

    motion: StepMotion
    profile: FloatArray
    wide: FloatArray

    def solve(self, start: FloatArray, excess: float) -> tuple[float, FloatArray]:
        """Return cost and parameters of the best fit near `start`."""
        from scipy.optimize import least_squares

        low, high = np.full(len(start), -np.inf), np.full(len(start), np.inf)
        low[0], high[0] = LOWEST_P - 1e-9, HIGHEST_P
        found = least_squares(
            self.residuals,
            np.clip(start, low + 1e-6, high),
            jac=self.slopes,
            bounds=(low, high),
            x_scale=self._prior_deviation,
            xtol=1e-6,
            ftol=1e-6,
            args=(excess,),
        )
        return float(found.cost), found.x

    def residuals(self, values: FloatArray, excess: float) -> FloatArray:
        """Return standardised misfits of readings and prior, (residual,).

        Args:
            values: All parameters.
            excess: Factor on the variance of readings.
        """
        prior = (values - self._prior_mean) / self._prior_deviation
        return np.concatenate([*self._standardised(values, excess), prior])

    def slopes(self, values: FloatArray, excess: float) -> FloatArray:
        """Return the derivatives of `residuals`, (residual, parameter)."""
        spread = np.sqrt(excess)
        pairs = zip(self.motion.slopes(values), self.motion.deviation, strict=True)
        readings = [slope / (spread * sigma[:, None]) for slope, sigma in pairs]
        return np.concatenate([*readings, np.diag(1.0 / self._prior_deviation)])

    def excess(self, values: FloatArray) -> float:
        """Return how much less readings say than independent ones with their known deviation.

        The variance of what is left times the number of readings that say the same: one plus twice
        the sum of their correlations, Bartlett's weights; never below 1.
        """
        left = self._standardised(values, 1.0)
        size = sum(len(z) for z in left)
        variance = sum(float(z @ z) for z in left)
        correlated = sum(
            (1.0 - lag / (CORRELATED + 1.0)) * sum(float(z[lag:] @ z[:-lag]) for z in left)
            for lag in range(1, CORRELATED + 1)
        )
        spent = SHARED + 3 * len(left)
        return max(1.0, (variance + 2.0 * correlated) / (size - spent), variance / (size - spent))

    def _standardised(self, values: FloatArray, excess: float) -> list[FloatArray]:
        spread = np.sqrt(excess)
        pairs = zip(self.motion.misfit(values), self.motion.deviation, strict=True)
        return [misfit / (spread * sigma) for misfit, sigma in pairs]

    @property
    def _prior_mean(self) -> FloatArray:
        return np.concatenate([self.profile, np.zeros(3 * len(self.motion.start))])

    @property
    def _prior_deviation(self) -> FloatArray:
        count = len(self.motion.start)
        delays = np.full(count, DEAD_TIME_SCATTER_S)
        levels = np.full(2 * count, LEVEL_COUNTS * self.motion.quantum)
        return np.concatenate([self.wide, delays, levels])
