"""Runs of one robot, judged with what the others say of what all of them share.

Expectation propagation. Each run i sends a site, a normal factor of theta; the belief is what was
believed before times all sites. A run is judged with the cavity, the belief without its own site:

    q_-i(theta) = sum over c of w_c,-i N_c,-i,    p_i(h) ~ p(h) sum_c w_c,-i integral p(run_i | h) N_c,-i
    m, V = moments of the mixture over h and c,   Lambda_i = V^-1 - V_-i^-1, no direction negative

with m_-i, V_-i the moments of the cavity. A run whose hypothesis is open sends a wide site, so that
what is faulty teaches little. Scatter and loss rates are learned beside it, by expectation and
maximisation with pseudo-counts.

Section: docs/self_calibration.md#the-model-population-runs-offsets
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.numerics import log_sum
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.digital_model.nonidealities import Imperfections, LostCommand
from failuretwin.inference.healthy_model import HealthyModel
from failuretwin.inference.posterior import Posterior
from failuretwin.inference.priors import Priors
from failuretwin.inference.run_likelihood import RunLikelihood
from failuretwin.inference.shared_belief import Belief, mixed, positive, summed
from failuretwin.inference.shared_likelihood import Normal
from failuretwin.inference.shared_posterior import Mixture
from failuretwin.inference.shared_unknowns import REGISTRATION, SharedLayout, offsets_of
from failuretwin.inference.shared_weighing import (
    COARSE_TO_FINE,
    Candidate,
    SharedWeighing,
    Weighed,
)

SCATTER_COUNT, RATE_COUNT = 12.0, 30.0
"""Movements that the prior of a scatter and of a loss rate counts for."""
LEAST_SHARE = 1e-3
"""Components of the belief that are less probable are not weighed."""
CHUNK_RUNS = 64
"""Runs that are weighed at a time."""


@dataclass(frozen=True)
class Counts:
    """What movements say of scatter and lost commands, sums over them.

    Attributes:
        scatter: Sum of squares of how far each motor has scattered, and of how many times it has,
            (..., 2, motor) [rad2, -].
        losses: How often each set of motors has lost a command, of how many movements; punctual
            and late ones, (..., entry, 2, 2).
    """

    scatter: FloatArray
    losses: FloatArray

    @classmethod
    def believed(cls, given: Imperfections) -> Counts:
        """Return what is believed of a robot, as movements that would say so."""
        if given.settling is None:
            return cls(np.zeros((2, 0)), np.zeros((0, 2, 2)))
        scatter = np.asarray(given.settling.scatter)
        rate = np.array([[e.rate, e.rate_when_late] for e in given.lost_commands]).reshape(-1, 2)
        return cls(
            SCATTER_COUNT * np.stack([scatter**2, np.ones_like(scatter)]),
            RATE_COUNT * np.stack([rate, np.ones_like(rate)], axis=-1),
        )

    @classmethod
    def none(cls, runs: int, given: Imperfections) -> Counts:
        """Return the counts of runs that have said nothing yet."""
        like = cls.believed(given)
        return cls(np.zeros((runs, *like.scatter.shape)), np.zeros((runs, *like.losses.shape)))

    def __getitem__(self, rows: slice | IntArray) -> Counts:
        """Return the counts of some of the runs alone."""
        return Counts(self.scatter[rows], self.losses[rows])

    def plus(self, told: Counts) -> Counts:
        """Return these and those of some runs together."""
        return Counts(
            self.scatter + told.scatter.sum(axis=0), self.losses + told.losses.sum(axis=0)
        )

    def times(self, share: float) -> Counts:
        """Return counts of a share of the movements."""
        return Counts(share * self.scatter, share * self.losses)

    def most_probable(self, given: Imperfections) -> Imperfections:
        """Return the imperfections with the scatter and the rates that these movements have."""
        if given.settling is None:
            return given
        scatter = np.sqrt(self.scatter[0] / self.scatter[1])
        rates = self.losses[..., 0] / self.losses[..., 1]
        lost = tuple(
            replace(entry, rate=float(rate), rate_when_late=float(when_late))
            for entry, (rate, when_late) in zip(given.lost_commands, rates, strict=True)
        )
        settling = replace(given.settling, scatter=tuple(scatter.tolist()))
        return replace(given, settling=settling, lost_commands=lost)


@dataclass(frozen=True)
class Judged:
    """What some of the runs say, each with its cavity.

    Attributes:
        rows: Which they are.
        weighing: The runs.
        cavity: What was believed without them, in units.
        candidates: What was found with each component of that.
        log_evidence: Log of weight times evidence, (run, candidate, hypothesis).
    """

    rows: IntArray
    weighing: SharedWeighing
    cavity: Belief
    candidates: Sequence[Candidate]
    log_evidence: FloatArray

    @property
    def share(self) -> FloatArray:
        """Probability of each hypothesis with each candidate, (run, candidate, hypothesis)."""
        height = self.log_evidence + self.weighing.log_odds
        return np.exp(height - log_sum(height, axis=(1, 2))[:, None, None])

    @property
    def best(self) -> FloatArray:
        """Best theta of each hypothesis beside where the runs are expanded, (run, h, theta)."""
        theta = np.stack([each.found.theta for each in self.candidates], axis=1)
        winner = np.argmax(self.log_evidence, axis=1)[:, None, :, None]
        return np.take_along_axis(theta, winner, axis=1)[:, 0]

    def posterior(self) -> Posterior:
        """Return the posterior over hypotheses of each run."""
        top = np.argmax(self.log_evidence, axis=1)[:, None]
        first = np.arange(len(self.candidates))[None, :, None] == top
        whole = log_sum(self.log_evidence, axis=1)[:, None]
        table = np.where(first, whole, -np.inf)
        return Mixture(self.weighing, self.candidates, table).posterior()

    def counts(self, given: Imperfections) -> Counts:
        """Return what the runs say of scatter and losses, (run, ...); faulty motors left out."""
        share = self.share
        told = [each.found for each in self.candidates]
        scatter = sum(
            np.einsum("rh,rhkn->rkn", share[:, c], found.scattered) for c, found in enumerate(told)
        )
        outcomes = sum(
            share[:, c, :, None, None] * found.outcomes for c, found in enumerate(told)
        )
        losses = [self._losses(entry, np.asarray(outcomes)) for entry in given.lost_commands]
        shape = (len(share), len(losses), 2, 2)
        return Counts(np.asarray(scatter), np.reshape(np.stack(losses, 1) if losses else [], shape))

    def _losses(self, entry: LostCommand, outcomes: FloatArray) -> FloatArray:
        """Return how often some motors lose a command, punctual and late, (run, 2, 2)."""
        likelihood = self.weighing.likelihood
        names, late = likelihood.model.motor_names, likelihood.late
        lost = np.isin(names, entry.motors)
        patterns = self.candidates[0].found.expansion.response.usual.lost
        told = np.zeros((len(outcomes), 2, 2))
        for h, hypothesis in enumerate(self.weighing.hypotheses):
            faulty = np.isin(names, [fault.motor for fault in hypothesis.faults])
            if (lost & faulty).any():
                continue
            hit = (patterns[:, ~faulty] == lost[~faulty]).all(axis=1)
            for k, kind in enumerate((1.0 - late, late)):
                told[:, k, 0] += (outcomes[:, h][..., hit].sum(axis=-1) * kind).sum(axis=1)
                told[:, k, 1] += (outcomes[:, h].sum(axis=-1) * kind).sum(axis=1)
        return told


@dataclass
class RunsTogether:
    """The state of the recursion; theta is relative to the model that was given.

    Attributes:
        given: The runs, with the model that was given.
        hypotheses: What may be the case.
        priors: Beliefs about faults and set-ups.
        layout: What stands in theta.
        unit: Unit of each part of theta, (theta,).
        base: What is believed of theta without these runs, one mixture, in units.
        sites: What each run says, in units.
        here: Where runs are expanded, (theta,).
        counts: What is believed of scatter and losses without these runs; None: they are known.
        told: What each run says of them.
        start: Where to search for the best theta of each, (run, hypothesis, theta); NaN: not known.
        model: The healthy robot with scatter and rates that were learned.
    """

    given: RunLikelihood
    hypotheses: Sequence[Hypothesis]
    priors: Priors
    layout: SharedLayout
    unit: FloatArray
    base: Belief
    sites: Normal
    here: FloatArray
    counts: Counts | None
    told: Counts
    start: FloatArray
    model: HealthyModel = field(init=False)

    def __post_init__(self) -> None:
        self.model = self.given.model
        self.maximise()

    @classmethod
    def of(cls, weighing: SharedWeighing, base: Belief, unit: FloatArray) -> RunsTogether:
        """Return the state before anything was judged.

        Args:
            weighing: The runs.
            base: What is believed before, in units.
            unit: Unit of each part of theta, (theta,).
        """
        likelihood, size = weighing.likelihood, len(unit)
        runs, given = len(likelihood.usable), likelihood.model.imperfections
        learns = weighing.layout.offsets and given.settling is not None
        return cls(
            likelihood,
            weighing.hypotheses,
            weighing.priors,
            weighing.layout,
            unit,
            base,
            Normal(np.zeros((runs, size, size)), np.zeros((runs, size))),
            np.zeros(size),
            Counts.believed(given) if learns else None,
            Counts.none(runs, given),
            np.full((runs, len(weighing.hypotheses), size), np.nan),
        )

    @property
    def runs(self) -> int:
        """How many they are."""
        return len(self.sites.shift)

    @property
    def belief(self) -> Belief:
        """What is believed given all runs, one mixture, in units."""
        return self.base.times(summed(self.sites))

    @property
    def learned(self) -> HealthyModel:
        """The healthy robot with the offsets that are most probable by all runs."""
        return self.at(self.belief.moments[0][0] * self.unit)

    def at(self, theta: FloatArray) -> HealthyModel:
        """Return the healthy robot with some offsets beside those given."""
        if len(theta) == REGISTRATION:
            return self.model
        imperfections, given = self.model.imperfections, self.given.model.settling
        settling = offsets_of(theta, replace(given, scatter=self.model.settling.scatter))
        return replace(self.model, imperfections=replace(imperfections, settling=settling))

    def judge(self, rows: IntArray) -> list[Judged]:
        """Return what some runs say, each with its cavity; so many at a time as fit."""
        parts = np.split(rows, np.arange(CHUNK_RUNS, len(rows), CHUNK_RUNS))
        return [self._judge(part) for part in parts]

    def learn(self, found: Sequence[Judged], damping: float = 1.0) -> None:
        """Take in what runs say: sites, where to search for them, scatter, rates.

        Args:
            found: What they say.
            damping: Share of a new site that is taken.
        """
        for judged in found:
            rows = judged.rows
            site = self._site(judged)
            old = Normal(self.sites.precision[rows], self.sites.shift[rows])
            self.sites.precision[rows] += damping * (site.precision - old.precision)
            self.sites.shift[rows] += damping * (site.shift - old.shift)
            self.start[rows] = judged.best + self.here
            if self.counts is not None:
                told = judged.counts(self.given.model.imperfections)
                self.told.scatter[rows], self.told.losses[rows] = told.scatter, told.losses
        self.maximise()
        self.here = self.belief.moments[0][0] * self.unit

    def maximise(self) -> None:
        """Take the scatter and the rates that explain the runs best."""
        if self.counts is None:
            return
        given = self.given.model
        known = self.counts.plus(self.told).most_probable(given.imperfections)
        self.model = replace(given, imperfections=known)

    def _cavity(self, rows: IntArray) -> Belief:
        """Return the belief without the sites of some runs, each without its own."""
        whole = summed(self.sites)
        precision = whole.precision - self.sites.precision[rows]
        return self.base.times(Normal(precision, whole.shift - self.sites.shift[rows]))

    def _local(self, normal: Normal) -> Normal:
        """Return normals of theta about where runs are expanded, no longer in units."""
        precision = normal.precision / np.outer(self.unit, self.unit)
        return Normal(precision, normal.shift / self.unit - precision @ self.here)

    def _judge(self, rows: IntArray) -> Judged:
        cavity = self._cavity(rows)
        likelihood = replace(self.given[rows], model=self.at(self.here), remembered=None)
        weighing = SharedWeighing(likelihood, self.hypotheses, self.priors, self.layout)
        place = np.tile(self.here, (len(rows), 1))
        place[:, REGISTRATION:] = 0.0
        at = weighing.expand(np.arange(len(rows)), place)
        starts = self._starts(weighing, rows, place, cavity)
        asked = np.flatnonzero((cavity.weight > LEAST_SHARE).any(axis=0))
        found = [self._search(weighing, at, self._local(cavity[c]), starts) for c in asked]
        candidates = [Candidate(0, np.arange(len(rows)), each) for each in found]
        height = np.stack([each.log_evidence for each in found], axis=1)
        height += cavity.log_weight[:, asked, None]
        used = Belief(
            cavity.log_weight[:, asked], cavity.precision[:, asked], cavity.shift[:, asked]
        )
        return Judged(rows, weighing, used, candidates, height)

    @staticmethod
    def _search(
        weighing: SharedWeighing, at: object, prior: Normal, starts: Sequence[FloatArray]
    ) -> Weighed:
        found = [weighing.search(at, prior, start) for start in starts]
        return found[0] if len(found) == 1 else found[0].better(found[1])

    def _starts(
        self, weighing: SharedWeighing, rows: IntArray, place: FloatArray, cavity: Belief
    ) -> list[FloatArray]:
        """Return where to search: where it was found before, else where it is found coarsely."""
        before = self.start[rows] - self.here
        if np.isfinite(before).all():
            return [before]
        untold = COARSE_TO_FINE[1] * weighing.likelihood.model.twin.robot.reach
        coarse = weighing.expand(np.arange(len(rows)), place, untold)
        prior = self._local(cavity.matched())
        return [weighing.search(coarse, prior, np.zeros_like(place)).theta]

    def _site(self, judged: Judged) -> Normal:
        """Return what each run says beside its cavity, in units."""
        units = np.outer(self.unit, self.unit)
        theta = np.stack([each.found.theta for each in judged.candidates], axis=1)
        information = np.stack([each.found.information for each in judged.candidates], axis=1)
        covariance = np.linalg.inv(judged.cavity.precision[:, :, None] + information * units)
        mean, spread = mixed(judged.share, (theta + self.here) / self.unit, covariance)
        cavity = judged.cavity.matched()
        site = positive(np.linalg.inv(spread) - cavity.precision, 0.0)
        whole = ((cavity.precision + site) @ mean[..., None])[..., 0]
        return Normal(site, whole - cavity.shift)
