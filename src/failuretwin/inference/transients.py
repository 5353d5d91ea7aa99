"""What the way says: whether the motors moved as they should, for each fault that shows there.

Where each movement began and ended is taken from the settled poses, in the way that explains them
best under the fault in question; how it got there is judged here. What became of a movement whose
end was not seen is judged by its way and by where the next one began.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from failuretwin.core.numerics import log_of, log_sum
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.inference.command_loss import CommandOutcomes
from failuretwin.inference.joint_likelihood import LARGEST_OFFSET_RAD, JointLikelihood
from failuretwin.inference.transient_likelihood import TransientHypothesis, TransientLikelihood

# Where the movements of runs led, and how well the readings on the way agree with that.

STARTS_RAD = np.linspace(-LARGEST_OFFSET_RAD, LARGEST_OFFSET_RAD, 13)
"""Where a motor may stand before the run if not where it should, from there."""
RARELY_ELSEWHERE = 0.01
"""Motors that do so less often are taken to stand where they should [-]."""


@dataclass(frozen=True)
class Trajectory:
    """Where the movements of some runs led.

    Attributes:
        ends: Where each one led if this or that became of it, (run, movement, outcome, motor)
            [rad].
        chosen: What became of it, (run, movement).
        lost: Motors that lose their command in each outcome, (outcome, motor).
        first: Pose before the first movement, (run, motor) [rad].
    """

    ends: FloatArray
    chosen: IntArray
    lost: BoolArray
    first: FloatArray

    def destination(self) -> FloatArray:
        """Return where each movement led, (run, movement, motor) [rad]."""
        return np.take_along_axis(self.ends, self.chosen[..., None, None], axis=2)[:, :, 0]

    def origin(self) -> FloatArray:
        """Return where each movement began, (run, movement, motor) [rad].

        A motor that missed the command was already where it is.
        """
        destination = self.destination()
        before = np.concatenate([self.first[:, None], destination[:, :-1]], axis=1)
        return np.where(self.lost[self.chosen], destination, before)


@dataclass(frozen=True)
class TrajectoryLikelihood:
    """Density of the readings on the way, given where the movements led.

    Attributes:
        ramps: Density of readings on the way.
        outcomes: What may have become of each movement.
    """

    ramps: TransientLikelihood
    outcomes: CommandOutcomes

    @property
    def usable(self) -> BoolArray:
        """Movements whose end was seen, (run, movement)."""
        return self.ramps.settled.usable

    @cached_property
    def duration(self) -> FloatArray:
        """How long each ramp takes, (run, movement, motor) [s]."""
        return np.nan_to_num(self.ramps.settled.movements.ramp_duration)

    @cached_property
    def index(self) -> tuple[IntArray, IntArray]:
        """Run and movement of all movements with readings on the way."""
        some = np.asarray(self.ramps.moving.seen.any(axis=-1))
        run, movement = np.nonzero(some)
        return run, movement

    @cached_property
    def expected(self) -> FloatArray:
        """Where a healthy arm settles, (run, movement, outcome, motor) [rad]."""
        model = self.ramps.model
        return model.settle(self.outcomes.base, self.outcomes.direction, model.none_held)

    @cached_property
    def first(self) -> FloatArray:
        """Pose of a healthy arm before the run, (run, motor) [rad]."""
        start, model = self.ramps.settled.movements.initial, self.ramps.model
        return model.settle(start, np.zeros_like(start), model.none_held)

    def settle(self, course: Trajectory) -> tuple[Trajectory, FloatArray]:
        """Find out what became of movements whose end was not seen.

        Returns:
            The course with the most probable outcome for them, and the log of what all
            outcomes together say over what that one says alone, (run, movement).
        """
        chosen = np.where(self.usable, course.chosen, 0)
        log_correction = np.zeros(self.usable.shape)
        course = replace(course, chosen=chosen)
        run, movement = np.nonzero(self.ramps.settled.movements.exists & ~self.usable)
        if len(run) == 0:
            return course, log_correction
        log_weight = self.outcomes.log_weight[run, movement]
        item, case = np.nonzero(np.isfinite(log_weight))
        says = np.full(log_weight.shape, -np.inf)
        says[item, case] = self._way_and_next(course, run[item], movement[item], case)
        weighed = says + np.where(np.isfinite(says), log_weight, 0.0)
        best = np.argmax(weighed, axis=-1)
        chosen[run, movement] = best
        log_correction[run, movement] = log_sum(weighed, axis=-1) - says[np.arange(len(best)), best]
        return replace(course, chosen=chosen), log_correction

    def _way_and_next(
        self, course: Trajectory, run: IntArray, movement: IntArray, outcome_probability: IntArray
    ) -> FloatArray:
        """Return log densities of some movements and of those that follow them, (item,).

        Args:
            course: Where all others led.
            run: Which run each movement belongs to, (item,).
            movement: Its number in the run, (item,).
            outcome_probability: What became of it, (item,).
        """
        origin, destination = course.origin(), course.destination()
        here = course.ends[run, movement, outcome_probability]
        begin = np.where(course.lost[outcome_probability], here, origin[run, movement])
        says = self.weigh(run, movement, begin[:, None], here[:, None])[:, 0]
        follows = movement + 1 < self.usable.shape[1]
        after = np.where(follows, movement + 1, movement)
        end = destination[run, after]
        begin = np.where(course.lost[course.chosen[run, after]], end, here)
        return says + np.where(
            follows, self.weigh(run, after, begin[:, None], end[:, None])[:, 0], 0.0
        )

    def log_density(self, course: Trajectory, spread_m: float = 0.0) -> FloatArray:
        """Return log densities of all movements of a course, (run, movement)."""
        item = self.index
        begin, end = (values[item][:, None] for values in (course.origin(), course.destination()))
        found = np.zeros(self.usable.shape)
        found[item] = self.weigh(*item, begin, end, spread_m=spread_m)[:, 0]
        return found

    def weigh(
        self,
        run: IntArray,
        movement: IntArray,
        origin: FloatArray,
        destination: FloatArray,
        stops: int | None = None,
        spread_m: float = 0.0,
    ) -> FloatArray:
        """Return log densities of some movements, (item, case); 0 without readings.

        Args:
            run: Which run each movement belongs to, (item,).
            movement: Its number in the run, (item,).
            origin: Where it begins, (item, case, motor) [rad].
            destination: Where it ends, (item, case, motor) [rad].
            stops: Motor that is on its way to its target but stops where it ends.
            spread_m: How far the tool may stray from its way [m].
        """
        duration = np.repeat(self.duration[run, movement][:, None], origin.shape[1], axis=1)
        if stops is not None:
            target = np.nan_to_num(self.ramps.settled.movements.target[run, movement, stops])
            travel = target[:, None] - origin[..., stops]
            travel = np.where(np.abs(travel) > 1e-6, travel, np.inf)
            done = (destination - origin)[..., stops] / travel
            duration[..., stops] *= np.clip(done, 0.0, 1.0)
        still = np.zeros(origin.shape[1:])
        ramps = TransientHypothesis(run, movement, origin, destination, duration, still, spread_m)
        return self.ramps.log_density(ramps)

    def marginalise_start(
        self, course: Trajectory, says: FloatArray, off: int | None = None
    ) -> FloatArray:
        """Return log densities if a motor may have stood elsewhere before the run.

        A healthy one does if it missed the command before.

        Args:
            course: Where the movements led.
            says: Log density of each movement if all stood where they should, (run, movement) or
                (run, movement, node).
            off: Motor that is as likely to have been off as not.
        """
        chance = np.exp(self.outcomes.log_weight[:, 0]) @ self.outcomes.lost  # (run, motor)
        if off is not None:
            chance = 0.5 * chance
            chance[:, off] = 0.5
        shape = (-1,) + (1,) * (says.ndim - 2)
        chance[:, chance.max(axis=0) <= RARELY_ELSEWHERE] = 0.0
        usual = np.log1p(-np.minimum(chance.sum(axis=1), 0.9))
        terms = [says[:, 0] + usual.reshape(shape)]
        for motor in np.flatnonzero(chance.any(axis=0)):
            other = self._elsewhere(course, int(motor)) + log_of(chance[:, motor])
            terms.append(np.broadcast_to(other.reshape(shape), terms[0].shape))
        says = says.copy()
        says[:, 0] = np.logaddexp.reduce(terms, axis=0)
        return says

    def _elsewhere(self, course: Trajectory, motor: int) -> FloatArray:
        """Return the log density of the first movement if a motor was off before it, (run,)."""
        run = np.flatnonzero(self.ramps.moving.seen[:, 0].any(axis=-1))
        begin, end = (
            np.repeat(pose[run, 0][:, None], len(STARTS_RAD), axis=1)
            for pose in (course.origin(), course.destination())
        )
        begin[..., motor] += STARTS_RAD
        found = np.zeros(len(self.usable))
        says = self.weigh(run, np.zeros_like(run), begin, end)
        found[run] = log_sum(says, axis=-1) - np.log(len(STARTS_RAD))
        return found


TEMPERING = 0.1
"""Power to which what the way says is taken: its readings share errors of timing and of both ends
that the model of the way does not know, so that all of a movement count for about one. Chosen on
simulated runs of both engines."""

OUTLIER_PATH = 0.1
"""How far the tool strays from its way if nothing explains it, as a share of the arm's reach."""
OUTLIER_PATH_RATE = 0.02
"""Share of movements in which it does [-]."""
LAST = 3
"""Movements, the last that tell, from which the size of a lasting fault is taken where the end of a
movement was not seen."""


