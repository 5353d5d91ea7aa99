"""What the way says: whether the motors moved as they should, for each fault that shows there.

Where each movement began and ended is taken from the settled poses, in the way that explains them
best under the fault in question; how it got there is judged here. What became of a movement whose
end was not seen is judged by its way and by where the next one began.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from failuretwin.core.types import FloatArray, IntArray
from failuretwin.decision.evidence.courses import Course, CourseJudge
from failuretwin.decision.evidence.motor_profile import LARGEST_OFFSET_RAD, MotorProfile
from failuretwin.decision.evidence.ramps import Ramps

TRUST = 0.1
"""Power to which what the way says is taken: its readings share errors of timing and of both ends
that the model of the way does not know, so that all of a movement count for about one. Chosen on
simulated runs of both engines."""

ASTRAY = 0.1
"""How far the tool strays from its way if nothing explains it, as a share of the arm's reach."""
ASTRAY_RATE = 0.02
"""Share of movements in which it does [-]."""
LAST = 3
"""Movements, the last that tell, from which the size of a lasting fault is taken where the end of a
movement was not seen."""


@dataclass(frozen=True)
class Transients:
    """Log densities of the readings on the way, for healthy robots and for faults of one motor.

    Attributes:
        judge: Density of readings on the way.
        terms: Log weight times density of each alternative for a healthy robot,
            (run, movement, alternative).
        poses: Pose that explains the settled position then, (run, movement, alternative, motor)
            [rad].
    """

    judge: CourseJudge
    terms: FloatArray
    poses: FloatArray

    @cached_property
    def healthy(self) -> FloatArray:
        """Log density if no motor is faulty, (run, movement)."""
        course, luck = self._healthy
        return self._trusted(
            self.judge.from_anywhere(course, self.judge.log_density(course)) + luck
        )

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
        ends = np.where(self.judge.usable[..., None, None], profile.pose, self.judge.expected)
        ends[..., motor] = nearest[..., None]
        lost = self.judge.alternatives.lost.copy()
        lost[:, motor] = True  # whatever becomes of its command
        course, luck = self.judge.settle(Course(ends, seen, lost, self.judge.first))
        item, cases = self.judge.items, len(angle)
        at = np.where(self.judge.usable[item][:, None], nearest[item][:, None], angle)
        end = np.repeat(course.destination()[item][:, None], cases, axis=1)
        end[..., motor] = at
        begin = np.repeat(course.origin()[item][:, None], cases, axis=1)
        begin[..., motor] = at
        stays = self.judge.weigh(*item, begin, end)
        moving = replace(course, lost=self.judge.alternatives.lost).origin()
        begin[..., motor] = moving[item][:, None, motor]
        stops = self.judge.weigh(*item, begin, end, stops=motor)
        found = np.zeros((*self.judge.usable.shape, cases))
        found[item] = np.logaddexp(stays, stops) - np.log(2.0)
        return self._trusted(self.judge.from_anywhere(course, found) + luck[..., None])

    def off(self, motor: int, profile: MotorProfile, gain: FloatArray | None = None) -> FloatArray:
        """Return the log density if a motor goes to where it was seen to settle.

        Args:
            motor: Index of the motor.
            profile: What each movement says of it.
            gain: By how much it is off for each unit of an amount that holds for the run,
                (run, movement, alternative) [rad]; None: other movements do not tell.

        Returns:
            (run, movement).
        """
        near = np.clip(
            profile.best,
            profile.expected - LARGEST_OFFSET_RAD,
            profile.expected + LARGEST_OFFSET_RAD,
        )
        seen = np.argmax(profile.log_terms(near, False), axis=-1)
        ends = np.where(self.judge.usable[..., None, None], profile.pose, self.judge.expected)
        unseen = self.judge.expected[..., motor]
        if gain is not None:
            amount = self._amount(_at(near - profile.expected, seen), _at(gain, seen))
            largest = LARGEST_OFFSET_RAD
            unseen = unseen + np.clip(gain * amount[:, None, None], -largest, largest)
        ends[..., motor] = np.where(self.judge.usable[..., None], near, unseen)
        return self.toward(ends, seen, motor)

    def toward(self, ends: FloatArray, became: IntArray, off: int) -> FloatArray:
        """Return the log density if the motors go from one given pose to the next.

        Args:
            ends: Where each movement led, for each that may have become of it,
                (run, movement, alternative, motor) [rad].
            became: What did, where its end was seen, (run, movement).
            off: Motor that may have been off before the run.

        Returns:
            (run, movement).
        """
        course, luck = self.judge.settle(
            Course(ends, became, self.judge.alternatives.lost, self.judge.first)
        )
        return self._trusted(
            self.judge.from_anywhere(course, self.judge.log_density(course), off) + luck
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
    def astray(self) -> FloatArray:
        """Log density if the tool strays from its way as no fault explains, (run, movement)."""
        course, _ = self._healthy
        spread_m = ASTRAY * self.judge.ramps.model.reach
        return TRUST * self.judge.log_density(course, spread_m)

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
        items, cases = self.judge.items, len(factor)
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
            Ramps(*items, origin, destination, duration, late)
        )
        return self._trusted(found + luck[..., None])

    @cached_property
    def _healthy(self) -> tuple[Course, FloatArray]:
        seen = np.argmax(self.terms, axis=-1)
        ends = np.where(self.judge.usable[..., None, None], self.poses, self.judge.expected)
        return self.judge.settle(Course(ends, seen, self.judge.alternatives.lost, self.judge.first))

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
    """Return the values (run, movement, alternative) of one alternative each."""
    return np.take_along_axis(values, alternative[..., None], axis=2)[..., 0]
