"""`failuretwin study`: the paper's study from end to end."""

from __future__ import annotations

from pathlib import Path

import click

from failuretwin.app.commands.options import PATH, common_options


@click.command()
@click.option("--out", required=True, type=PATH, metavar="DIR", help="Folder for everything.")
@click.option(
    "--test",
    "test_path",
    type=PATH,
    metavar="PATH",
    help="Real runs to test on. Default: runs of the physics engine, as a stand-in.",
)
@click.option(
    "--published-labels",
    is_flag=True,
    help="Take the truth of raw test sessions from folder names that end in _label_K and freeze "
    "the motor of labels 1-4 from sample 49 on, as the authors of the data did.",
)
@click.option("--quick", is_flag=True, help="A small version of about two minutes.")
@click.option("--resume", is_flag=True, help="Go on with a study that was cut short.")
@common_options
def study(
    out: Path,
    test_path: Path | None,
    published_labels: bool,
    quick: bool,
    resume: bool,
    robot: str,
    seed: int,
) -> None:
    """Repeat the paper's study: train its network on the published twin, test it, write a page.

    Both feature sets, both readings of the learning rate, five repetitions, the figures of
    tables II and III beside the published ones. Each training that is done is kept.
    """
    from failuretwin.app.learning import check_learning
    from failuretwin.app.plots import figure_class
    from failuretwin.app.progress import progress_bar
    from failuretwin.app.study.data import real_test_set, stand_in_test_set
    from failuretwin.app.study.plan import StudyPlan, quick_plan
    from failuretwin.app.study.study import check_folder, run_study
    from failuretwin.core.errors import InputError
    from failuretwin.digital_model.robot import load_robot

    if published_labels and test_path is None:
        raise InputError("--published-labels says how to read a test set. Add --test PATH.")
    model = load_robot(robot)
    plan = quick_plan(seed) if quick else StudyPlan(seed)
    check_folder(out, resume)
    figure_class()  # better told before the work than after it
    test = (
        stand_in_test_set(plan, model)
        if test_path is None
        else real_test_set(test_path, model, published_labels)
    )
    check_learning()
    total = len(list(plan.jobs())) * plan.iterations
    with progress_bar("training", total) as advance:
        page = run_study(plan, model, test, out, advance)
    click.echo(f"written to {page}")
