"""Picks: rows with what they say of outcomes, ready for the filter.

All outcomes of a row are looked at once; then those that count are weighed about the likeliest of
each moment, whose columns f has. Others have columns of their own: by how much they differ counts
as scatter.

Section: docs/inference.md#runs
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.inference.engine.filter import FilterRows
from failuretwin.inference.engine.integral import Mixture
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

    def row_of(self, array: FloatArray) -> IntArray:
        """Return the index along the axis of rows, which may be common to all."""
        return self.row if array.shape[1] > 1 else np.zeros_like(self.row)


@dataclass(frozen=True)
class Part:
    """Rows ready for the filter.

    Attributes:
        scene: The runs.
        rows: Rows of the hypothesis.
        picks: Which of them.
        components: What is believed of the robot.
        columns: G of each usual outcome, (pick, moment, usual, channel, theta).
        own: G of the outcome to which f belongs, (pick, moment, 1, channel, theta).
    """

    scene: Scene
    rows: Rows
    picks: Picks
    components: Components
    columns: FloatArray
    own: FloatArray

    @property
    def filter_rows(self) -> FilterRows:
        """What the filter takes."""
        f = _normal_of(self.own[:, :, 0], *self._theta)
        return _ready(self.scene, self.rows, self.picks, f, self.mixture_at)

    @property
    def _theta(self) -> tuple[FloatArray, FloatArray]:
        picks = self.picks
        return self.components.theta(picks.run, self.components.normal[picks.component])

    @cached_property
    def _other(self) -> tuple[FloatArray, FloatArray]:
        """How far outcomes have other columns, (pick, moment, usual, ...): mean, covariance."""
        return _apart(self.columns - self.own, *self._theta)

    def mixture_at(self, m: int) -> Mixture:
        """Return the outcomes of a moment under each row."""
        rows, run, outcomes = self.rows, self.picks.run, self.rows.outcomes
        row, component = self.picks.row_of(outcomes.residual), self.picks.component
        shift, wider = (values[:, m][:, rows.usual] for values in self._other)
        noise = self.components.noise_m[component, None, None, None] ** 2
        factor = self.components.sigma[component, None, None, None] ** 2
        scale = factor * outcomes.scatter[run, row, m] + noise * np.eye(shift.shape[-1])
        scale += outcomes.beside[run, row, m]
        scale += wider
        residual = outcomes.residual[run, row, m] - shift
        return Mixture(residual, scale, rows.log_weight[run, self.picks.row, m])


def _normal_of(G: FloatArray, V: FloatArray, mu: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return f by G (pick, moment, channel, theta): mean, and covariance of all its numbers."""
    picks, moments, channels, size = G.shape
    flat = G.reshape(picks, moments * channels, size)
    mean = np.matmul(flat, mu[..., None]).reshape(picks, moments, channels)
    return mean, flat @ V @ np.swapaxes(flat, -1, -2)


