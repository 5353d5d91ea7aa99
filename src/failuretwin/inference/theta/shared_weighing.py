"""What runs say of every hypothesis with theta normal, and of whether their set-up is in doubt.

Expanded about some registration, each hypothesis is searched for its best theta. A run that
nothing explains is registered first, from coarse to fine: what a wrong frame leaves must not look
like outliers.

Section: docs/inference.md#shared-unknowns
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.numerics import log_sum
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.posterior import (
    log_prior,
    marginal_likelihoods,
)
from failuretwin.inference.theta.linear_response import LinearResponse
from failuretwin.inference.theta.shared_likelihood import (
    Fit,
    LocalLikelihood,
    Normal,
    has_score,
    local_likelihood,
    search,
)
from failuretwin.inference.theta.shared_unknowns import (
    REGISTRATION,
    SharedComponent,
    SharedLayout,
    components,
    layout_of,
    registered_evidence,
    registered_samples,
)

COARSE_TO_FINE = (0.026, 0.004, 0.0)
"""Noise added while a sensor that is far off is registered, as shares of the reach: what a wrong
frame leaves must not look like outliers."""
ILL_FITTING = 8.0
"""Mean squared distance of a movement above which nothing explains a run, in scales: three axes
give three if all is well."""
SUSPECT_NATS, SUSPECT_RUN_NATS, SUSPECT_SHARE = 12.0, 0.2, 0.3
"""Set-ups of a run set are weighed where one registration of all runs would explain them better by
so much, half of the runs by so much each, or where so large a share fits ill: what few runs say
against the rest is their fault, not the set-up."""
SAMPLED_RUNS = 24
"""Runs from which the registration of a run set is found, as a start for each of its runs."""


FEW_RUNS = 10
"""So few runs start from their own registration and from the profile's, more from a common one."""


@dataclass(frozen=True)
class Expansion:
    """Some runs, ready to be weighed near one registration of each.

    Attributes:
        response: The runs.
        place: Registration of each there, (run, theta).
    """

    response: LinearResponse
    place: FloatArray

    def __getitem__(self, rows: slice | IntArray) -> Expansion:
        """Return some of the runs alone."""
        return Expansion(self.response[rows], self.place[rows])

    def prior(self, deviation: FloatArray) -> Normal:
        """Return N(0, P) of theta as seen from here.

        Args:
            deviation: Standard deviations, (theta,) or (run, theta).
        """
        precision = np.broadcast_to(deviation, self.place.shape) ** -2.0
        diagonal = precision[:, None] * np.eye(self.place.shape[1])
        return Normal(diagonal, -self.place * precision)


