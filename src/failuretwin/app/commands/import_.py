"""`failuretwin import`: logs into a run set."""

from __future__ import annotations

from pathlib import Path

import click

from failuretwin.app.commands.options import PATH, common_options, reading_options


@click.command("import")
@click.argument("sources", nargs=-1, required=True, type=PATH, metavar="SRC...")
@click.option("--out", required=True, type=PATH, help="Run set to write (.nc or .zarr).")
@reading_options
@common_options
def import_(
    sources: tuple[Path, ...],
    out: Path,
    how: str,
    published_labels: bool,
    robot: str,
    seed: int,
) -> None:
    """Read logs and write them as one run set.

    SRC is a run set or a folder with raw sessions, which is searched downwards.
    """
    del seed  # nothing here is drawn by chance
    from failuretwin.app.inputs import read_inputs
    from failuretwin.data_knowledge.store import check_suffix, save_run_set
    from failuretwin.digital_model.robot import load_robot

    check_suffix(out)
    runs = read_inputs(sources, load_robot(robot), how, published_labels)
    save_run_set(runs, out)
    click.echo(f"{runs.sizes['run']} runs written to {out}")
