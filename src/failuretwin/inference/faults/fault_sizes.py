"""How large a fault may be: nodes over its size, each with the prior mass nearest to it.

Sizes are uniform within each of some ranges. Nodes lie evenly, small ones in a constant ratio where
the ranges are wide, and crowd where movements point, as narrowly as those say.

    mass of a node = F(half way to the next) - F(half way from the one before)

with F the prior's distribution function: exact for the prior, and the trapezoidal rule for what is
integrated.

Section: docs/inference.md#hypotheses
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from failuretwin.core.numerics import log_of
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.failure_behavior.mode import Range

LOCAL_STEPS = np.array([-8, -5, -3.5, -2.5, -1.75, -1, -0.5, 0, 0.5, 1, 1.75, 2.5, 3.5, 5, 8.0])
"""Nodes around the value that a movement points to, in its own standard deviations."""
COARSE_NODES = 41
"""Nodes spread evenly over the range of sizes, on each side of zero."""
ERROR_NODES = 36
"""The same where every movement has a size of its own."""
DENSE = 0.6
"""Standard deviation of a likelihood, in steps between nodes, from which the trapezoidal rule is
off by less than 0.2 % (2 exp(-2 pi^2 0.6^2) of a normal one)."""
COARSE_RATIO = 1.12
"""Ratio of one size to the one below it, where even nodes would lie further apart."""
WIDE = 1.5
"""Step of the even nodes, in the least size, from which small sizes have nodes of their own."""
SMALLEST = 1e-3
"""Sizes below so much of the largest are one: ranges may begin at nothing."""


@dataclass(frozen=True)
class SizePrior:
    """What is believed of a fault's size: uniform within each of some ranges.

    Attributes:
        ranges: Lowest and highest size of each.
        shares: How probable each range is; they sum to 1.
        visible: Whether the ranges begin at what can be seen rather than where somebody said.
    """

    ranges: tuple[Range, ...]
    shares: tuple[float, ...]
    visible: bool = False

    @classmethod
    def even(cls, ranges: Sequence[Range]) -> SizePrior:
        """Return the prior of ranges that are equally likely."""
        return cls(tuple(ranges), (1.0 / len(ranges),) * len(ranges))

    def above(self, least: float) -> SizePrior:
        """Return the ranges that begin at a size or more, at least the last one."""
        kept = [i for i, (low, _) in enumerate(self.ranges) if low >= least] or [-1]
        total = sum(self.shares[i] for i in kept)
        ranges = tuple(self.ranges[i] for i in kept)
        return replace(self, ranges=ranges, shares=tuple(self.shares[i] / total for i in kept))

    @property
    def log_share(self) -> FloatArray:
        """Log probability of each range, (range,)."""
        return log_of(np.array(self.shares))

    @property
    def ends(self) -> Range:
        """Smallest and largest size."""
        return min(low for low, _ in self.ranges), max(high for _, high in self.ranges)


def nodes_around(
    best: FloatArray, width: FloatArray, usable: BoolArray, otherwise: float | FloatArray
) -> FloatArray:
    """Return nodes around the value that each movement points to, (run, node).

    Args:
        best: That value, (run, movement).
        width: Its standard deviation, (run, movement).
        usable: Movements that point anywhere, (run, movement).
        otherwise: What the others give, () or (run, 1).
    """
    nodes = best[..., None] + width[..., None] * LOCAL_STEPS
    others = np.asarray(otherwise)[..., None]
    return np.where(usable[..., None], nodes, others).reshape(len(best), -1)


def size_nodes(
    best: FloatArray,
    width: FloatArray,
    usable: BoolArray,
    ranges: Sequence[Range],
    signed: bool,
    coarse: int = COARSE_NODES,
) -> tuple[FloatArray, FloatArray]:
    """Return sizes of a fault, sorted, (run, node), and their log mass (run, range, node).

    Args:
        best: Size that each movement points to, (run, movement).
        width: Its standard deviation, (run, movement).
        usable: Movements that point anywhere, (run, movement).
        ranges: Lowest and highest size of each range, all between as likely.
        signed: Whether they come with a minus too.
        coarse: Nodes where no movement points.
    """
    low, high = min(low for low, _ in ranges), max(high for _, high in ranges)
    grid = coarse_sizes(low, high, coarse)
    if signed:
        grid = np.concatenate([-grid, grid])
    local = nodes_around(best, width, usable, low)
    nodes = np.concatenate([local, np.broadcast_to(grid, (len(best), len(grid)))], axis=1)
    side = np.where(signed & (nodes < 0.0), -1.0, 1.0)
    nodes = np.sort(side * np.clip(side * nodes, low, high), axis=1)
    return nodes, log_of(prior_mass(nodes, ranges) / (2.0 if signed else 1.0))


def coarse_sizes(low: float, high: float, count: int = COARSE_NODES) -> FloatArray:
    """Return sizes from `low` to `high`, (node,): evenly, and in a ratio where that is denser.

    Args:
        low: The least.
        high: The largest.
        count: Of even ones.
    """
    even = np.linspace(low, high, count)
    step, least = even[1] - even[0], max(low, SMALLEST * high)
    if step < WIDE * least:
        return even
    until = min(high, step / (COARSE_RATIO - 1.0))  # from there on even nodes are the denser ones
    small = np.geomspace(least, until, int(np.ceil(np.log(until / least) / np.log(COARSE_RATIO))))
    return np.concatenate([[low] if low < least else [], small, even[even > until]])


def redrawn_nodes(
    best: FloatArray, width: FloatArray, usable: BoolArray, ranges: Sequence[Range], least: float
) -> tuple[FloatArray, FloatArray]:
    """Return sizes of both signs for each movement, and their log mass in each range.

    They crowd where a movement points, unless even ones lie densely enough for all of them.

    Args:
        best: Size that each movement points to, (run, movement).
        width: Its standard deviation, (run, movement).
        usable: Movements that point anywhere, (run, movement).
        ranges: Lowest and highest size of each range, all between as likely.
        least: What no `width` is below.

    Returns:
        (run, movement, node) and (run, movement, range, node).
    """
    low, high = min(low for low, _ in ranges), max(high for _, high in ranges)
    dense = least > DENSE * np.diff(coarse_sizes(low, high, ERROR_NODES)).max()
    some = np.s_[:1, :0] if dense else np.s_[:]
    nodes, log_mass = size_nodes(
        best.reshape(-1, 1)[some],
        width.reshape(-1, 1)[some],
        usable.reshape(-1, 1)[some],
        ranges,
        signed=True,
        coarse=ERROR_NODES,
    )
    shape, count = best.shape, nodes.shape[-1]
    if dense:
        every = (*shape, len(ranges), count)
        return np.broadcast_to(nodes[0], (*shape, count)), np.broadcast_to(log_mass[0], every)
    return nodes.reshape(*shape, count), log_mass.reshape(*shape, len(ranges), count)


def prior_mass(nodes: FloatArray, ranges: Sequence[Range]) -> FloatArray:
    """Return the mass of each range that is nearest to each node, (run, range, node).

    Args:
        nodes: Sizes, sorted, (run, node); both signs count as much.
        ranges: Lowest and highest size of each range.
    """
    middle = 0.5 * (nodes[:, 1:] + nodes[:, :-1])
    edges = np.concatenate([nodes[:, :1], middle, nodes[:, -1:]], axis=1)[:, None]
    low, high = (np.array(ends)[:, None] for ends in zip(*ranges, strict=True))
    below = np.clip((np.abs(edges) - low) / (high - low), 0.0, 1.0)
    return np.diff(np.copysign(below, edges), axis=2)
