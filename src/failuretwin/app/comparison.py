"""Two result files on the same runs: which method is better?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.app.results import (
    Record,
    check_each_once,
    judged_records,
    protocol_of,
    some_names,
    truths_as_unknown,
)
from failuretwin.core.errors import InputError
from failuretwin.core.types import BoolArray, FloatArray
from failuretwin.decision.metrics import (
    LogScoreGain,
    McNemar,
    log_score,
    log_score_gain,
    mcnemar,
)


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
