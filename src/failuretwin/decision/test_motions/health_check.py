"""A health check: test movements made, what they say of every motor, and whether that is enough.

    green: P(healthy) >= 0.95;    red: P(motor k), the sum over its modes, >= 0.95;    else open

Section: docs/check.md#result-of-a-check
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from failuretwin.connection.links.base import Commander, Order
from failuretwin.core.hypothesis import (
    FAULTY_STATE,
    HEALTHY_STATE,
    OPEN_STATE,
    SURE,
    Diagnosis,
    Hypothesis,
    motor_probabilities,
)
from failuretwin.core.types import FloatArray
from failuretwin.decision.acting.believed_arm import Seen
from failuretwin.decision.acting.judging import settled_evidence_of, shown_faults
from failuretwin.decision.acting.safety import SafetyGate
from failuretwin.decision.acting.work import OrderSequence, Work, first_standing
from failuretwin.decision.test_motions.design import next_movement
from failuretwin.decision.test_motions.motions import Motions
from failuretwin.failure_behavior.mode import Range, Signature
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.faults.priors import Priors, visible_sizes
from failuretwin.inference.isolability import IsolabilityReport
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.evidence import SettledEvidence
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.log_quality import LogQuality
from failuretwin.inference.observation.settings import ERROR_STEPS, WIDEST_ERROR
from failuretwin.inference.posterior import Posterior, log_prior
from failuretwin.inference.theta.shared_posterior import set_up_in_doubt, shared_posterior

HEALTHY_TO_FAULTY = 2.0
"""Odds that an arm is healthy that nobody suspects; assumed."""
LEAST_SHARE = 0.5
"""Where ranges of errors begin, in the least error that a profile states."""
RANGES = 5
"""So many ranges from there to the paper's."""
SMALLER = 2
"""Ranges that a check adds below those from what one settled position shows: forty movements of a
minute show a sixth of that, and "healthy" must not be surer than they can make it."""
GREEN, RED, OPEN = "green", "red", "open"
LIGHTS = {HEALTHY_STATE: GREEN, FAULTY_STATE: RED, OPEN_STATE: OPEN}
"""Light of each state of a diagnosis."""
ROUNDS = 8
"""Steps in which movements that fit ill get less weight."""
LOOSE_RAD = 0.1
"""What zeros and play may be before anything is seen, their deviation [rad]."""


def checking(model: HealthyModel, hypotheses: Sequence[Hypothesis]) -> Priors:
    """Return priors of who checks an arm that nobody suspects: 2 to 1 that it is healthy.

    Movements that are chosen for it, and are many, show smaller errors than others do: where a
    profile states the least, ranges of errors begin at half of that, in even steps of the
    logarithm; elsewhere at a sixth of what one settled position shows.

    Args:
        model: The healthy robot.
        hypotheses: What may be the case.
    """
    plain = Priors(error_ranges=_error_ranges(model))
    prior = np.exp(log_prior(hypotheses, plain))
    own = sum(prior[i] for i, h in enumerate(hypotheses) if h.is_healthy)
    if not 0.0 < own < 1.0:
        return plain
    return replace(plain, healthy_odds=HEALTHY_TO_FAULTY * float((1.0 - own) / own))


def _error_ranges(model: HealthyModel) -> Sequence[Range] | Mapping[str, Sequence[Range]]:
    """Return ranges of errors, those of all motors or of each."""
    least = model.settings.least_error_rad
    if least:
        begin = np.geomspace(LEAST_SHARE, max(ERROR_STEPS), RANGES) * least
        return tuple((low, WIDEST_ERROR * low) for low in begin.tolist())
    mode = MODES["steady_state_error"]
    return {
        name: visible_sizes(mode, model, motor, SMALLER).ranges
        for motor, name in enumerate(model.motor_names)
    }


@dataclass(frozen=True)
class MotorOffsets:
    """What settled movements say of each motor if nothing is wrong with the others.

    Attributes:
        zero: By how much it settles beside where it should, (motor,) [rad].
        zero_sd: Standard deviation of that.
        play: By how much that differs by the side it comes from, (motor,) [rad].
        play_sd: Standard deviation of that.
    """

    zero: FloatArray
    zero_sd: FloatArray
    play: FloatArray
    play_sd: FloatArray


def motor_offsets(evidence: SettledEvidence, model: HealthyModel) -> MotorOffsets:
    """Return offsets of all motors from one run, weighed by how well each movement fits.

        r_m = J_m (b - d_m p / 2) + e_m,    e_m ~ Student t with scale S_m

    Args:
        evidence: Settled positions of one run.
        model: The healthy robot.
    """
    movements, usable = evidence.movements, evidence.usable[0]
    told = np.concatenate([movements.initial[:, None], movements.target], axis=1)[0]
    command, travel = told[1:][usable], np.diff(told, axis=0)[usable]
    direction = np.where(np.abs(travel) > 1e-9, np.sign(travel), 0.0)
    pose = model.settle(command, direction, model.none_held)
    error, jacobian, spread = model.residual(evidence.point[0][usable], pose, model.scatter)
    design = np.concatenate([jacobian, -0.5 * jacobian * direction[:, None]], axis=-1)
    count, channels, dof = design.shape[-1], error.shape[-1], model.settling.tail_dof
    whitened = np.stack([spread.solve(design[..., i]) for i in range(count)], axis=-1)
    weight = np.ones(len(error))
    for _ in range(ROUNDS):
        precision = (
            np.einsum("m,maj,mai->ji", weight, whitened, design) + np.eye(count) / LOOSE_RAD**2
        )
        found = np.linalg.solve(precision, np.einsum("m,maj,ma->j", weight, whitened, error))
        left = error - design @ found
        if np.isfinite(dof):
            weight = (dof + channels) / (dof + np.einsum("ma,ma->m", left, spread.solve(left)))
    deviation = np.sqrt(np.diag(np.linalg.inv(precision)))
    motors = count // 2
    return MotorOffsets(found[:motors], deviation[:motors], found[motors:], deviation[motors:])


