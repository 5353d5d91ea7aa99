"""What the command line prints: a table of runs, scores, a confusion matrix."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from failuretwin.app.results import Record, as_unknown_line, score_line, score_records
from failuretwin.core.diagnosis import Diagnosis
from failuretwin.decision.metrics import Scores, judged_truth

TOLD_RUNS = 3
"""So few runs are explained in full on the screen; for more there are --plot and --json."""
PIPE_WIDTH = 160
"""Columns when the output is not a terminal, so that sentences stay whole."""


def table_console() -> Console:
    """Return where tables are printed."""
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=PIPE_WIDTH)


def print_diagnoses(diagnoses: Sequence[Diagnosis]) -> None:
    """Print a row a run."""
    known = any(d.truth is not None for d in diagnoses)
    table = Table(box=None, pad_edge=False)
    for column in ("run", *(["truth", ""] if known else []), "verdict", "log"):
        table.add_column(column, overflow="fold")
    for d in diagnoses:
        truth = [d.truth or "", _mark(d)] if known else []
        count = len(d.quality)
        quality = f"{count} remark{'s' * (count > 1)}" if count else ""
        table.add_row(d.run, *truth, d.verdict, quality)
    console = table_console()
    console.print(table)
    if len(diagnoses) <= TOLD_RUNS:
        for d in diagnoses:
            console.print(f"\n{d.run}")
            for line in (*d.explanation, *(f"the log: {remark}" for remark in d.quality)):
                console.print(f"  - {line}", soft_wrap=True)
    console.print(f"\n{diagnoses[0].method}", soft_wrap=True)


def _mark(diagnosis: Diagnosis) -> str:
    """Return whether a verdict is right; empty where there is none or the truth is not known."""
    if diagnosis.truth is None or diagnosis.diagnosis is None:
        return ""
    truth = judged_truth(diagnosis.truth, diagnosis.posterior)
    return "right" if truth == diagnosis.diagnosis else "WRONG"


def print_lines(lines: Sequence[str]) -> None:
    """Print lines of text."""
    console = table_console()
    for line in lines:
        console.print(line, soft_wrap=True)


def print_scores(records: Sequence[Record]) -> None:
    """Print how good the diagnoses are, if the truth of any run is known."""
    scores = score_records(records)
    if scores is None:
        return
    console = table_console()
    console.print(f"\n{score_line(records)}")
    if as_unknown := as_unknown_line(records):
        console.print(as_unknown, soft_wrap=True)
    console.print()
    console.print(_class_table(scores))
    console.print("\nconfusion matrix: a row for each truth, a column for each diagnosis")
    console.print(_confusion_table(scores))


def plain_table(*columns: str) -> Table:
    """Return an empty table without rules, its first column to the left, figures to the right."""
    table = Table(box=None, pad_edge=False)
    for i, column in enumerate(columns):
        table.add_column(column, justify="right" if i else "left")
    return table


def _class_table(scores: Scores) -> Table:
    table = plain_table("class", "runs", "precision", "recall", "F1")
    for row in scores.by_class():
        ratios = (f"{value:.3f}" for value in (row.precision, row.recall, row.f1))
        table.add_row(row.name, str(row.runs), *ratios)
    return table


def _confusion_table(scores: Scores) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column("truth")
    for i in range(len(scores.classes)):
        table.add_column(f"({i})", justify="right")
    for i, (name, row) in enumerate(zip(scores.classes, scores.confusion, strict=True)):
        table.add_row(f"({i}) {name}", *(str(count) if count else "." for count in row))
    return table
