"""All robots of a store at a glance, and the runs of one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime

import sqlalchemy as sa

from failuretwin.data_knowledge.records.episodes import CONFIRMED
from failuretwin.data_knowledge.records.fleet import REFUTED, judged, kinds
from failuretwin.data_knowledge.records.schema import diagnoses, logs, runs

NEWEST = 200
"""Number of runs that are listed at most."""


@dataclass(frozen=True)
class RobotGlance:
    """A robot and its last diagnosis.

    Attributes:
        robot: Its name.
        kind: Name of its profile; empty if it has none.
        at: When its last run was (UTC); None: it has none.
        state: State of that diagnosis; empty: none.
        verdict: Its verdict.
        faults: Open episodes that nobody refuted, ``MOTOR:MODE`` with whether each is confirmed.
        remarks: Why it allows no verdict, and problems of its log, a line each.
    """

    robot: str
    kind: str
    at: datetime | None
    state: str
    verdict: str
    faults: Mapping[str, bool]
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class StoredRun:
    """A diagnosed run of a robot.

    Attributes:
        row: Row of the diagnosis in the store.
        at: When it was recorded (UTC).
        log: Path of its log.
        position: Its number in the log.
        name: Its name.
        verdict: The verdict.
        posterior: Probability of every hypothesis.
        onset_s: Onset of the fault [s]; None: not known.
    """

    row: int
    at: datetime
    log: str
    position: int
    name: str
    verdict: str
    posterior: Mapping[str, float]
    onset_s: float | None


def read_overview(connection: sa.Connection) -> tuple[RobotGlance, ...]:
    """Return all robots, by name."""
    own = diagnoses.alias()
    last = (
        sa.select(own.c.id)
        .where(own.c.robot_id == kinds.c.robot_id)
        .order_by(own.c.at.desc(), own.c.id.desc())
        .limit(1)
        .scalar_subquery()
    )
    query = (
        sa.select(kinds.c.robot_id, kinds.c.robot, kinds.c.kind)
        .add_columns(diagnoses.c.at, diagnoses.c.state, diagnoses.c.verdict)
        .add_columns(diagnoses.c.undecided, diagnoses.c.quality)
        .select_from(kinds.outerjoin(diagnoses, diagnoses.c.id == last))
        .order_by(kinds.c.robot)
    )
    faults: dict[int, dict[str, bool]] = {}
    standing = sa.select(judged).where(judged.c.until.is_(None), ~REFUTED)
    for one in connection.execute(standing):
        name = f"{one.motor}:{one.mode}"
        faults.setdefault(one.robot_id, {})[name] = one.verdict == CONFIRMED
    return tuple(
        RobotGlance(
            one.robot,
            one.kind,
            one.at,
            one.state or "",
            one.verdict or "",
            faults.get(one.robot_id, {}),
            (one.undecided or "", *(one.quality or ())),
        )
        for one in connection.execute(query)
    )


def read_runs_of(connection: sa.Connection, row: int) -> tuple[StoredRun, ...]:
    """Return the last `NEWEST` diagnosed runs of a robot, the newest first."""
    query = (
        sa.select(diagnoses.c.id, diagnoses.c.at, logs.c.path, runs.c.position, runs.c.name)
        .add_columns(diagnoses.c.verdict, diagnoses.c.posterior, diagnoses.c.onset_s)
        .join(runs, runs.c.id == diagnoses.c.run_id)
        .join(logs, logs.c.id == runs.c.log_id)
        .where(diagnoses.c.robot_id == row)
        .order_by(diagnoses.c.at.desc(), diagnoses.c.id.desc())
        .limit(NEWEST)
    )
    return tuple(StoredRun(*one) for one in connection.execute(query))
