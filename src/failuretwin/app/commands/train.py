"""`failuretwin train`: a network for a real robot, from its twin."""

from __future__ import annotations

from pathlib import Path

import click

from failuretwin.app.commands.options import PATH, HypothesesOption, common_options, plugin_option


@click.command()
@click.option("--out", required=True, type=PATH, metavar="MODEL", help="Network to write (.npz).")
@click.option(
    "--calibration",
    type=PATH,
    metavar="FILE",
    help="What `calibrate` learned of this robot. Default: the calibration its profile names.",
)
@click.option(
    "--network",
    type=click.Choice(["cnn", "motorwise", "lstm"]),
    default="cnn",
    show_default=True,
    help="A convolutional network, one that looks at every motor alike, or the paper's LSTM.",
)
@click.option(
    "--iterations",
    type=click.IntRange(min=1),
    default=6000,
    show_default=True,
    help="Batches of 64 runs to learn from.",
)
@click.option(
    "--hypotheses",
    cls=HypothesesOption,
    metavar="H,...",
    help="What the network tells apart, such as healthy,motor_2:stuck. Default: the paper's nine "
    "classes.",
)
@plugin_option
@common_options
def train(
    out: Path,
    calibration: Path | None,
    network: str,
    iterations: int,
    hypotheses: str | None,
    robot: str,
    seed: int,
) -> None:
    """Train a network on the imperfect twin, for `diagnose --method MODEL`.

    Runs come fresh from the generator, as various as real ones: no recorded failure is needed. Its
    probabilities are calibrated on simulated runs of the physics engine.
    """
    from failuretwin.app.inputs import check_learning, told_hypotheses
    from failuretwin.app.tables import progress_bar
    from failuretwin.connection.calibration.result import robot_as_calibrated
    from failuretwin.data_knowledge.store import check_writable
    from failuretwin.digital_model.nonidealities import default_imperfections, load_imperfections
    from failuretwin.digital_model.robot import load_robot

    check_learning()
    from failuretwin.decision.learned.storage import check_network_file, save_network
    from failuretwin.decision.training import TrainingPlan, train_network

    check_network_file(out)
    check_writable(out)
    model = load_robot(robot)
    if calibration is None:
        imperfections = default_imperfections(model)
    else:
        model = robot_as_calibrated(model, str(calibration))
        imperfections = load_imperfections(str(calibration), model)
    told = told_hypotheses(hypotheses, model)
    plan = TrainingPlan(network, iterations, seed, hypotheses=told)
    with progress_bar("training", iterations) as advance:
        diagnoser, alone, both = train_network(plan, model, imperfections, lambda done: advance(1))
    save_network(diagnoser, out)
    click.echo(
        f"of {alone.runs} simulated runs of the physics engine {100.0 * alone.right:.1f} % right, "
        f"log score {alone.surprise:.3f} nats a run, temperature {diagnoser.temperature_:.2f}; "
        f"blended with Bayes {100.0 * both.right:.1f} %, {both.surprise:.3f} nats"
    )
    click.echo(f"written to {out}; use it with `failuretwin diagnose --method {out}`")
    click.echo(f"or together with Bayes: --method bayes+{out}")


# `failuretwin study`: the paper's study from end to end.


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
    from failuretwin.app.inputs import check_learning
    from failuretwin.app.plots import figure_class
    from failuretwin.app.study.study import check_folder, run_study
    from failuretwin.app.study.trainings import (
        StudyPlan,
        quick_plan,
        real_test_set,
        stand_in_test_set,
    )
    from failuretwin.app.tables import progress_bar
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
