"""Scores of diagnoses whose truth is known, and comparison of two methods.

`evaluate` and `compare` take diagnoses or a results file and return frozen values.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from failuretwin.core.errors import InputError, counted
from failuretwin.core.hypothesis import Diagnosis, Hypothesis
from failuretwin.core.runs import truth_of
from failuretwin.data_knowledge.readers.read import RunsLike, as_runs
from failuretwin.decision.results import Record, Results, read_results, some_names
from failuretwin.decision.scoring import (
    IntervalCase,
    LogScoreGain,
    Scores,
    Split,
    judged_truth,
    log_score_gain,
)

if TYPE_CHECKING:
    import xarray as xr

Given = Results | Iterable[Diagnosis | Record] | str | Path


class RunTruth(NamedTuple):
    """True hypothesis of a run, onset [s] (0: before the run) and size in the unit of its mode.

    Empty or NaN where unknown or not applicable.
    """

    fault: str
    onset: float = np.nan
    magnitude: float = np.nan


@dataclass(frozen=True)
class Truths:
    """Truth of each run by its name; `name` identifies the source in errors."""

    name: str
    by_run: Mapping[str, RunTruth]

    @classmethod
    def of(cls, runs: xr.Dataset, name: str = "the run set") -> Truths:
        """Return the truth of every run of a run set.

        Raises:
            InputError: If the run set has no truth.
        """
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

    def told(self, diagnoses: Iterable[Diagnosis | Record]) -> list[Diagnosis | Record]:
        """Return diagnoses with the true faults.

        Raises:
            InputError: If the truth of a run is missing.
        """
        return [replace(d, truth=self[d.run].fault or None) for d in diagnoses]

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


def _truths(given: RunsLike | Truths | None, results: Results) -> Truths:
    """Return the truth of runs; None: the truth that results carry."""
    if given is None:
        return Truths(results.name, {d.run: RunTruth(d.truth or "") for d in results.diagnoses})
    return given if isinstance(given, Truths) else Truths.of(as_runs(given))


def as_results(given: Given, name: str = "the results") -> Results:
    """Return diagnoses as `Results`; a path is read."""
    if isinstance(given, str | Path):
        return read_results(Path(given))
    return given if isinstance(given, Results) else Results(name, tuple(given))


# Scores in words.


def is_right(diagnosis: Diagnosis | Record) -> bool | None:
    """Return whether a verdict is correct; None without a verdict or a known truth."""
    if diagnosis.truth is None or diagnosis.diagnosis is None:
        return None
    return diagnosis.diagnosis == judged_truth(diagnosis.truth, diagnosis.posterior)


def score_line(scores: Scores) -> str:
    """Return accuracy, interval, protocol and log score in one line; empty if there is no truth."""
    if not scores.runs:
        return ""
    low, high = scores.interval
    return (
        f"{scores.right} of {counted(scores.runs, 'run')} right: accuracy "
        f"{100 * scores.accuracy:.1f} % (95 % interval {100 * low:.1f} to {100 * high:.1f} "
        f"%), protocol {scores.protocol}, log score {_log_score_text(scores)}"
    )


def _log_score_text(scores: Scores) -> str:
    text, rest = f"{scores.log_score:.3f} nats a run", scores.nats[np.isfinite(scores.nats)]
    if rest.size == scores.runs:
        return text
    if not rest.size:
        return f"{text} (the truth was given no probability in any run)"
    return (
        f"{text} (of {scores.runs - rest.size} runs the truth was given no probability; the other "
        f"{rest.size}: {rest.mean():.3f})"
    )


def as_unknown_line(scores: Scores) -> str:
    """Return which truths are judged as `unknown`; empty if none is."""
    if not scores.as_unknown:
        return ""
    truths = [f"{truth} ({counted(count, 'run')})" for truth, count in scores.as_unknown.items()]
    return f"judged as unknown, since not among the hypotheses: {', '.join(truths)}"


# Scores of one method.


def evaluate(results: Given, truth: RunsLike | Truths | None = None) -> Scores:
    """Return all scores of the diagnoses whose truth is known.

    Args:
        results: Diagnoses, results, or the path of a results file.
        truth: Run set with the truth, or its path; None: the truth in the diagnoses, without
            coverage of intervals.

    Raises:
        InputError: If no truth is known, or a run is missing from `truth` or given twice.
    """
    given = as_results(results)
    truths = _truths(truth, given)
    told = truths.told(given.diagnoses)
    cases = [case for d in told if is_right(d) for case in _cases(d, truths[d.run])]
    return _judged(told, given.name, cases)


def _judged(
    diagnoses: Iterable[Diagnosis | Record], name: str, cases: Sequence[IntervalCase] = ()
) -> Scores:
    """Return scores of diagnoses; at least one must carry its truth."""
    scores = Scores.of(diagnoses, cases)
    if not scores.runs:
        raise InputError(
            f"{name}: no run says what was true. Give a run set that does with --truth RUNS."
        )
    return scores


def _cases(diagnosis: Diagnosis | Record, truth: RunTruth) -> list[IntervalCase]:
    """Return the intervals of a correctly diagnosed run with their true values."""
    hypothesis = Hypothesis.parse(str(diagnosis.diagnosis))
    mode = "+".join(f.mode for f in hypothesis.faults) or str(hypothesis)  # `unknown` has none
    rows = (
        ("onset", diagnosis.onset_90, truth.onset),
        ("magnitude", diagnosis.magnitude_90, truth.magnitude),
    )
    return [
        IntervalCase(mode, quantity, *interval, true)
        for quantity, interval, true in rows
        if interval is not None and np.isfinite(true)
    ]


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
        runs: Number of runs compared.
    """

    first: str
    second: str
    split: Split
    gain: LogScoreGain
    as_unknown: tuple[int, int]
    runs: int


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
    truths = _truths(truth, one)
    if truth is None:
        _check_agreement(truths, matched)
    ours = _judged(truths.told(one.diagnoses), one.name)
    theirs = _judged(truths.told(matched.diagnoses), other.name)
    return Comparison(
        first=f"{one.name} (protocol {ours.protocol})",
        second=f"{other.name} (protocol {theirs.protocol})",
        split=Split.of(ours.hits, theirs.hits),
        gain=log_score_gain(ours.nats, theirs.nats, rng or np.random.default_rng(0)),
        as_unknown=(sum(ours.as_unknown.values()), sum(theirs.as_unknown.values())),
        runs=ours.runs,
    )


def _matched(first: Results, second: Results) -> Results:
    """Return the second results in the order of the first; both must have the same runs."""
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
    return Results(second.name, [theirs[run] for run in ours])


def _check_agreement(truths: Truths, results: Results) -> None:
    """Raise InputError if results carry another truth."""
    for d in results.diagnoses:
        true = truths[d.run].fault
        if d.truth and true and d.truth != true:
            raise InputError(
                f"{results.name}: run {d.run!r} is {d.truth} there, but {true} in {truths.name}. "
                "Give the truth of both with --truth RUNS."
            )
