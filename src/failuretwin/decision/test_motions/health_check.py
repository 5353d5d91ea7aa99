"""A health check of one robot: the movements made, and what they say of every motor.

    green: P(healthy) >= 0.95;    red: P(motor k), the sum over its modes, >= 0.95;    else open

Section: docs/check.md#result-of-a-check
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from pathlib import Path

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
    paper_hypotheses,
)
from failuretwin.core.progress import Progress, unseen
from failuretwin.core.types import FloatArray, as_floats
from failuretwin.decision.acting.belief import settled_evidence_of, shown_faults
from failuretwin.decision.acting.believed_arm import Seen
from failuretwin.decision.acting.safety import SafetyGate, SafetyLimits
from failuretwin.decision.acting.work import OrderSequence, Work, first_standing
from failuretwin.decision.test_motions.design import Designer, next_movement
from failuretwin.decision.test_motions.motions import Motions, holds_motions, read_motions
from failuretwin.decision.test_motions.outlook import Outlook, of_priors
from failuretwin.digital_model.calibrated_robot import (
    CalibratedRobot,
    HealthyLike,
    RobotLike,
    calibrated,
)
from failuretwin.digital_model.nonidealities import Variation
from failuretwin.failure_behavior.mode import Range, Signature
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.diagnoser import BayesDiagnoser
from failuretwin.inference.engine.posterior import theta_posterior
from failuretwin.inference.engine.registration import robot_weighing, run_posterior, sensor_in_doubt
from failuretwin.inference.engine.runs import has_rows
from failuretwin.inference.faults.prior_odds import log_prior
from failuretwin.inference.faults.priors import Priors, visible_sizes
from failuretwin.inference.isolability import IsolabilityReport, isolability
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.log_quality import BEYOND_USUAL, LogQuality
from failuretwin.inference.observation.settings import ERROR_STEPS, WIDEST_ERROR
from failuretwin.inference.posterior import Posterior

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
    plain = Priors(error_ranges=_error_ranges(model), load_changes=0.0)
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
        movements: Movements that were seen at rest, or moments on the way of a run without rests.
        on_the_way: Whether these are moments on the way.
        further: How many of the movements made were not planned before.
        shown: What its movements can show at all; None: not looked at.
    """

    diagnosis: Diagnosis
    offsets: MotorOffsets
    movements: int
    further: int = 0
    shown: IsolabilityReport | None = None
    on_the_way: bool = False

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

        A file to `repeat` is of designed motions.
        """
        if repeat is not None:
            return read_motions(repeat, self.known.robot)
        made = self.designer.sequence(self.home, seconds, most)
        return Motions.of(self.known.robot, made)

    def isolability(
        self, command: FloatArray, time: FloatArray, on_progress: Progress = unseen
    ) -> IsolabilityReport:
        """Return what motions can tell apart, by the priors of a check.

        Args:
            command: References, (sample, motor) or (run, sample, motor) [rad].
            time: When, (sample,) [s].
            on_progress: Called with the number of further faults, of all in `asked`.
        """
        known, priors = self.known, checking(self.model, self.asked)
        about = known.twin, command, time, known.imperfections, self.asked, priors
        return isolability(*about, on_progress=on_progress)

    def isolability_of(self, motions: Motions, on_progress: Progress = unseen) -> IsolabilityReport:
        """Return the isolability of designed motions."""
        time, command = motions.reference()
        return self.isolability(command, time, on_progress)

    def random_motions(self, seconds: float = RANDOM_S, most: int = 1000) -> Motions:
        """Return random movements within the usual ranges, at most `seconds` long [s]."""
        designer = replace(self, usual=True).designer
        return Motions.of(self.known.robot, designer.random(self.home, seconds, most))

    def isolability_in(self, path: Path, on_progress: Progress = unseen) -> IsolabilityReport:
        """Return the isolability of motions in a file: designed ones, or those of a log."""
        from failuretwin.data_knowledge.readers.read import read_runs

        if holds_motions(path, self.known.robot):
            return self.isolability_of(read_motions(path, self.known.robot), on_progress)
        runs = read_runs(path, self.known.robot)
        subset = np.unique(np.linspace(0, runs.sizes["run"] - 1, MOST_RUNS).astype(np.int64))
        command = as_floats(runs["command"].values)[subset]
        return self.isolability(command, as_floats(runs["time"].values), on_progress)

    def shown(
        self,
        result: CheckResult,
        command: FloatArray,
        time: FloatArray,
        on_progress: Progress = unseen,
    ) -> CheckResult:
        """Return a result with what its movements can show, where it says that all is well.

        References of its movements are (run, sample, motor) [rad], at times (sample,) [s].
        """
        if result.light != GREEN:
            return result
        return replace(result, shown=self.isolability(command, time, on_progress))

    def of_logs(self, paths: Sequence[Path]) -> list[CheckResult]:
        """Return what logs of a check say that was made elsewhere, a result a run."""
        from failuretwin.data_knowledge.readers.read import read_runs

        runs = read_runs(list(paths), self.known.robot)
        known = self.known
        diagnoser = BayesDiagnoser(known.twin, known.imperfections, self.hypotheses, self.priors)
        settled = diagnoser.seen(runs).settled
        command, time = as_floats(runs["command"].values), as_floats(runs["time"].values)
        results = []
        for row, diagnosis in enumerate(diagnoser.diagnose(runs)):
            likelihood = RunLikelihood(settled.alike(np.array([row])), self.model)
            result = self._result(likelihood, diagnosis)
            results.append(self.shown(result, command[row : row + 1], time))
        return results

    # Movements on an arm.

    def carry_out(
        self, motions: Motions, further: int, commander: Commander, tell: Callable[[str], None]
    ) -> CheckResult:
        """Make planned movements on an arm, then further ones while the result is open."""
        standing, planned = first_standing(commander), motions.orders
        travel = motions.start - standing
        if np.abs(travel).max() > 1e-6:
            ramp = np.full(len(standing), self.gate.least_duration(travel))
            planned = [Order(motions.start, ramp), *planned]
        window = list[Seen]()
        orders = chain(planned, self._further(further, window, tell))
        sequence = OrderSequence(self.model, standing, orders, window)
        Work(sequence, self.gate, commander, standing).carry_out()
        return self._found(window, len(window) - len(planned))[0]

    def _further(
        self, most: int, window: Sequence[Seen], tell: Callable[[str], None]
    ) -> Iterator[Order]:
        """Yield movements that settle what those in the window leave open."""
        for number in range(1, most + 1):
            result, posterior = self._found(window)
            if result.light != OPEN:
                return
            at = window[-1].command
            order = next_movement(self.model, self.gate, posterior, at, self.seed)
            if order is None:
                return
            tell(f"still open: further movement {number}")
            yield order

    def _found(self, window: Sequence[Seen], further: int = 0) -> tuple[CheckResult, Posterior]:
        """Return the result of movements, and the posterior of all hypotheses.

        What is doubted of the arm is integrated out.
        """
        likelihood = RunLikelihood(settled_evidence_of([window]), self.model)
        weighed = likelihood, self.hypotheses, self.priors
        posterior = run_posterior(*weighed, sensor_in_doubt(*weighed))
        diagnosis = posterior.to_diagnosis(0, "check", LogQuality())
        return self._result(likelihood, diagnosis, further), posterior

    def _result(
        self, likelihood: RunLikelihood, diagnosis: Diagnosis, further: int = 0
    ) -> CheckResult:
        """Return a diagnosis with zeros and play.

        Designed movements reach the joint limits, so commands outside the usual ranges are no
        remark.
        """
        remarks = tuple(line for line in diagnosis.quality if not line.startswith(BEYOND_USUAL))
        offsets = motor_offsets(likelihood, self.hypotheses, self.priors)
        movements = int(likelihood.usable.sum())
        diagnosis = replace(diagnosis, quality=remarks)
        on_the_way = bool(likelihood.evidence.on_the_way.any())
        return CheckResult(diagnosis, offsets, movements, further, on_the_way=on_the_way)


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
    return asking.carry_out(asking.motions(seconds), further, commander, tell)
