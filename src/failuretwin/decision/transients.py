"""What the way says: whether the motors moved as they should, for each fault that shows there.

Where each movement began and ended is taken from the settled poses, in the way that explains them
best under the fault in question; how it got there is judged here. What became of a movement whose
end was not seen is judged by its way and by where the next one began.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from failuretwin.connection.healthy import Alternatives
from failuretwin.core.quadrature import log_of, log_sum
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.decision.motor_profile import MotorProfile
from failuretwin.decision.ramps import RampModel, Ramps

LARGEST_OFFSET_RAD = 0.9
"""Furthest from its target that a motor is taken to have settled without being stuck [rad]; the
largest encoder faults that are considered."""
STARTS_RAD = np.linspace(-LARGEST_OFFSET_RAD, LARGEST_OFFSET_RAD, 13)
"""Where a motor may stand before the run if not where it should, from there."""
RARELY_ELSEWHERE = 0.01
"""Motors that do so less often are taken to stand where they should [-]."""
TRUST = 0.1
"""Power to which what the way says is taken: its readings share errors of timing and of both ends
that the model of the way does not know, so that all of a movement count for about one. Chosen on
simulated runs of both engines."""

ASTRAY = 0.1
"""How far the tool strays from its way if nothing explains it, as a share of the arm's reach."""
ASTRAY_RATE = 0.02
"""Share of movements in which it does [-]."""