@dataclass(frozen=True)
class Weighed:
    """What some runs say of all hypotheses with theta normal about some mean.

    Attributes:
        expansion: Where they were weighed.
        theta: Best theta of each beside the place of the expansion, (run, hypothesis, theta).
        log_evidence: (run, hypothesis).
        misfit: Mean D^2 there, (run, hypothesis).
        information: A there, (run, hypothesis, theta, theta).
    """

    expansion: Expansion
    theta: FloatArray
    log_evidence: FloatArray
    misfit: FloatArray
    information: FloatArray

    @classmethod
    def of(cls, at: Expansion, fits: Sequence[Fit]) -> Weighed:
        """Return what was found near the best theta of each hypothesis."""
        return cls(
            at,
            np.stack([fit.theta for fit in fits], axis=1),
            np.stack([fit.log_evidence for fit in fits], axis=1),
            np.stack([fit.says.misfit for fit in fits], axis=1),
            np.stack([fit.says.information for fit in fits], axis=1),
        )

    def __getitem__(self, rows: slice | IntArray) -> Weighed:
        """Return some of the runs alone."""
        return Weighed(*(getattr(self, field.name)[rows] for field in fields(self)))

    def best(self, log_odds: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return theta (run, theta) and misfit (run,) of the most probable hypothesis."""
        best = np.argmax(self.log_evidence + log_odds, axis=1)
        rows = np.arange(len(best))
        return self.theta[rows, best], self.misfit[rows, best]

    def with_hypotheses(self, places: Sequence[int], some: Weighed) -> Weighed:
        """Return the same with what is said of some hypotheses replaced."""

        def replaced(name: str) -> FloatArray:
            values = np.array(getattr(self, name))
            values[:, places] = getattr(some, name)
            return values

        return Weighed(self.expansion, *(replaced(field.name) for field in fields(self)[1:]))

    def better(self, other: Weighed) -> Weighed:
        """Return the better of two searches for each run and hypothesis."""
        wins = other.log_evidence > self.log_evidence

        def either(name: str) -> FloatArray:
            ours, theirs = getattr(self, name), getattr(other, name)
            return np.where(wins.reshape(*wins.shape, *(1,) * (ours.ndim - 2)), theirs, ours)

        arrays = [either(field.name) for field in fields(self)[1:]]
        return Weighed(self.expansion, *arrays)


@dataclass(frozen=True)
class Candidate:
    """What some of the runs say in one component.

    Attributes:
        component: Its index.
        rows: Indices of the runs.
        found: What they say.
    """

    component: int
    rows: IntArray
    found: Weighed


@dataclass(frozen=True)
class SharedWeighing:
    """Some runs, and what is believed of their shared unknowns.

    Attributes:
        likelihood: The runs as they were seen.
        hypotheses: What may be the case.
        priors: Beliefs about faults and set-ups.
        known_layout: What stands in theta; None: what is in doubt of the model.
    """

    likelihood: RunLikelihood
    hypotheses: Sequence[Hypothesis]
    priors: Priors
    known_layout: SharedLayout | None = None

    @cached_property
    def layout(self) -> SharedLayout:
        """What stands in theta."""
        return self.known_layout or layout_of(self.likelihood.model)

    @cached_property
    def parts(self) -> list[SharedComponent]:
        """What is believed of theta; the first: all is well."""
        return components(self.likelihood.model, self.priors.setup, self.layout)

    @cached_property
    def log_odds(self) -> FloatArray:
        """Log prior of each hypothesis, (hypothesis,)."""
        return log_prior(self.hypotheses, self.priors)

    @property
    def _suspects(self) -> range:
        """Motors to look at: all, or none where all is well and the way is left aside."""
        healthy = all(hypothesis.is_healthy for hypothesis in self.hypotheses)
        return range(0 if healthy and self.likelihood.moving is None else self.layout.motors)

    @cached_property
    def broad(self) -> FloatArray:
        """Largest deviations of all components, (theta,)."""
        return np.maximum.reduce([part.deviation for part in self.parts])

    @cached_property
    def slabs(self) -> list[int]:
        """Components of a wrong registration."""
        return [c for c, part in enumerate(self.parts) if part.name and not part.noise_m]

    @cached_property
    def nowhere(self) -> FloatArray:
        """Theta of a set-up that is as it should be, (run, theta)."""
        return np.zeros((len(self.likelihood.usable), self.layout.size))

    # Weighing runs near some registration.

    def expand(self, rows: IntArray, place: FloatArray, untold_noise_m: float = 0.0) -> Expansion:
        """Return some of the runs, registered; with noise beside what is known, if any [m]."""
        likelihood, known = self.likelihood, self.likelihood.model
        noise = float(np.hypot(known.untold_noise_m, untold_noise_m))
        model = replace(known, untold_noise_m=noise)
        seen = registered_evidence(likelihood.evidence[rows], place, model.sensors)
        way = likelihood.moving
        way = None if way is None else registered_samples(way[rows], place, model.sensors)
        return Expansion(LinearResponse.of(seen, model, self.layout, self._suspects, way), place)

    def search(
        self, at: Expansion, prior: Normal, start: FloatArray, asked: BoolArray | None = None
    ) -> Weighed:
        """Return what runs say with theta normal.

        Hypotheses without a score of their own are weighed at the best theta of the others, and
        count as wide as the most probable of them.

        Args:
            at: The runs.
            prior: Of theta, as seen from there.
            start: Where to start, (run, theta) or (run, hypothesis, theta).
            asked: Hypotheses of each run that are weighed, (run, hypothesis); None: all.
        """
        shape = (len(start), len(self.hypotheses), self.layout.size)
        start = np.broadcast_to(start if start.ndim == 3 else start[:, None], shape)
        scored = [i for i, h in enumerate(self.hypotheses) if has_score(h)]
        of, odds = [self.hypotheses[i] for i in scored], self.log_odds[scored]
        which = None if asked is None else asked[:, scored]
        fits = search(at.response, of, odds, self.priors, prior, start[:, scored], which)
        known = Weighed.of(at, fits)
        if len(of) == len(self.hypotheses):
            return known
        theta, misfit = known.best(odds)
        rows, best = np.arange(len(theta)), np.argmax(known.log_evidence + odds, axis=1)
        information = known.information[rows, best]
        there = at.response.at(theta, range(self.layout.motors))
        others = marginal_likelihoods(there, self.hypotheses, self.priors)
        width = 0.5 * np.linalg.slogdet(prior.precision + information)[1]
        says = np.stack([other.log_evidence for other in others], axis=1)
        says = says + (prior.log_density(theta) - width)[:, None]
        all_alike = (np.repeat(one[:, None], len(others), axis=1) for one in (misfit, information))
        rest = Weighed(at, np.repeat(theta[:, None], len(others), axis=1), says, *all_alike)
        return rest.with_hypotheses(scored, known)

    def search_twice(self, at: Expansion, prior: Normal, start: FloatArray) -> Weighed:
        """Return the same, every hypothesis started from the best theta of all too."""
        found = self.search(at, prior, start)
        return found.better(self.search(at, prior, found.best(self.log_odds)[0]))

    # Whether the set-up is as it should be.

    @cached_property
    def as_told(self) -> list[Candidate]:
        """What settled positions say if the set-up is as it should be."""
        rows = np.arange(len(self.nowhere))
        at = self.expand(rows, self.nowhere)
        deviations = [part.deviation for part in self.parts if not part.name]
        priors = [at.prior(deviation) for deviation in deviations]
        if not self.layout.offsets:
            return [Candidate(0, rows, self.search(at, priors[0], self.nowhere))]
        untold = COARSE_TO_FINE[1] * self.likelihood.model.twin.robot.reach
        coarse = self.search(self.expand(rows, self.nowhere, untold), priors[-1], self.nowhere)
        starts = (coarse.theta, self.nowhere)
        return [
            Candidate(c, rows, self.search(at, prior, start))
            for c, prior in enumerate(priors)
            for start in starts
        ]

    def _here(self, at: Expansion) -> list[LocalLikelihood]:
        """Return what runs say of the hypotheses that have a score, where they are expanded."""
        zero = np.zeros_like(at.place)
        return [
            local_likelihood(at.response, h, self.priors, zero)
            for h in self.hypotheses
            if has_score(h)
        ]

    def pooled(self, at: Expansion) -> FloatArray:
        """Return the registration that explains some runs best together, (theta,) beside `at`.

        One Newton step, all hypotheses of each run in their shares.
        """
        says = self._here(at)
        height = np.stack([each.log_likelihood for each in says], axis=1)
        height += self.log_odds[[has_score(h) for h in self.hypotheses]]
        share = np.exp(height - log_sum(height, axis=1)[:, None])
        score = np.einsum("rh,hrt->t", share, np.stack([each.score for each in says]))
        information = np.einsum("rh,hrtu->tu", share, np.stack([each.information for each in says]))
        return self.newton(score, information, at.place[0])[0]

    def newton(
        self, score: FloatArray, information: FloatArray, place: FloatArray
    ) -> tuple[FloatArray, float]:
        """Return a Newton step of the registration that runs share, and its gain [nats].

        Args:
            score: Sum of their scores, (theta,).
            information: Sum of their information, (theta, theta).
            place: Where they are expanded, (theta,).
        """
        precision = np.diag(self.broad**-2.0)
        shift = score - precision @ place
        step = np.asarray(np.linalg.solve(information + precision, shift))
        step[REGISTRATION:] = 0.0
        return step, float(0.5 * shift @ step)

    def suspect(self, best: IntArray) -> bool:
        """Return whether the set-up may be off: all runs of a set share one.

        Args:
            best: The most probable hypothesis of each if the set-up is as it should be, (run,).
        """
        at = self.expand(np.arange(len(best)), self.nowhere)
        runs, size = at.place.shape
        score, information = np.zeros((runs, size)), np.zeros((runs, size, size))
        ill = np.zeros(runs, dtype=bool)
        for i, hypothesis in enumerate(self.hypotheses):
            rows = np.flatnonzero(best == i)
            if len(rows):
                some = at[rows]
                zero = np.zeros_like(some.place)
                says = local_likelihood(some.response, hypothesis, self.priors, zero)
                score[rows], information[rows] = says.score, says.information
                ill[rows] = says.misfit > ILL_FITTING
        step, gain = self.newton(score.sum(axis=0), information.sum(axis=0), self.nowhere[0])
        of_run = score @ step - 0.5 * np.einsum("t,rtu,u->r", step, information, step)
        together = gain > SUSPECT_NATS and float(np.median(of_run)) > SUSPECT_RUN_NATS
        return together or bool(ill.mean() > SUSPECT_SHARE)

    # Where the sensor may really stand.

    def register(self, rows: IntArray) -> FloatArray:
        """Return a registration of each of some runs, from coarse to fine, (run, theta)."""
        place = self.nowhere[rows]
        for share in COARSE_TO_FINE:
            at = self.expand(rows, place, share * self.likelihood.model.twin.robot.reach)
            found = self.search(at, at.prior(self.broad), np.zeros_like(place))
            place = place + found.best(self.log_odds)[0]
            place[:, REGISTRATION:] = 0.0
        return place

    def register_together(self) -> FloatArray:
        """Return one registration of all runs, (run, theta): the median of some, then theirs."""
        count, reach = len(self.nowhere), self.likelihood.model.twin.robot.reach
        rows = np.unique(np.linspace(0, count - 1, min(count, SAMPLED_RUNS)).astype(np.int64))
        place = np.median(self.register(rows), axis=0)
        for share in (COARSE_TO_FINE[1], 0.0, 0.0):
            at = self.expand(rows, np.tile(place, (len(rows), 1)), share * reach)
            place = place + self.pooled(at)
        return np.tile(place, (count, 1))

    def set_ups(self, rows: IntArray, place: FloatArray) -> list[Candidate]:
        """Return what some runs say in each component of a wrong registration.

        Args:
            rows: Indices of the runs.
            place: Where to expand them, (run, theta).
        """
        many = len(self.slabs)
        deviation = np.tile([self.parts[c].deviation for c in self.slabs], (len(rows), 1))
        at = self.expand(rows, place)[np.repeat(np.arange(len(rows)), many)]
        start = np.where(deviation < 1e-2 * self.broad, -at.place, 0.0)
        found = self.search_twice(at, at.prior(deviation), start)
        return [Candidate(c, rows, found[i::many]) for i, c in enumerate(self.slabs)]

    def noisy(self, rows: IntArray) -> list[Candidate]:
        """Return what some runs say if the sensor is noisier than is known."""
        found = []
        for c, part in enumerate(self.parts):
            if part.noise_m:
                at = self.expand(rows, self.nowhere[rows], part.noise_m)
                says = self.search(at, at.prior(part.deviation), self.nowhere[rows])
                found.append(Candidate(c, rows, says))
        return found

    @cached_property
    def candidates(self) -> list[Candidate]:
        """What the runs say in every component."""
        rows = np.arange(len(self.nowhere))
        if not self.slabs:
            return [*self.as_told, *self.noisy(rows)]
        if len(rows) < FEW_RUNS:
            places = [self.register(rows), self.nowhere]
        else:
            places = [self.register_together()]
        found = [each for place in places for each in self.set_ups(rows, place)]
        return [*self.as_told, *found, *self.noisy(rows)]
