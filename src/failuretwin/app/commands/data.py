"""`failuretwin import`, `simulate` and `robot`: runs from logs or the twin, robots from URDFs."""

from __future__ import annotations

from pathlib import Path

import click

from failuretwin.app.commands.options import (
    PATH,
    F,
    HypothesesOption,
    LogOptions,
    common_options,
    plugin_option,
    reading_options,
)


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
    from failuretwin.data_knowledge.matlab import check_export_suffix, export_runs
    from failuretwin.digital_model.robot import load_robot
    from failuretwin.digital_model.twin import DigitalTwin

    check_export_suffix(out)
    if out.resolve() in [source.resolve() for source in sources]:
        raise InputError(f"{out}: is what is to be read. Give another name to write to.")
    model = load_robot(robot)
    runs = read_inputs(sources, model, reading)
    export_runs(runs, out, DigitalTwin(model))
    click.echo(f"{runs.sizes['run']} runs written to {out}")


# `failuretwin simulate`: runs made by the twin.


@click.command()
@click.option("--out", required=True, type=PATH, help="Run set to write (.nc or .zarr).")
@click.option(
    "--runs-per-class",
    type=click.IntRange(min=1),
    default=400,
    help="Runs of each hypothesis; the paper has 400.",
)
@click.option(
    "--hypotheses",
    cls=HypothesesOption,
    metavar="H,...",
    help="What to simulate, such as healthy,motor_2:stuck. Default: the paper's nine classes.",
)
@click.option(
    "--imperfections",
    default="none",
    metavar="none|NAME|FILE",
    help="What the robot does that its twin does not: nothing, what is known of the robot of that "
    "name, or a TOML file.",
)
@click.option(
    "--engine",
    type=click.Choice(["servo", "physics"]),
    default="servo",
    help="What moves the robot: the published servo loops, or rigid-body physics (MuJoCo) with "
    "gears that stick and joints that flex.",
)
@click.option(
    "--faults",
    type=PATH,
    metavar="FILE",
    help="How large faults are, when they begin and how they grow: a TOML file with a table for "
    "each mode, such as [drift]. Default: the paper's stuck and steady_state_error; the other "
    "modes as assumed in docs/fault_modes.md.",
)
@click.option(
    "--workers",
    type=click.IntRange(min=1),
    default=1,
    help="Processes on this machine to spread the work over; the runs do not depend on it.",
)
@click.option(
    "--scheduler",
    metavar="ADDRESS",
    help="Dask scheduler whose workers do the work instead, such as tcp://host:8786. They must "
    "share the folder of --out.",
)
@plugin_option
@common_options
def simulate(
    out: Path,
    runs_per_class: int,
    hypotheses: str | None,
    imperfections: str,
    engine: str,
    faults: Path | None,
    workers: int,
    scheduler: str | None,
    robot: str,
    seed: int,
) -> None:
    """Make labelled runs with the digital twin and write them as a run set.

    To .zarr any number of runs can be written; if that is interrupted, the same command goes on
    with what is missing. Up to a few thousand can be written to .nc.
    """
    from failuretwin.app.tables import progress_bar
    from failuretwin.core.hypothesis import paper_hypotheses, parse_hypotheses
    from failuretwin.data_knowledge.generate import Plan
    from failuretwin.data_knowledge.resumable import produce
    from failuretwin.data_knowledge.store import check_destination
    from failuretwin.data_knowledge.workers import Workforce
    from failuretwin.digital_model.calibrated_robot import load_calibration
    from failuretwin.digital_model.robot import load_robot
    from failuretwin.failure_behavior.registry import MODES, load_modes

    check_destination(out)
    known = load_calibration(imperfections, load_robot(robot))
    names = known.robot.motor_names
    plan = Plan(
        robot=known.robot,
        hypotheses=paper_hypotheses(names)
        if hypotheses is None
        else parse_hypotheses(hypotheses.split(","), names),
        runs_per_class=runs_per_class,
        seed=seed,
        imperfections=known.imperfections,
        engine=engine,
        modes=MODES if faults is None else load_modes(faults),
    )
    workforce = Workforce(workers, scheduler)
    with progress_bar("simulating", plan.size) as advance:
        produce(plan, out, workforce, advance, tell=lambda text: click.echo(text, err=True))
    click.echo(f"{plan.size} runs written to {out}")


# `failuretwin robot`: bring a robot of your own, from its URDF.


def link_options(command: F) -> F:
    """Add what says where the chain begins and ends."""
    command = click.option(
        "--tool",
        metavar="LINK",
        help="Link whose origin is the tool point. Default: the end of the branch with the most "
        "moving joints.",
    )(command)
    return click.option(
        "--base", metavar="LINK", help="Link that carries the base frame. Default: the root."
    )(command)


@click.group()
def robot() -> None:
    """Look a URDF over and make a robot profile of it."""


@robot.command()
@click.argument("urdf", type=PATH)
@link_options
def check(urdf: Path, base: str | None, tool: str | None) -> None:
    """Say whether a URDF can be used, which motors move the tool, and what is missing."""
    from failuretwin.app.reports import print_report
    from failuretwin.digital_model.urdf_check import check_urdf

    report = check_urdf(urdf, base, tool)
    print_report(report)
    report.raise_errors()


@robot.command()
@click.argument("urdf", type=PATH)
@click.option("--out", required=True, type=PATH, metavar="PROFILE", help="Profile to write: .toml.")
@link_options
def init(urdf: Path, out: Path, base: str | None, tool: str | None) -> None:
    """Write a commented profile for the robot of a URDF, ready for --robot PROFILE."""
    from failuretwin.core.errors import InputError
    from failuretwin.data_knowledge.store import replacing
    from failuretwin.digital_model.robot import load_robot, profile_text
    from failuretwin.digital_model.urdf_check import check_urdf

    if out.suffix != ".toml":
        raise InputError(f"{out}: a profile ends in .toml. Give such a name.")
    if out.exists():
        raise InputError(f"{out}: exists already. Choose another name, or remove it first.")
    report = check_urdf(urdf, base, tool)
    text = profile_text(report, out)
    with replacing(out) as partial:
        partial.write_text(text, encoding="utf-8")
        load_robot(partial)
    for message in report.having("warning"):
        click.echo(f"warning: {message}", err=True)
    count = len(report.motors)
    click.echo(
        f"profile with {count} motor{'s' * (count != 1)} written to {out}; go through the "
        "lines that say 'assumed'"
    )
