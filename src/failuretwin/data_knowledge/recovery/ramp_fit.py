"""Movements fitted to a tool path by damped least squares, many first guesses at once.

Levenberg-Marquardt: dx = -(J'J + damping)^-1 J'e, with errors e of the tool path. The parameters x
of M movements are poses (1 + M, motor) [rad], ramp durations (M, motor) [s] and starts (M,) [s].
The run axis of `Movements` counts the guesses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import prod

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.movements import Movements
from failuretwin.core.types import BoolArray, FloatArray, IntArray, as_floats
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin

CONVERGED_M = 1e-14
"""Root mean square error [m] that only rounding can change."""
DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-15, 1e3
"""Initial damping and its limits, relative to the largest diagonal entry of J'J."""
STAYS_RAD = 1e-6
"""A motor with less travel [rad] does not move."""


@dataclass(frozen=True)
class PathPart:
    """Samples of a desired path.

    Attributes:
        time: (time,) [s].
        point: Tool positions, (time, axis) [m].
    """

    time: FloatArray
    point: FloatArray

    def take(self, rows: IntArray | BoolArray | slice) -> PathPart:
        """Return some of the samples."""
        return PathPart(self.time[rows], self.point[rows])

    def thinned(self, count: int) -> PathPart:
        """Return at most `count` samples, evenly spread."""
        rows = np.unique(np.linspace(0, len(self.time) - 1, count).round().astype(np.int64))
        return self.take(rows)


def moving_spans(
    path: PathPart, still_m: float, least_rest_s: float, width: int = 1
) -> list[tuple[int, int]]:
    """Return the last sample before and the first sample after every movement of a path.

    Where the record begins or ends within a movement, these are its first and last samples.

    Args:
        path: The path.
        still_m: Largest motion of a resting tool between averages [m].
        least_rest_s: Shorter rests belong to a movement [s].
        width: Samples of the moving average.
    """
    average = [np.convolve(axis, np.full(width, 1.0 / width), "valid") for axis in path.point.T]
    smooth = np.stack(average, axis=1)
    moving = np.linalg.norm(smooth[width:] - smooth[:-width], axis=1) > still_m
    edges = np.flatnonzero(np.diff(np.concatenate([[0], moving.astype(int), [0]])))
    spans: list[tuple[int, int]] = []
    for first, last in edges.reshape(-1, 2).tolist():
        # A change between two averages shows up to two widths before it begins.
        begin, end = min(first + width - 1, last), min(last + width - 1, len(path.time) - 1)
        if spans and path.time[begin] - path.time[spans[-1][1]] < least_rest_s:
            begin = spans.pop()[0]
        spans.append((begin, end))
    return spans


def single_movements(
    origin: FloatArray, target: FloatArray, duration: FloatArray | float, start: FloatArray | float
) -> Movements:
    """Return guesses of one movement: origins, targets and durations (guess, motor), starts."""
    origin, target, duration = np.broadcast_arrays(*map(np.atleast_2d, (origin, target, duration)))
    starts = np.broadcast_to(start, len(origin))
    return Movements(origin, target[:, None], duration[:, None], starts[:, None])


def joined(initial: FloatArray, parts: Sequence[Movements]) -> Movements:
    """Return one run from the pose `initial` (motor,) with the movements of all parts in order."""
    parts = [Movements.empty(run=1, movement=0, motor=len(initial)), *parts]
    target, duration, start = (
        np.concatenate([getattr(part, name) for part in parts], axis=1)
        for name in ("target", "ramp_duration", "start")
    )
    return Movements(initial[None], target, duration, start)


def without_idle_ramps(movements: Movements) -> Movements:
    """Return the movements with a duration of 0 for motors that stay."""
    travel = np.abs(np.diff(_parts(_parameters(movements), movements)[0], axis=1))
    durations = np.where(travel <= STAYS_RAD, 0.0, movements.ramp_duration)
    return replace(movements, ramp_duration=durations)


