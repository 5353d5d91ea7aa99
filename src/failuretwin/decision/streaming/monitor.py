"""Watching one robot at work: what is the case by all movements so far, and when to call somebody.

The last movements are seen and estimated as by `StreamingDiagnoser`; what is believed of the
faults comes from all movements so far (`FaultFilter`), by the calibration that is given and by what
the robot itself teaches (`HealthyMixture`, `LifeLearner`); the alarm comes from `AlarmRule`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from failuretwin.connection.links.base import OK, STALE, Answer
from failuretwin.core.hypothesis import CLEAR, Diagnosis, Hypothesis
from failuretwin.core.numerics import Weighted, log_of
from failuretwin.core.types import FloatArray
from failuretwin.decision.streaming.alarm_rule import AlarmRule
from failuretwin.decision.streaming.diagnoser import RobotStream
from failuretwin.decision.streaming.fleet import StreamingFleet
from failuretwin.decision.streaming.learning import LifeLearner, LifeMemory
from failuretwin.decision.streaming.set_up_watch import PROOF, SetUpWatch
from failuretwin.decision.streaming.trouble import DEAD, rests_throughout
from failuretwin.decision.streaming.way_watch import WINDOW_S, WayWatch
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.calibrated_robot import HealthyLike, RobotLike
from failuretwin.inference.diagnoser import BayesDiagnoser
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.misfit import FITS, misfit
from failuretwin.inference.movements.healthy_density import healthy_log_density
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.evidence import SettledEvidence
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.rounding import rounded, told_of
from failuretwin.inference.posterior import StreamPosition
from failuretwin.inference.together.fault_filter import FaultEvidence, FaultFilter
from failuretwin.inference.together.healthy_mixture import FOREIGN, HealthyMixture
from failuretwin.inference.together.life_filter import LifeFilter

WORTH_LEARNING = 0.01
"""Probability that the calibration that was given is not this robot's from which it learns."""

FIRST = np.array([0])
"""The only robot of its stream."""
NOTHING_SEEN = (
    "the arm has not been seen at rest after a movement yet, nor on its way for long enough"
)
"""Why there is no verdict before anything was judged."""
UNHEARD = 3
"""Commands in a row of which a motor reports that they did not arrive, from which it is told."""
BEGINS_ODDLY = (
    "the first movements do not end where those of a healthy arm do: a fault, lost commands, or a "
    "log that does not fit the profile; a few movements more tell"
)
"""Why the first movements allow no verdict where they do not fit."""


@dataclass(frozen=True)
class Fit:
    """Whose healthy behaviour the robot has, so far.

    Attributes:
        given: Name of the calibration that was given; empty: none of this robot.
        fits: Probability that it is this robot's; 0 without one.
        learned: Movements that this robot itself has taught.
        seen: Movements that have begun.
        moments: Moments on its way, where it hardly rests, that it has taught.
    """

    given: str
    fits: float
    learned: int
    seen: int = 0
    moments: int = 0


@dataclass(frozen=True)
class Believed:
    """What a watch makes of its robot by all movements so far.

    Attributes:
        model: The healthy robot that explains it best.
        hypotheses: What may be the case; the first is healthy.
        probability: Of each hypothesis, (hypothesis,).
        sizes: What is believed of the size of each fault; None of healthy.
    """

    model: HealthyModel
    hypotheses: Sequence[Hypothesis]
    probability: FloatArray
    sizes: Sequence[Weighted | None]


