"""The live view on a terminal: motors, residual, posterior over time, what changed."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence

import numpy as np
from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from failuretwin.app.shadow import Change, Snapshot
from failuretwin.connection.links.base import LinkCounts
from failuretwin.connection.links.statuses import (
    LEVEL_ERROR,
    LEVEL_NAMES,
    LEVEL_OK,
    LEVEL_STALE,
    LEVEL_WARN,
    statuses,
)
from failuretwin.core.foreign import printable

STYLES = {
    LEVEL_OK: "green",
    LEVEL_WARN: "yellow",
    LEVEL_ERROR: "bold red",
    LEVEL_STALE: "magenta",
}
BLOCKS = " ▁▂▃▄▅▆▇█"
COLUMNS = 60
"""Width of the posterior over time."""
COLUMN_S = 1.0
"""Time of the stream that one column stands for [s]."""
RESIDUAL_MM = 50.0
"""Residual that fills its bar [mm]."""
BAR = 20
SHOWN_HYPOTHESES = 6
SHOWN_CHANGES = 8


class View:
    """Draws what the shadow knows."""

    def __init__(self, motors: Sequence[str], source: str) -> None:
        self._motors = motors
        self._source = source
        self._history: deque[dict[str, float]] = deque(maxlen=COLUMNS)
        self._next_s = -np.inf

    def remember(self, snapshot: Snapshot) -> None:
        """Take a snapshot into the posterior over time; time without any is a gap."""
        now_s = snapshot.stream_time
        if now_s < self._next_s:
            return
        if np.isfinite(self._next_s):
            missing = int((now_s - self._next_s) / COLUMN_S)
            self._history.extend([{}] * min(missing, COLUMNS))
        self._next_s = now_s + COLUMN_S
        diagnosis, stale = snapshot.answer.diagnosis, snapshot.answer.state != "OK"
        known = diagnosis is not None and not stale
        self._history.append(dict(diagnosis.posterior) if known and diagnosis else {})

    def draw(
        self, snapshot: Snapshot, counts: LinkCounts, changes: Sequence[Change]
    ) -> RenderableType:
        """Return the view of what is known now; of the changes the newest is the last."""
        lines = [Text(printable(str(change))) for change in list(changes)[-SHOWN_CHANGES:]]
        return Group(
            self._head(snapshot, counts),
            self._motor_table(snapshot),
            Panel(self._posterior(), title=f"posterior, last {COLUMNS} s", title_align="left"),
            Panel(Group(*lines), title="what changed", title_align="left"),
        )

    def _head(self, snapshot: Snapshot, counts: LinkCounts) -> Text:
        arm = statuses(snapshot.answer, self._motors)[0]
        head = Text(f"{LEVEL_NAMES[arm.level]:6s}", STYLES[arm.level])
        head.append(f" {printable(arm.message)}\n", "default")
        off = float(np.linalg.norm(snapshot.residual)) * 1000.0
        share = 0.0 if np.isnan(off) else min(1.0, off / RESIDUAL_MM)
        said = "no reading" if np.isnan(off) else f"{off:5.1f} mm off the reference"
        head.append(
            f"{printable(self._source)}  {snapshot.stream_time:.1f} s  {counts.received} events, "
            f"{counts.garbage} garbage, {counts.dropped} dropped, {counts.reconnects} reconnects, "
            f"{1000 * snapshot.seconds:.1f} ms a sample\n",
            "dim",
        )
        head.append(f"tool   {_bar(share)} {said}", "default")
        return head

    def _motor_table(self, snapshot: Snapshot) -> Table:
        table = Table(box=None, pad_edge=False)
        for name in ("motor", "state", "faulty", "", "how"):
            table.add_column(name)
        for status in statuses(snapshot.answer, self._motors)[1:]:
            probability = float(status.values.get("probability", 0.0))
            table.add_row(
                printable(status.name),
                Text(LEVEL_NAMES[status.level], STYLES[status.level]),
                f"{100 * probability:5.1f} %" if status.values else "",
                _bar(probability),
                printable(status.message),
            )
        return table

    def _posterior(self) -> Table:
        """Return the posterior over time, a row for each hypothesis that ever mattered."""
        weight = Counter[str]()
        for column in self._history:
            weight.update(column)
        table = Table(box=None, show_header=False, pad_edge=False)
        for name, _ in weight.most_common(SHOWN_HYPOTHESES):
            blocks = "".join(_block(column.get(name)) for column in self._history)
            last = self._history[-1].get(name)
            table.add_row(printable(name), blocks, "" if last is None else f"{100 * last:5.1f} %")
        return table


def _bar(share: float) -> str:
    full = round(BAR * share)
    return "█" * full + "·" * (BAR - full)


def _block(probability: float | None) -> str:
    if probability is None:
        return "?"
    return BLOCKS[round(probability * (len(BLOCKS) - 1))]
