"""When a fault may have begun: which movement it spoils first, and what that says of the onset."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.movements import Movements
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.failure_behavior.registry import MODES
from failuretwin.inference.evidence import SettledEvidence

QUADRATURE = np.linspace(0.05, 0.95, 10)
"""Points at which a stretch of time is sampled, as shares of its length."""


@dataclass(frozen=True)
class OnsetPrior:
    """When a fault may have begun; onsets too late to show in the run are not considered.

    Attributes:
        prior_before_run: Probability that the fault was there before the run; of a stuck motor,
            that it was stuck before the run or gets stuck on its first ramp. The rest is spread
            evenly over the time after that. None: as the mode says.
        free: Probability that the held angle of a stuck motor is unrelated to the commands,
            anywhere in range.
        known_s: The onset of a stuck motor, where it is known [s].

    Raises:
        InputError: If a probability or the onset makes no sense.
    """

    prior_before_run: float | None = None
    free: float = 0.2
    known_s: float | None = None

    def __post_init__(self) -> None:
        for name, value in (("early", self.prior_before_run), ("free", self.free)):
            if value is not None and not 0.0 <= value <= 1.0:
                raise InputError(f"{name} is {value:g}, expected a probability from 0 to 1.")
        if self.known_s is not None and not 0.0 <= self.known_s < np.inf:
            raise InputError(f"known_s is {self.known_s:g}, expected 0 or more [s].")

    def before_run(self, mode: str) -> float:
        """Return the probability that a fault of this mode was there before the run."""
        return MODES[mode].before_run if self.prior_before_run is None else self.prior_before_run


@dataclass(frozen=True)
class OnsetIntervals:
    """The stretch of time in which an onset spoils each movement first, (run, movement) [s].

    Attributes:
        begin: Begin of each; of the first movement, the start of the run.
        end: End of each.
        exists: Movements that are there.
    """

    begin: FloatArray
    end: FloatArray
    exists: BoolArray

    def weights(self, prior_before_run: float) -> FloatArray:
        """Return the prior probability that each movement is the first spoilt, (run, movement).

        Args:
            prior_before_run: Probability that the fault was there before the run.
        """
        length = np.where(self.exists, np.maximum(self.end - self.begin, 0.0), 0.0)
        total = length.sum(axis=1, keepdims=True)
        share = np.where(total > 0.0, prior_before_run, 1.0)
        weights = (1.0 - share) * length / np.where(total > 0.0, total, 1.0)
        weights[:, 0] += share[:, 0]
        return weights

    def samples(self, prior_before_run: float, run: int) -> tuple[FloatArray, FloatArray]:
        """Return onsets in a run [s] and their share of their stretch, each (movement, sample).

        A fault that was there before the run counts as an onset at 0.
        """
        begin, end = np.nan_to_num(self.begin[run]), np.nan_to_num(self.end[run])
        late = begin[:, None] + QUADRATURE * np.maximum(end - begin, 0.0)[:, None]
        onset = np.concatenate([np.zeros_like(late[:, :1]), late], axis=1)
        before = np.zeros_like(begin)
        weight = self.weights(prior_before_run)[run, 0]
        before[0] = prior_before_run / weight if weight > prior_before_run else 1.0
        inside = np.repeat((1.0 - before)[:, None] / len(QUADRATURE), len(QUADRATURE), axis=1)
        return onset, np.concatenate([before[:, None], inside], axis=1)

    def onsets(self, prior_before_run: float) -> Callable[[int], tuple[FloatArray, FloatArray]]:
        """Return `samples` of a run by its index, with an axis for nodes: (movement, 1, sample)."""

        def of_run(run: int) -> tuple[FloatArray, FloatArray]:
            onset, share = self.samples(prior_before_run, run)
            return onset[:, None], share[:, None]

        return of_run


def next_movement(movements: Movements) -> OnsetIntervals:
    """Return the stretches of a fault that acts on the movements that start after its onset."""
    return _between(movements.start, movements.exists)


def immediate(evidence: SettledEvidence) -> OnsetIntervals:
    """Return the stretches of a fault that acts at once: up to where the tool is seen at rest.

    Of a movement that is never seen at rest: up to the last reading or the next movement.
    """
    middle = 0.5 * (np.minimum(evidence.begin, evidence.end) + evidence.end)
    exists = evidence.movements.exists
    return _between(np.where(exists, middle, np.nan), exists)


def _between(end: FloatArray, exists: BoolArray) -> OnsetIntervals:
    begin = np.concatenate([np.zeros_like(end[:, :1]), end[:, :-1]], axis=1)
    return OnsetIntervals(begin, end, exists)
