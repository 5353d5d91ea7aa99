"""`failuretwin calibrate`, `train` and `study`: what is learned, from logs or from the twin."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from failuretwin.app.commands.options import (
    PATH,
    LogOptions,
    calibration_option,
    common_options,
    hypotheses_option,
    plugin_option,
    published_labels_option,
    reading_options,
    report_option,
)
from failuretwin.app.terminal import progress_bar, tell

if TYPE_CHECKING:
    import xarray as xr

    from failuretwin.digital_model.robot import Robot


@click.command()
@click.argument("logs", nargs=-1, required=True, type=PATH, metavar="LOG...")
@click.option("--out", required=True, type=PATH, help="Calibration to write (.toml).")
@click.option(
    "--hold-out",
    metavar="SESSION",
    help="Learn nothing from sessions with this in their name; only see how well they are "
    "predicted. Default: each session is left out once, and the result learns from all.",
)
@click.option("--name", help="What results call the calibration. Default: the file's name.")
@report_option("Write a page with tables and pictures.")
@click.option(
    "--pool",
    is_flag=True,
    help="Each LOG is a calibration of another robot of the kind: write what they have in common "
    "and differ by, the prior of a robot that nobody has calibrated.",
)
@reading_options
@common_options
def calibrate(
    logs: tuple[Path, ...],
    out: Path,
    hold_out: str | None,
    name: str | None,
    report: Path | None,
    pool: bool,
    reading: LogOptions,
    robot: str,
    seed: int,
) -> None:
    """Learn from healthy logs where the motors settle, how they lag and what goes wrong by chance.

    LOG is whatever `diagnose` reads. Motor readings are used where the logs have them, else the
    tool path alone. Runs that are labelled or look faulty are left out. Step tests (CSV files, or
    folders that hold some) add servo loops and speed limits.
    """
    del seed  # nothing here depends on chance
    from failuretwin.app.inputs import read_inputs
    from failuretwin.app.reports.calibration_report import print_calibration
    from failuretwin.connection.calibration import step_parameters
    from failuretwin.connection.calibration.calibrate import calibrate as learn
    from failuretwin.connection.calibration.result import check_calibration_file, save_calibration
    from failuretwin.core.errors import InputError
    from failuretwin.digital_model.robot import load_robot

    check_calibration_file(out)
    if pool:
        if hold_out is not None or report is not None:
            raise click.UsageError("--pool reads no logs. Leave out --hold-out and --report.")
        _pool(logs, out, name, robot)
        return
    tests, others = step_parameters.split_step_tests(logs, reading.columns)
    steps = step_parameters.learn_loops(tests, load_robot(robot))
    model = steps.robot
    runs = read_inputs(others, model, reading)
    source = ", ".join(str(log) for log in logs)
    wrong = _wrong_set_up(runs, model)
    try:
        found = learn(runs, model, name or out.stem, source, hold_out)
    except InputError as error:
        if not wrong:
            raise
        raise InputError(f"{wrong} {error}") from error
    found = step_parameters.with_step_tests(found, steps)
    if wrong:
        tell(f"warning: {wrong}", err=True)
    if report is not None:
        from failuretwin.app.reports.calibration_report import write_calibration_page

        write_calibration_page(found, runs, model, report)
    save_calibration(found, model, out)
    print_calibration(found, model)
    tell(f"written to {out}")
    if found.beats_uncalibrated is not False:
        tell(f"use it with `failuretwin diagnose --calibration {out}`")


def _wrong_set_up(runs: xr.Dataset, robot: Robot) -> str:
    """Return where logs do not fit the profile, which a calibration would learn as the robot.

    Small zeros are left to it: that is what a calibration is for.
    """
    from failuretwin.inference.diagnoser import BayesDiagnoser
    from failuretwin.inference.seen_runs import set_up_remark

    seen = BayesDiagnoser(robot).seen(runs)
    set_ups = seen.set_ups()
    remark = "" if set_ups.best.set_up.kind == "zero" else set_up_remark(set_ups)
    if set_ups.fits and not remark:
        remark = seen.elsewhere()
    said = "; ".join(filter(None, (remark, *seen.rounding())))
    if not said:
        return ""
    right = " Put it right first: `failuretwin doctor LOG --out MAP.toml`." if remark else ""
    return f"{said}; what is learned of such logs is not the robot.{right}"


def _pool(calibrations: tuple[Path, ...], out: Path, name: str | None, robot: str) -> None:
    """Write the population that some calibrated robots come from."""
    from dataclasses import replace

    from failuretwin.app.reports.calibration_report import print_population
    from failuretwin.connection.calibration.result import save_calibration
    from failuretwin.connection.population import Population
    from failuretwin.digital_model.robot import load_robot

    model = load_robot(robot)
    population = Population.fit(calibrations, model)
    figures = population.imperfections
    found = replace(population, imperfections=replace(figures, name=name or figures.name))
    save_calibration(found.calibration, model, out)
    print_population(found.calibration, model)
    tell(f"written to {out}")
    tell(
        "use it for another robot of the kind with `failuretwin diagnose LOGS --self-calibrate "
        f"--calibration {out} --out MINE.toml`, or without --self-calibrate for a single run"
    )


@click.command()
@click.option("--out", required=True, type=PATH, metavar="MODEL", help="Network to write (.npz).")
@calibration_option
@click.option(
    "--network",
    type=click.Choice(["cnn", "motorwise", "lstm"]),
    default="cnn",
    help="A convolutional network, one that looks at every motor alike, or the paper's LSTM.",
)
@click.option(
    "--iterations",
    type=click.IntRange(min=1),
    default=6000,
    help="Batches of 64 runs to learn from.",
)
@hypotheses_option(
    "Hypotheses that the network distinguishes, such as healthy,motor_2:stuck. Default: the "
    "paper's nine classes."
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
    from failuretwin.app.inputs import check_learning
    from failuretwin.data_knowledge.store import check_writable
    from failuretwin.digital_model.calibrated_robot import load_calibration
    from failuretwin.digital_model.robot import load_robot

    check_learning()
    from failuretwin.app.inputs import parse_cli_hypotheses
    from failuretwin.decision.learned.storage import check_network_file, save_network
    from failuretwin.decision.training import TrainingPlan, train_network

    check_network_file(out)
    check_writable(out)
    model = load_robot(robot)
    known = load_calibration(calibration, model)
    chosen = parse_cli_hypotheses(hypotheses, model)
    plan = TrainingPlan(network, iterations, seed, hypotheses=chosen)
    with progress_bar("training", iterations) as advance:
        diagnoser, alone, both = train_network(
            plan, known.robot, known.imperfections, lambda done: advance(1)
        )
    save_network(diagnoser, out)
    tell(
        f"of {alone.runs} simulated runs of the physics engine {100.0 * alone.accuracy:.1f} % "
        f"right, log score {alone.log_score:.3f} nats a run, "
        f"temperature {diagnoser.temperature_:.2f}; "
        f"blended with Bayes {100.0 * both.accuracy:.1f} %, {both.log_score:.3f} nats"
    )
    tell(f"written to {out}; use it with `failuretwin diagnose --method {out}`")
    tell(f"or together with Bayes: --method bayes+{out}")


@click.command()
@click.option("--out", required=True, type=PATH, metavar="DIR", help="Folder for everything.")
@click.option(
    "--test",
    "test_path",
    type=PATH,
    metavar="PATH",
    help="Real runs to test on. Default: runs of the physics engine, as a stand-in.",
)
@published_labels_option
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
    from failuretwin.app.reports.plots import figure_class
    from failuretwin.app.reports.study_page import write_study_page
    from failuretwin.core.errors import InputError
    from failuretwin.decision.learned import paper_study as paper
    from failuretwin.digital_model.robot import load_robot

    if published_labels and test_path is None:
        raise InputError("--published-labels says how to read a test set. Add --test PATH.")
    model = load_robot(robot)
    plan = paper.quick_plan(seed) if quick else paper.StudyPlan(seed)
    paper.check_folder(out, resume)
    figure_class()  # better told before the work than after it
    test = (
        paper.stand_in_test_set(plan, model)
        if test_path is None
        else paper.given_test_set(test_path, model, published_labels)
    )
    check_learning()
    jobs = len(plan.jobs())
    tell(f"{jobs} trainings of {plan.iterations} iterations each")
    with progress_bar("training", jobs) as advance:
        trainings = paper.run_study(plan, model, test, out, advance)
    page = out / paper.PAGE
    write_study_page(trainings, plan, model, test, page)
    tell(f"written to {page}")
