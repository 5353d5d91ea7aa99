"""Reading of all inputs: run sets, raw sessions, MATLAB files, bags, LeRobot, RTDE, any CSV."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import TypeAlias, cast

from failuretwin import __version__
from failuretwin.core.errors import InputError
from failuretwin.core.foreign import files_below
from failuretwin.core.progress import Progress, unseen
from failuretwin.core.runs import RunSet, concatenate
from failuretwin.data_knowledge.readers.bag_file import is_bag
from failuretwin.data_knowledge.readers.bag_messages import BagTopics
from failuretwin.data_knowledge.readers.bags import read_bag
from failuretwin.data_knowledge.readers.column_guess import unambiguous_columns
from failuretwin.data_knowledge.readers.column_map import ColumnMap
from failuretwin.data_knowledge.readers.lerobot import (
    INFO_FILE,
    find_lerobot,
    is_lerobot,
    read_lerobot,
)
from failuretwin.data_knowledge.readers.lerobot_units import LeRobotAngles
from failuretwin.data_knowledge.readers.matlab import (
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
from failuretwin.data_knowledge.workers import ONE_PROCESS, Workforce
from failuretwin.digital_model.robot import Robot, load_robot

RunsLike: TypeAlias = "RunSet | str | Path | Sequence[str | Path]"
"""A run set, or where one is read from."""
CSV_FILES = ("*.csv",)
FILES = ("*.nc", "*.bag", "*.mcap", *CSV_FILES)
"""Files that are read below a folder: those of the first kind that is there."""
VIRTUAL_TOOL = "tool path = forward kinematics of the readings"
"""Words in the source of runs whose tool was watched by no sensor but the motors' encoders."""
RTDE_SOURCE = "RTDE; a tool path in it is computed by the controller from its encoders"


@dataclass(frozen=True)
class ReadOptions:
    """How logs become runs.

    Attributes:
        how: Raw sessions: ``measured`` (readings at their times) or ``published`` (as the authors).
        published_labels: Take the truth from folder names that end in ``_label_K`` and freeze the
            motor of labels 1 to 4.
        columns: Roles and units of the columns of CSV files.
        lerobot: Unit and sense of the numbers of LeRobot data sets.
        topics: Roles of the topics of bags, where their types leave a choice.
    """

    how: As = "measured"
    published_labels: bool = False
    columns: ColumnMap | None = None
    lerobot: LeRobotAngles | None = None
    topics: BagTopics | None = None


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
    workforce: Workforce = ONE_PROCESS,
) -> RunSet:
    """Read runs from anything that holds some, as one run set.

    Args:
        sources: Run sets (.nc, .zarr), folders with raw sessions or published MATLAB files (they
            are searched downwards), such files (.mat), bags (.bag, .mcap, folders of ROS 2),
            LeRobot data sets (folders), RTDE recordings, or CSV files, whose columns are found
            by their names or named by a column map. Folders of run sets, bags or CSV files are
            searched too.
        robot: The robot that the logs are of, or its name.
        options: How logs become runs.
        workforce: Processes that read the logs, each log once; the runs do not depend on them.

    Raises:
        InputError: If a source does not exist, cannot be read or holds no runs.
    """
    if isinstance(robot, str):
        robot = load_robot(robot)
    if isinstance(sources, str | Path):
        sources = [sources]
    options = options or ReadOptions()
    logs = find_logs([Path(source) for source in sources], options)
    return read_logs(logs, robot, options, workforce)


def read_logs(
    logs: Sequence[Log],
    robot: Robot,
    options: ReadOptions,
    workforce: Workforce = ONE_PROCESS,
    on_progress: Progress = unseen,
) -> RunSet:
    """Return the runs of some logs as one run set.

    `on_progress` is called with the number of further logs that have been read.

    Raises:
        InputError: If a log cannot be read.
    """
    parts: list[RunSet] = []
    with workforce.map(partial(read_log, robot=robot, options=options), logs) as found:
        for some in found:
            parts += some
            on_progress(1)
    return concatenate(parts)


def as_runs(runs: RunsLike, robot: Robot | str = "armpi_fpv") -> RunSet:
    """Return a run set as it is, or read it from wherever a path points; see `read_runs`."""
    if hasattr(runs, "data_vars"):
        return cast("RunSet", runs)
    return read_runs(runs, robot)


@dataclass(frozen=True)
class Reader:
    """Reader of one kind of log.

    Attributes:
        read: Returns the run sets in a log of its kind.
        recognises: Whether a path that exists is one.
        below: Returns the logs of its kind at or below a folder that is none itself.
    """

    read: Callable[[Path, Robot, ReadOptions], list[RunSet]]
    recognises: Callable[[Path], bool] = lambda path: False
    below: Callable[[Path], list[Path]] = lambda folder: []


@dataclass(frozen=True)
class Log:
    """The least that is read by itself: a file, a session folder, a data set.

    Attributes:
        path: Where it is.
        read: Returns the run sets in it.
    """

    path: Path
    read: Callable[[Path, Robot, ReadOptions], list[RunSet]]

    @property
    def is_run_set(self) -> bool:
        """Whether it is a stored run set, of which some runs can be read."""
        return self.read is _read_run_set


