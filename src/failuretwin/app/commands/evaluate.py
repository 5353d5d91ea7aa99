"""`failuretwin evaluate`: how good stored diagnoses are."""

from __future__ import annotations

from pathlib import Path

import click

from failuretwin.app.commands.options import PATH, common_options


@click.command()
@click.argument("results", type=PATH, metavar="RESULTS.jsonl")
@click.option(
    "--truth", type=PATH, metavar="RUNS", help="Run set that knows the truth; default: the results."
)
@common_options
def evaluate(results: Path, truth: Path | None, robot: str, seed: int) -> None:
    """Score the results of `diagnose --json` against the truth."""
    del seed, robot  # nothing is drawn, and the results name their motors
    from failuretwin.app.results import read_json_lines, with_truth
    from failuretwin.app.tables import print_scores
    from failuretwin.core.errors import InputError

    records = read_json_lines(results)
    if truth is not None:
        records = with_truth(records, truth)
    if not any(record["truth"] for record in records):
        raise InputError(
            f"{results}: no run says what was true. Give a run set that does with --truth RUNS."
        )
    print_scores(records)
