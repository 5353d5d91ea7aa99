"""One movement out of an exact desired path: targets in whole servo units, published durations."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np

from failuretwin.core.movements import Movements
from failuretwin.core.types import BoolArray, FloatArray, frozen_array
from failuretwin.data_knowledge.recovery.recovery_inverse_kinematics import (
    EXACT_M,
    MOTORS,
    PlaneArm,
)
from failuretwin.data_knowledge.recovery.recovery_ramps import (
    Free,
    PathPart,
    Ramps,
    fit_ramps,
    largest_error,
)
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.failure_behavior.random_movements import RandomMovements

RAMP_S = frozen_array([s * RandomMovements().period_s for s in RandomMovements().ramp_shares])
"""Durations that the ramps of published movements take [s], the shortest first."""
WHOLE_COUNTS = 0.02
"""A fitted angle may be this far off the whole unit that it stands for [counts]."""
STAYS_RAD = 1e-9
"""A motor with less travel [rad] does not move."""
FIT_SAMPLES = 16
"""Samples of a movement that first fits look at; the last fit looks at all."""
CUT_OFF_STEPS = (40, 400)
"""Steps of the fit to a ramp that is cut off; few suffice unless the arm was straight before."""
LAST_ANGLES = 60
"""First guesses of the last motor where the record ends, or begins, within a ramp."""
REACH_SLACK = 0.05
"""These guesses may miss the tool as if its third joint had a cosine of 1.05."""
BEST_GUESSES = 30
"""First guesses that are followed up there."""
NEAR_M = 1e-7
"""First fits with a larger error [m] are wrong: a wrong duration is off by 1e-4 m or more."""
EARLIEST_S = 0.1
"""A ramp under way when the record begins has begun at most this long before [s]."""
NONE = np.zeros(MOTORS, dtype=np.bool_)
ALL = np.ones(MOTORS, dtype=np.bool_)


@dataclass(frozen=True)
class SeenRamp:
    """What a record holds of one movement.

    Attributes:
        part: Its path, from the last sample before it to the first one after it, where seen.
        arm: The arm.
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

    def between(self, origin: FloatArray, target: FloatArray) -> Ramps | None:
        """Return the ramp from `origin` to `target`, None if there is none.

        Args:
            origin: Pose before it, (motor,) [rad]; motor 1 NaN: found from the ramp.
            target: Pose after it, (motor,) [rad]; motor 1 NaN: found from the ramp.
        """
        free = Free(np.isnan(origin), np.isnan(target), NONE)
        origin, target = self._with_first_motor(origin, target)
        moves = (np.abs(target - origin) > STAYS_RAD) | free.origin | free.target
        durations = _durations(moves)
        start = np.full(len(durations), self._middle_start)
        guesses = Ramps(
            np.tile(origin, (len(start), 1)), np.tile(target, (len(start), 1)), durations, start
        )
        return self._settled(fit_ramps(guesses, free, self._few, self._twin, steps=10), free)

    def begun_before(self, target: FloatArray) -> Ramps | None:
        """Return the ramp to `target` (motor,) [rad] that was under way when the record began.

        It is taken to have begun shortly before, as it does where the record starts with the
        last reading before the first movement.
        """
        if np.isnan(target).any():
            return None
        lead = 0.5 * float(self.part.time[1] - self.part.time[0])
        poses = self._poses_at(0, target)
        durations = _durations(ALL)
        count = len(poses) * len(durations)
        guesses = Ramps(
            origin=np.repeat(poses, len(durations), axis=0),
            target=np.tile(target, (count, 1)),
            duration=np.tile(durations, (len(poses), 1)),
            start=np.full(count, self.part.time[0] - lead),
        )
        free = Free(ALL, NONE, NONE)
        fitted = fit_ramps(self._best(guesses, self._few), free, self._few, self._twin, steps=40)
        begun = self.part.time[0] - fitted.start
        return self._settled(fitted[(begun >= 0.0) & (begun <= EARLIEST_S)], free)

    def cut_off(self, origin: FloatArray) -> Ramps | None:
        """Return the ramp from `origin` (motor,) [rad] that the end of the record cuts off.

        Where several targets and durations make what is seen, it is one of these. Where so
        little is seen that its speeds stay vague, its target may be no whole units.
        """
        first_motor = np.isnan(origin)
        origin, _ = self._with_first_motor(origin, origin)
        # All motors are under way together for as long as the shortest ramp takes.
        together = self.part.take(self.part.time <= self.part.time[0] + RAMP_S[0])
        poses = np.stack([origin, *self._poses_at(len(together.time) - 1, origin)])
        done = (together.time[-1] - self._middle_start) / RAMP_S[0]
        guesses = Ramps(
            origin=np.tile(origin, (len(poses), 1)),
            target=origin + (poses - origin) / done,
            duration=np.full(poses.shape, RAMP_S[0]),
            start=np.full(len(poses), self._middle_start),
        )
        free = Free(first_motor, ALL, NONE)
        part = together.thinned(FIT_SAMPLES)
        guesses = self._best(guesses, part)
        for steps in CUT_OFF_STEPS:
            guesses = fit_ramps(guesses, free, part, self._twin, steps)
            solved = self._settled_cut_off(self._sorted(guesses, part), first_motor)
            if solved is not None:
                return solved
        return None

    def _settled_cut_off(self, fitted: Ramps, first_motor: BoolArray) -> Ramps | None:
        """Return the first ramp to whole units near `fitted`, else its best if that is exact.

        Args:
            fitted: Ramps of the shortest duration, the best first.
            first_motor: True for motor 1 if its origin is hidden, (motor,).
        """
        hidden = Free(first_motor, NONE, NONE)
        for row in range(len(fitted)):
            whole = self._whole_targets(fitted[row : row + 1])
            refitted = fit_ramps(whole, hidden, self._few, self._twin, steps=10)
            settled = self._settled(refitted, hidden)
            if settled is not None:
                return settled
        return self._finished(fitted[:1]) if len(fitted) else None

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
            low, high = self.arm.robot.motors[0].movement_range
            known = 0.5 * (low + high) - turn.mean()
        turn = turn + np.pi * np.round(known / np.pi)
        speed = (turn[1] - turn[0]) / (time[1] - time[0])
        first = turn[0] - speed * (time[0] - self._middle_start)
        origin, target = origin.copy(), target.copy()
        origin[0] = first if np.isnan(origin[0]) else origin[0]
        target[0] = turn[-1] if np.isnan(target[0]) else target[0]
        return origin, target

    def _poses_at(self, sample: int, near: FloatArray) -> FloatArray:
        """Return poses all over the arm's range at one sample, (pose, motor) [rad].

        A motor 1 that is hidden there is taken from the pose `near` (motor,).
        """
        counts = self.arm.all_counts
        last = self.arm.units.to_rad(np.linspace(counts.low[-1], counts.high[-1], LAST_ANGLES))
        poses = self.arm.poses_with_last(self.part.point[sample], last, slack=REACH_SLACK)
        return np.where(np.isnan(poses), near, poses)

    def _best(self, guesses: Ramps, part: PathPart) -> Ramps:
        error = largest_error(guesses, part, self._twin)
        return guesses[np.argsort(error, kind="stable")[:BEST_GUESSES]]

    def _sorted(self, fitted: Ramps, part: PathPart) -> Ramps:
        """Return those that fit, the best first."""
        error = largest_error(fitted, part, self._twin)
        order = np.argsort(error, kind="stable")
        return fitted[order[error[order] <= NEAR_M]]

    def _whole_targets(self, fitted: Ramps) -> Ramps:
        """Return all ramps of published durations to the whole units nearest to one's speeds.

        Those within the ranges of random movements come first.
        """
        units = self.arm.units
        moves = np.abs(fitted.target[0] - fitted.origin[0]) > STAYS_RAD
        durations = _durations(moves)
        speed = (fitted.target - fitted.origin) / fitted.duration
        counts = np.round(units.to_counts(fitted.origin + speed * durations))
        usual = self.arm.movement_counts.hold(counts)
        possible = self.arm.all_counts.hold(counts)
        rows = np.concatenate([np.flatnonzero(usual), np.flatnonzero(possible & ~usual)])
        return Ramps(
            np.repeat(fitted.origin, len(rows), axis=0),
            np.where(moves, units.to_rad(counts[rows]), fitted.origin),
            durations[rows],
            np.repeat(fitted.start, len(rows)),
        )

    def _settled(self, fitted: Ramps, free: Free) -> Ramps | None:
        """Return the first that is exact with its free angles on whole units, None if none is."""
        near = largest_error(fitted, self._few, self._twin) <= NEAR_M
        for row in np.flatnonzero(near):
            ramp = self._rounded(fitted[row : row + 1], free)
            finished = None if ramp is None else self._finished(ramp)
            if finished is not None:
                return finished
        return None

    def _rounded(self, ramp: Ramps, free: Free) -> Ramps | None:
        """Return `ramp` with its free angles on whole units, None if they are not near any."""
        origin = self._nearest_whole(ramp.origin, free.origin)
        target = self._nearest_whole(ramp.target, free.target)
        if origin is None or target is None:
            return None
        return replace(ramp, origin=origin, target=target)

    def _nearest_whole(self, pose: FloatArray, free: BoolArray) -> FloatArray | None:
        counts = self.arm.units.to_counts(pose)
        whole = np.where(free, np.round(counts), counts)
        if np.abs(whole - counts).max() > WHOLE_COUNTS or not self.arm.all_counts.hold(whole).all():
            return None
        return np.where(free, self.arm.units.to_rad(whole), pose)

    def _finished(self, ramp: Ramps) -> Ramps | None:
        """Return `ramp` with its start refined over all samples, None if it is not exact."""
        ramp = fit_ramps(ramp, Free(NONE, NONE, NONE), self.part, self._twin, steps=6)
        return ramp if largest_error(ramp, self.part, self._twin)[0] <= EXACT_M else None