@dataclass(frozen=True)
class TransientEvidence:
    """Log densities of the readings on the way, for healthy robots and for faults of one motor.

    Attributes:
        judge: Density of readings on the way.
        terms: Log weight times density of each outcome for a healthy robot,
            (run, movement, outcome).
        poses: Pose that explains the settled position then, (run, movement, outcome, motor)
            [rad].
    """

    judge: TrajectoryLikelihood
    terms: FloatArray
    poses: FloatArray

    @cached_property
    def healthy(self) -> FloatArray:
        """Log density if no motor is faulty, (run, movement)."""
        course, log_correction = self._healthy
        return self._trusted(
            self.judge.marginalise_start(course, self.judge.log_density(course)) + log_correction
        )

    def stuck(self, motor: int, profile: JointLikelihood, angle: FloatArray) -> FloatArray:
        """Return the log density if a motor is held all the way or gets stuck on it.

        Where the end of a movement was seen, the motor is taken to be held where that puts it.

        Args:
            motor: Index of the motor.
            profile: What each movement says of it.
            angle: Where it may be held otherwise, (node,) [rad].

        Returns:
            (run, movement, node).
        """
        seen = np.argmax(profile.log_terms(profile.mode, True), axis=-1)
        nearest = self._nearest_seen(_at(profile.mode, seen), motor)
        ends = np.where(self.judge.usable[..., None, None], profile.map_pose, self.judge.expected)
        ends[..., motor] = nearest[..., None]
        lost = self.judge.outcomes.lost.copy()
        lost[:, motor] = True  # whatever becomes of its command
        course, log_correction = self.judge.settle(Trajectory(ends, seen, lost, self.judge.first))
        item, cases = self.judge.index, len(angle)
        at = np.where(self.judge.usable[item][:, None], nearest[item][:, None], angle)
        end = np.repeat(course.destination()[item][:, None], cases, axis=1)
        end[..., motor] = at
        begin = np.repeat(course.origin()[item][:, None], cases, axis=1)
        begin[..., motor] = at
        stays = self.judge.weigh(*item, begin, end)
        moving = replace(course, lost=self.judge.outcomes.lost).origin()
        begin[..., motor] = moving[item][:, None, motor]
        stops = self.judge.weigh(*item, begin, end, stops=motor)
        found = np.zeros((*self.judge.usable.shape, cases))
        found[item] = np.logaddexp(stays, stops) - np.log(2.0)
        return self._trusted(
            self.judge.marginalise_start(course, found) + log_correction[..., None]
        )

    def offset(
        self, motor: int, profile: JointLikelihood, gain: FloatArray | None = None
    ) -> FloatArray:
        """Return the log density if a motor goes to where it was seen to settle.

        Args:
            motor: Index of the motor.
            profile: What each movement says of it.
            gain: By how much it is off for each unit of an amount that holds for the run,
                (run, movement, outcome) [rad]; None: other movements do not tell.

        Returns:
            (run, movement).
        """
        near = np.clip(
            profile.mode,
            profile.expected - LARGEST_OFFSET_RAD,
            profile.expected + LARGEST_OFFSET_RAD,
        )
        seen = np.argmax(profile.log_terms(near, False), axis=-1)
        ends = np.where(self.judge.usable[..., None, None], profile.map_pose, self.judge.expected)
        unseen = self.judge.expected[..., motor]
        if gain is not None:
            amount = self._amount(_at(near - profile.expected, seen), _at(gain, seen))
            largest = LARGEST_OFFSET_RAD
            unseen = unseen + np.clip(gain * amount[:, None, None], -largest, largest)
        ends[..., motor] = np.where(self.judge.usable[..., None], near, unseen)
        return self.toward(ends, seen, motor)

    def toward(self, ends: FloatArray, outcome_probability: IntArray, off: int) -> FloatArray:
        """Return the log density if the motors go from one given pose to the next.

        Args:
            ends: Where each movement led, for each that may have become of it,
                (run, movement, outcome, motor) [rad].
            outcome_probability: What did, where its end was seen, (run, movement).
            off: Motor that may have been off before the run.

        Returns:
            (run, movement).
        """
        course, log_correction = self.judge.settle(
            Trajectory(ends, outcome_probability, self.judge.outcomes.lost, self.judge.first)
        )
        return self._trusted(
            self.judge.marginalise_start(course, self.judge.log_density(course), off)
            + log_correction
        )

    def _amount(self, offset: FloatArray, gain: FloatArray) -> FloatArray:
        """Return the amount that makes offsets of gains, (run,).

        The median of what the last movements say: those before the onset say that there is none.

        Args:
            offset: Of the movements whose ends were seen, (run, movement) [rad].
            gain: Offset for each unit of the amount, (run, movement) [rad]; those that are small
                beside the others say little.
        """
        large = np.where(self.judge.usable, np.abs(gain), 0.0)
        tells = (large > 0.0) & (large >= 0.5 * large.max(axis=1, keepdims=True))
        tells &= np.cumsum(tells[:, ::-1], axis=1)[:, ::-1] <= LAST
        ratio = np.where(tells, offset / np.where(tells, gain, 1.0), np.nan)
        ratio[~tells.any(axis=1)] = 0.0
        return np.asarray(np.nanmedian(ratio, axis=1))

    @cached_property
    def outlier_path(self) -> FloatArray:
        """Log density if the tool strays from its way as no fault explains, (run, movement)."""
        course, _ = self._healthy
        spread_m = OUTLIER_PATH * self.judge.ramps.model.reach
        return TEMPERING * self.judge.log_density(course, spread_m)

    def _trusted(self, says: FloatArray) -> FloatArray:
        """Return what the way says as far as it is trusted, (run, movement, ...)."""
        astray = self.outlier_path.reshape(self.outlier_path.shape + (1,) * (says.ndim - 2))
        return np.logaddexp(
            np.log1p(-OUTLIER_PATH_RATE) + TEMPERING * says, np.log(OUTLIER_PATH_RATE) + astray
        )

    def delayed_or_slow(
        self, motor: int, factor: FloatArray, delay: FloatArray, begin: FloatArray | None = None
    ) -> FloatArray:
        """Return log densities if a motor takes longer or starts later, (run, movement, node).

        Args:
            motor: Index of the motor.
            factor: How many times as long as commanded it takes, (node,).
            delay: How much later than the others it starts, (node,) [s].
            begin: Where it begins each movement if it has not reached its targets,
                (run, movement, node) [rad]; None: it reaches them all.
        """
        course, log_correction = self._healthy
        items, cases = self.judge.index, len(factor)
        origin, destination, duration = (
            np.repeat(values[items][:, None], cases, axis=1)
            for values in (course.origin(), course.destination(), self.judge.duration)
        )
        duration[..., motor] *= factor
        if begin is not None:
            origin[..., motor] = begin[items]
            destination[..., motor] = self.judge.expected[items][:, 0, None, motor]
        late = np.zeros((cases, origin.shape[-1]))
        late[:, motor] = delay
        found = np.zeros((*self.judge.usable.shape, cases))
        found[items] = self.judge.ramps.log_density(
            TransientHypothesis(*items, origin, destination, duration, late)
        )
        return self._trusted(found + log_correction[..., None])

    @cached_property
    def _healthy(self) -> tuple[Trajectory, FloatArray]:
        seen = np.argmax(self.terms, axis=-1)
        ends = np.where(self.judge.usable[..., None, None], self.poses, self.judge.expected)
        return self.judge.settle(Trajectory(ends, seen, self.judge.outcomes.lost, self.judge.first))

    def _nearest_seen(self, angle: FloatArray, motor: int) -> FloatArray:
        """Return angles (run, movement) with those of unseen ends from the next movement seen.

        Where none follows, from the last one before; where there is none, from before the run.
        """
        filled = np.where(self.judge.usable, angle, np.nan)
        count = filled.shape[1]
        for m in range(count - 2, -1, -1):
            filled[:, m] = np.where(np.isnan(filled[:, m]), filled[:, m + 1], filled[:, m])
        before = self.judge.first[:, motor]
        for m in range(count):
            filled[:, m] = before = np.where(np.isnan(filled[:, m]), before, filled[:, m])
        return filled


def _at(values: FloatArray, alternative: IntArray) -> FloatArray:
    """Return the values (run, movement, outcome) of one outcome each."""
    return np.take_along_axis(values, alternative[..., None], axis=2)[..., 0]