@dataclass(frozen=True)
class CheckResult:
    """What a check found.

    Attributes:
        diagnosis: Of all movements together.
        offsets: Zeros and play of the motors.
        movements: Movements that were seen at rest.
        further: How many of the movements made were not planned before.
        shown: What its movements can show at all; None: not looked at.
    """

    diagnosis: Diagnosis
    offsets: MotorOffsets
    movements: int
    further: int = 0
    shown: IsolabilityReport | None = None

    @property
    def by_motor(self) -> Mapping[str, float]:
        """Probability that something is wrong with each motor."""
        return motor_probabilities(self.diagnosis.posterior)

    @property
    def motor(self) -> str:
        """The motor that is named; empty: none."""
        if self.diagnosis.undecided:
            return ""
        return next((name for name, p in self.by_motor.items() if p >= SURE), "")

    @property
    def light(self) -> str:
        """``green``, ``red`` or ``open``."""
        return LIGHTS[self.diagnosis.state]


def faults_at_rest(model: HealthyModel) -> tuple[Hypothesis, ...]:
    """Return healthy and every single fault that can show in where a motor settles."""
    shown = (Signature.HELD, Signature.REDRAWN_OFFSET, Signature.OFFSET)
    return shown_faults(model, [name for name, mode in MODES.items() if mode.signature in shown])


def judged(
    likelihood: RunLikelihood, hypotheses: Sequence[Hypothesis], priors: Priors
) -> Posterior:
    """Return the posterior of runs, with what is doubted of the arm integrated out."""
    in_doubt = set_up_in_doubt(likelihood, hypotheses, priors)
    return shared_posterior(likelihood, hypotheses, priors, in_doubt)


def result_of(likelihood: RunLikelihood, diagnosis: Diagnosis, further: int = 0) -> CheckResult:
    """Return what one run says beyond its diagnosis.

    Args:
        likelihood: The run.
        diagnosis: Its diagnosis.
        further: How many of its movements were not planned.
    """
    evidence = likelihood.evidence
    offsets = motor_offsets(evidence, likelihood.model)
    return CheckResult(diagnosis, offsets, int(evidence.usable.sum()), further)


@dataclass
class HealthCheck:
    """Makes planned movements on an arm, then further ones while the result is open.

    Attributes:
        model: The healthy arm.
        gate: Safety limits.
        motions: Planned movements.
        hypotheses: Hypotheses of the check.
        priors: Beliefs about faults.
        further: Maximum number of further movements.
        seed: Seed of the poses that are tried for those.
        window: Movements as they were seen.
    """

    model: HealthyModel
    gate: SafetyGate
    motions: Motions
    hypotheses: Sequence[Hypothesis]
    priors: Priors
    further: int = 0
    seed: int = 0
    window: list[Seen] = field(default_factory=list)
    _added: int = field(default=0, init=False)

    def work(self, commander: Commander, tell: Callable[[str], None]) -> CheckResult:
        """Carry the check out on an arm and return the result."""
        standing = first_standing(commander)
        said: list[str] = []
        orders = self._orders(standing, said)
        sequence = OrderSequence(self.model, standing, orders, said, self.window)
        Work(sequence, self.gate, commander, standing, tell).carry_out()
        return self.result

    def _orders(self, standing: FloatArray, said: list[str]) -> Iterator[Order]:
        """Yield the way to the start, the planned movements and the further ones."""
        travel = self.motions.start - standing
        if np.abs(travel).max() > 1e-6:
            ramp = np.full(len(standing), self.gate.least_duration(travel))
            yield Order(self.motions.start, ramp)
        yield from self.motions.orders
        for number in range(1, self.further + 1):
            if self.result.light != OPEN:
                return
            at = self.window[-1].command
            order = next_movement(self.model, self.gate, self.posterior, at, self.seed)
            if order is None:
                return
            self._added = number
            said.append(f"still open: further movement {number}")
            yield order

    @property
    def likelihood(self) -> RunLikelihood:
        """Likelihood of all movements."""
        return RunLikelihood(settled_evidence_of([self.window]), self.model)

    @property
    def posterior(self) -> Posterior:
        """Posterior of all hypotheses given all movements."""
        return judged(self.likelihood, self.hypotheses, self.priors)

    @property
    def result(self) -> CheckResult:
        """Result of the check."""
        diagnosis = self.posterior.to_diagnosis(0, "check", LogQuality())
        return result_of(self.likelihood, diagnosis, self._added)
