"""Servo loop, speed limit and dead time of one motor, fitted to all its step tests together.

The model is the published loop with a limit on the speed that its controller asks for
(`respond_limited`). Gains and limit are common to all steps. Each step has its own deviation from
the common dead time, and its own levels before and after it, known to a count. Weak priors about
the robot's profile keep parameters that the steps do not determine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.step_tests import StepTest
from failuretwin.digital_model.profile import Motor
from failuretwin.digital_model.servo import respond_limited

GRID_S = 0.002
"""Time step of the simulated motion [s]."""
EARLIEST_S, MARGIN_S = -0.05, 0.15
"""Readings used: from this time after the stamp until this long after the motor arrives [s]."""
NEAR = 0.05
"""Share of the travel that is left when a motor has arrived."""
READING_COUNTS = 0.3
"""Standard deviation of rounding to whole counts [counts], 1/sqrt(12)."""
STAMP_S = 0.0015
"""Standard deviation of the stamps of readings [s]; their spacing varies by about 0.002 s."""
SPEED_READINGS = 3
"""Readings to either side from which the speed is computed."""

SHARED = 5
"""Parameters common to all steps: P, log I, log filter time, log speed limit, dead time."""
SHARED_STEPS = np.array([0.01, 0.02, 0.02, 0.02, 0.002])
"""Steps of the numerical derivatives by them."""
PRIOR_DEVIATION = np.array([0.15, 1.0, 0.4, 0.5, 0.03])
"""Prior standard deviations of the shared parameters: P as motors of one arm differ, I within a
factor of seven, the filter time within two, the speed limit within three; dead time as buses
differ."""
SIZES_APART, PINNED = 1.5, 0.05
"""Below this ratio of the largest to the smallest travel, a speed limit and a slow loop look alike;
then the log speed limit has this prior standard deviation."""
PRIOR_DEAD_TIME_S = 0.01
DEAD_TIME_SCATTER_S = 0.004
"""Standard deviation of a step's own dead time [s]: 0.0036 s on ten steps of a real motor."""
LEVEL_COUNTS = 0.5
"""Standard deviation of the levels before and after a step [counts]."""
CORRELATED = 8
"""Largest lag at which residuals may be correlated [readings]."""
LOWEST_P, HIGHEST_P = 0.0, 5.0
STARTS = ((1.0, 0.0), (0.0, -1.0))
"""Starting points: factor on P of the profile, and offset of log I."""


@dataclass(frozen=True)
class SharedFit:
    """Posterior of the parameters that the steps of a motor share.

    Attributes:
        mode: P [-], log I [log 1/s], log filter time [log s], log speed limit [log rad/s] and
            dead time [s], (5,).
        deviation: Their standard deviations, (5,).
        residual: Root mean square residual of the readings [rad].
    """

    mode: FloatArray
    deviation: FloatArray
    residual: float


def fit_shared(steps: Sequence[StepTest], motor: Motor, rad_per_count: float) -> SharedFit:
    """Fit the motion of one motor to steps without flaw."""
    problem = _Problem.of(steps, motor, rad_per_count)
    starts = np.tile(problem.prior, (len(STARTS), 1))
    starts[:, 0] *= [factor for factor, _ in STARTS]
    starts[:, 1] += [offset for _, offset in STARTS]
    fits = [problem.solve(start, excess=1.0) for start in starts]
    _, mode = min(fits, key=lambda fit: fit[0])
    _, mode = problem.solve(mode, problem.excess(mode))
    slopes = problem.slopes(mode, problem.excess(mode))
    covariance = np.linalg.inv(slopes.T @ slopes)
    misfit = problem.predicted(mode[None])[0] - problem.position
    return SharedFit(
        mode=mode[:SHARED],
        deviation=np.sqrt(np.diag(covariance)[:SHARED]),
        residual=float(np.sqrt(np.mean(misfit**2))),
    )


def sizes_differ(steps: Sequence[StepTest]) -> bool:
    """Return whether the sizes of steps differ enough to tell a speed limit from the loop."""
    travel = [abs(step.travel) for step in steps]
    return max(travel) > SIZES_APART * min(travel)


