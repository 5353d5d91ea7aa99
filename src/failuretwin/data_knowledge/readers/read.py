"""One door for all inputs: run sets, raw sessions, MATLAB files, bags, LeRobot, RTDE, any CSV."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias, cast

from failuretwin import __version__
from failuretwin.core.errors import InputError
from failuretwin.core.foreign import files_below
from failuretwin.core.runs import concatenate
from failuretwin.data_knowledge.readers.bag_file import is_bag
from failuretwin.data_knowledge.readers.bag_messages import BagTopics
from failuretwin.data_knowledge.readers.bags import read_bag
from failuretwin.data_knowledge.readers.column_guess import told_columns
from failuretwin.data_knowledge.readers.csv_log import ColumnMap, read_mapped_csv
from failuretwin.data_knowledge.readers.lerobot import (
    INFO_FILE,
    LeRobotAngles,
    is_lerobot,
    lerobot_version,
    read_lerobot,
)
from failuretwin.data_knowledge.readers.matlab import (
    RECOVERY_ERROR,
    RECOVERY_WORST,
    find_matlab_files,
    read_matlab_file,
)
from failuretwin.data_knowledge.readers.raw_sessions import (
    SESSION_FILES,
    As,
    find_sessions,
    read_session,
    session_runs,
)
from failuretwin.data_knowledge.readers.rtde import is_rtde, read_rtde
from failuretwin.data_knowledge.readers.timed_log import TimedLog, timed_run
from failuretwin.data_knowledge.store import SUFFIXES, load_run_set
from failuretwin.digital_model.robot import Robot, load_robot

if TYPE_CHECKING:
    import xarray as xr


RunsLike: TypeAlias = "xr.Dataset | str | Path | Sequence[str | Path]"
"""A run set, or where one is read from."""
VIRTUAL_TOOL = "tool path = forward kinematics of the readings"
"""What a run set says of itself where no sensor watched the tool: its motors' encoders did."""
RTDE_SOURCE = "RTDE; a tool path in it is computed by the controller from its encoders"


@dataclass(frozen=True)
class ReadOptions:
    """How logs become runs.

    Attributes:
        how: Raw sessions: ``measured`` (readings at their times) or ``published`` (as the authors).
        published_labels: Take the truth from folder names that end in ``_label_K`` and freeze the
            motor of labels 1 to 4.
        columns: What the columns of CSV files are.
        lerobot: What the numbers of LeRobot data sets are.
        topics: Which topics of bags are what, where their types do not tell.
        approximate: Published paths without commands: accept commands that reproduce the desired
            path only in the least-squares sense.
    """

    how: As = "measured"
    published_labels: bool = False
    columns: ColumnMap | None = None
    lerobot: LeRobotAngles | None = None
    topics: BagTopics | None = None
    approximate: bool = False


def sample_log() -> Path:
    """Return the path of a CSV file with three runs of an ArmPi FPV: healthy, stuck, off target.

    Simulated with the physics engine and the imperfections of the bundled calibration (lost
    commands, late starts, sag, scatter). Tool position at 10 Hz. Commands in rad, positions in m in
    the base frame. Run 1 is run 160 of 250 healthy ones of seed 13.
    """
    return Path(str(files("failuretwin.data_knowledge") / "samples" / "armpi_fpv.csv"))


