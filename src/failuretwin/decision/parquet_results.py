"""Diagnoses in parquet: a folder with one file per piece of the runs, in their order.

Columns are those of the CSV, with text and evidence as lists. `p(H)` is the probability of
hypothesis H. Needs pyarrow (extra `parquet`).
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from failuretwin.core.errors import InputError, needs_extra
from failuretwin.core.foreign import reading
from failuretwin.core.hypothesis import Diagnosis, MovementEvidence

if TYPE_CHECKING:
    import pyarrow as pa

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

    rows = [_row(diagnosis) for diagnosis in diagnoses]
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


def _row(diagnosis: Diagnosis) -> dict[str, Any]:
    row = {name: getattr(diagnosis, name) for name in (*TEXTS, *FIGURES, *LAST)}
    for name in INTERVALS:
        low, high = getattr(diagnosis, name) or (None, None)
        row |= {f"{name}_low": low, f"{name}_high": high}
    row |= {name: list(getattr(diagnosis, name)) for name in LISTS}
    row["evidence"] = [asdict(movement) for movement in diagnosis.evidence]
    return row | {f"p({name})": chance for name, chance in diagnosis.posterior.items()}


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
