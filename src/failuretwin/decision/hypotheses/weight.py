"""What runs say of a hypothesis: evidence, posterior of what is unknown, estimates."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from failuretwin.core.quadrature import Weighted, log_sum
from failuretwin.core.types import FloatArray


@dataclass(frozen=True)
class Estimate:
    """What one run says of a fault that is taken to be there.

    Attributes:
        onset: Distribution of the onset [s]; None without a fault.
        size: Distribution of the magnitude; None where it has none.
        became: Probability of each alternative, (movement, alternative).
    """

    onset: Weighted | None
    size: Weighted | None
    became: FloatArray


@dataclass(frozen=True)
class Weight:
    """What some runs say of one hypothesis.

    Attributes:
        log_evidence: Log marginal likelihood of each run, (run,).
        by_movement: Log density of each movement of a run given all others, (movement,), by the
            run's index; asked for few hypotheses alone.
        settled: The same of its settled position alone.
        estimate: Onset and size in a run, by its index; asked for the best hypothesis alone.
    """

    log_evidence: FloatArray
    by_movement: Callable[[int], FloatArray]
    settled: Callable[[int], FloatArray]
    estimate: Callable[[int], Estimate]


@dataclass(frozen=True)
class Posterior:
    """Log evidence of each run, and of first movement and cell given it.

    Attributes:
        log_evidence: (run,).
        log_share: Log posterior, (run, movement first spoilt, cell).
    """

    log_evidence: FloatArray
    log_share: FloatArray


def posterior_of(
    log_healthy: FloatArray,
    density: FloatArray,
    log_prior: FloatArray,
    on_way: tuple[FloatArray, FloatArray],
) -> Posterior:
    """Sum over the first movement that a fault spoils and over its cells.

    Args:
        log_healthy: Log density of each settled position if all is well, (run, movement).
        density: The same with the fault, (run, movement, cell).
        log_prior: Log probability of first movement and cell, (run, movement, cell).
        on_way: Log density of the readings on the way if all is well, (run, movement), and with
            the fault, (run, movement, cell) or the same for all cells, (run, movement, 1).
    """
    healthy, faulty = log_healthy + on_way[0], density + on_way[1]
    before = np.cumsum(healthy, axis=1) - healthy
    after = np.cumsum(faulty[:, ::-1], axis=1)[:, ::-1]
    joint = before[:, :, None] + after + log_prior
    log_evidence = log_sum(joint, axis=(1, 2))
    log_share = joint - log_evidence[:, None, None]
    return Posterior(log_evidence, log_share)


def given_others(healthy: FloatArray, faulty: FloatArray, log_share: FloatArray) -> FloatArray:
    """Return the log density of each movement of a run given all others, (movement,).

    It is one over the posterior mean of one over its density.

    Args:
        healthy: Log density of each movement if all is well, (movement,).
        faulty: The same with the fault, (movement, cell).
        log_share: Log posterior of first movement spoilt and cell, (movement, cell).
    """
    affected = np.logaddexp.accumulate(log_share, axis=0)
    not_yet = np.full_like(healthy, -np.inf)
    later = log_sum(log_share, axis=1)[::-1]
    not_yet[:-1] = np.logaddexp.accumulate(later)[::-1][1:]
    return -np.logaddexp(log_sum(affected - faulty, axis=1), not_yet - healthy)
