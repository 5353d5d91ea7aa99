"""Rows that `Store` writes, within its transaction."""

from __future__ import annotations

import hashlib
import json
import tomllib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import Any

import sqlalchemy as sa

from failuretwin import __version__
from failuretwin.core.errors import InputError, unknown_name
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.data_knowledge.records.history import (
    FaultEpisode,
    StoredCalibration,
    read_calibrations,
    read_counts,
    read_episodes,
)
from failuretwin.data_knowledge.records.log_files import LogFile
from failuretwin.data_knowledge.records.schema import (
    STANDING,
    Basis,
    SessionRows,
    add_rows,
    calibrations,
    diagnoses,
    findings,
    logs,
    notes,
    profiles,
    repairs,
    robots,
    runs,
    sensors,
    sessions,
    storable,
    withdrawals,
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


# What people state, and calibrations that replace each other.


def add_finding(
    connection: sa.Connection,
    robot: str,
    number: int,
    stated: Mapping[str, Any],
    withdraw: bool = False,
) -> FaultEpisode:
    """Store a finding about an episode, or withdraw the last one; return the episode.

    Raises:
        InputError: If there is no such robot or episode, or no finding to withdraw.
    """
    row = find_locked(connection, robot)
    episode = _numbered(connection, row, robot, number)
    standing = episode.finding if withdraw else None
    if withdraw and standing is None:
        raise InputError(
            f"episode {number} of {robot!r} has no finding to withdraw. Expected one of "
            "`failuretwin found`."
        )
    of = {"episode_id": episode.row, "withdraws": standing and standing.number}
    add_rows(connection, findings, [{**stated, **of}])
    return _numbered(connection, row, robot, number)


def _numbered(connection: sa.Connection, row: int, robot: str, number: int) -> FaultEpisode:
    all_of_it = read_episodes(connection, row)
    found = next((one for one in all_of_it if one.number == number), None)
    if found is None:
        valid = ", ".join(str(one.number) for one in all_of_it) or "none so far"
        raise InputError(f"robot {robot!r} has no episode {number}. Its episodes: {valid}.")
    return found


def withdraw_last_repair(
    connection: sa.Connection, robot: str, motor: str, stated: Mapping[str, Any]
) -> None:
    """Take back the last repair of a motor that stands.

    Raises:
        InputError: If there is no such robot, or no repair of that motor.
    """
    row = find_locked(connection, robot)
    query = sa.select(repairs.c.id).where(repairs.c.robot_id == row, STANDING)
    query = query.where(repairs.c.motor == motor).order_by(repairs.c.id.desc()).limit(1)
    last = connection.scalar(query)
    if last is None:
        raise InputError(
            f"{motor} of {robot!r} has no repair to withdraw. Expected one of "
            "`failuretwin repaired`."
        )
    add_rows(connection, withdrawals, [{**stated, "repair_id": last, "at": datetime.now(UTC)}])


def calibration_in_force(connection: sa.Connection, robot: int) -> StoredCalibration | None:
    """Return the calibration of a robot whose validity has no end; None: it has none."""
    stored = read_calibrations(connection, robot)
    return next((one for one in stored if one.valid_to is None), None)


def replace_calibration(
    connection: sa.Connection, robot: int, stated: Mapping[str, Any], start: datetime
) -> StoredCalibration:
    """Store a calibration that is valid from `start` on, and return the one in force.

    Raises:
        InputError: If the calibration in force is newer.
    """
    current = calibration_in_force(connection, robot)
    if current is not None and current.document == stated["document"]:
        return current
    if current is not None:
        _close(connection, current, start)
    row = {**stated, "robot_id": robot, "valid_from": start}
    add_rows(connection, calibrations, [row])
    return read_calibrations(connection, robot)[-1]


def _close(connection: sa.Connection, current: StoredCalibration, end: datetime) -> None:
    if end < current.valid_from:
        raise InputError(
            f"calibration {current.name!r} is valid from {current.valid_from:%Y-%m-%d %H:%M}, "
            f"after {end:%Y-%m-%d %H:%M}. Expected a later time."
        )
    row = calibrations.c.id == current.number
    connection.execute(sa.update(calibrations).where(row).values(valid_to=end))
