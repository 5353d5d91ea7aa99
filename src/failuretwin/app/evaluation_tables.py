"""What `evaluate` prints beyond the short form of `diagnose`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.table import Table

from failuretwin.app.tables import plain_table, table_console
from failuretwin.data_knowledge.store import replacing
from failuretwin.decision.evaluation import Calibration, Comparison, Evaluation
from failuretwin.decision.metrics import Coverage, LogScoreGain, Reliability, Share


def percent_interval(share: Share) -> str:
    """Return a share and its Wilson interval in per cent; a dash for a share of nothing."""
    if not share.total:
        return "-"
    low, high = share.interval
    return (
        f"{100 * share.value:.1f} % (95 % interval {100 * low:.1f} to {100 * high:.1f} %), "
        f"{share.count} of {share.total} runs"
    )


def summary_rows(evaluation: Evaluation) -> list[tuple[str, str]]:
    """Return name and value of each score of all runs together."""
    scores, alarms = evaluation.scores, evaluation.alarms
    accuracy = Share(scores.right, scores.runs)
    rows = [
        ("accuracy", percent_interval(accuracy)),
        ("macro-F1", f"{scores.macro_f1:.3f}, mean over the classes that were true of any run"),
        (
            "false-alarm rate",
            percent_interval(alarms.false_alarms) + _abstained(alarms.healthy_abstained),
        ),
        (
            "missed-detection rate",
            percent_interval(alarms.missed) + _abstained(alarms.faulty_abstained),
        ),
        ("log score", f"{scores.log_score:.3f} nats a run"),
        ("Brier score", f"{evaluation.brier:.3f} (0 is perfect, 2 the worst)"),
    ]
    if evaluation.calibration is not None:
        rows += _calibration_rows(evaluation.calibration)
    return rows


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


def print_evaluation(evaluation: Evaluation, truth_given: bool) -> None:
    """Print every score but those that the short form has printed before.

    Args:
        evaluation: The scores.
        truth_given: Whether a run set could have known the true onsets and magnitudes.
    """
    console = table_console()
    summary = Table(box=None, pad_edge=False, show_header=False)
    for name, value in summary_rows(evaluation):
        summary.add_row(name, value)
    console.print(f"\nall {evaluation.scores.runs} runs, protocol {evaluation.protocol}")
    console.print(summary)
    if evaluation.calibration is not None:
        console.print("\nreliability: how often a verdict of such confidence is right")
        console.print(_reliability_table(evaluation.calibration.equal))
    console.print(f"\n{_coverage_title(evaluation.coverage, truth_given)}", soft_wrap=True)
    if evaluation.coverage:
        console.print(coverage_table(evaluation.coverage))


def _reliability_table(bins: Reliability) -> Table:
    table = plain_table("confidence", "runs", "mean", "right", "95 % interval")
    for i in np.flatnonzero(bins.count):
        right = Share(int(bins.right[i]), int(bins.count[i]))
        low, high = right.interval
        table.add_row(
            f"{bins.edges[i]:.1f} to {bins.edges[i + 1]:.1f}",
            str(right.total),
            f"{bins.confidence[i]:.3f}",
            f"{right.value:.3f}",
            f"{low:.3f} to {high:.3f}",
        )
    return table


def _coverage_title(coverage: Sequence[Coverage], truth_given: bool) -> str:
    if coverage:
        return "coverage of the 90 % intervals, over runs whose fault was found"
    if truth_given:
        return "coverage of intervals: the truth names no onset or magnitude of a fault found"
    return "coverage of intervals: needs true onsets and magnitudes, give --truth RUNS"


def coverage_table(coverage: Sequence[Coverage]) -> Table:
    """Return a row for each quantity of each fault mode."""
    table = plain_table("interval", "runs", "inside", "95 % interval", "below", "above", "points")
    for row in coverage:
        low, high = row.inside.interval
        table.add_row(
            f"{row.quantity} of {row.mode}",
            str(row.inside.total),
            f"{100 * row.inside.value:.1f} %",
            f"{100 * low:.1f} to {100 * high:.1f} %",
            *(str(count) for count in (row.below, row.above, row.points)),
        )
    return table


def print_comparison(comparison: Comparison) -> None:
    """Print how two result files differ on the same runs."""
    console = table_console()
    console.print(f"\n{comparison.runs} runs, each by A and by B")
    for name, value in comparison_rows(comparison):
        console.print(f"{name}: {value}", soft_wrap=True)


def comparison_rows(comparison: Comparison) -> list[tuple[str, str]]:
    """Return name and value of whatever says how two result files differ."""
    split = comparison.split
    return [
        ("A", comparison.first),
        ("B", comparison.second),
        (
            "right",
            f"both {split.both}, only A {split.first_only}, only B {split.second_only}, neither "
            f"{split.neither}; exact McNemar p = {split.p:.3g}",
        ),
        *_unknown_rows(comparison.as_unknown),
        *_gain_rows(comparison.gain),
    ]


def _unknown_rows(as_unknown: tuple[int, int]) -> list[tuple[str, str]]:
    if not any(as_unknown):
        return []
    return [
        (
            "judged as unknown",
            f"by A {as_unknown[0]} runs, by B {as_unknown[1]}: their truth is not among its "
            "hypotheses",
        )
    ]


def _gain_rows(gain: LogScoreGain) -> list[tuple[str, str]]:
    rows = []
    if gain.first_impossible or gain.second_impossible or gain.both_impossible:
        rows.append(
            (
                "truth given no probability",
                f"only by A in {gain.first_impossible} runs, only by B in "
                f"{gain.second_impossible}, by both in {gain.both_impossible}",
            )
        )
        rows.append(("log score, A minus B, all runs", f"{gain.mean:+.3f} nats a run"))
    if gain.runs:
        low, high = gain.interval
        better = "A is better" if high < 0.0 else "B is better" if low > 0.0 else "not settled"
        rows.append(
            (
                f"log score, A minus B, {gain.runs} runs",
                f"{gain.finite_mean:+.3f} nats a run (95 % bootstrap interval {low:+.3f} to "
                f"{high:+.3f}): {better}",
            )
        )
    return rows


# Scores as LaTeX tables (package booktabs), for papers.

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
