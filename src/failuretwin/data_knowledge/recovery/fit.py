"""Single movements fitted to a path: damped Gauss-Newton from many first guesses at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from failuretwin.core.errors import InputError
from failuretwin.core.movements import Movements
from failuretwin.core.types import BoolArray, FloatArray, IntArray, as_floats
from failuretwin.digital_model.robot import Robot
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


# All movements of a run fitted to its path at once, by least squares.

STEPS = 100
"""Most steps of the fit."""
RUN_DAMPING, DAMPING_RANGE = 1e-4, (1e-13, 1e2)
"""First damping and its limits, as shares of the largest diagonal entry of the equations."""
LEAST_GAIN = 1e-5
"""The fit ends with a step that lessens the squared error by a smaller share."""
LEAST_COST = 1e-24
"""A squared error as small as rounding [m2]."""
START_SHIFT_S = 0.15
"""A start may move this far from its first guess [s]."""
LEAST_DURATION_S = 0.02
"""Shortest ramp that is fitted [s]."""
STAYS_RAD = 1e-6
"""A motor with less travel [rad] does not move."""


@dataclass(frozen=True)
class RunFit:
    """The fit of all movements of a run at once, from first guesses of each.

    The parameters are the initial pose, all targets, all durations and all starts, in this order.

    Attributes:
        path: The desired path.
        twin: Its kinematics make a path of a reference.
        ramps: One guess of each movement.
    """

    path: PathPart
    twin: DigitalTwin
    ramps: Sequence[Ramps]

    def movements(self) -> Movements:
        """Return the best movements, with a leading run axis of 1."""
        pose, duration, start = self._unpack(self._fitted())
        stays = np.abs(np.diff(pose, axis=0)) <= STAYS_RAD
        return Movements(
            initial=pose[:1],
            target=pose[None, 1:],
            ramp_duration=np.where(stays, 0.0, duration)[None],
            start=start[None],
        )

    def _fitted(self) -> FloatArray:
        """Return the best parameters, by damped Gauss-Newton steps within bounds."""
        low, high = self._bounds()
        guess = np.clip(self._pack(), low, high)
        x, error, J = guess, self._error(guess), self._jacobian(guess)
        damping = RUN_DAMPING
        for _ in range(STEPS):
            trial = np.clip(x + _run_step(error, J, damping), low, high)
            trial_error = self._error(trial)
            gain = 1.0 - np.sum(trial_error**2) / max(np.sum(error**2), LEAST_COST)
            if gain > 0.0:
                x, error, J = trial, trial_error, self._jacobian(trial)
            damping = np.clip(damping * (0.1 if gain > 0.0 else 10.0), *DAMPING_RANGE)
            if 0.0 <= gain < LEAST_GAIN or damping == DAMPING_RANGE[1]:
                break
        return x

    def _pack(self) -> FloatArray:
        pose = [self.ramps[0].origin, *(ramp.target for ramp in self.ramps)]
        duration = [ramp.duration for ramp in self.ramps]
        start = [ramp.start for ramp in self.ramps]
        return np.concatenate([np.ravel(pose), np.ravel(duration), np.ravel(start)])

    def _unpack(self, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return poses (1 + movement, motor), durations (movement, motor), starts (movement,)."""
        count, motors = len(self.ramps), len(self.twin.robot.motors)
        ends = [(count + 1) * motors, (2 * count + 1) * motors]
        pose, duration, start = np.split(x, ends)
        return pose.reshape(-1, motors), duration.reshape(-1, motors), start

    def _bounds(self) -> tuple[FloatArray, FloatArray]:
        count, motors = len(self.ramps), len(self.twin.robot.motors)
        low, high = _limits(self.twin.robot)
        begun = np.array([ramp.start[0] for ramp in self.ramps])
        begun = np.maximum.accumulate(begun)
        longest = np.diff(begun, append=np.inf).clip(2.0 * LEAST_DURATION_S)
        early, late = begun - START_SHIFT_S, begun + START_SHIFT_S
        shortest = np.full(count * motors, LEAST_DURATION_S)
        return (
            np.concatenate([np.tile(low, count + 1), shortest, early]),
            np.concatenate([np.tile(high, count + 1), np.repeat(longest, motors), late]),
        )

    def _shares(self, x: FloatArray) -> FloatArray:
        """Return how much of each ramp is done, (movement, time, motor)."""
        _, duration, start = self._unpack(x)
        passed = self.path.time[None, :, None] - start[:, None, None]
        return np.clip(passed / duration[:, None], 0.0, 1.0)

    def _reference(self, x: FloatArray) -> FloatArray:
        pose, _, _ = self._unpack(x)
        return pose[0] + np.einsum("mtk,mk->tk", self._shares(x), np.diff(pose, axis=0))

    def _error(self, x: FloatArray) -> FloatArray:
        return (self.twin.path(self._reference(x)) - self.path.point).ravel()

    def _jacobian(self, x: FloatArray) -> FloatArray:
        """Return derivatives of `_error`, (time * axis, parameter)."""
        pose, duration, _ = self._unpack(x)
        share, travel = self._shares(x), np.diff(pose, axis=0)
        _, by_motor = self.twin.path_and_jacobian(self._reference(x))
        under_way = (share > 0.0) & (share < 1.0)
        speed = np.where(under_way, (travel / duration)[:, None], 0.0)
        of_pose = np.concatenate([1.0 - share[:1], share[:-1] - share[1:], share[-1:]])
        by_pose = np.einsum("tak,mtk->tamk", by_motor, of_pose)
        by_duration = np.einsum("tak,mtk->tamk", by_motor, -speed * share)
        by_start = np.einsum("tak,mtk->tam", by_motor, -speed)
        rows = 3 * len(self.path.time)
        parts = (by_pose, by_duration, by_start)
        return np.concatenate([part.reshape(rows, -1) for part in parts], axis=1)


