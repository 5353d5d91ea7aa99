"""`failuretwin import`: logs into a run set."""

from __future__ import annotations

from pathlib import Path

import click

from failuretwin.app.commands.options import PATH, LogOptions, common_options, reading_options


@click.command("import")
@click.argument("sources", nargs=-1, required=True, type=PATH, metavar="SRC...")
@click.option(
    "--out",
    required=True,
    type=PATH,
    help="What to write: a run set (.nc, .zarr), a published layout (.mat: one file of cells, no "
    "ending for a folder of pairs), or .csv.",
)
@reading_options
@common_options
def import_(
    sources: tuple[Path, ...],
    out: Path,
    reading: LogOptions,
    robot: str,
    seed: int,
) -> None:
    """Read logs and write them as one run set.

    SRC is a run set (.nc, .zarr), a folder with raw sessions or published MATLAB files (searched
    downwards), such a file (.mat), a bag (.bag, .mcap), or a CSV file with --columns.
    """
    del seed  # nothing here is drawn by chance
    from failuretwin.app.inputs import read_inputs
    from failuretwin.core.errors import InputError
    from failuretwin.data_knowledge.exports import check_export_suffix, export_runs
    from failuretwin.digital_model.robot import load_robot
    from failuretwin.digital_model.twin import DigitalTwin

    check_export_suffix(out)
    if out.resolve() in [source.resolve() for source in sources]:
        raise InputError(f"{out}: is what is to be read. Give another name to write to.")
    model = load_robot(robot)
    runs = read_inputs(sources, model, reading)
    export_runs(runs, out, DigitalTwin(model))
    click.echo(f"{runs.sizes['run']} runs written to {out}")
