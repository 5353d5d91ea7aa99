"""`failuretwin evaluate` and `advise`: how often results are right, and what to do about an arm."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import failuretwin as ft
from failuretwin.app.commands import options as opt
from failuretwin.app.commands.store import (
    LEARNED,
    StoreOptions,
    learned_priors_option,
    store_options,
)
from failuretwin.app.terminal import show, tell, write_json
from failuretwin.core.errors import InputError, OutputError
from failuretwin.core.hypothesis import Hypothesis

if TYPE_CHECKING:
    from failuretwin.app.remembering import RobotRecord
    from failuretwin.decision.remaining_life import RemainingLife
    from failuretwin.decision.results import Record


@click.command()
@click.argument("results", type=opt.PATH, metavar="RESULTS.jsonl|DIR")
@opt.file_option(
    "--truth",
    "RUNS",
    "Run set or raw sessions with the truth, needed for the coverage of intervals. Default: "
    "the truth in the results.",
)
@opt.published_labels_option
@opt.file_option("--against", "OTHER.jsonl", "Compare with other results of the same runs.")
@opt.file_option("--latex", "FILE", "Write the scores as LaTeX tables.")
@opt.report_option("Write a picture of the reliability.")
@opt.plugin_option
@opt.robot_options
def evaluate(
    results: Path,
    truth: Path | None,
    published_labels: bool,
    against: Path | None,
    latex: Path | None,
    report: Path | None,
    robot: opt.RobotOptions,
) -> None:
    """Score the results of `diagnose --json` or `--parquet` against the truth."""
    import numpy as np

    from failuretwin.app.reports.plots import write_reliability
    from failuretwin.app.reports.reports import comparison_parts, evaluation_parts, write_latex
    from failuretwin.data_knowledge.run_pieces import open_runs
    from failuretwin.decision.evaluation import Truths

    truths = None
    if truth is None:
        opt.refuse_unused("no runs with the truth are given", "published_labels")
    else:
        options = ft.ReadOptions(published_labels=published_labels)
        truths = Truths.of(open_runs(truth, robot.model, options), str(truth))
    first = ft.read_results(results)
    scores = ft.evaluate(first, truths, np.random.default_rng(robot.seed))
    comparison = None
    if against is not None:
        second, rng = ft.read_results(against), np.random.default_rng(robot.seed)
        comparison = ft.compare(first, second, truths, rng)
    if latex is not None:
        write_latex(scores, comparison, latex)
    if report is not None:
        write_reliability(scores, report)
    show(*evaluation_parts(scores, truth is not None))
    if comparison is not None:
        show(*comparison_parts(comparison))


Report = tuple[list[str], list[dict[str, Any]]]
"""Lines for the terminal, and JSON objects."""


@click.command()
@click.argument(
    "source", metavar="[RESULTS.jsonl|HISTORY.history.jsonl]", type=opt.PATH, required=False
)
@opt.file_option("--costs", "FILE.toml", "Cost table: downtime, repair, replacement.")
@opt.file_option("--template", "FILE.toml", "Write a cost table to fill in.")
@click.option("--run", metavar="NAME", help="Run to use. Default: the last one.")
@opt.json_option("Write the advice.")
@store_options
@learned_priors_option
@opt.calibrated_robot_options()
def advise(
    source: Path | None,
    costs: Path | None,
    template: Path | None,
    run: str | None,
    json_file: Path | None,
    memory: StoreOptions,
    learned_priors: bool,
    robot: opt.RobotOptions,
) -> None:
    """Report the cheapest action: continue, compensate, slow down, inspect, replace, stop.

    RESULTS.jsonl is a file of `diagnose --json`. For a history that `diagnose --track` keeps, the
    remaining life of every motor is reported; name its calibration (--calibration), or the robot in
    the store (--robot-name) in place of the file.
    """
    if template is not None:
        _write_template(template)
        tell(f"costs to be filled in: {template}")
    if source is None and memory.robot_name is None:
        if template is None:
            raise InputError(
                "nothing to advise on. Name results or a history, a robot in the store "
                "(--robot-name), or --template FILE."
            )
        return
    if source is None or source.name.endswith(".history.jsonl"):
        lines, records = _life_report(source, memory, robot)
    else:
        if costs is None:
            raise InputError(
                "costs are yours to say: name a file (--costs FILE.toml). `failuretwin advise "
                "--template FILE.toml` writes one to be filled in."
            )
        stored = None
        if learned_priors:
            stored = memory.needed(memory.record(robot), LEARNED)
        lines, records = _results_report(source, costs, run, stored)
    show(*lines)
    write_json(records, json_file)


def _write_template(path: Path) -> None:
    """Write a cost table to fill in; an existing file is never overwritten."""
    from failuretwin.data_knowledge.store import write_text
    from failuretwin.decision.expected_cost import costs_template

    if path.exists():
        raise OutputError(f"{path}: is there already. Choose another name.")
    write_text(costs_template(), path)


def _results_report(
    source: Path, costs_file: Path, run: str | None, stored: RobotRecord | None
) -> Report:
    """Return the advice on a stored diagnosis, by the learned priors of a store if there is one."""
    from failuretwin.decision.expected_cost import advise as advise_on
    from failuretwin.decision.expected_cost import load_costs
    from failuretwin.decision.results import read_results

    costs, found = load_costs(costs_file), read_results(source).diagnoses
    chosen = [each for each in found if run is None or each.run == run]
    if not chosen:
        raise InputError(f"{source}: no run {run!r}. The last is {found[-1].run!r}.")
    diagnosis = chosen[-1]
    advice = advise_on(_posterior(diagnosis, stored), costs)
    lines = [f"run {diagnosis.run}: {diagnosis.verdict or diagnosis.diagnosis}"]
    lines += [f"  {option!s:24s} {option.cost:10.4g}" for option in advice.options]
    record = {
        "run": diagnosis.run,
        "advice": str(advice.best),
        "expected_cost": {str(option): option.cost for option in advice.options},
        "hinges_on": advice.hinge or None,
        "hinge_probability": advice.hinge_probability if advice.hinge else None,
    }
    return [*lines, advice.verdict], [record]


def _posterior(diagnosis: ft.Diagnosis | Record, stored: RobotRecord | None) -> Mapping[str, float]:
    """Return the posterior of a diagnosis, by the learned priors of a store if there is one."""
    from failuretwin.connection.fault_rates import reweighted
    from failuretwin.inference.explanation import LEARNED_METHOD

    if stored is None or LEARNED_METHOD in diagnosis.method:
        return diagnosis.posterior
    hypotheses = [Hypothesis.parse(name) for name in diagnosis.posterior]
    return reweighted(diagnosis.posterior, stored.fault_factors(hypotheses))


def _life_report(source: Path | None, memory: StoreOptions, robot: opt.RobotOptions) -> Report:
    """Return the remaining life of every motor of a tracked robot; no source: that of the store."""
    import numpy as np

    from failuretwin.connection.tracked_diagnosis import read_rows
    from failuretwin.decision.remaining_life import LEAST_RUNS, motor_lives
    from failuretwin.inference.observation.healthy_model import HealthyModel

    rows: Sequence[Mapping[str, Any]]
    if source is None:
        stored, known = memory.look_up(robot)
        rows = memory.needed(stored, "--robot-name").tracked_rows()
    else:
        known = robot.known
        rows = read_rows(source, known.robot.name)
    model = HealthyModel(known.twin, known.imperfections)
    lives = motor_lives(rows, model, np.random.default_rng(robot.seed))
    lines = [
        f"{name}: fewer than {LEAST_RUNS} runs say something of its wear"
        if life is None
        else f"{name}: worn by {life.level:.1f} of {life.limit:.0f} scatters; {life.verdict}"
        for name, life in lives.items()
    ]
    lines.append("how real arms wear is not known; shapes and limit are assumed (docs/acting.md)")
    return lines, [{"motors": [_record(name, life) for name, life in lives.items() if life]}]


def _record(name: str, life: RemainingLife) -> dict[str, Any]:
    import numpy as np

    quantiles = {f"{share:g}": life.quantile(share) for share in (0.05, 0.5, 0.95)}
    return {
        "motor": name,
        "level_scatters": life.level,
        "limit_scatters": life.limit,
        "runs_seen": life.seen,
        "runs_left": {k: v if np.isfinite(v) else None for k, v in quantiles.items()},
        "end_in_sight": life.in_sight,
        "verdict": life.verdict,
        "time_of_event": [v if np.isfinite(v) else None for v in life.runs[::20].tolist()],
    }
