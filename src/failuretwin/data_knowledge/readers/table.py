"""Tables of text: CSV files and the like, every cell as text until it is asked for as a number."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np

from failuretwin.core.errors import InputError, check_name
from failuretwin.core.foreign import check_memory, reading, stored_bytes
from failuretwin.core.types import FloatArray

if TYPE_CHECKING:
    import pandas as pd

CSV_EXPANSION = 30
"""Memory of a byte of a CSV file while its cells are text: a cell of two bytes takes sixty."""
BLANKS = r"\s+"
"""Separator of columns with any number of blanks between them."""


def first_line(path: Path) -> str:
    """Return the first line of a text file, stripped; empty if it cannot be read as text."""
    try:
        with path.open(encoding="utf-8") as file:
            return file.readline().strip()
    except (OSError, UnicodeDecodeError):
        return ""


def separator_of(path: Path) -> str:
    """Return the separator of columns that the header of a file suggests."""
    header = first_line(path)
    likely = max(",;\t", key=header.count)
    return likely if likely in header or " " not in header else BLANKS


@dataclass(frozen=True)
class Table:
    """Rows of a file.

    Attributes:
        path: The file.
        cells: Every cell as text.
    """

    path: Path
    cells: pd.DataFrame

    @classmethod
    def read(cls, path: Path, separator: str = ",", decimal: str = ".") -> Self:
        """Read a file with a header.

        Raises:
            InputError: If it cannot be read or holds no rows.
        """
        import pandas as pd

        size = stored_bytes(path)
        check_memory(CSV_EXPANSION * size, str(path), "its cells")
        if size == 0:
            raise InputError(f"{path}: is empty. Expected a header and rows of numbers.")
        with reading(path, "CSV", "Expected a header and rows of numbers."):
            cells = pd.read_csv(path, dtype=str, sep=separator, skipinitialspace=True)
        if not isinstance(cells.index, pd.RangeIndex):
            raise InputError(
                f"{path}: its rows have more cells than its header has names. Check the separator, "
                "or add the missing names."
            )
        if cells.empty:
            raise InputError(f"{path}: has a header but no rows.")
        if decimal != ".":
            cells = cells.apply(lambda column: column.str.replace(decimal, ".", regex=False))
        return cls(path, cells)

    @property
    def names(self) -> list[str]:
        """Names of the columns."""
        return [str(name) for name in self.cells]

    def parts(self, column: str) -> Iterator[tuple[str, Table]]:
        """Yield each value in a column and the rows that have it.

        Raises:
            InputError: If there is no such column.
        """
        self.check([column])
        for key, rows in self.cells.groupby(column, sort=False):
            yield str(key), Table(self.path, rows)

    def check(self, columns: Sequence[str]) -> None:
        """Raise InputError unless all of some columns are there."""
        for column in columns:
            check_name("column", column, self.names, f"{self.path}: ")

    def values(self, columns: Sequence[str]) -> FloatArray:
        """Return columns as numbers, (row, column); NaN for text and empty cells."""
        import pandas as pd

        values = np.empty((len(self.cells), len(columns)))
        for place, column in enumerate(columns):
            values[:, place] = pd.to_numeric(self.cells[column], errors="coerce")
        return values

    def numbers(self, columns: Sequence[str], *, gaps: bool = True) -> FloatArray:
        """Return columns as numbers, (row, column); NaN for empty cells, which only `gaps` allows.

        Raises:
            InputError: If a column is missing or a cell is no number.
        """
        self.check(columns)
        values = self.values(columns)
        cells = [self.cells[column].to_numpy() for column in columns]
        for row, place in np.argwhere(~np.isfinite(values)).tolist():
            cell = cells[place][row]
            if not (gaps and _is_empty(cell)):
                line = int(self.cells.index[row]) + 2
                raise InputError(
                    f"{self.path}: line {line}, column {columns[place]}: got {cell!r}, expected "
                    f"{_expected(values[row, place], gaps)}"
                )
        return values


def _is_empty(cell: object) -> bool:
    """Return whether a cell holds nothing."""
    return not isinstance(cell, str) or cell.strip().lower() in ("nan", "")


def _expected(value: float, gaps: bool) -> str:
    """Return what is expected in place of a cell that holds no finite value, and how to get it.

    Args:
        value: The cell as a number; NaN: it is none.
        gaps: Whether a cell may be empty.
    """
    if np.isinf(value):
        mend = " Leave the cell empty where there is no value." if gaps else ""
        return f"a finite number.{mend}"
    if not gaps:
        return "a number."
    return 'a number. For decimal commas add decimal = "," at the top of the map.'
