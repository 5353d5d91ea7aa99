"""What the latest movements of arms say of them: the posterior that a belief is taken from.

Section: docs/acting.md#how-it-works
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.core.hypothesis import HEALTHY, Hypothesis, single_faults
from failuretwin.core.movements import Movements
from failuretwin.core.types import FloatArray
from failuretwin.decision.acting.believed_arm import BelievedFault, Seen
from failuretwin.failure_behavior.mode import Reaction, Signature
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.faults.priors import MONITORING, Priors
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.evidence import SettledEvidence
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.posterior import LEVELS, Posterior, compute_posterior
from failuretwin.inference.theta.shared_posterior import shared_posterior

ACTED_ON = (
    *("stuck", "steady_state_error", "encoder_bias", "encoder_scale"),
    *("drift", "torque_loss", "intermittent"),
)
"""Modes that are told from settled positions and answered; of the others feedback, waiting and
sending again are the whole answer, whatever they are called."""


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
            object.__setattr__(self, "hypotheses", shown_faults(self.model, ACTED_ON))

    def __call__(
        self, windows: Sequence[Sequence[Seen]], believed: Sequence[BelievedFault | None]
    ) -> list[Judgement | None]:
        """Return what movements say of each arm; None where it has made none.

        Doubts about an arm count as scatter first. Where that points to another fault than the one
        believed, they are integrated out as common to all movements, which takes long.
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
        arrived=np.full(movements.target.shape, np.nan),
    )
