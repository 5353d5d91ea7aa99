"""What runs say of a hypothesis, as a function of the shared unknowns near their best values.

    log p(run | h, theta + d) ~ L + b^T d - 1/2 d^T A d

By Fisher's identity the score b is the mean of the complete score over all that is unknown; by
Louis's identity the information A is the complete information less what the unknown angle of the
faulty motor takes away. With weights w of outcomes and states, u = (nu + d)/(nu + D^2),

    b = sum w u Gamma^T rho,    A = sum w (nu + d)/(nu + d + 2) Gamma^T Gamma - missing

A motor with an active fault says nothing of its own offsets.

Section: docs/inference.md#shared-unknowns
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.types import ArrayStruct, Axes, BoolArray, FloatArray, IntArray
from failuretwin.failure_behavior.mode import Signature
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.faults.priors import Priors
from failuretwin.inference.theta.explained_movements import (
    ExplainedMovements,
    explained,
    mean_pull,
    pull_of,
)
from failuretwin.inference.theta.linear_response import LinearResponse

ByRun = Annotated[FloatArray, Axes("run")]
ByTheta = Annotated[FloatArray, Axes("run", "theta")]


@dataclass(frozen=True)
class LocalLikelihood(ArrayStruct):
    """The log likelihood of some runs near one theta of each.

    Attributes:
        theta: Where it is expanded, (run, theta).
        log_likelihood: L, (run,).
        score: b, (run, theta).
        information: A, (run, theta, theta).
        misfit: Mean D^2 of what is explained, (run,); 3 if all is well.
    """

    theta: ByTheta
    log_likelihood: ByRun
    score: ByTheta
    information: Annotated[FloatArray, Axes("run", "theta", "theta")]
    misfit: ByRun


OUTLYING = 100.0
"""Squared distance that stands for "nowhere near" when the fit of a run is judged."""


def has_score(hypothesis: Hypothesis) -> bool:
    """Return whether settled positions have a score under it: healthy, or one motor settles off.

    For the rest, which settle as healthy ones or hold two faults or any, the best theta of these
    has to do.
    """
    if not hypothesis.known or len(hypothesis.faults) > 1:
        return False
    signatures = [MODES[fault.mode].signature for fault in hypothesis.faults]
    return not set(signatures) & {Signature.TRANSIENT, Signature.MISSED}


def local_likelihood(
    response: LinearResponse, hypothesis: Hypothesis, priors: Priors, theta: FloatArray
) -> LocalLikelihood:
    """Return what settled positions say of a hypothesis near theta.

    Args:
        response: The runs.
        hypothesis: What may be the case; one that `has_score`.
        priors: Beliefs about onset and size.
        theta: Beside the theta of the response, (run, theta).
    """
    runs = explained(response, hypothesis, priors, theta)
    nu, size = response.model.settling.tail_dof, theta.shape[1]
    score, information = np.zeros_like(theta), np.zeros((len(theta), size, size))
    square, sound = np.zeros(len(theta)), np.zeros(len(theta))
    for some in runs.movements:
        told = _theta_sums(some, nu)
        score, information = score + told[0], information + told[1]
        square = square + some.counted.total(some.square * some.share)
        sound = sound + some.weight.sum(axis=(1, 2))
    count = np.maximum(runs.usable.sum(axis=1), 1)
    misfit = (square + OUTLYING * (count - sound)) / count
    return LocalLikelihood(theta, runs.log_likelihood, score, information, misfit)


def _theta_sums(some: ExplainedMovements, nu: float) -> tuple[FloatArray, FloatArray]:
    """Return score (run, theta) and information (run, theta, theta) of some movements."""
    counted, seen = some.counted, some.seen
    pull = pull_of(some.square, nu, seen.dims) * some.share
    root = np.sqrt(mean_pull(nu, seen.dims) * some.share)
    score = np.matmul((pull[:, None] * some.off)[:, None], seen.gamma)[:, 0]
    scaled = seen.gamma * root[:, None, None]
    information = np.matmul(np.swapaxes(scaled, -1, -2), scaled)
    if some.own is not None:
        told = some.own.told * root[:, None]
        score = score - pull[:, None] * some.own.pull
        information = information + told[:, :, None] * told[:, None]
    return counted.total(score), counted.total(information)


# A normal distribution of theta times a local likelihood: its integral and what is left of it.


@dataclass(frozen=True)
class Normal:
    """Normal distributions of theta, one a run, by precision and precision times mean.

    Attributes:
        precision: (run, theta, theta).
        shift: Precision times mean, (run, theta).
    """

    precision: FloatArray
    shift: FloatArray

    def __getitem__(self, rows: IntArray) -> Normal:
        """Return those of some of the runs."""
        return Normal(self.precision[rows], self.shift[rows])

    @property
    def mean(self) -> FloatArray:
        """(run, theta)."""
        return np.asarray(np.linalg.solve(self.precision, self.shift[..., None])[..., 0])

    def times(self, says: LocalLikelihood) -> Normal:
        """Return the distribution given what runs say, to second order."""
        turn = np.einsum("rtu,ru->rt", says.information, says.theta)
        return Normal(self.precision + says.information, self.shift + says.score + turn)

    def log_density(self, theta: FloatArray) -> FloatArray:
        """Return the log density, but for the constant of pi, (run,)."""
        away = theta - self.mean
        square = np.einsum("rt,rtu,ru->r", away, self.precision, away)
        return 0.5 * (np.linalg.slogdet(self.precision)[1] - square)


# Searching for the most probable theta of each hypothesis.

FOUND_NATS = 0.1
"""What a step promises or brings, below which it is not made: the promise itself is counted."""
STEPS, MOST_STEPS = 2, 8
"""Newton steps, and those at most of what is far off, such as a zero that nobody has measured."""
RISING_NATS = 2.0
"""What promises more is far off: where all is an outlier, a promise says little of what comes."""
HOPELESS_NATS = 20.0
"""Hypotheses that are not far off and would be so much less probable than another are left."""
SHORTEST = 0.2
"""A step that does not rise is halved, until it is shorter than this share of it."""


@dataclass(frozen=True)
class Fit(ArrayStruct):
    """What some runs say of one hypothesis with theta normal, by Laplace's method.

    Attributes:
        says: The likelihood where it was evaluated last.
        top: Where prior times likelihood is highest, to second order, (run, theta).
        promised: By how much it is higher there, (run,) [nats].
        height: Log of prior times likelihood where it was evaluated, (run,).
        width: 1/2 log |P^-1 + A|, (run,).
    """

    says: LocalLikelihood
    top: ByTheta
    promised: ByRun
    height: Annotated[FloatArray, Axes("run", empty=-np.inf)]
    width: ByRun

    @classmethod
    def of(cls, prior: Normal, says: LocalLikelihood) -> Fit:
        """Return what a likelihood says with theta normal."""
        height = says.log_likelihood + prior.log_density(says.theta)
        pulled = prior.shift - np.einsum("rtu,ru->rt", prior.precision, says.theta)
        slope, precision = says.score + pulled, prior.precision + says.information
        step = np.linalg.solve(precision, slope[..., None])[..., 0]
        promised = 0.5 * np.einsum("rt,rt->r", slope, step)
        curved = 0.5 * np.linalg.slogdet(precision)[1]
        return cls(says, says.theta + step, promised, height, curved)

    @property
    def found(self) -> BoolArray:
        """Whether the top is so near that it is known to second order, (run,)."""
        return np.asarray(self.promised < FOUND_NATS)

    @property
    def theta(self) -> FloatArray:
        """The best theta that is known, (run, theta)."""
        return np.where(self.found[:, None], self.top, self.says.theta)

    @property
    def log_evidence(self) -> FloatArray:
        """Log of the integral of prior times likelihood over theta there, (run,).

        L + log N(theta; prior) - 1/2 log |P^-1 + A| + 1/2 log |P^-1|
        """
        return self.height + np.where(self.found, self.promised, 0.0) - self.width


def search(
    response: LinearResponse,
    hypotheses: Sequence[Hypothesis],
    log_odds: FloatArray,
    priors: Priors,
    prior: Normal,
    start: FloatArray,
    asked: BoolArray | None = None,
) -> list[Fit]:
    """Return what runs say of hypotheses near the most probable theta of each: Newton's steps.

    A step that does not rise is halved. A hypothesis is followed on while that may matter.

    Args:
        response: The runs.
        hypotheses: What may be the case; all of them have a score.
        log_odds: Log prior of each, (hypothesis,).
        priors: Beliefs about onset and size.
        prior: Of theta, beside that of the response.
        start: Where to start, (run, hypothesis, theta).
        asked: Hypotheses of each run that are weighed, (run, hypothesis); the others have no
            evidence; None: all.
    """
    which = np.ones(start.shape[:2], dtype=bool) if asked is None else asked
    fits = [
        _begun(response, h, priors, prior, start[:, i], np.flatnonzero(which[:, i]))
        for i, h in enumerate(hypotheses)
    ]
    share, gained = np.ones(start.shape[:2]), np.full(start.shape[:2], np.inf)
    for step in range(MOST_STEPS):
        enough = FOUND_NATS if step < STEPS else RISING_NATS
        followed = _worth_following(fits, log_odds, gained, enough) & (share > SHORTEST)
        if not followed.any():
            break
        for i in map(int, np.flatnonzero(followed.any(axis=0))):
            rows = np.flatnonzero(followed[:, i])
            old = fits[i][rows]
            theta = old.says.theta + share[rows, i, None] * (old.top - old.says.theta)
            new = _fit(response, hypotheses[i], priors, prior, theta, rows)
            gain = new.height - old.height
            rose = gain > 0.0
            fits[i].put(rows[rose], new[rose])
            share[rows, i] = np.where(rose, 1.0, 0.5 * share[rows, i])
            gained[rows, i] = np.where(rose, gain, gained[rows, i])
    return fits


def _fit(
    response: LinearResponse,
    hypothesis: Hypothesis,
    priors: Priors,
    prior: Normal,
    theta: FloatArray,
    rows: IntArray,
) -> Fit:
    """Return what some of the runs say of a hypothesis near theta of each, (some, theta)."""
    some = response if len(rows) == len(prior.shift) else response[rows]
    return Fit.of(prior[rows], local_likelihood(some, hypothesis, priors, theta))


def _begun(
    response: LinearResponse,
    hypothesis: Hypothesis,
    priors: Priors,
    prior: Normal,
    start: FloatArray,
    rows: IntArray,
) -> Fit:
    """Return what some of the runs say where the search begins; the others say nothing."""
    some = rows if len(rows) else np.zeros(1, dtype=np.int64)
    fit = _fit(response, hypothesis, priors, prior, start[some], some)
    if len(rows) == len(start):
        return fit
    whole = fit.blank(len(start))
    whole.put(rows, fit[: len(rows)])
    return whole


def _worth_following(
    fits: Sequence[Fit], log_odds: FloatArray, gained: FloatArray, enough: float
) -> BoolArray:
    """Return which hypotheses still matter, (run, hypothesis): those that rise by enough.

    Args:
        fits: What is known of each.
        log_odds: Log prior of each, (hypothesis,).
        gained: By how much each rose last, (run, hypothesis) [nats].
        enough: What a step promises or brings at least [nats].
    """
    promised = np.stack([fit.promised for fit in fits], axis=1)
    reach = np.stack([fit.height - fit.width for fit in fits], axis=1) + promised + log_odds
    hopeless = reach < reach.max(axis=1, keepdims=True) - HOPELESS_NATS
    rising = np.minimum(promised, gained) > FOUND_NATS
    rising &= np.maximum(promised, np.where(np.isinf(gained), 0.0, gained)) > enough
    return np.asarray(rising & ~(hopeless & (promised < RISING_NATS)))
