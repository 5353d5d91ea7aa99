"""Alarms of an arm at work: when it is sure of a fault, and when that fault is over.

An alarm names the believed fault once a diagnosis of the latest movements is sure of it, by the
rule of `failuretwin.data_knowledge.records.episodes`. It holds until the belief is dropped: the
reaction to a fault removes the evidence for it, so a less sure diagnosis later is no repair.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass

from failuretwin.core.hypothesis import Diagnosis, Fault
from failuretwin.data_knowledge.records.episodes import RAISED, NamedFault, named_faults
from failuretwin.decision.acting.belief import Belief, Judgement
from failuretwin.decision.streaming.set_up_watch import PROOF


@dataclass(frozen=True)
class AlarmChange:
    """A change of the alarm.

    Attributes:
        text: A sentence.
        diagnosis: The diagnosis of the latest movements behind it.
        fault: The fault that the alarm names; None: it is clear.
        final: Whether the diagnosis counts as that of a whole run.
    """

    text: str
    diagnosis: Diagnosis
    fault: NamedFault | None
    final: bool = False


class FaultAlarm:
    """Follows the belief of an arm at work.

    Calls `report` with each change of the alarm.
    """

    def __init__(self, report: Callable[[AlarmChange], None]) -> None:
        self._report = report
        self._named: NamedFault | None = None
        self._last: Judgement | None = None
        self._free = 0

    def see(self, belief: Belief, judgement: Judgement | None) -> None:
        """Take the belief after a movement, and the judgement of it; None: there is none."""
        if judgement is None:
            return
        self._last = judgement
        believed = belief.believed
        self._free = self._free + 1 if believed is None else 0
        before = self._named
        if believed is None and before is None:
            return
        found = judgement.diagnosis(belief.since_s)
        self._named = now = None if believed is None else _named(believed.fault, found, before)
        if now is not None and now != before:
            self._report(AlarmChange(f"ALARM: {found.verdict}", found, now))
        elif now is None and before is not None:
            text = f"CLEARED: {before.motor}:{before.mode} is over"
            self._report(AlarmChange(text, found, None))

    def end(self) -> None:
        """Report the last diagnosis if it counts as that of a run.

        It does after more than `PROOF` movements without a believed fault.
        """
        if self._last is None or self._free <= PROOF:
            return
        found = self._last.diagnosis()
        self._report(AlarmChange(f"ends: {found.verdict}", found, None, final=True))


def _named(fault: Fault, found: Diagnosis, before: NamedFault | None) -> NamedFault | None:
    """Return the fault to name: the believed one if a diagnosis is sure of it, or as before."""
    own = before if before is not None and before.motor == fault.motor else None
    if own is not None and own.mode == fault.mode and own.state == RAISED:
        return own
    named = named_faults(found)
    return next((one for one in named if (one.motor, one.mode) == astuple(fault)), own)
