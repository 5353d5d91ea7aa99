"""Runs of one robot, judged with what the others say of what all of them share.

Expectation propagation. Each run i sends a site, a normal factor of theta; the belief is what was
believed before times all sites. A run is judged with the cavity, the belief without its own site:

    q_-i(theta) = sum over c of w_c,-i N_c,-i,
    p_i(h) ~ p(h) sum over c of w_c,-i integral of p(run_i | h, theta) N_c,-i
    m, V = moments of the mixture over h and c,    Lambda_i = V^-1 - V_-i^-1, no direction negative

with m_-i, V_-i the moments of the cavity. A run whose hypothesis is open sends a wide site, so that
what is faulty teaches little. Scatter and loss rates are learned beside it, by expectation and
maximisation with pseudo-counts.

Section: docs/inference.md#folders
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.evidence import TransientSamples
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.theta.shared_belief import Belief, mixed, summed
from failuretwin.inference.theta.shared_likelihood import Normal
from failuretwin.inference.theta.shared_unknowns import REGISTRATION, SharedLayout, offsets_of
from failuretwin.inference.theta.shared_weighing import (
    COARSE_TO_FINE,
    Candidate,
    SharedWeighing,
)
from failuretwin.inference.together.habits import Habits
from failuretwin.inference.together.judged_runs import Judged

LEAST_SHARE = 1e-3
"""Components of the belief that are less probable are not weighed."""
KNOWN_FRAME = 1e-3
"""Share of the largest precision of a frame below which it is in doubt; they lie millions apart."""
CHUNK_RUNS = 64
"""Runs that are weighed at a time."""


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
        habits: What is believed of scatter and losses without these runs; None: they are known.
        told: What each run says of them.
        counted: Whether others are judged with what each says, (run,).
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
    habits: Habits | None
    told: Habits
    counted: BoolArray
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
            Habits.believed(given) if learns else None,
            Habits.none(runs, given),
            np.ones(runs, dtype=bool),
        )

    @property
    def runs(self) -> int:
        """How many they are."""
        return len(self.sites.shift)

    @property
    def belief(self) -> Belief:
        """What is believed given all runs, one mixture, in units."""
        return self.base.times(summed(self.sites, self.counted))

    @property
    def learned(self) -> HealthyModel:
        """The healthy robot with the offsets that are most probable by all runs."""
        return self.at(self.belief.moments[0][0] * self.unit)

    def at(self, theta: FloatArray) -> HealthyModel:
        """Return the healthy robot with some offsets beside those given."""
        if len(theta) == REGISTRATION:
            return self.model
        imperfections, given = self.model.imperfections, self.given.model.settling
        now = self.model.settling
        given = replace(given, scatter=now.scatter, tail_dof=now.tail_dof)
        settling = offsets_of(theta, given)
        return replace(self.model, imperfections=replace(imperfections, settling=settling))

    def of_runs(self, rows: IntArray) -> RunsTogether:
        """Return the state of some of the runs alone, with what they have said so far."""
        return replace(
            self,
            given=self.given[rows],
            sites=Normal(self.sites.precision[rows], self.sites.shift[rows]),
            told=self.told[rows],
            counted=self.counted[rows],
        )

    def judge(
        self, rows: IntArray, moving: TransientSamples | None = None, asked: BoolArray | None = None
    ) -> list[Judged]:
        """Return what some runs say, each with its cavity; so many at a time as fit.

        Args:
            rows: The runs.
            moving: Their readings on the way; None: they are left aside.
            asked: Hypotheses that are weighed, (of these runs, hypothesis); None: all.
        """
        parts = np.split(np.arange(len(rows)), np.arange(CHUNK_RUNS, len(rows), CHUNK_RUNS))
        return [
            self._judge(
                rows[p],
                None if moving is None else moving[p],
                None if asked is None else asked[p],
            )
            for p in parts
        ]

    def learn(self, found: Sequence[Judged], damping: float = 1.0, of_habits: float = 1.0) -> None:
        """Take in what runs say: sites, scatter, rates.

        Args:
            found: What they say.
            damping: Share of a new site that is taken.
            of_habits: Share of what they newly say of scatter and losses that is taken.
        """
        for judged in found:
            rows, covariance = judged.rows, self._covariance(judged)
            site = self._site(judged, covariance)
            old = Normal(self.sites.precision[rows], self.sites.shift[rows])
            self.sites.precision[rows] += damping * (site.precision - old.precision)
            self.sites.shift[rows] += damping * (site.shift - old.shift)
            if self.habits is not None:
                covariance = covariance * np.outer(self.unit, self.unit)
                given = self.given.model.imperfections
                told = judged.habits(given, covariance, self._log_scatter)
                self.told.put(rows, self.told[rows].toward(told, of_habits))
        self.maximise()
        self.here = self.belief.moments[0][0] * self.unit

    def alone(self, judged: Judged) -> Normal:
        """Return what each run says without any belief, in units; before it is learned.

        The normal likelihoods Lambda, eta of all hypotheses, each about its best theta:

            Lambda theta + Lambda_c theta = eta + eta_c,    sum over c, h of p(c, h) (Lambda, eta)

        with Lambda_c, eta_c those of the cavity. A site is less apt: it also says which component
        of the belief is true, which narrows what a run by itself leaves open.
        """
        found = [each.found for each in judged.candidates]
        told = np.stack([each.information for each in found], axis=1)
        told = told * np.outer(self.unit, self.unit)
        theta = (np.stack([each.theta for each in found], axis=1) + self.here) / self.unit
        whole = told + judged.cavity.precision[:, :, None]
        shift = (whole @ theta[..., None])[..., 0] - judged.cavity.shift[:, :, None]
        share = judged.share
        return Normal(
            np.einsum("rch,rchtu->rtu", share, told), np.einsum("rch,rcht->rt", share, shift)
        )

    def maximise(self) -> None:
        """Take the scatter and the rates that explain the runs best."""
        if self.habits is None:
            return
        given = self.given.model
        told = self.habits.plus(self.told[np.flatnonzero(self.counted)])
        known = told.most_probable(given.imperfections)
        self.model = replace(given, imperfections=known)

    @property
    def _log_scatter(self) -> FloatArray:
        """Logarithms of scatter and tail beside those given, (motor + 1,)."""
        now, given = (m.settling for m in (self.model, self.given.model))
        tail = np.log(now.tail_dof / given.tail_dof) if np.isfinite(given.tail_dof) else 0.0
        return np.append(np.log(np.divide(now.scatter, given.scatter)), tail)

    def _cavity(self, rows: IntArray) -> Belief:
        """Return the belief without the sites of some runs, each without its own."""
        whole, own = summed(self.sites, self.counted), self.counted[rows]
        precision = whole.precision - own[:, None, None] * self.sites.precision[rows]
        shift = whole.shift - own[:, None] * self.sites.shift[rows]
        return self.base.times(Normal(precision, shift))

    def _local(self, normal: Normal) -> Normal:
        """Return normals of theta about where runs are expanded, no longer in units."""
        precision = normal.precision / np.outer(self.unit, self.unit)
        return Normal(precision, normal.shift / self.unit - precision @ self.here)

    def _judge(
        self, rows: IntArray, moving: TransientSamples | None, of: BoolArray | None
    ) -> Judged:
        cavity, model = self._cavity(rows), self.at(self.here)
        likelihood = RunLikelihood(self.given.evidence[rows], model, moving)
        weighing = SharedWeighing(likelihood, self.hypotheses, self.priors, self.layout)
        place = np.tile(self.here, (len(rows), 1))
        place[:, REGISTRATION:] = 0.0
        at = weighing.expand(np.arange(len(rows)), place)
        start = self._start(weighing, rows, place)
        asked = np.flatnonzero((cavity.weight > LEAST_SHARE).any(axis=0))
        found = [weighing.search(at, self._local(cavity[int(c)]), start, of) for c in asked]
        candidates = [Candidate(0, np.arange(len(rows)), each) for each in found]
        height = np.stack([each.log_evidence for each in found], axis=1)
        height += cavity.log_weight[:, asked, None]
        used = Belief(
            cavity.log_weight[:, asked], cavity.precision[:, asked], cavity.shift[:, asked]
        )
        return Judged(rows, weighing, used, candidates, height, self._loose[asked])

    @property
    def _loose(self) -> BoolArray:
        """With which components the frame may be elsewhere, if with some it may not, (component,).

        By how precisely its origin is believed to be known.
        """
        known = self.base.precision[0, :, 0, 0]
        return np.asarray(known < KNOWN_FRAME * known.max())

    def _start(self, weighing: SharedWeighing, rows: IntArray, place: FloatArray) -> FloatArray:
        """Return where to search, (run, theta) or (run, hypothesis, theta).

        At the mean of what is believed; of runs that say something for the first time, where each
        hypothesis is found coarsely.
        """
        prior = self._local(self._cavity(rows).matched())
        if self.sites.precision[rows].any(axis=(1, 2)).all():
            return prior.mean
        untold = COARSE_TO_FINE[1] * weighing.likelihood.model.twin.robot.reach
        coarse = weighing.expand(np.arange(len(rows)), place, untold)
        return weighing.search(coarse, prior, np.zeros_like(place)).theta

    def _covariance(self, judged: Judged) -> FloatArray:
        """Return that of theta in units, (run, candidate, hypothesis, theta, theta)."""
        information = np.stack([each.found.information for each in judged.candidates], axis=1)
        units = np.outer(self.unit, self.unit)
        precision = judged.cavity.precision[:, :, None] + information * units
        return np.asarray(np.linalg.inv(precision))

    def _site(self, judged: Judged, covariance: FloatArray) -> Normal:
        """Return what each run says beside its cavity, in units.

        The moments are those over hypotheses and components, with the frame known and with it in
        doubt apart; the two count by their shares. Moments over both would say with the run which
        is true: a run that but prefers a known frame would be sure of it.
        """
        runs, size = len(judged.share), len(self.unit)
        told = Normal(np.zeros((runs, size, size)), np.zeros((runs, size)))
        for loose in np.unique(judged.loose):
            some = np.flatnonzero(judged.loose == loose)
            weight = judged.share[:, some].sum(axis=(1, 2))
            site = self._moments(judged, covariance, some)
            told.precision[...] += weight[:, None, None] * site.precision
            told.shift[...] += weight[:, None] * site.shift
        return told

    def _moments(self, judged: Judged, covariance: FloatArray, some: IntArray) -> Normal:
        """Return what each run says by the moments over some components, in units.

        A direction in which a run leaves more open than was believed before tells nothing.
        """
        theta = np.stack([judged.candidates[c].found.theta for c in some], axis=1)
        share = np.maximum(judged.share[:, some], np.finfo(float).tiny)
        share = share / share.sum(axis=(1, 2), keepdims=True)
        mean, spread = mixed(share, (theta + self.here) / self.unit, covariance[:, some])
        cavity, precision = judged.cavity.only(some).matched(), np.linalg.inv(spread)
        shift = (precision @ mean[..., None])[..., 0] - cavity.shift
        values, vectors = np.linalg.eigh(precision - cavity.precision)
        told = np.swapaxes(vectors, -1, -2) * (values > 0.0)[..., None]
        site = np.swapaxes(told, -1, -2) @ (told * values[..., None])
        along = np.swapaxes(told, -1, -2) @ (told @ shift[..., None])
        return Normal(site, along[..., 0])
