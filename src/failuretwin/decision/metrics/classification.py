"""Right or wrong: accuracy, confusion, precision, recall and F1 of each class."""

from __future__ import annotations

import math
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.decision.metrics.probability import LogScore, Share, log_score, wilson_interval

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


# False alarms and missed detections: faulty or not, whatever the fault.


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


# Which of two methods is better on the same runs?

DRAWS = 10_000
"""Bootstrap samples."""
CHUNK = 1_000_000
"""Runs drawn at a time, so that memory stays small."""


@dataclass(frozen=True)
class McNemar:
    """Exact McNemar test of two methods on the same runs (McNemar, Psychometrika 1947).

    Attributes:
        both: Runs that both got right.
        first_only: Runs that only the first got right.
        second_only: Runs that only the second got right.
        neither: Runs that both got wrong.
        p: Two-sided chance of a split of the runs on which they differ at least as uneven, if both
            methods were equally good (binomial with one half).
    """

    both: int
    first_only: int
    second_only: int
    neither: int
    p: float


@dataclass(frozen=True)
class LogScoreGain:
    """Nats a run that the second method saves; positive: the second is better.

    Attributes:
        mean: Mean over all runs of first minus second [nats a run]; infinite where one method
            alone ruled out a truth, NaN where each ruled out one that the other did not.
        finite_mean: The same over the runs whose truth neither ruled out; NaN if there are none.
        interval: 95 % bootstrap interval of `finite_mean` (percentiles; Efron 1979).
        runs: Runs behind `finite_mean`.
        first_impossible: Runs whose truth only the first method ruled out.
        second_impossible: Runs whose truth only the second ruled out.
        both_impossible: Runs whose truth both ruled out: no difference there.
    """

    mean: float
    finite_mean: float
    interval: tuple[float, float]
    runs: int
    first_impossible: int
    second_impossible: int
    both_impossible: int


def mcnemar(first: BoolArray, second: BoolArray) -> McNemar:
    """Compare which runs two methods got right.

    Args:
        first: Whether the first method was right, (run,).
        second: The same of the second, on the same runs, (run,).

    Raises:
        InputError: If they do not have the same runs.
    """
    from scipy.stats import binomtest

    _check_same_runs(first, second)
    only = int((first & ~second).sum()), int((second & ~first).sum())
    p = float(binomtest(only[0], sum(only)).pvalue) if sum(only) else 1.0
    return McNemar(int((first & second).sum()), *only, int((~first & ~second).sum()), p)


def log_score_gain(
    first: FloatArray, second: FloatArray, rng: np.random.Generator, draws: int = DRAWS
) -> LogScoreGain:
    """Compare the log scores of two methods run by run.

    Args:
        first: Log score of each run by the first method, (run,) [nats]; may be infinite.
        second: The same by the second method, on the same runs, (run,) [nats].
        rng: Source of chance.
        draws: Bootstrap samples.

    Raises:
        InputError: If they do not have the same runs.
    """
    _check_same_runs(first, second)
    lost_first, lost_second = np.isinf(first), np.isinf(second)
    kept = ~(lost_first | lost_second)
    gain = first[kept] - second[kept]
    finite_mean = float(gain.mean()) if gain.size else float("nan")
    alone = int((lost_first & ~lost_second).sum()), int((lost_second & ~lost_first).sum())
    return LogScoreGain(
        mean=_mean(alone, float(gain.sum()) / len(first)),
        finite_mean=finite_mean,
        interval=_bootstrap_interval(gain, rng, draws),
        runs=int(gain.size),
        first_impossible=alone[0],
        second_impossible=alone[1],
        both_impossible=int((lost_first & lost_second).sum()),
    )


def _mean(alone: tuple[int, int], finite: float) -> float:
    if alone[0] and alone[1]:
        return float("nan")
    if alone[0] or alone[1]:
        return float("inf") if alone[0] else float("-inf")
    return finite


def _bootstrap_interval(
    values: FloatArray, rng: np.random.Generator, draws: int
) -> tuple[float, float]:
    if values.size == 0:
        return float("nan"), float("nan")
    step = max(1, CHUNK // values.size)
    means = [
        values[rng.integers(0, values.size, (min(step, draws - i), values.size))].mean(axis=1)
        for i in range(0, draws, step)
    ]
    low, high = np.quantile(np.concatenate(means), [0.025, 0.975])
    return float(low), float(high)


def _check_same_runs(first: BoolArray | FloatArray, second: BoolArray | FloatArray) -> None:
    if first.shape != second.shape or first.ndim != 1 or first.size == 0:
        raise InputError(
            f"two methods are compared on the same runs; got {first.shape} and {second.shape}."
        )
