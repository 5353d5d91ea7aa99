"""Readings of a motor's step tests beside the motion that a servo loop predicts for them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.step_tests import StepTest
from failuretwin.digital_model.limited_servo import respond_limited

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
