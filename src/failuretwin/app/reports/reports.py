"""Diagnoses and their scores as sentences and tables, for `diagnose` and `evaluate`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from failuretwin.app.terminal import Part, Table, figures_table
from failuretwin.core.errors import counted
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.data_knowledge.store import write_text
from failuretwin.decision import scoring
from failuretwin.decision.evaluation import (
    Calibration,
    Comparison,
    Evaluation,
    Judged,
    as_unknown_line,
    is_right,
    score_line,
)
from failuretwin.decision.robot_state import RobotState
from failuretwin.digital_model.robot import Robot
from failuretwin.inference.explanation import joint_names_in
from failuretwin.inference.together.fault_course import FaultCourse

MAX_EXPLAINED = 3
"""Maximum number of runs that are explained in full on the screen."""
MARKS = {True: "right", False: "WRONG", None: ""}
"""Marks of verdicts whose truth is known."""


def diagnosis_parts(diagnoses: Sequence[Diagnosis]) -> list[Part]:
    """Return a row a run; of a few runs, all that explains them."""
    known = any(d.truth is not None for d in diagnoses)
    headings = ("run", *(["truth", ""] if known else []), "verdict", "log")
    lines = []
    if len(diagnoses) <= MAX_EXPLAINED:
        for d in diagnoses:
            said = (*d.explanation, *(f"the log: {remark}" for remark in d.quality))
            lines += [f"\n{d.run}", *(f"  - {line}" for line in said)]
    else:
        first = diagnoses[0].quality
        shared = [line for line in first if all(line in d.quality for d in diagnoses)]
        lines = [f"\nevery log: {line}" for line in shared]
    table = Table(headings, [_diagnosis_row(d, known) for d in diagnoses])
    return [table, *lines, f"\n{diagnoses[0].method}"]


def _diagnosis_row(d: Diagnosis, known: bool) -> list[str]:
    count = len(d.quality)
    quality = counted(count, "remark") if count else ""
    return [d.run, *([d.truth or "", MARKS[is_right(d)]] if known else []), d.verdict, quality]


def state_lines(state: RobotState, together: bool) -> list[str]:
    """Return the state over several runs and the next step, as on the page, a line each.

    The diagnosis of a single run holds both; for runs weighed together see `course_lines`.
    """
    if together or state.runs < 2:
        return []
    return ["", f"over all runs: {state.line}", f"what to do: {state.step}"]


def course_lines(course: FaultCourse | None, state: RobotState, robot: Robot) -> list[str]:
    """Return the verdict over all runs and the next step; None: each was judged alone."""
    if course is None:
        return []
    told = [f"over all runs: {joint_names_in(line, robot)}" for line in course.verdict]
    return [*told, f"what to do: {state.step}"]


def score_parts(diagnoses: Sequence[Diagnosis] | Judged) -> list[Part]:
    """Return how good the diagnoses are, if the truth of any run is known."""
    judged = diagnoses if isinstance(diagnoses, Judged) else Judged.of(diagnoses)
    if not judged.diagnoses:
        return []
    unknown = [as_unknown_line(judged)] if judged.as_unknown else []
    tables = class_table(judged.scores), "", _confusion_table(judged.scores)
    return [f"\n{score_line(judged)}", *unknown, "", *tables]


def class_table(scores: scoring.Scores) -> Table:
    """Return precision, recall and F1 of each class."""
    return figures_table(
        ("class", "runs", "precision", "recall", "F1"),
        [
            (name, str(runs.sum()), *(f"{ratio:.3f}" for ratio in ratios))
            for name, runs, ratios in zip(
                scores.classes, scores.confusion, scores.ratios, strict=True
            )
        ],
    )


def _confusion_table(scores: scoring.Scores) -> Table:
    return figures_table(
        ("truth", *(f"({i})" for i in range(len(scores.classes)))),
        [
            (f"({i}) {name}", *(str(count) if count else "." for count in row))
            for i, (name, row) in enumerate(zip(scores.classes, scores.confusion, strict=True))
        ],
        "confusion matrix: a row for each truth, a column for each diagnosis",
    )


# Scores of `evaluate`.


def evaluation_parts(evaluation: Evaluation, truth_given: bool) -> list[Part]:
    """Return every score; without a run set given, no true onset or magnitude can be known."""
    parts = score_parts(evaluation.judged)
    parts += [f"\nall {evaluation.runs_and_protocol}", summary_table(evaluation)]
    if evaluation.calibration is not None:
        parts += ["", _reliability_table(evaluation.calibration.equal)]
    if evaluation.coverage:
        return [*parts, "", coverage_table(evaluation.coverage)]
    why = "needs true onsets and magnitudes, give --truth RUNS"
    if truth_given:
        why = "the truth names no onset or magnitude of a fault found"
    return [*parts, f"\ncoverage of intervals: {why}"]


def summary_table(evaluation: Evaluation) -> Table:
    """Return name and value of each score of all runs together."""
    scores, alarms = evaluation.scores, evaluation.alarms
    false_alarms = _percent(alarms.false_alarms) + _abstained(alarms.healthy_abstained)
    rows = [
        ("accuracy", _percent(scoring.Share(scores.right, scores.runs))),
        ("macro-F1", f"{scores.macro_f1:.3f}, mean over the classes that were true of any run"),
        ("false-alarm rate", false_alarms),
        ("missed-detection rate", _percent(alarms.missed) + _abstained(alarms.faulty_abstained)),
        ("log score", f"{scores.log_score:.3f} nats a run"),
        ("Brier score", f"{evaluation.brier:.3f} (0 is perfect, 2 the worst)"),
    ]
    if evaluation.calibration is not None:
        rows += _calibration_rows(evaluation.calibration)
    return Table(("Score", evaluation.runs_and_protocol), rows, header=False)


def _percent(share: scoring.Share) -> str:
    """Return a share and its Wilson interval in per cent; a dash for a share of nothing."""
    if not share.total:
        return "-"
    low, high = share.interval
    return (
        f"{100 * share.value:.1f} % (95 % interval {100 * low:.1f} to {100 * high:.1f} %), "
        f"{share.count} of {share.total} runs"
    )


def _abstained(count: int) -> str:
    return f", {count} without a verdict, which is no alarm" if count else ""


def _calibration_rows(calibration: Calibration) -> list[tuple[str, str]]:
    equal, adaptive = calibration.equal, calibration.adaptive
    typical, high = np.quantile(calibration.by_chance, [0.5, 0.95])
    return [
        ("calibration error", f"{equal.error:.3f} in {len(equal.count)} bins of equal width"),
        ("  by chance alone", f"{typical:.3f}, in 1 of 20 cases above {high:.3f}"),
        ("  adaptive", f"{adaptive.error:.3f} in {len(adaptive.count)} bins of about equal counts"),
    ]


def _reliability_table(bins: scoring.Reliability) -> Table:
    rows = []
    for i in np.flatnonzero(bins.count):
        right = scoring.Share(int(bins.right[i]), int(bins.count[i]))
        low, high = right.interval
        edges = f"{bins.edges[i]:.1f} to {bins.edges[i + 1]:.1f}"
        ratios = f"{bins.confidence[i]:.3f}", f"{right.value:.3f}", f"{low:.3f} to {high:.3f}"
        rows.append((edges, str(right.total), *ratios))
    return figures_table(
        ("confidence", "runs", "mean", "right", "95 % interval"),
        rows,
        "reliability: how often a verdict of such confidence is right",
    )


def coverage_table(coverage: Sequence[scoring.Coverage]) -> Table:
    """Return a row for each quantity of each fault mode."""
    rows = []
    for row in coverage:
        low, high = row.inside.interval
        share = f"{100 * row.inside.value:.1f} %", f"{100 * low:.1f} to {100 * high:.1f} %"
        counts = (str(count) for count in (row.below, row.above, row.points))
        rows.append((f"{row.quantity} of {row.mode}", str(row.inside.total), *share, *counts))
    return figures_table(
        ("interval", "runs", "inside", "95 % interval", "below", "above", "points"),
        rows,
        "coverage of the 90 % intervals, over runs whose fault was found",
    )


def comparison_parts(comparison: Comparison) -> list[Part]:
    """Return how two methods differ on the same runs."""
    head = f"\n{counted(comparison.runs, 'run')}, each by A and by B"
    return [head, *(f"{name}: {value}" for name, value in comparison_rows(comparison))]


def comparison_rows(comparison: Comparison) -> list[tuple[str, str]]:
    """Return name and value of each figure of a comparison."""
    split, (a, b) = comparison.split, comparison.as_unknown
    right = (
        f"both {split.both}, only A {split.first_only}, only B {split.second_only}, neither "
        f"{split.neither}; exact McNemar p = {split.p:.3g}"
    )
    rows = [("A", comparison.first), ("B", comparison.second), ("right", right)]
    if a or b:
        unknown = f"by A {a} runs, by B {b}: their truth is not among its hypotheses"
        rows.append(("judged as unknown", unknown))
    gain = comparison.gain
    if gain.first_impossible or gain.second_impossible or gain.both_impossible:
        impossible = (
            f"only by A in {gain.first_impossible} runs, only by B in {gain.second_impossible}, by "
            f"both in {gain.both_impossible}"
        )
        rows.append(("truth given no probability", impossible))
        rows.append(("log score, A minus B, all runs", f"{gain.mean:+.3f} nats a run"))
    if gain.runs:
        low, high = gain.interval
        better = "A is better" if high < 0.0 else "B is better" if low > 0.0 else "not settled"
        mean = (
            f"{gain.finite_mean:+.3f} nats a run (95 % bootstrap interval {low:+.3f} to "
            f"{high:+.3f}): {better}"
        )
        rows.append((f"log score, A minus B, {gain.runs} runs", mean))
    return rows


def write_latex(evaluation: Evaluation, comparison: Comparison | None, path: Path) -> None:
    """Write all scores, those of each class, coverage and the comparison, as tables for a paper."""
    summary, classes = summary_table(evaluation), class_table(evaluation.scores)
    if count := sum(evaluation.judged.as_unknown.values()):
        unknown = f"{count} runs, whose truth is not among the hypotheses"
        summary = replace(summary, rows=[*summary.rows, ("judged as unknown", unknown)])
    dashes = [["--" if cell == "nan" else cell for cell in row] for row in classes.rows]
    tables = [summary, figures_table(("Class", "Runs", "Precision", "Recall", "F1"), dashes)]
    if evaluation.coverage:
        rows = [row[:4] for row in coverage_table(evaluation.coverage).rows]
        tables.append(figures_table(("90 % interval", "Runs", "Inside", "95 % interval"), rows))
    if comparison is not None:
        tables.append(Table(("Compared", "on the same runs"), comparison_rows(comparison)))
    text = "\n".join([r"% \usepackage{booktabs}", *map(latex, tables)])
    write_text(text, path)


# Tables for papers (package booktabs).

ESCAPES = str.maketrans(
    {
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        **{letter: f"\\{letter}" for letter in "&%$#_{}"},
    }
)


def escaped(text: str) -> str:
    """Return `text` so that LaTeX prints it letter by letter."""
    return text.translate(ESCAPES)


def latex(table: Table) -> str:
    """Return a tabular with booktabs rules; the title is left to the paper."""
    lines = [
        rf"\begin{{tabular}}{{{''.join('r' if right else 'l' for _, right in table.columns)}}}",
        r"\toprule",
        _latex_row(table.headings),
        r"\midrule",
        *map(_latex_row, table.rows),
        r"\bottomrule",
        r"\end{tabular}",
    ]
    return "\n".join(lines) + "\n"


def _latex_row(cells: Sequence[str]) -> str:
    return " & ".join(escaped(cell.strip()) for cell in cells) + r" \\"
