"""One door for all inputs: run sets, raw session folders, whatever comes later."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from failuretwin import __version__
from failuretwin.core.errors import InputError
from failuretwin.core.runs import concatenate
from failuretwin.data_knowledge.raw_session import SESSION_FILES, find_sessions, read_session
from failuretwin.data_knowledge.session_runs import As, session_runs
from failuretwin.data_knowledge.store import SUFFIXES, load_run_set
from failuretwin.digital_model.robot import Robot, load_robot

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True)
class ReadOptions:
    """How raw logs become runs.

    Attributes:
        how: ``measured`` (readings at their times) or ``published`` (as the authors did).
        published_labels: Take the truth from folder names that end in ``_label_K`` and freeze the
            motor of labels 1 to 4.
    """

    how: As = "measured"
    published_labels: bool = False


def read_runs(
    sources: str | Path | Sequence[str | Path],
    robot: Robot | str = "armpi_fpv",
    options: ReadOptions | None = None,
) -> xr.Dataset:
    """Read runs from anything that holds some, as one run set.

    Args:
        sources: Run sets (.nc, .zarr) or folders with raw sessions, which are searched downwards.
        robot: The robot that raw sessions are of, or its name.
        options: How raw sessions are read.

    Raises:
        InputError: If a source does not exist, cannot be read or holds no runs.
    """
    if isinstance(robot, str):
        robot = load_robot(robot)
    if isinstance(sources, str | Path):
        sources = [sources]
    options = options or ReadOptions()
    parts = [part for source in sources for part in _read_source(Path(source), robot, options)]
    return concatenate(parts)


def _read_source(path: Path, robot: Robot, options: ReadOptions) -> list[xr.Dataset]:
    if not path.exists():
        raise InputError(f"{path}: does not exist. Expected a run set or a folder of raw sessions.")
    if path.suffix in SUFFIXES:
        return [load_run_set(path)]
    if not path.is_dir():
        raise InputError(
            f"{path}: not a kind of file that can be read. Expected a run set (.nc, .zarr) or a "
            f"folder that holds {', '.join(SESSION_FILES)}."
        )
    folders = find_sessions(path)
    if not folders:
        raise InputError(
            f"{path}: no raw session in it or below. A session is a folder that holds "
            f"{', '.join(SESSION_FILES)}."
        )
    return [_session_dataset(folder, robot, options) for folder in folders]


def _session_dataset(folder: Path, robot: Robot, options: ReadOptions) -> xr.Dataset:
    session = read_session(folder, robot)
    table = session_runs(session, robot, options.how, published_labels=options.published_labels)
    runs = table.to_dataset()
    runs.attrs |= {
        "robot": robot.name,
        "source": f"raw session, as {options.how}",
        "failuretwin_version": __version__,
        "configuration": json.dumps(
            {"as": options.how, "published_labels": options.published_labels}
        ),
    }
    return runs
