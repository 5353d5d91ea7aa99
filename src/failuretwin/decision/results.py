"""Diagnoses in files: JSON lines, CSV, and folders of parquet files.

A row of CSV and parquet has plain columns, ends of intervals, and `p(H)`, the probability of each
hypothesis H. Parquet needs pyarrow (extra `parquet`).
"""

from __future__ import annotations

import csv
import json
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from failuretwin.core.config import from_table
from failuretwin.core.errors import InputError, needs_extra
from failuretwin.core.foreign import as_cell, check_memory, reading, stored_bytes
from failuretwin.core.hypothesis import Diagnosis, Interval, MovementEvidence
from failuretwin.data_knowledge.store import replacing, write_records
from failuretwin.inference.together.fault_course import FaultCourse

if TYPE_CHECKING:
    import pyarrow as pa

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
    row = _row(diagnosis)
    del row["evidence"]
    row |= {name: "; ".join(row[name]) for name in LISTS}
    for item in diagnosis.evidence:
        name = f"nats({item.movement})"
        row[name] = row.get(name, 0.0) + item.nats
    return row


def _row(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return a diagnosis as a row; texts and evidence are lists."""
    row: dict[str, Any] = {}
    for key, value in diagnosis.to_record().items():
        if key in INTERVALS:
            row[f"{key}_low"], row[f"{key}_high"] = value or (None, None)
        elif key != "posterior":
            row[key] = value
    return row | {f"p({name})": p for name, p in diagnosis.posterior.items()}


# Parquet: a folder with one file per piece of the runs, in their order.

TEXTS = ("run", "truth", "state", "diagnosis", "runner_up", "magnitude_unit")
"""Columns of text before the figures."""
FIGURES = ("probability", "onset_s", "magnitude")
INTERVALS = ("onset_90", "magnitude_90")
LISTS = ("explanation", "quality")
LAST = ("verdict", "undecided", "protocol", "method")
"""Columns of text behind the figures."""
SCORED = ("run", "truth", "onset_s", "magnitude", "undecided", "protocol", "method")
"""Columns that scores need, in addition to intervals and probabilities."""


def check_parquet() -> None:
    """Raise InputError, naming the extra, if pyarrow is missing."""
    with needs_extra("parquet files need pyarrow", "parquet"):
        import pyarrow.parquet
    del pyarrow


def part_name(piece: int) -> str:
    """Return the name of the file of a piece."""
    return f"part-{piece:06d}.parquet"


def part_files(folder: Path) -> list[Path]:
    """Return the files of a folder of results, in the order of the runs."""
    found = sorted(folder.glob("part-*.parquet"))
    if not found:
        raise InputError(f"{folder}: holds no results. Expected the output of diagnose --parquet.")
    return found


def write_part(diagnoses: Sequence[Diagnosis], hypotheses: Sequence[str], path: Path) -> None:
    """Write diagnoses to one file, which appears whole.

    Each hypothesis has a column.
    """
    import pyarrow as pa

    rows = [_row(diagnosis) | {"undecided": diagnosis.undecided} for diagnosis in diagnoses]
    _write(pa.Table.from_pylist(rows, schema=_schema(hypotheses)), path)


def rename_runs(path: Path, names: Sequence[str]) -> None:
    """Give the runs of a file other names."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.ParquetFile(path).read()
    at = table.schema.get_field_index("run")
    _write(table.set_column(at, table.schema.field("run"), pa.array(names, pa.string())), path)


def _write(table: pa.Table, path: Path) -> None:
    import pyarrow.parquet as pq

    partial = path.with_suffix(".partial")
    pq.write_table(table, partial, compression="zstd")
    partial.replace(path)


def _schema(hypotheses: Sequence[str]) -> pa.Schema:
    import pyarrow as pa

    text, figure = pa.string(), pa.float64()
    evidence = pa.struct([("movement", pa.int64()), ("nats", figure), ("time_s", figure)])
    return pa.schema(
        [
            *((name, text) for name in TEXTS),
            *((name, figure) for name in FIGURES),
            *((f"{name}_{end}", figure) for name in INTERVALS for end in ("low", "high")),
            *((name, text) for name in LAST),
            *((name, pa.list_(text)) for name in LISTS),
            ("evidence", pa.list_(evidence)),
            *((f"p({name})", figure) for name in hypotheses),
        ]
    )


def read_names(path: Path) -> list[str]:
    """Return the names of the runs in a file."""
    import pyarrow.parquet as pq

    return list(pq.ParquetFile(path).read(["run"]).column("run").to_pylist())


def read_diagnoses(folder: str | Path, texts: bool = True) -> Iterator[Diagnosis]:
    """Yield the diagnoses in a folder of results, a file in memory at a time.

    Args:
        folder: The output of `diagnose --parquet`.
        texts: Whether verdict, explanation, evidence and quality are read, which scores do not
            need.
    """
    for row in _rows(Path(folder), texts):
        fields: dict[str, Any] = {name: row[name] for name in SCORED}
        for name in ("truth", "protocol", "method"):  # the same text in many runs
            fields[name] = row[name] and sys.intern(row[name])
        for name in INTERVALS:
            low, high = row[f"{name}_low"], row[f"{name}_high"]
            fields[name] = None if low is None else (low, high)
        if texts:
            fields |= {name: row[name] for name in ("verdict", "magnitude_unit")}
            fields |= {name: tuple(row[name]) for name in LISTS}
            fields["evidence"] = tuple(MovementEvidence(**one) for one in row["evidence"])
        chances = {sys.intern(n[2:-1]): row[n] for n in row if _is_chance(n)}
        yield Diagnosis(posterior={n: p for n, p in chances.items() if p is not None}, **fields)


def _rows(folder: Path, texts: bool) -> Iterator[dict[str, Any]]:
    """Yield the rows of all files, without `texts` only with what scores need."""
    check_parquet()
    import pyarrow.parquet as pq

    ends = [f"{name}_{end}" for name in INTERVALS for end in ("low", "high")]
    for path in part_files(folder):
        with reading(path, "results", "Expected the output of diagnose --parquet."):
            file = pq.ParquetFile(path)
            names = file.schema_arrow.names
            wanted = [n for n in names if texts or n in (*SCORED, *ends) or _is_chance(n)]
            rows = file.read(wanted).to_pylist()
        yield from rows


def _is_chance(name: str) -> bool:
    return name.startswith("p(") and name.endswith(")")