@dataclass(frozen=True)
class _Problem:
    """Least squares of the readings of all steps of a motor, and of the prior.

    The parameters are the shared ones, then for each step its own part of the dead time [s], then
    for each step the error of the level before it [rad], then that of the level after it.

    Attributes:
        steps: The steps.
        prior: Prior means, (parameter,).
        deviation: Prior standard deviations, (parameter,).
        change: Steps of the numerical derivatives, (parameter,).
        rad_per_count: Size of a count [rad].
    """

    steps: Sequence[StepTest]
    prior: FloatArray
    deviation: FloatArray
    change: FloatArray
    rad_per_count: float

    @classmethod
    def of(cls, steps: Sequence[StepTest], motor: Motor, rad_per_count: float) -> _Problem:
        loop, count = motor.loop, len(steps)
        logs = np.log([loop.I, loop.filter_s, motor.speed_limit])
        shared = PRIOR_DEVIATION.copy()
        if not sizes_differ(steps):
            shared[3] = PINNED

        def joined(shared: FloatArray, delay: float, level: float) -> FloatArray:
            return np.concatenate([shared, np.full(count, delay), np.full(2 * count, level)])

        return cls(
            steps,
            joined(np.array([loop.P, *logs, PRIOR_DEAD_TIME_S]), 0.0, 0.0),
            joined(shared, DEAD_TIME_SCATTER_S, LEVEL_COUNTS * rad_per_count),
            joined(SHARED_STEPS, SHARED_STEPS[4], rad_per_count),
            rad_per_count,
        )

    @cached_property
    def _read(self) -> list[tuple[FloatArray, FloatArray]]:
        """Times since the command [s] and angles [rad] that are used, of each step."""
        windows = [(step, _window(step)) for step in self.steps]
        return [(step.time[window], step.position[window]) for step, window in windows]

    @cached_property
    def position(self) -> FloatArray:
        """All readings, step by step, (reading,) [rad]."""
        return np.concatenate([position for _, position in self._read])

    @cached_property
    def reading_deviation(self) -> FloatArray:
        """Standard deviation of them by rounding and uncertain stamps, (reading,) [rad]."""
        speed = np.concatenate([_speed(time, position) for time, position in self._read])
        return np.hypot(READING_COUNTS * self.rad_per_count, STAMP_S * speed)

    @cached_property
    def _reference(self) -> FloatArray:
        """Reference as a share of the travel, (step, grid)."""
        grid = np.arange(0.0, max(time[-1] for time, _ in self._read) + 0.1, GRID_S)
        return np.stack([np.clip(grid / max(s.duration, GRID_S), 0.0, 1.0) for s in self.steps])

    def predicted(self, values: FloatArray) -> FloatArray:
        """Return the readings predicted by `values` (set, parameter), (set, reading) [rad]."""
        shared = values[:, :SHARED]
        delay, before, after = np.moveaxis(values[:, SHARED:].reshape(len(values), 3, -1), 1, 0)
        late = shared[:, 4:] + delay
        gains = np.column_stack([shared[:, 0], np.exp(shared[:, 1:3])])
        start, travel = np.array([[step.start, step.travel] for step in self.steps]).T
        reference = (travel + after - before)[..., None] * self._reference
        curves = respond_limited(gains, np.exp(shared[:, 3]), reference, GRID_S)
        grid = np.arange(curves.shape[-1]) * GRID_S
        parts = [
            [
                level + np.interp(time - shift, grid, curve)
                for (time, _), level, shift, curve in zip(self._read, *rows, strict=True)
            ]
            for rows in zip(start + before, late, curves, strict=True)
        ]
        return np.stack([np.concatenate(part) for part in parts])

    def solve(self, start: FloatArray, excess: float) -> tuple[float, FloatArray]:
        """Return cost and parameters of the best fit near `start`."""
        from scipy.optimize import least_squares

        low, high = np.full(len(start), -np.inf), np.full(len(start), np.inf)
        low[0], high[0] = LOWEST_P - 1e-9, HIGHEST_P
        fit = least_squares(
            self.residuals,
            np.clip(start, low + 1e-6, high),
            jac=self.slopes,
            bounds=(low, high),
            x_scale=self.deviation,
            xtol=1e-6,
            ftol=1e-6,
            args=(excess,),
        )
        return float(fit.cost), fit.x

    def residuals(self, values: FloatArray, excess: float) -> FloatArray:
        """Return standardised residuals of readings and prior, (residual,).

        `excess` is a factor on the variance of readings.
        """
        misfit = self.predicted(values[None])[0] - self.position
        readings = misfit / (np.sqrt(excess) * self.reading_deviation)
        return np.concatenate([readings, (values - self.prior) / self.deviation])

    def slopes(self, values: FloatArray, excess: float) -> FloatArray:
        """Return the central differences of `residuals`, (residual, parameter)."""
        moved = np.diag(self.change)
        ahead, behind = np.split(
            self.predicted(np.concatenate([values + moved, values - moved])), 2
        )
        slopes = ((ahead - behind) / (2.0 * self.change[:, None])).T
        spread = np.sqrt(excess) * self.reading_deviation
        return np.concatenate([slopes / spread[:, None], np.diag(1.0 / self.deviation)])

    def excess(self, values: FloatArray) -> float:
        """Return the factor on the variance that correlated residuals call for, 1 at least.

        Variance of the standardised residuals times one plus twice the sum of their correlations,
        with Bartlett's weights, or their variance alone if that is larger.
        """
        residuals = self.residuals(values, 1.0)[: len(self.position)]
        ends = np.cumsum([len(time) for time, _ in self._read])[:-1]
        parts = np.split(residuals, ends)
        variance = float(residuals @ residuals)
        correlated = sum(
            (1.0 - lag / (CORRELATED + 1.0)) * sum(float(z[lag:] @ z[:-lag]) for z in parts)
            for lag in range(1, CORRELATED + 1)
        )
        degrees = len(residuals) - SHARED - 3 * len(parts)
        return max(1.0, (variance + 2.0 * correlated) / degrees, variance / degrees)


def _window(step: StepTest) -> slice:
    """Return the readings of the motion, with some before and after it."""
    left = np.abs(step.position - step.settled) / abs(step.travel)
    arrived = step.time[(step.time > 0.0) & (left < NEAR)]
    first = int(np.searchsorted(step.time, EARLIEST_S))
    return slice(first, int(np.searchsorted(step.time, arrived[0] + MARGIN_S)))


def _speed(time: FloatArray, position: FloatArray) -> FloatArray:
    """Return the approximate speed at each reading [rad/s]."""
    index = np.arange(len(time))
    ahead = np.minimum(index + SPEED_READINGS, len(time) - 1)
    behind = np.maximum(index - SPEED_READINGS, 0)
    return np.abs(position[ahead] - position[behind]) / (time[ahead] - time[behind])
