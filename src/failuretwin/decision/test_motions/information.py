"""How much movements are expected to tell of what is the case.

    D_ij = min(cap, d^2 / 8 + log(|S| / sqrt(|S_i| |S_j|)) / 2),    S = (S_i + S_j) / 2
    I = sum_i p_i log [sum over j of i's hypothesis p(j | h) exp(-D_ij) / sum_j p_j exp(-D_ij)]

D_ij is the distance of Bhattacharyya of where the tool comes to rest if member i, or j, is true;
with heavy tails d^2 counts as (nu + c) log(1 + d^2/(nu + c + 2)). Movements add up, so a whole set
has a closed form: the estimate of Kolchinsky and Tracey (2017) by pairwise distances.

Section: docs/check.md#choice-of-movements
"""

from __future__ import annotations

import numpy as np

from failuretwin.core.numerics import log_sum
from failuretwin.core.types import FloatArray, IntArray


def pairwise_distance(mean: FloatArray, spread: FloatArray, dof: float, cap: float) -> FloatArray:
    """Return how far members are apart in what is seen after a movement, (..., member, member).

    In nats: minus the log of the overlap of two densities; 0 on the diagonal.

    Args:
        mean: Where the tool is expected, (..., member, channel) [m].
        spread: Covariance of that, (..., member, channel, channel) [m2].
        dof: Degrees of freedom of the scatter.
        cap: What one movement counts at most [nats].
    """
    one, other = np.triu_indices(mean.shape[-2], 1)
    between = 0.5 * (spread[..., one, :, :] + spread[..., other, :, :])
    log_det = np.linalg.slogdet(spread)[1]
    apart = mean[..., one, :] - mean[..., other, :]
    d2 = np.einsum("...a,...a->...", apart, np.linalg.solve(between, apart[..., None])[..., 0])
    if np.isfinite(dof):
        channels = mean.shape[-1]
        d2 = (dof + channels) * np.log1p(d2 / (dof + channels + 2.0))
    wider = np.linalg.slogdet(between)[1] - 0.5 * (log_det[..., one] + log_det[..., other])
    found = np.zeros((*mean.shape[:-1], mean.shape[-2]))
    found[..., one, other] = np.minimum(0.125 * d2 + 0.5 * wider, cap)
    return found + np.swapaxes(found, -1, -2)


def expected_information(nats: FloatArray, log_share: FloatArray, kind: IntArray) -> FloatArray:
    """Return how much is expected to be learned about the hypothesis, (...) [nats].

    Args:
        nats: D of all movements together, (..., member, member) [nats].
        log_share: Log probability of each member, (member,).
        kind: Index of its hypothesis, (member,).
    """
    terms = log_share - nats
    same = kind[:, None] == kind
    of_own = np.array([log_sum(log_share[kind == k], axis=0) for k in kind])
    own = log_sum(np.where(same, terms, -np.inf), axis=-1) - of_own
    return np.asarray(np.sum(np.exp(log_share) * (own - log_sum(terms, axis=-1)), axis=-1))
