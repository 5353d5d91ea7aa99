"""Proper scores: what the stated probabilities are worth. Honest probabilities score best."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.core.types import FloatArray


@dataclass(frozen=True)
class LogScore:
    """Log score (Good, J. R. Stat. Soc. B 1952): minus the log probability of the truth.

    Attributes:
        nats: Surprise at the truth of each run, (run,) [nats]; infinite where the truth was given
            no probability at all. Nothing is floored.
    """

    nats: FloatArray

    @property
    def mean(self) -> float:
        """Mean [nats a run]; infinite if any run is."""
        return float(np.mean(self.nats))

    @property
    def impossible(self) -> int:
        """Number of runs whose truth was given no probability."""
        return int(np.isinf(self.nats).sum())

    @property
    def mean_of_rest(self) -> float:
        """Mean over the runs whose truth was thought possible [nats a run]; NaN if there are none.

        Never a score by itself: it leaves out the worst runs.
        """
        rest = self.nats[np.isfinite(self.nats)]
        return float(np.mean(rest)) if rest.size else float("nan")


def log_score(truth: Sequence[str], posterior: Sequence[Mapping[str, float]]) -> LogScore:
    """Return the log score of each run.

    Args:
        truth: True hypothesis of each run.
        posterior: Probabilities of each run; a truth that is not among them has none.
    """
    chance = np.array([p.get(t, 0.0) for p, t in zip(posterior, truth, strict=True)])
    with np.errstate(divide="ignore"):  # no probability: an infinite surprise, as it should be
        return LogScore(-np.log(chance) + 0.0)  # + 0.0: no surprise is 0, not -0


def brier_score(truth: Sequence[str], posterior: Sequence[Mapping[str, float]]) -> FloatArray:
    """Return the Brier score of each run: sum over hypotheses of (probability - truth)^2.

    The original form for several classes (Brier, Monthly Weather Review 1950): 0 is perfect, 2 is
    certainty of something wrong. A truth that no hypothesis stands for adds 1.

    Args:
        truth: True hypothesis of each run.
        posterior: Probabilities of each run.
    """
    return np.array(
        [
            sum((chance - (name == true)) ** 2 for name, chance in p.items()) + (true not in p)
            for p, true in zip(posterior, truth, strict=True)
        ],
        dtype=np.float64,
    )
