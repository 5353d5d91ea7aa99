"""Diagnosis of an older campaign: motors stuck all along, constant and proportional errors.

    python benchmarks/killian.py FOLDER [--modes stuck,encoder_bias,encoder_scale] [--json FILE]

FOLDER is the campaign of `killian_truth.py`, whose list says what is true of which run. Each run
is diagnosed from commands and tool path alone; the readings of the motors are deleted first.
Healthy behaviour is the generic one, that of each bundled calibration, and one learned from the
healthy runs of the campaign, the judged run left out (P0c). Accuracy is that of the judged runs of
the list; the healthy runs are shown beside it, as false alarms.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from killian_truth import TrueRun, read_list

import failuretwin as ft
from failuretwin.connection.calibration.calibrate import calibrate
from failuretwin.core.hypothesis import Diagnosis, Hypothesis, single_faults
from failuretwin.decision.evaluation import Judged, score_line
from failuretwin.decision.results import write_json_lines
from failuretwin.decision.scoring import Share
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.calibrated_robot import load_calibration
from failuretwin.digital_model.nonidealities import Imperfections
from failuretwin.digital_model.robot import Robot

if TYPE_CHECKING:
    import xarray as xr

MODES = "stuck,encoder_bias,encoder_scale"


def main() -> None:
    """Score the campaign with every calibration."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--modes", default=MODES, help="fault modes of the hypothesis set")
    parser.add_argument("--json", type=Path, help="write the results of the campaign's own")
    options = parser.parse_args()
    robot = ft.load_robot("armpi_fpv")
    hypotheses = single_faults(robot.motor_names, options.modes.split(","))
    listed = read_list()
    runs = read_campaign(options.folder, listed, robot)
    known = runs.drop_vars("position")
    generic = generic_imperfections(robot)
    report(generic.name, listed, diagnose(known, robot, generic, hypotheses))
    for name in bundled():
        imperfections = load_calibration(name, robot).imperfections
        report(name, listed, diagnose(known, robot, imperfections, hypotheses))
    found = with_own_calibration(runs, robot, hypotheses)
    report("learned from the healthy runs of the campaign", listed, found)
    if options.json is not None:
        write_json_lines(found, options.json)


def bundled() -> list[str]:
    """Return the names of the bundled calibrations."""
    folder = files("failuretwin.digital_model.robots") / "calibrations"
    return sorted(Path(str(file)).stem for file in folder.iterdir())


def read_campaign(folder: Path, listed: Sequence[TrueRun], robot: Robot) -> xr.Dataset:
    """Return the listed runs in their order, with what is true of them."""
    runs = ft.read_runs([folder / run.run for run in listed], robot)
    truth = np.array([run.truth for run in listed], dtype=object)
    return runs.assign(fault=("run", truth))


def diagnose(
    runs: xr.Dataset, robot: Robot, healthy: Imperfections, hypotheses: Sequence[Hypothesis]
) -> list[Diagnosis]:
    """Return the results of some runs."""
    diagnoser = ft.BayesDiagnoser(ft.DigitalTwin(robot), healthy, hypotheses)
    return diagnoser.diagnose(runs)


def with_own_calibration(
    runs: xr.Dataset, robot: Robot, hypotheses: Sequence[Hypothesis]
) -> list[Diagnosis]:
    """Return the results with what the healthy runs teach, each healthy run left out for itself."""
    healthy = np.flatnonzero(runs["fault"].values == "healthy")
    faulty = np.flatnonzero(runs["fault"].values != "healthy")
    results: dict[int, Diagnosis] = {}
    for judged in (faulty, *(healthy[k : k + 1] for k in range(len(healthy)))):
        learning = runs.isel(run=np.setdiff1d(healthy, judged))
        found = calibrate(learning, robot, "campaign", "healthy runs of the campaign")
        blind = runs.isel(run=judged).drop_vars("position")
        diagnoses = diagnose(blind, robot, found.imperfections, hypotheses)
        results |= dict(zip(judged.tolist(), diagnoses, strict=True))
    return [results[run] for run in range(len(results))]


def report(name: str, listed: Sequence[TrueRun], diagnoses: Sequence[Diagnosis]) -> None:
    """Print how many are right, by kind of fault, and the wrong ones."""
    judged = Judged.of(d for run, d in zip(listed, diagnoses, strict=True) if run.judged)
    print(f"{name}: {score_line(judged)}")
    scores = judged.scores
    for k, name in enumerate(scores.classes):
        hits, runs = int(scores.confusion[k, k]), int(scores.confusion[k].sum())
        if runs:
            low, high = Share(hits, runs).interval
            print(f"  {name}: {hits} of {runs} ({100 * low:.0f} to {100 * high:.0f} %)")
    healthy = [d for d in diagnoses if d.truth == "healthy"]
    alarms = sum(d.diagnosis not in ("healthy", None) for d in healthy)
    silent = sum(d.diagnosis is None for d in healthy)
    print(f"  {len(healthy)} healthy runs: {alarms} false alarms, {silent} without a verdict")
    for run, diagnosis in zip(listed, diagnoses, strict=True):
        if diagnosis.diagnosis != diagnosis.truth:
            asked = "" if run.judged or run.truth == "healthy" else " (not judged)"
            print(f"  {run.run}{asked}: {run.truth}, said: {diagnosis.verdict}")


if __name__ == "__main__":
    main()
