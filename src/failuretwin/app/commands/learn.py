"""`failuretwin calibrate`, `train` and `study`: learning from logs or from the twin."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

import failuretwin as ft
from failuretwin.app.commands import options as opt
from failuretwin.app.commands.store import StoreOptions, store_options
from failuretwin.app.terminal import progress_bar, show, tell
from failuretwin.core.errors import InputError

if TYPE_CHECKING:
    import xarray as xr


MOST_RUNS = 1000
"""Runs that `calibrate` learns from: more would narrow no figure by much, and fill the memory."""


@click.command()
@opt.file_option("--out", "FILE", "Calibration to write (.toml).", required=True)
@click.option(
    "--hold-out",
    metavar="SESSION",
    help="Sessions with this text in their name are only predicted, not learned from. Default: "
    "each session is left out once, and the result learns from all.",
)
@click.option("--name", help="Name of the calibration in results. Default: the file's name.")
@opt.report_option("Write a page with tables and pictures.")
@opt.flag_option(
    "--pool",
    "Each LOG is a calibration of another robot of the kind: write their mean and spread, the "
    "prior of an uncalibrated robot.",
)
@store_options
@opt.reading_options
@opt.robot_options
def calibrate(
    out: Path,
    hold_out: str | None,
    name: str | None,
    report: Path | None,
    pool: bool,
    memory: StoreOptions,
    reading: opt.LogOptions,
    robot: opt.RobotOptions,
) -> None:
    """Learn from healthy logs where the motors settle, how they lag and what goes wrong by chance.

    LOG is any input of `diagnose`. Motor readings are used where the logs have them, else the tool
    path alone. Runs that are labelled or look faulty are left out. Of more than 1000 runs, so many
    evenly spread ones are used. Step tests (CSV files, or
    folders that hold some) add servo loops and speed limits.
    """
    from failuretwin.app.inputs import read_some
    from failuretwin.app.reports.calibration_report import (
        calibration_parts,
        write_calibration_page,
    )
    from failuretwin.connection.calibration import step_parameters
    from failuretwin.connection.calibration.calibrate import number_of_fits
    from failuretwin.connection.calibration.result import check_calibration_file

    name = name or out.stem
    check_calibration_file(out, robot.model, name)
    if pool:
        if hold_out is not None or report is not None:
            raise click.UsageError("--pool reads no logs. Leave out --hold-out and --report.")
        opt.refuse_unused("a population is not one robot", "store", "robot_name")
        _pool(reading.logs, out, name, robot)
        return
    stored = memory.record(robot)
    tests, others = step_parameters.split_step_tests(reading.logs, reading.columns)
    steps = step_parameters.learn_loops(tests, robot.model)
    model = steps.robot
    runs = read_some(others, model, reading.options, reading.columns, MOST_RUNS)
    source = ", ".join(map(str, reading.logs))
    wrong = _wrong_set_up(runs, model)
    try:
        with progress_bar("calibrating", number_of_fits(runs, hold_out)) as advance:
            found = ft.calibrate(runs, model, name, source, hold_out, advance)
    except InputError as error:
        if not wrong:
            raise
        raise InputError(f"{wrong} {error}") from error
    found = step_parameters.with_step_tests(found, steps)
    tell(wrong and f"warning: {wrong}", err=True)
    if report is not None:
        write_calibration_page(found, runs, model, report)
    ft.save_calibration(found, model, out)
    show(*calibration_parts(found, model))
    tell(f"written to {out}")
    if stored is not None:
        tell(stored.keep_calibration(found))
    if found.beats_uncalibrated is not False:
        options = replace(robot, calibration=out).words
        tell(f"use it with `failuretwin diagnose LOG{options}`")


def _wrong_set_up(runs: xr.Dataset, robot: ft.Robot) -> str:
    """Return the misfit between logs and profile, which a calibration would learn as the robot.

    Small zeros, scatter and noise are no misfit: a calibration learns them.
    """
    from failuretwin.inference.seen_runs import set_up_remark
    from failuretwin.inference.set_ups.wrong_setup import ELSEWHERE

    seen = ft.BayesDiagnoser(robot).seen(runs)
    set_ups = seen.set_ups()
    remark = "" if set_ups.best.set_up.kind == "zero" else set_up_remark(set_ups)
    if set_ups.fits and not remark:
        place = seen.elsewhere()
        remark = place if ELSEWHERE in place else ""
    said = "; ".join(filter(None, (remark, *seen.rounding())))
    if not said:
        return ""
    right = " Put it right first: `failuretwin doctor LOG --out MAP.toml`." if remark else ""
    return f"{said}; what is learned of such logs is not the robot.{right}"


def _pool(calibrations: tuple[Path, ...], out: Path, name: str, robot: opt.RobotOptions) -> None:
    """Write the population that some calibrated robots come from."""
    from failuretwin.app.reports.calibration_report import population_parts

    if out.resolve() in [path.resolve() for path in calibrations]:
        raise InputError(f"{out}: is one of the calibrations to pool. Choose another --out.")
    population = ft.Population.fit(calibrations, robot.model)
    figures = population.imperfections
    population = replace(population, imperfections=replace(figures, name=name))
    ft.save_calibration(population.calibration, robot.model, out)
    show(*population_parts(population.calibration, robot.model))
    tell(f"written to {out}")
    tell(
        "use it for another robot of the kind with `failuretwin diagnose LOGS --self-calibrate"
        f"{replace(robot, calibration=out).words} --out MINE.toml`, or without --self-calibrate "
        "for a single run"
    )


@click.command()
@opt.file_option("--out", "MODEL", "Network to write (.npz).", required=True)
@opt.file_option("--onnx", "FILE", "Write it as an ONNX file too, for a robot's own computer.")
@opt.flag_option("--all-arms", "Learn from all bundled arms: one network for any of them.")
@click.option(
    "--device",
    type=click.Choice(["auto", "cpu", "cuda"]),
    default="auto",
    help="Where to train. auto: on a GPU if there is one.",
)
@opt.count_option("--iterations", 6000, "Number of batches, of 64 runs each.", least=1)
@opt.hypotheses_option(
    "Hypotheses that the network distinguishes: healthy, and each of some modes at each motor. "
    "Default: the paper's nine classes."
)
@opt.plugin_option
@opt.calibrated_robot_options()
def train(
    out: Path,
    onnx: Path | None,
    all_arms: bool,
    device: str,
    iterations: int,
    hypotheses: str | None,
    robot: opt.RobotOptions,
) -> None:
    """Train a network on the imperfect twin, for `diagnose --method MODEL`.

    Runs come fresh from the generator, as various as real ones: no recorded failure is needed. Its
    probabilities are calibrated on simulated runs of the physics engine.
    """
    from failuretwin.app.inputs import check_learning, parse_cli_hypotheses
    from failuretwin.data_knowledge.store import check_writable

    check_learning()
    from failuretwin.decision.learned.storage import (
        check_network_file,
        check_onnx,
        export_onnx,
        save_network,
    )
    from failuretwin.decision.training import TrainingPlan, train_network

    check_network_file(out)
    if onnx is not None:
        check_onnx()
    for file in filter(None, (out, onnx)):
        check_writable(file)
    known = robot.known
    chosen = parse_cli_hypotheses(hypotheses, robot.model)
    plan = TrainingPlan(iterations, robot.seed, hypotheses=chosen, all_arms=all_arms, device=device)
    with progress_bar("training", iterations) as advance:

        def report(done: int) -> None:
            advance(1)
            if done == iterations:
                tell("calibrating on runs of the physics engine, about a minute")

        diagnoser, alone, both = train_network(plan, known, report)
    save_network(diagnoser, out)
    if onnx is not None:
        export_onnx(diagnoser, onnx)
    tell(
        f"of {alone.runs} simulated runs of the physics engine {100.0 * alone.accuracy:.1f} % "
        f"right, log score {alone.log_score:.3f} nats a run, "
        f"temperature {diagnoser.temperature_:.2f}; "
        f"blended with Bayes {100.0 * both.accuracy:.1f} %, {both.log_score:.3f} nats"
    )
    tell(f"written to {out}; use it with `failuretwin diagnose --method {out}`")
    tell(f"or together with Bayes: --method bayes+{out}")


@click.command()
@opt.file_option("--out", "DIR", "Folder for everything.", required=True)
@opt.file_option(
    "--test", "PATH", "Real runs to test on. Default: runs of the physics engine, as a stand-in."
)
@opt.published_labels_option
@opt.flag_option(
    "--rivals", "Compare networks, classifiers, filters and Bayes on equal terms instead."
)
@opt.flag_option("--quick", "A small version of about two minutes.")
@opt.flag_option("--resume", "Continue an interrupted study.")
@opt.robot_options
def study(
    out: Path,
    test: Path | None,
    published_labels: bool,
    rivals: bool,
    quick: bool,
    resume: bool,
    robot: opt.RobotOptions,
) -> None:
    """Repeat the paper's study: train its network on the published twin, test it, write a page.

    Both feature sets, both readings of the learning rate, five repetitions, the figures of
    tables II and III beside the published ones. Each training that is done is kept.
    """
    from failuretwin.app.inputs import check_learning
    from failuretwin.app.reports.plots import figure_class
    from failuretwin.app.reports.study_page import write_study_page
    from failuretwin.decision.learned import paper_study as paper

    if test is None:
        opt.refuse_unused("no real runs are given", "published_labels")
    model, seed = robot.model, robot.seed
    paper.check_folder(out, resume)
    if rivals:
        check_learning()
        _rivals(out, test, published_labels, quick, robot)
        return
    plan = paper.quick_plan(seed) if quick else paper.StudyPlan(seed)
    figure_class()  # better told before the work than after it
    exam = (
        paper.stand_in_test_set(plan, model)
        if test is None
        else paper.given_test_set(test, model, published_labels)
    )
    check_learning()
    jobs = len(plan.jobs())
    tell(f"{jobs} trainings of {plan.iterations} iterations each")
    with progress_bar("training", jobs) as advance:
        trainings = paper.run_study(plan, model, exam, out, advance)
    tell(f"written to {write_study_page(trainings, plan, model, exam, out)}")


def _rivals(
    out: Path, test: Path | None, published_labels: bool, quick: bool, robot: opt.RobotOptions
) -> None:
    """Compare the rivals and write table and page."""
    from failuretwin.app.reports.study_page import rivals_table, write_rivals
    from failuretwin.decision.learned import paper_study as paper
    from failuretwin.decision.rivals.study import rival_scores, run_rivals
    from failuretwin.decision.rivals.training import RivalPlan, quick_rivals, rival_jobs

    model, seed = robot.model, robot.seed
    plan = quick_rivals(seed) if quick else RivalPlan(seed)
    exam = (
        paper.stand_in_test_set(paper.StudyPlan(seed, stand_in_runs=plan.stand_in_runs), model)
        if test is None
        else paper.given_test_set(test, model, published_labels, "measured")
    )
    jobs = len(rival_jobs(plan))
    tell(f"{jobs} trainings and diagnoses, networks of {plan.iterations} iterations")
    with progress_bar("rivals", jobs) as advance:
        run_rivals(plan, model, exam, out, advance)
    scores = list(rival_scores(plan, out / paper.WORK))
    show(rivals_table(scores))
    tell(f"written to {write_rivals(scores, plan, model, exam, out)}")
