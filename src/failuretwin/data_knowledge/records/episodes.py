"""Fault episodes: when one begins, goes on and ends.

1. A diagnosis names a fault of a motor if P(motor) >= `SURE` (0.95), the probability from which a
   motor is called faulty. Its mode is the most probable one of that motor.
2. The first such diagnosis begins an episode: `raised` if P(motor, mode) >= `SURE`, otherwise
   `suspected`, since only the motor is certain.
3. Later diagnoses that name the same motor and mode continue it; one that is sure of the mode
   raises a suspected one.
4. A healthy diagnosis clears all open episodes. A diagnosis of another mode of the same motor
   clears its episode and begins another; so does any fault of a motor whose episode a person has
   found wrong, so that a finding hides no later fault. All others change nothing.
5. The alarms of a watch begin, raise and clear episodes as they are raised and cleared. At its end
   the last diagnosis counts like that of any run.

An open episode that a person has confirmed is `confirmed`; see `history.FaultEpisode`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from datetime import datetime

from failuretwin.core.hypothesis import (
    FAULTY_STATE,
    HEALTHY_STATE,
    SURE,
    Diagnosis,
    Hypothesis,
    motor_probabilities,
)

SUSPECTED, RAISED, CONFIRMED, CLEARED = "suspected", "raised", "confirmed", "cleared"
"""States of an episode."""


@dataclass(frozen=True)
class NamedFault:
    """A fault that a diagnosis names.

    Attributes:
        motor: The motor.
        mode: Its most probable mode.
        state: `RAISED` if the mode is certain, otherwise `SUSPECTED`.
    """

    motor: str
    mode: str
    state: str


def named_faults(diagnosis: Diagnosis) -> list[NamedFault]:
    """Return the faults that a diagnosis names; empty unless it is sure of a motor."""
    if diagnosis.state != FAULTY_STATE:
        return []
    probabilities = motor_probabilities(diagnosis.posterior)
    return [_named(motor, diagnosis) for motor, p in probabilities.items() if p >= SURE]


def _named(motor: str, diagnosis: Diagnosis) -> NamedFault:
    modes: dict[str, float] = {}
    for name, probability in diagnosis.posterior.items():
        for fault in Hypothesis.parse(name).faults:
            if fault.motor == motor:
                modes[fault.mode] = modes.get(fault.mode, 0.0) + probability
    mode = max(modes, key=modes.__getitem__)
    return NamedFault(motor, mode, RAISED if modes[mode] >= SURE else SUSPECTED)


@dataclass
class Course:
    """An episode while diagnoses are followed.

    Attributes:
        fault: Motor, mode and state.
        since: Time of the first diagnosis.
        row: Its row in the store; None: not stored yet.
        until: Time of the diagnosis that cleared it; None: open.
        events: New states, with the time and the number of the diagnosis behind each.
    """

    fault: NamedFault
    since: datetime
    row: int | None = None
    refuted: bool = False
    until: datetime | None = None
    events: list[tuple[str, datetime, int]] = field(default_factory=list)


class EpisodeTracker:
    """Follows the diagnoses of one robot, in their order, by the rule above.

    Args:
        open_episodes: Episodes that are open so far.
    """

    def __init__(self, open_episodes: Iterable[Course] = ()) -> None:
        self._open = {course.fault.motor: course for course in open_episodes}
        self.changed: list[Course] = []
        """Episodes with new events, in the order of their first one."""

    def follow(self, diagnosis: Diagnosis, at: datetime, number: int) -> None:
        """Follow one diagnosis.

        Args:
            diagnosis: The diagnosis.
            at: Time of its run (UTC).
            number: Its number, by which events refer to it.
        """
        if diagnosis.state == HEALTHY_STATE:
            for motor in list(self._open):
                self._clear(motor, at, number)
        for fault in named_faults(diagnosis):
            self._name(fault, at, number)

    def follow_alarm(
        self, before: Sequence[str], faults: Sequence[NamedFault], at: datetime, number: int
    ) -> None:
        """Follow the alarm of a watch, which decides by its own budget of false alarms.

        Args:
            before: Motors that the alarm of this watch named before; it clears no others.
            faults: Faults that it names now.
            at: When (UTC).
            number: Number of the diagnosis.
        """
        for motor in sorted({*before} - {fault.motor for fault in faults}):
            if motor in self._open:
                self._clear(motor, at, number)
        for fault in faults:
            self._name(fault, at, number)

    def _name(self, fault: NamedFault, at: datetime, number: int) -> None:
        course = self._open.get(fault.motor)
        if course is not None and (course.refuted or course.fault.mode != fault.mode):
            self._clear(fault.motor, at, number)
            course = None
        if course is None:
            course = self._open[fault.motor] = Course(fault, at)
        elif not (course.fault.state == SUSPECTED and fault.state == RAISED):
            return
        course.fault = fault
        self._note(course, fault.state, at, number)

    def _clear(self, motor: str, at: datetime, number: int) -> None:
        course = self._open.pop(motor)
        course.until = at
        self._note(course, CLEARED, at, number)

    def _note(self, course: Course, state: str, at: datetime, number: int) -> None:
        if not course.events:
            self.changed.append(course)
        course.events.append((state, at, number))
