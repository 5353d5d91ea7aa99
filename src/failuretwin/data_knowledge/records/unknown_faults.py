"""Faults that no known mode explains: episodes of `unknown`, grouped by how the motor is displaced.

Displacements d of a motor follow one of four laws K, a Gaussian process in its angle phi and the
direction of its last travel, in units of its size. Two episodes have the same law with

    p(same | d_1, d_2) = B / (1 + B)
    B = p(d_1, d_2) / [p(d_1) p(d_2)],    p(d) = sum over K of w_K p(d | K)

at even prior odds, with the prior w of the laws. The groups are those of average linkage at
p = 1/2.

Section: docs/store.md#unknown-faults
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from itertools import combinations
from typing import Any

import numpy as np
import sqlalchemy as sa
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.linalg import cho_factor, cho_solve
from scipy.special import expit, logsumexp

from failuretwin.core.hypothesis import HEALTHY_STATE, Diagnosis
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.data_knowledge.records.schema import add_rows, diagnoses, residuals

LEAST_RUNS = 2
"""Runs without a healthy one between from which `unknown` is an episode: a fault stays, a false
verdict does not."""
MOST_MOVEMENTS = 24
"""Movements of an episode that are compared, the newest."""
MOST_EPISODES = 60
"""Episodes of a motor that are compared, the newest."""
LENGTH = 0.15
"""Length over which the law by angle varies, as a share of the angles that were seen; assumed."""
MISFIT = 0.3
"""Part of a displacement that a law leaves open, as a share of the size; assumed."""
SHOWN_DEVIATIONS = 3.0
"""Deviations from which a displacement shows."""
OUTLIER_SIZES = 3.0
"""Sizes from which a displacement is none of the fault, such as that of a dropped command."""
ONE_SIGN = 0.9
"""Share of the displacement of one sign from which a fault has this sign."""
LAWS = {"constant": 0.3, "by angle": 0.3, "by direction": 0.3, "each movement": 0.1}
"""Laws of the displacement and their prior; with the last, each movement draws its own, so it makes
all alike that fit no other."""
LISTS = ("displacement", "deviation", "angle", "direction")
"""What is stored of each movement."""
SHOWN = {"rad": (180.0 / math.pi, "deg"), "m": (1e3, "mm")}
"""Factor and unit in which sizes are shown."""


# Rows.


def add_residuals(
    connection: sa.Connection, robot: int, found: Sequence[tuple[int, datetime, Diagnosis]]
) -> None:
    """Store the residuals of diagnoses that have one; given are rows, times (UTC) and diagnoses."""
    stated = []
    for row, at, diagnosis in found:
        if diagnosis.residual is not None:
            lists = asdict(diagnosis.residual)
            named = {"motor": lists.pop("motor"), "unit": lists.pop("unit")}
            of = {"diagnosis_id": row, "robot_id": robot, "at": at}
            stated.append({**named, **of, "movements": lists})
    add_rows(connection, residuals, stated)


def _stored(connection: sa.Connection) -> Iterator[Any]:
    """Yield the residuals of runs whose last diagnosis is `unknown`, the oldest first.

    `healthy` is the row of the last healthy diagnosis before; None: there is none.
    """
    later, before = diagnoses.alias("later"), diagnoses.alias("before")
    replaced = sa.exists().where(
        later.c.run_id == diagnoses.c.run_id, later.c.id > residuals.c.diagnosis_id
    )
    order = sa.tuple_(before.c.at, before.c.id) < sa.tuple_(
        residuals.c.at, residuals.c.diagnosis_id
    )
    healthy = (
        sa.select(before.c.id)
        .where(before.c.robot_id == residuals.c.robot_id, before.c.state == HEALTHY_STATE, order)
        .order_by(before.c.at.desc(), before.c.id.desc())
        .limit(1)
        .scalar_subquery()
    )
    query = sa.select(residuals, healthy.label("healthy")).join(diagnoses).where(~replaced)
    yield from connection.execute(query.order_by(residuals.c.at, residuals.c.id))


# Episodes and their likeness.


@dataclass(frozen=True)
class UnknownEpisode:
    """Runs of a robot that no known fault explains, all by the same motor.

    Attributes:
        robot: Row of the robot.
        motor: The motor.
        unit: Unit of displacements and angles.
        since: Time of the first run (UTC).
        until: Time of the last run (UTC).
        runs: Number of runs.
        displacement: (movement,).
        deviation: Its standard deviation, (movement,).
        angle: Settled angle of a healthy motor, (movement,).
        direction: Sign of its last travel, (movement,).
    """

    robot: int
    motor: str
    unit: str
    since: datetime
    until: datetime
    runs: int
    displacement: FloatArray
    deviation: FloatArray
    angle: FloatArray
    direction: FloatArray

    @classmethod
    def of(cls, rows: Sequence[Any]) -> UnknownEpisode:
        """Return the episode of some stored residuals, the oldest first."""
        first, last = rows[0], rows[-1]
        where = first.robot_id, first.motor, first.unit, first.at, last.at, len(rows)
        return cls(*where, *(_newest(rows, name) for name in LISTS))

    @property
    def size(self) -> float:
        """Median of the displacements that show, by their amount; of all if none does."""
        amount = np.abs(self.displacement)
        shown = amount[amount > SHOWN_DEVIATIONS * self.deviation]
        return max(float(np.median(shown if len(shown) else amount)), 1e-12)


def _newest(rows: Sequence[Any], name: str) -> FloatArray:
    """Return a list of the newest movements of some stored residuals, (movement,)."""
    return np.concatenate([row.movements[name] for row in rows])[-MOST_MOVEMENTS:]


def read_episodes_of_unknown(connection: sa.Connection) -> list[UnknownEpisode]:
    """Return the episodes of `unknown` of all robots, the oldest first.

    Runs of one robot and motor without a healthy run between are one episode, from `LEAST_RUNS` on.
    """
    found: dict[tuple[int, str, str, int | None], list[Any]] = {}
    for row in _stored(connection):
        found.setdefault((row.robot_id, row.motor, row.unit, row.healthy), []).append(row)
    return [UnknownEpisode.of(rows) for rows in found.values() if len(rows) >= LEAST_RUNS]


def log_evidence(episodes: Sequence[UnknownEpisode], span: float) -> FloatArray:
    """Return log w_K + log p(d | K) of the displacements of some episodes together, (law,).

    Args:
        episodes: They share the law.
        span: Range of the angles that were seen, over which laws vary.
    """
    shift, deviation = (
        np.concatenate([getattr(one, name) / one.size for one in episodes])
        for name in ("displacement", "deviation")
    )
    angle = np.concatenate([one.angle for one in episodes])
    direction = np.concatenate([one.direction for one in episodes])
    apart = (angle[:, None] - angle) / (LENGTH * max(span, 1e-12))
    alike: BoolArray = direction[:, None] == direction
    laws = (np.ones_like(apart), np.exp(-0.5 * apart**2), alike.astype(float), 0.0 * apart)
    outlier = np.where(np.abs(shift) > OUTLIER_SIZES, shift**2, 0.0)
    free = deviation**2 + MISFIT**2 + outlier
    noise = [free, free, free, free + 1.0]
    found = [_log_normal(shift, law, own) for law, own in zip(laws, noise, strict=True)]
    return np.array(found) + np.log(list(LAWS.values()))


def _log_normal(values: FloatArray, shared: FloatArray, own: FloatArray) -> float:
    """Return the log density of values, (n,), with a shared and an own part of the covariance."""
    factor = cho_factor(shared + np.diag(own), lower=True)
    square = values @ cho_solve(factor, values)
    log_det = 2.0 * np.log(np.diag(factor[0])).sum()
    return float(-0.5 * (square + log_det + len(values) * math.log(2.0 * math.pi)))


def likeness(episodes: Sequence[UnknownEpisode]) -> FloatArray:
    """Return the probability that two episodes have the same law, (pair,) as `combinations`."""
    span = _span(episodes)
    alone = [logsumexp(log_evidence([one], span)) for one in episodes]
    log_factor = [
        logsumexp(log_evidence([episodes[i], episodes[j]], span)) - alone[i] - alone[j]
        for i, j in combinations(range(len(episodes)), 2)
    ]
    return np.asarray(expit(np.array(log_factor)))


def _span(episodes: Sequence[UnknownEpisode]) -> float:
    return float(np.ptp(np.concatenate([one.angle for one in episodes])))


# Groups.


@dataclass(frozen=True)
class UnknownGroup:
    """Episodes with one law of displacement: a candidate for a fault mode.

    Attributes:
        kind: Kind of robot.
        episodes: Its episodes, the oldest first.
        alike: Mean probability that two of them have the same law; None: there is one.
    """

    kind: str
    episodes: Sequence[UnknownEpisode]
    alike: float | None

    @property
    def law(self) -> str:
        """The most probable of `LAWS`."""
        found = log_evidence(self.episodes, _span(self.episodes))
        return list(LAWS)[int(np.argmax(found))]

    @property
    def sign(self) -> str:
        """``+``, ``-``, or ``+-`` where displacements have both signs."""
        shift = np.concatenate([one.displacement for one in self.episodes])
        share = float(np.maximum(shift, 0.0).sum() / max(np.abs(shift).sum(), 1e-12))
        return "+" if share >= ONE_SIGN else "-" if share <= 1.0 - ONE_SIGN else "+-"

    @property
    def row(self) -> tuple[Any, ...]:
        """Columns of the ready question."""
        members, last = self.episodes, max(one.until for one in self.episodes)
        factor, unit = SHOWN[members[0].unit]
        size = factor * float(np.median([one.size for one in members]))
        runs = sum(one.runs for one in members)
        alike = None if self.alike is None else f"{100.0 * self.alike:.0f} %"
        counts = len(members), runs, len({one.robot for one in members})
        told = f"{size:.1f} {unit}", self.sign, self.law
        return (self.kind, members[0].motor, *counts, *told, members[0].since, last, alike)


def unknown_groups(
    episodes: Sequence[UnknownEpisode], kinds: Mapping[int, str]
) -> list[UnknownGroup]:
    """Return groups of episodes of one motor of one kind of robot, the largest first.

    Args:
        episodes: The oldest first.
        kinds: Kind of each robot, by its row.
    """
    by_motor: dict[tuple[str, str, str], list[UnknownEpisode]] = {}
    for one in episodes:
        by_motor.setdefault((kinds[one.robot], one.motor, one.unit), []).append(one)
    found = [
        UnknownGroup(kind, *group)
        for (kind, _, _), some in by_motor.items()
        for group in _clusters(some[-MOST_EPISODES:])
    ]
    return sorted(found, key=lambda group: -len(group.episodes))


def _clusters(
    episodes: Sequence[UnknownEpisode],
) -> Iterator[tuple[list[UnknownEpisode], float | None]]:
    """Yield the episodes of each cluster of a motor, and how alike they are."""
    if len(episodes) == 1:
        yield list(episodes), None
        return
    same = likeness(episodes)
    label = fcluster(linkage(1.0 - same, "average"), 0.5, "distance")
    pairs = np.array(list(combinations(range(len(episodes)), 2)))
    for cluster in np.unique(label):
        members = np.flatnonzero(label == cluster).tolist()
        within = same[np.isin(pairs, members).all(axis=1)]
        yield [episodes[i] for i in members], float(within.mean()) if len(within) else None
