"""Export of the store as parquet, one file a table, for pandas, DuckDB and the like."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import sqlalchemy as sa

from failuretwin.core.errors import needs_extra
from failuretwin.data_knowledge.records.schema import Utc, metadata
from failuretwin.data_knowledge.store import filling

if TYPE_CHECKING:
    import pyarrow as pa

CHUNK_ROWS = 20_000
"""Rows in memory at a time."""


def export_parquet(connection: sa.Connection, folder: Path) -> dict[str, int]:
    """Write every table to `TABLE.parquet` in a folder; all files appear together.

    Times are UTC, JSON columns are text.

    Returns:
        Number of rows of each table.

    Raises:
        InputError: If pyarrow is missing.
        OutputError: If they cannot be written; the folder is as before.
    """
    with needs_extra("parquet needs pyarrow", "store"):
        import pyarrow.parquet
    del pyarrow
    with filling(folder) as partial:
        return {
            table.name: _write_table(connection, table, partial / f"{table.name}.parquet")
            for table in metadata.sorted_tables
        }


def _write_table(connection: sa.Connection, table: sa.Table, file: Path) -> int:
    import pyarrow as pa
    import pyarrow.parquet as pq

    schema, count = _schema(table), 0
    query = sa.select(table).order_by(table.c.id).execution_options(yield_per=CHUNK_ROWS)
    with pq.ParquetWriter(file, schema) as writer:
        for rows in connection.execute(query).mappings().partitions():
            cells = [_cells(row) for row in rows]
            writer.write_table(pa.Table.from_pylist(cells, schema))
            count += len(cells)
    return count


def _cells(row: Mapping[Any, Any]) -> dict[str, Any]:
    return {
        str(name): json.dumps(value, ensure_ascii=False)
        if isinstance(value, dict | list)
        else value
        for name, value in row.items()
    }


def _schema(table: sa.Table) -> pa.Schema:
    import pyarrow as pa

    def kind(column: sa.Column[Any]) -> pa.DataType:
        if isinstance(column.type, Utc):
            return pa.timestamp("us", tz="UTC")
        if isinstance(column.type, sa.Integer):
            return pa.int64()
        if isinstance(column.type, sa.LargeBinary):
            return pa.binary()
        return pa.float64() if isinstance(column.type, sa.Double) else pa.string()

    return pa.schema(
        [pa.field(one.name, kind(one), nullable=bool(one.nullable)) for one in table.columns]
    )
