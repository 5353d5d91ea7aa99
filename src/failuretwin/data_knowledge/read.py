"""One door for all inputs: run sets, raw sessions, published MATLAB files, bags, any CSV."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias, cast

from failuretwin import __version__
from failuretwin.core.errors import InputError
from failuretwin.core.runs import RunTable, concatenate
from failuretwin.data_knowledge.bags import BagTopics, is_bag, read_bag
from failuretwin.data_knowledge.csv_log import ColumnMap, read_mapped_csv
from failuretwin.data_knowledge.matlab import (
    RECOVERY_ERROR,
    RECOVERY_WORST,
    find_matlab_files,
    read_matlab_file,
)
from failuretwin.data_knowledge.raw_sessions import (
    SESSION_FILES,
    As,
    find_sessions,
    read_session,
    session_runs,
)
from failuretwin.data_knowledge.store import SUFFIXES, load_run_set
from failuretwin.data_knowledge.timed_log import timed_run
from failuretwin.digital_model.robot import Robot, load_robot

if TYPE_CHECKING:
    import xarray as xr


RunsLike: TypeAlias = "xr.Dataset | str | Path | Sequence[str | Path]"
"""A run set, or where one is read from."""


@dataclass(frozen=True)
class ReadOptions:
    """How logs become runs.

    Attributes:
        how: Raw sessions: ``measured`` (readings at their times) or ``published`` (as the authors).
        published_labels: Take the truth from folder names that end in ``_label_K`` and freeze the
            motor of labels 1 to 4.
        columns: What the columns of CSV files are.
        topics: Which topics of bags are what, where their types do not tell.
        approximate: Published paths without commands: accept commands that reproduce the desired
            path only in the least-squares sense.
    """

    how: As = "measured"
    published_labels: bool = False
    columns: ColumnMap | None = None
    topics: BagTopics | None = None
    approximate: bool = False


def read_runs(
    sources: str | Path | Sequence[str | Path],
    robot: Robot | str = "armpi_fpv",
    options: ReadOptions | None = None,
) -> xr.Dataset:
    """Read runs from anything that holds some, as one run set.

    Args:
        sources: Run sets (.nc, .zarr), folders with raw sessions or published MATLAB files (they
            are searched downwards), such files (.mat), bags (.bag, .mcap, folders of ROS 2) or
            CSV files with a column map.
        robot: The robot that the logs are of, or its name.
        options: How logs become runs.

    Raises:
        InputError: If a source does not exist, cannot be read or holds no runs.
    """
    if isinstance(robot, str):
        robot = load_robot(robot)
    if isinstance(sources, str | Path):
        sources = [sources]
    options = options or ReadOptions()
    parts = [part for source in sources for part in _read_source(Path(source), robot, options)]
    runs = concatenate(parts)
    worst = max(parts, key=lambda part: float(part.attrs.get(RECOVERY_ERROR, -1.0)))
    if RECOVERY_ERROR in worst.attrs:  # of several files the worst one is told
        runs.attrs |= {name: worst.attrs[name] for name in (RECOVERY_ERROR, RECOVERY_WORST)}
    return runs


def as_runs(runs: RunsLike, robot: Robot | str = "armpi_fpv") -> xr.Dataset:
    """Return a run set as it is, or read it from wherever a path points; see `read_runs`."""
    if hasattr(runs, "data_vars"):
        return cast("xr.Dataset", runs)
    return read_runs(runs, robot)


def _read_source(path: Path, robot: Robot, options: ReadOptions) -> list[xr.Dataset]:
    if not path.exists():
        raise InputError(f"{path}: does not exist. Expected a run set, a log or a folder of logs.")
    if path.suffix in SUFFIXES:
        return [load_run_set(path)]
    if is_bag(path):
        logs = read_bag(path, robot, options.topics)
        return [_named(timed_run(log, robot), robot, "bag", {}) for log in logs]
    if path.is_dir():
        return _read_folder(path, robot, options)
    if path.suffix == ".mat":
        return [_matlab_dataset(path, robot, options)]
    if path.suffix == ".csv":
        return _read_csv(path, robot, options)
    raise InputError(
        f"{path}: not a kind of file that can be read. Expected a run set (.nc, .zarr), a "
        "published MATLAB file (.mat), a bag (.bag, .mcap), a CSV file with a column map, or a "
        f"folder that holds {', '.join(SESSION_FILES)}."
    )


def _read_folder(path: Path, robot: Robot, options: ReadOptions) -> list[xr.Dataset]:
    found = [_session_dataset(folder, robot, options) for folder in find_sessions(path)]
    found += [_matlab_dataset(file, robot, options) for file in find_matlab_files(path)]
    if not found and options.columns is not None:
        files = sorted(path.rglob("*.csv"))
        found = [part for file in files for part in _read_csv(file, robot, options)]
    if not found:
        raise InputError(
            f"{path}: no raw session in it or below, and no published MATLAB file. A session is a "
            f"folder that holds {', '.join(SESSION_FILES)}. Other CSV files need --columns."
        )
    return found


def _session_dataset(folder: Path, robot: Robot, options: ReadOptions) -> xr.Dataset:
    session = read_session(folder, robot)
    table = session_runs(session, robot, options.how, published_labels=options.published_labels)
    choice = {"as": options.how, "published_labels": options.published_labels}
    return _named(table, robot, f"raw session, as {options.how}", choice)


def _matlab_dataset(path: Path, robot: Robot, options: ReadOptions) -> xr.Dataset:
    table = read_matlab_file(path, robot, approximate=options.approximate)
    return _named(table, robot, "published MATLAB file", {"approximate": options.approximate})


def _read_csv(path: Path, robot: Robot, options: ReadOptions) -> list[xr.Dataset]:
    if options.columns is None:
        raise InputError(
            f"{path}: a CSV file needs a column map that says which column is what. Add --columns "
            "MAP.toml: if that file does not exist yet, a guess is written there for you to check."
        )
    logs = read_mapped_csv(path, options.columns, robot)
    return [_named(timed_run(log, robot), robot, "CSV with a column map", {}) for log in logs]


def _named(table: RunTable, robot: Robot, source: str, choice: Mapping[str, object]) -> xr.Dataset:
    """Return the run set of a table with what it says of its origin."""
    runs = table.to_dataset()
    runs.attrs |= {
        "robot": robot.name,
        "source": source,
        "failuretwin_version": __version__,
        "configuration": json.dumps(choice),
    }
    return runs
