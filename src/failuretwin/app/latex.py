"""Scores as LaTeX tables (package booktabs), for papers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from failuretwin.app.comparison import Comparison
from failuretwin.app.evaluation import Evaluation
from failuretwin.app.evaluation_tables import comparison_rows, summary_rows
from failuretwin.data_knowledge.store import replacing

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


def latex_table(columns: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a tabular with booktabs rules.

    Args:
        columns: Column letters, such as ``"lrr"``.
        header: Title of each column.
        rows: Cells, escaped here.
    """
    lines = [_row(row) for row in rows]
    return "\n".join(
        [
            rf"\begin{{tabular}}{{{columns}}}",
            r"\toprule",
            _row(header),
            r"\midrule",
            *lines,
            r"\bottomrule",
            r"\end{tabular}",
            "",
        ]
    )


def _row(cells: Sequence[str]) -> str:
    return " & ".join(escaped(cell.strip()) for cell in cells) + r" \\"


def latex_text(evaluation: Evaluation, comparison: Comparison | None) -> str:
    """Return all scores, those of each class, coverage and the comparison, as tables."""
    runs = f"{evaluation.scores.runs} runs, protocol {evaluation.protocol}"
    classes = [
        (row.name, str(row.runs), *(_ratio(v) for v in (row.precision, row.recall, row.f1)))
        for row in evaluation.scores.by_class()
    ]
    parts = [
        r"% \usepackage{booktabs}",
        latex_table("ll", ("Score", runs), _score_rows(evaluation)),
        latex_table("lrrrr", ("Class", "Runs", "Precision", "Recall", "F1"), classes),
    ]
    if evaluation.coverage:
        header = ("90 % interval", "Runs", "Inside", "95 % interval")
        parts.append(latex_table("lrrr", header, _coverage_rows(evaluation)))
    if comparison is not None:
        rows = comparison_rows(comparison)
        parts.append(latex_table("ll", ("Compared", "on the same runs"), rows))
    return "\n".join(parts)


def _score_rows(evaluation: Evaluation) -> list[tuple[str, str]]:
    rows = summary_rows(evaluation)
    if evaluation.as_unknown:
        what = f"{evaluation.as_unknown} runs, whose truth is not among the hypotheses"
        rows.append(("judged as unknown", what))
    return rows


def _coverage_rows(evaluation: Evaluation) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for row in evaluation.coverage:
        low, high = (f"{100 * end:.1f}" for end in row.inside.interval)
        share = f"{100 * row.inside.value:.1f} %"
        name = f"{row.quantity} of {row.mode}"
        rows.append((name, str(row.inside.total), share, f"{low} to {high} %"))
    return rows


def _ratio(value: float) -> str:
    return "--" if math.isnan(value) else f"{value:.3f}"


def write_latex(evaluation: Evaluation, comparison: Comparison | None, path: Path) -> None:
    """Write the tables; the file appears whole or not at all."""
    with replacing(path) as partial:
        partial.write_text(latex_text(evaluation, comparison), encoding="utf-8")
