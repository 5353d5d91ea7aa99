"""What the command line prints: a table of runs, scores, a confusion matrix."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from failuretwin.core.hypothesis import Diagnosis, Hypothesis
from failuretwin.core.types import as_floats
from failuretwin.decision.metrics import Scores, judged_truth
from failuretwin.decision.results import Record, as_unknown_line, score_line, score_records
from failuretwin.digital_model.urdf import UrdfJoint
from failuretwin.digital_model.urdf_check import JointReport, UrdfReport
from failuretwin.digital_model.urdf_findings import has_range
from failuretwin.inference.diagnoser import BayesDiagnoser
from failuretwin.inference.explanation import plain_name, size_words
from failuretwin.inference.isolability import IsolabilityReport, isolability

if TYPE_CHECKING:
    import xarray as xr

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


# Where tables go: the terminal, or a pipe wide enough to keep sentences whole.

"""Columns when the output is not a terminal."""


def console() -> Console:
    """Return the console to print on."""
    terminal = Console(highlight=False)
    return terminal if terminal.is_terminal else Console(highlight=False, width=PIPE_WIDTH)


# Progress of long work, shown on a terminal and nowhere else.


@contextmanager
def progress_bar(what: str, total: int) -> Iterator[Callable[[int], None]]:
    """Give a function to call with the number of steps just done.

    Args:
        what: What is being done, such as ``simulating``.
        total: Number of steps in all.
    """
    if not sys.stderr.isatty():
        yield lambda done: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(what, total=total)
        yield lambda done: progress.advance(task, done)


# What the motion of the runs at hand could not tell, in a line or two.

MOST_MOTIONS = 3
"""Motions that are looked at, spread evenly over the runs."""
MOST_HYPOTHESES = 16
"""More hypotheses take longer to tell apart than to diagnose; then the user is left to ask."""


def ambiguity_lines(runs: xr.Dataset, diagnoser: BayesDiagnoser) -> list[str]:
    """Return which faults such motions cannot tell apart, and the smallest that they show.

    Args:
        runs: The runs that were diagnosed.
        diagnoser: Who diagnosed them; of its hypotheses healthy and single faults count.
    """
    single = [h for h in diagnoser.hypothesis_set if h.known and len(h.faults) <= 1]
    left_out = _left_out_lines([h for h in diagnoser.hypothesis_set if h not in single])
    if not any(h.faults for h in single):
        return left_out
    if len(single) > MOST_HYPOTHESES:
        return [
            f"which of these {len(single)} hypotheses such motions tell apart may take longer to "
            f"work out than the diagnosis (done for up to {MOST_HYPOTHESES}): call "
            "failuretwin.isolability in Python (docs/isolability.md), or name fewer with "
            "--hypotheses",
            *left_out,
        ]
    command = as_floats(runs["command"].values)
    moving = np.flatnonzero(np.ptp(command, axis=1).any(axis=1))
    some = moving[np.unique(np.linspace(0, len(moving) - 1, MOST_MOTIONS).astype(int))]
    found = isolability(
        diagnoser.twin,
        command[some],
        as_floats(runs["time"].values),
        imperfections=diagnoser.imperfections,
        hypotheses=single,
        priors=diagnoser.priors,
        onset_s=diagnoser.priors.onset.known_s or 0.0,
    )
    return _group_lines(found) + _size_lines(found) + left_out


def _left_out_lines(others: Sequence[Hypothesis]) -> list[str]:
    """Return the hypotheses that nothing is said of here: pairs of faults, and `unknown`."""
    pairs = sum(len(h.faults) > 1 for h in others)
    names = [f"{pairs} pair{'s' * (pairs > 1)} of faults"] * (pairs > 0)
    names += [str(h) for h in others if not h.known]
    if not names:
        return []
    return [f"what motions tell apart is said of single faults only, not of {' and '.join(names)}"]


def _group_lines(found: IsolabilityReport) -> list[str]:
    """Return the groups, with the sizes at which their faults look alike."""
    groups = [
        " or ".join(_name(name, found.typical.get(name)) for name in group)
        for group in found.groups
    ]
    if not groups:
        return []
    sized = any(name in found.typical for group in found.groups for name in group)
    when = " when faults are as large as this" if sized else ""
    return [f"cannot be told apart by such motions{when}: {'; '.join(groups)}"]


def _size_lines(found: IsolabilityReport) -> list[str]:
    """Return the smallest sizes that are found, and what is known of faults never found."""
    hidden = [name for name, size in found.isolated.items() if size is None]
    alarms = {name: found.detected[name] for name in hidden}
    lines = {
        "smallest faults that such motions show": found.isolated,
        "not shown for certain, even when as large as this": {n: found.largest[n] for n in hidden},
        "of these, that something is wrong shows from this size on": alarms,
    }
    return [
        f"{what}: {', '.join(_name(name, size) for name, size in sizes.items() if size)}"
        for what, sizes in lines.items()
        if any(sizes.values())
    ]


def _name(hypothesis: str, size: float | None = None) -> str:
    """Return a hypothesis as a person would say it, with the size of its fault if it has one."""
    parsed = Hypothesis.parse(hypothesis)
    if size is None:
        return plain_name(parsed)
    return plain_name(parsed) + size_words(parsed.faults[0], size).replace("+", "")  # either sign


# What `robot check` prints: the joints of a URDF and what was found.


def print_report(report: UrdfReport) -> None:
    """Print the chain, its joints and all findings that are no errors."""
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=PIPE_WIDTH)
    if report.joints:
        console.print(_summary(report))
        console.print(_joint_table(report))
    for severity in ("warning", "note"):
        for message in report.having(severity):
            console.print(f"\n{severity}: {escape(message)}")


def _summary(report: UrdfReport) -> str:
    count = len(report.motors)
    return escape(
        f"{report.name or report.source.name}: from {report.base_link} to {report.tool_link}, "
        f"{count} motor{'s' * (count != 1)} can move the tool point\n"
        f"the tool gets {report.reach:.3f} m away from the base's origin; "
        f"what moves weighs {report.moving_mass:.3f} kg\n"
    )


def _joint_table(report: UrdfReport) -> Table:
    table = Table(box=None, pad_edge=False)
    for column in ("joint", "type", "limits", "speed", "effort", "link mass", "motor"):
        table.add_column(column, overflow="fold")
    for joint in report.joints:
        table.add_row(*(escape(cell) for cell in _row(joint)))
    return table


def _row(report: JointReport) -> tuple[str, ...]:
    joint = report.joint
    moving = joint.type not in ("fixed", "floating", "planar")
    return (
        joint.name,
        joint.type,
        _limits(joint) if moving else "",
        _with_unit(_shown(joint, joint.velocity), _unit(joint) + "/s") if moving else "",
        _with_unit(joint.effort, "N" if joint.type == "prismatic" else "N m") if moving else "",
        _with_unit(report.mass, "kg") if moving or report.mass is not None else "",
        report.motor or f"- ({report.reason})",
    )


def _limits(joint: UrdfJoint) -> str:
    if joint.type == "continuous":
        return "endless"
    if not has_range(joint.low, joint.high):
        return "?"
    return f"{_shown(joint, joint.low):.4g} to {_shown(joint, joint.high):.4g} {_unit(joint)}"


def _shown(joint: UrdfJoint, value: float | None) -> float:
    """Return what is printed of an angle [rad] or a length [m]: degrees or millimetres."""
    if value is None:
        return math.nan
    return 1e3 * value if joint.type == "prismatic" else math.degrees(value)


def _unit(joint: UrdfJoint) -> str:
    return "mm" if joint.type == "prismatic" else "deg"


def _with_unit(value: float | None, unit: str) -> str:
    return "?" if value is None or math.isnan(value) else f"{value:.4g} {unit}"
