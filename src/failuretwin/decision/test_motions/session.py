"""A health check or a design of one robot: what it needs, the movements made, and its result."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from failuretwin.connection.links.base import Commander, Order
from failuretwin.core.hypothesis import Hypothesis, paper_hypotheses
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.decision.acting.believed_arm import Seen
from failuretwin.decision.acting.judging import settled_evidence_of
from failuretwin.decision.acting.safety import SafetyGate, SafetyLimits
from failuretwin.decision.acting.work import OrderSequence, Work, first_standing
from failuretwin.decision.test_motions.design import Designer, next_movement
from failuretwin.decision.test_motions.health_check import (
    GREEN,
    OPEN,
    CheckResult,
    checking,
    faults_at_rest,
    judged,
    result_of,
)
from failuretwin.decision.test_motions.motions import Motions, holds_motions, read_motions
from failuretwin.decision.test_motions.outlook import Outlook, of_priors
from failuretwin.digital_model.calibrated_robot import (
    CalibratedRobot,
    HealthyLike,
    RobotLike,
    calibrated,
)
from failuretwin.inference.diagnoser import BayesDiagnoser
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.isolability import IsolabilityReport, isolability
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.evidence import Evidence
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.log_quality import LogQuality
from failuretwin.inference.posterior import Posterior

MOST_RUNS = 3
"""Runs of a log whose motions are examined, evenly spread."""
RANDOM_S = 20.0
"""Length of random motions where no others are given [s]."""


@dataclass(frozen=True)
class Checking:
    """What a check and a design need.

    Attributes:
        known: The robot as it is known.
        gate: What is safe.
        named: Hypotheses that the user names; None: all faults that show at rest.
        usual: Whether poses keep to the ranges of usual movements.
        seed: Seed of the poses that are tried.
        rest_s: Time that is left for coming to rest after each movement at least [s].
    """

    known: CalibratedRobot
    gate: SafetyGate
    named: Sequence[Hypothesis] | None = None
    usual: bool = False
    seed: int = 0
    rest_s: float = 0.0

    @cached_property
    def model(self) -> HealthyModel:
        """The healthy robot."""
        return HealthyModel.of(self.known.twin, self.known.imperfections)

    @cached_property
    def hypotheses(self) -> Sequence[Hypothesis]:
        """What is weighed."""
        return self.named or faults_at_rest(self.model)

    @cached_property
    def priors(self) -> Priors:
        """Beliefs about what is weighed."""
        return checking(self.model, self.hypotheses)

    @property
    def asked(self) -> Sequence[Hypothesis]:
        """What movements are chosen to tell apart."""
        return self.named or paper_hypotheses(self.model.motor_names)

    @property
    def home(self) -> FloatArray:
        """Where an arm is taken to stand that is not asked, (motor,) [rad]."""
        return self.known.robot.resting_pose

    @property
    def designer(self) -> Designer:
        """What chooses movements."""
        members = of_priors(self.model, self.asked, checking(self.model, self.asked))
        outlook = Outlook(self.model, members)
        return Designer(self.gate, outlook, self.seed, self.usual, self.rest_s)

    def motions(self, seconds: float, repeat: Path | None = None, most: int = 1000) -> Motions:
        """Return the motions of a check: those of a file, or designed anew.

        Args:
            seconds: Time for all of them [s].
            repeat: The file; None: they are designed.
            most: So many at most.

        Raises:
            InputError: If the file cannot be read or is of another robot, or no movement is safe.
        """
        if repeat is not None:
            return read_motions(repeat, self.known.robot)
        made = self.designer.sequence(self.home, seconds, most)
        return Motions.of(self.known.robot, made)

    def health_check(self, motions: Motions, further: int) -> HealthCheck:
        """Return a check that has not begun."""
        return HealthCheck(self, motions, further)

    def isolability(self, command: FloatArray, time: FloatArray) -> IsolabilityReport:
        """Return what motions can tell apart, by the priors of a check.

        Args:
            command: References, (sample, motor) or (run, sample, motor) [rad].
            time: Their times, (sample,) [s].
        """
        known, priors = self.known, checking(self.model, self.asked)
        return isolability(known.twin, command, time, known.imperfections, self.asked, priors)

    def isolability_of(self, motions: Motions) -> IsolabilityReport:
        """Return the isolability of designed motions."""
        time, command = motions.reference()
        return self.isolability(command, time)

    def random_motions(self, seconds: float = RANDOM_S, most: int = 1000) -> Motions:
        """Return random movements within the usual ranges, at most `seconds` long [s]."""
        designer = replace(self, usual=True).designer
        return Motions.of(self.known.robot, designer.random(self.home, seconds, most))

    def isolability_in(self, path: Path) -> IsolabilityReport:
        """Return the isolability of motions in a file: designed ones, or those of a log.

        Raises:
            InputError: If it cannot be read, or holds no movement.
        """
        from failuretwin.data_knowledge.readers.read import read_runs

        if holds_motions(path, self.known.robot):
            return self.isolability_of(read_motions(path, self.known.robot))
        runs = read_runs(path, self.known.robot)
        subset = np.unique(np.linspace(0, runs.sizes["run"] - 1, MOST_RUNS).astype(np.int64))
        command = as_floats(runs["command"].values)[subset]
        return self.isolability(command, as_floats(runs["time"].values))

    def shown(self, result: CheckResult, command: FloatArray, time: FloatArray) -> CheckResult:
        """Return a result with what its movements can show, where it says that all is well.

        Args:
            result: The result.
            command: References of its movements, (run, sample, motor) [rad].
            time: Their times, (sample,) [s].
        """
        if result.light != GREEN:
            return result
        return replace(result, shown=self.isolability(command, time))

    def of_logs(self, paths: Sequence[Path]) -> list[CheckResult]:
        """Return what logs of a check say that was made elsewhere, a result a run.

        Raises:
            InputError: If they cannot be read.
        """
        from failuretwin.data_knowledge.readers.read import read_runs

        runs = read_runs(list(paths), self.known.robot)
        known, hypotheses, priors = self.known, self.hypotheses, self.priors
        diagnoser = BayesDiagnoser(known.twin, known.imperfections, hypotheses, priors)
        settled = Evidence(runs, self.model.settings).sound.settled
        command, time = as_floats(runs["command"].values), as_floats(runs["time"].values)
        found = [
            result_of(
                RunLikelihood(settled[row : row + 1], self.model), hypotheses, priors, diagnosis
            )
            for row, diagnosis in enumerate(diagnoser.diagnose(runs))
        ]
        return [self.shown(each, command[row : row + 1], time) for row, each in enumerate(found)]


@dataclass
class HealthCheck:
    """Makes planned movements on an arm, then further ones while the result is open.

    Attributes:
        asking: The robot, what is safe and what is weighed.
        motions: Planned movements.
        further: Maximum number of further movements.
        window: Movements as they were seen.
    """

    asking: Checking
    motions: Motions
    further: int = 0
    window: list[Seen] = field(default_factory=list)
    _added: int = field(default=0, init=False)

    def work(self, commander: Commander, tell: Callable[[str], None]) -> CheckResult:
        """Carry the check out on an arm and return the result."""
        standing = first_standing(commander)
        said: list[str] = []
        orders = self._orders(standing, said)
        sequence = OrderSequence(self.asking.model, standing, orders, said, self.window)
        Work(sequence, self.asking.gate, commander, standing, tell).carry_out()
        return self.result

    def _orders(self, standing: FloatArray, said: list[str]) -> Iterator[Order]:
        """Yield the way to the start, the planned movements and the further ones."""
        asking, travel = self.asking, self.motions.start - standing
        if np.abs(travel).max() > 1e-6:
            ramp = np.full(len(standing), asking.gate.least_duration(travel))
            yield Order(self.motions.start, ramp)
        yield from self.motions.orders
        for number in range(1, self.further + 1):
            if self.result.light != OPEN:
                return
            at = self.window[-1].command
            order = next_movement(asking.model, asking.gate, self.posterior, at, asking.seed)
            if order is None:
                return
            self._added = number
            said.append(f"still open: further movement {number}")
            yield order

    @property
    def likelihood(self) -> RunLikelihood:
        """Likelihood of all movements."""
        return RunLikelihood(settled_evidence_of([self.window]), self.asking.model)

    @property
    def posterior(self) -> Posterior:
        """Posterior of all hypotheses given all movements."""
        return judged(self.likelihood, self.asking.hypotheses, self.asking.priors)

    @property
    def result(self) -> CheckResult:
        """Result of the check."""
        diagnosis = self.posterior.to_diagnosis(0, "check", LogQuality())
        asking = self.asking
        return result_of(self.likelihood, asking.hypotheses, asking.priors, diagnosis, self._added)


def check(
    commander: Commander,
    robot: RobotLike = "armpi_fpv",
    calibration: HealthyLike = None,
    seconds: float = 20.0,
    further: int = 0,
    limits: SafetyLimits | None = None,
    tell: Callable[[str], None] = print,
) -> CheckResult:
    """Check an arm by test movements; the arm moves.

    Args:
        commander: The arm.
        robot: The robot, its name or its profile.
        calibration: What `calibrate` learned of it, by name or path; None: what its profile names.
        seconds: Time for the movements [s].
        further: So many further movements at most, if it is still open then what is wrong.
        limits: What orders must keep to; None: the usual limits.
        tell: Called with what happens.

    Returns:
        What was found.

    Raises:
        InputError: If something cannot be read, no movement is safe, or it is not known where the
            arm stands.
        Halted: If somebody else commands the arm, or it falls silent.
        UnsafeOrderError: If an order must not be sent.
    """
    known = calibrated(robot, calibration)
    asking = Checking(known, SafetyGate(known.robot, limits or SafetyLimits()))
    return asking.health_check(asking.motions(seconds), further).work(commander, tell)
