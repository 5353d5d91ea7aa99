"""Ready questions to the store."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

import sqlalchemy as sa

from failuretwin.core.errors import check_name
from failuretwin.data_knowledge.records import CHECK_DAYS
from failuretwin.data_knowledge.records.episodes import CONFIRMED
from failuretwin.data_knowledge.records.history import (
    OTHER_CAUSE,
    WRONG,
    StoredCalibration,
    stored_calibration,
)
from failuretwin.data_knowledge.records.schema import (
    calibrations,
    diagnoses,
    episode_events,
    episodes,
    findings,
    profiles,
    robots,
)
from failuretwin.data_knowledge.records.unknown_faults import (
    read_episodes_of_unknown,
    unknown_groups,
)

DAY_S = 86_400.0


@dataclass(frozen=True)
class QueryAnswer:
    """Answer to a ready question.

    Attributes:
        name: Name of the question.
        title: The question in words.
        columns: Names of the columns, with units.
        rows: Values; times are UTC, None is unknown.
    """

    name: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]


@dataclass(frozen=True)
class FleetFaults:
    """Confirmed faults of the robots of a kind.

    Attributes:
        kind: Name of their profile.
        robots: Number of robots.
        hours: Time from the first to the last run of each, in all [h].
        confirmed: Number of confirmed faults by ``MOTOR:MODE``.
    """

    kind: str
    robots: int
    hours: float
    confirmed: Mapping[str, int]


# Parts of the questions: the profile in force, and the finding that stands.

_last_profile = (
    sa.select(profiles.c.robot_id, sa.func.max(profiles.c.id).label("profile"))
    .group_by(profiles.c.robot_id)
    .subquery()
)
kinds = (
    sa.select(robots.c.id.label("robot_id"), robots.c.name.label("robot"))
    .add_columns(sa.func.coalesce(profiles.c.name, "").label("kind"))
    .outerjoin(_last_profile, _last_profile.c.robot_id == robots.c.id)
    .outerjoin(profiles, profiles.c.id == _last_profile.c.profile)
    .subquery()
)
"""Robots with the name of their profile."""
_withdrawing = findings.alias("withdrawing")
_standing = (
    sa.select(findings.c.episode_id, sa.func.max(findings.c.id).label("finding"))
    .where(
        findings.c.withdraws.is_(None),
        ~sa.exists().where(_withdrawing.c.withdraws == findings.c.id),
    )
    .group_by(findings.c.episode_id)
    .subquery()
)
judged = (
    sa.select(episodes, findings.c.verdict, findings.c.cause, findings.c.person)
    .outerjoin(_standing, _standing.c.episode_id == episodes.c.id)
    .outerjoin(findings, findings.c.id == _standing.c.finding)
    .subquery()
)
"""Episodes with the finding that stands; null where there is none."""
_of_the_robot = diagnoses.c.robot_id == kinds.c.robot_id
FIRST_RUN = sa.select(sa.func.min(diagnoses.c.at)).where(_of_the_robot).scalar_subquery()
LAST_RUN = sa.select(sa.func.max(diagnoses.c.at)).where(_of_the_robot).scalar_subquery()
"""Times of the first and last run of each robot of `kinds`: one look into the index each."""
REFUTED = judged.c.verdict.in_([WRONG, OTHER_CAUSE]).is_(True)


def _count(condition: sa.ColumnElement[bool]) -> sa.ColumnElement[int]:
    return sa.func.coalesce(sa.func.sum(sa.case((condition, 1), else_=0)), 0)


def _failing_motors(connection: sa.Connection, now: datetime, days: float) -> list[tuple[Any, ...]]:
    count = sa.func.count()
    query = (
        sa.select(kinds.c.kind, judged.c.motor, judged.c.mode, count)
        .add_columns(sa.func.count(sa.distinct(judged.c.robot_id)))
        .add_columns(_count(judged.c.verdict == CONFIRMED), _count(REFUTED))
        .join(kinds, kinds.c.robot_id == judged.c.robot_id)
        .group_by(kinds.c.kind, judged.c.motor, judged.c.mode)
        .order_by(count.desc(), kinds.c.kind, judged.c.motor, judged.c.mode)
    )
    return [tuple(row) for row in connection.execute(query)]


def _time_between(connection: sa.Connection, now: datetime, days: float) -> list[tuple[Any, ...]]:
    """Time from the first to the last run of all robots of a kind, over the failures of a motor."""
    watched = watched_days(connection)
    count = sa.func.count()
    query = (
        sa.select(kinds.c.kind, judged.c.motor, count)
        .join(kinds, kinds.c.robot_id == judged.c.robot_id)
        .where(~REFUTED)
        .group_by(kinds.c.kind, judged.c.motor)
        .order_by(kinds.c.kind, count.desc(), judged.c.motor)
    )
    rows = connection.execute(query).all()
    return [
        (kind, motor, *watched[kind], failures, _between(watched[kind][1], failures))
        for kind, motor, failures in rows
    ]


def _between(days: float, failures: int) -> float | None:
    """Return the mean time between failures [days]; None: watched for no time yet."""
    return round(days / failures, 3) if days > 0.0 else None


def fleet_faults(connection: sa.Connection, kind: str) -> FleetFaults:
    """Return the confirmed faults of the robots of a kind."""
    robot_count, days = watched_days(connection).get(kind, (0, 0.0))
    query = (
        sa.select(judged.c.motor, judged.c.mode, sa.func.count())
        .join(kinds, kinds.c.robot_id == judged.c.robot_id)
        .where(kinds.c.kind == kind, judged.c.verdict == CONFIRMED)
        .group_by(judged.c.motor, judged.c.mode)
        .order_by(judged.c.motor, judged.c.mode)
    )
    rows = connection.execute(query)
    confirmed = {f"{motor}:{mode}": int(count) for motor, mode, count in rows}
    return FleetFaults(kind, robot_count, 24.0 * days, confirmed)


def fleet_calibrations(connection: sa.Connection, kind: str) -> dict[str, StoredCalibration]:
    """Return the calibrations in force of the robots of a kind, each file once, by robot."""
    query = (
        sa.select(kinds.c.robot, calibrations)
        .join(kinds, kinds.c.robot_id == calibrations.c.robot_id)
        .where(kinds.c.kind == kind, calibrations.c.valid_to.is_(None))
        .order_by(calibrations.c.id.desc())
    )
    of_file = {one.sha256: (one.robot, one) for one in connection.execute(query)}
    return {robot: stored_calibration(one) for robot, one in list(of_file.values())[::-1]}


def watched_days(connection: sa.Connection) -> dict[str, tuple[int, float]]:
    """Return the number of robots of each kind, and the time they were watched in all [days]."""
    query = sa.select(kinds.c.kind, FIRST_RUN, LAST_RUN)
    found: dict[str, tuple[int, float]] = {}
    for kind, begin, end in connection.execute(query.where(FIRST_RUN.is_not(None))):
        count, days = found.get(kind, (0, 0.0))
        found[kind] = (count + 1, round(days + (end - begin).total_seconds() / DAY_S, 3))
    return found


def _wrong(connection: sa.Connection, now: datetime, days: float) -> list[tuple[Any, ...]]:
    first = (
        sa.select(sa.func.min(episode_events.c.diagnosis_id))
        .where(episode_events.c.episode_id == judged.c.id)
        .scalar_subquery()
    )
    query = (
        sa.select(kinds.c.robot, judged.c.number, judged.c.since, diagnoses.c.verdict)
        .add_columns(judged.c.verdict, judged.c.cause, judged.c.person)
        .join(kinds, kinds.c.robot_id == judged.c.robot_id)
        .join(diagnoses, diagnoses.c.id == first)
        .where(REFUTED)
        .order_by(kinds.c.robot, judged.c.number)
    )
    return [tuple(row) for row in connection.execute(query)]


def _due(connection: sa.Connection, now: datetime, days: float) -> list[tuple[Any, ...]]:
    query = sa.select(kinds.c.robot_id, kinds.c.robot, LAST_RUN).order_by(kinds.c.robot)
    is_open = sa.select(judged.c.robot_id).where(judged.c.until.is_(None), ~REFUTED)
    faulty = set(connection.scalars(is_open))
    in_force = sa.select(calibrations.c.robot_id).where(calibrations.c.valid_to.is_(None))
    calibrated = set(connection.scalars(in_force))
    limit, found = now - timedelta(days=days), []
    for row, robot, seen in connection.execute(query):
        reasons = {
            "open fault": row in faulty,
            "no run yet": seen is None,
            f"no run for {days:g} days": seen is not None and seen < limit,
            "no calibration": row not in calibrated,
        }
        if any(reasons.values()):
            found.append((robot, seen, ", ".join(name for name, true in reasons.items() if true)))
    return found


def _unknown(connection: sa.Connection, now: datetime, days: float) -> list[tuple[Any, ...]]:
    names = {row: kind for row, _, kind in connection.execute(sa.select(kinds))}
    return [group.row for group in unknown_groups(read_episodes_of_unknown(connection), names)]


@dataclass(frozen=True)
class _Question:
    title: str
    columns: tuple[str, ...]
    ask: Callable[[sa.Connection, datetime, float], list[tuple[Any, ...]]]


QUESTIONS = {
    "failing-motors": _Question(
        "Which motors fail most?",
        ("kind", "motor", "mode", "episodes", "robots", "confirmed", "refuted"),
        _failing_motors,
    ),
    "time-between-failures": _Question(
        "Mean time between failures of each motor; refuted episodes do not count",
        ("kind", "motor", "robots", "watched_days", "failures", "days_between"),
        _time_between,
    ),
    "wrong-diagnoses": _Question(
        "Which diagnoses were wrong?",
        ("robot", "episode", "since", "diagnosis", "finding", "cause", "person"),
        _wrong,
    ),
    "unknown-faults": _Question(
        "Which faults does no known mode explain? Each group may be a mode of its own",
        (
            *("kind", "motor", "episodes", "runs", "robots", "size", "sign", "law"),
            *("since", "until", "alike"),
        ),
        _unknown,
    ),
    "due": _Question("Which robots are due for a check?", ("robot", "last_run", "why"), _due),
}
"""Ready questions by name."""


def ask(connection: sa.Connection, name: str, days: float = CHECK_DAYS) -> QueryAnswer:
    """Return the answer to a ready question.

    Args:
        connection: Connection to the store.
        name: Name of the question, see `QUESTIONS`.
        days: Time without a run after which a robot is due [days].

    Raises:
        InputError: If there is no such question.
    """
    check_name("query", name, QUESTIONS)
    question = QUESTIONS[name]
    rows = question.ask(connection, datetime.now(UTC), days)
    return QueryAnswer(name, question.title, question.columns, tuple(rows))
