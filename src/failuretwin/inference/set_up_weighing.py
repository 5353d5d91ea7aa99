"""Which set-up a log was made with, weighed with every hypothesis behind each.

    p(w | runs) ~ p(w) prod over runs i of sum over h of p(h) p(run_i | w, h)

The sum over hypotheses inside and the product over runs outside tell a set-up, which all runs
share, from faults, which some have. What explains the runs as well as a healthy model says it
should is not looked behind: a log that fits costs nothing.

Section: docs/inference.md#set-ups
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.numerics import log_of, log_sum
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.robot import Robot
from failuretwin.inference.engine.registration import (
    FEW_RUNS,
    displaced_evidence,
    evidence_at_once,
)
from failuretwin.inference.engine.runs import has_rows
from failuretwin.inference.engine.theta import offset_deviation, offsets_doubted
from failuretwin.inference.engine.weighing import Weighing
from failuretwin.inference.faults.motor_residual import EXPLAINED
from failuretwin.inference.faults.prior_odds import log_prior
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.misfit import highest_and_outlier
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.robot_mixture import robot_components
from failuretwin.inference.set_up_posterior import SetUpPosterior, WeighedSetUp, with_doubt
from failuretwin.inference.set_ups.log_correction import LogCorrection
from failuretwin.inference.set_ups.set_ups import (
    FEWEST_TO_TURN,
    MOST_RAD,
    SetUp,
    mistakes,
    turned,
    zero_off,
)

FEW = 8
"""Runs that set-ups are weighed by, evenly spread: five name what shows."""
FINALISTS = 2
"""Mistakes that are looked at with a sensor that may stand a little elsewhere too."""
NEAR, PROMISING = 0.15, 8
"""Of single mistakes, of two at once and of the zeros of a motor so many are weighed: those that
bring most movements nearest, within this share of the reach."""
FAR = 0.08
"""A frame that moves the tool by less than this share of the reach is a matter of registration."""
CHOICE_NATS = 12.0
"""What seven numbers of a registration, chosen anew for each run, cost of its evidence [nats]."""
CLUSTER, OFF, AGREEING = 3.0, 2.0, 0.2
"""A zero is weighed where such a share of the movements agrees on it within `CLUSTER` deviations,
and it is off by `OFF`: only movements count that one motor explains."""
RIGHT = 2
"""Movements of a run in which a motor stands right show that its zero is."""
ZEROS_RAD = tuple(np.deg2rad([z for z in range(-15, 16) if z]).tolist())
"""Zeros that are tried where nothing explains the runs: most that are off are so by less, and one
beside a fault is not what movements agree on."""
BESIDE_RAD = tuple(np.deg2rad([2.0, 1.0]).tolist())
"""Steps by which a zero is looked for beside a sensor that stands elsewhere."""
HOPELESS_NATS = 12.0
"""A zero that is so much less probable than the best of all motors, or the set-up as told, is not
looked at more closely."""
ROUNDS, NEARLY = 2, 0.3
"""Newton steps to the zero that explains the runs best, at most, and how many of its deviations are
no step."""
CHUNK_RUNS = 64
"""Runs that are weighed at a time, whatever the set-up."""


@dataclass(frozen=True)
class SetUpWeighing:
    """Some runs that share a set-up.

    Attributes:
        likelihood: Runs by their settled positions, as they were seen.
        hypotheses: What may be the case.
        priors: Beliefs about faults and set-ups.
        known: The same runs weighed as told, where that is how all set-ups are weighed.
    """

    likelihood: RunLikelihood
    hypotheses: Sequence[Hypothesis]
    priors: Priors
    known: Sequence[Weighing] = ()

    @cached_property
    def as_told(self) -> SetUp:
        """The set-up that nothing is wrong with."""
        none = LogCorrection.none(len(self.likelihood.model.scatter))
        return SetUp("", "", none, float(log_of(1.0 - self.rate)))

    @cached_property
    def rate(self) -> float:
        """Probability that the set-up is wrong: small where healthy logs fitted the profile."""
        rates = self.priors.setup.wrong_rate
        return rates[1] if offsets_doubted(self.likelihood.model) else rates[0]

    @property
    def log_rate(self) -> float:
        """Log of that."""
        return float(log_of(self.rate))

    @property
    def robot(self) -> Robot:
        """The robot."""
        return self.likelihood.model.twin.robot

    @cached_property
    def log_odds(self) -> FloatArray:
        """Log prior of each hypothesis, (hypothesis,)."""
        return log_prior(self.hypotheses, self.priors)

    def behind(self, set_ups: Sequence[SetUp]) -> RunLikelihood:
        """Return the runs with each of some set-ups undone, one after the other."""
        if len(set_ups) == 1 and set_ups[0].correction.is_none:
            return self.likelihood
        evidence, count = self.likelihood.evidence, len(self.likelihood.usable)
        undone = evidence[np.tile(np.arange(count), len(set_ups))]
        for i, set_up in enumerate(set_ups):
            undone.put(slice(i * count, (i + 1) * count), set_up.correction.evidence(evidence))
        return RunLikelihood(undone, self.likelihood.model)

    def weigh(self, set_ups: Sequence[SetUp], everything: bool = False) -> list[WeighedSetUp]:
        """Return what the runs say of set-ups, with the sensor where the profile has it.

        Args:
            set_ups: The set-ups.
            everything: Whether pairs of faults and the unknown one count: they take long. Without
                them a set-up is called no more probable than it is.
        """
        found, count = [], len(self.likelihood.usable)
        asked = [i for i, h in enumerate(self.hypotheses) if everything or len(h.faults) < 2]
        asked = [i for i in asked if everything or self.hypotheses[i].known] or asked
        hypotheses, log_odds = [self.hypotheses[i] for i in asked], self.log_odds[asked]
        at_a_time = max(1, CHUNK_RUNS // count)
        for first in range(0, len(set_ups), at_a_time):
            some = set_ups[first : first + at_a_time]
            likelihood = self.behind(some)
            if self.known and likelihood is self.likelihood:
                says = np.concatenate([one.by_hypothesis for one in self.known])[:, asked]
            else:
                says = evidence_at_once(likelihood, hypotheses, self.priors)
            found += _weighed(some, likelihood, log_sum(says + log_odds, axis=1))
        return found

    def weigh_moved(self, set_ups: Sequence[SetUp]) -> list[WeighedSetUp]:
        """Return the same with a sensor that may stand a little elsewhere.

        Where no hypothesis has a score, none tells where it stands: it is where the profile has it.
        """
        if not any(has_rows(h) for h in self.hypotheses):
            return self.weigh(set_ups, everything=True)
        found, at_a_time = [], max(1, (FEW_RUNS - 1) // len(self.likelihood.usable))
        for first in range(0, len(set_ups), at_a_time):  # each run has a registration of its own
            some = set_ups[first : first + at_a_time]
            likelihood = self.behind(some)
            log_joint = displaced_evidence(likelihood, self.hypotheses, self.priors) + self.log_odds
            found += _weighed(some, likelihood, log_sum(log_joint, axis=1), CHOICE_NATS)
        return [replace(one, moved=True) for one in found]

    # Which set-ups are weighed.

    def posterior(self, thorough: bool = False) -> SetUpPosterior:
        """Return what is believed of the set-up; as told at once where that fits.

        Args:
            thorough: Whether other set-ups are weighed also where it fits: a fault that fits the
                runs need not be what explains them best.
        """
        if self.rate == 0.0 or not self.likelihood.usable.any():
            return self.taken_as_told()
        told = self.weigh([self.as_told])
        if not told[0].fits:
            told = self.weigh([self.as_told], everything=True)
        if told[0].fits and not thorough:
            zeros = self.zeros(self.as_told, told[0].log_joint)
            return self._believed([*told, *zeros, *self.others(zeros)])
        return self.few.searched()

    def _believed(self, weighed: Sequence[WeighedSetUp]) -> SetUpPosterior:
        """Return the posterior over set-ups that were weighed."""
        return SetUpPosterior.of(with_doubt(weighed, self.rate))

    def taken_as_told(self) -> SetUpPosterior:
        """Return the belief that nothing is wrong, whatever the runs say."""
        nothing = np.zeros(len(self.likelihood.usable))
        return SetUpPosterior([WeighedSetUp(self.as_told, nothing, 0.0)], np.ones(1))

    @cached_property
    def few(self) -> SetUpWeighing:
        """The same by few of the runs."""
        return replace(self, likelihood=self._some(FEW), known=())

    def _some(self, most: int) -> RunLikelihood:
        """Return so many of the runs at most, evenly spread."""
        count = len(self.likelihood.usable)
        if count <= most:
            return self.likelihood
        return self.likelihood[np.unique(np.linspace(0, count - 1, most).astype(np.int64))]

    def searched(self) -> SetUpPosterior:
        """Return what is believed of the set-up of runs that do not fit it.

        One mistake is tried, then a sensor that stands a little elsewhere, then two mistakes, then
        a mistake with such a sensor, until something explains the runs.
        """
        single = self.options(self.as_told)
        told = self.weigh([self.as_told], everything=True)[0]
        zeros = self.zeros(self.as_told, told.log_joint, ZEROS_RAD)
        found = [told, *self.weigh(self.nearest(single)), *zeros, *self.others(zeros)]
        likeliest = max(zeros, key=lambda one: one.log_joint, default=None)
        if likeliest is not None:
            found += self.zeros(likeliest.set_up, likeliest.log_joint, ZEROS_RAD)
        fitting = any(one.fits for one in found)
        found += self.weigh_moved([self.as_told])
        if likeliest is not None and not fitting:
            found += self._moved_zeros(likeliest.set_up)
        if any(one.fits for one in found):
            return self._believed(found)
        likely = self.nearest([two.beside(one) for one in mistakes(self.robot) for two in single])
        found += self.weigh(likely)
        for first in self.nearest(single)[:FINALISTS]:
            found += self.zeros(first, told.log_joint)
        if not any(one.fits for one in found):
            found += self.weigh_moved(self.nearest(single)[:FINALISTS])
        return self._believed(found)

    def options(self, first: SetUp) -> list[SetUp]:
        """Return every mistake behind one that is undone."""
        found = [*mistakes(self.robot), *self.frames(first)]
        return [replace(s, log_prior=s.log_prior + self.log_rate).beside(first) for s in found]

    def nearest(self, set_ups: Sequence[SetUp]) -> list[SetUp]:
        """Return the set-ups that bring the tool nearest to where healthy commands would have it.

        Movements that stay far off count alike, however far: some may be faulty. Commands by which
        joints turn round and round are none, unless all set-ups make such.
        """
        evidence, usable = self.likelihood.evidence, self.likelihood.usable
        told, point = evidence.movements.target[usable], evidence.point[usable]
        commands = np.stack([s.correction.command(told) for s in set_ups])
        expected = self.likelihood.model.twin.path(commands)
        seen = np.stack([s.correction.point(point) for s in set_ups])
        away = np.linalg.norm(seen - expected, axis=-1) / (NEAR * self.robot.reach)
        angles = np.where(self.robot.slides, 0.0, commands)
        wild = (np.abs(angles) > MOST_RAD).any(axis=(1, 2))
        score = np.minimum(away, 1.0).mean(axis=1) + (wild & ~wild.all())
        order = np.argsort(score, kind="stable")[:PROMISING]
        return [set_ups[i] for i in order if score[i] <= 1.0]

    # Mistakes with numbers of their own.

    def frames(self, first: SetUp) -> list[SetUp]:
        """Return the frame that explains settled poses best behind a mistake."""
        likelihood, model = self.behind([first]), self.likelihood.model
        usable, healthy = likelihood.usable, likelihood.healthy_pose
        if usable.sum() < FEWEST_TO_TURN:
            return []
        expected, point = model.twin.path(healthy[usable]), likelihood.evidence.point[usable]
        found = turned(model.twin.robot, expected, point)
        away = np.linalg.norm(found.correction.point(point) - point, axis=1)
        return [found] if np.median(away) > FAR * model.twin.robot.reach else []

    def zeros(self, first: SetUp, told: float, also: Sequence[float] = ()) -> list[WeighedSetUp]:
        """Return the likeliest zero of each motor behind a mistake.

        Args:
            first: What is undone before.
            told: Log of prior times evidence of the set-up as told.
            also: Zeros that are tried beside those that movements agree on [rad].
        """
        likelihood = self.behind([first])
        motors = np.flatnonzero(~self.robot.slides).tolist()
        tried = {k: self._likeliest_zero(likelihood, first, k, also) for k in motors}
        best = max([told, *(height for _, height in tried.values())])
        found = []
        for k, (likeliest, height) in tried.items():
            if height > best - HOPELESS_NATS:
                width = float(likelihood.model.least_visible[k])
                zero = self._zero(first, k, likeliest, width)
                off = zero.set_up.correction.z[k] - first.correction.z[k]
                found += [zero] if abs(off) > OFF * width else []
        return found

    def _likeliest_zero(
        self, likelihood: RunLikelihood, first: SetUp, motor: int, also: Sequence[float]
    ) -> tuple[float, float]:
        """Return the zero of a motor that explains the runs best, and log of prior times evidence.

        Args:
            likelihood: The runs behind the mistake.
            first: The mistake.
            motor: Index of the motor.
            also: Zeros that are tried beside those that movements agree on [rad].
        """
        width, least = float(likelihood.model.least_visible[motor]), likelihood.usable.sum()
        says = likelihood.profile(motor)
        seen = likelihood.usable & (says.min_distance2[..., 0] < EXPLAINED)
        away = says.turned(says.mode - says.expected)[..., 0]
        values = [*_agreed(away[seen], width, AGREEING * least), *also]
        values = [z for z in values if not right_in_some(away, seen, z, width)]
        if not values:
            return 0.0, -np.inf
        tried = self.weigh(self.nearest([self._off(first, motor, value) for value in values]))
        best = max(tried, key=lambda one: one.log_joint)
        off = best.set_up.correction.z[motor] - first.correction.z[motor]
        return float(off), best.log_joint

    def others(self, zeros: Sequence[WeighedSetUp]) -> list[WeighedSetUp]:
        """Return other robots than the calibrated one, set up as told, that explain as much.

            p(z) = p(another robot) N(b + z; b_class, deviation of b in its class)

        Args:
            zeros: Zeros z, each of one motor, whose bias is b in the calibration.
        """
        model = self.likelihood.model
        known = robot_components(model, self.priors)
        if model.imperfections.of_class or len(known) == 1:
            return []
        kind, found = known[1], list[WeighedSetUp]()
        bias = np.asarray(model.settling.bias) - np.asarray(kind.model.settling.bias)
        deviation = offset_deviation(kind.model)
        for zero in zeros:
            motor = int(np.argmax(np.abs(zero.set_up.correction.z)))
            off = float(zero.set_up.correction.z[motor])
            width = float(zero.set_up.log_prior - self._off(self.as_told, motor, off).log_prior)
            square = ((bias[motor] + off) / deviation[motor]) ** 2
            says = -0.5 * square - float(np.log(np.sqrt(2.0 * np.pi) * deviation[motor]))
            log_prior = self.as_told.log_prior + kind.log_weight + says + width
            found.append(replace(zero, set_up=replace(self.as_told, log_prior=log_prior)))
        return found

    def _moved_zeros(self, near: SetUp) -> list[WeighedSetUp]:
        """Return the zero that is likeliest beside a sensor that stands elsewhere, if one is off.

        Args:
            near: That of a sensor that stands where it should.
        """
        motor = int(np.argmax(np.abs(near.correction.z)))
        value, few = float(near.correction.z[motor]), replace(self, likelihood=self._some(FEW // 2))

        says = dict[float, float]()
        for step in BESIDE_RAD:
            new = [zero for zero in (value, value - step, value + step) if zero not in says]
            tried = few.weigh_moved([self._off(self.as_told, motor, zero) for zero in new])
            says |= {zero: one.log_joint for zero, one in zip(new, tried, strict=True)}
            value = max(says, key=lambda zero: says[zero])
        if abs(value) <= OFF * self.likelihood.model.least_visible[motor]:
            return []
        return self.weigh_moved([self._off(self.as_told, motor, value)])

    def _off(self, first: SetUp, motor: int, zero: float) -> SetUp:
        """Return the mistake that a zero is so far off, behind another."""
        known, rate = zero_off(self.robot, motor, zero), 0.0 if first.what else self.log_rate
        return replace(known, log_prior=known.log_prior + rate).beside(first)

    def _zero(self, first: SetUp, motor: int, zero: float, width: float) -> WeighedSetUp:
        """Return what the runs say of a zero near some value, the value integrated out."""
        for _ in range(ROUNDS):
            around = [self._off(first, motor, zero + width * step) for step in (-1.0, 0.0, 1.0)]
            tried = self.weigh(around)
            low, middle, high = (float(one.log_evidence.sum()) for one in tried)
            curvature = max((2.0 * middle - low - high) / width**2, 0.1 / width**2)
            step = float(np.clip((high - low) / (2.0 * width * curvature), -width, width))
            best, width = tried[1], float(np.clip(curvature**-0.5, 0.1 * width, width))
            if abs(step) < NEARLY * width:
                break
            zero += step
        else:
            best = self.weigh([self._off(first, motor, zero)])[0]
        volume = 0.5 * float(np.log(2.0 * np.pi / curvature))
        known = replace(best.set_up, log_prior=best.set_up.log_prior + volume)
        return replace(best, set_up=known)


def _agreed(off: FloatArray, width: float, least: float) -> list[float]:
    """Return the values off 0 that enough movements agree on, each once.

    Args:
        off: By how much a motor is off in each movement, (movement,) [rad].
        width: Deviation of each [rad].
        least: Movements that must agree.
    """
    values = list[float]()
    together = np.abs(off[:, None] - off) < CLUSTER * width
    for members in together[np.argsort(-together.sum(axis=1), kind="stable")]:
        value = float(np.median(off[members]))
        new = all(abs(value - known) > CLUSTER * width for known in values)
        if members.sum() >= least and abs(value) > OFF * width and new:
            values.append(value)
    return values


def right_in_some(away: FloatArray, seen: BoolArray, zero: float, width: float) -> bool:
    """Return whether a motor stands where it should in most movements of some run, not at a zero.

    A zero that is wrong is so in every run; what only some have is a fault.

    Args:
        away: By how much the motor is off, (run, movement) [rad].
        seen: Which movements tell, (run, movement).
        zero: The zero [rad].
        width: Deviation of each movement [rad].
    """
    right = (np.abs(away) < min(0.5 * abs(zero), CLUSTER * width)) & seen
    most = 2 * right.sum(axis=1) > seen.sum(axis=1)
    return bool((most & (right.sum(axis=1) >= RIGHT)).any())


def _weighed(
    set_ups: Sequence[SetUp],
    likelihood: RunLikelihood,
    log_evidence: FloatArray,
    choice_nats: float = 0.0,
) -> list[WeighedSetUp]:
    """Return what runs say of set-ups; each in turn was undone on all of them.

    Args:
        set_ups: The set-ups.
        likelihood: The runs behind each.
        log_evidence: What these say, (set-up and run,).
        choice_nats: What numbers that were chosen for each run cost, which is no misfit.
    """
    best, worst = (says.sum(axis=1) for says in highest_and_outlier(likelihood))
    best = best - choice_nats
    lost, most, says = (
        values.reshape(len(set_ups), -1)
        for values in (best - log_evidence, best - worst, log_evidence)
    )
    misfit = lost.sum(axis=1) / np.maximum(most.sum(axis=1), 1.0)
    return [
        WeighedSetUp(set_up, row, float(share))
        for set_up, row, share in zip(set_ups, says, misfit, strict=True)
    ]
