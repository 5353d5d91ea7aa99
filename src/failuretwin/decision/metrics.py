"""How good diagnoses are, where the truth is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.core.types import IntArray

Z_95 = 1.959963984540054
"""Two-sided 95 % point of the normal distribution."""
NO_VERDICT = "cannot tell"
"""Class of the runs that got no verdict."""
PROBABILITY_FLOOR = 1e-12
"""A truth that a posterior gives less than this counts as this in the log score."""


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Return the Wilson 95 % interval of a share."""
    if trials == 0:
        return 0.0, 1.0
    share, z2 = successes / trials, Z_95**2
    centre = (share + z2 / (2 * trials)) / (1 + z2 / trials)
    half = Z_95 * np.sqrt(share * (1 - share) / trials + z2 / (4 * trials**2)) / (1 + z2 / trials)
    return max(0.0, float(centre - half)), min(1.0, float(centre + half))


@dataclass(frozen=True)
class ClassScore:
    """Scores of one class; NaN where the ratio has no meaning.

    Attributes:
        name: The hypothesis.
        runs: Runs of which it is the truth.
        precision: Share of its diagnoses that are right.
        recall: Share of its runs that are found.
        f1: Harmonic mean of both.
    """

    name: str
    runs: int
    precision: float
    recall: float
    f1: float


@dataclass(frozen=True)
class Scores:
    """Scores of a set of diagnoses.

    Attributes:
        classes: Hypotheses in the order of the confusion matrix.
        confusion: Counts, (truth, diagnosis).
        log_score: Mean of minus the log probability of the truth [nats a run].
    """

    classes: tuple[str, ...]
    confusion: IntArray
    log_score: float

    @property
    def runs(self) -> int:
        """Number of runs."""
        return int(self.confusion.sum())

    @property
    def right(self) -> int:
        """Number of runs diagnosed right."""
        return int(np.trace(self.confusion))

    @property
    def accuracy(self) -> float:
        """Share of runs diagnosed right."""
        return self.right / self.runs

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson 95 % interval of the accuracy."""
        return wilson_interval(self.right, self.runs)

    def by_class(self) -> list[ClassScore]:
        """Return precision, recall and F1 of each class."""
        truth, said = self.confusion.sum(axis=1), self.confusion.sum(axis=0)
        rows = []
        for i, name in enumerate(self.classes):
            hit = float(self.confusion[i, i])
            precision = hit / said[i] if said[i] else float("nan")
            recall = hit / truth[i] if truth[i] else float("nan")
            total = precision + recall
            f1 = 2 * precision * recall / total if total > 0 else float("nan")
            rows.append(ClassScore(name, int(truth[i]), float(precision), float(recall), f1))
        return rows


def score(
    truth: Sequence[str],
    diagnosis: Sequence[str | None],
    posterior: Sequence[Mapping[str, float]],
) -> Scores:
    """Score diagnoses against the truth.

    Args:
        truth: True hypothesis of each run.
        diagnosis: Most probable hypothesis of each run; None: no verdict, a class of its own.
        posterior: Probabilities of each run.
    """
    said_of = [NO_VERDICT if said is None else said for said in diagnosis]
    names = [name for p in posterior for name in p]
    classes = tuple(dict.fromkeys([*names, *truth, *said_of]))
    index = {name: i for i, name in enumerate(classes)}
    confusion = np.zeros((len(classes), len(classes)), dtype=np.int64)
    for true, said in zip(truth, said_of, strict=True):
        confusion[index[true], index[said]] += 1
    chance = [p.get(t, 0.0) for p, t in zip(posterior, truth, strict=True)]
    log_score = -np.mean(np.log(np.maximum(chance, PROBABILITY_FLOOR)))
    return Scores(classes, confusion, float(log_score))
