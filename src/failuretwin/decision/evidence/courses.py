"""Where the movements of runs led, and how well the readings on the way agree with that."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from failuretwin.connection.lost_commands import Alternatives
from failuretwin.core.quadrature import log_of, log_sum
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.decision.evidence.motor_profile import LARGEST_OFFSET_RAD
from failuretwin.decision.evidence.ramps import RampModel, Ramps

STARTS_RAD = np.linspace(-LARGEST_OFFSET_RAD, LARGEST_OFFSET_RAD, 13)
"""Where a motor may stand before the run if not where it should, from there."""
RARELY_ELSEWHERE = 0.01
"""Motors that do so less often are taken to stand where they should [-]."""


@dataclass(frozen=True)
class Course:
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
class CourseJudge:
    """Density of the readings on the way, given where the movements led.

    Attributes:
        ramps: Density of readings on the way.
        alternatives: What may have become of each movement.
    """

    ramps: RampModel
    alternatives: Alternatives

    @property
    def usable(self) -> BoolArray:
        """Movements whose end was seen, (run, movement)."""
        return self.ramps.settled.usable

    @cached_property
    def duration(self) -> FloatArray:
        """How long each ramp takes, (run, movement, motor) [s]."""
        return np.nan_to_num(self.ramps.settled.movements.ramp_duration)

    @cached_property
    def items(self) -> tuple[IntArray, IntArray]:
        """Run and movement of all movements with readings on the way."""
        some = np.asarray(self.ramps.moving.seen.any(axis=-1))
        run, movement = np.nonzero(some)
        return run, movement

    @cached_property
    def expected(self) -> FloatArray:
        """Where a healthy arm settles, (run, movement, alternative, motor) [rad]."""
        model = self.ramps.model
        return model.settle(self.alternatives.base, self.alternatives.direction, model.none_held)

    @cached_property
    def first(self) -> FloatArray:
        """Pose of a healthy arm before the run, (run, motor) [rad]."""
        start, model = self.ramps.settled.movements.initial, self.ramps.model
        return model.settle(start, np.zeros_like(start), model.none_held)

    def settle(self, course: Course) -> tuple[Course, FloatArray]:
        """Find out what became of movements whose end was not seen.

        Returns:
            The course with the most probable alternative for them, and the log of what all
            alternatives together say over what that one says alone, (run, movement).
        """
        chosen = np.where(self.usable, course.chosen, 0)
        luck = np.zeros(self.usable.shape)
        course = replace(course, chosen=chosen)
        run, movement = np.nonzero(self.ramps.settled.movements.exists & ~self.usable)
        if len(run) == 0:
            return course, luck
        log_weight = self.alternatives.log_weight[run, movement]
        item, case = np.nonzero(np.isfinite(log_weight))
        says = np.full(log_weight.shape, -np.inf)
        says[item, case] = self._way_and_next(course, run[item], movement[item], case)
        weighed = says + np.where(np.isfinite(says), log_weight, 0.0)
        best = np.argmax(weighed, axis=-1)
        chosen[run, movement] = best
        luck[run, movement] = log_sum(weighed, axis=-1) - says[np.arange(len(best)), best]
        return replace(course, chosen=chosen), luck

    def _way_and_next(
        self, course: Course, run: IntArray, movement: IntArray, became: IntArray
    ) -> FloatArray:
        """Return log densities of some movements and of those that follow them, (item,).

        Args:
            course: Where all others led.
            run: Which run each movement belongs to, (item,).
            movement: Its number in the run, (item,).
            became: What became of it, (item,).
        """
        origin, destination = course.origin(), course.destination()
        here = course.ends[run, movement, became]
        begin = np.where(course.lost[became], here, origin[run, movement])
        says = self.weigh(run, movement, begin[:, None], here[:, None])[:, 0]
        follows = movement + 1 < self.usable.shape[1]
        after = np.where(follows, movement + 1, movement)
        end = destination[run, after]
        begin = np.where(course.lost[course.chosen[run, after]], end, here)
        return says + np.where(
            follows, self.weigh(run, after, begin[:, None], end[:, None])[:, 0], 0.0
        )

    def log_density(self, course: Course, spread_m: float = 0.0) -> FloatArray:
        """Return log densities of all movements of a course, (run, movement)."""
        item = self.items
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
        ramps = Ramps(run, movement, origin, destination, duration, still, spread_m)
        return self.ramps.log_density(ramps)

    def from_anywhere(self, course: Course, says: FloatArray, off: int | None = None) -> FloatArray:
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
        chance[:, chance.max(axis=0) <= RARELY_ELSEWHERE] = 0.0
        usual = np.log1p(-np.minimum(chance.sum(axis=1), 0.9))
        terms = [says[:, 0] + usual.reshape(shape)]
        for motor in np.flatnonzero(chance.any(axis=0)):
            other = self._elsewhere(course, int(motor)) + log_of(chance[:, motor])
            terms.append(np.broadcast_to(other.reshape(shape), terms[0].shape))
        says = says.copy()
        says[:, 0] = np.logaddexp.reduce(terms, axis=0)
        return says

    def _elsewhere(self, course: Course, motor: int) -> FloatArray:
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
