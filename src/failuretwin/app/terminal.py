"""Output of commands: lines, tables and progress. Text of files is shown as text only.

Pages draw the same tables by the macro `table` of `base.html.j2`.
"""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from failuretwin.core.foreign import printable
from failuretwin.core.progress import Progress

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table as TerminalTable

PIPE_WIDTH = 160
"""Columns when the output is not a terminal, so that sentences stay whole."""


SHOWN = {"rad": (180.0 / math.pi, "deg"), "m": (1e3, "mm")}
"""Factor and unit in which an angle or a length is shown."""


def tell(text: str, *, err: bool = False) -> None:
    """Print a line to stdout, or to stderr; nothing if there is nothing to say."""
    if text:
        click.echo(printable(text), err=err)


@dataclass(frozen=True)
class Table:
    """Rows of text under headings.

    Attributes:
        headings: Headings of the columns.
        rows: Cells of each row, one for each heading.
        align: ``l`` (text) or ``r`` (figures) for each column; empty: all to the left.
        title: Title above the table; empty: none.
        header: Whether the headings are shown on a terminal.
    """

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    align: str = ""
    title: str = ""
    header: bool = True

    @property
    def columns(self) -> list[tuple[str, bool]]:
        """Heading of each column, and whether it holds figures."""
        align = self.align or "l" * len(self.headings)
        return [(name, side == "r") for name, side in zip(self.headings, align, strict=True)]


def figures_table(headings: Sequence[str], rows: Iterable[Sequence[str]], title: str = "") -> Table:
    """Return a table whose first column is text and all others figures."""
    return Table(headings, list(rows), "l" + "r" * (len(headings) - 1), title)


Part = str | Table
"""A sentence or a table of a report."""


def console() -> Console:
    """Return the console for all output; it takes brackets and colons literally."""
    from rich.console import Console

    plain = Console(highlight=False, markup=False, emoji=False)
    if not plain.is_terminal:
        plain.width = PIPE_WIDTH
    return plain


def show(*parts: Part) -> None:
    """Print sentences, which no width cuts, and tables; text of files only as text."""
    out = console()
    for part in parts:
        if isinstance(part, str):
            out.print(printable(part), soft_wrap=True)
            continue
        if part.title:
            out.print(printable(part.title), soft_wrap=True)
        out.print(drawn(part))


def drawn(table: Table) -> TerminalTable:
    """Return a table as a terminal shows it; its cells are text only."""
    from rich.table import Table as TerminalTable

    made = TerminalTable(box=None, pad_edge=False, show_header=table.header)
    for heading, right in table.columns:
        made.add_column(printable(heading), overflow="fold", justify="right" if right else "left")
    for row in table.rows:
        made.add_row(*map(printable, row))
    return made


def write_json(records: Iterable[Mapping[str, Any]], path: Path | None) -> None:
    """Write JSON objects, one a line; None: nothing is written."""
    from failuretwin.data_knowledge.store import write_records

    if path is not None:
        write_records(records, path)


@contextmanager
def until_interrupted() -> Iterator[None]:
    """End the block on Ctrl-C, and report it."""
    try:
        yield
    except KeyboardInterrupt:
        tell("stopped")


# Progress of long work: a bar on a terminal, now and then a line elsewhere.

REPORT_EVERY_S = 5.0
"""Time between two lines about progress; shorter work says nothing [s]."""


@contextmanager
def progress_bar(what: str, total: int) -> Iterator[Progress]:
    """Give a function to call with the number of steps just done, of `total` in all."""
    if not sys.stderr.isatty():
        yield _progress_lines(what, total)
        return
    from rich.console import Console
    from rich.progress import Progress as Bar

    with Bar(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(what, total=total)
        yield lambda steps: bar.advance(task, steps)


def _progress_lines(what: str, total: int) -> Progress:
    """Return a function that writes done, total and time left to stderr every few seconds."""
    begun_s = reported_s = time.monotonic()
    done = 0

    def advance(steps: int) -> None:
        nonlocal done, reported_s
        done += steps
        now_s = time.monotonic()
        if 0 < done < total and now_s - reported_s >= REPORT_EVERY_S:
            reported_s = now_s
            left_s = (now_s - begun_s) * (total - done) / done
            tell(f"{what}: {done} of {total}, about {left_s:.0f} s left", err=True)

    return advance


@contextmanager
def elapsed(what: str) -> Iterator[None]:
    """Tell now and then that the block goes on: nobody knows how long it takes."""
    if sys.stderr.isatty():
        from rich.console import Console

        with Console(stderr=True).status(what):
            yield
        return
    over = threading.Event()

    def tell_now_and_then() -> None:
        seconds = 0.0
        while not over.wait(REPORT_EVERY_S):
            seconds += REPORT_EVERY_S
            tell(f"{what}: {seconds:.0f} s so far", err=True)

    telling = threading.Thread(target=tell_now_and_then, daemon=True)
    telling.start()
    try:
        yield
    finally:
        over.set()
        telling.join()
