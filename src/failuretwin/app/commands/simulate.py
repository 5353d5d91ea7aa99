"""`failuretwin simulate`: runs made by the twin."""

from __future__ import annotations

from pathlib import Path

import click

from failuretwin.app.commands.options import PATH, common_options


@click.command()
@click.option("--out", required=True, type=PATH, help="Run set to write (.nc or .zarr).")
@click.option(
    "--runs-per-class",
    type=click.IntRange(min=1),
    default=400,
    show_default=True,
    help="Runs of each hypothesis; the paper has 400.",
)
@click.option(
    "--hypotheses",
    metavar="H,...",
    help="What to simulate, such as healthy,motor_2:stuck. Default: the paper's nine classes.",
)
@click.option(
    "--imperfections",
    default="none",
    show_default=True,
    metavar="none|NAME|FILE",
    help="What the robot does that its twin does not: nothing, what is known of the robot of that "
    "name, or a TOML file.",
)
@click.option(
    "--workers",
    type=click.IntRange(min=1),
    default=1,
    show_default=True,
    help="Processes to spread the work over; the runs do not depend on it.",
)
@common_options
def simulate(
    out: Path,
    runs_per_class: int,
    hypotheses: str | None,
    imperfections: str,
    workers: int,
    robot: str,
    seed: int,
) -> None:
    """Make labelled runs with the digital twin and write them as a run set."""
    from failuretwin.app.progress import progress_bar
    from failuretwin.connection.calibration.loops import robot_as_calibrated
    from failuretwin.core.hypothesis import paper_hypotheses, parse_hypotheses
    from failuretwin.data_knowledge import generation
    from failuretwin.data_knowledge.store import check_destination, save_run_set
    from failuretwin.digital_model.imperfections import load_imperfections
    from failuretwin.digital_model.robot import load_robot

    check_destination(out)
    model = robot_as_calibrated(load_robot(robot), imperfections)
    names = model.motor_names
    plan = generation.Plan(
        robot=model,
        hypotheses=(
            parse_hypotheses(hypotheses.split(","), names)
            if hypotheses is not None
            else paper_hypotheses(names)
        ),
        runs_per_class=runs_per_class,
        seed=seed,
        imperfections=load_imperfections(imperfections, model),
    )
    with progress_bar("simulating", plan.size) as advance:
        runs = generation.simulate(plan, workers, advance)
    save_run_set(runs, out)
    click.echo(f"{plan.size} runs written to {out}")
