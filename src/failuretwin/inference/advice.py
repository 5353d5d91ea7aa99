"""What to do next about a robot, as sure as its diagnosis is: one source for all that tell it.

    P(motor k) = sum of p(h) over the hypotheses h with a fault of motor k

From P = 0.95 on, not resting on one movement alone, the repair of the fault is advised, by the kind
of actuator; below, another log in which the motor moves. Nothing is taken apart on a guess.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from failuretwin.core.hypothesis import SURE, Diagnosis, Fault, Hypothesis, motor_probabilities
from failuretwin.failure_behavior.registry import MODES
from failuretwin.failure_behavior.repair import advice_for

IN_QUESTION = 0.02
"""Motors whose fault is as probable as this are to move in the next log."""
MOST_NAMED = 2
"""So many motors are asked to move at most."""

NOTHING_TO_DO = "Nothing to do now. Check again after a repair, or in a month."
UNKNOWN_ADVICE = (
    "None of the known faults explains it: check load, tool and the mount of the sensor, ask "
    "`failuretwin doctor LOG`, and name further faults with --hypotheses."
)
WAIT = "Take nothing apart before that."
MOVEMENT = "movement"
"""The single thing that a verdict of one run may rest on."""
WORDS = (
    (0.999, "all but certain"),
    (SURE, "sure"),
    (0.8, "likely, but not sure"),
    (0.5, "more likely than not"),
    (0.0, "open"),
)
"""How sure a probability is called, from which on."""


def sureness(probability: float) -> str:
    """Return how sure a probability is, in words."""
    return next(words for least, words in WORDS if probability >= least)


def rests_on_one_movement(diagnosis: Diagnosis) -> bool:
    """Return whether a fault would not be the most probable without one of the movements.

    Without movement m, log p(best)/p(second) is less by its nats. A runner-up of the same motors
    leaves no doubt about which they are.
    """
    if diagnosis.undecided or len(diagnosis.posterior) < 2 or not diagnosis.evidence:
        return False
    best, second = (Hypothesis.parse(name) for name in diagnosis.ranked[:2])
    if not best.faults:
        return False
    if len(diagnosis.evidence) == 1:
        return True
    least = diagnosis.posterior[str(second)]
    if _motors(best) == _motors(second) or least <= 0.0:
        return False
    odds = math.log(diagnosis.posterior[str(best)] / least)
    return max(movement.nats for movement in diagnosis.evidence) >= odds


def next_steps(posterior: Mapping[str, float], arm_class: str = "", alone: str = "") -> list[str]:
    """Return what to do next, a sentence or two for each fault that is sure.

    Args:
        posterior: Probability of every hypothesis; sums to 1.
        arm_class: Kind of arm; empty: not known.
        alone: On what single thing the verdict rests, such as ``movement``; empty: on several.
    """
    name = max(posterior, key=lambda key: posterior[key])
    best, told = Hypothesis.parse(name), posterior[name]
    if not best.faults:
        if told >= SURE:
            return [NOTHING_TO_DO if best.known else UNKNOWN_ADVICE]
        return [f"Record again, {_moving(_questioned(posterior))}."]
    of_motors = sum(
        p for other, p in posterior.items() if _motors(Hypothesis.parse(other)) == _motors(best)
    )
    if of_motors < SURE:
        named = list(dict.fromkeys([*_motors(best), *_questioned(posterior)]))
        return [f"Record again, {_moving(named[: max(MOST_NAMED, len(best.faults))])}. {WAIT}"]
    if alone:
        return [f"One {alone} alone shows it: record again, {_moving(_motors(best))}. {WAIT}"]
    if told < SURE:
        where = " and ".join(map(_spoken, _motors(best)))
        return [
            f"Which fault of {where} it is stays open: record again, {_moving(_motors(best))}. "
            f"{WAIT}"
        ]
    return [_repair(fault, arm_class) for fault in best.faults]


STEP = "what to do: "
"""Begin of a line that says what to do."""


def advice_lines(hypothesis: Hypothesis, steps: Sequence[str]) -> list[str]:
    """Return what may have broken and what to do now, a line each.

    Args:
        hypothesis: The most probable one.
        steps: What to do, as of `next_steps`; one for each of its faults, or one for all.
    """
    modes = [MODES.find(fault.mode) for fault in hypothesis.faults]
    causes = [f"possible causes: {', '.join(m.mechanisms)}" if m.mechanisms else "" for m in modes]
    told = [f"{STEP}{step}" for step in steps if step != NOTHING_TO_DO]
    if len(told) == len(causes):
        return [line for both in zip(causes, told, strict=True) for line in both if line]
    return [line for line in (*causes, *told) if line]


def _repair(fault: Fault, arm_class: str) -> str:
    """Return what to do about a fault that is sure."""
    mode = MODES.get(fault.mode)  # results may name one that is registered elsewhere
    told = "" if mode is None else advice_for(mode, arm_class)
    return told or f"Look at {_spoken(fault.motor)}, and repeat a few movements of it alone."


def _moving(motors: Sequence[str]) -> str:
    names = " and ".join(map(_spoken, motors)) or "every motor"
    return f"with {names} moving in five movements or more, and diagnose that log too"


def _questioned(posterior: Mapping[str, float]) -> list[str]:
    """Return the motors that may be faulty, the most probable first."""
    by_motor = motor_probabilities(posterior)
    ranked = sorted(by_motor, key=lambda motor: -by_motor[motor])
    return [motor for motor in ranked if by_motor[motor] >= IN_QUESTION][:MOST_NAMED]


def _motors(hypothesis: Hypothesis) -> tuple[str, ...]:
    return tuple(fault.motor for fault in hypothesis.faults)


def _spoken(motor: str) -> str:
    return motor.replace("_", " ")
