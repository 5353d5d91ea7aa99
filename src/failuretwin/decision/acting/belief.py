"""What is believed of the arm that acts: latched, told by evidence that is not forgotten.

A reaction destroys its own evidence: a held motor that is told to stay where it stands says nothing
any more. So a fault that was probable once is believed until movements speak against it,

    lead <- min(cap, lead + log p(e_m | believed) - log p(e_m | healthy)),    let go below -5,

and until another fault explains the latest movements better by as much. What was seen before it was
let go is forgotten then: the arm may have been repaired.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from failuretwin.core.hypothesis import HEALTHY, Hypothesis, single_faults
from failuretwin.core.movements import Movements
from failuretwin.core.types import FloatArray
from failuretwin.decision.acting.believed_arm import BelievedArm, BelievedFault, Seen
from failuretwin.decision.acting.drifting import followed
from failuretwin.failure_behavior.mode import Signature
from failuretwin.failure_behavior.reaction import Reaction
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.evidence import SettledEvidence
from failuretwin.inference.healthy_model import HealthyModel
from failuretwin.inference.posterior import LEVELS, Posterior, compute_posterior
from failuretwin.inference.priors import MONITORING, Priors
from failuretwin.inference.run_likelihood import RunLikelihood
from failuretwin.inference.shared_posterior import shared_posterior

ACTED_ON = (
    *("stuck", "steady_state_error", "encoder_bias", "encoder_scale"),
    *("drift", "torque_loss", "lost_commands"),
)
"""Modes that are told from settled positions and answered; of the others feedback and waiting are
the whole answer, whatever they are called."""

# What the latest movements of some arms say.


@dataclass(frozen=True)
class Judgement:
    """Posterior of one arm over its latest movements.

    Attributes:
        posterior: Of all hypotheses, for several arms.
        row: Which of them.
    """

    posterior: Posterior
    row: int

    def probability(self, hypothesis: Hypothesis) -> float:
        """Return the probability of a hypothesis; 0 of one that was not weighed."""
        if hypothesis not in self.posterior.hypotheses:
            return 0.0
        at = self.posterior.hypotheses.index(hypothesis)
        return float(np.exp(self.posterior.log_posterior[self.row, at]))

    @property
    def best(self) -> Hypothesis:
        """The most probable hypothesis."""
        return self.posterior.hypotheses[int(np.argmax(self.posterior.log_posterior[self.row]))]

    @property
    def constant(self) -> tuple[Hypothesis, float]:
        """The most probable constant error, and how probable an error of its motor is.

        Whether an error is constant or drawn anew takes several movements to tell, which motor it
        is of far fewer.
        """
        shares = {
            hypothesis: self.probability(hypothesis)
            for hypothesis in self.posterior.hypotheses
            if _reaction(hypothesis) in (Reaction.INVERT, Reaction.PARK)
        }
        constant = [each for each in shares if _reaction(each) is Reaction.INVERT]
        best = max(constant, key=shares.__getitem__, default=HEALTHY)
        alike = [
            each for each in shares if best.faults and each.faults[0].motor == best.faults[0].motor
        ]
        return best, sum(shares[each] for each in alike)

    def log_evidence(self, hypothesis: Hypothesis) -> float:
        """Return log p(movements | hypothesis)."""
        at = self.posterior.hypotheses.index(hypothesis)
        joint = self.posterior.log_posterior[self.row, at] - self.posterior.log_prior[at]
        return float(joint)

    def size(self, hypothesis: Hypothesis) -> tuple[float, float]:
        """Return median and half of the 90 % interval of the size; NaN and 0 where it has none."""
        at = self.posterior.hypotheses.index(hypothesis)
        size = self.posterior.weights[at].estimate(self.row).size
        if size is None:
            return np.nan, 0.0
        low, middle, high = size.quantiles(LEVELS).tolist()
        return middle, 0.5 * (high - low)

    def onset_s(self, hypothesis: Hypothesis) -> float:
        """Return when a fault most probably began, since the first of the movements began [s]."""
        at = self.posterior.hypotheses.index(hypothesis)
        onset = self.posterior.weights[at].estimate(self.row).onset
        return 0.0 if onset is None else float(onset.quantiles((0.5,))[0])


def _reaction(hypothesis: Hypothesis) -> Reaction | None:
    """Return what is done about one fault; None: healthy, unknown, or several faults."""
    if not hypothesis.known or len(hypothesis.faults) != 1:
        return None
    return MODES[hypothesis.faults[0].mode].reaction


@dataclass(frozen=True)
class Judge:
    """Weighs hypotheses by the latest movements of arms.

    Attributes:
        model: The healthy robot.
        priors: Beliefs about faults.
        hypotheses: What may be the case.
    """

    model: HealthyModel
    priors: Priors = MONITORING
    hypotheses: Sequence[Hypothesis] = ()

    def __post_init__(self) -> None:
        if not self.hypotheses:
            names = self.model.twin.robot.motor_names
            object.__setattr__(self, "hypotheses", single_faults(names, ACTED_ON))

    def __call__(
        self, windows: Sequence[Sequence[Seen]], believed: Sequence[BelievedFault | None]
    ) -> list[Judgement | None]:
        """Return what movements say of each arm; None where it has made none.

        Doubts about an arm count as scatter first. Where that points to another fault than the one
        believed, they are integrated out as common to all movements, which takes long.

        Args:
            windows: Movements of each arm.
            believed: What each arm is taken to have.
        """
        found: list[Judgement | None] = [None] * len(windows)
        for length in {len(window) for window in windows} - {0}:
            rows = [i for i, window in enumerate(windows) if len(window) == length]
            evidence = settled_evidence_of([windows[i] for i in rows])
            likelihood = RunLikelihood(evidence, self.model)
            rough = compute_posterior(likelihood, self.hypotheses, self.priors)
            judged = [Judgement(rough, at) for at in range(len(rows))]
            news = [at for at, i in enumerate(rows) if self._is_news(judged[at], believed[i])]
            if news:
                some = likelihood[np.array(news)]
                fine = shared_posterior(some, _left(rough, news), self.priors, False)
                for at, row in enumerate(news):
                    judged[row] = Judgement(fine, at)
            for at, i in enumerate(rows):
                found[i] = judged[at]
        return found

    def _is_news(self, judgement: Judgement, believed: BelievedFault | None) -> bool:
        """Return whether movements point to a fault that is not believed already."""
        if self.model.imperfections.variation is None:
            return False
        best = judgement.best
        if best.is_healthy or judgement.probability(best) < SUSPICIOUS:
            return False
        return believed is None or best.faults[0].motor != believed.fault.motor


SUSPICIOUS = 0.3
"""Probability of a fault from which it is looked at more closely."""
RULED_OUT_NATS = 12.0
"""What lies so far below the best of some arms is not looked at more closely [nats]."""


def _left(posterior: Posterior, rows: Sequence[int]) -> list[Hypothesis]:
    """Return healthy and the hypotheses that are not ruled out for some arms."""
    log_posterior = posterior.log_posterior[np.array(rows)]
    near = log_posterior > log_posterior.max(axis=1, keepdims=True) - RULED_OUT_NATS
    kept = near.any(axis=0)
    return [h for h, keep in zip(posterior.hypotheses, kept, strict=True) if keep or h.is_healthy]


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
    )


# What an arm is taken to be.

GROWTH = 1.2
"""The spread of a size that is remembered grows by this factor with each movement [-]."""


@dataclass(frozen=True)
class BeliefSettings:
    """When a fault is taken up and when it is let go of.

    Attributes:
        latch: Probability from which a fault is believed.
        constant: A constant error is believed from this probability on if an error of its motor is
            as probable as `latch`: were it drawn anew, feedback would do no better.
        movements: Latest movements that are weighed together.
        least_movements: No fault is believed after fewer.
        start_lead: Log Bayes factor with which a belief begins.
        cap: Highest lead: a repair must show within a few movements.
        let_go: Lead below which a belief is let go.
    """

    latch: float = 0.95
    constant: float = 0.3
    movements: int = 5
    least_movements: int = 2
    start_lead: float = 4.0
    cap: float = 8.0
    let_go: float = -5.0


class Belief(Protocol):
    """Says what the arm is taken to be."""

    @property
    def believed(self) -> BelievedFault | None:
        """The fault that it is taken to have; None: none."""
        ...

    @property
    def window(self) -> Sequence[Seen]:
        """Movements that are to be weighed; empty: none need be."""
        ...

    @property
    def confirmed(self) -> bool:
        """Whether movements have confirmed it as far as they can."""
        ...

    def add(self, seen: Seen) -> None:
        """Remember a movement, before it is weighed."""
        ...

    def take(self, seen: Seen, judgement: Judgement | None) -> str:
        """Learn from a movement that was added; return in words what changed, or nothing."""
        ...

    def stands_at(self, angle: float, spread: float) -> None:
        """Learn where the faulty motor rests [rad]; a NaN: it moves."""
        ...


@dataclass
class NoBelief:
    """Takes the arm for healthy, whatever happens."""

    believed: BelievedFault | None = None
    window: Sequence[Seen] = ()
    confirmed: bool = False

    def add(self, seen: Seen) -> None:
        """Remember nothing."""

    def take(self, seen: Seen, judgement: Judgement | None) -> str:
        """Learn nothing."""
        return ""

    def stands_at(self, angle: float, spread: float) -> None:
        """Learn nothing."""


@dataclass
class LatchedBelief:
    """Believes a fault once it is probable, until movements speak against it.

    Attributes:
        model: The healthy robot.
        settings: When it takes up and lets go.
        believed: The fault that the arm is taken to have.
        history: Movements since the last repair that was noticed.
        lead: Log Bayes factor of the belief against healthy, capped.
    """

    model: HealthyModel
    settings: BeliefSettings = BeliefSettings()
    believed: BelievedFault | None = None
    history: list[Seen] = field(default_factory=list)
    lead: float = 0.0

    def __post_init__(self) -> None:
        self.lead = self.settings.start_lead

    @property
    def window(self) -> Sequence[Seen]:
        """The latest movements that were seen at rest."""
        return self.history[-self.settings.movements :]

    @property
    def confirmed(self) -> bool:
        """Whether movements have confirmed it as far as they can."""
        return self.lead >= self.settings.cap

    def add(self, seen: Seen) -> None:
        """Remember a movement, before it is weighed."""
        self.history.append(seen)
        del self.history[: -2 * self.settings.movements]

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
        if sure < self.settings.latch:
            best, sure = judgement.constant
            if judgement.probability(best) < self.settings.constant:
                return ""
        enough = sum(seen.point is not None for seen in self.window)
        if not (
            best.known
            and best.faults
            and sure >= self.settings.latch
            and enough >= self.settings.least_movements
        ):
            return ""
        self._believe(best, judgement)
        said = f"taken for {best}, {judgement.probability(best):.0%} sure"
        if judgement.probability(best) < self.settings.latch:
            said += f", {sure:.0%} that it is this motor; what it is off by is taken off"
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
        self.lead = self.settings.start_lead

    def _follow_size(self, judgement: Judgement) -> None:
        """Take over what the latest movements say of the size where that is sharper."""
        believed = self.believed
        if believed is None or believed.reaction is Reaction.PARK:
            return
        if believed.mode.signature is Signature.GROWING_OFFSET:
            self.believed = followed(self.model, believed, self.history)
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
        self.lead = min(self.settings.cap, self.lead + gain)
        if self.lead >= self.settings.let_go:
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
        if ahead - self._own_lead() < -self.settings.let_go:
            return ""
        said = f"{self._name} given up: {best} explains far better what the arm does"
        self.believed, self.lead = None, self.settings.start_lead
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
        self.believed, self.lead = None, self.settings.start_lead
        del self.history[:-1]