def read_runs(
    sources: str | Path | Sequence[str | Path],
    robot: Robot | str = "armpi_fpv",
    options: ReadOptions | None = None,
) -> xr.Dataset:
    """Read runs from anything that holds some, as one run set.

    Args:
        sources: Run sets (.nc, .zarr), folders with raw sessions or published MATLAB files (they
            are searched downwards), such files (.mat), bags (.bag, .mcap, folders of ROS 2),
            LeRobot data sets (folders), RTDE recordings, or CSV files, whose columns are found
            by their names or named by a column map.
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
    if not (path.is_file() or path.is_dir()):
        raise InputError(f"{path}: is a device or a pipe. Expected a file or a folder of logs.")
    if path.suffix in SUFFIXES:
        return [load_run_set(path)]
    if is_bag(path):
        return _log_datasets([read_bag(path, robot, options.topics)], robot, "bag")
    if is_lerobot(path):
        unit = "degrees (assumed)" if options.lerobot is None else options.lerobot.unit
        source = f"LeRobot {lerobot_version(path)}, angles in {unit}"
        return _log_datasets(read_lerobot(path, robot, options.lerobot), robot, source)
    if path.is_dir():
        return _read_folder(path, robot, options)
    if path.suffix == ".mat":
        return [_matlab_dataset(path, robot, options)]
    if path.suffix == ".csv" or is_rtde(path):
        return _read_text(path, robot, options)
    raise InputError(
        f"{path}: not a kind of file that can be read. Expected a run set (.nc, .zarr), a "
        "published MATLAB file (.mat), a bag (.bag, .mcap), a CSV file, an RTDE recording, a "
        f"LeRobot data set (a folder with {INFO_FILE}), or a folder that holds "
        f"{', '.join(SESSION_FILES)}."
    )


def _read_folder(path: Path, robot: Robot, options: ReadOptions) -> list[xr.Dataset]:
    found = [_session_dataset(folder, robot, options) for folder in find_sessions(path)]
    found += [_matlab_dataset(file, robot, options) for file in find_matlab_files(path)]
    sets = sorted(
        file.parents[1]
        for file in files_below(path, INFO_FILE.name)
        if file.parent.name == INFO_FILE.parent.name
    )
    found += [part for folder in sets for part in _read_source(folder, robot, options)]
    if not found and options.columns is not None:
        tables = sorted(files_below(path, "*.csv"))
        found = [part for file in tables for part in _read_text(file, robot, options)]
    if not found:
        raise InputError(
            f"{path}: no raw session in it or below, no published MATLAB file and no LeRobot data "
            f"set. A session is a folder that holds {', '.join(SESSION_FILES)}. Name other files "
            "one by one, or all CSV files with --columns."
        )
    return found


def _session_dataset(folder: Path, robot: Robot, options: ReadOptions) -> xr.Dataset:
    session = read_session(folder, robot)
    runs = session_runs(session, robot, options.how, published_labels=options.published_labels)
    choice = {"as": options.how, "published_labels": options.published_labels}
    return _named(runs, robot, f"raw session, as {options.how}; {VIRTUAL_TOOL}", choice)


def _matlab_dataset(path: Path, robot: Robot, options: ReadOptions) -> xr.Dataset:
    table = read_matlab_file(path, robot, approximate=options.approximate)
    return _named(
        table.to_dataset(), robot, "published MATLAB file", {"approximate": options.approximate}
    )


def _read_text(path: Path, robot: Robot, options: ReadOptions) -> list[xr.Dataset]:
    """Return the runs of a text file: by the column map, else by what its header says."""
    if options.columns is not None:
        logs = read_mapped_csv(path, options.columns, robot)
        return _log_datasets(logs, robot, "CSV with a column map")
    if is_rtde(path):
        return _log_datasets([read_rtde(path, robot)], robot, RTDE_SOURCE)
    logs = read_mapped_csv(path, told_columns(path, robot), robot)
    return _log_datasets(logs, robot, "CSV, columns by their names")


def _log_datasets(logs: Sequence[TimedLog], robot: Robot, source: str) -> list[xr.Dataset]:
    """Return a run set of each log, which says so where its tool path is none of a sensor."""
    return [
        _named(
            timed_run(log, robot).to_dataset(),
            robot,
            source if log.tool is not None else f"{source}; {VIRTUAL_TOOL}",
            {},
        )
        for log in logs
    ]


def _named(runs: xr.Dataset, robot: Robot, source: str, choice: Mapping[str, object]) -> xr.Dataset:
    """Return a run set with the attributes of its origin."""
    runs.attrs |= {
        "robot": robot.name,
        "source": source,
        "failuretwin_version": __version__,
        "configuration": json.dumps(choice),
    }
    return runs
