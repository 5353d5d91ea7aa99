"""State of a robot over several runs: healthy, faulty or open, its probability and the next step.

Runs diagnosed together have a `FaultCourse`; the state is the posterior of the last run given all.
Runs diagnosed independently are pooled linearly,

    p(h) = mean over runs i of p(h | run i)

because their common errors, such as those of the calibration, do not average out.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from failuretwin.core.errors import InputError, counted
from failuretwin.core.hypothesis import (
    FAULTY_STATE,
    HEALTHY,
    HEALTHY_STATE,
    OPEN_STATE,
    SURE,
    UNKNOWN,
    Diagnosis,
    Hypothesis,
    motor_probabilities,
    state_of,
)
from failuretwin.digital_model.arm_classes import class_name
from failuretwin.digital_model.robot import Robot
from failuretwin.inference.advice import (
    MOVEMENT,
    NOTHING_TO_DO,
    next_steps,
    rests_on_one_movement,
    sureness,
)
from failuretwin.inference.diagnoser import BayesDiagnoser
from failuretwin.inference.explanation import (
    joint_names_in,
    percent,
    plain_name,
    set_up_doubt,
    undecided_step,
)
from failuretwin.inference.faults.prior_odds import log_prior
from failuretwin.inference.set_ups.set_ups import FAULT_OF_EVERY_RUN
from failuretwin.inference.set_ups.wrong_setup import ALONE, MAY_MISFIT
from failuretwin.inference.together.fault_course import FaultCourse

SUSPECT = 0.05
"""Motors of an open state are listed from this probability on."""
RUN = "run"
"""A verdict over several runs may rest on a single run."""
DIFFERENT_STEP = (
    "If these are runs of one robot in their order, {how}; else diagnose the runs of each state "
    "alone."
)
WEIGH, ORDERED = "weigh them together with --track or --self-calibrate", "leave out --independent"
TOGETHER_STEP = "Runs of one robot say more together: diagnose them with --self-calibrate."
ZERO_STEP = (
    "Look at the zero mark of this motor, and at the zero in the profile. If the profile is wrong, "
    "`failuretwin doctor LOG --out FILE` writes the zero down. If the zero was right before, this "
    "is a fault: stop and repair the motor."
)

LONE_MOTOR = re.compile(rf"motor \d+[^;:]* {ALONE}[^;:]*")
"""Which motor alone explains a run, in why there is no verdict on it."""
SET_UP_HEADLINE = "Healthy, but its set-up is uncertain"
SET_UP_STEP = "Put the set-up right first, and diagnose the same log again: {doubt}."
SET_UP_TOO = "Look at the set-up too: {doubt}."


@dataclass(frozen=True)
class State:
    """State of the robot according to one run or all runs.

    Attributes:
        kind: `HEALTHY_STATE`, `FAULTY_STATE` or `OPEN_STATE`.
        motors: Faulty or suspected motors in chain order; empty for a healthy robot.
        probability: Probability of `kind` and `motors`; None without a verdict.
    """

    kind: str
    motors: tuple[str, ...] = ()
    probability: float | None = None


@dataclass(frozen=True)
class MotorState:
    """State of one motor over all runs.

    Attributes:
        motor: Name of the motor.
        joint: Name of its joint in the URDF.
        column: Its column in raw logs; empty: unknown.
        kind: State over all runs; see `State`.
        faulty: Number of runs in which it is faulty.
        suspected: Number of runs in which it is only suspected.
        highest: Largest probability of a fault in any run.
        probability: Probability of a fault over the runs behind the state.
    """

    motor: str
    joint: str
    column: str
    kind: str
    faulty: int
    suspected: int
    highest: float
    probability: float


@dataclass(frozen=True)
class RobotState:
    """State of a robot over all runs, in words for users.

    Attributes:
        state: The state.
        headline: The state in a few words, with motor and joint.
        step: The next step.
        remark: Remark on the runs as a whole, or empty.
        posterior: Probability of each hypothesis over the runs behind the state.
        motors: State of each motor, in chain order.
        arm_class: Kind of arm, by its actuators.
        runs: Number of runs.
    """

    state: State
    headline: str
    step: str
    remark: str = ""
    posterior: Mapping[str, float] = field(default_factory=dict)
    motors: tuple[MotorState, ...] = ()
    arm_class: str = ""
    runs: int = 0

    @property
    def sureness(self) -> str:
        """Its probability in words; empty without a verdict."""
        chance = self.state.probability
        return "" if chance is None else f"{sureness(chance)} ({percent(chance)})"

    @property
    def line(self) -> str:
        """State, sureness and remark in one line."""
        line = f"{self.headline}: {self.sureness}" if self.sureness else self.headline
        return f"{line}; {self.remark}" if self.remark else line


def with_motors(posterior: Mapping[str, float], order: Sequence[str]) -> State:
    """Return the state of a posterior; `order` lists the motors in chain order."""
    kind, by_motor = state_of(posterior), motor_probabilities(posterior)
    if kind == HEALTHY_STATE:
        return State(kind, (), posterior[str(HEALTHY)])
    least = SURE if kind == FAULTY_STATE else SUSPECT
    motors = tuple(motor for motor in order if by_motor.get(motor, 0.0) >= least)
    if kind == FAULTY_STATE:
        return State(kind, motors, min(by_motor[motor] for motor in motors))
    best = max(posterior, key=lambda name: posterior[name])
    probable = [by_motor[fault.motor] for fault in Hypothesis.parse(best).faults]
    return State(kind, motors, min(probable, default=posterior[best]))


def state_of_run(diagnosis: Diagnosis, order: Sequence[str]) -> State:
    """Return the state of one run; it is open without a verdict, or healthy by a doubted set-up."""
    state = State(OPEN_STATE) if diagnosis.undecided else with_motors(diagnosis.posterior, order)
    doubted = state.kind == HEALTHY_STATE and set_up_doubt(diagnosis.quality)
    return State(OPEN_STATE) if doubted else state


def robot_state(
    diagnoses: Sequence[Diagnosis],
    robot: Robot,
    course: FaultCourse | None = None,
    learned: Sequence[str] | None = None,
) -> RobotState:
    """Return the state of a robot over all its runs.

    Args:
        diagnoses: Diagnosis of each run, oldest first.
        robot: The robot.
        course: Fault course of runs diagnosed together; None: diagnosed independently.
        learned: Sentences on what the runs taught about the robot; None: nothing was learned.
    """
    if not diagnoses:
        raise InputError("a state needs the diagnosis of one run at least; there is none.")
    states = [state_of_run(d, robot.motor_names) for d in diagnoses]
    decided = [i for i, d in enumerate(diagnoses) if not d.undecided]
    if not decided:
        found = _no_verdict(diagnoses)
    elif course is not None:
        found = _of_course(course, robot)
    else:
        found = _one_by_one(diagnoses, states, decided, robot, learned is None)
    quality = [line for d in diagnoses for line in d.quality]
    found = _with_zero(found, [*quality, *(learned or ())])
    found = _with_lone_motor(found, diagnoses) if decided else found
    found = _with_set_up(found, set_up_doubt(quality)) if decided else found
    return replace(
        found,
        headline=joint_names_in(found.headline, robot),
        step=joint_names_in(found.step, robot),
        remark=joint_names_in(found.remark, robot),
        motors=_motor_states(diagnoses, states, found, robot),
        arm_class=class_name(robot),
        runs=len(diagnoses),
    )


def course_of(diagnoses: Sequence[Diagnosis], diagnoser: BayesDiagnoser) -> FaultCourse:
    """Return the fault course over runs, oldest first, with the priors of their diagnoser."""
    prior = np.exp(log_prior(diagnoser.hypothesis_set, diagnoser.priors))
    return FaultCourse.of(diagnoses, prior)


def _with_zero(found: RobotState, lines: Sequence[str]) -> RobotState:
    """Return an open state if a healthy one has a remark on a zero or a fault of every run."""
    remarks = [line for line in lines if FAULT_OF_EVERY_RUN in line]
    if found.state.kind != HEALTHY_STATE or not remarks:
        return found
    remark = "; ".join(filter(None, (found.remark, remarks[-1])))
    headline = "Cannot tell yet; healthy, but for a zero that may be a fault"
    return replace(found, state=State(OPEN_STATE), headline=headline, step=ZERO_STEP, remark=remark)


def _with_lone_motor(found: RobotState, diagnoses: Sequence[Diagnosis]) -> RobotState:
    """Return a state that names the motor which alone explains runs that no fault does.

    A fault that other runs show for sure comes before it.
    """
    lone = [clause for d in diagnoses for clause in LONE_MOTOR.findall(d.undecided)]
    if not lone or found.state.kind == FAULTY_STATE:
        return found
    runs = f"{len(lone)} of {counted(len(diagnoses), 'run')}"
    remark = "; ".join(filter(None, (found.remark, lone[0])))
    headline = f"Cannot tell yet; no fault that is considered explains {runs}"
    step = undecided_step(lone[0])
    return replace(found, state=State(OPEN_STATE), headline=headline, step=step, remark=remark)


def _with_set_up(found: RobotState, doubt: str) -> RobotState:
    """Return a state that says first that its set-up is uncertain, and why; empty: it is not.

    A fault that is sure although the set-up may be wrong comes before it.
    """
    if not doubt:
        return found
    if found.state.kind == FAULTY_STATE and MAY_MISFIT in doubt:
        return replace(found, step=f"{found.step} {SET_UP_TOO.format(doubt=doubt)}")
    if found.state.kind == HEALTHY_STATE:
        found = replace(found, state=State(OPEN_STATE), headline=SET_UP_HEADLINE)
    told = [SET_UP_STEP.format(doubt=doubt), found.step]
    step = " ".join(line for line in told if line != NOTHING_TO_DO)
    return replace(found, step=step)


def _no_verdict(diagnoses: Sequence[Diagnosis]) -> RobotState:
    """Return the summary of runs without any verdict."""
    reason = diagnoses[0].undecided
    return RobotState(State(OPEN_STATE), f"Cannot tell, because {reason}", undecided_step(reason))


def _of_course(course: FaultCourse, robot: Robot) -> RobotState:
    """Return the state at the last run given all runs."""
    last = course.posterior[-1]
    posterior = {str(h): float(p) for h, p in zip(course.hypotheses, last, strict=True)}
    steps = " ".join(next_steps(posterior, class_name(robot)))
    state = with_motors(posterior, robot.motor_names)
    return RobotState(
        state, _headline(state, posterior), steps, "; ".join(course.verdict), posterior
    )


def _one_by_one(
    diagnoses: Sequence[Diagnosis],
    states: Sequence[State],
    decided: Sequence[int],
    robot: Robot,
    each_alone: bool,
) -> RobotState:
    """Return the pooled state since the first faulty run, if the runs agree.

    `each_alone`: the runs share nothing learned, so diagnosing them together is advised.
    """
    faulty = [i for i in decided if states[i].kind == FAULTY_STATE]
    since = faulty[0] if faulty else 0
    used = [i for i in decided if i >= since]
    posterior = _pooled([diagnoses[i].posterior for i in used])
    named = {states[i].motors for i in faulty}
    if len(named) > 1 or (faulty and any(states[i].kind == HEALTHY_STATE for i in used)):
        step = DIFFERENT_STEP.format(how=WEIGH if each_alone else ORDERED)
        return _different(states, decided, posterior, step)
    state = with_motors(posterior, robot.motor_names)
    alone = _alone(diagnoses, faulty, len(decided))
    remarks = [f"one {alone} alone shows it"] if alone else []
    if any(states[i].kind == HEALTHY_STATE for i in decided if i < since):
        remarks.append(f"since run {since + 1} of {len(diagnoses)} ({diagnoses[since].run})")
    step = " ".join(next_steps(posterior, class_name(robot), alone))
    if state.kind == OPEN_STATE and len(used) > 1 and each_alone:
        step = f"{step} {TOGETHER_STEP}"
    return RobotState(state, _headline(state, posterior), step, "; ".join(remarks), posterior)


def _alone(diagnoses: Sequence[Diagnosis], faulty: Sequence[int], decided: int) -> str:
    """Return `RUN` or `MOVEMENT` if a fault rests on a single one, else an empty string."""
    if len(faulty) > 1:
        return ""
    if faulty and decided > 1:
        return RUN
    return MOVEMENT if any(rests_on_one_movement(diagnoses[i]) for i in faulty) else ""


def _pooled(posteriors: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return the mean of posteriors; missing hypotheses count as 0."""
    names = dict.fromkeys(name for posterior in posteriors for name in posterior)
    return {name: float(np.mean([p.get(name, 0.0) for p in posteriors])) for name in names}