def _limits(robot: Robot) -> tuple[FloatArray, FloatArray]:
    """Return lowest and highest angles in the log's sense, (motor,) [rad]."""
    joints = np.array([(joint.low, joint.high) for joint in robot.chain.joints])
    ends = np.sort(joints * robot.sense[:, None], axis=1)
    return ends[:, 0], ends[:, 1]


def _run_step(error: FloatArray, J: FloatArray, damping: float) -> FloatArray:
    # Without BLAS, see above.
    normal = np.einsum("rp,rq->pq", J, J)
    normal += damping * normal.diagonal().max() * np.eye(len(normal))
    return as_floats(-np.linalg.solve(normal, np.einsum("rp,r->p", J, error)))


# Movements fitted to a desired path by least squares: targets, durations and starts of any value.

SEEDS = (0, 1, 2)
"""Seeds of the first guesses, each tried until the fit is as good as the path's noise."""
POSES = 32
"""Poses that the fit of each movement starts from."""
FIRST_POSES = 6
"""Poses before the first movement that its fit starts from."""
SPREAD_RAD = 0.7
"""Spread of the guesses of a pose around the one before it [rad]."""
DURATION_SHARES = ((1.0, 1.0), (0.6, 1.0), (0.6, 1.0), (0.6, 1.0))
"""Ranges of guessed durations, as shares of the time for which the tool moves."""
FIT_SAMPLES = 24
"""Samples of a movement that its own fit looks at; the fit of the whole run looks at all."""
POSE_STEPS, RAMP_STEPS = 40, 60
"""Most steps of the fits of a pose and of a movement."""
REACHED_M = 1e-3
"""A pose this much worse than the best one [m] does not reach its point."""
OUTSIDE_RAD = 0.05
"""Poses further outside the range of random movements [rad] are taken where nothing else fits."""
OUTSIDE_FACTOR = 10.0
"""Fits that end there count as so many times worse."""
EQUAL_SHARE, EQUAL_M = 0.1, 1e-7
"""Fits that are worse by less than this share of the best and this [m] are as good."""
SMOOTH_SAMPLES = 10
"""Samples that are averaged to see movements in a path with noise."""
NO_NOISE_M = 1e-7
"""A path with less noise [m] is not averaged."""
NOISE_FACTOR = 2.5
"""A noisy path moves where its average changes by more than so many standard deviations."""
GOOD_FIT = 2.0
"""A fit is as good as the noise if its rms is at most this many times the noise's."""
LEAST_REST_S, LEAST_MOVEMENT_S = 0.3, 0.1
"""Shorter rests belong to a movement, shorter movements to a rest [s]."""
POOR_FIT_M = 0.01
"""A path whose fit is off by more than this rms [m] is not made of movements."""


def fit_run(path: PathPart, robot: Robot, name: str) -> Movements:
    """Return the movements of one run that fit its path best, with a leading run axis of 1.

    Args:
        path: The desired path of the run.
        robot: The robot.
        name: Name of the run, for messages.

    Raises:
        InputError: If the path is nothing that movements could make.
    """
    twin, good = DigitalTwin(robot), GOOD_FIT * np.sqrt(3.0) * _noise(path) + NO_NOISE_M
    best, least = None, np.inf
    for seed in SEEDS:
        movements = _FirstGuess(path, twin, np.random.default_rng(seed)).movements()
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


def moving_spans(path: PathPart) -> list[tuple[int, int]]:
    """Return first and last sample of every movement that stands out of a path's noise."""
    noise = _noise(path)
    width = SMOOTH_SAMPLES if noise > NO_NOISE_M and len(path.time) > 3 * SMOOTH_SAMPLES else 1
    smooth = np.stack(
        [np.convolve(axis, np.full(width, 1.0 / width), "valid") for axis in path.point.T], axis=1
    )
    change = np.linalg.norm(smooth[width:] - smooth[:-width], axis=1)
    moving = change > max(NOISE_FACTOR * noise, NO_NOISE_M)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], moving.astype(int), [0]])))
    spans: list[tuple[int, int]] = []
    for first, last in edges.reshape(-1, 2).tolist():
        # A change between two averages shows up to two widths before it begins.
        begin, end = min(first + width - 1, last), min(last + width - 1, len(path.time) - 1)
        if spans and path.time[begin] - path.time[spans[-1][1]] < LEAST_REST_S:
            begin = spans.pop()[0]
        spans.append((begin, end))
    return [
        (first, last)
        for first, last in spans
        if path.time[last] - path.time[first] >= LEAST_MOVEMENT_S or last == len(path.time) - 1
    ]


