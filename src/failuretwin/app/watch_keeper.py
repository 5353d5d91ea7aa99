"""A watch in the store: each change is stored before it is told."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np

from failuretwin.app.remembering import RobotRecord
from failuretwin.app.shadow import Change, Snapshot
from failuretwin.connection.links.base import STALE, Answer
from failuretwin.connection.links.statuses import LEVELS, statuses
from failuretwin.core.errors import OutputError
from failuretwin.core.hypothesis import RAISED
from failuretwin.data_knowledge.records.log_files import LogFile
from failuretwin.data_knowledge.records.rows import Basis
from failuretwin.data_knowledge.records.sessions import Note, Session

RETRY_S = 5.0
"""Time after which a watch tries again to write to a store that failed [s]."""
VERDICTS = ("CLEARED", *(state for state in LEVELS if state != STALE))
"""First words of changes that a diagnosis is behind."""


class WatchKeeper:
    """Keeps a watch as it happens: each change is stored before it is told.

    A store that fails does not end the watch: changes wait, and are written when it works again.

    Attributes:
        trouble: Why changes wait, for the user; empty: all are stored.

    Args:
        record: The robot in the store.
        session: The session in it.
        log_begun: Start of the log that is replayed (UTC); None: the robot works now.
    """

    def __init__(
        self,
        record: RobotRecord,
        session: Session,
        log_begun: datetime | None,
    ) -> None:
        self._record = record
        self._session = session
        self._log_begun = log_begun
        self._waiting: list[Note] = []
        self._due_s = -np.inf
        self.trouble = ""

    def keep(self, changes: Sequence[Change], answer: Answer) -> None:
        """Store changes, and the diagnosis behind the last one, before they are told."""
        for change in changes:
            verdict = change.text.startswith(VERDICTS)
            self._waiting.append(self._note(change.stream_time, change.text, answer, verdict))
        if self._waiting and time.monotonic() >= self._due_s:
            self._try()

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
        known = verdict and answer.state != STALE and answer.diagnosis is not None
        if not known or answer.diagnosis is None:
            return Note(at, text)
        alarm = None if answer.diagnosis.undecided else _raised(answer)
        return Note(at, text, answer.diagnosis, alarm)

    def _try(self) -> None:
        try:
            self._write()
        except OutputError as error:
            self._due_s = time.monotonic() + RETRY_S
            self.trouble = f"changes wait until they can be stored: {error}"

    def _write(self) -> None:
        self._session.note(*self._waiting)
        self._waiting, self.trouble = [], ""


def _raised(answer: Answer) -> str:
    """Return the fault that an alarm names; empty: none is raised."""
    return answer.alarm.cause if answer.alarm.state == RAISED else ""


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
    return WatchKeeper(record, session, None if log is None else begun)
