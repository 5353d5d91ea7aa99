"""Histories and answers of the store as sentences, tables and a page."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from failuretwin.app.terminal import SHOWN, Part, Table
from failuretwin.core.errors import counted
from failuretwin.data_knowledge.records.history import FaultEpisode, History, state_counts
from failuretwin.data_knowledge.records.offsets import Drift
from failuretwin.data_knowledge.records.queries import QueryAnswer


def episode_line(episode: FaultEpisode) -> str:
    """Return an episode in a line."""
    until = f" until {_time(episode.until)}" if episode.until else ""
    since = f"since {_time(episode.since)}{until}"
    return f"episode {episode.number}: {episode.fault}, {episode.state}, {since}"


def history_parts(history: History) -> list[Part]:
    """Return the history of a robot as sentences and tables."""
    kind = f" ({history.kind})" if history.kind not in ("", history.robot) else ""
    parts: list[Part] = [f"{history.robot}{kind}: {history.health}"]
    if history.counts:
        parts.append(f"diagnosed: {state_counts(history.counts)}")
    if history.episodes:
        parts += ["", _episodes_table(history.episodes)]
    wear = [one for one in history.drifts if len(one.at) > 1]
    if wear:
        parts += ["", _wear_table(wear)]
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


BLOCKS = "▁▂▃▄▅▆▇█"


def _wear_table(drifts: Sequence[Drift]) -> Table:
    """Return the offsets of the motors over time: first and last value, and the way between."""
    rows = [_wear_row(one) for one in drifts]
    headings = ["motor", "offset", "first", "last", "change", "unit", "over time"]
    return Table(headings, rows, "llrrrll", title="wear (mean +- standard deviation)")


def _wear_row(drift: Drift) -> list[str]:
    base, slash, load = drift.unit.partition("/")
    factor, unit = SHOWN.get(base, (1.0, base))
    first, last = (
        f"{factor * drift.values[k]:+.2f} +- {factor * drift.deviations[k]:.2f}" for k in (0, -1)
    )
    change = f"{factor * drift.change:+.2f}"
    return [drift.motor, drift.name, first, last, change, unit + slash + load, _course(drift)]


def _course(drift: Drift) -> str:
    """Return the values as blocks; their height spans six deviations at least."""
    values = np.asarray(drift.values)
    low, high = values.min(), values.max()
    span = max(high - low, 6.0 * float(np.median(drift.deviations)), 1e-12)
    share = (values - 0.5 * (low + high)) / span + 0.5
    return "".join(BLOCKS[int(one)] for one in np.round(share * (len(BLOCKS) - 1)))


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
        return f"{value:.1f}" if abs(value) >= 1.0 else f"{value:.2g}"
    return "" if value is None else str(value)


def _time(time: datetime | None) -> str:
    return "" if time is None else f"{time:%Y-%m-%d %H:%M}"


def write_history_page(history: History, folder: Path) -> None:
    """Write `index.html` with the history of a robot into a folder.

    Raises:
        OutputError: If it cannot be written; the folder is as before.
    """
    from failuretwin.app.reports.plots import write_index

    tone = "bad" if history.open_episodes else "good" if history.recent else "unknown"
    parts = history_parts(history)
    values = {
        "history": history,
        "tone": tone,
        "tables": [part for part in parts if isinstance(part, Table)],
        "lines": [part for part in parts[1:] if isinstance(part, str) and part],
    }
    write_index("history.html.j2", values, folder)
