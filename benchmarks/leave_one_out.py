"""Diagnosis of labelled real sessions, each with a calibration that has not seen it.

    python benchmarks/leave_one_out.py FOLDER [--json FILE]

FOLDER holds session folders named ..._label_K. Those of labels 0 to 4 are logs of a healthy robot
and calibrate the twin, all but the session that is judged. The generic offsets of an uncalibrated
robot are judged beside it.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import failuretwin as ft
from failuretwin.app.calibrating import learn_robot
from failuretwin.app.results import Record, score_line, write_json_lines
from failuretwin.connection.calibration.calibration import Calibration
from failuretwin.data_knowledge.raw_session import find_sessions
from failuretwin.decision.priors import priors_of
from failuretwin.digital_model.imperfections import Imperfections, generic_imperfections
from failuretwin.digital_model.robot import Robot

HEALTHY_LABELS = tuple(f"label_{k}" for k in range(5))


def main() -> None:
    """Score the sessions of a folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--robot", default="armpi_fpv")
    parser.add_argument("--onset", type=float, help="onset of stuck faults, where known [s]")
    parser.add_argument("--sse-range", type=float, nargs=2, help="range of errors, where known")
    parser.add_argument("--json", type=Path, help="write the results, calibrated")
    options = parser.parse_args()
    robot = ft.load_robot(options.robot)
    priors = priors_of(robot, options.sse_range, options.onset)
    sessions = find_sessions(options.folder)
    healthy = [s for s in sessions if s.name.endswith(HEALTHY_LABELS)]
    known: dict[tuple[Path, ...], Calibration] = {}
    calibrated: list[Record] = []
    generic: list[Record] = []
    for session in sessions:
        others = tuple(s for s in healthy if s != session)
        if others not in known:
            known[others] = _learn(others, robot)
        runs = ft.read_runs(session, robot, ft.ReadOptions(published_labels=True))
        for records, imperfections in (
            (calibrated, known[others].imperfections),
            (generic, generic_imperfections(robot)),
        ):
            records += _diagnose(runs, robot, imperfections, priors)
    print(f"calibrated without the session: {score_line(calibrated)}")
    print(f"generic offsets:                {score_line(generic)}")
    for record in calibrated:
        if record["diagnosis"] != record["truth"]:
            print(f"  {record['run']}: {record['truth']}, said: {record['verdict']}")
    if options.json is not None:
        write_json_lines(calibrated, options.json)
        write_json_lines(generic, options.json.with_name(f"generic_{options.json.name}"))


def _learn(sessions: tuple[Path, ...], robot: Robot) -> Calibration:
    runs = ft.read_runs(list(sessions), robot)
    found, _ = learn_robot(runs, robot, "held out", "sessions that are not judged", None)
    return found


def _diagnose(
    runs: object, robot: Robot, imperfections: Imperfections, priors: ft.Priors
) -> list[Record]:
    import xarray as xr

    assert isinstance(runs, xr.Dataset)
    diagnoser = ft.BayesDiagnoser(ft.DigitalTwin(robot), imperfections, priors=priors)
    return [diagnosis.to_record() for diagnosis in diagnoser.diagnose(runs)]


if __name__ == "__main__":
    main()