@dataclass(frozen=True)
class _FirstGuess:
    """Movements of one run, one after the other; `rng` draws what their fits start from."""

    path: PathPart
    twin: DigitalTwin
    rng: np.random.Generator

    def movements(self) -> Movements:
        spans = moving_spans(self.path)
        zero = np.zeros((1, len(self.twin.robot.motors)))
        if not spans:
            rest = self._poses(self.path.point.mean(axis=0), zero, 1)
            none = np.empty((1, 0, zero.shape[1]))
            return Movements(rest, none, none, np.empty((1, 0)))
        ends = [0, *(last for _, last in spans)]
        begins = [*(first for first, _ in spans), len(self.path.time) - 1]
        rests = [
            self.path.point[end : begin + 1].mean(axis=0) if end <= begin else self.path.point[-1]
            for end, begin in zip(ends, begins, strict=True)
        ]
        origins = self._poses(rests[0], zero, FIRST_POSES)
        ramps: list[Ramps] = []
        for m, span in enumerate(spans):
            part = self.path.take(slice(max(span[0] - 3, ends[m]), min(span[1] + 4, begins[m + 1])))
            part = part.thinned(FIT_SAMPLES)
            ramps.append(self._ramp(span, part, origins, rests[m + 1], first=m == 0))
            origins = ramps[-1].target
        return RunFit(self.path, self.twin, ramps).movements()

    def _poses(self, point: FloatArray, near: FloatArray, count: int) -> FloatArray:
        """Return up to `count` poses (pose, motor) at `point`, the nearest to `near` first."""
        motors = near.shape[1]
        guesses = near.mean(axis=0) + SPREAD_RAD * self.rng.standard_normal((4 * POSES, motors))
        guesses = np.concatenate([near, guesses])
        count_all = len(guesses)
        free = Free(*(np.full(motors, x) for x in (True, False, False)))
        still = Ramps(guesses, guesses, np.ones_like(guesses), np.full(count_all, 1.0))
        at = PathPart(np.zeros(1), point[None])
        poses = fit_ramps(still, free, at, self.twin, POSE_STEPS).origin
        error = np.linalg.norm(self.twin.path(poses) - point, axis=1)
        reached = error <= error.min() + REACHED_M
        outside = np.where(reached, self._outside(poses), np.inf)
        reached &= outside <= outside.min() + OUTSIDE_RAD
        distance = np.linalg.norm(poses - near.mean(axis=0), axis=1)
        order = np.argsort(np.where(reached, distance, np.inf), kind="stable")
        return poses[order[: min(count, int(reached.sum()))]]

    def _outside(self, poses: FloatArray) -> FloatArray:
        """Return how far `poses` (pose, motor) lie outside the movements' range, (pose,) [rad]."""
        low, high = np.array([motor.movement_range for motor in self.twin.robot.motors]).T
        return np.maximum(low - poses, poses - high).clip(0.0).sum(axis=1)

    def _ramp(
        self,
        span: tuple[int, int],
        part: PathPart,
        origins: FloatArray,
        rest: FloatArray,
        *,
        first: bool,
    ) -> Ramps:
        """Return the ramp that fits one movement best; its origin is free if it is the first."""
        motors = origins.shape[1]
        pairs = [
            (origin, target)
            for origin in origins
            for target in self._poses(rest, origin[None], POSES // len(origins))
        ]
        origin, target = (
            np.repeat(x, len(DURATION_SHARES), axis=0)
            for x in map(np.array, zip(*pairs, strict=True))
        )
        begun, ended = self.path.time[list(span)]
        low, high = np.tile(np.array(DURATION_SHARES), (len(pairs), 1)).T[..., None]
        shares = self.rng.uniform(low, high, (len(origin), motors))
        guesses = Ramps(origin, target, shares * (ended - begun), np.full(len(origin), begun))
        free = Free(*(np.full(motors, x) for x in (first, True, True)))
        fitted = fit_ramps(guesses, free, part, self.twin, RAMP_STEPS)
        return self._nearest(fitted, part)

    def _nearest(self, fitted: Ramps, part: PathPart) -> Ramps:
        """Return the one with the least travel among those that fit as well as the best."""
        off = self.twin.path(fitted.reference(part.time)) - part.point
        rms = np.sqrt(np.mean(np.sum(off**2, axis=2), axis=1))
        rms = np.where(self._outside(fitted.target) <= OUTSIDE_RAD, rms, OUTSIDE_FACTOR * rms)
        good = rms <= rms.min() * (1.0 + EQUAL_SHARE) + EQUAL_M
        travel = np.linalg.norm(fitted.target - fitted.origin, axis=1)
        travel = travel + np.linalg.norm(fitted.origin, axis=1)
        best = int(np.argmin(np.where(good, travel, np.inf)))
        return fitted[best : best + 1]