def _apart(apart: FloatArray, V: FloatArray, mu: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return mean and covariance of what outcomes differ by, as if theta were independent.

    Args:
        apart: G of each outcome less that of f, (pick, moment, outcome, channel, theta).
        V: (pick, theta, theta).
        mu: (pick, theta).
    """
    scaled = apart * np.sqrt(np.diagonal(V, axis1=-2, axis2=-1))[:, None, None, None]
    shift = np.matmul(apart, mu[:, None, None, :, None])[..., 0]
    return shift, np.matmul(scaled, np.swapaxes(scaled, -1, -2))


LEFT_OUT = 1e-2
"""Share of the outcomes of a moment under a row that may be left out, once all are weighed."""


@dataclass(frozen=True)
class Narrowed:
    """The outcomes of the rows of a hypothesis that count, about the likeliest of each moment.

    Attributes:
        place: Index of each row among those that are kept, (run, row).
        kept: Outcomes, (place, moment, outcome).
        columns: G of the likeliest outcome, (place, moment, channel, theta).
        f: Mean (place, moment, channel) and covariance (place, number, number) of f in each normal
            distribution of theta.
        apart: Mean (place, moment, outcome, channel) and covariance of what outcomes differ by
            since their columns do, in each.
        residual: (place, moment, outcome, channel) [m].
        scatter: (place, moment, outcome, channel, channel) [m2].
        beside: Same axes [m2].
        log_weight: (place, moment, outcome).
    """

    place: IntArray
    kept: IntArray
    columns: FloatArray
    f: tuple[FloatArray, FloatArray]
    apart: tuple[FloatArray, FloatArray]
    residual: FloatArray
    scatter: FloatArray
    beside: FloatArray
    log_weight: FloatArray


def narrowed(
    scene: Scene, rows: Rows, picks: Picks, share: FloatArray, components: Components
) -> Narrowed:
    """Return the outcomes of some rows that count.

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
    G = rows.columns[run, picks.row_of(rows.columns)]
    usual = rows.usual[kept]
    own = G[np.arange(len(run))[:, None], moment[..., 0], usual[..., 0]]
    apart = G - own[:, :, None]
    some = np.arange(len(run))[:, None, None], moment, usual
    r = picks.row_of(rows.outcomes.residual)[:, None, None]
    index = run[:, None, None], r, moment, kept
    log_weight = rows.log_weight[run[:, None, None], row[:, None, None], moment, kept]
    own_count = np.arange(kept.shape[-1]) < count[..., None]  # whatever its neighbours need
    normals = [components.theta(run, normal) for normal in range(components.normals)]
    return Narrowed(
        place,
        kept,
        own,
        _stacked([_normal_of(own, *theta) for theta in normals]),
        _stacked([tuple(v[some] for v in _apart(apart, *theta)) for theta in normals]),
        rows.outcomes.residual[index],
        rows.outcomes.scatter[index],
        rows.outcomes.beside[index],
        np.where(own_count, log_weight, -np.inf),
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


def _stacked(pairs: Sequence[tuple[FloatArray, ...]]) -> tuple[FloatArray, FloatArray]:
    first, second = zip(*pairs, strict=True)
    return np.stack(first), np.stack(second)


@dataclass(frozen=True)
class NarrowPart:
    """Picks of narrowed rows, ready for the filter.

    Attributes:
        scene: The runs.
        rows: Rows of the hypothesis.
        picks: Which of them.
        components: What is believed of the robot.
        narrow: The outcomes that count.
    """

    scene: Scene
    rows: Rows
    picks: Picks
    components: Components
    narrow: Narrowed

    @cached_property
    def place(self) -> IntArray:
        """Index of each pick among the rows that are kept."""
        return self.narrow.place[self.picks.run, self.picks.row]

    @cached_property
    def normal(self) -> IntArray:
        """The normal distribution of theta of each pick."""
        return self.components.normal[self.picks.component]

    @property
    def filter_rows(self) -> FilterRows:
        """What the filter takes."""
        mean, covariance = (values[self.normal, self.place] for values in self.narrow.f)
        return _ready(self.scene, self.rows, self.picks, (mean, covariance), self.mixture_at)

    def mixture_at(self, m: int) -> Mixture:
        """Return the outcomes of a moment under each row."""
        narrow, place, component = self.narrow, self.place, self.picks.component
        shift, wider = (values[self.normal, place, m] for values in narrow.apart)
        factor = self.components.sigma[component, None, None, None] ** 2
        noise = self.components.noise_m[component, None, None, None] ** 2
        scale = factor * narrow.scatter[place, m] + noise * np.eye(shift.shape[-1])
        scale += wider
        scale += narrow.beside[place, m]
        return Mixture(narrow.residual[place, m] - shift, scale, narrow.log_weight[place, m])


def _ready(
    scene: Scene,
    rows: Rows,
    picks: Picks,
    f: tuple[FloatArray, FloatArray],
    mixture_at: Callable[[int], Mixture],
) -> FilterRows:
    """Return picks with their distribution of f: mean and covariance."""
    return FilterRows(
        mixture_at,
        scene.moments.usable[picks.run],
        _kept(scene, rows, picks),
        *f,
        rows.lever[picks.run, picks.row],
        rows.variance[picks.run, picks.row],
        scene.noise,
    )
