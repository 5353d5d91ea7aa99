"""From marginal likelihoods to the posterior, and to the diagnosis of each run.

    p(h | run) = p(h) p(run | h) / sum over h' of p(h') p(run | h')

Section: docs/inference.md#posterior
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from failuretwin.core.errors import InputError, counted
from failuretwin.core.hypothesis import (
    UNKNOWN,
    Diagnosis,
    Fault,
    Hypothesis,
    MovementEvidence,
    single_faults,
)
from failuretwin.core.numerics import log_sum
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.digital_model.arm_classes import class_name
from failuretwin.digital_model.robot import Robot
from failuretwin.failure_behavior.mode import FaultMode, Signature
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.explanation import lost_command_lines, with_joint_names, worded
from failuretwin.inference.faults.double_faults import double_fault_likelihood
from failuretwin.inference.faults.fault_models import (
    growing_offset_model,
    offset_model,
    redrawn_offset_model,
    transient_model,
)
from failuretwin.inference.faults.fault_sizes import LOCAL_STEPS, SizePrior
from failuretwin.inference.faults.marginal import (
    Estimate,
    FaultModel,
    MarginalLikelihood,
    marginal_likelihood,
)
from failuretwin.inference.faults.missed_movements import missed_movements_likelihood
from failuretwin.inference.faults.motor_residual import lone_motor, motor_residual
from failuretwin.inference.faults.prior_odds import log_prior, prior_odds
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.faults.stuck import stuck_model
from failuretwin.inference.faults.unknown import unknown_likelihood
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.movements.two_joint_likelihood import two_joint_likelihood
from failuretwin.inference.observation.between_commands import TOO_SELDOM
from failuretwin.inference.observation.evidence import unused_movements
from failuretwin.inference.observation.log_quality import (
    LogQuality,
    commands_beyond,
)
from failuretwin.inference.set_ups.wrong_setup import NOTHING_SIMPLE, NOWHERE, wrong_setup

# From a hypothesis to what runs say of it.

MOST_FAULTS = 2
"""Faults that can be weighed at once."""
NOT_IN_PAIRS = (Signature.TRANSIENT, Signature.MISSED)
"""Faults that leave the motor at its target, or at times: they are not weighed beside another."""


def check_diagnosable(hypothesis: Hypothesis) -> None:
    """Refuse a hypothesis that cannot be weighed.

    Raises:
        InputError: If a mode is not known, or cannot be weighed together with another.
    """
    modes = [MODES.find(fault.mode) for fault in hypothesis.faults]
    if len(hypothesis.faults) > MOST_FAULTS:
        raise InputError(
            f"hypothesis '{hypothesis}' has {len(hypothesis.faults)} faults. Expected "
            f"{MOST_FAULTS} at most."
        )
    for mode in modes if len(modes) > 1 else ():
        if mode.signature in NOT_IN_PAIRS:
            known = [name for name, m in MODES.items() if m.signature not in NOT_IN_PAIRS]
            raise InputError(
                f"fault mode {mode.mode!r} cannot be weighed in '{hypothesis}'. Expected one of "
                f"{', '.join(known)}."
            )


def shows_in_transients(hypothesis: Hypothesis) -> bool:
    """Return whether a hypothesis shows in how the motors move more than in where they settle."""
    return not hypothesis.known or any(
        MODES[fault.mode].signature is Signature.TRANSIENT for fault in hypothesis.faults
    )


def marginal_likelihoods(
    likelihood: RunLikelihood, hypotheses: Sequence[Hypothesis], priors: Priors
) -> list[MarginalLikelihood]:
    """Return what runs say of each hypothesis, in their order."""
    known = [h for h in hypotheses if h.known]
    weights = {h: marginal_likelihood_of(likelihood, h, priors) for h in known}
    if len(known) < len(hypotheses):
        others = [
            (prior_odds(h) * priors.factor_of(h), marginal_likelihood_of(likelihood, h, priors))
            for h in unlisted(likelihood, known)
        ]
        weights[UNKNOWN] = unknown_likelihood(likelihood, _healthy_likelihood, others, known)
    return [weights[h] for h in hypotheses]


def unlisted(likelihood: RunLikelihood, known: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return the single faults that can be weighed but are not among the known hypotheses."""
    names = likelihood.model.twin.robot.motor_names
    return [h for h in single_faults(names, MODES) if h.faults and h not in known]


