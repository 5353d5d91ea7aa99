"""All that can be said of stored diagnoses where the truth is known."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.runs import truth_of
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.data_knowledge.read import ReadOptions, read_runs
from failuretwin.decision.metrics import (
    Alarms,
    Coverage,
    IntervalCase,
    LogScoreGain,
    McNemar,
    Reliability,
    Scores,
    adaptive_edges,
    brier_score,
    calibrated_error,
    count_alarms,
    coverage_by_mode,
    equal_edges,
    log_score,
    log_score_gain,
    mcnemar,
    reliability,
)
from failuretwin.decision.results import (
    Record,
    check_each_once,
    judged_records,
    protocol_of,
    score_records,
    some_names,
    truths_as_unknown,
)

if TYPE_CHECKING:
    import xarray as xr

# What was true of the runs of a result file, where a run set or a log knows it.


@dataclass(frozen=True)
class RunTruth:
    """The truth of one run; NaN where it is not known or does not apply.

    Attributes:
        fault: True hypothesis.
        onset: When the fault began [s]; 0: before the run.
        magnitude: Size of the fault in the unit of its mode.
    """

    fault: str
    onset: float
    magnitude: float


def read_truths(path: Path, robot: str, published_labels: bool) -> dict[str, RunTruth]:
    """Return the truth of every run of a run set or of raw sessions, by its name.

    Args:
        path: Run set, or whatever else `diagnose` reads.
        robot: Name or profile of the robot that the logs are of.
        published_labels: Take the truth of raw sessions from their folder names.

    Raises:
        InputError: If it cannot be read or knows no truth.
    """
    options = ReadOptions(published_labels=published_labels)
    return truths_of(read_runs(path, robot, options), str(path))


def truths_of(runs: xr.Dataset, where: str) -> dict[str, RunTruth]:
    """Return the truth of every run by its name.

    Args:
        runs: The run set.
        where: What to call it in an error.

    Raises:
        InputError: If it knows no truth.
    """
    faults = truth_of(runs)
    if faults is None:
        raise InputError(
            f"{where}: has no variable `fault`, so it does not know the truth. If the names of raw "
            "sessions end in _label_K, add --published-labels."
        )
    unknown = np.full(len(faults), np.nan)
    onset, magnitude = (runs[n].values if n in runs else unknown for n in ("onset", "magnitude"))
    names = map(str, runs["run"].values)
    return {
        name: RunTruth(fault, float(began), float(size))
        for name, fault, began, size in zip(names, faults, onset, magnitude, strict=True)
    }


def with_truth(
    records: Sequence[Record], truths: Mapping[str, RunTruth], where: str
) -> list[Record]:
    """Return the records with the truth, matched by run name.

    Raises:
        InputError: If the truth of a run is not there.
    """
    for record in records:
        if record["run"] not in truths:
            raise InputError(_no_run(record["run"], truths, where))
    return [{**record, "truth": truths[record["run"]].fault} for record in records]


def _no_run(run: str, truths: Mapping[str, RunTruth], where: str) -> str:
    """Return what is wrong if a run is not there, and why that may be."""
    problem = f"{where}: holds no run {run!r} of the results. "
    name, numbered, _ = run.rpartition("#")
    if numbered and name in truths:
        return problem + (
            f"It holds {name!r}; diagnose numbers runs of the same name, so it was given an input "
            "twice, or several whose runs are called alike. Diagnose and evaluate each input once, "
            "by itself."
        )
    return problem + "Expected the runs that were diagnosed."


@dataclass(frozen=True)
class Calibration:
    """Calibration of the probability of the most probable hypothesis.

    Attributes:
        equal: Bins of equal width.
        adaptive: Bins of about as many runs each.
        by_chance: Errors that a perfectly calibrated method would show in `equal`, (draw,).
    """

    equal: Reliability
    adaptive: Reliability
    by_chance: FloatArray


@dataclass(frozen=True)
class Evaluation:
    """Scores of a result file.

    Attributes:
        protocol: How much real data the method has seen.
        untold: Runs without a verdict.
        as_unknown: Runs that are judged as `unknown`, since their truth is no hypothesis.
        scores: Right, wrong and the log score.
        alarms: False alarms and missed detections.
        brier: Mean Brier score, 0 to 2.
        calibration: Over runs with a verdict; None if there are none.
        coverage: Of 90 % intervals, by fault mode; empty where the true values are not known.
    """

    protocol: str
    untold: int
    as_unknown: int
    scores: Scores
    alarms: Alarms
    brier: float
    calibration: Calibration | None
    coverage: Sequence[Coverage]


def evaluate_records(
    records: Sequence[Record], truths: Mapping[str, RunTruth], rng: np.random.Generator
) -> Evaluation | None:
    """Return all scores of the records whose truth is known; None if there are none.

    Args:
        records: Diagnoses.
        truths: True onset and magnitude of runs by name, where known.
        rng: Source of chance, for the calibration error that chance alone would show.
    """
    judged, scores = judged_records(records), score_records(records)
    if scores is None:
        return None
    truth = [record["truth"] for record in judged]
    return Evaluation(
        protocol=protocol_of(records),
        untold=sum(record["diagnosis"] is None for record in judged),
        as_unknown=truths_as_unknown(records).total(),
        scores=scores,
        alarms=count_alarms(truth, [record["diagnosis"] for record in judged]),
        brier=float(brier_score(truth, [record["posterior"] for record in judged]).mean()),
        calibration=_calibration(judged, rng),
        coverage=coverage_by_mode(c for record in judged for c in _intervals(record, truths)),
    )


def _calibration(judged: Sequence[Record], rng: np.random.Generator) -> Calibration | None:
    told = [record for record in judged if record["diagnosis"] is not None]
    if not told:
        return None
    chance = np.array([record["posterior"][record["diagnosis"]] for record in told])
    stated = np.minimum(chance, 1.0)  # sums of probabilities may round above
    right = np.array([record["diagnosis"] == record["truth"] for record in told])
    equal = equal_edges()
    return Calibration(
        equal=reliability(stated, right, equal),
        adaptive=reliability(stated, right, adaptive_edges(stated)),
        by_chance=calibrated_error(stated, equal, rng),
    )


def _intervals(record: Record, truths: Mapping[str, RunTruth]) -> Iterator[IntervalCase]:
    """Yield the intervals of a run whose fault was found, with the values that they should hold."""
    known = truths.get(record["run"])
    if known is None or record["diagnosis"] != record["truth"]:
        return
    truth = Hypothesis.parse(record["truth"])
    mode = "+".join(fault.mode for fault in truth.faults) or str(truth)  # `unknown` has no mode
    for quantity, true in (("onset", known.onset), ("magnitude", known.magnitude)):
        interval = record.get(f"{quantity}_90")
        if interval is not None and np.isfinite(true):
            low, high = interval
            yield IntervalCase(mode, quantity, low, high, true)


# Two result files on the same runs: which method is better?


@dataclass(frozen=True)
class Results:
    """A result file and what to call it.

    Attributes:
        name: Such as its path.
        records: Its diagnoses.
    """

    name: str
    records: Sequence[Record]

    @property
    def protocol(self) -> str:
        """How much real data the method has seen."""
        return protocol_of(self.records)


@dataclass(frozen=True)
class Comparison:
    """What two result files say of the same runs.

    Attributes:
        first: Name and protocol of the first.
        second: Name and protocol of the second.
        split: Which runs they got right.
        gain: Nats a run that the second saves.
        as_unknown: Runs that the first and the second judge as `unknown`, since the truth is not
            among their own hypotheses.
    """

    first: str
    second: str
    split: McNemar
    gain: LogScoreGain
    as_unknown: tuple[int, int]

    @property
    def runs(self) -> int:
        """Number of runs compared."""
        split = self.split
        return split.both + split.first_only + split.second_only + split.neither


def compare_results(first: Results, second: Results, rng: np.random.Generator) -> Comparison:
    """Compare two result files run by run, matched by run name.

    Args:
        first: Diagnoses, with the truth of those runs that are to count.
        second: Others of the same runs; where they lack the truth, that of the first counts.
        rng: Source of chance, for the bootstrap.

    Raises:
        InputError: If the runs or their truths differ.
    """
    paired = _paired(first, second)
    ours, theirs = (judged_records(records) for records in paired)  # each by its own hypotheses
    return Comparison(
        first=f"{first.name} (protocol {first.protocol})",
        second=f"{second.name} (protocol {second.protocol})",
        split=mcnemar(_right(ours), _right(theirs)),
        gain=log_score_gain(_nats(ours), _nats(theirs), rng),
        as_unknown=(truths_as_unknown(paired[0]).total(), truths_as_unknown(paired[1]).total()),
    )


def _right(records: Sequence[Record]) -> BoolArray:
    return np.array([record["diagnosis"] == record["truth"] for record in records], dtype=np.bool_)


def _nats(records: Sequence[Record]) -> FloatArray:
    truth = [record["truth"] for record in records]
    return log_score(truth, [record["posterior"] for record in records]).nats


def _paired(first: Results, second: Results) -> tuple[list[Record], list[Record]]:
    """Return the records of both whose truth is known, run by run, both with that of the first."""
    ours, theirs = _by_run(first), _by_run(second)
    for has, lacks, missing in (
        (first, second, [run for run in ours if run not in theirs]),
        (second, first, [run for run in theirs if run not in ours]),
    ):
        if missing:
            raise InputError(
                f"{lacks.name}: lacks {len(missing)} runs of {has.name} ({some_names(missing)}). "
                "Two methods are compared on the same runs: diagnose the same inputs with both."
            )
    known = [record for record in first.records if record["truth"]]
    matched = [theirs[record["run"]] for record in known]
    for one, other in zip(known, matched, strict=True):
        if other["truth"] not in (None, "", one["truth"]):
            raise InputError(
                f"{second.name}: run {one['run']!r} is {other['truth']} there, but {one['truth']} "
                f"in {first.name}. Give the truth of both with --truth RUNS."
            )
    return known, [
        {**other, "truth": one["truth"]} for one, other in zip(known, matched, strict=True)
    ]


def _by_run(results: Results) -> dict[str, Record]:
    check_each_once(results.records, results.name)
    return {record["run"]: record for record in results.records}
