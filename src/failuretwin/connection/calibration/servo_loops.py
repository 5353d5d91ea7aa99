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

from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.step_tests import StepTest
from failuretwin.digital_model.robot import Motor
from failuretwin.digital_model.servo import respond_limited

# Readings of a motor's step tests beside the motion that a servo loop predicts for them.

GRID_S = 0.002
"""Time step of the simulated motion [s]."""
EARLIEST_S, MARGIN_S = -0.05, 0.15
"""Readings count from here, after the stamp, until this long after the motor has arrived [s]."""
NEAR = 0.05
"""A motor has arrived when this share of its travel is left."""
SHARED = 5
"""Parameters common to all steps: P, log I, log filter time, log speed limit, dead time."""
READING_COUNTS = 0.3
"""Deviation of rounding to whole counts [counts], 1/sqrt(12)."""
STAMP_S = 0.0015
"""Deviation of the stamps of readings [s]; their spacing varies by about 0.002 s."""
SPEED_READINGS = 3
"""Readings to either side from which the speed is taken."""
STEPS = np.array([0.01, 0.02, 0.02, 0.02])
"""Steps of the numerical derivatives by P and the three logarithms."""
DELAY_STEP_S = 0.002


@dataclass(frozen=True)
class StepMotion:
    """Readings of all steps of a motor and the motion they should show.

    The parameters are the shared ones, then for each step its own part of the dead time [s], then
    for each step how far the level before it is off [rad], then the level after it.

    Attributes:
        reference: What the motor is told, as a share of the travel, (step, grid).
        start: Levels before, (step,) [rad].
        travel: Signed distances to the levels after, (step,) [rad].
        time: Times of the readings of each step since its command [s].
        position: The readings [rad].
        deviation: Their deviation by rounding and uncertain stamps [rad].
        quantum: Size of a count [rad].
    """

    reference: FloatArray
    start: FloatArray
    travel: FloatArray
    time: tuple[FloatArray, ...]
    position: tuple[FloatArray, ...]
    deviation: tuple[FloatArray, ...]
    quantum: float

    @classmethod
    def of(cls, steps: Sequence[StepTest], rad_per_count: float) -> StepMotion:
        """Return the motion of steps; `rad_per_count` is the size of a count [rad]."""
        windows = [_window(step) for step in steps]
        time = tuple(step.time[w] for step, w in zip(steps, windows, strict=True))
        position = tuple(step.position[w] for step, w in zip(steps, windows, strict=True))
        grid = np.arange(0.0, max(t[-1] for t in time) + 0.1, GRID_S)
        return cls(
            reference=np.stack([np.clip(grid / max(s.duration, GRID_S), 0.0, 1.0) for s in steps]),
            start=np.array([step.start for step in steps]),
            travel=np.array([step.travel for step in steps]),
            time=time,
            position=position,
            deviation=tuple(
                np.hypot(READING_COUNTS * rad_per_count, STAMP_S * _speed(t, y))
                for t, y in zip(time, position, strict=True)
            ),
            quantum=rad_per_count,
        )

    def misfit(self, values: FloatArray) -> list[FloatArray]:
        """Return predicted minus read for the readings of each step [rad]."""
        curve = self._curves(values[None, :4], self._travel(values)[None])[0]
        delay, before, _ = self._own(values)
        return [
            self.start[k] + before[k] + self._read(k, curve[k], values[4] + delay[k]) - y
            for k, y in enumerate(self.position)
        ]

    def slopes(self, values: FloatArray) -> list[FloatArray]:
        """Return the derivative of each step's readings by all parameters, (reading, parameter)."""
        moved = np.diag(STEPS)
        shared = np.concatenate([values[:4] + moved, values[:4] - moved, values[None, :4]])
        shared = np.concatenate([shared, values[None, :4]])
        travel = np.repeat(self._travel(values)[None], len(shared), axis=0)
        travel[-1] += self.quantum
        curves = self._curves(shared, travel)
        delay, _, _ = self._own(values)
        count = len(self.start)
        found = []
        for k, time in enumerate(self.time):
            late = values[4] + delay[k]
            read = np.stack([self._read(k, curve[k], late) for curve in curves])
            slope = np.zeros((len(time), len(values)))
            slope[:, :4] = ((read[:4] - read[4:8]) / (2.0 * STEPS[:, None])).T
            base = curves[-2, k]
            around = [self._read(k, base, late + s * DELAY_STEP_S) for s in (1, -1)]
            slope[:, 4] = slope[:, SHARED + k] = (around[0] - around[1]) / (2.0 * DELAY_STEP_S)
            by_travel = (read[-1] - read[-2]) / self.quantum
            slope[:, SHARED + count + k] = 1.0 - by_travel
            slope[:, SHARED + 2 * count + k] = by_travel
            found.append(slope)
        return found

    def _own(self, values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return what belongs to each step: part of the dead time, level before, level after."""
        delay, before, after = values[SHARED:].reshape(3, -1)
        return delay, before, after

    def _travel(self, values: FloatArray) -> FloatArray:
        _, before, after = self._own(values)
        return self.travel + after - before

    def _curves(self, shared: FloatArray, travel: FloatArray) -> FloatArray:
        """Return the motion from its start, (variant, step, grid) [rad]."""
        gains = np.column_stack([shared[:, 0], np.exp(shared[:, 1:3])])
        reference = travel[..., None] * self.reference
        return respond_limited(gains, np.exp(shared[:, 3]), reference, GRID_S)

    def _read(self, step: int, curve: FloatArray, delay: float) -> FloatArray:
        grid = np.arange(len(curve)) * GRID_S
        return np.interp(self.time[step] - delay, grid, curve)


def _window(step: StepTest) -> slice:
    """Return the readings of the motion, with some before and after it."""
    left = np.abs(step.position - step.settled) / abs(step.travel)
    arrived = step.time[(step.time > 0.0) & (left < NEAR)]
    first = int(np.searchsorted(step.time, EARLIEST_S))
    return slice(first, int(np.searchsorted(step.time, arrived[0] + MARGIN_S)))


def _speed(time: FloatArray, position: FloatArray) -> FloatArray:
    """Return how fast the motor is at each reading, roughly [rad/s]."""
    index = np.arange(len(time))
    ahead = np.minimum(index + SPEED_READINGS, len(time) - 1)
    behind = np.maximum(index - SPEED_READINGS, 0)
    return np.abs(position[ahead] - position[behind]) / (time[ahead] - time[behind])


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