def marginal_likelihood_of(
    likelihood: RunLikelihood, hypothesis: Hypothesis, priors: Priors
) -> MarginalLikelihood:
    """Return what runs say of one known hypothesis."""
    if not hypothesis.faults:
        return _healthy_likelihood(likelihood)
    if len(hypothesis.faults) == 2:
        likelihoods = [likelihood[run] for run in range(len(likelihood.log_healthy))]
        one, two = hypothesis.faults
        return double_fault_likelihood(
            likelihoods, [_fault_models_of_two(alone, one, two, priors) for alone in likelihoods]
        )
    fault = hypothesis.faults[0]
    if MODES[fault.mode].signature is Signature.MISSED:
        motor, early = motor_of(likelihood, fault), priors.onset.before_run(fault.mode)
        return missed_movements_likelihood(likelihood, motor, fault.mode, early)
    return marginal_likelihood(likelihood, fault_model_of(likelihood, fault, priors))


def motor_of(likelihood: RunLikelihood, fault: Fault) -> int:
    """Return the index of the motor that has the fault."""
    return likelihood.model.motor_names.index(fault.motor)


MODELS: Mapping[
    Signature, Callable[[RunLikelihood, int, FaultMode, SizePrior, float], FaultModel]
] = {
    Signature.OFFSET: offset_model,
    Signature.GROWING_OFFSET: growing_offset_model,
    Signature.REDRAWN_OFFSET: redrawn_offset_model,
    Signature.TRANSIENT: transient_model,
}
"""Fault models of faults that have a size."""


def fault_model_of(likelihood: RunLikelihood, fault: Fault, priors: Priors) -> FaultModel:
    """Return the fault model of a fault, of any mode but those of missed movements."""
    motor, mode = motor_of(likelihood, fault), MODES[fault.mode]
    early = priors.onset.before_run(fault.mode)
    if mode.signature is Signature.HELD:
        return stuck_model(likelihood, motor, priors.onset)
    sizes = priors.sizes_of(mode, likelihood.model, motor)
    return MODELS[mode.signature](likelihood, motor, mode, sizes, early)


def _fault_models_of_two(
    likelihood: RunLikelihood, one: Fault, two: Fault, priors: Priors
) -> tuple[FaultModel, FaultModel]:
    """Return the fault models of two faults at once; those held look where both point."""
    first, second = sorted((motor_of(likelihood, one), motor_of(likelihood, two)))
    seen = two_joint_likelihood(
        likelihood.evidence, likelihood.model, likelihood.outcomes, (first, second)
    )

    def fault_model(fault: Fault) -> FaultModel:
        if MODES[fault.mode].signature is not Signature.HELD:
            return fault_model_of(likelihood, fault, priors)
        motor = motor_of(likelihood, fault)
        at = seen.pair.index(motor)
        width = np.sqrt(seen.covariance[..., at, at])
        nodes = seen.angle[..., at, None] + width[..., None] * LOCAL_STEPS
        return stuck_model(likelihood, motor, priors.onset, nodes.reshape(len(nodes), -1))

    return fault_model(one), fault_model(two)


def _healthy_likelihood(likelihood: RunLikelihood) -> MarginalLikelihood:
    """Return what runs say of no motor being faulty."""
    by_movement = likelihood.log_healthy + likelihood.log_transient

    def estimate(run: int) -> Estimate:
        return Estimate(None, None, likelihood.outcome_probability[run])

    of_run, settled = by_movement.__getitem__, likelihood.log_healthy.__getitem__
    return MarginalLikelihood(by_movement.sum(axis=1), of_run, settled, estimate)


# What keeps a run from being judged, and what happened in it besides any fault.

UNEXPLAINED_NATS = 1.0
"""A movement whose density is within this of "anywhere within reach" is not explained [nats]."""
FEW_MOVEMENTS = 2
"""So few usable movements carry a verdict only if one hypothesis holds half of the probability."""


