"""Rows: every way in which a hypothesis may have come about in a run.

A row fixes what is discrete: the onset, the range of sizes. One continuous amount z of each row
(a held angle, a constant offset, a rate) is integrated with theta, as a column H of its own.

Section: docs/inference.md#hypotheses
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from failuretwin.core.numerics import log_of, log_sum
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.inference.engine.integral import Noise
from failuretwin.inference.engine.moments import Moments
from failuretwin.inference.engine.outcomes import Outcomes
from failuretwin.inference.engine.theta import Layout, Motion, Shown, columns
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.observation.healthy_model import HealthyModel

AmountPrior = Callable[[FloatArray, IntArray, IntArray], FloatArray]
"""Log density of amounts (pick, node) of some runs (pick,) and rows (pick,), same axes."""
Onsets = Callable[[int, int, FloatArray], tuple[FloatArray, FloatArray]]
"""Samples of the onset of a run and row [s], and their shares, (sample,) each, given mean and
deviation of its amount, (2,)."""
ColumnsOf = Callable[[IntArray, IntArray, IntArray, IntArray], FloatArray]
"""G by run, row, moment and usual outcome, (...,) each, as (..., channel, theta)."""


@dataclass(frozen=True)
class Drawn:
    """Sizes that every movement draws anew.

    Attributes:
        size: Middle of the node of each outcome, (outcome,); NaN: the outcome has no size.
        width: Width of the node, (outcome,): its variance is width^2 / 12.
        lever: What the sensors show of a size, (run, moment, outcome, channel) [m per unit].
        square: Mean and variance of the square of a size that is not seen, (row, 2).
    """

    size: FloatArray
    width: FloatArray
    lever: FloatArray
    square: FloatArray


@dataclass(frozen=True)
class Episodes:
    """A motor that sticks with a share s of the time, from an onset on.

    Of a row with the share s_0, in which a moment was in an episode of age a with probability p_a,
    of p in all, and all commands arrived in it with q, another share changes what it says by

        p s / s_0 + q (1 - s) / (1 - s_0) + 1 - p - q

    and an onset after it by the same with s = 0. An episode begins with the onset: by

        sum over a of p_a b_a / (s_0 P_a) + q (1 - sum b_a) / (1 - s_0) + 1 - p - q

    if the moment is the first that the fault affects, and the fault is not from before the run.

    Attributes:
        share: s_0 of each row, (row,).
        age: Age of each outcome in an episode, (outcome,); -1 of the others, of which the first is
            that all commands arrive.
        of_age: P_a, probability of each age in an episode, (age,).
        begun: b_a, probability that a moment is in an episode of that age which began since the
            moment before, (run, moment, age).
        sizes: Shares that are told, of the same prior probability, (size,).
        log_first: Log prior that each moment is the first affected, (run, moment).
        onset: Samples of the onset before each, (run, moment, sample) [s].
        part: Their shares, same axes.
    """

    share: FloatArray
    age: IntArray
    of_age: FloatArray
    begun: FloatArray
    sizes: FloatArray
    log_first: FloatArray
    onset: FloatArray
    part: FloatArray

    def told(self, kept: IntArray, share: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return p_a (..., age) and q (...) of moments.

        Args:
            kept: Index of each outcome, (..., outcome).
            share: Its share, same axes.
        """
        found = [np.where(self.age[kept] == age, share, 0.0) for age in range(len(self.of_age))]
        held = np.stack([one.sum(axis=-1) for one in found], axis=-1)
        return held, np.where(kept == 0, share, 0.0).sum(axis=-1)

    def posterior(
        self, run: int, row: int, first: int, outcomes: tuple[FloatArray, FloatArray]
    ) -> FloatArray:
        """Return how probable each first moment and size is, (moment, size).

        Args:
            run: Index of the run.
            row: Index of the row.
            first: Its first moment affected: no earlier one is told.
            outcomes: p_a (moment, age) and q (moment,).
        """
        (held, arrived), usual, begun = outcomes, self.share[row], self.begun[run]
        told = held.sum(axis=1)
        other, sound = np.maximum(1.0 - told - arrived, 0.0), arrived / (1.0 - usual)
        after = told[:, None] * self.sizes / usual + sound[:, None] * (1.0 - self.sizes)
        after = log_of(after + other[:, None])
        before = log_of(sound + other)[:, None]
        begins = np.sum(held * begun / self.of_age, axis=1) / usual
        begins = log_of(begins + sound * (1.0 - begun.sum(axis=1)) + other)[:, None]
        so_far = np.cumsum(before - after, axis=0) - (before - after)
        joint = so_far + after.sum(axis=0) + self.log_first[run][:, None]
        joint[1:] += (begins - after)[1:]
        joint[:first] = -np.inf
        return np.asarray(np.exp(joint - log_sum(joint.ravel(), axis=0)))


