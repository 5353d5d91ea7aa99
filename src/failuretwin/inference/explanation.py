"""Diagnoses in plain words: the verdict, what speaks for it, what else it may be, what to do.

Section: docs/inference.md#posterior
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from failuretwin.core.hypothesis import (
    OPEN_STATE,
    SURE,
    Diagnosis,
    Fault,
    Hypothesis,
    Interval,
    MovementEvidence,
)
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.digital_model.robot import Robot
from failuretwin.failure_behavior.mode import Signature
from failuretwin.failure_behavior.registry import MODES, plain_fault
from failuretwin.inference.advice import (
    MOVEMENT,
    advice_lines,
    next_steps,
    rests_on_one_movement,
)
from failuretwin.inference.observation.between_commands import TOO_SELDOM
from failuretwin.inference.set_ups.wrong_setup import ALONE, DOUBTS, MISFITS, NOWHERE, undone

TELLING_NATS = 1.0
"""Evidence of a movement worth telling [nats]: it changes the odds by a factor of 2.7."""

LARGE_FAULT_ADVICE = (
    "Look at the motor that is named. `--hypotheses` with drift or unknown weighs faults of any "
    "size."
)
WRONG_SETUP_ADVICE = (
    "Put right what the verdict names, or check that the log is of this robot, and diagnose the "
    "same log again."
)


NO_HYPOTHESIS = "is none of the hypotheses"
"""Said of a fault that nobody asked for."""


def percent(probability: float) -> str:
    """Return a probability in per cent that never claims certainty."""
    if probability > 0.999:
        return "over 99.9 %"
    return f"{100 * probability:.1f} %" if probability > 0.99 else f"{100 * probability:.0f} %"


def worded(
    diagnosis: Diagnosis,
    ranked: Sequence[Hypothesis],
    losses: Sequence[str] = (),
    arm_class: str = "",
) -> Diagnosis:
    """Return a diagnosis with its verdict and explanation in words.

    Args:
        diagnosis: With evidence and estimates filled in, as far as there are any.
        ranked: Its hypotheses from the most to the least probable.
        losses: Commands that seem not to have arrived.
        arm_class: Kind of arm, which advice depends on; empty: not known.
    """
    return replace(
        diagnosis,
        verdict=verdict(diagnosis, ranked),
        explanation=explanation(diagnosis, ranked, losses, arm_class),
    )


COUNTED_MOTOR = re.compile(r"motor_\d+")
COUNTED_JOINT = re.compile(r"(.*_)?(joint|axis|j|a)_?\d+")
"""Names of motors and joints that only count them."""


def with_joint_names(diagnosis: Diagnosis, robot: Robot) -> Diagnosis:
    """Return a diagnosis whose verdict names the joint of each motor that has but a number.

    Args:
        diagnosis: With its verdict in words.
        robot: The robot; joints of it that are only counted say nothing more.
    """
    return replace(diagnosis, verdict=joint_names_in(diagnosis.verdict, robot))


def joint_names_in(text: str, robot: Robot) -> str:
    """Return a text with the joint named beside the first mention of each motor; see above."""
    for motor in robot.motors:
        if COUNTED_MOTOR.fullmatch(motor.name) and not COUNTED_JOINT.fullmatch(motor.joint.lower()):
            plain = motor.joint.removesuffix("_joint").replace("_", " ")
            name = motor.name.replace("_", " ")
            text = re.sub(rf"\b{name}\b(?! \()", f"{name} ({plain})", text, count=1)
    return text


def plain_name(hypothesis: Hypothesis) -> str:
    """Return a hypothesis as a person would say it, such as ``motor 3 stuck``.

    A fault of a mode that is not known here, such as one from results of elsewhere, is told by the
    mode's id.
    """
    if not hypothesis.known:
        return "something that none of the known faults explains"
    return " and ".join(map(plain_fault, hypothesis.faults)) or "healthy"


def verdict(diagnosis: Diagnosis, ranked: Sequence[Hypothesis]) -> str:
    """Return the diagnosis as one sentence.

    Args:
        diagnosis: With its estimates filled in.
        ranked: Its hypotheses from the most to the least probable.
    """
    if diagnosis.undecided:
        return f"cannot tell, because {diagnosis.undecided}"
    best = ranked[0]
    text = plain_name(best)
    if not best.is_healthy:
        text += _size_and_onset(diagnosis, best)
    probability = diagnosis.posterior[str(best)]
    if diagnosis.state == OPEN_STATE and probability < SURE:
        text = f"cannot tell yet; most probable: {text}, {percent(probability)}"
    else:
        text = f"{text}, {percent(probability)} sure"
    possible = possible_hypotheses(diagnosis, ranked)
    if len(possible) > 1:
        others = [f"{plain_name(h)} {percent(diagnosis.posterior[str(h)])}" for h in possible[1:3]]
        text += f" (or {', '.join(others)})"
    if best.is_healthy and (wrong := undone(diagnosis.quality)):
        text += f"; but {MISFITS}: {wrong}"
    return f"{text}{LAST_ONLY}" if _shows_last(diagnosis, best) else text


LAST_ONLY = "; seen in the last movement only: a lost command looks the same"
"""Said of a motor that stops in the last movement."""


def _shows_last(diagnosis: Diagnosis, best: Hypothesis) -> bool:
    """Return whether only the last movement says that a motor is stuck."""
    if [fault.mode for fault in best.faults] != [STUCK] or not rests_on_one_movement(diagnosis):
        return False
    *before, last = (movement.nats for movement in diagnosis.evidence)
    return bool(before) and max(before) < TELLING_NATS < last


_TOLD_UNITS = {
    "rad": (180.0 / math.pi, "deg"),
    "rad/s": (180.0 / math.pi, "deg/s"),
    "m": (1e3, "mm"),
    "m/s": (1e3, "mm/s"),
    "ratio": (1e2, "%"),
}
"""Factor to the unit that people read, and its name, by unit; any other is told as it is."""


OPEN_ONSET_S = 0.6
"""Width of the 90 % interval of an onset from which it is told [s]; assumed."""


def _size_and_onset(diagnosis: Diagnosis, hypothesis: Hypothesis) -> str:
    onset = round(diagnosis.onset_s or 0.0, 1)
    since = f" since {onset:.1f} s{_told_range(diagnosis.onset_90)}"
    since = since if onset else " since before the run"
    if len(hypothesis.faults) != 1 or diagnosis.magnitude is None:
        return since if onset else ""
    fault, size = hypothesis.faults[0], diagnosis.magnitude
    told = onset or MODES.find(fault.mode).signature is Signature.HELD
    return size_words(fault, size, diagnosis.magnitude_unit) + (since if told else "")


def _told_range(onset_90: Interval | None) -> str:
    """Return the interval of an onset [s] where the tenths of the onset promise too much."""
    if onset_90 is None or onset_90[1] - onset_90[0] < OPEN_ONSET_S:
        return ""
    return f" ({onset_90[0]:.1f} to {onset_90[1]:.1f} s)"


def size_words(fault: Fault, size: float, unit: str | None = None) -> str:
    """Return the size of a fault as it is told behind its name, such as `` by about 2.4 deg``.

    Args:
        fault: Of any known mode.
        size: Its magnitude.
        unit: Its unit; None: that of its mode. Of a joint that slides, m where that has rad.
    """
    mode = MODES.find(fault.mode)
    factor, told = _TOLD_UNITS.get(unit or mode.unit, (1.0, unit or mode.unit))
    return mode.size_words.format(size=factor * size, unit=told)


def possible_hypotheses(diagnosis: Diagnosis, ranked: Sequence[Hypothesis]) -> Sequence[Hypothesis]:
    """Return the fewest hypotheses that together are `SURE`."""
    total = np.cumsum([diagnosis.posterior[str(h)] for h in ranked])
    return ranked[: int(np.searchsorted(total, SURE)) + 1]


def explanation(
    diagnosis: Diagnosis, ranked: Sequence[Hypothesis], losses: Sequence[str], arm_class: str = ""
) -> tuple[str, ...]:
    """Return what speaks for the verdict, what else it may be and what to do, a line each.

    Args:
        diagnosis: With evidence filled in.
        ranked: Its hypotheses from the most to the least probable.
        losses: Commands that seem not to have arrived.
        arm_class: Kind of arm; empty: not known.
    """
    if diagnosis.undecided:
        return (undecided_step(diagnosis.undecided),)
    lines = list(_evidence_lines(diagnosis.evidence, ranked))
    lines += losses
    possible = possible_hypotheses(diagnosis, ranked)
    if len(possible) > 1:
        names = " or ".join(plain_name(h) for h in possible)
        lines.append(f"cannot be told apart in this run: {names}")
    alone = MOVEMENT if rests_on_one_movement(diagnosis) else ""
    return (*lines, *advice_lines(ranked[0], next_steps(diagnosis.posterior, arm_class, alone)))


def undecided_step(reason: str) -> str:
    """Return what to do about a run that allows no verdict, for this reason."""
    if ALONE in reason:
        return LARGE_FAULT_ADVICE
    if NOWHERE in reason:
        return WRONG_SETUP_ADVICE
    if NO_HYPOTHESIS in reason:
        return "Diagnose the log again with that fault among the hypotheses (`--hypotheses`)."
    if reason == TOO_SELDOM:
        return "Log again, with commands at 10 Hz or more."
    return (
        "Log again with the tool in view: five movements or more with rests, or half a minute of "
        "motion."
    )


def set_up_doubt(lines: Iterable[str]) -> str:
    """Return the first remark on a log that says that its set-up is uncertain; empty: none."""
    return next((line for line in lines if any(doubt in line for doubt in DOUBTS)), "")


def _evidence_lines(
    evidence: Sequence[MovementEvidence], ranked: Sequence[Hypothesis]
) -> list[str]:
    if len(ranked) < 2:
        return []
    best, second = plain_name(ranked[0]), plain_name(ranked[1])
    lines = []
    for item in evidence:
        when = "" if item.time_s is None else f", {item.time_s:.1f} s"
        where = f"movement {item.movement}{when}"
        if item.nats >= TELLING_NATS:
            lines.append(f"{where}: {item.nats:.1f} nats for {best} over {second}")
        elif item.nats <= -TELLING_NATS:
            lines.append(f"{where}: {-item.nats:.1f} nats for {second} over {best}")
    return lines


STUCK = "stuck"
LEARNED_METHOD = "learned priors"
"""What the method of a diagnosis says of priors that a store has taught."""


def with_learned_method(diagnosis: Diagnosis) -> Diagnosis:
    """Return a diagnosis whose method says that its priors were learned."""
    return replace(diagnosis, method=f"{diagnosis.method}; {LEARNED_METHOD}")


def with_reading_doubt(diagnosis: Diagnosis, cause: str) -> Diagnosis:
    """Return a diagnosis that says that a frozen reading looks like a stuck motor.

    Where the tool is computed from the motors' own readings nothing else tells the two apart.

    Args:
        diagnosis: What is said.
        cause: What is blamed, such as ``motor_2:stuck``.
    """
    motor, _, mode = cause.partition(":")
    if mode != STUCK:
        return diagnosis
    said = (
        f"{diagnosis.verdict}; the tool is computed from motor readings, so a frozen reading of "
        f"{motor.replace('_', ' ')} looks the same"
    )
    return replace(diagnosis, verdict=said)


LIKELY = 0.5
"""Probability from which a lost command is told [-]."""


def lost_command_lines(
    outcome_probability: FloatArray,
    numbers: Sequence[int],
    lost: BoolArray,
    motors: Sequence[str],
    faulty: Sequence[str],
) -> list[str]:
    """Return the commands of a run that seem not to have arrived, a line each.

    Args:
        outcome_probability: Probability of each outcome, (movement, outcome).
        numbers: The movements' numbers in the run, (movement,).
        lost: Motors that lose their command in it, (outcome, motor).
        motors: Names of the motors.
        faulty: Motors whose fault is told anyway.
    """
    lines = []
    for number, share in zip(numbers, outcome_probability, strict=True):
        missing = share @ lost > LIKELY
        told = [m for m, gone in zip(motors, missing, strict=True) if gone and m not in faulty]
        if told:
            names = " and ".join(motor.replace("_", " ") for motor in told)
            lines.append(f"movement {number}: {names} did not get the command")
    return lines
