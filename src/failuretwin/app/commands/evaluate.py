"""`failuretwin evaluate`: how often results are right."""

from __future__ import annotations

from pathlib import Path

import click

import failuretwin as ft
from failuretwin.app.commands import options as opt
from failuretwin.app.terminal import show


@click.command()
@click.argument("results", type=opt.PATH, metavar="RESULTS.jsonl")
@opt.file_option(
    "--truth",
    "RUNS",
    "Run set or raw sessions with the truth, needed for the coverage of intervals. Default: "
    "the truth in the results.",
)
@opt.published_labels_option
@opt.file_option("--against", "OTHER.jsonl", "Compare with other results of the same runs.")
@opt.file_option("--latex", "FILE", "Write the scores as LaTeX tables.")
@opt.report_option("Write a picture of the reliability.")
@opt.plugin_option
@opt.robot_options
def evaluate(
    results: Path,
    truth: Path | None,
    published_labels: bool,
    against: Path | None,
    latex: Path | None,
    report: Path | None,
    robot: opt.RobotOptions,
) -> None:
    """Score the results of `diagnose --json` against the truth."""
    import numpy as np

    from failuretwin.app.reports.plots import write_reliability
    from failuretwin.app.reports.reports import comparison_parts, evaluation_parts, write_latex
    from failuretwin.decision.evaluation import Truths

    truths = None
    if truth is None:
        opt.refuse_unused("no runs with the truth are given", "published_labels")
    else:
        options = ft.ReadOptions(published_labels=published_labels)
        truths = Truths.of(ft.read_runs(truth, robot.robot, options), str(truth))
    first = ft.read_results(results)
    scores = ft.evaluate(first, truths, np.random.default_rng(robot.seed))
    comparison = None
    if against is not None:
        second, rng = ft.read_results(against), np.random.default_rng(robot.seed)
        comparison = ft.compare(first, second, truths, rng)
    if latex is not None:
        write_latex(scores, comparison, latex)
    if report is not None:
        write_reliability(scores, report)
    show(*evaluation_parts(scores, truth is not None))
    if comparison is not None:
        show(*comparison_parts(comparison))
