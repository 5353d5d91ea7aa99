"""Single movements fitted to a path: damped Gauss-Newton from many first guesses at once."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from failuretwin.core.types import BoolArray, FloatArray, IntArray, as_floats
from failuretwin.digital_model.twin import DigitalTwin

CONVERGED_M = 1e-14
"""Root mean square error [m] below which a fit cannot get better by more than rounding."""
DAMPING = 1e-4
"""First damping, as a share of the largest diagonal entry of the normal equations."""
LEAST_DAMPING, MOST_DAMPING = 1e-15, 1e3


@dataclass(frozen=True)
class Ramps:
    """Guesses of one movement: every motor from origin to target, all starting together.

    Attributes:
        origin: Reference before it, (guess, motor) [rad].
        target: Reference after it, (guess, motor) [rad].
        duration: Time from start to target, (guess, motor) [s], positive.
        start: Time at which the ramps begin, (guess,) [s].
    """

    origin: FloatArray
    target: FloatArray
    duration: FloatArray
    start: FloatArray

    def __len__(self) -> int:
        return len(self.start)

    def __getitem__(self, rows: BoolArray | IntArray | slice) -> Ramps:
        return Ramps(self.origin[rows], self.target[rows], self.duration[rows], self.start[rows])

    def share(self, time: FloatArray) -> FloatArray:
        """Return how much of each ramp is done at `time` (time,), (guess, time, motor)."""
        passed = time[:, None] - self.start[:, None, None]
        return np.clip(passed / self.duration[:, None, :], 0.0, 1.0)

    def reference(self, time: FloatArray) -> FloatArray:
        """Return the reference at `time` (time,) [s], (guess, time, motor) [rad]."""
        return self.origin[:, None] + (self.target - self.origin)[:, None] * self.share(time)


@dataclass(frozen=True)
class Free:
    """What a fit may change besides the start.

    Attributes:
        origin: Motors whose origin is free, (motor,).
        target: Motors whose target is free, (motor,).
        duration: Motors whose duration is free, (motor,).
    """

    origin: BoolArray
    target: BoolArray
    duration: BoolArray

    @cached_property
    def parts(self) -> tuple[slice, slice, slice]:
        """Columns of the free origins, targets and durations; the start comes last."""
        ends = np.cumsum([self.origin.sum(), self.target.sum(), self.duration.sum()]).tolist()
        return slice(0, ends[0]), slice(ends[0], ends[1]), slice(ends[1], ends[2])


@dataclass(frozen=True)
class PathPart:
    """A stretch of a desired path.

    Attributes:
        time: (time,) [s].
        point: Tool positions, (time, axis) [m].
    """

    time: FloatArray
    point: FloatArray

    def take(self, rows: IntArray | slice | NDArray[np.bool_]) -> PathPart:
        """Return some of its samples."""
        return PathPart(self.time[rows], self.point[rows])

    def thinned(self, count: int) -> PathPart:
        """Return at most `count` of its samples, evenly spread."""
        rows = np.unique(np.linspace(0, len(self.time) - 1, count).round().astype(np.int64))
        return self.take(rows)


def largest_error(ramps: Ramps, part: PathPart, twin: DigitalTwin) -> FloatArray:
    """Return how far the tool is off at most, (guess,) [m]."""
    off = twin.path(ramps.reference(part.time)) - part.point
    return as_floats(np.sqrt(np.square(off).sum(axis=-1).max(axis=-1)))


def fit_ramps(ramps: Ramps, free: Free, part: PathPart, twin: DigitalTwin, steps: int) -> Ramps:
    """Return `ramps` moved to a least-squares fit of the path, each guess for itself.

    What the path does not determine stays near the guess.

    Args:
        ramps: First guesses.
        free: What may change; the start always may.
        part: The path to fit.
        twin: Its kinematics make a path of a reference.
        steps: Most steps to take.
    """
    damping = np.full(len(ramps), DAMPING)
    error, J = _error_and_jacobian(ramps, free, part, twin)
    cost = np.sum(error**2, axis=1)
    for _ in range(steps):
        if np.all(cost <= len(part.time) * CONVERGED_M**2):
            break
        trial = _moved(ramps, free, _step(error, J, damping))
        trial_error, trial_jacobian = _error_and_jacobian(trial, free, part, twin)
        trial_cost = np.sum(trial_error**2, axis=1)
        better = trial_cost < cost
        ramps = _choose(better, trial, ramps)
        error = np.where(better[:, None], trial_error, error)
        J = np.where(better[:, None, None], trial_jacobian, J)
        cost = np.where(better, trial_cost, cost)
        damping = np.clip(
            np.where(better, damping * 0.01, damping * 10.0), LEAST_DAMPING, MOST_DAMPING
        )
    return ramps


def _step(error: FloatArray, J: FloatArray, damping: FloatArray) -> FloatArray:
    """Return the damped Gauss-Newton step, (guess, parameter)."""
    normal = J.transpose(0, 2, 1) @ J
    diagonal = np.einsum("gpp->gp", normal)
    # The floor keeps parameters without any effect, such as a duration without travel, solvable.
    diagonal += np.maximum(damping * diagonal.max(axis=1), 1e-30)[:, None]
    gradient = J.transpose(0, 2, 1) @ error[..., None]
    return as_floats(-np.linalg.solve(normal, gradient)[..., 0])


def _moved(ramps: Ramps, free: Free, step: FloatArray) -> Ramps:
    origins, targets, durations = free.parts
    origin, target, duration = (x.copy() for x in (ramps.origin, ramps.target, ramps.duration))
    origin[:, free.origin] += step[:, origins]
    target[:, free.target] += step[:, targets]
    # A duration may shrink by no more than half at a step, so that it stays positive.
    change = np.maximum(step[:, durations], -0.5 * duration[:, free.duration])
    duration[:, free.duration] += change
    return Ramps(origin, target, duration, ramps.start + step[:, -1])


def _choose(first: BoolArray, one: Ramps, other: Ramps) -> Ramps:
    column = first[:, None]
    return replace(
        other,
        origin=np.where(column, one.origin, other.origin),
        target=np.where(column, one.target, other.target),
        duration=np.where(column, one.duration, other.duration),
        start=np.where(first, one.start, other.start),
    )


def _error_and_jacobian(
    ramps: Ramps, free: Free, part: PathPart, twin: DigitalTwin
) -> tuple[FloatArray, FloatArray]:
    """Return errors (guess, time * axis) [m] and derivatives (guess, time * axis, parameter)."""
    share = ramps.share(part.time)
    travel = (ramps.target - ramps.origin)[:, None]
    path, by_motor = twin.path_and_jacobian(ramps.origin[:, None] + travel * share)
    # The speed counts while the ramp is under way.
    speed = np.where((share > 0.0) & (share < 1.0), travel / ramps.duration[:, None], 0.0)
    by_angle = [
        by_motor[..., free.origin] * (1.0 - share)[:, :, None, free.origin],
        by_motor[..., free.target] * share[:, :, None, free.target],
        -by_motor[..., free.duration] * (speed * share)[:, :, None, free.duration],
        -(by_motor @ speed[..., None]),
    ]
    J = np.concatenate(by_angle, axis=-1)
    shape = (len(ramps), 3 * len(part.time))
    return (path - part.point).reshape(shape), J.reshape(*shape, J.shape[-1])
