"""Motor commands recovered from desired tool paths, for published runs that hold no commands.

A desired path is what the kinematics make of the reference of the motors. Where that reference
ramps between whole servo units, as the published ones do, movements come back exactly; others can
be fitted by least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.movements import Movements
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.data_knowledge.recovery.recovery_exact import NoWholeUnitsError, solve_run
from failuretwin.data_knowledge.recovery.recovery_inverse_kinematics import (
    PlaneArm,
    plane_arm,
)
from failuretwin.data_knowledge.recovery.recovery_ramps import (
    Free,
    PathPart,
    Ramps,
    fit_movements,
    fit_ramps,
)
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin

STEP_S = 0.01
"""Nominal step of published runs [s]."""


def recover_movements(
    desired: FloatArray,
    time: FloatArray,
    robot: Robot,
    *,
    approximate: bool = False,
    names: Sequence[str],
) -> Movements:
    """Return the movements whose reference makes the desired paths.

    Targets are whole servo units, ramps of the published durations; motors that stay have a
    duration of 0, movements without any travel do not appear. The last ramp of a record that ends
    within it is one of those that make what is seen of it, and a movement that begins after the
    record does not appear. What comes back makes the desired path to 1e-9 m.

    Args:
        desired: Desired tool paths in the base frame, (run, time, axis) [m].
        time: Uniform time grid, (time,) [s].
        robot: The robot.
        approximate: Fit the runs that have no such movements by least squares, with targets
            and durations of any value. A tool position leaves the pose of an arm with more than
            three motors open; the fit takes the pose nearest to the one before it among those
            that also fit the ramps.
        names: Name of each run, for messages.

    Raises:
        InputError: If the arrays do not fit, or a run has no such movements and `approximate`
            is False, or nothing of a run's path can be fitted.
    """
    desired, time = _checked(desired, time, names)
    arm = _arm_unless(robot, approximate=approximate)
    parts = [
        _recover_run(PathPart(time, path), robot, arm, approximate, name)
        for path, name in zip(desired, names, strict=True)
    ]
    return _stacked(parts, len(robot.motors))


def path_error(
    movements: Movements, desired: FloatArray, time: FloatArray, robot: Robot
) -> FloatArray:
    """Return how far the path of `movements` is off `desired` at most, (run,) [m].

    Args:
        movements: Movements of every run.
        desired: Desired tool paths in the base frame, (run, time, axis) [m].
        time: Time grid, (time,) [s].
        robot: The robot.
    """
    off = DigitalTwin(robot).path(movements.reference(time)) - desired
    return np.linalg.norm(off, axis=-1).max(axis=1, initial=0.0)


def published_time_bases(samples: int) -> list[FloatArray]:
    """Return the grids that published runs come on, (time,) [s].

    For 1000 samples these are 0.01 to 10.00, and 1000 points from 0 to 10.
    """
    end = samples * STEP_S
    return [as_floats(np.arange(1, samples + 1) * STEP_S), np.linspace(0.0, end, samples)]


def published_time(desired: FloatArray, robot: Robot, *, names: Sequence[str]) -> FloatArray:
    """Return the time base on which movements of published durations make the desired paths.

    The bases differ in their step, which whole movements reveal; an offset of the whole run in
    time could not be seen. Runs whose movements are all cut off fit both. Where no run decides,
    because none is exact or the robot is of another kind than the search for whole units can
    handle, it is the grid from 0.01 s.

    Args:
        desired: Desired tool paths in the base frame, (run, time, axis) [m].
        robot: The robot.
        names: Name of each run, for messages.

    Raises:
        InputError: If the arrays do not fit.
    """
    bases = published_time_bases(np.shape(desired)[1])
    desired, _ = _checked(desired, bases[0], names)
    arm = _arm_unless(robot, approximate=True)
    if arm is None:
        return bases[0]
    for path in desired:
        fitting = [base for base in bases if _is_exact(PathPart(base, path), arm)]
        if len(fitting) == 1:
            return fitting[0]
    return bases[0]


def _is_exact(path: PathPart, arm: PlaneArm) -> bool:
    try:
        solve_run(path, arm)
    except NoWholeUnitsError:
        return False
    return True


def _recover_run(
    path: PathPart, robot: Robot, arm: PlaneArm | None, approximate: bool, name: str
) -> Movements:
    """Return the movements of one run; `arm` is None where whole units cannot be searched."""
    if arm is not None:
        try:
            return solve_run(path, arm)
        except NoWholeUnitsError as reason:
            if not approximate:
                raise InputError(
                    f"run {name!r}: no movements of robot {robot.name!r} between whole servo "
                    f"units make its desired path exactly: {reason}. If the path is of another "
                    "robot, give that one with --robot; if its targets are no whole units or it "
                    "holds noise, use --approximate."
                ) from None
    return fit_run(path, robot, name)


def _arm_unless(robot: Robot, *, approximate: bool) -> PlaneArm | None:
    """Return the arm to search, None where it cannot be searched and need not be."""
    try:
        return plane_arm(robot)
    except InputError:
        if not approximate:
            raise
        return None


def _checked(
    desired: FloatArray, time: FloatArray, names: Sequence[str]
) -> tuple[FloatArray, FloatArray]:
    desired, time = as_floats(desired), as_floats(time)
    if desired.ndim != 3 or desired.shape[1:] != (len(time), 3) or len(time) < 2:
        raise InputError(
            f"`desired` has shape {desired.shape}, expected (run, {len(time)} times, 3 axes) with "
            "two samples at least."
        )
    if len(names) != len(desired):
        raise InputError(f"{len(names)} names for {len(desired)} runs. Give one for each run.")
    for name, path in zip(names, desired, strict=True):
        if not np.all(np.isfinite(path)):
            raise InputError(
                f"run {name!r}: its desired path holds values that are not finite. Expected a "
                "position [m] at every sample."
            )
    return desired, time


def _stacked(parts: Sequence[Movements], motors: int) -> Movements:
    """Return the movements of all runs, runs with fewer padded by NaN."""
    count = max((part.start.shape[1] for part in parts), default=0)
    target, ramp = np.full((2, len(parts), count, motors), np.nan)
    start = np.full((len(parts), count), np.nan)
    initial = np.empty((len(parts), motors))
    for run, part in enumerate(parts):
        own = part.start.shape[1]
        initial[run], start[run, :own] = part.initial[0], part.start[0]
        target[run, :own], ramp[run, :own] = part.target[0], part.ramp_duration[0]
    return Movements(initial, target, ramp, start)


# Runs without such movements: targets, durations and starts of any value, by least squares.

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
        return fit_movements(self.path, self.twin, ramps)

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
