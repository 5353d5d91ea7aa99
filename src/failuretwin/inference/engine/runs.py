"""Runs: the evidence of every hypothesis, with all that is unknown of the robot integrated.

    p(run | h) = sum over c of w_c  sum over rows of p(row | h)  integral of p(run | row, theta, c)

Components c are normal distributions of theta with a factor on the scatter and a noise of the
sensor. The first weighs every row; the others weigh the rows that matter, where healthy or the best
fault says that they may.

Section: docs/inference.md#runs
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from failuretwin.core.hypothesis import Fault, Hypothesis
from failuretwin.core.numerics import log_of, log_sum
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.failure_behavior.mode import Signature
from failuretwin.failure_behavior.modes import EncoderBias
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.engine.episode_rows import episode_rows
from failuretwin.inference.engine.filter import RowsPosterior
from failuretwin.inference.engine.healthy_rows import healthy_rows
from failuretwin.inference.engine.held_rows import held_rows
from failuretwin.inference.engine.offset_rows import offset_rows
from failuretwin.inference.engine.picks import Part, Picks, Prepared, narrowed, prepared
from failuretwin.inference.engine.redrawn_rows import redrawn_rows
from failuretwin.inference.engine.rows import Rows, Scene
from failuretwin.inference.engine.theta import Components
from failuretwin.inference.engine.way_rows import way_rows

AMOUNT_STEPS = np.linspace(-4.0, 4.0, 33)
"""Nodes at which the prior of an amount is put in, in posterior deviations."""
FAR_STEPS = np.linspace(-40.0, 40.0, 1281)
"""The same where all of these are sizes that a fault cannot have."""
WIDEST = 0.5
"""Largest deviation at which it is, as a share of that of the normal distribution it replaces."""
ROWS_NATS, MOST_ROWS = 6.0, 3
"""Rows of a hypothesis that other components weigh: so near its best, and at most."""
REFINED_NATS = 8.0
"""Rows whose moments are weighed again given all others: so near the best of their run."""
HYPOTHESIS_NATS = 12.0
"""Hypotheses that more than one component weighs: so near the best by that with most scatter."""
COMPONENT_NATS = 4.0
"""Components that weigh all hypotheses of a run: so near the best for healthy or the best fault."""


@dataclass(frozen=True)
class Weighed:
    """What rows say.

    Attributes:
        picks: Which rows, by which components.
        log_evidence: With the prior of rows and amounts, without that of components, (pick,).
        found: Filtered moments.
        amount: Mean and deviation of the amount, (pick, 2).
        lossy: Probability that commands get lost more often, (pick,).
    """

    picks: Picks
    log_evidence: FloatArray
    found: RowsPosterior
    amount: FloatArray
    lossy: FloatArray

    @classmethod
    def joined(cls, parts: Sequence[Weighed]) -> Weighed:
        """Return what several sets of rows say as one."""
        return cls(
            Picks.joined([one.picks for one in parts]),
            np.concatenate([one.log_evidence for one in parts]),
            RowsPosterior.joined([one.found for one in parts]),
            np.concatenate([one.amount for one in parts]),
            np.concatenate([one.lossy for one in parts]),
        )

    def with_picks(self, places: IntArray, some: Weighed) -> Weighed:
        """Return the same with some of the picks weighed anew."""
        arrays = [x.copy() for x in (self.log_evidence, self.amount, self.lossy)]
        for values, new in zip(arrays, (some.log_evidence, some.amount, some.lossy), strict=True):
            values[places] = new
        log_evidence, amount, lossy = arrays
        found = self.found.with_picks(places, some.found)
        return Weighed(self.picks, log_evidence, found, amount, lossy)


def _by_components(picks: Picks, run: IntArray, component: IntArray) -> Picks:
    """Return rows of a hypothesis by some components of their runs."""
    pick, of = np.nonzero(picks.run[:, None] == run)
    return Picks(picks.run[pick], picks.row[pick], component[of])


def has_rows(hypothesis: Hypothesis, moving: bool = False, curved: bool = False) -> bool:
    """Return whether moments tell of a hypothesis: healthy, or one motor that settles off.

    Args:
        hypothesis: What may be the case.
        moving: Whether there are moments on the way, which tell of one that is late or slow too.
        curved: Whether some are on curves, which tell of one that sticks now and then too.
    """
    if not hypothesis.known or len(hypothesis.faults) > 1:
        return False
    modes = [MODES[fault.mode] for fault in hypothesis.faults]
    told = {Signature.TRANSIENT: moving, Signature.MISSED: False}
    return all(curved if one.in_episodes else told.get(one.signature, True) for one in modes)


def rows_of(scene: Scene, hypothesis: Hypothesis, hypotheses: Sequence[Hypothesis]) -> Rows:
    """Return the rows of a hypothesis that has some, beside others."""
    if hypothesis.is_healthy:
        return healthy_rows(scene)
    fault = hypothesis.faults[0]
    motor, mode = scene.model.motor_names.index(fault.motor), MODES[fault.mode]
    if mode.signature is Signature.HELD:
        return held_rows(scene, motor)
    if mode.signature is Signature.REDRAWN_OFFSET:
        return redrawn_rows(scene, motor, mode, _zero_of(fault.motor) not in hypotheses)
    if mode.in_episodes:
        return episode_rows(scene, motor, mode)
    winds = mode.signature is Signature.OFFSET and mode.hysteresis and scene.layout.moving
    if winds or mode.signature is Signature.TRANSIENT:
        return way_rows(scene, motor, mode)
    return offset_rows(scene, motor, mode)


def _zero_of(motor: str) -> Hypothesis:
    """Return the hypothesis that the zero of a motor is off."""
    return Hypothesis((Fault(motor, EncoderBias.mode),))


@dataclass(frozen=True)
class RunsEvidence:
    """Some runs with every hypothesis weighed.

    Attributes:
        scene: The runs.
        hypotheses: What may be the case; all of them have rows.
        components: What is believed of the robot.
        log_odds: Log prior of each hypothesis, (hypothesis,).
        asked: Hypotheses that are weighed, (run, hypothesis); None: all.
    """

    scene: Scene
    hypotheses: Sequence[Hypothesis]
    components: Components
    log_odds: FloatArray
    asked: BoolArray | None = None

    @cached_property
    def rows(self) -> list[Rows]:
        """Rows of each hypothesis."""
        return [rows_of(self.scene, one, self.hypotheses) for one in self.hypotheses]

    @cached_property
    def prepared(self) -> list[Prepared]:
        """Rows of each hypothesis ready for the filter: those that count, once all are weighed."""
        return [prepared(self.scene, rows, self.components) for rows in self.rows]

    @cached_property
    def left_out(self) -> dict[int, FloatArray]:
        """Log of all rows over those that are kept, by hypothesis, (run,): they count as these."""
        return {}

    @cached_property
    def weighed(self) -> list[Weighed]:
        """What the rows of each hypothesis say, by the components that weigh them."""
        every = range(len(self.rows))
        first = self.weigh([self._all_rows(h) for h in every])
        kept = [self._narrow(h, one) for h, one in enumerate(first)]
        wanted = self._wanted(first)
        widest = self._widest(wanted)
        begun = self.weigh([_by_components(kept[h], *np.nonzero(widest)) for h in every])
        near, others = self._near(begun), wanted & ~widest
        more = [np.nonzero(others & near[:, self.components.normal, h]) for h in every]
        says = self.weigh([_by_components(kept[h], *more[h]) for h in every])
        return self._refined([Weighed.joined(pair) for pair in zip(begun, says, strict=True)])

    def _widest(self, wanted: BoolArray) -> BoolArray:
        """Return the components with the largest scatter of those that weigh a run.

        One of each normal distribution of theta, (run, component).
        """
        components = self.components
        scales = components.jitter, components.noise_m, components.sigma
        rank = np.argsort(np.lexsort(scales))
        height = np.where(wanted, rank, -1)
        of = components.normal[:, None] == components.normal
        return np.asarray(wanted & (height >= np.where(of, height[:, None], -1).max(axis=2)))

    def _near(self, found: Sequence[Weighed]) -> BoolArray:
        """Return the hypotheses that may come near the best, (run, normal, hypothesis).

        Of all components with one belief about theta, that with the largest scatter tells them
        least apart.
        """
        table = np.full((self.scene.moments.runs, self.components.normals, len(found)), -np.inf)
        for h, one in enumerate(found):
            at = one.picks.run, self.components.normal[one.picks.component]
            np.maximum.at(table[..., h], at, one.log_evidence + self.log_odds[h])
        return np.asarray(table > table.max(axis=2, keepdims=True) - HYPOTHESIS_NATS)

    def _refined(self, found: Sequence[Weighed]) -> list[Weighed]:
        """Return what rows say, those that come near the best of their run refined."""
        says = [
            one.log_evidence
            + self.components.weight(one.picks.run, one.picks.component)
            + self.log_odds[h]
            for h, one in enumerate(found)
        ]
        best = np.full(self.scene.moments.runs, -np.inf)
        for one, height in zip(found, says, strict=True):
            np.maximum.at(best, one.picks.run, height)
        pairs = zip(found, says, strict=True)
        near = [np.flatnonzero(h > best[one.picks.run] - REFINED_NATS) for one, h in pairs]
        some = list(zip(found, near, strict=True))
        again = self.weigh(
            [one.picks[i] for one, i in some], [one.found.some(i) for one, i in some]
        )
        return [one.with_picks(i, new) for (one, i), new in zip(some, again, strict=True)]

    @cached_property
    def log_evidence(self) -> FloatArray:
        """Log of weight times evidence, (run, component, hypothesis)."""
        runs, count = self.scene.moments.runs, len(self.components)
        table = np.full((len(self.hypotheses), runs * count), -np.inf)
        for h, one in enumerate(self.weighed):
            run, component = one.picks.run, one.picks.component
            says = one.log_evidence + self.components.weight(run, component)
            np.logaddexp.at(table[h], run * count + component, says)
        return np.moveaxis(table.reshape(-1, runs, count), 0, -1)

    @property
    def by_hypothesis(self) -> FloatArray:
        """Log p(run | h), (run, hypothesis)."""
        return log_sum(self.log_evidence, axis=1)

    @cached_property
    def lossy(self) -> FloatArray:
        """Probability that commands get lost more often, by each hypothesis, (run, hypothesis)."""
        found, whole = np.zeros(self.by_hypothesis.shape), self.by_hypothesis + self.log_odds
        for h, one in enumerate(self.weighed):
            total = whole[one.picks.run, h]
            share = np.exp(self.height(h) - np.where(np.isfinite(total), total, 0.0))
            np.add.at(found[:, h], one.picks.run, share * one.lossy)
        return found

    def reweighted(self, log_weight: FloatArray) -> RunsEvidence:
        """Return the same rows by components of other weights, (run, component)."""
        other = replace(self, components=replace(self.components, log_weight=log_weight))
        kept = ("rows", "prepared", "left_out", "weighed")
        vars(other).update({name: getattr(self, name) for name in kept})
        return other

    def height(self, h: int) -> FloatArray:
        """Return the log of prior times evidence of all picks of a hypothesis, (pick,)."""
        one = self.weighed[h]
        weight = self.components.weight(one.picks.run, one.picks.component)
        return one.log_evidence + weight + self.log_odds[h]

    def part(self, h: int, picks: Picks) -> Part:
        """Return some picks of a hypothesis, ready for the filter."""
        return Part(self.scene, self.rows[h], picks, self.components, self.prepared[h])

    def _all_rows(self, h: int) -> Picks:
        possible = np.isfinite(self.rows[h].log_prior)
        if self.asked is not None:
            possible &= self.asked[:, h, None]
        run, row = np.nonzero(possible)
        return Picks(run, row, np.zeros_like(row))

    def _narrow(self, h: int, one: Weighed) -> Picks:
        """Keep the rows of a hypothesis that come near its best, with the outcomes that count.

        That of a healthy robot in which nothing changes is always kept: robots that scatter more
        may need no change where the usual one does.
        """
        table: FloatArray = np.full(self.rows[h].log_prior.shape, -np.inf)
        table[one.picks.run, one.picks.row] = one.log_evidence
        most = min(MOST_ROWS, table.shape[1])
        least = np.maximum(table.max(axis=1) - ROWS_NATS, np.sort(table, axis=1)[:, -most])
        near = (table >= least[:, None]) & np.isfinite(table)
        if self.hypotheses[h].is_healthy:
            near[:, 0] = np.isfinite(table[:, 0])
        some = np.flatnonzero(near[one.picks.run, one.picks.row])
        kept, share = one.picks[some], one.found.share[some]
        self.prepared[h] = narrowed(self.scene, self.rows[h], kept, share, self.components)
        whole, part = log_sum(table, axis=1), log_sum(np.where(near, table, -np.inf), axis=1)
        possible = np.isfinite(part)
        self.left_out[h] = np.where(possible, whole - np.where(possible, part, 0.0), 0.0)
        return kept

    def _wanted(self, first: Sequence[Weighed]) -> BoolArray:
        """Return which components weigh each run in full, (run, component)."""
        runs, count = self.scene.moments.runs, len(self.components)
        found = np.zeros((runs, count), dtype=bool)
        found[:, 0] = True
        if count == 1:
            return found
        says, row = np.full((runs, len(first)), -np.inf), np.zeros((runs, len(first)), np.int64)
        for h, one in enumerate(first):
            order = np.argsort(one.log_evidence, kind="stable")
            row[one.picks.run[order], h] = one.picks.row[order]
            says[one.picks.run[order], h] = one.log_evidence[order] + self.log_odds[h]
        healthy = [h for h, one in enumerate(self.hypotheses) if one.is_healthy]
        row[:, healthy] = 0  # where nothing changes, as in `_narrow`
        others = says.copy()
        others[:, healthy] = -np.inf
        asked = np.zeros(says.shape, dtype=bool)
        asked[:, healthy] = True
        asked[np.arange(runs), others.argmax(axis=1)] = True
        asked &= np.isfinite(says)
        table = np.full((runs, count, len(first)), -np.inf)
        picks = []
        for h in range(len(first)):
            some = np.repeat(np.flatnonzero(asked[:, h]), count)
            component = np.tile(np.arange(count), len(some) // count)
            picks.append(Picks(some, row[some, h], component))
        for h, part in enumerate(self.weigh(picks)):
            at = part.picks.run, part.picks.component
            says_of = part.log_evidence + self.components.weight(*at)
            table[*at, h] = says_of + self.log_odds[h]
        near = table > table.max(axis=1, keepdims=True) - COMPONENT_NATS
        return np.asarray(found | (near & np.isfinite(table)).any(axis=2))

    def weigh(
        self, picks: Sequence[Picks], before: Sequence[RowsPosterior] | None = None
    ) -> list[Weighed]:
        """Return what some rows of each hypothesis say.

        Args:
            picks: The rows of each hypothesis.
            before: What the filter has found, to weigh every moment again given all others; None:
                the filter finds it.
        """
        parts = [self.part(h, some) for h, some in enumerate(picks)]
        if before is None:
            found = [one.filtered() for one in parts]
        else:
            found = [one.refined(known) for one, known in zip(parts, before, strict=True)]
        return [self._weighed(h, *one) for h, one in enumerate(zip(parts, found, strict=True))]

    def _weighed(self, h: int, part: Part, found: RowsPosterior) -> Weighed:
        """Return what rows of a hypothesis say, with the prior of rows, amounts and losses."""
        rows, picks = part.rows, part.picks
        total = found.total + rows.log_prior[picks.run, picks.row]
        if h in self.left_out:
            total = total + self.left_out[h][picks.run]
        amount = np.sqrt(np.maximum(found.amount, 0.0))
        amount[:, 0] = found.amount[:, 0] + rows.centre[picks.run, picks.row]
        some = np.flatnonzero(rows.variance[picks.run, picks.row] > 0.0)
        if rows.amount_prior is not None and len(some):
            gain = np.full(len(some), -np.inf)
            for steps in (AMOUNT_STEPS, FAR_STEPS):
                left = np.flatnonzero(~np.isfinite(gain))
                at = some[left]
                gain[left], amount[at] = _with_amount_prior(
                    rows, picks[at], found.amount[at], steps
                )
            total[some] += gain
        more, lossy = self._with_losses(part, found)
        return Weighed(picks, total + more, found, amount, lossy)

    def _with_losses(self, part: Part, found: RowsPosterior) -> tuple[FloatArray, FloatArray]:
        """Return what robots that lose more commands change, and how probable they are, (pick,).

            p(row) ~ (1 - s) + s R,    R = prod over movements sum over a of p(a | row) w'_a / w_a

        with the share s of such robots and the weight w'_a of an outcome a in them.
        """
        share = self.components.lossy
        if share == 0.0:
            return np.zeros(len(part.picks.run)), np.zeros(len(part.picks.run))
        usual, more = log_of(1.0 - share), log_of(share) + part.log_losses(found.share)
        total = np.logaddexp(usual, more)
        return total, np.exp(more - total)


def _with_amount_prior(
    rows: Rows, picks: Picks, amount: FloatArray, steps: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return what the prior of the amount changes, (pick,), and mean and deviation, (pick, 2).

    Args:
        rows: The rows.
        picks: Some of them, with an amount.
        amount: Its mean and variance by the readings, (pick, 2).
        steps: Nodes, in deviations.
    """
    run, row = picks.run, picks.row
    variance, centre = rows.variance[run, row], rows.centre[run, row]
    prior = np.sqrt(variance)
    middle = np.clip(amount[:, 0], -2.0 * prior, 2.0 * prior)
    deviation = np.sqrt(np.clip(amount[:, 1], 1e-16, (WIDEST * prior) ** 2))
    z = middle[:, None] + deviation[:, None] * steps
    weight = -0.5 * steps**2
    weight = weight - log_sum(weight, axis=0)
    normal = -0.5 * (z**2 / variance[:, None] + np.log(2.0 * np.pi * variance)[:, None])
    assert rows.amount_prior is not None
    log_prior = rows.amount_prior(centre[:, None] + z, run, row)
    joint = weight + log_prior - normal
    total = log_sum(joint, axis=1)
    share = np.exp(joint - np.where(np.isfinite(total), total, 0.0)[:, None])
    share = np.where(np.isfinite(total)[:, None], share, np.exp(weight))
    mean = np.sum(share * z, axis=1)
    spread = np.sqrt(np.maximum(np.sum(share * z**2, axis=1) - mean**2, 1e-18))
    return total, np.stack([centre + mean, spread], axis=1)
