"""Rows that `Store` writes, within its transaction."""

from __future__ import annotations

import hashlib
import json
import tomllib
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import Any

import sqlalchemy as sa

from failuretwin import __version__
from failuretwin.core.errors import InputError, unknown_name
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.data_knowledge.records.episodes import (
    RAISED,
    SUSPECTED,
    Course,
    EpisodeTracker,
    NamedFault,
)
from failuretwin.data_knowledge.records.history import read_counts, read_episodes
from failuretwin.data_knowledge.records.log_files import LogFile
from failuretwin.data_knowledge.records.rows import Basis, SessionRows, add_rows
from failuretwin.data_knowledge.records.schema import (
    diagnoses,
    episode_events,
    episodes,
    logs,
    notes,
    profiles,
    robots,
    runs,
    sensors,
    sessions,
    storable,
)
from failuretwin.data_knowledge.records.unknown_faults import add_residuals
from failuretwin.digital_model.arm_classes import class_name
from failuretwin.digital_model.robot import Robot


def find_robot(connection: sa.Connection, name: str) -> int:
    """Return the row of a robot.

    Raises:
        InputError: If the store does not know it.
    """
    row = connection.scalar(sa.select(robots.c.id).where(robots.c.name == name))
    if row is None:
        known = list(connection.scalars(sa.select(robots.c.name).order_by(robots.c.name)))
        if not known:
            raise InputError(
                f"unknown robot {name!r}: the store is empty. Diagnose a log of it with --store."
            )
        raise unknown_name("robot", name, known)
    return row


def is_noted(connection: sa.Connection, robot: int, text: str) -> bool:
    """Return whether a note of a robot has just this text."""
    query = sa.select(notes.c.id).where(notes.c.robot_id == robot, notes.c.text == text)
    return connection.scalar(query.limit(1)) is not None


def keep_robot(connection: sa.Connection, name: str, profile: Robot | None) -> int:
    """Return the row of a robot, made if it is new, and keep other writers from it meanwhile."""
    if not name.strip() or not name.isprintable():
        raise InputError(f"robot name {name!r} cannot be shown. Expected plain characters.")
    row = _locked(connection, name)
    if row is None:
        # ON CONFLICT is the same on both engines; SQLAlchemy has it by dialect only.
        text = "INSERT INTO robots (name, added) VALUES (:name, :added) ON CONFLICT DO NOTHING"
        added = sa.bindparam("added", datetime.now(UTC), robots.c.added.type)
        connection.execute(
            sa.text(text).bindparams(sa.bindparam("name", name, robots.c.name.type), added)
        )
        row = find_locked(connection, name)
    if profile is not None:
        _keep_profile(connection, row, profile)
    return row


def find_locked(connection: sa.Connection, name: str) -> int:
    """Return the row of a known robot and keep other writers from it meanwhile."""
    row = _locked(connection, name)
    return find_robot(connection, name) if row is None else row


def _locked(connection: sa.Connection, name: str) -> int | None:
    query = sa.select(robots.c.id).where(robots.c.name == name)
    return connection.scalar(query.with_for_update())


def lock_robot(connection: sa.Connection, row: int) -> None:
    """Keep other writers from a robot until the transaction ends."""
    connection.execute(sa.select(robots.c.id).where(robots.c.id == row).with_for_update())


def _keep_profile(connection: sa.Connection, row: int, robot: Robot) -> None:
    document = robot.source.read_text("utf-8")
    checksum = text_checksum(document)
    known = sa.select(profiles.c.id).where(
        profiles.c.robot_id == row, profiles.c.sha256 == checksum
    )
    if connection.scalar(known) is not None:
        return
    stated: dict[str, Any] = {
        "name": robot.name,
        "arm_class": class_name(robot),
        "document": document,
    }
    stated |= {"robot_id": row, "sha256": checksum, "added": datetime.now(UTC)}
    (profile,) = add_rows(connection, profiles, [stated])
    tool = {"sensor_pose": robot.profile.sensor_pose}
    found = [("tool", tool), *((one.kind, asdict(one)) for one in robot.profile.sensors)]
    rows = [{"profile_id": profile, "kind": kind, "details": each} for kind, each in found]
    add_rows(connection, sensors, rows)


def motors_of(connection: sa.Connection, row: int) -> list[str]:
    """Return the motors of a robot by its last profile; empty if it has none."""
    query = sa.select(profiles.c.document).where(profiles.c.robot_id == row)
    document = connection.scalar(query.order_by(profiles.c.id.desc()).limit(1))
    return [motor["name"] for motor in tomllib.loads(document or "").get("motors", [])]


def text_checksum(text: str) -> str:
    """Return the SHA-256 of a text."""
    return hashlib.sha256(text.encode("utf-8", "replace")).hexdigest()


# Logs and runs.


@dataclass(frozen=True)
class StoredLog:
    """A log in the store: its row, and whether its contents were new."""

    row: int
    new: bool


def keep_log(connection: sa.Connection, robot: int, log: LogFile) -> StoredLog:
    """Return a log of the store, made if its contents are new."""
    if log.sha256 is not None:
        same = sa.select(logs.c.id).where(logs.c.robot_id == robot, logs.c.sha256 == log.sha256)
        row = connection.scalar(same)
        if row is not None:
            return StoredLog(row, new=False)
    stated: dict[str, Any] = {"path": log.path, "sha256": log.sha256, "bytes": log.size_bytes}
    stated |= {"robot_id": robot, "recorded": log.recorded, "added": datetime.now(UTC)}
    return StoredLog(add_rows(connection, logs, [stated])[0], new=True)


