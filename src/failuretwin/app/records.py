"""The store behind commands: what they take from it, what they add, and how it is shown."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from failuretwin.app.terminal import Part, Table, tell
from failuretwin.connection.calibration.result import Calibration, calibration_text
from failuretwin.core.errors import counted
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.core.runs import concatenate
from failuretwin.data_knowledge.records.history import (
    FaultEpisode,
    History,
    StoredCalibration,
    state_counts,
)
from failuretwin.data_knowledge.records.log_files import log_file
from failuretwin.data_knowledge.records.queries import QueryAnswer
from failuretwin.data_knowledge.records.store import Store
from failuretwin.data_knowledge.store import filling
from failuretwin.digital_model.calibrated_robot import CalibratedRobot, calibration_from_table
from failuretwin.digital_model.robot import Robot

if TYPE_CHECKING:
    import xarray as xr


class DiagnosisKeeper:
    """Keeps the diagnoses of one command, log by log.

    Args:
        store: The store.
        logs: The logs.
        read: Returns the runs of each log as a run set of its own.
        robot_name: Name of the robot; None: that of its profile.
        recorded: When they were recorded (UTC); None: when each was last modified.
    """

    def __init__(
        self,
        store: Store,
        logs: Sequence[Path],
        read: Callable[[Robot], list[xr.Dataset]],
        robot_name: str | None,
        recorded: datetime | None,
    ) -> None:
        self._store = store
        self._logs = logs
        self._read = read
        self._robot_name = robot_name
        self._recorded = recorded
        self._parts: list[xr.Dataset] = []
        self._calibration: StoredCalibration | None = None

    def calibrated(self, robot: Robot) -> CalibratedRobot | None:
        """Return the robot with its calibration of the store, and say so; None: it has none."""
        name = self._robot_name or robot.name
        stored = self._calibration = self._store.calibration(name)
        if stored is None:
            return None
        since = f"{stored.valid_from:%Y-%m-%d}"
        tell(f"calibration of {name} from the store: {stored.name}, valid from {since}", err=True)
        where = f"{self._store.name}: calibration {stored.name!r}"
        return calibration_from_table(tomllib.loads(stored.document), robot, where)

    def runs(self, robot: Robot) -> xr.Dataset:
        """Return the runs of all logs as one run set."""
        self._parts = self._read(robot)
        return concatenate(self._parts)

    def remember(self, diagnoses: Sequence[Diagnosis], robot: Robot) -> list[str]:
        """Store the diagnoses of all runs, and return what was stored, in lines."""
        name, rest = self._robot_name or robot.name, list(diagnoses)
        added = known = 0
        changed: dict[int, FaultEpisode] = {}
        for log, part in zip(self._logs, self._parts, strict=True):
            names = map(str, part["run"].values)
            own = [replace(one, run=run) for run, one in zip(names, rest, strict=False)]
            del rest[: len(own)]
            done = self._store.remember(
                own,
                name,
                log=log_file(log, self._recorded),
                runs=part,
                profile=robot,
                calibration=None if self._calibration is None else self._calibration.number,
            )
            added, known = added + done.added, known + done.known
            changed |= {one.number: one for one in done.episodes}
        before = f", {known} known before" if known else ""
        first = f"remembered in {self._store.name}: {counted(added, 'run')} of {name}{before}"
        return [first, *(episode_line(one) for one in changed.values())]


def keep_calibration(store: Store, name: str, found: Calibration, robot: Robot) -> str:
    """Store a calibration, and return what was stored, in a line."""
    figures = found.imperfections
    kept = store.keep_calibration(
        name,
        calibration_text(found, robot),
        name=figures.name,
        protocol=figures.protocol,
        profile=robot,
    )
    return f"remembered in {store.name}: calibration {kept.name} of {name}, in force from now on"


# Words and tables.


def episode_line(episode: FaultEpisode) -> str:
    """Return an episode in a line."""
    until = f" until {_time(episode.until)}" if episode.until else ""
    since = f"since {_time(episode.since)}{until}"
    return f"episode {episode.number}: {episode.motor} {episode.mode}, {episode.state}, {since}"


def history_parts(history: History) -> list[Part]:
    """Return the history of a robot as sentences and tables."""
    kind = f" ({history.kind})" if history.kind not in ("", history.robot) else ""
    parts: list[Part] = [f"{history.robot}{kind}: {history.health}"]
    if history.counts:
        parts.append(f"diagnosed: {state_counts(history.counts)}")
    if history.episodes:
        parts += ["", _episodes_table(history.episodes)]
    if history.timeline:
        rows = [[_time(one.at), one.kind, one.text] for one in history.timeline]
        parts += ["", Table(["when (UTC)", "event", ""], rows, title="timeline")]
    earlier = sum(history.counts.values()) - len(history.recent)
    if earlier > 0:
        parts.append(f"{counted(earlier, 'earlier run')} not listed")
    return parts


def _episodes_table(episodes: Sequence[FaultEpisode]) -> Table:
    rows = [
        [
            *(str(one.number), one.motor, one.mode, one.state),
            *(_time(one.since), _time(one.until)),
            _finding(one),
        ]
        for one in episodes
    ]
    headings = ["episode", "motor", "mode", "state", "since", "until", "finding"]
    return Table(headings, rows, "rllllll", title="fault episodes")


def _finding(episode: FaultEpisode) -> str:
    found = episode.finding
    return "" if found is None else ", ".join(filter(None, (found.verdict, found.cause)))


def query_table(answer: QueryAnswer) -> Table:
    """Return the answer to a ready question as a table."""
    rows = [[_cell(value) for value in row] for row in answer.rows]
    return Table([name.replace("_", " ") for name in answer.columns], rows, title=answer.title)


def _cell(value: Any) -> str:
    if isinstance(value, datetime):
        return _time(value)
    if isinstance(value, float):
        return f"{value:.1f}"
    return "" if value is None else str(value)


def _time(time: datetime | None) -> str:
    return "" if time is None else f"{time:%Y-%m-%d %H:%M}"


def write_history_page(history: History, folder: Path) -> None:
    """Write `index.html` with the history of a robot into a folder.

    Raises:
        OutputError: If it cannot be written; the folder is as before.
    """
    from failuretwin.app.reports.plots import render_page

    tone = "bad" if history.open_episodes else "good" if history.recent else "unknown"
    parts = history_parts(history)
    values = {
        "history": history,
        "tone": tone,
        "tables": [part for part in parts if isinstance(part, Table)],
        "lines": [part for part in parts[1:] if isinstance(part, str) and part],
    }
    text = render_page("history.html.j2", values)
    with filling(folder) as partial:
        (partial / "index.html").write_text(text, encoding="utf-8")
