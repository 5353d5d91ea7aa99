"""False alarms and missed detections: faulty or not, whatever the fault."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from failuretwin.decision.metrics.shares import Share

HEALTHY = "healthy"


@dataclass(frozen=True)
class Alarms:
    """Alarms on healthy runs and silence on faulty ones.

    An alarm is a verdict other than healthy. A run without a verdict raises none, so it is missed
    if it is faulty.

    Attributes:
        false_alarms: Healthy runs that raised an alarm, of all healthy runs.
        missed: Faulty runs that raised none, of all faulty runs.
        healthy_untold: Healthy runs without a verdict.
        faulty_untold: Faulty runs without a verdict, part of `missed`.
    """

    false_alarms: Share
    missed: Share
    healthy_untold: int
    faulty_untold: int


def count_alarms(truth: Sequence[str], diagnosis: Sequence[str | None]) -> Alarms:
    """Count false alarms and missed detections.

    Args:
        truth: True hypothesis of each run.
        diagnosis: Diagnosis of each run; None: no verdict.
    """
    pairs = list(zip(truth, diagnosis, strict=True))
    healthy = [said for true, said in pairs if true == HEALTHY]
    faulty = [said for true, said in pairs if true != HEALTHY]
    false_alarms = sum(said not in (HEALTHY, None) for said in healthy)
    missed = sum(said in (HEALTHY, None) for said in faulty)
    return Alarms(
        false_alarms=Share(false_alarms, len(healthy)),
        missed=Share(missed, len(faulty)),
        healthy_untold=healthy.count(None),
        faulty_untold=faulty.count(None),
    )
