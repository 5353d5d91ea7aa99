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

from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.inference.engine.filter import FilterRows
from failuretwin.inference.engine.integral import Mixture
from failuretwin.inference.engine.rows import Rows, Scene
from failuretwin.inference.engine.symmetric import identity, packed
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

    def row_of(self, array: FloatArray) -> IntArray:
        """Return the index along the axis of rows, which may be common to all."""
        return self.row if array.shape[1] > 1 else np.zeros_like(self.row)


@dataclass(frozen=True)
class Prepared:
    """Rows of a hypothesis with what does not depend on scatter and noise, an array an entry.

    A place is a row of a run, or a run where all of its rows share their outcomes.

    Attributes:
        place: Index of each row among the places, (run, row); -1: it is left out.
        residual: r_a less what theta moves it by beside f, (normal, moment, channel, outcome,
            place) [m].
        scatter: J diag(s^2) J^T, packed, (moment, entry, outcome, place) [m2].
        extra: Variance of single motors, and of theta where outcomes differ from f, packed,
            (normal, moment, entry, outcome, place) [m2].
        columns: G of f, (place, moment, channel, theta).
        f: Mean (normal, place, moment, channel) and covariance (normal, place, number, number) of
            f in each normal distribution of theta.
        kept: Outcomes that are looked at, (place, moment, outcome); None: all, in their order.
        log_weight: Log probability of each, (moment, outcome, row of a run).
        weight_place: Index of each row among those of `log_weight`, (run, row).
    """

    place: IntArray
    residual: FloatArray
    scatter: FloatArray
    extra: FloatArray
    columns: FloatArray
    f: tuple[FloatArray, FloatArray]
    kept: IntArray | None
    log_weight: FloatArray
    weight_place: IntArray


def prepared(rows: Rows, components: Components) -> Prepared:
    """Return all rows of a hypothesis with all outcomes, by the first component.

    Args:
        rows: Rows of the hypothesis.
        components: What is believed of the robot.
    """
    runs, count = rows.log_prior.shape
    own = rows.outcomes.residual.shape[1]  # rows with outcomes of their own, or 1
    assert rows.columns.shape[1] == own, "rows share outcomes and columns, or neither"
    every = np.arange(runs * count).reshape(runs, count)
    place = every if own == count else np.repeat(np.arange(runs)[:, None], count, axis=1)
    run = np.repeat(np.arange(runs), own)

    def flat(array: FloatArray) -> FloatArray:
        return array.reshape(runs * own, *array.shape[2:])

    G = flat(rows.columns)
    outcomes, unknown = rows.outcomes, components.unknown
    theta = _some(components.theta(run, int(components.normal[0])), unknown)
    G_u = G[..., unknown]
    mean, spread = _apart(G_u - G_u[:, :, :1], *theta)
    return _prepared(
        place,
        every,
        (flat(outcomes.residual), flat(outcomes.scatter), flat(outcomes.beside)),
        [(mean[:, :, rows.usual], spread[:, :, rows.usual])],
        (G[:, :, 0], G_u[:, :, 0]),
        [theta],
        rows.log_weight.reshape(runs * count, *rows.log_weight.shape[2:]),
        None,
    )


def _prepared(
    place: IntArray,
    weight_place: IntArray,
    outcomes: tuple[FloatArray, FloatArray, FloatArray],
    apart: Sequence[tuple[FloatArray, FloatArray]],
    columns: tuple[FloatArray, FloatArray],
    theta: Sequence[tuple[FloatArray, FloatArray]],
    log_weight: FloatArray,
    kept: IntArray | None,
) -> Prepared:
    """Return rows in the order of the filter.

    Args:
        place: See `Prepared`.
        weight_place: See there.
        outcomes: Residual, scatter and beside, (place, moment, outcome, ...) each.
        apart: What outcomes differ by in each normal distribution: mean and covariance, same axes.
        columns: G of f, (place, moment, channel, theta), and of what is unknown in theta.
        theta: V and mu of what is unknown at each place, in each normal distribution.
        log_weight: (row of a run, moment, outcome).
        kept: See `Prepared`.
    """
    residual, scatter, beside = outcomes
    G, G_u = columns
    normals = [_normal_of(G_u, *one) for one in theta]
    return Prepared(
        place,
        np.stack([_rows_last(np.moveaxis(residual - mean, -1, 0)) for mean, _ in apart]),
        _rows_last(packed(scatter)),
        np.stack([_rows_last(packed(beside + spread)) for _, spread in apart]),
        G,
        (np.stack([mean for mean, _ in normals]), np.stack([spread for _, spread in normals])),
        kept,
        np.ascontiguousarray(np.moveaxis(log_weight, 0, -1)),
        weight_place,
    )


