"""Do 90 % intervals hold the truth in 90 % of the runs?"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from failuretwin.decision.metrics.shares import Share


@dataclass(frozen=True)
class IntervalCase:
    """An interval and the truth that it should hold.

    Attributes:
        mode: Fault mode that it is about.
        quantity: What is estimated, such as ``"onset"``.
        low: Lower end, in the unit of the quantity.
        high: Upper end, in the same unit.
        truth: True value, in the same unit.
    """

    mode: str
    quantity: str
    low: float
    high: float
    truth: float


@dataclass(frozen=True)
class Coverage:
    """How often the intervals of one quantity hold the truth; ends count as inside.

    Attributes:
        mode: Fault mode.
        quantity: What is estimated.
        inside: Intervals that hold the truth, of all.
        below: Truths below their interval.
        above: Truths above their interval.
        points: Intervals without width: told or assumed rather than estimated.
    """

    mode: str
    quantity: str
    inside: Share
    below: int
    above: int
    points: int


def coverage_by_mode(cases: Iterable[IntervalCase]) -> list[Coverage]:
    """Return the coverage of each quantity of each fault mode, in order of appearance.

    Give the runs whose fault was diagnosed right: an interval says where the value lies *if* the
    diagnosis holds, and choosing runs by what the data say does not change its coverage.
    """
    groups: dict[tuple[str, str], list[IntervalCase]] = {}
    for case in cases:
        groups.setdefault((case.mode, case.quantity), []).append(case)
    return [_coverage(*key, group) for key, group in groups.items()]


def _coverage(mode: str, quantity: str, cases: list[IntervalCase]) -> Coverage:
    below = sum(case.truth < case.low for case in cases)
    above = sum(case.truth > case.high for case in cases)
    inside = Share(len(cases) - below - above, len(cases))
    points = sum(case.low == case.high for case in cases)
    return Coverage(mode, quantity, inside, below, above, points)