@dataclass(frozen=True)
class Rows:
    """Rows of one hypothesis.

    Attributes:
        log_prior: Log probability of each row given its hypothesis, (run, row).
        first: First moment that the fault affects, (row,).
        outcomes: Outcomes, (run, table, moment, outcome, ...); rows may share a table.
        log_weight: Their log probability, (run, row, moment, outcome).
        usual: Outcome of the healthy robot whose columns an outcome has, (outcome,).
        columns: G where every command arrives, (run, table, moment, channel, theta).
        columns_of: G of other usual outcomes too: there are too many to keep those of all.
        lever: H, (run, row, moment, channel).
        centre: Amount at z = 0, (run, row).
        variance: var(z) before its prior is put in, (run, row); 0 without an amount.
        amount_prior: Log density of the amount; None: the normal one stands.
        drawn: Sizes of outcomes where every movement draws its own; None: it does not.
        onsets: Onset of a run and row; None: no fault.
        tie: What theta adds to the amount, so that the amount itself is less in doubt,
            (run, row, theta); None: nothing.
        own: Places in theta that say nothing any more from the onset on.
        episodes: The share of the time that a motor sticks; None: it does not.
        shared: Index of each row along the axis of outcomes and columns, (row,); None: each has its
            own, or all have the same.
    """

    log_prior: FloatArray
    first: IntArray
    outcomes: Outcomes
    log_weight: FloatArray
    usual: IntArray
    columns: FloatArray
    columns_of: ColumnsOf
    lever: FloatArray
    centre: FloatArray
    variance: FloatArray
    amount_prior: AmountPrior | None = None
    drawn: Drawn | None = None
    onsets: Onsets | None = None
    tie: FloatArray | None = None
    own: Sequence[int] = ()
    episodes: Episodes | None = None
    shared: IntArray | None = None

    @property
    def table(self) -> IntArray:
        """Index of each row along the axis of outcomes and columns, (row,)."""
        if self.shared is not None:
            return self.shared
        return np.minimum(np.arange(len(self.first)), self.columns.shape[1] - 1)

    def beside(self, other: Rows) -> Rows:
        """Return these rows and others of the same hypothesis behind them.

        Args:
            other: Rows whose outcomes are the first of these, with an amount, not drawn.
        """
        both = _Both(self, other)
        more = self.log_weight.shape[-1] - other.log_weight.shape[-1]
        pairs = zip(self.outcomes.arrays, other.outcomes.arrays, strict=True)
        padded, own = _padded(other.log_weight, more, -np.inf), self.columns.shape[1]
        return replace(
            self,
            log_prior=_joined(self.log_prior, other.log_prior),
            first=np.concatenate([self.first, other.first]),
            outcomes=Outcomes(*(_joined(a, _padded(b, more)) for a, b in pairs)),
            log_weight=_joined(self.log_weight, padded),
            columns=_joined(self.columns, other.columns),
            columns_of=both.columns_of,
            lever=_joined(self.lever, other.lever),
            centre=_joined(self.centre, other.centre),
            variance=_joined(self.variance, other.variance),
            amount_prior=both.amount_prior,
            drawn=both.drawn,
            onsets=both.onsets,
            shared=np.concatenate([self.table, own + other.table]),
        )