class FaultMonitor(RobotStream):
    """Watches one robot: its faults, its set-up and how it differs from its calibration.

    What is learned is kept from watch to watch by `memory`; None: it is not kept.
    """

    def __init__(
        self,
        diagnoser: BayesDiagnoser,
        false_alarms_per_100h: float = 1.0,
        memory: LifeMemory | None = None,
    ) -> None:
        super().__init__(StreamingFleet(diagnoser, 1))
        known = diagnoser.healthy_model
        ideal, cold = known.imperfections.settling is None, known.imperfections.of_class
        learns = known.sensors.tool_alone and not ideal
        self._learner = LifeLearner(diagnoser, memory) if learns else None
        self._follower = LifeLearner(diagnoser, cold=False) if learns and not cold else None
        self._models: list[HealthyModel] = [] if cold and learns else [known]
        if self._learner is not None:
            self._models.append(self._learner.model)
        else:
            self._models = candidates(known)
        self._mixture = mixture_of(self._models, diagnoser)
        self._given = "" if cold else known.imperfections.name
        rate = self._mixture.filters[0].faults_per_h
        self._rule = AlarmRule(self._fleet.hypotheses, rate, false_alarms_per_100h)
        self._concluded = self._present = self._mixture.begin(1)
        self._movements = 0
        self._explained: dict[int, float] = {}
        self._decided: Diagnosis | None = None
        self._set_up = SetUpWatch(diagnoser)
        self._way = WayWatch(diagnoser, self._mixture.filters[0]) if learns else None
        self._arrived = np.full((0, len(known.scatter)), np.nan)
        self._rests, self._misfit = False, 0.0
        self._rested_s: float | None = None
        self._began_s = np.inf
        if len(self._models) == 1 and self._learner is not None and self._learner.movements:
            self._adopt(-1)

    @property
    def set_up(self) -> str | None:
        """What is to be said of the set-up; empty: the log fits the profile; None: not looked."""
        return self._set_up.finding if self._set_up.looked else None

    @property
    def rounding(self) -> tuple[str, ...]:
        """What is to be said of how coarsely readings are written down, a line each."""
        return tuple(told_of(self._fleet.rounding, None, 0.0))

    @property
    def fit(self) -> Fit:
        """Whose healthy behaviour the robot has, so far."""
        fits = float(np.exp(self._concluded.log_weight[0, 0])) if self._given else 0.0
        learned = 0 if self._learner is None else self._learner.movements
        moments = 0 if self._way is None else self._way.taught
        return Fit(self._given, fits, learned, self._set_up.movements, moments)

    @property
    def life(self) -> LifeFilter | None:
        """What the robot itself has taught, to go on from; None: it is not learned."""
        return None if self._learner is None else self._learner.life

    @property
    def believed(self) -> Believed:
        """What is believed, the present movement as it looks now included."""
        best = int(np.argmax(self._present.log_weight[0]))
        own, belief = self._mixture.filters[best], self._present.beliefs[best]
        sizes = [own.size(belief, at) for at in range(len(own.hypotheses))]
        probability = self._mixture.posterior(self._present)[0]
        return Believed(self._models[best], own.hypotheses, probability, sizes)

    def _answer(self) -> Answer:
        """Return what is believed; where something is in doubt, no motor is blamed."""
        state, reason = STALE if self._fleet.stale[0] else OK, self._in_doubt()
        if not reason:
            return Answer(self._fleet.time, state, self._diagnosis, self._rule.alarm)
        undecided = replace(self._fleet.undecided(0, reason, self._diagnosis), run="stream")
        return Answer(self._fleet.time, state, undecided)

    def _in_doubt(self) -> str:
        """Return why nothing can be said of the motors, though one hypothesis is far ahead.

        Faults are so rare that of an arm that nobody has seen at work yet a healthy one is far
        ahead, whatever its first movements do.
        """
        if self._rests:
            return DEAD.fatal
        alarm, way = self._rule.alarm, self._way
        if way is not None and way.fits and self._diagnosis is way.diagnosis:
            return self._unheard(alarm.cause)
        young = self._set_up.movements <= PROOF and alarm.state == CLEAR
        odd = BEGINS_ODDLY if young and self._misfit > FITS else ""
        known = self._set_up.against(alarm) or odd or self._unheard(alarm.cause)
        return known or (NOTHING_SEEN if self._saw_nothing else "")

    @property
    def _saw_nothing(self) -> bool:
        """Whether movements went by of which none was judged."""
        judged = self._way is not None and self._way.diagnosis is not None
        late = self._movements > 0 and self._fleet.time - self._began_s > 2.0 * WINDOW_S
        return late and self._rested_s is None and not judged

    def _watch(self, time: float, reference: FloatArray | None, point: FloatArray | None) -> None:
        """Look at the set-up, count as noise what is rounded off, and judge what never rests."""
        self._set_up.see(time, reference, point)
        found = self._set_up.rounding
        if self._fleet.rounding is None and found is not None:
            self._fleet.count_as_noise(found)
            self._models = [rounded(model, found, None) for model in self._models]
        self._began_s, way = min(self._began_s, time), self._way
        if way is not None:
            self._count(way, way.see(time, reference, point, self._rested_s))

    def _conclude_watch(self) -> None:
        """Judge the last part of a way, if it is long enough."""
        if self._way is not None:
            self._count(self._way, self._way.conclude(self._rested_s))

    def _count(self, way: WayWatch, hours: float) -> None:
        """Count a window on the way of so many hours; 0: none was judged."""
        if hours > 0.0:
            self._rule.see(self._fleet.time, way.posterior, hours)
            self._diagnosis = way.diagnosis

    def _unheard(self, cause: str) -> str:
        """Return that commands do not reach the motor that a fault is blamed on; else nothing."""
        names, motor = self._fleet.diagnoser.twin.robot.motor_names, cause.partition(":")[0]
        if motor not in names:
            return ""
        arrived = self._arrived[:, names.index(motor)]
        last = arrived[np.isfinite(arrived)][-UNHEARD:]
        if len(last) < UNHEARD or last.any():
            return ""
        name = motor.replace("_", " ")
        return f"{name} reports that its commands do not arrive: what it does is not known"

    def _judge(self) -> None:
        """Renew what is believed by what the last movements say."""
        seen, told = self._fleet.seen(0), None
        if seen is not None and seen[0].usable.any():
            self._rested_s = self._fleet.time
        on_way = self._way is not None and self._way.diagnosis is not None
        if seen is not None and on_way and not seen[0].usable.any():
            return  # no movement was seen at rest
        if seen is not None:
            likelihood, position = seen
            posterior, before = self._followed(likelihood, position), position.movements
            window = range(before, before + likelihood.usable.shape[1])
            explained = np.array([self._explained.get(m, np.inf) for m in window])
            told = log_of(posterior), explained
            self._rests = rests_throughout(likelihood.evidence, likelihood.model.settings)
            self._misfit = misfit(likelihood, explained)
        found = self._fleet.diagnosis(0, self._decided, told)
        if found is None:
            return
        self._diagnosis = replace(found, run="stream")
        if not found.undecided:
            self._decided = self._diagnosis

    def _followed(self, likelihood: RunLikelihood, position: StreamPosition) -> FloatArray:
        """Return the probability of each hypothesis, (hypothesis,).

        Movements that are over are counted once and for all, then learned from; the present one
        as it looks now.
        """
        count, before = likelihood.usable.shape[1], position.movements
        self._arrived = likelihood.evidence.arrived[0]
        new = max(self._movements - before, 0)
        says = [
            evidence_since(one, self._fleet.weigh(FIRST, model), new)
            for one, model in zip(self._mixture.filters, self._models, strict=True)
        ]
        belief, hours = self._concluded, 0.0
        self._explained = {m: v for m, v in self._explained.items() if m >= before}
        for movement in range(new, count):
            belief = self._mixture.advance(belief, says, movement - new)
            self._explained[before + movement] = float(belief.explained[0])
            if movement < count - 1:
                hours += float(says[0].hours[0, movement - new])
                self._concluded, self._movements = belief, before + movement + 1
        self._present = belief
        posterior = self._mixture.posterior(belief)[0]
        self._rule.see(self._fleet.time, posterior, hours)
        for movement in range(new, count - 1):
            self._learn(likelihood.evidence, movement, position.begin_s)
        return posterior

    def _learn(self, evidence: SettledEvidence, movement: int, begin_s: float) -> None:
        """Learn from a movement that is over; what is known better counts from the next on.

        The robot of the calibration is followed as long as it may be this one, as its zeros drift
        and it wears; another robot is learned once it may be one. The movements begin at `begin_s`
        by the time of the stream [s].
        """
        share = np.exp(self._concluded.log_weight[0])
        one = evidence[:, movement : movement + 1]
        told = evidence.movements.since(movement)[:, :1]
        told = replace(told, start=told.start + begin_s)
        one = replace(one, movements=told)
        for at, learner in ((0, self._follower), (-1, self._learner)):
            if learner is not None and learner.take(one, learns=share[at] > WORTH_LEARNING):
                self._models[at] = rounded(learner.model, self._fleet.rounding, None)
                if share[at] > 0.5:
                    self._adopt(at)

    def _adopt(self, at: int) -> None:
        """Estimate by one of the models, which the robot itself has taught."""
        self._fleet.adopt(self._models[at].imperfections)
        self._models[at] = self._fleet.model


