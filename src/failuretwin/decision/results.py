"""Results of a diagnosis as files: JSON lines and CSV."""

from __future__ import annotations

import csv
import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from failuretwin.core.errors import InputError
from failuretwin.data_knowledge.store import replacing
from failuretwin.decision.metrics import LogScore, Scores, judged_truth, score

Record = dict[str, Any]
"""One diagnosis as the JSON object of the contract."""

NEEDED = ("run", "diagnosis", "posterior")
NAMED_RUNS = 3
"""So many runs are named in an error."""
SUM_ERROR = 1e-6
"""Probabilities of a run may sum to 1 plus or minus this."""


def write_json_lines(records: Sequence[Record], path: Path) -> None:
    """Write an object a line; the file appears whole or not at all."""
    with replacing(path) as partial:
        text = "".join(json.dumps(record) + "\n" for record in records)
        partial.write_text(text, encoding="utf-8")


def read_json_lines(path: Path) -> list[Record]:
    """Read what `write_json_lines` wrote; a line without `truth` is as one whose truth is null.

    Raises:
        InputError: If the file cannot be read, a line is not a diagnosis, or a run is there twice.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path}: cannot be read ({error}). Expected the output of diagnose --json."
        ) from error
    records = []
    for number, line in enumerate(lines, start=1):
        if line.strip():
            records.append(_read_record(line, f"{path}: line {number}"))
    if not records:
        raise InputError(f"{path}: is empty. Expected the output of diagnose --json.")
    check_each_once(records, str(path))
    return records


def check_each_once(records: Sequence[Record], where: str) -> None:
    """Refuse results that hold a run twice, which would count it twice.

    Args:
        records: Diagnoses.
        where: What to call them in the error.

    Raises:
        InputError: If a run is there twice.
    """
    count = Counter(record["run"] for record in records)
    twice = [run for run, times in count.items() if times > 1]
    if twice:
        raise InputError(
            f"{where}: {some_names(twice)} given twice. Expected each run once: remove the lines "
            "that repeat one, or write the file anew with diagnose --json."
        )


def some_names(names: Sequence[str]) -> str:
    """Return the first few names, and whether there are more."""
    return ", ".join(names[:NAMED_RUNS]) + (", ..." if len(names) > NAMED_RUNS else "")


def _read_record(line: str, where: str) -> Record:
    try:
        record = json.loads(line)
    except json.JSONDecodeError as error:
        raise InputError(
            f"{where}: not JSON ({error}). Expected diagnose --json output."
        ) from error
    missing = [key for key in NEEDED if not isinstance(record, dict) or key not in record]
    if missing:
        raise InputError(f"{where}: no {', '.join(missing)}. Expected diagnose --json output.")
    record = {"truth": None} | record
    _check_kinds(record, where)
    posterior = record["posterior"]
    numbers = isinstance(posterior, dict) and all(
        isinstance(p, int | float) for p in posterior.values()
    )
    if not numbers or record["diagnosis"] not in (None, *posterior):
        raise InputError(
            f"{where}: `posterior` and `diagnosis` do not fit together. Expected a probability for "
            "each hypothesis, and one of them (or null) as diagnosis."
        )
    _check_probabilities(list(posterior.values()), where)
    return record


def _check_kinds(record: Record, where: str) -> None:
    for key, allowed in (("run", str), ("truth", str | None)):
        if not isinstance(record[key], allowed):
            raise InputError(f"{where}: `{key}` is {record[key]!r}, expected text.")
    for key in ("onset_90", "magnitude_90"):
        ends = record.get(key)
        if ends is not None and not (
            isinstance(ends, list)
            and len(ends) == 2
            and all(isinstance(e, int | float) for e in ends)
        ):
            raise InputError(f"{where}: `{key}` is {ends!r}, expected two numbers or null.")


def _check_probabilities(posterior: Sequence[float], where: str) -> None:
    total = sum(posterior)
    inside = all(0.0 <= p <= 1.0 + SUM_ERROR for p in posterior)
    if not inside or not abs(total - 1.0) <= SUM_ERROR:
        raise InputError(
            f"{where}: `posterior` sums to {total:g}. Expected probabilities within 0 to 1 that "
            "sum to 1."
        )


def judged_records(records: Sequence[Record]) -> list[Record]:
    """Return the records whose truth is known, with the truth that they are judged by."""
    return [
        {**record, "truth": judged_truth(record["truth"], record["posterior"])}
        for record in records
        if record["truth"]
    ]


def truths_as_unknown(records: Sequence[Record]) -> Counter[str]:
    """Return how many runs of each truth are judged as `unknown`, by the truth."""
    known = [record for record in records if record["truth"]]
    judged = judged_records(records)
    return Counter(
        told["truth"]
        for told, record in zip(known, judged, strict=True)
        if told["truth"] != record["truth"]
    )


def as_unknown_line(records: Sequence[Record]) -> str:
    """Return which truths are judged as `unknown`, in words; empty if none is."""
    found = truths_as_unknown(records)
    if not found:
        return ""
    truths = [f"{truth} ({count} run{'s' * (count > 1)})" for truth, count in found.items()]
    return f"judged as unknown, since not among the hypotheses: {', '.join(truths)}"


def protocol_of(records: Sequence[Record]) -> str:
    """Return the protocol letters of the records, joined by a slash where they differ."""
    return "/".join(sorted({record.get("protocol") or "?" for record in records}))


def score_records(records: Sequence[Record]) -> Scores | None:
    """Return the scores of those records whose truth is known; None if there are none."""
    judged = judged_records(records)
    if not judged:
        return None
    return score(
        [record["truth"] for record in judged],
        [record["diagnosis"] for record in judged],
        [record["posterior"] for record in judged],
    )


def score_line(records: Sequence[Record]) -> str:
    """Return the accuracy with its protocol, number of runs and interval; empty if unknown."""
    scores = score_records(records)
    if scores is None:
        return ""
    low, high = scores.interval
    return (
        f"{scores.right} of {scores.runs} runs right: accuracy {100 * scores.accuracy:.1f} % "
        f"(95 % interval {100 * low:.1f} to {100 * high:.1f} %), protocol {protocol_of(records)}, "
        f"log score {log_score_text(scores.log_scores)}"
    )


def log_score_text(surprise: LogScore) -> str:
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


def write_csv(records: Sequence[Record], path: Path) -> None:
    """Write a row a run: plain columns, then the probability of each hypothesis."""
    with replacing(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        rows = [_csv_row(record) for record in records]
        columns = dict.fromkeys(column for row in rows for column in row)
        writer = csv.DictWriter(file, fieldnames=list(columns))
        writer.writeheader()
        writer.writerows(rows)


def _csv_row(record: Record) -> Record:
    row: Record = {}
    for key, value in record.items():
        if key in ("posterior", "evidence"):
            continue
        if key.endswith("_90"):
            low, high = value or (None, None)
            row |= {f"{key}_low": low, f"{key}_high": high}
        else:
            row[key] = "; ".join(value) if isinstance(value, list) else value
    row |= {f"p({name})": p for name, p in record["posterior"].items()}
    return row | {f"nats({e['movement']})": e["nats"] for e in record["evidence"]}
