"""Right or wrong: accuracy, confusion, precision, recall and F1 of each class."""

from __future__ import annotations

import math
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.core.types import IntArray
from failuretwin.decision.metrics.proper import LogScore, log_score
from failuretwin.decision.metrics.shares import wilson_interval

NO_VERDICT = "cannot tell"
"""Class of the runs that got no verdict."""
UNKNOWN, HEALTHY = "unknown", "healthy"


def judged_truth(truth: str, hypotheses: Container[str]) -> str:
    """Return the hypothesis that is right for a run: its truth, or `unknown` where that means it.

    `unknown` stands for every fault that is not named, so where it is among the hypotheses and
    the true fault is not, it is the right answer. A healthy robot has no fault and stays healthy.

    Args:
        truth: True hypothesis of the run.
        hypotheses: Those that were given a probability.
    """
    if truth == HEALTHY or truth in hypotheses or UNKNOWN not in hypotheses:
        return truth
    return UNKNOWN


@dataclass(frozen=True)
class ClassScore:
    """Scores of one class; NaN where the ratio has no meaning (0 / 0).

    Attributes:
        name: The hypothesis.
        runs: Runs of which it is the truth.
        precision: Share of its diagnoses that are right; NaN if it was never diagnosed.
        recall: Share of its runs that are found; NaN if it is never the truth.
        f1: 2 hits / (runs + diagnoses), the harmonic mean of both where both have a meaning. A
            class that is true but never diagnosed has 0; NaN if it is neither.
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
        surprise: Log score of the same runs.
    """

    classes: tuple[str, ...]
    confusion: IntArray
    surprise: LogScore

    @property
    def log_score(self) -> float:
        """Mean of minus the log probability of the truth [nats a run]; may be infinite."""
        return self.surprise.mean

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

    @property
    def macro_f1(self) -> float:
        """Mean F1 of the classes that are the truth of any run, each with the same weight.

        Other classes (never true; "cannot tell") have no say of their own: their diagnoses already
        lower the recall of the classes that were true.
        """
        return float(np.mean([row.f1 for row in self.by_class() if row.runs]))

    def by_class(self) -> list[ClassScore]:
        """Return precision, recall and F1 of each class."""
        truth, said = self.confusion.sum(axis=1), self.confusion.sum(axis=0)
        return [
            ClassScore(
                name=name,
                runs=int(truth[i]),
                precision=_ratio(self.confusion[i, i], said[i]),
                recall=_ratio(self.confusion[i, i], truth[i]),
                f1=_ratio(2 * self.confusion[i, i], truth[i] + said[i]),
            )
            for i, name in enumerate(self.classes)
        ]


def _ratio(part: int, whole: int) -> float:
    return float(part / whole) if whole else math.nan


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
    return Scores(classes, confusion, log_score(truth, posterior))
