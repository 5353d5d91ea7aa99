"""What is stored as it happens: the work of an arm, a watch, and what is believed of a robot."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np

from failuretwin.app.remembering import RobotRecord
from failuretwin.app.shadow import Change, Snapshot
from failuretwin.app.terminal import tell
from failuretwin.connection.calibration.result import SETTLING_UNITS
from failuretwin.connection.links.base import STALE, Answer
from failuretwin.connection.links.statuses import LEVELS, statuses
from failuretwin.connection.tracked_diagnosis import History, start_of
from failuretwin.core.errors import OutputError
from failuretwin.core.foreign import reading
from failuretwin.core.hypothesis import RAISED
from failuretwin.data_knowledge.records import episodes
from failuretwin.data_knowledge.records.beliefs import Belief, BeliefLine
from failuretwin.data_knowledge.records.history import FaultEpisode
from failuretwin.data_knowledge.records.log_files import LogFile
from failuretwin.data_knowledge.records.offsets import MotorOffset
from failuretwin.data_knowledge.records.schema import Basis
from failuretwin.data_knowledge.records.sessions import Note, Session
from failuretwin.decision.acting.session import AlarmChange
from failuretwin.inference.together.life_filter import OFFSETS, LifeFilter

RETRY_S = 5.0
"""Time after which notes are tried again on a store that failed [s]."""
VERDICTS = ("CLEARED", *(state for state in LEVELS if state != STALE))
"""First words of changes that a diagnosis is behind."""


class SessionKeeper:
    """Stores the notes of a session; where the store fails, they wait and are tried again.

    Attributes:
        trouble: Why notes wait, for the user; empty: all are stored.

    Args:
        record: The robot in the store.
        begin: Begins the session, when the first notes are stored.
    """

    def __init__(self, record: RobotRecord, begin: Callable[[], Session]) -> None:
        self._record = record
        self._begin = begin
        self._session: Session | None = None
        self._waiting: list[Note] = []
        self._changed: dict[int, FaultEpisode] = {}
        self._due_s = -math.inf
        self.trouble = ""

    def _add(self, *notes: Note) -> None:
        """Store notes and all that waits, or let them wait."""
        self._waiting += notes
        if not self._waiting or time.monotonic() < self._due_s:
            return
        try:
            self._write()
        except OutputError as error:
            self._due_s = time.monotonic() + RETRY_S
            self.trouble = f"changes wait until they can be stored: {error}"

    def _write(self) -> None:
        if self._session is None:
            self._session = self._begin()
        changed = self._session.note(*self._waiting)
        self._changed |= {one.number: one for one in changed}
        self._waiting, self.trouble = [], ""


class WorkKeeper(SessionKeeper):
    """Stores the entries of a diary while the arm works, in a thread: the arm never waits for it.

    Args:
        record: The robot in the store.
        basis: The command, and what its results rest on.
    """

    def __init__(self, record: RobotRecord, basis: Basis) -> None:
        super().__init__(record, self._begun)
        self._basis = basis
        self._writer = ThreadPoolExecutor(1)

    def keep(self, at: datetime, entry: str | AlarmChange) -> None:
        """Store an entry of a time (UTC), soon."""
        self._writer.submit(self._add, _note(at, entry))

    def end(self) -> list[str]:
        """Store what waits, and return what was stored, in lines.

        Raises:
            OutputError: If it cannot be stored.
        """
        self._writer.shutdown()
        self._write()
        return self._record.remembered(self._basis.command, episodes=self._changed.values())

    def _begun(self) -> Session:
        record, command = self._record, self._basis.command
        log = LogFile(command, None, 0, datetime.now(UTC))
        return record.store.begin(
            record.name, self._basis, log=log, runs=[command], profile=record.profile
        )


def _note(at: datetime, entry: str | AlarmChange) -> Note:
    if isinstance(entry, str):
        return Note(at, entry)
    fault = entry.fault
    alarm = "" if fault is None else f"{fault.motor}:{fault.mode}"
    certain = fault is None or fault.state == episodes.RAISED
    return Note(at, entry.text, entry.diagnosis, alarm, certain, entry.final)


class WatchKeeper(SessionKeeper):
    """Keeps a watch as it happens: each change is stored before it is told.

    A store that fails does not end the watch.

    Args:
        record: The robot in the store.
        begin: Returns the session in it.
        log_begun: Start of the log that is replayed (UTC); None: the robot works now.
    """

    def __init__(
        self, record: RobotRecord, begin: Callable[[], Session], log_begun: datetime | None
    ) -> None:
        super().__init__(record, begin)
        self._log_begun = log_begun

    def keep(self, changes: Sequence[Change], answer: Answer) -> None:
        """Store changes, and the diagnosis behind the last one, before they are told."""
        self._add(
            *(
                self._note(one.stream_time, one.text, answer, one.text.startswith(VERDICTS))
                for one in changes
            )
        )

    def end(self, last: Snapshot, *, decided: bool) -> None:
        """Store the last answer; if `decided`, it counts as the diagnosis of a run.

        Raises:
            OutputError: If what waits cannot be stored.
        """
        text = f"ends: {statuses(last.answer, self._record.profile.motor_names)[0]}"
        note = self._note(last.stream_time, text, last.answer, decided)
        self._waiting.append(replace(note, alarm=None, final=note.diagnosis is not None))
        self._write()

    def _note(self, at_s: float, text: str, answer: Answer, verdict: bool) -> Note:
        at = datetime.now(UTC)
        if self._log_begun is not None:
            at = self._log_begun + timedelta(seconds=at_s)
        if not verdict or answer.state == STALE or answer.diagnosis is None:
            return Note(at, text)
        raised = answer.alarm.cause if answer.alarm.state == RAISED else ""
        return Note(at, text, answer.diagnosis, None if answer.diagnosis.undecided else raised)


def begin_watch(record: RobotRecord, source: str, basis: Basis, log: LogFile | None) -> WatchKeeper:
    """Begin the session of a watch.

    Args:
        record: The robot in the store.
        source: Name of the source.
        basis: What its answers rest on.
        log: The log that is replayed; None: the robot works now.

    Raises:
        OutputError: If it cannot be stored.
    """
    now = datetime.now(UTC)
    begun = now if log is None else log.recorded
    session = record.store.begin(
        record.name,
        basis,
        Note(begun, f"begins: {source}"),
        log=log or LogFile(source, None, 0, now),
        runs=["watch"],
        profile=record.profile,
    )
    return WatchKeeper(record, lambda: session, None if log is None else begun)


# The life of a robot: the posterior of yesterday is the prior of today.
#
# The random walk of the life filter is one a run, not one a day: a motor wears as it works, and no
# records exist from which a walk over idle time could be stated. So what is stored is what the next
# run begins with.

KEEP_EVERY_S = 300.0
"""Time between two states that a watch stores while it learns [s]."""


class LifeKeeper:
    """Keeps what is believed of a robot from command to command.

    Args:
        stored: The robot in the store.
        follower: The command that follows it: ``diagnose`` or ``watch``.
    """

    def __init__(self, stored: RobotRecord, follower: str) -> None:
        self._stored = stored
        self._follower = follower
        self._line = BeliefLine(follower, "")
        self._after: int | None = None
        self._keys: tuple[str, ...] = ()
        self._runs = self._stored_runs = 0
        self._due_s = -math.inf

    def resumed(self, start: LifeFilter) -> LifeFilter:
        """Return what the last command believed; where there is none, `start`.

        Raises:
            InputError: If it is damaged.
        """
        record = self._stored
        self._line = BeliefLine(self._follower, json.dumps(start_of(start), sort_keys=True))
        found, unused = record.store.belief(record.name, self._line)
        if unused:
            text = f"what {record.store.name} holds of {record.name} is not used: {unused}"
            tell(f"{text}. Beginning anew", err=True)
        if found is None:
            return start
        self._runs = self._stored_runs = found.runs
        self._after, self._keys = found.number, tuple(str(row.get("key", "")) for row in found.rows)
        where = f"{record.store.name}: belief {found.number}"
        with reading(where, "that of a robot", "It is damaged: restore the store from a copy."):
            return start.resumed(found.arrays)

    def history(self, start: LifeFilter, cold: bool) -> History:
        """Return what has been seen of the robot before."""
        life = self.resumed(start)
        return History(life, cold, keys=self._keys)

    def keep(
        self, life: LifeFilter, rows: Sequence[Mapping[str, Any]], at: datetime | None
    ) -> None:
        """Store what is believed after new runs, the last of which is of a time (UTC; None: now).

        Raises:
            OutputError: If it could not be stored, or another command went on meanwhile.
        """
        if not rows:
            return
        record, begun = self._stored, life.begun
        basis = Basis("track", record.calibration_number, f"begun with {begun.name}", "P1")
        belief = Belief(life.arrived, life.to_arrays(), rows, self._after)
        found = _offsets(life)
        self._after = record.store.keep_belief(
            record.name,
            basis,
            self._line,
            belief,
            at or datetime.now(UTC),
            found,
            profile=record.profile,
        )

    def keep_watch(self, life: LifeFilter | None) -> str:
        """Store what a watch has learned, and return what was stored, in a line.

        Raises:
            OutputError: If it could not be stored, or another command went on meanwhile.
        """
        known = f"{self._runs} runs of movements known before"
        if life is None or life.arrived <= self._runs:
            return f"tracked: nothing new to learn; {known}"
        self._keep_new(life)
        return f"tracked: {life.arrived - self._runs} runs of movements learned; {known}"

    def learned(self, life: LifeFilter) -> None:
        """Store what a watch has learned so far, every `KEEP_EVERY_S`.

        A watch goes on where that fails; `keep_watch` stores all at its end.
        """
        if time.monotonic() >= self._due_s:
            self._due_s = time.monotonic() + KEEP_EVERY_S
            with suppress(OutputError):
                self._keep_new(life)

    def _keep_new(self, life: LifeFilter) -> None:
        new = life.arrived - self._stored_runs
        if new > 0:
            self.keep(life, [{"runs": new, "movements": life.movements}], None)
            self._stored_runs = life.arrived


def _offsets(life: LifeFilter) -> list[MotorOffset]:
    """Return mean and deviation of theta, motor by motor."""
    mean, deviation = life.offsets
    return [
        MotorOffset(motor, name, float(mean[k, i]), float(deviation[k, i]), SETTLING_UNITS[name])
        for i, motor in enumerate(life.model.motor_names)
        for k, name in enumerate(OFFSETS)
        if np.isfinite(deviation[k, i])
    ]
