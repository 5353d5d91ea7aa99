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

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.inference.engine.theta import (
    AS_TOLD,
    JITTER,
    Components,
    Layout,
    offsets_doubted,
    offsets_of,
)
from failuretwin.inference.engine.weighing import Weighing
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.evidence import TransientSamples
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.registered import REGISTRATION
from failuretwin.inference.together.belief import Belief, Normal, summed
from failuretwin.inference.together.habits import Habits
from failuretwin.inference.together.judged_runs import Judged

LEAST_SHARE = 1e-3
"""Components of the belief that are less probable are not weighed."""
KNOWN_FRAME = 1e-3
"""Share of the largest precision of a frame below which it is in doubt; they lie millions apart."""
CHUNK_RUNS = 32
"""Runs that are weighed at a time."""


@dataclass
class RunsTogether:
    """The state of the recursion; theta is relative to the model that was given.

    Attributes:
        given: The runs, with the model that was given.
        hypotheses: What may be the case.
        priors: Beliefs about faults and set-ups.
        layout: Places in theta.
        unit: Unit of each part of theta, (theta,).
        base: What is believed of theta without these runs, one mixture, in units.
        sites: What each run says, in units.
        here: Where runs are expanded, (theta,).
        habits: What is believed of scatter, noise and losses without these runs; None: they are
            known.
        told: What each run says of them.
        counted: Whether others are judged with what each says, (run,).
        model: The healthy robot with scatter and rates that were learned.
    """

    given: RunLikelihood
    hypotheses: Sequence[Hypothesis]
    priors: Priors
    layout: Layout
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
    def of(
        cls,
        likelihood: RunLikelihood,
        hypotheses: Sequence[Hypothesis],
        priors: Priors,
        layout: Layout,
        base: Belief,
        unit: FloatArray,
    ) -> RunsTogether:
        """Return the state before anything was judged.

        Args:
            likelihood: The runs.
            hypotheses: What may be the case.
            priors: Beliefs about faults and set-ups.
            layout: Places in theta.
            base: What is believed before, in units.
            unit: Unit of each part of theta, (theta,).
        """
        size, runs, model = layout.size, len(likelihood.usable), likelihood.model
        learns = offsets_doubted(model) and model.imperfections.settling is not None
        return cls(
            likelihood,
            hypotheses,
            priors,
            layout,
            unit,
            base,
            Normal(np.zeros((runs, size, size)), np.zeros((runs, size))),
            np.zeros(size),
            Habits.believed(model) if learns else None,
            Habits.none(runs, model),
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
        if self.model.imperfections.settling is None:
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
        self,
        rows: IntArray,
        moving: TransientSamples | None = None,
        asked: BoolArray | None = None,
        noise_m: float = 0.0,
    ) -> Iterator[Judged]:
        """Yield what some runs say, each with its cavity; so many at a time as fit.

        Nothing may be learned before the last one was taken.

        Args:
            rows: The runs.
            moving: Their readings on the way; None: they are left aside.
            asked: Hypotheses that are weighed, (of these runs, hypothesis); None: all.
            noise_m: Noise of the sensor beside what is known [m].
        """
        parts = np.split(np.arange(len(rows)), np.arange(CHUNK_RUNS, len(rows), CHUNK_RUNS))
        for p in parts:
            way = None if moving is None else moving[p]
            yield self._judge(rows[p], way, None if asked is None else asked[p], noise_m)

    def learn(
        self, found: Iterable[Judged], damping: float = 1.0, of_habits: float = 1.0
    ) -> BoolArray:
        """Take in what runs say: sites, scatter, rates.

        What was worked out to judge them is dropped as soon as a site is there.

        Args:
            found: What they say.
            damping: Share of a new site that is taken.
            of_habits: Share of what they newly say of scatter and losses that is taken.

        Returns:
            Which hypotheses of each run may teach something, (run, hypothesis).
        """
        said = [self._said(judged) for judged in found]
        for rows, site, told, _ in said:
            old = Normal(self.sites.precision[rows], self.sites.shift[rows])
            self.sites.precision[rows] += damping * (site.precision - old.precision)
            self.sites.shift[rows] += damping * (site.shift - old.shift)
            if told is not None:
                self.told.put(rows, self.told[rows].toward(told, of_habits))
        self._wait_for_scales(np.concatenate([rows for rows, *_ in said]))
        self.maximise()
        self.here = self.layout.place(self.belief.moments[0][0] * self.unit)
        return np.concatenate([likely for *_, likely in said])

    def _said(self, judged: Judged) -> tuple[IntArray, Normal, Habits | None, BoolArray]:
        """Return runs, their sites, what they say of habits, and their likely hypotheses."""
        habits = None if self.habits is None else judged.habits(self.given.model)
        return judged.rows, self._site(judged), habits, judged.likely

    def _wait_for_scales(self, rows: IntArray) -> None:
        """Let what some runs say of tails wait until scatter and noise are found."""
        if self.habits is not None and not self._habits.settled(self.model, self.given.model):
            self.told.forget_tails(rows)

    @property
    def _habits(self) -> Habits:
        """What is believed of scatter, noise and losses with these runs."""
        assert self.habits is not None
        return self.habits.plus(self.told[np.flatnonzero(self.counted)])

    def alone(self, judged: Judged) -> Normal:
        """Return what each run says without any belief, in units; before it is learned.

        A site is less apt: it also says which component of the belief is true, which narrows what a
        run by itself leaves open.
        """
        information, shift = judged.factors
        shift = shift + information @ self.here
        return Normal(information * np.outer(self.unit, self.unit), shift * self.unit)

    def maximise(self) -> None:
        """Take the scatter, the noise and the rates that explain the runs best."""
        if self.habits is not None:
            self.model = self._habits.most_probable(self.given.model)

    def _cavity(self, rows: IntArray) -> Belief:
        """Return the belief without the sites of some runs, each without its own."""
        whole, own = summed(self.sites, self.counted), self.counted[rows]
        precision = whole.precision - own[:, None, None] * self.sites.precision[rows]
        shift = whole.shift - own[:, None] * self.sites.shift[rows]
        return self.base.times(Normal(precision, shift))

    def _judge(
        self,
        rows: IntArray,
        moving: TransientSamples | None,
        asked: BoolArray | None,
        noise_m: float,
    ) -> Judged:
        cavity, model = self._cavity(rows), self.at(self.here)
        some = np.flatnonzero((cavity.weight > LEAST_SHARE).any(axis=0))
        used = Belief(cavity.log_weight[:, some], cavity.precision[:, some], cavity.shift[:, some])
        weighing = Weighing(
            RunLikelihood(self.given.evidence[rows], model, moving),
            self.hypotheses,
            self.priors,
            self.layout,
            self._components(used, float(np.hypot(model.path_noise, noise_m))),
            np.tile(self.here[:REGISTRATION], (len(rows), 1)),
            asked,
            self.belief.moments[1][0] * np.outer(self.unit, self.unit),
            lag_s=self.here[self.layout.lags] if self.layout.moving else None,
        )
        return Judged(rows, weighing, used, self._loose[some])

    def _components(self, belief: Belief, noise_m: float) -> Components:
        """Return beliefs of each run about where runs are expanded, no longer in units.

        How evenly motors start is unknown of each run that is seen on the way.
        """
        covariance: FloatArray = np.asarray(np.linalg.inv(belief.precision))
        mean = np.einsum("rctu,rcu->rct", covariance, belief.shift) * self.unit - self.here
        covariance = np.asarray(covariance * np.outer(self.unit, self.unit))
        starts = JITTER if self.layout.moving else AS_TOLD.jitter
        normal = np.tile(np.arange(mean.shape[1]), len(starts))
        share = np.repeat(list(starts.values()), mean.shape[1])
        return Components(
            belief.log_weight[:, normal] + np.log(share),
            normal,
            mean,
            covariance,
            np.ones(len(normal)),
            np.repeat(list(starts), mean.shape[1]),
            np.full(len(normal), noise_m),
            np.zeros(len(normal), dtype=bool),
        )

    @property
    def _loose(self) -> BoolArray:
        """With which components the frame may be elsewhere, if with some it may not, (component,).

        By how precisely its origin is believed to be known.
        """
        known = self.base.precision[0, :, 0, 0]
        return np.asarray(known < KNOWN_FRAME * known.max())

    def _site(self, judged: Judged) -> Normal:
        """Return what each run says beside its cavity, in units.

        The moments are those over hypotheses and components, with the frame known and with it in
        doubt apart; the two count by their shares. Moments over both would say with the run which
        is true: a run that but prefers a known frame would be sure of it.
        """
        runs, size = judged.runs, len(self.unit)
        told = Normal(np.zeros((runs, size, size)), np.zeros((runs, size)))
        for loose in np.unique(judged.loose).tolist():
            weight, mean, covariance = judged.moments(loose)
            some = np.flatnonzero(weight > LEAST_SHARE)
            mean = (mean[some] + self.here) / self.unit
            spread = covariance[some] / np.outer(self.unit, self.unit)
            cavity = judged.cavity.only(np.flatnonzero(judged.loose == loose)).matched()[some]
            site = _beside(cavity, mean, spread)
            told.precision[some] += weight[some, None, None] * site.precision
            told.shift[some] += weight[some, None] * site.shift
        return told


def _beside(cavity: Normal, mean: FloatArray, spread: FloatArray) -> Normal:
    """Return the normal factor that makes moments of theta of those of a cavity.

    A direction in which a run leaves more open than was believed before tells nothing.

    Args:
        cavity: What was believed before.
        mean: Mean given the run, (run, theta).
        spread: Covariance given the run, (run, theta, theta).
    """
    precision = np.linalg.inv(spread)
    shift = (precision @ mean[..., None])[..., 0] - cavity.shift
    values, vectors = np.linalg.eigh(precision - cavity.precision)
    told = np.swapaxes(vectors, -1, -2) * (values > 0.0)[..., None]
    site = np.swapaxes(told, -1, -2) @ (told * values[..., None])
    along = np.swapaxes(told, -1, -2) @ (told @ shift[..., None])
    return Normal(site, along[..., 0])
