"""Motor commands recovered from desired tool paths, for published runs that hold no commands.

A desired path is what the kinematics make of the reference of the motors. Every ramp is fitted by
least squares from many first guesses: targets by inverse kinematics, durations at random. A path
without noise then gives the poses and speeds, and every ramp is rounded to whole servo counts and
published durations, exactly.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.movements import Movements, stack_movements
from failuretwin.core.runs import STEP_S
from failuretwin.core.types import FloatArray, IntArray, as_floats, frozen_array
from failuretwin.data_knowledge.ramp_fit import fit, path_error, single_movements
from failuretwin.data_knowledge.readers.timed_log import Samples
from failuretwin.digital_model.inverse_kinematics import InverseKinematics
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.failure_behavior.random_movements import RandomMovements

Span = tuple[int, int]
"""Last sample before a movement and first sample after it."""

RAMP_S = frozen_array([s * RandomMovements().period_s for s in RandomMovements().ramp_shares])
"""Durations of published ramps [s], the shortest first."""
EXACT_M = 1e-9
"""Largest distance of equal tool positions [m]; published paths are exact to 1e-15 m."""
STAYS_RAD = 1e-6
"""A motor with less travel [rad] does not move."""
WHOLE_COUNTS = 0.1
"""Largest distance of an angle that is rounded from its whole count [counts]."""
EARLIEST_S = 0.1
"""Longest time from the start of a ramp to the start of the record that cuts it [s]."""

GUESSES = (6, 24, 96, 384)
"""Numbers of first guesses of a ramp, tried until a fit is as good as the path."""
MOST_MOTORS = 4
"""Motors whose pose follows from a tool position and the count of the last one."""
WHOLE_STARTS = 16
"""First guesses of a pose for every count of the last motor."""
REACHED_M = 1e-3
"""A pose this much worse than the best one [m] does not reach its point."""
DURATION_SHARES = (0.6, 1.0)
"""Range of guessed durations, as shares of the time in which the tool moves."""
FIT_SAMPLES, REST_SAMPLES = 24, 5
"""Samples for the fit of a ramp, and samples at rest on both sides of it."""
RAMP_STEPS, START_STEPS = 60, 8
"""Maximum number of steps of the fits of a ramp and its start."""
MOVES_M = 1e-7
"""Change between two samples [m] that counts as motion."""
LEAST_REST_S, LEAST_MOVEMENT_S = 0.3, 0.1
"""Shorter rests belong to a movement, shorter movements to a rest [s]."""


def recover_movements(
    desired: FloatArray,
    robot: Robot,
    *,
    names: Sequence[str],
    time: FloatArray | None = None,
) -> tuple[FloatArray, Movements]:
    """Return the time grid (time,) [s] and the movements whose reference makes the desired paths.

    Targets are whole servo units, ramps of the published durations; motors that stay have a
    duration of 0, movements without any travel do not appear. The last ramp of a record that ends
    within it is one of those that make what is seen of it, and a movement that begins after the
    record does not appear. What comes back makes the desired path to 1e-9 m.

    Args:
        desired: Desired tool paths in the base frame, finite, (run, time, axis) [m].
        robot: The robot.
        names: Name of each run, for messages.
        time: Uniform time grid, (time,) [s]; None: the published one that fits.

    Raises:
        InputError: If a run has no such movements.
    """
    grids = published_time_bases(desired.shape[1]) if time is None else [time]
    grid = _fitting_grid(grids, desired, robot)
    parts = [
        _recover_run(Samples(grid, path), robot, name)
        for path, name in zip(desired, names, strict=True)
    ]
    return grid, stack_movements(parts)


def published_time_bases(samples: int) -> list[FloatArray]:
    """Return the grids that published runs come on, (time,) [s].

    For 1000 samples these are 0.01 to 10.00, and 1000 points from 0 to 10.
    """
    end = samples * STEP_S
    return [as_floats(np.arange(1, samples + 1) * STEP_S), np.linspace(0.0, end, samples)]


def _fitting_grid(grids: Sequence[FloatArray], desired: FloatArray, robot: Robot) -> FloatArray:
    """Return the grid on which movements of published durations make the desired paths.

    The grids differ in their step, which whole movements reveal; an offset of the whole run in
    time could not be seen. Runs whose movements are all cut off fit both. Where no run decides,
    because none is exact, it is the first.
    """
    if len(grids) == 1:
        return grids[0]
    for path in desired:
        fitting = []
        for grid in grids:
            with suppress(_NoWholeUnitsError):
                _whole_run(Samples(grid, path), robot)
                fitting.append(grid)
        if len(fitting) == 1:
            return fitting[0]
    return grids[0]


def _recover_run(path: Samples, robot: Robot, name: str) -> Movements:
    try:
        return _whole_run(path, robot)
    except _NoWholeUnitsError as reason:
        raise InputError(
            f"run {name!r}: no movements of robot {robot.name!r} between whole servo units make "
            f"its desired path exactly: {reason}. If the path is of another robot, give that one "
            "with --robot. Else give a log that holds its commands."
        ) from None


class _NoWholeUnitsError(Exception):
    """No movements between whole counts make the path; the text says where."""


def _whole_run(path: Samples, robot: Robot) -> Movements:
    """Return the movements between whole counts that make a path.

    Where next to nothing is seen of the last one, its targets may lie between counts.
    """
    if robot.profile.servo_units is None:
        raise _NoWholeUnitsError("the robot has no servo units")
    run = _Run(path, DigitalTwin(robot))
    movements = run.whole()
    error = path_error(movements, path, run.twin)[0]
    if error.max() > EXACT_M:
        at = path.time[error.argmax()]
        raise _NoWholeUnitsError(f"at {at:.2f} s the tool does not rest where it should")
    return movements


@dataclass(frozen=True)
class _Run:
    """Fits of one run.

    Attributes:
        path: The desired path.
        twin: Kinematics.
        rng: Draws first guesses.
    """

    path: Samples
    twin: DigitalTwin
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))

    @cached_property
    def kinematics(self) -> InverseKinematics:
        return InverseKinematics.of(self.twin.robot)

    @cached_property
    def spans(self) -> list[Span]:
        """Samples around every movement."""
        time, end = self.path.time, len(self.path.time) - 1
        moving = np.linalg.norm(np.diff(self.path.value, axis=0), axis=1) > MOVES_M
        edges = np.flatnonzero(np.diff(np.concatenate([[0], moving.astype(int), [0]])))
        spans: list[Span] = []
        for begin, stop in edges.reshape(-1, 2).tolist():
            if spans and time[begin] - time[spans[-1][1]] < LEAST_REST_S:
                begin = spans.pop()[0]
            spans.append((begin, stop))
        return [s for s in spans if time[s[1]] - time[s[0]] >= LEAST_MOVEMENT_S or s[1] == end]

    @cached_property
    def rests(self) -> list[FloatArray]:
        """Median tool position in every rest, (axis,) [m]; the last point if the record ends."""
        begins = [0, *(last for _, last in self.spans)]
        ends = [*(first for first, _ in self.spans), len(self.path.time) - 1]
        return [
            np.median(self.path.value[begin : max(begin, end) + 1], axis=0)
            for begin, end in zip(begins, ends, strict=True)
        ]

    # Movements between whole counts.

    def whole(self) -> Movements:
        if not self.spans:
            return self._joined(self._whole_poses(self.path.value[0])[:1], [])
        if self.spans == [(0, len(self.path.time) - 1)]:
            raise _NoWholeUnitsError("the record holds no settled pose")
        return self._chain()

    def _whole_poses(self, point: FloatArray) -> FloatArray:
        """Return the poses in whole counts at a point, (pose, motor) [rad], usual ones first.

        Every count of the last motor is tried; inverse kinematics gives the other motors.

        Raises:
            _NoWholeUnitsError: If there are none.
        """
        units, zero = self.twin.robot.servo_units, self._zero
        low, high = self._whole_limits
        last = units.to_rad(np.arange(low[-1], high[-1] + 1.0))
        starts = self.kinematics.starts(WHOLE_STARTS * len(last), self.rng)
        starts[:, -1] = np.tile(last, WHOLE_STARTS)
        locked = np.arange(len(zero)) == len(zero) - 1
        goals = np.broadcast_to(point, (len(starts), 3))
        found = self.kinematics.solve(goals, starts[:, None], locked).pose[:, 0]
        whole = np.unique(np.round(units.to_counts(np.concatenate([found, zero[None]]))), axis=0)
        poses = units.to_rad(whole[((whole >= low) & (whole <= high)).all(axis=1)])
        poses = poses[np.linalg.norm(self.twin.path(poses) - point, axis=1) <= 2.0 * EXACT_M]
        if not len(poses):
            raise _NoWholeUnitsError("no pose in whole servo units puts the tool where it rests")
        return poses[_nearest_first(poses, zero)]

    def _whole_ramps(self, m: int, origins: FloatArray | None) -> Movements:
        """Return the ramps between whole counts that make movement `m`, the best first.

        They begin at some origins (pose, motor) [rad]; None: anywhere.

        Raises:
            _NoWholeUnitsError: If there are none.
        """
        part = self._part(m)
        for fitted in self._fits(m, origins):
            error = path_error(fitted, part, self.twin).max(axis=1)
            best = int(error.argmin())
            near = fitted[best : best + 1]
            whole = self._rounded(near, part, origins is None)
            if len(whole.start):
                return whole
            if error[best] <= EXACT_M and self._is_cut_off(m):
                return near  # too little of it is seen to tell its speeds
        at = self.path.time[self.spans[m][0]]
        raise _NoWholeUnitsError(
            f"no start and durations of the published kind make the movement at {at:.2f} s"
        )

    def _fits(self, m: int, origins: FloatArray | None) -> Iterator[Movements]:
        """Yield fits of movement `m` from ever more guesses, then those to whole targets.

        A ramp may leave poses open, such as one of the first motor alone, or nearly so, such as one
        from a stretched arm.
        """
        for count in GUESSES:
            yield self._fitted(m, origins, None, count)
        if not self._is_cut_off(m) and len(self._zero) <= MOST_MOTORS:
            yield self._fitted(m, origins, self._whole_poses(self.rests[m + 1]), GUESSES[-1])

    def _rounded(self, ramp: Movements, part: Samples, free_origin: bool) -> Movements:
        """Return the exact ramps of published durations to whole counts near a fitted ramp.

        The speeds of the ramp hold: target = origin + speed * duration. If it is under way when the
        record begins, the target holds and the origin follows.
        """
        units = self.twin.robot.servo_units
        origin, target, fitted = ramp.initial[0], ramp.target[0, 0], ramp.ramp_duration[0, 0]
        moves = np.abs(target - origin) > STAYS_RAD
        speed = np.where(moves, (target - origin) / fitted, 0.0)
        duration = np.array(list(product(*(RAMP_S if one else RAMP_S[:1] for one in moves))))
        start = np.full(len(duration), ramp.start[0, 0])
        begun = free_origin and start[0] <= part.time[0] + 1e-6
        if begun:
            origin = target - speed * duration
            start += np.mean((fitted - duration)[:, moves], axis=1)
        else:
            target = origin + speed * duration
        counts = units.to_counts(np.stack(np.broadcast_arrays(origin, target)))
        whole = np.round(counts)
        low, high = self._whole_limits
        kept = (np.abs(whole - counts) <= WHOLE_COUNTS) & (whole >= low) & (whole <= high)
        good = kept.all(axis=(0, 2)) & (start >= part.time[0] - EARLIEST_S)
        origin, target = units.to_rad(whole[:, good])
        guesses = single_movements(origin, target, duration[good], start[good])
        if not good.any():
            return guesses
        fixed = np.zeros(3 * len(speed), dtype=np.bool_)
        found = fit(guesses, part, self.twin, fixed, START_STEPS)
        found = found[path_error(found, part, self.twin).max(axis=1) <= EXACT_M]
        return found[_nearest_first(found.target[:, 0], ramp.target[0, 0])]

    @cached_property
    def _whole_limits(self) -> FloatArray:
        """Lowest and highest whole count of every motor, (2, motor)."""
        ends = np.stack([self.kinematics.low, self.kinematics.high])
        low, high = np.sort(self.twin.robot.servo_units.to_counts(ends), axis=0)
        return np.stack([np.ceil(low - 1e-9), np.floor(high + 1e-9)])

    def _chain(self) -> Movements:
        """Return movements whose origins are the targets before them.

        Where a ramp leaves its target open, the next one decides.
        """
        found = [self._whole_ramps(0, None)]
        for m in range(1, len(self.spans)):
            origins = np.unique(found[-1].target[:, 0], axis=0)
            found.append(self._whole_ramps(m, origins))
        chain = [found.pop()[:1]]
        while found:
            leads = (found[-1].target[:, 0] == chain[0].initial).all(axis=1)
            chain.insert(0, found.pop()[leads][:1])
        return self._joined(chain[0].initial, chain)

    @property
    def _zero(self) -> FloatArray:
        return np.zeros(len(self.twin.robot.motors))

    def _is_cut_off(self, m: int) -> bool:
        return self.spans[m][1] == len(self.path.time) - 1

    def _part(self, m: int) -> Samples:
        """Return samples of movement `m` and of the rests around it."""
        first, last = self.spans[m]
        before = self.spans[m - 1][1] if m else 0
        after = self.spans[m + 1][0] if m + 1 < len(self.spans) else len(self.path.time) - 1
        first, last = max(first - REST_SAMPLES, before), min(last + REST_SAMPLES, after)
        rows = np.unique(np.linspace(first, last, FIT_SAMPLES).round().astype(np.int64))
        return self.path.take(rows)

    def _poses(self, point: FloatArray, count: int) -> FloatArray:
        """Return poses all over the arm's range at a point, (pose, motor) [rad]."""
        low, high = np.transpose([motor.movement_range for motor in self.twin.robot.motors])
        starts = self.rng.uniform(low, high, (4 * count, len(low)))
        found = self.kinematics.solve(point[None], np.concatenate([self._zero[None], starts]))
        return found.pose[0][found.miss_m[0] <= found.miss_m.min() + REACHED_M]

    def _fitted(
        self, m: int, origins: FloatArray | None, targets: FloatArray | None, count: int
    ) -> Movements:
        """Return fits of movement `m` from `count` first guesses.

        Args:
            m: Number of the movement.
            origins: Possible poses before it, (pose, motor) [rad]; None: free, any in the rest.
            targets: Possible poses after it, likewise.
            count: Number of guesses.
        """
        origin, target = (
            self.rng.choice(self._poses(rest, count) if poses is None else poses, count)
            for poses, rest in zip((origins, targets), self.rests[m : m + 2], strict=True)
        )
        first, last = self.path.time[list(self.spans[m])]
        duration = self.rng.uniform(*DURATION_SHARES, origin.shape) * (last - first)
        step = self.path.time[1] - self.path.time[0]
        guesses = single_movements(origin, target, duration, first + 0.5 * step)
        free = np.repeat([origins is None, targets is None, True], origin.shape[1])
        return fit(guesses, self._part(m), self.twin, free, RAMP_STEPS, one_is_enough=True)

    def _joined(self, initial: FloatArray, ramps: Sequence[Movements]) -> Movements:
        """Return one run from the pose `initial` (1, motor) with the movements of all ramps.

        Motors that stay have a duration of 0.
        """
        none = Movements.empty(run=1, movement=0, motor=initial.shape[1])
        parts = [none, *ramps]
        target, duration, start = (
            np.concatenate([getattr(part, name) for part in parts], axis=1)
            for name in ("target", "ramp_duration", "start")
        )
        poses = np.concatenate([initial[:, None], target], axis=1)
        idle = np.abs(np.diff(poses, axis=1)) <= STAYS_RAD
        return Movements(initial, target, np.where(idle, 0.0, duration), start)


def _nearest_first(poses: FloatArray, to: FloatArray) -> IntArray:
    """Return the order of poses (pose, motor) by their distance from a pose."""
    return np.argsort(np.linalg.norm(poses - to, axis=1), kind="stable")
