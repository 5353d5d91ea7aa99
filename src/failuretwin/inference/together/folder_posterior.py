"""What the runs of a folder say together: of each run's hypothesis, and of what they share.

Every run is judged with what all others say (`RunsTogether`), some times over.

Section: docs/inference.md#folders
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.progress import Progress, unseen
from failuretwin.core.types import FloatArray
from failuretwin.inference.engine.registration import (
    displaced_components,
    looked_further,
    registered_together,
    sensor_in_doubt,
)
from failuretwin.inference.engine.theta import (
    AS_TOLD,
    layout_of,
    offsets_doubted,
    robot_components,
)
from failuretwin.inference.engine.weighing import odd_zeros_of
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.movements.run_likelihood import RunLikelihood
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.observation.registered import REGISTRATION
from failuretwin.inference.posterior import Posterior
from failuretwin.inference.together.belief import Belief, Normal
from failuretwin.inference.together.judged_runs import Judged
from failuretwin.inference.together.runs_together import RunsTogether

PASSES, MOST_PASSES, MOVED = 6, 12, 0.2
"""Times that every run is judged, and at most: until a pass moves theta by no more than this share
of its deviation."""
SAMPLED_RUNS = 32
"""Runs that tell whether the sensor may be displaced."""
AS_HEALTHY, COARSE = 2, 0.004
"""First passes, in which every run counts as healthy, and noise of the sensor in the very first, as
a share of the reach: what all runs share must not look like a fault of each. Scatter and losses are
learned after them."""
OPEN = AS_HEALTHY + 2
"""Pass from which hypotheses that are out of the question for a run are left out of the next."""
DAMPING = 0.7
"""Share of a new site that is taken, from the second pass on."""


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
    def moved(self) -> bool:
        """Whether the sensor may stand elsewhere than the profile says."""
        frame = slice(0, REGISTRATION)
        return bool((self.prior_deviation[frame] > 1.5 * self.usual_deviation[frame]).any())

    @property
    def deviation(self) -> FloatArray:
        """Standard deviation of theta, (theta,)."""
        return np.sqrt(np.diag(self.covariance))


def folder_posterior(
    likelihood: RunLikelihood,
    hypotheses: Sequence[Hypothesis],
    priors: Priors,
    advance: Progress = unseen,
) -> FolderPosterior:
    """Weigh every hypothesis by each run, with what all runs say of what they share.

    Args:
        likelihood: The runs; the doubt of their model is the prior of theta.
        hypotheses: What may be the case.
        priors: Beliefs about faults and set-ups.
        advance: Called with the number of further passes, of `PASSES`; more are not told.
    """
    together, usual = begun(likelihood, hypotheses, priors)
    rows, moved, likely = np.arange(together.runs), np.inf, None
    healthy = np.tile([h.is_healthy for h in hypotheses], (together.runs, 1))
    for done in range(MOST_PASSES):
        last = done == MOST_PASSES - 1 or (done >= PASSES - 1 and moved <= MOVED)
        as_healthy = done < AS_HEALTHY and bool(healthy.any()) and not last
        asked = None if last else healthy if as_healthy else likely
        noise = COARSE * likelihood.model.twin.robot.reach if done == 0 else 0.0
        found = together.judge(rows, asked=asked, noise_m=noise)
        if last:
            posteriors = [_posterior(each, together.here, usual) for each in found]
            advance(int(done < PASSES))
            break
        before = together.here
        damping = 1.0 if done == 0 else DAMPING
        probable = together.learn(found, damping, float(done > AS_HEALTHY))
        likely = probable if done >= OPEN else None
        advance(int(done < PASSES))
        (_,), (covariance,) = together.belief.moments
        spread = together.unit * np.sqrt(np.diag(covariance))
        moved = float(np.abs((together.here - before) / spread).max())
    (mean,), (covariance,) = together.belief.moments
    unit, sites = together.unit, together.sites
    taught = 0.5 * np.linalg.slogdet(np.eye(len(unit)) + sites.precision @ covariance)[1]
    mean, covariance = mean * unit, covariance * np.outer(unit, unit)
    place = mean.copy()
    place[REGISTRATION:] = 0.0
    at = together.at(mean)
    return FolderPosterior(at, place, mean, covariance, unit, usual, sites, taught, posteriors)


def begun(
    likelihood: RunLikelihood, hypotheses: Sequence[Hypothesis], priors: Priors
) -> tuple[RunsTogether, FloatArray]:
    """Return runs of which nothing was judged yet, and what others of their kind differ by.

    What arms of the kind are like is the prior of theta. The frame of the sensor is known; if the
    runs say that it may not be, it is known or anywhere near, by the odds of the set-up.
    """
    model = likelihood.model
    layout = layout_of(model.without_doubt, bool(likelihood.evidence.on_the_way.any()))
    believed = robot_components(model, layout, AS_TOLD)
    usual = unit = believed.usual_deviation
    in_doubt = doubted(likelihood, hypotheses, priors)
    if in_doubt:
        unit = displaced_components(model, priors.setup, layout, believed).widest
    base = Belief.of(believed, unit)
    if in_doubt:
        anywhere_near = (np.arange(layout.size) < REGISTRATION).astype(np.float64)
        base = base.or_moved(anywhere_near, priors.setup.odds)
    together = RunsTogether.of(likelihood, hypotheses, priors, layout, base, unit)
    if in_doubt:
        together.here[:REGISTRATION] = registered_together(likelihood, hypotheses, priors)
    return together, usual


def doubted(likelihood: RunLikelihood, hypotheses: Sequence[Hypothesis], priors: Priors) -> bool:
    """Return whether some of the runs, evenly spread, say that the sensor may be displaced."""
    runs = len(likelihood.usable)
    some = np.unique(np.linspace(0, runs - 1, SAMPLED_RUNS).astype(np.int64))
    return sensor_in_doubt(likelihood[some], hypotheses, priors)


def _posterior(judged: Judged, here: FloatArray, usual: FloatArray) -> Posterior:
    """Return the posterior of runs, with zeros that are odd by those of their kind."""
    found = looked_further(judged.weighing)
    if not offsets_doubted(judged.weighing.likelihood.model):
        return replace(found, offsets=())
    return replace(found, offsets=odd_zeros_of(judged.weighing, usual, here))
