"""Movements fitted to a tool path: one from many first guesses at once, or all of a run.

The parameters of M movements are poses (1 + M, motor) [rad], durations (M, motor) [s] and starts
(M,) [s], in this order; in between, every motor ramps from pose to pose on a line.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from failuretwin.core.movements import Movements
from failuretwin.core.types import BoolArray, FloatArray, IntArray, as_floats
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin

CONVERGED_M = 1e-14
"""Root mean square error [m] below which a fit cannot get better by more than rounding."""
DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-15, 1e3
"""First damping and its limits, as shares of the largest diagonal entry of the equations."""

Evaluate = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Errors (guess, row) and derivatives (guess, row, parameter) at some parameters (guess, ...)."""


# Levenberg-Marquardt from many first guesses at once, each for itself.


def least_squares(
    evaluate: Evaluate,
    move: Callable[[FloatArray, FloatArray], FloatArray],
    guess: FloatArray,
    steps: int,
    least_gain: float = 0.0,
) -> FloatArray:
    """Return parameters of least squared error near each guess, (guess, ...).

    What the errors do not determine stays near the guess. The solver is our own: that of scipy
    takes one guess at a time, and singular values of the whole Jacobian, for which BLAS starts
    threads that take up to a hundred times as long where cores are shared.

    Args:
        evaluate: Gives errors and derivatives.
        move: Gives the parameters that a step (guess, parameter) leads to, within their bounds.
        guess: First guesses, (guess, ...).
        steps: Most steps to take.
        least_gain: Steps end once they lessen the squared error by a smaller share than this.
    """
    x, damping = guess, np.full(len(guess), DAMPING)
    error, J = evaluate(x)
    cost = np.sum(error**2, axis=1)
    enough = error.shape[1] / 3.0 * CONVERGED_M**2
    settled = np.zeros(len(guess), dtype=np.bool_)
    for _ in range(steps):
        if np.all(settled | (cost <= enough) | (damping >= MOST_DAMPING) & (least_gain > 0.0)):
            break
        trial = move(x, _step(error, J, damping))
        trial_error, trial_jacobian = evaluate(trial)
        trial_cost = np.sum(trial_error**2, axis=1)
        better = trial_cost < cost
        settled = better & (cost - trial_cost < least_gain * cost)
        x = np.where(better[:, None], trial, x)
        error = np.where(better[:, None], trial_error, error)
        J = np.where(better[:, None, None], trial_jacobian, J)
        cost = np.where(better, trial_cost, cost)
        factor = np.where(better, 0.01, 10.0)
        damping = np.clip(factor * damping, LEAST_DAMPING, MOST_DAMPING)
    return x


def _step(error: FloatArray, J: FloatArray, damping: FloatArray) -> FloatArray:
    """Return the damped Gauss-Newton step -(J'J + damping)^-1 J'e, (guess, parameter)."""
    normal = np.einsum("grp,grq->gpq", J, J)  # without BLAS, and so without its threads
    diagonal = np.einsum("gpp->gp", normal)
    # The floor keeps parameters without any effect, such as a duration without travel, solvable.
    diagonal += np.maximum(damping * diagonal.max(axis=1), 1e-30)[:, None]
    gradient = np.einsum("grp,gr->gp", J, error)
    return as_floats(-np.linalg.solve(normal, gradient[..., None])[..., 0])


# Single movements fitted to a path.


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

    @classmethod
    def of(cls, x: FloatArray) -> Ramps:
        """Return the ramps with parameters `x`, (guess, 3 motor + 1)."""
        origin, target, duration = np.split(x[:, :-1], 3, axis=1)
        return cls(origin, target, duration, x[:, -1])

    @property
    def parameters(self) -> FloatArray:
        """Origins, targets, durations and starts, (guess, 3 motor + 1)."""
        return np.column_stack([self.origin, self.target, self.duration, self.start])

    def reference(self, time: FloatArray) -> FloatArray:
        """Return the reference at `time` (time,) [s], (guess, time, motor) [rad]."""
        motors = self.origin.shape[1]
        pose, _, _ = _unpack(self.parameters, motors)
        return _reference(pose, _shares(self.parameters, time, motors))


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

    @property
    def columns(self) -> BoolArray:
        """Which of the parameters of `Ramps` are free, the start among them, (3 motor + 1,)."""
        return np.concatenate([self.origin, self.target, self.duration, [True]])


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
    columns, motors = free.columns, len(free.duration)
    durations = slice(2 * motors, 3 * motors)

    def move(x: FloatArray, step: FloatArray) -> FloatArray:
        moved = x.copy()
        moved[:, columns] += step
        # A duration may shrink by no more than half at a step, so that it stays positive.
        moved[:, durations] = np.maximum(moved[:, durations], 0.5 * x[:, durations])
        return moved

    evaluate = partial(_error_and_jacobian, columns=columns, part=part, twin=twin)
    return Ramps.of(least_squares(evaluate, move, ramps.parameters, steps))


# The path of movements, and how it changes with their parameters.


