"""What the way says: whether the motors moved from plateau to plateau as each fault would have it.

    log p(way) = 0.1 log sum over tau of p(tau) prod over readings of t_4(reading - path(t - tau))

Movements begin and end at the settled poses that explain them best under the fault in question.
What became of one whose end was not seen is judged by its way and by where the next one began. The
start delay tau is shared by all motors, and summed over; a tool may stray as no fault explains.

Section: docs/diagnosis.md#transient-likelihood-readings-on-the-way
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from failuretwin.core.numerics import along_polyline, log_of, log_sum
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.inference.evidence import SettledEvidence, TransientSamples
from failuretwin.inference.healthy_model import HealthyModel, StartNodes
from failuretwin.inference.joint_likelihood import (
    LARGEST_OFFSET_RAD,
    JointLikelihood,
    MovementLikelihoods,
)
from failuretwin.inference.reading_density import log_density_on_way

KNOTS = 11
"""Instants of a ramp at which the path is computed; between them it is a straight line."""
SEEN, UNSEEN = 0.3, 12.0
"""Factors on the variance of the settled scatter, where both ends of a movement were seen and where
not. All readings of a movement share its ends, so that each tells a twelfth of what is not known of
them; what is known of them is taken as it was seen."""
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
class TransientLikelihood:
    """Log densities of the readings on the way, for healthy robots and for faults of one motor.

    Attributes:
        model: The healthy robot.
        settled: Settled positions of the runs: their movements and times.
        moving: Readings on the way.
        findings: What every movement says by itself.
        start: Pose of a healthy arm before the run, (run, motor) [rad].
    """

    model: HealthyModel
    settled: SettledEvidence
    moving: TransientSamples
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
        seen = np.argmax(profile.log_terms(profile.mode, True), axis=-1)
        nearest = self._nearest_seen(_at(profile.mode, seen), motor)[..., None]
        ends = np.where(usable[..., None], profile.map_pose, self.findings.expected)
        ends[..., motor] = nearest
        whatever = lost | (np.arange(lost.shape[1]) == motor)  # becomes of its own command
        chosen, log_correction = self._fill_in(ends, seen, whatever)
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
        seen = np.argmax(profile.log_terms(near, False), axis=-1)
        ends = np.where(usable[..., None], profile.map_pose, self.findings.expected)
        unseen = profile.expected
        if gain is not None:
            amount = self._amount(_at(near - profile.expected, seen), _at(gain, seen))
            unseen = unseen + np.clip(gain * amount[:, None, None], -largest, largest)
        ends[..., motor] = np.where(usable, near, unseen)
        return self.toward(ends, seen, motor)

    def toward(self, ends: FloatArray, outcome: IntArray, off: int) -> FloatArray:
        """Return the log density if the motors go from one given pose to the next.

        Args:
            ends: Where each movement led, for each that may have become of it,
                (run, movement, outcome, motor) [rad].
            outcome: What did, where its end was seen, (run, movement).
            off: Motor that may have been off before the run.

        Returns:
            (run, movement).
        """
        lost = self.findings.outcomes.lost
        chosen, log_correction = self._fill_in(ends, outcome, lost)
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
        ends = np.where(seen, self.findings.poses, self.findings.expected)
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
        self, ends: FloatArray, chosen: IntArray, lost: BoolArray
    ) -> tuple[IntArray, FloatArray]:
        """Find out what became of movements whose end was not seen, by the way there and on.

        Returns:
            What became of each movement, the most probable where its end was not seen, and the
            log of what all outcomes together say over what that one says alone, (run, movement).
        """
        usable = self.settled.usable
        chosen, log_correction = np.where(usable, chosen, 0), np.zeros(usable.shape)
        unseen = np.nonzero(self.settled.movements.exists & ~usable)
        if len(unseen[0]) == 0:
            return chosen, log_correction
        origin, destination = self._course(ends, chosen, lost)
        log_weight = self.findings.outcomes.log_weight[unseen]
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
        weighed = says + np.where(np.isfinite(says), log_weight, 0.0)
        chosen[unseen] = best = np.argmax(weighed, axis=-1)
        log_correction[unseen] = log_sum(weighed, axis=-1) - _at(says, best)
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

    def _of_runs(
        self,
        origin: FloatArray,
        destination: FloatArray,
        duration: FloatArray | None = None,
        delay: FloatArray | None = None,
        spread_m: float = 0.0,
    ) -> FloatArray:
        """Return `log_density` of all movements, (run, movement, case); 0 without readings."""
        item = np.nonzero(self.moving.seen.any(axis=-1))
        found = np.zeros(origin.shape[:-1])
        lasts = None if duration is None else duration[item]
        found[item] = self.log_density(
            item, origin[item], destination[item], lasts, delay, spread_m
        )
        return found

    def log_density(
        self,
        item: tuple[IntArray, ...],
        origin: FloatArray,
        destination: FloatArray,
        duration: FloatArray | None = None,
        delay: FloatArray | None = None,
        spread_m: float = 0.0,
    ) -> FloatArray:
        """Return the log density of the readings of some movements, (item, case).

        Args:
            item: Their runs and numbers, (item,) each.
            origin: Where each motor starts, (item, case, motor) [rad].
            destination: Where it goes, (item, case, motor) [rad].
            duration: How long it takes, (item, case, motor) [s]; None: as commanded.
            delay: How much later than the others it starts, (case, motor) [s]; None: no later.
            spread_m: How far the tool may stray from its way beside what is usual [m].
        """
        if duration is None:
            duration = self.settled.movements.ramp_duration[item][:, None]
        late = np.zeros(origin.shape[1:]) if delay is None else delay
        path, longest, lead = self._path(origin, destination, np.nan_to_num(duration), late)
        variance = self._variance(item, destination[:, 0]) + spread_m**2
        found = np.full(origin.shape[:2], -np.inf)
        for start, log_chance in self._starts:
            chance = log_chance[item]
            some = np.flatnonzero(chance > -np.inf)
            if len(some) > 0:
                at = tuple(index[some] for index in item)
                ways = path[some], longest[some], lead[some]
                says = self._of_starts(at, *ways, variance[some], start)
                found[some] = np.logaddexp(found[some], says + chance[some, None])
        return found

    @cached_property
    def _starts(self) -> tuple[tuple[StartNodes, FloatArray], ...]:
        """Punctual and late starts, and the log probability of each, (run, movement)."""
        late = log_of(self.model.late(self.settled.movements, self.settled.first_reading_delay))
        delay, on_time = self.model.start_delay, log_of(-np.expm1(np.minimum(late, 0.0)))
        return (delay.punctual, on_time), (delay.late, late)

    def _of_starts(
        self,
        item: tuple[IntArray, ...],
        path: FloatArray,
        longest: FloatArray,
        lead: FloatArray,
        variance: FloatArray,
        start: StartNodes,
    ) -> FloatArray:
        """Return log densities of movements that begin so late, (item, case).

        Args:
            item: Runs and numbers of movements, (item,) each.
            path: What is seen at each knot, (item, case, knot, axis) [m].
            longest: Time from the first knot to the last, (item, case) [s].
            lead: How long before the start the first one is, (item, case) [s].
            variance: Of a reading on each axis, (item,) [m2].
            start: How late.
        """
        since = self.moving.since[item][:, None, :, None] - start.delay  # (.., reading, start)
        if lead.any():
            since = since + lead[..., None, None]
        way = along_polyline(path, longest, since)
        point = self.moving.point[item][:, None, :, None]
        sensors, step_s = self.model.sensors, start.step_s
        log_at = log_density_on_way(point, *way, variance[:, None, None, None], step_s, sensors)
        log_at *= self.moving.seen[item][:, None, :, None]
        return log_sum(log_at.sum(axis=2) + start.log_weight, axis=-1)

    def _variance(self, item: tuple[IntArray, ...], destination: FloatArray) -> FloatArray:
        """Return the variance of a reading on each axis, (item,) [m2]; ends (item, motor) [rad]."""
        jacobian = self.model.sensors.jacobian_on_way(destination)
        axes = jacobian.shape[-2]
        scaled = np.sum((jacobian * self.model.scatter) ** 2, axis=(-1, -2)) / axes
        seen = self.settled.usable.copy()
        seen[:, 1:] &= self.settled.usable[:, :-1]
        rough = self.model.settings.path_roughness_m
        return np.where(seen[item], SEEN, UNSEEN) * scaled + self.model.path_noise**2 + rough**2

    def _path(
        self, origin: FloatArray, destination: FloatArray, duration: FloatArray, delay: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return what is seen at each knot, (item, case, knot, axis) [m], and when knots are.

        The latter is the time from the first to the last and that from the first to the start,
        (item, case) [s] each; arguments as for `log_density`. What accelerates is seen at rest
        before and after, at a knot of its own.
        """
        duration = duration * (1.0 - self.model.shortening)
        longest = np.maximum((duration + delay).max(axis=-1), 0.05)
        longest = np.broadcast_to(longest, origin.shape[:2])
        beyond = 2 * self.model.sensors.accelerates
        step = longest / (KNOTS - 1)
        at = longest[..., None] * np.linspace(0.0, 1.0, KNOTS)
        if beyond:
            at = step[..., None] * np.arange(-beyond, KNOTS + beyond)
        since = at[..., None] - delay[:, None]  # (item, case, knot, motor)
        share = np.clip(since / np.maximum(duration, 1e-6)[..., None, :], 0.0, 1.0)
        pose = origin[..., None, :] + share * (destination - origin)[..., None, :]
        return self.model.sensors.along(pose, step), longest + 2 * beyond * step, beyond * step


def _at(values: FloatArray, outcome: IntArray) -> FloatArray:
    """Return the values (..., outcome) of one outcome each."""
    return np.take_along_axis(values, outcome[..., None], axis=-1)[..., 0]
