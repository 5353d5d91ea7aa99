"""Whether the runs of a folder are of two robots rather than of one.

Each run's site is a normal factor of theta. Runs of one robot share a theta, runs of two have one
each; with N(0, I) as the prior of either,

    log Z(S) = 1/2 eta^T (I + Lambda)^-1 eta - 1/2 log |I + Lambda|,    Lambda, eta: sums over S
    gain = log Z(A) + log Z(B) - log Z(A and B)

less what it takes to say which runs are whose: log n where one robot follows the other, n log 2
where they come in any order.

Section: docs/inference.md#folders
"""

from __future__ import annotations

import numpy as np

from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.inference.together.belief import Normal

ODDS_NATS = 7.0
"""Log odds of one robot against two before any run is seen, and how sure it must be; assumed."""
DIRECTIONS, ROUNDS = 6, 20
"""Directions of theta along which runs are parted to begin with, and times they are parted anew."""
FEWEST = 2
"""Runs that one robot has at least, and one more in all that is told of it."""


def of_second_robot(sites: Normal) -> BoolArray | None:
    """Return which runs seem to be of a second robot, (run,); None: all are of one.

    Args:
        sites: What each run says of theta, in units of the prior.
    """
    count = len(sites.shift)
    if count < 2 * FEWEST:
        return None
    blocks = [np.arange(count) >= k for k in range(FEWEST, count - FEWEST + 1)]
    cases = [(block, np.log(count)) for block in blocks]
    cases += [(part, count * np.log(2.0)) for part in _parted(sites)]
    gains = [_gain(sites, part) - cost for part, cost in cases]
    best = int(np.argmax(gains))
    part, cost = cases[best]
    sure = gains[best] > ODDS_NATS and _least_gain(sites, part) - cost > ODDS_NATS
    return part if sure else None


def _sums(sites: Normal, part: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return Lambda (theta, theta) and eta (theta,) of some runs together."""
    return sites.precision[part].sum(axis=0), sites.shift[part].sum(axis=0)


def _log_evidence(precision: FloatArray, shift: FloatArray) -> FloatArray:
    """Return log Z of sums of sites, (...) of (..., theta, theta) and (..., theta)."""
    whole = np.eye(shift.shape[-1]) + precision
    mean = np.linalg.solve(whole, shift[..., None])[..., 0]
    return np.asarray(0.5 * np.sum(shift * mean, axis=-1) - 0.5 * np.linalg.slogdet(whole)[1])


def _gain(sites: Normal, part: BoolArray) -> float:
    """Return the gain of two robots over one; none where one has too few runs."""
    if min(part.sum(), (~part).sum()) < FEWEST:
        return -np.inf
    first, second, both = (
        float(_log_evidence(*_sums(sites, some))) for some in (part, ~part, part | True)
    )
    return first + second - both


def _least_gain(sites: Normal, part: BoolArray) -> float:
    """Return the gain without the run that makes most of it: one odd run is no robot."""
    rows = [np.delete(np.arange(len(part)), run) for run in range(len(part))]
    some = [(Normal(sites.precision[kept], sites.shift[kept]), part[kept]) for kept in rows]
    return min(_gain(*case) for case in some)


def _parted(sites: Normal) -> list[BoolArray]:
    """Return ways to part the runs that no change of one run improves, whatever their order."""
    precision, shift = _sums(sites, np.ones(len(sites.shift), dtype=bool))
    mean = np.linalg.solve(np.eye(len(shift)) + precision, shift)
    _, axes = np.linalg.eigh(precision)
    off = (sites.shift - sites.precision @ mean) @ axes[:, : -DIRECTIONS - 1 : -1]
    return [_settled(sites, along > np.median(along)) for along in off.T]


def _settled(sites: Normal, part: BoolArray) -> BoolArray:
    """Return the runs parted anew, each to the robot that foretells it better, until all stay."""
    for _ in range(ROUNDS):
        first, second = (_foretold(sites, own) for own in (~part, part))
        if ((second > first) == part).all():
            break
        part = second > first
    return part


def _foretold(sites: Normal, part: BoolArray) -> FloatArray:
    """Return log p(run | the other runs of a robot), (run,)."""
    precision, shift = _sums(sites, part)
    others = (
        precision - np.where(part[:, None, None], sites.precision, 0.0),
        shift - np.where(part[:, None], sites.shift, 0.0),
    )
    whole = _log_evidence(others[0] + sites.precision, others[1] + sites.shift)
    return whole - _log_evidence(*others)


def two_robots(part: BoolArray, names: list[str]) -> str:
    """Return the finding as a sentence.

    Args:
        part: Runs of the second robot, (run,).
        names: Of all runs.
    """
    few = part if part.sum() <= len(part) / 2 else ~part
    some = [names[i] for i in np.flatnonzero(few)]
    shown = ", ".join(some[:4]) + (f" and {len(some) - 4} more" if len(some) > 4 else "")
    return (
        f"the runs seem to be of two robots, or of one that was changed: {shown} differ from the "
        "others in what every run of theirs shares. Diagnose them apart"
    )