def abstention_reason(
    quality: LogQuality,
    likelihood: RunLikelihood,
    run: int,
    probability: float,
    by_movement: FloatArray,
    before: int = 0,
) -> str:
    """Return why a run allows no verdict, empty if it does.

    Args:
        quality: Defects of the log.
        likelihood: The runs.
        run: Index of the run.
        probability: Posterior of the best hypothesis.
        by_movement: Log density of each movement under the best hypothesis, (movement,).
        before: Movements of the stream before the run.
    """
    if quality.fatal:
        return quality.fatal
    evidence, usable = likelihood.evidence, likelihood.usable[run]
    if not evidence.movements.exists[run].any():
        return "no motor is told to move"
    if not usable.any():
        return TOO_SELDOM if evidence.too_seldom[run] else NEVER_AT_REST
    if usable.sum() <= FEW_MOVEMENTS and probability < 0.5:
        count = int(usable.sum())
        return f"only {counted(count, 'movement')} can be used and no hypothesis stands out"
    outlier = likelihood.model.outlier_log_density
    unexplained = usable & (by_movement < outlier + UNEXPLAINED_NATS)
    if 2 * unexplained.sum() <= usable.sum():
        return ""
    which = ", ".join(str(before + n) for n in np.unique(evidence.numbers[run][unexplained]))
    if not likelihood.model.sensors.sees_tool:
        return f"after movement {which} no hypothesis explains what the sensors read"
    return f"after movement {which} {NOWHERE}: {_why_nowhere(likelihood, run, unexplained)}"


def _why_nowhere(likelihood: RunLikelihood, run: int, unexplained: BoolArray) -> str:
    """Return what explains the movements of a run that no hypothesis does, a clause."""
    evidence, usable = likelihood.evidence, likelihood.usable[run]
    target, point = evidence.movements.target[run][usable], evidence.point[run][usable, :3]
    setup = wrong_setup(likelihood.model.twin, target, point)
    if setup is not None:
        return setup.told
    return lone_motor(likelihood, run, unexplained) or NOTHING_SIMPLE


NEVER_AT_REST = (
    "the tool is not seen at rest after any movement, and too few readings on its way can be "
    "compared with the commands"
)
"""Why a run without a usable movement allows no verdict."""
LEVELS = (0.05, 0.5, 0.95)
"""Quantiles that are told: the ends of a 90 % interval and the median."""


@dataclass(frozen=True)
class StreamPosition:
    """Where a run lies in a stream.

    Attributes:
        begin_s: When it begins [s].
        movements: Movements of the stream before it.
        before: What was said before; of a fault that is older than the run, its onset stands.
    """

    begin_s: float = 0.0
    movements: int = 0
    before: Diagnosis | None = None

    def known_onset(self, hypothesis: Hypothesis) -> Diagnosis | None:
        """Return what was said before, if that was the same fault, older than the run.

        Args:
            hypothesis: What is said now.
        """
        before = self.before
        if before is None or before.onset_s is None or before.diagnosis != str(hypothesis):
            return None
        return before if before.onset_s < self.begin_s else None


