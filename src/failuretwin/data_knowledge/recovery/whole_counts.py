"""Movements recovered exactly: targets in whole servo counts, ramps of published durations."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np

from failuretwin.core.movements import Movements
from failuretwin.core.types import BoolArray, FloatArray, frozen_array
from failuretwin.data_knowledge.recovery.plane_arm import EXACT_M, MOTORS, PlaneArm
from failuretwin.data_knowledge.recovery.ramp_fit import (
    STAYS_RAD,
    PathPart,
    fit,
    joined,
    largest_error,
    moving_spans,
    single_movements,
    without_idle_ramps,
)
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.failure_behavior.random_movements import RandomMovements

RAMP_S = frozen_array([s * RandomMovements().period_s for s in RandomMovements().ramp_shares])
"""Durations of published ramps [s], the shortest first."""
WHOLE_COUNTS = 0.02
"""Largest distance of a fitted angle from its whole count [counts]."""
FIT_SAMPLES = 16
"""Samples of a movement for first fits; the last fit uses all."""
CUT_OFF_STEPS = (40, 400)
"""Steps of the fit to a ramp that is cut off; few suffice unless the arm was straight before."""
LAST_ANGLES = 60
"""First guesses of the last motor where the record ends, or begins, within a ramp."""
REACH_SLACK = 0.05
"""Excess of the third joint's cosine over 1 that these guesses accept."""
BEST_GUESSES = 30
"""First guesses that are followed up there."""
NEAR_M = 1e-7
"""Largest error of a first fit [m]: a wrong duration is off by 1e-4 m or more."""
EARLIEST_S = 0.1
"""Longest time from the start of a ramp to the start of the record that cuts it [s]."""
NONE = np.zeros(MOTORS, dtype=np.bool_)
ALL = np.ones(MOTORS, dtype=np.bool_)
STILL_M = 1e-10
"""Largest motion of a resting tool from one sample to the next [m]."""
LEAST_REST_S = 0.045
"""Shortest rest [s]; a shorter one is the turning point of a movement."""


class NoWholeUnitsError(Exception):
    """No movements between whole counts make the path; the text says where."""


def solve_run(path: PathPart, arm: PlaneArm) -> Movements:
    """Return the movements of one run, with a leading run axis of 1.

    A motor that stays has a duration of 0. Where the end of the record cuts off a ramp and several
    targets and durations make the visible part, the result is one of these; where next to nothing
    is visible, targets may lie between counts.

    Raises:
        NoWholeUnitsError: If no movements make this path.
    """
    spans = moving_spans(path, STILL_M, LEAST_REST_S)
    if not spans:
        return joined(_resting_pose(path, arm), [])
    ramps: list[Movements] = []
    for first, last in reversed(spans):
        following = ramps[0].initial if ramps else None
        ramps.insert(0, _solve_stretch(path, first, last, arm, following))
    movements = without_idle_ramps(joined(ramps[0].initial[0], ramps))
    off = np.abs(DigitalTwin(arm.robot).path(movements.reference(path.time)[0]) - path.point)
    if off.max() > EXACT_M:
        at = path.time[off.max(axis=1).argmax()]
        raise NoWholeUnitsError(f"at {at:.2f} s the tool does not rest where it should")
    return movements


def _resting_pose(path: PathPart, arm: PlaneArm) -> FloatArray:
    poses = arm.whole_poses(path.point[0])
    if not len(poses):
        raise NoWholeUnitsError("no pose in whole servo units puts the tool where it rests")
    return arm.units.to_rad(np.where(np.isnan(poses[0]), arm.units.to_counts(0.0), poses[0]))


def _solve_stretch(
    path: PathPart, first: int, last: int, arm: PlaneArm, following: FloatArray | None
) -> Movements:
    """Return the movement from sample `first` to `last`.

    Args:
        path: The path of the run.
        first: Last sample before the movement.
        last: First sample after it.
        arm: The arm.
        following: Origin of the next movement, (1, motor) [rad]; None for the last one.
    """
    seen = path.take(slice(first, last + 1))
    begun = f"the movement at {seen.time[0]:.2f} s"
    origins = arm.units.to_rad(arm.whole_poses(seen.point[0]))
    targets = following
    if targets is None:
        targets = arm.units.to_rad(arm.whole_poses(seen.point[-1]))
    cut_off = following is None and last == len(path.time) - 1
    if not len(origins) and first > 0:
        raise NoWholeUnitsError(f"no pose in whole servo units puts the tool where {begun} begins")
    if not len(targets) and not cut_off:
        raise NoWholeUnitsError(f"no pose in whole servo units puts the tool where {begun} ends")
    if not len(origins) and not len(targets):
        raise NoWholeUnitsError("the record holds no settled pose")
    ramp = _SeenRamp(seen, arm)
    if len(origins):
        solved = _first(ramp.between(*pair) for pair in product(origins, targets))
    else:
        solved = _first(ramp.begun_before(target) for target in targets)
    if solved is None and cut_off:
        solved = _first(ramp.cut_off(origin) for origin in origins)
    if solved is None:
        raise NoWholeUnitsError(f"no start and durations of the published kind make {begun}")
    return solved


