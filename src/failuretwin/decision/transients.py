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
from failuretwin.core.quadrature import log_sum
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.decision.motor_profile import MotorProfile
from failuretwin.decision.ramps import RampModel, Ramps

LARGEST_OFFSET_RAD = 0.3
"""Furthest from its target that a motor is taken to have settled without being stuck [rad]."""
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
        return self._trusted(self._judge(course.origin(), course.destination()) + luck)

    def held(self, motor: int, profile: MotorProfile) -> FloatArray:
        """Return the log density if a motor is held all the way or gets stuck on it.

        Args:
            motor: Index of the motor.
            profile: What each movement says of it.

        Returns:
            (run, movement).
        """
        seen = np.argmax(profile.log_terms(profile.best, True), axis=-1)
        angle, usable = _at(profile.best, seen), self._usable
        angle = np.where(usable, angle, self._typical(angle, motor)[:, None])
        ends = np.where(usable[..., None, None], profile.pose, self._expected)
        ends[..., motor] = angle[..., None]
        lost = self.alternatives.lost.copy()
        lost[:, motor] = True  # whatever becomes of its command
        course, luck = self._settle(_Course(ends, seen, lost, self._first))
        stays = self._judge(course.origin(), course.destination())
        moving = replace(course, lost=self.alternatives.lost).origin()
        stops = self._judge(moving, course.destination(), stops=motor)
        return self._trusted(np.logaddexp(stays, stops) - np.log(2.0) + luck)

    def off(self, motor: int, profile: MotorProfile) -> FloatArray:
        """Return the log density if a motor goes to where it was seen to settle.

        Args:
            motor: Index of the motor.
            profile: What each movement says of it.

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
        ends[..., motor] = np.where(self._usable[..., None], near, self._expected[..., motor])
        course, luck = self._settle(_Course(ends, seen, self.alternatives.lost, self._first))
        return self._trusted(self._judge(course.origin(), course.destination()) + luck)

    @cached_property
    def astray(self) -> FloatArray:
        """Log density if the tool strays from its way as no fault explains, (run, movement)."""
        course, _ = self._healthy
        spread_m = ASTRAY * self.ramps.model.reach
        return TRUST * self._judge(course.origin(), course.destination(), spread_m=spread_m)

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

    def _typical(self, angle: FloatArray, motor: int) -> FloatArray:
        """Return the median over the movements seen, else the angle before the run, (run,)."""
        masked = np.where(self._usable, angle, np.nan)
        start = self._first[:, motor]
        some = np.asarray(self._usable.any(axis=1))
        return np.where(some, np.nanmedian(np.where(some[:, None], masked, 0.0), axis=1), start)

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
        self, run: IntArray, movement: IntArray, origin: FloatArray, destination: FloatArray
    ) -> FloatArray:
        """Return log densities of some movements, (item, case); 0 without readings."""
        duration = np.repeat(self._duration[run, movement][:, None], origin.shape[1], axis=1)
        still = np.zeros(origin.shape[1:])
        return self.ramps.log_density(Ramps(run, movement, origin, destination, duration, still))

    def _judge(
        self,
        origin: FloatArray,
        destination: FloatArray,
        stops: int | None = None,
        spread_m: float = 0.0,
    ) -> FloatArray:
        """Return log densities of motors that go from one pose to another, (run, movement).

        Args:
            origin: Where each movement begins, (run, movement, motor) [rad].
            destination: Where it ends, (run, movement, motor) [rad].
            stops: Motor that is on its way to its target but stops where it ends.
            spread_m: How far the tool may stray from its way [m].
        """
        duration = self._duration
        if stops is not None:
            duration = duration.copy()
            target = np.nan_to_num(self.ramps.settled.movements.target[..., stops])
            travel = target - origin[..., stops]
            travel = np.where(np.abs(travel) > 1e-6, travel, np.inf)
            done = (destination - origin)[..., stops] / travel
            duration[..., stops] *= np.clip(done, 0.0, 1.0)
        item = self._items
        still = np.zeros((1, origin.shape[-1]))
        found = np.zeros(self._usable.shape)
        begin, end, time = (values[item][:, None] for values in (origin, destination, duration))
        ramps = Ramps(*item, begin, end, time, still, spread_m)
        found[item] = self.ramps.log_density(ramps)[:, 0]
        return found


def _at(values: FloatArray, alternative: IntArray) -> FloatArray:
    """Return the values (run, movement, alternative) of one alternative each."""
    return np.take_along_axis(values, alternative[..., None], axis=2)[..., 0]
