"""How good diagnoses are where the truth is known, and which of two methods is better.

`evaluate` and `compare` take diagnoses as they come from a diagnoser or a file and return frozen
values; nothing is printed.
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
from failuretwin.data_knowledge.read import RunsLike, as_runs
from failuretwin.decision import proportions, scoring_rules
from failuretwin.decision.results import Record, Results, read_results, some_names

if TYPE_CHECKING:
    import xarray as xr

Given = Results | Iterable[Diagnosis | Record] | str | Path

# What was true of the runs, where a run set or a log knows it.


@dataclass(frozen=True)
class RunTruth:
    """The truth of one run; NaN where it is not known or does not apply.

    Attributes:
        fault: True hypothesis.
        onset: When the fault began [s]; 0: before the run.
        magnitude: Size of the fault in the unit of its mode.
    """

    fault: str
    onset: float = np.nan
    magnitude: float = np.nan


@dataclass(frozen=True)
class Truths:
    """The truth of the runs of a run set, by their names; `name` is what errors call the set."""

    name: str
    by_run: Mapping[str, RunTruth]

    @classmethod
    def of(cls, runs: xr.Dataset, name: str = "the run set") -> Truths:
        """Return the truth of every run of a run set.

        Raises:
            InputError: If it knows no truth.
        """
        faults = truth_of(runs)
        if faults is None:
            raise InputError(
                f"{name}: has no variable `fault`, so it does not know the truth. If the names of "
                "raw sessions end in _label_K, add --published-labels."
            )
        unknown = np.full(len(faults), np.nan)
        columns = (runs[n].values if n in runs else unknown for n in ("onset", "magnitude"))
        values = zip(faults, *(map(float, column) for column in columns), strict=True)
        truths = (RunTruth(*value) for value in values)
        return cls(name, dict(zip(map(str, runs["run"].values), truths, strict=True)))

    def __getitem__(self, run: str) -> RunTruth:
        if run not in self.by_run:
            raise InputError(f"{self.name}: holds no run {run!r} of the results. {self._why(run)}")
        return self.by_run[run]

    def _why(self, run: str) -> str:
        name, numbered, _ = run.rpartition("#")
        if numbered and name in self.by_run:
            return (
                f"It holds {name!r}; diagnose numbers runs of the same name, so it was given an "
                "input twice, or several whose runs are called alike. Diagnose and evaluate each "
                "input once, by itself."
            )
        return "Expected the runs that were diagnosed."


# Diagnoses beside what was true.


@dataclass(frozen=True)
class Judged:
    """Diagnoses of the runs whose truth is known, beside it.

    Attributes:
        diagnoses: One a run.
        truth: What is right for each: its truth, or `unknown` where that means it.
        as_unknown: How many runs are judged as `unknown`, by their truth.
        protocol: How much real data the method has seen; letters joined by a slash where they
            differ.
    """

    diagnoses: tuple[Diagnosis | Record, ...]
    truth: tuple[str, ...]
    as_unknown: Mapping[str, int]
    protocol: str

    @classmethod
    def of(cls, results: Given, truths: Truths | None = None) -> Judged:
        """Judge diagnoses by these truths, or by those that they name themselves.

        Raises:
            InputError: If the truth of a run is not among `truths`.
        """
        given = as_results(results).diagnoses
        known = [d.truth if truths is None else truths[d.run].fault for d in given]
        pairs = [(d, true) for d, true in zip(given, known, strict=True) if true]
        truth = tuple(proportions.judged_truth(true, d.posterior) for d, true in pairs)
        return cls(
            diagnoses=tuple(d for d, _ in pairs),
            truth=truth,
            as_unknown=Counter(t for (_, t), right in zip(pairs, truth, strict=True) if right != t),
            protocol="/".join(sorted({d.protocol or "?" for d in given})),
        )

    @property
    def verdicts(self) -> list[str | None]:
        """Verdict on each run; None where there is none."""
        return [d.diagnosis for d in self.diagnoses]

    @property
    def right(self) -> BoolArray:
        """Whether each run is diagnosed right, (run,)."""
        pairs = zip(self.verdicts, self.truth, strict=True)
        return np.array([verdict == true for verdict, true in pairs], dtype=np.bool_)

    @property
    def posteriors(self) -> list[Mapping[str, float]]:
        """Probabilities of each run."""
        return [d.posterior for d in self.diagnoses]

    @cached_property
    def scores(self) -> proportions.Scores:
        """Right, wrong and the log score; of one run at least."""
        return proportions.score(self.truth, self.verdicts, self.posteriors)


def as_results(given: Given, name: str = "the results") -> Results:
    """Return diagnoses with a name; those that have one keep it, a path is read."""
    if isinstance(given, str | Path):
        return read_results(Path(given))
    return given if isinstance(given, Results) else Results(name, tuple(given))


def score_line(judged: Judged) -> str:
    """Return the accuracy with its protocol, number of runs and interval; empty if unknown."""
    if not judged.diagnoses:
        return ""
    scores = judged.scores
    low, high = scores.interval
    return (
        f"{scores.right} of {counted(scores.runs, 'run')} right: accuracy "
        f"{100 * scores.accuracy:.1f} % (95 % interval {100 * low:.1f} to {100 * high:.1f} %), "
        f"protocol {judged.protocol}, log score {_log_score_text(scores.log_scores)}"
    )


def _log_score_text(surprise: scoring_rules.LogScore) -> str:
    """Return the log score in words; says so where a truth was ruled out altogether."""
    text = f"{surprise.mean:.3f} nats a run"
    if not surprise.impossible:
        return text
    rest = surprise.nats.size - surprise.impossible
    if not rest:
        return f"{text} (the truth was given no probability in any run)"
    return (
        f"{text} (of {surprise.impossible} runs the truth was given no probability; the other "
        f"{rest}: {surprise.mean_of_rest:.3f})"
    )


def as_unknown_line(judged: Judged) -> str:
    """Return which truths are judged as `unknown`, in words; empty if none is."""
    found = judged.as_unknown
    if not found:
        return ""
    truths = [f"{truth} ({counted(count, 'run')})" for truth, count in found.items()]
    return f"judged as unknown, since not among the hypotheses: {', '.join(truths)}"


# All scores of one method.


@dataclass(frozen=True)
class Calibration:
    """Calibration of the verdict's probability, in bins of equal width and of about equal counts.

    By chance alone, a perfectly calibrated method would show these errors in `equal`, (draw,).
    """

    equal: scoring_rules.Reliability
    adaptive: scoring_rules.Reliability
    by_chance: FloatArray


@dataclass(frozen=True)
class Evaluation:
    """Scores of diagnoses whose truth is known.

    Attributes:
        judged: The diagnoses beside their truth.
        alarms: False alarms and missed detections.
        brier: Mean Brier score, 0 to 2.
        calibration: Over runs with a verdict; None if there are none.
        coverage: Of 90 % intervals, by fault mode; empty where the true values are not known.
    """

    judged: Judged
    alarms: proportions.Alarms
    brier: float
    calibration: Calibration | None
    coverage: Sequence[proportions.Coverage]

    @property
    def scores(self) -> proportions.Scores:
        """Right, wrong and the log score."""
        return self.judged.scores

    @property
    def runs_and_protocol(self) -> str:
        """What was judged, in words."""
        return f"{counted(self.scores.runs, 'run')}, protocol {self.judged.protocol}"


def evaluate(
    results: Given,
    truth: RunsLike | Truths | None = None,
    rng: np.random.Generator | None = None,
) -> Evaluation:
    """Return all scores of the diagnoses whose truth is known.

    Args:
        results: Diagnoses, as a diagnoser returns them or `read_results` reads them, or the path
            of such a file.
        truth: Run set that knows the truth, or where it is; None: what the diagnoses say. Without
            it nothing is known of the coverage of intervals.
        rng: Source of chance, for the calibration error that chance alone would show; None: seed 0.

    Raises:
        InputError: If no truth is known, a run is not in `truth`, or is given twice.
    """
    given, truths = as_results(results), _truths(truth)
    judged = Judged.of(given, truths)
    if not judged.diagnoses:
        raise _no_truth(given.name)
    intervals = () if truths is None else _intervals(judged, truths)
    return Evaluation(
        judged=judged,
        alarms=proportions.count_alarms(judged.truth, judged.verdicts),
        brier=float(scoring_rules.brier_score(judged.truth, judged.posteriors).mean()),
        calibration=_calibration(judged, rng or np.random.default_rng(0)),
        coverage=proportions.coverage_by_mode(intervals),
    )


def _no_truth(name: str) -> InputError:
    return InputError(
        f"{name}: no run says what was true. Give a run set that does with --truth RUNS."
    )


def _truths(given: RunsLike | Truths | None) -> Truths | None:
    if given is None or isinstance(given, Truths):
        return given
    return Truths.of(as_runs(given))


def _calibration(judged: Judged, rng: np.random.Generator) -> Calibration | None:
    pairs = zip(judged.verdicts, judged.posteriors, strict=True)
    decided = np.array([verdict is not None for verdict in judged.verdicts])
    if not decided.any():
        return None
    chance = np.array([posterior[verdict] for verdict, posterior in pairs if verdict is not None])
    stated, right = np.minimum(chance, 1.0), judged.right[decided]  # sums may round above 1
    equal = scoring_rules.equal_edges()
    return Calibration(
        equal=scoring_rules.reliability(stated, right, equal),
        adaptive=scoring_rules.reliability(stated, right, scoring_rules.adaptive_edges(stated)),
        by_chance=scoring_rules.calibrated_error(stated, equal, rng),
    )


def _intervals(judged: Judged, truths: Truths) -> Iterator[proportions.IntervalCase]:
    """Yield the intervals of runs whose fault was found, with the values that they should hold."""
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
                yield proportions.IntervalCase(mode, quantity, *interval, true)


# Two methods on the same runs: which is better?


@dataclass(frozen=True)
class Comparison:
    """What two methods, by name and protocol, say of the same runs.

    Attributes:
        split: Which runs they got right.
        gain: Nats a run that the second saves.
        as_unknown: Runs that the first and the second judge as `unknown`, since the truth is not
            among their own hypotheses.
    """

    first: str
    second: str
    split: scoring_rules.McNemar
    gain: scoring_rules.LogScoreGain
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
    """Compare two methods run by run, matched by run name, each by its own hypotheses.

    Args:
        first: Diagnoses, with the truth of those runs that are to count.
        second: Others of the same runs; where they lack the truth, that of the first counts.
        truth: Run set that knows the truth; None: what the diagnoses say.
        rng: Source of chance, for the bootstrap; None: seed 0.

    Raises:
        InputError: If the runs or their truths differ, or no truth is known.
    """
    one, other = as_results(first, "the first results"), as_results(second, "the second results")
    matched = _matched(one, other)
    truths = _truths(truth) or _own_truth(one, other.name, matched)
    counted = [d for d in one.diagnoses if truth is not None or d.truth]
    ours, theirs = (Judged.of(ds, truths) for ds in (counted, [matched[d.run] for d in counted]))
    return Comparison(
        first=_named(one),
        second=_named(other),
        split=scoring_rules.mcnemar(ours.right, theirs.right),
        gain=scoring_rules.log_score_gain(
            ours.scores.log_scores.nats,
            theirs.scores.log_scores.nats,
            rng or np.random.default_rng(0),
        ),
        as_unknown=(sum(ours.as_unknown.values()), sum(theirs.as_unknown.values())),
    )


def _named(results: Results) -> str:
    return f"{results.name} (protocol {Judged.of(results).protocol})"


def _matched(first: Results, second: Results) -> dict[str, Diagnosis | Record]:
    """Return the second diagnoses by run name, which must be those of the first."""
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
    """Return what the first diagnoses say was true, which the second must not gainsay."""
    known = {d.run: RunTruth(d.truth) for d in first.diagnoses if d.truth}
    if not known:
        raise _no_truth(first.name)
    for run, true in known.items():
        said = matched[run].truth
        if said and said != true.fault:
            raise InputError(
                f"{second}: run {run!r} is {said} there, but {true.fault} in {first.name}. Give "
                "the truth of both with --truth RUNS."
            )
    return Truths(first.name, known)
