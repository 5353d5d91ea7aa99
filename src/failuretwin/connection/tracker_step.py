"""What the tracker keeps of a run and what became of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from failuretwin.connection.run_evidence import RunEvidence
from failuretwin.connection.wear import WearState

Fate = Literal["learned", "frozen", "discarded"]
"""What became of a run: learned; not learned because a fault was suspected when its turn came; not
learned because it, or a run that it waited for, is faulty."""


@dataclass(frozen=True)
class Waiting:
    """A run of the latest.

    Attributes:
        number: How many runs had come with it, from 1.
        evidence: What it says.
        open: Whether it may still be learned.
    """

    number: int
    evidence: RunEvidence
    open: bool


@dataclass(frozen=True)
class Step:
    """What one run changed.

    Attributes:
        number: How many runs have come with it.
        evidence: What it says.
        suspicion: Probability that it is faulty; NaN where nothing can be told.
        level: Sum of what runs say for a fault [nats].
        alarm: What is suspected, or empty.
        fates: What became of earlier runs or of this one, by number.
        learned_at: Number of the last run learned.
        state: Tracked state.
    """

    number: int
    evidence: RunEvidence
    suspicion: float
    level: float
    alarm: str
    fates: tuple[tuple[int, Fate], ...]
    learned_at: int
    state: WearState