@dataclass(frozen=True)
class _Course:
    """Where the movements of some runs led.

    Attributes:
        ends: Where each one led if this or that became of it, (run, movement, alternative, motor)
            [rad].
        chosen: What became of it, (run, movement).
        lost: Motors that lose their command in each alternative, (alternative, motor).
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
class Transients:
    """Log densities of the readings on the way, for healthy robots and for faults of one motor.

    Attributes:
        ramps: Density of readings on the way.
        alternatives: What may have become of each movement.
        terms: Log weight times density of each alternative for a healthy robot,
            (run, movement, alternative).
        poses: Pose that explains the settled position then, (run, movement, alternative, motor)
            [rad].
    """

    ramps: RampModel
    alternatives: Alternatives
    terms: FloatArray
    poses: FloatArray

    @cached_property
    def healthy(self) -> FloatArray:
        """Log density if no motor is faulty, (run, movement)."""
        course, luck = self._healthy
        return self._trusted(self._from_anywhere(course, self._judge(course)) + luck)

    def held(self, motor: int, profile: MotorProfile, angle: FloatArray) -> FloatArray:
        """Return the log density if a motor is held all the way or gets stuck on it.

        Where the end of a movement was seen, the motor is taken to be held where that puts it.

        Args:
            motor: Index of the motor.
            profile: What each movement says of it.
            angle: Where it may be held otherwise, (node,) [rad].

        Returns:
            (run, movement, node).
        """
        seen = np.argmax(profile.log_terms(profile.best, True), axis=-1)
        nearest = self._nearest_seen(_at(profile.best, seen), motor)
        ends = np.where(self._usable[..., None, None], profile.pose, self._expected)
        ends[..., motor] = nearest[..., None]
        lost = self.alternatives.lost.copy()
        lost[:, motor] = True  # whatever becomes of its command
        course, luck = self._settle(_Course(ends, seen, lost, self._first))
        item, cases = self._items, len(angle)
        at = np.where(self._usable[item][:, None], nearest[item][:, None], angle)
        end = np.repeat(course.destination()[item][:, None], cases, axis=1)
        end[..., motor] = at
        begin = np.repeat(course.origin()[item][:, None], cases, axis=1)
        begin[..., motor] = at
        stays = self._weigh(*item, begin, end)
        moving = replace(course, lost=self.alternatives.lost).origin()
        begin[..., motor] = moving[item][:, None, motor]
        stops = self._weigh(*item, begin, end, stops=motor)
        found = np.zeros((*self._usable.shape, cases))
        found[item] = np.logaddexp(stays, stops) - np.log(2.0)
        return self._trusted(self._from_anywhere(course, found) + luck[..., None])

    def off(self, motor: int, profile: MotorProfile, lasting: bool) -> FloatArray:
        """Return the log density if a motor goes to where it was seen to settle.

        Args:
            motor: Index of the motor.
            profile: What each movement says of it.
            lasting: Whether it is off by about the same in all movements.

        Returns:
            (run, movement).
        """
        near = np.clip(
            profile.best,
            profile.expected - LARGEST_OFFSET_RAD,
            profile.expected + LARGEST_OFFSET_RAD,
        )
        seen = np.argmax(profile.log_terms(near, False), axis=-1)
        ends = np.where(self._usable[..., None, None], profile.pose, self._expected)
        unseen = self._expected[..., motor]
        if lasting:
            unseen = unseen + self._usually_off(_at(near - profile.expected, seen))
        ends[..., motor] = np.where(self._usable[..., None], near, unseen)
        course, luck = self._settle(_Course(ends, seen, self.alternatives.lost, self._first))
        return self._trusted(self._from_anywhere(course, self._judge(course), motor) + luck)

    def _usually_off(self, offset: FloatArray) -> FloatArray:
        """Return the median of offsets (run, movement) over the movements seen, (run, 1, 1)."""
        some = self._usable.any(axis=1, keepdims=True)
        seen = np.where(self._usable, offset, np.where(some, np.nan, 0.0))
        return np.asarray(np.nanmedian(seen, axis=1))[:, None, None]

    def _from_anywhere(
        self, course: _Course, says: FloatArray, off: int | None = None
    ) -> FloatArray:
        """Return log densities if a motor may have stood elsewhere before the run.

        A healthy one does if it missed the command before.

        Args:
            course: Where the movements led.
            says: Log density of each movement if all stood where they should, (run, movement) or
                (run, movement, node).
            off: Motor that is as likely to have been off as not.
        """
        chance = np.exp(self.alternatives.log_weight[:, 0]) @ self.alternatives.lost  # (run, motor)
        if off is not None:
            chance = 0.5 * chance
            chance[:, off] = 0.5
        shape = (-1,) + (1,) * (says.ndim - 2)
        usual = np.log1p(-np.minimum(chance.sum(axis=1), 0.9))
        terms = [says[:, 0] + usual.reshape(shape)]
        for motor in np.flatnonzero(chance.max(axis=0) > RARELY_ELSEWHERE):
            other = self._elsewhere(course, int(motor)) + log_of(chance[:, motor])
            terms.append(np.broadcast_to(other.reshape(shape), terms[0].shape))
        says = says.copy()
        says[:, 0] = np.logaddexp.reduce(terms, axis=0)
        return says

    def _elsewhere(self, course: _Course, motor: int) -> FloatArray:
        """Return the log density of the first movement if a motor was off before it, (run,)."""
        run = np.flatnonzero(self.ramps.moving.seen[:, 0].any(axis=-1))
        begin, end = (
            np.repeat(pose[run, 0][:, None], len(STARTS_RAD), axis=1)
            for pose in (course.origin(), course.destination())
        )
        begin[..., motor] += STARTS_RAD
        found = np.zeros(len(self._usable))
        says = self._weigh(run, np.zeros_like(run), begin, end)
        found[run] = log_sum(says, axis=-1) - np.log(len(STARTS_RAD))
        return found

    @cached_property
    def astray(self) -> FloatArray:
        """Log density if the tool strays from its way as no fault explains, (run, movement)."""
        course, _ = self._healthy
        spread_m = ASTRAY * self.ramps.model.reach
        return TRUST * self._judge(course, spread_m)

    def _trusted(self, says: FloatArray) -> FloatArray:
        """Return what the way says as far as it is trusted, (run, movement, ...)."""
        astray = self.astray.reshape(self.astray.shape + (1,) * (says.ndim - 2))
        return np.logaddexp(np.log1p(-ASTRAY_RATE) + TRUST * says, np.log(ASTRAY_RATE) + astray)

    def timed(
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
        course, luck = self._healthy
        items, cases = self._items, len(factor)
        origin, destination, duration = (
            np.repeat(values[items][:, None], cases, axis=1)
            for values in (course.origin(), course.destination(), self._duration)
        )
        duration[..., motor] *= factor
        if begin is not None:
            origin[..., motor] = begin[items]
            destination[..., motor] = self._expected[items][:, 0, None, motor]
        late = np.zeros((cases, origin.shape[-1]))
        late[:, motor] = delay
        found = np.zeros((*self._usable.shape, cases))
        found[items] = self.ramps.log_density(Ramps(*items, origin, destination, duration, late))
        return self._trusted(found + luck[..., None])

    @property
    def _usable(self) -> BoolArray:
        return self.ramps.settled.usable

    @cached_property
    def _duration(self) -> FloatArray:
        return np.nan_to_num(self.ramps.settled.movements.ramp_duration)

    @cached_property
    def _items(self) -> tuple[IntArray, IntArray]:
        """Run and movement of all movements with readings on the way."""
        some = np.asarray(self.ramps.moving.seen.any(axis=-1))
        run, movement = np.nonzero(some)
        return run, movement

    @cached_property
    def _expected(self) -> FloatArray:
        """Where a healthy arm settles, (run, movement, alternative, motor) [rad]."""
        model = self.ramps.model
        return model.settle(self.alternatives.base, self.alternatives.direction, model.none_held)

    @cached_property
    def _first(self) -> FloatArray:
        """Pose of a healthy arm before the run, (run, motor) [rad]."""
        start, model = self.ramps.settled.movements.initial, self.ramps.model
        return model.settle(start, np.zeros_like(start), model.none_held)

    @cached_property
    def _healthy(self) -> tuple[_Course, FloatArray]:
        seen = np.argmax(self.terms, axis=-1)
        ends = np.where(self._usable[..., None, None], self.poses, self._expected)
        return self._settle(_Course(ends, seen, self.alternatives.lost, self._first))

    def _nearest_seen(self, angle: FloatArray, motor: int) -> FloatArray:
        """Return angles (run, movement) with those of unseen ends from the next movement seen.

        Where none follows, from the last one before; where there is none, from before the run.
        """
        filled = np.where(self._usable, angle, np.nan)
        count = filled.shape[1]
        for m in range(count - 2, -1, -1):
            filled[:, m] = np.where(np.isnan(filled[:, m]), filled[:, m + 1], filled[:, m])
        before = self._first[:, motor]
        for m in range(count):
            filled[:, m] = before = np.where(np.isnan(filled[:, m]), before, filled[:, m])
        return filled

    def _settle(self, course: _Course) -> tuple[_Course, FloatArray]:
        """Find out what became of movements whose end was not seen.

        Returns:
            The course with the most probable alternative for them, and the log of what all
            alternatives together say over what that one says alone, (run, movement).
        """
        chosen = np.where(self._usable, course.chosen, 0)
        luck = np.zeros(self._usable.shape)
        course = replace(course, chosen=chosen)
        run, movement = np.nonzero(self.ramps.settled.movements.exists & ~self._usable)
        if len(run) == 0:
            return course, luck
        origin, destination = course.origin(), course.destination()
        cases = course.ends[run, movement]  # (item, alternative, motor)
        begin = np.where(course.lost, cases, origin[run, movement][:, None])
        says = self._weigh(run, movement, begin, cases)
        follows = movement + 1 < self._usable.shape[1]
        after = np.where(follows, movement + 1, movement)
        end = np.repeat(destination[run, after][:, None], cases.shape[1], axis=1)
        missed = course.lost[chosen[run, after]][:, None]
        begin = np.where(missed, end, cases)
        says += np.where(follows[:, None], self._weigh(run, after, begin, end), 0.0)
        weighed = says + self.alternatives.log_weight[run, movement]
        best = np.argmax(weighed, axis=-1)
        chosen[run, movement] = best
        luck[run, movement] = log_sum(weighed, axis=-1) - says[np.arange(len(best)), best]
        return replace(course, chosen=chosen), luck

    def _weigh(
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
        duration = np.repeat(self._duration[run, movement][:, None], origin.shape[1], axis=1)
        if stops is not None:
            target = np.nan_to_num(self.ramps.settled.movements.target[run, movement, stops])
            travel = target[:, None] - origin[..., stops]
            travel = np.where(np.abs(travel) > 1e-6, travel, np.inf)
            done = (destination - origin)[..., stops] / travel
            duration[..., stops] *= np.clip(done, 0.0, 1.0)
        still = np.zeros(origin.shape[1:])
        ramps = Ramps(run, movement, origin, destination, duration, still, spread_m)
        return self.ramps.log_density(ramps)

    def _judge(self, course: _Course, spread_m: float = 0.0) -> FloatArray:
        """Return log densities of all movements of a course, (run, movement)."""
        item = self._items
        begin, end = (values[item][:, None] for values in (course.origin(), course.destination()))
        found = np.zeros(self._usable.shape)
        found[item] = self._weigh(*item, begin, end, spread_m=spread_m)[:, 0]
        return found


def _at(values: FloatArray, alternative: IntArray) -> FloatArray:
    """Return the values (run, movement, alternative) of one alternative each."""
    return np.take_along_axis(values, alternative[..., None], axis=2)[..., 0]
