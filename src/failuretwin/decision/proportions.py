"""How many of how many: right or wrong, false alarms, coverage of intervals, and how soon.

Shares of runs come with the interval that so few runs allow.
"""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.types import BoolArray, FloatArray, IntArray
from failuretwin.decision.scoring_rules import LogScore, log_score


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Return the Wilson 95 % interval of a share (Wilson, JASA 1927)."""
    from scipy.stats import binomtest

    if trials == 0:
        return 0.0, 1.0
    low, high = binomtest(int(successes), int(trials)).proportion_ci(method="wilson")
    return float(low), float(high)


@dataclass(frozen=True)
class Share:
    """So many (`count`) of so many (`total`)."""

    count: int
    total: int

    @property
    def value(self) -> float:
        """The share; NaN of nothing."""
        return self.count / self.total if self.total else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson 95 % interval; everything where there is nothing."""
        return wilson_interval(self.count, self.total)


# Right or wrong: accuracy, confusion, precision, recall and F1 of each class.

NO_VERDICT = "cannot tell"
"""Class of the runs that got no verdict."""
UNKNOWN, HEALTHY = "unknown", "healthy"


def judged_truth(truth: str, hypotheses: Container[str]) -> str:
    """Return the hypothesis that is right for a run: its truth, or `unknown` where that means it.

    `unknown` stands for every fault that is not named, so where it is among the hypotheses (those
    given a probability) and the true fault is not, it is the right answer. A healthy robot has no
    fault and stays healthy.
    """
    if truth == HEALTHY or truth in hypotheses or UNKNOWN not in hypotheses:
        return truth
    return UNKNOWN


@dataclass(frozen=True)
class ClassScore:
    """Scores of one class; NaN where the ratio has no meaning (0 / 0).

    Attributes:
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
        log_scores: Log score of the same runs.
    """

    classes: tuple[str, ...]
    confusion: IntArray
    log_scores: LogScore

    @property
    def log_score(self) -> float:
        """Mean of minus the log probability of the truth [nats a run]; may be infinite."""
        return self.log_scores.mean

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
        runs, ratios = self.confusion.sum(axis=1).tolist(), class_ratios(self.confusion).tolist()
        rows = zip(self.classes, runs, ratios, strict=True)
        return [ClassScore(name, count, *ratio) for name, count, ratio in rows]


def class_ratios(confusion: IntArray) -> FloatArray:
    """Return precision, recall and F1 of each class, (..., class, 3), as of `ClassScore`.

    Confusion matrices are counts (..., truth, diagnosis).
    """
    hits = np.diagonal(confusion, axis1=-2, axis2=-1)
    true, said = confusion.sum(axis=-1), confusion.sum(axis=-2)
    with np.errstate(invalid="ignore"):  # 0 / 0 has no meaning: NaN
        return np.stack([hits / said, hits / true, 2 * hits / (true + said)], axis=-1)


