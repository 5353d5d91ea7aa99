"""Corrected copies of LeRobot data sets: the readings of some joints shifted, all else the same."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from failuretwin.core.errors import InputError
from failuretwin.core.foreign import files_below, read_text, reading
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.readers.lerobot import INFO_FILE, STATE, is_lerobot
from failuretwin.data_knowledge.store import filling

if TYPE_CHECKING:
    import pyarrow as pa

NOTE_FILE = Path("meta") / "correction.json"
"""Notes of all corrections, a list."""
UNSHIFTED = ("std", "count")
"""Statistics that do not move with a constant."""
Change = Callable[["pa.Table"], "pa.Table"]


def check_copy(source: Path, out: Path) -> None:
    """Raise InputError unless `source` is a LeRobot data set and `out` free and outside of it."""
    if not is_lerobot(source):
        raise InputError(
            f"{source}: is no LeRobot data set. Expected a folder with {INFO_FILE}; only such data "
            "are copied. Leave out --correct."
        )
    if out.exists() or out.is_symlink():
        raise InputError(f"{out}: exists already. Expected a new folder: name another.")
    if source.resolve() in out.resolve().parents:
        raise InputError(f"{out}: lies in {source}. Expected a folder outside of the data set.")


def write_shifted(source: Path, out: Path, shift: FloatArray, note: Mapping[str, Any]) -> None:
    """Copy a data set, with a constant added to each channel of ``observation.state``.

    Statistics of that column move along. All other files and columns stay, and types do.

    Args:
        source: Folder of the data set.
        out: Folder to write, whole or not at all.
        shift: What is added, in the unit of the data set, (channel,).
        note: Record of the correction, appended to ``meta/correction.json``.

    Raises:
        InputError: If `check_copy` refuses, or a file cannot be read.
        OutputError: If the copy cannot be written; nothing is left behind.
    """
    check_copy(source, out)
    with filling(out) as partial:
        for file in files_below(source, "*"):
            copied = partial / file.relative_to(source)
            copied.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, copied)
        for file in files_below(partial / "data", "*.parquet"):
            _rewrite(file, lambda table: _with_shifted(table, STATE, shift))
        for file in files_below(partial / "meta" / "episodes", "*.parquet"):
            _rewrite(file, lambda table: _with_shifted_statistics(table, shift))
        _rewrite_json(partial / "meta", shift)
        noted = partial / NOTE_FILE
        before = json.loads(read_text(noted, "JSON")) if noted.is_file() else []
        noted.write_text(json.dumps([*before, note], indent=4) + "\n", encoding="utf-8")


def _rewrite(file: Path, change: Change) -> None:
    """Change the tables of a parquet file, row group by row group."""
    import pyarrow.parquet as pq

    with reading(file, "parquet"), pq.ParquetFile(file) as old:
        partial, groups = file.with_suffix(".new"), old.metadata.num_row_groups
        codec = old.metadata.row_group(0).column(0).compression if groups else "SNAPPY"
        codec = "NONE" if codec == "UNCOMPRESSED" else codec
        with pq.ParquetWriter(partial, old.schema_arrow, compression=codec) as new:
            for group in range(groups):
                new.write_table(change(old.read_row_group(group)))
    partial.replace(file)


def _with_shifted(table: pa.Table, name: str, shift: FloatArray) -> pa.Table:
    """Return a table with `shift` added to a column of vectors, whose type stays."""
    import pyarrow as pa

    place, kind = table.schema.get_field_index(name), table.schema.field(name).type
    values = np.stack(table[name].to_numpy()) + shift
    if pa.types.is_integer(kind.value_type):
        values = np.rint(values)
    flat = pa.array(values.ravel()).cast(kind.value_type)
    width = values.shape[1]
    if pa.types.is_fixed_size_list(kind):
        column = pa.FixedSizeListArray.from_arrays(flat, width)
    else:
        column = pa.ListArray.from_arrays(np.arange(len(values) + 1, dtype=np.int32) * width, flat)
    return table.set_column(place, table.schema.field(name), column.cast(kind))


def _with_shifted_statistics(table: pa.Table, shift: FloatArray) -> pa.Table:
    start = f"stats/{STATE}/"
    for name in table.column_names:
        if name.startswith(start) and name.removeprefix(start) not in UNSHIFTED:
            table = _with_shifted(table, name, shift)
    return table


def _rewrite_json(meta: Path, shift: FloatArray) -> None:
    """Shift the statistics of the whole set, and of each episode (v2.1)."""
    whole, episodes = meta / "stats.json", meta / "episodes_stats.jsonl"
    if whole.is_file():
        with reading(whole, "JSON"):
            stats = _shifted_statistics(json.loads(read_text(whole, "JSON")), shift)
        whole.write_text(json.dumps(stats, indent=4), encoding="utf-8")
    if episodes.is_file():
        with reading(episodes, "JSON lines"):
            rows = [json.loads(line) for line in read_text(episodes, "JSON lines").splitlines()]
            rows = [row | {"stats": _shifted_statistics(row["stats"], shift)} for row in rows]
        episodes.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")


def _shifted_statistics(stats: dict[str, Any], shift: FloatArray) -> dict[str, Any]:
    told = {
        name: value if name in UNSHIFTED else (np.asarray(value) + shift).tolist()
        for name, value in stats.get(STATE, {}).items()
    }
    return stats | ({STATE: told} if told else {})
