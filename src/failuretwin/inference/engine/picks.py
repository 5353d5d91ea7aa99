"""Picks: rows with what they say of outcomes, ready for the filter.

All outcomes of a row are looked at once; then those that count are weighed about the likeliest of
each moment, whose columns f has. Others have columns of their own: by how much they differ counts
as scatter.

Section: docs/inference.md#runs
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from failuretwin.core.compiled import compiled, laid_out
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.inference.engine.filter import Places, RowsPosterior, Tables, filter_picks, refine
from failuretwin.inference.engine.outcomes import Outcomes
from failuretwin.inference.engine.rows import Rows, Scene
from failuretwin.inference.engine.theta import Components


@dataclass(frozen=True)
class Picks:
    """Some rows of one hypothesis, each of one run and by one component.

    Attributes:
        run: (pick,).
        row: (pick,).
        component: (pick,).
    """

    run: IntArray
    row: IntArray
    component: IntArray

    def __getitem__(self, some: IntArray | slice) -> Picks:
        """Return some of them."""
        return Picks(self.run[some], self.row[some], self.component[some])

    @classmethod
    def joined(cls, parts: Sequence[Picks]) -> Picks:
        """Return several sets of picks as one."""
        names = [field.name for field in fields(cls)]
        return cls(*(np.concatenate([getattr(one, n) for one in parts]) for n in names))


@dataclass(frozen=True)
class Prepared:
    """Rows of a hypothesis with what does not depend on scatter and noise.

    A place is a row of a run, or several that share their outcomes.

    Attributes:
        tables: What rows say, of one normal distribution of theta or of each.
        place: Index of each row among the places, (run, row); -1: it is left out.
        weight_place: Index of each row among the weights of outcomes, (run, row).
        columns: G of f, (place, moment, channel, theta).
        kept: Outcomes that are looked at, (place, moment, outcome); None: all, in their order.
    """

    tables: Tables
    place: IntArray
    weight_place: IntArray
    columns: FloatArray
    kept: IntArray | None


def prepared(scene: Scene, rows: Rows, components: Components) -> Prepared:
    """Return all rows of a hypothesis with all outcomes, by the first component.

    How columns differ from outcome to outcome is that of a healthy robot here.

    Args:
        scene: The runs.
        rows: Rows of the hypothesis.
        components: What is believed of the robot.
    """
    runs, count = rows.log_prior.shape
    own = rows.outcomes.residual.shape[1]  # tables of outcomes, which rows may share
    assert rows.columns.shape[1] == own, "rows share outcomes and columns, or neither"
    every = np.arange(runs * count).reshape(runs, count)
    place = own * np.arange(runs)[:, None] + rows.table

    def flat(array: FloatArray) -> FloatArray:
        return array.reshape(runs * own, *array.shape[2:])

    first, run = int(components.normal[0]), np.arange(runs)
    shift, spread = apart(scene.columns, components, run, first)
    shift, spread = shift[:, None], spread[:, None]
    if rows.own:
        after = (np.arange(shift.shape[2]) >= rows.first[:, None])[None, :, :, None, None]
        others = apart(scene.columns, components, run, first, rows.own)
        shift, spread = (
            np.where(after.reshape(*after.shape, *(1,) * (x.ndim - 5)), y[:, None], x)
            for x, y in zip((shift, spread), others, strict=True)
        )
    outcomes, G = rows.outcomes, flat(rows.columns)
    residual = flat(outcomes.residual - shift[:, :, :, rows.usual])
    extra = flat(outcomes.beside + spread[:, :, :, rows.usual])
    mean, covariance = _of_f(G, components, np.repeat(run, own), first)
    tables = (
        residual[None],
        flat(outcomes.scatter),
        flat(outcomes.late),
        extra[None],
        rows.log_weight.reshape(runs * count, *rows.log_weight.shape[2:]),
        mean[None],
        covariance[None],
    )
    return Prepared(_contiguous(tables), place, every, G, None)


def _contiguous(tables: Sequence[FloatArray]) -> Tables:
    return Tables(*map(laid_out, tables))


def _of_f(
    G: FloatArray, components: Components, run: IntArray, normal: int
) -> tuple[FloatArray, FloatArray]:
    """Return G mu (place, moment, channel) and G V G^T over all moments of each place.

    Args:
        G: (place, moment, channel, theta).
        components: What is believed of the robot.
        run: Of each place.
        normal: Which normal distribution of theta.
    """
    unknown = components.unknown
    V, mu = components.theta(run, normal)
    V, mu = V[:, unknown[:, None], unknown], mu[:, unknown]
    whole = G[..., unknown].reshape(len(G), G.shape[1] * G.shape[2], len(unknown))
    return (whole @ mu[..., None]).reshape(G.shape[:3]), whole @ V @ np.swapaxes(whole, 1, 2)


def apart(
    G: FloatArray,
    components: Components,
    run: IntArray,
    normal: int,
    without: Sequence[int] = (),
) -> tuple[FloatArray, FloatArray]:
    """Return what outcomes differ by from the first, as if parts of theta were independent.

    Args:
        G: (place, moment, outcome, channel, theta).
        components: What is believed of the robot.
        run: Of each place.
        normal: Which normal distribution of theta.
        without: Places in theta that are left out.

    Returns:
        Mean (place, moment, outcome, channel) [m] and covariance (..., channel, channel) [m2].
    """
    unknown = np.setdiff1d(components.unknown, np.array(without, dtype=np.int64))
    V, mu = components.theta(run, normal)
    variance = np.ascontiguousarray(np.diagonal(V, axis1=1, axis2=2)[:, unknown])
    shift, spread = np.zeros(G.shape[:4]), np.zeros((*G.shape[:4], G.shape[3]))
    known = np.ascontiguousarray(mu[:, unknown])
    _write_apart(np.ascontiguousarray(G), unknown, variance, known, shift, spread)
    return shift, spread


@compiled
def _write_apart(
    G: FloatArray,
    unknown: IntArray,
    variance: FloatArray,
    mu: FloatArray,
    shift: FloatArray,
    spread: FloatArray,
) -> None:
    """Write what outcomes differ by from f, as if parts of theta were independent.

    Args:
        G: Columns, (place, moment, outcome, channel, theta).
        unknown: Places in theta that are not known.
        variance: Of these, (place, unknown).
        mu: Their mean, same axes.
        shift: Mean of the difference, (place, moment, outcome, channel) [m].
        spread: Its covariance, (place, moment, outcome, channel, channel) [m2].
    """
    places, moments, outcomes, channels, _ = G.shape
    many = len(unknown)
    off = np.empty((many, channels))
    for p in range(places):
        for m in range(moments):
            for a in range(1, outcomes):
                for c in range(channels):
                    total = 0.0
                    for t in range(many):
                        off[t, c] = G[p, m, a, c, unknown[t]] - G[p, m, 0, c, unknown[t]]
                        total += off[t, c] * mu[p, t]
                    shift[p, m, a, c] = total
                for c in range(channels):
                    for d in range(c + 1):
                        total = 0.0
                        for t in range(many):
                            total += off[t, c] * off[t, d] * variance[p, t]
                        spread[p, m, a, c, d] = spread[p, m, a, d, c] = total


@dataclass(frozen=True)
class Part:
    """Some rows of a hypothesis by some components, ready for the filter.

    Attributes:
        scene: The runs.
        rows: Rows of the hypothesis.
        picks: Which of them.
        components: What is believed of the robot.
        prepared: The rows with what they say of outcomes.
    """

    scene: Scene
    rows: Rows
    picks: Picks
    components: Components
    prepared: Prepared

    @property
    def place(self) -> IntArray:
        """Place of each pick, (pick,)."""
        return self.prepared.place[self.picks.run, self.picks.row]

    @property
    def normal(self) -> IntArray:
        """The normal distribution of theta of each pick."""
        return self.components.normal[self.picks.component]

    @property
    def columns(self) -> FloatArray:
        """G of f, (pick, moment, channel, theta)."""
        return self.prepared.columns[self.place]

    @property
    def kept(self) -> IntArray:
        """Index of each outcome among those of its rows, (pick, moment, outcome)."""
        assert self.prepared.kept is not None
        return self.prepared.kept[self.place]

    def log_losses(self, share: FloatArray) -> FloatArray:
        """Return by how much more probable picks are where commands get lost more often, (pick,).

        Moments of one movement share its outcome: the last one tells which it was.

        Args:
            share: Share of each outcome, (pick, moment, outcome).
        """
        moments, run = self.scene.moments, self.picks.run
        begins = np.maximum.accumulate(
            np.where(moments.kept > 0.0, 0, np.arange(moments.count)), axis=1
        )
        ends = np.diff(begins, append=moments.count, axis=1) > 0
        outcome = np.arange(share.shape[-1]) if self.prepared.kept is None else self.kept
        usual = np.broadcast_to(self.rows.usual[outcome], share.shape)
        lossy = moments.lossy[run[:, None, None], begins[run][..., None], usual]
        known = np.sum(share * np.expm1(lossy), axis=-1)
        return np.asarray(np.sum(np.where(ends[run], np.log1p(known), 0.0), axis=1))

    def filtered(self) -> RowsPosterior:
        """Return what moments say, one after the other."""
        return filter_picks(self.prepared.tables, self._places, self.scene.noise)

    def refined(self, found: RowsPosterior) -> RowsPosterior:
        """Return what moments say, each given all others, after what the filter has found."""
        return refine(self.prepared.tables, self._places, self.scene.noise, found)

    @property
    def _places(self) -> Places:
        picks, component = self.picks, self.picks.component
        known = self.components
        factors = known.sigma[component], known.jitter[component], known.noise_m[component]
        return Places(
            self._prepared_normal,
            self.place,
            self.prepared.weight_place[picks.run, picks.row],
            np.stack(factors, axis=1) ** 2,
            self.scene.moments.usable[picks.run],
            _kept(self.scene, self.rows, picks),
            laid_out(self.rows.lever[picks.run, picks.row]),
            self.rows.variance[picks.run, picks.row],
        )

    @property
    def _prepared_normal(self) -> IntArray:
        """The normal distribution of theta of each pick, among those that are prepared."""
        only = len(self.prepared.tables.mean) == 1
        return np.zeros_like(self.picks.run) if only else self.normal

    @property
    def prior(self) -> tuple[FloatArray, FloatArray]:
        """Mean (pick, number) and covariance (pick, number, number) of f [m, m2]."""
        places, tables = self._places, self.prepared.tables
        at = places.normal, places.place
        mean = tables.mean[at].reshape(len(places.place), tables.covariance.shape[-1])
        lever = places.lever.reshape(mean.shape)
        own = places.amount[:, None, None] * lever[:, :, None] * lever[:, None]
        return mean, tables.covariance[at] + own

    @property
    def log_weight(self) -> FloatArray:
        """Log probability of each outcome, (pick, moment, outcome)."""
        return self.prepared.tables.log_weight[self._places.weight_place]

    def outcomes_at(self, m: int) -> tuple[FloatArray, FloatArray]:
        """Return r_a (pick, outcome, channel) [m] and S_a (..., channel, channel) [m2]."""
        places, tables = self._places, self.prepared.tables
        (factor, uneven, noise), at = places.variance.T[..., None, None, None], places.place
        scale = factor * tables.scatter[at, m] + tables.extra[places.normal, at, m]
        if tables.late.size:
            scale = scale + uneven * tables.late[at, m]
        return tables.residual[places.normal, at, m], scale + noise * np.eye(scale.shape[-1])


LEFT_OUT = 1e-2
"""Share of the outcomes of a moment under a row that may be left out, once all are weighed."""


def narrowed(
    scene: Scene, rows: Rows, picks: Picks, share: FloatArray, components: Components
) -> Prepared:
    """Return some rows with the outcomes that count, about the likeliest of each moment.

    Args:
        scene: The runs.
        rows: Rows of the hypothesis.
        picks: Those that are kept.
        share: Share of each outcome, (pick, moment, outcome).
        components: What is believed of the robot.
    """
    run, row = picks.run, picks.row
    place = np.full(rows.log_prior.shape, -1)
    place[run, row] = np.arange(len(run))
    share = _of_movements(share, _kept(scene, rows, picks) > 0.0)
    arrives = np.isfinite(rows.log_weight[run, row, :, 0])
    order, others = _likeliest_first(share, arrives)
    left = 1.0 - np.cumsum(np.take_along_axis(share, order, axis=-1), axis=-1)
    total = share.sum(axis=-1, keepdims=True)
    count = 1 + (left - (1.0 - total) > LEFT_OUT * total).sum(axis=-1)  # (pick, moment)
    count = np.maximum(count, 1 + others)
    kept = order[..., : count.max(initial=1)]
    moment = np.arange(share.shape[1])[None, :, None]
    some = run[:, None, None]
    G = rows.columns_of(*np.broadcast_arrays(some, row[:, None, None], moment, rows.usual[kept]))
    index = some, rows.table[row][:, None, None], moment, kept
    outcomes = Outcomes(*(x[index] for x in rows.outcomes.arrays))
    log_weight = rows.log_weight[some, row[:, None, None], moment, kept]
    own_count = np.arange(kept.shape[-1]) < count[..., None]  # whatever its neighbours need
    log_weight = np.where(own_count, log_weight, -np.inf)
    normals = range(components.normals)
    shift, spread = zip(*(apart(G, components, run, n) for n in normals), strict=True)
    mean, covariance = zip(*(_of_f(G[:, :, 0], components, run, n) for n in normals), strict=True)
    tables = (
        outcomes.residual - np.stack(shift),
        outcomes.scatter,
        outcomes.late,
        outcomes.beside + np.stack(spread),
        log_weight,
        np.stack(mean),
        np.stack(covariance),
    )
    return Prepared(_contiguous(tables), place, place, G[:, :, 0], kept)


def _likeliest_first(share: FloatArray, arrives: BoolArray) -> tuple[IntArray, BoolArray]:
    """Return outcomes by their share, (pick, moment, outcome), and where the likeliest is a loss.

    There all commands arrive in the second: robots that scatter more may need no loss.

    Args:
        share: Share of each outcome, (pick, moment, outcome).
        arrives: Whether all commands may arrive, (pick, moment).
    """
    best = share.argmax(axis=-1)
    lost, height = arrives & (best != 0), share.copy()
    np.put_along_axis(height, best[..., None], 3.0, axis=-1)
    height[..., 0] = np.where(lost, 2.0, height[..., 0])
    return np.argsort(-height, axis=-1, kind="stable"), lost


def _kept(scene: Scene, rows: Rows, picks: Picks) -> FloatArray:
    """Return how probable it is that the outcome of the moment before holds on, (pick, moment).

    A fault that begins in the middle of a movement makes another of it.
    """
    begins = np.arange(scene.moments.count) == rows.first[picks.row][:, None]
    return np.where(begins, 0.0, scene.moments.kept[picks.run])


def _of_movements(share: FloatArray, same: BoolArray) -> FloatArray:
    """Return shares (pick, moment, outcome) that are alike in all moments of one movement.

    An outcome counts as in the moment that it explains best.
    """
    if not same.any():
        return share
    found = share.copy()
    for m in range(1, share.shape[1]):
        found[same[:, m], m] = np.maximum(found[same[:, m], m], found[same[:, m], m - 1])
    for m in range(share.shape[1] - 1, 0, -1):
        found[same[:, m], m - 1] = found[same[:, m], m]
    return found / np.maximum(found.sum(axis=-1, keepdims=True), 1.0)
