"""What the runs of a folder say together: of each run's hypothesis, and of what they share.

Expectation propagation. Each run i sends a site, a normal factor of theta; the belief is the prior
times all sites. A run is judged with the cavity, the belief without its own site:

    Lambda = Lambda_0 + sum_i Lambda_i,    p_i(h) ~ p(h) integral of p(run_i | h, theta) N_cav
    m, V = moments of the mixture over h,  Lambda_i = V^-1 - Lambda_cav, no direction negative

A run whose hypothesis is open sends a wide site, so that what is faulty teaches little. Scatter and
loss rates are learned beside it, by expectation and maximisation with pseudo-counts.

Section: docs/self_calibration.md
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.numerics import log_sum
from failuretwin.core.types import FloatArray, IntArray
from failuretwin.digital_model.nonidealities import LostCommand
from failuretwin.inference.healthy_model import HealthyModel
from failuretwin.inference.posterior import Posterior
from failuretwin.inference.priors import Priors
from failuretwin.inference.run_likelihood import RunLikelihood
from failuretwin.inference.shared_likelihood import Normal
from failuretwin.inference.shared_posterior import Mixture, set_up_in_doubt
from failuretwin.inference.shared_unknowns import REGISTRATION, offsets_of
from failuretwin.inference.shared_weighing import (
    COARSE_TO_FINE,
    Candidate,
    SharedWeighing,
    Weighed,
)

PASSES = 4
"""Times that every run is judged; later ones change nothing that matters."""
DAMPING = 0.7
"""Share of a new site that is taken, from the second pass on."""
LEAST_PRECISION = 1e-9
"""Of a cavity, in units of the prior's."""
SCATTER_COUNT, RATE_COUNT = 12.0, 30.0
"""Movements that the prior of a scatter and of a loss rate counts for."""
CHUNK_RUNS = 64
"""Runs that are weighed at a time."""
Advance = Callable[[int], None]
"""Told how many passes over the runs have just been done, of `PASSES`."""


@dataclass(frozen=True)
class FolderPosterior:
    """What some runs say together.

    Attributes:
        model: The healthy robot with the offsets, scatter and rates that were learned.
        place: Where the sensor stands, (theta,).
        mean: Posterior mean of theta about the model that was given, (theta,).
        covariance: Posterior covariance, (theta, theta).
        prior_deviation: What theta was believed to differ by, (theta,): more than that of others of
            the kind where the set-up is in doubt.
        usual_deviation: What theta of others of the kind differs by, (theta,).
        sites: What each run says of theta, in units of `prior_deviation`.
        taught: By how much each run has narrowed theta, 1/2 log det (I + Lambda_i V),
            (run,) [nats].
        posteriors: Of some of the runs each, in their order.
    """

    model: HealthyModel
    place: FloatArray
    mean: FloatArray
    covariance: FloatArray
    prior_deviation: FloatArray
    usual_deviation: FloatArray
    sites: Normal
    taught: FloatArray
    posteriors: Sequence[Posterior]

    @property
    def deviation(self) -> FloatArray:
        """Standard deviation of theta, (theta,)."""
        return np.sqrt(np.diag(self.covariance))


def folder_posterior(
    likelihood: RunLikelihood,
    hypotheses: Sequence[Hypothesis],
    priors: Priors,
    advance: Advance = lambda passes: None,
) -> FolderPosterior:
    """Weigh every hypothesis by each run, with what all runs say of what they share.

    Args:
        likelihood: The runs; the doubt of their model is the prior of theta.
        hypotheses: What may be the case.
        priors: Beliefs about faults and set-ups.
        advance: Told of progress.
    """
    return _Folder.of(likelihood, hypotheses, priors).run(advance)


