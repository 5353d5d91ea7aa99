"""Accuracy, false alarms and coverage of intervals, with Wilson intervals."""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.core.types import FloatArray, IntArray
from failuretwin.decision.scoring_rules import LogScore, log_score


@dataclass(frozen=True)
class Share:
    """`count` of `total`; the value is NaN where the total is 0."""

    count: int
    total: int

    @property
    def value(self) -> float:
        """The share."""
        return self.count / self.total if self.total else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson 95 % interval (Wilson, JASA 1927); (0, 1) where the total is 0."""
        from scipy.stats import binomtest

        if self.total == 0:
            return 0.0, 1.0
        low, high = binomtest(self.count, self.total).proportion_ci(method="wilson")
        return float(low), float(high)


# Accuracy, confusion matrix, precision, recall and F1.

NO_VERDICT = "cannot tell"
"""Class of the runs without a verdict."""
UNKNOWN, HEALTHY = "unknown", "healthy"


def judged_truth(truth: str, hypotheses: Container[str]) -> str:
    """Return the correct answer for a run among these hypotheses.

    It is `unknown` if the true fault is not among the hypotheses and `unknown` is; otherwise the
    truth itself. A healthy robot is never `unknown`.
    """
    if truth == HEALTHY or truth in hypotheses or UNKNOWN not in hypotheses:
        return truth
    return UNKNOWN


@dataclass(frozen=True)
class ClassScore:
    """Scores of one class; `runs` have it as truth. Ratios of 0 / 0 are NaN."""

    name: str
    runs: int
    precision: float
    recall: float
    f1: float


@dataclass(frozen=True)
class Scores:
    """Accuracy and log score of a set of diagnoses.

    Attributes:
        classes: Hypotheses in the order of the confusion matrix.
        confusion: Counts, (truth, diagnosis).
        log_scores: Log score of the same runs.
    """

    classes: tuple[str, ...]
    confusion: IntArray
    log_scores: LogScore

    @property
    def log_score(self) -> float:
        """Mean log score [nats per run]; may be infinite."""
        return self.log_scores.mean

    @property
    def runs(self) -> int:
        """Number of runs."""
        return int(self.confusion.sum())

    @property
    def right(self) -> int:
        """Number of correctly diagnosed runs."""
        return int(np.trace(self.confusion))

    @property
    def accuracy(self) -> float:
        """Share of correctly diagnosed runs."""
        return self.right / self.runs

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson 95 % interval of the accuracy."""
        return Share(self.right, self.runs).interval

    @property
    def macro_f1(self) -> float:
        """Mean F1 of the classes that are the truth of any run, equally weighted."""
        return float(np.mean([row.f1 for row in self.by_class() if row.runs]))

    def by_class(self) -> list[ClassScore]:
        """Return precision, recall and F1 of each class."""
        runs, ratios = self.confusion.sum(axis=1).tolist(), class_ratios(self.confusion).tolist()
        rows = zip(self.classes, runs, ratios, strict=True)
        return [ClassScore(name, count, *ratio) for name, count, ratio in rows]


def class_ratios(confusion: IntArray) -> FloatArray:
    """Return precision, recall and F1 of each class, (..., class, 3); 0 / 0 is NaN.

    F1 = 2 hits / (runs + diagnoses). The confusion matrix holds counts (..., truth, diagnosis).
    """
    hits = np.diagonal(confusion, axis1=-2, axis2=-1)
    runs, diagnoses = confusion.sum(axis=-1), confusion.sum(axis=-2)
    with np.errstate(invalid="ignore"):
        return np.stack([hits / diagnoses, hits / runs, 2 * hits / (runs + diagnoses)], axis=-1)


def score(
    truth: Sequence[str],
    diagnosis: Sequence[str | None],
    posterior: Sequence[Mapping[str, float]],
) -> Scores:
    """Score the diagnosis of each run; None is a class of its own, `NO_VERDICT`."""
    verdicts = [NO_VERDICT if verdict is None else verdict for verdict in diagnosis]
    names = [name for p in posterior for name in p]
    classes = tuple(dict.fromkeys([*names, *truth, *verdicts]))
    index = {name: i for i, name in enumerate(classes)}
    confusion = np.zeros((len(classes), len(classes)), dtype=np.int64)
    for true, verdict in zip(truth, verdicts, strict=True):
        confusion[index[true], index[verdict]] += 1
    return Scores(classes, confusion, log_score(truth, posterior))


# False alarms and missed detections.


@dataclass(frozen=True)
class Alarms:
    """False alarms and missed detections; an alarm is a verdict other than healthy.

    Attributes:
        false_alarms: Healthy runs with an alarm, of all healthy runs.
        missed: Faulty runs without an alarm, of all faulty runs.
        healthy_abstained: Healthy runs without a verdict.
        faulty_abstained: Faulty runs without a verdict; included in `missed`.
    """

    false_alarms: Share
    missed: Share
    healthy_abstained: int
    faulty_abstained: int


def count_alarms(truth: Sequence[str], diagnosis: Sequence[str | None]) -> Alarms:
    """Count false alarms and missed detections; a diagnosis of None is no verdict."""
    pairs = list(zip(truth, diagnosis, strict=True))
    healthy = [verdict for true, verdict in pairs if true == HEALTHY]
    faulty = [verdict for true, verdict in pairs if true != HEALTHY]
    return Alarms(
        false_alarms=Share(sum(v not in (HEALTHY, None) for v in healthy), len(healthy)),
        missed=Share(sum(v in (HEALTHY, None) for v in faulty), len(faulty)),
        healthy_abstained=healthy.count(None),
        faulty_abstained=faulty.count(None),
    )


# Coverage of 90 % intervals.


@dataclass(frozen=True)
class IntervalCase:
    """Interval of a quantity of a fault mode, such as `onset`, and its true value."""

    mode: str
    quantity: str
    low: float
    high: float
    truth: float


@dataclass(frozen=True)
class Coverage:
    """Coverage of the intervals of one quantity of one fault mode.

    Attributes:
        inside: Intervals that contain the truth, ends included, of all intervals.
        below: Truths below their interval.
        above: Truths above their interval.
        points: Intervals of zero width: given or assumed, not estimated.
    """

    mode: str
    quantity: str
    inside: Share
    below: int
    above: int
    points: int


def coverage_by_mode(cases: Iterable[IntervalCase]) -> list[Coverage]:
    """Return the coverage of each quantity of each fault mode, in order of appearance.

    Pass runs whose fault was diagnosed correctly: an interval is conditional on the diagnosis.
    """
    groups: dict[tuple[str, str], list[IntervalCase]] = {}
    for case in cases:
        groups.setdefault((case.mode, case.quantity), []).append(case)
    return [_coverage(mode, quantity, group) for (mode, quantity), group in groups.items()]


def _coverage(mode: str, quantity: str, group: Sequence[IntervalCase]) -> Coverage:
    low, high, truth = np.array([(case.low, case.high, case.truth) for case in group]).T
    below, above, points = (int(np.sum(w)) for w in (truth < low, truth > high, low == high))
    inside = Share(len(group) - below - above, len(group))
    return Coverage(mode, quantity, inside, below, above, points)
