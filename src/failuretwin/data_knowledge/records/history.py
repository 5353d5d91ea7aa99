"""The history of one robot, as values."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import sqlalchemy as sa

from failuretwin.core.errors import counted
from failuretwin.core.hypothesis import Fault
from failuretwin.data_knowledge.records.episodes import CLEARED, CONFIRMED, RAISED, SUSPECTED
from failuretwin.data_knowledge.records.offsets import Drift, read_drifts
from failuretwin.data_knowledge.records.schema import (
    STANDING,
    calibrations,
    diagnoses,
    episode_events,
    episodes,
    findings,
    notes,
    profiles,
    repairs,
    runs,
    sessions,
)
from failuretwin.failure_behavior.registry import plain_fault

RECENT = 20
"""Number of diagnoses, and of notes, that a history lists; other diagnoses are counted."""
WRONG, OTHER_CAUSE = "wrong", "other cause"
"""Verdicts of a finding, in addition to `CONFIRMED`."""


@dataclass(frozen=True)
class Finding:
    """What a person found about an episode.

    Attributes:
        number: Its number in the store.
        verdict: ``confirmed``, ``wrong`` or ``other cause``.
        cause: The cause; empty if not stated.
        person: Who found it; empty if not stated.
        note: Anything else.
        at: When it was stated (UTC).
        withdrawn_when: When it was withdrawn (UTC); None: it stands.
    """

    number: int
    verdict: str
    cause: str
    person: str
    note: str
    at: datetime
    withdrawn_when: datetime | None = None


@dataclass(frozen=True)
class FaultEpisode:
    """A fault of one motor from its first diagnosis to the healthy one that clears it.

    Attributes:
        row: Its row in the store.
        number: Its number at this robot, from 1.
        motor: The motor.
        mode: The fault mode.
        since: Time of the first diagnosis (UTC).
        until: Time of the diagnosis that cleared it (UTC); None: open.
        raised: Whether the mode became certain.
        findings: What people found, the oldest first, withdrawn ones included.
    """

    row: int
    number: int
    motor: str
    mode: str
    since: datetime
    until: datetime | None
    raised: bool
    findings: tuple[Finding, ...] = ()

    @property
    def finding(self) -> Finding | None:
        """The last finding that stands; None: none does."""
        standing = [one for one in self.findings if one.withdrawn_when is None]
        return standing[-1] if standing else None

    @property
    def fault(self) -> str:
        """The fault as a person would say it."""
        return plain_fault(Fault(self.motor, self.mode))

    @property
    def refuted(self) -> bool:
        """Whether a person found it wrong, or another cause."""
        return self.finding is not None and self.finding.verdict in (WRONG, OTHER_CAUSE)

    @property
    def state(self) -> str:
        """``suspected``, ``raised``, ``confirmed`` or ``cleared``."""
        if self.until is not None:
            return CLEARED
        if self.finding is not None and self.finding.verdict == CONFIRMED:
            return CONFIRMED
        return RAISED if self.raised else SUSPECTED


@dataclass(frozen=True)
class StoredCalibration:
    """A calibration and the time in which it holds.

    Attributes:
        number: Its number in the store.
        name: Its name.
        protocol: Real data it rests on: P0c or P1.
        document: The calibration file (TOML).
        valid_from: Start of its validity (UTC).
        valid_to: End of its validity (UTC); None: in force.
    """

    number: int
    name: str
    protocol: str
    document: str
    valid_from: datetime
    valid_to: datetime | None


@dataclass(frozen=True)
class Repair:
    """A repair of a motor: when (UTC), the replaced part, who did it, and a note."""

    at: datetime
    motor: str
    part: str
    person: str
    note: str


@dataclass(frozen=True)
class StoredDiagnosis:
    """A diagnosis in a history: time of its run (UTC), run, state, verdict and command."""

    at: datetime
    run: str
    state: str
    verdict: str
    command: str


@dataclass(frozen=True)
class StoredNote:
    """What happened in a session: when (UTC), the command, and a sentence."""

    at: datetime
    command: str
    text: str


@dataclass(frozen=True)
class Moment:
    """A line of a timeline: when (UTC), the kind of event, and a sentence."""

    at: datetime
    kind: str
    text: str


@dataclass(frozen=True)
class History:
    """What the store knows of a robot.

    Attributes:
        robot: Its name.
        kind: Name of its profile; empty if it has none.
        counts: Number of diagnoses of runs by state.
        recent: The last `RECENT` diagnoses of runs, the oldest first.
        notes: What happened in the last sessions, the last `RECENT` notes, the oldest first.
        episodes: Fault episodes, the oldest first.
        calibrations: Calibrations, the oldest first.
        repairs: Repairs, the oldest first.
        drifts: Offsets of the motors over time.
    """

    robot: str
    kind: str
    counts: Mapping[str, int]
    recent: tuple[StoredDiagnosis, ...]
    notes: tuple[StoredNote, ...]
    episodes: tuple[FaultEpisode, ...]
    calibrations: tuple[StoredCalibration, ...]
    repairs: tuple[Repair, ...]
    drifts: tuple[Drift, ...] = ()

    @property
    def open_episodes(self) -> list[FaultEpisode]:
        """Episodes that are not cleared and were not found wrong."""
        return [one for one in self.episodes if one.until is None and not one.refuted]

    @property
    def health(self) -> str:
        """One sentence on the state of the robot, its days in UTC."""
        return self.health_by("{:%Y-%m-%d}".format)

    def health_by(self, day: Callable[[datetime], str]) -> str:
        """Return the same sentence with days in another zone."""
        if self.open_episodes:
            return "; ".join(
                f"{one.fault}, {one.state}, since {day(one.since)}" for one in self.open_episodes
            )
        if not self.recent:
            return "no open fault" if self.notes else "no run has been diagnosed"
        return f"no open fault; last run ({day(self.recent[-1].at)}): {self.recent[-1].state}"

    @property
    def timeline(self) -> list[Moment]:
        """Everything with its time, the oldest first; of diagnoses and notes only the last."""
        moments = []
        for one in self.recent:
            kind = "run" if one.command == "diagnose" else one.command
            moments.append(Moment(one.at, kind, f"{one.run}: {one.verdict}"))
        moments += [Moment(one.at, one.command, one.text) for one in self.notes]
        for episode in self.episodes:
            moments += _moments_of(episode)
        for calibration in self.calibrations:
            text = f"{calibration.name} ({calibration.protocol}) in force"
            moments.append(Moment(calibration.valid_from, "calibration", text))
        moments += [Moment(one.at, "repair", _repair_text(one)) for one in self.repairs]
        return sorted(moments, key=lambda moment: moment.at)


def _moments_of(episode: FaultEpisode) -> list[Moment]:
    name = f"episode {episode.number}"
    start = f"{name} begins: {episode.fault}"
    moments = [Moment(episode.since, "episode", start)]
    if episode.until is not None:
        moments.append(Moment(episode.until, "episode", f"{name} cleared"))
    for one in episode.findings:
        said = ", ".join(filter(None, (one.verdict, one.cause, one.note)))
        by = f" ({one.person})" if one.person else ""
        moments.append(Moment(one.at, "finding", f"{name}: {said}{by}"))
        if one.withdrawn_when is not None:
            text = f"{name}: finding {one.verdict!r} withdrawn"
            moments.append(Moment(one.withdrawn_when, "finding", text))
    return moments


def _repair_text(repair: Repair) -> str:
    part = f"{repair.part} replaced" if repair.part else "repaired"
    note = f", {repair.note}" if repair.note else ""
    by = f" ({repair.person})" if repair.person else ""
    return f"{repair.motor.replace('_', ' ')}: {part}{note}{by}"


# Reading from the store.


def read_history(connection: sa.Connection, row: int, robot: str) -> History:
    """Return the history of a robot, given its row and name."""
    return History(
        robot,
        _kind(connection, row),
        read_counts(connection, row),
        _recent(connection, row),
        _notes(connection, row),
        read_episodes(connection, row),
        read_calibrations(connection, row),
        _repairs(connection, row),
        read_drifts(connection, row),
    )


def _kind(connection: sa.Connection, row: int) -> str:
    newest = sa.select(profiles.c.name).where(profiles.c.robot_id == row)
    return connection.scalar(newest.order_by(profiles.c.id.desc()).limit(1)) or ""


def read_counts(connection: sa.Connection, row: int) -> dict[str, int]:
    """Return the number of diagnoses of a robot by state, without those behind notes."""
    last = sa.select(sessions.c.diagnosed).where(sessions.c.robot_id == row)
    return connection.scalar(last.order_by(sessions.c.id.desc()).limit(1)) or {}


def _recent(connection: sa.Connection, row: int) -> tuple[StoredDiagnosis, ...]:
    query = (
        sa.select(diagnoses.c.at, runs.c.name, diagnoses.c.state, diagnoses.c.verdict)
        .add_columns(sessions.c.command)
        .join(runs, runs.c.id == diagnoses.c.run_id)
        .join(sessions, sessions.c.id == diagnoses.c.session_id)
        .where(diagnoses.c.robot_id == row)
        .where(~sa.exists().where(notes.c.diagnosis_id == diagnoses.c.id))
        .order_by(diagnoses.c.at.desc(), diagnoses.c.id.desc())
        .limit(RECENT)
    )
    return tuple(StoredDiagnosis(*found) for found in connection.execute(query))[::-1]


def _notes(connection: sa.Connection, row: int) -> tuple[StoredNote, ...]:
    query = (
        sa.select(notes.c.at, sessions.c.command, notes.c.text)
        .join(sessions, sessions.c.id == notes.c.session_id)
        .where(notes.c.robot_id == row)
        .order_by(notes.c.at.desc(), notes.c.id.desc())
        .limit(RECENT)
    )
    return tuple(StoredNote(*found) for found in connection.execute(query))[::-1]


def read_episodes(
    connection: sa.Connection, row: int, *which: sa.ColumnElement[bool]
) -> tuple[FaultEpisode, ...]:
    """Return the fault episodes of a robot for which conditions hold, the oldest first."""
    of = sa.and_(episodes.c.robot_id == row, *which)
    rows = connection.execute(sa.select(episodes).where(of).order_by(episodes.c.number)).all()
    if not rows:
        return ()
    raised = sa.select(episode_events.c.episode_id).join(episodes)
    certain = set(connection.scalars(raised.where(of, episode_events.c.state == RAISED)))
    found = _findings(connection, sa.select(findings).join(episodes).where(of))
    return tuple(
        FaultEpisode(
            *(one.id, one.number, one.motor, one.mode, one.since, one.until),
            one.id in certain,
            tuple(found.get(one.id, ())),
        )
        for one in rows
    )


def _findings(connection: sa.Connection, query: sa.Select[Any]) -> dict[int, list[Finding]]:
    """Return the findings of each episode, with those that were withdrawn marked."""
    rows = connection.execute(query.order_by(findings.c.id)).all()
    withdrawn = {one.withdraws: one.at for one in rows if one.withdraws is not None}
    found: dict[int, list[Finding]] = {}
    for one in rows:
        if one.withdraws is None:
            stated = (one.id, one.verdict, one.cause, one.person, one.note, one.at)
            finding = Finding(*stated, withdrawn.get(one.id))
            found.setdefault(one.episode_id, []).append(finding)
    return found


def read_calibrations(connection: sa.Connection, row: int) -> tuple[StoredCalibration, ...]:
    """Return the calibrations of a robot, the oldest first."""
    query = sa.select(calibrations).where(calibrations.c.robot_id == row)
    ordered = query.order_by(calibrations.c.valid_from, calibrations.c.id)
    return tuple(stored_calibration(one) for one in connection.execute(ordered))


def stored_calibration(one: Any) -> StoredCalibration:
    """Return the calibration of a row."""
    validity = (one.valid_from, one.valid_to)
    return StoredCalibration(one.id, one.name, one.protocol, one.document, *validity)


def _repairs(connection: sa.Connection, row: int) -> tuple[Repair, ...]:
    query = sa.select(repairs).where(repairs.c.robot_id == row, STANDING)
    rows = connection.execute(query.order_by(repairs.c.at, repairs.c.id))
    return tuple(Repair(one.at, one.motor, one.part, one.person, one.note) for one in rows)


def state_counts(counts: Mapping[str, int]) -> str:
    """Return counts by state in words: "2 runs faulty, 1 run healthy"."""
    ordered: Iterable[tuple[str, int]] = sorted(counts.items(), key=lambda item: -item[1])
    return ", ".join(f"{counted(count, 'run')} {state}" for state, count in ordered)
