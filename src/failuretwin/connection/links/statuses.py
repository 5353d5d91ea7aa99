"""Status of the arm and of each motor in an answer, the same for screens, logs and networks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.connection.links.base import OK, STALE, Answer
from failuretwin.core.hypothesis import (
    CLEAR,
    FAULTY_STATE,
    RAISED,
    SURE,
    SUSPECTED,
    Alarm,
    Diagnosis,
    Hypothesis,
)
from failuretwin.inference.explanation import percent, plain_name

LEVEL_OK, LEVEL_WARN, LEVEL_ERROR, LEVEL_STALE = range(4)
"""Levels of ``diagnostic_msgs/DiagnosticStatus``."""
STATES = {CLEAR: "OK", SUSPECTED: "SUSPECTED", RAISED: "ALARM"}
"""Word for each state of an alarm."""
UNDECIDED = "UNDECIDED"
BEFORE = "no data for a while; before that: "
"""Begin of the message of a robot that fell silent."""
LEVELS = {
    "OK": LEVEL_OK,
    "SUSPECTED": LEVEL_WARN,
    UNDECIDED: LEVEL_WARN,
    "ALARM": LEVEL_ERROR,
    STALE: LEVEL_STALE,
}
"""Level of each state."""


@dataclass(frozen=True)
class Status:
    """Status of a motor or of the whole arm.

    Attributes:
        name: ``arm``, or the name of the motor.
        state: One of `LEVELS`.
        message: Description in words.
        values: Key-values: probability, mode, magnitude, onset, runner-up.
    """

    name: str
    state: str
    message: str
    values: Mapping[str, str]

    def __str__(self) -> str:
        """Return state and description as a line."""
        return f"{self.state}: {self.message}"

    @property
    def level(self) -> int:
        """Level of the state."""
        return LEVELS[self.state]


def statuses(answer: Answer, motors: Sequence[str]) -> list[Status]:
    """Return the statuses of an answer: the arm first, then its motors.

    The alarm decides the states, whatever the probabilities are. Without data every status is
    stale, with the last known state in its message.
    """
    names = ["arm", *motors]
    diagnosis = answer.diagnosis
    if diagnosis is None:
        text = "no data have come yet" if answer.state == STALE else "nothing can be said yet"
        return [Status(name, STALE, text, {}) for name in names]
    alarm = answer.alarm
    if diagnosis.undecided:
        raised = [name for name in names if alarm.state == RAISED and _concerns(alarm, name)]
        words = {name: STATES[RAISED] if name in raised else UNDECIDED for name in names}
        current = [Status(name, word, diagnosis.verdict, {}) for name, word in words.items()]
    else:
        current = [_arm(diagnosis, alarm), *(_motor(diagnosis, alarm, motor) for motor in motors)]
    if answer.state != STALE:
        return current
    return [Status(s.name, STALE, BEFORE + s.message, s.values) for s in current]


def is_sure(diagnosis: Diagnosis) -> bool:
    """Return whether a fault, or a faulty motor, has 95 %."""
    best = diagnosis.ranked[0]
    one = best != "healthy" and diagnosis.posterior[best] >= SURE
    return one or diagnosis.state == FAULTY_STATE


def _arm(diagnosis: Diagnosis, alarm: Alarm) -> Status:
    best = diagnosis.ranked[0]
    values = {"alarm": alarm.state} | _episode(alarm)
    values |= {"diagnosis": best, "probability": _number(diagnosis.posterior[best])}
    if best != "healthy":
        values |= _size(diagnosis)
    if (runner_up := diagnosis.runner_up) is not None:
        values["runner_up"] = runner_up
        values["runner_up_probability"] = _number(diagnosis.posterior[runner_up])
    message = diagnosis.verdict
    if alarm.cause and alarm.cause != best:
        share = diagnosis.posterior.get(alarm.cause, 0.0)
        what = plain_name(Hypothesis.parse(alarm.cause))
        message = f"{what}, {percent(share)}; {message}"
    if alarm.threshold is not None and not is_sure(diagnosis):
        message += f"; alarm threshold {percent(alarm.threshold)}, by --false-alarms-per-100h"
    return Status("arm", STATES[alarm.state], message, values)


def _episode(alarm: Alarm) -> dict[str, str]:
    """Return the last episode of an alarm."""
    episode = alarm.episode
    if episode is None:
        return {}
    values = {
        "episode": str(episode.number),
        "episode_cause": episode.cause,
        "raised_s": f"{episode.raised_s:.2f}",
    }
    if episode.cleared_s is not None:
        values["cleared_s"] = f"{episode.cleared_s:.2f}"
    return values


def _motor(diagnosis: Diagnosis, alarm: Alarm, motor: str) -> Status:
    modes = {
        fault.mode: probability
        for name, probability in diagnosis.posterior.items()
        for fault in Hypothesis.parse(name).faults
        if fault.motor == motor
    }
    total = min(1.0, sum(modes.values()))
    ranked = sorted(modes, key=lambda mode: -modes[mode])
    values = {"probability": _number(total)} | dict(
        zip(("mode", "runner_up"), ranked, strict=False)
    )
    if ranked and f"{motor}:{ranked[0]}" in diagnosis.ranked[0].split("+"):
        values |= _size(diagnosis)
    state = STATES[alarm.state if _concerns(alarm, motor) else CLEAR]
    if state == OK or not ranked:
        return Status(motor, state, f"no fault seen ({100 * total:.1f} % faulty)", values)
    return Status(motor, state, f"{ranked[0]}, {100 * total:.1f} %", values)


def _size(diagnosis: Diagnosis) -> dict[str, str]:
    values = {}
    if diagnosis.magnitude is not None and np.isfinite(diagnosis.magnitude):
        values["magnitude"] = _number(diagnosis.magnitude)
        values["magnitude_unit"] = diagnosis.magnitude_unit or ""
    if diagnosis.onset_s is not None:
        values["onset_s"] = f"{diagnosis.onset_s:.2f}"
    return values


def _number(value: float) -> str:
    return f"{value:.6g}"


def _concerns(alarm: Alarm, name: str) -> bool:
    """Return whether an alarm is of a motor; it is always of the arm."""
    return name == "arm" or alarm.concerns(name)