def keep_runs(
    connection: sa.Connection,
    log: StoredLog,
    names: Sequence[str],
    details: Sequence[Any],
    first: int = 0,
) -> list[int]:
    """Return the rows of the runs of a log, in its order, from number `first` on."""
    query = sa.select(runs.c.position, runs.c.name, runs.c.id).where(runs.c.log_id == log.row)
    query = query.where(runs.c.position.between(first, first + len(names) - 1))
    stored = [] if log.new else connection.execute(query).all()
    known = {(one.position, one.name): one.id for one in stored}
    wanted = list(enumerate(map(storable, names), first))
    rows = [
        {"log_id": log.row, "position": k, "name": name, "details": details[k - first]}
        for k, name in wanted
        if (k, name) not in known
    ]
    added = add_rows(connection, runs, rows)
    known |= {(one["position"], one["name"]): row for one, row in zip(rows, added, strict=True)}
    return [known[key] for key in wanted]


# Sessions.


def add_session(
    connection: sa.Connection, robot: int, basis: Basis, states: Iterable[str] = ()
) -> int:
    """Return the row of a new session, of a robot that other writers are kept from.

    Args:
        connection: Connection to the store.
        robot: Row of the robot.
        basis: What the session rests on.
        states: States of the diagnoses of runs that it adds.
    """
    diagnosed = Counter(read_counts(connection, robot)) + Counter(states)
    stated: dict[str, Any] = {"robot_id": robot, "calibration_id": basis.calibration}
    stated |= {"begun": datetime.now(UTC), "version": __version__, "command": basis.command}
    stated |= {"method": basis.method, "protocol": basis.protocol, "diagnosed": diagnosed}
    return add_rows(connection, sessions, [stated])[0]


# Diagnoses.

Kept = list[tuple[Diagnosis, int, str]]
"""Diagnoses with the row of their run and their digest."""


def new_diagnoses(
    connection: sa.Connection,
    log: StoredLog,
    diagnoses: Sequence[Diagnosis],
    run_rows: Sequence[int],
    calibration: int | None,
) -> tuple[Kept, set[int]]:
    """Return the diagnoses that are not stored yet, and the runs that have one already."""
    known = set() if log.new else _stored_digests(connection, run_rows)
    each = [
        (one, row, _digest_of(one, calibration))
        for one, row in zip(diagnoses, run_rows, strict=True)
    ]
    return [one for one in each if (one[1], one[2]) not in known], {row for row, _ in known}


def add_diagnoses(
    connection: sa.Connection, rows: SessionRows, kept: Kept, at: datetime
) -> list[int]:
    """Store diagnoses of runs, and return their rows."""
    stated = [{**_diagnosis_row(one, digest, at), "run_id": run} for one, run, digest in kept]
    return _add_diagnoses(connection, rows, stated, [(at, one) for one, _, _ in kept])


def add_session_diagnoses(
    connection: sa.Connection,
    rows: SessionRows,
    found: Sequence[tuple[datetime, Diagnosis | None]],
) -> list[int | None]:
    """Store diagnoses of the run of a session over time, and return their rows in that order."""
    kept, run = [(at, one) for at, one in found if one is not None], {"run_id": rows.run}
    stated = [{**_diagnosis_row(one, _digest_of(one, None), at), **run} for at, one in kept]
    numbers = iter(_add_diagnoses(connection, rows, stated, kept))
    return [None if one is None else next(numbers) for _, one in found]


def _add_diagnoses(
    connection: sa.Connection,
    rows: SessionRows,
    stated: Sequence[dict[str, Any]],
    found: Sequence[tuple[datetime, Diagnosis]],
) -> list[int]:
    added = add_rows(connection, diagnoses, [{**one, **rows.columns} for one in stated])
    add_residuals(connection, rows.robot, [(n, *one) for n, one in zip(added, found, strict=True)])
    return added


def _digest_of(diagnosis: Diagnosis, calibration: int | None) -> str:
    """Return the checksum of a diagnosis and what it rests on."""
    record = [diagnosis.to_record(), diagnosis.undecided, __version__, calibration]
    return text_checksum(json.dumps(record, sort_keys=True))


def _stored_digests(connection: sa.Connection, run_rows: Sequence[int]) -> set[tuple[int, str]]:
    """Return run and digest of all diagnoses of some runs of one log."""
    query = sa.select(diagnoses.c.run_id, diagnoses.c.digest)
    query = query.where(diagnoses.c.run_id.between(min(run_rows), max(run_rows)))
    return {(one.run_id, one.digest) for one in connection.execute(query)}


def _diagnosis_row(diagnosis: Diagnosis, digest: str, at: datetime) -> dict[str, Any]:
    """Return the columns of a diagnosis, without those that refer to other rows."""
    onset = diagnosis.onset_90 or (None, None)
    size = diagnosis.magnitude_90 or (None, None)
    return {
        "at": at,
        "state": diagnosis.state,
        "hypothesis": diagnosis.diagnosis,
        "probability": diagnosis.probability,
        "posterior": dict(diagnosis.posterior),
        "onset_s": diagnosis.onset_s,
        "onset_low_s": onset[0],
        "onset_high_s": onset[1],
        "magnitude": diagnosis.magnitude,
        "magnitude_unit": diagnosis.magnitude_unit,
        "magnitude_low": size[0],
        "magnitude_high": size[1],
        "verdict": diagnosis.verdict,
        "undecided": diagnosis.undecided,
        "quality": [storable(line) for line in diagnosis.quality],
        "digest": digest,
    }


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
) -> list[int]:
    """Write new and closed episodes and their events; `rows` are those of the diagnoses.

    Returns:
        Rows of the episodes.
    """
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
    return list(known.values())


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
