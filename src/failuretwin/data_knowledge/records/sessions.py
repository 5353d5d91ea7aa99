"""Sessions: what a command did with a robot, stored as it happens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import sqlalchemy as sa

from failuretwin.core.hypothesis import Diagnosis, Hypothesis
from failuretwin.data_knowledge.records import writing
from failuretwin.data_knowledge.records.database import Database
from failuretwin.data_knowledge.records.episodes import RAISED, EpisodeTracker, NamedFault
from failuretwin.data_knowledge.records.history import FaultEpisode, read_episodes
from failuretwin.data_knowledge.records.rows import SessionRows, add_rows
from failuretwin.data_knowledge.records.schema import notes


@dataclass(frozen=True)
class Note:
    """Something that happened in a session.

    Attributes:
        at: When (UTC).
        text: A sentence.
        diagnosis: The diagnosis behind it; None: there is none.
        alarm: Fault that an alarm names, such as ``motor_3:stuck``; empty: the alarm is clear;
            None: there is no alarm rule, or its state is not known.
        final: Whether the diagnosis counts as that of a whole run.
    """

    at: datetime
    text: str
    diagnosis: Diagnosis | None = None
    alarm: str | None = None
    final: bool = False


class Session:
    """A session that is going on; `Store.begin` returns one.

    Args:
        database: The database.
        rows: Rows that it refers to.
    """

    def __init__(self, database: Database, rows: SessionRows) -> None:
        self._database = database
        self._rows = rows
        self._alarmed: tuple[str, ...] = ()

    @property
    def number(self) -> int:
        """Its number in the store."""
        return self._rows.session

    def note(self, *happened: Note) -> tuple[FaultEpisode, ...]:
        """Store notes in one transaction, and return the episodes that changed.

        Raises:
            OutputError: If nothing could be stored.
        """
        with self._database.writing() as connection:
            writing.lock_robot(connection, self._rows.robot)
            changed, alarmed = self._follow(connection, happened)
            known = read_episodes(connection, self._rows.robot) if changed else ()
        self._alarmed = alarmed
        return tuple(one for one in known if one.row in changed)

    def _follow(
        self, connection: sa.Connection, happened: Sequence[Note]
    ) -> tuple[list[int], tuple[str, ...]]:
        """Write notes, their diagnoses and the episodes; return these, and the alarmed motors."""
        robot, alarmed = self._rows.robot, self._alarmed
        tracker = writing.tracker_of(connection, robot)
        latest = writing.latest_run(connection, robot)
        behind = writing.add_session_diagnoses(
            connection, self._rows, [(one.at, one.diagnosis) for one in happened]
        )
        for number, one in enumerate(happened):
            if behind[number] is not None and (latest is None or one.at >= latest):
                alarmed = _follow_note(tracker, one, number, alarmed)
        add_notes(connection, self._rows, happened, behind)
        return writing.keep_episodes(connection, robot, tracker.changed, behind), alarmed


def _follow_note(
    tracker: EpisodeTracker, note: Note, number: int, alarmed: tuple[str, ...]
) -> tuple[str, ...]:
    """Let the episodes follow a note, and return the motors that its alarm names."""
    if note.final and note.diagnosis is not None:
        tracker.follow(note.diagnosis, note.at, number)
    if note.alarm is None:
        return alarmed
    faults = Hypothesis.parse(note.alarm).faults if note.alarm else ()
    named = [NamedFault(fault.motor, fault.mode, RAISED) for fault in faults]
    tracker.follow_alarm(alarmed, named, note.at, number)
    return tuple(fault.motor for fault in named)


def add_notes(
    connection: sa.Connection,
    rows: SessionRows,
    happened: Sequence[Note],
    behind: Sequence[int | None] = (),
) -> None:
    """Write notes of a session; `behind` are the rows of their diagnoses."""
    of = {"session_id": rows.session, "robot_id": rows.robot}
    known = behind or [None] * len(happened)
    stated: list[dict[str, Any]] = [
        {**of, "at": one.at, "text": one.text, "diagnosis_id": row}
        for one, row in zip(happened, known, strict=True)
    ]
    add_rows(connection, notes, stated)
