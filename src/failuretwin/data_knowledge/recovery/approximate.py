"""Movements fitted to a desired path by least squares: targets, durations and starts of any value.

For paths that are not exact or whose targets are no whole units, and for arms of any kind. The
tool position leaves some motors open: of the poses that fit the ramps equally well, the one
nearest to the pose before is taken, and for the first pose the one nearest to zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.movements import Movements
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.recovery.ramp_fit import Free, PathPart, Ramps, fit_ramps
from failuretwin.data_knowledge.recovery.run_fit import RunFit
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin

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
