"""The smallest size of a fault that a motion shows."""

from __future__ import annotations

import numpy as np

from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.types import FloatArray
from failuretwin.decision.telling_apart.trials import Trials

FOUND_NATS = 5.0
"""A fault is found if it is expected to be ahead by this: odds of 150."""
SIZES = 5
"""Sizes tried at first, and again between the two that the smallest one lies between."""
BELOW = 0.25
"""Smallest size tried, as a share of the smallest that is considered."""
LEAST = 0.001
"""No smaller share of the largest size is tried: ranges of errors may begin at 0."""


def smallest_sizes(
    trials: Trials, hypothesis: Hypothesis, considered: tuple[float, float]
) -> tuple[float | None, float | None]:
    """Return the smallest sizes at which a fault is told from healthy, and from everything else.

    Args:
        trials: The motions; the first of the judge's hypotheses is healthy.
        hypothesis: One of them, with a size.
        considered: Smallest and largest size that is considered.

    Returns:
        Two sizes; None where the largest is not told either.
    """
    own = trials.judge.hypotheses.index(hypothesis)

    def ahead(sizes: FloatArray) -> FloatArray:
        nats = trials.ahead([(hypothesis, float(size)) for size in sizes])
        nats[:, own] = np.inf
        return np.stack([nats[:, 0], nats.min(axis=1)])

    low, high = considered
    sizes = np.geomspace(max(BELOW * low, LEAST * high), high, SIZES)
    nats = ahead(sizes)
    between = np.unique(np.concatenate([_bracket(sizes, row) for row in nats]))
    if len(between):
        sizes, nats = np.append(sizes, between), np.append(nats, ahead(between), axis=1)
    order = np.argsort(sizes)
    found = [_crossing(sizes[order], row[order]) for row in nats]
    return found[0], found[1]


def _bracket(sizes: FloatArray, nats: FloatArray) -> FloatArray:
    """Return sizes between the largest that is not found and the next, none if there is none."""
    missed = np.flatnonzero(nats < FOUND_NATS)
    if len(missed) == 0 or missed[-1] == len(sizes) - 1:
        return np.empty(0)
    return np.geomspace(sizes[missed[-1]], sizes[missed[-1] + 1], SIZES + 2)[1:-1]


def _crossing(sizes: FloatArray, nats: FloatArray) -> float | None:
    """Return the size from which on a fault is found; None if the largest is not."""
    missed = np.flatnonzero(nats < FOUND_NATS)
    if len(missed) == 0:
        return float(sizes[0])
    last = missed[-1]
    if last == len(sizes) - 1:
        return None
    share = (FOUND_NATS - nats[last]) / (nats[last + 1] - nats[last])
    return float(sizes[last] + share * (sizes[last + 1] - sizes[last]))