def score(
    truth: Sequence[str],
    diagnosis: Sequence[str | None],
    posterior: Sequence[Mapping[str, float]],
) -> Scores:
    """Score the diagnosis of each run; no verdict (None) is a class of its own."""
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
        healthy_abstained: Healthy runs without a verdict.
        faulty_abstained: Faulty runs without a verdict, part of `missed`.
    """

    false_alarms: Share
    missed: Share
    healthy_abstained: int
    faulty_abstained: int


def count_alarms(truth: Sequence[str], diagnosis: Sequence[str | None]) -> Alarms:
    """Count false alarms and missed detections, run by run; a diagnosis of None is no verdict."""
    pairs = list(zip(truth, diagnosis, strict=True))
    healthy = [said for true, said in pairs if true == HEALTHY]
    faulty = [said for true, said in pairs if true != HEALTHY]
    false_alarms = sum(said not in (HEALTHY, None) for said in healthy)
    missed = sum(said in (HEALTHY, None) for said in faulty)
    return Alarms(
        false_alarms=Share(false_alarms, len(healthy)),
        missed=Share(missed, len(faulty)),
        healthy_abstained=healthy.count(None),
        faulty_abstained=faulty.count(None),
    )


# Do 90 % intervals hold the truth in 90 % of the runs?


@dataclass(frozen=True)
class IntervalCase:
    """An interval of a quantity of a fault mode, such as ``"onset"``, and the truth it should hold.

    All in the unit of the quantity.
    """

    mode: str
    quantity: str
    low: float
    high: float
    truth: float


@dataclass(frozen=True)
class Coverage:
    """How often the intervals of one quantity hold the truth; ends count as inside.

    Attributes:
        inside: Intervals that hold the truth, of all.
        below: Truths below their interval.
        above: Truths above their interval.
        points: Intervals without width: told or assumed rather than estimated.
    """

    mode: str
    quantity: str
    inside: Share
    below: int
    above: int
    points: int


def coverage_by_mode(cases: Iterable[IntervalCase]) -> list[Coverage]:
    """Return the coverage of each quantity of each fault mode, in order of appearance.

    Give the runs whose fault was diagnosed right: an interval says where the value lies *if* the
    diagnosis holds, and choosing runs by what the data say does not change its coverage.
    """
    groups: dict[tuple[str, str], list[IntervalCase]] = {}
    for case in cases:
        groups.setdefault((case.mode, case.quantity), []).append(case)
    coverage = []
    for key, group in groups.items():
        below = sum(case.truth < case.low for case in group)
        above = sum(case.truth > case.high for case in group)
        points = sum(case.low == case.high for case in group)
        inside = Share(len(group) - below - above, len(group))
        coverage.append(Coverage(*key, inside, below, above, points))
    return coverage


# How soon after its onset a fault is noticed and named, at a stated rate of false alarms.

ISOLATED = 0.5
"""A fault is isolated once it holds more than this share of the probability of any fault."""


@dataclass(frozen=True)
class CensoredDelays:
    """From onset to an event in the faulty runs, in their order.

    Attributes:
        delay: (faulty run,) [s]; infinite: no event before the run ended; NaN: an alarm came before
            the onset, which is a false alarm and no delay.
        followed: From onset to the end of the run, (faulty run,) [s]: a delay that is infinite is
            only known to be longer than this.
    """

    delay: FloatArray
    followed: FloatArray

    @property
    def never(self) -> Share:
        """Runs that ended without the event, of those without an early alarm."""
        return Share(int(np.isinf(self.delay).sum()), int((~np.isnan(self.delay)).sum()))

    @property
    def median(self) -> float:
        """Where the product-limit curve falls to one half (Kaplan & Meier, JASA 1958) [s].

        Infinite where it never does; NaN where there is no run.
        """
        from scipy.stats import CensoredData, ecdf

        ended = np.isinf(self.delay)
        if self.never.count == self.never.total:
            return float("inf") if self.never.total else float("nan")
        data = CensoredData(self.delay[np.isfinite(self.delay)], right=self.followed[ended])
        curve = ecdf(data).sf
        low = curve.probabilities <= 0.5 + 1e-12
        return float(curve.quantiles[low.argmax()]) if low.any() else float("inf")


@dataclass(frozen=True)
class Delays:
    """How soon faults are noticed (`detection`) and the right one is in front (`isolation`).

    Attributes:
        threshold: An alarm is a probability of any fault above this.
        false_alarms: Healthy runs that alarm with it, of all healthy runs.
        early: Faulty runs with an alarm before the onset, of all faulty runs.
    """

    threshold: float
    false_alarms: Share
    early: Share
    detection: CensoredDelays
    isolation: CensoredDelays


def alarm_threshold(healthy: FloatArray, share: float) -> float:
    """Return the lowest threshold that at most `share` of the healthy runs ever exceed.

    `healthy` is the probability of any fault, (healthy run, time), NaN where there is no answer
    yet; `share` is the stated rate of false alarms [runs with one a run], 0 <= share < 1.

    Raises:
        InputError: If there are no healthy runs or the share is not one.
    """
    if not 0.0 <= share < 1.0:
        raise InputError(f"the rate of false alarms is {share:g}, expected 0 <= rate < 1.")
    if healthy.size == 0:
        raise InputError("there are no healthy runs to set the threshold by.")
    peaks = np.sort(np.max(np.where(np.isnan(healthy), 0.0, healthy), axis=1))[::-1]
    allowed = int(share * len(peaks) + 1e-9)  # 0.29 of 100 is 28.999...
    return float(peaks[allowed])


def delays_after_onset(
    time: FloatArray, fault: FloatArray, true_fault: FloatArray, onset: FloatArray, share: float
) -> Delays:
    """Return the delays at the threshold that keeps false alarms at `share` of the healthy runs.

    Args:
        time: Instants of the answers, (time,) [s].
        fault: Probability of any fault given all data so far, (run, time); NaN: no answer, as
            after the end of the run.
        true_fault: Probability of the true hypothesis, (run, time); not read in healthy runs.
        onset: When the fault began, (run,) [s]; NaN: healthy; 0: before the run.
        share: Stated rate of false alarms [runs with one a run], 0 <= share < 1.

    Raises:
        InputError: If shapes do not fit, or no healthy or no faulty run is there.
    """
    if not fault.shape == true_fault.shape == (len(onset), len(time)):
        raise InputError(
            f"`fault` has shape {fault.shape}, `true_fault` {true_fault.shape}; expected both "
            f"(run, time) = {(len(onset), len(time))}."
        )
    healthy = np.isnan(onset)
    if healthy.all():
        raise InputError("there are no faulty runs to measure delays on.")
    threshold = alarm_threshold(fault[healthy], share)
    alarm = fault > threshold  # False where NaN
    named = alarm & (true_fault > ISOLATED * fault)
    faulty, began = ~healthy, onset[~healthy]
    early = np.any(alarm[faulty] & (time < began[:, None]), axis=1)
    answered = np.where(np.isnan(fault[faulty]), -np.inf, time).max(axis=1)
    followed = np.maximum(answered - began, 0.0)
    first = (_first_after(time, event[faulty], began, early) for event in (alarm, named))
    return Delays(
        threshold,
        Share(int(alarm[healthy].any(axis=1).sum()), int(healthy.sum())),
        Share(int(early.sum()), len(early)),
        *(CensoredDelays(delay, followed) for delay in first),
    )


def _first_after(
    time: FloatArray, event: BoolArray, onset: FloatArray, early: BoolArray
) -> FloatArray:
    """Return the time from each onset to the first event at or after it [s]."""
    at = np.where(event & (time >= onset[:, None]), time, np.inf).min(axis=1)
    return np.where(early, np.nan, at - onset)