def _unpack(x: FloatArray, motors: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return poses (guess, 1 + M, motor), durations (guess, M, motor) and starts (guess, M)."""
    count = (x.shape[1] - motors) // (2 * motors + 1)
    pose, duration, start = np.split(x, [(count + 1) * motors, (2 * count + 1) * motors], axis=1)
    shape = (len(x), count, motors)
    return pose.reshape(len(x), count + 1, motors), duration.reshape(shape), start


def _shares(x: FloatArray, time: FloatArray, motors: int) -> FloatArray:
    """Return how much of each ramp is done at `time` (time,), (guess, M, time, motor)."""
    _, duration, start = _unpack(x, motors)
    passed = time[:, None] - start[..., None, None]
    return np.clip(passed / duration[:, :, None], 0.0, 1.0)


def _reference(pose: FloatArray, share: FloatArray) -> FloatArray:
    """Return the reference where so much of each ramp is done, (guess, time, motor) [rad]."""
    return pose[:, :1] + (share * np.diff(pose, axis=1)[:, :, None]).sum(axis=1)


def _error_and_jacobian(
    x: FloatArray, columns: BoolArray, part: PathPart, twin: DigitalTwin
) -> tuple[FloatArray, FloatArray]:
    """Return errors (guess, time * axis) [m] and derivatives (guess, time * axis, column).

    Args:
        x: Parameters, (guess, parameter).
        columns: Which of them derivatives are by, (parameter,); all starts are among them.
        part: The path.
        twin: Its kinematics make a path of a reference.
    """
    motors = len(twin.robot.motors)
    pose, duration, _ = _unpack(x, motors)
    share = _shares(x, part.time, motors)
    path, by_motor = twin.path_and_jacobian(_reference(pose, share))
    # The speed counts while the ramp is under way.
    under_way = (share > 0.0) & (share < 1.0)
    speed = np.where(under_way, (np.diff(pose, axis=1) / duration)[:, :, None], 0.0)
    of_pose = [1.0 - share[:, :1], share[:, :-1] - share[:, 1:], share[:, -1:]]
    angle = np.concatenate([*of_pose, -speed * share], axis=1).transpose(0, 2, 1, 3)
    angles = len(columns) - speed.shape[1]
    free = np.flatnonzero(columns[:angles])
    angle = angle.reshape(*angle.shape[:2], 1, angles)
    by_free = angle[..., free] * by_motor[..., free % motors]
    by_start = -by_motor @ speed.transpose(0, 2, 3, 1)
    J = np.concatenate([by_free, by_start], axis=-1)
    shape = (len(x), 3 * len(part.time))
    return (path - part.point).reshape(shape), J.reshape(*shape, J.shape[-1])


# All movements of a run fitted to its path at once.

STEPS = 100
"""Most steps of the fit."""
LEAST_GAIN = 1e-5
"""The fit ends with a step that lessens the squared error by a smaller share."""
START_SHIFT_S = 0.15
"""A start may move this far from its first guess [s]."""
LEAST_DURATION_S = 0.02
"""Shortest ramp that is fitted [s]."""
STAYS_RAD = 1e-6
"""A motor with less travel [rad] does not move."""


def fit_movements(path: PathPart, twin: DigitalTwin, ramps: Sequence[Ramps]) -> Movements:
    """Return the movements that fit a path best, with a leading run axis of 1.

    Args:
        path: The desired path.
        twin: Its kinematics make a path of a reference.
        ramps: One first guess of each movement.
    """
    guess = np.concatenate(
        [
            np.ravel([ramps[0].origin, *(ramp.target for ramp in ramps)]),
            np.ravel([ramp.duration for ramp in ramps]),
            np.ravel([ramp.start for ramp in ramps]),
        ]
    )
    low, high = _bounds(ramps, twin.robot)
    fitted = least_squares(
        evaluate=partial(
            _error_and_jacobian, columns=np.full(len(guess), True), part=path, twin=twin
        ),
        move=lambda x, step: np.clip(x + step, low, high),
        guess=np.clip(guess, low, high)[None],
        steps=STEPS,
        least_gain=LEAST_GAIN,
    )
    pose, duration, start = _unpack(fitted, len(twin.robot.motors))
    stays = np.abs(np.diff(pose, axis=1)) <= STAYS_RAD
    return Movements(pose[:, 0], pose[:, 1:], np.where(stays, 0.0, duration), start)


def _bounds(ramps: Sequence[Ramps], robot: Robot) -> tuple[FloatArray, FloatArray]:
    """Return lowest and highest parameters, (parameter,)."""
    count, motors = len(ramps), len(robot.motors)
    joints = np.array([(joint.low, joint.high) for joint in robot.chain.joints])
    low, high = np.sort(joints * robot.sense[:, None], axis=1).T
    begun = np.maximum.accumulate([ramp.start[0] for ramp in ramps])
    longest = np.diff(begun, append=np.inf).clip(2.0 * LEAST_DURATION_S)
    shortest = np.full(count * motors, LEAST_DURATION_S)
    return (
        np.concatenate([np.tile(low, count + 1), shortest, begun - START_SHIFT_S]),
        np.concatenate(
            [np.tile(high, count + 1), np.repeat(longest, motors), begun + START_SHIFT_S]
        ),
    )
