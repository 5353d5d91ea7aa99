"""Movements fitted to a tool path by damped least squares, many first guesses at once.

Levenberg-Marquardt: dx = -(J'J + damping)^-1 J'e, with errors e of the tool path. The parameters x
of M movements are poses (1 + M, motor) [rad], ramp durations (M, motor) [s] and starts (M,) [s].
The run axis of `Movements` counts the guesses.
"""

from __future__ import annotations

from math import prod

import numpy as np

from failuretwin.core.movements import Movements
from failuretwin.core.types import BoolArray, FloatArray, as_floats
from failuretwin.data_knowledge.readers.timed_log import Samples
from failuretwin.digital_model.twin import DigitalTwin

CONVERGED_M = 1e-14
"""Root mean square error [m] that only rounding can change."""
DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-15, 1e3
"""Initial damping and its limits, relative to the largest diagonal entry of J'J."""


def single_movements(
    origin: FloatArray, target: FloatArray, duration: FloatArray | float, start: FloatArray | float
) -> Movements:
    """Return guesses of one movement: origins, targets and durations (guess, motor), starts."""
    origin, target, duration = np.broadcast_arrays(*map(np.atleast_2d, (origin, target, duration)))
    starts = np.broadcast_to(start, len(origin))
    return Movements(origin, target[:, None], duration[:, None], starts[:, None])


def path_error(movements: Movements, path: Samples, twin: DigitalTwin) -> FloatArray:
    """Return the distance of the tool from a path, (guess, time) [m]."""
    return np.linalg.norm(twin.path(movements.reference(path.time)) - path.value, axis=-1)


def fit(
    guess: Movements,
    part: Samples,
    twin: DigitalTwin,
    free: BoolArray,
    steps: int,
    one_is_enough: bool = False,
) -> Movements:
    """Return a least-squares fit near each guess; undetermined parameters stay near the guess.

    The solver is our own: that of scipy takes one guess at a time, and its BLAS threads take up to
    a hundred times as long on shared cores.

    Args:
        guess: First guesses, with durations above 0.
        part: The path.
        twin: Kinematics.
        free: Free poses and durations, ((1 + 2 M) motor,); starts are always free.
        steps: Maximum number of steps.
        one_is_enough: Stop when one guess has become exact.
    """
    x, damping = _parameters(guess), np.full(len(guess.start), DAMPING)
    _, count, motors = guess.target.shape
    durations = slice((1 + count) * motors, (1 + 2 * count) * motors)
    columns = np.append(free, np.full(guess.start.shape[1], True))
    error, J = _error_and_jacobian(x, guess, columns, part, twin)
    cost = np.sum(error**2, axis=1)
    longest = part.time[-1] - part.time[0]
    enough = error.shape[1] / 3.0 * CONVERGED_M**2
    for _ in range(steps):
        exact = cost <= enough
        if np.all(exact | (damping >= MOST_DAMPING)) or (one_is_enough and exact.any()):
            break
        trial = x.copy()
        trial[:, columns] += _step(error, J, damping)
        # Durations stay positive, and no longer than the path.
        trial[:, durations] = np.clip(trial[:, durations], 0.5 * x[:, durations], longest)
        trial_error, trial_jacobian = _error_and_jacobian(trial, guess, columns, part, twin)
        trial_cost = np.sum(trial_error**2, axis=1)
        better = trial_cost < cost
        x = np.where(better[:, None], trial, x)
        error = np.where(better[:, None], trial_error, error)
        J = np.where(better[:, None, None], trial_jacobian, J)
        cost = np.where(better, trial_cost, cost)
        factor = np.where(better, 0.01, 10.0)
        damping = np.clip(factor * damping, LEAST_DAMPING, MOST_DAMPING)
    pose, duration, start = _parts(x, guess)
    return Movements(pose[:, 0], pose[:, 1:], duration, start)


def _step(error: FloatArray, J: FloatArray, damping: FloatArray) -> FloatArray:
    """Return the damped Gauss-Newton step -(J'J + damping)^-1 J'e, (guess, parameter)."""
    normal = np.einsum("grp,grq->gpq", J, J)  # without BLAS, and so without its threads
    diagonal = np.einsum("gpp->gp", normal)
    # The floor keeps parameters without any effect, such as a duration without travel, solvable.
    diagonal += np.maximum(damping * diagonal.max(axis=1), 1e-30)[:, None]
    gradient = np.einsum("grp,gr->gp", J, error)
    return as_floats(-np.linalg.solve(normal, gradient[..., None])[..., 0])


def _parameters(movements: Movements) -> FloatArray:
    """Return the parameters of movements, (guess, parameter)."""
    values = (movements.initial, movements.target, movements.ramp_duration, movements.start)
    shapes = [(len(value), prod(value.shape[1:])) for value in values]
    flat = [value.reshape(shape) for value, shape in zip(values, shapes, strict=True)]
    return np.concatenate(flat, axis=1)


def _parts(x: FloatArray, like: Movements) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return poses (guess, 1 + M, motor), durations (guess, M, motor) and starts (guess, M)."""
    _, count, motors = like.target.shape
    pose, duration, start = np.split(x, [(count + 1) * motors, (2 * count + 1) * motors], axis=1)
    return (
        pose.reshape(len(x), count + 1, motors),
        duration.reshape(len(x), count, motors),
        start,
    )


def _shares(duration: FloatArray, start: FloatArray, time: FloatArray) -> FloatArray:
    """Return the completed share of each ramp at `time` (time,), (guess, M, time, motor)."""
    passed = time[:, None] - start[..., None, None]
    return np.clip(passed / duration[:, :, None], 0.0, 1.0)


def _reference(pose: FloatArray, share: FloatArray) -> FloatArray:
    """Return the reference at completed shares of the ramps, (guess, time, motor) [rad]."""
    return pose[:, :1] + (share * np.diff(pose, axis=1)[:, :, None]).sum(axis=1)


def _error_and_jacobian(
    x: FloatArray, like: Movements, columns: BoolArray, part: Samples, twin: DigitalTwin
) -> tuple[FloatArray, FloatArray]:
    """Return errors (guess, time * axis) [m] and derivatives (guess, time * axis, column).

    Args:
        x: Parameters, (guess, parameter).
        like: Movements with the same shape.
        columns: Parameters with derivatives, (parameter,); all starts are among them.
        part: The path.
        twin: Kinematics.
    """
    pose, duration, start = _parts(x, like)
    share, motors = _shares(duration, start, part.time), pose.shape[-1]
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
    return (path - part.value).reshape(shape), J.reshape(*shape, J.shape[-1])