def largest_error(movements: Movements, part: PathPart, twin: DigitalTwin) -> FloatArray:
    """Return the largest distance of the tool from a path, (guess,) [m]."""
    pose, duration, start = _parts(_parameters(movements), movements)
    reference = _reference(pose, _shares(duration, start, part.time))
    off = twin.path(reference) - part.point
    return as_floats(np.sqrt(np.square(off).sum(axis=-1).max(axis=-1)))


def fit(
    guess: Movements,
    part: PathPart,
    twin: DigitalTwin,
    free: BoolArray,
    steps: int,
    limits: tuple[FloatArray, FloatArray] | None = None,
    least_gain: float = 0.0,
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
        limits: Lowest and highest parameters, (parameter,); None: unlimited.
        least_gain: Smallest relative decrease of the squared error for another step.
    """
    x, damping = _parameters(guess), np.full(len(guess.start), DAMPING)
    low, high = limits or (-np.inf, np.inf)
    _, count, motors = guess.target.shape
    durations = slice((1 + count) * motors, (1 + 2 * count) * motors)
    columns = np.append(free, np.full(guess.start.shape[1], True))
    error, J = _error_and_jacobian(x, guess, columns, part, twin)
    cost = np.sum(error**2, axis=1)
    enough = error.shape[1] / 3.0 * CONVERGED_M**2
    settled = np.zeros(len(x), dtype=np.bool_)
    for _ in range(steps):
        if np.all(settled | (cost <= enough) | (damping >= MOST_DAMPING) & (least_gain > 0.0)):
            break
        trial = x.copy()
        trial[:, columns] += _step(error, J, damping)
        trial = np.clip(trial, low, high)
        # Durations stay positive.
        trial[:, durations] = np.maximum(trial[:, durations], 0.5 * x[:, durations])
        trial_error, trial_jacobian = _error_and_jacobian(trial, guess, columns, part, twin)
        trial_cost = np.sum(trial_error**2, axis=1)
        better = trial_cost < cost
        settled = better & (cost - trial_cost < least_gain * cost)
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
    x: FloatArray, like: Movements, columns: BoolArray, part: PathPart, twin: DigitalTwin
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
    return (path - part.point).reshape(shape), J.reshape(*shape, J.shape[-1])


# Fit of a whole run: movement by movement from many guesses, then all at once.

SEEDS = (0, 1, 2)
"""Seeds of the first guesses, each tried until the fit is as good as the path's noise."""
POSES = 32
"""First guesses of a pose for the fit of each movement."""
FIRST_POSES = 6
"""Poses before the first movement that its fit starts from."""
SPREAD_RAD = 0.7
"""Spread of the guesses of a pose around the one before it [rad]."""
DURATION_SHARES = ((1.0, 1.0), (0.6, 1.0), (0.6, 1.0), (0.6, 1.0))
"""Ranges of guessed durations, as shares of the time in which the tool moves."""
FIT_SAMPLES = 24
"""Samples of a movement for its own fit; the fit of the whole run uses all."""
POSE_STEPS, RAMP_STEPS, RUN_STEPS = 40, 60, 100
"""Maximum number of steps of the fits of a pose, a movement and a run."""
LEAST_DURATION_S = 0.02
"""Shortest ramp in the fit of a run [s]."""
LEAST_GAIN = 1e-5
"""Smallest relative decrease of the squared error in the fit of a run."""
START_SHIFT_S = 0.15
"""Largest change of a start in the fit of a run [s]."""
REACHED_M = 1e-3
"""A pose this much worse than the best one [m] does not reach its point."""
OUTSIDE_RAD = 0.05
"""Distance from the range of random movements [rad] above which a pose is a last resort."""
OUTSIDE_FACTOR = 10.0
"""Factor on the error of fits that end there."""
EQUAL_SHARE, EQUAL_M = 0.1, 1e-7
"""Fits that are worse by less than this share of the best and this [m] are as good."""
SMOOTH_SAMPLES = 10
"""Samples of the moving average that shows movements in a noisy path."""
NO_NOISE_M = 1e-7
"""A path with less noise [m] is not averaged."""
NOISE_FACTOR = 2.5
"""Change of the average, in standard deviations of the noise, that counts as motion."""
GOOD_FIT = 2.0
"""Largest rms of a fit that is as good as the noise, in standard deviations of the noise."""
LEAST_REST_S, LEAST_MOVEMENT_S = 0.3, 0.1
"""Shorter rests belong to a movement, shorter movements to a rest [s]."""
POOR_FIT_M = 0.01
"""Largest rms error of a path made of movements [m]."""


def fit_run(path: PathPart, robot: Robot, name: str) -> Movements:
    """Return the movements of one run that fit its path best, with a leading run axis of 1.

    Args:
        path: The desired path of the run.
        robot: The robot.
        name: Name of the run, for messages.

    Raises:
        InputError: If no movements make anything like the path.
    """
    twin, good = DigitalTwin(robot), GOOD_FIT * np.sqrt(3.0) * _noise(path) + NO_NOISE_M
    best, least = None, np.inf
    for seed in SEEDS:
        movements = _Fit(path, twin, np.random.default_rng(seed)).movements()
        off = twin.path(movements.reference(path.time)[0]) - path.point
        rms = float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
        if rms < least:
            best, least = movements, rms
        if least <= good:
            break
    if best is None or least > POOR_FIT_M:
        raise InputError(
            f"run {name!r}: the best movements of robot {robot.name!r} are {least:.3f} m (rms) off "
            "its desired path. Expected ramps that all motors start together, with rests of "
            f"{LEAST_REST_S} s or more between them; give the robot it is of with --robot."
        )
    return best


def _noise(path: PathPart) -> float:
    """Return the standard deviation of a path's noise on each axis [m]; ramps hardly count."""
    bends = np.abs(np.diff(path.point, 2, axis=0))
    return float(1.4826 * np.median(bends) / np.sqrt(6.0)) if bends.size else 0.0


def _noisy_spans(path: PathPart) -> list[tuple[int, int]]:
    """Return first and last sample of every movement that stands out of a path's noise."""
    noise = _noise(path)
    width = SMOOTH_SAMPLES if noise > NO_NOISE_M and len(path.time) > 3 * SMOOTH_SAMPLES else 1
    spans = moving_spans(path, max(NOISE_FACTOR * noise, NO_NOISE_M), LEAST_REST_S, width)
    time, end = path.time, len(path.time) - 1
    return [
        (first, last)
        for first, last in spans
        if time[last] - time[first] >= LEAST_MOVEMENT_S or last == end
    ]


@dataclass(frozen=True)
class _Fit:
    """Fit of one run, one movement after the other and then all at once; `rng` draws guesses."""

    path: PathPart
    twin: DigitalTwin
    rng: np.random.Generator

    def movements(self) -> Movements:
        spans = _noisy_spans(self.path)
        zero = np.zeros((1, len(self.twin.robot.motors)))
        if not spans:
            return joined(self._poses(self.path.point.mean(axis=0), zero, 1)[0], [])
        ends = [0, *(last for _, last in spans)]
        begins = [*(first for first, _ in spans), len(self.path.time) - 1]
        rests = [
            self.path.point[end : begin + 1].mean(axis=0) if end <= begin else self.path.point[-1]
            for end, begin in zip(ends, begins, strict=True)
        ]
        origins = self._poses(rests[0], zero, FIRST_POSES)
        ramps: list[Movements] = []
        for m, (first, last) in enumerate(spans):
            part = self.path.take(slice(max(first - 3, ends[m]), min(last + 4, begins[m + 1])))
            pairs = self._pairs(origins, rests[m + 1])
            ramps.append(self._ramp((first, last), part.thinned(FIT_SAMPLES), pairs, not ramps))
            origins = ramps[-1].target[:, 0]
        return self._together(joined(ramps[0].initial[0], ramps))

    def _poses(self, point: FloatArray, near: FloatArray, count: int) -> FloatArray:
        """Return up to `count` poses (pose, motor) at `point`, the nearest to `near` first."""
        drawn = self.rng.standard_normal((4 * POSES, near.shape[1]))
        guesses = np.concatenate([near, near.mean(axis=0) + SPREAD_RAD * drawn])
        still = single_movements(guesses, guesses, 1.0, 1.0)
        at = PathPart(np.zeros(1), point[None])
        poses = fit(still, at, self.twin, self._free(True, False, False), POSE_STEPS).initial
        error = np.linalg.norm(self.twin.path(poses) - point, axis=1)
        reached = error <= error.min() + REACHED_M
        outside = np.where(reached, self._outside(poses), np.inf)
        reached &= outside <= outside.min() + OUTSIDE_RAD
        distance = np.linalg.norm(poses - near.mean(axis=0), axis=1)
        order = np.argsort(np.where(reached, distance, np.inf), kind="stable")
        return poses[order[: min(count, int(reached.sum()))]]

    def _pairs(self, origins: FloatArray, rest: FloatArray) -> FloatArray:
        """Return origins with targets at the point `rest`, (2, pair, motor) [rad]."""
        each = [self._poses(rest, origin[None], POSES // len(origins)) for origin in origins]
        first = np.repeat(origins, [len(targets) for targets in each], axis=0)
        return np.stack([first, np.concatenate(each)])

    def _free(self, origin: bool, target: bool, duration: bool) -> BoolArray:
        return np.repeat([origin, target, duration], len(self.twin.robot.motors))

    def _outside(self, poses: FloatArray) -> FloatArray:
        """Return the distance of `poses` (pose, motor) from the movements' range, (pose,) [rad]."""
        low, high = np.array([motor.movement_range for motor in self.twin.robot.motors]).T
        return np.maximum(low - poses, poses - high).clip(0.0).sum(axis=1)

    def _ramp(
        self, span: tuple[int, int], part: PathPart, pairs: FloatArray, first: bool
    ) -> Movements:
        """Return the ramp that fits one movement best; the origin of the first one is free."""
        origin, target = np.repeat(pairs, len(DURATION_SHARES), axis=1)
        begun, ended = self.path.time[list(span)]
        low, high = np.tile(np.array(DURATION_SHARES), (pairs.shape[1], 1)).T[..., None]
        duration = self.rng.uniform(low, high, origin.shape) * (ended - begun)
        guesses = single_movements(origin, target, duration, begun)
        free = self._free(first, True, True)
        return self._nearest(fit(guesses, part, self.twin, free, RAMP_STEPS), part)

    def _nearest(self, fitted: Movements, part: PathPart) -> Movements:
        """Return the one with the least travel among those that fit as well as the best."""
        off = self.twin.path(fitted.reference(part.time)) - part.point
        rms = np.sqrt(np.mean(np.sum(off**2, axis=2), axis=1))
        target = fitted.target[:, 0]
        rms = np.where(self._outside(target) <= OUTSIDE_RAD, rms, OUTSIDE_FACTOR * rms)
        good = rms <= rms.min() * (1.0 + EQUAL_SHARE) + EQUAL_M
        travel = np.linalg.norm(target - fitted.initial, axis=1)
        travel = travel + np.linalg.norm(fitted.initial, axis=1)
        best = int(np.argmin(np.where(good, travel, np.inf)))
        return fitted[best : best + 1]

    def _together(self, guess: Movements) -> Movements:
        """Return all movements of the run fitted at once."""
        robot, count = self.twin.robot, guess.start.shape[1]
        motors = len(robot.motors)
        joints = np.array([(joint.low, joint.high) for joint in robot.chain.joints])
        low, high = np.sort(joints * robot.sense[:, None], axis=1).T
        begun = np.maximum.accumulate(guess.start[0])
        longest = np.diff(begun, append=np.inf).clip(2.0 * LEAST_DURATION_S)
        shortest = np.full(count * motors, LEAST_DURATION_S)
        limits = (
            np.concatenate([np.tile(low, count + 1), shortest, begun - START_SHIFT_S]),
            np.concatenate(
                [np.tile(high, count + 1), np.repeat(longest, motors), begun + START_SHIFT_S]
            ),
        )
        free = np.full((1 + 2 * count) * motors, True)
        fitted = fit(guess, self.path, self.twin, free, RUN_STEPS, limits, LEAST_GAIN)
        return without_idle_ramps(fitted)
