"""Scores of verdicts, probabilities and intervals, and comparison of two methods."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from failuretwin.core.errors import InputError, counted
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.decision.results import Record


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


# Coverage of 90 % intervals.


class IntervalCase(NamedTuple):
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
    groups = defaultdict[tuple[str, str], list[list[float]]](list)
    for mode, quantity, *numbers in cases:
        groups[mode, quantity].append(numbers)
    rows = []
    for (mode, quantity), group in groups.items():
        low, high, truth = np.array(group).T
        below, above, points = (int(np.sum(w)) for w in (truth < low, truth > high, low == high))
        inside = Share(len(group) - below - above, len(group))
        rows.append(Coverage(mode, quantity, inside, below, above, points))
    return rows


# Verdicts and probabilities.

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
    """Scores of the diagnoses whose truth is known.

    Attributes:
        truth: Correct answer for each run; see `judged_truth`.
        verdicts: Verdict on each run; None: no verdict.
        posteriors: Probabilities of each run.
        as_unknown: Number of runs whose correct answer is `unknown`, by true fault.
        protocol: Protocol letters, joined by a slash.
        cases: Intervals of the correctly diagnosed runs whose true values are known.
    """

    truth: Sequence[str]
    verdicts: Sequence[str | None]
    posteriors: Sequence[Mapping[str, float]]
    as_unknown: Mapping[str, int] = field(default_factory=dict)
    protocol: str = ""
    cases: Sequence[IntervalCase] = ()

    @classmethod
    def of(
        cls, diagnoses: Iterable[Diagnosis | Record], cases: Sequence[IntervalCase] = ()
    ) -> Scores:
        """Return the scores of diagnoses by the truth that they carry; others are left out."""
        given = list(diagnoses)
        told = [(d, d.truth) for d in given if d.truth]
        judged = [judged_truth(fault, d.posterior) for d, fault in told]
        return cls(
            truth=judged,
            verdicts=[d.diagnosis for d, _ in told],
            posteriors=[d.posterior for d, _ in told],
            as_unknown=Counter(t for (_, t), true in zip(told, judged, strict=True) if t != true),
            protocol="/".join(sorted({d.protocol or "?" for d in given})),
            cases=cases,
        )

    @property
    def runs(self) -> int:
        """Number of runs."""
        return len(self.truth)

    @property
    def runs_and_protocol(self) -> str:
        """Number of runs and protocol, as text."""
        return f"{counted(self.runs, 'run')}, protocol {self.protocol}"

    @property
    def hits(self) -> BoolArray:
        """Whether each run is diagnosed correctly, (run,)."""
        pairs = zip(self.verdicts, self.truth, strict=True)
        return np.array([verdict == true for verdict, true in pairs], dtype=np.bool_)

    @property
    def right(self) -> int:
        """Number of correctly diagnosed runs."""
        return int(self.hits.sum())

    @property
    def share(self) -> Share:
        """Correctly diagnosed runs of all runs."""
        return Share(self.right, self.runs)

    @property
    def accuracy(self) -> float:
        """Share of correctly diagnosed runs."""
        return self.share.value

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson 95 % interval of the accuracy."""
        return self.share.interval

    @property
    def false_alarms(self) -> Share:
        """Healthy runs with an alarm, a verdict other than healthy, of all healthy runs."""
        verdicts = self._verdicts_on(healthy=True)
        return Share(sum(v not in (HEALTHY, None) for v in verdicts), len(verdicts))

    @property
    def missed(self) -> Share:
        """Faulty runs without an alarm, of all faulty runs."""
        verdicts = self._verdicts_on(healthy=False)
        return Share(sum(v in (HEALTHY, None) for v in verdicts), len(verdicts))

    @property
    def abstained(self) -> tuple[int, int]:
        """Healthy and faulty runs without a verdict; the faulty ones count as missed."""
        healthy, faulty = (self._verdicts_on(healthy).count(None) for healthy in (True, False))
        return healthy, faulty

    def _verdicts_on(self, healthy: bool) -> list[str | None]:
        pairs = zip(self.verdicts, self.truth, strict=True)
        return [verdict for verdict, true in pairs if (true == HEALTHY) == healthy]

    @cached_property
    def classes(self) -> tuple[str, ...]:
        """Hypotheses, truths and verdicts, in the order of the confusion matrix."""
        names = [name for posterior in self.posteriors for name in posterior]
        return tuple(dict.fromkeys([*names, *self.truth, *self._named]))

    @property
    def _named(self) -> list[str]:
        return [NO_VERDICT if verdict is None else verdict for verdict in self.verdicts]

    @cached_property
    def confusion(self) -> IntArray:
        """Counts, (truth, diagnosis); no verdict is a class of its own, `NO_VERDICT`."""
        index = {name: i for i, name in enumerate(self.classes)}
        cells = [[index[name] for name in names] for names in (self.truth, self._named)]
        counts = np.zeros((len(index), len(index)), dtype=np.int64)
        np.add.at(counts, tuple(cells), 1)
        return counts

    @property
    def macro_f1(self) -> float:
        """Mean F1 of the classes that are the truth of any run, equally weighted."""
        true = self.confusion.sum(axis=1) > 0
        return float(class_ratios(self.confusion)[true, 2].mean())

    @cached_property
    def nats(self) -> FloatArray:
        """Log score of each run, (run,) [nats]; infinite where the truth has probability 0."""
        return log_score(self.truth, self.posteriors)

    @property
    def log_score(self) -> float:
        """Mean log score [nats per run]; may be infinite."""
        return float(np.mean(self.nats))

    @property
    def brier(self) -> float:
        """Mean Brier score, 0 to 2."""
        return float(brier_score(self.truth, self.posteriors).mean())

    @cached_property
    def decided(self) -> tuple[FloatArray, BoolArray]:
        """Stated probability of each verdict, and whether it is right, (verdict,) each."""
        rows = zip(self.verdicts, self.posteriors, self.hits, strict=True)
        pairs = [(p[verdict], hit) for verdict, p, hit in rows if verdict is not None]
        stated, right = np.array(pairs, dtype=np.float64).reshape(-1, 2).T
        return np.minimum(stated, 1.0), right > 0.0  # sums may round above 1

    @property
    def coverage(self) -> list[Coverage]:
        """Coverage of 90 % intervals by fault mode; empty where true values are unknown."""
        return coverage_by_mode(self.cases)