@dataclass(frozen=True)
class _Both:
    """Rows of a hypothesis, and others behind them."""

    rows: Rows
    other: Rows

    @property
    def _count(self) -> int:
        return self.rows.log_prior.shape[1]

    @property
    def drawn(self) -> Drawn | None:
        """Sizes that are drawn, of the first rows."""
        found = self.rows.drawn
        if found is None:
            return None
        nothing = np.zeros((self.other.log_prior.shape[1], 2))
        return replace(found, square=np.concatenate([found.square, nothing]))

    def columns_of(
        self, run: IntArray, row: IntArray, moment: IntArray, outcome: IntArray
    ) -> FloatArray:
        """Return G; see `ColumnsOf`."""
        found, theirs = None, row >= self._count
        for mask, rows, begin in ((~theirs, self.rows, 0), (theirs, self.other, self._count)):
            at = run[mask], row[mask] - begin, moment[mask], outcome[mask]
            some = rows.columns_of(*at)
            if found is None:
                found = np.empty((*row.shape, *some.shape[1:]))
            found[mask] = some
        assert found is not None
        return found

    def amount_prior(self, x: FloatArray, run: IntArray, row: IntArray) -> FloatArray:
        """Return the log density of amounts, of rows that have some; see `AmountPrior`."""
        found, theirs = np.zeros(x.shape), row >= self._count
        for mask, rows, begin in ((~theirs, self.rows, 0), (theirs, self.other, self._count)):
            if rows.amount_prior is not None:
                found[mask] = rows.amount_prior(x[mask], run[mask], row[mask] - begin)
        return found

    def onsets(self, run: int, row: int, amount: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return samples of the onset; see `Onsets`."""
        one, at = (self.rows, row) if row < self._count else (self.other, row - self._count)
        assert one.onsets is not None
        return one.onsets(run, at, amount)


@dataclass(frozen=True)
class Scene:
    """What all hypotheses about some runs share.

    Attributes:
        model: The healthy robot; its doubt is in theta, not in its scatter.
        moments: The moments.
        priors: Beliefs about onset and size.
        noise: The Student t of residuals.
        layout: Places in theta.
        columns: G of a healthy robot under each outcome, (run, moment, outcome, channel, theta).
        spread: G V G^T where every command arrives, (run, moment, channel, channel) [m2].
        zeros: Deviation of the zero of each motor, of bias and joint frame, (motor,) [rad].
        pose: Settled angles under each outcome, (run, moment, outcome, motor) [rad].
        shown: What the sensors show of these, (run, moment, outcome, ...).
        healthy: Outcomes of a healthy robot, (run, moment, outcome, ...).
    """

    model: HealthyModel
    moments: Moments
    priors: Priors
    noise: Noise
    layout: Layout
    columns: FloatArray
    spread: FloatArray
    zeros: FloatArray
    pose: FloatArray
    shown: Shown
    healthy: Outcomes

    @classmethod
    def of(
        cls,
        model: HealthyModel,
        moments: Moments,
        priors: Priors,
        layout: Layout,
        covariance: FloatArray,
    ) -> Scene:
        """Return the scene of some moments.

        Args:
            model: The healthy robot, without doubt.
            moments: The moments.
            priors: Beliefs about onset and size.
            layout: Places in theta.
            covariance: V by which rows are centred, (theta, theta).
        """
        noise = Noise.of(model.settling.tail_dof, model.sensors.dims, model.outlier_log_density)
        pose = model.settle(moments.base, moments.direction, model.none_held)
        motion = Motion(moments.direction, moments.speed, moments.bend)
        shown = model.sensors.expected(pose)
        G = columns(model, pose, shown, motion, layout)
        usual = G[:, :, 0]
        spread = usual @ covariance @ np.swapaxes(usual, -1, -2)
        beside = moments.late, moments.bent
        healthy = Outcomes.of_poses(moments, shown, model.scatter**2, *beside)
        zeros = layout.zeros(covariance)
        return cls(model, moments, priors, noise, layout, G, spread, zeros, pose, shown, healthy)

    def columns_of(
        self, run: IntArray, row: IntArray, moment: IntArray, outcome: IntArray
    ) -> FloatArray:
        """Return G of a healthy robot, whatever the row; see `ColumnsOf`."""
        del row
        return self.columns[run, moment, outcome]

    def off_on_the_way(self, motor: int) -> FloatArray:
        """Return what a healthy motor is off by on its way beside its scatter, (run,) [rad].

        The median over the moments of a run; 0 at rest, and of a robot of which its class alone is
        known.
        """
        moments = self.moments
        if not self.model.is_calibrated:
            return np.zeros(moments.runs)
        off = np.sqrt((moments.late + moments.bent)[:, :, 0, motor])
        nothing = ~moments.usable.any(axis=1, keepdims=True)
        return np.nanmedian(np.where(moments.usable | nothing, off, np.nan), axis=1)

    @property
    def settled(self) -> FloatArray:
        """Settled angles where every command arrives, (run, moment, motor) [rad]."""
        return self.pose[:, :, 0]


def _joined(own: FloatArray, others: FloatArray) -> FloatArray:
    """Return values (run, row, ...) of some rows and of others behind them."""
    return np.concatenate([own, others], axis=1)


def _padded(array: FloatArray, more: int, value: float = 0.0) -> FloatArray:
    """Return an array (run, row, moment, outcome, ...) with room for more outcomes."""
    width = [(0, more if axis == 3 else 0) for axis in range(array.ndim)]
    return np.pad(array, width, constant_values=value)


def sampled(onset: FloatArray, share: FloatArray) -> Onsets:
    """Return the onsets of rows that each have samples of their own, whatever their amount.

    Args:
        onset: (run, row, sample) [s].
        share: Share of each, same axes.
    """
    return lambda run, row, _: (onset[run, row], share[run, row])


def arrived(columns_of: ColumnsOf, rows: int, moments: Moments) -> FloatArray:
    """Return G where every command arrives, (run, row, moment, channel, theta)."""
    run, row, moment, outcome = np.indices((moments.runs, rows, moments.count, 1))[..., 0]
    return columns_of(run, row, moment, outcome)


def before_onset(rows: Rows, healthy: Outcomes) -> Rows:
    """Return rows whose outcomes before the first affected moment are those of a healthy robot."""
    count = rows.log_weight.shape[2]
    mask = (np.arange(count) < rows.first[:, None])[None, :, :, None]

    def pick(sound: FloatArray, faulty: FloatArray) -> FloatArray:
        return np.where(mask.reshape(*mask.shape, *(1,) * (faulty.ndim - 4)), sound, faulty)

    pairs = zip(healthy.with_rows().arrays, rows.outcomes.arrays, strict=True)
    outcomes = Outcomes(*(pick(*pair) for pair in pairs))
    return replace(rows, outcomes=outcomes, lever=np.where(mask, 0.0, rows.lever))