def candidates(known: HealthyModel) -> list[HealthyModel]:
    """Return the candidates for the healthy behaviour of a robot that teaches nothing.

    What is known of it, and what arms of its kind are like, where that is something else.
    """
    imperfections = known.imperfections
    if imperfections.of_class or imperfections.settling is None:
        return [known]
    kind = generic_imperfections(known.twin.robot)
    return [known, HealthyModel.of(known.twin, kind).seen_by(known.sensing)]


def mixture_of(models: Sequence[HealthyModel], diagnoser: BayesDiagnoser) -> HealthyMixture:
    """Return the filter of one candidate, or of two of which the second is another robot."""
    hypotheses, priors = diagnoser.hypothesis_set, diagnoser.priors
    filters = [FaultFilter(model, hypotheses, priors) for model in models]
    share = [1.0] if len(filters) == 1 else [1.0 - FOREIGN, FOREIGN]
    return HealthyMixture(filters, np.array(share))


def evidence_since(faults: FaultFilter, likelihood: RunLikelihood, movement: int) -> FaultEvidence:
    """Return what the last movements say of each fault, from one of them on."""
    findings, before = likelihood.findings, min(movement, 1)
    healthy = np.zeros(likelihood.usable.shape)
    healthy[:, movement:] = healthy_log_density(likelihood.evidence, findings, movement)
    told = replace(likelihood, healthy=healthy, remembered=findings)
    return faults.evidence(told.since(movement - before), before)


def monitor(
    twin: RobotLike,
    imperfections: HealthyLike = None,
    false_alarms_per_100h: float = 1.0,
    sensing: str | None = None,
    memory: LifeMemory | None = None,
    priors: Priors | None = None,
) -> FaultMonitor:
    """Return what watches a robot at work: settled poses, and faults are rare.

    Args:
        twin: The robot: its twin, itself, its name or its profile.
        imperfections: How the healthy robot differs from it, or a calibration by name or path;
            None: as its profile says.
        false_alarms_per_100h: False alarms that are allowed in 100 hours of work.
        sensing: ``tool``, with ``+encoders``, ``+goals`` or both; None: the tool's position alone.
        memory: What keeps what is learned of the robot from watch to watch; None: nothing does.
        priors: Beliefs about faults; None: the usual ones.
    """
    diagnoser = BayesDiagnoser(twin, imperfections, priors=priors, whole_run=False, sensing=sensing)
    return FaultMonitor(diagnoser, false_alarms_per_100h, memory)