def _first(ramps: Iterable[Movements | None]) -> Movements | None:
    return next((ramp for ramp in ramps if ramp is not None), None)


def _durations(moves: BoolArray) -> FloatArray:
    """Return all choices of durations (choice, motor) [s]; motors that stay have one only."""
    return np.array(list(product(*(RAMP_S if moving else RAMP_S[:1] for moving in moves))))


@dataclass(frozen=True)
class _SeenRamp:
    """Visible path of one movement, from the last sample before it to the first one after it.

    The solutions are None where no ramp of whole counts and published durations makes the path.
    """

    part: PathPart
    arm: PlaneArm

    @cached_property
    def _twin(self) -> DigitalTwin:
        return DigitalTwin(self.arm.robot)

    @cached_property
    def _few(self) -> PathPart:
        return self.part.thinned(FIT_SAMPLES)

    @property
    def _middle_start(self) -> float:
        """Half-way between the last sample at rest and the first one under way [s]."""
        return float(self.part.time[:2].mean())

    def between(self, origin: FloatArray, target: FloatArray) -> Movements | None:
        """Return the ramp between two poses (motor,) [rad]; motor 1 may be NaN: unknown."""
        free = np.concatenate([np.isnan(origin), np.isnan(target), NONE])
        origin, target = self._with_first_motor(origin, target)
        moves = (np.abs(target - origin) > STAYS_RAD) | free[:MOTORS] | free[MOTORS : 2 * MOTORS]
        guesses = single_movements(origin, target, _durations(moves), self._middle_start)
        return self._settled(self._fit(guesses, free, self._few, 10), free)

    def begun_before(self, target: FloatArray) -> Movements | None:
        """Return the ramp to `target` (motor,) [rad] that is under way when the record begins.

        It has begun shortly before, as in records that start with the last reading before the first
        movement.
        """
        if np.isnan(target).any():
            return None
        poses, durations = self._poses_at(0, target), _durations(ALL)
        step = float(self.part.time[1] - self.part.time[0])
        guesses = single_movements(
            np.repeat(poses, len(durations), axis=0),
            target,
            np.tile(durations, (len(poses), 1)),
            self.part.time[0] - 0.5 * step,
        )
        free = np.concatenate([ALL, NONE, NONE])
        fitted = self._fit(self._best(guesses, self._few), free, self._few, 40)
        begun = self.part.time[0] - fitted.start[:, 0]
        return self._settled(fitted[(begun >= 0.0) & (begun <= EARLIEST_S)], free)

    def cut_off(self, origin: FloatArray) -> Movements | None:
        """Return the ramp from `origin` (motor,) [rad] that the end of the record cuts off.

        Where several targets and durations make the visible part, it is one of these. Where its
        speeds stay vague, its target may lie between counts.
        """
        hidden = np.isnan(origin)
        origin, _ = self._with_first_motor(origin, origin)
        # All motors are under way together for as long as the shortest ramp takes.
        together = self.part.take(self.part.time <= self.part.time[0] + RAMP_S[0])
        poses = np.stack([origin, *self._poses_at(len(together.time) - 1, origin)])
        done = (together.time[-1] - self._middle_start) / RAMP_S[0]
        target = origin + (poses - origin) / done
        part = together.thinned(FIT_SAMPLES)
        guesses = single_movements(origin, target, RAMP_S[0], self._middle_start)
        guesses = self._best(guesses, part)
        for steps in CUT_OFF_STEPS:
            guesses = self._fit(guesses, np.concatenate([hidden, ALL, NONE]), part, steps)
            near = guesses[np.argsort(largest_error(guesses, part, self._twin), kind="stable")]
            near = near[largest_error(near, part, self._twin) <= NEAR_M]
            solved = _first(self._whole_near(ramp, hidden) for ramp in _each(near))
            if solved is None and len(near.start):
                solved = self._finished(near[:1])
            if solved is not None:
                return solved
        return None

    def _whole_near(self, fitted: Movements, hidden: BoolArray) -> Movements | None:
        """Return the exact ramp to whole counts near one fitted ramp of the shortest duration."""
        free = np.concatenate([hidden, NONE, NONE])
        whole = self._fit(self._whole_targets(fitted), free, self._few, 10)
        return self._settled(whole, free)

    def _with_first_motor(
        self, origin: FloatArray, target: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return both poses with a guess of motor 1 where the tool on its axis hides it."""
        off_axis = self.arm.radius(self.part.point) > 1e3 * EXACT_M
        if not (np.isnan(origin[0]) or np.isnan(target[0])) or off_axis.sum() < 2:
            return np.nan_to_num(origin), np.nan_to_num(target)
        time = self.part.time[off_axis]
        turn = np.unwrap(self.arm.turns(self.part.point[off_axis]), period=np.pi)
        known = next((x for x in (target[0] - turn[-1], origin[0] - turn[0]) if x == x), None)
        if known is None:
            known = np.mean(self.arm.robot.motors[0].movement_range) - turn.mean()
        turn = turn + np.pi * np.round(known / np.pi)
        speed = (turn[1] - turn[0]) / (time[1] - time[0])
        first = turn[0] - speed * (time[0] - self._middle_start)
        origin, target = origin.copy(), target.copy()
        origin[0] = first if np.isnan(origin[0]) else origin[0]
        target[0] = turn[-1] if np.isnan(target[0]) else target[0]
        return origin, target

    def _poses_at(self, sample: int, near: FloatArray) -> FloatArray:
        """Return poses all over the arm's range at one sample, (pose, motor) [rad].

        A hidden motor 1 is taken from the pose `near` (motor,).
        """
        counts = self.arm.all_counts
        last = self.arm.units.to_rad(np.linspace(counts.low[-1], counts.high[-1], LAST_ANGLES))
        poses = self.arm.poses(self.part.point[sample], last, REACH_SLACK)
        return np.where(np.isnan(poses), near, poses)

    def _fit(self, guesses: Movements, free: BoolArray, part: PathPart, steps: int) -> Movements:
        return fit(guesses, part, self._twin, free, steps)

    def _best(self, guesses: Movements, part: PathPart) -> Movements:
        error = largest_error(guesses, part, self._twin)
        return guesses[np.argsort(error, kind="stable")[:BEST_GUESSES]]

    def _whole_targets(self, fitted: Movements) -> Movements:
        """Return the ramps of published durations to the whole counts nearest to fitted speeds.

        Those within the ranges of random movements come first.
        """
        units, origin, target = self.arm.units, fitted.initial[0], fitted.target[0, 0]
        moves = np.abs(target - origin) > STAYS_RAD
        durations = _durations(moves)
        speed = (target - origin) / fitted.ramp_duration[0, 0]
        counts = np.round(units.to_counts(origin + speed * durations))
        usual = self.arm.movement_counts.hold(counts)
        possible = self.arm.all_counts.hold(counts)
        rows = np.concatenate([np.flatnonzero(usual), np.flatnonzero(possible & ~usual)])
        targets = np.where(moves, units.to_rad(counts[rows]), origin)
        return single_movements(origin, targets, durations[rows], fitted.start[0, 0])

    def _settled(self, fitted: Movements, free: BoolArray) -> Movements | None:
        """Return the first exact ramp with its free angles on whole counts."""
        near = fitted[largest_error(fitted, self._few, self._twin) <= NEAR_M]
        rounded = (self._rounded(ramp, free) for ramp in _each(near))
        return _first(self._finished(ramp) for ramp in rounded if ramp is not None)

    def _rounded(self, ramp: Movements, free: BoolArray) -> Movements | None:
        """Return `ramp` with its free angles on whole counts, None if they are not near any."""
        angles = np.concatenate([ramp.initial, ramp.target[0]])
        free_angles = free[: 2 * MOTORS].reshape(2, MOTORS)
        counts = self.arm.units.to_counts(angles)
        whole = np.where(free_angles, np.round(counts), counts)
        if np.abs(whole - counts).max() > WHOLE_COUNTS or not self.arm.all_counts.hold(whole).all():
            return None
        origin, target = np.where(free_angles, self.arm.units.to_rad(whole), angles)
        return replace(ramp, initial=origin[None], target=target[None, None])

    def _finished(self, ramp: Movements) -> Movements | None:
        """Return `ramp` with its start refined over all samples, None if it is not exact."""
        ramp = self._fit(ramp, np.concatenate([NONE, NONE, NONE]), self.part, 6)
        return ramp if largest_error(ramp, self.part, self._twin)[0] <= EXACT_M else None


def _each(movements: Movements) -> Iterator[Movements]:
    """Yield the guesses one by one, each with a run axis of 1."""
    return (movements[row : row + 1] for row in range(len(movements.start)))
