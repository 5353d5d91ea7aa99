"""`failuretwin advise`: what to do about an arm, and how long its motors last."""

from __future__ import annotations

from pathlib import Path

import click

from failuretwin.app.commands.options import PATH, calibration_option, common_options, json_option
from failuretwin.app.terminal import tell


@click.command()
@click.argument(
    "source", metavar="[RESULTS.jsonl|HISTORY.history.jsonl]", type=PATH, required=False
)
@click.option(
    "--costs", type=PATH, metavar="FILE.toml", help="Cost table: downtime, repair, replacement."
)
@click.option("--template", type=PATH, metavar="FILE.toml", help="Write a cost table to fill in.")
@click.option("--run", metavar="NAME", help="Run to use. Default: the last one.")
@json_option("Write the advice.")
@calibration_option
@common_options
def advise(
    source: Path | None,
    costs: Path | None,
    template: Path | None,
    run: str | None,
    json_file: Path | None,
    calibration: Path | None,
    robot: str,
    seed: int,
) -> None:
    """Say what costs least: continue, compensate, slow down, inspect, replace, stop.

    RESULTS.jsonl is what `diagnose --json` wrote. Of a history that `diagnose --track` keeps, the
    remaining life of every motor is told; name its calibration (--calibration).
    """
    from failuretwin.app.maintenance import life_report, results_report, write_template
    from failuretwin.core.errors import InputError

    if template is not None:
        write_template(template)
        tell(f"costs to be filled in: {template}")
    if source is None:
        if template is None:
            raise InputError("nothing to advise on. Name results or a history, or --template FILE.")
        return
    if source.name.endswith(".history.jsonl"):
        lines = life_report(source, calibration, robot, seed, json_file)
    else:
        if costs is None:
            raise InputError(
                "costs are yours to say: name a file (--costs FILE.toml). `failuretwin advise "
                "--template FILE.toml` writes one to be filled in."
            )
        lines = results_report(source, costs, run, json_file)
    for line in lines:
        tell(line)
