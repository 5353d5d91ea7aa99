"""Scores of verdicts, probabilities and intervals, and comparison of two methods."""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.types import BoolArray, FloatArray, IntArray


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
class Scores:
    """Accuracy and log score of a set of diagnoses.

    Attributes:
        classes: Hypotheses in the order of the confusion matrix.
        confusion: Counts, (truth, diagnosis).
        nats: Log score of each run, (run,) [nats]; infinite where the truth has probability 0.
    """

    classes: tuple[str, ...]
    confusion: IntArray
    nats: FloatArray

    @property
    def log_score(self) -> float:
        """Mean log score [nats per run]; may be infinite."""
        return float(np.mean(self.nats))

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
        return float(np.mean(self.ratios[self.confusion.any(axis=1), 2]))

    @property
    def ratios(self) -> FloatArray:
        """Precision, recall and F1 of each class, (class, 3); see `class_ratios`."""
        return class_ratios(self.confusion)


def class_ratios(confusion: IntArray) -> FloatArray:
    """Return precision, recall and F1 of each class, (..., class, 3); 0 / 0 is NaN.

    F1 = 2 hits / (runs + diagnoses). The confusion matrix holds counts (..., truth, diagnosis).
    """
    hits = np.diagonal(confusion, axis1=-2, axis2=-1)
    runs, diagnoses = confusion.sum(axis=-1), confusion.sum(axis=-2)
    with np.errstate(invalid="ignore"):
        return np.stack([hits / diagnoses, hits / runs, 2 * hits / (runs + diagnoses)], axis=-1)


