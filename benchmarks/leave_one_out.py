"""Diagnosis of labelled real sessions, each with a calibration that has not seen it.

    python benchmarks/leave_one_out.py FOLDER [--as published] [--sag-as-held] [--onset SECONDS]

FOLDER holds session folders named ..._label_K. Those of labels 0 to 4 are logs of a healthy robot
and calibrate the twin, all but the session that is judged. Two others are judged beside it, and
compared run by run: the generic offsets of an uncalibrated robot, and the same calibrations with
settled poses alone. `--priors` judges by other priors instead, to show how much each matters.

The authors froze the stuck motors of labels 1 to 4 in the log of a healthy arm, whose other motors
sagged in the pose that was not frozen. `--sag-as-held` moves their readings to where they would
have sagged with the motor really held, by the compliance of the calibration.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import failuretwin as ft
from failuretwin.app.reports.plots import plot_runs
from failuretwin.connection.calibration.calibrate import calibrate
from failuretwin.connection.calibration.result import Calibration
from failuretwin.core.hypothesis import Diagnosis
from failuretwin.core.types import as_floats
from failuretwin.data_knowledge.readers.raw_sessions import find_sessions
from failuretwin.decision.evaluation import Judged, compare, score_line
from failuretwin.decision.results import write_json_lines
from failuretwin.digital_model.arm_classes import generic_imperfections
from failuretwin.digital_model.robot import Robot
from failuretwin.digital_model.settling import Settling, sag
from failuretwin.inference.faults.priors import OnsetPrior, priors_of

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
        priors: What it believes; None: what is told of all.
        found: Its diagnoses so far.
    """

    name: str
    calibrated: bool = True
    whole_run: bool = True
    priors: ft.Priors | None = None
    found: list[Diagnosis] = field(default_factory=list)


def main() -> None:
    """Score the sessions of a folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--robot", default="armpi_fpv")
    parser.add_argument("--as", dest="how", choices=("measured", "published"), default="measured")
    parser.add_argument("--sag-as-held", action="store_true", help="see above")
    parser.add_argument("--onset", type=float, help="onset of stuck faults, where known [s]")
    parser.add_argument("--sse-range", type=float, nargs=2, help="range of errors, where known")
    parser.add_argument("--priors", action="store_true", help="judge by other priors too")
    parser.add_argument("--json", type=Path, help="write the results, calibrated")
    parser.add_argument("--plot", type=Path, help="folder for a picture of each run that is wrong")
    options = parser.parse_args()
    robot = ft.load_robot(options.robot)
    priors = priors_of(robot, options.sse_range, options.onset)
    judged = Method("calibrated without the session")
    beside = _other_priors(robot) if options.priors else _other_methods()
    sessions = find_sessions(options.folder)
    healthy = [s for s in sessions if s.name.endswith(HEALTHY_LABELS)]
    truth: list[float] = []
    known: dict[tuple[Path, ...], Calibration] = {}
    for session in sessions:
        others = tuple(s for s in healthy if s != session)
        if others not in known:
            known[others] = _learn(others, robot)
        runs = ft.read_runs(session, robot, ft.ReadOptions(options.how, published_labels=True))
        if options.sag_as_held:
            moving = ft.read_runs(session, robot, ft.ReadOptions(options.how))
            runs = sagging_as_held(runs, moving, robot, known[others].imperfections.settling)
        truth += runs["magnitude"].values.tolist()
        for method in (judged, *beside):
            found = _diagnose(runs, robot, known[others], priors, method)
            method.found += found
            if method is judged and options.plot is not None:
                _plot_wrong(found, runs, robot, options.plot)
    print(f"{judged.name}: {score_line(Judged.of(judged.found))}")
    print(f"  {held_angles(judged.found, truth)}")
    for method in beside:
        print(f"{method.name}: {score_line(Judged.of(method.found))}")
        print(f"  {_compare(method.found, judged.found)}")
    for diagnosis in judged.found:
        if diagnosis.diagnosis != diagnosis.truth:
            print(f"  {diagnosis.run}: {diagnosis.truth}, said: {diagnosis.verdict}")
    if options.json is not None:
        write_json_lines(judged.found, options.json)


def _other_methods() -> list[Method]:
    return [
        Method("generic offsets", calibrated=False),
        Method("calibrated, settled poses alone", whole_run=False),
    ]


def _other_priors(robot: Robot) -> list[Method]:
    """Return the same method with one prior changed each."""
    told = {
        "stuck early 0.1 instead of 0.5": ft.Priors(OnsetPrior({"stuck": 0.1})),
        "stuck early 0.9": ft.Priors(OnsetPrior({"stuck": 0.9})),
        "errors before the run 0.5 instead of 0.9": ft.Priors(
            OnsetPrior({"steady_state_error": 0.5})
        ),
        "held angle unrelated 0.5 instead of 0.2": ft.Priors(OnsetPrior(free=0.5)),
        "one range, 3 to 100 counts": priors_of(robot, (3.0, 100.0), None),
        "10 to 50 counts alone": priors_of(robot, (10.0, 50.0), None),
        "healthy 30 times as probable": ft.Priors(healthy_odds=30.0),
    }
    return [Method(name, priors=priors) for name, priors in told.items()]


def _learn(sessions: tuple[Path, ...], robot: Robot) -> Calibration:
    runs = ft.read_runs(list(sessions), robot)
    return calibrate(runs, robot, "held out", "sessions that are not judged")


def sagging_as_held(
    runs: xr.Dataset, moving: xr.Dataset, robot: Robot, settling: Settling | None
) -> xr.Dataset:
    """Return runs whose motors sag in the pose with the stuck motor held.

    Args:
        runs: Runs of a session with a motor frozen afterwards; others are returned as they are.
        moving: The same runs as the healthy arm made them.
        robot: The robot.
        settling: How its motors settle; None: exactly at their targets.
    """
    stuck = [name.endswith(":stuck") for name in runs["fault"].values]
    if not all(stuck) or settling is None:
        return runs
    compliance = np.asarray(settling.compliance)
    held, free = as_floats(runs["position"].values), as_floats(moving["position"].values)
    more = [sag(robot, pose, compliance, settling.payload) for pose in (held, free)]
    position = np.where(held == free, held + more[0] - more[1], held)
    path = ft.DigitalTwin(robot).path(np.nan_to_num(position))
    path[np.isnan(position).any(axis=-1)] = np.nan
    return runs.assign(measured=(runs["measured"].dims, path))


def held_angles(found: Sequence[Diagnosis], truth: Sequence[float]) -> str:
    """Return how many 90 % intervals hold the angle of a stuck motor that was named rightly."""
    inside = [
        d.magnitude_90[0] <= angle <= d.magnitude_90[1]
        for d, angle in zip(found, truth, strict=True)
        if d.truth == d.diagnosis and str(d.truth).endswith(":stuck") and d.magnitude_90
    ]
    return f"held angles inside their 90 % intervals: {sum(inside)} of {len(inside)}"


def _diagnose(
    runs: xr.Dataset, robot: Robot, known: Calibration, priors: ft.Priors, method: Method
) -> list[Diagnosis]:
    diagnoser = ft.BayesDiagnoser(
        ft.DigitalTwin(robot),
        known.imperfections if method.calibrated else generic_imperfections(robot),
        priors=method.priors or priors,
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
        plot_runs(runs, found, ft.DigitalTwin(robot), folder, wrong)


if __name__ == "__main__":
    main()
