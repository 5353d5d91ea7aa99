"""`failuretwin evaluate`: how good stored diagnoses are."""

from __future__ import annotations

from pathlib import Path

import click

from failuretwin.app.commands.options import PATH, common_options, plugin_option


@click.command()
@click.argument("results", type=PATH, metavar="RESULTS.jsonl")
@click.option(
    "--truth",
    type=PATH,
    metavar="RUNS",
    help="Run set or raw sessions that know the truth; default: the results. Needed for the "
    "coverage of intervals.",
)
@click.option(
    "--published-labels",
    is_flag=True,
    help="Take the truth of raw sessions from folder names that end in _label_K, as diagnose does.",
)
@click.option(
    "--against",
    type=PATH,
    metavar="OTHER.jsonl",
    help="Compare with other results of the same runs.",
)
@click.option("--latex", type=PATH, metavar="FILE", help="Write the scores as LaTeX tables.")
@click.option("--plot", type=PATH, metavar="DIR", help="Write a picture of the reliability.")
@plugin_option
@common_options
def evaluate(
    results: Path,
    truth: Path | None,
    published_labels: bool,
    against: Path | None,
    latex: Path | None,
    plot: Path | None,
    robot: str,
    seed: int,
) -> None:
    """Score the results of `diagnose --json` against the truth."""
    import numpy as np

    from failuretwin.app.evaluation_tables import print_comparison, print_evaluation, write_latex
    from failuretwin.app.plots import write_reliability
    from failuretwin.app.tables import print_scores
    from failuretwin.core.errors import InputError
    from failuretwin.decision.evaluation import (
        Results,
        compare_results,
        evaluate_records,
        read_truths,
        with_truth,
    )
    from failuretwin.decision.results import read_json_lines

    truths = {} if truth is None else read_truths(truth, robot, published_labels)
    if published_labels and truth is None:
        raise InputError("--published-labels says how to read the truth. Add --truth RUNS.")

    def read(path: Path) -> Results:
        records = read_json_lines(path)
        known = records if truth is None else with_truth(records, truths, str(truth))
        return Results(str(path), known)

    first = read(results)
    evaluation = evaluate_records(first.records, truths, np.random.default_rng(seed))
    if evaluation is None:
        raise InputError(
            f"{results}: no run says what was true. Give a run set that does with --truth RUNS."
        )
    comparison = None
    if against is not None:
        comparison = compare_results(first, read(against), np.random.default_rng(seed))
    if latex is not None:
        write_latex(evaluation, comparison, latex)
    if plot is not None:
        write_reliability(evaluation, plot)
    print_scores(first.records)
    print_evaluation(evaluation, truth is not None)
    if comparison is not None:
        print_comparison(comparison)