def _durations(moves: BoolArray) -> FloatArray:
    """Return all choices of durations (choice, motor) [s]; motors that stay have one only."""
    options = [RAMP_S if motor_moves else RAMP_S[:1] for motor_moves in moves]
    return np.array(list(product(*options)))


# Runs out of exact desired paths: targets in whole servo units, ramps of published durations.

STILL_M = 1e-10
"""A tool that moves less from one sample to the next [m] rests."""
LEAST_REST = 5
"""Samples that a rest has at least; fewer are the turning point of a movement."""


class NoWholeUnitsError(Exception):
    """A path that no movements of whole units make; the text says where."""


@dataclass(frozen=True)
class Stretch:
    """A movement seen in a path.

    Attributes:
        first: Last sample before it moves; 0 also where the record begins within it.
        last: First sample after it; the last one also where the record ends within it.
    """

    first: int
    last: int


def find_stretches(path: FloatArray) -> list[Stretch]:
    """Return where an exact `path` (time, axis) [m] moves, in order."""
    moving = np.linalg.norm(np.diff(path, axis=0), axis=1) > STILL_M
    edges = np.flatnonzero(np.diff(np.concatenate([[0], moving.astype(int), [0]])))
    stretches: list[Stretch] = []
    for first, last in edges.reshape(-1, 2).tolist():
        if stretches and first - stretches[-1].last < LEAST_REST:
            first = stretches.pop().first
        stretches.append(Stretch(first, last))
    return stretches


