"""Scores of diagnoses whose truth is known, and comparison of two methods.

`evaluate` and `compare` take diagnoses or a results file and return frozen values.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.core.errors import InputError, counted
from failuretwin.core.hypothesis import Diagnosis, Hypothesis
from failuretwin.core.runs import truth_of
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.data_knowledge.readers.read import RunsLike, as_runs
from failuretwin.decision import scoring
from failuretwin.decision.results import Record, Results, read_results, some_names

if TYPE_CHECKING:
    import xarray as xr

Given = Results | Iterable[Diagnosis | Record] | str | Path

# Truth of the runs.


@dataclass(frozen=True)
class RunTruth:
    """Truth of one run; NaN where unknown or not applicable.

    Attributes:
        fault: True hypothesis.
        onset: Start of the fault [s]; 0: before the run.
        magnitude: Size of the fault in the unit of its mode.
    """

    fault: str
    onset: float = np.nan
    magnitude: float = np.nan


@dataclass(frozen=True)
class Truths:
    """Truth of each run by its name; `name` identifies the run set in errors."""

    name: str
    by_run: Mapping[str, RunTruth]

    @classmethod
    def of(cls, runs: xr.Dataset, name: str = "the run set") -> Truths:
        """Return the truth of every run of a run set."""
        faults = truth_of(runs)
        if faults is None:
            raise InputError(
                f"{name}: has no variable `fault`, so it does not know the truth. If the names of "
                "raw sessions end in _label_K, add --published-labels."
            )
        unknown = np.full(len(faults), np.nan)
        columns = (runs[n].values if n in runs else unknown for n in ("onset", "magnitude"))
        truths = map(RunTruth, faults, *(map(float, column) for column in columns))
        return cls(name, dict(zip(map(str, runs["run"].values), truths, strict=True)))

    def __getitem__(self, run: str) -> RunTruth:
        if run in self.by_run:
            return self.by_run[run]
        why = "Expected the runs that were diagnosed."
        name, numbered, _ = run.rpartition("#")
        if numbered and name in self.by_run:
            why = (
                f"It holds {name!r}; diagnose numbers runs of the same name, so an input was given "
                "twice, or several inputs have a run of this name. Diagnose and evaluate each "
                "input once, by itself."
            )
        raise InputError(f"{self.name}: holds no run {run!r} of the results. {why}")


# Diagnoses with their truth.


def is_right(diagnosis: Diagnosis) -> bool | None:
    """Return whether a verdict is correct; None without a verdict or a known truth."""
    if diagnosis.truth is None or diagnosis.diagnosis is None:
        return None
    truth = scoring.judged_truth(diagnosis.truth, diagnosis.posterior)
    return truth == diagnosis.diagnosis


@dataclass(frozen=True)
class Judged:
    """Diagnoses of the runs whose truth is known.

    Attributes:
        diagnoses: One per run.
        truth: Correct answer for each run; see `judged_truth`.
        as_unknown: Number of runs whose correct answer is `unknown`, by true fault.
        protocol: Protocol letters of all diagnoses, joined by a slash.
    """

    diagnoses: tuple[Diagnosis | Record, ...]
    truth: tuple[str, ...]
    as_unknown: Mapping[str, int]
    protocol: str

    @classmethod
    def of(cls, results: Given, truths: Truths | None = None) -> Judged:
        """Judge diagnoses by `truths`; None: by the truth that they carry."""
        given = as_results(results).diagnoses
        known = [d.truth if truths is None else truths[d.run].fault for d in given]
        pairs = [(d, true) for d, true in zip(given, known, strict=True) if true]
        truth = tuple(scoring.judged_truth(true, d.posterior) for d, true in pairs)
        return cls(
            diagnoses=tuple(d for d, _ in pairs),
            truth=truth,
            as_unknown=Counter(t for (_, t), right in zip(pairs, truth, strict=True) if right != t),
            protocol="/".join(sorted({d.protocol or "?" for d in given})),
        )

    @property
    def verdicts(self) -> list[str | None]:
        """Verdict on each run; None: no verdict."""
        return [d.diagnosis for d in self.diagnoses]

    @property
    def right(self) -> BoolArray:
        """Whether each run is diagnosed correctly, (run,)."""
        pairs = zip(self.verdicts, self.truth, strict=True)
        return np.array([verdict == true for verdict, true in pairs], dtype=np.bool_)

    @property
    def posteriors(self) -> list[Mapping[str, float]]:
        """Probabilities of each run."""
        return [d.posterior for d in self.diagnoses]

    @cached_property
    def scores(self) -> scoring.Scores:
        """Accuracy and log score; needs at least one run."""
        return scoring.score_diagnoses(self.truth, self.verdicts, self.posteriors)


def as_results(given: Given, name: str = "the results") -> Results:
    """Return diagnoses as `Results`; a path is read."""
    if isinstance(given, str | Path):
        return read_results(Path(given))
    return given if isinstance(given, Results) else Results(name, tuple(given))


def score_line(judged: Judged) -> str:
    """Return accuracy, interval, protocol and log score in one line; empty if there is no truth."""
    if not judged.diagnoses:
        return ""
    scores = judged.scores
    low, high = scores.interval
    return (
        f"{scores.right} of {counted(scores.runs, 'run')} right: accuracy "
        f"{100 * scores.accuracy:.1f} % (95 % interval {100 * low:.1f} to {100 * high:.1f} %), "
        f"protocol {judged.protocol}, log score {_log_score_text(scores)}"
    )


def _log_score_text(scores: scoring.Scores) -> str:
    text, rest = f"{scores.log_score:.3f} nats a run", scores.nats[np.isfinite(scores.nats)]
    if rest.size == scores.runs:
        return text
    if not rest.size:
        return f"{text} (the truth was given no probability in any run)"
    return (
        f"{text} (of {scores.runs - rest.size} runs the truth was given no probability; the other "
        f"{rest.size}: {rest.mean():.3f})"
    )


def as_unknown_line(judged: Judged) -> str:
    """Return which truths are judged as `unknown`; empty if none is."""
    if not judged.as_unknown:
        return ""
    truths = [f"{truth} ({counted(count, 'run')})" for truth, count in judged.as_unknown.items()]
    return f"judged as unknown, since not among the hypotheses: {', '.join(truths)}"


# Scores of one method.


@dataclass(frozen=True)
class Calibration:
    """Reliability of the verdict's probability, in equal and in adaptive bins.

    `by_chance` holds the errors of a perfectly calibrated method in equal bins, (draw,).
    """

    equal: scoring.Reliability
    adaptive: scoring.Reliability
    by_chance: FloatArray


@dataclass(frozen=True)
class Evaluation:
    """Scores of diagnoses whose truth is known.

    Attributes:
        judged: Diagnoses with their truth.
        alarms: False alarms and missed detections.
        brier: Mean Brier score, 0 to 2.
        calibration: Of runs with a verdict; None if there are none.
        coverage: Coverage of 90 % intervals by fault mode; empty where true values are unknown.
    """

    judged: Judged
    alarms: scoring.Alarms
    brier: float
    calibration: Calibration | None
    coverage: Sequence[scoring.Coverage]

    @property
    def scores(self) -> scoring.Scores:
        """Accuracy and log score."""
        return self.judged.scores

    @property
    def runs_and_protocol(self) -> str:
        """Number of runs and protocol, as text."""
        return f"{counted(self.scores.runs, 'run')}, protocol {self.judged.protocol}"


def evaluate(
    results: Given,
    truth: RunsLike | Truths | None = None,
    rng: np.random.Generator | None = None,
) -> Evaluation:
    """Return all scores of the diagnoses whose truth is known.

    Args:
        results: Diagnoses, results, or the path of a results file.
        truth: Run set with the truth, or its path; None: the truth in the diagnoses, without
            coverage of intervals.
        rng: Random generator for the calibration error by chance; None: seed 0.

    Raises:
        InputError: If no truth is known, or a run is missing from `truth` or given twice.
    """
    given, truths = as_results(results), _truths(truth)
    judged = Judged.of(given, truths)
    if not judged.diagnoses:
        raise _no_truth(given.name)
    intervals = () if truths is None else _intervals(judged, truths)
    return Evaluation(
        judged=judged,
        alarms=scoring.count_alarms(judged.truth, judged.verdicts),
        brier=float(scoring.brier_score(judged.truth, judged.posteriors).mean()),
        calibration=_calibration(judged, rng or np.random.default_rng(0)),
        coverage=scoring.coverage_by_mode(intervals),
    )


def _no_truth(name: str) -> InputError:
    return InputError(
        f"{name}: no run says what was true. Give a run set that does with --truth RUNS."
    )


def _truths(given: RunsLike | Truths | None) -> Truths | None:
    return given if given is None or isinstance(given, Truths) else Truths.of(as_runs(given))


def _calibration(judged: Judged, rng: np.random.Generator) -> Calibration | None:
    decided = np.array([verdict is not None for verdict in judged.verdicts])
    if not decided.any():
        return None
    pairs = zip(judged.verdicts, judged.posteriors, strict=True)
    stated = np.array([posterior[verdict] for verdict, posterior in pairs if verdict is not None])
    stated, right = np.minimum(stated, 1.0), judged.right[decided]  # sums may round above 1
    return Calibration(
        equal=scoring.reliability(stated, right),
        adaptive=scoring.reliability(stated, right, scoring.adaptive_edges(stated)),
        by_chance=scoring.calibrated_error(stated, rng),
    )


def _intervals(judged: Judged, truths: Truths) -> Iterator[scoring.IntervalCase]:
    """Yield the intervals of correctly diagnosed runs with their true values."""
    for diagnosis, right in zip(judged.diagnoses, judged.truth, strict=True):
        if diagnosis.diagnosis != right:
            continue
        known, hypothesis = truths[diagnosis.run], Hypothesis.parse(right)
        mode = "+".join(f.mode for f in hypothesis.faults) or str(hypothesis)  # `unknown` has none
        for quantity, interval, true in (
            ("onset", diagnosis.onset_90, known.onset),
            ("magnitude", diagnosis.magnitude_90, known.magnitude),
        ):
            if interval is not None and np.isfinite(true):
                yield scoring.IntervalCase(mode, quantity, *interval, true)


# Two methods on the same runs.


@dataclass(frozen=True)
class Comparison:
    """Comparison of two methods on the same runs.

    Attributes:
        first: Name and protocol of the first method.
        second: Name and protocol of the second method.
        split: Runs that either method got right.
        gain: Log score saved by the second method [nats per run].
        as_unknown: Number of runs that the first and the second judge as `unknown`.
    """

    first: str
    second: str
    split: scoring.McNemar
    gain: scoring.LogScoreGain
    as_unknown: tuple[int, int]

    @property
    def runs(self) -> int:
        """Number of runs compared."""
        split = self.split
        return split.both + split.first_only + split.second_only + split.neither


def compare(
    first: Given,
    second: Given,
    truth: RunsLike | Truths | None = None,
    rng: np.random.Generator | None = None,
) -> Comparison:
    """Compare two methods run by run, matched by run name; each is judged by its own hypotheses.

    Args:
        first: Diagnoses; without `truth`, their own truth counts.
        second: Diagnoses of the same runs.
        truth: Run set with the truth; None: the truth in the diagnoses.
        rng: Random generator for the bootstrap; None: seed 0.

    Raises:
        InputError: If the runs or their truths differ, or no truth is known.
    """
    one, other = as_results(first, "the first results"), as_results(second, "the second results")
    matched = _matched(one, other)
    truths = _truths(truth) or _own_truth(one, other.name, matched)
    scored = [d for d in one.diagnoses if d.run in truths.by_run or truth is not None]
    ours, theirs = (Judged.of(ds, truths) for ds in (scored, [matched[d.run] for d in scored]))
    return Comparison(
        first=f"{one.name} (protocol {Judged.of(one).protocol})",
        second=f"{other.name} (protocol {Judged.of(other).protocol})",
        split=scoring.mcnemar(ours.right, theirs.right),
        gain=scoring.log_score_gain(
            ours.scores.nats,
            theirs.scores.nats,
            rng or np.random.default_rng(0),
        ),
        as_unknown=(sum(ours.as_unknown.values()), sum(theirs.as_unknown.values())),
    )


def _matched(first: Results, second: Results) -> dict[str, Diagnosis | Record]:
    """Return the second diagnoses by run name; both must have the same runs."""
    ours, theirs = ({d.run: d for d in results.diagnoses} for results in (first, second))
    for has, lacks, missing in (
        (first, second, [run for run in ours if run not in theirs]),
        (second, first, [run for run in theirs if run not in ours]),
    ):
        if missing:
            raise InputError(
                f"{lacks.name}: lacks {len(missing)} runs of {has.name} ({some_names(missing)}). "
                "Two methods are compared on the same runs: diagnose the same inputs with both."
            )
    return theirs


def _own_truth(first: Results, second: str, matched: Mapping[str, Diagnosis | Record]) -> Truths:
    """Return the truth in the first diagnoses; the second must not contradict it."""
    known = {d.run: RunTruth(d.truth) for d in first.diagnoses if d.truth}
    if not known:
        raise _no_truth(first.name)
    for run, true in known.items():
        other = matched[run].truth
        if other and other != true.fault:
            raise InputError(
                f"{second}: run {run!r} is {other} there, but {true.fault} in {first.name}. Give "
                "the truth of both with --truth RUNS."
            )
    return Truths(first.name, known)