def class_ratios(confusion: IntArray) -> FloatArray:
    """Return precision, recall and F1 of each class, (..., class, 3); 0 / 0 is NaN.

    F1 = 2 hits / (runs + diagnoses). The confusion matrix holds counts (..., truth, diagnosis).
    """
    hits = np.diagonal(confusion, axis1=-2, axis2=-1)
    runs, diagnoses = confusion.sum(axis=-1), confusion.sum(axis=-2)
    with np.errstate(invalid="ignore"):
        return np.stack([hits / diagnoses, hits / runs, 2 * hits / (runs + diagnoses)], axis=-1)


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
    tables = [({t: 0.0, **p}, t) for p, t in zip(posterior, truth, strict=True)]
    return np.array([sum((p - (name == t)) ** 2 for name, p in ps.items()) for ps, t in tables])


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
    """Return the reliability diagram of stated probabilities and whether each was right, (run,).

    Raises:
        InputError: If there are no runs or a value is not a probability.
    """
    if not confidence.size or not np.all((confidence >= 0.0) & (confidence <= 1.0)):
        raise InputError("expected the stated probability of at least one run, within 0 to 1.")
    inside, bins = np.searchsorted(edges[1:-1], confidence), len(edges) - 1
    count = np.bincount(inside, minlength=bins)
    with np.errstate(invalid="ignore"):
        mean = np.bincount(inside, confidence, bins) / count
    return Reliability(edges, count, np.bincount(inside[right], minlength=bins), mean)


def calibrated_error(
    confidence: FloatArray, rng: np.random.Generator, draws: int = DRAWS
) -> FloatArray:
    """Return calibration errors of a perfectly calibrated method, (draws,), in equal bins.

    Answers are drawn from the stated probabilities, (run,) (consistency resampling: Broecker &
    Smith, Weather and Forecasting 2007).
    """
    drawn = (rng.random(len(confidence)) < confidence for _ in range(draws))
    return np.array([reliability(confidence, right).error for right in drawn])


# Two methods on the same runs.

RESAMPLES = 10_000
"""Bootstrap samples."""
BATCH = 100
"""Bootstrap samples in memory at a time."""


@dataclass(frozen=True)
class Split:
    """Numbers of runs of which a property, such as being right, holds for two methods."""

    both: int
    first_only: int
    second_only: int
    neither: int

    @classmethod
    def of(cls, first: BoolArray, second: BoolArray) -> Split:
        """Count runs by whether the property holds for each method, (run,) each."""
        cells = (first & second, first & ~second, second & ~first, ~first & ~second)
        return cls(*(int(cell.sum()) for cell in cells))

    @property
    def p(self) -> float:
        """Exact McNemar test: two-sided binomial probability of a split at least as uneven."""
        from scipy.stats import binomtest

        differ = self.first_only + self.second_only
        return float(binomtest(self.first_only, differ).pvalue) if differ else 1.0


@dataclass(frozen=True)
class LogScoreGain:
    """Log score of the first method minus that of the second; positive: the second is better.

    Attributes:
        mean: Mean over all runs [nats per run]; infinite if only one method gave a truth
            probability 0, NaN if each did so in a different run.
        finite_mean: Mean over the runs whose truth both gave a probability; NaN if there are none.
        interval: 95 % bootstrap percentile interval of `finite_mean` (Efron 1979).
        runs: Runs behind `finite_mean`.
        impossible: Runs whose truth has probability 0; where both gave it, there is no difference.
    """

    mean: float
    finite_mean: float
    interval: tuple[float, float]
    runs: int
    impossible: Split


def log_score_gain(
    first: FloatArray, second: FloatArray, rng: np.random.Generator, draws: int = RESAMPLES
) -> LogScoreGain:
    """Compare the log scores of two methods on the same runs, (run,) [nats]."""
    from scipy.stats import bootstrap

    impossible = np.isinf(first), np.isinf(second)
    with np.errstate(invalid="ignore"):  # infinities of both signs have no mean
        gain = np.where(impossible[0] & impossible[1], 0.0, first - second)
        mean = float(np.mean(gain))
    finite = gain[~(impossible[0] | impossible[1])]
    middle = float(finite.mean()) if finite.size else math.nan
    low = high = middle
    if finite.size > 1:
        low, high = bootstrap(
            (finite,),
            np.mean,
            n_resamples=draws,
            batch=BATCH,
            method="percentile",
            random_state=rng,
        ).confidence_interval
    interval = float(low), float(high)
    return LogScoreGain(mean, middle, interval, int(finite.size), Split.of(*impossible))
