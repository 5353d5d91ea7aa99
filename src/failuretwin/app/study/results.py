"""From the results of the trainings to the numbers of the paper's tables."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from failuretwin.app.study.published import Spread
from failuretwin.app.study.trainings import Training
from failuretwin.core.types import FloatArray, IntArray

SETS = ("training", "validation", "test")
"""What accuracies are taken on."""


def of_kind(trainings: Sequence[Training], features: str, learning_rate: float) -> list[Training]:
    """Return the repetitions of one kind of training."""
    return [
        training
        for training in trainings
        if (training.job.features, training.job.learning_rate) == (features, learning_rate)
    ]


def spread_of(values: Sequence[float] | FloatArray) -> Spread:
    """Return mean and sample standard deviation; NaN if any value is NaN, as in the paper."""
    array = np.asarray(values, dtype=np.float64)
    deviation = float(array.std(ddof=1)) if len(array) > 1 else math.nan
    return Spread(float(array.mean()), deviation)


def accuracies(repeats: Sequence[Training], name: str) -> list[Spread]:
    """Return the accuracy on one of `SETS` at each checkpoint."""
    rows = [[getattr(point, name) for point in training.checkpoints] for training in repeats]
    return [spread_of(column) for column in np.array(rows).T]


def class_ratios(repeats: Sequence[Training]) -> list[tuple[Spread, Spread, Spread]]:
    """Return precision, recall and F1 of each class on the test set.

    Precision and F1 are NaN in a repetition that never names the class, as in the paper.
    """
    ratios = np.array([_ratios(np.array(training.confusion)) for training in repeats])
    return [
        (spread_of(rows[:, 0]), spread_of(rows[:, 1]), spread_of(rows[:, 2]))
        for rows in np.moveaxis(ratios, 1, 0)
    ]


def _ratios(confusion: IntArray) -> FloatArray:
    """Return (class, 3) ratios of one confusion matrix (truth, diagnosis)."""
    hits = np.diag(confusion).astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        precision = hits / confusion.sum(axis=0)
        recall = hits / confusion.sum(axis=1)
        f1 = 2.0 * hits / (confusion.sum(axis=0) + confusion.sum(axis=1))
    f1[np.isnan(precision)] = np.nan
    return np.stack([precision, recall, f1], axis=1)


def mean_confusion(repeats: Sequence[Training]) -> FloatArray:
    """Return the share of each truth that got each diagnosis on the test set, (truth, diagnosis).

    NaN in the row of a class that the test set lacks.
    """
    total = np.sum([training.confusion for training in repeats], axis=0).astype(np.float64)
    with np.errstate(invalid="ignore"):
        return total / total.sum(axis=1, keepdims=True)
