"""All that can be said of stored diagnoses where the truth is known."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from failuretwin.app.results import (
    Record,
    judged_records,
    protocol_of,
    score_records,
    truths_as_unknown,
)
from failuretwin.app.truth import RunTruth
from failuretwin.core.hypothesis import Hypothesis
from failuretwin.core.types import FloatArray
from failuretwin.decision.metrics import (
    Alarms,
    Coverage,
    IntervalCase,
    Reliability,
    Scores,
    adaptive_edges,
    brier_score,
    calibrated_error,
    count_alarms,
    coverage_by_mode,
    equal_edges,
    reliability,
)


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