def solve_run(path: PathPart, arm: PlaneArm) -> Movements:
    """Return the movements of one run, with a leading run axis of 1.

    A motor that stays has a duration of 0. Where a ramp is cut off by the end of the record and
    several targets and durations make what is seen of it, they are one of these; where next to
    nothing is seen, targets may be no whole units.

    Raises:
        NoWholeUnitsError: If no movements make this path.
    """
    stretches = find_stretches(path.point)
    if not stretches:
        return _one_run(_resting_pose(path, arm), [])
    ramps: list[Ramps] = []
    for stretch in reversed(stretches):
        ramps.append(_solve_stretch(path, stretch, arm, ramps[-1].origin if ramps else None))
    ramps.reverse()
    movements = _one_run(ramps[0].origin[0], ramps)
    off = DigitalTwin(arm.robot).path(movements.reference(path.time)[0]) - path.point
    if np.abs(off).max() > EXACT_M:
        at = path.time[np.abs(off).max(axis=1).argmax()]
        raise NoWholeUnitsError(f"at {at:.2f} s the tool does not rest where it should")
    return movements


def _one_run(initial: FloatArray, ramps: list[Ramps]) -> Movements:
    none = np.empty((0, MOTORS))
    target = np.concatenate([none, *(ramp.target for ramp in ramps)])
    origin = np.concatenate([none, *(ramp.origin for ramp in ramps)])
    duration = np.concatenate([none, *(ramp.duration for ramp in ramps)])
    return Movements(
        initial=initial[None],
        target=target[None],
        ramp_duration=np.where(target == origin, 0.0, duration)[None],
        start=np.concatenate([np.empty(0), *(ramp.start for ramp in ramps)])[None],
    )


def _resting_pose(path: PathPart, arm: PlaneArm) -> FloatArray:
    poses = arm.whole_poses(path.point[0])
    if not len(poses):
        raise NoWholeUnitsError("no pose in whole servo units puts the tool where it rests")
    return arm.units.to_rad(np.where(np.isnan(poses[0]), arm.units.to_counts(0.0), poses[0]))


def _solve_stretch(
    path: PathPart, stretch: Stretch, arm: PlaneArm, following: FloatArray | None
) -> Ramps:
    """Return one ramp.

    Args:
        path: The path of the run.
        stretch: Where the movement is.
        arm: The arm.
        following: Origin of the next movement, (1, motor) [rad]; None for the last one.
    """
    seen = path.take(slice(stretch.first, stretch.last + 1))
    begun = f"the movement at {seen.time[0]:.2f} s"
    origins = arm.units.to_rad(arm.whole_poses(seen.point[0]))
    targets = following
    if targets is None:
        targets = arm.units.to_rad(arm.whole_poses(seen.point[-1]))
    cut_off = following is None and stretch.last == len(path.time) - 1
    if not len(origins) and stretch.first > 0:
        raise NoWholeUnitsError(f"no pose in whole servo units puts the tool where {begun} begins")
    if not len(targets) and not cut_off:
        raise NoWholeUnitsError(f"no pose in whole servo units puts the tool where {begun} ends")
    if not len(origins) and not len(targets):
        raise NoWholeUnitsError("the record holds no settled pose")
    ramp = SeenRamp(seen, arm)
    pairs = product(origins, targets)
    if not len(origins):
        solved = _first(ramp.begun_before(target) for target in targets)
    else:
        solved = _first(ramp.between(origin, target) for origin, target in pairs)
    if solved is None and cut_off:
        solved = _first(ramp.cut_off(origin) for origin in origins)
    if solved is None:
        raise NoWholeUnitsError(f"no start and durations of the published kind make {begun}")
    return solved


def _first(ramps: Iterable[Ramps | None]) -> Ramps | None:
    return next((ramp for ramp in ramps if ramp is not None), None)
