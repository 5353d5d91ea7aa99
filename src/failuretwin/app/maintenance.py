"""From stored diagnoses and histories to advice, in words and as JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from failuretwin.connection.tracked_diagnosis import read_history
from failuretwin.connection.wear_tracker import Step, Tracker
from failuretwin.core.errors import InputError, OutputError
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.store import replacing
from failuretwin.decision.maintenance.expected_cost import TEMPLATE, advise, load_costs
from failuretwin.decision.maintenance.remaining_life import (
    LEAST_RUNS,
    RemainingLife,
    remaining_life,
)
from failuretwin.decision.results import read_results
from failuretwin.digital_model.calibrated_robot import load_calibration


def write_template(path: Path) -> None:
    """Write costs to be filled in; a file that is there stays as it is.

    Raises:
        OutputError: If there is one already.
    """
    if path.exists():
        raise OutputError(f"{path}: is there already. Choose another name.")
    with replacing(path) as partial:
        partial.write_text(TEMPLATE)


def results_report(
    source: Path, costs_file: Path, run: str | None, json_file: Path | None
) -> list[str]:
    """Return what to do about the arm of a stored diagnosis.

    Raises:
        InputError: If a file cannot be read, or there is no such run.
    """
    costs, found = load_costs(costs_file), read_results(source).diagnoses
    chosen = [each for each in found if run is None or each.run == run]
    if not chosen:
        raise InputError(f"{source}: no run {run!r}. The last is {found[-1].run!r}.")
    diagnosis = chosen[-1]
    advice = advise(diagnosis.posterior, costs)
    lines = [f"run {diagnosis.run}: {diagnosis.verdict or diagnosis.diagnosis}"]
    lines += [f"  {option!s:24s} {option.cost:10.4g}" for option in advice.options]
    lines.append(advice.verdict)
    if json_file is not None:
        _write(json_file, {
            "run": diagnosis.run,
            "advice": str(advice.best),
            "expected_cost": {str(option): option.cost for option in advice.options},
            "hinges_on": advice.hinge or None,
            "hinge_probability": advice.hinge_probability if advice.hinge else None,
        })  # fmt: skip
    return lines


def life_report(
    source: Path, calibration: Path | None, robot: str, seed: int, json_file: Path | None
) -> list[str]:
    """Return the remaining life of every motor of a tracked robot.

    Raises:
        InputError: If the history cannot be read or belongs to another calibration.
    """
    known = load_calibration(calibration, robot)
    tracker = Tracker.of(known.imperfections, known.robot)
    history = read_history(source, tracker)
    if not history.steps:
        raise InputError(f"{source}: holds no run. Expected what `diagnose --track` keeps.")
    lives = motor_lives(history.steps, tracker, np.random.default_rng(seed))
    lines, records = [], []
    for name, life in lives.items():
        if life is None:
            lines.append(f"{name}: fewer than {LEAST_RUNS} runs say something of its wear")
            continue
        lines.append(
            f"{name}: worn by {life.level:.1f} of {life.limit:.0f} scatters; {life.verdict}"
        )
        records.append(_record(name, life))
    lines.append("how real arms wear is not known; shapes and limit are assumed (docs/acting.md)")
    if json_file is not None:
        _write(json_file, {"motors": records})
    return lines


def motor_lives(
    steps: tuple[Step, ...], tracker: Tracker, rng: np.random.Generator
) -> dict[str, RemainingLife | None]:
    """Return the remaining life of each motor by what its runs say, each by itself.

    Runs that were discarded as faulty say nothing, nor do the latest, which are not decided on.

    Args:
        steps: Runs of the history.
        tracker: The tracker of the calibration.
        rng: Source of chance.
    """
    learned = {
        number for step in steps for number, outcome in step.outcomes if outcome == "discarded"
    }
    rows = [(None if s.number in learned else run_wear(s, tracker)) for s in steps]
    motors = tracker.robot.motor_names
    nothing = np.full(len(motors), np.nan)
    wear = np.array([nothing if row is None else row[0] for row in rows])
    variance = np.array([nothing if row is None else row[1] for row in rows])
    found: dict[str, RemainingLife | None] = {}
    for k, name in enumerate(motors):
        if np.isfinite(wear[:, k]).sum() < LEAST_RUNS:
            found[name] = None
            continue
        found[name] = remaining_life(wear[:, k], variance[:, k], tracker.limits.limit, rng)
    return found


def run_wear(step: Step, tracker: Tracker) -> tuple[FloatArray, FloatArray] | None:
    """Return what one run says by itself of each motor's bias, and its variance, in scatters.

    (H^T H + 1)^-1 H^T y in units of a scatter each, with wear of one scatter as a prior that is
    then divided out; compliance is summed out.
    """
    error, design = step.evidence.error, step.evidence.design
    if error.size == 0:
        return None
    motors = len(tracker.robot.motors)
    slope = design.reshape(-1, 2 * motors) * tracker.unit
    precision = slope.T @ slope
    prior = np.eye(2 * motors) * PRIOR
    covariance = np.linalg.inv(precision + prior)
    mean = covariance @ (slope.T @ error.reshape(-1))
    variance = np.diag(covariance)
    told = 1.0 - PRIOR * variance  # share that the run says, not the prior
    with np.errstate(divide="ignore", invalid="ignore"):
        level, spread = mean / told, variance / told
    known = told[:motors] > LEAST_SHARE
    return np.where(known, level[:motors], np.nan), np.where(known, spread[:motors], np.nan)


PRIOR = 1e-2
"""Precision of the wear of one run before it is seen, per squared scatter: ten scatters."""
LEAST_SHARE = 0.5
"""A run that says less of a motor, beside what was believed before, says nothing."""


def _record(name: str, life: RemainingLife) -> dict[str, Any]:
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


def _write(path: Path, value: dict[str, Any]) -> None:
    with replacing(path) as partial:
        partial.write_text(json.dumps(value) + "\n")
