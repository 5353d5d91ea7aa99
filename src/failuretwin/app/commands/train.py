"""`failuretwin train`: a network for a real robot, from its twin."""

from __future__ import annotations

from pathlib import Path

import click

from failuretwin.app.commands.options import PATH, common_options


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
@common_options
def train(
    out: Path, calibration: Path | None, network: str, iterations: int, robot: str, seed: int
) -> None:
    """Train a network on the imperfect twin, for `diagnose --method MODEL`.

    Runs come fresh from the generator, as various as real ones: no recorded failure is needed. Its
    probabilities are calibrated on simulated runs of the physics engine.
    """
    from failuretwin.app.learning import check_learning
    from failuretwin.app.progress import progress_bar
    from failuretwin.connection.calibration.loops import robot_as_calibrated
    from failuretwin.data_knowledge.store import check_writable
    from failuretwin.digital_model.imperfections import default_imperfections, load_imperfections
    from failuretwin.digital_model.robot import load_robot

    check_learning()
    from failuretwin.app.training import TrainingPlan, train_network
    from failuretwin.decision.learned.storage import check_network_file, save_network

    check_network_file(out)
    check_writable(out)
    model = load_robot(robot)
    if calibration is None:
        imperfections = default_imperfections(model)
    else:
        model = robot_as_calibrated(model, str(calibration))
        imperfections = load_imperfections(str(calibration), model)
    plan = TrainingPlan(network, iterations, seed)
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
