"""Runs of any number, read a piece at a time: rows of stored run sets, or some logs of a folder.

The pieces are the same whoever reads them, and memory does not grow with their number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from failuretwin.core.foreign import files_below
from failuretwin.core.runs import check_runs, concatenate
from failuretwin.data_knowledge.readers.read import (
    Log,
    ReadOptions,
    find_logs,
    read_log,
    read_logs,
)
from failuretwin.data_knowledge.store import open_run_set
from failuretwin.digital_model.robot import Robot

if TYPE_CHECKING:
    import xarray as xr

PIECE = 128
"""Runs of a stored set, or logs, in a piece; also the most that a sample is read from."""
OPEN_SETS = 8
"""Run sets that a process keeps open."""


@dataclass(frozen=True)
class Piece:
    """Some runs that are read together.

    Attributes:
        logs: Logs that are read whole; or one run set.
        rows: Numbers of the runs of that set; None: all runs of the logs.
    """

    logs: tuple[Log, ...]
    rows: range | None = None

    @property
    def size(self) -> int:
        """Number of runs of a run set, else of logs."""
        return len(self.logs) if self.rows is None else len(self.rows)


@dataclass(frozen=True)
class RunPieces:
    """All runs of some sources.

    Attributes:
        sources: What `read_runs` reads.
        robot: The robot that they are of.
        options: How logs become runs.

    Raises:
        InputError: When pieces are asked for, if a source cannot be read.
    """

    sources: Sequence[Path]
    robot: Robot
    options: ReadOptions

    @cached_property
    def pieces(self) -> list[Piece]:
        """All pieces, in the order of the sources."""
        found = list[Piece]()
        for stored, logs in groupby(
            find_logs(self.sources, self.options), attrgetter("is_run_set")
        ):
            some = tuple(logs)
            if stored:
                found += [Piece((log,), rows) for log in some for rows in _rows(log)]
            else:
                found += [Piece(some[at : at + PIECE]) for at in range(0, len(some), PIECE)]
        return found

    def read(self, number: int) -> xr.Dataset:
        """Return the runs of a piece.

        Raises:
            InputError: If they cannot be read.
        """
        piece = self.pieces[number]
        return self._read(piece, range(piece.size))

    @property
    def size(self) -> int:
        """Number of runs of run sets and of other logs."""
        return sum(piece.size for piece in self.pieces)

    def sample(self, most: int | None = None) -> xr.Dataset:
        """Return runs that are evenly spread over all.

        Of logs, whole ones are read, evenly spread, and then evenly spread runs are kept.

        Args:
            most: Largest number of runs; None: `PIECE`.

        Raises:
            InputError: If they cannot be read.
        """
        sizes = np.array([piece.size for piece in self.pieces])
        first = np.concatenate([[0], np.cumsum(sizes)])
        chosen = _spread(int(first[-1]), most or PIECE)
        parts = []
        for number, piece in enumerate(self.pieces):
            here = chosen[(chosen >= first[number]) & (chosen < first[number + 1])]
            if len(here):
                parts.append(self._read(piece, (here - first[number]).tolist()))
        runs = concatenate(parts)
        return runs.isel(run=_spread(runs.sizes["run"], most or PIECE))

    def _read(self, piece: Piece, items: Sequence[int]) -> xr.Dataset:
        """Return some runs of a run set, or the runs of some logs of a piece."""
        if piece.rows is not None:
            path = piece.logs[0].path
            rows = [piece.rows[item] for item in items]
            return check_runs(_opened(path).isel(run=rows).load(), str(path))
        logs = (piece.logs[item] for item in items)
        return concatenate([r for log in logs for r in read_log(log, self.robot, self.options)])

    def stamps(self) -> list[Any]:
        """Return path, size and time of change [ns] of every file, by which a change is seen."""
        logs = dict.fromkeys(log.path for piece in self.pieces for log in piece.logs)
        files = [f for p in logs for f in (sorted(files_below(p, "*")) if p.is_dir() else [p])]
        return [(str(f.absolute()), f.stat().st_size, f.stat().st_mtime_ns) for f in files]


def open_runs(source: Path, robot: Robot, options: ReadOptions) -> xr.Dataset:
    """Return runs; of one stored run set only the variables that are asked for are read.

    Raises:
        InputError: If they cannot be read.
    """
    logs = find_logs([source], options)
    stored = len(logs) == 1 and logs[0].is_run_set
    return _opened(source) if stored else read_logs(logs, robot, options)


def _spread(count: int, most: int) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))


def _rows(log: Log) -> list[range]:
    runs = range(_opened(log.path).sizes["run"])
    return [runs[at : at + PIECE] for at in range(0, len(runs), PIECE)]


def _opened(path: Path) -> xr.Dataset:
    """Return a run set whose values are read when they are asked for; opened once a process."""
    file = path / "zarr.json" if path.is_dir() else path
    return _opened_since(path, file.stat().st_mtime_ns if file.is_file() else 0)


@lru_cache(maxsize=OPEN_SETS)
def _opened_since(path: Path, changed: int) -> xr.Dataset:
    return open_run_set(path, PIECE)
