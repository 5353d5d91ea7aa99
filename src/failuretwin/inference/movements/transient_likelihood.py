"""What the way says: whether the motors moved from plateau to plateau as each fault would have it.

    log p(way) = 0.1 log sum over tau of p(tau) prod over readings of t_4(reading - path(t - tau))

Movements begin and end at the settled poses that explain them best under the fault in question.
What became of one whose end was not seen is judged by its way and by where the next one began. The
start delay tau is shared by all motors, and summed over; a tool may stray as no fault explains.

Section: docs/inference.md#readings-on-the-way
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from failuretwin.core.numerics import log_of, log_sum
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.inference.movements.joint_likelihood import (
    LARGEST_OFFSET_RAD,
    JointLikelihood,
    MovementLikelihoods,
)
from failuretwin.inference.movements.path_likelihood import PathLikelihood

STARTS_RAD = np.linspace(-LARGEST_OFFSET_RAD, LARGEST_OFFSET_RAD, 13)
"""Where a motor may stand before the run if not where it should, from there."""
RARELY_ELSEWHERE = 0.01
"""Motors that do so less often are taken to stand where they should [-]."""
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
class TransientLikelihood(PathLikelihood):
    """Log densities of the readings on the way, for healthy robots and for faults of one motor.

    Attributes:
        findings: What every movement says by itself.
        start: Pose of a healthy arm before the run, (run, motor) [rad].
    """

    findings: MovementLikelihoods
    start: FloatArray

    @cached_property
    def healthy(self) -> FloatArray:
        """Log density if no motor is faulty, (run, movement)."""
        return self._from_to(*self._healthy)

    def stuck(self, motor: int, profile: JointLikelihood, angle: FloatArray) -> FloatArray:
        """Return the log density if a motor is held all the way or gets stuck on it.

        Where the end of a movement was seen, the motor is taken to be held where that puts it.

        Args:
            motor: Index of the motor.
            profile: What each movement says of it.
            angle: Where it may be held otherwise, (run, node) [rad].

        Returns:
            (run, movement, node).
        """
        usable, lost = self.settled.usable[..., None], self.findings.outcomes.lost
        terms = profile.log_terms(profile.mode, True)
        seen = np.argmax(terms, axis=-1)
        nearest = self._nearest_seen(_at(profile.mode, seen), motor)[..., None]
        ends = np.where(usable[..., None], profile.map_pose, self.findings.expected)
        ends[..., motor] = nearest
        whatever = lost | (np.arange(lost.shape[1]) == motor)  # becomes of its own command
        chosen, log_correction = self._fill_in(ends, seen, whatever, terms)
        origin, destination = self._course(ends, chosen, whatever)
        begin, end, duration = (
            np.repeat(values[:, :, None], angle.shape[1], axis=2)
            for values in (origin, destination, self.settled.movements.ramp_duration)
        )
        begin[..., motor] = end[..., motor] = np.where(usable, nearest, angle[:, None])
        stays = self._of_runs(begin, end, duration)
        begin[..., motor] = self._course(ends, chosen, lost)[0][..., None, motor]
        travel = self.settled.movements.target[..., None, motor] - begin[..., motor]
        travel = np.where(np.abs(travel) > 1e-6, travel, np.inf)
        duration[..., motor] *= np.clip((end - begin)[..., motor] / travel, 0.0, 1.0)
        found = np.logaddexp(stays, self._of_runs(begin, end, duration)) - np.log(2.0)
        found = self._from_anywhere(origin, destination, found)
        return self._tempered(found + log_correction[..., None])

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
        usable, largest = self.settled.usable[..., None], LARGEST_OFFSET_RAD
        near = profile.expected + np.clip(profile.mode - profile.expected, -largest, largest)
        terms = profile.log_terms(near, False)
        seen = np.argmax(terms, axis=-1)
        ends = np.where(usable[..., None], profile.map_pose, self.findings.expected)
        unseen = profile.expected
        if gain is not None:
            amount = self._amount(_at(near - profile.expected, seen), _at(gain, seen))
            unseen = unseen + np.clip(gain * amount[:, None, None], -largest, largest)
        ends[..., motor] = np.where(usable, near, unseen)
        return self.toward(ends, seen, motor, terms)

    def toward(
        self, ends: FloatArray, outcome: IntArray, off: int, terms: FloatArray | None = None
    ) -> FloatArray:
        """Return the log density if the motors go from one given pose to the next.

        Args:
            ends: Where each movement led, for each that may have become of it,
                (run, movement, outcome, motor) [rad].
            outcome: What did, where its end was seen, (run, movement).
            off: Motor that may have been off before the run.
            terms: What is seen at rest of each outcome, as for `_fill_in`.

        Returns:
            (run, movement).
        """
        lost = self.findings.outcomes.lost
        chosen, log_correction = self._fill_in(ends, outcome, lost, terms)
        return self._from_to(*self._course(ends, chosen, lost), log_correction, off)

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
        *course, log_correction = self._healthy
        origin, destination, duration = (
            np.repeat(values[:, :, None], len(factor), axis=2)
            for values in (*course, self.settled.movements.ramp_duration)
        )
        duration[..., motor] *= factor
        if begin is not None:
            origin[..., motor] = begin
            destination[..., motor] = self.findings.expected[:, :, 0, None, motor]
        late = delay[:, None] * (np.arange(origin.shape[-1]) == motor)
        says = self._of_runs(origin, destination, duration, late)
        return self._tempered(says + log_correction[..., None])

    @cached_property
    def _healthy(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Where each movement of a healthy arm began and ended, and what else became of it."""
        lost, seen = self.findings.outcomes.lost, self.settled.usable[..., None, None]
        ends = np.where(seen, self.findings.explanation.poses, self.findings.expected)
        chosen, log_correction = self._fill_in(ends, np.argmax(self.findings.terms, axis=-1), lost)
        return *self._course(ends, chosen, lost), log_correction

    def _from_to(
        self,
        origin: FloatArray,
        destination: FloatArray,
        log_correction: FloatArray,
        off: int | None = None,
    ) -> FloatArray:
        says = self._of_runs(origin[:, :, None], destination[:, :, None])[..., 0]
        says = self._from_anywhere(origin, destination, says, off)
        return self._tempered(says + log_correction)

    @cached_property
    def _outlier_path(self) -> FloatArray:
        """Log density if the tool strays from its way as no fault explains, (run, movement)."""
        origin, destination, _ = self._healthy
        spread_m = OUTLIER_PATH * self.model.twin.robot.reach
        says = self._of_runs(origin[:, :, None], destination[:, :, None], spread_m=spread_m)
        return TEMPERING * says[..., 0]

    def _tempered(self, says: FloatArray) -> FloatArray:
        """Return what the way says as far as it is trusted, (run, movement, ...)."""
        astray = self._outlier_path.reshape(self._outlier_path.shape + (1,) * (says.ndim - 2))
        return np.logaddexp(
            np.log1p(-OUTLIER_PATH_RATE) + TEMPERING * says, np.log(OUTLIER_PATH_RATE) + astray
        )

    def _amount(self, offset: FloatArray, gain: FloatArray) -> FloatArray:
        """Return the amount that makes offsets of gains, (run, movement) [rad] each, as (run,).

        The median of what the last movements say: those before the onset say that there is none,
        and those whose gain is small beside the others' say little.
        """
        large = np.where(self.settled.usable, np.abs(gain), 0.0)
        tells = (large > 0.0) & (large >= 0.5 * large.max(axis=1, keepdims=True))
        tells &= np.cumsum(tells[:, ::-1], axis=1)[:, ::-1] <= LAST
        ratio = np.where(tells, offset / np.where(tells, gain, 1.0), np.nan)
        ratio[~tells.any(axis=1)] = 0.0
        return np.asarray(np.nanmedian(ratio, axis=1))

    def _nearest_seen(self, angle: FloatArray, motor: int) -> FloatArray:
        """Return angles (run, movement) with those of unseen ends from the next movement seen.

        Where none follows, from the last one before; where there is none, from before the run.
        """
        filled, other = np.where(self.settled.usable, angle, np.nan).T, np.full(len(angle), np.nan)
        for here in filled[::-1]:
            here[:] = other = np.where(np.isnan(here), other, here)
        other = self.start[:, motor]
        for here in filled:
            here[:] = other = np.where(np.isnan(here), other, here)
        return filled.T

    def _course(
        self, ends: FloatArray, chosen: IntArray, lost: BoolArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return where each movement began and ended, (run, movement, motor) [rad] each.

        A motor that missed the command was already where it is.

        Args:
            ends: Where each one led if this or that became of it, (run, movement, outcome, motor)
                [rad].
            chosen: What became of it, (run, movement).
            lost: Motors that lose their command in each outcome, (outcome, motor).
        """
        destination = np.take_along_axis(ends, chosen[..., None, None], axis=2)[:, :, 0]
        before = np.concatenate([self.start[:, None], destination[:, :-1]], axis=1)
        return np.where(lost[chosen], destination, before), destination

    def _fill_in(
        self,
        ends: FloatArray,
        chosen: IntArray,
        lost: BoolArray,
        terms: FloatArray | None = None,
    ) -> tuple[IntArray, FloatArray]:
        """Find out what became of movements whose end was not seen, by the way there and on.

        Of all movements where what is seen at rest does not show every motor: each outcome then
        weighs what that leaves it.

        Args:
            ends: As for `_course`.
            chosen: What became of each movement, where its end was seen.
            lost: Motors that lose their command in each outcome, (outcome, motor).
            terms: Log weight times density of what was seen at rest under each outcome,
                (run, movement, outcome); None: of a healthy robot.

        Returns:
            What became of each movement, the most probable where its end was not seen, and the
            log of what all outcomes together say over what that one says alone, (run, movement).
        """
        usable, log_weight = self.settled.usable, self.findings.outcomes.log_weight
        power = 1.0  # to which the way is taken beside what is known of each outcome
        if not self.model.sensors.tells_all_at_rest:
            terms = self.findings.terms if terms is None else terms
            left = terms - log_sum(terms, axis=-1)[..., None]
            log_weight, usable = np.where(usable[..., None], left, log_weight), usable & False
            power = TEMPERING
        chosen, log_correction = np.where(usable, chosen, 0), np.zeros(usable.shape)
        unseen = np.nonzero(self.settled.movements.exists & ~usable)
        if len(unseen[0]) == 0:
            return chosen, log_correction
        origin, destination = self._course(ends, chosen, lost)
        log_weight = log_weight[unseen]
        item, outcome = np.nonzero(np.isfinite(log_weight))
        run, number = unseen[0][item], unseen[1][item]
        here = ends[run, number, outcome]
        begin = np.where(lost[outcome], here, origin[run, number])
        follows = number + 1 < usable.shape[1]
        after = np.where(follows, number + 1, number)
        end = destination[run, after]
        then = np.where(lost[chosen[run, after]], end, here)
        next_one = self.log_density((run, after), then[:, None], end[:, None])[:, 0]
        says = np.full(log_weight.shape, -np.inf)
        says[item, outcome] = self.log_density((run, number), begin[:, None], here[:, None])[:, 0]
        says[item, outcome] += np.where(follows, next_one, 0.0)
        weighed = power * says + np.where(np.isfinite(says), log_weight, 0.0)
        chosen[unseen] = best = np.argmax(weighed, axis=-1)
        log_correction[unseen] = log_sum(weighed, axis=-1) / power - _at(says, best)
        return chosen, log_correction

    def _from_anywhere(
        self, origin: FloatArray, destination: FloatArray, says: FloatArray, off: int | None = None
    ) -> FloatArray:
        """Return log densities if a motor may have stood elsewhere before the run.

        A healthy one does if it missed the command before.

        Args:
            origin: Where the movements began, (run, movement, motor) [rad].
            destination: Where they ended.
            says: Log density of each movement if all stood where they should, (run, movement) or
                (run, movement, node).
            off: Motor that is as likely to have been off as not.
        """
        outcomes = self.findings.outcomes
        chance = np.exp(outcomes.log_weight[:, 0]) @ outcomes.lost  # (run, motor)
        if off is not None:
            chance = 0.5 * chance
            chance[:, off] = 0.5
        chance[:, chance.max(axis=0) <= RARELY_ELSEWHERE] = 0.0
        first, run = says[:, 0].T, np.flatnonzero(self.moving.seen[:, 0].any(axis=-1))
        total = first + np.log1p(-np.minimum(chance.sum(axis=1), 0.9))
        for motor in np.flatnonzero(chance.any(axis=0)):
            begin, end = (
                np.repeat(pose[run, 0][:, None], len(STARTS_RAD), axis=1)
                for pose in (origin, destination)
            )
            begin[..., motor] += STARTS_RAD
            other = log_of(chance[:, motor])
            weighed = self.log_density((run, np.zeros_like(run)), begin, end)
            other[run] += log_sum(weighed, axis=-1) - np.log(len(STARTS_RAD))
            total = np.logaddexp(total, other)
        return np.concatenate([total.T[:, None], says[:, 1:]], axis=1)


def _at(values: FloatArray, outcome: IntArray) -> FloatArray:
    """Return the values (..., outcome) of one outcome each."""
    return np.take_along_axis(values, outcome[..., None], axis=-1)[..., 0]
