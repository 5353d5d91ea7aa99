"""Sessions: what a command did with a robot, stored as it happens, and the episodes that follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import sqlalchemy as sa

from failuretwin.core.hypothesis import Diagnosis, Hypothesis
from failuretwin.data_knowledge.records import writing
from failuretwin.data_knowledge.records.database import Database
from failuretwin.data_knowledge.records.episodes import (
    RAISED,
    SUSPECTED,
    Course,
    EpisodeTracker,
    NamedFault,
)
from failuretwin.data_knowledge.records.history import FaultEpisode, read_episodes
from failuretwin.data_knowledge.records.schema import (
    SessionRows,
    add_rows,
    diagnoses,
    episode_events,
    episodes,
    notes,
)


@dataclass(frozen=True)
class Note:
    """Something that happened in a session.

    Attributes:
        at: When (UTC).
        text: A sentence.
        diagnosis: The diagnosis behind it; None: there is none.
        alarm: Fault that an alarm names, such as ``motor_3:stuck``; empty: the alarm is clear;
            None: there is no alarm rule, or its state is not known.
        certain: Whether the mode of that fault is certain, not only its motor.
        final: Whether the diagnosis counts as that of a whole run.
    """

    at: datetime
    text: str
    diagnosis: Diagnosis | None = None
    alarm: str | None = None
    certain: bool = True
    final: bool = False


class Session:
    """A session that is going on; `Store.begin` returns one.

    Attributes:
        changed: Episodes that its first notes changed.

    Args:
        database: The database.
        rows: Rows that it refers to.
        first: What its first notes changed.
    """

    def __init__(self, database: Database, rows: SessionRows, first: Followed) -> None:
        self._database = database
        self._rows = rows
        self._alarmed = first.alarmed
        self.changed = first.episodes

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
            followed = follow_notes(connection, self._rows, happened, self._alarmed)
        self._alarmed = followed.alarmed
        return followed.episodes


@dataclass(frozen=True)
class Followed:
    """What notes have changed.

    Attributes:
        episodes: Episodes that began, were raised or were cleared.
        alarmed: Motors that the alarm of the session names now.
    """

    episodes: tuple[FaultEpisode, ...]
    alarmed: tuple[str, ...]


def follow_notes(
    connection: sa.Connection,
    rows: SessionRows,
    happened: Sequence[Note],
    alarmed: tuple[str, ...] = (),
) -> Followed:
    """Write notes of a session and their diagnoses, and let the episodes follow them.

    Args:
        connection: Connection to the store.
        rows: Rows that the session refers to.
        happened: The notes, the oldest first.
        alarmed: Motors that the alarm of the session named before.
    """
    if all(one.diagnosis is None for one in happened):
        _add_notes(connection, rows, happened, [None] * len(happened))
        return Followed((), alarmed)
    tracker = tracker_of(connection, rows.robot)
    latest = latest_run(connection, rows.robot)
    given = [(one.at, one.diagnosis) for one in happened]
    behind = writing.add_session_diagnoses(connection, rows, given)
    for number, one in enumerate(happened):
        if behind[number] is not None and (latest is None or one.at >= latest):
            alarmed = _follow_note(tracker, one, number, alarmed)
    _add_notes(connection, rows, happened, behind)
    return Followed(keep_episodes(connection, rows.robot, tracker.changed, behind), alarmed)


def _follow_note(
    tracker: EpisodeTracker, note: Note, number: int, alarmed: tuple[str, ...]
) -> tuple[str, ...]:
    """Let the episodes follow a note, and return the motors that its alarm names."""
    if note.final and note.diagnosis is not None:
        tracker.follow(note.diagnosis, note.at, number)
    if note.alarm is None:
        return alarmed
    faults = Hypothesis.parse(note.alarm).faults if note.alarm else ()
    state = RAISED if note.certain else SUSPECTED
    named = [NamedFault(fault.motor, fault.mode, state) for fault in faults]
    tracker.follow_alarm(alarmed, named, note.at, number)
    return tuple(fault.motor for fault in named)


def _add_notes(
    connection: sa.Connection,
    rows: SessionRows,
    happened: Sequence[Note],
    behind: Sequence[int | None],
) -> None:
    """Write notes of a session; `behind` are the rows of their diagnoses."""
    stated = [
        {**rows.columns, "at": one.at, "text": one.text, "diagnosis_id": row}
        for one, row in zip(happened, behind, strict=True)
    ]
    add_rows(connection, notes, stated)


# Episodes.


def latest_run(connection: sa.Connection, robot: int) -> datetime | None:
    """Return the time of the last diagnosed run of a robot (UTC)."""
    of = sa.select(sa.func.max(diagnoses.c.at)).where(diagnoses.c.robot_id == robot)
    return connection.scalar(of)


def tracker_of(connection: sa.Connection, robot: int) -> EpisodeTracker:
    """Return the tracker of a robot with its open episodes."""
    return EpisodeTracker(
        Course(
            NamedFault(one.motor, one.mode, RAISED if one.raised else SUSPECTED),
            one.since,
            one.row,
            one.refuted,
        )
        for one in read_episodes(connection, robot, episodes.c.until.is_(None))
    )


def keep_episodes(
    connection: sa.Connection, robot: int, changed: Sequence[Course], rows: Sequence[int | None]
) -> tuple[FaultEpisode, ...]:
    """Write new and closed episodes and their events, and return these episodes.

    `rows` are those of the diagnoses.
    """
    if not changed:
        return ()
    fresh = [course for course in changed if course.row is None]
    added = iter(add_rows(connection, episodes, _new_episodes(connection, robot, fresh)))
    known = {id(course): course.row or next(added) for course in changed}
    for course in changed:
        if course.row is not None and course.until is not None:
            close = sa.update(episodes).where(episodes.c.id == course.row)
            connection.execute(close.values(until=course.until))
    events = [
        {"episode_id": known[id(one)], "diagnosis_id": rows[number], "state": state, "at": at}
        for one in changed
        for state, at, number in one.events
    ]
    add_rows(connection, episode_events, events)
    return read_episodes(connection, robot, episodes.c.id.in_(known.values()))


def _new_episodes(
    connection: sa.Connection, robot: int, fresh: Sequence[Course]
) -> list[dict[str, Any]]:
    if not fresh:
        return []
    last = sa.select(sa.func.max(episodes.c.number)).where(episodes.c.robot_id == robot)
    first = (connection.scalar(last) or 0) + 1
    return [
        {
            "robot_id": robot,
            "number": number,
            "motor": course.fault.motor,
            "mode": course.fault.mode,
            "since": course.since,
            "until": course.until,
        }
        for number, course in enumerate(fresh, start=first)
    ]
