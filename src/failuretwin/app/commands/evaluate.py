"""`failuretwin evaluate`: how often results are right."""

from __future__ import annotations

from pathlib import Path

import click

from failuretwin.app.commands.options import (
    PATH,
    common_options,
    plugin_option,
    published_labels_option,
    report_option,
)


@click.command()
@click.argument("results", type=PATH, metavar="RESULTS.jsonl")
@click.option(
    "--truth",
    type=PATH,
    metavar="RUNS",
    help="Run set or raw sessions that know the truth; default: the results. Needed for the "
    "coverage of intervals.",
)
@published_labels_option
@click.option(
    "--against",
    type=PATH,
    metavar="OTHER.jsonl",
    help="Compare with other results of the same runs.",
)
@click.option("--latex", type=PATH, metavar="FILE", help="Write the scores as LaTeX tables.")
@report_option("Write a picture of the reliability.")
@plugin_option
@common_options
def evaluate(
    results: Path,
    truth: Path | None,
    published_labels: bool,
    against: Path | None,
    latex: Path | None,
    report: Path | None,
    robot: str,
    seed: int,
) -> None:
    """Score the results of `diagnose --json` against the truth."""
    import numpy as np

    from failuretwin.app.reports.plots import write_reliability
    from failuretwin.app.reports.reports import (
        print_comparison,
        print_evaluation,
        write_latex,
    )
    from failuretwin.core.errors import InputError
    from failuretwin.data_knowledge.readers.read import ReadOptions, read_runs
    from failuretwin.decision import evaluation
    from failuretwin.decision.results import read_results

    truths = None
    if truth is not None:
        runs = read_runs(truth, robot, ReadOptions(published_labels=published_labels))
        truths = evaluation.Truths.of(runs, str(truth))
    elif published_labels:
        raise InputError("--published-labels says how to read the truth. Add --truth RUNS.")
    first = read_results(results)
    scores = evaluation.evaluate(first, truths, np.random.default_rng(seed))
    comparison = None
    if against is not None:
        second = read_results(against)
        comparison = evaluation.compare(first, second, truths, np.random.default_rng(seed))
    if latex is not None:
        write_latex(scores, comparison, latex)
    if report is not None:
        write_reliability(scores, report)
    print_evaluation(scores, truth is not None)
    if comparison is not None:
        print_comparison(comparison)
