"""What is believed of the arm that acts: what its latest movements say, latched.

A reaction destroys its own evidence: a held motor that is told to stay where it stands says nothing
any more. So a fault that was probable once is believed until movements speak against it,

    lead <- min(cap, lead + log p(e_m | believed) - log p(e_m | healthy)),    let go below -5,

and until another fault explains the latest movements better by as much. What was seen before it was
let go is forgotten then: the arm may have been repaired.

The latest few movements show a drift as a constant error, so rate and beginning of one that is
believed are fitted to all movements since it began,

    o_i = J_k' S_k^-1 e_i / (J_k' S_k^-1 J_k),    o_i = rate (t_i - since) + noise

with e the miss of the tool at rest, S_k its scatter by all motors.

Section: docs/acting.md#how-it-works
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from failuretwin.core.hypothesis import HEALTHY, Diagnosis, Hypothesis, single_faults
from failuretwin.core.movements import Movements
from failuretwin.core.types import FloatArray
from failuretwin.decision.acting.believed_arm import HALF_90, BelievedArm, BelievedFault, Seen
from failuretwin.failure_behavior.mode import Reaction, Signature
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.engine.registration import run_posterior
from failuretwin.inference.faults.priors import MONITORING
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.evidence import SettledEvidence
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.log_quality import LogQuality
from failuretwin.inference.posterior import LEVELS, Posterior, StreamPosition, compute_posterior

# What the latest movements say.

ACTED_ON = (
    *("stuck", "steady_state_error", "encoder_bias", "encoder_scale"),
    *("drift", "torque_loss", "intermittent"),
)
"""Modes that are told from settled positions and answered; of the others feedback, waiting and
sending again are the whole answer, whatever they are called."""

SUSPICIOUS = 0.3
"""Probability of a fault from which it is looked at more closely."""
RULED_OUT_NATS = 12.0
"""What lies so far below the best is not looked at more closely [nats]."""


def shown_faults(model: HealthyModel, modes: Iterable[str]) -> tuple[Hypothesis, ...]:
    """Return healthy and single faults of some modes, without those that cannot show at rest.

    A motor that does not give way under load shows no loss of torque there.
    """
    gives = dict(zip(model.motor_names, model.settling.compliance, strict=True))
    return tuple(
        hypothesis
        for hypothesis in single_faults(model.motor_names, modes)
        if all(gives[f.motor] or not MODES[f.mode].needs_compliance for f in hypothesis.faults)
    )


@dataclass(frozen=True)
class Judgement:
    """Posterior of all hypotheses on one arm over its latest movements."""

    posterior: Posterior

    def probability(self, hypothesis: Hypothesis) -> float:
        """Return the probability of a hypothesis; 0 of one that was not weighed."""
        if hypothesis not in self.posterior.hypotheses:
            return 0.0
        at = self.posterior.hypotheses.index(hypothesis)
        return float(np.exp(self.posterior.log_posterior[0, at]))

    @property
    def best(self) -> Hypothesis:
        """The most probable hypothesis."""
        return self.posterior.hypotheses[int(np.argmax(self.posterior.log_posterior[0]))]

    @property
    def until_told_apart(self) -> tuple[Hypothesis, float]:
        """The most probable constant error, and how probable an error of its motor is.

        Whether an error is constant or drawn anew takes several movements to tell, which motor it
        is of takes far fewer. Were it drawn anew, inverting it would do no worse than feedback.
        """
        single = [h for h in self.posterior.hypotheses if h.known and len(h.faults) == 1]
        modes = {h: MODES[h.faults[0].mode] for h in single}
        constant = [h for h in single if modes[h].reaction is Reaction.INVERT]
        best = max(constant, key=self.probability, default=HEALTHY)
        drawn_anew = [h for h in single if modes[h].signature is Signature.REDRAWN_OFFSET]
        motors = {fault.motor for fault in best.faults}
        twins = [h for h in (*constant, *drawn_anew) if h.faults[0].motor in motors]
        return best, sum(map(self.probability, twins))

    def diagnosis(self, begin_s: float = 0.0) -> Diagnosis:
        """Return the diagnosis of the movements, the first of which began at a time [s]."""
        return self.posterior.to_diagnosis(0, "act", LogQuality(), None, StreamPosition(begin_s))

    def log_evidence(self, hypothesis: Hypothesis) -> float:
        """Return log p(movements | hypothesis)."""
        at = self.posterior.hypotheses.index(hypothesis)
        return float(self.posterior.log_posterior[0, at] - self.posterior.log_prior[at])

    def size(self, hypothesis: Hypothesis) -> tuple[float, float]:
        """Return median and half of the 90 % interval of the size; NaN and 0 where it has none."""
        at = self.posterior.hypotheses.index(hypothesis)
        size = self.posterior.weights[at].estimate(0).size
        if size is None:
            return np.nan, 0.0
        low, middle, high = size.quantiles(LEVELS).tolist()
        return middle, 0.5 * (high - low)

    def onset_s(self, hypothesis: Hypothesis) -> float:
        """Return when a fault most probably began, since the first of the movements began [s]."""
        at = self.posterior.hypotheses.index(hypothesis)
        onset = self.posterior.weights[at].estimate(0).onset
        return 0.0 if onset is None else float(onset.quantiles((0.5,))[0])


@dataclass(frozen=True)
class Judge:
    """Weighs hypotheses by the latest movements of an arm.

    Attributes:
        model: The healthy robot.
        hypotheses: What may be the case.
    """

    model: HealthyModel
    hypotheses: Sequence[Hypothesis] = ()

    def __post_init__(self) -> None:
        if not self.hypotheses:
            object.__setattr__(self, "hypotheses", shown_faults(self.model, ACTED_ON))

    def __call__(self, window: Sequence[Seen], believed: BelievedFault | None) -> Judgement | None:
        """Return what movements say of an arm; None where it has made none.

        Doubts about an arm count as scatter first. Where that points to another fault than the one
        believed, they are integrated out as common to all movements, which takes long.
        """
        if not window:
            return None
        likelihood = RunLikelihood(settled_evidence_of([window]), self.model)
        rough = Judgement(compute_posterior(likelihood, self.hypotheses, MONITORING))
        if not self._is_news(rough, believed):
            return rough
        log_posterior = rough.posterior.log_posterior[0]
        near = log_posterior > log_posterior.max() - RULED_OUT_NATS
        left = [h for h, keep in zip(self.hypotheses, near, strict=True) if keep or h.is_healthy]
        return Judgement(run_posterior(likelihood, left, MONITORING, False))

    def _is_news(self, judgement: Judgement, believed: BelievedFault | None) -> bool:
        """Return whether movements point to a fault that is not believed already."""
        if self.model.imperfections.variation is None:
            return False
        best = judgement.best
        if best.is_healthy or judgement.probability(best) < SUSPICIOUS:
            return False
        return believed is None or best.faults[0].motor != believed.fault.motor


def settled_evidence_of(windows: Sequence[Sequence[Seen]]) -> SettledEvidence:
    """Return movements of several arms, equally many of each, as settled evidence."""

    def of_each(name: str) -> FloatArray:
        return np.array([[getattr(seen, name) for seen in window] for window in windows])

    usable = np.array([[seen.point is not None for seen in window] for window in windows])
    nowhere = np.zeros(3)
    point = np.array(
        [[nowhere if seen.point is None else seen.point for seen in w] for w in windows]
    )
    start, rest = of_each("start_s"), of_each("rest_s")
    zero = start[:, :1]
    movements = Movements(
        of_each("previous")[:, 0], of_each("command"), of_each("duration"), start - zero
    )
    return SettledEvidence(
        movements=movements,
        point=point,
        usable=usable,
        moving=np.zeros_like(usable),
        begin=rest - zero,
        end=rest - zero,
        first_reading_delay=np.full(start.shape, np.nan),
        arrived=np.full(movements.target.shape, np.nan),
        too_seldom=np.zeros(len(usable), dtype=bool),
    )


# What is believed.

GROWTH = 1.2
"""Growth of the spread of a remembered size with each movement [-]."""
LATCH = 0.9
"""Probability from which a fault is believed."""
UNTIL_TOLD_APART = 0.3
"""A constant error is believed from this probability on if any error of its motor is as probable
as `LATCH`."""
WINDOW = 5
"""Latest movements that are weighed together."""
LEAST_MOVEMENTS = 2
"""Movements that must have been seen before a fault is believed."""
START_LEAD = 4.0
"""Log Bayes factor of a new belief."""
CAP = 8.0
"""Largest log Bayes factor: a repair must show within a few movements."""
LET_GO = -5.0
"""Log Bayes factor below which a belief is dropped."""
LINE_MOVEMENTS = 3
"""Movements that a drift is fitted to at least."""
FAR = 3.0
"""A movement so many deviations off the line counts half; lost commands are such."""
ROUNDS = 5


@dataclass
class Belief:
    """Believes a fault once it is probable, until movements speak against it.

    Attributes:
        model: The healthy robot.
        believed: The fault that the arm is taken to have; None: healthy.
        history: Movements since the last repair that was noticed.
        lead: Log Bayes factor of the belief against healthy, at most `CAP`.
        latch: Probability from which a fault is believed.
    """

    model: HealthyModel
    believed: BelievedFault | None = None
    history: list[Seen] = field(default_factory=list)
    lead: float = START_LEAD
    latch: float = LATCH

    @property
    def window(self) -> Sequence[Seen]:
        """The latest movements that were seen at rest."""
        return self.history[-WINDOW:]

    @property
    def since_s(self) -> float:
        """When the first of them began [s]."""
        return self.window[0].start_s if self.history else 0.0

    @property
    def confirmed(self) -> bool:
        """Whether movements have confirmed it as far as they can."""
        return self.lead >= CAP

    def add(self, seen: Seen) -> None:
        """Remember a movement, before it is weighed."""
        self.history.append(seen)
        del self.history[: -2 * WINDOW]

    def take(self, seen: Seen, judgement: Judgement | None) -> str:
        """Learn from a movement that was added; return in words what changed."""
        if judgement is None or seen.point is None:
            return ""
        if self.believed is not None:
            if not self.believed.rests:
                self._follow_size(judgement)
            said = self._doubt(seen) or self._replaced(judgement)
            if self.believed is not None and self.believed.rests:
                self._follow_size(judgement)  # a held angle must not follow a motor that moves
            return said
        return self._taken_up(judgement)

    def stands_at(self, angle: float, spread: float) -> None:
        """Learn where the faulty motor rests [rad]; a NaN: it moves."""
        if self.believed is not None:
            self.believed = replace(self.believed, angle=angle, spread=spread)

    # Taking up.

    def _taken_up(self, judgement: Judgement) -> str:
        best, sure = judgement.best, judgement.probability(judgement.best)
        if sure < self.latch:
            best, sure = judgement.until_told_apart
            if judgement.probability(best) < UNTIL_TOLD_APART:
                return ""
        enough = sum(seen.point is not None for seen in self.window)
        if not (best.known and best.faults and sure >= self.latch and enough >= LEAST_MOVEMENTS):
            return ""
        self._believe(best, judgement)
        said = f"taken for {best}, {judgement.probability(best):.0%} sure"
        if judgement.probability(best) < self.latch:
            said += f", {sure:.0%} with what looks alike at first"
        return said

    def _believe(self, hypothesis: Hypothesis, judgement: Judgement) -> None:
        fault = hypothesis.faults[0]
        size, spread = judgement.size(hypothesis)
        held = MODES[fault.mode].reaction is Reaction.LOCK
        self.believed = BelievedFault(
            fault=fault,
            motor=self.model.motor_names.index(fault.motor),
            size=size,
            spread=spread,
            since_s=self.window[0].start_s + judgement.onset_s(hypothesis),
            angle=size if held else np.nan,
            probability=judgement.probability(hypothesis),
        )
        self.lead = START_LEAD

    def _follow_size(self, judgement: Judgement) -> None:
        """Take over what the latest movements say of the size where that is sharper."""
        believed = self.believed
        if believed is None or believed.reaction is Reaction.PARK:
            return
        if believed.mode.signature is Signature.GROWING_OFFSET:
            self.believed = fitted_drift(self.model, believed, self.history)
            return
        hypothesis = Hypothesis((believed.fault,))
        if hypothesis not in judgement.posterior.hypotheses:
            return
        size, spread = judgement.size(hypothesis)
        remembered = GROWTH * max(believed.spread, 1e-6)
        if not np.isfinite(size) or spread > remembered:
            self.believed = replace(believed, spread=min(remembered, max(spread, 1e-6)))
            return
        angle = size if believed.reaction is Reaction.LOCK else believed.angle
        self.believed = replace(believed, size=size, spread=spread, angle=angle)

    # Letting go.

    def _doubt(self, seen: Seen) -> str:
        """Let go of a belief that the arm contradicts; return so in words."""
        arm, healthy = BelievedArm(self.model, self.believed), BelievedArm(self.model)
        gain = arm.log_density(seen) - healthy.log_density(seen)
        self.lead = min(CAP, self.lead + gain)
        if self.lead >= LET_GO:
            return ""
        said = f"let go of {self._name}: the arm does not do what it predicts"
        self._let_go()
        return said

    def _replaced(self, judgement: Judgement) -> str:
        """Give a belief up that another fault explains far better; take that if it is sure."""
        believed, best = self.believed, judgement.best
        if believed is None or not best.known or not best.faults:
            return ""
        other = best.faults[0]
        if other == believed.fault or (other.motor == believed.fault.motor and believed.rests):
            return ""  # a motor that is not told to move is not stuck by that
        ahead = judgement.log_evidence(best) - judgement.log_evidence(HEALTHY)
        if ahead - self._own_lead() < -LET_GO:
            return ""
        said = f"{self._name} given up: {best} explains far better what the arm does"
        self.believed, self.lead = None, START_LEAD
        taken = self._taken_up(judgement)
        return f"{said}; {taken}" if taken else said

    def _own_lead(self) -> float:
        """Return the log Bayes factor of the belief against healthy over the latest movements.

        It may have begun with any of them.
        """
        arm, healthy = BelievedArm(self.model, self.believed), BelievedArm(self.model)
        gains = [arm.log_density(s) - healthy.log_density(s) for s in self.window]
        return float(np.max(np.cumsum([0.0, *gains[::-1]])))

    @property
    def _name(self) -> str:
        return "" if self.believed is None else str(self.believed.fault)

    def _let_go(self) -> None:
        self.believed, self.lead = None, START_LEAD
        del self.history[:-1]


# A drift.


def fitted_drift(
    model: HealthyModel, believed: BelievedFault, history: Sequence[Seen]
) -> BelievedFault:
    """Return a drift with the rate and beginning fitted to the movements since it began."""
    since = [s for s in history if s.point is not None and s.rest_s > believed.since_s]
    if len(since) < LINE_MOVEMENTS:
        return believed
    offset, deviation = np.array([_offset(model, believed.motor, seen) for seen in since]).T
    time = np.array([seen.rest_s for seen in since])
    last = time[-1]
    share, (rate, now), covariance = np.ones_like(time), np.zeros(2), np.eye(2)
    for _ in range(ROUNDS):
        weight = np.sqrt(share) / deviation
        (rate, now), covariance = np.polyfit(time - last, offset, 1, w=weight, cov="unscaled")
        away = (offset - now - rate * (time - last)) / (FAR * deviation)
        share = 1.0 / (1.0 + away**2)
    if now * rate <= 0.0:
        return believed
    grown_s = float(now / rate)
    return replace(
        believed,
        size=float(rate),
        spread=HALF_90 * float(np.sqrt(covariance[1, 1])) / grown_s,
        since_s=float(last - grown_s),
    )


def _offset(model: HealthyModel, motor: int, seen: Seen) -> tuple[float, float]:
    """Return by how much one motor is off, were all others healthy, and its deviation [rad]."""
    arm = BelievedArm(model)
    pose = arm.settle(seen.command, seen.previous, seen.rest_s)
    assert seen.point is not None
    found, variance = 0.0, np.inf
    for _ in range(3):
        turned = pose.copy()
        turned[motor] += found
        error, jacobian, spread = model.residual(seen.point, turned, model.scatter)
        column: FloatArray = jacobian[:, motor]
        pull = spread.solve(column)
        variance = 1.0 / max(float(column @ pull), 1e-12)
        found += variance * float(pull @ error)
    return found, float(np.sqrt(variance))
