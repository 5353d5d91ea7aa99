"""When to raise an alarm: as often in error as the user allows, and no more.

With faults at a rate lambda, the odds of a fault that the filter gives of a healthy robot are a sum
of martingales, one for each movement with which a fault may have begun: they reach A in error at
most lambda / A times an hour (the bound of Shiryaev and Roberts). So

    A = lambda / (3 x allowed false alarms an hour)

keeps the budget of a robot that does what its model says; lambda cancels. The 3 is what simulated
robots leave of the bound. A robot that does worse
is found out by its own life: what was suspected and passed by itself is counted, and where that is
more than the bound allows, A is raised as much.

Section: docs/inference.md#streams
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit

from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import ALL_CLEAR, CLEAR, RAISED, SUSPECTED, Alarm, Episode
from failuretwin.core.types import FloatArray
from failuretwin.digital_model.nonidealities import Imperfections
from failuretwin.inference.together.fault_filter import S_PER_H

UNUSED = 3.0
"""The bound over what simulated healthy robots reach (303 h: 1.0 false alarms in 100 h where the
bound is 3, 2.3 of 10; benchmarks/alarms.py)."""
SUSPICION = 100.0
"""A fault is suspected at odds so many times smaller than those of an alarm."""
NAMED = 0.95
"""Share of one hypothesis among all faults from which an alarm names it."""
PATIENCE = 4
"""Movements for which an alarm waits for a name."""
LARGEST_BUDGET = 1000.0
"""False alarms in 100 hours that can be allowed at most."""


@dataclass
class AlarmRule:
    """Turns probabilities into alarms, of one robot.

    Attributes:
        hypotheses: What may be the case; the first is healthy.
        faults_per_h: Rate of faults that the probabilities count on [1/h].
        per_100_h: False alarms that the user allows in 100 hours of work.
        alarm: The alarm as it stands.
        hours: Hours of work so far, as far as nothing was wrong.
        passed: Suspicions so far that passed by themselves.
        unnamed: Movements for which an alarm has waited for a name.
    """

    hypotheses: Sequence[str]
    faults_per_h: float
    per_100_h: float = 1.0
    alarm: Alarm = ALL_CLEAR
    hours: float = 0.0
    passed: int = 0
    unnamed: int = 0

    def __post_init__(self) -> None:
        if not 0.0 < self.per_100_h <= LARGEST_BUDGET:
            raise InputError(
                f"{self.per_100_h:g} false alarms in 100 hours are allowed. Expected above 0, up "
                f"to {LARGEST_BUDGET:g}."
            )

    @property
    def excess(self) -> float:
        """By how much suspicions pass more often than chance allows; 1 or more."""
        expected = self.hours * SUSPICION * self._bound_per_h
        return max(1.0, (1.0 + self.passed) / (1.0 + expected))

    @property
    def log_odds(self) -> float:
        """Log odds of a fault from which an alarm is raised."""
        return float(np.log(self.faults_per_h / self._bound_per_h * self.excess))

    @property
    def _bound_per_h(self) -> float:
        """False alarms an hour that the bound is set to [1/h]."""
        return UNUSED * self.per_100_h / 100.0

    def see(self, time: float, posterior: FloatArray, concluded_h: float = 0.0) -> Alarm:
        """Return the alarm by what is believed now.

        `time` is that of the stream [s], `posterior` is (hypothesis,), `concluded_h` are the hours
        of the movements that were concluded since the last call.
        """
        faulty, last = posterior[1:], self.alarm.episode
        total = float(faulty.sum())
        odds = np.maximum([total, posterior[0]], 1e-300)
        above = float(np.log(odds[0] / odds[1])) - self.log_odds
        cause = self.hypotheses[1 + int(np.argmax(faulty))]
        named = float(faulty.max()) >= NAMED * total
        if self.alarm.state == RAISED and last is not None:
            if above < -np.log(SUSPICION):
                self.alarm = Alarm(CLEAR, "", replace(last, cleared_s=time))
            elif named and cause != last.cause and above >= 0.0:
                self._raise(last.number + 1, cause, time)
            return self.alarm
        self.hours += concluded_h
        self.unnamed = self.unnamed + (concluded_h > 0.0) if above >= 0.0 else 0
        if above >= 0.0 and (named or self.unnamed >= PATIENCE):
            self._raise(1 if last is None else last.number + 1, cause, time)
        elif above >= -np.log(SUSPICION):
            self.alarm = Alarm(SUSPECTED, cause, last)
        elif self.alarm.state != CLEAR:
            self.passed += 1
            self.alarm = Alarm(CLEAR, "", last)
        return self.alarm

    def _raise(self, number: int, cause: str, time: float) -> None:
        self.unnamed, threshold = 0, float(expit(self.log_odds))
        self.alarm = Alarm(RAISED, cause, Episode(number, cause, time), threshold)


def movements_to_tell(
    imperfections: Imperfections, motors: Sequence[str], per_100_h: float
) -> dict[str, int]:
    """Return how many movements a motor that sticks at rest takes to be told from lost commands.

    A motor that is stuck where it had settled and one that misses n commands do the same, so each
    movement says -ln p(lost) for the fault, and no rule can do better:

        n = ceil( T / ((1 - l) (-(1 - l) ln p - l ln p_late)) ),    T = ln(movements / false alarms)

    with l the share of late starts, before which a movement is not seen.

    Returns:
        By motor; those that never lose a command are left out.
    """
    late, period_s = imperfections.timing.late_rate, np.mean(imperfections.schedule.period_s)
    period_s += late * np.mean(imperfections.timing.late_s)
    needed = np.log(100.0 * S_PER_H / period_s / (UNUSED * per_100_h))
    found = {}
    for motor in motors:
        entries = [entry for entry in imperfections.lost_commands if motor in entry.motors]
        lost, when_late = (
            sum(getattr(entry, name) for entry in entries) for name in ("rate", "rate_when_late")
        )
        if lost > 0.0 and (when_late > 0.0 or late == 0.0):
            each = -(1.0 - late) * np.log(lost) - (late * np.log(when_late) if late else 0.0)
            found[motor] = max(1, int(np.ceil(needed / ((1.0 - late) * each))))
    return found