def _rows_last(array: FloatArray) -> FloatArray:
    """Return (entry, place, moment, outcome) as (moment, entry, outcome, place)."""
    return np.ascontiguousarray(np.transpose(array, (2, 0, 3, 1)))


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

    @property
    def filter_rows(self) -> FilterRows:
        """What the filter takes."""
        picks, (mean, covariance) = self.picks, self.prepared.f
        normal = self._normal
        return FilterRows(
            self.mixture_at,
            self.scene.moments.usable[picks.run],
            _kept(self.scene, self.rows, picks),
            mean[normal, self.place],
            covariance[normal, self.place],
            self.rows.lever[picks.run, picks.row, ..., None],
            self.rows.variance[picks.run, picks.row, None],
            self.scene.noise,
        )

    @property
    def _normal(self) -> IntArray:
        """The same among those that are prepared."""
        only = len(self.prepared.residual) == 1
        return np.zeros_like(self.picks.run) if only else self.normal

    def mixture_at(self, m: int) -> Mixture:
        """Return the outcomes of a moment under each pick."""
        known, place, component = self.prepared, self.place, self.picks.component
        residual = _of_picks(known.residual[:, m], self._normal, place)
        factor, noise = self.components.sigma[component], self.components.noise_m[component]
        scale = np.take(known.scatter[m], place, axis=-1)
        scale *= factor**2
        scale += _of_picks(known.extra[:, m], self._normal, place)
        scale += (identity(len(residual))[:, None] * noise**2)[:, None]
        at = known.weight_place[self.picks.run, self.picks.row]
        return Mixture(residual, scale, np.take(known.log_weight[m], at, axis=-1))


def _of_picks(values: FloatArray, normal: IntArray, place: IntArray) -> FloatArray:
    """Return values (normal, ..., place) of picks, (..., pick)."""
    if len(values) == 1:
        return np.take(values[0], place, axis=-1)
    return np.ascontiguousarray(np.moveaxis(values[normal, ..., place], 0, -1))


def _some(theta: tuple[FloatArray, FloatArray], which: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return V and mu of some places in theta."""
    V, mu = theta
    return V[:, which[:, None], which], mu[:, which]


def _normal_of(G: FloatArray, V: FloatArray, mu: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return f by G (place, moment, channel, theta): mean, and covariance of all its numbers."""
    places, moments, channels, size = G.shape
    flat = G.reshape(places, moments * channels, size)
    mean = np.matmul(flat, mu[..., None]).reshape(places, moments, channels)
    return mean, flat @ V @ np.swapaxes(flat, -1, -2)


def _apart(apart: FloatArray, V: FloatArray, mu: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return mean and covariance of what outcomes differ by, as if theta were independent.

    Args:
        apart: G of each outcome less that of f, (place, moment, outcome, channel, theta).
        V: (place, theta, theta).
        mu: (place, theta).
    """
    scaled = apart * np.sqrt(np.diagonal(V, axis1=-2, axis2=-1))[:, None, None, None]
    shift = np.matmul(apart, mu[:, None, None, :, None])[..., 0]
    return shift, np.matmul(scaled, np.swapaxes(scaled, -1, -2))


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
    order = np.argsort(-share, axis=-1, kind="stable")
    left = 1.0 - np.cumsum(np.take_along_axis(share, order, axis=-1), axis=-1)
    total = share.sum(axis=-1, keepdims=True)
    count = 1 + (left - (1.0 - total) > LEFT_OUT * total).sum(axis=-1)  # (pick, moment)
    kept = order[..., : count.max(initial=1)]
    moment = np.arange(share.shape[1])[None, :, None]
    some, r = run[:, None, None], picks.row_of(rows.columns)[:, None, None]
    G = rows.columns[some, r, moment, rows.usual[kept]]
    unknown = components.unknown
    theta = [_some(components.theta(run, n), unknown) for n in range(components.normals)]
    own, G_u = G[:, :, 0], G[..., unknown]
    index = some, picks.row_of(rows.outcomes.residual)[:, None, None], moment, kept
    outcomes = rows.outcomes
    log_weight = rows.log_weight[some, row[:, None, None], moment, kept]
    own_count = np.arange(kept.shape[-1]) < count[..., None]  # whatever its neighbours need
    return _prepared(
        place,
        place,
        (outcomes.residual[index], outcomes.scatter[index], outcomes.beside[index]),
        [_apart(G_u - G_u[:, :, :1], *one) for one in theta],
        (own, G_u[:, :, 0]),
        theta,
        np.where(own_count, log_weight, -np.inf),
        kept,
    )


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
