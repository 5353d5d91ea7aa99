"""How a task is carried out, and what became of each of its targets."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from failuretwin.decision.acting.task import Target


@dataclass(frozen=True)
class ActingSettings:
    """How a task is carried out.

    Attributes:
        most_movements: After so many a target is given up.
        feedback: Whether what the tool misses is corrected; else each target has one movement.
        most_repeats: So often a command that seems lost is sent again for one target.
        probe_every: A motor that is held is told to move once in so many targets, so that a
            repair is noticed.
        questions: So many movements of the task at most are made only to settle what is wrong,
            while that is open.
    """

    most_movements: int = 6
    feedback: bool = True
    most_repeats: int = 1
    probe_every: int = 8
    questions: int = 0


@dataclass(frozen=True)
class TargetResult:
    """What became of a target.

    Attributes:
        target: The target.
        reached: Whether the tool was seen within its tolerance.
        error_m: How far it was from it in the end [m]; NaN: it was not seen.
        error_rad: How far from its approach direction, as far as the believed arm tells [rad]; 0
            where none is asked for.
        first_error_m: The same after the first movement [m].
        movements: Movements made.
        reachable: Whether the last plan could reach it on the arm as it was believed to be.
        believed: What was believed in the end; empty: no fault.
        why: Why it was given up, empty if it was reached.
    """

    target: Target
    reached: bool
    error_m: float
    error_rad: float
    first_error_m: float
    movements: int
    reachable: bool
    believed: str
    why: str = ""

    @property
    def direction_error_rad(self) -> float | None:
        """Angle to the approach direction [rad]; None if none is asked for or it is not known."""
        unknown = self.target.direction is None or math.isnan(self.error_rad)
        return None if unknown else self.error_rad

    def record(self) -> dict[str, Any]:
        """Return the result as a JSON object; unknown errors are null."""
        return {
            "position": list(self.target.position),
            "reached": self.reached,
            "error_m": None if math.isnan(self.error_m) else self.error_m,
            "error_rad": self.direction_error_rad,
            "movements": self.movements,
            "reachable": self.reachable,
            "believed": self.believed or None,
            "why": self.why,
        }