def _different(
    states: Sequence[State], decided: Sequence[int], posterior: Mapping[str, float], step: str
) -> RobotState:
    """Return the summary of runs with different states."""
    counts = Counter(_short(states[i]) for i in decided)
    remark = ", ".join(f"{name} in {counted(n, 'run')}" for name, n in counts.most_common())
    motors = dict.fromkeys(
        m for i in decided if states[i].kind == FAULTY_STATE for m in states[i].motors
    )
    headline = "Different states in different runs"
    return RobotState(State(OPEN_STATE, tuple(motors)), headline, step, remark, posterior)


def _short(state: State) -> str:
    if state.kind != FAULTY_STATE:
        return state.kind
    return f"{' and '.join(map(_spoken, state.motors))} faulty"


def _headline(state: State, posterior: Mapping[str, float]) -> str:
    """Return the state in a few words."""
    best = max(posterior, key=lambda name: posterior[name])
    name = plain_name(Hypothesis.parse(best))
    if state.kind == HEALTHY_STATE:
        return "Healthy"
    if state.kind == FAULTY_STATE:
        faulty = name if posterior[best] >= SURE else " and ".join(map(_spoken, state.motors))
        return f"Faulty: {faulty}"
    return f"Cannot tell yet; most probable: {name}"


def _motor_states(
    diagnoses: Sequence[Diagnosis], states: Sequence[State], found: RobotState, robot: Robot
) -> tuple[MotorState, ...]:
    """Return the state of each motor; an unknown fault or an uncertain set-up leaves all open."""
    by_run = [{} if d.undecided else motor_probabilities(d.posterior) for d in diagnoses]
    over_all = motor_probabilities(found.posterior)
    unknown = found.posterior.get(str(UNKNOWN), 0.0) if found.posterior else 1.0
    unknown = 1.0 if found.headline == SET_UP_HEADLINE else unknown
    rows = []
    for name, motor in zip(robot.motor_names, robot.motors, strict=True):
        chance = over_all.get(name, 0.0)
        kind = HEALTHY_STATE if chance + unknown < SUSPECT else OPEN_STATE
        rows.append(
            MotorState(
                name,
                motor.joint,
                motor.log_column,
                found.state.kind if name in found.state.motors else kind,
                sum(s.kind == FAULTY_STATE and name in s.motors for s in states),
                sum(s.kind == OPEN_STATE and name in s.motors for s in states),
                max(each.get(name, 0.0) for each in by_run),
                chance,
            )
        )
    return tuple(rows)


def _spoken(motor: str) -> str:
    return motor.replace("_", " ")