@dataclass(frozen=True)
class Posterior:
    """Some runs with every hypothesis weighed.

    Attributes:
        likelihood: The runs.
        hypotheses: What may be the case.
        log_prior: (hypothesis,).
        log_posterior: (run, hypothesis).
        weights: What the runs say of each hypothesis, in their order.
        set_up: What is to be said of the set-up of each run; empty: nothing of any.
        offsets: The same of zeros that are far off what such robots do.
        explained: Log density of each settled position given all before it, (run, movement), where
            more is known than the runs say; None: what the best hypothesis makes of it counts.
        log_settled: Log of the sum over hypotheses of p(h) p(settled positions | h), (run,); None:
            it was not asked for.
        no_verdict: Why no set-up allows a verdict on each run; empty: nothing keeps from any.
        unasked: What explains each run better and is no hypothesis; empty: nothing does.
    """

    likelihood: RunLikelihood
    hypotheses: Sequence[Hypothesis]
    log_prior: FloatArray
    log_posterior: FloatArray
    weights: Sequence[MarginalLikelihood]
    set_up: Sequence[str] = ()
    offsets: Sequence[str] = ()
    explained: FloatArray | None = None
    log_settled: FloatArray | None = None
    no_verdict: Sequence[str] = ()
    unasked: Sequence[str] = ()

    @property
    def settled_evidence(self) -> FloatArray:
        """Log density of the settled positions of each run, over all hypotheses, (run,)."""
        assert self.log_settled is not None, "this posterior was made without settled evidence"
        return self.log_settled

    def undecided(self, run: int, quality: LogQuality, before: int = 0) -> str:
        """Return why a run allows no verdict, empty if it does.

        Args:
            run: Index of the run.
            quality: Defects of its log.
            before: Movements of the stream before it.
        """
        best = int(np.argmax(self.log_posterior[run]))
        if self.no_verdict and self.no_verdict[run] and not quality.fatal:
            alone = lone_motor(self.likelihood, run, self.likelihood.usable[run])
            return "; ".join(filter(None, (self.no_verdict[run], alone)))
        faulty = bool(self.hypotheses[best].faults)
        if faulty and self.unasked and self.unasked[run] and not quality.fatal:
            return self.unasked[run]
        known = self.explained
        explained = self.weights[best].settled(run) if known is None else known[run]
        return abstention_reason(
            quality,
            self.likelihood,
            run,
            float(np.exp(self.log_posterior[run, best])),
            explained,
            before,
        )

    def posterior(self, run: int, undecided: str) -> FloatArray:
        """Return the posterior of a run, (hypothesis,).

        Args:
            run: Index of the run.
            undecided: Why it allows no verdict. Then nothing is learnt: the prior stands.
        """
        return np.exp(self.log_prior if undecided else self.log_posterior[run])

    def to_diagnosis(
        self,
        run: int,
        name: str,
        quality: LogQuality,
        truth: str | None = None,
        place: StreamPosition = StreamPosition(),
    ) -> Diagnosis:
        """Return the diagnosis of a run.

        Args:
            run: Index of the run.
            name: What to call it.
            quality: Defects of its log.
            truth: What was wrong, where known; it is only passed on.
            place: Where it lies in a stream, whose times and movements are told.
        """
        evidence, model = self.likelihood.evidence, self.likelihood.model
        robot = model.twin.robot
        order = np.argsort(-self.log_posterior[run], kind="stable")
        ranked = [self.hypotheses[i] for i in order]
        best, before = self.weights[order[0]], place.movements
        undecided = self.undecided(run, quality, before)
        posterior = self.posterior(run, undecided)
        unused = unused_movements(evidence, run, before)
        used = "settled poses" if self.likelihood.moving is None else "whole run"
        used = "readings on the way" if evidence.on_the_way[run] else used
        used += "" if model.sensors.tool_alone else f", by {'+'.join(model.sensing)}"
        diagnosis = Diagnosis(
            run=name,
            truth=truth,
            posterior={str(h): float(p) for h, p in zip(self.hypotheses, posterior, strict=True)},
            quality=(
                *quality.remarks,
                *(said[run] for said in (self.set_up, self.offsets) if said and said[run]),
                *unused,
                *commands_beyond(robot, evidence.movements, run),
            ),
            undecided=undecided,
            protocol=model.imperfections.protocol,
            method=f"bayes, {used}; healthy behaviour: {model.imperfections.name}",
        )
        losses: list[str] = []
        if not undecided:
            diagnosis = replace(diagnosis, evidence=self._evidence(run, order, place))
            estimate = best.estimate(run)
            losses = [*self._losses(run, estimate, ranked[0], before), *self._not_shown(run)]
            diagnosis = _with_estimate(diagnosis, ranked[0], estimate, place, robot)
            if not ranked[0].known:
                diagnosis = replace(diagnosis, residual=motor_residual(self.likelihood, run))
        return with_joint_names(worded(diagnosis, ranked, losses, class_name(robot)), robot)

    def _evidence(
        self, run: int, order: IntArray, place: StreamPosition
    ) -> tuple[MovementEvidence, ...]:
        """Return what each usable movement says of the best hypothesis against the second."""
        if len(order) < 2:
            return ()
        best, second = (self.weights[i].by_movement(run) for i in order[:2])
        evidence = self.likelihood.evidence
        usable, number = np.flatnonzero(evidence.usable[run]), evidence.numbers[run]
        again = np.bincount(number[usable])
        return tuple(
            MovementEvidence(
                place.movements + int(number[m]),
                float(best[m] - second[m]),
                float(evidence.end[run, m]) if again[number[m]] > 1 else None,
            )
            for m in usable
        )

    def _losses(
        self, run: int, estimate: Estimate, hypothesis: Hypothesis, before: int
    ) -> list[str]:
        """Return the commands that seem not to have arrived if `hypothesis` is true."""
        motors = self.likelihood.model.twin.robot.motor_names
        faulty = [fault.motor for fault in hypothesis.faults]
        return lost_command_lines(
            estimate.outcome_probability,
            (before + self.likelihood.evidence.numbers[run]).tolist(),
            self.likelihood.model.lost_commands.lost,
            motors,
            faulty,
        )

    def _not_shown(self, run: int) -> list[str]:
        """Return what the motion of a run that may be healthy does not show, a line a motor.

        A run that says nothing of a hypothesis leaves its odds beside healthy as they were.
        """
        healthy = np.flatnonzero([h.is_healthy for h in self.hypotheses])
        if np.exp(self.log_posterior[run, healthy]).sum() < LEAST_HEALTHY:
            return []
        gain = self.log_posterior[run] - self.log_prior
        gain = gain - gain[healthy[0]]
        untold = (gain > -AGAINST_NATS) & (gain < FOR_NATS)
        model, lines = self.likelihood.model, []
        travel = self.likelihood.evidence.movements.travel(run)
        suspect = np.argsort(-self.log_posterior[run])[:2]
        for k, motor in enumerate(model.motor_names):
            own = [i for i, h in enumerate(self.hypotheses) if _is_of(h, motor)]
            held = [i for i in own if is_held(self.hypotheses[i])]
            moved = f"{motor.replace('_', ' ')} moved {_told_travel(model.twin.robot, k, travel)}"
            hardly = travel[k] < HARDLY * model.least_visible[k]
            if own and untold[own].all():
                lines.append(f"{moved}: little can be said of it")
            elif hardly and untold[held].any():
                lines.append(f"{moved}: if it is stuck, this hardly shows")
            elif hardly and np.isin(suspect, own).any():
                lines.append(f"{moved}: too little to tell what is wrong with it")
        return lines