@dataclass
class _Folder:
    """The state of the recursion; theta is relative to the model that was given."""

    given: RunLikelihood
    model: HealthyModel
    hypotheses: Sequence[Hypothesis]
    priors: Priors
    usual: FloatArray
    unit: FloatArray
    here: FloatArray
    sites: Normal
    start: FloatArray | None = None

    @classmethod
    def of(
        cls, likelihood: RunLikelihood, hypotheses: Sequence[Hypothesis], priors: Priors
    ) -> _Folder:
        weighing = SharedWeighing(likelihood, hypotheses, priors)
        usual = deviation = weighing.parts[0].deviation
        here = np.zeros(len(deviation))
        runs = len(likelihood.usable)
        some = np.unique(np.linspace(0, runs - 1, CHUNK_RUNS // 2).astype(np.int64))
        if set_up_in_doubt(likelihood[some], hypotheses, priors):
            deviation = weighing.broad
            here = weighing.register_together()[0]
        sites = Normal(np.zeros((runs, len(here), len(here))), np.zeros((runs, len(here))))
        model = likelihood.model
        return cls(likelihood, model, hypotheses, priors, usual, deviation, here, sites)

    def run(self, advance: Advance) -> FolderPosterior:
        """Pass over the runs until nothing changes."""
        for done in range(PASSES):
            found = [self._judge(rows) for rows in self._chunks]
            if done < PASSES - 1:
                self._learn(found, 1.0 if done == 0 else DAMPING)
            advance(1)
        belief = self._belief
        covariance = np.linalg.inv(belief.precision[0]) * np.outer(self.unit, self.unit)
        narrowed = self.sites.precision @ np.linalg.inv(belief.precision[0])
        taught = 0.5 * np.linalg.slogdet(np.eye(len(self.unit)) + narrowed)[1]
        posteriors = [
            Mixture.of(weighing, [Candidate(0, np.arange(len(rows)), weighed)]).posterior()
            for (weighing, weighed), rows in zip(found, self._chunks, strict=True)
        ]
        mean = belief.mean[0] * self.unit
        place = mean.copy()
        place[REGISTRATION:] = 0.0
        at = self._at(mean)
        return FolderPosterior(
            at, place, mean, covariance, self.unit, self.usual, self.sites, taught, posteriors
        )

    @property
    def _chunks(self) -> list[IntArray]:
        count = len(self.sites.shift)
        return [
            np.arange(first, min(first + CHUNK_RUNS, count))
            for first in range(0, count, CHUNK_RUNS)
        ]

    @property
    def _belief(self) -> Normal:
        """Prior times all sites, in units, of one row."""
        size = len(self.unit)
        precision = np.eye(size) + self.sites.precision.sum(axis=0)
        return Normal(precision[None], self.sites.shift.sum(axis=0)[None])

    def _cavity(self, rows: IntArray) -> Normal:
        """Return the belief without the sites of some runs, each without its own, in units."""
        belief = self._belief
        precision = _positive(belief.precision - self.sites.precision[rows], LEAST_PRECISION)
        return Normal(precision, belief.shift - self.sites.shift[rows])

    def _local(self, normal: Normal) -> Normal:
        """Return normals of theta about where the runs are expanded, no longer in units."""
        precision = normal.precision / np.outer(self.unit, self.unit)
        return Normal(precision, normal.shift / self.unit - precision @ self.here)

    def _at(self, theta: FloatArray) -> HealthyModel:
        """Return the healthy robot with some offsets beside those given."""
        if len(theta) == REGISTRATION:
            return self.model
        imperfections = self.model.imperfections
        given = self.given.model.settling
        settling = offsets_of(theta, replace(given, scatter=self.model.settling.scatter))
        return replace(self.model, imperfections=replace(imperfections, settling=settling))

    def _judge(self, rows: IntArray) -> tuple[SharedWeighing, Weighed]:
        """Return what some runs say, each with its cavity."""
        likelihood = replace(self.given[rows], model=self._at(self.here), remembered=None)
        weighing = SharedWeighing(likelihood, self.hypotheses, self.priors)
        place = np.tile(self.here, (len(rows), 1))
        place[:, REGISTRATION:] = 0.0
        prior = self._local(self._cavity(rows))
        if self.start is None:
            untold = COARSE_TO_FINE[1] * likelihood.model.twin.robot.reach
            coarse = weighing.expand(np.arange(len(rows)), place, untold)
            start = weighing.search(coarse, prior, np.zeros_like(place)).theta
        else:
            start = self.start[rows] - self.here
        at = weighing.expand(np.arange(len(rows)), place)
        return weighing, weighing.search(at, prior, start)

    def _learn(self, found: Sequence[tuple[SharedWeighing, Weighed]], damping: float) -> None:
        """Take in what the runs say: sites, where to expand them, scatter, rates."""
        shares, means, precisions, shifts = [], [], [], []
        for rows, (weighing, weighed) in zip(self._chunks, found, strict=True):
            height = weighed.log_evidence + weighing.log_odds
            share = np.exp(height - log_sum(height, axis=1)[:, None])
            cavity = self._cavity(rows)
            mean, precision = self._mixture(share, weighed, cavity)
            site = _positive(precision - cavity.precision, 0.0)
            whole = (cavity.precision + site) @ mean[..., None]
            shares.append(share)
            means.append(weighed.theta + self.here)
            precisions.append(site)
            shifts.append(whole[..., 0] - cavity.shift)
        self.start = np.concatenate(means)
        old = self.sites
        self.sites = Normal(
            old.precision + damping * (np.concatenate(precisions) - old.precision),
            old.shift + damping * (np.concatenate(shifts) - old.shift),
        )
        self.model = self._maximised(found, shares)
        self.here = self._belief.mean[0] * self.unit

    def _mixture(
        self, share: FloatArray, weighed: Weighed, cavity: Normal
    ) -> tuple[FloatArray, FloatArray]:
        """Return mean and precision of theta given each run, in units: all hypotheses together."""
        units = np.outer(self.unit, self.unit)
        each = (weighed.theta + self.here) / self.unit
        covariance = np.linalg.inv(cavity.precision[:, None] + weighed.information * units)
        mean = np.einsum("rh,rht->rt", share, each)
        away = each - mean[:, None]
        spread = np.einsum("rh,rhtu->rtu", share, covariance)
        spread += np.einsum("rh,rht,rhu->rtu", share, away, away)
        return mean, np.linalg.inv(spread)

    def _maximised(
        self, found: Sequence[tuple[SharedWeighing, Weighed]], shares: Sequence[FloatArray]
    ) -> HealthyModel:
        """Return the healthy robot with the scatter and the rates that explain the runs best."""
        given = self.given.model.imperfections
        if given.settling is None or len(self.unit) == REGISTRATION:
            return self.model
        sums = sum(
            np.einsum("rh,rhkn->kn", share, weighed.scattered)
            for share, (_, weighed) in zip(shares, found, strict=True)
        )
        before = np.asarray(given.settling.scatter)
        scatter = np.sqrt((SCATTER_COUNT * before**2 + sums[0]) / (SCATTER_COUNT + sums[1]))
        settling = replace(given.settling, scatter=tuple(scatter.tolist()))
        lost = tuple(self._rate(entry, found, shares) for entry in given.lost_commands)
        return replace(
            self.given.model, imperfections=replace(given, settling=settling, lost_commands=lost)
        )

    def _rate(
        self,
        entry: LostCommand,
        found: Sequence[tuple[SharedWeighing, Weighed]],
        shares: Sequence[FloatArray],
    ) -> LostCommand:
        """Return how often some motors lose a command, punctual and late; faulty ones left out."""
        names = self.model.motor_names
        lost = np.isin(names, entry.motors)
        hits, trials = np.zeros(2), np.zeros(2)
        for share, (weighing, weighed) in zip(shares, found, strict=True):
            late = weighing.likelihood.late
            patterns = weighed.expansion.response.usual.lost
            for h, hypothesis in enumerate(weighing.hypotheses):
                faulty = np.isin(names, [fault.motor for fault in hypothesis.faults])
                if (lost & faulty).any():
                    continue
                hit = (patterns[:, ~faulty] == lost[~faulty]).all(axis=1)
                weight = share[:, h, None, None] * weighed.outcomes[:, h]
                for k, kind in enumerate((1.0 - late, late)):
                    hits[k] += float((weight[..., hit].sum(axis=-1) * kind).sum())
                    trials[k] += float((weight.sum(axis=-1) * kind).sum())
        before = np.array([entry.rate, entry.rate_when_late])
        rate, when_late = (RATE_COUNT * before + hits) / (RATE_COUNT + trials)
        return replace(entry, rate=float(rate), rate_when_late=float(when_late))


def _positive(matrix: FloatArray, least: float) -> FloatArray:
    """Return symmetric matrices (..., n, n) with no eigenvalue below the least."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + np.swapaxes(matrix, -1, -2)))
    return np.asarray(
        (vectors * np.maximum(values, least)[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    )