def score_diagnoses(
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


# Proper scoring rules of probabilities.


def log_score(truth: Sequence[str], posterior: Sequence[Mapping[str, float]]) -> FloatArray:
    """Return minus the log probability of the truth of each run [nats] (Good, JRSS B 1952).

    It is infinite where the truth has probability 0 or is missing from the posterior.
    """
    chance = np.array([p.get(t, 0.0) for p, t in zip(posterior, truth, strict=True)])
    with np.errstate(divide="ignore"):
        return np.asarray(-np.log(chance) + 0.0)  # + 0.0 turns -0 into 0


def brier_score(truth: Sequence[str], posterior: Sequence[Mapping[str, float]]) -> FloatArray:
    """Return the Brier score of each run, sum over hypotheses of (probability - truth)^2.

    0 is perfect, 2 is the worst (Brier, Monthly Weather Review 1950). A truth missing from its
    posterior adds 1.
    """
    pairs = list(zip(posterior, truth, strict=True))
    squares = [sum((c - (name == true)) ** 2 for name, c in p.items()) for p, true in pairs]
    return np.array(squares) + [true not in p for p, true in pairs]


# Reliability and calibration error.

EQUAL_EDGES = np.linspace(0.0, 1.0, 11)
"""Edges of ten bins of equal width."""
ADAPTIVE_BINS = 10
DRAWS = 1000
"""Simulated sets of answers behind the calibration error by chance."""


@dataclass(frozen=True)
class Reliability:
    """Reliability diagram: runs in bins of stated probability, low < probability <= high.

    Attributes:
        edges: Edges of the bins, (bins + 1,).
        count: Runs of each bin, (bins,).
        right: Correctly diagnosed runs of each bin, (bins,).
        confidence: Mean stated probability of each bin, (bins,); NaN where empty.
    """

    edges: FloatArray
    count: IntArray
    right: IntArray
    confidence: FloatArray

    @property
    def error(self) -> float:
        """Expected calibration error (Naeini et al., AAAI 2015; Guo et al., ICML 2017)."""
        gap = np.abs(self.right - self.count * np.nan_to_num(self.confidence))
        return float(gap.sum() / self.count.sum())


def adaptive_edges(confidence: FloatArray) -> FloatArray:
    """Return edges of bins of about equal counts (Nixon et al., CVPR 2019).

    Edges lie midway between runs; ties share a bin, so there may be fewer than `ADAPTIVE_BINS`.
    """
    ordered, bins = np.sort(confidence), min(ADAPTIVE_BINS, len(confidence))
    first = np.ceil(np.arange(1, bins) * len(ordered) / bins).astype(np.int64)
    between = (ordered[first - 1] + ordered[first]) / 2
    return np.r_[0.0, np.unique(between), 1.0]


def reliability(
    confidence: FloatArray, right: BoolArray, edges: FloatArray = EQUAL_EDGES
) -> Reliability:
    """Return the reliability diagram of stated probabilities and whether each was right, (run,)."""
    if not confidence.size or not np.all((confidence >= 0.0) & (confidence <= 1.0)):
        raise InputError("expected the stated probability of at least one run, within 0 to 1.")
    inside, bins = np.searchsorted(edges[1:-1], confidence, side="left"), len(edges) - 1
    count = np.bincount(inside, minlength=bins)
    total = np.bincount(inside, weights=confidence, minlength=bins)
    mean = np.full(bins, np.nan)
    np.divide(total, count, out=mean, where=count > 0)
    return Reliability(edges, count, np.bincount(inside[right], minlength=bins), mean)


def calibrated_error(
    confidence: FloatArray, rng: np.random.Generator, draws: int = DRAWS
) -> FloatArray:
    """Return calibration errors of a perfectly calibrated method, (draws,), in equal bins.

    Answers are drawn from the stated probabilities, (run,) (consistency resampling: Broecker &
    Smith, Weather and Forecasting 2007).
    """
    runs = len(confidence)
    drawn = (rng.random(runs) < confidence for _ in range(draws))
    return np.array([reliability(confidence, right).error for right in drawn])


# Two methods on the same runs.

RESAMPLES = 10_000
"""Bootstrap samples."""
BATCH = 100
"""Bootstrap samples in memory at a time."""


@dataclass(frozen=True)
class McNemar:
    """Exact McNemar test (McNemar, Psychometrika 1947).

    Attributes:
        both: Runs that both methods got right.
        first_only: Runs that only the first got right.
        second_only: Runs that only the second got right.
        neither: Runs that neither got right.
        p: Two-sided binomial probability of a split at least as uneven.
    """

    both: int
    first_only: int
    second_only: int
    neither: int
    p: float


@dataclass(frozen=True)
class LogScoreGain:
    """Log score of the first method minus that of the second; positive: the second is better.

    Attributes:
        mean: Mean over all runs [nats per run]; infinite if only one method gave a truth
            probability 0, NaN if each did so in a different run.
        finite_mean: Mean over the runs whose truth both gave a probability; NaN if there are none.
        interval: 95 % bootstrap percentile interval of `finite_mean` (Efron 1979).
        runs: Runs behind `finite_mean`.
        first_impossible: Runs whose truth only the first method gave probability 0.
        second_impossible: The same for the second method.
        both_impossible: Runs whose truth both gave probability 0; they count as no difference.
    """

    mean: float
    finite_mean: float
    interval: tuple[float, float]
    runs: int
    first_impossible: int
    second_impossible: int
    both_impossible: int


def mcnemar(first: BoolArray, second: BoolArray) -> McNemar:
    """Compare which of the same runs two methods got right, (run,) each."""
    from scipy.stats import binomtest

    cells = (first & second, first & ~second, second & ~first, ~first & ~second)
    both, first_only, second_only, neither = (int(cell.sum()) for cell in cells)
    differ = first_only + second_only
    p = float(binomtest(first_only, differ).pvalue) if differ else 1.0
    return McNemar(both, first_only, second_only, neither, p)


def log_score_gain(
    first: FloatArray, second: FloatArray, rng: np.random.Generator, draws: int = RESAMPLES
) -> LogScoreGain:
    """Compare the log scores of two methods on the same runs, (run,) [nats]."""
    lost_first, lost_second = np.isinf(first), np.isinf(second)
    with np.errstate(invalid="ignore"):  # infinities of both signs have no mean
        gain = np.where(lost_first & lost_second, 0.0, first - second)
        mean = float(np.mean(gain))
    finite = gain[~(lost_first | lost_second)]
    return LogScoreGain(
        mean=mean,
        finite_mean=float(finite.mean()) if finite.size else float("nan"),
        interval=_bootstrap_interval(finite, rng, draws),
        runs=int(finite.size),
        first_impossible=int((lost_first & ~lost_second).sum()),
        second_impossible=int((lost_second & ~lost_first).sum()),
        both_impossible=int((lost_first & lost_second).sum()),
    )


def _bootstrap_interval(
    values: FloatArray, rng: np.random.Generator, draws: int
) -> tuple[float, float]:
    from scipy.stats import bootstrap

    if values.size < 2:
        only = float(values[0]) if values.size else float("nan")
        return only, only
    found = bootstrap(
        (values,), np.mean, n_resamples=draws, batch=BATCH, method="percentile", random_state=rng
    ).confidence_interval
    return float(found.low), float(found.high)
