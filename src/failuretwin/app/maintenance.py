"""From stored diagnoses and histories to advice, in words and as JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from failuretwin.connection.life_history import read_rows
from failuretwin.core.errors import InputError, OutputError
from failuretwin.core.types import FloatArray
from failuretwin.data_knowledge.store import write_records, write_text
from failuretwin.decision.expected_cost import TEMPLATE, advise, load_costs
from failuretwin.decision.remaining_life import (
    LEAST_RUNS,
    RemainingLife,
    remaining_life,
)
from failuretwin.decision.results import read_results
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.twin import DigitalTwin
from failuretwin.inference.observation.healthy_model import HealthyModel
from failuretwin.inference.together.wear_limits import WearLimits, wear_unit


def write_template(path: Path) -> None:
    """Write costs to be filled in; a file that is there stays as it is.

    Raises:
        OutputError: If there is one already.
    """
    if path.exists():
        raise OutputError(f"{path}: is there already. Choose another name.")
    write_text(TEMPLATE, path)


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
        record = {
            "run": diagnosis.run,
            "advice": str(advice.best),
            "expected_cost": {str(option): option.cost for option in advice.options},
            "hinges_on": advice.hinge or None,
            "hinge_probability": advice.hinge_probability if advice.hinge else None,
        }
        write_records([record], json_file)
    return lines


def life_report(
    source: Path, calibration: Path | None, robot: str, seed: int, json_file: Path | None
) -> list[str]:
    """Return the remaining life of every motor of a tracked robot.

    Raises:
        InputError: If the history cannot be read or belongs to another calibration.
    """
    known = load_calibration(calibration, robot)
    model = HealthyModel(DigitalTwin(known.robot), known.imperfections)
    rows = read_rows(source, known.robot.name)
    if not rows:
        raise InputError(f"{source}: holds no run. Expected what `diagnose --track` keeps.")
    lives = motor_lives(rows, model, np.random.default_rng(seed))
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
        write_records([{"motors": records}], json_file)
    return lines


def motor_lives(
    rows: Sequence[Mapping[str, Any]], model: HealthyModel, rng: np.random.Generator
) -> dict[str, RemainingLife | None]:
    """Return the remaining life of each motor by what its runs say of its bias, each by itself.

    Wear is counted in scatters of the motor. Runs while something changed as no wear does say
    nothing.

    Args:
        rows: Runs of the history.
        model: The healthy robot as it was calibrated.
        rng: Source of chance.
    """
    names = model.motor_names
    scatter = wear_unit(model)[: len(names)]
    wear, deviation = (_per_run(rows, key) / scatter for key in BIAS_ALONE)
    limit, found = WearLimits().limit, dict[str, RemainingLife | None]()
    for k, name in enumerate(names):
        enough = np.isfinite(wear[:, k]).sum() >= LEAST_RUNS
        found[name] = (
            remaining_life(wear[:, k], deviation[:, k] ** 2, limit, rng) if enough else None
        )
    return found


BIAS_ALONE = ("bias_alone", "bias_alone_deviation")
"""Keys of what a run says of each bias by itself [rad]."""


def _per_run(rows: Sequence[Mapping[str, Any]], key: str) -> FloatArray:
    """Return the values of a key, (run, motor); NaN where there are none."""
    return np.array(
        [
            [np.nan if value is None or row["alarm"] else value for value in row[key]]
            for row in rows
        ],
        dtype=np.float64,
    )


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
