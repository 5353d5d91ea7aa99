"""The result of a health check: what test movements say of every motor, and if that is enough.

    green: P(healthy) >= 0.95;    red: P(motor k), the sum over its modes, >= 0.95;    else open

Section: docs/check.md#result-of-a-check
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

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
from failuretwin.decision.acting.judging import shown_faults
from failuretwin.digital_model.nonidealities import Variation
from failuretwin.failure_behavior.mode import Range, Signature
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.engine.posterior import theta_posterior
from failuretwin.inference.engine.registration import robot_weighing, sensor_in_doubt
from failuretwin.inference.engine.runs import has_rows
from failuretwin.inference.faults.priors import Priors, visible_sizes
from failuretwin.inference.isolability import IsolabilityReport
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.log_quality import BEYOND_USUAL
from failuretwin.inference.observation.settings import ERROR_STEPS, WIDEST_ERROR
from failuretwin.inference.posterior import Posterior, log_prior
from failuretwin.inference.theta.shared_posterior import shared_posterior

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
LOOSE_RAD = 0.1
"""Standard deviation of zeros and play before anything is seen [rad]; assumed."""


def checking(model: HealthyModel, hypotheses: Sequence[Hypothesis]) -> Priors:
    """Return priors of who checks an arm that nobody suspects: 2 to 1 that it is healthy.

    Movements that are chosen for it, and are many, show smaller errors than others do: where a
    profile states the least, ranges of errors begin at half of that, in even steps of the
    logarithm; elsewhere at a sixth of what one settled position shows.
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
    """Posterior of the zero and the play of each motor.

    Attributes:
        zero: Mean of the zero, by which a motor settles beside its target, (motor,) [rad].
        zero_sd: Standard deviation of it.
        play: Mean of the play, the difference by the side it comes from, (motor,) [rad].
        play_sd: Standard deviation of it.
    """

    zero: FloatArray
    zero_sd: FloatArray
    play: FloatArray
    play_sd: FloatArray


def motor_offsets(
    likelihood: RunLikelihood, hypotheses: Sequence[Hypothesis], priors: Priors
) -> MotorOffsets:
    """Return the zeros and the play of all motors, hypotheses and lost commands summed out.

        p(b, f | run) = sum over h, rows and components of P(h, row, c | run) N(theta; mean, V)

    with zero b and play 2 f of theta. The prior is wide, `LOOSE_RAD`, and not that of the
    calibration: a check measures what has moved since. A motor that is called stuck leaves the
    prior of its zero and play. The sensor's frame is taken as the profile states it.
    """
    ranked = [h for h in hypotheses if has_rows(h)]
    weighing = robot_weighing(_with_loose_offsets(likelihood), ranked, priors)
    (mean,), (spread,) = theta_posterior(weighing.evidence)
    offsets = weighing.layout.offsets
    zero, _, friction = mean[offsets].reshape(3, -1)
    zero_sd, _, friction_sd = np.sqrt(np.diag(spread)[offsets]).reshape(3, -1)
    return MotorOffsets(zero, zero_sd, 2.0 * friction, 2.0 * friction_sd)


def _with_loose_offsets(likelihood: RunLikelihood) -> RunLikelihood:
    """Return a run of a robot whose zeros and play nobody has measured."""
    model = likelihood.model
    loose, given = np.full(len(model.scatter), LOOSE_RAD), model.imperfections
    doubt = replace(given.variation or Variation(), bias=tuple(loose), friction=tuple(0.5 * loose))
    model = replace(model, imperfections=replace(given, variation=doubt))
    return RunLikelihood(likelihood.evidence, model)


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
    in_doubt = sensor_in_doubt(likelihood, hypotheses, priors)
    return shared_posterior(likelihood, hypotheses, priors, in_doubt)


def result_of(
    likelihood: RunLikelihood,
    hypotheses: Sequence[Hypothesis],
    priors: Priors,
    diagnosis: Diagnosis,
    further: int = 0,
) -> CheckResult:
    """Return the result of a check: its diagnosis, with zeros and play.

    Designed movements reach the joint limits, so commands outside the usual ranges are no remark.
    """
    remarks = tuple(line for line in diagnosis.quality if not line.startswith(BEYOND_USUAL))
    diagnosis = replace(diagnosis, quality=remarks)
    offsets = motor_offsets(likelihood, hypotheses, priors)
    return CheckResult(diagnosis, offsets, int(likelihood.usable.sum()), further)
