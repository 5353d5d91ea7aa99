"""Diagnosis of labelled real sessions, each with a calibration that has not seen it.

    python benchmarks/leave_one_out.py FOLDER [--onset SECONDS] [--json FILE] [--plot DIR]

FOLDER holds session folders named ..._label_K. Those of labels 0 to 4 are logs of a healthy robot
and calibrate the twin, all but the session that is judged. Two others are judged beside it, and
compared run by run: the generic offsets of an uncalibrated robot, and the same calibrations with
settled poses alone.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import failuretwin as ft
from failuretwin.app.plots import plot_runs
from failuretwin.connection.calibration.calibrate import calibrate
from failuretwin.connection.calibration.result import Calibration
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.data_knowledge.raw_sessions import find_sessions
from failuretwin.decision.evaluation import Judged, compare, score_line
from failuretwin.decision.results import write_json_lines
from failuretwin.digital_model.nonidealities import generic_imperfections
from failuretwin.digital_model.robot import Robot
from failuretwin.inference.priors import priors_of

if TYPE_CHECKING:
    import xarray as xr

HEALTHY_LABELS = tuple(f"label_{k}" for k in range(5))


@dataclass
class Method:
    """A way to diagnose, and what came of it.

    Attributes:
        name: What to call it.
        calibrated: Whether it knows the robot; else generic offsets.
        whole_run: Whether readings on the way count.
        found: Its diagnoses so far.
    """

    name: str
    calibrated: bool = True
    whole_run: bool = True
    found: list[Diagnosis] = field(default_factory=list)


def main() -> None:
    """Score the sessions of a folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--robot", default="armpi_fpv")
    parser.add_argument("--onset", type=float, help="onset of stuck faults, where known [s]")
    parser.add_argument("--sse-range", type=float, nargs=2, help="range of errors, where known")
    parser.add_argument("--json", type=Path, help="write the results, calibrated")
    parser.add_argument("--plot", type=Path, help="folder for a picture of each run that is wrong")
    options = parser.parse_args()
    robot = ft.load_robot(options.robot)
    priors = priors_of(robot, options.sse_range, options.onset)
    judged = Method("calibrated without the session")
    beside = (
        Method("generic offsets", calibrated=False),
        Method("calibrated, settled poses alone", whole_run=False),
    )
    sessions = find_sessions(options.folder)
    healthy = [s for s in sessions if s.name.endswith(HEALTHY_LABELS)]
    known: dict[tuple[Path, ...], Calibration] = {}
    for session in sessions:
        others = tuple(s for s in healthy if s != session)
        if others not in known:
            known[others] = _learn(others, robot)
        runs = ft.read_runs(session, robot, ft.ReadOptions(published_labels=True))
        for method in (judged, *beside):
            found = _diagnose(runs, robot, known[others], priors, method)
            method.found += found
            if method is judged and options.plot is not None:
                _plot_wrong(found, runs, robot, options.plot)
    print(f"{judged.name}: {score_line(Judged.of(judged.found))}")
    for method in beside:
        print(f"{method.name}: {score_line(Judged.of(method.found))}")
        print(f"  {_compare(method.found, judged.found)}")
    for diagnosis in judged.found:
        if diagnosis.diagnosis != diagnosis.truth:
            print(f"  {diagnosis.run}: {diagnosis.truth}, said: {diagnosis.verdict}")
    if options.json is not None:
        write_json_lines(judged.found, options.json)


def _learn(sessions: tuple[Path, ...], robot: Robot) -> Calibration:
    runs = ft.read_runs(list(sessions), robot)
    return calibrate(runs, robot, "held out", "sessions that are not judged")


def _diagnose(
    runs: xr.Dataset, robot: Robot, known: Calibration, priors: ft.Priors, method: Method
) -> list[Diagnosis]:
    diagnoser = ft.BayesDiagnoser(
        ft.DigitalTwin(robot),
        known.imperfections if method.calibrated else generic_imperfections(robot),
        priors=priors,
        whole_run=method.whole_run,
    )
    return diagnoser.diagnose(runs)


def _compare(first: Sequence[Diagnosis], second: Sequence[Diagnosis]) -> str:
    """Return what the second saves over the first, on the same runs."""
    found = compare(first, second)
    low, high = found.gain.interval
    return (
        f"calibrated, whole run saves {found.gain.mean:.4f} nats a run over it (95 % interval "
        f"{low:.4f} to {high:.4f}); exact McNemar p = {found.split.p:.3g}"
    )


def _plot_wrong(found: Sequence[Diagnosis], runs: xr.Dataset, robot: Robot, folder: Path) -> None:
    wrong = [i for i, diagnosis in enumerate(found) if diagnosis.diagnosis != diagnosis.truth]
    if wrong:
        folder.mkdir(parents=True, exist_ok=True)
        plot_runs(runs.isel(run=wrong), [found[i] for i in wrong], ft.DigitalTwin(robot), folder)


if __name__ == "__main__":
    main()