LEAST_HEALTHY = 0.05
"""Probability of healthy from which it is told what a motion does not show."""
HARDLY = 5.0
"""A motor that moves less hardly moves, in the smallest angle of it that shows."""
AGAINST_NATS, FOR_NATS = 3.0, 1.0
"""A run that speaks against a fault or for it by less says little of it."""


def _is_of(hypothesis: Hypothesis, motor: str) -> bool:
    """Return whether a hypothesis is a single fault of a motor."""
    return [fault.motor for fault in hypothesis.faults] == [motor]


def is_held(hypothesis: Hypothesis) -> bool:
    """Return whether a motor is held."""
    return any(MODES[fault.mode].signature is Signature.HELD for fault in hypothesis.faults)


def _told_travel(robot: Robot, motor: int, travel: FloatArray) -> str:
    """Return how far a motor was told to go, between the ends of its way."""
    if robot.slides[motor]:
        return f"{1e3 * travel[motor]:.0f} mm"
    return f"{np.rad2deg(travel[motor]):.0f} deg"


def compute_posterior(
    likelihood: RunLikelihood, hypotheses: Sequence[Hypothesis], priors: Priors
) -> Posterior:
    """Weigh every hypothesis by some runs.

    Args:
        likelihood: The runs.
        hypotheses: What may be the case.
        priors: Beliefs about onset and size.
    """
    weights = settled = marginal_likelihoods(likelihood, hypotheses, priors)
    if likelihood.moving is not None:
        settled = marginal_likelihoods(replace(likelihood, moving=None), hypotheses, priors)
    prior = log_prior(hypotheses, priors)
    log_joint, log_settled = (
        np.stack([weight.log_evidence for weight in said], axis=1) + prior
        for said in (weights, settled)
    )
    log_posterior = log_joint - log_sum(log_joint, axis=1)[:, None]
    return Posterior(
        likelihood,
        hypotheses,
        prior,
        log_posterior,
        weights,
        log_settled=log_sum(log_settled, axis=1),
    )


def _with_estimate(
    diagnosis: Diagnosis,
    hypothesis: Hypothesis,
    estimate: Estimate,
    place: StreamPosition,
    robot: Robot,
) -> Diagnosis:
    """Return the diagnosis with onset and magnitude of the fault that is most probable."""
    if estimate.onset is not None:
        early, middle, late = (place.begin_s + estimate.onset.quantiles(LEVELS)).tolist()
        diagnosis = replace(diagnosis, onset_s=middle, onset_90=(early, late))
        known = place.known_onset(hypothesis)
        if known is not None:
            diagnosis = replace(diagnosis, onset_s=known.onset_s, onset_90=known.onset_90)
    if estimate.size is not None:
        low, half, high = estimate.size.quantiles(LEVELS).tolist()
        fault = hypothesis.faults[0]
        unit = robot.own_unit(fault.motor, MODES[fault.mode].unit)
        diagnosis = replace(
            diagnosis, magnitude=half, magnitude_unit=unit, magnitude_90=(low, high)
        )
    return diagnosis
