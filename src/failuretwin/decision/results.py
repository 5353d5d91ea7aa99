"""Diagnoses in files: JSON lines with one object per run, and CSV with one row per run."""

from __future__ import annotations

import csv
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from failuretwin.core.config import from_table
from failuretwin.core.errors import InputError
from failuretwin.core.foreign import as_cell, check_memory, reading, stored_bytes
from failuretwin.core.hypothesis import Diagnosis, Interval
from failuretwin.data_knowledge.store import replacing, write_records
from failuretwin.decision.parquet_results import read_diagnoses
from failuretwin.inference.together.fault_course import FaultCourse

SUM_ERROR = 1e-6
"""Tolerance of the sum of probabilities."""
NAMED_RUNS = 3
"""Number of runs named in an error."""
JSON_EXPANSION = 20
"""Largest memory per byte of JSON [bytes]."""
EXPECTED = "Expected the output of diagnose --json."


@dataclass(frozen=True)
class Record:
    """A diagnosis read from a file; the fields are those of `Diagnosis`."""

    run: str
    posterior: dict[str, float]
    diagnosis: str | None = None
    truth: str | None = None
    onset_s: float | None = None
    onset_90: Interval | None = None
    magnitude: float | None = None
    magnitude_unit: str | None = None
    magnitude_90: Interval | None = None
    verdict: str = ""
    protocol: str | None = None
    method: str = ""


NEEDED = ("run", "diagnosis", "posterior")
KNOWN = frozenset(field.name for field in fields(Record))


@dataclass(frozen=True)
class Results:
    """Diagnoses by one method; `name` identifies them in errors and tables."""

    name: str
    diagnoses: Sequence[Diagnosis | Record]

    def __post_init__(self) -> None:
        count = Counter(diagnosis.run for diagnosis in self.diagnoses)
        twice = [run for run, times in count.items() if times > 1]
        if twice:
            raise InputError(
                f"{self.name}: {some_names(twice)} given twice. Expected each run once: remove the "
                "lines that repeat one, or write the file anew with diagnose --json."
            )


def some_names(names: Sequence[str]) -> str:
    """Return the first few names, with an ellipsis if there are more."""
    return ", ".join(names[:NAMED_RUNS]) + (", ..." if len(names) > NAMED_RUNS else "")


def write_json_lines(
    diagnoses: Sequence[Diagnosis], path: Path, course: FaultCourse | None = None
) -> None:
    """Write one JSON object per line, atomically.

    `course` adds the fault course over all runs to each; None: diagnosed independently.
    """
    told = _with_course(diagnoses, course)
    write_records((diagnosis.to_record() | extra for diagnosis, extra in told), path)


def _with_course(
    diagnoses: Sequence[Diagnosis], course: FaultCourse | None
) -> Iterator[tuple[Diagnosis, dict[str, Any]]]:
    """Yield each diagnosis with the extra columns of the fault course."""
    for run, diagnosis in enumerate(diagnoses):
        if course is None:
            yield diagnosis, {}
            continue
        state = int(course.path[run])
        name, chance = str(course.hypotheses[state]), float(course.posterior[run, state])
        yield diagnosis, {"course": name, "course_probability": round(chance, 6)}


def read_results(path: str | Path) -> Results:
    """Read a file of `write_json_lines`, or of another program with the same keys.

    Missing and null values are unknown; other keys than those of `Record` are ignored. Of a folder
    of parquet files, all is read but texts and evidence.

    Args:
        path: The output of `diagnose --json` or `--parquet`.

    Raises:
        InputError: If the file cannot be read, a line is not a diagnosis, or a run occurs twice.
    """
    if Path(path).is_dir():
        return Results(str(path), list(read_diagnoses(path, texts=False)))
    check_memory(JSON_EXPANSION * stored_bytes(Path(path)), str(path), "its lines")
    with reading(path, "results", EXPECTED):
        lines = Path(path).read_text(encoding="utf-8").split("\n")
    records = [
        _read_record(line, f"{path}: line {number}")
        for number, line in enumerate(lines, start=1)
        if line.strip()
    ]
    if not records:
        raise InputError(f"{path}: is empty. {EXPECTED}")
    return Results(str(path), records)


def _read_record(line: str, where: str) -> Record:
    with reading(where, "JSON", EXPECTED):
        stored = json.loads(line)
    missing = [key for key in NEEDED if not isinstance(stored, dict) or key not in stored]
    if missing:
        raise InputError(f"{where}: no {', '.join(missing)}. {EXPECTED}")
    known = {key: value for key, value in stored.items() if key in KNOWN and value is not None}
    record = from_table(Record, known, where)
    _check_probabilities(record, where)
    return record


def _check_probabilities(record: Record, where: str) -> None:
    if record.diagnosis not in (None, *record.posterior):
        raise InputError(
            f"{where}: `posterior` has no `diagnosis` {record.diagnosis!r}. Expected a probability "
            "for each hypothesis, and one of them (or null) as diagnosis."
        )
    total = sum(record.posterior.values())
    inside = all(0.0 <= p <= 1.0 + SUM_ERROR for p in record.posterior.values())
    if not inside or not abs(total - 1.0) <= SUM_ERROR:
        raise InputError(
            f"{where}: `posterior` sums to {total:g}. Expected probabilities within 0 to 1 that "
            "sum to 1."
        )


def write_csv(
    diagnoses: Sequence[Diagnosis], path: Path, course: FaultCourse | None = None
) -> None:
    """Write one CSV row per run: plain columns, then the probability of each hypothesis.

    `course` is that of `write_json_lines`.
    """
    with replacing(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        rows = [_csv_row(diagnosis) | told for diagnosis, told in _with_course(diagnoses, course)]
        columns = dict.fromkeys(column for row in rows for column in row)
        writer = csv.DictWriter(file, fieldnames=list(columns))
        writer.writeheader()
        writer.writerows({key: as_cell(value) for key, value in row.items()} for row in rows)


def _csv_row(diagnosis: Diagnosis) -> dict[str, Any]:
    row: dict[str, Any] = {}
    for key, value in diagnosis.to_record().items():
        if key.endswith("_90"):
            low, high = value or (None, None)
            row |= {f"{key}_low": low, f"{key}_high": high}
        elif key not in ("posterior", "evidence"):
            row[key] = "; ".join(value) if isinstance(value, list) else value
    row |= {f"p({name})": p for name, p in diagnosis.posterior.items()}
    for item in diagnosis.evidence:
        name = f"nats({item.movement})"
        row[name] = row.get(name, 0.0) + item.nats
    return row