def read_log(log: Log, robot: Robot, options: ReadOptions) -> list[RunSet]:
    """Return the run sets in a log; raises as `read_runs` does."""
    return log.read(log.path, robot, options)


def find_logs(sources: Sequence[Path], options: ReadOptions) -> list[Log]:
    """Return the logs in some sources; folders are searched downwards.

    Raises:
        InputError: If a source does not exist or is of no kind that can be read.
    """
    return [log for source in sources for log in _logs_in(source, options)]


def _logs_in(path: Path, options: ReadOptions) -> list[Log]:
    if not path.exists():
        raise InputError(f"{path}: does not exist. Expected a run set, a log or a folder of logs.")
    if not (path.is_file() or path.is_dir()):
        raise InputError(f"{path}: is a device or a pipe. Expected a file or a folder of logs.")
    for reader in READERS:
        if reader.recognises(path):
            return [Log(path, reader.read)]
    if path.is_dir():
        return _logs_below(path, options)
    raise InputError(
        f"{path}: not a kind of file that can be read. Expected a run set (.nc, .zarr), a "
        "published MATLAB file (.mat), a bag (.bag, .mcap), a CSV file, an RTDE recording, a "
        f"LeRobot data set (a folder with {INFO_FILE}), or a folder that holds "
        f"{', '.join(SESSION_FILES)}."
    )


def _logs_below(path: Path, options: ReadOptions) -> list[Log]:
    found = [Log(log, reader.read) for reader in READERS for log in reader.below(path)]
    if found:
        return found
    for pattern in FILES if options.columns is None else CSV_FILES:
        if files := sorted(files_below(path, pattern)):
            return find_logs(files, options)
    raise InputError(
        f"{path}: no log in it or below. Expected raw sessions (folders that hold "
        f"{', '.join(SESSION_FILES)}), published MATLAB files, LeRobot data sets, or files "
        f"{', '.join(FILES)}."
    )


def _read_run_set(path: Path, robot: Robot, options: ReadOptions) -> list[RunSet]:
    return [load_run_set(path)]


def _read_bag(path: Path, robot: Robot, options: ReadOptions) -> list[RunSet]:
    return _log_datasets([read_bag(path, robot, options.topics)], robot, "bag")


def _read_lerobot(path: Path, robot: Robot, options: ReadOptions) -> list[RunSet]:
    found = read_lerobot(path, robot, options.lerobot)
    return _log_datasets(found.logs, robot, found.source)


def _read_session(folder: Path, robot: Robot, options: ReadOptions) -> list[RunSet]:
    session = read_session(folder, robot)
    runs = session_runs(session, robot, options.how, published_labels=options.published_labels)
    choice = {"as": options.how, "published_labels": options.published_labels}
    return [_named(runs, robot, f"raw session, as {options.how}; {VIRTUAL_TOOL}", choice)]


def _read_matlab(path: Path, robot: Robot, options: ReadOptions) -> list[RunSet]:
    runs = read_matlab_file(path, robot).to_dataset()
    return [_named(runs, robot, "published MATLAB file", {})]


def _read_csv(path: Path, robot: Robot, options: ReadOptions) -> list[RunSet]:
    """Return the runs of a text file: by the column map, else by its header."""
    if options.columns is not None:
        return _log_datasets(options.columns.logs(path, robot), robot, "CSV with a column map")
    source = RTDE_SOURCE if is_rtde(path) else "CSV, columns by their names"
    return _log_datasets(text_logs(path, robot), robot, source)


def is_text_log(path: Path) -> bool:
    """Return whether a path is a CSV file or a recording of RTDE."""
    return not path.is_dir() and (path.suffix == ".csv" or is_rtde(path))


def text_logs(path: Path, robot: Robot) -> Sequence[TimedLog]:
    """Return the logs in a CSV file, whose columns say by their names what they are, or of RTDE."""
    if is_rtde(path):
        return [read_rtde(path, robot)]
    return unambiguous_columns(path, robot).logs(path, robot)


READERS = (
    Reader(_read_run_set, lambda path: path.suffix in SUFFIXES),
    Reader(_read_bag, is_bag),
    Reader(_read_session, below=find_sessions),
    Reader(
        _read_matlab, lambda path: path.suffix == ".mat" and not path.is_dir(), find_matlab_files
    ),
    Reader(_read_lerobot, is_lerobot, find_lerobot),
    Reader(_read_csv, is_text_log),
)
"""Readers of all kinds of logs; the first one that recognises a path reads it."""


def _log_datasets(logs: Sequence[TimedLog], robot: Robot, source: str) -> list[RunSet]:
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


def _named(runs: RunSet, robot: Robot, source: str, choice: Mapping[str, object]) -> RunSet:
    """Return a run set with the attributes of its origin."""
    runs.attrs |= {
        "robot": robot.name,
        "source": source,
        "failuretwin_version": __version__,
        "configuration": json.dumps(choice),
    }
    return runs
